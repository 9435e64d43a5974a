"""Check the stated camera of a photo: fit a camera to the matches of the photo, and compare both.

A wrong pose compensates most of a wrong focal length or principal point, so that the reprojection error does
not show that the camera is wrong.  Self-calibration, which adjusts camera and pose together, does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array, Camera, adjoint, exp_se3, inverse, transform

__all__ = ["CameraFit", "fit_camera"]

_ITERATIONS = 16  # Gauss-Newton steps of a fit; the scale of the loss shrinks after each of them
_FIRST_SCALES_PX = (16.0, 32.0)
"""First scale of the loss in pixels in each of the two fits of a photo, of which the fit with the lower cost
is used.  A focal length that is wrong by 20 % moves pixels by about 16 px, and one that is wrong by 40 % by
about 32 px, so that inliers still have a large weight."""
_LAST_SCALE_PX = 2.0  # scale of the loss at the end, px: the noise of ORB corners
_SCALE_SHRINK = 0.75  # factor by which the scale of the loss is multiplied after each step
_LOG_FOCAL_DEVIATION = 0.2
"""Prior standard deviation of the natural logarithm of the quotient of true and stated focal length."""
_CENTRE_DEVIATION = 0.1  # prior standard deviation of the principal point, as a share of the image width
_SHUTTER_DEVIATION_PX = 20.0
"""Prior standard deviation, px, of the shift between the first and the last row of an image that a rolling
shutter and the motion of the camera cause."""
# Depth in metres at which a point is projected that is nearer than this depth, or behind the camera.
_MIN_DEPTH_M = 0.05
_MIN_VARIANCE_PX2 = 0.1  # smallest variance of a pixel, px^2: it replaces a smaller one that matches suggest
_CORRELATION_FACTOR = 5.0
"""Factor by which the variance of a pose is larger than the variance that is computed with the assumption
that the errors of all matches are independent.  The factor was measured.  The errors are not independent:
matches of one keyframe share the errors of its points, and one pixel may match several keyframes."""
_MIN_EIGENVALUE = 1e-9
"""Smallest eigenvalue of an information matrix that is scaled to a diagonal of 1.  A smaller eigenvalue is
the result of rounding, and is replaced by this one."""
_DEPTH_DEVIATION = 0.01  # relative standard deviation of the depth of a map point: that of a Kinect at 6 m
_CAMERA_PARAMETERS = slice(6, 11)
"""Columns of the camera among the 11 parameters: logarithm of the focal length, principal point (2), shift by
a rolling shutter (2); the first six are the twist of the pose."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraFit:
    """The pose and the focal length that fit the matches of a photo best, with their uncertainty.

    Attributes:
        T_map_camera: ``(4, 4)``, m, pose with the fitted camera.
        covariance: ``(6, 6)`` of the twist (m, rad) on the left of the pose.  It contains the uncertainty of
            the focal length, the principal point and the rolling shutter.
        log_focal: Natural logarithm of the quotient of fitted and stated focal length.
        log_focal_deviation: Standard deviation of that logarithm.
        position_deviation_m: Root of the summed variances of the camera's position along the three axes.
        turn_deviation_deg: Root of the summed variances of the camera's rotation about the three axes.
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
    """Fit pose, focal length, principal point and rolling shutter to all matches of a photo.

    The matches that PnP rejected with the stated camera are used, too: with a wrong camera, PnP rejects right
    matches.  The loss of the fit is robust, so that wrong matches have a small weight.  The rolling shutter
    is fitted because the distortion by a quick rotation during the exposure would otherwise change the
    camera.

    Args:
        points_map: ``(n, 3)`` m, matched points of the map, at least 6.
        origins_map: ``(n, 3)`` m, for each point the position of the camera that measured it.
        pixels: ``(n, 2)``, pixels of the photo, undistorted by the stated camera.
        T_map_camera: ``(4, 4)`` m, pose that was computed with the stated camera, from which the fits begin.
        camera: The stated camera.

    Source:
        Gauss-Newton on the Geman-McClure loss with a shrinking scale: Yang et al., Graduated Non-Convexity
        for Robust Spatial Perception, 2020.  Correction of the information for noise of the points: Fuller,
        Measurement Error Models, 1987, Sect. 2.2.
    """
    # 1. Fit twice, from each of `_FIRST_SCALES_PX` as the first scale of the loss, with a prior of these
    #    standard deviations on the camera; take the fit with the lower cost.
    deviations = [
        _LOG_FOCAL_DEVIATION,
        *[_CENTRE_DEVIATION * camera.width] * 2,
        *[_SHUTTER_DEVIATION_PX] * 2,
    ]
    prior_information = np.square(1.0 / np.array(deviations))
    fits = [
        _adjust(points_map, pixels, T_map_camera, camera, prior_information, scale_px)
        for scale_px in _FIRST_SCALES_PX
    ]
    fit = min(fits, key=lambda fit: fit.cost)
    # 2. Compute the information of the matches, and the spurious part of it that results from depth errors of
    # the points.  The points of a flat wall do not determine the focal length; but depth errors move them off
    # their plane, so that the information matrix states that they do.
    shifted_map = points_map + _DEPTH_DEVIATION * (points_map - origins_map)
    jacobian_change = fit.jacobian_and_errors(shifted_map, pixels, camera)[0] - fit.jacobian
    weights = fit.weights[:, None, None]
    information = (fit.jacobian * weights).reshape(-1, 11).T @ fit.jacobian.reshape(-1, 11)
    spurious = (jacobian_change * weights).reshape(-1, 11).T @ jacobian_change.reshape(-1, 11)
    # 3. Estimate the variance of a pixel from the errors that remain, and compute the covariance with it.
    squares_px2 = float(fit.weights @ np.square(fit.errors_px).sum(axis=1))
    variance_px2 = max(_MIN_VARIANCE_PX2, squares_px2 / (2.0 * float(fit.weights.sum())))
    covariance = _covariance_of(information, spurious, _CORRELATION_FACTOR * variance_px2, prior_information)
    variances = np.diag(covariance)
    # 4. Convert the twist left of T_camera_map into that left of T_map_camera: the inverse of exp(xi) T has
    # the twist -Ad(inverse(T)) xi on its left.
    T_fitted = inverse(fit.T_camera_map)
    adjoint_to_map = adjoint(T_fitted)
    return CameraFit(
        T_map_camera=T_fitted,
        covariance=adjoint_to_map @ covariance[:6, :6] @ adjoint_to_map.T,
        log_focal=float(fit.camera_change[0]),
        log_focal_deviation=math.sqrt(variances[6]),
        position_deviation_m=math.sqrt(variances[:3].sum()),
        turn_deviation_deg=math.degrees(math.sqrt(variances[3:6].sum())),
    )


class _Fit:
    """A pose and a camera, with the errors and the weights of all matches.

    Attributes:
        T_camera_map: ``(4, 4)``, m.
        camera_change: ``(5,)``: natural logarithm of the quotient of this and the stated focal length, shift
            of the principal point (2, px), shift between the first and the last row by a rolling shutter (2,
            px).
        jacobian: ``(n, 2, 11)``, derivative of the projected pixels by twist and camera.
        errors_px: ``(n, 2)``, matched pixels minus projected ones.
        weights: ``(n,)``, weights of the Geman-McClure loss.
        cost: The loss of all matches, px^2.
    """

    def __init__(
        self,
        points_map: Array,
        pixels: Array,
        camera: Camera,
        T_camera_map: Array,
        camera_change: Array,
        scale_px: float,
    ) -> None:
        self.T_camera_map, self.camera_change = T_camera_map, camera_change
        self.jacobian, self.errors_px = self.jacobian_and_errors(points_map, pixels, camera)
        ratios = np.square(self.errors_px).sum(axis=1) / scale_px**2
        self.weights = (1.0 + ratios) ** -2.0
        self.cost = scale_px**2 * float((ratios / (1.0 + ratios)).sum())

    def jacobian_and_errors(self, points_map: Array, pixels: Array, camera: Camera) -> tuple[Array, Array]:
        """Return Jacobian ``(n, 2, 11)`` and errors ``(n, 2)``, px, of points ``(n, 3)`` of the map.

        Both are those at the pose and the camera of this fit, *camera* being the stated camera.
        """
        points = transform(self.T_camera_map, points_map)
        depths = np.maximum(points[:, 2], _MIN_DEPTH_M)
        rays = points[:, :2] / depths[:, None]
        focal = np.array([camera.fx, camera.fy]) * np.exp(self.camera_change[0])
        row_fractions = pixels[:, 1:] / camera.height - 0.5
        errors_px = pixels - focal * rays - [camera.cx, camera.cy]
        errors_px = errors_px - self.camera_change[1:3] - row_fractions * self.camera_change[3:]
        return _projection_jacobian(rays, depths, focal, row_fractions[:, 0]), errors_px


def _adjust(
    points_map: Array,
    pixels: Array,
    T_map_camera: Array,
    camera: Camera,
    prior_information: Array,
    first_scale_px: float,
) -> _Fit:
    """Return pose and camera after Gauss-Newton steps on a loss whose scale shrinks to `_LAST_SCALE_PX`.

    *prior_information* ``(5,)`` draws the camera towards the stated *camera*.
    """
    T_camera_map, camera_change, scale_px = inverse(T_map_camera), np.zeros(5), first_scale_px
    for _ in range(_ITERATIONS):
        # The prior on the camera is multiplied by the square of last scale / scale: it is weak at first, so
        # that the fit can move away from the stated camera if that is wrong.
        prior = _CORRELATION_FACTOR * (_LAST_SCALE_PX / scale_px) ** 2 * prior_information
        fit = _Fit(points_map, pixels, camera, T_camera_map, camera_change, scale_px)
        weighted = (fit.jacobian * fit.weights[:, None, None]).reshape(-1, 11)
        information = weighted.T @ fit.jacobian.reshape(-1, 11)
        information[range(6, 11), range(6, 11)] += prior
        gradient = weighted.T @ fit.errors_px.ravel()
        gradient[_CAMERA_PARAMETERS] -= prior * camera_change
        step = np.linalg.solve(information + 1e-9 * np.diag(np.diag(information)), gradient)
        T_camera_map = exp_se3(step[:6]) @ T_camera_map
        camera_change = camera_change + step[_CAMERA_PARAMETERS]
        scale_px = max(_LAST_SCALE_PX, _SCALE_SHRINK * scale_px)
    return _Fit(points_map, pixels, camera, T_camera_map, camera_change, _LAST_SCALE_PX)


def _covariance_of(
    information: Array, spurious: Array, variance_px2: float, prior_information: Array
) -> Array:
    """Return the covariance ``(11, 11)`` of pose and camera.

    Args:
        information: ``(11, 11)``, information matrix of the matches for pixels of variance 1 px^2.
        spurious: ``(11, 11)``, the spurious part of *information*, which results from noise of the points and
            is subtracted from it.
        variance_px2: Variance of a pixel, px^2, by which the difference is divided.
        prior_information: ``(5,)``, prior information on the parameters of the camera, which is added.
    """
    # 1. Scale to a diagonal of 1, subtract, and keep the result positive definite.
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh((information - spurious) * np.outer(scale, scale))
    corrected = (vectors * np.maximum(values, _MIN_EIGENVALUE)) @ vectors.T / np.outer(scale, scale)
    # 2. Add the prior, and invert.
    corrected /= variance_px2
    corrected[range(6, 11), range(6, 11)] += prior_information
    return np.linalg.inv(corrected)


def _projection_jacobian(rays: Array, depths: Array, focal: Array, row_fractions: Array) -> Array:
    """Return the derivatives ``(n, 2, 11)`` of pixels by the twist left of T_camera_map and by the camera.

    Args:
        rays: ``(n, 2)``, points of the camera frame divided by their depth.
        depths: ``(n,)``, m.
        focal: ``(2,)``, focal lengths, px.
        row_fractions: ``(n,)``, rows of the pixels, -0.5 at the top and 0.5 at the bottom of the image.
    """
    x, y = rays.T
    jacobian = np.zeros((len(rays), 2, 11))
    of_x = (1.0 / depths, np.zeros_like(x), -x / depths, -x * y, 1.0 + x * x, -y, x)
    of_y = (np.zeros_like(x), 1.0 / depths, -y / depths, -1.0 - y * y, x * y, x, y)
    jacobian[:, 0, :7] = focal[0] * np.stack(of_x, axis=1)
    jacobian[:, 1, :7] = focal[1] * np.stack(of_y, axis=1)
    jacobian[:, 0, 7] = jacobian[:, 1, 8] = 1.0
    jacobian[:, 0, 9] = jacobian[:, 1, 10] = row_fractions
    return jacobian
