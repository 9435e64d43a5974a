"""Turn the keyframes of a monocular tracker into an odometry whose poses and scale never change.

The tracker adjusts its newest keyframes with every new keyframe, and it may change its scale.  A live map
takes each keyframe once.  Therefore a keyframe is sent only after it has settled, and its pose is that of the
keyframe sent before it times their present relative pose.  What the tracker adjusts later does not move a
keyframe that was sent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from client_sdk.tracking.monocular_segment import AdjustedKeyframe
from client_sdk.tracking.monocular_tracker import MonocularTracker
from rse_pf.geometry import Array, inverse, scaled

__all__ = ["MonocularOdometry"]

_SETTLED_AFTER = 2  # a keyframe is sent when two newer ones exist: until then each new one still moves it
_MAX_LOOP_SCALE = 1.03
"""Largest factor by which a loop closure may correct lengths without ending the odometry, 3 % in either
direction: beyond it, the lengths before and after the loop have different scales, and no single scale to the
map fits both."""


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
        """Begin another odometry frame with this frame if needed; return whether one began after the first.

        It is needed if the tracker began or changed its segment, if segments were joined since the last call,
        and if a loop closure corrected lengths by more than 3 %.
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
        # Keyframes of a segment that was continued are those of an earlier odometry frame: skip them.
        self._next_keyframe = 0 if is_new_segment else tracker.segment_keyframes
        self._length_factor_at_start, self._last_sent = tracker.length_factor, None
        return not is_first

    def pose_in_odometry(self, T_world_camera: Array) -> Array:
        """Return ``T_odom_camera`` ``(4, 4)`` for a ``(4, 4)`` pose in the tracker's present world and unit.

        The pose relative to the keyframe that was sent last is kept, in the unit of the odometry frame.
        Before a keyframe of the odometry frame was sent, only the unit is changed.
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
