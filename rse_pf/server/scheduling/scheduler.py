"""Decide which command runs next: fair between tenants and robots, newest frame of a stream first.

At most one command of a robot runs, in the order of `FairQueue`; all that run may be of one tenant, since
each has a deadline.  Within a stream the newest frame replaces the one that waits, unless it says ``keep``.
A command whose deadline passed never runs, and `Overload` says what is refused because it would wait for too
long.  The scheduler has no thread and no clock: commands and times go in, commands and refusals come out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec

from rse_pf.errors import Busy, Expired, RsePfError, Stale
from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import FairQueue
from rse_pf.server.scheduling.overload import PAUSE_S, Overload, TurnTime, is_too_late
from rse_pf.wire import Command

__all__ = [
    "BEHIND",
    "BEHIND_HINT",
    "INLINE_BYTES",
    "QueueBacklog",
    "QueuedCommand",
    "RefusedCommand",
    "Scheduler",
    "behind_error",
    "expired_error",
]

BEHIND = "the server is behind with its work"
BEHIND_HINT = "try again later; another server may have been added"

INLINE_BYTES = 16_384
"""A cheap command up to this size is computed in the event loop when nothing waits."""
SHORT_COMPUTE_S = 0.001  # passing a command to a thread costs 0.1 ms of CPU and up to 5 ms of waiting for it
SHORT_SHARE = (
    0.8  # of the last commands were short: a share, since a process that others interrupt is not slow
)
SMOOTHING = 0.1  # weight of the last command in that share: about ten commands count


class QueuedCommand(msgspec.Struct, eq=False):
    """One command from its arrival to its answer; ``owner`` is the connection that waits for the answer.

    A frame that replaces a waiting one inherits its ``position`` in the queue and ``queued_s``, the time at
    which that position was taken.
    """

    owner: Any
    robot: RobotId
    command: Command
    size_bytes: int
    received_s: float
    deadline_s: float
    started_s: float = 0.0
    position: int = 1
    queued_s: float = 0.0

    @property
    def allowed_s(self) -> float:
        """Time from its arrival to its deadline."""
        return self.deadline_s - self.received_s


class QueueBacklog(NamedTuple):
    """What would delay one more command of a robot.

    Attributes:
        waiting: How many commands of the robot wait in the same queue.
        pause_s: For how long the robot pauses because the command would wait for too long; 0 accepts it.
    """

    waiting: int = 0
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RefusedCommand:
    """A command that ends without compute; ``reason`` is a label of the metric ``rse_pf_shed_total``."""

    queued: QueuedCommand
    error: RsePfError
    reason: str


class Scheduler:
    """The queue of one worker."""

    def __init__(self) -> None:
        self.running = 0
        self._queue: FairQueue[QueuedCommand] = FairQueue(max_running_per_robot=1)
        self._overload = Overload()
        self._turn = TurnTime()
        self._short_share = 0.0

    @property
    def waiting(self) -> int:
        """How many commands wait."""
        return len(self._queue)

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*: nothing if it replaces another frame."""
        waiting = self._queue.items_of(queued.robot)
        if _replaceable(waiting, queued) is not None:
            return QueueBacklog()
        return QueueBacklog(len(waiting), self._pause_s(queued.robot, queued.allowed_s))

    def unread_pause_s(self, robot: RobotId, allowed_s: float) -> float:
        """Return the pause of a robot, in seconds, if its next command would wait too long; 0 accepts it.

        The command is not decoded yet, so its deadline is not known: *allowed_s*, the time that the robot's
        last command had until its deadline, stands for it.  A command that may replace a waiting frame of
        its stream is accepted.
        """
        if any(map(_is_replaceable, self._queue.items_of(robot))):
            return 0.0
        return self._pause_s(robot, allowed_s)

    def submit(self, queued: QueuedCommand) -> list[RefusedCommand]:
        """Queue *queued*, which was admitted; return the frame of its stream that ends instead."""
        waiting = self._queue.items_of(queued.robot)
        older = _replaceable(waiting, queued)
        if older is not None:
            if queued.command.seq < older.command.seq:
                return [_stale(queued)]
            queued.position, queued.queued_s = older.position, older.queued_s
            waiting[waiting.index(older)] = queued
            return [_stale(older)]
        self._overload.note_accepted(queued.robot.tenant, queued.received_s)
        queued.position, queued.queued_s = self._queue.position(queued.robot), queued.received_s
        self._queue.add(queued.robot, queued)
        return []

    def start(self, now: float) -> tuple[QueuedCommand | None, list[RefusedCommand]]:
        """Return the command whose turn it is, now running, and those that were given up on the way."""
        refusals: list[RefusedCommand] = []
        while (queued := self._queue.take()) is not None:
            self._turn.note(now - queued.queued_s, queued.position)
            if queued.deadline_s > now and not is_too_late(now - queued.received_s, queued.allowed_s):
                queued.started_s = now
                self.running += 1
                return queued, refusals
            self._queue.release(queued.robot)
            refusals.append(_refuse_late(queued, now))
        return None, refusals

    def start_unqueued(self, queued: QueuedCommand, now: float) -> bool:
        """Start *queued* without a place in the queue; False if others wait or run, or it is too late.

        `finish_unqueued` ends the command.
        """
        if self._queue or self.running or queued.deadline_s <= now:
            return False
        self._overload.note_accepted(queued.robot.tenant, now)
        self._turn.note(0.0, 1)
        queued.started_s = now
        self.running = 1
        return True

    def finish_unqueued(self, queued: QueuedCommand, now: float) -> None:
        """Note the end of the compute of a command that `start_unqueued` started."""
        self.running = 0
        self._note_compute(now - queued.started_s)

    def done(self, queued: QueuedCommand, now: float) -> None:
        """Note that the compute of *queued* ended; another command of its robot may run."""
        self.running -= 1
        self._note_compute(now - queued.started_s)
        self._queue.release(queued.robot)

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Drop the waiting commands of a connection that ended, and return them."""
        return self._queue.remove(lambda queued: queued.owner is owner) if self._queue else []

    def oldest_wait_s(self, now: float) -> float:
        """Return the age of the oldest waiting command."""
        return max(0.0, now - min((queued.received_s for queued in self._queue), default=now))

    def runs_inline(self, *, cheap: bool, size_bytes: int) -> bool:
        """Return whether the command just started may run in the event loop.

        It may if it is small and no thread would save time: nothing else waits, or it is answered sooner than
        two threads pass the interpreter lock to each other.
        """
        saves_time = not self._queue or self._short_share >= SHORT_SHARE
        return cheap and size_bytes <= INLINE_BYTES and saves_time and self.running <= 1

    def _pause_s(self, robot: RobotId, allowed_s: float) -> float:
        expected_wait_s = (self._queue.position(robot) - 1) * self._turn.mean_s
        return self._overload.pause_s(robot.tenant, expected_wait_s, allowed_s)

    def _note_compute(self, spent_s: float) -> None:
        self._short_share += SMOOTHING * ((spent_s <= SHORT_COMPUTE_S) - self._short_share)


def behind_error(pause_s: float) -> Busy:
    """Return the error of a command that would wait for too long, or did; its robot pauses for *pause_s*."""
    return Busy(BEHIND, hint=BEHIND_HINT, retry_after_ms=1e3 * pause_s)


def expired_error(queued: QueuedCommand, now: float) -> Expired:
    """Return the error of a command whose deadline passed before its turn."""
    waited_ms = (now - queued.received_s) * 1e3
    return Expired(
        f"its deadline passed after {waited_ms:.0f} ms in the queue", hint="allow more time, or send fewer"
    )


def _refuse_late(queued: QueuedCommand, now: float) -> RefusedCommand:
    if queued.deadline_s <= now:
        return RefusedCommand(queued, expired_error(queued, now), "expired")
    return RefusedCommand(queued, behind_error(PAUSE_S), "behind")


def _replaceable(waiting: deque[QueuedCommand], queued: QueuedCommand) -> QueuedCommand | None:
    stream = queued.command.stream
    if not _is_replaceable(queued):
        return None
    return next((w for w in waiting if w.command.stream == stream and not w.command.keep), None)


def _is_replaceable(queued: QueuedCommand) -> bool:
    return bool(queued.command.stream) and not queued.command.keep


def _stale(queued: QueuedCommand) -> RefusedCommand:
    return RefusedCommand(queued, Stale("a newer frame of the stream took its place"), "stale")
