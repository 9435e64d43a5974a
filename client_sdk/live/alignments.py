"""What a robot knows of a live map: where its segments lie in it, where the others are, what state it is in.

Updates go in, corrections come out; no clock, no connection.  A segment is one odometry frame of the robot:
tracking that was lost begins a new one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rse_pf.errors import BadMessage
from rse_pf.geometry import Array, inverse, scaled
from rse_pf.wire import as_type
from rse_pf.wire.live_map import AlignmentUpdate, MapUpdate, PoseUpdate, RelocaliseReply

__all__ = ["NOT_ASKED", "AlignedBy", "Alignments", "Correction", "OtherRobot", "SegmentAlignment"]

NOT_ASKED = "the map has not answered yet"
_UPPER = np.triu_indices(6)

AlignedBy = Literal["map", "relocalisation", "nothing"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentAlignment:
    """Where one odometry frame lies in the map; ``reason`` says why that is unknown.

    ``covariance`` ``(6, 6)`` is of the twist (metres, radians) on the left of ``T_map_odom`` ``(4, 4)``.  An
    alignment by relocalisation comes from one keyframe, and holds until the map has its own.  ``scale`` is
    how many metres the unit of the odometry frame is; its lengths are multiplied by it before.
    """

    T_map_odom: Array | None = None
    covariance: Array | None = None
    by: AlignedBy = "nothing"
    reason: str = NOT_ASKED
    scale: float = 1.0

    def in_map(self, T_odom_camera: Array) -> Array | None:
        """Return a pose of the odometry frame in the map, metres; None while it is not aligned."""
        if self.T_map_odom is None:
            return None
        placed: Array = self.T_map_odom @ scaled(T_odom_camera, self.scale)
        return placed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correction:
    """The alignment of a segment changed: every later ``T_map_camera`` uses the new one.

    ``before`` and ``after`` are ``T_map_odom`` ``(4, 4)``, None where the segment was or is not aligned.
    ``cause`` is the robot and the number of the keyframe that made the map change, if one did.  ``scale`` is
    how many metres the unit of the segment is, 1 where it has metres.
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
    """Where another robot made its newest keyframe; ``T_map_camera`` is None while it is not aligned."""

    T_map_camera: Array | None
    timestamp_s: float | None
    reason: str


class Alignments:
    """The newest known state of one live map, as one robot sees it."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self.version = 0
        self.map_keyframes = 0
        self.map_state = ""
        self.owner = ""
        self.others: dict[str, OtherRobot] = {}
        self._me = ""
        self._first_segment = 0
        self._segments: dict[int, SegmentAlignment] = {}

    def know_myself(self, robot: str, first_segment: int) -> list[Correction]:
        """Take the robot's name in the map, and the map's number of the robot's segment 0.

        Another number of it means that the map began anew, so that no alignment holds any longer.
        """
        began_anew = bool(self._me) and first_segment != self._first_segment
        self._me, self._first_segment = robot, first_segment
        self.others.pop(robot, None)
        return self.forget("the map began anew") if began_anew else []

    def forget(self, reason: str) -> list[Correction]:
        """Forget every alignment."""
        self.others.clear()
        return [
            change
            for segment in list(self._segments)
            if (change := self._set(segment, SegmentAlignment(reason=reason), None)) is not None
        ]

    def of(self, segment: int) -> SegmentAlignment:
        """Return the alignment of a segment of this robot."""
        return self._segments.get(segment, _UNKNOWN)

    def updated(self, key: str, payload: Any) -> Correction | None:
        """Take an update of the map's topic; return the correction that it is, if it is one.

        Raises:
            BadMessage: The payload does not fit its key; nothing has changed.
        """
        kind = key.partition("/")[0]
        if kind == "map":
            self._take_map(as_type(payload, MapUpdate))
        elif kind == "pose":
            self._take_pose(as_type(payload, PoseUpdate))
        elif kind == "alignment":
            return self._take_alignment(as_type(payload, AlignmentUpdate))
        return None

    def relocalised(self, segment: int, T_odom_camera: Array, reply: RelocaliseReply) -> Correction | None:
        """Take the answer to a keyframe of *segment*; what the map itself found wins over it.

        Raises:
            BadMessage: It says ``ok`` without a pose.
        """
        if self.of(segment).by == "map":
            return None
        if reply.verdict != "ok" or reply.T_map_camera is None:
            why = f"not relocalised: {reply.reason or reply.verdict}"
            kept = self.of(segment)
            if kept.by == "nothing":
                self._segments[segment] = SegmentAlignment(reason=why)
            return None
        found = SegmentAlignment(
            T_map_odom=_pose(reply.T_map_camera) @ inverse(scaled(T_odom_camera, _scale(reply.scale))),
            covariance=_covariance(reply.covariance),
            by="relocalisation",
            reason="",
            scale=_scale(reply.scale),
        )
        self.version = max(self.version, reply.version)
        return self._set(segment, found, None)

    def _take_map(self, update: MapUpdate) -> None:
        self.version, self.map_keyframes = update.version, update.keyframes
        self.map_state, self.owner = update.state, update.owner

    def _take_pose(self, update: PoseUpdate) -> None:
        if update.robot != self._me:
            self.others[update.robot] = OtherRobot(
                T_map_camera=_pose(update.T_map_camera), timestamp_s=update.timestamp_s, reason=""
            )

    def _take_alignment(self, update: AlignmentUpdate) -> Correction | None:
        self.version = max(self.version, update.version)
        if update.robot != self._me:
            if not update.aligned:
                self.others[update.robot] = OtherRobot(
                    T_map_camera=None, timestamp_s=None, reason=update.reason
                )
            return None
        segment = update.segment - self._first_segment
        if segment < 0:
            return None  # of an earlier run of this robot
        if not update.aligned:
            kept = self.of(segment)
            if kept.by == "relocalisation" and not update.reason.startswith("ambiguous"):
                return None
            return self._set(segment, SegmentAlignment(reason=update.reason or "not aligned"), update)
        if update.T_map_odom is None:
            raise BadMessage("an alignment without T_map_odom", hint="update the server")
        found = SegmentAlignment(
            T_map_odom=_pose(update.T_map_odom),
            covariance=_covariance(update.covariance),
            by="map",
            reason="",
            scale=_scale(update.scale),
        )
        return self._set(segment, found, update)

    def _set(
        self, segment: int, found: SegmentAlignment, update: AlignmentUpdate | None
    ) -> Correction | None:
        """Keep *found*, and return the correction if the transform changed."""
        before, scale = self.of(segment).T_map_odom, self.of(segment).scale
        self._segments[segment] = found
        after = found.T_map_odom
        is_equal = before is not None and after is not None and np.array_equal(before, after)
        if before is after or (is_equal and scale == found.scale):
            return None
        cause = None if update is None or update.cause is None else (update.cause.robot, update.cause.number)
        return Correction(
            segment=segment,
            before=before,
            after=after,
            covariance=found.covariance,
            by=found.by,
            reason=found.reason,
            version=self.version,
            cause=cause,
            scale=found.scale,
        )


_UNKNOWN = SegmentAlignment()


def _pose(numbers: Any) -> Array:
    """Return the ``(4, 4)`` pose of 16 finite numbers; raises BadMessage."""
    pose = np.array(numbers, dtype=np.float64).ravel()
    if pose.shape != (16,) or not np.isfinite(pose).all():
        raise BadMessage("a pose needs 16 finite numbers", hint="update the server")
    return pose.reshape(4, 4)


def _scale(scale: float | None) -> float:
    """Return how many metres a unit is; raises BadMessage where it is none."""
    if scale is None:
        return 1.0
    if not 0.0 < scale < math.inf:
        raise BadMessage("a scale is above 0 and finite", hint="update the server")
    return scale


def _covariance(numbers: Any) -> Array | None:
    """Return the ``(6, 6)`` covariance of the 21 numbers of its upper triangle; raises BadMessage."""
    if numbers is None:
        return None
    upper = np.array(numbers, dtype=np.float64).ravel()
    if upper.shape != (21,) or not np.isfinite(upper).all():
        raise BadMessage("a covariance needs 21 finite numbers", hint="update the server")
    covariance = np.zeros((6, 6))
    covariance[_UPPER] = upper
    covariance.T[_UPPER] = upper
    return covariance
