"""Decide which command runs next, and which is refused because it would wait for too long.

- Order: fair between tenants, then between the robots of a tenant (`FairQueue`).  At most one command of a
  robot runs at a time.
- Streams: the newest frame of a stream replaces the one that waits, and inherits its position, unless one of
  them was sent with ``keep``.
- Deadlines: a command whose deadline has passed never runs.
- Overload: `OverloadControl` decides from the expected wait which commands are refused.

The scheduler has no thread and no clock: commands and times go in, commands and refusals come out.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from rse_pf.errors import Busy, Expired, Stale
from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import FairQueue
from rse_pf.server.scheduling.command_queue import QueueBacklog, QueuedCommand, RefusedCommand
from rse_pf.server.scheduling.overload import PAUSE_S, OverloadControl, WaitPerPosition, is_too_late

__all__ = ["BEHIND", "BEHIND_HINT", "INLINE_BYTES", "Scheduler", "behind_error", "expired_error"]

BEHIND = "the server is overloaded: the command would wait for too much of its deadline"
BEHIND_HINT = "send the command again after retry_after_ms; add servers if this happens often"

INLINE_BYTES = 16_384  # a larger command is computed in a thread: decoding it would delay other robots
SHORT_COMPUTE_S = 0.001  # passing a command to a thread costs 0.1 ms of CPU and up to 5 ms of waiting for it
MIN_SHORT_SHARE = 0.8  # of the last commands: some are long only because the process was interrupted
SHORT_SHARE_SMOOTHING = 0.1  # weight of the last command in that share: about ten commands count


class Scheduler:
    """The waiting and running commands of one queue."""

    def __init__(self, max_running: float = math.inf) -> None:
        """Hold no command yet; at most *max_running* run at a time."""
        self.running = 0
        self._max_running = max_running
        self._queue: FairQueue[QueuedCommand] = FairQueue(max_running_per_robot=1)
        self._overload = OverloadControl()
        self._wait_per_position = WaitPerPosition()
        self._short_share = 0.0

    @property
    def waiting(self) -> int:
        """How many commands wait."""
        return len(self._queue)

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*: nothing if it replaces a waiting frame."""
        waiting = self._queue.items_of(queued.robot)
        if _frame_to_replace(waiting, queued) is not None:
            return QueueBacklog()
        return QueueBacklog(len(waiting), self._pause_s(queued.robot, queued.allowed_s))

    def unread_pause_s(self, robot: RobotId, allowed_s: float) -> float:
        """Return the pause of *robot* in seconds if its undecoded command would wait too long; 0 accepts it.

        The deadline of the command is not known yet.  *allowed_s*, the time that the robot's last command had
        from its arrival to its deadline, is used instead.  The command is accepted if the robot has a waiting
        frame that it may replace.
        """
        if any(map(_is_replaceable, self._queue.items_of(robot))):
            return 0.0
        return self._pause_s(robot, allowed_s)

    def submit(self, queued: QueuedCommand) -> list[RefusedCommand]:
        """Queue *queued*, which was admitted; return the older frame of its stream, which it replaces."""
        waiting = self._queue.items_of(queued.robot)
        older = _frame_to_replace(waiting, queued)
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
        """Start the next command, unless as many run as may; *now* is in seconds.

        Returns:
            The command, which runs from now on, or None; and the commands before it that waited for too long.
        """
        refusals: list[RefusedCommand] = []
        if self.running >= self._max_running:
            return None, refusals
        while (queued := self._queue.take()) is not None:
            self._wait_per_position.note(now - queued.queued_s, queued.position)
            if queued.deadline_s > now and not is_too_late(now - queued.received_s, queued.allowed_s):
                queued.started_s = now
                self.running += 1
                return queued, refusals
            self._queue.release(queued.robot)
            refusals.append(_refuse_late(queued, now))
        return None, refusals

    def start_unqueued(self, queued: QueuedCommand, now: float) -> bool:
        """Start *queued* without queueing it; False if commands wait or run, or its deadline has passed.

        `finish_unqueued` must be called when it is computed.
        """
        if self._queue or self.running or queued.deadline_s <= now:
            return False
        self._overload.note_accepted(queued.robot.tenant, now)
        self._wait_per_position.note(0.0, 1)
        queued.started_s = now
        self.running = 1
        return True

    def finish_unqueued(self, queued: QueuedCommand, now: float) -> None:
        """Note that a command which `start_unqueued` started is computed."""
        self.running = 0
        self._note_compute(now - queued.started_s)

    def done(self, queued: QueuedCommand, now: float) -> None:
        """Note that *queued* is computed; another command of its robot may run."""
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
        """Return whether the command that was just started may run in the event loop.

        It may if it is small, and if a thread would save no time: nothing else waits, or most of the last
        commands took less time than passing the interpreter lock to another thread.
        """
        saves_time = not self._queue or self._short_share >= MIN_SHORT_SHARE
        return cheap and size_bytes <= INLINE_BYTES and saves_time and self.running <= 1

    def _pause_s(self, robot: RobotId, allowed_s: float) -> float:
        expected_wait_s = (self._queue.position(robot) - 1) * self._wait_per_position.mean_s
        return self._overload.pause_s(robot.tenant, expected_wait_s, allowed_s)

    def _note_compute(self, spent_s: float) -> None:
        self._short_share += SHORT_SHARE_SMOOTHING * ((spent_s <= SHORT_COMPUTE_S) - self._short_share)


def behind_error(pause_s: float) -> Busy:
    """Return the error of a command that waited or would wait for too long; its robot pauses *pause_s*."""
    return Busy(BEHIND, hint=BEHIND_HINT, retry_after_ms=1e3 * pause_s)


def expired_error(queued: QueuedCommand, now: float) -> Expired:
    """Return the error of a command whose deadline passed before its turn."""
    waited_ms = (now - queued.received_s) * 1e3
    return Expired(
        f"its deadline passed after {waited_ms:.0f} ms in the queue",
        hint="set a longer deadline, or send fewer commands",
    )


def _refuse_late(queued: QueuedCommand, now: float) -> RefusedCommand:
    if queued.deadline_s <= now:
        return RefusedCommand(queued, expired_error(queued, now), "expired")
    return RefusedCommand(queued, behind_error(PAUSE_S), "behind")


def _frame_to_replace(waiting: deque[QueuedCommand], queued: QueuedCommand) -> QueuedCommand | None:
    stream = queued.command.stream
    if not _is_replaceable(queued):
        return None
    return next((w for w in waiting if w.command.stream == stream and not w.command.keep), None)


def _is_replaceable(queued: QueuedCommand) -> bool:
    return bool(queued.command.stream) and not queued.command.keep


def _stale(queued: QueuedCommand) -> RefusedCommand:
    return RefusedCommand(queued, Stale("a newer frame of the stream took its place"), "stale")
