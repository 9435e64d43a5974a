"""Decide whether a server takes a command: by rate, size, scope, deadline and backlog, in this order.

Rate, size and the backlog of the whole server are judged before a message is decoded, because a refusal is
then cheaper than decoding.  Scope, deadline and the backlog of the robot are judged once the command is
known, whether it goes to the scheduler, to a sandbox or to a job.  Values go in and decisions come out: there
is no clock, no queue and no connection here.
"""

from __future__ import annotations

import msgspec

from rse_pf.auth.roster import scopes_allow
from rse_pf.auth.tokens import Claims
from rse_pf.backend.gateway.rate_limits import CutOff, RobotRates
from rse_pf.backend.scheduling.scheduler import (
    BEHIND,
    BEHIND_HINT,
    QueuedCommand,
    RefusedCommand,
    expired,
    max_wait_s,
    retry_after_ms,
)
from rse_pf.config import ServingSettings, SessionSettings
from rse_pf.errors import Busy, Forbidden

__all__ = ["Admission", "UnreadRefusal"]

_SUSPECTS_SHARE = 0.25
"""Share of ``serving.max_unread_bytes`` that is open to robots which sent undecodable messages before."""


class UnreadRefusal(msgspec.Struct, frozen=True, gc=False):
    """Why a message is refused as ``busy`` before it is decoded."""

    reason: str
    """Label of the metric ``rse_pf_shed_total``."""
    message: str
    hint: str
    retry_after_ms: float


class Admission:
    """The limits of one worker, and how much of its rate each robot has used."""

    def __init__(self, session: SessionSettings, serving: ServingSettings) -> None:
        self.rates = RobotRates(session)
        self._max_unread_bytes = serving.max_unread_bytes
        self._max_queue = serving.max_queue_per_robot

    def judge_rate(self, robot: tuple[str, str], now: float) -> UnreadRefusal | CutOff | None:
        """Return what to do with one more message of *robot* (tenant, name) at *now* (s); None: take it."""
        verdict = self.rates.judge(robot, now)
        if verdict is None or isinstance(verdict, CutOff):
            return verdict
        return UnreadRefusal(
            "rate",
            "this robot sends more than its rate",
            "send fewer, or have the operator raise session.max_commands_per_s",
            verdict.retry_after_ms,
        )

    def judge_delay(self, allowed_s: float, delay_s: float, max_delay_s: float) -> UnreadRefusal | None:
        """Return why a command that is not decoded yet is refused, if its turn would come too late.

        Args:
            allowed_s: Time that the robot's last command had until its deadline; the next is taken for alike.
            delay_s: How long the next command of the robot would wait for its turn.
            max_delay_s: How long commands may wait now; see `Scheduler.max_delay_s`.
        """
        if delay_s <= max_wait_s(allowed_s, max_delay_s):
            return None
        return UnreadRefusal("unread", BEHIND, BEHIND_HINT, retry_after_ms(delay_s))

    def judge_size(self, size_bytes: int, unread_bytes: int, bad_messages: int) -> UnreadRefusal | None:
        """Return why a message that is too long for the event loop is refused, if too much waits to be
        decoded.

        Args:
            size_bytes: Length of the message on the wire.
            unread_bytes: Length of the messages that wait for the decoder thread; one alone is always taken.
            bad_messages: How many messages of the connection could not be decoded.
        """
        share = _SUSPECTS_SHARE if bad_messages else 1.0
        if not unread_bytes or unread_bytes + size_bytes <= share * self._max_unread_bytes:
            return None
        return UnreadRefusal(
            "unread", "too many long messages wait to be read", "try again later, or send less at once", 500.0
        )

    def judge(
        self,
        queued: QueuedCommand,
        claims: Claims | None,
        backlog: tuple[int, float, float],
        max_delay_s: float,
    ) -> RefusedCommand | None:
        """Return why a decoded command is refused; None if it is admitted.

        Args:
            queued: The command, with the times of its arrival and of its deadline.
            claims: What the robot's token says; None where no token is required.
            backlog: How many commands of the robot wait in the queue that *queued* would join, how long it
            would
                wait for its turn, and how long each turn takes, in seconds.
            max_delay_s: How long commands may wait now; see `Scheduler.max_delay_s`.
        """
        service = queued.command.service
        if claims is not None and not scopes_allow(claims.scopes, f"services:{service}"):
            forbidden = Forbidden(
                f"this token does not hold the scope services:{service}", hint="issue one that does"
            )
            return RefusedCommand(queued, forbidden, "scope")
        allowed_s = queued.deadline_s - queued.received_s
        if allowed_s <= 0:
            return RefusedCommand(queued, expired(queued, queued.received_s), "expired")
        waiting, delay_s, turn_s = backlog
        if waiting >= self._max_queue:
            busy = Busy(
                f"{waiting} commands of this robot wait already",
                hint="send slower, or let newer frames replace older ones",
                retry_after_ms=retry_after_ms(waiting * turn_s),
            )
            return RefusedCommand(queued, busy, "robot-queue")
        if delay_s > max_wait_s(allowed_s, max_delay_s):
            busy = Busy(BEHIND, hint=BEHIND_HINT, retry_after_ms=retry_after_ms(delay_s))
            return RefusedCommand(queued, busy, "behind")
        return None
