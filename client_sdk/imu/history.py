"""Collect the samples of an IMU in the order of time, and return those of an interval.

Only the last five minutes are held, and an interval in which too many samples are missing has no result.
"""

from __future__ import annotations

import numpy as np

from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.geometry import Array

__all__ = ["ImuHistory"]

_KEPT_S = 300.0
"""Samples more than this many seconds before the newest sample are dropped, so that the memory of a long
drive is bounded."""
_MAX_GAP_INTERVALS = 5.0
"""Longest time between two successive samples, in sampling intervals, over which they are interpolated: after
a longer time too many samples are missing, and the motion is unknown."""
_MAX_HOLD_INTERVALS = 1.5
"""Longest time from the newest sample to the end of an interval, in sampling intervals, for which the values
of the newest sample are used at the end: a frame often arrives before the first sample that is later than the
frame."""


class ImuHistory:
    """Samples of the last five minutes, with time stamps on the clock of the IMU.

    ``model`` is the model of the samples that were added last.
    """

    def __init__(self, model: ImuModel) -> None:
        self.model = model
        self._new_parts: list[Array] = []  # arrays ``(n, 7)`` that were added since the last `to_array`
        self._samples: Array = np.empty((0, 7))

    def add(self, samples: ImuSamples) -> None:
        """Append the samples that are later than `last_s`; the others are ignored."""
        self.model = samples.model
        part = np.column_stack([samples.timestamps_s, samples.gyro, samples.accel])
        part = part[part[:, 0] > self.last_s]
        if len(part):
            self._new_parts.append(part)

    @property
    def last_s(self) -> float:
        """Time stamp of the newest sample; minus infinity before the first."""
        if self._new_parts:
            return float(self._new_parts[-1][-1, 0])
        return float(self._samples[-1, 0]) if len(self._samples) else float("-inf")

    def between(self, begin_s: float, end_s: float, shift_s: float = 0.0) -> ImuSamples | None:
        """Return the samples of an interval, with interpolated samples at its begin and end.

        Args:
            begin_s: Begin of the interval on the clock of the camera.
            end_s: End of the interval on the clock of the camera, later than *begin_s*.
            shift_s: Time by which the clock of the IMU is ahead of that of the camera; it is added to both
                times.

        Returns:
            Samples with time stamps on the clock of the IMU.  None if two successive samples of the interval
            are more than 5 sampling intervals apart, if the first known sample is after the begin, if the
            last one is more than 1.5 sampling intervals before the end, or if there are fewer than two.
        """
        samples = self.to_array()
        begin_s, end_s = begin_s + shift_s, end_s + shift_s
        if len(samples) < 2 or not samples[0, 0] <= begin_s < end_s:
            return None
        if end_s > samples[-1, 0] + _MAX_HOLD_INTERVALS / self.model.rate_hz:
            return None
        first = int(np.searchsorted(samples[:, 0], begin_s, side="right")) - 1
        last = int(np.searchsorted(samples[:, 0], end_s, side="left")) + 1
        part = samples[first:last]
        if float(np.diff(part[:, 0]).max(initial=0.0)) > _MAX_GAP_INTERVALS / self.model.rate_hz:
            return None
        inside = part[(part[:, 0] > begin_s) & (part[:, 0] < end_s)]
        first_and_last = np.array(
            [
                [stamp, *(np.interp(stamp, part[:, 0], part[:, axis]) for axis in range(1, 7))]
                for stamp in (begin_s, end_s)
            ]
        )
        interval = np.concatenate([first_and_last[:1], inside, first_and_last[1:]])
        return ImuSamples(interval[:, 0], interval[:, 1:4], interval[:, 4:7], self.model)

    def mean_gyro(self, begins_s: Array, ends_s: Array) -> Array:
        """Return the mean angular rates ``(n, 3)`` of n intervals, rad/s, in the IMU's frame.

        *begins_s* and *ends_s* ``(n,)`` are on the clock of the IMU.  The part of an interval before the
        first sample or after the last sample counts with a rate of 0.
        """
        samples = self.to_array()
        dt = np.diff(samples[:, 0])[:, None]
        integral = np.concatenate(
            [np.zeros((1, 3)), np.cumsum(0.5 * dt * (samples[1:, 1:4] + samples[:-1, 1:4]), axis=0)]
        )
        at_begins, at_ends = (
            np.stack([np.interp(stamps, samples[:, 0], integral[:, axis]) for axis in range(3)], axis=1)
            for stamps in (begins_s, ends_s)
        )
        rates: Array = (at_ends - at_begins) / (ends_s - begins_s)[:, None]
        return rates

    def mean_accel(self) -> Array | None:
        """Return the mean ``(3,)`` of all specific forces in the IMU's frame, m/s^2; None without samples."""
        samples = self.to_array()
        return samples[:, 4:7].mean(axis=0) if len(samples) else None

    def to_array(self) -> Array:
        """Return all samples ``(n, 7)``: time (s), angular rates (rad/s), specific forces (m/s^2).

        Samples more than five minutes before the newest are dropped.  The array is not a copy.
        """
        if self._new_parts:
            self._samples = np.concatenate([self._samples, *self._new_parts])
            self._new_parts = []
            oldest = int(np.searchsorted(self._samples[:, 0], self._samples[-1, 0] - _KEPT_S))
            self._samples = self._samples[oldest:]
        return self._samples
