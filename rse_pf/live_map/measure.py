"""Measure the links of a keyframe of a live map with others that may show the same place."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from rse_pf.geometry import Array, Camera
from rse_pf.live_map.events import LoopClosuresMeasured, MeasuredLoopClosure, matrix_bytes
from rse_pf.slam.keyframe import KeyframeFeatures, decode_keyframe
from rse_pf.slam.localise import LocalisationCandidate
from rse_pf.slam.relative_pose import (
    Landmarks,
    RelativePose,
    RelativePoseOptions,
    ScaleRatio,
    View,
    measure_inverse_relative_pose,
    measure_relative_pose,
)

__all__ = [
    "StoredView",
    "assumed_scale",
    "decoded_view",
    "landmarks_of_features",
    "measure_loop_closures",
    "measure_stored_keyframes",
    "merge_measurements",
    "placed_keyframe",
    "view_of_features",
]

_DEFAULT = RelativePoseOptions()
_MEDIAN_DEPTH = 2.0
"""Metres that the median depth of points without scale counts as, where they are sought."""
_OFF, _OFF_DEVIATIONS = 0.04, 2.0
"""Depths of good cameras differ by less: those of the kitchen's three robots by 1 to 2 %."""
StoredView = tuple[int, bytes]
"""Id and bytes of a keyframe."""


def measure_loop_closures(
    keyframe: tuple[int, KeyframeFeatures, Camera],
    others: Sequence[tuple[int, KeyframeFeatures, Camera]],
    options: RelativePoseOptions = _DEFAULT,
) -> LoopClosuresMeasured:
    """Measure the pose of each of *others* relative to *keyframe*; deterministic.

    Args:
        keyframe: Its id, features and camera.
        others: The ids, features and cameras of the keyframes to compare it with.
        options: What a link needs.

    Returns:
        The links in the order of *others*, and the number of failures by the reasons of
        `measure_relative_pose`.
    """
    number, features, camera = keyframe
    reference = landmarks_of_features(features, camera)
    links: list[MeasuredLoopClosure] = []
    failed: Counter[str] = Counter()
    for other, other_features, other_camera in others:
        if other_features.is_metric and not features.is_metric:
            # So that the pose is in metres.
            sought = landmarks_of_features(other_features, other_camera)
            measured = measure_inverse_relative_pose(sought, view_of_features(features, camera), options)
        else:
            measured = measure_relative_pose(
                reference, view_of_features(other_features, other_camera), options
            )
        if isinstance(measured, str):
            failed[measured] += 1
            continue
        measured = _in_units(measured, features, other_features)
        links.append(
            MeasuredLoopClosure(
                other=other, T_keyframe_other=matrix_bytes(measured.T_a_b),
                information=matrix_bytes(measured.information),
                inliers=measured.inliers, matches=measured.matches,
                scale=None if measured.scale is None else (measured.scale.log_ratio, measured.scale.variance),
                off_scale=_off_scale(measured),
            )
        )  # fmt: skip
    return LoopClosuresMeasured(keyframe=number, links=tuple(links), failed=dict(sorted(failed.items())))


def measure_stored_keyframes(
    keyframe: StoredView, others: Sequence[StoredView], options: RelativePoseOptions = _DEFAULT
) -> LoopClosuresMeasured:
    """Decode stored keyframes and measure their links as `measure_loop_closures` does; raises BadRequest."""
    return measure_loop_closures(decoded_view(keyframe), [decoded_view(other) for other in others], options)


def decoded_view(stored: StoredView) -> tuple[int, KeyframeFeatures, Camera]:
    """Return id, features and camera of a keyframe as it is kept; raises BadRequest."""
    number, data = stored
    keyframe = decode_keyframe(data)
    return number, keyframe.features, keyframe.camera


def landmarks_of_features(features: KeyframeFeatures, camera: Camera) -> Landmarks:
    """Return the points of a keyframe that are sought in other images, by `assumed_scale` without scale."""
    if features.is_metric:
        return Landmarks(points_camera=features.points_camera(camera), descriptors=features.descriptors)
    rows = np.flatnonzero(features.depths_m > 0.0)
    return Landmarks(
        points_camera=assumed_scale(features) * features.points_camera(camera)[rows],
        descriptors=features.descriptors[rows],
    )


def view_of_features(features: KeyframeFeatures, camera: Camera) -> View:
    """Return the image of a keyframe in which the points of others are sought, as `landmarks_of_features`."""
    depths = features.depths_m.astype(np.float64)
    return View(
        camera=camera, pixels=features.pixels.astype(np.float64), descriptors=features.descriptors,
        depths_m=depths if features.is_metric else assumed_scale(features) * depths, noise=features.noise,
        is_metric=features.is_metric,
    )  # fmt: skip


def assumed_scale(features: KeyframeFeatures) -> float:
    """Return by what lengths without scale are multiplied, so that points are as far as those in a room.

    Noise and rounding are those of metres.
    """
    depths = features.depths_m[features.depths_m > 0.0]
    return 1.0 if features.is_metric or not len(depths) else _MEDIAN_DEPTH / float(np.median(depths))


def _off_scale(measured: RelativePose) -> float | None:
    """Return the logarithm of the ratio of two metres that clearly differ, else None."""
    ratio = measured.depth_ratio
    if ratio is None or abs(ratio.log_ratio) < max(_OFF, _OFF_DEVIATIONS * math.sqrt(ratio.variance)):
        return None
    return round(ratio.log_ratio, 4)


def _in_units(measured: RelativePose, features: KeyframeFeatures, other: KeyframeFeatures) -> RelativePose:
    """Return a link whose lengths were multiplied by `assumed_scale` as a `MeasuredLoopClosure` has it."""
    if measured.scale is None:
        return measured
    here, there = assumed_scale(features), assumed_scale(other)
    T_a_b, information = measured.T_a_b, measured.information
    if not other.is_metric and not features.is_metric:
        T_a_b = T_a_b.copy()
        T_a_b[:3, 3] /= here
        stretch = np.array([here] * 3 + [1.0] * 3)
        information = stretch[:, None] * information * stretch
    scale = ScaleRatio(measured.scale.log_ratio + math.log(there / here), measured.scale.variance)
    return replace(measured, T_a_b=T_a_b, information=information, scale=scale)


def placed_keyframe(stored: StoredView, T_map_keyframe: Array, scale: float = 1.0) -> LocalisationCandidate:
    """Return a stored keyframe with its ``(4, 4)`` pose, to find a view near it; raises BadRequest.

    *scale* is how many metres its unit is, if it is not in metres.
    """
    number, features, camera = decoded_view(stored)
    reference = landmarks_of_features(features, camera)
    if not features.is_metric:
        points = scale / assumed_scale(features) * reference.points_camera
        reference = replace(reference, points_camera=points)
    return LocalisationCandidate(id=number, landmarks=reference, T_map_keyframe=T_map_keyframe)


def merge_measurements(keyframe: int, measured: Iterable[LoopClosuresMeasured]) -> LoopClosuresMeasured:
    """Return the loop closures and failures of several measurements of *keyframe* as one event."""
    links: list[MeasuredLoopClosure] = []
    failed: Counter[str] = Counter()
    for part in measured:
        links += part.links
        failed.update(part.failed)
    return LoopClosuresMeasured(keyframe=keyframe, links=tuple(links), failed=dict(sorted(failed.items())))
