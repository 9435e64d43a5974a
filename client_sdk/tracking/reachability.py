"""Can the camera have moved to a recognised place?

Two places may look the same: twin rooms, or a corridor that repeats.  An image cannot tell which of them it
shows, but a camera that was not observed for some seconds cannot be everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array

__all__ = [
    "DRIFT_DEPTH_SHARE",
    "MAX_DRIFT",
    "REACH_DEPTH_SHARE",
    "Reach",
    "reach_after",
    "reach_at_begin",
    "reach_between",
]

MAX_DRIFT = 0.2
"""Largest drift of a tracked camera without depth, as a share of the length of its path, in addition to
`DRIFT_DEPTH_SHARE`: a loop closure that corrects more most likely connects two places that look the same."""
DRIFT_DEPTH_SHARE = 0.5
"""Drift that is allowed in addition to `MAX_DRIFT`, as a share of the distance of what the camera sees: two
places that look the same are farther apart."""
REACH_DEPTH_SHARE = 0.1
"""A recognised pose may lie outside the reach by this share of the distance of what the camera sees there:
poses have errors, and maps drift."""
_SPEED_MARGIN = 1.15
"""While it is not observed, the camera moves at most this many times as fast as ever before: with 1.25, a
drive in a corridor that repeats every 5 m was continued 5 m too far back."""
_SPEED_WINDOW_S = 0.5
"""Speeds are measured over at least this time, in seconds: over a shorter one they are noise."""
_PREDICTED_S = 3.0
"""For this time after its last pose, in seconds, the camera is expected to move on at a constant velocity: a
longer prediction says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """The ball in which a camera may be after it was not observed for some time.

    Attributes:
        centre: ``(3,)``, predicted position.
        radius: Radius of the ball; infinite if the time or the speed is not known.
    """

    centre: Array
    radius: float

    def excess(self, position: Array) -> float:
        """Return how far a ``(3,)`` position lies outside the ball; 0 inside."""
        return max(0.0, float(np.linalg.norm(position - self.centre)) - self.radius)

    def farthest(self, position: Array) -> float:
        """Return the largest distance of a ``(3,)`` position from a point of the ball."""
        return float(np.linalg.norm(position - self.centre)) + self.radius


def reach_after(path: Trajectory, stamp_s: float, known_motion: float = 0.0, known_s: float = 0.0) -> Reach:
    """Return where a camera may be at a time after the last pose of a path.

    Args:
        path: Poses in the order of time, one or more.
        stamp_s: The time, in seconds.  If it is not after the path, time stamps mean nothing: the radius is
            infinite.  So it is for a path without two times, whose speed is not known.
        known_motion: Distance that the camera moved in *known_s* of this time in an unknown direction, in the
            unit of the path.
        known_s: Time after the path for which the camera was observed, but not in the frame of the path.
    """
    stamps_s, rows = np.unique(path.timestamps_s, return_index=True)
    positions, elapsed_s = path.positions[rows], stamp_s - stamps_s[-1] - known_s
    if len(stamps_s) < 2 or elapsed_s < 0.0 or stamp_s <= stamps_s[-1]:
        return Reach(positions[-1], math.inf)
    after = np.searchsorted(stamps_s, stamps_s + _SPEED_WINDOW_S).clip(max=len(stamps_s) - 1)
    steps_s = np.maximum(stamps_s[after] - stamps_s, _SPEED_WINDOW_S)
    fastest = float((np.linalg.norm(positions[after] - positions, axis=1) / steps_s).max())
    before = max(0, int(np.searchsorted(stamps_s, stamps_s[-1] - _SPEED_WINDOW_S, side="right")) - 1)
    velocity = (positions[-1] - positions[before]) / (stamps_s[-1] - stamps_s[before])
    predicted_s = 0.0 if known_s else min(elapsed_s, _PREDICTED_S)
    return Reach(positions[-1] + predicted_s * velocity, _SPEED_MARGIN * fastest * elapsed_s + known_motion)


def reach_between(path: Trajectory, own: Trajectory, stamp_s: float) -> Reach:
    """Return where a camera may be in the frame of a path that it left for a segment in another frame.

    Args:
        path: Poses of the segment that was left, in the order of time, one or more.
        own: Poses of the present segment, in the order of time.
        stamp_s: The time, in seconds.
    """
    rows = np.flatnonzero(own.timestamps_s > path.timestamps_s[-1])
    if not len(rows):
        return reach_after(path, stamp_s)
    known_s = float(own.timestamps_s[-1] - own.timestamps_s[rows[0]])
    moved = float(np.linalg.norm(own.positions[-1] - own.positions[rows[0]]))
    return reach_after(path, stamp_s, moved, known_s)


def reach_at_begin(older: Trajectory, newer: Trajectory) -> Reach:
    """Return where the first pose of a newer segment may be in the frame of an older one.

    Both are in the order of time.  The radius is infinite if the older one has no pose before the newer one.
    """
    begin_s = float(newer.timestamps_s[0])
    rows = np.flatnonzero(older.timestamps_s < begin_s)
    if not len(rows):
        return Reach(older.positions[0], math.inf)
    return reach_after(Trajectory(older.timestamps_s[rows], older.T_world_camera[rows]), begin_s)
