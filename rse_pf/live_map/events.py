"""The events of a live map: the content of its log, and all that its state depends on.

The log of a map is a list of entries, and an entry is a list of events.  All events from the
first one on, or a snapshot and the events after it, give the same map on every computer.

The tags and the names of fields are encoded in stored logs and never change.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import msgspec
import numpy as np

from rse_pf.errors import BadRequest, message_of
from rse_pf.geometry import Array
from rse_pf.slam.keyframe import SentKeyframe, decode_keyframe

__all__ = [
    "Event",
    "KeyframeAdded",
    "LoopClosuresMeasured",
    "MapServerChanged",
    "MapStarted",
    "MeasuredLoopClosure",
    "Optimised",
    "RobotForgotten",
    "RobotLeft",
    "StartEdge",
    "StartKeyframe",
    "decode_events",
    "encode_events",
    "matrix_bytes",
    "matrix_of",
]


class KeyframeAdded(msgspec.Struct, frozen=True, kw_only=True, dict=True, tag="keyframe-2"):
    """A robot made a keyframe.

    ``robot`` is the text of `RobotId.folder`: its tenant, its name, and its enrolment if it has one.
    ``segment`` is the number of the robot's odometry frame, from 0, which never decreases: a new segment
    begins when tracking was lost, or when the robot started again.  ``number`` counts the robot's keyframes
    over all segments, from 0 and without gaps.  ``data`` is the keyframe as the robot encoded it.
    """

    robot: str
    segment: int
    number: int
    data: bytes

    @cached_property
    def keyframe(self) -> SentKeyframe:
        """The keyframe, decoded once.

        Raises:
            BadRequest: The data are damaged.
            InvalidCamera: The camera model cannot be right.
        """
        return decode_keyframe(self.data)


class MeasuredLoopClosure(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The measured pose of keyframe ``other`` relative to ``keyframe`` of a `LoopClosuresMeasured`.

    ``T_keyframe_other`` ``(4, 4)`` and its ``information`` ``(6, 6)`` are bytes as `matrix_bytes` makes them.
    The information is the inverse covariance of a small motion of the other camera in its own frame (three
    lengths, then three radians).  Lengths are metres if one of both keyframes is metric, else in the unit of
    ``keyframe``.  ``inliers`` of ``matches`` fit the pose.

    ``scale`` is None between two metric keyframes; else it holds the natural logarithm of the length of the
    unit of ``other`` in the unit of ``keyframe``, and the variance of this logarithm.  ``off_scale`` is None
    unless both keyframes are metric and their depths differ significantly; then one robot's metre is wrong,
    and ``off_scale`` is the logarithm of the length of the metre of ``other`` in metres of ``keyframe``.
    """

    other: int
    T_keyframe_other: bytes
    information: bytes
    inliers: int
    matches: int
    scale: tuple[float, float] | None = None
    off_scale: float | None = None


class LoopClosuresMeasured(msgspec.Struct, frozen=True, kw_only=True, tag="links"):
    """The loop closures that were measured for a keyframe, and how many candidates failed, by reason.

    The reasons are those that `rse_pf.slam.relative_pose.measure_relative_pose` returns: "no-matches" and
    others.
    """

    keyframe: int
    links: tuple[MeasuredLoopClosure, ...] = ()
    failed: dict[str, int] = {}


class Optimised(msgspec.Struct, frozen=True, kw_only=True, tag="optimised"):
    """All keyframes that were connected with the frame of the map were optimised in the background.

    The optimisation began when the map had applied ``up_to`` events.  ``T_map_camera`` has the optimised
    poses ``(n, 4, 4)`` of the keyframes ``ids`` in the frame of the map, as `matrix_bytes` makes them.
    """

    up_to: int
    ids: tuple[int, ...]
    T_map_camera: bytes


class RobotForgotten(msgspec.Struct, frozen=True, kw_only=True, tag="forgotten"):
    """An operator removes all that a robot contributed to the map."""

    robot: str


class RobotLeft(msgspec.Struct, frozen=True, kw_only=True, tag="left"):
    """A robot asked to leave the map; its keyframes and loop closures stay."""

    robot: str


class StartKeyframe(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """A keyframe of the version that a live map starts from.

    ``data`` is encoded like a keyframe of a robot; its odometry pose is the pose in the version.
    """

    robot: str
    data: bytes

    @cached_property
    def keyframe(self) -> SentKeyframe:
        """The keyframe, decoded once.

        Raises:
            BadRequest: The data are damaged.
            InvalidCamera: The camera model cannot be right.
        """
        return decode_keyframe(self.data)


class StartEdge(msgspec.Struct, frozen=True, kw_only=True):
    """An edge of the version that a live map starts from.

    ``a`` and ``b`` are indices, from 0, of the keyframes of the `MapStarted`.  ``T_a_b`` ``(4, 4)``, which
    maps points of the camera of *b* to that of *a*, and ``information`` ``(6, 6)`` are bytes as
    `matrix_bytes` makes them.  The information is the inverse covariance of a small motion of camera *b* in
    its own frame (metres, then radians).
    """

    a: int
    b: int
    T_a_b: bytes
    information: bytes


class MapStarted(msgspec.Struct, frozen=True, kw_only=True, tag="started-2"):
    """The map begins with the keyframes and edges of the version ``source``, or empty.

    ``equal_rooms_m`` is the size, in metres, of rooms that look the same; 0 if every place looks unique.
    The keyframes of the loop closures that join two components must then extend over more than this size.
    """

    source: str
    keyframes: tuple[StartKeyframe, ...]
    links: tuple[StartEdge, ...] = ()
    equal_rooms_m: float = 0.0


class MapServerChanged(msgspec.Struct, frozen=True, kw_only=True, tag="owner"):
    """Another process, the map server ``owner``, writes the log from now on.

    ``epoch`` is the number of its lease of the map, which every change of the map server increments.
    """

    owner: str
    epoch: int


Event = (
    KeyframeAdded
    | LoopClosuresMeasured
    | Optimised
    | RobotForgotten
    | RobotLeft
    | MapStarted
    | MapServerChanged
)


RESTART_HINT = "start a new map from the last published version: rse-pf map live start MAP --from MAP"

_ENCODER = msgspec.msgpack.Encoder(order="deterministic")
_DECODER = msgspec.msgpack.Decoder(list[Event])


def encode_events(events: Sequence[Event]) -> bytes:
    """Return *events* as one entry of a log, in MessagePack; equal events give equal bytes."""
    return _ENCODER.encode(list(events))


def decode_events(data: bytes) -> list[Event]:
    """Return the events of one entry of a log, as `encode_events` encoded them.

    Raises:
        BadRequest: The bytes are damaged.
    """
    try:
        return _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BadRequest(f"an entry of the log is damaged: {message_of(error)}", hint=RESTART_HINT) from error


def matrix_bytes(matrix: Array) -> bytes:
    """Return a matrix as float64, little-endian, row-major."""
    return np.ascontiguousarray(matrix, dtype="<f8").tobytes()


def matrix_of(data: bytes, rows: int, columns: int) -> Array:
    """Return the ``(rows, columns)`` matrix that `matrix_bytes` encoded.

    Raises:
        BadRequest: The number of bytes is not that of such a matrix.
    """
    if len(data) != 8 * rows * columns:
        raise BadRequest(
            f"a matrix of {rows}x{columns} has {8 * rows * columns} bytes, not {len(data)}",
            hint=RESTART_HINT,
        )
    matrix: Array = np.frombuffer(data, dtype="<f8").reshape(rows, columns)
    return matrix
