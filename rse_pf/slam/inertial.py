"""Encode what an IMU measured for a keyframe: the direction of gravity, and the motion before the keyframe.

The motion is that since the previous keyframe of the same segment of the robot's odometry.  Raw samples stay
on the robot.  The content of the IMU block of a keyframe is little-endian; it has 40 bytes without a motion,
and 284 bytes with one::

    gravity   unit vector down in the camera's frame (3 float32), its standard deviation in rad (float32)
    mount     T_imu_camera: rotation vector in rad, translation in metres (6 float32)
    motion    optional: the preintegrated measurement in the axes of the IMU, see `InertialMotion`: duration
              in s, rotation vector in rad, change of velocity in m/s and displacement in m, both without
              gravity (10 float32), biases of gyroscope (rad/s) and accelerometer (m/s^2) that were
              subtracted (6 float32), and the upper triangle, row by row, of the 9x9 covariance of rotation,
              velocity and position (45 float32)

The decoder checks that each number is physically possible.  A plausible but false gravity is outvoted by the
other robots of a map, see `agreed_gravity`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3, log_se3

__all__ = [
    "InertialMotion",
    "KeyframeImu",
    "agreed_gravity",
    "decode_imu",
    "encode_imu",
    "upright_rotation",
]

_GRAVITY_STRUCT = struct.Struct("<4f")
_MOUNT_STRUCT = struct.Struct("<6f")
_MOTION_STRUCT = struct.Struct("<61f")
_TRIANGLE = np.triu_indices(9)
_MIN_GRAVITY_DEVIATION_RAD = 1e-4
"""Smallest accepted standard deviation in radians of a direction of gravity: no IMU is more accurate.  An IMU
block with a smaller one is refused."""
_MAX_GRAVITY_DEVIATION_RAD = 0.35
"""Largest accepted standard deviation in radians of a direction of gravity: beyond 20 degrees it is useless.
An IMU block with a larger one is refused."""
# `decode_imu` refuses a block with a number beyond one of the following limits.
_MAX_ROTATION_RAD = 3.2  # largest accepted length of a rotation vector in radians: pi, and room for rounding
# Longest accepted preintegrated motion in seconds: an IMU drifts too far in a longer time.
_MAX_DURATION_S = 60.0
_MAX_VELOCITY_M_S = 1e3  # largest accepted coordinate of the velocity of a preintegrated motion in m/s
_MAX_POSITION_M = 1e4  # largest accepted coordinate of the position of a preintegrated motion in metres
_MAX_LEVER_ARM_M = 10.0  # largest accepted distance in metres of the IMU from the camera on one robot
_MAX_BIAS = 10.0  # largest accepted bias of a gyroscope in rad/s, or of an accelerometer in m/s^2
_MAX_MOTION_DEVIATION = 1e3
"""Largest standard deviation of a preintegrated rotation (rad), velocity (m/s) or position (m): above it, the
motion says nothing, and its block is refused."""
_MAX_GRAVITY_DIFFERENCE_DEG = 5.0
"""Largest angle in degrees between the directions of gravity of two robots that agree (`agreed_gravity`)."""
_MAX_DIRECTIONS = 200
"""Largest number of directions of gravity whose median is computed; of more, an even selection is taken,
which bounds time and memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InertialMotion:
    """A preintegrated motion in the axes of the IMU, as `client_sdk.imu.preintegration` defines it.

    All vectors are in the axes that the IMU has at the first of the two keyframes.

    Attributes:
        duration_s: Time between the two keyframes.
        rotation: ``(3,)`` rotation vector, rad, of the rotation that maps the axes of the IMU at the second
            keyframe to those at the first.
        velocity: ``(3,)`` change of velocity without gravity, m/s.
        position: ``(3,)`` displacement without gravity and initial velocity, m.
        bias_gyro: ``(3,)`` bias that was subtracted from angular rates, rad/s.
        bias_accel: ``(3,)`` bias that was subtracted from accelerations, m/s^2.
        covariance: ``(9, 9)``, of rotation (rad), velocity (m/s) and position (m), in this order.
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
    """The IMU measurements of one keyframe.

    Attributes:
        down_camera: ``(3,)`` unit vector in the direction of gravity, in the frame of the camera.
        deviation_rad: Standard deviation of this direction.
        T_imu_camera: ``(4, 4)``, maps points from the frame of the camera to that of the IMU, metres.
        motion: The motion since the previous keyframe of the segment, None if it was not measured.
    """

    down_camera: Array
    deviation_rad: float
    T_imu_camera: Array
    motion: InertialMotion | None = None


def encode_imu(imu: KeyframeImu) -> bytes:
    """Return *imu* as the content of the IMU block of a keyframe: 40 bytes, or 284 with a motion."""
    mount = log_se3(imu.T_imu_camera[None])[0]
    data = _GRAVITY_STRUCT.pack(*imu.down_camera, imu.deviation_rad)
    data += _MOUNT_STRUCT.pack(*mount[3:], *imu.T_imu_camera[:3, 3])
    if imu.motion is not None:
        motion = imu.motion
        data += _MOTION_STRUCT.pack(
            motion.duration_s,
            *motion.rotation,
            *motion.velocity,
            *motion.position,
            *motion.bias_gyro,
            *motion.bias_accel,
            *motion.covariance[_TRIANGLE],
        )
    return data


def decode_imu(data: bytes) -> KeyframeImu:
    """Return the IMU measurements that `encode_imu` encoded.

    Raises:
        BadRequest: *data* has another size, a number is not finite, or a value is physically impossible.
    """
    size = _GRAVITY_STRUCT.size + _MOUNT_STRUCT.size
    if len(data) not in (size, size + _MOTION_STRUCT.size):
        raise _bad_block(f"{len(data)} bytes are neither {size} nor {size + _MOTION_STRUCT.size}")
    numbers = np.frombuffer(data, dtype="<f4").astype(np.float64)
    if not np.isfinite(numbers).all():
        raise _bad_block("a number is not finite")
    down, deviation_rad = numbers[:3], float(numbers[3])
    length = float(np.linalg.norm(down))
    if not 0.99 <= length <= 1.01:
        raise _bad_block(f"the direction of gravity has the length {length:.3g}, not 1")
    if not _MIN_GRAVITY_DEVIATION_RAD <= deviation_rad <= _MAX_GRAVITY_DEVIATION_RAD:
        raise _bad_block(
            f"the standard deviation of gravity, {deviation_rad:g} rad, is not within "
            f"{_MIN_GRAVITY_DEVIATION_RAD:g}..{_MAX_GRAVITY_DEVIATION_RAD:g} rad"
        )
    mount_rotation, lever_arm = numbers[4:7], numbers[7:10]
    if not (
        np.linalg.norm(mount_rotation) <= _MAX_ROTATION_RAD and np.linalg.norm(lever_arm) <= _MAX_LEVER_ARM_M
    ):
        raise _bad_block(
            f"T_imu_camera rotates by more than {_MAX_ROTATION_RAD:g} rad, or the camera is more than "
            f"{_MAX_LEVER_ARM_M:g} m from the IMU"
        )
    T_imu_camera = exp_se3(np.concatenate([np.zeros(3), mount_rotation]))
    T_imu_camera[:3, 3] = lever_arm
    return KeyframeImu(
        down_camera=down / length,
        deviation_rad=deviation_rad,
        T_imu_camera=T_imu_camera,
        motion=_decode_motion(numbers[10:]) if len(numbers) > 10 else None,
    )


def agreed_gravity(downs: Sequence[Array]) -> Array | None:
    """Return the direction of gravity ``(3,)`` on which more than half of the robots agree, else None.

    Each robot has one vote, the median of its own directions, so that a robot with many keyframes does not
    outvote others.  Two votes agree if they differ by at most 5 degrees.  The vote that agrees with most
    votes is chosen, the first one of several.  The result is a unit vector: the median of the votes that
    agree with the chosen one (itself included).  The result is None if they are not more than half of all
    votes.

    Args:
        downs: For each robot with an IMU the directions of gravity at its keyframes, unit vectors ``(n, 3)``
            with n >= 1, all in the same world frame; may be empty.
    """
    votes = np.array([_median_direction(directions) for directions in downs]).reshape(-1, 3)
    if not len(votes):
        return None
    agrees = votes @ votes.T >= np.cos(np.radians(_MAX_GRAVITY_DIFFERENCE_DEG))
    best = int(np.argmax(agrees.sum(axis=1)))
    if 2 * int(agrees[best].sum()) <= len(votes):
        return None
    return _median_direction(votes[agrees[best]])


def upright_rotation(down: Array) -> Array:
    """Return the smallest rotation, as ``(4, 4)``, that moves the direction *down* ``(3,)`` to -z.

    *down* may have any length above 0.
    """
    down = down / np.linalg.norm(down)
    axis = np.cross(down, [0.0, 0.0, -1.0])
    sine, cosine = float(np.linalg.norm(axis)), -float(down[2])
    if sine < 1e-12:
        # *down* is parallel to z: no rotation, or half a turn, for which any level axis would do; x is taken.
        return np.diag([1.0, 1.0, 1.0, 1.0] if cosine > 0.0 else [1.0, -1.0, -1.0, 1.0])
    return exp_se3(np.concatenate([np.zeros(3), axis / sine * np.arctan2(sine, cosine)]))


def _median_direction(directions: Array) -> Array:
    """Return the medoid of unit vectors ``(n, 3)``: the one with the smallest sum of angles to the others.

    The medoid is robust: fewer than half of the vectors cannot move it far.  Of more than `_MAX_DIRECTIONS`
    vectors, this number is chosen at equal intervals.
    """
    if len(directions) > _MAX_DIRECTIONS:
        rows = np.linspace(0, len(directions) - 1, _MAX_DIRECTIONS).astype(np.int64)
        directions = directions[rows]
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    median: Array = directions[int(np.argmin(angles.sum(axis=1)))]
    return median


def _decode_motion(numbers: Array) -> InertialMotion:
    """Return the motion of the 61 numbers of its encoding; raises BadRequest if one is impossible."""
    duration_s = float(numbers[0])
    rotation, velocity, position = numbers[1:4], numbers[4:7], numbers[7:10]
    biases = numbers[10:16]
    if not 0.0 < duration_s <= _MAX_DURATION_S:
        raise _bad_block(
            f"the duration of its motion, {duration_s:g} s, is not within 0..{_MAX_DURATION_S:g} s"
        )
    if (
        np.linalg.norm(rotation) > _MAX_ROTATION_RAD
        or np.abs(velocity).max() > _MAX_VELOCITY_M_S
        or np.abs(position).max() > _MAX_POSITION_M
        or np.abs(biases).max() > _MAX_BIAS
    ):
        raise _bad_block(
            f"its motion has a rotation above {_MAX_ROTATION_RAD:g} rad, a velocity above "
            f"{_MAX_VELOCITY_M_S:g} m/s, a displacement above {_MAX_POSITION_M:g} m, or a bias above "
            f"{_MAX_BIAS:g} rad/s or m/s^2"
        )
    covariance = np.zeros((9, 9))
    covariance[_TRIANGLE] = numbers[16:]
    covariance = covariance + np.triu(covariance, 1).T
    diagonal = np.diag(covariance)
    if not (diagonal > 0.0).all() or diagonal.max() > _MAX_MOTION_DEVIATION**2:
        raise _bad_block(f"a variance of its motion is not within 0..{_MAX_MOTION_DEVIATION**2:g}")
    correlation = covariance / np.sqrt(np.outer(diagonal, diagonal))
    if np.linalg.eigvalsh(correlation)[0] < -1e-4:
        raise _bad_block("the covariance of its motion is not positive semidefinite")
    return InertialMotion(
        duration_s=duration_s,
        rotation=rotation,
        velocity=velocity,
        position=position,
        bias_gyro=biases[:3],
        bias_accel=biases[3:],
        covariance=covariance,
    )


def _bad_block(reason: str) -> BadRequest:
    return BadRequest(f"the block of the IMU is refused: {reason}", hint="send what encode_imu returned")
