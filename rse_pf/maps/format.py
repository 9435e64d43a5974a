"""Maps as values (keyframes, edges, a point cloud) and their encoding as bytes.

`decode_map` returns complete and validated maps only and executes nothing it reads.  Sizes and counts are
judged on the bytes, before any object is made.  The same map always gives the same bytes.

Format: ``RSEMAP1\\n``, then one MessagePack map, zlib-compressed; arrays are raw little-endian bytes.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.budget import (
    LIST_VALUES,
    MAP_VALUES,
    PROVENANCE,
    Budget,
    announced_values,
    inflate_within,
    measure_msgpack,
    small_text,
)
from rse_pf.errors import BadMessage, BadRequest, LimitExceeded, RsePfError, message_of
from rse_pf.geometry import Array, Camera, rigid
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors, one_kind

__all__ = [
    "UP",
    "UP_FIELD",
    "Edge",
    "EdgeKind",
    "Keyframe",
    "MapLimits",
    "MapVersion",
    "decode_map",
    "encode_map",
]

EdgeKind = Literal["odometry", "loop", "merge"]

UP_FIELD = "up"
"""Field of the provenance of a map whose gravity is known: the direction against it, in the world."""
UP = (0.0, 0.0, 1.0)
"""That of maps that were turned, so that their z points up."""

_MAGIC = b"RSEMAP1\n"
_MAX_BYTES = 1 << 30
_MAX_RATIO, _FREE_BYTES = 50.0, 1 << 20
"""Features and clouds deflate to half their size; only empty or hostile maps deflate to a fiftieth."""
_MAX_ID = 2**63 - 1
_MAX_NAME = 64
_MAX_NUMBER, _MAX_TIME_S, _MAX_PIXEL, _MAX_INFORMATION = 1e9, 1e12, 1e5, 1e18
"""Metres or pixels, and seconds: larger numbers overflow in what computes with them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLimits:
    """How much a map may hold; one with more is refused before it is decoded.

    ``keyframe_features`` is the limit of one keyframe, ``features`` that of all together.
    """

    keyframes: int = 20_000
    keyframe_features: int = 20_000
    features: int = 5_000_000
    edges: int = 100_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """One image of a map, as features.

    Attributes:
        id: Unique in its map.
        T_world_camera: ``(4, 4)`` float64, metres.
        pixels: ``(n, 2)`` float32, undistorted.
        descriptors: ``(n, d)`` uint8 or int8, of one kind in a map.
        points_camera: ``(n, 3)`` float32 metres, camera frame; NaN rows where there is no depth.
        kind: Of the descriptors.

    Raises:
        BadRequest: Shapes do not fit, or a number is not finite where it must be.
    """

    id: int
    robot: str
    timestamp_s: float
    T_world_camera: Array
    camera: Camera
    pixels: npt.NDArray[np.float32]
    descriptors: Descriptors
    points_camera: npt.NDArray[np.float32]
    kind: DescriptorKind = ORB

    def __post_init__(self) -> None:
        n = len(self.pixels)
        if not (
            self.pixels.shape == (n, 2)
            and len(self.descriptors) == n
            and self.kind.describes(self.descriptors)
            and self.points_camera.shape == (n, 3)
        ):
            raise BadRequest(f"the arrays of keyframe {self.id} do not fit", hint="one row for each feature")
        if not (0 <= self.id <= _MAX_ID and len(self.robot) <= _MAX_NAME):
            raise BadRequest(
                f"the id {self.id} is not within 0..2**63-1, or the robot's name longer than {_MAX_NAME}",
                hint="number keyframes from 0",
            )
        if not (abs(self.timestamp_s) <= _MAX_TIME_S and _is_bounded(self.pixels, _MAX_PIXEL)):
            raise BadRequest(
                f"keyframe {self.id} holds a number that is not finite, or absurd", hint="leave it out"
            )
        # Frozen from here on.
        object.__setattr__(self, "T_world_camera", _checked_pose(f"keyframe {self.id}", self.T_world_camera))


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
        object.__setattr__(self, "T_a_b", _checked_pose(f"edge {self.a}-{self.b}", self.T_a_b))
        if self.information.shape != (6, 6) or not (np.abs(self.information) <= _MAX_INFORMATION).all():
            raise BadRequest(f"edge {self.a}-{self.b} has no (6, 6) information", hint="invert a covariance")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapVersion:
    """A complete map: immutable, a change makes a new version.

    ``points`` ``(m, 3)`` float32 metres, world frame; ``colours`` ``(m, 3)`` uint8.

    Raises:
        BadRequest: Two keyframes have one id or features of two kinds, an edge leads nowhere, or points and
            colours do not fit.
    """

    keyframes: tuple[Keyframe, ...]
    edges: tuple[Edge, ...] = ()
    points: npt.NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    colours: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), dtype=np.uint8))
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> DescriptorKind:
        """Of the descriptors of all keyframes; ORB without any."""
        return self.keyframes[0].kind if self.keyframes else ORB

    @property
    def up(self) -> Array | None:
        """The ``(3,)`` unit vector against gravity, in the world; None where gravity is not known."""
        told = self.provenance.get(UP_FIELD)
        if not isinstance(told, list) or len(told) != 3 or not all(type(each) is float for each in told):
            return None
        up = np.array(told)
        length = float(np.linalg.norm(up))
        return up / length if 0.99 <= length <= 1.01 else None

    def __post_init__(self) -> None:
        ids = {keyframe.id for keyframe in self.keyframes}
        if len(ids) != len(self.keyframes):
            raise BadRequest("two keyframes of a map have one id", hint="assign unique ids")
        one_kind((keyframe.kind for keyframe in self.keyframes), "the map")
        dangling = next((edge for edge in self.edges if edge.a not in ids or edge.b not in ids), None)
        if dangling is not None:
            raise BadRequest(
                f"edge {dangling.a}-{dangling.b} names a missing keyframe", hint="add the keyframe"
            )
        m = len(self.points)
        if self.points.shape != (m, 3) or self.colours.shape != (m, 3) or not _is_bounded(self.points):
            raise BadRequest("points and colours of a map do not fit", hint="send (m, 3) of both")


class _Keyframe(msgspec.Struct, frozen=True, kw_only=True):
    id: int
    robot: str
    timestamp_s: float
    pose: bytes
    camera: Camera
    pixels: memoryview
    descriptors: memoryview
    points: memoryview


class _Edge(msgspec.Struct, frozen=True, kw_only=True):
    a: int
    b: int
    step: bytes
    information: bytes
    kind: EdgeKind


class _Kind(msgspec.Struct, frozen=True, array_like=True):
    name: str
    dtype: str
    size: int


class _Map(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    keyframes: list[_Keyframe]
    edges: list[_Edge]
    points: memoryview
    colours: memoryview
    provenance: msgspec.Raw
    features: _Kind | None = None
    """None for ORB."""


def encode_map(version: MapVersion) -> bytes:
    """Return *version* as bytes; the same map gives the same bytes."""
    kind = version.kind
    packed = _Map(
        keyframes=[
            _Keyframe(
                id=k.id, robot=k.robot, timestamp_s=k.timestamp_s, pose=_raw(k.T_world_camera, "<f8"),
                camera=k.camera, pixels=_view(k.pixels, "<f4"), descriptors=_view(k.descriptors, kind.dtype),
                points=_view(k.points_camera, "<f4"),
            )
            for k in version.keyframes
        ],
        edges=[
            _Edge(
                a=e.a, b=e.b, step=_raw(e.T_a_b, "<f8"), information=_raw(e.information, "<f8"), kind=e.kind
            )
            for e in version.edges
        ],
        points=_view(version.points, "<f4"),
        colours=_view(version.colours, "u1"),
        provenance=msgspec.Raw(msgspec.msgpack.encode(dict(version.provenance), order="deterministic")),
        features=None if kind == ORB else _Kind(kind.name, kind.dtype, kind.size),
    )  # fmt: skip
    return _MAGIC + zlib.compress(msgspec.msgpack.encode(packed, order="deterministic"), 1)


def decode_map(data: bytes, max_bytes: int = _MAX_BYTES, limits: MapLimits | None = None) -> MapVersion:
    """Return the map of *data*, whose arrays share the memory of the inflated bytes.

    The provenance is decoded when it is first asked for, and raises BadRequest then if it is damaged.

    Args:
        data: What `encode_map` returned, or a stranger's bytes.
        max_bytes: Size of the inflated map.
        limits: Counts that it may hold; None means the defaults.

    Raises:
        BadRequest: The bytes are not a map, are damaged, or hold more than *max_bytes*.
        LimitExceeded: The map holds more than *limits* allow.
    """
    limits = limits or MapLimits()
    text = _inflated(data, max_bytes)
    try:
        _check_sections(text, limits)
        packed = msgspec.msgpack.decode(memoryview(text).toreadonly(), type=_Map)
        named = packed.features
        kind = ORB if named is None else DescriptorKind(named.name, named.dtype, named.size)
        _check_features(packed.keyframes, limits, kind.size)
        return MapVersion(
            keyframes=tuple(_keyframe(each, kind) for each in packed.keyframes),
            edges=tuple(
                Edge(
                    a=e.a, b=e.b, T_a_b=_array(e.step, "<f8", (4, 4)),
                    information=_array(e.information, "<f8", (6, 6)), kind=e.kind,
                )
                for e in packed.edges
            ),
            points=_array(packed.points, "<f4", (-1, 3)),
            colours=_array(packed.colours, "u1", (-1, 3)),
            provenance=_Provenance(bytes(packed.provenance)),
        )  # fmt: skip
    except (msgspec.MsgspecError, ValueError, RecursionError, BadMessage) as error:
        if isinstance(error, RsePfError) and not isinstance(error, BadMessage):
            raise
        raise BadRequest(f"the map is damaged: {message_of(error)}", hint="fetch it again") from error


def _inflated(data: bytes, max_bytes: int) -> bytes | bytearray:
    if data[: len(_MAGIC)] != _MAGIC:
        raise BadRequest("these bytes are not a map", hint="send what encode_map returned")
    budget = Budget(
        wire_bytes=max_bytes, inflated_bytes=max_bytes, inflate_ratio=_MAX_RATIO, free_bytes=_FREE_BYTES,
        depth=0, containers=0, values=0, mixed_values=0, memory_bytes=max_bytes,
    )  # fmt: skip
    try:
        return inflate_within(data[len(_MAGIC) :], budget)
    except LimitExceeded as error:
        raise BadRequest(f"the map: {error.message}", hint="send fewer points") from error
    except BadMessage as error:
        raise BadRequest(f"the map is truncated or damaged: {error.message}", hint="send it again") from error


def _check_sections(text: bytes | bytearray, limits: MapLimits) -> None:
    """Check the counts of each field of an encoded map, which is one MessagePack map."""
    count, at, names = announced_values(text, 0), 1, set()
    if not 0x80 <= text[0] <= 0x8F:
        raise BadMessage("it is not a map of fields")
    for _ in range(count // 2):
        name, at = small_text(text, at)
        if name in names:
            raise BadMessage(f"the field {name!r} is there twice")
        names.add(name)
        items = announced_values(text, at)
        if name in _ITEM_VALUES and items > getattr(limits, name):
            raise LimitExceeded(
                f"a map of {items} {name} is above {getattr(limits, name)}", hint="split the map"
            )
        if name == "provenance" and not (0x80 <= text[at] < 0x90 or text[at] in (0xDE, 0xDF)):
            raise BadMessage("its provenance is not a map")
        begin, at = at, measure_msgpack(text, at, _budget_of(name, items))
        if name == "provenance" and at - begin > PROVENANCE.wire_bytes:
            raise LimitExceeded(
                f"a provenance of {at - begin} bytes is above {PROVENANCE.wire_bytes}", hint="leave it out"
            )


_ITEM_VALUES = {"keyframes": 100, "edges": 40}
"""Values of one item of a list, beyond what the format has today, so that fields may be added."""
_OTHER_FIELD = 1000


def _budget_of(name: str, items: int) -> Budget:
    """Return the budget of a field whose value announces *items* items."""
    if name == "provenance":
        return PROVENANCE
    values = LIST_VALUES + items * _ITEM_VALUES[name] if name in _ITEM_VALUES else _OTHER_FIELD
    containers = 1 + values // MAP_VALUES
    return Budget(
        wire_bytes=_MAX_BYTES, inflated_bytes=_MAX_BYTES, inflate_ratio=_MAX_RATIO, free_bytes=_FREE_BYTES,
        depth=4, containers=containers, values=values, mixed_values=values, memory_bytes=_MAX_BYTES,
    )  # fmt: skip


def _check_features(keyframes: list[_Keyframe], limits: MapLimits, descriptor_bytes: int) -> None:
    total = 0
    for each in keyframes:
        count = max(len(each.pixels) // 8, len(each.descriptors) // descriptor_bytes, len(each.points) // 12)
        total += count
        if count > limits.keyframe_features or total > limits.features:
            raise LimitExceeded(
                f"keyframe {each.id} has {count} features, which is above {limits.keyframe_features}, or the "
                f"map more than {limits.features}",
                hint="keep the strongest features of each image",
            )


class _Provenance(Mapping[str, Any]):
    """What a map says about its origin, decoded when it is first asked for."""

    def __init__(self, raw: bytes) -> None:
        self._raw = raw

    def __getitem__(self, name: str) -> Any:
        return self._decoded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._decoded)

    def __len__(self) -> int:
        return len(self._decoded)

    @functools.cached_property
    def _decoded(self) -> dict[str, Any]:
        try:
            return msgspec.msgpack.decode(self._raw, type=dict[str, Any], ext_hook=_no_extension)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise BadRequest(
                f"the provenance of the map is damaged: {message_of(error)}", hint="fetch it again"
            ) from error


def _no_extension(kind: int, _: memoryview) -> Any:
    raise ValueError(f"it holds the extension {kind}")


def _keyframe(k: _Keyframe, kind: DescriptorKind) -> Keyframe:
    return Keyframe(
        id=k.id, robot=k.robot, timestamp_s=k.timestamp_s, T_world_camera=_array(k.pose, "<f8", (4, 4)),
        camera=k.camera, pixels=_array(k.pixels, "<f4", (-1, 2)),
        descriptors=_array(k.descriptors, kind.dtype, (-1, kind.size)),
        points_camera=_array(k.points, "<f4", (-1, 3)), kind=kind,
    )  # fmt: skip


def _raw(array: npt.NDArray[Any], kind: str) -> bytes:
    return np.ascontiguousarray(array, dtype=np.dtype(kind)).tobytes()


def _view(array: npt.NDArray[Any], kind: str) -> memoryview:
    return memoryview(_raw(array, kind))


def _array(raw: bytes | memoryview, kind: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    return np.frombuffer(raw, dtype=np.dtype(kind)).reshape(shape)


def _is_bounded(values: npt.NDArray[np.float32], most: float = _MAX_NUMBER) -> bool:
    """Return whether all *values* are finite and not absurd; a NaN makes both comparisons false."""
    if not values.size:
        return True
    return bool(values.min() >= -most and values.max() <= most)


def _checked_pose(what: str, T: Array) -> Array:
    """Return a pose with a rotation; raises BadRequest."""
    made = rigid(T)
    if made is None:
        raise BadRequest(
            f"{what} has no rigid pose, or a matrix that is not a rotation",
            hint="send (4, 4) matrices of a rotation with at least three decimals and a finite translation",
        )
    return made
