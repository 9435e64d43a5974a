"""Judge what the disparities of all pairs of a stereo drive lack together.

Such an offset bends a path as a wrong baseline does, but of near points less than of far ones: the keyframes
tell it by themselves.  What a baseline is compared by are the poses without it, and its doubt is theirs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from client_sdk.check.competition import Measured, explain
from client_sdk.check.findings import CannotTell, FaultKind, Finding, matters
from client_sdk.tracking.stereo_adjustment import StereoAdjustment
from rse_pf.geometry import Array

__all__ = ["PairsJudgement", "judge_pairs"]

_KIND = FaultKind.DISPARITY_OFFSET
_LEAST_KEYFRAMES = 12
"""Fewer keyframes, 5 to 11 of MH_01, told offsets that they had not by five of their deviations."""
_INFLATION, _UNKNOWN_PX = 1.5, 0.03
_USUAL_PX, _WIDEST_PX, _LEAST_PX = 0.033, 0.5, 0.1
_TOLD_PX = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairsJudgement:
    """What the pairs of a drive show.

    ``adjusted`` are the segments whose offset is there, and how their poses move without it.
    ``metres_deviation``, relative, is what the offset leaves of doubt in metres.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    adjusted: Mapping[int, StereoAdjustment] = field(default_factory=dict)
    metres_deviation: float = 0.0

    def moved(self, stamps_s: Array, T_world_camera: Array, segments: Array) -> Array:
        """Return ``(n, 4, 4)`` poses without the offset; *segments* ``(n,)`` are those of the poses."""
        poses: Array = T_world_camera.copy()
        for number, found in self.adjusted.items():
            own = segments == number
            if own.any():
                poses[own] = found.moved(stamps_s[own], poses[own])
        return poses


def judge_pairs(found: Mapping[int, StereoAdjustment]) -> PairsJudgement:
    """Return what is wrong with the disparities of a drive; *found* is by segment, the longest one counts."""
    if not found:
        return PairsJudgement()
    longest = max(found.values(), key=lambda each: len(each.stamps_s))
    growth, keyframes = abs(longest.growth_per_px), len(longest.stamps_s)
    if keyframes < _LEAST_KEYFRAMES:
        reason = f"{keyframes} keyframes do not tell an offset of disparities"
        return PairsJudgement(
            cannot_tell=(CannotTell(_KIND, reason),), metres_deviation=growth * _WIDEST_PX
        )  # fmt: skip
    measured = _measured(longest)
    causes = explain(measured).causes
    values, _ = measured.under(causes)
    _, covariance = measured.under([_KIND])
    offset_px, deviation_px = float(values[0]), math.sqrt(float(covariance[0, 0]))
    cost_m = abs(offset_px) * longest.bend_m_per_px
    is_large = causes and abs(offset_px) > max(_LEAST_PX, 3.0 * deviation_px)
    findings: tuple[Finding, ...] = ()
    untold: tuple[CannotTell, ...] = ()
    if is_large and matters(cost_m, longest.noise_m):
        findings = (_finding(offset_px, deviation_px, cost_m),)
    elif 3.0 * deviation_px > _TOLD_PX:
        within = 3.0 * deviation_px
        reason = f"points near and far agree on the disparities within {within:.1f} px only"
        untold = (CannotTell(_KIND, reason, within),)
    adjusted = {n: each for n, each in found.items() if _KIND in explain(_measured(each)).causes}
    return PairsJudgement(
        findings=findings, cannot_tell=untold, adjusted=adjusted, metres_deviation=growth * deviation_px
    )


def _measured(found: StereoAdjustment) -> Measured:
    return Measured(
        values=np.array([found.offset_px]),
        covariance=np.array([[(_INFLATION * found.deviation_px) ** 2]]),
        unknown=np.array([_UNKNOWN_PX]), usual=np.array([_USUAL_PX]), widest=np.array([_WIDEST_PX]),
        causes={_KIND: (0,)},
    )  # fmt: skip


def _finding(offset_px: float, deviation_px: float, cost_m: float) -> Finding:
    wrong, right = ("small", "larger") if offset_px > 0 else ("large", "smaller")
    return Finding(
        kind=_KIND, value=offset_px, deviation=deviation_px, unit="px", cost_m=cost_m,
        sentence=f"disparities are {abs(offset_px):.2f} px too {wrong} (+- {deviation_px:.2f}): far points "
        "show it and near ones do not, so the baseline is not the cause",
        fix="a map is corrected when it is saved; to correct the rig, calibrate the pair again, or set cx of "
        f"the right camera {abs(offset_px):.2f} px {right}",
    )  # fmt: skip
