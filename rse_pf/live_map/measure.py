"""Measure the links of a keyframe of a live map with others that may show the same place."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from rse_pf.geometry import Array, Camera
from rse_pf.live_map.events import LinksMeasured, MeasuredLink, matrix_bytes
from rse_pf.slam.keyframe import KeyframeFeatures, decode_keyframe
from rse_pf.slam.localise import PlacedKeyframe
from rse_pf.slam.relative_pose import (
    MeasuredScale,
    Reference,
    RelativePose,
    RelativePoseOptions,
    View,
    measure_inverse_link,
    measure_link,
)

__all__ = [
    "StoredView",
    "decoded_view",
    "joined_links",
    "measure_links",
    "measure_stored",
    "placed_keyframe",
    "reference_of_features",
    "sought_per_unit",
    "view_of_features",
]

_DEFAULT = RelativePoseOptions()
_MEDIAN_DEPTH = 2.0
"""Metres that the median depth of points without scale counts as, where they are sought."""
_OFF, _OFF_DEVIATIONS = 0.04, 2.0
"""Depths of good cameras differ by less: those of the kitchen's three robots by 1 to 2 %."""
StoredView = tuple[int, bytes]
"""Id and bytes of a keyframe."""


def measure_links(
    keyframe: tuple[int, KeyframeFeatures, Camera],
    others: Sequence[tuple[int, KeyframeFeatures, Camera]],
    options: RelativePoseOptions = _DEFAULT,
) -> LinksMeasured:
    """Measure the pose of each of *others* relative to *keyframe*; deterministic.

    Args:
        keyframe: Its id, features and camera.
        others: The ids, features and cameras of the keyframes to compare it with.
        options: What a link needs.

    Returns:
        The links in the order of *others*, and the number of failures by the reasons of `measure_link`.
    """
    number, features, camera = keyframe
    reference = reference_of_features(features, camera)
    links: list[MeasuredLink] = []
    failed: Counter[str] = Counter()
    for other, other_features, other_camera in others:
        if other_features.is_metric and not features.is_metric:
            # So that the pose is in metres.
            sought = reference_of_features(other_features, other_camera)
            measured = measure_inverse_link(sought, view_of_features(features, camera), options)
        else:
            measured = measure_link(reference, view_of_features(other_features, other_camera), options)
        if isinstance(measured, str):
            failed[measured] += 1
            continue
        measured = _in_units(measured, features, other_features)
        links.append(
            MeasuredLink(
                other=other, T_keyframe_other=matrix_bytes(measured.T_a_b),
                information=matrix_bytes(measured.information),
                inliers=measured.inliers, matches=measured.matches,
                scale=None if measured.scale is None else (measured.scale.log_ratio, measured.scale.variance),
                off_scale=_off_scale(measured),
            )
        )  # fmt: skip
    return LinksMeasured(keyframe=number, links=tuple(links), failed=dict(sorted(failed.items())))


def measure_stored(
    keyframe: StoredView, others: Sequence[StoredView], options: RelativePoseOptions = _DEFAULT
) -> LinksMeasured:
    """Decode stored keyframes and measure their links as `measure_links` does; raises BadRequest."""
    return measure_links(decoded_view(keyframe), [decoded_view(other) for other in others], options)


def decoded_view(stored: StoredView) -> tuple[int, KeyframeFeatures, Camera]:
    """Return id, features and camera of a keyframe as it is kept; raises BadRequest."""
    number, data = stored
    keyframe = decode_keyframe(data)
    return number, keyframe.features, keyframe.camera


def reference_of_features(features: KeyframeFeatures, camera: Camera) -> Reference:
    """Return the points of a keyframe that are sought in other images, by `sought_per_unit` without scale."""
    if features.is_metric:
        return Reference(points_camera=features.points_camera(camera), descriptors=features.descriptors)
    rows = np.flatnonzero(features.depths_m > 0.0)
    return Reference(
        points_camera=sought_per_unit(features) * features.points_camera(camera)[rows],
        descriptors=features.descriptors[rows],
    )


def view_of_features(features: KeyframeFeatures, camera: Camera) -> View:
    """Return the image of a keyframe in which the points of others are sought, as `reference_of_features`."""
    depths = features.depths_m.astype(np.float64)
    return View(
        camera=camera, pixels=features.pixels.astype(np.float64), descriptors=features.descriptors,
        depths_m=depths if features.is_metric else sought_per_unit(features) * depths, noise=features.noise,
        is_metric=features.is_metric,
    )  # fmt: skip


def sought_per_unit(features: KeyframeFeatures) -> float:
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
    """Return a link whose lengths were multiplied by `sought_per_unit` as a `MeasuredLink` has it."""
    if measured.scale is None:
        return measured
    here, there = sought_per_unit(features), sought_per_unit(other)
    T_a_b, information = measured.T_a_b, measured.information
    if not other.is_metric and not features.is_metric:
        T_a_b = T_a_b.copy()
        T_a_b[:3, 3] /= here
        stretch = np.array([here] * 3 + [1.0] * 3)
        information = stretch[:, None] * information * stretch
    scale = MeasuredScale(measured.scale.log_ratio + math.log(there / here), measured.scale.variance)
    return replace(measured, T_a_b=T_a_b, information=information, scale=scale)


def placed_keyframe(stored: StoredView, T_map_keyframe: Array, scale: float = 1.0) -> PlacedKeyframe:
    """Return a stored keyframe with its ``(4, 4)`` pose, to find a view near it; raises BadRequest.

    *scale* is how many metres its unit is, if it is not in metres.
    """
    number, features, camera = decoded_view(stored)
    reference = reference_of_features(features, camera)
    if not features.is_metric:
        points = scale / sought_per_unit(features) * reference.points_camera
        reference = replace(reference, points_camera=points)
    return PlacedKeyframe(id=number, reference=reference, T_map_keyframe=T_map_keyframe)


def joined_links(keyframe: int, measured: Iterable[LinksMeasured]) -> LinksMeasured:
    """Return the links and failures of several calls of `measure_links` for one keyframe, in their order."""
    links: list[MeasuredLink] = []
    failed: Counter[str] = Counter()
    for part in measured:
        links += part.links
        failed.update(part.failed)
    return LinksMeasured(keyframe=keyframe, links=tuple(links), failed=dict(sorted(failed.items())))
