"""Undo what a rolling shutter does to the image of a camera that turns, and estimate how long it reads one.

A camera such as a Kinect's reads its rows one after the other, about 30 ms from the first to the last.  While
it turns by 100 degrees a second, its image is turned by 3 degrees from top to bottom.  Features are moved to
where they would be if all rows were read when the middle one is.  That the camera moves on meanwhile is left
out.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from client_sdk.frontend import Features
from rse_pf.geometry import Array, Camera, log_se3, skew

__all__ = ["ReadoutEstimate", "sways", "turn_rate", "without_shutter"]

_MOST_S = 0.05
_FIRST_DEV_S = 0.02
"""Deviation of the readout from none, before any image was seen."""
_LEAST_RATE = 0.2
_LEAST_SINE = 1e-5  # an angle below it is its sine
_TURN_DEV = 0.01
"""Deviation, in radians, of the turn that an image tells of: its features err together."""
_DRIFT_S = 0.0003
"""How much the estimate may change from one image to the next in the long run."""


def without_shutter(features: Features, camera: Camera, turn: Array) -> Features:
    """Return features as a camera shows them that reads all rows at once.

    Args:
        features: As the image shows them.
        camera: Its intrinsics.
        turn: ``(3,)`` radians by which the camera turns while it reads the image, in its own frame.
    """
    if not turn.any():
        return features
    rays = camera.back_project(features.pixels, np.ones(len(features.pixels)))
    shares = _shares(features.pixels, camera)
    return replace(
        features,
        pixels=camera.project(_turned(rays, shares, turn)),
        points_camera=_turned(features.points_camera, shares, turn),
    )


def sways(features: Features, points_camera: Array, camera: Camera, rate: Array) -> Array:
    """Return how far ``(n, 3)`` points move for each second that the readout takes longer.

    Args:
        features: As the image shows them.
        points_camera: ``(n, 3)``, theirs.
        camera: Its intrinsics.
        rate: ``(3,)`` radians a second at which the camera turns, in its own frame.
    """
    moved: Array = _shares(features.pixels, camera)[:, None] * (points_camera @ skew(rate).T)
    return moved


def turn_rate(T_world_first: Array, T_world_second: Array, interval_s: float, before: Array) -> Array:
    """Return the ``(3,)`` radians a second at which a camera turns in the second pose, in its own frame.

    Args:
        T_world_first: ``(4, 4)``.
        T_world_second: ``(4, 4)``.
        interval_s: From the one to the other, above 0.
        before: ``(3,)``, the rate in the first pose; 0 if it is not known.
    """
    mean = _rotation_vector(T_world_first[:3, :3].T @ T_world_second[:3, :3]) / interval_s
    # The rate between the two poses is that in the middle; a whole step beyond it carries too much noise.
    return mean + 0.5 * (mean - before) if before.any() else mean


class ReadoutEstimate:
    """How many seconds a camera reads an image, from the first row to the last: 0 for a global shutter."""

    def __init__(self) -> None:
        self.readout_s = 0.0
        self._variance = _FIRST_DEV_S**2

    def add(self, more_s: float, information: float, rate: Array) -> float:
        """Take what an image tells of a camera that turned; return by how much the estimate changed.

        Args:
            more_s: By how much the readout takes longer than the estimate.
            information: Of *more_s*, 0 if the image tells nothing.
            rate: ``(3,)`` radians a second at which the camera turned.
        """
        speed = float(np.linalg.norm(rate))
        if not (information > 0.0 and speed > _LEAST_RATE):
            return 0.0
        variance = 1.0 / information + (_TURN_DEV / speed) ** 2
        self._variance += _DRIFT_S**2
        gain = self._variance / (self._variance + variance)
        before = self.readout_s
        self.readout_s = float(np.clip(before + gain * more_s, 0.0, _MOST_S))
        self._variance *= 1.0 - gain
        return self.readout_s - before


def _shares(pixels: Array, camera: Camera) -> Array:
    """Return when each feature was read: from -0.5 for the first row to 0.5 for the last one."""
    shares: Array = (pixels[:, 1] - 0.5 * (camera.height - 1)) / camera.height
    return shares


def _turned(points: Array, shares: Array, turn: Array) -> Array:
    """Return ``(n, 3)`` points, each rotated by its share of a turn; to 1e-5 below half a radian."""
    K = skew(turn)
    theta2 = shares**2 * float(turn @ turn)
    along, across = shares * (1.0 - theta2 / 6.0), shares**2 * (0.5 - theta2 / 24.0)
    turned: Array = points + along[:, None] * (points @ K.T) + across[:, None] * (points @ (K @ K).T)
    return turned


def _rotation_vector(R: Array) -> Array:
    """Return the ``(3,)`` logarithm of a rotation; as that of `log_se3`, in a tenth of its time."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine, cosine = math.sqrt(x * x + y * y + z * z), 0.5 * (a + e + i - 1.0)
    if cosine < 0.0:
        T = np.eye(4)
        T[:3, :3] = R
        return log_se3(T[None])[0, 3:]
    scale = 1.0 if sine < _LEAST_SINE else math.atan2(sine, cosine) / sine
    return np.array([scale * x, scale * y, scale * z])
