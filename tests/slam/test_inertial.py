"""The IMU block of a keyframe: round trips, rejected values, and that a false gravity is outvoted."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, exp_se3
from rse_pf.maps.descriptors import ORB
from rse_pf.slam.inertial import (
    InertialMotion,
    KeyframeImu,
    agreed_gravity,
    decode_imu,
    encode_imu,
)
from rse_pf.slam.keyframe import SentKeyframe, decode_keyframe, encode_keyframe, make_features

RNG = np.random.default_rng(4)
ROOT = RNG.normal(size=(9, 9))
MOTION = InertialMotion(
    duration_s=0.35,
    rotation=np.array([0.1, -0.2, 0.05]),
    velocity=np.array([1.0, 2.0, -3.0]),
    position=np.array([0.2, 0.3, -0.5]),
    bias_gyro=np.array([0.01, 0.02, 0.08]),
    bias_accel=np.array([0.1, -0.1, 0.05]),
    covariance=1e-6 * ROOT @ ROOT.T,
)
IMU = KeyframeImu(
    down_camera=np.array([0.0, 0.8, 0.6]),
    deviation_rad=0.004,
    T_imu_camera=exp_se3(np.array([0.1, 0.2, 0.3, 1.0, -2.0, 0.5])),
    motion=MOTION,
)
FIRST_OF_MOTION = 10
"""Index in the float32 numbers of an IMU block at which the motion begins."""


def changed(row: int, value: float, imu: KeyframeImu = IMU) -> bytes:
    data = bytearray(encode_imu(imu))
    struct.pack_into("<f", data, 4 * row, value)
    return bytes(data)


@pytest.mark.parametrize("imu", [IMU, replace(IMU, motion=None)])
def test_what_is_read_is_what_was_written(imu):
    data = encode_imu(imu)

    read = decode_imu(data)

    assert len(data) <= 392
    np.testing.assert_allclose(read.down_camera, imu.down_camera, atol=1e-6)
    np.testing.assert_allclose(read.T_imu_camera, imu.T_imu_camera, atol=1e-6)
    assert (read.motion is None) == (imu.motion is None)
    if read.motion is not None:
        np.testing.assert_allclose(read.motion.velocity, MOTION.velocity, atol=1e-6)
        np.testing.assert_allclose(read.motion.bias_accel, MOTION.bias_accel, atol=1e-6)
        np.testing.assert_allclose(read.motion.covariance, MOTION.covariance, rtol=1e-5)
        np.testing.assert_allclose(read.motion.covariance, read.motion.covariance.T)


@pytest.mark.parametrize(
    ("data", "line"),
    [
        (b"", "0 bytes"),
        (encode_imu(IMU)[:-4], "bytes are neither"),
        (b"\0" * (encode_imu(IMU).__len__() + 1), "bytes are neither"),
        (changed(0, float("nan")), "not finite"),
        (changed(60, float("inf")), "not finite"),
        (changed(1, 5.0), "length"),
        (changed(3, 0.0), "deviation of gravity, 0 rad"),
        (changed(3, 2.0), "deviation of gravity, 2 rad"),
        (changed(5, 50.0), "T_imu_camera"),
        (changed(8, 50.0), "T_imu_camera"),
        (changed(FIRST_OF_MOTION, 0.0), "duration of its motion, 0 s"),
        (changed(FIRST_OF_MOTION, 1e9), "duration of its motion, 1e"),
        (changed(FIRST_OF_MOTION + 4, 1e6), "its motion has a rotation above"),
        (changed(FIRST_OF_MOTION + 10, 1e3), "its motion has a rotation above"),
        (changed(FIRST_OF_MOTION + 16, -1.0), "variance"),
        (changed(FIRST_OF_MOTION + 17, 1.0), "not positive"),
    ],
)
def test_hostile_blocks_are_refused(data, line):
    with pytest.raises(BadRequest, match=line) as caught:
        decode_imu(data)
    assert "\n" not in caught.value.message


def keyframe(imu: KeyframeImu | None) -> SentKeyframe:
    return SentKeyframe(
        timestamp_s=1.0,
        T_odom_camera=np.eye(4),
        camera=Camera(fx=500.0, fy=500.0, cx=319.5, cy=239.5, width=640, height=480),
        features=make_features(np.full((3, 2), 5.0), np.ones(3), np.zeros((3, ORB.size), dtype=np.uint8)),
        imu=imu,
    )


def test_the_block_takes_less_than_400_bytes_of_a_keyframe():
    with_imu, without = encode_keyframe(keyframe(IMU)), encode_keyframe(keyframe(None))

    assert len(with_imu) - len(without) <= 400
    assert decode_keyframe(without).imu is None
    read = decode_keyframe(with_imu)
    assert read.imu is not None
    assert encode_keyframe(read) == with_imu


def tilted(degrees: float, count: int) -> Array:
    rng = np.random.default_rng(count)
    down = exp_se3(np.array([0, 0, 0, np.radians(degrees), 0, 0]))[:3, :3] @ np.array([0.0, 0.0, -1.0])
    noisy = down + 0.005 * rng.normal(size=(count, 3))
    made: Array = noisy / np.linalg.norm(noisy, axis=1)[:, None]
    return made


def test_false_gravity_of_one_robot_is_outvoted_however_many_keyframes_it_has():
    agreed = agreed_gravity([tilted(0.0, 5), tilted(90.0, 500), tilted(0.5, 5)])

    assert agreed is not None
    assert agreed[2] < -0.999
