"""Decisions about a live map, as values: the rules return them, and `MapGraph.apply` carries them out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rse_pf.geometry import Array
from rse_pf.live_map.events import MeasuredLoopClosure
from rse_pf.live_map.outcomes import Corrected, Joined, Unaligned

__all__ = [
    "AcceptEdges",
    "AddEdges",
    "CompareEdges",
    "Decision",
    "ExcludeSegment",
    "Fit",
    "JoinComponents",
    "MarkAliases",
    "RecordContradictions",
    "RecordMisfits",
    "RejectEdges",
    "StateReason",
]

Fit = Literal["agrees", "vague", "contrary"]
"""How a loop closure within one component fits the pose graph: it *agrees* with the poses of its keyframes;
or it agrees, but these poses are too uncertain to confirm it (*vague*); or it is *contrary* to them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AddEdges:
    """Add the loop closures that were measured for ``keyframe``; they are pending."""

    keyframe: int
    measured: Sequence[MeasuredLoopClosure]


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareEdges:
    """State how loop closures of full weight within one component fit the graph; the graph does not change.

    By ``fits`` a keyframe is recorded as contradicting the map.  Loop closures at perceptual aliases say
    nothing about the robot that made them; their fit is "alias", which is no contradiction.
    """

    fits: set[Fit | Literal["alias"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptEdges:
    """Accept the pending loop closures ``numbers``, each of which is within one component."""

    numbers: Sequence[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectEdges:
    """Reject the pending or accepted loop closures ``numbers``; components may fall apart."""

    numbers: Sequence[int]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JoinComponents:
    """Move the component ``moving`` into the frame of another one, and accept loop closures between both.

    ``scale`` is the length of the unit of the moved component in the unit of the other one; lengths of the
    moved component are multiplied by ``scale`` before ``T_stay_moving`` ``(4, 4)`` is applied.  ``numbers``
    are those of the pending loop closures that agree on this pose.
    """

    moving: int
    T_stay_moving: Array
    scale: float
    numbers: Sequence[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkAliases:
    """Mark ``keyframes`` as perceptual aliases: the places they are at look like another place of the map."""

    keyframes: Sequence[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class StateReason:
    """Note why the segments ``rows`` have no alignment; if ``is_reported``, also report it as `Ambiguous`."""

    rows: Sequence[int]
    reason: str
    is_reported: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordMisfits:
    """Record, by number, in how many smoothings in a row an accepted loop closure has misfitted the graph."""

    misfits: Mapping[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordContradictions:
    """Set the record of contradictions of segment ``row`` to the bits ``contradictions``."""

    row: int
    contradictions: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ExcludeSegment:
    """Take out all loop closures of segment ``row``, and ignore its later ones; its keyframes stay."""

    row: int
    reason: str


Decision = (
    AddEdges
    | CompareEdges
    | AcceptEdges
    | RejectEdges
    | JoinComponents
    | MarkAliases
    | StateReason
    | RecordMisfits
    | RecordContradictions
    | ExcludeSegment
    | Joined
    | Corrected
    | Unaligned
)
"""What the rules decide.  Reports of alignments are decisions as well: the graph notes what was sent."""
