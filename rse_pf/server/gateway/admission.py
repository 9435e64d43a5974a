"""Decide whether a command is admitted or refused.

The dispatcher checks these limits in this order, the first three before it decodes a message, when a refusal
costs least:

1. the message rate of the robot (`RobotRates`),
2. the overload of the server, by the deadline of the robot's last command (`Scheduler.unread_pause_s`),
3. for a long message, the bytes that wait for the decoder thread (`Admission.may_wait`),
4. for the decoded command, the scope of the token, the deadline, the number of commands of the robot that
   wait, and the overload by the command's own deadline (`Admission.refusal`).

Values go in and decisions come out: there is no clock, no queue and no connection here.
"""

from __future__ import annotations

from typing import NamedTuple

from rse_pf.auth.roster import scopes_allow
from rse_pf.auth.tokens import Claims
from rse_pf.config import SessionSettings
from rse_pf.errors import Busy, Forbidden
from rse_pf.server.gateway.rate_limits import RobotRates
from rse_pf.server.scheduling.command_queue import QueueBacklog, QueuedCommand, RefusedCommand
from rse_pf.server.scheduling.overload import PAUSE_S
from rse_pf.server.scheduling.scheduler import BEHIND, BEHIND_HINT, behind_error, expired_error

__all__ = ["DECODER_FULL", "TOO_LATE", "Admission", "UnreadRefusal", "is_in_scope"]

MAX_QUEUE_PER_ROBOT = 8  # commands of one robot in one queue: the default of ``session.max_in_flight``
# Bytes of long messages that may wait for the decoder thread of a worker: 64 messages of the greatest size.
_MAX_UNREAD_BYTES = 1 << 24
# Share of `_MAX_UNREAD_BYTES` above which messages of robots that sent undecodable messages before are
# refused, so that such robots cannot fill the decoder's queue.
_SUSPECTS_SHARE = 0.25


class UnreadRefusal(NamedTuple):
    """The text of a failure ``busy``, with which a message is refused before it is decoded.

    ``reason`` is the label under which the metric ``rse_pf_shed_total`` counts the refusal.
    """

    reason: str
    message: str
    hint: str


TOO_LATE = UnreadRefusal("unread", BEHIND, BEHIND_HINT)
DECODER_FULL = UnreadRefusal(
    "unread",
    f"more than {_MAX_UNREAD_BYTES} bytes of long messages wait to be decoded",
    "send the command again after retry_after_ms, or send shorter messages",
)


class Admission:
    """Decides which messages and commands a worker refuses; ``rates`` has the token buckets of its robots."""

    def __init__(self, session: SessionSettings, *, max_queue: int = MAX_QUEUE_PER_ROBOT) -> None:
        self.rates = RobotRates(session)
        self.too_fast = UnreadRefusal(
            "rate",
            f"this robot exceeds its rate of {session.max_commands_per_s:g} messages a second",
            "send fewer messages, or have the operator raise session.max_commands_per_s",
        )
        self._max_queue = max_queue

    def may_wait(self, size_bytes: int, unread_bytes: int, bad_messages: int) -> bool:
        """Return whether a message that is too long for the event loop may wait for the decoder thread.

        The limit for the bytes that wait is `_MAX_UNREAD_BYTES`, and a quarter of that for a robot that sent
        undecodable messages.  If nothing waits, the message is always accepted.

        Args:
            size_bytes: Length of the message on the wire, in bytes.
            unread_bytes: Length of the messages that wait for the decoder thread already, in bytes.
            bad_messages: How many messages of the connection could not be decoded.
        """
        share = _SUSPECTS_SHARE if bad_messages else 1.0
        return not unread_bytes or unread_bytes + size_bytes <= share * _MAX_UNREAD_BYTES

    def refusal(
        self, queued: QueuedCommand, claims: Claims | None, backlog: QueueBacklog
    ) -> RefusedCommand | None:
        """Return the refusal of a decoded command; None if the command is admitted.

        Args:
            queued: The command, with the times of its arrival and of its deadline.
            claims: The claims of the robot's token; None if the scope is not checked here.
            backlog: The load of the queue that *queued* would join, see `CommandQueue.backlog`.
        """
        service = queued.command.service
        if claims is not None and not is_in_scope(service, claims):
            forbidden = Forbidden(
                f"this token does not hold the scope services:{service}", hint="issue one that does"
            )
            return RefusedCommand(queued, forbidden, "scope")
        if queued.allowed_s <= 0:
            return RefusedCommand(queued, expired_error(queued, queued.received_s), "expired")
        if backlog.waiting >= self._max_queue:
            busy = Busy(
                f"{backlog.waiting} commands of this robot wait already, and at most {self._max_queue} may",
                hint="send more slowly, or name a stream, in which newer frames replace older ones",
                retry_after_ms=1e3 * PAUSE_S,
            )
            return RefusedCommand(queued, busy, "robot-queue")
        if backlog.pause_s:
            return RefusedCommand(queued, behind_error(backlog.pause_s), "behind")
        return None


def is_in_scope(service: str, claims: Claims) -> bool:
    """Return whether *claims* allow commands to *service*; a token without scopes allows all services."""
    return not claims.scopes or scopes_allow(claims.scopes, f"services:{service}")
