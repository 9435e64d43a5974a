"""The events that `rse_pf.wire.client_session` returns to the owner of a robot's sockets."""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.wire.messages import Failure, Result, Welcome

__all__ = [
    "Answered",
    "ConnectionLost",
    "Event",
    "MoveRequested",
    "Notice",
    "Progressed",
    "RenewalDue",
    "Welcomed",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A command ended.

    ``sent_s`` is when the robot accepted it (its clock); ``up_s`` and ``down_s`` are the paper's two
    one-way delays, None where no clock offset is known; ``wire_bytes`` is the size of its message.
    """

    id: int
    answer: Result | Failure
    sent_s: float
    wire_bytes: int = 0
    up_s: float | None = None
    down_s: float | None = None


@dataclass(frozen=True, slots=True)
class Welcomed:
    """The server accepted the connection; the session sends on it from now on."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class MoveRequested:
    """The server asks the robot to connect to another server."""

    reason: str
    within_s: float


@dataclass(frozen=True, slots=True)
class ConnectionLost:
    """The connection is lost, although its socket may still be open."""

    reason: str


@dataclass(frozen=True, slots=True)
class Notice:
    """The server reports a failure of a message or of the session, not of one command."""

    failure: Failure


@dataclass(frozen=True, slots=True)
class Progressed:
    """Progress of a long command: the share *done* (0..1), and *what* was done last."""

    id: int
    done: float
    what: str


@dataclass(frozen=True, slots=True)
class RenewalDue:
    """The connection expires soon unless a fresh token is sent: see `ClientSession.renew`."""


Event = RenewalDue | Answered | Welcomed | MoveRequested | ConnectionLost | Notice | Progressed
