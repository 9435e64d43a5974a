"""The result of joining two segments of a drive."""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.geometry import Array

__all__ = ["NOT_JOINED", "Join"]

NOT_JOINED = "in a segment that is not joined to the first one yet"
"""`TrackedFrame.reason` of a frame that has a pose, but in the world of its own segment and not in that of
the first segment."""


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
