"""What a robot's side of the protocol tells whoever holds its sockets.

Promises to be values only: the rules that make them are in `rse_pf.wire.client_session`.
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.wire.messages import Failure, Result, Welcome

__all__ = ["Answered", "Event", "LinkLost", "MoveAsked", "Notice", "Progressed", "RenewalDue", "Welcomed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A command came to its end.

    ``sent_s`` is when the robot took it (its clock); ``up_s`` and ``down_s`` are the paper's two
    one-way delays, None where no clock offset is known; ``wire_bytes`` is what it weighed.
    """

    id: int
    answer: Result | Failure
    sent_s: float
    wire_bytes: int = 0
    up_s: float | None = None
    down_s: float | None = None


@dataclass(frozen=True, slots=True)
class Welcomed:
    """The link is open; the session sends on it from now on."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class MoveAsked:
    """The server wants the robot elsewhere."""

    reason: str
    within_s: float


@dataclass(frozen=True, slots=True)
class LinkLost:
    """The link is dead although its socket may look alive."""

    reason: str


@dataclass(frozen=True, slots=True)
class Notice:
    """The server complains about a message or the session, not about one command."""

    failure: Failure


@dataclass(frozen=True, slots=True)
class Progressed:
    """A long command is so far: the share *done* (0..1), and *what* was done last."""

    id: int
    done: float
    what: str


@dataclass(frozen=True, slots=True)
class RenewalDue:
    """The link ends soon unless a fresh token is shown: see `RobotSession.renew`."""


Event = RenewalDue | Answered | Welcomed | MoveAsked | LinkLost | Notice | Progressed
