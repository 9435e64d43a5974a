"""Adjust the keyframes of a stereo drive together with their landmarks and the offset of its disparities.

An error of the calibration, such as a small rotation of one camera, adds a nearly constant offset to all
disparities.  If disparities are too small, far points are too far, and a path is too long.  Points that are
seen both near and far determine the offset, but only if poses and landmarks are adjusted with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from client_sdk.tracking.keyframe_map import KeyframeMap, depths_for_noise
from client_sdk.tracking.landmark_matching import NO_LANDMARK
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

__all__ = ["MAX_ADJUSTED_KEYFRAMES", "StereoAdjustment", "adjust_stereo"]

Rows = npt.NDArray[np.int64]

_DISPARITY_SIGMA_PX = 0.1
"""Standard deviation, in pixels, of a disparity in the adjustment of a stereo drive."""
_OFFSET_PRIOR_PX = 0.5
"""Standard deviation, in pixels, of the disparity offset around 0 before the adjustment of a stereo drive."""
_MIN_KEYFRAMES = 5
"""Fewest keyframes of a stereo segment that are adjusted: fewer do not determine the offset."""
MAX_ADJUSTED_KEYFRAMES = 150
"""Largest number of keyframes of a stereo segment that are adjusted together: bounds the time to seconds."""
_MIN_LANDMARKS = 50
"""Fewest landmarks, seen by two keyframes or more, with which a stereo segment is adjusted."""
_MAX_LANDMARKS = 2500
"""Largest number of landmarks that the adjustment of a stereo segment takes, those seen most often first."""
_ROUNDS = 2
"""Number of adjustments in a row; the second one evaluates the noise of depths at the result of the first."""
_MIN_CLEAR_OFFSET_PX = 0.1
"""Smallest disparity offset, in pixels, that changes a map: good calibrations have smaller ones, and an
adjustment does not improve their drives."""
_MIN_CLEAR_SIGMAS = 4.0
"""Smallest disparity offset that changes a map, in its own standard deviations."""
_CURVE = UNKNOWNS.index("curve")
"""Index of ``curve`` among the unknowns of a self-calibration.  A measured depth z is too large by curve
times z^2; the unit of the curve is 1/m.  Times focal length (pixels) and baseline (metres) the curve is the
disparity offset in pixels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoAdjustment:
    """The result of adjusting one stereo segment: how its keyframes move, and the offset of its disparities.

    Attributes:
        stamps_s: ``(k,)``, times of the keyframes, in seconds.
        T_new_old: ``(k, 4, 4)``; the corrected pose of keyframe *i* is ``T_new_old[i] @ T_world_camera``.
        f_baseline: Focal length in pixels times the baseline in metres.
        offset_px: Pixels by which all disparities are too small.
        deviation_px: Standard deviation of the offset, in pixels.
        bend_m_per_px: Root mean square change of the keyframes' positions, in metres, by an offset of one
            pixel that is not corrected, see `Calibrated.bend_m`; `rse-pf check` reports it.
        growth_per_px: Relative growth of the extent of the path if one pixel more is added to the
            disparities; negative, since points are then nearer.
        noise_m: Root mean square of the random error of the keyframes' positions, in metres, by the
            covariance of the adjustment.
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
        """Whether the offset is large enough to change a map: at least 0.1 px and 4 standard deviations."""
        return abs(self.offset_px) >= max(_MIN_CLEAR_OFFSET_PX, _MIN_CLEAR_SIGMAS * self.deviation_px)

    def moved(self, stamps_s: Array, T_world_camera: Array) -> Array:
        """Return corrected ``(n, 4, 4)`` poses of frames at any times ``(n,)`` in seconds.

        A frame moves as the keyframes around it in time: their motions ``T_new_old`` are interpolated.
        """
        return Trajectory(self.stamps_s, self.T_new_old).at(stamps_s) @ T_world_camera


def adjust_stereo(segment_map: KeyframeMap, f_baseline: float) -> StereoAdjustment | None:
    """Adjust the keyframes, landmarks and the disparity offset of a stereo segment; the first keyframe stays.

    The map is changed only if the offset is clear, see `StereoAdjustment.is_clear`.

    Args:
        segment_map: The map of the segment.
        f_baseline: Focal length in pixels times the baseline in metres.

    Returns:
        None if the segment has fewer than 5 or more than 150 keyframes, fewer than 50 landmarks that two
        keyframes see, or a geometry that does not determine the offset.
    """
    count = segment_map.keyframe_count
    if not _MIN_KEYFRAMES <= count <= MAX_ADJUSTED_KEYFRAMES:
        return None
    landmark_count, observed = _collect_observations(segment_map)
    if landmark_count < _MIN_LANDMARKS:
        return None
    # 1. Adjust poses, points and the disparity offset twice; the noise of a depth is evaluated at the
    # geometric mean of the measured depth and the depth that the poses and points predict.
    old = segment_map.poses
    T_camera_world = inverse(old)
    points = triangulate_landmarks(observed, T_camera_world, landmark_count)
    calibrated: Calibrated | None = None
    try:
        for _ in range(_ROUNDS):
            observed = _set_depth_noise(observed, T_camera_world, points, f_baseline)
            values = None if calibrated is None else calibrated.values
            calibrated = adjust_with_calibration(observed, T_camera_world, points, ("curve",), values=values)
            T_camera_world, points = calibrated.T_camera_world, calibrated.points_world
    except DegenerateGeometry:
        return None
    assert calibrated is not None
    # 2. Move the result so that the first keyframe stays.
    new = segment_map.poses[0] @ T_camera_world[0] @ inverse(T_camera_world)
    # 3. Compute by how much the path bends and grows with an offset of one pixel.
    one_pixel = np.zeros(len(UNKNOWNS))
    one_pixel[_CURVE] = 1.0 / f_baseline
    positions = inverse(T_camera_world)[:, :3, 3]
    positions -= positions.mean(axis=0)
    bends_m = calibrated.bends_m[_CURVE] / f_baseline
    adjustment = StereoAdjustment(
        stamps_s=np.array([view.timestamp_s for view in segment_map.views]),
        T_new_old=new @ inverse(old),
        f_baseline=f_baseline,
        offset_px=float(calibrated.values[_CURVE]) * f_baseline,
        deviation_px=float(calibrated.deviations[_CURVE]) * f_baseline,
        bend_m_per_px=calibrated.bend_m(one_pixel),
        growth_per_px=float((bends_m * positions).sum() / max(float((positions**2).sum()), 1e-12)),
        noise_m=calibrated.noise_m,
    )
    # 4. Change the map if the offset is clear.
    if adjustment.is_clear:
        segment_map.correct(new, f_baseline, adjustment.offset_px)
    return adjustment


def _collect_observations(segment_map: KeyframeMap) -> tuple[int, DriveObservations]:
    """Return the number of landmarks that two keyframes see, at most 2,500, and all observations of them.

    Landmarks that are seen most often are taken first, and of those the nearest: they determine the scale.
    The standard deviations of the depths are not set yet: they hold the depths themselves.
    """
    # 1. Collect landmark, keyframe and depth of every feature of every keyframe.
    views, seen = segment_map.views, np.concatenate(segment_map.seen)
    keyframes = np.repeat(np.arange(len(views)), [len(view.features) for view in views])
    depths_m = np.concatenate([view.features.points_camera[:, 2] for view in views])
    # 2. Choose the landmarks that two or more keyframes see: those seen most often, then the nearest.
    total = segment_map.landmark_count
    observation_counts = np.bincount(seen[seen != NO_LANDMARK], minlength=total)
    smallest_depths_m = np.full(total, np.inf)
    has_depth = (seen != NO_LANDMARK) & np.isfinite(depths_m)
    np.minimum.at(smallest_depths_m, seen[has_depth], depths_m[has_depth])
    order = np.lexsort((smallest_depths_m, -observation_counts))
    chosen = np.sort(order[observation_counts[order] > 1][:_MAX_LANDMARKS])
    # 3. Keep the observations of the chosen landmarks, numbered anew.
    new_numbers = np.full(total + 1, NO_LANDMARK)  # the last row is that of NO_LANDMARK
    new_numbers[chosen] = np.arange(len(chosen))
    rows = np.flatnonzero(new_numbers[seen] != NO_LANDMARK)
    return len(chosen), DriveObservations(
        camera=views[0].camera,
        keyframes=keyframes[rows],
        landmarks=new_numbers[seen[rows]],
        pixels=np.concatenate([view.features.pixels for view in views])[rows],
        pixel_deviations_px=np.concatenate([view.features.sizes for view in views])[rows],
        depths_m=depths_m[rows],
        depth_deviations_m=np.maximum(depths_m[rows], 1e-3),
        rates_m_s=np.zeros(len(rows)),
        twists_s=np.zeros((len(views), 6)),
    )


def _set_depth_noise(
    observed: DriveObservations, T_camera_world: Array, points: Array, f_baseline: float
) -> DriveObservations:
    """Return observations with the noise of stereo depths, and with the prior of the disparity offset.

    The noise of a depth is the constant noise of disparities, converted at the geometric mean of the measured
    depth and the depth that these poses and points predict (`depths_for_noise`).
    """
    T = T_camera_world[observed.keyframes]
    expected_m = np.einsum("ni,ni->n", T[:, 2, :3], points[observed.landmarks]) + T[:, 2, 3]
    noise_depths_m = depths_for_noise(np.nan_to_num(observed.depths_m, nan=1.0), expected_m)
    return replace(
        observed,
        depth_deviations_m=_DISPARITY_SIGMA_PX * noise_depths_m**2 / f_baseline,
        curve_dev_per_m=_OFFSET_PRIOR_PX / f_baseline,
    )
