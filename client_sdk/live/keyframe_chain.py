"""The keyframes of a camera without depth, as one odometry that a live map takes.

The tracker adjusts its newest keyframes with each new one, and a live map takes each keyframe once.  So a
keyframe is sent when it has settled, and its pose continues that of the one before: what is adjusted later
moves none that was sent, and tears nothing apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from client_sdk.tracking.monocular_tracker import MonocularTracker, SeenKeyframe
from rse_pf.geometry import Array, inverse, scaled

__all__ = ["KeyframeChain"]

_NEWER = 2
"""A keyframe has settled when so many newer ones exist."""
_MOST_LOOP_SCALE = 1.03
"""A loop that corrects lengths by more ends the odometry: it had no one unit any longer."""


class KeyframeChain:
    """One odometry after the other, each in a unit of length that stays, of one tracker.

    Call `follow` for each frame that has a pose.
    """

    def __init__(self, tracker: MonocularTracker) -> None:
        self._tracker = tracker
        self._place: tuple[int, int] | None = None
        self._newest_segment = -1
        self._loops = 0
        self._next = 0
        self._unit = 1.0
        self._sent: int | None = None
        self._T_odom_sent: Array

    def follow(self) -> bool:
        """Take that a frame got a pose; say whether another odometry begins with it.

        It does in each segment of the tracker, when segments are joined, and when a loop changed the unit.
        """
        tracker = self._tracker
        place, loop_scales = (tracker.segment, len(tracker.joins)), tracker.loop_scales[self._loops :]
        self._loops += len(loop_scales)
        is_bent = any(abs(math.log(scale)) > math.log(_MOST_LOOP_SCALE) for scale in loop_scales)
        if place == self._place and not is_bent:
            return False
        is_first = self._place is None
        is_new = tracker.segment > self._newest_segment
        self._place, self._newest_segment = place, max(self._newest_segment, tracker.segment)
        self._next = 0 if is_new else tracker.segment_keyframes
        self._unit, self._sent = tracker.unit, None
        return not is_first

    def pose(self, T_world_camera: Array) -> Array:
        """Return the ``(4, 4)`` pose in the odometry of a pose that the tracker has now."""
        units = self._unit / self._tracker.unit
        if self._sent is None:
            return scaled(T_world_camera, units)
        step = inverse(self._tracker.keyframe_pose(self._sent)) @ T_world_camera
        chained: Array = self._T_odom_sent @ scaled(step, units)
        return chained

    def settled(self) -> Iterator[tuple[SeenKeyframe, Array]]:
        """Yield the keyframes that have settled since the last call, and their poses in the odometry.

        Their depths are in the unit of the odometry.
        """
        while self._next + _NEWER < self._tracker.segment_keyframes:
            seen = self._tracker.keyframe(self._next)
            T_odom_camera = self.pose(seen.T_world_camera)
            units = self._unit / self._tracker.unit
            self._sent, self._T_odom_sent = self._next, T_odom_camera
            self._next += 1
            yield replace(seen, depths=units * seen.depths), T_odom_camera
