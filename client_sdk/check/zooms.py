"""Judge whether the focal length of a drive changes: two cameras, or a lens that focuses.

Two cameras are told by jumps from one view to the next, which the errors of depth do not make; a lens that
focuses by a change that goes on through all parts of the drive, which they do make.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.check.findings import CannotTell, FaultKind, Finding
from rse_pf.geometry import Array, inverse
from rse_pf.slam.self_calibration import Calibrated, rms_after_alignment

__all__ = ["ZoomJudgement", "judge_zooms"]

_LEAST_JUMP, _LEAST_MOVE = 0.03, 0.02
_DEVIATIONS, _CLEAR, _HINT = 3.0, 6.0, 1.5
_UNEVEN = 0.2
"""Jumps of two cameras are of one size, but for this share of it."""
_FLOOR, _INFLATION = 0.005, 1.5
_PARTS, _MAINLY = 5, 2.0
_QUANTILE, _OF_NORMAL = 0.3, 0.385
"""Of the absolute steps of a normal distribution; up to half of the steps may be jumps."""
_TOLD = 0.08
"""A drive that could hide a larger change of the focal length cannot tell one."""

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoomJudgement:
    """A focal length that changes, None if it does not, and what of it cannot be told.

    ``hint`` is by how much it seems to change where that is not certain, 0 where nothing speaks for it.
    """

    finding: Finding | None = None
    hint: float = 0.0
    cannot_tell: tuple[CannotTell, ...] = ()


def judge_zooms(zoomed: Calibrated, times_s: Array, common: Calibrated) -> ZoomJudgement:
    """Return whether the focal length is the same all the time.

    Args:
        zoomed: Adjusted with a focal length for each keyframe.
        times_s: ``(k,)``, of the keyframes.
        common: Adjusted with one for all.
    """
    zooms = zoomed.zooms
    if len(zooms) < _PARTS:
        return ZoomJudgement()
    steps = np.diff(zooms)
    noise = _noise(zoomed)
    jumps = np.flatnonzero(np.abs(steps) > np.maximum(_LEAST_JUMP, _CLEAR * noise))
    if len(jumps):
        return _jumped(steps, jumps, noise, common, zoomed)
    return _moved(zooms, times_s, common, zoomed)


def _noise(zoomed: Calibrated) -> Array:
    """Return ``(k - 1,)`` deviations of the steps: what the adjustment says, and what all steps show."""
    own = np.diag(zoomed.zooms_covariance)
    together = np.diag(zoomed.zooms_covariance, 1)
    variances = np.maximum(own[1:] + own[:-1] - 2.0 * together, 0.0)
    usual = float(np.quantile(np.abs(np.diff(zoomed.zooms)), _QUANTILE)) / _OF_NORMAL
    noise: Array = np.sqrt(_INFLATION**2 * variances + usual**2)
    return noise


def _jumped(steps: Array, jumps: Rows, noise: Array, common: Calibrated, zoomed: Calibrated) -> ZoomJudgement:
    """Return two cameras where all jumps are of one size, and each goes back where the last came from."""
    sizes, n = np.abs(steps[jumps]), len(jumps)
    size = float(np.average(sizes, weights=1.0 / noise[jumps] ** 2))
    deviation = math.hypot(_FLOOR, float(np.sqrt(np.square(noise[jumps]).sum())) / n)
    apart = np.abs(sizes - size) > np.maximum(_UNEVEN * size, _DEVIATIONS * noise[jumps])
    is_alternating = bool((np.diff(np.sign(steps[jumps])) != 0).all())
    if not is_alternating or apart.any():
        reason = (
            f"the focal length jumps by {math.expm1(sizes.min()):.0%} to {math.expm1(sizes.max()):.0%} "
            f"{n} times, which neither two cameras nor a lens that focuses explain"
        )
        return ZoomJudgement(
            cannot_tell=tuple(
                CannotTell(kind, reason) for kind in (FaultKind.TWO_CAMERAS, FaultKind.MOVING_FOCAL_LENGTH)
            )
        )
    of_second = np.concatenate([[0], np.cumsum(np.isin(np.arange(len(steps)), jumps))]) % 2
    larger = int(of_second.sum()) if steps[jumps[0]] > 0 else int((1 - of_second).sum())
    ratio = math.expm1(size)
    return ZoomJudgement(
        finding=Finding(
            kind=FaultKind.TWO_CAMERAS, value=ratio, deviation=deviation, unit="relative",
            cost_m=_cost(common, zoomed),
            sentence=(
                f"{larger} of {len(zoomed.zooms)} views have a focal length that is {ratio:.1%} "
                f"(+- {deviation:.1%}) larger than that of the others, as of two cameras"
            ),
            fix="give the frames of each camera their own calibration, or map them apart",
        )
    )  # fmt: skip


def _moved(zooms: Array, times_s: Array, common: Calibrated, zoomed: Calibrated) -> ZoomJudgement:
    """Return a lens that focuses where all parts of the drive show the same change."""
    span_s = float(np.ptp(times_s))
    rates = _rates(zooms, times_s)
    centred = times_s - times_s.mean()
    weights = centred / max(float(centred @ centred), 1e-12) * span_s
    move = float(weights @ zooms)
    own = math.sqrt(max(0.0, float(weights @ zoomed.zooms_covariance @ weights)))
    between = float(np.std(rates, ddof=1)) / math.sqrt(len(rates)) * span_s
    deviation = _INFLATION * math.hypot(own, between, _FLOOR)
    if abs(move) > max(_LEAST_MOVE, _DEVIATIONS * deviation):
        return ZoomJudgement(
            finding=Finding(
                kind=FaultKind.MOVING_FOCAL_LENGTH, value=math.expm1(move), deviation=deviation,
                unit="relative", cost_m=_cost(common, zoomed),
                sentence=(
                    f"the focal length changes by {math.expm1(move):+.1%} (+- {deviation:.1%}) in "
                    f"{span_s:.0f} s, as of a lens that focuses"
                ),
                fix="switch the autofocus off, calibrate again, and drive again",
            )
        )  # fmt: skip
    hint = math.expm1(move) if abs(move) > max(_FLOOR, _HINT * deviation) else 0.0
    if _DEVIATIONS * deviation <= _TOLD:
        return ZoomJudgement(hint=hint)
    low, high = float(rates.min()) * span_s, float(rates.max()) * span_s
    errors = "of depth or of the lens" if common.has_metric_scale else "of the lens or its distortion"
    reason = f"{len(zooms)} views do not tell more"
    if between > _MAINLY * own:
        reason = (
            f"parts of the drive say that the focal length changes by {low:+.0%} to {high:+.0%}, as by "
            f"errors {errors}"
        )
    reason += f": a change within {_DEVIATIONS * deviation:.0%}"
    return ZoomJudgement(
        hint=hint,
        cannot_tell=(CannotTell(FaultKind.MOVING_FOCAL_LENGTH, reason, _DEVIATIONS * deviation),),
    )


def _rates(zooms: Array, times_s: Array) -> Array:
    """Return how fast the zooms change in each of some parts of the drive, 1/s."""
    ends = np.rint(np.linspace(0, len(zooms) - 1, _PARTS + 1)).astype(np.int64)
    rates: Array = np.diff(zooms[ends]) / np.maximum(np.diff(times_s[ends]), 1e-6)
    return rates


def _cost(common: Calibrated, zoomed: Calibrated) -> float:
    """Return how far apart the two paths are after alignment, root mean square in metres."""
    at, there = (inverse(each.T_camera_world)[:, :3, 3] for each in (common, zoomed))
    return rms_after_alignment(at, there - at, has_metric_scale=common.has_metric_scale)
