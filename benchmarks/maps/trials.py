"""Measure whether the tracker finds a known place again: lens covered, part cut out, camera moved elsewhere.

Each trial follows a camera up to a moment, interrupts it, and shows what comes then for 3 s:

* covered: the lens is covered for 3 s, while the camera moves on;
* cut: 5 s are cut out of the video, whose stamps go on as if nothing were missing;
* moved: the camera is elsewhere in what it has seen, 0.3 m or 20 degrees away; of its images no map was made,
  but of those between them.

An image shows a mapped place if one image that had a pose before the interruption saw half of its depths,
from directions within 20 degrees and at 2/3 to 1.5 times the distances: by the true poses, whatever the
tracker says.  A trial is judged if one does, and images for 1 s follow it.

Defends: at least 100 trials judged; in each of them a pose within 1 s of the first image that shows a mapped
place, in the first segment or in one that is joined to it; 0 poses wrong by 20 cm or 5 degrees.  The truth is
interpolated to the images, and the map is laid on it by the images before the interruption.  fr1/xyz, redwood
and NYU are too short to be cut: their lens is covered, and then the later images, or the ones before, are
shown to and fro.  Poses are solved in this process as the service does; n = 1, and load changes no figure.

    python -m benchmarks maps.trials --recordings ../shared/data --out trials.json
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from benchmarks.frame.registry import Bar, Recordings, benchmark
from benchmarks.frame.report import say
from benchmarks.maps.recordings import RED_KITCHEN, track
from benchmarks.maps.tracking import hard_drive, poses_of
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame, FrontEndOptions, TrackedFrame
from client_sdk.simulator import render_along
from client_sdk.simulator.drive import loop_trajectory
from client_sdk.simulator.world import make_world
from client_sdk.tracking.tracker import Tracker
from rse_pf.geometry import Array, Camera, inverse, pose_difference, transform

__all__ = ["Depths", "Scene", "Shown", "Trial", "interruptions", "judge", "share_seen"]

_COVERED_S, _CUT_S, _SHOWN_S, _RELOCALISE_S = 3.0, 5.0, 3.0, 1.0
_WRONG_M, _WRONG_DEG = 0.2, 5.0
_ELSEWHERE_M, _ELSEWHERE_DEG = 0.3, 20.0
_SEEN_SHARE, _SEEN_COSINE, _SEEN_NEARER, _SEEN_DEPTH = 0.5, 0.94, 1.5, 0.1
_EVERY_PX, _SPARSE = 8, 5
_LEAST_JUDGED = 100
_LONG = (
    (RED_KITCHEN, 1, 4.0, 1.0), (RED_KITCHEN, 2, 4.0, 1.0),
    ("tum_fr1_rpy_start", 2, 2.0, 0.5), ("tum_fr1_rpy_start", 3, 2.25, 0.5),
)  # fmt: skip
_SHORT = (
    ("tum_fr1_xyz_start", 1, 0.1, 0.066), ("redwood_living_room", 1, 0.03, 0.033),
    ("nyu_dining_room", 1, 1.0, 1.0),
)  # fmt: skip
"""Recordings, one of how many images are mapped, and in seconds when trials begin, and how far apart."""
_WORLD_FRAMES, _WORLD_STEP_M, _WORLD_HZ, _WORLD_SEEDS = 160, 0.034, 10.0, (10, 11, 12)
_HARD_BEGINS_S, _HARD_HZ = (0.0, 2.5), 20.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Depths:
    """The depths of an image at every eighth pixel, metres, 0 where there is none, and its true pose."""

    depths_m: npt.NDArray[np.float32]
    T_world_camera: Array
    camera: Camera

    def points_world(self) -> Array:
        """Return ``(n, 3)`` points of every fifth row and column."""
        depths_m = self.depths_m[::_SPARSE, ::_SPARSE]
        rows, columns = np.nonzero(depths_m > 0)
        z, step, camera = depths_m[rows, columns].astype(float), _SPARSE * _EVERY_PX, self.camera
        x, y = (columns * step - camera.cx) / camera.fx, (rows * step - camera.cy) / camera.fy
        return transform(self.T_world_camera, np.column_stack([x * z, y * z, z]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """Images that can be shown in any order, with their stamps and ``(n, 4, 4)`` true poses.

    The map is made of every *every*-th image, and trials begin every *step_s* from *first_s* on.  Nothing can
    be cut out of a scene that ``is_short``.
    """

    read: Callable[[int], Frame]
    stamps_s: Array
    T_world_camera: Array
    every: int
    first_s: float = 4.0
    step_s: float = 1.0
    is_short: bool = False
    options: FrontEndOptions | None = None

    @property
    def interval_s(self) -> float:
        """The time from one tracked image to the next."""
        return self.every * float(np.median(np.diff(self.stamps_s)))

    def depths(self, row: int, frame: Frame) -> Depths:
        """Return the depths of an image that was read."""
        return Depths(
            depths_m=frame.depth_m[::_EVERY_PX, ::_EVERY_PX],
            T_world_camera=self.T_world_camera[row],
            camera=frame.camera,
        )


@dataclass(frozen=True, slots=True)
class Shown:
    """One image of a trial: its row, None while the lens is covered, and the stamp that it bears."""

    row: int | None
    stamp_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What came of one interruption.

    ``first_s`` is when an image showed a mapped place first, None if none did; ``found_s`` when the first
    right pose came from then on; ``last_s`` the stamp of the last image; ``wrong`` are the errors of wrong
    poses, in metres and degrees.
    """

    scene: str
    kind: str
    at_s: float
    first_s: float | None
    found_s: float | None
    last_s: float
    wrong: tuple[tuple[float, float], ...]

    @property
    def is_judged(self) -> bool:
        """Whether an image showed a mapped place, and others for 1 s after it."""
        return self.first_s is not None and self.last_s - self.first_s >= _RELOCALISE_S - 1e-6

    @property
    def is_found(self) -> bool:
        """Whether a pose came within 1 s of it."""
        if self.first_s is None or self.found_s is None:
            return False
        return self.found_s - self.first_s <= _RELOCALISE_S + 1e-6


def share_seen(image: Depths, other: Depths) -> float:
    """Return which share of an image's depths another one saw, from much the same direction and distance."""
    points_world = image.points_world()
    if not len(points_world):
        return 0.0
    points, camera = transform(inverse(other.T_world_camera), points_world), other.camera
    here, there = (points_world - seen.T_world_camera[:3, 3] for seen in (image, other))
    here_m, there_m = np.linalg.norm(here, axis=1), np.linalg.norm(there, axis=1)
    z = np.maximum(points[:, 2], 1e-3)
    columns = np.rint((camera.fx * points[:, 0] / z + camera.cx) / _EVERY_PX)
    rows = np.rint((camera.fy * points[:, 1] / z + camera.cy) / _EVERY_PX)
    height, width = other.depths_m.shape
    is_inside = (points[:, 2] > 1e-3) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    at = np.where(is_inside, rows, 0).astype(int), np.where(is_inside, columns, 0).astype(int)
    is_seen = (
        is_inside
        & (np.abs(other.depths_m[at] - z) < _SEEN_DEPTH * z)
        & ((here * there).sum(axis=1) > _SEEN_COSINE * here_m * there_m)
        & (here_m < _SEEN_NEARER * there_m)
        & (there_m < _SEEN_NEARER * here_m)
    )
    return float(is_seen.mean())


def interruptions(scene: Scene, row: int) -> Iterator[tuple[str, list[Shown]]]:
    """Yield the kinds of interruption after an image, and what is shown then."""
    interval_s, now_s = scene.interval_s, float(scene.stamps_s[row])
    steps = range(1, round(_COVERED_S / interval_s) + 1)
    covered = [Shown(None, now_s + interval_s * step) for step in steps]
    if scene.is_short:
        for others in (range(row + 1, len(scene.stamps_s)), range(row - 1, -1, -1)):
            if others:
                to_and_fro = [*others, *others[::-1]] * len(steps)
                yield "covered", covered + _continued(scene, to_and_fro, covered[-1].stamp_s)
        return
    every = range(row % scene.every, len(scene.stamps_s), scene.every)
    while_covered = [other for other in every if scene.stamps_s[other] > now_s + _COVERED_S]
    if while_covered:
        yield "covered", covered + _continued(scene, while_covered, covered[-1].stamp_s)
    after_cut = [other for other in every if scene.stamps_s[other] > now_s + _CUT_S]
    if after_cut:
        yield "cut", _continued(scene, after_cut, now_s)
    between = range(scene.every // 2, row, scene.every) if scene.every > 1 else ()
    elsewhere = [other for other in between if _is_elsewhere(scene, row, other)]
    if elsewhere:
        begin = elsewhere[int(np.random.default_rng([row, len(scene.stamps_s)]).integers(len(elsewhere)))]
        yield "moved", _continued(scene, range(begin, row, scene.every), now_s)


def judge(
    trial: Trial,
    shown: Sequence[Shown],
    poses: Sequence[Array | None],
    true_poses: Sequence[Array | None],
    is_mapped: Sequence[bool],
) -> Trial:
    """Return *trial* with what came of it.

    Args:
        trial: Its scene, kind and time.
        shown: Its images.
        poses: Theirs in the first segment, laid on the truth; None without one.
        true_poses: None while the lens is covered: any pose is wrong then.
        is_mapped: Whether each shows a mapped place.
    """
    first_s, found_s, wrong = None, None, []
    for image, pose, true_pose, is_known in zip(shown, poses, true_poses, is_mapped, strict=True):
        if is_known and first_s is None:
            first_s = image.stamp_s
        if pose is None:
            continue
        error_m, error_deg = (np.inf, np.inf) if true_pose is None else pose_difference(pose, true_pose)
        if error_m >= _WRONG_M or error_deg >= _WRONG_DEG:
            wrong.append((round(error_m, 3), round(error_deg, 2)))
        elif first_s is not None and found_s is None:
            found_s = image.stamp_s
    return replace(trial, first_s=first_s, found_s=found_s, wrong=tuple(wrong))


def trials(name: str, scene: Scene) -> Iterator[Trial]:
    """Map a scene, and yield the trials that begin at each of its moments, with the map of that moment."""
    tracker = Tracker(scene.options)
    rows = range(0, len(scene.stamps_s), scene.every)
    seen: dict[int, Depths] = {}
    tracked: list[TrackedFrame] = []
    due_s = scene.stamps_s[0] + scene.first_s
    for row in rows:
        frame = scene.read(row)
        seen[row] = scene.depths(row, frame)
        tracked.append(_without_images(track(tracker, frame)))
        if scene.stamps_s[row] < due_s - 1e-6:
            continue
        due_s += scene.step_s
        before = zip(rows, poses_of(tracked, tracker.joins), strict=False)
        posed = {mapped: pose for mapped, pose in before if pose is not None}
        if not posed:
            continue
        T_truth_map = _mean_pose([scene.T_world_camera[mapped] @ inverse(T) for mapped, T in posed.items()])
        for kind, shown in interruptions(scene, row):
            at_s = round(float(scene.stamps_s[row] - scene.stamps_s[0]), 3)
            trial = Trial(
                scene=name,
                kind=kind,
                at_s=at_s,
                first_s=None,
                found_s=None,
                last_s=shown[-1].stamp_s,
                wrong=(),
            )
            branch, after, is_mapped = copy.deepcopy(tracker), list(tracked), []
            for image in shown:
                shot = _covered(frame) if image.row is None else scene.read(image.row)
                after.append(_without_images(track(branch, replace(shot, timestamp_s=image.stamp_s))))
                depths = None if image.row is None else scene.depths(image.row, shot)
                is_mapped.append(
                    depths is not None
                    and any(share_seen(depths, seen[mapped]) >= _SEEN_SHARE for mapped in posed)
                )
            poses = poses_of(after, branch.joins)[len(tracked) :]
            yield judge(
                trial,
                shown,
                [None if pose is None else T_truth_map @ pose for pose in poses],
                [None if image.row is None else scene.T_world_camera[image.row] for image in shown],
                is_mapped,
            )


def scenes(recordings: Path) -> Iterator[tuple[str, Callable[[], Scene]]]:
    """Yield the name of each recording and rendered world, and what makes its scene."""
    for name, every, first_s, step_s in _LONG:
        yield f"{name}, 1 of {every}", partial(_recorded, recordings, name, every, first_s, step_s)
    for name, every, first_s, step_s in _SHORT:
        yield name, partial(_recorded, recordings, name, every, first_s, step_s, is_short=True)
    for seed in _WORLD_SEEDS:
        yield f"rendered world {seed}", partial(_rendered, seed)
    for seed, begin_s in enumerate(_HARD_BEGINS_S):
        yield f"hard world {seed}", partial(_turning, recordings, seed, begin_s)


@benchmark(
    Bar("all.judged", at_least=_LEAST_JUDGED),
    Bar("all.not_found", equals=0),
    Bar("all.wrong_poses", equals=0),
)
def run_benchmark(
    *,
    recordings: Recordings = Path("../shared/data"),
    only: Annotated[str, "scenes whose name holds this"] = "",
) -> dict[str, Any]:
    """Interrupt every scene at every moment, and count by scene and kind."""
    results: list[Trial] = []
    counts: dict[str, Any] = {}
    for name, make in scenes(recordings):
        if only in name:
            came = list(trials(name, make()))
            results += came
            counts[name] = _counted(came)
            say({"scene": name, **counts[name]})
    for kind in ("covered", "cut", "moved"):
        counts[kind] = _counted([trial for trial in results if trial.kind == kind])
    failed = [trial for trial in results if trial.wrong or (trial.is_judged and not trial.is_found)]
    return {"all": _counted(results), "counts": counts, "failed": [asdict(trial) for trial in failed]}


def _counted(came: list[Trial]) -> dict[str, int]:
    judged = [trial for trial in came if trial.is_judged]
    found = sum(trial.is_found for trial in judged)
    wrong = [trial for trial in came if trial.wrong]
    return {
        "tried": len(came), "judged": len(judged), "not_found": len(judged) - found,
        "wrong_poses": sum(len(trial.wrong) for trial in wrong), "trials_with_wrong_poses": len(wrong),
    }  # fmt: skip


def _recorded(
    recordings: Path, name: str, every: int, first_s: float, step_s: float, *, is_short: bool = False
) -> Scene:
    dataset = open_dataset(recordings / name)
    assert dataset.truth is not None
    stamps_s = np.array(dataset.timestamps_s)
    return Scene(
        read=lambda row: dataset.read(dataset.rows[row]),
        stamps_s=stamps_s,
        T_world_camera=dataset.truth.at(stamps_s),
        every=every,
        first_s=first_s,
        step_s=step_s,
        is_short=is_short,
        options=FrontEndOptions.wide_baseline() if name.startswith("nyu") else None,
    )


def _rendered(seed: int) -> Scene:
    path = loop_trajectory(2.0 * seed, _WORLD_FRAMES, seed, step_m=_WORLD_STEP_M)
    frames = list(render_along(path, make_world(seed), (seed, 77)))
    stamps_s = np.arange(_WORLD_FRAMES) / _WORLD_HZ
    return Scene(read=frames.__getitem__, stamps_s=stamps_s, T_world_camera=path.T_world_camera, every=2)


def _turning(recordings: Path, seed: int, begin_s: float) -> Scene:
    turning = open_dataset(recordings / "tum_fr1_rpy_start")
    assert turning.truth is not None
    drive = hard_drive(turning.truth, turning.timestamps_s[0] + begin_s, seed, rate_hz=_HARD_HZ)
    frames = list(drive.frames)
    return Scene(
        read=frames.__getitem__, stamps_s=np.array(drive.stamps_s), T_world_camera=drive.truth.T_world_camera,
        every=2, first_s=1.5, step_s=0.5,
    )  # fmt: skip


def _continued(scene: Scene, rows: Sequence[int], last_s: float) -> list[Shown]:
    """Return images for 3 s, whose stamps go on from that of the last one."""
    count = min(len(rows), round(_SHOWN_S / scene.interval_s))
    return [Shown(rows[step], last_s + scene.interval_s * (step + 1)) for step in range(count)]


def _is_elsewhere(scene: Scene, row: int, other: int) -> bool:
    apart_m, apart_deg = pose_difference(scene.T_world_camera[row], scene.T_world_camera[other])
    return apart_m >= _ELSEWHERE_M or apart_deg >= _ELSEWHERE_DEG


def _covered(frame: Frame) -> Frame:
    """Return what a covered lens shows: black, without depth."""
    return replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))


def _without_images(tracked: TrackedFrame) -> TrackedFrame:
    """Return a result whose images take no memory."""
    return replace(tracked, frame=None)  # type: ignore[arg-type]


def _mean_pose(poses: Sequence[Array]) -> Array:
    """Return the mean of poses that differ little."""
    mean: Array = np.mean(poses, axis=0)
    U, _, Vt = np.linalg.svd(mean[:3, :3])
    mean[:3, :3] = U @ Vt
    return mean
