"""Measure the links of a keyframe of a live map with others that may show the same place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from rse_pf.geometry import Array, Camera
from rse_pf.live_map.events import LinksMeasured, MeasuredLink, matrix_bytes
from rse_pf.slam.keyframe import KeyframeFeatures, decode_keyframe
from rse_pf.slam.localise import PlacedKeyframe
from rse_pf.slam.relative_pose import Reference, RelativePoseOptions, View, measure_link

__all__ = [
    "StoredView",
    "decoded_view",
    "joined_links",
    "measure_links",
    "measure_stored",
    "placed_keyframe",
    "reference_of_features",
    "view_of_features",
]

_DEFAULT = RelativePoseOptions()
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
        measured = measure_link(reference, view_of_features(other_features, other_camera), options)
        if isinstance(measured, str):
            failed[measured] += 1
            continue
        links.append(
            MeasuredLink(
                other=other, T_keyframe_other=matrix_bytes(measured.T_a_b),
                information=matrix_bytes(measured.information),
                inliers=measured.inliers, matches=measured.matches,
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
    """Return the points of a keyframe that are sought in other images."""
    return Reference(points_camera=features.points_camera(camera), descriptors=features.descriptors)


def view_of_features(features: KeyframeFeatures, camera: Camera) -> View:
    """Return the image of a keyframe in which the points of others are sought."""
    return View(
        camera=camera, pixels=features.pixels.astype(np.float64), descriptors=features.descriptors,
        depths_m=features.depths_m.astype(np.float64), noise=features.noise,
    )  # fmt: skip


def placed_keyframe(stored: StoredView, T_map_keyframe: Array) -> PlacedKeyframe:
    """Return a stored keyframe with its ``(4, 4)`` pose, to find a view near it; raises BadRequest."""
    number, features, camera = decoded_view(stored)
    return PlacedKeyframe(
        id=number, reference=reference_of_features(features, camera), T_map_keyframe=T_map_keyframe
    )  # fmt: skip


def joined_links(keyframe: int, measured: Iterable[LinksMeasured]) -> LinksMeasured:
    """Return the links and failures of several calls of `measure_links` for one keyframe, in their order."""
    links: list[MeasuredLink] = []
    failed: Counter[str] = Counter()
    for part in measured:
        links += part.links
        failed.update(part.failed)
    return LinksMeasured(keyframe=keyframe, links=tuple(links), failed=dict(sorted(failed.items())))
