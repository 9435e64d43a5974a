"""Check an IMU by its samples alone, and compare its gyroscope with the rotations of a camera.

Each check returns a sentence for people that says what is wrong, empty if nothing is; `ImuEstimator` does not
use an IMU for which a check returned a sentence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from client_sdk.imu.history import ImuHistory
from client_sdk.imu.samples import ImuModel
from rse_pf.geometry import Array, log_so3, rotation_angle_deg

__all__ = [
    "GRAVITY_M_S2",
    "MAX_GRAVITY_ERROR_M_S2",
    "RateCheck",
    "check_rates",
    "describe_gravity_error",
    "find_sample_trouble",
]

GRAVITY_M_S2 = 9.81  # magnitude of gravity; it varies by 0.03 over the Earth, far below a sensor's bias
MAX_GRAVITY_ERROR_M_S2 = 0.6
"""Largest difference between 9.81 m/s^2 and a measured magnitude of gravity that the bias of a sound
accelerometer explains: three standard deviations of such a bias, 0.2 m/s^2 each.  Beyond it the accelerometer
is refused."""

# Limits of the samples alone, see `find_sample_trouble`
_MIN_SAMPLES = 100  # fewer IMU samples are not checked, and have no fault: half a second at 200 Hz
_MAX_MISSING_FRACTION = 0.05  # an IMU is refused if a larger fraction of its samples is missing
_MAX_SATURATED_FRACTION = 0.01  # an IMU is refused if a larger fraction of its samples is saturated
_SATURATION = 0.999  # a sample is saturated from this fraction of the sensor's range on
_MIN_IN_G = 0.7  # lower end of the mean magnitudes of an accelerometer that are refused as being in g
_MAX_IN_G = 1.3  # upper end of the mean magnitudes of an accelerometer that are refused as being in g
# Smallest mean magnitude of the samples of an accelerometer, as a multiple of gravity; below it the IMU is
# refused.
_MIN_MEAN_ACCEL = 0.7
# Largest mean magnitude of the samples of an accelerometer, as a multiple of gravity; above it the IMU is
# refused.
_MAX_MEAN_ACCEL = 1.5
_REST_S = 0.5  # length of the time windows in which an IMU is tested for being stationary
_MIN_REST_WINDOWS = 3  # with fewer stationary windows, the magnitude of gravity in them is not checked
_REST_NOISE_FACTOR = 3.0
"""Multiple of its white noise by which the samples of a stationary sensor may scatter, in addition to
`_REST_GYRO_RAD_S` or `_REST_ACCEL_M_S2`."""
_REST_GYRO_RAD_S = 0.02  # standard deviation of a stationary gyroscope that is allowed beyond its noise
_REST_ACCEL_M_S2 = 0.1  # standard deviation of a stationary accelerometer that is allowed beyond its noise

# Limits of the comparison with the camera, see `check_rates`
_MIN_INTERVALS = 30  # with fewer intervals between poses, the rates of gyroscope and camera are not compared
_MAX_INTERVAL_S = 0.5  # an interval between two poses that is longer, in seconds, is left out
_MIN_RATE_SPREAD_RAD_S = 0.04
"""Smallest standard deviation of the camera's rates, in rad/s, along the second of their three principal axes
(in the order of their variances) for which rates are compared: slower rotations, or rotations about one axis
only, do not distinguish the axes of the gyroscope."""
_MAX_OFFSET_S = 0.1
"""The time offset between the clocks of IMU and camera is searched up to this size in either direction.  That
is more than `_MAX_USABLE_OFFSET_S`, so that the size of an offset that is refused can be reported."""
_OFFSET_STEP_S = 0.002
"""Step of the search for the time offset between IMU and camera; the result is interpolated between the
steps."""
_MIN_OFFSET_CHANGE_S = 0.003
"""A measured time offset that differs from the offset in use by no more than this does not replace it,
because the measurement is not more accurate."""
_MAX_USABLE_OFFSET_S = 0.06
"""Largest offset between the clocks of IMU and camera that is corrected; for a larger one, up to
`_MAX_OFFSET_S`, the IMU is refused."""
_OUTLIER_FACTOR = 4.0
"""An interval is an outlier if its rates of gyroscope and camera differ by more than this many times the
median difference."""
_MAX_UNEXPLAINED = 0.5
"""Largest root mean square of the difference between the camera's rates and the best-fitting rotation of the
gyroscope's rates, as a fraction of that of the camera's rates.  Above it the two sensors do not measure the
same motion, and the IMU is refused."""
_MIN_DEGREES_RATIO = 40.0
"""Gyroscope rates divided by camera rates above which the IMU is refused because its unit is degrees per
second: a degree per second read as rad/s is 57 times too large."""
# Largest ratio of gyroscope rates to camera rates, and vice versa; beyond it the IMU is refused.
_MAX_RATE_RATIO = 1.25
_MAX_AXES_ERROR_DEG = 8.0
"""Largest angle, in degrees, by which the gyroscope's axes may be rotated against what ``T_imu_camera``
states; beyond it the IMU is refused."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RateCheck:
    """Result of comparing the rates of a gyroscope with those of a camera.

    Attributes:
        trouble: Why the IMU must not be used, as a sentence; empty if it may be used.
        fault: Kind of *trouble*: ``axes`` (they are not as ``T_imu_camera`` states), ``offset`` (the clocks
            differ by more than 60 ms), or empty for any other kind and without trouble.
        offset_s: Time by which the clock of the IMU is ahead of that of the camera: the measured offset if it
            differs by more than 3 ms from the offset in use, else the offset in use.
        gyro_bias_rad_s: ``(3,)`` bias of the gyroscope, in the IMU's frame.
    """

    trouble: str
    fault: Literal["", "axes", "offset"]
    offset_s: float
    gyro_bias_rad_s: Array


def find_sample_trouble(history: ImuHistory) -> str:
    """Return as a sentence why the samples of an IMU cannot be used; empty if they can.

    Faults are more than 5 % missing samples, more than 1 % saturated samples, an accelerometer whose unit is
    g or whose mean magnitude is not 0.7 to 1.5 times gravity, and an accelerometer whose magnitude differs
    from 9.81 m/s^2 by more than 0.6 m/s^2 while the IMU is stationary.  Fewer than 100 samples are not
    checked.
    """
    samples, model = history.to_array(), history.model
    if len(samples) < _MIN_SAMPLES:
        return ""
    # 1. Refuse a sensor with too many missing samples, by the times between samples.
    steps = np.diff(samples[:, 0]) * model.rate_hz
    missing = float(np.maximum(0.0, np.round(steps) - 1.0).sum() / (steps.sum() + 1e-9))
    if missing > _MAX_MISSING_FRACTION:
        return f"{100 * missing:.0f} % of the IMU's samples are missing at {model.rate_hz:g} Hz"
    # 2. Refuse a sensor with too many samples at the end of its range.
    for name, unit, columns, limit in (
        ("gyroscope", "rad/s", slice(1, 4), model.max_gyro),
        ("accelerometer", "m/s^2", slice(4, 7), model.max_accel),
    ):
        saturated = float((np.abs(samples[:, columns]) >= _SATURATION * limit).any(axis=1).mean())
        if saturated > _MAX_SATURATED_FRACTION:
            return f"the {name} is saturated at {limit:g} {unit} in {100 * saturated:.0f} % of its samples"
    # 3. Refuse an accelerometer whose mean magnitude shows another unit than m/s^2.
    mean_accel = float(np.linalg.norm(samples[:, 4:7], axis=1).mean())
    if _MIN_IN_G < mean_accel < _MAX_IN_G:
        return f"the accelerometer reads {mean_accel:.2f} on average: in g, where m/s^2 are needed"
    if not _MIN_MEAN_ACCEL * GRAVITY_M_S2 < mean_accel < _MAX_MEAN_ACCEL * GRAVITY_M_S2:
        return f"the accelerometer reads {mean_accel:.1f} m/s^2 on average, where gravity is 9.8"
    # 4. Compare the mean force while the IMU is stationary with gravity.
    stationary_accel = _stationary_accel(samples, model)
    return "" if stationary_accel is None else describe_gravity_error(stationary_accel, "while stationary")


def describe_gravity_error(measured_m_s2: float, circumstance: str) -> str:
    """Return as a sentence how wrong an accelerometer is that measures gravity as *measured_m_s2*.

    Empty up to an error of 0.6 m/s^2, which the usual bias explains.  A measurement in one orientation does
    not distinguish a wrong scale from a bias, so the sentence names both.  *circumstance* are words of the
    sentence that say when gravity was measured, such as ``while stationary``.
    """
    error = measured_m_s2 - GRAVITY_M_S2
    if abs(error) <= MAX_GRAVITY_ERROR_M_S2:
        return ""
    percent, direction = 100.0 * abs(error) / GRAVITY_M_S2, "much" if error > 0.0 else "little"
    return (
        f"the accelerometer reads {measured_m_s2:.2f} m/s^2 {circumstance}, {percent:.0f} % too {direction}: "
        f"its scale is wrong, or it has a bias of {abs(error):.1f} m/s^2"
    )


def _stationary_accel(samples: Array, model: ImuModel) -> float | None:
    """Return the median magnitude of the mean specific force, m/s^2, of the stationary windows of 0.5 s.

    In a stationary window neither rates nor forces scatter by more than the noise of the sensor and an
    allowance.  None if there are fewer than 3 such windows.
    """
    size = round(_REST_S * model.rate_hz)
    count = len(samples) // size
    if count < _MIN_REST_WINDOWS:
        return None
    windows = samples[: count * size].reshape(count, size, 7)
    scatter, noise_factor = windows[:, :, 1:].std(axis=1), _REST_NOISE_FACTOR * model.rate_hz**0.5
    max_gyro = _REST_GYRO_RAD_S + noise_factor * model.gyro_noise
    max_accel = _REST_ACCEL_M_S2 + noise_factor * model.accel_noise
    is_stationary = (scatter[:, :3] <= max_gyro).all(axis=1) & (scatter[:, 3:] <= max_accel).all(axis=1)
    if is_stationary.sum() < _MIN_REST_WINDOWS:
        return None
    return float(np.median(np.linalg.norm(windows[is_stationary, :, 4:].mean(axis=1), axis=1)))


def check_rates(
    history: ImuHistory, timestamps_s: Array, R_world_camera: Array, offset_s: float
) -> RateCheck | None:
    """Compare the gyroscope with the rotations of the camera: time offset, bias, unit, and axes.

    Args:
        history: Samples that cover the time of the poses.
        timestamps_s: ``(n,)`` time stamps of the poses, ascending.
        R_world_camera: ``(n, 3, 3)`` rotations of the poses.
        offset_s: Offset in use, by which the clock of the IMU is ahead of that of the camera; it only decides
            what `RateCheck.offset_s` is.

    Returns:
        The result; None while there are fewer than 30 usable intervals between poses, or the camera rotates
        too slowly or about one axis only.

    Source:
        Rotation between two sets of vectors: Kabsch, Acta Cryst. A32, 1976.
    """
    # 1. Compute the camera's mean rate in each interval, in the IMU's frame.
    R_imu_camera = history.model.T_imu_camera[:3, :3]
    dt = np.diff(timestamps_s)
    usable = np.flatnonzero((dt > 0.0) & (dt <= _MAX_INTERVAL_S))
    if len(usable) < _MIN_INTERVALS:
        return None
    begins, ends = timestamps_s[usable], timestamps_s[usable + 1]
    rotations = np.swapaxes(R_world_camera[usable], 1, 2) @ R_world_camera[usable + 1]
    camera_rates = log_so3(rotations) / dt[usable, None] @ R_imu_camera.T
    variances = np.linalg.eigvalsh(np.cov(camera_rates.T))  # about the principal axes, ascending
    if not variances[1] > _MIN_RATE_SPREAD_RAD_S**2:
        return None
    # 2. Find the time offset, twice: the second time without the outliers of the first.
    is_inlier = np.ones(len(camera_rates), dtype=bool)
    for _ in range(2):
        best_offset_s = _find_offset_s(history, begins[is_inlier], ends[is_inlier], camera_rates[is_inlier])
        gyro_rates = history.mean_gyro(begins + best_offset_s, ends + best_offset_s)
        differences = gyro_rates - camera_rates
        distances = np.linalg.norm(differences - np.median(differences, axis=0), axis=1)
        is_inlier = distances <= _OUTLIER_FACTOR * np.median(distances)
    camera_rates, gyro_rates = camera_rates[is_inlier], gyro_rates[is_inlier]
    # 3. Compute the gyroscope's bias, and the ratio of the deviations of both rates from their means.
    camera_centred = camera_rates - camera_rates.mean(axis=0)
    bias = gyro_rates.mean(axis=0) - camera_rates.mean(axis=0)
    gyro_centred = gyro_rates - gyro_rates.mean(axis=0)
    ratio = float(np.sqrt(np.square(gyro_centred).sum() / np.square(camera_centred).sum()))
    # 4. Find the orthogonal matrix that maps the gyroscope's rates to those of the camera (Kabsch).
    U, _, Vt = np.linalg.svd(camera_centred.T @ gyro_centred)
    Q = U @ Vt
    is_mirrored = float(np.linalg.det(Q)) < 0.0
    if is_mirrored and not variances[0] > _MIN_RATE_SPREAD_RAD_S**2:
        # Rotations about two axes only do not determine the sign of the third axis: choose the sign that
        # makes Q a rotation.  A mirrored sensor is therefore found only from rotations about three axes.
        U[:, 2] *= -1.0
        Q, is_mirrored = U @ Vt, False
    residuals = gyro_centred @ Q.T / ratio - camera_centred
    unexplained = float(np.sqrt(np.square(residuals).sum() / np.square(camera_centred).sum()))
    # 5. Name the fault, if there is one.
    fault, trouble = _find_rate_trouble(ratio, Q, unexplained, best_offset_s, is_mirrored=is_mirrored)
    return RateCheck(
        trouble=trouble,
        fault=fault,
        offset_s=best_offset_s if abs(best_offset_s - offset_s) > _MIN_OFFSET_CHANGE_S else offset_s,
        gyro_bias_rad_s=bias,
    )


def _find_offset_s(history: ImuHistory, begins_s: Array, ends_s: Array, camera_rates: Array) -> float:
    """Return the time offset within 0.1 s at which the rates ``(n, 3)`` of camera and gyroscope fit best.

    The offset is the time by which the clock of the IMU is ahead of that of the camera; *begins_s* and
    *ends_s* of the intervals are on the clock of the camera.  For each offset, the rates of the gyroscope are
    mapped to those of the camera by the orthogonal matrix that fits best, so that swapped axes do not hide an
    offset.  The maximum of the fit is interpolated by a parabola.
    """
    camera_centred = camera_rates - camera_rates.mean(axis=0)
    offsets_s = np.arange(-_MAX_OFFSET_S, _MAX_OFFSET_S + 1e-9, _OFFSET_STEP_S)
    fits = []
    for offset_s in offsets_s.tolist():
        gyro_rates = history.mean_gyro(begins_s + offset_s, ends_s + offset_s)
        gyro_rates = gyro_rates - gyro_rates.mean(axis=0)
        # The sum of singular values is the largest correlation over all orthogonal matrices.
        correlation = np.linalg.svd(camera_centred.T @ gyro_rates, compute_uv=False).sum()
        fits.append(float(correlation / (np.linalg.norm(gyro_rates) + 1e-12)))
    peak = int(np.argmax(fits))
    if not 0 < peak < len(offsets_s) - 1:
        return float(offsets_s[peak])
    before, at, after = fits[peak - 1 : peak + 2]
    return float(offsets_s[peak]) + 0.5 * _OFFSET_STEP_S * (before - after) / (before - 2.0 * at + after)


def _find_rate_trouble(
    ratio: float, Q: Array, unexplained: float, offset_s: float, *, is_mirrored: bool
) -> tuple[Literal["", "axes", "offset"], str]:
    """Return fault and trouble as in `RateCheck`.

    Args:
        ratio: Magnitude of the gyroscope's rates divided by that of the camera's.
        Q: ``(3, 3)`` orthogonal matrix that maps the gyroscope's rates to the camera's, both in the frame of
            the IMU by ``T_imu_camera``; the identity if the axes are as that pose states.
        unexplained: What `_MAX_UNEXPLAINED` limits.
        offset_s: Measured time by which the clock of the IMU is ahead of that of the camera.
        is_mirrored: Whether *Q* has the determinant -1: one axis has the wrong sign, or two are swapped.
    """
    if unexplained > _MAX_UNEXPLAINED:
        return "", "the rates of the gyroscope do not follow the camera's, at any time offset within 100 ms"
    if ratio > _MIN_DEGREES_RATIO:
        return "", (
            f"the gyroscope reads {ratio:.0f} times the camera's rates: in degrees/s, where rad/s are needed"
        )
    if not 1.0 / _MAX_RATE_RATIO < ratio < _MAX_RATE_RATIO:
        return "", f"the gyroscope reads {ratio:.2f} times the camera's rates: is its unit rad/s?"
    if is_mirrored:
        return "axes", "the gyroscope's axes are left-handed: one has the wrong sign, or two are swapped"
    angle = rotation_angle_deg(Q)
    if angle > _MAX_AXES_ERROR_DEG:
        return "axes", (
            f"the axes of the IMU are turned by {angle:.0f} degrees against what T_imu_camera says: "
            "are two of them swapped?"
        )
    if abs(offset_s) > _MAX_USABLE_OFFSET_S:
        return (
            "offset",
            f"the clock of the IMU is {1e3 * offset_s:.0f} ms ahead of the camera's: more than 60 ms off",
        )
    return "", ""
