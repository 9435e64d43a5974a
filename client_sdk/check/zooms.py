"""Judge whether the focal length of a drive changes: two cameras, or a lens that focuses."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from client_sdk.check.findings import FaultKind, Finding
from rse_pf.geometry import Array, inverse
from rse_pf.slam.self_calibration import Calibrated, rms_after_alignment

__all__ = ["judge_zooms"]

_LEAST_STEP, _LEAST_MOVE = 0.04, 0.02
_DEVIATIONS = 3.0
_APART = 3.0
"""Two cameras' focal lengths lie so many times as far apart as those of one of them scatter."""
_FLOOR, _INFLATION = 0.01, 1.5
"""Errors of depth that change with the scene look like a focal length that changes."""
_LEAST_GROUP = 3

_Flags = npt.NDArray[np.bool_]


def judge_zooms(zoomed: Calibrated, times_s: Array, common: Calibrated, worse: float = 1.0) -> Finding | None:
    """Return the finding of a focal length that is not the same all the time; None if it is.

    Args:
        zoomed: Adjusted with a focal length for each keyframe.
        times_s: ``(k,)``, of the keyframes.
        common: Adjusted with one for all.
        worse: How much larger the errors of depth are than those of a good camera.
    """
    zooms, covariance = zoomed.zooms, zoomed.zooms_covariance
    steps, slope = _groups(zooms), _slope(zooms, times_s)
    left_step = _left(zooms, steps)
    left_slope = float(np.var(zooms - slope * (times_s - times_s.mean())))
    if len(zooms) >= 2 * _LEAST_GROUP and left_step < left_slope:
        weights = np.where(steps, 1.0 / steps.sum(), -1.0 / (~steps).sum())
        step = float(weights @ zooms)
        deviation = _deviation(weights, covariance, worse)
        if step > max(_LEAST_STEP, _DEVIATIONS * deviation, _APART * math.sqrt(left_step)):
            ratio = math.exp(step) - 1.0
            return Finding(
                kind=FaultKind.TWO_CAMERAS, value=ratio, deviation=deviation, unit="relative",
                cost_m=_cost(common, zoomed),
                sentence=(
                    f"{int(steps.sum())} of {len(zooms)} views have a focal length that is {ratio:.1%} "
                    f"(+- {deviation:.1%}) larger than that of the others, as of two cameras"
                ),
                fix="give the frames of each camera their own calibration, or map them apart",
            )  # fmt: skip
    centred = times_s - times_s.mean()
    weights = centred / max(float(centred @ centred), 1e-12) * float(np.ptp(times_s))
    move = float(weights @ zooms)
    deviation = _deviation(weights, covariance, worse)
    if abs(move) > max(_LEAST_MOVE, _DEVIATIONS * deviation) and left_slope < 0.5 * float(np.var(zooms)):
        return Finding(
            kind=FaultKind.MOVING_FOCAL_LENGTH, value=math.exp(move) - 1.0, deviation=deviation,
            unit="relative", cost_m=_cost(common, zoomed),
            sentence=(
                f"the focal length changes by {math.exp(move) - 1.0:+.1%} (+- {deviation:.1%}) in "
                f"{np.ptp(times_s):.0f} s, as of a lens that focuses"
            ),
            fix="switch the autofocus off, calibrate again, and drive again",
        )  # fmt: skip
    return None


def _deviation(weights: Array, covariance: Array, worse: float) -> float:
    variance = max(0.0, float(weights @ covariance @ weights))
    return math.hypot(worse * _FLOOR, _INFLATION * math.sqrt(variance))


def _groups(zooms: Array) -> _Flags:
    """Return who is above the value that parts the zooms best (Otsu 1979)."""
    ordered = np.sort(zooms)
    best, least = ordered[-1], np.inf
    for row in range(_LEAST_GROUP, len(ordered) - _LEAST_GROUP + 1):
        left = float(np.var(ordered[:row]) * row + np.var(ordered[row:]) * (len(ordered) - row))
        if left < least:
            best, least = 0.5 * (ordered[row - 1] + ordered[row]), left
    above: _Flags = zooms > best
    return above


def _left(zooms: Array, groups: _Flags) -> float:
    """Return the variance that is left within two groups."""
    left = zooms.copy()
    for own in (groups, ~groups):
        if own.any():
            left[own] -= zooms[own].mean()
    return float(np.mean(left**2))


def _slope(zooms: Array, times_s: Array) -> float:
    centred = times_s - times_s.mean()
    return float(centred @ zooms / max(float(centred @ centred), 1e-12))


def _cost(common: Calibrated, zoomed: Calibrated) -> float:
    """Return how far apart the two paths are after alignment, root mean square in metres."""
    at, there = (inverse(each.T_camera_world)[:, :3, 3] for each in (common, zoomed))
    return rms_after_alignment(at, there - at, has_metres=common.has_metres)
