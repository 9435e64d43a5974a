"""What an IMU tells of a keyframe: where down is, and the motion since the previous keyframe of the segment.

Raw samples stay on the robot.  The content of the block, little-endian, 40 or 284 bytes::

    gravity   unit vector down in the frame of the camera (3 float32), deviation in rad (float32)
    mount     T_imu_camera: rotation vector, translation in metres (6 float32)
    motion    optional: duration in s, rotation vector, velocity, position (10 float32), biases of gyroscope
              and accelerometer that were subtracted (6 float32), and the upper triangle, row by row, of the
              covariance of rotation, velocity, position (45 float32): preintegrated, in the axes of the IMU

Every number is judged: false gravity of one robot is judged again by what others say.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3, log_se3

__all__ = ["InertialMotion", "KeyframeImu", "agreed_gravity", "decode_imu", "encode_imu", "upright_turn"]

_GRAVITY, _MOUNT, _MOTION = struct.Struct("<4f"), struct.Struct("<6f"), struct.Struct("<61f")
_TRIANGLE = np.triu_indices(9)
_LEAST_RAD, _MOST_RAD = 1e-4, 0.35
_MOST_S, _MOST_M_S, _MOST_M, _MOST_ARM_M = 60.0, 1e3, 1e4, 10.0
_MOST_BIAS = 10.0
_MOST_DEVIATION = 1e3
_AGREE_DEG = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InertialMotion:
    """A preintegrated motion in the axes of the IMU, as `client_sdk.imu.preintegration` defines it.

    ``rotation`` ``(3,)`` is a rotation vector; ``covariance`` ``(9, 9)`` is of rotation, velocity, position.
    """

    duration_s: float
    rotation: Array
    velocity: Array
    position: Array
    bias_gyro: Array
    bias_accel: Array
    covariance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeImu:
    """``down_camera`` ``(3,)`` is a unit vector in the frame of the camera, with its deviation in rad."""

    down_camera: Array
    deviation_rad: float
    T_imu_camera: Array
    motion: InertialMotion | None = None


def encode_imu(imu: KeyframeImu) -> bytes:
    """Return the content of a block."""
    mount = log_se3(imu.T_imu_camera[None])[0]
    data = _GRAVITY.pack(*imu.down_camera, imu.deviation_rad)
    data += _MOUNT.pack(*mount[3:], *imu.T_imu_camera[:3, 3])
    if imu.motion is not None:
        motion = imu.motion
        data += _MOTION.pack(
            motion.duration_s, *motion.rotation, *motion.velocity, *motion.position, *motion.bias_gyro,
            *motion.bias_accel, *motion.covariance[_TRIANGLE],
        )  # fmt: skip
    return data


def decode_imu(data: bytes) -> KeyframeImu:
    """Return what `encode_imu` encoded.

    Raises:
        BadRequest: The size is another one, or a number is not finite or absurd.
    """
    least = _GRAVITY.size + _MOUNT.size
    if len(data) not in (least, least + _MOTION.size):
        raise _refusal(f"{len(data)} bytes are neither {least} nor {least + _MOTION.size}")
    numbers = np.frombuffer(data, dtype="<f4").astype(np.float64)
    if not np.isfinite(numbers).all():
        raise _refusal("a number is not finite")
    down, deviation_rad = numbers[:3], float(numbers[3])
    length = float(np.linalg.norm(down))
    if not 0.99 <= length <= 1.01:
        raise _refusal(f"gravity has the length {length:.3g}, not 1")
    if not _LEAST_RAD <= deviation_rad <= _MOST_RAD:
        raise _refusal(f"a gravity with a deviation of {deviation_rad:g} rad tells nothing")
    turned, arm = numbers[4:7], numbers[7:10]
    if not (np.linalg.norm(turned) <= 3.2 and np.linalg.norm(arm) <= _MOST_ARM_M):
        raise _refusal("T_imu_camera is absurd")
    T_imu_camera = exp_se3(np.concatenate([np.zeros(3), turned]))
    T_imu_camera[:3, 3] = arm
    return KeyframeImu(
        down_camera=down / length, deviation_rad=deviation_rad, T_imu_camera=T_imu_camera,
        motion=_motion(numbers[10:]) if len(numbers) > 10 else None,
    )  # fmt: skip


def agreed_gravity(downs: Sequence[Array]) -> Array | None:
    """Return the ``(3,)`` direction on which more than half of the robots agree; None if there is none.

    Args:
        downs: For each robot unit vectors ``(n, 3)``, n >= 1, in one world.  A robot has one vote, the
            direction in the middle of its own, so that none outweighs others by many keyframes.
    """
    votes = np.array([_middle(each) for each in downs]).reshape(-1, 3)
    if not len(votes):
        return None
    agree = votes @ votes.T >= np.cos(np.radians(_AGREE_DEG))
    best = int(np.argmax(agree.sum(axis=1)))
    if 2 * int(agree[best].sum()) <= len(votes):
        return None
    return _middle(votes[agree[best]])


def upright_turn(down: Array) -> Array:
    """Return the smallest rotation ``(4, 4)`` of a world after which *down* ``(3,)`` points along -z."""
    down = down / np.linalg.norm(down)
    axis = np.cross(down, [0.0, 0.0, -1.0])
    sine, cosine = float(np.linalg.norm(axis)), -float(down[2])
    if sine < 1e-12:  # nothing to turn, or half a turn about any level axis
        return np.diag([1.0, 1.0, 1.0, 1.0] if cosine > 0.0 else [1.0, -1.0, -1.0, 1.0])
    return exp_se3(np.concatenate([np.zeros(3), axis / sine * np.arctan2(sine, cosine)]))


def _middle(directions: Array) -> Array:
    """Return the one of unit vectors ``(n, 3)`` that is nearest to all: half of them cannot move it far."""
    if len(directions) > 200:
        directions = directions[np.linspace(0, len(directions) - 1, 200).astype(np.int64)]
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    middle: Array = directions[int(np.argmin(angles.sum(axis=1)))]
    return middle


def _motion(numbers: Array) -> InertialMotion:
    duration_s, rotation, velocity, position = float(numbers[0]), numbers[1:4], numbers[4:7], numbers[7:10]
    biases = numbers[10:16]
    if not 0.0 < duration_s <= _MOST_S:
        raise _refusal(f"a motion of {duration_s:g} s is not within 0..{_MOST_S:g} s")
    if (
        np.linalg.norm(rotation) > 3.2
        or np.abs(velocity).max() > _MOST_M_S
        or np.abs(position).max() > _MOST_M
        or np.abs(biases).max() > _MOST_BIAS
    ):
        raise _refusal("its motion is absurd")
    covariance = np.zeros((9, 9))
    covariance[_TRIANGLE] = numbers[16:]
    covariance = covariance + np.triu(covariance, 1).T
    diagonal = np.diag(covariance)
    if not (diagonal > 0.0).all() or diagonal.max() > _MOST_DEVIATION**2:
        raise _refusal("its covariance is not positive, or absurd")
    scaled = covariance / np.sqrt(np.outer(diagonal, diagonal))
    if np.linalg.eigvalsh(scaled)[0] < -1e-4:
        raise _refusal("its covariance is not positive")
    return InertialMotion(
        duration_s=duration_s, rotation=rotation, velocity=velocity, position=position,
        bias_gyro=biases[:3], bias_accel=biases[3:], covariance=covariance,
    )  # fmt: skip


def _refusal(why: str) -> BadRequest:
    return BadRequest(f"the block of the IMU is refused: {why}", hint="send what encode_imu returned")
