"""Undo what a rolling shutter does to the image of a camera that turns, and estimate how long it reads one.

A camera such as a Kinect's reads its rows one after the other, about 30 ms from the first to the last.  While
it turns by 100 degrees a second, its image is turned by 3 degrees from top to bottom.  Features are moved to
where they would be if all rows were read when the middle one is.  That the camera moves on meanwhile is left
out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from client_sdk.frontend import Features
from rse_pf.geometry import Array, Camera, inverse, log_se3, skew

__all__ = ["ReadoutEstimate", "sways", "turn_rate", "without_shutter"]

_MOST_S = 0.05
_FIRST_DEV_S = 0.02
"""Deviation of the readout from none, before any image was seen."""
_LEAST_RATE = 0.2
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
    ones = np.ones(len(features.pixels))
    rays = np.column_stack([(features.pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), ones])
    rotations = _rotations(_shares(features.pixels, camera)[:, None] * turn)
    return replace(
        features,
        pixels=camera.project(np.einsum("nij,nj->ni", rotations, rays)),
        points_camera=np.einsum("nij,nj->ni", rotations, features.points_camera),
    )


def sways(features: Features, points_camera: Array, camera: Camera, rate: Array) -> Array:
    """Return how far ``(n, 3)`` points move for each second that the readout takes longer.

    Args:
        features: As the image shows them.
        points_camera: ``(n, 3)``, theirs.
        camera: Its intrinsics.
        rate: ``(3,)`` radians a second at which the camera turns, in its own frame.
    """
    moved: Array = _shares(features.pixels, camera)[:, None] * np.cross(rate, points_camera)
    return moved


def turn_rate(T_world_first: Array, T_world_second: Array, interval_s: float, before: Array) -> Array:
    """Return the ``(3,)`` radians a second at which a camera turns in the second pose, in its own frame.

    Args:
        T_world_first: ``(4, 4)``.
        T_world_second: ``(4, 4)``.
        interval_s: From the one to the other, above 0.
        before: ``(3,)``, the rate in the first pose; 0 if it is not known.
    """
    mean: Array = log_se3((inverse(T_world_first) @ T_world_second)[None])[0, 3:] / interval_s
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


def _rotations(angles: Array) -> Array:
    """Return the ``(n, 3, 3)`` rotations by ``(n, 3)`` angles; to 1e-5 below half a radian."""
    theta2 = (angles**2).sum(axis=1)[:, None, None]
    K = skew(angles)
    rotations: Array = np.eye(3) + (1.0 - theta2 / 6.0) * K + (0.5 - theta2 / 24.0) * (K @ K)
    return rotations
