"""What an event changed in a live map, as values: the map server logs them and notifies robots."""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.geometry import Array

__all__ = [
    "Added",
    "Alignment",
    "Ambiguous",
    "Corrected",
    "Culled",
    "Joined",
    "LoopClosureAccepted",
    "LoopClosureRejected",
    "OptimiseWanted",
    "Outcome",
    "Unaligned",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Added:
    """A keyframe was added to the map; ``id`` is its position in order of arrival, from 0."""

    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """A segment of a robot is aligned with the map from now on.

    ``links`` counts the accepted loop closures that have one end or both ends in this segment.
    """

    robot: str
    segment: int
    links: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corrected:
    """The alignment of a robot's segment with the map changed, or the segment has one now, or again.

    ``T_map_odom`` ``(4, 4)`` maps from the odometry frame of the segment to the frame of the map.
    ``covariance`` ``(6, 6)`` is that of its left twist (metres, radians).  ``cause`` is the keyframe (robot,
    number) whose event changed the alignment, None if an optimisation or the removal of a robot did.
    ``scale`` is the length in metres of the segment's unit, by which translations of the odometry are
    multiplied before ``T_map_odom`` is applied; None if the odometry is in metres.
    """

    robot: str
    segment: int
    T_map_odom: Array
    covariance: Array
    cause: tuple[str, int] | None
    scale: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Unaligned:
    """A segment lost its alignment with the map; ``reason`` is a sentence for the operator."""

    robot: str
    segment: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopClosureAccepted:
    """The loop closure between the keyframes ``a`` and ``b`` is an edge of the pose graph from now on."""

    a: int
    b: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopClosureRejected:
    """The loop closure between the keyframes ``a`` and ``b`` was taken out of the graph as an outlier."""

    a: int
    b: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimiseWanted:
    """The whole pose graph should be optimised in the background, by `LiveMap.prepare_optimisation`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ambiguous:
    """A segment cannot be aligned: it may be at one of several equal places, or it contradicts the map.

    ``reason`` is a sentence for the operator.
    """

    robot: str
    segment: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Culled:
    """The features of the keyframes ``ids`` were dropped; their poses and loop closures stay."""

    ids: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """The alignment of a robot's segment with the map as the robot was last sent it.

    ``reason`` says why there is none, else it is empty.  The other fields are those of `Corrected`, None
    without an alignment.
    """

    robot: str
    segment: int
    aligned: bool
    reason: str
    T_map_odom: Array | None
    covariance: Array | None
    scale: float | None = None


Outcome = (
    Added
    | Joined
    | Corrected
    | Unaligned
    | LoopClosureAccepted
    | LoopClosureRejected
    | OptimiseWanted
    | Ambiguous
    | Culled
)
