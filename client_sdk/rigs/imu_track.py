"""Attach to each frame of a recording the IMU samples since the frame before it."""

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
    """All samples of the IMU of a recording.

    Attributes:
        timestamps_s: ``(n,)``, strictly ascending, on the clock of the camera: the reader of the recording
            has subtracted `RigCamera.time_offset_s` from the time stamps of the IMU.
        gyro: ``(n, 3)`` angular rates, rad/s, in the frame of the IMU.
        accel: ``(n, 3)`` specific forces, m/s^2, in the frame of the IMU.
        model: Noise, rate and range of the IMU, and its pose relative to the camera.

    Raises:
        UsageError: The shapes do not fit, a number is not finite, or time stamps do not ascend.
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    model: ImuModel

    def __post_init__(self) -> None:
        check_samples(self.timestamps_s, self.gyro, self.accel)

    def between(self, since_s: float, until_s: float) -> ImuSamples:
        """Return the samples from the last at or before *since_s* to the first at or after *until_s*.

        If the track begins after *since_s* or ends before *until_s*, its first or its last sample is the
        limit.
        """
        first = max(0, int(np.searchsorted(self.timestamps_s, since_s, side="right")) - 1)
        end = int(np.searchsorted(self.timestamps_s, until_s, side="left")) + 1
        rows = slice(first, end)
        return ImuSamples(self.timestamps_s[rows], self.gyro[rows], self.accel[rows], self.model)


def with_imu(frames: Iterable[Frame], track: ImuTrack | None) -> Iterator[Frame]:
    """Yield *frames*, each with the IMU samples since the frame before it; unchanged if *track* is None.

    The first frame gets the last sample at or before its own time stamp and the first at or after it.
    """
    previous_s = None
    for frame in frames:
        if track is None:
            yield frame
            continue
        since_s = frame.timestamp_s if previous_s is None else previous_s
        yield replace(frame, imu=track.between(since_s, frame.timestamp_s))
        previous_s = frame.timestamp_s
