"""Samples of a whole recording, and those that a frame takes of them."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.imu.samples import ImuModel
from client_sdk.rigs.imu_track import ImuTrack
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

MODEL = ImuModel(
    T_imu_camera=np.eye(4), gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=10.0
)
TIMES_S = np.arange(5) / 10.0
RATES = np.zeros((5, 3))


def changed(values: Array, row: int, value: float) -> Array:
    values = values.copy()
    values[row] = value
    return values


@pytest.mark.parametrize(
    ("times_s", "gyro", "sentence"),
    [
        (changed(TIMES_S, 3, 0.2), RATES, "do not ascend"),
        (changed(TIMES_S, 3, 0.05), RATES, "do not ascend"),
        (TIMES_S, changed(RATES, 2, np.nan), "not finite"),
        (TIMES_S, RATES[:4], "do not fit"),
    ],
)
def test_a_track_that_cannot_be_searched_is_refused(times_s: Array, gyro: Array, sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        ImuTrack(times_s, gyro, RATES, MODEL)


def test_a_frame_takes_one_sample_before_and_one_after_its_interval() -> None:
    samples = ImuTrack(TIMES_S, RATES, RATES, MODEL).between(0.15, 0.25)

    assert samples.timestamps_s.tolist() == pytest.approx([0.1, 0.2, 0.3])
