"""Compare the motion by wheels with the motion by the camera, and name readings that are wrong.

**Windows.**  A window is half a second of tracked frames in one world.  Of each window in which the robot
drives, the lengths and the rotations of both motions are compared.  A fault is named by the median or the sum
of the newest windows, because wheels slip for a moment and poses may be wrong once.

**Time.**  Late stamps show where the robot begins and ends to turn: the headings by the wheels, moved in
time, fit those of the camera better.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array, inverse

__all__ = ["WheelCheck"]

_WINDOW_S = 0.5
"""Shortest window, in seconds: at 0.5 m/s the length is then known to 2 % by poses that are good to 3 mm."""
_MAX_WINDOW_S = 1.5  # longest window, in seconds: frames that are farther apart are not compared
_WINDOWS = 8  # number of newest windows that are compared: 4 s, so that a fault is named within 5 s
_MIN_WINDOWS = 5  # fewest windows by which a fault is named: a slip of 2 s is none
_MIN_LENGTH_M = 0.05  # in a shorter window the robot does not drive: the noise of the poses would decide
_MIN_TURN_RAD = 0.1  # in a window with less rotation, and without length, the robot stands
_MAX_LENGTH_RATIO = math.log(1.12)
"""Largest logarithm of the ratio of lengths: wheels whose steps slip by 5 % and that are 1 % too large stay
below 1.08 in five windows."""
_MAX_TURN_RAD_M = 0.35
"""Largest difference of the rotations, in rad per metre: two wheels that slip by 5 % in each step give 0.05,
one blocked wheel gives 1 at a track of 1 m, and more at a smaller one."""
_MAX_TURN_SHARE = 0.15  # in addition: largest difference of the rotations, as a share of the rotation
_MAX_TURN_RAD = 0.05  # in addition: largest difference of the rotations, in rad
_SHIFTS_S: Array = np.linspace(-0.2, 0.2, 21)  # times, in seconds, by which stamps are tried to be late
_MAX_SHIFT_S = 0.07  # largest time, in seconds, by which stamps may be late; drivers are by 20 to 50 ms
_SHIFT_CLEARNESS = 20.0
"""By how many times the variance of a rotation the sum of squares must fall for another time: wheels that
only slip reached 14 on 12 rendered drives, and late ones 78 to 220 after some turns."""
_SHIFT_SPAN_S = 10.0  # newest time, in seconds, whose headings are compared: begin and end of a turn
_MIN_HEADINGS = 15  # fewest differences of headings that are compared


@dataclass(frozen=True, slots=True, kw_only=True)
class _Window:
    """Lengths in metres and rotations in rad of one window, by the camera and by the wheels."""

    camera_m: float
    wheels_m: float
    camera_rad: float
    wheels_rad: float

    @property
    def has_length(self) -> bool:
        return max(self.camera_m, self.wheels_m) >= _MIN_LENGTH_M

    @property
    def is_driven(self) -> bool:
        return self.has_length or max(abs(self.camera_rad), abs(self.wheels_rad)) >= _MIN_TURN_RAD

    @property
    def length_ratio(self) -> float:
        """Logarithm of the length by the wheels over that by the camera; both count as 1 mm or more."""
        return math.log(max(self.wheels_m, 1e-3) / max(self.camera_m, 1e-3))


class WheelCheck:
    """Comparison of wheels and camera over the newest windows.

    Attributes:
        trouble: What is wrong with the readings, as one sentence; empty if nothing is.  It goes when length
            and rotation agree again in all newest windows, but stays for stamps that are late.
        window_s: Begin and end of the last window, in seconds.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self.window_s = 0.0, 0.0
        self._is_late = False
        self._agreeing = 0
        self._windows: deque[_Window] = deque(maxlen=_WINDOWS)
        self._poses: list[tuple[float, Array]] = []
        self._headings: deque[tuple[float, float]] = deque()
        """Time in seconds and heading in rad, without a wrap at half a turn, of the newest frames."""
        self._world: object = None

    def add(self, timestamp_s: float, T_world_base: Array, world: object) -> bool:
        """Add the tracked pose of a frame; return whether it ends a window, for `close`."""
        since_s = timestamp_s - self._poses[-1][0] if self._poses else 0.0
        if world != self._world or not 0.0 < since_s <= _MAX_WINDOW_S:
            self._poses.clear()
            self._headings.clear()
        self._world = world
        heading_rad = 0.0
        if self._poses:
            heading_rad = self._headings[-1][1] + _yaw(inverse(self._poses[-1][1]) @ T_world_base)
        self._headings.append((timestamp_s, heading_rad))
        while timestamp_s - self._headings[0][0] > _SHIFT_SPAN_S:
            self._headings.popleft()
        self._poses.append((timestamp_s, T_world_base))
        self.window_s = self._poses[0][0], timestamp_s
        return timestamp_s - self._poses[0][0] >= _WINDOW_S

    def close(self, T_begin_end: Array | None, stamps_s: Array, headings_rad: Array) -> None:
        """Compare the window that `add` has ended, and set `trouble`.

        Args:
            T_begin_end: ``(4, 4)``, motion of the base in the window by the wheels; None if not known.
            stamps_s: ``(n,)`` times of all readings, in seconds.
            headings_rad: ``(n,)`` their headings, without a wrap at half a turn.
        """
        camera = inverse(self._poses[0][1]) @ self._poses[-1][1]
        del self._poses[:-1]
        if T_begin_end is None:
            return
        window = _Window(
            camera_m=float(np.linalg.norm(camera[:3, 3])),
            wheels_m=float(np.linalg.norm(T_begin_end[:3, 3])),
            camera_rad=_yaw(camera),
            wheels_rad=_yaw(T_begin_end),
        )
        if not window.is_driven:
            return
        self._windows.append(window)
        is_agreeing = not (_find_turn_fault([window]) or _find_length_fault([window]))
        self._agreeing = self._agreeing + 1 if is_agreeing else 0
        if self._agreeing >= _WINDOWS and not self._is_late:
            self.trouble = ""
        if len(self._windows) >= _MIN_WINDOWS:
            windows = list(self._windows)
            fault = _find_turn_fault(windows) or _find_length_fault(windows)
            late_s = 0.0 if fault or self.trouble else self._find_shift(stamps_s, headings_rad)
            if late_s:
                self._is_late = True
                order = "later" if late_s > 0 else "earlier"
                shift_ms = abs(1000 * late_s)
                fault = f"the stamps of the wheels are {shift_ms:.0f} ms {order} than those of the images"
            self.trouble = fault or self.trouble

    def _find_shift(self, stamps_s: Array, headings_rad: Array) -> float:
        """Return by how many seconds the wheels are late; 0 while it is not clear, or little.

        The headings of the camera are moved in time, because they have little noise: where the robot drives
        straight, no time fits better than another one.
        """
        times_s, camera_rad = np.array(self._headings).T
        inner_s = times_s[(times_s >= times_s[0] + _SHIFTS_S[-1]) & (times_s <= times_s[-1] + _SHIFTS_S[0])]
        inner_s = inner_s[inner_s <= stamps_s[-1]]
        if len(inner_s) <= _MIN_HEADINGS:
            return 0.0
        wheels_rad = np.diff(np.interp(inner_s, stamps_s, headings_rad))
        moved_rad = np.diff(np.interp(inner_s - _SHIFTS_S[:, None], times_s, camera_rad), axis=1)
        # The mean is left out: wheels of different radii turn the robot all the time.
        squares = len(wheels_rad) * (wheels_rad - moved_rad).var(axis=1)
        best = int(np.argmin(squares))
        fall = squares[len(_SHIFTS_S) // 2] - squares[best]
        is_clear = fall > _SHIFT_CLEARNESS * squares[best] / len(wheels_rad)
        return float(_SHIFTS_S[best]) if is_clear and abs(_SHIFTS_S[best]) > _MAX_SHIFT_S else 0.0


def _find_turn_fault(windows: list[_Window]) -> str:
    """Say how the rotations of windows differ; empty if they do not differ much."""
    camera_rad = sum(window.camera_rad for window in windows)
    wheels_rad = sum(window.wheels_rad for window in windows)
    turned_rad = sum(abs(window.camera_rad) for window in windows)
    length_m = sum(max(window.camera_m, window.wheels_m) for window in windows)
    limit_rad = _MAX_TURN_RAD + _MAX_TURN_SHARE * turned_rad + _MAX_TURN_RAD_M * length_m
    if abs(wheels_rad - camera_rad) <= limit_rad:
        return ""
    return (
        f"the wheels turn by {math.degrees(wheels_rad):.0f} degrees where the camera turns by "
        f"{math.degrees(camera_rad):.0f}"
    )


def _find_length_fault(windows: list[_Window]) -> str:
    """Say how the lengths of windows differ; empty if they do not differ much, or the robot only turns."""
    moving = [window for window in windows if window.has_length]
    if len(moving) < min(len(windows), _MIN_WINDOWS):
        return ""
    if abs(np.median([window.length_ratio for window in moving])) <= _MAX_LENGTH_RATIO:
        return ""
    wheels_m, camera_m = sum(window.wheels_m for window in moving), sum(window.camera_m for window in moving)
    return f"the wheels report {wheels_m:.2f} m of way where the camera moves by {camera_m:.2f} m"


def _yaw(T: Array) -> float:
    """Return the rotation of a pose about z, in rad."""
    return math.atan2(T[1, 0], T[0, 0])
