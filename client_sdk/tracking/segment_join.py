"""Joins of two segments of a drive: the result, and the measurements before."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from client_sdk.tracking.landmark_matching import MAX_JOIN_DIFFERENCE_DEG
from client_sdk.wheel_odometry import WheelMotion
from rse_pf.geometry import Array, pose_difference, rotation_angle_deg, transform

__all__ = [
    "CONTRADICTED",
    "NOT_JOINED",
    "REPEATED",
    "Join",
    "JoinCandidate",
    "WheelConnection",
    "carried_segment_after",
    "connections_between",
    "is_join_expected",
    "root_of",
    "without_segment",
]

NOT_JOINED = "in a segment that is not joined to the first one yet"
"""`TrackedFrame.reason` of a frame that has a pose, but in the world of its own segment and not in that of
the first segment."""
CONTRADICTED = "the image shows another place than the wheels tell"
"""`TrackedFrame.reason` of a frame without a pose: the robot was carried, or something hides the view."""
REPEATED = "the image repeats while the wheels turn"
"""`TrackedFrame.reason` of a frame whose image is that of the frame before, although the wheels moved."""
_MAX_JOIN_DIFFERENCE_M = 0.15
"""Largest translation, in metres, between two measurements of the pose of one segment in another one, for the
two to confirm each other."""

_SIGMAS = 3.0
"""Largest rotation between the worlds of two segments that wheels connect, in standard deviations."""
_CARRIED_SHARE = 4
"""A segment whose first pose is carried by wheels begins after this share of the unrecognised frames: it
begins at its place, so that little is lost if an older place would have been recognised soon.  With the
default of 10 it begins with the fourth frame, within a second at 5 Hz."""


def carried_segment_after(segment_after: int) -> int:
    """Return after how many unrecognised frames a segment begins whose first pose the wheels have carried.

    It is a quarter of *segment_after*, the number without wheels, rounded up.
    """
    return -(-segment_after // _CARRIED_SHARE)


def root_of(anchors: Mapping[int, int], segment: int) -> int:
    """Return the number of the segment in whose world a segment is, by connections as in `without_segment`.

    It is its own number if wheels have not connected it.
    """
    while segment in anchors:
        segment = anchors[segment]
    return segment


def connections_between(anchors: Mapping[int, int], first: int, second: int) -> list[int]:
    """Return the segments whose connections by wheels lead from one segment to another one of its world."""
    on_way: set[int] = set()
    for segment in (first, second):
        while segment in anchors:
            on_way ^= {segment}  # connections that both have in common do not move one against the other
            segment = anchors[segment]
    return sorted(on_way)


def without_segment(anchors: Mapping[int, int], segment: int) -> dict[int, int]:
    """Return the connections by wheels, as segment and segment before it, after *segment* was joined.

    Segments that continued its world continue that which it had continued; they are not connected any more
    if there is none.
    """
    kept = {number: anchor for number, anchor in anchors.items() if segment not in (number, anchor)}
    if segment in anchors:
        kept.update({number: anchors[segment] for number, anchor in anchors.items() if anchor == segment})
    return kept


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WheelConnection:
    """Motion by wheels from the last pose of a segment to the first one of the next segment.

    Attributes:
        position: ``(3,)`` of the camera at that first pose, world.
        motion: The motion; its deviations tell how far the worlds of both segments may be apart.
    """

    position: Array
    motion: WheelMotion

    def moved(self, T_new_old: Array) -> WheelConnection:
        """Return the connection in another world, by ``T_new_old`` ``(4, 4)``."""
        return replace(self, position=transform(T_new_old, self.position[None])[0])


def is_join_expected(connections: Iterable[WheelConnection], T_other_present: Array, here: Array) -> bool:
    """Return whether the motion by wheels allows a measurement of where one segment lies in another one.

    Args:
        connections: All connections on the way from one segment to the other.
        T_other_present: ``(4, 4)``, the measurement; the identity if the wheels have no error.
        here: ``(3,)``, position of the camera in the present segment.
    """
    reach_m = reach_rad = 0.0
    for connection in connections:
        turn_rad = _SIGMAS * connection.motion.heading_deviation_rad
        reach_rad += turn_rad
        reach_m += connection.motion.reach_m + turn_rad * float(np.linalg.norm(here - connection.position))
    moved_m = float(np.linalg.norm(transform(T_other_present, here[None])[0] - here))
    return moved_m <= reach_m and math.radians(rotation_angle_deg(T_other_present[:3, :3])) <= reach_rad
