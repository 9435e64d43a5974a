"""Find out whether the focal length changes during a drive: two cameras, or a lens that focuses.

A zoom is the natural logarithm of the focal length of a keyframe over the common one.  Two cameras show as
jumps from one view to the next, which errors of depth do not cause.  A lens that focuses shows as a steady
change through all parts of the drive, which errors of depth may cause, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.check.findings import CannotTell, FaultKind, Finding
from rse_pf.geometry import Array, inverse
from rse_pf.slam.self_calibration import Calibrated, rms_after_alignment

__all__ = ["ZoomCheck", "check_zooms"]

_MIN_JUMP = 0.03  # smallest difference of two successive zooms that is a jump
_MIN_CHANGE = 0.02  # smallest change of the zoom over a drive that is reported
# A change of the zoom, the logarithm of the focal length, is a finding only if it exceeds this many of its
# standard deviations.
_CERTAIN_SIGMAS = 3.0
_JUMP_SIGMAS = 6.0  # a jump of the zoom exceeds this many standard deviations of its step
_HINT_SIGMAS = 1.5  # a change of the zoom of more than this many standard deviations is returned as a hint
# Largest difference of a jump from the mean jump between two cameras, as a share of the mean jump.
_MAX_JUMP_DIFFERENCE = 0.2
_MODEL_DEVIATION = 0.005  # standard deviation of a zoom that remains in every drive, whatever its length
_DEVIATION_INFLATION = 1.5  # factor on the standard deviations of the adjustment, which are too small
# Number of parts of a drive whose rates of change of the zoom are compared, and fewest keyframes for this.
_DRIVE_PARTS = 5
# The parts of a drive disagree if the standard deviation between them exceeds this many times the standard
# deviation of the adjustment.
_DISAGREEMENT_RATIO = 2.0
_NOISE_QUANTILE = 0.3
"""Quantile of the absolute steps between successive zooms from which their noise is computed.  It is below
the median, so that up to half of the steps may be jumps."""
_NORMAL_QUANTILE = 0.385  # 0.3 quantile of the absolute values of a normal distribution with deviation 1
# Largest bound (three standard deviations) of the change of the zoom that a drive determines.
_MAX_BOUND = 0.08

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoomCheck:
    """The result of checking whether the focal length changes.

    ``finding`` is the change, or None if there is no certain one.  ``hint`` is the relative change over the
    drive that is likely but not certain, else 0.  ``cannot_tell`` lists what the drive does not determine.
    """

    finding: Finding | None = None
    hint: float = 0.0
    cannot_tell: tuple[CannotTell, ...] = ()


def check_zooms(zoomed: Calibrated, times_s: Array, common: Calibrated) -> ZoomCheck:
    """Find out whether the focal length jumps or moves during a drive.

    Fewer than 5 keyframes give an empty result.

    Args:
        zoomed: The drive, adjusted with a focal length for each keyframe.
        times_s: ``(k,)``, times of the keyframes, seconds.
        common: The drive, adjusted with one focal length for all keyframes.
    """
    zooms = zoomed.zooms
    if len(zooms) < _DRIVE_PARTS:
        return ZoomCheck()
    steps = np.diff(zooms)
    noise = _noise(zoomed)
    jumps = np.flatnonzero(np.abs(steps) > np.maximum(_MIN_JUMP, _JUMP_SIGMAS * noise))
    if len(jumps):
        return _check_jumps(steps, jumps, noise, common, zoomed)
    return _check_steady_change(zooms, times_s, common, zoomed)


def _noise(zoomed: Calibrated) -> Array:
    """Return standard deviations ``(k - 1,)`` of the steps between successive zooms.

    They combine the covariance of the adjustment with the scatter of all steps.
    """
    own = np.diag(zoomed.zooms_covariance)
    together = np.diag(zoomed.zooms_covariance, 1)
    variances = np.maximum(own[1:] + own[:-1] - 2.0 * together, 0.0)
    usual = float(np.quantile(np.abs(np.diff(zoomed.zooms)), _NOISE_QUANTILE)) / _NORMAL_QUANTILE
    noise: Array = np.sqrt(_DEVIATION_INFLATION**2 * variances + usual**2)
    return noise


def _check_jumps(
    steps: Array, jumps: Rows, noise: Array, common: Calibrated, zoomed: Calibrated
) -> ZoomCheck:
    """Return the finding of two cameras if all *jumps* have one size and alternating signs.

    Otherwise return that the drive does not determine the cause of the jumps.  *jumps* are indices of *steps*
    ``(k - 1,)``, *noise* the standard deviations of the steps.
    """
    sizes, n = np.abs(steps[jumps]), len(jumps)
    size = float(np.average(sizes, weights=1.0 / noise[jumps] ** 2))
    deviation = math.hypot(_MODEL_DEVIATION, float(np.sqrt(np.square(noise[jumps]).sum())) / n)
    apart = np.abs(sizes - size) > np.maximum(_MAX_JUMP_DIFFERENCE * size, _CERTAIN_SIGMAS * noise[jumps])
    is_alternating = bool((np.diff(np.sign(steps[jumps])) != 0).all())
    if not is_alternating or apart.any():
        reason = (
            f"the focal length jumps by {math.expm1(sizes.min()):.0%} to {math.expm1(sizes.max()):.0%} "
            f"{n} times, which neither two cameras nor a lens that focuses explain"
        )
        return ZoomCheck(
            cannot_tell=tuple(
                CannotTell(kind, reason) for kind in (FaultKind.TWO_CAMERAS, FaultKind.MOVING_FOCAL_LENGTH)
            )
        )
    of_second = np.concatenate([[0], np.cumsum(np.isin(np.arange(len(steps)), jumps))]) % 2
    larger = int(of_second.sum()) if steps[jumps[0]] > 0 else int((1 - of_second).sum())
    ratio = math.expm1(size)
    return ZoomCheck(
        finding=Finding(
            kind=FaultKind.TWO_CAMERAS, value=ratio, deviation=deviation, unit="relative",
            cost_m=_cost(common, zoomed),
            sentence=(
                f"{larger} of {len(zoomed.zooms)} views have a focal length that is {ratio:.1%} "
                f"(+- {deviation:.1%}) larger than that of the others: two cameras"
            ),
            fix="give the frames of each camera their own calibration, or map them apart",
        )
    )  # fmt: skip


def _check_steady_change(zooms: Array, times_s: Array, common: Calibrated, zoomed: Calibrated) -> ZoomCheck:
    """Return the finding of a lens that focuses if all parts of the drive show the same change.

    Otherwise return a hint of the change, and a bound of the change if the drive does not determine it.
    """
    span_s = float(np.ptp(times_s))
    rates = _rates(zooms, times_s)
    centred = times_s - times_s.mean()
    weights = centred / max(float(centred @ centred), 1e-12) * span_s
    move = float(weights @ zooms)
    own = math.sqrt(max(0.0, float(weights @ zoomed.zooms_covariance @ weights)))
    between = float(np.std(rates, ddof=1)) / math.sqrt(len(rates)) * span_s
    deviation = _DEVIATION_INFLATION * math.hypot(own, between, _MODEL_DEVIATION)
    if abs(move) > max(_MIN_CHANGE, _CERTAIN_SIGMAS * deviation):
        return ZoomCheck(
            finding=Finding(
                kind=FaultKind.MOVING_FOCAL_LENGTH, value=math.expm1(move), deviation=deviation,
                unit="relative", cost_m=_cost(common, zoomed),
                sentence=(
                    f"the focal length changes by {math.expm1(move):+.1%} (+- {deviation:.1%}) in "
                    f"{span_s:.0f} s: a lens that focuses"
                ),
                fix="switch the autofocus off, calibrate again, and drive again",
            )
        )  # fmt: skip
    hint = math.expm1(move) if abs(move) > max(_MODEL_DEVIATION, _HINT_SIGMAS * deviation) else 0.0
    if _CERTAIN_SIGMAS * deviation <= _MAX_BOUND:
        return ZoomCheck(hint=hint)
    low, high = float(rates.min()) * span_s, float(rates.max()) * span_s
    errors = "of depth or of the lens" if common.has_metric_scale else "of the lens or its distortion"
    reason = f"{len(zooms)} views do not determine more"
    if between > _DISAGREEMENT_RATIO * own:
        reason = (
            f"parts of the drive say that the focal length changes by {low:+.0%} to {high:+.0%}, as by "
            f"errors {errors}"
        )
    reason += f": a change within {_CERTAIN_SIGMAS * deviation:.0%}"
    return ZoomCheck(
        hint=hint,
        cannot_tell=(CannotTell(FaultKind.MOVING_FOCAL_LENGTH, reason, _CERTAIN_SIGMAS * deviation),),
    )


def _rates(zooms: Array, times_s: Array) -> Array:
    """Return the rate of change of the zoom, 1/s, in each of 5 consecutive parts of the drive."""
    ends = np.rint(np.linspace(0, len(zooms) - 1, _DRIVE_PARTS + 1)).astype(np.int64)
    rates: Array = np.diff(zooms[ends]) / np.maximum(np.diff(times_s[ends]), 1e-6)
    return rates


def _cost(common: Calibrated, zoomed: Calibrated) -> float:
    """Return how far the paths of both adjustments are apart after alignment, root mean square, metres."""
    at, there = (inverse(each.T_camera_world)[:, :3, 3] for each in (common, zoomed))
    return rms_after_alignment(at, there - at, has_metric_scale=common.has_metric_scale)
