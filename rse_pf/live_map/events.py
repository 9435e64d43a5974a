"""The events of a live map: what its log holds, and all that its state depends on.

The log of a map is a list of entries, an entry a list of events.  They hold plain numbers: the events from
the first on, or a snapshot and those after it, give the same map everywhere.
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

    ``robot`` is the text of `RobotId.folder`.  ``segment`` counts the odometry frames of a robot: a new one
    begins when tracking was lost, or the robot started again.  ``number`` counts its keyframes over all
    segments, from 0 and without gaps.  ``data`` is the keyframe as the robot encoded it.
    """

    robot: str
    segment: int
    number: int
    data: bytes

    @cached_property
    def keyframe(self) -> SentKeyframe:
        """The keyframe, decoded once; raises BadRequest or InvalidCamera."""
        return decode_keyframe(self.data)


class MeasuredLoopClosure(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A measured relative pose to keyframe ``other``, with its ``(6, 6)`` information.

    ``scale`` is the logarithm, with its variance, of how long the unit of the other keyframe is in that of
    this one; none between two in metres.  Lengths are metres if one of the two is, else in the unit of this
    one.  ``off_scale`` is the logarithm of how long a metre of the other keyframe is in those of this one,
    where both claim metres and these clearly differ; else none.
    """

    other: int
    T_keyframe_other: bytes
    information: bytes
    inliers: int
    matches: int
    scale: tuple[float, float] | None = None
    off_scale: float | None = None


class LoopClosuresMeasured(msgspec.Struct, frozen=True, kw_only=True, tag="links"):
    """The links that `measure` found for a keyframe, and the number of candidates that failed, by reason."""

    keyframe: int
    links: tuple[MeasuredLoopClosure, ...] = ()
    failed: dict[str, int] = {}


class Optimised(msgspec.Struct, frozen=True, kw_only=True, tag="optimised"):
    """Poses ``(n, 4, 4)`` that a background optimisation found, from the state after ``up_to`` events."""

    up_to: int
    ids: tuple[int, ...]
    T_map_camera: bytes


class RobotForgotten(msgspec.Struct, frozen=True, kw_only=True, tag="forgotten"):
    """All that a robot contributed is taken out."""

    robot: str


class RobotLeft(msgspec.Struct, frozen=True, kw_only=True, tag="left"):
    """A robot left; what it contributed stays."""

    robot: str


class StartKeyframe(msgspec.Struct, frozen=True, kw_only=True):
    """A keyframe of the version that a live map starts from; the pose in ``data`` is that in the version."""

    robot: str
    data: bytes


class StartEdge(msgspec.Struct, frozen=True, kw_only=True):
    """An edge of the version that a live map starts from; ``a`` and ``b`` are row numbers."""

    a: int
    b: int
    T_a_b: bytes
    information: bytes


class MapStarted(msgspec.Struct, frozen=True, kw_only=True, tag="started-2"):
    """The map begins with the keyframes of a version, or with none; it has no keyframes before.

    ``equal_rooms_m`` is the size of rooms that look the same, 0 if every place is unique: what joins robots
    must lie farther apart.
    """

    source: str
    keyframes: tuple[StartKeyframe, ...]
    links: tuple[StartEdge, ...] = ()
    equal_rooms_m: float = 0.0


class MapServerChanged(msgspec.Struct, frozen=True, kw_only=True, tag="owner"):
    """Another process owns the map from here on."""

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


_ENCODER = msgspec.msgpack.Encoder(order="deterministic")
_DECODER = msgspec.msgpack.Decoder(list[Event])


def encode_events(events: Sequence[Event]) -> bytes:
    """Return *events* as one entry of a log, as MessagePack."""
    return _ENCODER.encode(list(events))


def decode_events(data: bytes) -> list[Event]:
    """Return the events of an entry that `encode_events` returned.

    Raises:
        BadRequest: The bytes are damaged.
    """
    try:
        return _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BadRequest(
            f"an entry of the log is damaged: {message_of(error)}", hint="restore the map from a snapshot"
        ) from error


def matrix_bytes(matrix: Array) -> bytes:
    """Return numbers as float64, little-endian, row-major."""
    return np.ascontiguousarray(matrix, dtype="<f8").tobytes()


def matrix_of(data: bytes, rows: int, columns: int) -> Array:
    """Return the ``(rows, columns)`` matrix of `matrix_bytes`.

    Raises:
        BadRequest: The size does not fit.
    """
    if len(data) != 8 * rows * columns:
        raise BadRequest(
            f"a matrix of {rows}x{columns} has {8 * rows * columns} bytes, not {len(data)}",
            hint="send float64, little-endian, row-major",
        )
    matrix: Array = np.frombuffer(data, dtype="<f8").reshape(rows, columns)
    return matrix
