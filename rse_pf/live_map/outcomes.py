"""What an event changed in a live map, as values: the owner logs them and tells the robots."""

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
    """A keyframe is in the map; ``id`` is its position in order of arrival."""

    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """A segment is aligned with the map from here on, by so many links."""

    robot: str
    segment: int
    links: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corrected:
    """The alignment of an aligned segment moved, because of keyframe ``cause`` = (robot, number).

    ``covariance`` ``(6, 6)`` is of the twist (metres, radians) on the left of ``T_map_odom``.  ``scale`` is
    how many metres the unit of the segment is, by which its lengths are multiplied before; None if it has
    metres.
    """

    robot: str
    segment: int
    T_map_odom: Array
    covariance: Array
    cause: tuple[str, int] | None
    scale: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Unaligned:
    """A segment that was aligned is no longer."""

    robot: str
    segment: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopClosureAccepted:
    """A link between keyframes ``a`` and ``b`` holds poses together from here on."""

    a: int
    b: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopClosureRejected:
    """A link that was believed is no longer."""

    a: int
    b: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimiseWanted:
    """The whole graph fits badly: run `LiveMap.optimise` in the background."""

    misfit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Ambiguous:
    """Links would join a segment, but cannot tell which of several equal places it sees."""

    robot: str
    segment: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Culled:
    """Redundant keyframes are gone; what they said is kept in the links of the others."""

    ids: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """Where the newest segment of a robot lies in the map, or the reason why that is unknown.

    ``scale`` is that of `Corrected`.
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
