"""Start the tracker of one lens without depth: from its first frames on moving cameras, and never at rest.

    python -m benchmarks maps.starts ../shared/data [--only drives rest] [--seconds 60] [--seed 0]

``drives``: KITTI 06 and 00 forwards, backwards and at half rate, and rendered corridors.  Bars: >= 98 % of
the frames posed, the first pose within 8 frames, ATE (Sim(3)) <= 1.5 % of the path.
``rest``: one image of each of five scenes is repeated at 10 Hz with shake, changes of light and noise, with
and without a textured patch of 10 to 30 % of the image that moves before it.  A pose is a false start.  Bars:
0 false starts without a patch, and at most 1 of 5 with a patch.
``rotation``: one image of each of six scenes as a camera sees it that rotates about its centre, with the
right intrinsics and with wrong ones (focal length 5 or 7 % off, or a distortion that is not stated).  A pose
is a false start.  Bar: 0 false starts.
``planes``: a camera moves past a plane 2 m away: sideways, sideways with an oblique plane, and towards it.
The relative pose of the two views of the start is right if the translation is within 30 deg of the true one
and the rotation within 5 deg.  Bar: 9 of 9.

Frames between the two views of a start count as posed; the first posed frame is the first whose pose was
returned at once, counted from 1.  Poses are solved in this process as the service does.  Everything is
deterministic: n = 1, and load changes no figure.  The seed chooses images, patches, motions and corridors.

Defends the promise that one lens without depth is tracked, and that degenerate input never gives a pose.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, Recordings, benchmark
from benchmarks.frame.report import say
from benchmarks.one_image import (
    RATE_HZ,
    Scene,
    patch_of,
    photograph,
    resting_frames,
    rotating_frames,
    scene_of,
    swaying,
)
from benchmarks.recorded_drives import track
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import Frame
from client_sdk.simulator import World, make_world, render_along
from client_sdk.simulator.world import DEPTH_M, HEIGHT_M, ROOM_M, Face
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.geometry import inverse, rotation_angle_deg

# Parts of this benchmark, of which --only chooses some.
PARTS = ("drives", "rest", "rotation", "planes")
SCENES = (
    "7scenes_redkitchen", "tum_fr1_rpy_start", "euroc_mh01_start", "kitti_06_start", "rendered",
    "nyu_dining_room",
)  # fmt: skip
"""Recordings of which one image is shown; ``rendered`` is a room of the simulator.  The first five are shown
at rest, and the first three as planes."""

SWAY_DEG = 1.0  # amplitude of the rotation of a moving camera about each axis
SWAY_PERIOD_S = 2.0  # period of the rotation about y; the rotations about x and z have longer periods
PATCH_SHARES = (0.1, 0.15, 0.2, 0.25, 0.3)  # area of the patch over that of the image, for each scene at rest
# Number of frames of a camera that moves past a plane.
PLANE_FRAMES = 40
PLANE_PATH_M = 1.2  # distance that the camera moves past a plane, from the first to the last frame
WRONG_INTRINSICS = ((0.93, 0.0), (0.95, 0.0), (1.05, 0.0), (1.07, 0.0), (1.0, 0.1), (1.0, 0.2))
"""Stated focal length as a multiple of the true one, and radial distortion k1 of the images that is not
stated; one for each scene."""
OBLIQUE_DEG = (20.0, 30.0, 40.0)  # angle of an oblique plane with the image, one for each scene

RIGHT_DIRECTION_DEG = 30.0  # largest error of the direction of a right relative pose
RIGHT_ROTATION_DEG = 5.0  # largest error of the rotation of a right relative pose

CORRIDOR_ROOMS = 4  # length of a corridor in rooms of the simulator, 5 m each
CORRIDOR_WIDTH_M = (1.6, 3.0)  # width of the narrowest and of the widest corridor, metres
# Number of frames of a drive along a corridor.
CORRIDOR_FRAMES = 60
CORRIDOR_SPEED_M_S = (0.5, 1.5)  # speed of the slowest and of the fastest drive along a corridor
PAPER_TEXEL_M = ROOM_M / 1024  # the texture of a wallpaper has 1024 texels, so that it covers a room once
# Side, in texels, of the textures of pictures in a rendered world, by which pictures are found.
PICTURE_TEXELS = 256
PICTURE_EVERY_M = 1.5  # distance of the pictures along each wall


@benchmark(
    Bar("drives.*.posed_percent", at_least=98.0, unit="%"),
    Bar("drives.*.first_posed_frame", at_most=8),
    Bar("drives.*.ate_percent", at_most=1.5, unit="% of the path"),
    Bar("rest.false_starts", at_most=0),
    Bar("rest_with_patch.false_starts", at_most=1),
    Bar("rotation.false_starts", at_most=0),
    Bar("rotation_with_wrong_intrinsics.false_starts", at_most=0),
    Bar("planes.wrong", at_most=0),
)
def run_benchmark(
    *,
    data: Recordings,
    only: Annotated[tuple[str, ...], "parts to measure", PARTS] = PARTS,
    seconds: Annotated[float, "duration of each sequence at rest"] = 60.0,
    corridors: Annotated[int, "rendered corridors"] = 10,
    seed: Annotated[int, "chooses images, patches, motions and corridors"] = 0,
) -> dict[str, Any]:
    """Track the sequences of the parts."""
    figures: dict[str, Any] = {}
    if "drives" in only:
        rows = figures["drives"] = {}
        for name, frames, truth in drives(data, corridors, seed):
            rows[name] = row_of_drive(frames, truth)
            say(f"{name}: {rows[name]}")
    scenes = [scene_of(data, name, seed) for name in SCENES]
    if "rest" in only:
        count = round(seconds * RATE_HZ)
        still = {scene.name: resting_frames(scene, count, seed) for scene in scenes[:-1]}
        figures["rest"] = false_starts("rest", still)
        patched = {
            f"{scene.name}, {share:.0%}": resting_frames(scene, count, seed, patch_of(other, scene, share))
            for scene, other, share in zip(scenes[:-1], scenes[1:], PATCH_SHARES, strict=True)
        }
        figures["rest_with_patch"] = false_starts("rest with patch", patched)
    if "rotation" in only:
        rotating = {scene.name: rotating_frames(scene, seed) for scene in scenes}
        figures["rotation"] = false_starts("rotation", rotating)
        wrong = {
            f"{scene.name}, focal length x {factor:g}, k1 {k1:g}": rotating_frames(scene, seed, factor, k1)
            for scene, (factor, k1) in zip(scenes, np.roll(WRONG_INTRINSICS, seed, axis=0), strict=True)
        }
        figures["rotation_with_wrong_intrinsics"] = false_starts("rotation, wrong intrinsics", wrong)
    if "planes" in only:
        rows = {}
        for scene, degrees in zip(scenes, OBLIQUE_DEG, strict=False):
            for motion in ("sideways", f"oblique {degrees:g} deg", "towards"):
                name = f"{scene.name}, {motion}"
                tilt_deg = degrees if motion.startswith("oblique") else 0.0
                rows[name] = row_of_plane(scene, tilt_deg, 2 if motion == "towards" else 0, seed)
                say(f"plane {name}: {rows[name]}")
        figures["planes"] = {"wrong": sum(not row["is_right"] for row in rows.values()), "rows": rows}
    return figures


# --- Drives ---


def drives(data: Path, corridors: int, seed: int) -> Iterator[tuple[str, Iterable[Frame], Trajectory]]:
    """Yield the name of each drive, its frames and its true path."""
    for name, folder in (("KITTI 06", "kitti_06_start"), ("KITTI 00", "kitti_00_left_start")):
        dataset = open_dataset(data / folder, camera="left", imu=False)
        assert dataset.truth is not None
        yield f"{name} forwards", dataset, dataset.truth
        yield f"{name} backwards", *backwards(dataset, dataset.truth)
        half = replace(dataset, rows=dataset.rows[::2], timestamps_s=dataset.timestamps_s[::2])
        yield f"{name} at half rate", half, dataset.truth
    for number in range(corridors * seed, corridors * (seed + 1)):
        truth = corridor_path(number)
        yield f"corridor {number}", render_along(truth, make_corridor(number), (number, 3)), truth


def backwards(dataset: Dataset, truth: Trajectory) -> tuple[Iterator[Frame], Trajectory]:
    """Return the frames of a recording in reverse order, at increasing times, and their true path."""
    stamps_s = np.array(dataset.timestamps_s)
    reversed_s = (stamps_s[0] + stamps_s[-1] - stamps_s)[::-1]
    frames = (
        replace(dataset.read(row), timestamp_s=float(stamp_s))
        for row, stamp_s in zip(reversed(dataset.rows), reversed_s, strict=True)
    )
    return frames, Trajectory(reversed_s, truth.at(stamps_s)[::-1])


def make_corridor(seed: int) -> World:
    """Return a straight corridor along x with pictures on both walls, made of faces of furnished rooms.

    All faces look different: each has the wallpaper of another room, which repeats after 5 m.
    """
    world, rng = make_world(seed, rooms=3 * CORRIDOR_ROOMS), np.random.default_rng([seed, 4])
    floor, ceiling, wall = world.faces[:3]
    papers = [face for face in world.faces if (face.axis, face.offset, face.high[1]) == (1, 0.0, HEIGHT_M)]
    pictures = [face for face in world.faces if len(world.textures[face.texture]) == PICTURE_TEXELS]
    half_width_m, length_m = 0.5 * rng.uniform(*CORRIDOR_WIDTH_M), CORRIDOR_ROOMS * ROOM_M
    right, left = 0.5 * DEPTH_M - half_width_m, 0.5 * DEPTH_M + half_width_m
    faces: list[Face] = []
    # 1. Paper the floor and both walls of each room; the ceiling is plain.
    for room in range(CORRIDOR_ROOMS):
        skins = [papers[3 * room + number].texture for number in range(3)]
        begin, end = room * ROOM_M, (room + 1) * ROOM_M
        level = replace(floor, low=(begin, right), high=(end, left), room=room, texel_m=PAPER_TEXEL_M)
        upright = replace(wall, low=(begin, 0.0), high=(end, HEIGHT_M), room=room, texel_m=PAPER_TEXEL_M)
        faces += [
            replace(level, texture=skins[0]),
            replace(level, offset=HEIGHT_M, sign=-1, colour_0=ceiling.colour_0, colour_1=ceiling.colour_0),
            replace(upright, offset=right, sign=1, texture=skins[1]),
            replace(upright, offset=left, sign=-1, texture=skins[2]),
        ]
    last = CORRIDOR_ROOMS - 1
    faces.append(
        replace(wall, axis=0, offset=length_m, sign=-1, low=(right, 0.0), high=(left, HEIGHT_M), room=last)
    )
    # 2. Hang pictures of all sizes on both walls, 1 cm before them.
    order = iter(rng.permutation(len(pictures)))
    for along in np.arange(0.5, length_m - PICTURE_EVERY_M, PICTURE_EVERY_M):
        for y, sign in ((right, 1), (left, -1)):
            side_m, x, z = rng.uniform(0.4, 1.0), along + rng.uniform(0.0, 0.5), rng.uniform(0.6, 1.4)
            faces.append(
                replace(
                    pictures[next(order)], axis=1, offset=y + 0.01 * sign, sign=sign, low=(x, z),
                    high=(x + side_m, z + side_m), texel_m=side_m / PICTURE_TEXELS, room=int(x // ROOM_M),
                )
            )  # fmt: skip
    return World(tuple(faces), world.textures)


def corridor_path(seed: int, frames: int = CORRIDOR_FRAMES) -> Trajectory:
    """Return the path of a camera that drives along a corridor at a constant speed, and sways a little."""
    rng = np.random.default_rng([seed, 5])
    stamps_s = np.arange(frames) / RATE_HZ
    # x of the camera points to the right (-y of the world), y down (-z), and z along the corridor (x).
    R_world_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses = swaying(frames, np.full(3, SWAY_DEG), SWAY_PERIOD_S, rng)
    poses[:, :3, :3] = R_world_camera @ poses[:, :3, :3]
    poses[:, 0, 3] = 1.0 + rng.uniform(*CORRIDOR_SPEED_M_S) * stamps_s
    poses[:, 1, 3] = 0.5 * DEPTH_M + rng.uniform(-0.3, 0.3) + 0.05 * np.sin(stamps_s)
    poses[:, 2, 3] = 0.5 * HEIGHT_M + 0.01 * np.sin(3.0 * stamps_s)
    return Trajectory(stamps_s, poses)


def row_of_drive(frames: Iterable[Frame], truth: Trajectory) -> dict[str, Any]:
    """Track a drive; return its frames with a pose in the first segment, and their error."""
    tracker, first = MonocularTracker(), None
    for frame in frames:
        has_pose = track(tracker, frame).T_world_camera is not None
        first = tracker.frames if first is None and has_pose else first
    path = tracker.trajectory()
    ate_m = accuracy(path, truth, with_scale=True).ate_m if len(path) >= 3 else np.nan
    return {
        "frames": tracker.frames,
        "posed_percent": 100.0 * len(path) / tracker.frames,
        "first_posed_frame": first,
        "ate_percent": 100.0 * ate_m / truth.length_m,
        "segments": len(tracker.segments),
    }


# --- The start ---


def first_posed_frame(
    tracker: MonocularTracker, frames: Iterable[Frame]
) -> tuple[int | None, dict[str, int]]:
    """Track until the first pose; return the number of its frame, and how often each reason was given."""
    reasons = Counter[str]()
    for frame in frames:
        result = track(tracker, frame)
        if result.T_world_camera is not None:
            return tracker.frames, dict(reasons)
        reasons[re.sub(r"[0-9.]+", "N", result.reason)] += 1
    return None, dict(reasons)


def false_starts(part: str, sequences: dict[str, Iterator[Frame]]) -> dict[str, Any]:
    """Track cameras that do not move from their place; return how many got a pose."""
    rows: dict[str, Any] = {}
    for name, frames in sequences.items():
        first, reasons = first_posed_frame(MonocularTracker(), frames)
        rows[name] = {"first_posed_frame": first, "reasons": reasons}
        say(f"{part}, {name}: {rows[name]}")
    starts = sum(row["first_posed_frame"] is not None for row in rows.values())
    return {"n": len(rows), "false_starts": starts, "rows": rows}


def row_of_plane(scene: Scene, tilt_deg: float, axis: int, seed: int) -> dict[str, Any]:
    """Move a camera along an axis past a plane; return the error of the relative pose of the start."""
    rng = np.random.default_rng([seed, 7])
    poses = swaying(PLANE_FRAMES, np.full(3, SWAY_DEG), SWAY_PERIOD_S, rng)
    poses[:, axis, 3] = PLANE_PATH_M * np.linspace(-0.5, 0.5, PLANE_FRAMES)
    frames = (photograph(scene, pose, number, rng, tilt_deg=tilt_deg) for number, pose in enumerate(poses))
    tracker = MonocularTracker()
    first, reasons = first_posed_frame(tracker, frames)
    if first is None:
        return {"first_posed_frame": None, "is_right": False, "reasons": reasons}
    path = tracker.trajectory()
    views = np.rint(path.timestamps_s[[0, -1]] * RATE_HZ).astype(int)
    moved = inverse(path.T_world_camera[0]) @ path.T_world_camera[-1]
    truly_moved = inverse(poses[views[0]]) @ poses[views[1]]
    along, truly_along = (T[:3, 3] / np.linalg.norm(T[:3, 3]) for T in (moved, truly_moved))
    direction_deg = float(np.degrees(np.arccos(np.clip(along @ truly_along, -1.0, 1.0))))
    rotation_deg = rotation_angle_deg(moved[:3, :3].T @ truly_moved[:3, :3])
    return {
        "first_posed_frame": first,
        "direction_error_deg": direction_deg,
        "rotation_error_deg": rotation_deg,
        "is_right": direction_deg <= RIGHT_DIRECTION_DEG and rotation_deg <= RIGHT_ROTATION_DEG,
    }
