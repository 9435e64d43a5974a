"""Measure loop closures: the relative poses of a keyframe of a live map and older ones, by their features.

Cameras without depth have no metric scale.  Their lengths are multiplied by `assumed_scale` before matching,
so that thresholds and noise in metres fit, and divided by the same number afterwards.
"""

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
    "LOOP_CLOSURE_EVIDENCE",
    "StoredView",
    "assumed_scale",
    "decode_view",
    "landmarks_of_features",
    "measure_loop_closures",
    "measure_stored_keyframes",
    "merge_measurements",
    "placed_keyframe",
    "view_of_features",
]

ASSUMED_MEDIAN_DEPTH_M = 2.0
"""Metres: median depth that a keyframe without metric scale is assumed to have, as in a room."""
MIN_WRONG_LOG_SCALE = 0.04
"""Absolute natural logarithm of the ratio of two robots' depths from which on one metric scale counts as
wrong, if it is also above `MIN_WRONG_SCALE_DEVIATIONS`; the depths of the three robots of the 7-Scenes red
kitchen recordings differ by 1 to 2 %."""
MIN_WRONG_SCALE_DEVIATIONS = 2.0
"""Standard deviations of the measured logarithm of this ratio from which on one metric scale counts as wrong,
if the logarithm is also above `MIN_WRONG_LOG_SCALE`."""

LOOP_CLOSURE_EVIDENCE = RelativePoseOptions(min_inliers=15, min_inlier_ratio=0.3, min_matches=15)
"""Evidence that the measured relative pose of two keyframes needs to become a pending loop closure.  It is
half of what full weight needs (30 inliers, half of the matches), so that several weak loop closures can join
robots."""

StoredView = tuple[int, bytes]
"""Id of a keyframe, and the keyframe as encoded by the robot."""

_DEFAULT_OPTIONS = RelativePoseOptions()


def measure_loop_closures(
    keyframe: tuple[int, KeyframeFeatures, Camera],
    others: Sequence[tuple[int, KeyframeFeatures, Camera]],
    options: RelativePoseOptions = _DEFAULT_OPTIONS,
) -> LoopClosuresMeasured:
    """Measure the pose of each of *others* relative to *keyframe* by PnP; deterministic.

    Args:
        keyframe: Id, features and camera of the new keyframe.
        others: Ids, features and cameras of the keyframes it is compared with.
        options: Inliers and matches that a loop closure needs.

    Returns:
        The loop closures in the order of *others*, and the number of failures by the reasons of
        `measure_relative_pose`.
    """
    i, features, camera = keyframe
    landmarks = landmarks_of_features(features, camera)
    loop_closures: list[MeasuredLoopClosure] = []
    failed: Counter[str] = Counter()
    for other, other_features, other_camera in others:
        # 1. Solve PnP with the landmarks of the metric keyframe, if there is one, so that the pose is in
        #    metres.
        if other_features.is_metric and not features.is_metric:
            other_landmarks = landmarks_of_features(other_features, other_camera)
            view = view_of_features(features, camera)
            measured = measure_inverse_relative_pose(other_landmarks, view, options)
        else:
            view = view_of_features(other_features, other_camera)
            measured = measure_relative_pose(landmarks, view, options)
        if isinstance(measured, str):
            failed[measured] += 1
            continue
        # 2. Convert the pose and the ratio of scales from assumed metres to the units of both robots.
        measured = _in_robots_units(measured, features, other_features)
        scale = measured.scale
        loop_closures.append(
            MeasuredLoopClosure(
                other=other,
                T_keyframe_other=matrix_bytes(measured.T_a_b),
                information=matrix_bytes(measured.information),
                inliers=measured.inliers,
                matches=measured.matches,
                scale=None if scale is None else (scale.log_ratio, scale.variance),
                off_scale=_wrong_log_scale(measured),
            )
        )
    return LoopClosuresMeasured(keyframe=i, links=tuple(loop_closures), failed=dict(sorted(failed.items())))


def measure_stored_keyframes(
    keyframe: StoredView, others: Sequence[StoredView], options: RelativePoseOptions = _DEFAULT_OPTIONS
) -> LoopClosuresMeasured:
    """Decode keyframes and measure their loop closures as `measure_loop_closures` does.

    Raises:
        BadRequest: A keyframe is damaged.
    """
    return measure_loop_closures(decode_view(keyframe), [decode_view(other) for other in others], options)


def merge_measurements(keyframe: int, parts: Iterable[LoopClosuresMeasured]) -> LoopClosuresMeasured:
    """Return one event with the loop closures, in order, and the failures of all *parts* of *keyframe*."""
    loop_closures: list[MeasuredLoopClosure] = []
    failed: Counter[str] = Counter()
    for part in parts:
        loop_closures += part.links
        failed.update(part.failed)
    return LoopClosuresMeasured(
        keyframe=keyframe, links=tuple(loop_closures), failed=dict(sorted(failed.items()))
    )


def decode_view(stored: StoredView) -> tuple[int, KeyframeFeatures, Camera]:
    """Return the id, the features and the camera of an encoded keyframe.

    Raises:
        BadRequest: The keyframe is damaged.
    """
    i, data = stored
    keyframe = decode_keyframe(data)
    return i, keyframe.features, keyframe.camera


def landmarks_of_features(features: KeyframeFeatures, camera: Camera) -> Landmarks:
    """Return the 3-D points of a keyframe in its camera frame, to be matched with the features of others.

    Points are in metres, by `assumed_scale` if the keyframe is not metric.  Features without depth, which
    only such a keyframe has, are left out.
    """
    if features.is_metric:
        return Landmarks(points_camera=features.points_camera(camera), descriptors=features.descriptors)
    with_depth = np.flatnonzero(features.depths_m > 0.0)
    return Landmarks(
        points_camera=assumed_scale(features) * features.points_camera(camera)[with_depth],
        descriptors=features.descriptors[with_depth],
    )


def view_of_features(features: KeyframeFeatures, camera: Camera) -> View:
    """Return the features of a keyframe as the view in which landmarks of other keyframes are found.

    Depths are in metres, by `assumed_scale` if the keyframe is not metric.
    """
    depths = features.depths_m.astype(np.float64)
    return View(
        camera=camera,
        pixels=features.pixels.astype(np.float64),
        descriptors=features.descriptors,
        depths_m=depths if features.is_metric else assumed_scale(features) * depths,
        noise=features.noise,
        is_metric=features.is_metric,
    )


def assumed_scale(features: KeyframeFeatures) -> float:
    """Return the metres that a unit of a keyframe is assumed to have, so that its median depth is 2 m.

    The result is 1 if the keyframe is metric, or has no depth at all.
    """
    depths = features.depths_m[features.depths_m > 0.0]
    if features.is_metric or not len(depths):
        return 1.0
    return ASSUMED_MEDIAN_DEPTH_M / float(np.median(depths))


def placed_keyframe(stored: StoredView, T_map_keyframe: Array, scale: float = 1.0) -> LocalisationCandidate:
    """Return an encoded keyframe with its pose, as a candidate for the localisation of a view.

    Args:
        stored: Id and encoded keyframe.
        T_map_keyframe: ``(4, 4)``, its pose in the map, metres.
        scale: Metres of its unit, if the keyframe is not metric.

    Raises:
        BadRequest: The keyframe is damaged.
    """
    i, features, camera = decode_view(stored)
    landmarks = landmarks_of_features(features, camera)
    if not features.is_metric:
        points = scale / assumed_scale(features) * landmarks.points_camera
        landmarks = replace(landmarks, points_camera=points)
    return LocalisationCandidate(id=i, landmarks=landmarks, T_map_keyframe=T_map_keyframe)


def _wrong_log_scale(measured: RelativePose) -> float | None:
    """Return the logarithm of the length of the metre of *b* in metres of *a*, None if it is near 0.

    Here *a* and *b* are the keyframes of ``T_a_b``.  Near 0 is below 0.04 or two standard deviations, the
    larger of both.  The result is also None if the ratio of depths was not measured.
    """
    ratio = measured.depth_ratio
    if ratio is None:
        return None
    limit = max(MIN_WRONG_LOG_SCALE, MIN_WRONG_SCALE_DEVIATIONS * math.sqrt(ratio.variance))
    return None if abs(ratio.log_ratio) < limit else round(ratio.log_ratio, 4)


def _in_robots_units(
    measured: RelativePose, features: KeyframeFeatures, other: KeyframeFeatures
) -> RelativePose:
    """Return a relative pose, given in assumed metres, with lengths and scale in the robots' own units.

    If both keyframes are not metric, the pose gets the unit of the first one (*features*).  If one is metric,
    the pose is in its metres already, and only the scale changes.  If both are metric, nothing changes.
    """
    if measured.scale is None:
        return measured
    scale_a, scale_b = assumed_scale(features), assumed_scale(other)
    T_a_b, information = measured.T_a_b, measured.information
    if not other.is_metric and not features.is_metric:
        T_a_b = T_a_b.copy()
        T_a_b[:3, 3] /= scale_a
        per_unit = np.array([scale_a] * 3 + [1.0] * 3)
        information = per_unit[:, None] * information * per_unit
    scale = ScaleRatio(measured.scale.log_ratio + math.log(scale_b / scale_a), measured.scale.variance)
    return replace(measured, T_a_b=T_a_b, information=information, scale=scale)
