"""Turn the keyframes of a drive into observations and first poses, under one reading of its depth images."""

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

_LEAST_SEEN, _LEAST_KEYFRAMES = 20, 5
_PNP = PnpOptions(inlier_px=8.0, max_iterations=100)
"""Wide: intrinsics that are wrong have residuals of some pixels."""
_PIXEL_PX = 0.7
_LEAST_SHARE = 0.3
_FAR_S = 0.07
_FASTEST_M_S, _REACHES_S = 3.0, (0.3, 0.2, 0.1)
_ZOOMS = (1.25, 0.8)
_MISS = 6.0
"""What an observation costs in a frame whose pose could not be found."""
_SCORE_PX, _SCORE_DEVIATIONS = 3.0, 4.0
_DELAYS_S = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4)
_BETTER = 0.9
"""Another reading of the depth images is believed if it costs less than this share of the plain one."""


@dataclass(frozen=True, slots=True)
class DepthReading:
    """How depth images belong to colour images: the row of one of `FLIPS`, and so many seconds late."""

    flip: int = 0
    delay_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveModel:
    """The longest connected part of a drive: ``rows`` of its keyframes, where it begins, what they see.

    ``score`` says how badly depths and pixels of the whole drive agree, before anything is adjusted.
    """

    rows: Rows
    observed: DriveObservations
    T_camera_world: Array
    points_world: Array
    score: float


def best_reading(keyframes: list[Keyframe], tracks: Tracks) -> DepthReading:
    """Return how the depth images are read best: which way round, and how late."""
    readings = [DepthReading(flip) for flip in range(1, len(FLIPS))]
    readings += [DepthReading(delay_s=delay_s) for delay_s in _DELAYS_S]
    best, least = DepthReading(), _BETTER * _score(keyframes, tracks, DepthReading())
    for reading in readings:
        score = _score(keyframes, tracks, reading)
        if score < least:
            best, least = reading, score
    return best


def nearest_delay(keyframes: list[Keyframe], delay_s: float) -> float:
    """Return the delay nearest to one at which there are depth images: a multiple of their interval."""
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
    """Return observations of a drive with poses to begin with; None where too few keyframes connect.

    Args:
        keyframes: Of the drive.
        tracks: Their landmarks.
        reading: How their depths are read.
        by_depth: Whether poses come from depths, or are those that were tracked.
    """
    camera = keyframes[0].camera
    at, depths, rates = _gathered(keyframes, tracks, reading)
    pixels = np.concatenate([each.pixels for each in keyframes])[at]
    sizes = np.concatenate([each.sizes for each in keyframes])[at]
    variances = np.concatenate([_variances(each, reading) for each in keyframes])[at]
    score = np.nan
    if by_depth:
        poses, score = _chained(camera, tracks, pixels, depths, np.sqrt(variances), len(keyframes))
    else:
        poses = np.array(
            [
                np.full((4, 4), np.nan) if each.T_world_camera is None else inverse(each.T_world_camera)
                for each in keyframes
            ]
        )
    rows = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    if len(rows) < _LEAST_KEYFRAMES:
        return None
    renumbered = np.full(len(keyframes), -1)
    renumbered[rows] = np.arange(len(rows))
    kept = renumbered[tracks.keyframes] >= 0
    kept &= np.bincount(tracks.landmarks[kept], minlength=tracks.count)[tracks.landmarks] >= 2
    seen, landmarks = np.unique(tracks.landmarks[kept], return_inverse=True)
    if len(seen) < _LEAST_SEEN:
        return None
    observed = DriveObservations(
        camera=camera, keyframes=renumbered[tracks.keyframes[kept]], landmarks=landmarks,
        pixels=pixels[kept], pixel_deviations_px=_PIXEL_PX * sizes[kept], depths_m=depths[kept],
        depth_deviations_m=np.sqrt(variances[kept]), rates_m_s=rates[kept],
        twists_s=np.array([keyframes[row].twist_s for row in rows]),
    )  # fmt: skip
    points = triangulate_landmarks(observed, poses[rows], len(seen))
    return DriveModel(
        rows=rows, observed=observed, T_camera_world=poses[rows], points_world=points, score=score
    )


def _score(keyframes: list[Keyframe], tracks: Tracks, reading: DepthReading) -> float:
    at, depths, _ = _gathered(keyframes, tracks, reading)
    pixels = np.concatenate([each.pixels for each in keyframes])[at]
    variances = np.concatenate([_variances(each, reading) for each in keyframes])[at]
    return _chained(keyframes[0].camera, tracks, pixels, depths, np.sqrt(variances), len(keyframes))[1]


def _gathered(keyframes: list[Keyframe], tracks: Tracks, reading: DepthReading) -> tuple[Rows, Array, Array]:
    """Return the rows of the tracks' features among those of all keyframes, their depths and rates."""
    read = [_read_depths(keyframe, reading) for keyframe in keyframes]
    starts = np.concatenate([[0], np.cumsum([len(each.pixels) for each in keyframes])])
    at = starts[tracks.keyframes] + tracks.features
    return at, np.concatenate([each[0] for each in read])[at], np.concatenate([each[1] for each in read])[at]


def _variances(keyframe: Keyframe, reading: DepthReading) -> Array:
    depths = _read_depths(keyframe, reading)[0]
    return keyframe.noise.variance_m2(np.nan_to_num(depths, nan=1.0))


def _read_depths(keyframe: Keyframe, reading: DepthReading) -> tuple[Array, Array]:
    """Return ``(n,)`` depths at the features, NaN where there are none, and ``(n,)`` their rates, m/s."""
    n = len(keyframe.pixels)
    if reading.flip or len(keyframe.around) < 2:
        return keyframe.depths_m[reading.flip], np.zeros(n)
    around = sorted(keyframe.around, key=lambda each: each[0])
    apart_s = np.array([each[0] for each in around])
    at = int(np.argmin(np.abs(apart_s - reading.delay_s)))
    if abs(apart_s[at] - reading.delay_s) > _FAR_S:
        return np.full(n, np.nan), np.zeros(n)
    now = around[at]
    rates = np.full(n, np.nan)
    # Far images first: the noise of a rate from near ones would pull the delay towards none.
    for reach_s in _REACHES_S:
        before, after = (around[row] for row in _ends(apart_s, at, reach_s))
        if after[0] > before[0]:
            rates = np.where(np.isfinite(rates), rates, (after[1] - before[1]) / (after[0] - before[0]))
    rates = np.where(np.abs(rates) < _FASTEST_M_S, rates, 0.0)
    # A depth between two images is that of the nearest one, moved on: a mean of both would have less noise
    # than either, and attract the delay.
    return now[1] + rates * (reading.delay_s - now[0]), rates


def _ends(apart_s: Array, at: int, reach_s: float) -> tuple[int, int]:
    """Return the first and the last row within a time of row *at*; of ascending times."""
    low = int(np.searchsorted(apart_s, apart_s[at] - reach_s - 1e-3))
    return low, int(np.searchsorted(apart_s, apart_s[at] + reach_s + 1e-3)) - 1


def _chained(
    camera: Camera, tracks: Tracks, pixels: Array, depths: Array, depths_dev_m: Array, count: int
) -> tuple[Array, float]:
    """Return poses of the longest run of keyframes that connect, NaN elsewhere, and a score.

    The score is the mean cost of landmarks where they are expected, in pixels and depth.
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
        for zoom in _ZOOMS if T is None and len(there) >= _LEAST_SEEN else ():
            # A frame of another camera connects to those before with its own focal length only.
            own_camera = msgspec.structs.replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy)
            T = T if T is not None else _pose(own_camera, known[landmarks[there]], at[there])
        if T is not None:
            seen = transform(T, known[landmarks[there]])
            z = np.maximum(seen[:, 2], 0.05)
            seen[:, 2] = z
            apart = np.square(camera.project(seen) - at[there]).sum(axis=1) / _SCORE_PX**2
            deep = np.square((z - depth[there]) / (_SCORE_DEVIATIONS * depths_dev_m[own][there]))
            cost = np.log1p(np.minimum(apart, 1e4)) + np.log1p(np.minimum(np.nan_to_num(deep, nan=1.0), 1e4))
            total += float(np.minimum(cost, _MISS).sum())
        elif row > 0:
            total += _MISS * max(len(there), _LEAST_SEEN)
        if row > 0:
            counted += max(len(there), _LEAST_SEEN if T is None else 0)
        if T is None:
            number += 1
            known[:] = np.nan
            T = np.eye(4)
        poses[row], part[row] = T, number
        fresh = np.isfinite(depth)
        # A landmark is where it was seen last: an error of one depth does not stay.
        known[landmarks[fresh]] = transform(inverse(T), camera.back_project(at[fresh], depth[fresh]))
    poses[part != np.bincount(part).argmax()] = np.nan
    return poses, total / max(counted, 1)


def _pose(camera: Camera, points: Array, pixels: Array) -> Array | None:
    if len(points) < _LEAST_SEEN:
        return None
    try:
        found = solve_pnp(points, pixels, camera, _PNP)
    except PnpError:
        return None
    enough = max(_LEAST_SEEN // 2, _LEAST_SHARE * len(points))
    return found.T_camera_world if len(found.inliers) >= enough else None
