"""Judge the calibration of a drive: focal length, principal point, distortion, and depth against colour.

Findings come from an adjustment of keyframes with the calibration as unknowns.  What is measured against
odometry or an IMU is judged in `client_sdk.check.motion`.
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
from client_sdk.check.zooms import judge_zooms
from rse_pf.errors import DegenerateGeometry
from rse_pf.geometry import Array, Camera, inverse, log_so3
from rse_pf.slam.self_calibration import (
    UNKNOWNS,
    Calibrated,
    adjust_with_calibration,
    estimate_part_deviations,
)

__all__ = ["CalibrationJudgement", "judge_calibration"]

_FX, _FY, _CX, _CY, _K1, _OFFSET, _DELAY = range(7)
_COLOUR = ("fx", "fy", "cx", "cy", "k1", "readout")
_LEAST_KEYFRAMES = 6
_INFLATION = 1.5
_FLOOR = np.array([0.005, 0.005, 2.0, 2.0, 0.006, 0.006, 0.003, 0.01, 0.002])
"""Deviations that remain of any drive, from what the adjustment does not know: other terms of the lens,
registration, and errors of depth.  They grow with the residuals of depth."""
_USUAL_DEPTH_FACTOR = 0.7
_USUAL = np.array([0.005, 0.005, 2.0, 2.0, 0.01, 0.007, 0.005, 0.03, 0.007])
_WIDEST = np.array([0.15, 0.15, 40.0, 40.0, 0.15, 0.15, 0.3, 0.03, 0.007])
"""Deviations of the errors of a good calibration, and of faults.  A rolling shutter and errors of depth that
grow with depth are no faults."""
_LEAST = np.array([0.02, 0.02, 6.0, 6.0, 0.045, 0.015, 0.02])
"""Smaller errors are those of a good calibration."""
_TOLD = np.array([0.06, 0.06, 20.0, 20.0, 0.15, 0.06, 0.1])
"""A drive that could hide more than this of an unknown cannot tell it."""
_FEW_DEG = 12.0
_OF_FEW_PARTS = 1.5
"""Deviations that come from two to four parts are too small as often as not."""
_MAINLY, _ALIKE = 0.7, 0.8
_HARDLY, _LITTLE, _NOISY, _FEW_DEPTHS = 0.01, 0.06, 2.0, 0.2
_ROWS = {
    FaultKind.FOCAL_LENGTH: (_FX, _FY), FaultKind.PRINCIPAL_POINT: (_CX, _CY),
    FaultKind.DISTORTION: (_K1,), FaultKind.DEPTH_OFFSET: (_OFFSET,), FaultKind.DEPTH_DELAY: (_DELAY,),
}  # fmt: skip
_OF_COLOUR = (FaultKind.FOCAL_LENGTH, FaultKind.PRINCIPAL_POINT, FaultKind.DISTORTION)
_UNITS = ("%", "%", "px", "px", "", "cm", "s")
_TIMES = (100.0, 100.0, 1.0, 1.0, 1.0, 100.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationJudgement:
    """What the calibration of a drive shows.

    ``noise_m`` is how well the drive tells its path.  ``stamps_s`` ``(k,)`` and ``T_world_camera``
    ``(k, 4, 4)`` are the keyframes that were adjusted with the calibration, for whoever compares motions;
    empty where there were too few.  ``metres_deviation``, relative, is how well the calibration tells metres.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    noise_m: float = 0.0
    metres_deviation: float = 0.0
    stamps_s: Array = field(default_factory=lambda: np.empty(0))
    T_world_camera: Array = field(default_factory=lambda: np.empty((0, 4, 4)))


def judge_calibration(store: KeyframeStore) -> CalibrationJudgement:
    """Return what is wrong with the calibration of a drive."""
    keyframes, has_depth = store.keyframes, store.has_depth or store.has_stereo
    if len(keyframes) < _LEAST_KEYFRAMES:
        return _untold(f"{len(keyframes)} views that differ", has_depth=has_depth)
    tracks = tracks_of(keyframes)
    reading = best_reading(keyframes, tracks) if store.has_depth else DepthReading()
    free = UNKNOWNS if store.has_depth else _COLOUR
    try:
        model, found, reading = _adjusted(store, tracks, reading, free)
        if model is None or found is None:
            return _untold(_unconnected(store, reading), has_depth=has_depth)
        zoomed = adjust_with_calibration(
            model.observed, found.T_camera_world, found.points_world, free, zooms=True, values=found.values,
        )  # fmt: skip
    except DegenerateGeometry:
        return _untold("views that do not determine their poses", has_depth=has_depth)
    times_s = np.array([keyframes[row].timestamp_s for row in model.rows])
    zoom = judge_zooms(zoomed, times_s, found)
    findings = [] if zoom.finding is None else [zoom.finding]
    found = zoomed if findings else found
    parts = np.zeros(len(UNKNOWNS)) if findings else estimate_part_deviations(model.observed, found, free)
    causes = _causes(reading, has_depth=store.has_depth, is_one_camera=not findings)
    measured = _measured(found, parts, reading, causes)
    explanation = explain(measured)
    told = [each for each in explanation.causes if not explanation.rivals[each]]
    doubted: list[FaultKind] = []
    if zoom.hint:
        # What only one focal length for all views explains may be one that moves.
        moving = explain(_measured(zoomed, parts, reading, causes)).causes
        doubted = [each for each in told if each not in moving]
        told = [each for each in told if each in moving]
    findings += _findings(measured, explanation.causes, told, found, model, reading)
    drive = _Drive(measured, explanation, found, model, parts)
    return CalibrationJudgement(
        findings=tuple(findings),
        cannot_tell=(
            *zoom.cannot_tell,
            *_doubts(doubted, zoom.hint),
            *_cannot_tell(
                drive, reading, told={*doubted, *(each.kind for each in findings)}, has_depth=store.has_depth
            ),
        ),
        noise_m=found.noise_m,
        stamps_s=times_s,
        **_path(found, measured, explanation),
    )


class _Path(TypedDict):
    T_world_camera: Array
    metres_deviation: float


def _path(found: Calibrated, measured: Measured, explanation: Explanation) -> _Path:
    """Return the keyframes with the calibration that causes explain, and how well that tells their metres."""
    values, _ = measured.under(explanation.causes)
    # Depths that are too large by an offset look like a scale: metres are doubted by what it may be.
    offset = [FaultKind.DEPTH_OFFSET] if FaultKind.DEPTH_OFFSET in measured.causes else []
    _, covariance = measured.under([*explanation.causes, *offset])
    T_world_camera = inverse(found.T_camera_world)
    T_world_camera[:, :3, 3] += np.tensordot(values - measured.values, found.bends_m, axes=1)
    at = T_world_camera[:, :3, 3] - T_world_camera[:, :3, 3].mean(axis=0)
    slopes = np.tensordot(found.bends_m, at, axes=2) / max(float((at**2).sum()), 1e-12)
    variance = float(slopes @ covariance @ slopes)
    return _Path(T_world_camera=T_world_camera, metres_deviation=math.sqrt(max(variance, 0.0)))


def _causes(
    reading: DepthReading, *, has_depth: bool, is_one_camera: bool
) -> dict[FaultKind, tuple[int, ...]]:
    """Return which faults may explain a drive, and the rows of their unknowns."""
    kinds = list(_OF_COLOUR) if is_one_camera else []
    kinds += [FaultKind.DEPTH_OFFSET, FaultKind.DEPTH_DELAY] if has_depth and not reading.flip else []
    return {kind: _ROWS[kind] for kind in kinds}


def _measured(
    found: Calibrated, parts: Array, reading: DepthReading, causes: dict[FaultKind, tuple[int, ...]]
) -> Measured:
    """Return what an adjustment says of the calibration, with what it does not know of its own errors."""
    values = found.values.copy()
    values[_DELAY] += reading.delay_s
    usual = _USUAL.copy()
    if FaultKind.FOCAL_LENGTH not in causes:
        usual[: _K1 + 1] = _WIDEST[: _K1 + 1]
    return Measured(
        values=values, covariance=_INFLATION**2 * found.covariance + np.diag((_OF_FEW_PARTS * parts) ** 2),
        unknown=_depth_error_factor(found) * _FLOOR, usual=usual, widest=_WIDEST, causes=causes,
    )  # fmt: skip


def _adjusted(
    store: KeyframeStore, tracks: Tracks, reading: DepthReading, free: tuple[str, ...]
) -> tuple[DriveModel | None, Calibrated | None, DepthReading]:
    """Adjust a drive, and again with the delay of its depth that this finds, if that is another image."""
    by_depth = store.has_depth or store.has_stereo
    reading = DepthReading(reading.flip, nearest_delay(store.keyframes, reading.delay_s))
    tried_s = [reading.delay_s]
    while True:
        model = drive_model(store.keyframes, tracks, reading, by_depth=by_depth)
        if model is None:
            return None, None, reading
        found = adjust_with_calibration(model.observed, model.T_camera_world, model.points_world, free)
        late_s = nearest_delay(store.keyframes, reading.delay_s + float(found.values[_DELAY]))
        if reading.flip or late_s in tried_s:
            break
        tried_s.append(late_s)
        reading = DepthReading(delay_s=late_s)
    return model, found, reading


def _depth_error_factor(found: Calibrated) -> float:
    """Return how much larger the errors of depth are than the noise of a Kinect, 1 at least."""
    return max(1.0, found.depth_factor / _USUAL_DEPTH_FACTOR)


def _findings(
    measured: Measured, causes: tuple[FaultKind, ...], told: list[FaultKind], found: Calibrated,
    model: DriveModel, reading: DepthReading,
) -> list[Finding]:  # fmt: skip
    """Return the findings of causes that are told from others."""
    values, covariance = measured.under(causes)
    errors = _Errors(values, np.sqrt(np.diag(covariance)), found, model.observed.camera)
    judges = {
        FaultKind.FOCAL_LENGTH: _focal, FaultKind.PRINCIPAL_POINT: _principal,
        FaultKind.DISTORTION: _distortion, FaultKind.DEPTH_OFFSET: _offset, FaultKind.DEPTH_DELAY: _delay,
    }  # fmt: skip
    findings = [judges[kind](errors) for kind in told]
    if reading.flip:
        findings.append(_flipped(reading))
    return [finding for finding in findings if finding is not None]


@dataclass(frozen=True, slots=True)
class _Errors:
    """``(9,)`` values of the unknowns that causes explain, their deviations, and the drive they are of."""

    values: Array
    deviations: Array
    found: Calibrated
    camera: Camera

    def certain(self, kind: FaultKind) -> tuple[list[int], float]:
        """Return the rows of a fault that are certain, with its cost; none where it does not matter."""
        rows = [
            row for row in _ROWS[kind] if abs(self.values[row]) > max(3.0 * self.deviations[row], _LEAST[row])
        ]
        wrong = np.zeros(len(UNKNOWNS))
        wrong[rows] = self.values[rows]
        cost_m = self.found.bend_m(wrong)
        is_kept = matters(cost_m, self.found.noise_m) or kind is FaultKind.DEPTH_DELAY
        return (rows if is_kept else []), cost_m

    def with_the_other(self, rows: list[int]) -> list[int]:
        """Return both focal lengths where one is certain and the other is wrong alike by a deviation.

        One of two corrected alone bends a map more: 7.4 cm instead of 6.5 where both were 6 % too small.
        """
        first = self.values[rows[0]]
        return [
            row
            for row in _ROWS[FaultKind.FOCAL_LENGTH]
            if row in rows or self.values[row] * np.sign(first) > self.deviations[row]
        ]

    def worst(self, rows: list[int]) -> int:
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
    told = " and ".join(
        f"{names[row]} is {abs(relative[row]):.1%} too {_size(relative[row])} (+- {deviations[row]:.1%})"
        for row in rows
    )
    return Finding(
        kind=FaultKind.FOCAL_LENGTH, value=relative[worst], deviation=float(deviations[worst]),
        unit="relative",
        cost_m=cost_m, sentence=f"the focal length {told}",
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
    told = " and ".join(
        f"{UNKNOWNS[row]} is {abs(values[row]):.1f} px too {_size(-values[row])} (+- {deviations[row]:.1f})"
        for row in rows
    )
    return Finding(
        kind=FaultKind.PRINCIPAL_POINT, value=-float(values[worst]),
        deviation=float(deviations[worst]), unit="px", cost_m=cost_m,
        sentence=f"the principal point {told}",
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
            f"{which} is {1e3 * abs(delay_s):.0f} ms late (+- {1e3 * deviation_s:.0f}) beside {other}"
        ),
        fix=(
            f"pair each colour image with the depth image whose stamp is {1e3 * abs(delay_s):.0f} ms "
            f"{'later' if delay_s > 0 else 'earlier'}"
        ),
    )  # fmt: skip


def _size(error: float) -> str:
    return "large" if error > 0 else "small"


# --- what a drive cannot tell ---


@dataclass(frozen=True, slots=True)
class _Drive:
    """What a drive shows: for reasons of what it does not."""

    measured: Measured
    explanation: Explanation
    found: Calibrated
    model: DriveModel
    parts: Array


def _kinds(*, has_depth: bool) -> tuple[FaultKind, ...]:
    return tuple(_ROWS) if has_depth else _OF_COLOUR


def _untold(shown: str, *, has_depth: bool) -> CalibrationJudgement:
    return CalibrationJudgement(
        cannot_tell=tuple(CannotTell(kind, f"the drive has {shown}") for kind in _kinds(has_depth=has_depth))
    )


def _unconnected(store: KeyframeStore, reading: DepthReading) -> str:
    """Return why the keyframes of a drive do not connect."""
    keyframes = store.keyframes
    if store.has_depth or store.has_stereo:
        read = np.concatenate([each.depths_m[reading.flip] for each in keyframes])
        share = float(np.isfinite(read).mean())
        if share < _FEW_DEPTHS:
            return f"a depth at {share:.0%} of its features only"
    else:
        posed = sum(each.T_world_camera is not None for each in keyframes)
        if posed < _LEAST_KEYFRAMES:
            return f"a pose in {posed} of {len(keyframes)} views only"
    return "too few views that share enough features"


def _cannot_tell(
    drive: _Drive, reading: DepthReading, *, told: set[FaultKind], has_depth: bool
) -> Iterator[CannotTell]:
    if reading.flip:
        yield CannotTell(FaultKind.DEPTH_DELAY, "depth images that lie wrong on colour were not tried late")
    rivals = {**drive.explanation.rivals}
    for kind in _kinds(has_depth=has_depth):
        if kind in told or kind not in drive.measured.causes:
            continue
        _, covariance = drive.measured.under([*drive.explanation.causes, kind])
        deviations = np.sqrt(np.diag(covariance))
        row = max(_ROWS[kind], key=lambda each: deviations[each] / _TOLD[each])
        within = 3.0 * float(deviations[row])
        of = next((cause for cause, others in rivals.items() if others and kind in (cause, *others)), None)
        if of is not None:
            yield CannotTell(kind, _either(drive, of, row), within)
        elif within > _TOLD[row]:
            yield CannotTell(kind, f"{_reason(row, within / 3.0, drive)}: {_bound(row, within)}", within)


def _doubts(kinds: list[FaultKind], hint: float) -> Iterator[CannotTell]:
    """Yield what cannot be told from a focal length that moves by *hint*, relative."""
    moving = FaultKind.MOVING_FOCAL_LENGTH
    for kind in kinds:
        yield CannotTell(kind, f"this drive looks alike with {moving.value} (by {hint:+.1%})")
        yield CannotTell(moving, f"this drive looks alike with {kind.value}")


def _either(drive: _Drive, cause: FaultKind, row: int) -> str:
    """Return that some causes explain a drive alike, and by how much."""
    alike = (cause, *drive.explanation.rivals[cause])
    before = [each for each in drive.explanation.causes if each is not cause]
    told = []
    for kind in alike:
        values, _ = drive.measured.under([*before, kind])
        worst = max(_ROWS[kind], key=lambda each: abs(values[each]) / _LEAST[each])
        value = _TIMES[worst] * float(values[worst])
        told.append(f"{kind.value} ({UNKNOWNS[worst]} by {value:+.3g} {_UNITS[worst]}".rstrip() + ")")
    return f"this drive looks alike with {' and with '.join(told)}"


def _reason(row: int, deviation: float, drive: _Drive) -> str:
    """Return which motion, or which sight, this drive lacks, with its figure."""
    found, model = drive.found, drive.model
    yaw, pitch, roll = _turns_deg(found)
    moved = _moved_share(found)
    if moved < _HARDLY and max(yaw, pitch, roll) < _FEW_DEG:
        return "the camera neither moves nor turns"
    if found.depth_factor > _NOISY:
        return f"depths scatter by {found.depth_factor:.1f} times what those of a Kinect do"
    if row in (_FX, _CX, _FY, _CY):
        about, turned = ("vertical", yaw) if row in (_FX, _CX) else ("horizontal", pitch)
        if turned < _FEW_DEG:
            return f"the camera turns by {turned:.0f} degrees only about its {about} axis"
        if row in (_CX, _CY) and roll < _FEW_DEG:
            return f"the camera turns by {roll:.0f} degrees only about its optical axis"
    if moved < (_LITTLE if row == _OFFSET else _HARDLY):
        return f"the camera moves by {moved:.1%} of the depth of what it sees only"
    if _OF_FEW_PARTS * drive.parts[row] > _MAINLY * deviation:
        return "parts of the drive, adjusted by themselves, disagree by more than they know"
    if row == _DELAY:
        rate = float(np.median(np.abs(model.observed.rates_m_s)))
        return f"depths at a pixel change by {100 * rate:.0f} cm/s only"
    correlation = _correlations(found.covariance, row)
    other = int(np.argmax(np.abs(correlation)))
    # Errors that grow with depth look like an offset where all depths are alike.
    if row == _OFFSET and (UNKNOWNS[other] == "curve" or abs(correlation[other]) <= _ALIKE):
        depths = model.observed.depths_m[np.isfinite(model.observed.depths_m)]
        low, high = np.percentile(depths, [5, 95])
        return f"depths lie between {low:.1f} and {high:.1f} m"
    if abs(correlation[other]) > _ALIKE:
        return (
            f"{UNKNOWNS[row]} looks like {UNKNOWNS[other]} in these views "
            f"(correlation {correlation[other]:+.2f})"
        )
    return f"{len(found.points_world)} landmarks in {len(model.rows)} views do not tell more"


def _moved_share(found: Calibrated) -> float:
    """Return how far the camera moves, root mean square, beside the median distance of what it sees."""
    at = inverse(found.T_camera_world)[:, :3, 3]
    middle = at.mean(axis=0)
    reach = float(np.sqrt(np.square(at - middle).sum(axis=1).mean()))
    return reach / max(float(np.median(np.linalg.norm(found.points_world - middle, axis=1))), 1e-9)


def _correlations(covariance: Array, row: int) -> Array:
    """Return ``(n,)`` correlations of one unknown with the others, 0 with itself."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlations: Array = covariance[row] / (deviations * deviations[row])
    correlations[row] = 0.0
    return correlations


def _bound(row: int, within: float) -> str:
    if row in (_FX, _FY):
        return f"{UNKNOWNS[row]} within {within:.0%}"
    if row in (_CX, _CY):
        return f"{UNKNOWNS[row]} within {within:.0f} px"
    if row == _K1:
        return f"k1 within {within:.2f}"
    return f"offset within {100 * within:.0f} cm" if row == _OFFSET else f"delay within {within:.2f} s"


def _turns_deg(found: Calibrated) -> tuple[float, float, float]:
    """Return how far the camera turns about its vertical, horizontal and optical axis, between extremes."""
    R = found.T_camera_world[:, :3, :3]
    # Of each view beside the middle one, in the camera's axes: x to the right, y down, z ahead.
    turns = log_so3(R @ R[len(R) // 2].T)
    x, y, z = np.degrees(np.ptp(turns, axis=0))
    return float(y), float(x), float(z)
