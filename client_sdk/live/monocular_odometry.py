"""Turn the keyframes of a monocular tracker into an odometry whose poses and scale never change.

The tracker adjusts its newest keyframes with every new keyframe, and it may change its scale.  A live map
accepts each keyframe once.  Therefore a keyframe is sent only after it has settled: when two newer ones
exist.  Its pose is that of the keyframe sent before it, times the relative pose of the two by the tracker at
that time.  Later adjustments by the tracker do not move a keyframe that was sent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from client_sdk.tracking.monocular_segment import AdjustedKeyframe
from client_sdk.tracking.monocular_tracker import MonocularTracker
from rse_pf.geometry import Array, inverse, scaled

__all__ = ["MonocularOdometry"]

_SETTLED_AFTER = 2  # newer keyframes that must exist before one is sent: until then, each new one moves it
_MAX_LOOP_SCALE = 1.03
"""Largest factor by which a loop closure of the tracker may correct lengths (or divide them) within one
odometry frame; beyond it a new odometry frame begins, because lengths before and after the loop closure
differ by so much that no single scale to the map fits both."""


class MonocularOdometry:
    """Odometry frames of one monocular tracker, each with a constant scale.

    An odometry frame begins with the first pose, and whenever `start_if_broken` returns True.  Its length
    unit is the tracker's unit at that moment.  Call `start_if_broken` for each frame that has a pose, then
    `take_settled` and `pose_in_odometry`.
    """

    def __init__(self, tracker: MonocularTracker) -> None:
        self._tracker = tracker
        self._segment_and_joins: tuple[int, int] | None = None
        self._newest_segment = -1
        self._processed_loops = 0
        self._next_keyframe = 0
        self._length_factor_at_start = 1.0
        self._last_sent: int | None = None
        self._T_odom_last_sent: Array

    def start_if_broken(self) -> bool:
        """Begin an odometry frame at the tracker's last frame if needed; return whether it replaces another.

        An odometry frame begins at the first call; later if the tracker has begun or changed its segment, has
        joined segments, or has closed a loop that corrected lengths by more than 3 % since the last call.
        The first call returns False.
        """
        tracker = self._tracker
        segment_and_joins = (tracker.segment, len(tracker.joins))
        loop_scales = tracker.loop_scales[self._processed_loops :]
        self._processed_loops += len(loop_scales)
        has_new_scale = any(abs(math.log(scale)) > math.log(_MAX_LOOP_SCALE) for scale in loop_scales)
        if segment_and_joins == self._segment_and_joins and not has_new_scale:
            return False
        is_first = self._segment_and_joins is None
        is_new_segment = tracker.segment > self._newest_segment
        self._segment_and_joins = segment_and_joins
        self._newest_segment = max(self._newest_segment, tracker.segment)
        # A segment that the tracker continues has keyframes that belong to an earlier odometry frame: skip
        # them.
        self._next_keyframe = 0 if is_new_segment else tracker.segment_keyframes
        self._length_factor_at_start, self._last_sent = tracker.length_factor, None
        return not is_first

    def pose_in_odometry(self, T_world_camera: Array) -> Array:
        """Return ``T_odom_camera`` ``(4, 4)`` for a ``(4, 4)`` pose in the tracker's present world and unit.

        The result has the same pose relative to the keyframe that was sent last, in the unit of the odometry
        frame.  Before a keyframe of the odometry frame was sent, only the unit is changed.
        """
        tracker_to_odometry_scale = self._length_factor_at_start / self._tracker.length_factor
        if self._last_sent is None:
            return scaled(T_world_camera, tracker_to_odometry_scale)
        T_sent_camera = inverse(self._tracker.keyframe_pose(self._last_sent)) @ T_world_camera
        T_odom_camera: Array = self._T_odom_last_sent @ scaled(T_sent_camera, tracker_to_odometry_scale)
        return T_odom_camera

    def take_settled(self) -> Iterator[tuple[AdjustedKeyframe, Array]]:
        """Yield each keyframe that has settled since the last call, with ``T_odom_camera`` ``(4, 4)``.

        The depths of its features are in the unit of the odometry frame.
        """
        while self._next_keyframe + _SETTLED_AFTER < self._tracker.segment_keyframes:
            keyframe = self._tracker.keyframe(self._next_keyframe)
            T_odom_camera = self.pose_in_odometry(keyframe.T_world_camera)
            tracker_to_odometry_scale = self._length_factor_at_start / self._tracker.length_factor
            self._last_sent, self._T_odom_last_sent = self._next_keyframe, T_odom_camera
            self._next_keyframe += 1
            yield replace(keyframe, depths=tracker_to_odometry_scale * keyframe.depths), T_odom_camera
