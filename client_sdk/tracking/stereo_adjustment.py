"""Adjust the keyframes of a stereo drive together with their landmarks and the offset of its disparities.

A calibration whose disparities are all a little too small makes far points too far, and a drive too long.
What is seen both near and far tells the offset, but only if poses and landmarks may move with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from client_sdk.tracking.keyframe_map import NO_LANDMARK, KeyframeMap, between
from client_sdk.trajectory import Trajectory
from rse_pf.errors import DegenerateGeometry
from rse_pf.geometry import Array, inverse
from rse_pf.slam.self_calibration import (
    UNKNOWNS,
    Calibrated,
    DriveObservations,
    adjust_with_calibration,
    triangulate_landmarks,
)

__all__ = ["MOST_KEYFRAMES", "StereoAdjustment", "adjust_stereo"]

Rows = npt.NDArray[np.int64]

_DISPARITY_PX, _PRIOR_PX = 0.1, 0.5
_LEAST_KEYFRAMES, MOST_KEYFRAMES = 5, 150
_LEAST_LANDMARKS, _MOST_LANDMARKS = 50, 2500
_ROUNDS = 2
_LEAST_PX, _LEAST_DEVIATIONS = 0.1, 4.0
"""Smaller offsets are those of good calibrations, whose drives an adjustment makes no better."""
_CURVE = UNKNOWNS.index("curve")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoAdjustment:
    """How the keyframes of a map move, and what all its disparities lack.

    Attributes:
        stamps_s: ``(k,)``, seconds.
        T_new_old: ``(k, 4, 4)``, which a pose of each keyframe's time is multiplied with.
        f_baseline: Focal length in pixels times the baseline in metres.
        offset_px: Pixels by which disparities are too small.
        deviation_px: Standard deviation of the offset.
        bend_m_per_px: By how much an offset of a pixel bends the path, see `Calibrated.bend_m`.
        growth_per_px: By how much the path grows, relative, if a pixel more is taken for the offset.
        noise_m: How well the keyframes tell their positions.
    """

    stamps_s: Array
    T_new_old: Array
    f_baseline: float
    offset_px: float
    deviation_px: float
    bend_m_per_px: float
    growth_per_px: float
    noise_m: float

    @property
    def is_clear(self) -> bool:
        """Whether the offset is large enough to move a map: 0.1 px and 4 deviations."""
        return abs(self.offset_px) >= max(_LEAST_PX, _LEAST_DEVIATIONS * self.deviation_px)

    def moved(self, stamps_s: Array, T_world_camera: Array) -> Array:
        """Return ``(n, 4, 4)`` poses of other times, moved as the keyframes around them."""
        return Trajectory(self.stamps_s, self.T_new_old).at(stamps_s) @ T_world_camera


def adjust_stereo(known: KeyframeMap, f_baseline: float) -> StereoAdjustment | None:
    """Move the keyframes of a map to where they agree best with all that they see; the first one stays.

    Nothing moves where the offset of the disparities is not clear.  None is returned where there are fewer
    than 5 or more than 150 keyframes, or fewer than 50 landmarks that two of them see.

    Args:
        known: The map.
        f_baseline: Focal length in pixels times the baseline in metres.
    """
    if not _LEAST_KEYFRAMES <= len(known) <= MOST_KEYFRAMES:
        return None
    numbers, observed = _observed(known)
    if len(numbers) < _LEAST_LANDMARKS:
        return None
    T = inverse(np.array([known.pose(row) for row in range(len(known))]))
    found: Calibrated | None = None
    points = triangulate_landmarks(observed, T, len(numbers))
    try:
        for _ in range(_ROUNDS):
            observed = _with_noise(observed, T, points, f_baseline)
            values = None if found is None else found.values
            found = adjust_with_calibration(observed, T, points, ("curve",), values=values)
            T, points = found.T_camera_world, found.points_world
    except DegenerateGeometry:
        return None
    assert found is not None
    T_new = known.pose(0) @ T[0] @ inverse(T)
    old = np.array([known.pose(row) for row in range(len(known))])
    pixel = np.zeros(len(UNKNOWNS))
    pixel[_CURVE] = 1.0 / f_baseline
    at = inverse(T)[:, :3, 3]
    at -= at.mean(axis=0)
    moved = found.bends_m[_CURVE] / f_baseline
    adjusted = StereoAdjustment(
        stamps_s=np.array([known.view(row).timestamp_s for row in range(len(known))]),
        T_new_old=T_new @ inverse(old), f_baseline=f_baseline,
        offset_px=float(found.values[_CURVE]) * f_baseline,
        deviation_px=float(found.deviations[_CURVE]) * f_baseline, bend_m_per_px=found.bend_m(pixel),
        growth_per_px=float((moved * at).sum() / max(float((at**2).sum()), 1e-12)), noise_m=found.noise_m,
    )  # fmt: skip
    if adjusted.is_clear:
        known.correct(T_new, f_baseline, adjusted.offset_px)
    return adjusted


def _observed(known: KeyframeMap) -> tuple[Rows, DriveObservations]:
    """Return the numbers of the landmarks that two keyframes see, at most 2,500, and all looks at them.

    Those that are seen most are taken, and of those seen alike the nearest: they tell metres.
    """
    views = [known.view(row) for row in range(len(known))]
    seen = np.concatenate([known.seen_in(row) for row in range(len(known))])
    keyframes = np.repeat(np.arange(len(views)), [len(view.features) for view in views])
    depths_m = np.concatenate([view.points_camera[:, 2] for view in views])
    looks = np.bincount(seen[seen != NO_LANDMARK], minlength=known.landmark_count)
    nearest = np.full(known.landmark_count, np.inf)
    has_depth = (seen != NO_LANDMARK) & np.isfinite(depths_m)
    np.minimum.at(nearest, seen[has_depth], depths_m[has_depth])
    order = np.lexsort((nearest, -looks))
    numbers = np.sort(order[looks[order] > 1][:_MOST_LANDMARKS])
    rows = np.full(known.landmark_count + 1, NO_LANDMARK)
    rows[numbers] = np.arange(len(numbers))
    kept = np.flatnonzero(rows[seen] != NO_LANDMARK)
    pixels = np.concatenate([view.features.pixels for view in views])[kept]
    sizes = np.concatenate([view.features.sizes for view in views])[kept]
    return numbers, DriveObservations(
        camera=views[0].camera, keyframes=keyframes[kept], landmarks=rows[seen[kept]], pixels=pixels,
        pixels_px=sizes, depths_m=depths_m[kept], depths_dev_m=np.maximum(depths_m[kept], 1e-3),
        rates_m_s=np.zeros(len(kept)), twists_s=np.zeros((len(views), 6)),
    )  # fmt: skip


def _with_noise(
    observed: DriveObservations, T_camera_world: Array, points: Array, f_baseline: float
) -> DriveObservations:
    """Return observations whose depths have the noise of their disparities, see `between`."""
    T = T_camera_world[observed.keyframes]
    expected_m = np.einsum("ni,ni->n", T[:, 2, :3], points[observed.landmarks]) + T[:, 2, 3]
    at_m = between(np.nan_to_num(observed.depths_m, nan=1.0), expected_m)
    return replace(
        observed, depths_dev_m=_DISPARITY_PX * at_m**2 / f_baseline, curve_dev_per_m=_PRIOR_PX / f_baseline
    )
