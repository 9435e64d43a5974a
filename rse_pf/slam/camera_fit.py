"""Compare the camera that a photo is said to have with the one that its matches fit best.

A pose that is wrong compensates most of a wrong focal length or principal point, so that the reprojection
error stays below any fixed limit.  Self-calibration, which adjusts camera and pose together, shows it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array, Camera, adjoint, exp_se3, inverse, transform

__all__ = ["CameraFit", "fit_camera"]

_ITERATIONS = 16
_FIRST_SCALES_PX = (16.0, 32.0)  # of the loss: matches count that a camera 20 or 40 % off misses
_LAST_SCALE_PX = 2.0  # of the loss: the noise of ORB's corners
_SCALE_SHRINK = 0.75  # of the scale at each iteration
_FOCAL_DEVIATION = 0.2  # of the logarithm of the focal length, before anything is seen
_CENTRE_DEVIATION = 0.1  # of the principal point, as a share of the width, before anything is seen
_SHUTTER_DEVIATION_PX = 20.0  # of how far a rolling shutter moves the last row against the first
_NEAREST_M = 0.05  # points that a step puts nearer, or behind the camera, count as this far
_LEAST_VARIANCE_PX2 = 0.1  # of a pixel, however well all matches fit
_COMMON_ERRORS = 5.0  # times the variance of independent errors, since matches share keyframes; measured
_LEAST_EIGENVALUE = 1e-9  # of information whose diagonal is 1: less is not invertible
_DEPTH_DEVIATION = 0.01  # of the depth of a map's point, as a share of it; that of a Kinect at 6 m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraFit:
    """The pose ``T_map_camera`` ``(4, 4)`` that the adjusted camera has.

    ``covariance`` ``(6, 6)`` is of the twist (metres, radians) on its left.  ``log_focal`` is the logarithm
    of the adjusted focal length over the given one.  The standard deviations are of this logarithm, of the
    position and of the direction of the camera.
    """

    T_map_camera: Array
    covariance: Array
    log_focal: float
    log_focal_deviation: float
    position_deviation_m: float
    turn_deviation_deg: float


def fit_camera(
    points_map: Array, origins_map: Array, pixels: Array, T_map_camera: Array, camera: Camera
) -> CameraFit:
    """Adjust pose, focal length and principal point to all matches, whether they agreed with the pose or not.

    A rolling shutter is adjusted, too: else a quick turn looks like another camera.  Errors of the points of
    a keyframe are common to their matches, and a pixel may match several keyframes, so that all variances
    are larger than those of independent errors.  Before a flat wall only errors of the depths make points
    leave their plane, and seem to determine the camera: the information that they feign is left out.

    Args:
        points_map: ``(n, 3)`` metres, n at least 6.
        origins_map: ``(n, 3)`` metres, where the cameras were that measured the points.
        pixels: ``(n, 2)``, undistorted as the given camera says.
        T_map_camera: ``(4, 4)``, the pose that was found with the given camera.
        camera: The given camera.

    Source:
        Gauss-Newton on Geman-McClure's loss whose scale shrinks, as in Yang et al., Graduated Non-Convexity
        for Robust Spatial Perception, 2020.  The information is corrected as in Fuller, Measurement Error
        Models, 1987, Sect. 2.2.
    """
    deviations = [_FOCAL_DEVIATION, *[_CENTRE_DEVIATION * camera.width] * 2, *[_SHUTTER_DEVIATION_PX] * 2]
    prior = np.square(1.0 / np.array(deviations))
    starts = [_adjust(points_map, pixels, T_map_camera, camera, prior, scale) for scale in _FIRST_SCALES_PX]
    found = min(starts, key=lambda each: each.cost)
    longer_map = points_map + _DEPTH_DEVIATION * (points_map - origins_map)
    change_by_depth = found.slopes_of(longer_map, pixels, camera)[0] - found.slopes
    weights = found.weights[:, None, None]
    information = (found.slopes * weights).reshape(-1, 11).T @ found.slopes.reshape(-1, 11)
    feigned = (change_by_depth * weights).reshape(-1, 11).T @ change_by_depth.reshape(-1, 11)
    squares_px2 = float(found.weights @ np.square(found.errors).sum(axis=1))
    variance_px2 = max(_LEAST_VARIANCE_PX2, squares_px2 / (2.0 * float(found.weights.sum())))
    covariance = _covariance_of(information, feigned, _COMMON_ERRORS * variance_px2, prior)
    variances = np.diag(covariance)
    T_adjusted = inverse(found.T_camera_map)
    # The inverse of exp(xi) T has the twist -Ad(inverse(T)) xi on its left.
    to_map = adjoint(T_adjusted)
    return CameraFit(
        T_map_camera=T_adjusted,
        covariance=to_map @ covariance[:6, :6] @ to_map.T,
        log_focal=float(found.change[0]),
        log_focal_deviation=math.sqrt(variances[6]),
        position_deviation_m=math.sqrt(variances[:3].sum()),
        turn_deviation_deg=math.degrees(math.sqrt(variances[3:6].sum())),
    )


class _Adjusted:
    """A pose and a camera with the errors that they leave.

    ``change`` is the logarithm of the focal length's ratio, and the steps of the principal point and of a
    rolling shutter, px.  ``errors`` ``(n, 2)`` and ``slopes`` ``(n, 2, 11)`` are of the pixels, ``weights``
    ``(n,)`` and ``cost`` those of the loss.
    """

    def __init__(
        self, points_map: Array, pixels: Array, camera: Camera, T_camera_map: Array, change: Array,
        scale_px: float,
    ) -> None:  # fmt: skip
        self.T_camera_map, self.change = T_camera_map, change
        self.slopes, self.errors = self.slopes_of(points_map, pixels, camera)
        ratios = np.square(self.errors).sum(axis=1) / scale_px**2
        self.weights = (1.0 + ratios) ** -2.0
        self.cost = scale_px**2 * float((ratios / (1.0 + ratios)).sum())

    def slopes_of(self, points_map: Array, pixels: Array, camera: Camera) -> tuple[Array, Array]:
        """Return how pixels move, and their errors, if the points were these."""
        points = transform(self.T_camera_map, points_map)
        depths = np.maximum(points[:, 2], _NEAREST_M)
        rays = points[:, :2] / depths[:, None]
        focal = np.array([camera.fx, camera.fy]) * np.exp(self.change[0])
        row = pixels[:, 1:] / camera.height - 0.5
        errors = pixels - focal * rays - [camera.cx, camera.cy] - self.change[1:3] - row * self.change[3:]
        return _slopes(rays, depths, focal, row[:, 0]), errors


def _adjust(
    points_map: Array, pixels: Array, T_map_camera: Array, camera: Camera, prior: Array, first_scale_px: float
) -> _Adjusted:
    """Return pose and camera after the scale of the loss has shrunk from its first to its last value."""
    T_camera_map, change, scale_px = inverse(T_map_camera), np.zeros(5), first_scale_px
    for _ in range(_ITERATIONS):
        # The prior is weak while the scale is large, so that a wrong camera can be left.
        pull = _COMMON_ERRORS * (_LAST_SCALE_PX / scale_px) ** 2 * prior
        now = _Adjusted(points_map, pixels, camera, T_camera_map, change, scale_px)
        weighted = (now.slopes * now.weights[:, None, None]).reshape(-1, 11)
        information = weighted.T @ now.slopes.reshape(-1, 11)
        information[range(6, 11), range(6, 11)] += pull
        gradient = weighted.T @ now.errors.ravel()
        gradient[6:] -= pull * change
        step = np.linalg.solve(information + 1e-9 * np.diag(np.diag(information)), gradient)
        T_camera_map = exp_se3(step[:6]) @ T_camera_map
        change = change + step[6:]
        scale_px = max(_LAST_SCALE_PX, _SCALE_SHRINK * scale_px)
    return _Adjusted(points_map, pixels, camera, T_camera_map, change, _LAST_SCALE_PX)


def _covariance_of(information: Array, feigned: Array, variance_px2: float, prior: Array) -> Array:
    """Return the covariance that information per squared pixel, less that which is *feigned*, leaves.

    The prior is that of the camera, which is all that remains where the rest is feigned.
    """
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh((information - feigned) * np.outer(scale, scale))
    true = (vectors * np.maximum(values, _LEAST_EIGENVALUE)) @ vectors.T / np.outer(scale, scale)
    true /= variance_px2
    true[range(6, 11), range(6, 11)] += prior
    covariance: Array = np.linalg.inv(true)
    return covariance


def _slopes(rays: Array, depths: Array, focal: Array, row: Array) -> Array:
    """Return ``(n, 2, 11)``: how pixels move with the twist left of T_camera_map, and with the camera."""
    x, y = rays.T
    slopes = np.zeros((len(rays), 2, 11))
    across = (1.0 / depths, np.zeros_like(x), -x / depths, -x * y, 1.0 + x * x, -y, x)
    down = (np.zeros_like(x), 1.0 / depths, -y / depths, -1.0 - y * y, x * y, x, y)
    slopes[:, 0, :7] = focal[0] * np.stack(across, axis=1)
    slopes[:, 1, :7] = focal[1] * np.stack(down, axis=1)
    slopes[:, 0, 7] = slopes[:, 1, 8] = 1.0
    slopes[:, 0, 9] = slopes[:, 1, 10] = row
    return slopes
