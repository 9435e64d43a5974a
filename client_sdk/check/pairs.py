"""Find a constant offset of all disparities of a stereo drive.

Like a wrong baseline, the offset changes the scale of the path, but it affects far points more than near
ones: the keyframes determine it without another sensor.  The baseline is checked with poses that are
corrected for the offset, and the uncertainty of the offset adds to that of their scale.
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

__all__ = ["PairsCheck", "check_pairs"]

# Kind of the fault that this module finds.
_KIND = FaultKind.DISPARITY_OFFSET
_MIN_KEYFRAMES = 12
"""Fewest adjusted keyframes with which a disparity offset is reported.  With 5 to 11 keyframes of EuRoC MH_01
the estimate was wrong by up to five of its standard deviations."""
_DEVIATION_INFLATION = 1.5  # factor on the standard deviation of the adjustment, which by itself is too small
_MODEL_DEVIATION_PX = 0.03  # standard deviation of the disparity offset, px, that remains in every drive
_USUAL_DEVIATION_PX = 0.033  # standard deviation of the disparity offset of a good calibration, px
_FAULT_DEVIATION_PX = 0.5  # standard deviation of the disparity offset of a wrong calibration, px
_MIN_OFFSET_PX = 0.1  # smallest disparity offset that is reported, px
_MAX_BOUND_PX = 0.3  # largest bound (three standard deviations), px, of an offset that a drive determines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairsCheck:
    """The result of checking the disparities of a stereo drive.

    Attributes:
        findings: The offset of the disparities, if it is certain and matters.
        cannot_tell: The fault "disparity offset", if the drive does not determine the offset.
        adjusted: The adjustments of the segments that have an offset, by number of the segment.
        scale_deviation: Relative standard deviation of the metric scale that results from the uncertainty of
            the offset.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    adjusted: Mapping[int, StereoAdjustment] = field(default_factory=dict)
    scale_deviation: float = 0.0

    def moved(self, stamps_s: Array, T_world_camera: Array, segments: Array) -> Array:
        """Return the poses ``(n, 4, 4)``, corrected for the offset of the disparities of their segment.

        *stamps_s* and *segments* ``(n,)`` are times and segments of the poses; poses of a segment without an
        offset stay as they are.
        """
        poses: Array = T_world_camera.copy()
        for number, found in self.adjusted.items():
            own = segments == number
            if own.any():
                poses[own] = found.moved(stamps_s[own], poses[own])
        return poses


def check_pairs(found: Mapping[int, StereoAdjustment]) -> PairsCheck:
    """Check the offset of the disparities of a stereo drive; an empty result without adjustments.

    The finding is that of the segment with most keyframes.  *found* are the adjustments by number of the
    segment.
    """
    if not found:
        return PairsCheck()
    longest = max(found.values(), key=lambda each: len(each.stamps_s))
    growth, keyframes = abs(longest.growth_per_px), len(longest.stamps_s)
    if keyframes < _MIN_KEYFRAMES:
        reason = f"{keyframes} keyframes do not determine an offset of disparities"
        return PairsCheck(
            cannot_tell=(CannotTell(_KIND, reason),), scale_deviation=growth * _FAULT_DEVIATION_PX
        )  # fmt: skip
    measured = _measured(longest)
    causes = explain(measured).causes
    values, _ = measured.under(causes)
    _, covariance = measured.under([_KIND])
    offset_px, deviation_px = float(values[0]), math.sqrt(float(covariance[0, 0]))
    cost_m = abs(offset_px) * longest.bend_m_per_px
    is_large = causes and abs(offset_px) > max(_MIN_OFFSET_PX, 3.0 * deviation_px)
    findings: tuple[Finding, ...] = ()
    undetermined: tuple[CannotTell, ...] = ()
    if is_large and matters(cost_m, longest.noise_m):
        findings = (_finding(offset_px, deviation_px, cost_m),)
    elif 3.0 * deviation_px > _MAX_BOUND_PX:
        within = 3.0 * deviation_px
        reason = f"points near and far agree on the disparities within {within:.1f} px only"
        undetermined = (CannotTell(_KIND, reason, within),)
    adjusted = {n: each for n, each in found.items() if _KIND in explain(_measured(each)).causes}
    return PairsCheck(
        findings=findings, cannot_tell=undetermined, adjusted=adjusted, scale_deviation=growth * deviation_px
    )


def _measured(found: StereoAdjustment) -> Measured:
    return Measured(
        values=np.array([found.offset_px]),
        covariance=np.array([[(_DEVIATION_INFLATION * found.deviation_px) ** 2]]),
        unknown=np.array([_MODEL_DEVIATION_PX]), usual=np.array([_USUAL_DEVIATION_PX]),
        widest=np.array([_FAULT_DEVIATION_PX]), causes={_KIND: (0,)},
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
