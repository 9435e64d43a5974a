"""Judge the calibration of a drive: focal length, principal point, distortion, and depth against colour.

Findings come from an adjustment of keyframes with the calibration as unknowns.  What is measured against
odometry or an IMU is judged in `client_sdk.check.motion`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from client_sdk.check.drive_model import DepthReading, DriveModel, best_reading, drive_model, nearest_delay
from client_sdk.check.findings import CannotTell, FaultKind, Finding
from client_sdk.check.keyframes import FLIPS, KeyframeStore, Tracks, tracks_of
from client_sdk.check.zooms import judge_zooms
from rse_pf.errors import DegenerateGeometry
from rse_pf.geometry import Array, Camera, inverse, log_so3
from rse_pf.slam.self_calibration import UNKNOWNS, Calibrated, adjust_with_calibration

__all__ = ["CalibrationJudgement", "judge_calibration"]

_FX, _FY, _CX, _CY, _K1, _OFFSET, _DELAY = range(7)
_COLOUR = ("fx", "fy", "cx", "cy", "k1", "readout")
_LEAST_KEYFRAMES = 6
_INFLATION = 1.5
_FLOOR = np.array([0.005, 0.005, 2.0, 2.0, 0.006, 0.006, 0.003])
"""Deviations that remain of any drive, from what the adjustment does not know: other terms of the lens,
registration, and errors of depth.  They grow with the residuals of depth."""
_USUAL_DEPTH_FACTOR = 0.7
_LEAST = np.array([0.02, 0.02, 6.0, 6.0, 0.03, 0.015, 0.02])
"""Smaller errors are those of a good calibration."""
_TOLD = np.array([0.06, 0.06, 25.0, 25.0, 0.15, 0.06, 0.1])
"""A drive that could hide more than this of an unknown cannot tell it."""
_LEAST_COST_M, _COST_OF_NOISE = 0.004, 1.2
_FEW_DEG = 12.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationJudgement:
    """What the calibration of a drive shows.

    ``noise_m`` is how well the drive tells its path.  ``stamps_s`` ``(k,)`` and ``T_world_camera``
    ``(k, 4, 4)`` are the keyframes that were adjusted with the calibration, for whoever compares motions;
    empty where there were too few.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    noise_m: float = 0.0
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
            return _untold("too few views that show the same", has_depth=has_depth)
        zoomed = adjust_with_calibration(
            model.observed, found.T_camera_world, found.points_world, free, zooms=True, values=found.values,
        )  # fmt: skip
    except DegenerateGeometry:
        return _untold("views that do not determine their poses", has_depth=has_depth)
    times_s = np.array([keyframes[row].timestamp_s for row in model.rows])
    zoom = judge_zooms(zoomed, times_s, found, _depth_error_factor(zoomed))
    found = found if zoom is None else zoomed
    deviations = _whole_deviations(found)
    kinds = _of_colour(found, deviations, model) if zoom is None else [zoom]
    if store.has_depth:
        kinds += list(_of_depth(found, deviations, reading))
    return CalibrationJudgement(
        findings=tuple(kinds),
        cannot_tell=tuple(_cannot_tell(found, deviations, model, reading, has_depth=store.has_depth)),
        noise_m=found.noise_m,
        stamps_s=times_s,
        T_world_camera=inverse(found.T_camera_world),
    )


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


def _whole_deviations(found: Calibrated) -> Array:
    """Return ``(7,)`` deviations with what the adjustment does not know."""
    own: Array = found.deviations[: len(_FLOOR)]
    return np.hypot(_INFLATION * own, _depth_error_factor(found) * _FLOOR)


def _depth_error_factor(found: Calibrated) -> float:
    """Return how much larger the errors of depth are than the noise of a Kinect, 1 at least."""
    return max(1.0, found.depth_factor / _USUAL_DEPTH_FACTOR)


def _matters(found: Calibrated, rows: list[int], errors: Array) -> float | None:
    """Return the cost of errors of some unknowns, None where it is lost in the noise of the drive."""
    wrong = np.zeros(len(UNKNOWNS))
    wrong[rows] = errors
    cost_m = found.bend_m(wrong)
    return cost_m if cost_m > max(_LEAST_COST_M, _COST_OF_NOISE * found.noise_m) else None


def _certain(found: Calibrated, deviations: Array, rows: list[int]) -> list[int]:
    values = np.abs(found.values[rows])
    return [
        row
        for row, value in zip(rows, values, strict=True)
        if value > max(3.0 * deviations[row], _LEAST[row])
    ]


def _of_colour(found: Calibrated, deviations: Array, model: DriveModel) -> list[Finding]:
    camera = model.observed.camera
    judged = (judge(found, deviations, camera) for judge in (_focal, _principal, _distortion))
    return [finding for finding in judged if finding is not None]


def _focal(found: Calibrated, deviations: Array, camera: Camera) -> Finding | None:
    rows = _certain(found, deviations, [_FX, _FY])
    cost_m = _matters(found, rows, found.values[rows]) if rows else None
    if cost_m is None:
        return None
    worst = max(rows, key=lambda row: abs(found.values[row]) / deviations[row])
    names = {row: UNKNOWNS[row] for row in rows}
    errors = {row: math.exp(-found.values[row]) - 1.0 for row in rows}
    right = {names[row]: getattr(camera, names[row]) * math.exp(found.values[row]) for row in rows}
    told = " and ".join(
        f"{names[row]} is {abs(errors[row]):.1%} too {_size(errors[row])} (+- {deviations[row]:.1%})"
        for row in rows
    )
    return Finding(
        kind=FaultKind.FOCAL_LENGTH, value=errors[worst], deviation=float(deviations[worst]), unit="relative",
        cost_m=cost_m, sentence=f"the focal length {told}",
        fix="set " + ", ".join(f"{name} = {value:.1f}" for name, value in right.items()),
        correction=right,
    )  # fmt: skip


def _principal(found: Calibrated, deviations: Array, camera: Camera) -> Finding | None:
    rows = _certain(found, deviations, [_CX, _CY])
    cost_m = _matters(found, rows, found.values[rows]) if rows else None
    if cost_m is None:
        return None
    worst = max(rows, key=lambda row: abs(found.values[row]) / deviations[row])
    right = {UNKNOWNS[row]: getattr(camera, UNKNOWNS[row]) + found.values[row] for row in rows}
    told = " and ".join(
        f"{UNKNOWNS[row]} is {abs(found.values[row]):.1f} px too {_size(-found.values[row])} "
        f"(+- {deviations[row]:.1f})"
        for row in rows
    )
    return Finding(
        kind=FaultKind.PRINCIPAL_POINT, value=-float(found.values[worst]),
        deviation=float(deviations[worst]), unit="px", cost_m=cost_m,
        sentence=f"the principal point {told}",
        fix="set " + ", ".join(f"{name} = {value:.1f}" for name, value in right.items()),
        correction={name: float(value) for name, value in right.items()},
    )  # fmt: skip


def _distortion(found: Calibrated, deviations: Array, camera: Camera) -> Finding | None:
    rows = _certain(found, deviations, [_K1])
    cost_m = _matters(found, rows, found.values[rows]) if rows else None
    if cost_m is None:
        return None
    k1 = float(found.values[_K1])
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


def _of_depth(found: Calibrated, deviations: Array, reading: DepthReading) -> Iterator[Finding]:
    if reading.flip:
        how = FLIPS[reading.flip]
        yield Finding(
            kind=FaultKind.MIRRORED, value=1.0, deviation=0.0, unit="", cost_m=None,
            sentence=f"depth fits the colour images only with {how}",
            fix="turn either the depth or the colour images in the driver of the camera",
        )  # fmt: skip
        return
    if _certain(found, deviations, [_OFFSET]):
        cost_m = _matters(found, [_OFFSET], found.values[[_OFFSET]])
        offset_m = float(found.values[_OFFSET])
        if cost_m is not None:
            yield Finding(
                kind=FaultKind.DEPTH_OFFSET, value=offset_m, deviation=float(deviations[_OFFSET]), unit="m",
                cost_m=cost_m, fix=f"subtract {offset_m:+.3f} m from every depth before it is used",
                sentence=(
                    f"depths are {100 * abs(offset_m):.1f} cm too {_size(offset_m)} "
                    f"(+- {100 * deviations[_OFFSET]:.1f})"
                ),
            )  # fmt: skip
    delay_s = reading.delay_s + float(found.values[_DELAY])
    if abs(delay_s) > max(3.0 * deviations[_DELAY], _LEAST[_DELAY]):
        wrong = np.zeros(len(UNKNOWNS))
        wrong[_DELAY] = delay_s
        which, other = ("depth", "colour") if delay_s > 0 else ("colour", "depth")
        yield Finding(
            kind=FaultKind.DEPTH_DELAY, value=delay_s, deviation=float(deviations[_DELAY]), unit="s",
            cost_m=found.bend_m(wrong),
            sentence=(
                f"{which} is {1e3 * abs(delay_s):.0f} ms late (+- {1e3 * deviations[_DELAY]:.0f}) "
                f"beside {other}"
            ),
            fix=f"pair each colour image with the depth image {1e3 * delay_s:+.0f} ms from it",
        )  # fmt: skip


def _size(error: float) -> str:
    return "large" if error > 0 else "small"


# --- what a drive cannot tell ---

_KINDS = (
    (FaultKind.FOCAL_LENGTH, (_FX, _FY), "relative"), (FaultKind.PRINCIPAL_POINT, (_CX, _CY), "px"),
    (FaultKind.DISTORTION, (_K1,), "relative"), (FaultKind.DEPTH_OFFSET, (_OFFSET,), "m"),
    (FaultKind.DEPTH_DELAY, (_DELAY,), "s"),
)  # fmt: skip
_COLOUR_KINDS = 3


def _untold(shown: str, *, has_depth: bool) -> CalibrationJudgement:
    kinds = _KINDS if has_depth else _KINDS[:_COLOUR_KINDS]
    return CalibrationJudgement(
        cannot_tell=tuple(CannotTell(kind, f"the drive has {shown}") for kind, _, _ in kinds)
    )


def _cannot_tell(
    found: Calibrated, deviations: Array, model: DriveModel, reading: DepthReading, *, has_depth: bool
) -> Iterator[CannotTell]:
    if reading.flip:
        yield CannotTell(FaultKind.DEPTH_DELAY, "depth images that lie wrong on colour were not tried late")
    for kind, rows, _ in _KINDS if has_depth else _KINDS[:_COLOUR_KINDS]:
        row = max(rows, key=lambda each: deviations[each] / _TOLD[each])
        within = 3.0 * float(deviations[row])
        if within > _TOLD[row] and not (row == _DELAY and reading.flip):
            yield CannotTell(kind, f"{_reason(row, found, model)}: {_bound(row, within)}", within)


def _reason(row: int, found: Calibrated, model: DriveModel) -> str:
    """Return which motion, or which sight, this drive lacks, with its figure."""
    yaw, pitch, roll = _turns_deg(found)
    if row in (_FX, _CX, _FY, _CY):
        about, turned = ("vertical", yaw) if row in (_FX, _CX) else ("horizontal", pitch)
        if turned < _FEW_DEG:
            return f"the camera turns by {turned:.0f} degrees only about its {about} axis"
        if row in (_CX, _CY) and roll < _FEW_DEG:
            return f"the camera turns by {roll:.0f} degrees only about its optical axis"
    if row == _OFFSET:
        depths = model.observed.depths_m[np.isfinite(model.observed.depths_m)]
        if not len(depths):
            return "no feature has a depth"
        low, high = np.percentile(depths, [5, 95])
        return f"depths lie between {low:.1f} and {high:.1f} m"
    if row == _DELAY:
        rate = float(np.median(np.abs(model.observed.rates_m_s)))
        return f"depths at a pixel change by {100 * rate:.0f} cm/s only"
    return f"{len(found.points_world)} landmarks in {len(model.rows)} views are too few"


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
