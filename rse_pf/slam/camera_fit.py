"""Compare the camera that a photo is said to have with the one that its matches fit best.

A pose that is wrong compensates most of a wrong focal length or principal point, so that the reprojection
error stays below any fixed limit.  Self-calibration, which adjusts camera and pose together, shows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array, Camera, adjoint, exp_se3, inverse, transform

__all__ = ["CameraFit", "fit_camera"]

_ITERATIONS = 16
_FIRST_SCALE_PX = 16.0  # of the loss: matches count that a camera which is 20 % off misses
_LAST_SCALE_PX = 2.0  # of the loss: the noise of ORB's corners
_SCALE_SHRINK = 0.75  # of the scale at each iteration
_FOCAL_DEVIATION = 0.3  # of the logarithm of the focal length, before anything is seen
_CENTRE_DEVIATION = 0.2  # of the principal point, as a share of the width, before anything is seen
_SHUTTER_DEVIATION_PX = 20.0  # of how far a rolling shutter moves the last row against the first
_NEAREST_M = 0.05  # points that a step puts nearer, or behind the camera, count as this far
_LEAST_VARIANCE_PX2 = 0.1  # of a pixel, however well all matches fit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraFit:
    """The pose ``T_map_camera`` ``(4, 4)`` that the adjusted camera has.

    ``covariance`` ``(6, 6)`` is of the twist (metres, radians) on its left.  ``log_focal`` is the logarithm
    of the adjusted focal length over the given one, with its standard deviation.
    """

    T_map_camera: Array
    covariance: Array
    log_focal: float
    log_focal_deviation: float


def fit_camera(points_map: Array, pixels: Array, T_map_camera: Array, camera: Camera) -> CameraFit:
    """Adjust pose, focal length and principal point to all matches, whether they agreed with the pose or not.

    A rolling shutter is adjusted, too: else a quick turn looks like another camera.

    Args:
        points_map: ``(n, 3)`` metres, n at least 6.
        pixels: ``(n, 2)``, undistorted as the given camera says.
        T_map_camera: ``(4, 4)``, the pose that was found with the given camera.
        camera: The given camera.

    Source:
        Gauss-Newton on Geman-McClure's loss whose scale shrinks, as in Yang et al., Graduated Non-Convexity
        for Robust Spatial Perception, 2020.
    """
    T_camera_map = inverse(T_map_camera)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    row = (pixels[:, 1:] - 0.5 * camera.height) / camera.height
    deviations = [_FOCAL_DEVIATION, *[_CENTRE_DEVIATION * camera.width] * 2, *[_SHUTTER_DEVIATION_PX] * 2]
    prior = np.square(1.0 / np.array(deviations))
    change = np.zeros(
        5
    )  # logarithm of the focal length's ratio; steps of the principal point and shutter, px
    scale_px = _FIRST_SCALE_PX
    for _ in range(_ITERATIONS):
        points = transform(T_camera_map, points_map)
        depths = np.maximum(points[:, 2], _NEAREST_M)
        rays = points[:, :2] / depths[:, None]
        adjusted = focal * np.exp(change[0])
        errors = pixels - adjusted * rays - centre - change[1:3] - row * change[3:]
        weights = (1.0 + np.square(errors).sum(axis=1) / scale_px**2) ** -2.0
        slopes = _slopes(rays, depths, adjusted, row[:, 0])
        weighted = (slopes * weights[:, None, None]).reshape(-1, 11)
        information = weighted.T @ slopes.reshape(-1, 11)
        information[range(6, 11), range(6, 11)] += prior
        gradient = weighted.T @ errors.ravel()
        gradient[6:] -= prior * change
        step = np.linalg.solve(information + 1e-9 * np.diag(np.diag(information)), gradient)
        T_camera_map = exp_se3(step[:6]) @ T_camera_map
        change = change + step[6:]
        scale_px = max(_LAST_SCALE_PX, _SCALE_SHRINK * scale_px)
    squares_px2 = float(weights @ np.square(errors).sum(axis=1))
    variance_px2 = max(_LEAST_VARIANCE_PX2, squares_px2 / (2.0 * float(weights.sum())))
    covariance = variance_px2 * np.linalg.inv(information)
    T_adjusted = inverse(T_camera_map)
    # The inverse of exp(xi) T has the twist -Ad(inverse(T)) xi on its left.
    to_map = adjoint(T_adjusted)
    return CameraFit(
        T_map_camera=T_adjusted,
        covariance=to_map @ covariance[:6, :6] @ to_map.T,
        log_focal=float(change[0]),
        log_focal_deviation=float(np.sqrt(covariance[6, 6])),
    )


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
