"""Represent maps as values (keyframes, edges, a point cloud), and encode them as bytes.

A map file is the 8 bytes ``RSEMAP1\n`` and one MessagePack object with the fields of the map, compressed by
zlib; its arrays are raw little-endian bytes.  Equal maps give equal bytes.

`decode_map` returns complete and valid maps only.  Sizes and counts are checked on the bytes before an object
is made from them, so that a malformed or hostile file costs little memory; nothing in a file is executed.
"""

from __future__ import annotations

import functools
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadMessage, BadRequest, LimitExceeded, RsePfError, message_of
from rse_pf.geometry import Array, Camera, rigid
from rse_pf.limits.budget import (
    LIST_VALUES,
    MAP_VALUES,
    PROVENANCE,
    Budget,
    announced_values,
    inflate_within,
    measure_msgpack,
    small_text,
)
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors, common_kind

__all__ = [
    "IMAGES_FOLDER",
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
"""What an edge measures: the motion to the next keyframe of a robot, a loop closure within one map, or a loop
closure between two maps that were merged."""

IMAGES_FOLDER = "images"
"""Name of the folder that holds the image files of keyframes, beside an exported map or a drive's results."""
UP_FIELD = "up"
"""Name of the field of a map's provenance that holds the unit vector against gravity in the map's world."""
UP = (0.0, 0.0, 1.0)
"""Value that the field ``up`` gets when gravity is known: the world of the map is then rotated so that its z
axis points up."""

_MAGIC = b"RSEMAP1\n"  # the first bytes of a map file, with the version of the format
# Largest size of a decompressed map file (1 GiB) if the caller of `decode_map` states no other; a larger map
# is refused.
_MAX_BYTES = 1 << 30
_MAX_COMPRESSION_RATIO = 50.0
"""Largest accepted ratio of the decompressed to the compressed size of a map file: features and point clouds
compress to half their size only, so that a file with a larger ratio is hostile, and is refused."""
_UNCHECKED_BYTES = 1 << 20
"""Decompressed size in bytes up to which a map file may have any compression ratio, because 1 MiB of memory
harms nobody; a larger file is refused beyond `_MAX_COMPRESSION_RATIO`."""
_MAX_ID = 2**63 - 1  # the largest id of a keyframe, an int64; a keyframe with a larger one is refused
# Largest number of characters of the name of a keyframe's robot; a keyframe with a longer one is refused.
_MAX_NAME_LENGTH = 64
_MAX_COORDINATE_M = 1e9
"""Largest absolute coordinate in metres of a point in a map, beyond any map; a map with a larger one is
refused, because far larger ones would overflow float32 when they are squared."""
_MAX_TIME_S = 1e12
"""Largest absolute time of a keyframe in Unix seconds: far beyond any clock, and float64 still resolves
0.2 ms.  A keyframe with a larger one is refused."""
# Largest absolute coordinate of a feature in pixels, since no camera has wider images; a keyframe with a
# larger one is refused.
_MAX_PIXEL = 1e5
_MAX_INFORMATION = 1e18
"""Largest absolute number in the information matrix of an edge, a standard deviation of 1 nm or 1 nrad; an
edge with a larger one is refused."""
_ITEM_VALUES = {"keyframes": 100, "edges": 40}
"""Largest average number of MessagePack values (keys, numbers, strings and byte strings) of the keyframes of
a map file, and of its edges: more than they have in this release, so that a later release can add fields.  A
file with more is refused."""
_OTHER_FIELD_VALUES = 1000
"""Largest number of MessagePack values of each field of a map file other than keyframes, edges and
provenance; also of a field of a later release, which is ignored.  A file with more is refused."""
_UNSAFE_IN_FILE_NAMES = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLimits:
    """The largest numbers of items that a map may hold; a larger map is rejected before it is decoded.

    Attributes:
        keyframes: Keyframes of the map.
        keyframe_features: Features of one keyframe.
        features: Features of all keyframes together.
        edges: Edges of the pose graph.
    """

    keyframes: int = 20_000
    keyframe_features: int = 20_000
    features: int = 5_000_000
    edges: int = 100_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A keyframe of a map: the features of one image, with the pose of its camera in the world of the map.

    This class is the keyframe of everything that works with whole maps: versions, merging, localisation and
    exports.  What a robot sends before a map has given it an id and a pose is
    `rse_pf.slam.keyframe.SentKeyframe`, which converts into this class.

    Attributes:
        id: Unique in its map, 0..2**63-1.
        robot: Name of the robot that took the image, at most 64 characters.
        timestamp_s: When the image was taken, Unix seconds.
        T_world_camera: ``(4, 4)`` float64, metres; maps points from the camera's frame to the map's world.
        camera: The pinhole camera whose undistorted pixels these are.
        pixels: ``(n, 2)`` float32, undistorted.
        descriptors: ``(n, d)`` uint8 or int8, of the same kind in the whole map.
        points_camera: ``(n, 3)`` float32, the 3-D point of each feature in the camera's frame, metres; NaN
            where the depth is unknown.
        kind: The kind of the descriptors.

    Raises:
        BadRequest: The shapes do not fit, or a number is not finite or out of its range.
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
            and self.kind.is_kind_of(self.descriptors)
            and self.points_camera.shape == (n, 3)
        ):
            raise BadRequest(
                f"the arrays of keyframe {self.id} do not fit: pixels {self.pixels.shape}, descriptors "
                f"{self.descriptors.shape}, points_camera {self.points_camera.shape}",
                hint="send one row for each feature in each array",
            )
        if not (0 <= self.id <= _MAX_ID and len(self.robot) <= _MAX_NAME_LENGTH):
            raise BadRequest(
                f"the id {self.id} is not within 0..2**63-1, or the robot's name longer than "
                f"{_MAX_NAME_LENGTH}",
                hint="number keyframes from 0, and shorten the name of the robot",
            )
        if not (abs(self.timestamp_s) <= _MAX_TIME_S and _is_bounded(self.pixels, _MAX_PIXEL)):
            raise BadRequest(
                f"the time of keyframe {self.id} is not within +-{_MAX_TIME_S:g} s, or a pixel not within "
                f"+-{_MAX_PIXEL:g}",
                hint="leave this keyframe out",
            )
        pose = _checked_pose(f"keyframe {self.id}", self.T_world_camera)
        object.__setattr__(self, "T_world_camera", pose)  # A frozen dataclass allows no other way.

    @property
    def image_name(self) -> str:
        """The name of the file of the keyframe's image, ``ROBOT-ID.jpg``, which is unique in its map.

        ROBOT is the name of the robot with a hyphen in place of characters that file names should not have.
        """
        robot = _UNSAFE_IN_FILE_NAMES.sub("-", self.robot).strip(".-") or "camera"
        return f"{robot}-{self.id:06d}.jpg"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """A relative pose between two keyframes of a map that was measured: an edge of the pose graph.

    Attributes:
        a: Id of the first keyframe.
        b: Id of the second keyframe.
        T_a_b: ``(4, 4)``, the pose of the camera of *b* in the frame of the camera of *a*, metres.
        information: ``(6, 6)``, the inverse covariance of the twist (translation in metres, rotation in
            radians) ``log(inverse(T_a_b) @ inverse(T_world_a) @ T_world_b)``.
        kind: What the edge measures.

    Raises:
        BadRequest: The pose is not rigid, or the information is not a ``(6, 6)`` matrix of finite numbers.
    """

    a: int
    b: int
    T_a_b: Array
    information: Array
    kind: EdgeKind = "odometry"

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_a_b", _checked_pose(f"edge {self.a}-{self.b}", self.T_a_b))
        if self.information.shape != (6, 6) or not (np.abs(self.information) <= _MAX_INFORMATION).all():
            raise BadRequest(
                f"edge {self.a}-{self.b} has no (6, 6) information matrix with numbers up to "
                f"{_MAX_INFORMATION:g}",
                hint="send the inverse of the covariance of the relative pose",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapVersion:
    """The content of a map at one time; a changed map is another `MapVersion`.

    The registry (`rse_pf.maps.registry`) gives it an id and a record when it is committed.

    Attributes:
        keyframes: The keyframes, with unique ids.
        edges: The edges of the pose graph between them.
        points: ``(m, 3)`` float32, the point cloud in the world of the map, metres.
        colours: ``(m, 3)`` uint8, red, green and blue of each point.
        provenance: Where the map comes from: free fields that its maker wrote, and the field ``up``.

    Raises:
        BadRequest: Two keyframes have the same id or different kinds of descriptors, an edge refers to a
            missing keyframe, the shapes of points and colours do not fit, or a coordinate of a point is not
            finite or beyond 1e9 m.
    """

    keyframes: tuple[Keyframe, ...]
    edges: tuple[Edge, ...] = ()
    points: npt.NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    colours: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), dtype=np.uint8))
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> DescriptorKind:
        """The kind of the descriptors of all keyframes; ORB if there are no keyframes."""
        return self.keyframes[0].kind if self.keyframes else ORB

    @property
    def up(self) -> Array | None:
        """The unit vector ``(3,)`` against gravity in the world of the map; None if gravity is unknown.

        It is the field ``up`` of the provenance.  A field that is no list of three floats, or whose length
        differs from 1 by more than 0.01, counts as unknown.
        """
        stated = self.provenance.get(UP_FIELD)
        if not isinstance(stated, list) or len(stated) != 3 or not all(type(x) is float for x in stated):
            return None
        up = np.array(stated)
        length = float(np.linalg.norm(up))
        return up / length if 0.99 <= length <= 1.01 else None

    def __post_init__(self) -> None:
        ids = {keyframe.id for keyframe in self.keyframes}
        if len(ids) != len(self.keyframes):
            raise BadRequest("two keyframes of a map have one id", hint="assign unique ids")
        common_kind((keyframe.kind for keyframe in self.keyframes), "the map")
        dangling = next((edge for edge in self.edges if edge.a not in ids or edge.b not in ids), None)
        if dangling is not None:
            raise BadRequest(
                f"edge {dangling.a}-{dangling.b} names a missing keyframe", hint="add the keyframe"
            )
        m = len(self.points)
        if self.points.shape != (m, 3) or self.colours.shape != (m, 3) or not _is_bounded(self.points):
            raise BadRequest(
                f"points {self.points.shape} and colours {self.colours.shape} of a map are not both (m, 3), "
                f"or a coordinate is not within +-{_MAX_COORDINATE_M:g} m",
                hint="send (m, 3) of both, without NaN",
            )


class _EncodedKeyframe(msgspec.Struct, frozen=True, kw_only=True):
    """A `Keyframe` in a map file: ``pose`` is ``T_world_camera``, ``points`` are ``points_camera``."""

    id: int
    robot: str
    timestamp_s: float
    pose: bytes
    camera: Camera
    pixels: memoryview
    descriptors: memoryview
    points: memoryview


class _EncodedEdge(msgspec.Struct, frozen=True, kw_only=True):
    """An `Edge` in a map file: ``step`` is ``T_a_b``."""

    a: int
    b: int
    step: bytes
    information: bytes
    kind: EdgeKind


class _EncodedKind(msgspec.Struct, frozen=True, array_like=True):
    name: str
    dtype: str
    size: int


class _EncodedMap(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    keyframes: list[_EncodedKeyframe]
    edges: list[_EncodedEdge]
    points: memoryview
    colours: memoryview
    provenance: msgspec.Raw
    features: _EncodedKind | None = None
    """The kind of the descriptors; None means ORB."""


def encode_map(version: MapVersion) -> bytes:
    """Return *version* as the bytes of a map file; equal maps give equal bytes."""
    kind = version.kind
    encoded = _EncodedMap(
        keyframes=[
            _EncodedKeyframe(
                id=keyframe.id,
                robot=keyframe.robot,
                timestamp_s=keyframe.timestamp_s,
                pose=_array_bytes(keyframe.T_world_camera, "<f8"),
                camera=keyframe.camera,
                pixels=_array_view(keyframe.pixels, "<f4"),
                descriptors=_array_view(keyframe.descriptors, kind.dtype),
                points=_array_view(keyframe.points_camera, "<f4"),
            )
            for keyframe in version.keyframes
        ],
        edges=[
            _EncodedEdge(
                a=edge.a,
                b=edge.b,
                step=_array_bytes(edge.T_a_b, "<f8"),
                information=_array_bytes(edge.information, "<f8"),
                kind=edge.kind,
            )
            for edge in version.edges
        ],
        points=_array_view(version.points, "<f4"),
        colours=_array_view(version.colours, "u1"),
        provenance=msgspec.Raw(msgspec.msgpack.encode(dict(version.provenance), order="deterministic")),
        features=None if kind == ORB else _EncodedKind(kind.name, kind.dtype, kind.size),
    )
    return _MAGIC + zlib.compress(msgspec.msgpack.encode(encoded, order="deterministic"), 1)


def decode_map(data: bytes, max_bytes: int = _MAX_BYTES, limits: MapLimits | None = None) -> MapVersion:
    """Return the map of the bytes of a map file; its arrays are read-only views of the decompressed bytes.

    The provenance is decoded when it is first read, and raises BadRequest then if it is damaged.

    Args:
        data: The bytes that `encode_map` returned; they may come from an untrusted robot.
        max_bytes: The largest size of the decompressed map.
        limits: The largest numbers of keyframes, features and edges; None means the defaults.

    Raises:
        BadRequest: The bytes are not a map, are damaged, or decompress to more than *max_bytes*, or to more
            than 1 MiB and 50 times their size.
        LimitExceeded: The map holds more than *limits* allow.
    """
    limits = limits or MapLimits()
    # 1. Decompress, and refuse bytes that decompress to more than *max_bytes*.
    content = _decompress(data, max_bytes)
    try:
        # 2. Check the numbers of keyframes, edges and features before arrays are made from the bytes.
        _check_fields(content, limits)
        encoded = msgspec.msgpack.decode(memoryview(content).toreadonly(), type=_EncodedMap)
        features = encoded.features
        kind = ORB if features is None else DescriptorKind(features.name, features.dtype, features.size)
        _check_feature_counts(encoded.keyframes, limits, kind.size)
        # 3. Make keyframes, edges and the map, each of which checks its own values.
        return MapVersion(
            keyframes=tuple(_decode_keyframe(keyframe, kind) for keyframe in encoded.keyframes),
            edges=tuple(
                Edge(
                    a=edge.a,
                    b=edge.b,
                    T_a_b=_array(edge.step, "<f8", (4, 4)),
                    information=_array(edge.information, "<f8", (6, 6)),
                    kind=edge.kind,
                )
                for edge in encoded.edges
            ),
            points=_array(encoded.points, "<f4", (-1, 3)),
            colours=_array(encoded.colours, "u1", (-1, 3)),
            provenance=_LazyProvenance(bytes(encoded.provenance)),
        )
    except (msgspec.MsgspecError, ValueError, RecursionError, BadMessage) as error:
        if isinstance(error, RsePfError) and not isinstance(error, BadMessage):
            raise
        raise BadRequest(
            f"the map is damaged: {message_of(error)}", hint="use another copy of the map file"
        ) from error


def _decompress(data: bytes, max_bytes: int) -> bytes | bytearray:
    if data[: len(_MAGIC)] != _MAGIC:
        raise BadRequest("these bytes are not a map", hint="send what encode_map returned")
    budget = Budget(
        wire_bytes=max_bytes,
        inflated_bytes=max_bytes,
        inflate_ratio=_MAX_COMPRESSION_RATIO,
        free_bytes=_UNCHECKED_BYTES,
        depth=0,
        containers=0,
        values=0,
        mixed_values=0,
        memory_bytes=max_bytes,
    )
    try:
        return inflate_within(data[len(_MAGIC) :], budget)
    except LimitExceeded as error:
        raise BadRequest(
            f"the map file cannot be decompressed: its {error.message}",
            hint="save the map with fewer keyframes or points",
        ) from error
    except BadMessage as error:
        raise BadRequest(f"the map is truncated or damaged: {error.message}", hint="send it again") from error


def _check_fields(content: bytes | bytearray, limits: MapLimits) -> None:
    """Check the size of each field of a decompressed map file before the fields are decoded.

    Raises:
        BadMessage: The bytes are malformed, or a field occurs twice.
        LimitExceeded: The map has too many keyframes or edges, or its provenance is too long.
    """
    count, offset, names = announced_values(content, 0), 1, set()
    if not 0x80 <= content[0] <= 0x8F:
        raise BadMessage("it is not a map of fields")
    for _ in range(count // 2):
        name, offset = small_text(content, offset)
        if name in names:
            raise BadMessage(f"the field {name!r} is there twice")
        names.add(name)
        items = announced_values(content, offset)
        if name in _ITEM_VALUES and items > getattr(limits, name):
            raise LimitExceeded(
                f"a map of {items} {name} is above {getattr(limits, name)}", hint="split the map"
            )
        if name == "provenance" and not (0x80 <= content[offset] < 0x90 or content[offset] in (0xDE, 0xDF)):
            raise BadMessage("its provenance is not a map")
        begin, offset = offset, measure_msgpack(content, offset, _field_budget(name, items))
        if name == "provenance" and offset - begin > PROVENANCE.wire_bytes:
            raise LimitExceeded(
                f"the provenance of the map has {offset - begin} bytes, which is above "
                f"{PROVENANCE.wire_bytes}",
                hint="leave fields of the provenance out",
            )


def _field_budget(name: str, items: int) -> Budget:
    """Return the limits for decoding the field *name* of a map file, which announces *items* elements."""
    if name == "provenance":
        return PROVENANCE
    values = LIST_VALUES + items * _ITEM_VALUES[name] if name in _ITEM_VALUES else _OTHER_FIELD_VALUES
    containers = 1 + values // MAP_VALUES
    return Budget(
        wire_bytes=_MAX_BYTES,
        inflated_bytes=_MAX_BYTES,
        inflate_ratio=_MAX_COMPRESSION_RATIO,
        free_bytes=_UNCHECKED_BYTES,
        depth=4,
        containers=containers,
        values=values,
        mixed_values=values,
        memory_bytes=_MAX_BYTES,
    )


def _check_feature_counts(
    keyframes: list[_EncodedKeyframe], limits: MapLimits, descriptor_bytes: int
) -> None:
    """Raise LimitExceeded if one keyframe, or the map in total, has more features than *limits* allow.

    Pixels, descriptors (of *descriptor_bytes* bytes each) and points of a keyframe are counted by their
    bytes, and the largest of the three numbers is taken.
    """
    total = 0
    for keyframe in keyframes:
        count = max(
            len(keyframe.pixels) // 8,
            len(keyframe.descriptors) // descriptor_bytes,
            len(keyframe.points) // 12,
        )
        total += count
        if count > limits.keyframe_features:
            raise LimitExceeded(
                f"keyframe {keyframe.id} has {count} features, which is above {limits.keyframe_features}",
                hint="keep the strongest features of each image",
            )
        if total > limits.features:
            raise LimitExceeded(
                f"the keyframes of the map have more than {limits.features} features",
                hint="keep the strongest features of each image, or split the map",
            )


class _LazyProvenance(Mapping[str, Any]):
    """The provenance of a map, which is decoded when a field of it is first read.

    Reading raises BadRequest if the bytes are damaged.
    """

    def __init__(self, encoded: bytes) -> None:
        self._encoded = encoded

    def __getitem__(self, name: str) -> Any:
        return self._fields[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)

    @functools.cached_property
    def _fields(self) -> dict[str, Any]:
        try:
            return msgspec.msgpack.decode(self._encoded, type=dict[str, Any], ext_hook=_reject_extension)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise BadRequest(
                f"the provenance of the map is damaged: {message_of(error)}",
                hint="use another copy of the map file",
            ) from error


def _reject_extension(code: int, _: memoryview) -> Any:
    raise ValueError(f"the provenance holds a MessagePack extension of type {code}")


def _decode_keyframe(encoded: _EncodedKeyframe, kind: DescriptorKind) -> Keyframe:
    return Keyframe(
        id=encoded.id,
        robot=encoded.robot,
        timestamp_s=encoded.timestamp_s,
        T_world_camera=_array(encoded.pose, "<f8", (4, 4)),
        camera=encoded.camera,
        pixels=_array(encoded.pixels, "<f4", (-1, 2)),
        descriptors=_array(encoded.descriptors, kind.dtype, (-1, kind.size)),
        points_camera=_array(encoded.points, "<f4", (-1, 3)),
        kind=kind,
    )


def _array_bytes(array: npt.NDArray[Any], dtype: str) -> bytes:
    return np.ascontiguousarray(array, dtype=np.dtype(dtype)).tobytes()


def _array_view(array: npt.NDArray[Any], dtype: str) -> memoryview:
    return memoryview(_array_bytes(array, dtype))


def _array(data: bytes | memoryview, dtype: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    return np.frombuffer(data, dtype=np.dtype(dtype)).reshape(shape)


def _is_bounded(values: npt.NDArray[np.float32], bound: float = _MAX_COORDINATE_M) -> bool:
    """Return whether all *values* are within ``-bound..bound``; a NaN makes both comparisons false."""
    if not values.size:
        return True
    return bool(values.min() >= -bound and values.max() <= bound)


def _checked_pose(name: str, T: Array) -> Array:
    """Return *T* as the pose that `rigid` makes of it; *name* begins the message of the error.

    Raises:
        BadRequest: The matrix is not ``(4, 4)``, not finite, or its upper left part is not a rotation.
    """
    pose = rigid(T)
    if pose is None:
        raise BadRequest(
            f"{name} has no rigid pose, or a matrix that is not a rotation",
            hint="send (4, 4) matrices of a rotation with at least three decimals and a finite translation",
        )
    return pose
