"""Hold what a robot knows of a live map: alignments of its own segments, other robots, state of the map.

A segment is one odometry frame of the robot: a robot that has lost tracking begins another segment.  The
alignment of a segment is the pose of its odometry frame in the map, with a scale for a camera without depth.
`Alignments` applies the map's updates and returns corrections; it uses no clock and no network.
`CorrectionStream` passes corrections to their readers.

The covariance of an alignment is that of its error as a twist on the left: the true alignment is
``exp(twist) @ T_map_odom``, where the twist is three numbers of the translation in metres, then three of the
rotation in radians.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rse_pf.errors import BadMessage
from rse_pf.geometry import Array, inverse, scaled
from rse_pf.wire import as_type
from rse_pf.wire.live_map import AlignmentUpdate, MapUpdate, PoseUpdate, RelocaliseReply

__all__ = ["AlignedBy", "Alignments", "Correction", "CorrectionStream", "OtherRobot", "SegmentAlignment"]

_NO_ANSWER = "the map has not answered yet"  # why a segment is not aligned until an update names the segment
_UPPER_TRIANGLE = np.triu_indices(6)
"""Rows and columns, in this order, of the 21 numbers by which a message states a 6x6 covariance."""
_MAX_CORRECTIONS = 1000
"""Most corrections that wait for one slow reader, the oldest of which are dropped; and most corrections of
the past that a new reader gets."""

AlignedBy = Literal["map", "relocalisation", "nothing"]
"""Source of an alignment: ``map``, the map server's pose graph with its loop closures; ``relocalisation``,
one keyframe that was localised in the map; ``nothing``, which means that the segment is not aligned."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentAlignment:
    """Pose and scale of one odometry frame in the map.

    Attributes:
        T_map_odom: ``(4, 4)``, metres; None while the segment is not aligned.
        covariance: ``(6, 6)`` covariance of the twist (metres, radians) on the left of ``T_map_odom``; None
            if unknown.
        by: Source of the alignment.  An alignment by relocalisation holds until the pose graph of the map
            aligns the segment, or finds it ambiguous.
        reason: Why the segment is not aligned; empty if it is.
        metres_per_unit: Metric scale of the odometry frame: lengths in it times this are metres.  1 for a
            camera with depth.
    """

    T_map_odom: Array | None = None
    covariance: Array | None = None
    by: AlignedBy = "nothing"
    reason: str = _NO_ANSWER
    metres_per_unit: float = 1.0

    def pose_in_map(self, T_odom_camera: Array) -> Array | None:
        """Return ``T_map_camera`` ``(4, 4)`` in metres; None while the segment is not aligned.

        *T_odom_camera* is the ``(4, 4)`` pose in the odometry frame, with the position in its unit.
        """
        if self.T_map_odom is None:
            return None
        T_map_camera: Array = self.T_map_odom @ scaled(T_odom_camera, self.metres_per_unit)
        return T_map_camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correction:
    """A change of the alignment of one segment, which every later ``T_map_camera`` uses.

    Attributes:
        segment: The robot's number of the segment, from 0.
        before: ``T_map_odom`` ``(4, 4)`` before the change; None if the segment was not aligned.
        after: ``T_map_odom`` ``(4, 4)`` after the change; None if the segment is not aligned any more.
        covariance: ``(6, 6)`` covariance of the twist (metres, radians) on the left of ``after``; None if
            unknown.
        by: Source of the new alignment.
        reason: Why the segment is not aligned any more; empty if it is.
        version: The map's version: `Alignments.version` after the update or reply that made this change.
        cause: The keyframe that changed the map, as name of its robot and its number in the map; None if
            unknown.
        scale: Metres per unit of the odometry frame after the change, 1 for a camera with depth.
    """

    segment: int
    before: Array | None
    after: Array | None
    covariance: Array | None
    by: AlignedBy
    reason: str
    version: int
    cause: tuple[str, int] | None
    scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OtherRobot:
    """Pose of another robot's newest keyframe in the map.

    Attributes:
        T_map_camera: ``(4, 4)``, metres; None while the robot's segment is not aligned.
        timestamp_s: Time stamp of the keyframe, by the clock of that robot's camera; None while the segment
            is not aligned.
        reason: Why the robot's segment is not aligned; empty if it is.
    """

    T_map_camera: Array | None
    timestamp_s: float | None
    reason: str


class Alignments:
    """Newest known state of one live map, as one robot sees it."""

    def __init__(self) -> None:
        self.version = 0
        """Newest position in the log of the map that an update or a reply to a relocalisation has stated."""
        self.map_keyframes = 0
        """Number of keyframes of all robots in the map."""
        self.map_state = ""
        """State of the map in its last update of the key ``map``, empty before the first: ``live``,
        ``moving`` (to another server) or ``waiting for the store`` (the platform cannot use its object store,
        so keyframes are not accepted)."""
        self.map_server = ""
        """Id of the backend server on which the map server runs; empty before the first update of the key
        ``map``, and while the map moves."""
        self.others: dict[str, OtherRobot] = {}
        """Other robots of the map by their names."""
        self._own_name = ""
        self._first_segment = 0
        self._segments: dict[int, SegmentAlignment] = {}

    def identify_robot(self, name: str, first_segment: int) -> list[Correction]:
        """Store this robot's name in the map, and the number that the map gives to the robot's segment 0.

        If this number has changed, the map was started again without its content: the segments are not
        aligned any more, other robots are forgotten, and the corrections are returned.
        """
        is_new_map = bool(self._own_name) and first_segment != self._first_segment
        self._own_name, self._first_segment = name, first_segment
        self.others.pop(name, None)
        if not is_new_map:
            return []
        self.others.clear()
        unaligned = SegmentAlignment(reason="the map was started again")
        corrections = [self._set(segment, unaligned, None) for segment in list(self._segments)]
        return [correction for correction in corrections if correction is not None]

    def get(self, segment: int) -> SegmentAlignment:
        """Return the alignment of the segment of this robot that has the number *segment* in its own count.

        A segment that no update has named is not aligned.
        """
        return self._segments.get(segment, _UNALIGNED)

    def apply_update(self, key: str, payload: Any) -> Correction | None:
        """Apply an update of the map's topic; return a correction if an own segment's alignment changed.

        Args:
            key: ``map`` (size, version and state of the map), ``pose/ROBOT`` (pose of the newest keyframe of
                a robot) or ``alignment/ROBOT`` (alignment of a segment of a robot); other keys are ignored.
            payload: The decoded `MapUpdate`, `PoseUpdate` or `AlignmentUpdate`.

        Raises:
            BadMessage: *payload* is not of the type of *key*, or has invalid numbers; no alignment and no
                other robot was changed.
        """
        kind = key.partition("/")[0]
        if kind == "map":
            update = as_type(payload, MapUpdate)
            self.version, self.map_keyframes = update.version, update.keyframes
            self.map_state, self.map_server = update.state, update.owner
        elif kind == "pose":
            pose = as_type(payload, PoseUpdate)
            if pose.robot != self._own_name:
                self.others[pose.robot] = OtherRobot(
                    T_map_camera=_parse_pose(pose.T_map_camera), timestamp_s=pose.timestamp_s, reason=""
                )
        elif kind == "alignment":
            return self._apply_alignment(as_type(payload, AlignmentUpdate))
        return None

    def apply_relocalisation(
        self, segment: int, T_odom_camera: Array, reply: RelocaliseReply
    ) -> Correction | None:
        """Apply the reply to a relocalisation, unless the map's pose graph has aligned the segment meanwhile.

        Return a correction if the alignment changed.  A reply whose verdict is not ``ok`` changes only the
        reason of a segment that is not aligned.

        Args:
            segment: The robot's number of the segment of the keyframe that was localised.
            T_odom_camera: ``(4, 4)`` pose of that keyframe in its odometry frame, with the position in its
                unit.
            reply: The map's reply.

        Raises:
            BadMessage: A number of the reply is not finite or has the wrong shape.
        """
        present = self.get(segment)
        if present.by == "map":
            return None
        if reply.verdict != "ok" or reply.T_map_camera is None:
            if present.by == "nothing":
                reason = f"not relocalised: {reply.reason or reply.verdict}"
                self._segments[segment] = SegmentAlignment(reason=reason)
            return None
        metres_per_unit = _parse_scale(reply.scale)
        relocalised = SegmentAlignment(
            T_map_odom=_parse_pose(reply.T_map_camera) @ inverse(scaled(T_odom_camera, metres_per_unit)),
            covariance=_parse_covariance(reply.covariance),
            by="relocalisation",
            reason="",
            metres_per_unit=metres_per_unit,
        )
        self.version = max(self.version, reply.version)
        return self._set(segment, relocalised, None)

    def _apply_alignment(self, update: AlignmentUpdate) -> Correction | None:
        self.version = max(self.version, update.version)
        if update.robot != self._own_name:
            if not update.aligned:
                self.others[update.robot] = OtherRobot(
                    T_map_camera=None, timestamp_s=None, reason=update.reason
                )
            return None
        segment = update.segment - self._first_segment
        if segment < 0:
            return None  # ignore a segment of an earlier run of this robot
        if not update.aligned:
            # A map that has too few loop closures to align the segment does not contradict a relocalisation;
            # a map in which the segment fits several places does.
            is_ambiguous = update.reason.startswith("ambiguous")
            if self.get(segment).by == "relocalisation" and not is_ambiguous:
                return None
            return self._set(segment, SegmentAlignment(reason=update.reason or "not aligned"), update)
        if update.T_map_odom is None:
            raise BadMessage("an alignment without T_map_odom", hint="use the same version of server and SDK")
        aligned = SegmentAlignment(
            T_map_odom=_parse_pose(update.T_map_odom),
            covariance=_parse_covariance(update.covariance),
            by="map",
            reason="",
            metres_per_unit=_parse_scale(update.scale),
        )
        return self._set(segment, aligned, update)

    def _set(
        self, segment: int, alignment: SegmentAlignment, update: AlignmentUpdate | None
    ) -> Correction | None:
        """Store an alignment; return a correction if ``T_map_odom`` or the scale of the segment changed.

        *update* names the cause of the correction; None without an update.
        """
        present = self.get(segment)
        self._segments[segment] = alignment
        before, after = present.T_map_odom, alignment.T_map_odom
        is_equal = before is not None and after is not None and np.array_equal(before, after)
        if before is after or (is_equal and present.metres_per_unit == alignment.metres_per_unit):
            return None
        cause = None if update is None or update.cause is None else (update.cause.robot, update.cause.number)
        return Correction(
            segment=segment,
            before=before,
            after=after,
            covariance=alignment.covariance,
            by=alignment.by,
            reason=alignment.reason,
            version=self.version,
            cause=cause,
            scale=alignment.metres_per_unit,
        )


class CorrectionStream:
    """Pass the corrections of one live map to any number of readers, each of which reads at its own speed.

    At most 1,000 corrections wait for a reader, so that a slower reader loses the oldest ones; a new reader
    begins with the last 1,000.
    """

    def __init__(self) -> None:
        self._recent: deque[Correction] = deque(maxlen=_MAX_CORRECTIONS)
        self._readers: list[asyncio.Queue[Correction | None]] = []
        self._is_closed = False

    def publish(self, correction: Correction) -> None:
        """Pass a correction to all readers; a reader with 1,000 unread ones loses the oldest of them."""
        self._recent.append(correction)
        for reader in self._readers:
            if reader.qsize() >= _MAX_CORRECTIONS:
                reader.get_nowait()
            reader.put_nowait(correction)

    def close(self) -> None:
        """End the stream: each reader gets the corrections that it has not read, then its iteration ends."""
        self._is_closed = True
        for reader in self._readers:
            reader.put_nowait(None)

    async def read(self) -> AsyncIterator[Correction]:
        """Yield the last 1,000 corrections, then each new correction, until the stream is closed."""
        reader: asyncio.Queue[Correction | None] = asyncio.Queue()
        for correction in self._recent:
            reader.put_nowait(correction)
        if self._is_closed:
            reader.put_nowait(None)
        self._readers.append(reader)
        try:
            while (unread := await reader.get()) is not None:
                yield unread
        finally:
            self._readers.remove(reader)


_UNALIGNED = SegmentAlignment()  # state of a segment that no update of the map has named


def _parse_pose(numbers: Any) -> Array:
    """Return 16 finite numbers, row by row, as a ``(4, 4)`` pose; raises BadMessage."""
    pose = np.array(numbers, dtype=np.float64).ravel()
    if pose.shape != (16,) or not np.isfinite(pose).all():
        raise BadMessage(
            f"a pose has {pose.size} numbers, not 16 finite ones",
            hint="use the same version of server and SDK",
        )
    return pose.reshape(4, 4)


def _parse_scale(metres_per_unit: float | None) -> float:
    """Return a metric scale, 1 for None; raises BadMessage unless it is above 0 and finite."""
    if metres_per_unit is None:
        return 1.0
    if not 0.0 < metres_per_unit < math.inf:
        raise BadMessage(
            f"a scale of {metres_per_unit:g} metres per unit is not above 0 and finite",
            hint="use the same version of server and SDK",
        )
    return metres_per_unit


def _parse_covariance(numbers: Any) -> Array | None:
    """Return the 21 numbers of an upper triangle, row by row, as a symmetric ``(6, 6)`` covariance.

    The result is None for None.

    Raises:
        BadMessage: *numbers* are neither None nor 21 finite numbers.
    """
    if numbers is None:
        return None
    upper = np.array(numbers, dtype=np.float64).ravel()
    if upper.shape != (21,) or not np.isfinite(upper).all():
        raise BadMessage(
            f"a covariance has {upper.size} numbers, not 21 finite ones",
            hint="use the same version of server and SDK",
        )
    covariance = np.zeros((6, 6))
    covariance[_UPPER_TRIANGLE] = upper
    covariance.T[_UPPER_TRIANGLE] = upper
    return covariance
