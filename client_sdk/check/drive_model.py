"""Prepare the keyframes of a drive for bundle adjustment: observations, initial poses and landmarks.

Depth images may be flipped, or later than the colour images: each such `DepthReading` is tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from client_sdk.check.keyframes import FLIPS, Keyframe, Tracks
from rse_pf.errors import PnpError
from rse_pf.geometry import Array, Camera, inverse, transform
from rse_pf.pnp import PnpOptions, solve_pnp
from rse_pf.slam.self_calibration import DriveObservations, triangulate_landmarks

__all__ = ["DepthReading", "DriveModel", "best_reading", "drive_model", "nearest_delay"]

Rows = npt.NDArray[np.int64]

_MIN_LANDMARKS = 20  # fewest known landmarks for the pose of a keyframe, and fewest landmarks of a drive
_MIN_KEYFRAMES = 5  # fewest connected keyframes of a drive that is adjusted
_PNP = PnpOptions(inlier_px=8.0, max_iterations=100)
"""Options of PnP for the initial poses.  The inlier threshold is wide, since wrong intrinsics cause residuals
of some pixels."""
_PIXEL_SIGMA_PX = 0.7  # standard deviation of the position of a feature of size 1, pixels
# Smallest share of the known landmarks of a keyframe that must be inliers of its initial pose.
_MIN_INLIER_SHARE = 0.3
# Largest difference, seconds, between the stamp of a depth image and the time at which a depth is wanted.
_MAX_STAMP_DIFFERENCE_S = 0.07
# Largest rate of a depth, m/s; faster changes are an edge of an object, and count as a rate of 0.
_MAX_RATE_M_S = 3.0
_RATE_WINDOWS_S = (0.3, 0.2, 0.1)
"""Times, in seconds before and after a depth image, between whose depths a rate of change is computed.  The
longest time with depths at both of its ends is used."""
# Factors on the focal length that are tried for a keyframe without a pose, which may be of another camera.
_FOCAL_LENGTH_FACTORS = (1.25, 0.8)
_MAX_COST = 6.0
"""Largest cost of one observation in the score of a reading, and the cost of each observation of a keyframe
whose pose was not found.  Costs have no unit."""
_SCORE_SCALE_PX = 3.0  # reprojection error, pixels, that counts as 1 before the logarithm of the score
_SCORE_SCALE_SIGMAS = 4.0  # error of a depth, in standard deviations, that counts as 1 before that logarithm
_DELAYS_S = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4)  # delays of the depth images that are tried, seconds
_MAX_COST_RATIO = 0.9
"""A flip or a delay of the depth images is accepted if its score is below this share of the score of the
depth images as they are."""


@dataclass(frozen=True, slots=True)
class DepthReading:
    """How depth images belong to colour images.

    ``flip`` is an index of `FLIPS`.  ``delay_s`` is the delay of the depth images in seconds: the depth image
    with the stamp ``t + delay_s`` belongs to the colour image with the stamp ``t``.
    """

    flip: int = 0
    delay_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveModel:
    """The longest connected part of a drive, with the poses and landmarks with which an adjustment begins.

    ``rows`` ``(k,)`` are the indices of its keyframes among those of the drive; ``T_camera_world``
    ``(k, 4, 4)`` their poses, and ``points_world`` ``(l, 3)`` the landmarks, both in metres.
    """

    rows: Rows
    observed: DriveObservations
    T_camera_world: Array
    points_world: Array


def best_reading(keyframes: list[Keyframe], tracks: Tracks) -> DepthReading:
    """Return the flip or the delay of the depth images with the lowest score.

    The result is the plain reading (no flip, no delay) unless another reading has less than 0.9 times the
    score of the plain reading.
    """
    readings = [DepthReading(flip) for flip in range(1, len(FLIPS))]
    readings += [DepthReading(delay_s=delay_s) for delay_s in _DELAYS_S]
    best, least = DepthReading(), _MAX_COST_RATIO * _score(keyframes, tracks, DepthReading())
    for reading in readings:
        score = _score(keyframes, tracks, reading)
        if score < least:
            best, least = reading, score
    return best


def nearest_delay(keyframes: list[Keyframe], delay_s: float) -> float:
    """Round a delay (see `DepthReading`) to a multiple of the interval of the depth images, both in seconds.

    The result is bounded by the times before and after keyframes for which depth images were kept; it is 0
    without such images.
    """
    steps_s = [
        abs(apart_s) for keyframe in keyframes for apart_s, _ in keyframe.around if abs(apart_s) > 1e-3
    ]
    if not steps_s:
        return 0.0
    ordered = np.sort(steps_s)
    interval_s = float(np.median(ordered[ordered < 1.5 * ordered[len(ordered) // 50]]))
    longest = float(ordered[-1]) // interval_s
    return interval_s * float(np.clip(np.rint(delay_s / interval_s), -longest, longest))


def drive_model(
    keyframes: list[Keyframe], tracks: Tracks, reading: DepthReading, *, by_depth: bool = True
) -> DriveModel | None:
    """Return the observations of a drive with initial poses and landmarks.

    None if fewer than 5 keyframes connect, or if fewer than 20 landmarks are seen by two of them.

    Args:
        keyframes: The keyframes of the drive, in the order of time.
        tracks: The features of these keyframes that show the same landmark.
        reading: Flip and delay of the depth images.
        by_depth: Whether the initial poses come from PnP with depths; otherwise they are the tracked poses.
    """
    camera = keyframes[0].camera
    at, depths, rates = _gather_depths(keyframes, tracks, reading)
    pixels = np.concatenate([each.pixels for each in keyframes])[at]
    sizes = np.concatenate([each.sizes for each in keyframes])[at]
    variances = np.concatenate([_variances(each, reading) for each in keyframes])[at]
    if by_depth:
        poses, _ = _chain_poses(camera, tracks, pixels, depths, np.sqrt(variances), len(keyframes))
    else:
        poses = np.array(
            [
                np.full((4, 4), np.nan) if each.T_world_camera is None else inverse(each.T_world_camera)
                for each in keyframes
            ]
        )
    rows = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    if len(rows) < _MIN_KEYFRAMES:
        return None
    renumbered = np.full(len(keyframes), -1)
    renumbered[rows] = np.arange(len(rows))
    kept = renumbered[tracks.keyframes] >= 0
    kept &= np.bincount(tracks.landmarks[kept], minlength=tracks.count)[tracks.landmarks] >= 2
    seen, landmarks = np.unique(tracks.landmarks[kept], return_inverse=True)
    if len(seen) < _MIN_LANDMARKS:
        return None
    observed = DriveObservations(
        camera=camera, keyframes=renumbered[tracks.keyframes[kept]], landmarks=landmarks,
        pixels=pixels[kept], pixel_deviations_px=_PIXEL_SIGMA_PX * sizes[kept], depths_m=depths[kept],
        depth_deviations_m=np.sqrt(variances[kept]), rates_m_s=rates[kept],
        twists_s=np.array([keyframes[row].twist_s for row in rows]),
    )  # fmt: skip
    points = triangulate_landmarks(observed, poses[rows], len(seen))
    return DriveModel(rows=rows, observed=observed, T_camera_world=poses[rows], points_world=points)


def _score(keyframes: list[Keyframe], tracks: Tracks, reading: DepthReading) -> float:
    at, depths, _ = _gather_depths(keyframes, tracks, reading)
    pixels = np.concatenate([each.pixels for each in keyframes])[at]
    variances = np.concatenate([_variances(each, reading) for each in keyframes])[at]
    return _chain_poses(keyframes[0].camera, tracks, pixels, depths, np.sqrt(variances), len(keyframes))[1]


def _gather_depths(
    keyframes: list[Keyframe], tracks: Tracks, reading: DepthReading
) -> tuple[Rows, Array, Array]:
    """Return three arrays ``(n,)`` for the features of the tracks: index, depth (m), and its change (m/s).

    The index counts the features of all keyframes, one keyframe after another.
    """
    read = [_read_depths(keyframe, reading) for keyframe in keyframes]
    starts = np.concatenate([[0], np.cumsum([len(each.pixels) for each in keyframes])])
    at = starts[tracks.keyframes] + tracks.features
    return at, np.concatenate([each[0] for each in read])[at], np.concatenate([each[1] for each in read])[at]


def _variances(keyframe: Keyframe, reading: DepthReading) -> Array:
    depths = _read_depths(keyframe, reading)[0]
    return keyframe.noise.variance_m2(np.nan_to_num(depths, nan=1.0))


def _read_depths(keyframe: Keyframe, reading: DepthReading) -> tuple[Array, Array]:
    """Return the depths ``(n,)`` at the features of a keyframe, m, and their change with time ``(n,)``, m/s.

    A depth is NaN if there is no valid one, or no depth image near the time that *reading* states.
    """
    n = len(keyframe.pixels)
    if reading.flip or len(keyframe.around) < 2:
        return keyframe.depths_m[reading.flip], np.zeros(n)
    around = sorted(keyframe.around, key=lambda each: each[0])
    apart_s = np.array([each[0] for each in around])
    at = int(np.argmin(np.abs(apart_s - reading.delay_s)))
    if abs(apart_s[at] - reading.delay_s) > _MAX_STAMP_DIFFERENCE_S:
        return np.full(n, np.nan), np.zeros(n)
    now = around[at]
    rates = np.full(n, np.nan)
    # Wide windows first: rates from a short time are noisy, which would bias the estimated delay towards 0.
    for reach_s in _RATE_WINDOWS_S:
        before, after = (around[row] for row in _window_ends(apart_s, at, reach_s))
        if after[0] > before[0]:
            rates = np.where(np.isfinite(rates), rates, (after[1] - before[1]) / (after[0] - before[0]))
    rates = np.where(np.abs(rates) < _MAX_RATE_M_S, rates, 0.0)
    # Extrapolate from the nearest depth image.  An interpolation between two images would have less noise
    # than each of them, and so bias the estimated delay towards the middle between images.
    return now[1] + rates * (reading.delay_s - now[0]), rates


def _window_ends(apart_s: Array, at: int, reach_s: float) -> tuple[int, int]:
    """Return the indices of the first and the last time within *reach_s* seconds of the time at index *at*.

    *apart_s* ``(n,)`` are times in ascending order.
    """
    low = int(np.searchsorted(apart_s, apart_s[at] - reach_s - 1e-3))
    return low, int(np.searchsorted(apart_s, apart_s[at] + reach_s + 1e-3)) - 1


def _chain_poses(
    camera: Camera, tracks: Tracks, pixels: Array, depths: Array, depths_dev_m: Array, count: int
) -> tuple[Array, float]:
    """Locate each keyframe by PnP with landmarks from the depths of those before it.

    Returns ``T_camera_world`` ``(count, 4, 4)`` of the longest run of keyframes that connect, NaN for other
    keyframes, and the score: the mean cost of an observation, which grows with the logarithm of its squared
    errors in pixel and depth, and has no unit.

    *pixels*, *depths* (m) and *depths_dev_m* (standard deviations, m) are those of the features of *tracks*.
    """
    poses, part = np.full((count, 4, 4), np.nan), np.zeros(count, dtype=np.int64)
    known = np.full((tracks.count, 3), np.nan)
    ends = np.searchsorted(tracks.keyframes, np.arange(count + 1))
    number, total, counted = 0, 0.0, 0
    for row in range(count):
        own = slice(ends[row], ends[row + 1])
        landmarks, at, depth = tracks.landmarks[own], pixels[own], depths[own]
        there = np.flatnonzero(np.isfinite(known[landmarks, 0]))
        T = _pose(camera, known[landmarks[there]], at[there])
        for zoom in _FOCAL_LENGTH_FACTORS if T is None and len(there) >= _MIN_LANDMARKS else ():
            # A frame of another camera connects to earlier ones only with the focal length of that camera.
            own_camera = msgspec.structs.replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy)
            T = T if T is not None else _pose(own_camera, known[landmarks[there]], at[there])
        if T is not None:
            seen = transform(T, known[landmarks[there]])
            z = np.maximum(seen[:, 2], 0.05)
            seen[:, 2] = z
            apart = np.square(camera.project(seen) - at[there]).sum(axis=1) / _SCORE_SCALE_PX**2
            deep = np.square((z - depth[there]) / (_SCORE_SCALE_SIGMAS * depths_dev_m[own][there]))
            cost = np.log1p(np.minimum(apart, 1e4)) + np.log1p(np.minimum(np.nan_to_num(deep, nan=1.0), 1e4))
            total += float(np.minimum(cost, _MAX_COST).sum())
        elif row > 0:
            total += _MAX_COST * max(len(there), _MIN_LANDMARKS)
        if row > 0:
            counted += max(len(there), _MIN_LANDMARKS if T is None else 0)
        if T is None:
            number += 1
            known[:] = np.nan
            T = np.eye(4)
        poses[row], part[row] = T, number
        fresh = np.isfinite(depth)
        # The newest depth of a landmark replaces its position, so that an error of one depth does not
        # persist.
        known[landmarks[fresh]] = transform(inverse(T), camera.back_project(at[fresh], depth[fresh]))
    poses[part != np.bincount(part).argmax()] = np.nan
    return poses, total / max(counted, 1)


def _pose(camera: Camera, points: Array, pixels: Array) -> Array | None:
    if len(points) < _MIN_LANDMARKS:
        return None
    try:
        found = solve_pnp(points, pixels, camera, _PNP)
    except PnpError:
        return None
    enough = max(_MIN_LANDMARKS // 2, _MIN_INLIER_SHARE * len(points))
    return found.T_camera_world if len(found.inliers) >= enough else None
