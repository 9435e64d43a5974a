"""Drive where two places look the same, with the lens covered on the way: no pose may be in the wrong place.

    python -m benchmarks maps.twins [--drives 100] [--only rooms] [--first 0]

``rooms``: a building of five rooms in which the fourth is a copy of the second, 10 m away.  The robot drives
from the second room into its copy, where the lens is covered for 1 to 4 s while the robot drives on.
``known``: the robot has driven through the copy, turns back, and the lens is covered then.
``corridor``: a corridor that repeats every 5 m.  The lens is covered for 0.5 to 2.5 s.

Each drive is tracked with depth and without (one lens).  A jump is a drive with a pose that lies nearer to an
alias of its true place than to this place, after the scale of a drive without depth was fitted to its first
half.  Bar: 0 jumps, which defends the promise that degenerate input never gives a pose.  ``posed_percent``
counts the frames after the covered ones that have a pose in the first segment at the end.  Everything is
deterministic; the number of a drive is its seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.maps.starts import corridor_path, make_corridor
from benchmarks.maps.tracking import poses_of
from benchmarks.recorded_drives import track
from client_sdk.frontend import Frame
from client_sdk.simulator import RATE_HZ, World, loop_trajectory, make_world
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.simulator.world import ROOM_M, Face
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.tracker import Tracker
from rse_pf.geometry import Array, Camera

# Kinds of drives, of which --only chooses some.
KINDS = ("rooms", "known", "corridor")
# Intrinsics of the rendered camera, px.
CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)

ROOMS = 5  # number of rooms of the building
TWIN = 1  # index of the room that is copied
COPY = 3  # index of the copy of that room
STEP_M = 0.12  # distance that a robot moves between two frames: 0.6 m/s
COVERED_FRAMES = (5, 20)  # fewest and most frames for which the lens is covered in a room
FRAMES_AFTER = 25  # number of frames after those with a covered lens

CORRIDOR_PERIODS = 6  # length of the corridor in periods of 5 m
CORRIDOR_FRAMES = 110  # frames of a drive through the corridor, with those of the covered lens
CORRIDOR_COVERED_FRAMES = (5, 25)  # fewest and most frames for which the lens is covered in the corridor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A drive in which places look the same at the distance *alias_m*, metres, along x.

    The lens is covered in the frames from *covered_from* to before *covered_to*.
    """

    world: World
    stamps_s: Array
    T_world_camera: Array
    covered_from: int
    covered_to: int
    alias_m: float


@benchmark(
    Bar("*.depth.jumps", at_most=0),
    Bar("*.one_lens.jumps", at_most=0),
)
def run_benchmark(
    *,
    drives: Annotated[int, "drives of each kind"] = 100,
    only: Annotated[tuple[str, ...], "kinds to measure", KINDS] = KINDS,
    first: Annotated[int, "number of the first drive"] = 0,
) -> dict[str, Any]:
    """Track the drives of each kind with both trackers."""
    make = {"rooms": drive_between_rooms, "known": drive_in_known_room, "corridor": drive_in_corridor}
    figures: dict[str, Any] = {}
    for kind in only:
        rows: dict[str, list[dict[str, Any]]] = {"depth": [], "one_lens": []}
        for number in range(first, first + drives):
            drive = make[kind](number)
            frames = list(frames_of(drive, number))
            flat = [replace(frame, depth_m=np.zeros_like(frame.depth_m)) for frame in frames]
            start = drive.T_world_camera[0]
            rows["depth"].append(row_of(drive, Tracker(T_world_start=start), frames))
            rows["one_lens"].append(row_of(drive, MonocularTracker(T_world_start=start), flat))
            say(f"{kind} {number}: {rows['depth'][-1]}, one lens {rows['one_lens'][-1]}")
        figures[kind] = {
            camera: {
                "n": drives,
                "jumps": sum(row["is_jump"] for row in each),
                "posed_percent": float(np.mean([row["posed_percent"] for row in each])),
            }
            for camera, each in rows.items()
        }
        say(f"{kind}: {figures[kind]}")
    return figures


def shifted(face: Face, rooms: int) -> Face:
    """Return a face moved along x by a number of rooms."""
    by_m = rooms * ROOM_M
    if face.axis == 0:
        return replace(face, offset=face.offset + by_m, room=face.room + rooms)
    low, high = (face.low[0] + by_m, face.low[1]), (face.high[0] + by_m, face.high[1])
    return replace(face, low=low, high=high, room=face.room + rooms)


def drive_between_rooms(number: int) -> Drive:
    """Return a drive from a room into its copy, which was not seen before."""
    world, path = make_world(number, ROOMS), loop_trajectory(0.0, 400, number, ROOMS, step_m=STEP_M)
    faces = [face for face in world.faces if face.room != COPY]
    faces += [shifted(face, COPY - TWIN) for face in world.faces if face.room == TWIN]
    rng = np.random.default_rng([number, 21])
    in_copy = int(np.flatnonzero(path.T_world_camera[:, 0, 3] >= COPY * ROOM_M)[0])
    covered_from = in_copy + int(rng.integers(0, 15))
    covered_to = covered_from + int(rng.integers(*COVERED_FRAMES))
    rows = slice(0, covered_to + FRAMES_AFTER)
    return Drive(
        world=World(tuple(faces), world.textures),
        stamps_s=path.timestamps_s[rows],
        T_world_camera=path.T_world_camera[rows],
        covered_from=covered_from,
        covered_to=covered_to,
        alias_m=(COPY - TWIN) * ROOM_M,
    )


def drive_in_known_room(number: int) -> Drive:
    """Return a drive through the copy of a room and back, on which the lens is covered."""
    drive = drive_between_rooms(number)
    turn = int(np.flatnonzero(drive.T_world_camera[:, 0, 3] >= COPY * ROOM_M)[0]) + 30
    path = loop_trajectory(0.0, turn, number, ROOMS, step_m=STEP_M).T_world_camera
    covered = int(np.random.default_rng([number, 22]).integers(*COVERED_FRAMES))
    back = path[::-1][1 : 1 + covered + FRAMES_AFTER]
    poses = np.concatenate([path, back])
    return replace(
        drive, stamps_s=np.arange(len(poses)) / RATE_HZ, T_world_camera=poses, covered_from=turn,
        covered_to=turn + covered,
    )  # fmt: skip


def drive_in_corridor(number: int) -> Drive:
    """Return a drive along a corridor that repeats every 5 m."""
    corridor, path = make_corridor(number), corridor_path(number, CORRIDOR_FRAMES)
    period = [face for face in corridor.faces if face.room == 0]
    faces = [shifted(face, row) for row in range(CORRIDOR_PERIODS) for face in period]
    rng = np.random.default_rng([number, 23])
    covered = int(rng.integers(*CORRIDOR_COVERED_FRAMES))
    covered_to = CORRIDOR_FRAMES - FRAMES_AFTER
    return Drive(
        world=World(tuple(faces), corridor.textures),
        stamps_s=path.timestamps_s,
        T_world_camera=path.T_world_camera,
        covered_from=covered_to - covered,
        covered_to=covered_to,
        alias_m=ROOM_M,
    )


def frames_of(drive: Drive, number: int) -> Iterator[Frame]:
    """Yield the frames of a drive with depth."""
    renderer = Renderer(drive.world, CAMERA)
    for row, (stamp_s, pose) in enumerate(zip(drive.stamps_s, drive.T_world_camera, strict=True)):
        rng = np.random.default_rng([number, 24, row])
        colour, depth_m, cosine = renderer.draw(pose)
        if drive.covered_from <= row < drive.covered_to:
            colour, depth_m = np.zeros_like(colour), np.zeros_like(depth_m)
        yield Frame(
            timestamp_s=float(stamp_s),
            rgb=add_image_noise(colour, rng),
            depth_m=add_depth_noise(depth_m, cosine, rng),
            camera=CAMERA,
        )


def row_of(drive: Drive, tracker: Tracker | MonocularTracker, frames: list[Frame]) -> dict[str, Any]:
    """Track a drive; return whether a pose is at an alias, and the share of posed frames after the cover."""
    tracked = [track(tracker, frame) for frame in frames]
    truth = drive.T_world_camera[:, :3, 3]
    if isinstance(tracker, Tracker):
        poses = poses_of(tracked, tracker.joins)
        positions = np.array([np.full(3, np.nan) if pose is None else pose[:3, 3] for pose in poses])
    else:
        path, positions = tracker.trajectory(), np.full((len(frames), 3), np.nan)
        positions[np.searchsorted(drive.stamps_s, path.timestamps_s)] = path.positions
        moved, truly_moved = (each[: drive.covered_from // 2] - truth[0] for each in (positions, truth))
        unit_m = np.nansum(truly_moved * moved) / np.nansum(moved**2)
        positions = truth[0] + unit_m * (positions - truth[0])
    errors_m = np.linalg.norm(positions - truth, axis=1)
    after = slice(drive.covered_to, None)
    return {
        "is_jump": bool((errors_m > drive.alias_m / 2).any()),
        "posed_percent": round(100.0 * float(np.isfinite(errors_m[after]).mean())),
    }
