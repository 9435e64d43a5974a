"""Check the calibration of a drive: focal length, principal point, distortion, and depth against colour.

Findings come from a bundle adjustment of keyframes in which the errors of the calibration are unknowns.  The
comparison with odometry, ground truth or an IMU is in `client_sdk.check.motion`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypedDict

import numpy as np

from client_sdk.check.competition import Explanation, Measured, explain
from client_sdk.check.drive_model import DepthReading, DriveModel, best_reading, drive_model, nearest_delay
from client_sdk.check.findings import CannotTell, FaultKind, Finding, matters
from client_sdk.check.keyframes import FLIPS, KeyframeStore, Tracks, tracks_of
from client_sdk.check.zooms import check_zooms
from rse_pf.errors import DegenerateGeometry
from rse_pf.geometry import Array, Camera, inverse, log_so3
from rse_pf.slam.self_calibration import (
    UNKNOWNS,
    Calibrated,
    adjust_with_calibration,
    estimate_part_deviations,
)

__all__ = ["CalibrationCheck", "check_calibration"]

# Indices in `UNKNOWNS` of the errors of the camera, of the offset of depths, and of the delay of depth
# images.
_FX, _FY, _CX, _CY, _K1, _OFFSET, _DELAY = range(7)
# Errors of the calibration that are estimated for a drive without depth images.
_COLOUR_UNKNOWNS = ("fx", "fy", "cx", "cy", "k1", "readout")
# Fewest keyframes, and fewest poses of a camera without depth, with which a calibration is checked.
_MIN_KEYFRAMES = 6
# Factor on the standard deviations of the adjustment, which are too small: residuals are correlated.
_DEVIATION_INFLATION = 1.5
_MODEL_DEVIATIONS = np.array([0.005, 0.005, 2.0, 2.0, 0.006, 0.006, 0.003, 0.01, 0.002])
"""Standard deviations, in the order and units of `UNKNOWNS`, of what the model of the adjustment lacks:
higher terms of the lens, registration, and errors of depth.  `_depth_error_factor` multiplies them."""
_KINECT_DEPTH_FACTOR = 0.7  # `Calibrated.depth_factor` of a Kinect: its depth noise over the stated noise
_USUAL_DEVIATIONS = np.array([0.005, 0.005, 2.0, 2.0, 0.01, 0.007, 0.005, 0.03, 0.007])
"""Standard deviations of the errors of a good calibration, in the order and units of `UNKNOWNS`."""
_FAULT_DEVIATIONS = np.array([0.15, 0.15, 40.0, 40.0, 0.15, 0.15, 0.3, 0.03, 0.007])
"""Standard deviations of the errors of a wrong calibration, in the order and units of `UNKNOWNS`.  The last
two, ``readout`` and ``curve``, are as in `_USUAL_DEVIATIONS`: a rolling shutter and errors that grow with
depth are not faults."""
_MIN_ERRORS = np.array([0.02, 0.02, 6.0, 6.0, 0.045, 0.015, 0.02])
"""Smallest errors that are reported, of the first seven `UNKNOWNS`: good calibrations have smaller ones."""
_MAX_BOUNDS = np.array([0.06, 0.06, 20.0, 20.0, 0.15, 0.06, 0.1])
"""Largest bounds (three standard deviations), of the first seven `UNKNOWNS`, with which a drive determines an
error: with a larger bound, the fault is listed as undetermined."""
# Smallest rotation of the camera about an axis, degrees, that determines focal length and principal point.
_MIN_ROTATION_DEG = 12.0
# Factor on the standard deviations between parts of a drive, which two to four parts often underestimate.
_PART_INFLATION = 1.5
# Smallest share of an error's standard deviation that comes from differences between parts of the drive from
# which these differences are named as the reason why the drive does not determine the error.
_MIN_PART_SHARE = 0.7
# Smallest absolute correlation of two errors of the calibration that a drive does not separate.
_MIN_CORRELATION = 0.8
# Smallest motion of the camera, as a share of the distance of the scene, that determines a calibration.
_MIN_MOVED_SHARE = 0.01
# Smallest motion of the camera, as a share of the distance of the scene, that determines an offset of depths.
_MIN_MOVED_SHARE_FOR_OFFSET = 0.06
# `Calibrated.depth_factor` above which depth noise is named as the reason of uncertainty.
_MAX_DEPTH_FACTOR = 2.0
# Share of features with a depth below which missing depths are named as the reason of uncertainty.
_MIN_DEPTH_SHARE = 0.2
# For each fault of a calibration the indices in `UNKNOWNS` of its errors.
_UNKNOWNS_OF_FAULT = {
    FaultKind.FOCAL_LENGTH: (_FX, _FY), FaultKind.PRINCIPAL_POINT: (_CX, _CY),
    FaultKind.DISTORTION: (_K1,), FaultKind.DEPTH_OFFSET: (_OFFSET,), FaultKind.DEPTH_DELAY: (_DELAY,),
}  # fmt: skip
# Faults of the colour camera, which are checked in every drive.
_COLOUR_FAULTS = (FaultKind.FOCAL_LENGTH, FaultKind.PRINCIPAL_POINT, FaultKind.DISTORTION)
_UNITS = ("%", "%", "px", "px", "", "cm", "s")  # units in which messages state the first seven `UNKNOWNS`
_UNIT_FACTORS = (100.0, 100.0, 1.0, 1.0, 1.0, 100.0, 1.0)  # factors from the units of `UNKNOWNS` to `_UNITS`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationCheck:
    """The result of checking the calibration of a drive.

    Attributes:
        findings: Errors of the calibration.
        cannot_tell: Faults that the drive does not determine, with the reasons.
        noise_m: Uncertainty of the adjusted path, root mean square, metres; 0 if nothing was adjusted.
        scale_deviation: Relative standard deviation of the metric scale of the adjusted path that results
            from the uncertainty of the calibration; 0 if nothing was adjusted.
        stamps_s: ``(k,)``, time stamps of the adjusted keyframes; empty if too few keyframes connect.
        T_world_camera: ``(k, 4, 4)``, poses of these keyframes with the corrected calibration, metres.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    noise_m: float = 0.0
    scale_deviation: float = 0.0
    stamps_s: Array = field(default_factory=lambda: np.empty(0))
    T_world_camera: Array = field(default_factory=lambda: np.empty((0, 4, 4)))


def check_calibration(store: KeyframeStore) -> CalibrationCheck:
    """Estimate the errors of the calibration of a drive, and report those that are certain and matter.

    A drive with fewer than 6 keyframes, or whose keyframes do not connect, gives no findings; every fault is
    then listed under ``cannot_tell``.
    """
    keyframes, has_depth = store.keyframes, store.has_depth or store.has_stereo
    if len(keyframes) < _MIN_KEYFRAMES:
        return _undetermined(f"{len(keyframes)} views that differ", has_depth=has_depth)
    tracks = tracks_of(keyframes)
    reading = best_reading(keyframes, tracks) if store.has_depth else DepthReading()
    free = UNKNOWNS if store.has_depth else _COLOUR_UNKNOWNS
    try:
        model, adjusted, reading = _adjust_drive(store, tracks, reading, free)
        if model is None or adjusted is None:
            return _undetermined(_unconnected(store, reading), has_depth=has_depth)
        zoomed = adjust_with_calibration(
            model.observed, adjusted.T_camera_world, adjusted.points_world, free, zooms=True,
            values=adjusted.values,
        )  # fmt: skip
    except DegenerateGeometry:
        return _undetermined("views that do not determine their poses", has_depth=has_depth)
    times_s = np.array([keyframes[row].timestamp_s for row in model.rows])
    zoom = check_zooms(zoomed, times_s, adjusted)
    findings = [] if zoom.finding is None else [zoom.finding]
    adjusted = zoomed if findings else adjusted
    parts = np.zeros(len(UNKNOWNS)) if findings else estimate_part_deviations(model.observed, adjusted, free)
    causes = _causes(reading, has_depth=store.has_depth, is_one_camera=not findings)
    measured = _measured(adjusted, parts, reading, causes)
    explanation = explain(measured)
    accepted = [each for each in explanation.causes if not explanation.rivals[each]]
    ambiguous: list[FaultKind] = []
    if zoom.hint:
        # A fault that disappears once each keyframe has its own focal length may be a moving focal length.
        moving = explain(_measured(zoomed, parts, reading, causes)).causes
        ambiguous = [each for each in accepted if each not in moving]
        accepted = [each for each in accepted if each in moving]
    findings += _findings(measured, explanation.causes, accepted, adjusted, model, reading)
    drive = _Drive(measured, explanation, adjusted, model, parts)
    return CalibrationCheck(
        findings=tuple(findings),
        cannot_tell=(
            *zoom.cannot_tell,
            *_undetermined_by_zoom(ambiguous, zoom.hint),
            *_undetermined_faults(
                drive,
                reading,
                excluded={*ambiguous, *(each.kind for each in findings)},
                has_depth=store.has_depth,
            ),
        ),
        noise_m=adjusted.noise_m,
        stamps_s=times_s,
        **_path(adjusted, measured, explanation),
    )


class _Path(TypedDict):
    T_world_camera: Array
    scale_deviation: float


def _path(adjusted: Calibrated, measured: Measured, explanation: Explanation) -> _Path:
    """Return the poses of the keyframes with the corrected calibration, and the deviation of their scale."""
    values, _ = measured.under(explanation.causes)
    # An offset of depths resembles a wrong scale, so its uncertainty counts even if it is not a cause.
    offset = [FaultKind.DEPTH_OFFSET] if FaultKind.DEPTH_OFFSET in measured.causes else []
    _, covariance = measured.under([*explanation.causes, *offset])
    T_world_camera = inverse(adjusted.T_camera_world)
    T_world_camera[:, :3, 3] += np.tensordot(values - measured.values, adjusted.bends_m, axes=1)
    at = T_world_camera[:, :3, 3] - T_world_camera[:, :3, 3].mean(axis=0)
    slopes = np.tensordot(adjusted.bends_m, at, axes=2) / max(float((at**2).sum()), 1e-12)
    variance = float(slopes @ covariance @ slopes)
    return _Path(T_world_camera=T_world_camera, scale_deviation=math.sqrt(max(variance, 0.0)))


def _causes(
    reading: DepthReading, *, has_depth: bool, is_one_camera: bool
) -> dict[FaultKind, tuple[int, ...]]:
    """Return the faults that may explain a drive, each with the indices of its unknowns.

    Faults of the colour camera are left out if the drive has two cameras or a moving focal length (not
    *is_one_camera*), faults of depth without depth images or if these are flipped.
    """
    kinds = list(_COLOUR_FAULTS) if is_one_camera else []
    kinds += [FaultKind.DEPTH_OFFSET, FaultKind.DEPTH_DELAY] if has_depth and not reading.flip else []
    return {kind: _UNKNOWNS_OF_FAULT[kind] for kind in kinds}


def _measured(
    adjusted: Calibrated, parts: Array, reading: DepthReading, causes: dict[FaultKind, tuple[int, ...]]
) -> Measured:
    """Return the estimated errors of the calibration, with their covariance and their priors.

    *parts* ``(9,)`` are the deviations between parts of the drive, see `estimate_part_deviations`; *causes*
    are the faults that may explain the drive, see `_causes`.
    """
    values = adjusted.values.copy()
    values[_DELAY] += reading.delay_s
    usual = _USUAL_DEVIATIONS.copy()
    if FaultKind.FOCAL_LENGTH not in causes:
        usual[: _K1 + 1] = _FAULT_DEVIATIONS[: _K1 + 1]
    return Measured(
        values=values,
        covariance=_DEVIATION_INFLATION**2 * adjusted.covariance + np.diag((_PART_INFLATION * parts) ** 2),
        unknown=_depth_error_factor(adjusted) * _MODEL_DEVIATIONS,
        usual=usual,
        widest=_FAULT_DEVIATIONS,
        causes=causes,
    )


def _adjust_drive(
    store: KeyframeStore, tracks: Tracks, reading: DepthReading, free: tuple[str, ...]
) -> tuple[DriveModel | None, Calibrated | None, DepthReading]:
    """Adjust a drive, and repeat the adjustment with the estimated delay of depth until the delay is stable.

    Returns the model, the adjustment, and the flip and delay of the depth images with which they were made;
    model and adjustment are None if too few keyframes connect.
    """
    by_depth = store.has_depth or store.has_stereo
    reading = DepthReading(reading.flip, nearest_delay(store.keyframes, reading.delay_s))
    tried_s = [reading.delay_s]
    while True:
        model = drive_model(store.keyframes, tracks, reading, by_depth=by_depth)
        if model is None:
            return None, None, reading
        adjusted = adjust_with_calibration(model.observed, model.T_camera_world, model.points_world, free)
        late_s = nearest_delay(store.keyframes, reading.delay_s + float(adjusted.values[_DELAY]))
        if reading.flip or late_s in tried_s:
            break
        tried_s.append(late_s)
        reading = DepthReading(delay_s=late_s)
    return model, adjusted, reading


def _depth_error_factor(adjusted: Calibrated) -> float:
    """Return the factor on `_MODEL_DEVIATIONS`: depth noise of the drive over that of a Kinect, at least 1.

    Noise is the standard deviation of the depths as a multiple of the stated one; without depths it is 1.
    """
    return max(1.0, adjusted.depth_factor / _KINECT_DEPTH_FACTOR)


def _findings(
    measured: Measured, causes: tuple[FaultKind, ...], accepted: list[FaultKind], adjusted: Calibrated,
    model: DriveModel, reading: DepthReading,
) -> list[Finding]:  # fmt: skip
    """Return findings on the *accepted* causes that are certain and matter, and on flipped depth images.

    *causes* are all causes that explain the drive; *accepted* are those without a rival that explains the
    drive nearly as well.
    """
    values, covariance = measured.under(causes)
    errors = _Errors(values, np.sqrt(np.diag(covariance)), adjusted, model.observed.camera)
    finding_of = {
        FaultKind.FOCAL_LENGTH: _focal, FaultKind.PRINCIPAL_POINT: _principal,
        FaultKind.DISTORTION: _distortion, FaultKind.DEPTH_OFFSET: _offset, FaultKind.DEPTH_DELAY: _delay,
    }  # fmt: skip
    findings = [finding_of[kind](errors) for kind in accepted]
    if reading.flip:
        findings.append(_flipped(reading))
    return [finding for finding in findings if finding is not None]


@dataclass(frozen=True, slots=True)
class _Errors:
    """Errors of the calibration, in the order of `UNKNOWNS`, and the adjustment that estimated them.

    ``values`` ``(9,)`` are the errors and ``deviations`` ``(9,)`` their standard deviations; ``camera`` has
    the stated intrinsics.
    """

    values: Array
    deviations: Array
    adjusted: Calibrated
    camera: Camera

    def certain(self, kind: FaultKind) -> tuple[list[int], float]:
        """Return the indices of a fault's unknowns whose errors are certain, and the bend they cause, metres.

        An error is certain above three standard deviations and above its entry of `_MIN_ERRORS`.  The bend is
        the root mean square change of the keyframes' positions, see `Calibrated.bend_m`.  The list is empty
        if the bend is too small for `matters`, except for a delay of depth; the bend is returned in any case.
        """
        rows = [
            row
            for row in _UNKNOWNS_OF_FAULT[kind]
            if abs(self.values[row]) > max(3.0 * self.deviations[row], _MIN_ERRORS[row])
        ]
        wrong = np.zeros(len(UNKNOWNS))
        wrong[rows] = self.values[rows]
        cost_m = self.adjusted.bend_m(wrong)
        is_kept = matters(cost_m, self.adjusted.noise_m) or kind is FaultKind.DEPTH_DELAY
        return (rows if is_kept else []), cost_m

    def with_the_other(self, rows: list[int]) -> list[int]:
        """Return the indices of the focal lengths to correct: *rows*, and the focal length of the other axis.

        *rows* are the focal lengths whose errors are certain.  That of the other axis is added if its error
        has the same sign and exceeds one standard deviation.  Correcting one of two wrong focal lengths alone
        bends a map more: 7.4 cm instead of 6.5 cm where both were 6 % too small.
        """
        first = self.values[rows[0]]
        return [
            row
            for row in _UNKNOWNS_OF_FAULT[FaultKind.FOCAL_LENGTH]
            if row in rows or self.values[row] * np.sign(first) > self.deviations[row]
        ]

    def worst(self, rows: list[int]) -> int:
        """Return the index among *rows* whose error is largest relative to its standard deviation."""
        return max(rows, key=lambda row: abs(self.values[row]) / self.deviations[row])


def _focal(errors: _Errors) -> Finding | None:
    rows, cost_m = errors.certain(FaultKind.FOCAL_LENGTH)
    if not rows:
        return None
    values, deviations, camera = errors.values, errors.deviations, errors.camera
    worst = errors.worst(rows)
    names = {row: UNKNOWNS[row] for row in rows}
    relative = {row: math.exp(-values[row]) - 1.0 for row in rows}
    right = {
        UNKNOWNS[row]: getattr(camera, UNKNOWNS[row]) * math.exp(values[row])
        for row in errors.with_the_other(rows)
    }
    errors_text = " and ".join(
        f"{names[row]} is {abs(relative[row]):.1%} too {_size(relative[row])} (+- {deviations[row]:.1%})"
        for row in rows
    )
    return Finding(
        kind=FaultKind.FOCAL_LENGTH, value=relative[worst], deviation=float(deviations[worst]),
        unit="relative",
        cost_m=cost_m, sentence=f"the focal length {errors_text}",
        fix="set " + ", ".join(f"{name} = {value:.1f}" for name, value in right.items()),
        correction=right,
    )  # fmt: skip


def _principal(errors: _Errors) -> Finding | None:
    rows, cost_m = errors.certain(FaultKind.PRINCIPAL_POINT)
    if not rows:
        return None
    values, deviations, camera = errors.values, errors.deviations, errors.camera
    worst = errors.worst(rows)
    right = {UNKNOWNS[row]: getattr(camera, UNKNOWNS[row]) + values[row] for row in rows}
    errors_text = " and ".join(
        f"{UNKNOWNS[row]} is {abs(values[row]):.1f} px too {_size(-values[row])} (+- {deviations[row]:.1f})"
        for row in rows
    )
    return Finding(
        kind=FaultKind.PRINCIPAL_POINT, value=-float(values[worst]),
        deviation=float(deviations[worst]), unit="px", cost_m=cost_m,
        sentence=f"the principal point {errors_text}",
        fix="set " + ", ".join(f"{name} = {value:.1f}" for name, value in right.items()),
        correction={name: float(value) for name, value in right.items()},
    )  # fmt: skip


def _distortion(errors: _Errors) -> Finding | None:
    rows, cost_m = errors.certain(FaultKind.DISTORTION)
    if not rows:
        return None
    values, deviations, camera = errors.values, errors.deviations, errors.camera
    k1 = float(values[_K1])
    corner_px = abs(k1) * math.hypot(camera.width / 2 / camera.fx, camera.height / 2 / camera.fy) ** 3
    corner_px *= 0.5 * (camera.fx + camera.fy)
    return Finding(
        kind=FaultKind.DISTORTION, value=k1, deviation=float(deviations[_K1]), unit="relative", cost_m=cost_m,
        sentence=(
            f"the images are not undistorted: k1 = {k1:+.3f} (+- {deviations[_K1]:.3f}) is left, "
            f"{corner_px:.0f} px in the corners"
        ),
        fix=f"add k1 = {k1:+.3f} to the distortion, or undistort once if it was done twice",
        correction={"k1": k1},
    )  # fmt: skip


def _flipped(reading: DepthReading) -> Finding:
    return Finding(
        kind=FaultKind.MIRRORED, value=1.0, deviation=0.0, unit="", cost_m=None,
        sentence=f"depth fits the colour images only with {FLIPS[reading.flip]}",
        fix="turn either the depth or the colour images in the driver of the camera",
    )  # fmt: skip


def _offset(errors: _Errors) -> Finding | None:
    rows, cost_m = errors.certain(FaultKind.DEPTH_OFFSET)
    if not rows:
        return None
    offset_m, deviation_m = float(errors.values[_OFFSET]), float(errors.deviations[_OFFSET])
    return Finding(
        kind=FaultKind.DEPTH_OFFSET, value=offset_m, deviation=deviation_m, unit="m",
        cost_m=cost_m, fix=f"subtract {offset_m:+.3f} m from every depth before it is used",
        sentence=(
            f"depths are {100 * abs(offset_m):.1f} cm too {_size(offset_m)} (+- {100 * deviation_m:.1f})"
        ),
    )  # fmt: skip


def _delay(errors: _Errors) -> Finding | None:
    rows, cost_m = errors.certain(FaultKind.DEPTH_DELAY)
    if not rows:
        return None
    delay_s, deviation_s = float(errors.values[_DELAY]), float(errors.deviations[_DELAY])
    which, other = ("depth", "colour") if delay_s > 0 else ("colour", "depth")
    return Finding(
        kind=FaultKind.DEPTH_DELAY, value=delay_s, deviation=deviation_s, unit="s", cost_m=cost_m,
        sentence=(
            f"{which} is {1e3 * abs(delay_s):.0f} ms late (+- {1e3 * deviation_s:.0f}) relative to {other}"
        ),
        fix=(
            f"pair each colour image with the depth image whose stamp is {1e3 * abs(delay_s):.0f} ms "
            f"{'later' if delay_s > 0 else 'earlier'}"
        ),
    )  # fmt: skip


def _size(error: float) -> str:
    return "large" if error > 0 else "small"


# --- faults that a drive does not determine, and the reasons ---


@dataclass(frozen=True, slots=True)
class _Drive:
    """All results of the adjustment of a drive, from which the reason of an undetermined fault is chosen."""

    measured: Measured
    explanation: Explanation
    adjusted: Calibrated
    model: DriveModel
    parts: Array


def _kinds(*, has_depth: bool) -> tuple[FaultKind, ...]:
    return tuple(_UNKNOWNS_OF_FAULT) if has_depth else _COLOUR_FAULTS


def _undetermined(shown: str, *, has_depth: bool) -> CalibrationCheck:
    """Return a check without findings, with the reason "the drive has *shown*" for each possible fault."""
    return CalibrationCheck(
        cannot_tell=tuple(CannotTell(kind, f"the drive has {shown}") for kind in _kinds(has_depth=has_depth))
    )


def _unconnected(store: KeyframeStore, reading: DepthReading) -> str:
    """Return why too few keyframes of a drive connect, as the object of the sentence "the drive has ...".

    Reasons are too few features with a depth, too few poses of a camera without depth, or, if neither is the
    case, too few views with common features.
    """
    keyframes = store.keyframes
    if store.has_depth or store.has_stereo:
        read = np.concatenate([each.depths_m[reading.flip] for each in keyframes])
        share = float(np.isfinite(read).mean())
        if share < _MIN_DEPTH_SHARE:
            return f"a depth at {share:.0%} of its features only"
    else:
        posed = sum(each.T_world_camera is not None for each in keyframes)
        if posed < _MIN_KEYFRAMES:
            return f"a pose in {posed} of {len(keyframes)} views only"
    return "too few views that share enough features"


def _undetermined_faults(
    drive: _Drive, reading: DepthReading, *, excluded: set[FaultKind], has_depth: bool
) -> Iterator[CannotTell]:
    """Yield each fault that the drive does not determine and that is not *excluded*, with the reason."""
    if reading.flip:
        reason = "delays were not tried for depth images that are flipped against the colour images"
        yield CannotTell(FaultKind.DEPTH_DELAY, reason)
    rivals = {**drive.explanation.rivals}
    for kind in _kinds(has_depth=has_depth):
        if kind in excluded or kind not in drive.measured.causes:
            continue
        _, covariance = drive.measured.under([*drive.explanation.causes, kind])
        deviations = np.sqrt(np.diag(covariance))
        row = max(_UNKNOWNS_OF_FAULT[kind], key=lambda each: deviations[each] / _MAX_BOUNDS[each])
        within = 3.0 * float(deviations[row])
        of = next((cause for cause, others in rivals.items() if others and kind in (cause, *others)), None)
        if of is not None:
            yield CannotTell(kind, _equal_explanations(drive, of, row), within)
        elif within > _MAX_BOUNDS[row]:
            yield CannotTell(kind, f"{_reason(row, within / 3.0, drive)}: {_bound(row, within)}", within)


def _undetermined_by_zoom(kinds: list[FaultKind], hint: float) -> Iterator[CannotTell]:
    """Yield the faults *kinds* that may also be a moving focal length, and that fault for each of them.

    *hint* is the relative change of the focal length over the drive.
    """
    moving = FaultKind.MOVING_FOCAL_LENGTH
    for kind in kinds:
        yield CannotTell(kind, f"{moving.value} (by {hint:+.1%}) explains this drive as well")
        yield CannotTell(moving, f"{kind.value} explains this drive as well")


def _equal_explanations(drive: _Drive, cause: FaultKind, row: int) -> str:
    """Return a sentence that names *cause* and the other faults that explain the drive equally well."""
    alike = (cause, *drive.explanation.rivals[cause])
    before = [each for each in drive.explanation.causes if each is not cause]
    explanations = []
    for kind in alike:
        values, _ = drive.measured.under([*before, kind])
        worst = max(_UNKNOWNS_OF_FAULT[kind], key=lambda each: abs(values[each]) / _MIN_ERRORS[each])
        value = _UNIT_FACTORS[worst] * float(values[worst])
        explanations.append(f"{kind.value} ({UNKNOWNS[worst]} by {value:+.3g} {_UNITS[worst]}".rstrip() + ")")
    return f"the drive is explained equally well by {' and by '.join(explanations)}"


def _reason(row: int, deviation: float, drive: _Drive) -> str:
    """Return why the error with the index *row* of `UNKNOWNS` has the standard deviation *deviation*.

    The result names a lack of the drive with a number.  Reasons are tried in order, beginning with a camera
    that does not move, and the first that applies is returned.
    """
    adjusted, model = drive.adjusted, drive.model
    yaw, pitch, roll = _rotation_ranges_deg(adjusted)
    moved = _moved_share(adjusted)
    if moved < _MIN_MOVED_SHARE and max(yaw, pitch, roll) < _MIN_ROTATION_DEG:
        return "the camera neither moves nor turns"
    if adjusted.depth_factor > _MAX_DEPTH_FACTOR:
        return f"depths scatter by {adjusted.depth_factor:.1f} times what those of a Kinect do"
    if row in (_FX, _CX, _FY, _CY):
        about, turned = ("vertical", yaw) if row in (_FX, _CX) else ("horizontal", pitch)
        if turned < _MIN_ROTATION_DEG:
            return f"the camera turns by {turned:.0f} degrees only about its {about} axis"
        if row in (_CX, _CY) and roll < _MIN_ROTATION_DEG:
            return f"the camera turns by {roll:.0f} degrees only about its optical axis"
    if moved < (_MIN_MOVED_SHARE_FOR_OFFSET if row == _OFFSET else _MIN_MOVED_SHARE):
        return f"the camera moves by {moved:.1%} of the depth of what it sees only"
    if _PART_INFLATION * drive.parts[row] > _MIN_PART_SHARE * deviation:
        return "parts of the drive, adjusted alone, disagree by more than their uncertainty"
    if row == _DELAY:
        rate = float(np.median(np.abs(model.observed.rates_m_s)))
        return f"depths at a pixel change by {100 * rate:.0f} cm/s only"
    correlation = _correlations(adjusted.covariance, row)
    other = int(np.argmax(np.abs(correlation)))
    # If all depths are similar, an error that grows with depth has the same effect as an offset.
    if row == _OFFSET and (UNKNOWNS[other] == "curve" or abs(correlation[other]) <= _MIN_CORRELATION):
        depths = model.observed.depths_m[np.isfinite(model.observed.depths_m)]
        low, high = np.percentile(depths, [5, 95])
        return f"depths lie between {low:.1f} and {high:.1f} m"
    if abs(correlation[other]) > _MIN_CORRELATION:
        return (
            f"these views do not separate {UNKNOWNS[row]} from {UNKNOWNS[other]} "
            f"(correlation {correlation[other]:+.2f})"
        )
    return f"{len(adjusted.points_world)} landmarks in {len(model.rows)} views do not determine more"


def _moved_share(adjusted: Calibrated) -> float:
    """Return the RMS distance of the camera from its mean position over the median depth of the landmarks.

    The depth of a landmark is its distance from that mean position.
    """
    at = inverse(adjusted.T_camera_world)[:, :3, 3]
    middle = at.mean(axis=0)
    reach = float(np.sqrt(np.square(at - middle).sum(axis=1).mean()))
    return reach / max(float(np.median(np.linalg.norm(adjusted.points_world - middle, axis=1))), 1e-9)


def _correlations(covariance: Array, row: int) -> Array:
    """Return the correlations ``(n,)`` of the unknown *row* with all *n* unknowns, 0 for itself."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlations: Array = covariance[row] / (deviations * deviations[row])
    correlations[row] = 0.0
    return correlations


def _bound(row: int, within: float) -> str:
    """Return the bound *within* of the error *row* of `UNKNOWNS` as a phrase with its name and unit."""
    if row in (_FX, _FY):
        return f"{UNKNOWNS[row]} within {within:.0%}"
    if row in (_CX, _CY):
        return f"{UNKNOWNS[row]} within {within:.0f} px"
    if row == _K1:
        return f"k1 within {within:.2f}"
    return f"offset within {100 * within:.0f} cm" if row == _OFFSET else f"delay within {within:.2f} s"


def _rotation_ranges_deg(adjusted: Calibrated) -> tuple[float, float, float]:
    """Return the ranges of rotation, degrees, about the camera's vertical, horizontal and optical axis."""
    R = adjusted.T_camera_world[:, :3, :3]
    # Rotation of each view relative to the middle one, in the camera's axes: x right, y down, z forward.
    rotations = log_so3(R @ R[len(R) // 2].T)
    x, y, z = np.degrees(np.ptp(rotations, axis=0))
    return float(y), float(x), float(z)
