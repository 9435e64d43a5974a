"""Count how many views of one half of a drive are localised in a map of the other half.

The map's poses are the true ones, and keyframes have what fits into 36 kB.  A pose is right within 5 cm and
5 deg of the truth, near within 15 cm and 10 deg, else wrong.  Place search is compared with trying all
keyframes.  `live.wide_pairs` counts the links of views that lie apart.

    python -m benchmarks maps.relocalisation ../shared/data/7scenes_redkitchen --features xfeat:xfeat
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import benchmark
from benchmarks.maps.recordings import truth_of
from client_sdk.datasets import open_dataset
from client_sdk.frontend import FrontEndOptions, extract
from client_sdk.slots import FeaturesSlot, load_features
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.maps.format import Keyframe
from rse_pf.services.mapping.localise import LocaliseOptions, locate
from rse_pf.services.mapping.place import MapIndex
from rse_pf.slam.keyframe import most_features
from rse_pf.slam.relative_pose import (
    RelativePoseOptions,
    measure_pose,
    reference_of,
    view_of_keyframe,
)

__all__ = []

RIGHT_M, RIGHT_DEG = 0.05, 5.0
NEAR_M, NEAR_DEG = 0.15, 10.0
LIMITS = {
    "default": LocaliseOptions(),
    "15 inliers": LocaliseOptions(min_inliers=15, min_inlier_ratio=0.0),
}
SHOWS_INLIERS = 15
"""A keyframe with a right pose of so many inliers shows the place of a view."""


@benchmark()
def run_benchmark(
    *,
    data: Annotated[Path, "a recording with depth and truth"],
    features: Annotated[str | None, "default: ORB alone"] = None,
    map_step: Annotated[int, "frames between two keyframes of a map"] = 4,
) -> dict[str, Any]:
    """Localise with every kind of features."""
    function = load_features(features)
    slots = {"orb": None, **({} if function is None else {features: FeaturesSlot(function)})}
    return {name: relocalised(keyframes_of(data, slot), map_step) for name, slot in slots.items()}


def keyframes_of(folder: Path, slot: FeaturesSlot | None) -> list[Keyframe]:
    """Return a keyframe for each frame, at its true pose, with the features that live maps have."""
    dataset = open_dataset(folder)
    options, made = FrontEndOptions.live(), []
    for number, frame in enumerate(dataset):
        features = extract(frame, options, slot)
        kept = slice(most_features(features.kind))
        made.append(
            Keyframe(
                id=number, robot="r", timestamp_s=frame.timestamp_s, camera=frame.camera, kind=features.kind,
                T_world_camera=truth_of(dataset, [frame.timestamp_s])[0],
                pixels=features.pixels[kept].astype(np.float32), descriptors=features.descriptors[kept],
                points_camera=features.points_camera[kept].astype(np.float32),
            )
        )  # fmt: skip
    return made


def relocalised(views: Sequence[Keyframe], step: int) -> dict[str, Any]:
    """Return how many views of one half are found in a map of the other half, in both directions."""
    half = len(views) // 2
    found: dict[str, Counter[str]] = {}
    for mapped, sought in ((views[:half], views[half:]), (views[half:], views[:half])):
        index = MapIndex(mapped[::step])
        for view in sought[::step]:
            _relocalise(index, view, found)
    return {name: dict(counts) for name, counts in found.items()}


def _relocalise(index: MapIndex, keyframe: Keyframe, found: dict[str, Counter[str]]) -> None:
    view, true = view_of_keyframe(keyframe), keyframe.T_world_camera
    for name, limits in LIMITS.items():
        for tried, options in (
            ("", limits), (", all keyframes", _with_candidates(limits, len(index.keyframes))),
        ):  # fmt: skip
            reply = locate(index, view, options)
            what = reply.verdict if reply.verdict == "lost" else f"{reply.verdict} {reply.reason}".strip()
            if reply.T_map_camera is not None:
                what += f", {_judged(reply.T_map_camera, true)}"
            found.setdefault(name + tried, Counter())[what] += 1
    showing = _showing(index, keyframe)
    places = found.setdefault("place search", Counter())
    places["views"] += 1
    if showing:
        places["a keyframe shows the place"] += 1
        nearest = [row for row, _ in index.nearest(keyframe.descriptors, 8)]
        places["among the first"] += nearest[0] in showing
        places["among the first 8"] += bool(showing & set(nearest))
        places["showing"] += len(showing)
        places["showing, by chance among 8 of all"] += 1 - _missed(len(index.keyframes), len(showing), 8)


def _with_candidates(options: LocaliseOptions, count: int) -> LocaliseOptions:
    """Return *options* that look at *count* keyframes."""
    return LocaliseOptions(
        candidates=min(100, 2 * count), min_inliers=options.min_inliers,
        min_inlier_ratio=options.min_inlier_ratio,
    )  # fmt: skip


def _showing(index: MapIndex, keyframe: Keyframe) -> set[int]:
    """Return the rows of all keyframes that give the view a right pose."""
    rows, limits = set(), replace(RelativePoseOptions(), min_inliers=SHOWS_INLIERS)
    for row, other in enumerate(index.keyframes):
        measured = measure_pose(reference_of(other), view_of_keyframe(keyframe), limits)
        if isinstance(measured, str) or measured.inliers < SHOWS_INLIERS:
            continue
        T_map_view = other.T_world_camera @ inverse(measured.solution.T_camera_world)
        if _judged(T_map_view, keyframe.T_world_camera) == "right":
            rows.add(row)
    return rows


def _missed(all_: int, showing: int, drawn: int) -> float:
    """Return the probability that none of *drawn* random rows shows the place."""
    left = np.arange(min(drawn, all_))
    return float(np.prod(np.clip((all_ - showing - left) / (all_ - left), 0.0, 1.0)))


def _judged(T_found: Array, T_true: Array) -> str:
    apart_m, apart_deg = pose_difference(T_found, T_true)
    if apart_m <= RIGHT_M and apart_deg <= RIGHT_DEG:
        return "right"
    return "near" if apart_m <= NEAR_M and apart_deg <= NEAR_DEG else "wrong"
