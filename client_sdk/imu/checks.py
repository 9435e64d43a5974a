"""What is wrong with an IMU, said in one line: by its samples alone, and beside the rotations of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from client_sdk.imu.history import ImuHistory
from client_sdk.imu.samples import ImuModel
from rse_pf.geometry import Array, log_so3, rotation_angle_deg

__all__ = ["GRAVITY_M_S2", "MOST_OFF_M_S2", "RateCheck", "check_rates", "off_gravity", "trouble_of_samples"]

GRAVITY_M_S2 = 9.81
MOST_OFF_M_S2 = 0.6
"""So far may the bias of an accelerometer make gravity seem longer or shorter: three deviations of a bias."""
_FEWEST_SAMPLES, _FEWEST_RATES = 100, 30
_REST_S, _FEWEST_RESTS = 0.5, 3
_REST_NOISES, _REST_GYRO, _REST_ACCEL = 3.0, 0.02, 0.1
"""At rest samples scatter by less than these rad/s or m/s^2, and so many times their noise."""
_MISSING, _SATURATED = 0.05, 0.01
_LEAST_RATE = 0.04
"""rad/s, deviation about two axes: slower turns do not tell axes apart."""
_WRONG_DEG = 8.0
_RATIO = 1.25
_MOST_OFFSET_S, _OFFSET_STEP_S, _REFUSED_OFFSET_S = 0.1, 0.002, 0.06
_LEAST_OFFSET_S = 0.003
"""Offsets below are not corrected: the estimate is no better."""
_OUTLIER = 4.0
"""Rates that are so many times as far apart as the median of them are left out."""
_EXPLAINED = 0.5
"""Rates that agree leave so little of the deviation, as a share."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RateCheck:
    """What the rates of a gyroscope are beside those of a camera; ``trouble`` is empty if all is well.

    ``fault`` is empty unless axes or clock cause the trouble.  ``offset_s`` is by how much the clock of the
    IMU is ahead; ``bias_gyro`` ``(3,)`` is in rad/s.
    """

    trouble: str
    fault: Literal["", "axes", "offset"]
    offset_s: float
    bias_gyro: Array


def trouble_of_samples(history: ImuHistory) -> str:
    """Return in one line why samples cannot be used, empty if nothing is wrong with them alone."""
    rows, model = history.rows(), history.model
    if len(rows) < _FEWEST_SAMPLES:
        return ""
    steps = np.diff(rows[:, 0]) * model.rate_hz
    missing = float(np.maximum(0.0, np.round(steps) - 1.0).sum() / (steps.sum() + 1e-9))
    if missing > _MISSING:
        return f"{100 * missing:.0f} % of the IMU's samples are missing at {model.rate_hz:g} Hz"
    for name, unit, columns, largest in (
        ("gyroscope", "rad/s", slice(1, 4), model.max_gyro),
        ("accelerometer", "m/s^2", slice(4, 7), model.max_accel),
    ):
        share = float((np.abs(rows[:, columns]) >= 0.999 * largest).any(axis=1).mean())
        if share > _SATURATED:
            return f"the {name} is saturated at {largest:g} {unit} in {100 * share:.0f} % of its samples"
    length = float(np.linalg.norm(rows[:, 4:7], axis=1).mean())
    if 0.7 < length < 1.3:
        return f"the accelerometer reads {length:.2f} on average: in g, where m/s^2 are needed"
    if not 0.7 * GRAVITY_M_S2 < length < 1.5 * GRAVITY_M_S2:
        return f"the accelerometer reads {length:.1f} m/s^2 on average, where gravity is 9.8"
    at_rest = _accel_at_rest(rows, model)
    return "" if at_rest is None else off_gravity(at_rest, "at rest")


def off_gravity(length: float, where: str) -> str:
    """Return in one line by how much an accelerometer is wrong that measures gravity as *length* m/s^2.

    Empty if a bias may explain it.  One direction of gravity does not tell a scale from a bias.
    """
    off = length - GRAVITY_M_S2
    if abs(off) <= MOST_OFF_M_S2:
        return ""
    share, much = 100.0 * abs(off) / GRAVITY_M_S2, "much" if off > 0.0 else "little"
    return (
        f"the accelerometer reads {length:.2f} m/s^2 {where}, {share:.0f} % too {much}: its scale is wrong, "
        f"or it has a bias of {abs(off):.1f} m/s^2"
    )


def _accel_at_rest(rows: Array, model: ImuModel) -> float | None:
    """Return the median length of accelerations where neither they nor the rates change; None if never."""
    size = round(_REST_S * model.rate_hz)
    count = len(rows) // size
    if count < _FEWEST_RESTS:
        return None
    parts = rows[: count * size].reshape(count, size, 7)
    scatter, white = parts[:, :, 1:].std(axis=1), _REST_NOISES * model.rate_hz**0.5
    gyro, accel = _REST_GYRO + white * model.gyro_noise, _REST_ACCEL + white * model.accel_noise
    rests = (scatter[:, :3] <= gyro).all(axis=1) & (scatter[:, 3:] <= accel).all(axis=1)
    if rests.sum() < _FEWEST_RESTS:
        return None
    return float(np.median(np.linalg.norm(parts[rests, :, 4:].mean(axis=1), axis=1)))


def check_rates(
    history: ImuHistory, timestamps_s: Array, R_world_camera: Array, offset_s: float
) -> RateCheck | None:
    """Compare the gyroscope with how the camera turned; None while it turns too little to tell.

    Args:
        history: Samples of the time.
        timestamps_s: ``(n,)`` of the poses.
        R_world_camera: ``(n, 3, 3)``.
        offset_s: As it is known so far.
    """
    R_imu_camera = history.model.T_imu_camera[:3, :3]
    dt = np.diff(timestamps_s)
    usable = np.flatnonzero((dt > 0.0) & (dt <= 0.5))
    if len(usable) < _FEWEST_RATES:
        return None
    begins, ends = timestamps_s[usable], timestamps_s[usable + 1]
    turned = np.swapaxes(R_world_camera[usable], 1, 2) @ R_world_camera[usable + 1]
    seen = log_so3(turned) / dt[usable, None] @ R_imu_camera.T
    spread = np.linalg.eigvalsh(np.cov(seen.T))
    if not spread[1] > _LEAST_RATE**2:
        return None
    is_usable = np.ones(len(seen), dtype=bool)
    for _ in range(2):
        best = _best_offset(history, begins[is_usable], ends[is_usable], seen[is_usable])
        rates = history.mean_gyro(begins + best, ends + best)
        left = np.linalg.norm(rates - seen - np.median(rates - seen, axis=0), axis=1)
        is_usable = left <= _OUTLIER * np.median(left)
    seen, rates = seen[is_usable], rates[is_usable]
    seen_only = seen - seen.mean(axis=0)
    bias = rates.mean(axis=0) - seen.mean(axis=0)
    rates_only = rates - rates.mean(axis=0)
    ratio = float(np.sqrt(np.square(rates_only).sum() / np.square(seen_only).sum()))
    U, _, Vt = np.linalg.svd(seen_only.T @ rates_only)
    Q = U @ Vt  # takes the rates of the gyroscope to those of the camera
    is_mirrored = float(np.linalg.det(Q)) < 0.0
    if is_mirrored and not spread[0] > _LEAST_RATE**2:
        # Turns about two axes leave the sign of the third one open.
        U[:, 2] *= -1.0
        Q, is_mirrored = U @ Vt, False
    explained = float(
        np.sqrt(np.square(rates_only @ Q.T / ratio - seen_only).sum() / np.square(seen_only).sum())
    )
    fault, trouble = _trouble_of(ratio, Q, explained, best, is_mirrored=is_mirrored)
    return RateCheck(
        trouble=trouble,
        fault=fault,
        offset_s=best if abs(best - offset_s) > _LEAST_OFFSET_S else offset_s,
        bias_gyro=bias,
    )


def _best_offset(history: ImuHistory, begins_s: Array, ends_s: Array, seen: Array) -> float:
    """Return the offset in time at which rates ``(n, 3)`` of the camera and of the gyroscope agree best.

    The rotation between both is free, so that swapped axes do not hide an offset.
    """
    seen_only = seen - seen.mean(axis=0)
    shifts = np.arange(-_MOST_OFFSET_S, _MOST_OFFSET_S + 1e-9, _OFFSET_STEP_S)
    fits = []
    for shift_s in shifts.tolist():
        rates = history.mean_gyro(begins_s + shift_s, ends_s + shift_s)
        rates = rates - rates.mean(axis=0)
        agreeing = np.linalg.svd(seen_only.T @ rates, compute_uv=False).sum()
        fits.append(float(agreeing / (np.linalg.norm(rates) + 1e-12)))
    peak = int(np.argmax(fits))
    if not 0 < peak < len(shifts) - 1:
        return float(shifts[peak])
    before, at, after = fits[peak - 1 : peak + 2]
    return float(shifts[peak]) + 0.5 * _OFFSET_STEP_S * (before - after) / (before - 2.0 * at + after)


def _trouble_of(
    ratio: float, Q: Array, left: float, offset_s: float, *, is_mirrored: bool
) -> tuple[Literal["", "axes", "offset"], str]:
    """Return what is wrong, see `RateCheck`; *left* is the share of the rates that no rotation explains."""
    if left > _EXPLAINED:
        return "", "the gyroscope does not turn as the camera does, at any offset in time within 100 ms"
    if ratio > 40.0:
        return "", (
            f"the gyroscope reads {ratio:.0f} times what the camera turns: in degrees, where rad/s are needed"
        )
    if not 1.0 / _RATIO < ratio < _RATIO:
        return "", f"the gyroscope reads {ratio:.2f} times what the camera turns: is its unit rad/s?"
    if is_mirrored:
        return "axes", "an axis of the gyroscope has the wrong sign, or two are swapped: they are left-handed"
    angle = rotation_angle_deg(Q)
    if angle > _WRONG_DEG:
        return "axes", (
            f"the axes of the IMU are turned by {angle:.0f} degrees from what T_imu_camera says: "
            "are two of them swapped?"
        )
    if abs(offset_s) > _REFUSED_OFFSET_S:
        return "offset", f"the clock of the IMU is {1e3 * offset_s:.0f} ms off that of the camera"
    return "", ""
