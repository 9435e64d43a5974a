"""Undo the rolling shutter in the images of a camera that rotates, and estimate its readout time.

A camera such as a Kinect reads its image rows one after the other, in about 30 ms from the first to the last.
If it rotates by 100 degrees a second meanwhile, its image is sheared by 3 degrees from top to bottom.
Features are moved to where they would be if all rows were read at the same time as the middle row.  The
translation of the camera during the readout is neglected.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from client_sdk.tracking.keyframe_map import View
from client_sdk.tracking.landmark_matching import Matches
from rse_pf.geometry import Array, Camera, log_se3, skew
from rse_pf.slam.tracking import Features, FittedPose, Observations, fit_readout_change

__all__ = [
    "ReadoutEstimate",
    "correct_view",
    "measure_readout_change",
    "rotation_rate",
    "shutter_displacements",
    "undo_rolling_shutter",
]

_MAX_READOUT_S = 0.05
"""Largest estimated readout time of a camera, in seconds: slower sensors are not built."""
_INITIAL_SIGMA_S = 0.02
"""Standard deviation, in seconds, of the first estimate of the readout time, which is 0 (a global
shutter)."""
_MIN_RATE_RAD_S = 0.2
"""Rotation rate, in rad/s, below which an image does not update the readout time: its shear is too small."""
_SMALL_SINE = 1e-5
"""Sine of an angle below which the angle equals its sine in double precision."""
_ROTATION_SIGMA_RAD = 0.01
"""Standard deviation, in radians, with which one image measures the rotation of the camera during its
readout: the errors of its features are correlated, so that more features do not make it smaller."""
_DRIFT_SIGMA_S = 0.0003
"""Standard deviation, in seconds, that the Kalman filter adds for each image, so that it does not rely on the
first images for ever; the readout time itself is constant."""
_MIN_LANDMARKS = 30
"""Fewest inliers with depth by which one image measures the readout time."""


def undo_rolling_shutter(features: Features, camera: Camera, rotation_rad: Array) -> Features:
    """Return features as a camera with a global shutter would show them.

    Args:
        features: Features as the image shows them.
        camera: Intrinsics.
        rotation_rad: ``(3,)``, rotation vector of the camera during the readout of the image, in radians and
            in the camera's frame; for zeros the same features are returned.
    """
    if not rotation_rad.any():
        return features
    rays = camera.back_project(features.pixels, np.ones(len(features.pixels)))
    moments = _readout_moments(features.pixels, camera)
    return replace(
        features,
        pixels=camera.project(_rotate_by_shares(rays, moments, rotation_rad)),
        points_camera=_rotate_by_shares(features.points_camera, moments, rotation_rad),
    )


def shutter_displacements(features: Features, points_camera: Array, camera: Camera, rate: Array) -> Array:
    """Return the derivatives of the corrected points by the readout time.

    If the estimated readout time grows by *t* seconds, a point that `undo_rolling_shutter` returned moves by
    *t* times its displacement.  Points of the middle row do not move, and only the rotation of the camera
    counts.

    Args:
        features: ``n`` features as the image shows them.
        points_camera: ``(n, 3)``, their points in the camera's frame.
        camera: Intrinsics.
        rate: ``(3,)`` rad/s, rotation rate of the camera in its own frame.

    Returns:
        ``(n, 3)``, in the unit of the points per second, in the camera's frame.
    """
    moments = _readout_moments(features.pixels, camera)
    displacements: Array = moments[:, None] * (points_camera @ skew(rate).T)
    return displacements


def correct_view(view: View, readout_s: float, rate: Array) -> View:
    """Return an image with pixels, points and displacements of its features computed without rolling shutter.

    Args:
        view: The image, whose features have not been corrected yet.
        readout_s: Readout time of the camera, in seconds.
        rate: ``(3,)`` rad/s, rotation rate of the camera in its own frame.
    """
    corrected = undo_rolling_shutter(view.features, view.camera, readout_s * rate)
    displacements = shutter_displacements(view.features, corrected.points_camera, view.camera, rate)
    return replace(view, features=corrected, shutter_displacements=displacements)


def rotation_rate(
    T_world_first: Array, T_world_second: Array, interval_s: float, previous_rate: Array
) -> Array:
    """Return the ``(3,)`` rotation rate of a camera at the second of two poses, in rad/s.

    The rate is in the camera's own frame.

    Args:
        T_world_first: ``(4, 4)``.
        T_world_second: ``(4, 4)``.
        interval_s: Time from the first to the second pose, in seconds, above 0.
        previous_rate: ``(3,)`` rad/s, mean rate over the interval before the first pose; zeros if it is not
            known: then the mean rate between the two poses is returned.
    """
    mean = _rotation_vector(T_world_first[:3, :3].T @ T_world_second[:3, :3]) / interval_s
    # The mean rate is that of the middle of the interval.  It is extrapolated by half the difference of the
    # two mean rates, that is by half an interval if both intervals are equally long.
    return mean + 0.5 * (mean - previous_rate) if previous_rate.any() else mean


def measure_readout_change(
    view: View, matches: Matches, observed: Observations, fitted: FittedPose
) -> tuple[float, float]:
    """Measure by how many seconds the readout time is wrong, from one image with its pose.

    Args:
        view: The image, corrected with the present readout time.
        matches: Landmarks that the image shows.
        observed: Observations of these landmarks.
        fitted: The pose that fits them.

    Returns:
        The seconds by which the readout takes longer than the present estimate (negative: shorter), and the
        information of this number (1/s^2); 0 and 0 with fewer than 30 inliers with depth.
    """
    rows = np.flatnonzero(fitted.is_inlier & (observed.depths_m > 0.0))
    if len(rows) < _MIN_LANDMARKS:
        return 0.0, 0.0
    of_landmarks = matches.shutter_displacements[rows] @ fitted.T_camera_world[:3, :3].T
    of_image = view.shutter_displacements[matches.features[rows]]
    return fit_readout_change(
        observed.select(rows), of_landmarks - of_image, view.camera, fitted.T_camera_world
    )


class ReadoutEstimate:
    """Readout time of a camera from the first to the last row, by a Kalman filter; 0 for a global shutter."""

    def __init__(self) -> None:
        self.readout_s = 0.0
        self._variance = _INITIAL_SIGMA_S**2

    def update(self, change_s: float, information: float, rate: Array) -> float:
        """Update the estimate by one image; return the seconds that were added to it.

        An image without information, or of a camera that rotates slowly, changes nothing.

        Args:
            change_s: Seconds by which the readout takes longer than the estimate, measured by the image.
            information: Inverse variance of *change_s*, 1/s^2; 0 if the image does not measure it.
            rate: ``(3,)`` rad/s, rotation rate of the camera.
        """
        speed = float(np.linalg.norm(rate))
        if not (information > 0.0 and speed > _MIN_RATE_RAD_S):
            return 0.0
        variance = 1.0 / information + (_ROTATION_SIGMA_RAD / speed) ** 2
        self._variance += _DRIFT_SIGMA_S**2
        gain = self._variance / (self._variance + variance)
        previous_s = self.readout_s
        self.readout_s = float(np.clip(previous_s + gain * change_s, 0.0, _MAX_READOUT_S))
        self._variance *= 1.0 - gain
        return self.readout_s - previous_s


def _readout_moments(pixels: Array, camera: Camera) -> Array:
    """Return when each pixel is read, as a share of the readout: -0.5 in the first row, 0.5 in the last."""
    moments: Array = (pixels[:, 1] - 0.5 * (camera.height - 1)) / camera.height
    return moments


def _rotate_by_shares(points: Array, shares: Array, rotation_rad: Array) -> Array:
    """Rotate each of ``(n, 3)`` points by its share of a rotation vector.

    The relative error of a rotated point is below 1e-5 if its share of the rotation is below half a radian.

    This is the formula of Rodrigues with sine and cosine as series of the angle.
    """
    K = skew(rotation_rad)
    theta2 = shares**2 * float(rotation_rad @ rotation_rad)
    along, across = shares * (1.0 - theta2 / 6.0), shares**2 * (0.5 - theta2 / 24.0)
    rotated: Array = points + along[:, None] * (points @ K.T) + across[:, None] * (points @ (K @ K).T)
    return rotated


def _rotation_vector(R: Array) -> Array:
    """Return the ``(3,)`` rotation vector of a rotation matrix, as `log_se3` does, in a tenth of its time."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine, cosine = math.sqrt(x * x + y * y + z * z), 0.5 * (a + e + i - 1.0)
    if cosine < 0.0:
        T = np.eye(4)
        T[:3, :3] = R
        return log_se3(T[None])[0, 3:]
    scale = 1.0 if sine < _SMALL_SINE else math.atan2(sine, cosine) / sine
    return np.array([scale * x, scale * y, scale * z])
