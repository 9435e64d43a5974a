"""Maps as values (keyframes, edges, a point cloud) and their encoding as bytes.

`decode_map` returns complete and validated maps only and executes nothing it reads.  The same map always
gives the same bytes.

Format: ``RSEMAP1\\n``, then one MessagePack map, zlib-compressed; arrays are raw little-endian bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, RsePfError
from rse_pf.geometry import Array, Camera

__all__ = ["Edge", "EdgeKind", "Keyframe", "MapVersion", "decode_map", "encode_map"]

EdgeKind = Literal["odometry", "loop", "merge"]

_MAGIC = b"RSEMAP1\n"
_MAX_BYTES = 1 << 30
_DESCRIPTOR_BYTES = 32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """One image of a map, as features.

    Attributes:
        id: Unique in its map.
        T_world_camera: ``(4, 4)`` float64, metres.
        pixels: ``(n, 2)`` float32, undistorted.
        descriptors: ``(n, 32)`` uint8.
        points_camera: ``(n, 3)`` float32 metres, camera frame; NaN rows where there is no depth.

    Raises:
        BadRequest: Shapes do not fit, or a number is not finite where it must be.
    """

    id: int
    robot: str
    timestamp_s: float
    T_world_camera: Array
    camera: Camera
    pixels: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]
    points_camera: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.pixels)
        if not (
            self.pixels.shape == (n, 2)
            and self.descriptors.shape == (n, _DESCRIPTOR_BYTES)
            and self.points_camera.shape == (n, 3)
        ):
            raise BadRequest(f"the arrays of keyframe {self.id} do not fit", hint="one row for each feature")
        if not (np.isfinite(self.pixels).all() and np.isfinite(self.timestamp_s)):
            raise BadRequest(f"keyframe {self.id} holds a number that is not finite", hint="leave it out")
        _check_pose(f"keyframe {self.id}", self.T_world_camera)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """A measured relative pose ``T_a_b`` between the keyframes with ids *a* and *b*.

    ``information`` is the ``(6, 6)`` inverse covariance of the twist (rho metres, phi radians) in
    ``log(inverse(T_a_b) @ inverse(T_world_a) @ T_world_b)``.
    """

    a: int
    b: int
    T_a_b: Array
    information: Array
    kind: EdgeKind = "odometry"

    def __post_init__(self) -> None:
        _check_pose(f"edge {self.a}-{self.b}", self.T_a_b)
        if self.information.shape != (6, 6) or not np.isfinite(self.information).all():
            raise BadRequest(f"edge {self.a}-{self.b} has no (6, 6) information", hint="invert a covariance")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapVersion:
    """A complete map: immutable, a change makes a new version.

    ``points`` ``(m, 3)`` float32 metres, world frame; ``colours`` ``(m, 3)`` uint8.
    """

    keyframes: tuple[Keyframe, ...]
    edges: tuple[Edge, ...] = ()
    points: npt.NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    colours: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), dtype=np.uint8))
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ids = {keyframe.id for keyframe in self.keyframes}
        if len(ids) != len(self.keyframes):
            raise BadRequest("two keyframes of a map have one id", hint="assign unique ids")
        dangling = next((edge for edge in self.edges if edge.a not in ids or edge.b not in ids), None)
        if dangling is not None:
            raise BadRequest(
                f"edge {dangling.a}-{dangling.b} names a missing keyframe", hint="add the keyframe"
            )
        m = len(self.points)
        if self.points.shape != (m, 3) or self.colours.shape != (m, 3) or not np.isfinite(self.points).all():
            raise BadRequest("points and colours of a map do not fit", hint="send (m, 3) of both")


class _Keyframe(msgspec.Struct, frozen=True, kw_only=True):
    id: int
    robot: str
    timestamp_s: float
    pose: bytes
    camera: Camera
    pixels: bytes
    descriptors: bytes
    points: bytes


class _Edge(msgspec.Struct, frozen=True, kw_only=True):
    a: int
    b: int
    step: bytes
    information: bytes
    kind: EdgeKind


class _Map(msgspec.Struct, frozen=True, kw_only=True):
    keyframes: list[_Keyframe]
    edges: list[_Edge]
    points: bytes
    colours: bytes
    provenance: dict[str, Any]


def encode_map(version: MapVersion) -> bytes:
    """Return *version* as bytes; the same map gives the same bytes."""
    packed = _Map(
        keyframes=[
            _Keyframe(
                id=k.id, robot=k.robot, timestamp_s=k.timestamp_s, pose=_raw(k.T_world_camera, "<f8"),
                camera=k.camera, pixels=_raw(k.pixels, "<f4"), descriptors=_raw(k.descriptors, "u1"),
                points=_raw(k.points_camera, "<f4"),
            )
            for k in version.keyframes
        ],
        edges=[
            _Edge(
                a=e.a, b=e.b, step=_raw(e.T_a_b, "<f8"), information=_raw(e.information, "<f8"), kind=e.kind
            )
            for e in version.edges
        ],
        points=_raw(version.points, "<f4"),
        colours=_raw(version.colours, "u1"),
        provenance=dict(version.provenance),
    )  # fmt: skip
    return _MAGIC + zlib.compress(msgspec.msgpack.encode(packed, order="deterministic"), 1)


def decode_map(data: bytes, max_bytes: int = _MAX_BYTES) -> MapVersion:
    """Return the map of *data*.

    Raises:
        BadRequest: The bytes are not a map, are damaged, or hold more than *max_bytes*.
    """
    if data[: len(_MAGIC)] != _MAGIC:
        raise BadRequest("these bytes are not a map", hint="send what encode_map returned")
    try:
        inflater = zlib.decompressobj()
        raw = inflater.decompress(data[len(_MAGIC) :], max_bytes)
        if not inflater.eof:
            raise BadRequest(
                f"the map is truncated, or holds more than {max_bytes} bytes",
                hint="send the complete map, or fewer points",
            )
        packed = msgspec.msgpack.decode(raw, type=_Map)
        return MapVersion(
            keyframes=tuple(_keyframe(each) for each in packed.keyframes),
            edges=tuple(
                Edge(
                    a=e.a, b=e.b, T_a_b=_array(e.step, "<f8", (4, 4)),
                    information=_array(e.information, "<f8", (6, 6)), kind=e.kind,
                )
                for e in packed.edges
            ),
            points=_array(packed.points, "<f4", (-1, 3)),
            colours=_array(packed.colours, "u1", (-1, 3)),
            provenance=packed.provenance,
        )  # fmt: skip
    except (zlib.error, msgspec.MsgspecError, ValueError) as error:
        if isinstance(error, RsePfError):
            raise
        raise BadRequest(f"the map is damaged: {error}", hint="fetch it again") from error


def _keyframe(k: _Keyframe) -> Keyframe:
    return Keyframe(
        id=k.id, robot=k.robot, timestamp_s=k.timestamp_s, T_world_camera=_array(k.pose, "<f8", (4, 4)),
        camera=k.camera, pixels=_array(k.pixels, "<f4", (-1, 2)),
        descriptors=_array(k.descriptors, "u1", (-1, _DESCRIPTOR_BYTES)),
        points_camera=_array(k.points, "<f4", (-1, 3)),
    )  # fmt: skip


def _raw(array: npt.NDArray[Any], kind: str) -> bytes:
    return np.ascontiguousarray(array, dtype=np.dtype(kind)).tobytes()


def _array(raw: bytes, kind: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    return np.frombuffer(raw, dtype=np.dtype(kind)).reshape(shape)


def _check_pose(what: str, T: Array) -> None:
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1]):
        raise BadRequest(f"{what} has no rigid pose", hint="send (4, 4) matrices of finite numbers")
    rotation = T[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise BadRequest(f"{what} holds a matrix that is not a rotation", hint="orthonormalise it")
