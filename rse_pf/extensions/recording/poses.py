"""Make messages for Foxglove by its schemas: poses, point clouds and images.

Poses are computed without numpy: the recorder does so for every answer, and numpy takes ten times as long.

Source:
    Foxglove's message schemas PoseInFrame, PointCloud and CompressedImage (docs.foxglove.dev).
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Sequence
from typing import Any

import msgspec

__all__ = ["WORLD_FRAME", "image", "inverse", "point_cloud", "pose_in_frame", "read_answered_pose"]

WORLD_FRAME = "world"
"""Name of the coordinate frame of the points in a robot's commands."""
_FLOAT32 = 7  # number of the type FLOAT32 in Foxglove's NumericType
_NS = 1_000_000_000  # nanoseconds of a second
_POINT_BYTES = 12  # bytes of a point: x, y and z as float32
# Format of `struct` for the numbers of a MessagePack extension of the codec ``bin``, by its type.
_NUMBERS = {1: "f", 3: "d"}
# Size in bytes of a number of a MessagePack extension of ``bin``, by type of the extension.
_NUMBER_BYTES = {1: 4, 3: 8}


class _Pose(msgspec.Struct, frozen=True):
    T_camera_world: list[float] | None = None


class _PoseResult(msgspec.Struct, frozen=True):
    reply: _Pose | None = None


class _BinaryPose(msgspec.Struct, frozen=True):
    T_camera_world: Any = None


class _BinaryPoseResult(msgspec.Struct, frozen=True):
    reply: _BinaryPose | None = None


def _numbers(kind: int, data: memoryview) -> Any:
    code = _NUMBERS.get(kind)
    return None if code is None else struct.unpack(f"<{len(data) // _NUMBER_BYTES[kind]}{code}", data)


_from_json = msgspec.json.Decoder(_PoseResult).decode
_from_binary = msgspec.msgpack.Decoder(_BinaryPoseResult, ext_hook=_numbers).decode


def read_answered_pose(text: bytes, *, is_binary: bool) -> Sequence[float] | None:
    """Return the 16 numbers of ``T_camera_world`` (row-major) of a `pnp` result.

    None if the message holds no such pose, if one of the numbers is not finite, or if it cannot be decoded.

    Args:
        text: The inflated message.
        is_binary: Whether the codec of the message is ``bin``.
    """
    try:
        reply = (_from_binary if is_binary else _from_json)(text).reply
        pose: Any = None if reply is None else reply.T_camera_world
        return pose if pose is not None and len(pose) == 16 and math.isfinite(sum(pose)) else None
    except (msgspec.DecodeError, struct.error, TypeError):
        return None


def pose_in_frame(T_frame_camera: Sequence[float], time_ns: int, frame: str = WORLD_FRAME) -> dict[str, Any]:
    """Return a PoseInFrame message of the camera's pose in *frame*.

    *T_frame_camera* are 16 numbers, row-major, metres; *time_ns* is the Unix time, ns.
    """
    (a, b, c, x, d, e, f, y, g, h, i, z) = T_frame_camera[:12]
    qx, qy, qz, qw = _quaternion((a, b, c, d, e, f, g, h, i))
    return {
        "timestamp": _time(time_ns),
        "frame_id": frame,
        "pose": {
            "position": {"x": x, "y": y, "z": z},
            "orientation": {"x": qx, "y": qy, "z": qz, "w": qw},
        },
    }


def inverse(T: Sequence[float]) -> tuple[float, ...]:
    """Return the inverse of a rigid transform; both are 16 numbers, row-major."""
    (a, b, c, x, d, e, f, y, g, h, i, z) = T[:12]
    return (
        a, d, g, -(a * x + d * y + g * z),
        b, e, h, -(b * x + e * y + h * z),
        c, f, i, -(c * x + f * y + i * z),
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


def point_cloud(points: bytes, time_ns: int, frame: str = WORLD_FRAME) -> dict[str, Any]:
    """Return a PointCloud message of *points*: x, y, z of each point as little-endian float32, metres."""
    names = ("x", "y", "z")
    return {
        "timestamp": _time(time_ns),
        "frame_id": frame,
        "pose": {
            "position": {"x": 0.0, "y": 0.0, "z": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
        "point_stride": _POINT_BYTES,
        "fields": [{"name": name, "offset": 4 * k, "type": _FLOAT32} for k, name in enumerate(names)],
        "data": base64.b64encode(points).decode("ascii"),
    }


def image(jpeg: bytes, time_ns: int, frame: str = "camera") -> dict[str, Any]:
    """Return a CompressedImage message of a JPEG image; *frame* is the coordinate frame of its camera."""
    return {
        "timestamp": _time(time_ns),
        "frame_id": frame,
        "data": base64.b64encode(jpeg).decode("ascii"),
        "format": "jpeg",
    }


def _time(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // _NS, "nsec": time_ns % _NS}


def _quaternion(rotation: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a rotation matrix of nine numbers, row-major.

    Source:
        Shepperd, Quaternion from rotation matrix, 1978: the largest component is computed first.
    """
    a, b, c, d, e, f, g, h, i = rotation
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        w = math.sqrt(max(0.0, 1.0 + trace)) / 2
        s = 1 / (4 * w)
        return (h - f) * s, (c - g) * s, (d - b) * s, w
    if largest == a:
        x = math.sqrt(max(0.0, 1.0 + a - e - i)) / 2
        s = 1 / (4 * x)
        return x, (b + d) * s, (c + g) * s, (h - f) * s
    if largest == e:
        y = math.sqrt(max(0.0, 1.0 - a + e - i)) / 2
        s = 1 / (4 * y)
        return (b + d) * s, y, (f + h) * s, (c - g) * s
    z = math.sqrt(max(0.0, 1.0 - a - e + i)) / 2
    s = 1 / (4 * z)
    return (c + g) * s, (f + h) * s, z, (d - b) * s
