"""The samples of an IMU in the order of time, and those of any interval."""

from __future__ import annotations

import numpy as np

from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.geometry import Array

__all__ = ["ImuHistory"]

_KEPT_S = 300.0
_LONGEST_GAP = 5.0
"""Samples that are so many intervals apart have others missing between them."""


class ImuHistory:
    """The samples of the last five minutes; ``model`` is that of the last ones."""

    def __init__(self, model: ImuModel) -> None:
        self.model = model
        self._parts: list[Array] = []
        self._rows: Array = np.empty((0, 7))

    def add(self, samples: ImuSamples) -> None:
        """Take the samples of a frame; those that are known already are left out."""
        self.model = samples.model
        rows = np.column_stack([samples.timestamps_s, samples.gyro, samples.accel])
        rows = rows[rows[:, 0] > self.last_s]
        if len(rows):
            self._parts.append(rows)

    @property
    def last_s(self) -> float:
        """The time of the newest sample; minus infinity before the first."""
        if self._parts:
            return float(self._parts[-1][-1, 0])
        return float(self._rows[-1, 0]) if len(self._rows) else float("-inf")

    def between(self, begin_s: float, end_s: float, shift_s: float = 0.0) -> ImuSamples | None:
        """Return the samples of an interval, interpolated at its ends; None if it is not covered.

        Args:
            begin_s: On the clock of the camera.
            end_s: Later than *begin_s*.
            shift_s: Added to the interval, to get that on the clock of the IMU.
        """
        rows = self.rows()
        begin_s, end_s = begin_s + shift_s, end_s + shift_s
        if len(rows) < 2 or not rows[0, 0] <= begin_s < end_s:
            return None
        # The last sample may be one interval before the last frame: its rates are held until then.
        if end_s > rows[-1, 0] + 1.5 / self.model.rate_hz:
            return None
        first = int(np.searchsorted(rows[:, 0], begin_s, side="right")) - 1
        last = int(np.searchsorted(rows[:, 0], end_s, side="left")) + 1
        part = rows[first:last]
        if float(np.diff(part[:, 0]).max(initial=0.0)) > _LONGEST_GAP / self.model.rate_hz:
            return None
        inside = part[(part[:, 0] > begin_s) & (part[:, 0] < end_s)]
        ends = np.array(
            [[stamp, *(np.interp(stamp, part[:, 0], part[:, axis]) for axis in range(1, 7))]
             for stamp in (begin_s, end_s)]
        )  # fmt: skip
        found = np.concatenate([ends[:1], inside, ends[1:]])
        return ImuSamples(found[:, 0], found[:, 1:4], found[:, 4:7], self.model)

    def mean_gyro(self, begins_s: Array, ends_s: Array) -> Array:
        """Return the mean rates ``(n, 3)`` of intervals on the clock of the IMU, rad/s."""
        rows = self.rows()
        dt = np.diff(rows[:, 0])[:, None]
        turned = np.concatenate(
            [np.zeros((1, 3)), np.cumsum(0.5 * dt * (rows[1:, 1:4] + rows[:-1, 1:4]), axis=0)]
        )
        both = [
            np.stack([np.interp(stamps, rows[:, 0], turned[:, axis]) for axis in range(3)], axis=1)
            for stamps in (begins_s, ends_s)
        ]
        rates: Array = (both[1] - both[0]) / (ends_s - begins_s)[:, None]
        return rates

    def mean_accel(self) -> Array | None:
        """Return the mean ``(3,)`` of all accelerations, m/s^2; None without samples."""
        rows = self.rows()
        return rows[:, 4:7].mean(axis=0) if len(rows) else None

    def rows(self) -> Array:
        """Return all samples ``(n, 7)``: time, rates, accelerations."""
        if self._parts:
            self._rows = np.concatenate([self._rows, *self._parts])
            self._parts = []
            oldest = int(np.searchsorted(self._rows[:, 0], self._rows[-1, 0] - _KEPT_S))
            self._rows = self._rows[oldest:]
        return self._rows
