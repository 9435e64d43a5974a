"""Joins of two segments of a drive: the result, and the measurements before."""

from __future__ import annotations

from dataclasses import dataclass

from client_sdk.tracking.landmark_matching import MAX_JOIN_DIFFERENCE_DEG
from rse_pf.geometry import Array, pose_difference

__all__ = ["NOT_JOINED", "Join", "JoinCandidate"]

NOT_JOINED = "in a segment that is not joined to the first one yet"
"""`TrackedFrame.reason` of a frame that has a pose, but in the world of its own segment and not in that of
the first segment."""
_MAX_JOIN_DIFFERENCE_M = 0.15
"""Largest translation, in metres, between two measurements of the pose of one segment in another one, for the
two to confirm each other."""


@dataclass(frozen=True, slots=True)
class Join:
    """A segment became part of another one: poses of *segment* are ``T_into_segment @ pose`` in *into*.

    *segment* is the newer segment, which no longer exists, *into* the older one; both are numbers.  Of a
    camera without depth, all lengths of *segment* are multiplied by *scale* before; with depth *scale* is 1.
    """

    segment: int
    into: int
    T_into_segment: Array
    scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JoinCandidate:
    """Where the present segment may lie in another one, measured once or more often.

    Attributes:
        segment: Number of the other segment.
        T_other_present: ``(4, 4)``, pose of the present segment's world in that of the other one.
        first_position: ``(3,)``, of the camera in the present segment at the first of the measurements in a
            row that agree.
    """

    segment: int
    T_other_present: Array
    first_position: Array

    def agrees_with(self, segment: int, T_other_present: Array) -> bool:
        """Return whether a further measurement confirms this one."""
        apart_m, apart_deg = pose_difference(self.T_other_present, T_other_present)
        is_near = apart_m <= _MAX_JOIN_DIFFERENCE_M and apart_deg <= MAX_JOIN_DIFFERENCE_DEG
        return segment == self.segment and is_near
