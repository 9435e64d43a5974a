"""How much work a live map does for each keyframe.

The numbers that decide which loop closures are right are constants beside their rules.  Before one of these
options changes, ``python -m benchmarks live.one_process`` must show the accuracy and the CPU time of maps.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LiveMapOptions"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveMapOptions:
    """Limits of the work for one keyframe.

    A map server never changes them while a map exists, because a replay of the log must give the same map.

    Attributes:
        candidates: Older keyframes that place recognition proposes and a new keyframe is compared with, at
            most.
        window_sizes: Keyframes that the smoother moves at once, ascending.  The next larger window is taken
            if the border of a window moves too far.
        max_border_shift_m: Metres that a keyframe at the border of a window may move before the window counts
            as too small.
        max_border_rotation_deg: Degrees that a keyframe at the border of a window may turn before the window
            counts as too small.
        smoothing_allowance: Keyframes that may be smoothed because of one keyframe of a robot.  Those beyond
            it are added to the debt of the robot; a later keyframe that needs fewer lowers the debt by the
            difference.
        max_smoothing_debt: Keyframes of debt from which on only the smallest window is taken for a robot, so
            that no robot uses the CPU time of the others.
    """

    candidates: int = 12
    window_sizes: tuple[int, ...] = (20, 50, 120)
    max_border_shift_m: float = 0.002
    max_border_rotation_deg: float = 0.1
    smoothing_allowance: int = 40
    max_smoothing_debt: int = 2_000
