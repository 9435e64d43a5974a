"""Drive a robot on wheels through rendered buildings: what wheel odometry adds to a camera with depth.

    python -m benchmarks maps.wheels [--only covers] [--drives 3] [--first 3]

``drives``: drives of 60 to 120 m in three buildings.  ATE of the base with camera and wheels, compared with
the camera alone and with the wheels alone, over the frames that have a pose by the camera alone.
``lies``: the same frames with wheels that lie: from the start in drives with an even number, after 10 s in
others.  The time until the mapper names the fault counts only while the robot moves.
``covers``: the lens is covered for 5 s while the robot drives.  The error gained is that of the motion of the
base from the last frame before the cover to the last covered one.
``repeats``: the camera gives the same image with new stamps for 5 s while the robot drives.
``cpu``: CPU time of a frame with and without wheels, by two mappers that take turns.

Each wheel slips by 5 % at random in each step of 40 ms, and has a radius that is wrong by 1 %.  Images are of
320x240 px at 5 Hz, and the robot drives at most at 0.7 m/s.  Poses are solved in this process as the service
does.  Everything but ``cpu`` is deterministic; the number of a drive is its seed.
"""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, get_args

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.recorded_drives import answer
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.mapper import Mapper
from client_sdk.simulator.base import STEP_S, T_BASE_CAMERA, BaseDrive, Lie, drive_route, render_base
from client_sdk.simulator.building import BUILDINGS, Building, make_building
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.geometry import Array, inverse

PARTS = ("drives", "lies", "covers", "repeats", "cpu")
LIES: tuple[Lie, ...] = tuple(lie for lie in get_args(Lie) if lie != "none")
LIED_DRIVES = 3  # drives on which all lies are tried: one for each building
LATER_LIE_S = 10.0  # time after which the wheels lie in drives with an odd number
MOVING_M = 0.01  # a robot moves from one frame to the next if a wheel turns this far
INTERRUPTION_FRAMES = 25  # frames for which the lens is covered or the image repeated: 5 s
FRAMES_BEFORE = (60, 90)  # fewest and most frames before that: 12 to 18 s
FRAMES_AFTER = 15  # frames after that: 3 s
INTERRUPTED_ROUTE_M = 25.0  # length of a route on which an interruption fits
DARK_NOISE = 3  # largest grey level of the image of a covered lens
CPU_FRAMES = 300  # frames whose CPU time is measured

Readings = list[list[OdometryReading]]
"""For each frame, the readings since the frame before."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A drive with its rendered frames; *truth* has the exact poses of the base in the building."""

    name: str
    seed: int
    frames: list[Frame]
    truth: Trajectory
    driven: BaseDrive

    def readings(self, lie: Lie = "none", lies_after_s: float = 0.0) -> Readings:
        """Return the readings of the wheels for each frame."""
        batches = self.driven.odometry(self.seed, lie=lie, lies_after_s=lies_after_s)
        return [
            [OdometryReading(timestamp_s=stamp_s, T_odom_base=pose) for stamp_s, pose in batch]
            for batch in batches[: len(self.frames)]
        ]

    def true_motion(self, first: int, last: int) -> Array:
        """Return the pose of the base at frame *last* in its frame at frame *first*."""
        poses = self.truth.T_world_camera
        T_first_last: Array = inverse(poses[first]) @ poses[last]
        return T_first_last


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """What a mapper returned for the frames of a drive.

    Attributes:
        tracked: The result of each frame.
        poses: Pose of the base for each frame at the end of the drive, after all corrections; where the
            trajectory has none, the pose that the wheels carried; None without either.
        troubles: `Mapper.odometry_trouble` after each frame.
    """

    tracked: list[TrackedFrame]
    poses: list[Array | None]
    troubles: list[str]


@functools.cache
def building_of(number: int) -> Building:
    """Return the building of a number, with the textures of seed 0."""
    return make_building(BUILDINGS[number % len(BUILDINGS)], 0)


def make_drive(seed: int, length_m: float, frames: int | None = None) -> Drive:
    """Render a drive along a route of a length, or its first *frames* frames."""
    building = building_of(seed)
    driven = drive_route(building, building.route(seed, length_m))
    truth = driven.truth
    truth = Trajectory(truth.timestamps_s[:frames], truth.T_world_camera[:frames])
    return Drive(
        name=f"{BUILDINGS[seed % len(BUILDINGS)]} {seed}",
        seed=seed,
        frames=list(render_base(building, truth, (seed, 37))),
        truth=truth,
        driven=driven,
    )


def make_mapper() -> Mapper:
    """Return a mapper of the camera on the base, whose poses are solved in this process."""
    return Mapper(ask=answer, T_base_camera=T_BASE_CAMERA, adds_frames=False)


async def _track(mapper: Mapper, frames: Sequence[Frame], readings: Readings | None) -> Run:
    tracked, troubles = [], []
    for row, frame in enumerate(frames):
        odometry = () if readings is None else readings[row]
        tracked.append(await mapper.track(frame, odometry=odometry))
        troubles.append(mapper.odometry_trouble)
    path = mapper.trajectory
    T_camera_base = inverse(T_BASE_CAMERA)
    corrected = dict(zip(path.timestamps_s.tolist(), path.T_world_camera @ T_camera_base, strict=True))
    carried = [each.T_world_base if each.pose_source == "odometry" else None for each in tracked]
    poses = [corrected.get(frame.timestamp_s, pose) for frame, pose in zip(frames, carried, strict=True)]
    return Run(tracked=tracked, poses=poses, troubles=troubles)


def run(frames: Sequence[Frame], readings: Readings | None = None) -> Run:
    """Track frames by a mapper, with the readings of wheels or without."""
    return asyncio.run(_track(make_mapper(), frames, readings))


def ate_cm(drive: Drive, poses: Sequence[Array | None], rows: Sequence[int]) -> float | None:
    """Return the ATE of the base over the frames *rows*; None if one of them has no pose."""
    chosen = [poses[row] for row in rows]
    if any(pose is None for pose in chosen):
        return None
    estimate = Trajectory(drive.truth.timestamps_s[list(rows)], np.array(chosen))
    return 100.0 * accuracy(estimate, drive.truth).ate_m


def ratio(value: float | None, base: float | None) -> float | None:
    """Return *value* over *base* to three digits; None without either."""
    return None if value is None or base is None else round(value / base, 3)


def wheel_poses(readings: Readings) -> list[Array]:
    """Return ``T_odom_base`` at each frame, at whose time the last reading of its batch is."""
    return [np.eye(4), *(batch[-1].T_odom_base for batch in readings[1:])]


# --- Drives, and wheels that lie ---


def row_of_drive(drive: Drive, alone: Run) -> dict[str, Any]:
    """Return the errors of a drive with camera and wheels, and with either alone."""
    readings = drive.readings()
    both = run(drive.frames, readings)
    common = [row for row, pose in enumerate(alone.poses) if pose is not None]
    camera_cm = ate_cm(drive, alone.poses, common)
    wheels_cm = ate_cm(drive, wheel_poses(readings), common)
    both_cm = ate_cm(drive, both.poses, common)
    return {
        "drive": drive.name,
        "length_m": drive.truth.length_m,
        "frames": len(drive.frames),
        "collisions": drive.driven.collisions,
        "camera_ate_cm": camera_cm,
        "wheels_ate_cm": wheels_cm,
        "both_ate_cm": both_cm,
        "both_ate_of_all_frames_cm": ate_cm(drive, both.poses, range(len(drive.frames))),
        "ratio_to_camera": ratio(both_cm, camera_cm),
        "ratio_to_wheels": ratio(both_cm, wheels_cm),
        "frames_without_pose_by_camera_alone": len(drive.frames) - len(common),
        "frames_by_odometry": rows_of_source(both, "odometry"),
        "frames_lost": rows_of_source(both, "lost"),
        "trouble": next(filter(None, both.troubles), ""),
    }


def rows_of_source(run: Run, source: str) -> list[int]:
    """Return the rows of the frames whose pose has a source."""
    return [row for row, tracked in enumerate(run.tracked) if tracked.pose_source == source]


def row_of_lie(drive: Drive, alone: Run, lie: Lie) -> dict[str, Any]:
    """Return when a lie of the wheels was named, and the error compared with the camera alone."""
    begin_s = LATER_LIE_S if drive.seed % 2 else 0.0
    lied = run(drive.frames, drive.readings(lie, begin_s))
    common = [row for row, pose in enumerate(alone.poses) if pose is not None]
    camera_cm, lied_cm = ate_cm(drive, alone.poses, common), ate_cm(drive, lied.poses, common)
    stamps_s = drive.truth.timestamps_s
    named = next((row for row, trouble in enumerate(lied.troubles) if trouble), None)
    return {
        "drive": drive.name,
        "lie": lie,
        "begin_s": begin_s,
        "named_s": None if named is None else moving_s(drive, begin_s, float(stamps_s[named])),
        "named_too_early": named is not None and bool(stamps_s[named] < begin_s),
        "trouble": "" if named is None else lied.troubles[named],
        "trouble_at_end": lied.troubles[-1],
        "camera_ate_cm": camera_cm,
        "lied_ate_cm": lied_cm,
        "ratio_to_camera": ratio(lied_cm, camera_cm),
    }


def moving_s(drive: Drive, begin_s: float, end_s: float) -> float:
    """Return for how long the robot moved between two times."""
    steps = slice(round(begin_s / STEP_S), round(end_s / STEP_S))
    is_moving = np.abs(drive.driven.wheels_m[steps]).max(axis=1) * 5 > MOVING_M
    return STEP_S * int(is_moving.sum())


def run_drives(numbers: Sequence[int], length_m: float, only: Sequence[str]) -> dict[str, Any]:
    """Run the parts that need long drives, of which each is rendered once."""
    rows: dict[str, Any] = {}
    lies: dict[str, Any] = {}
    figures: dict[str, Any] = {}
    for number in numbers:
        has_lies = "lies" in only and number < numbers[0] + LIED_DRIVES
        has_cpu = "cpu" in only and number == numbers[0]
        if "drives" not in only and not has_lies and not has_cpu:
            continue
        drive = make_drive(number, length_m)
        alone = run(drive.frames)
        if "drives" in only:
            say(rows.setdefault(drive.name, row_of_drive(drive, alone)))
        for lie in LIES if has_lies else ():
            say(lies.setdefault(f"{lie}, {drive.name}", row_of_lie(drive, alone, lie)))
        if has_cpu:
            say(figures.setdefault("cpu", cpu_of(drive)))
    if rows:
        figures["drives"] = {
            "rows": rows,
            "median_ratio_to_camera": median_of(rows, "ratio_to_camera"),
            "false_alarms": sum(bool(row["trouble"]) for row in rows.values()),
        }
    if lies:
        figures["lies"] = lies
    return figures


def median_of(rows: dict[str, Any], key: str) -> float | None:
    """Return the median of a figure of rows; None if a row has none."""
    values = [row[key] for row in rows.values()]
    return None if None in values else float(np.median(values))


# --- Interruptions of the camera ---


def cover(frame: Frame, _before: Frame, rng: np.random.Generator) -> Frame:
    """Return a frame as a covered lens gives it: dark, and without depth."""
    dark = rng.integers(0, DARK_NOISE + 1, frame.rgb.shape, dtype=np.uint8)
    return replace(frame, rgb=dark, depth_m=np.zeros_like(frame.depth_m))


def repeat(frame: Frame, before: Frame, _rng: np.random.Generator) -> Frame:
    """Return the frame *before* with the stamp of *frame*."""
    return replace(before, timestamp_s=frame.timestamp_s)


def interrupted_drive(
    seed: int, change: Callable[[Frame, Frame, np.random.Generator], Frame]
) -> tuple[Drive, int]:
    """Return a drive whose frames are changed for 5 s, and the first of these frames."""
    rng = np.random.default_rng([seed, 41])
    first = int(rng.integers(*FRAMES_BEFORE))
    drive = make_drive(seed, INTERRUPTED_ROUTE_M, first + INTERRUPTION_FRAMES + FRAMES_AFTER)
    frames = list(drive.frames)
    for row in range(first, first + INTERRUPTION_FRAMES):
        frames[row] = change(frames[row], frames[first - 1], rng)
    return replace(drive, frames=frames), first


def gained_cm(drive: Drive, poses: Sequence[Array | None], first: int, last: int) -> float | None:
    """Return the error of the position at frame *last*, as seen from the estimated pose at frame *first*."""
    begin, end = poses[first], poses[last]
    if begin is None or end is None:
        return None
    error_m = (inverse(begin) @ end - drive.true_motion(first, last))[:3, 3]
    return 100.0 * float(np.linalg.norm(error_m))


def row_of_cover(seed: int) -> dict[str, Any]:
    """Return the errors of a drive whose lens is covered for 5 s."""
    drive, first = interrupted_drive(seed, cover)
    readings = drive.readings()
    both = run(drive.frames, readings)
    last = first + INTERRUPTION_FRAMES - 1
    told = [tracked.T_world_base for tracked in both.tracked]
    covered = both.tracked[first : last + 1]
    stamps_s, part = drive.truth.timestamps_s, slice(first - 1, last + 1)
    return {
        "drive": drive.name,
        "first_covered": first,
        "driven_m": Trajectory(stamps_s[part], drive.truth.T_world_camera[part]).length_m,
        "gained_cm": gained_cm(drive, told, first - 1, last),
        "gained_by_wheels_cm": gained_cm(drive, wheel_poses(readings), first - 1, last),
        "covered_frames_without_odometry": [
            first + row for row, tracked in enumerate(covered) if tracked.pose_source != "odometry"
        ],
        **sigmas(drive, both.tracked[last], last),
        **figures_after(drive, both, last),
        "trouble": next(filter(None, both.troubles), ""),
    }


def sigmas(drive: Drive, tracked: TrackedFrame, row: int) -> dict[str, Any]:
    """Return the error of x and y in the world in standard deviations, and the larger of these (cm)."""
    if tracked.T_world_base is None or tracked.pose_covariance is None:
        return {"sigmas": None, "sigma_cm": None, "error_cm": None}
    error_m = (tracked.T_world_base - drive.true_motion(0, row))[:2, 3]
    covariance = tracked.pose_covariance[:2, :2]
    return {
        "sigmas": float(np.sqrt(error_m @ np.linalg.solve(covariance, error_m))),
        "sigma_cm": 100.0 * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])),
        "error_cm": 100.0 * float(np.linalg.norm(error_m)),
    }


def figures_after(drive: Drive, run: Run, last: int) -> dict[str, Any]:
    """Return when a pose is visual again after frame *last*, and the errors of the motion since then."""
    stamps_s = drive.truth.timestamps_s
    after = (row for row in rows_of_source(run, "visual") if row > last)
    back = next(after, None)
    end = drive.true_motion(0, len(drive.frames) - 1)
    pose = run.tracked[-1].T_world_base
    return {
        "visual_after_s": None if back is None else round(float(stamps_s[back] - stamps_s[last]), 3),
        "segment_at_end": run.tracked[-1].segment,
        "error_at_end_cm": None if pose is None else 100.0 * float(np.linalg.norm((pose - end)[:3, 3])),
    }


def row_of_repeat(seed: int) -> dict[str, Any]:
    """Return how a mapper with wheels takes an image that is repeated for 5 s."""
    drive, first = interrupted_drive(seed, repeat)
    both = run(drive.frames, drive.readings())
    last = first + INTERRUPTION_FRAMES - 1
    repeated = range(first, last + 1)
    visual = [row for row in repeated if both.tracked[row].pose_source == "visual"]
    named = next((row for row in repeated if row not in visual and both.tracked[row].reason), None)
    stamps_s = drive.truth.timestamps_s
    return {
        "drive": drive.name,
        "first_repeated": first,
        "named_s": None if named is None else round(float(stamps_s[named] - stamps_s[first]), 3),
        "reason": "" if named is None else both.tracked[named].reason,
        "visual_poses": len(visual),
        "visual_frames": visual,
        **sigmas(drive, both.tracked[last], last),
        **figures_after(drive, both, last),
        "trouble": next(filter(None, both.troubles), ""),
    }


def run_covers(numbers: Sequence[int]) -> dict[str, Any]:
    """Cover the lens in each of the drives."""
    rows: dict[str, Any] = {}
    for number in numbers:
        row = row_of_cover(number)
        say(rows.setdefault(row["drive"], row))
    gained = [row["gained_cm"] for row in rows.values()]
    by_wheels = [row["gained_by_wheels_cm"] for row in rows.values()]
    is_complete = None not in gained
    return {
        "rows": rows,
        "n": len(rows),
        "rms_ratio_to_wheels": float(np.linalg.norm(gained) / np.linalg.norm(by_wheels))
        if is_complete
        else None,
        "median_gained_cm": float(np.median(gained)) if is_complete else None,
        "median_gained_by_wheels_cm": float(np.median(by_wheels)),
        "outside_3_sigma": sum(row["sigmas"] is None or row["sigmas"] > 3.0 for row in rows.values()),
        "covered_frames_without_odometry": sum(
            len(row["covered_frames_without_odometry"]) for row in rows.values()
        ),
    }


def run_repeats(numbers: Sequence[int]) -> dict[str, Any]:
    """Repeat an image in each of the drives."""
    rows: dict[str, Any] = {}
    for number in numbers:
        row = row_of_repeat(number)
        say(rows.setdefault(row["drive"], row))
    return rows


# --- CPU time ---


def cpu_of(drive: Drive) -> dict[str, Any]:
    """Return the CPU time of a frame with wheels and without, by two mappers that take turns."""
    return asyncio.run(_cpu_of(drive))


async def _cpu_of(drive: Drive) -> dict[str, Any]:
    readings = drive.readings()
    mappers = (make_mapper(), make_mapper())
    times_s = np.zeros((min(CPU_FRAMES, len(drive.frames)), 2))
    for row, frame in enumerate(drive.frames[:CPU_FRAMES]):
        for has_wheels in (row % 2, 1 - row % 2):
            begin_s = time.process_time()
            await mappers[has_wheels].track(frame, odometry=readings[row] if has_wheels else ())
            times_s[row, has_wheels] = time.process_time() - begin_s
    alone_s, both_s = times_s.sum(axis=0)
    return {
        "drive": drive.name,
        "frames": len(times_s),
        "alone_ms": 1000.0 * float(alone_s) / len(times_s),
        "both_ms": 1000.0 * float(both_s) / len(times_s),
        "ratio": float(both_s / alone_s),
        "median_ratio": float(np.median(times_s[:, 1] / times_s[:, 0])),
    }


@benchmark(
    Bar("drives.median_ratio_to_camera", at_most=1.0),
    Bar("drives.rows.*.ratio_to_camera", at_most=1.2),
    Bar("drives.rows.*.ratio_to_wheels", at_most=0.2),
    Bar("drives.false_alarms", at_most=0, unit="drives"),
    Bar("lies.*.named_s", at_most=5.0, unit="s"),
    Bar("lies.*.ratio_to_camera", at_most=1.05),
    Bar("covers.rms_ratio_to_wheels", at_most=1.2),
    Bar("covers.outside_3_sigma", at_most=1, unit="of 20 drives"),
    Bar("covers.covered_frames_without_odometry", at_most=0, unit="frames"),
    Bar("covers.rows.*.visual_after_s", at_most=1.0, unit="s"),
    Bar("repeats.*.named_s", at_most=1.0, unit="s"),
    Bar("repeats.*.visual_poses", at_most=0, unit="poses"),
    Bar("cpu.ratio", at_most=1.05),
)
def run_benchmark(
    *,
    only: Annotated[tuple[str, ...], "parts to measure", PARTS] = PARTS,
    drives: Annotated[int, "long drives"] = 10,
    covers: Annotated[int, "drives with a covered lens"] = 20,
    repeats: Annotated[int, "drives with a repeated image"] = 10,
    first: Annotated[int, "number of the first drive of each part"] = 0,
    length_m: Annotated[float, "least length of a long drive, metres"] = 65.0,
) -> dict[str, Any]:
    """Run the parts."""
    figures = run_drives(range(first, first + drives), length_m, only)
    if "covers" in only:
        figures["covers"] = run_covers(range(first, first + covers))
    if "repeats" in only:
        figures["repeats"] = run_repeats(range(first, first + repeats))
    return figures
