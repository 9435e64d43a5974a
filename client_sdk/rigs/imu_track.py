"""All samples of an IMU of a recording or a device, from which each frame takes those since the last one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from client_sdk.frontend import Frame
from client_sdk.imu.samples import ImuModel, ImuSamples, check_samples
from rse_pf.geometry import Array

__all__ = ["ImuTrack", "with_imu"]


@dataclass(frozen=True, slots=True, eq=False)
class ImuTrack:
    """Samples on the clock of the camera: ``(n,)`` seconds, ``(n, 3)`` rad/s and m/s^2, and the model.

    Raises:
        UsageError: The shapes do not fit, a number is not finite, or times do not ascend.
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    model: ImuModel

    def __post_init__(self) -> None:
        check_samples(self.timestamps_s, self.gyro, self.accel)

    def between(self, since_s: float, until_s: float) -> ImuSamples:
        """Return the samples from one at or before *since_s* to one at or after *until_s*."""
        first = max(0, int(np.searchsorted(self.timestamps_s, since_s, side="right")) - 1)
        last = int(np.searchsorted(self.timestamps_s, until_s, side="left")) + 1
        rows = slice(first, last)
        return ImuSamples(self.timestamps_s[rows], self.gyro[rows], self.accel[rows], self.model)


def with_imu(frames: Iterable[Frame], track: ImuTrack | None) -> Iterator[Frame]:
    """Yield frames, each with the samples since the one before it; None leaves them as they are."""
    last_s = None
    for frame in frames:
        if track is None:
            yield frame
            continue
        yield replace(
            frame, imu=track.between(frame.timestamp_s if last_s is None else last_s, frame.timestamp_s)
        )
        last_s = frame.timestamp_s
