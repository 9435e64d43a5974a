"""Links of wide baselines: pairs of keyframes a gap apart, alone and as a live map believes them.

A drive is divided into two robots: one drives all of it before the other, which makes its keyframes a gap of
frames away from those that it is compared with.  Keyframes lie as far apart as a live map's, and each phase
of them is a run of its own.  A link is right within 5 cm and 5 degrees of the truth, off beyond 10 cm or
5 degrees, and wrong beyond 30 cm or 10 degrees.  Then frames of one half of the kitchen's drive are sought
among keyframes of the other half: of the nearest by their true poses, so that no place recognition is needed.

    python -m benchmarks live.wide_pairs --recordings ../shared/data [--features module:function]

The function is a features function of `client_sdk.slots`; a keyframe has as many of its features as it can
carry.  MH_01 has the depth of its rectified stereo pairs by block matching.

Defends: >= 15 % of the pairs 60 frames apart accepted and right with ORB, and no wrong link believed.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, Recordings, benchmark
from benchmarks.frame.report import say
from benchmarks.maps.recordings import red_kitchen, track, truth_of
from benchmarks.maps.stereo import euroc_stereo
from client_sdk.frontend import Frame, FrontEndOptions, describe, points_at
from client_sdk.slots import FeaturesSlot, load_features
from client_sdk.tracking.tracker import Tracker
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.live_map.events import KeyframeAdded, LinksMeasured, MeasuredLink, matrix_bytes
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.pnp import DepthNoise
from rse_pf.slam.keyframe import (
    MAX_FEATURES,
    Keyframe,
    encode_keyframe,
    make_features,
    most_features,
)
from rse_pf.slam.localise import PlacedKeyframe, localise
from rse_pf.slam.relative_pose import Reference, RelativePose, View, measure_link

__all__ = [
    "Judged",
    "Sight",
    "judge_pairs",
    "kitchen_sights",
    "mh01_sights",
    "relocalise",
    "sights_of",
]

_FEATURES, _SENT = 1000, 870
_RIGHT_M, _RIGHT_DEG = 0.05, 5.0
_OFF_M, _WRONG_M, _WRONG_DEG = 0.1, 0.3, 10.0
_CANDIDATES = 12
_DRIVES = {
    "kitchen, 60 of 30 Hz": ("kitchen", 20, 5),
    "kitchen, 60 of 10 Hz": ("kitchen", 60, 5),
    "MH_01, 60 of 20 Hz": ("MH_01", 60, 10),
}
"""Recording, frames between the ends of a pair, frames from one keyframe to the next."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """One frame: its points, its image, its pose by odometry and its true one."""

    reference: Reference
    view: View
    T_odom_camera: Array
    T_world_camera: Array


@dataclass(slots=True, eq=False)
class Judged:
    """Pairs a gap apart: how many, the links among them, and those of them that a live map believes.

    Links are errors in metres and degrees; ``measure_ms`` is the CPU time of all pairs.
    """

    pairs: int = 0
    measure_ms: float = 0.0
    alone: list[tuple[float, float]] = field(default_factory=list)
    believed: list[tuple[float, float]] = field(default_factory=list)

    def count(self, links: Sequence[tuple[float, float]]) -> tuple[int, int, int]:
        """Return how many links are right, beyond 10 cm or 5 degrees, and wrong."""
        return (
            sum(metres <= _RIGHT_M and degrees <= _RIGHT_DEG for metres, degrees in links),
            sum(metres > _OFF_M or degrees > _RIGHT_DEG for metres, degrees in links),
            sum(metres > _WRONG_M or degrees > _WRONG_DEG for metres, degrees in links),
        )

    def row(self, links: Sequence[tuple[float, float]]) -> dict[str, float]:
        """Return the counts as figures."""
        right, off, wrong = self.count(links)
        share = 100.0 * right / self.pairs
        return {"links": len(links), "right": right, "right_percent": share, "off": off, "wrong": wrong}


def kitchen_sights(recordings: Path, slot: FeaturesSlot | None = None) -> list[Sight]:
    """Return the red kitchen's frames, 10 Hz."""
    dataset = red_kitchen(recordings)
    frames = [dataset.read(row) for row in range(len(dataset))]
    truth = truth_of(dataset, [frame.timestamp_s for frame in frames])
    return sights_of(frames, truth, DepthNoise(), 6.0, slot)


def mh01_sights(recordings: Path, slot: FeaturesSlot | None = None) -> list[Sight]:
    """Return the frames of MH_01's rectified left camera, 20 Hz."""
    stereo = euroc_stereo(recordings / "euroc_mh01_start")
    return sights_of(stereo.frames, stereo.T_world_camera, stereo.noise, 20.0, slot)


def sights_of(
    frames: Iterable[Frame],
    truth: Array,
    noise: DepthNoise,
    max_depth_m: float,
    slot: FeaturesSlot | None = None,
) -> list[Sight]:
    """Track *frames* by ORB, and return them with the features of *slot*, ORB's where it is None."""
    options = replace(FrontEndOptions.live(), max_depth_m=max_depth_m)
    tracker = Tracker(options)
    sights = []
    for frame, T_world_camera in zip(frames, truth, strict=True):
        step = track(tracker, frame)
        if step.T_world_camera is None:
            continue
        found = describe(frame.rgb, _FEATURES, is_spread=False, slot=slot)
        pixels, descriptors = found.pixels, found.descriptors
        points = points_at(frame, pixels, options)
        rows = np.flatnonzero(np.isfinite(points[:, 2]))[: _SENT * most_features(found.kind) // MAX_FEATURES]
        sights.append(
            Sight(
                reference=Reference(points_camera=points[rows], descriptors=descriptors[rows]),
                view=View(
                    camera=frame.camera, pixels=pixels[rows], descriptors=descriptors[rows],
                    depths_m=points[rows, 2], noise=noise,
                ),
                T_odom_camera=step.T_world_camera, T_world_camera=T_world_camera,
            )
        )  # fmt: skip
    return sights


def judge_pairs(
    sights: Sequence[Sight], gap: int, spacing: int, options: LiveMapOptions | None = None
) -> Judged:
    """Measure all pairs *gap* apart, let a live map judge them in *spacing* runs, and count."""
    options = options or LiveMapOptions()
    judged = Judged()
    for phase in range(spacing):
        first = range(phase, len(sights), spacing)
        second = range(phase + gap, len(sights), spacing)
        rows = [*first, *second]
        live_map = LiveMap(options)
        for number, row in enumerate(first):
            live_map.apply(_event("first", number, sights[row]))
        for number, row in enumerate(second):
            live_map.apply(_event("second", number, sights[row]))
            begin = time.process_time()
            link = measure_link(sights[row].reference, sights[row - gap].view, options.measured)
            judged.measure_ms += 1e3 * (time.process_time() - begin)
            judged.pairs += 1
            if isinstance(link, RelativePose):
                judged.alone.append(_error(link.T_a_b, sights[row], sights[row - gap]))
                live_map.apply(_measured(len(first) + number, first.index(row - gap), link))
        judged.believed += [_error(T, sights[rows[a]], sights[rows[b]]) for a, b, T in live_map.believed()]
    return judged


def relocalise(known: Sequence[Sight], sought: Sequence[Sight], every: int = 5) -> dict[str, Any]:
    """Seek views among each *every*-th one of *known*; say how many are found, and how exactly."""
    placed = list(known[::every])
    verdicts: Counter[str] = Counter()
    errors = []
    for sight in sought:
        found = localise(
            [
                PlacedKeyframe(
                    id=row, reference=placed[row].reference, T_map_keyframe=placed[row].T_world_camera
                )
                for row in _nearest(placed, sight)
            ],
            sight.view,
        )  # fmt: skip
        verdicts[found.verdict] += 1
        if found.verdict == "ok" and found.T_map_camera is not None:
            errors.append(pose_difference(found.T_map_camera, sight.T_world_camera))
    return {
        "keyframes": len(placed), "views": len(sought), "verdicts": dict(sorted(verdicts.items())),
        "ok": Judged(pairs=len(sought)).row(errors),
    }  # fmt: skip


def _nearest(placed: Sequence[Sight], sight: Sight) -> list[int]:
    """Return the rows of the keyframes that are nearest in metres, 30 degrees counting as one."""
    off = [pose_difference(each.T_world_camera, sight.T_world_camera) for each in placed]
    far = np.array([metres + degrees / 30.0 for metres, degrees in off])
    rows: list[int] = np.argsort(far, kind="stable")[:_CANDIDATES].tolist()
    return rows


def _error(T_a_b: Array, a: Sight, b: Sight) -> tuple[float, float]:
    return pose_difference(T_a_b, inverse(a.T_world_camera) @ b.T_world_camera)


def _event(robot: str, number: int, sight: Sight) -> KeyframeAdded:
    """Return a keyframe at the pose of its odometry; its features are not asked for."""
    few = np.array([[1.0, 1.0]]), np.ones(1), np.zeros((1, 32), dtype=np.uint8)
    keyframe = Keyframe(
        timestamp_s=float(number), T_odom_camera=sight.T_odom_camera, camera=sight.view.camera,
        features=make_features(*few),
    )  # fmt: skip
    return KeyframeAdded(robot=robot, segment=0, number=number, data=encode_keyframe(keyframe))


def _measured(keyframe: int, other: int, link: RelativePose) -> LinksMeasured:
    measured = MeasuredLink(
        other=other, T_keyframe_other=matrix_bytes(link.T_a_b), information=matrix_bytes(link.information),
        inliers=link.inliers, matches=link.matches,
    )  # fmt: skip
    return LinksMeasured(keyframe=keyframe, links=(measured,))


@benchmark(
    Bar("pairs.*.believed.wrong", equals=0),
    Bar("pairs.kitchen, 60 of 10 Hz.believed.right_percent", at_least=15.0, unit="%"),
)
def run_benchmark(
    *,
    recordings: Recordings = Path("../shared/data"),
    features: Annotated[str | None, "module:function of other features, as `rse-pf demo` takes it"] = None,
) -> dict[str, Any]:
    """Judge the pairs of each recording and gap, and relocalise."""
    function = load_features(features)
    slot = None if function is None else FeaturesSlot(function)
    sights = {"kitchen": kitchen_sights(recordings, slot), "MH_01": mh01_sights(recordings, slot)}
    pairs = {}
    for name, (recording, gap, spacing) in _DRIVES.items():
        judged = judge_pairs(sights[recording], gap, spacing)
        pairs[name] = {
            "n": judged.pairs, "alone": judged.row(judged.alone), "believed": judged.row(judged.believed),
            "cpu_ms_a_pair": judged.measure_ms / judged.pairs,
        }  # fmt: skip
        say({"drive": name, **pairs[name]})
    kitchen = sights["kitchen"]
    half = len(kitchen) // 2
    return {
        "pairs": pairs,
        "second_half_in_first": relocalise(kitchen[:half], kitchen[half:]),
        "first_half_in_second": relocalise(kitchen[half:], kitchen[:half]),
    }
