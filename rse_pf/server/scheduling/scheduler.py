"""Decide which command of a queue is computed next, and which commands are refused.

A command passes these steps:

1. Admission (`Scheduler.backlog`): it is refused if `OverloadControl` finds the expected wait too long.  The
   rule is random early detection (Floyd and Jacobson 1993).
2. Replacement (`Scheduler.submit`): a frame, which is a command with a stream and without ``keep``, replaces
   the waiting frame of the same robot and stream.  The newer frame takes over the position in the queue, and
   the older one is refused as stale.
3. Order (`Scheduler.start`): next is the tenant with the fewest running commands, then the robot of that
   tenant with the fewest; of several, the one that has waited longest (`FairQueue`: fair queueing, Nagle
   1987).  At most one command of a robot runs at a time, and a robot's commands start first in, first out.
4. Deadline (`Scheduler.start`): a command whose deadline has passed, or that has waited for too long
   (`is_too_late`), is refused instead of being started, and step 3 is repeated.

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

# Bytes on the wire: a larger command is neither decoded nor computed in the event loop, which it would delay.
INLINE_BYTES = 16_384
# Seconds of computation up to which a command counts as short: passing a command to a thread costs 0.1 ms of
# CPU time, and up to 5 ms until the thread has the interpreter lock.
SHORT_COMPUTE_S = 0.001
# Share of short commands from which the event loop computes commands although others wait: not 1, because
# some commands take long only since the process was interrupted.
MIN_SHORT_SHARE = 0.8
SHORT_SHARE_SMOOTHING = 0.1  # weight of the newest command in that share: about the last ten commands count


class Scheduler:
    """The waiting and running commands of one queue; ``running`` is the number of the latter."""

    def __init__(self, max_running: float = math.inf) -> None:
        """Hold no command yet; at most *max_running* commands run at the same time."""
        self.running = 0
        self._max_running = max_running
        self._queue: FairQueue[QueuedCommand] = FairQueue(max_running_per_robot=1)
        self._overload = OverloadControl()
        self._wait_per_position = WaitPerPosition()
        self._short_share = 0.0

    @property
    def waiting(self) -> int:
        """Number of commands that wait."""
        return len(self._queue)

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return how many commands of the robot wait, and the pause if *queued* must be refused for overload.

        Both are 0 if *queued* would replace a waiting frame, since it takes no further position.
        """
        waiting = self._queue.items_of(queued.robot)
        if _frame_to_replace(waiting, queued) is not None:
            return QueueBacklog()
        return QueueBacklog(len(waiting), self._pause_s(queued.robot, queued.allowed_s))

    def unread_pause_s(self, robot: RobotId, allowed_s: float) -> float:
        """Return 0 to accept an undecoded command of *robot*, or refuse it and return its pause in seconds.

        The deadline of the command is not known yet, so *allowed_s* is that of the robot's last command:
        seconds from its arrival to its deadline.  The command is also accepted if a frame of the robot waits,
        which it may replace.
        """
        if any(map(_is_replaceable, self._queue.items_of(robot))):
            return 0.0
        return self._pause_s(robot, allowed_s)

    def submit(self, queued: QueuedCommand) -> list[RefusedCommand]:
        """Queue *queued*, which was admitted; return the refusal of the frame that is replaced, if any.

        If a frame of the same stream waits, the one of the two with the smaller ``seq`` is refused as stale.
        This may be *queued* itself, which is then not queued.
        """
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
        """Start the next command at *now* (monotonic s).

        Returns:
            The command, which counts as running until `done`; None if none waits, if the limit of running
            commands is reached, or if a command of every waiting robot runs.  And the refusals of commands
            that came before it in the queue, and whose deadline had passed or that had waited for too long.
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
        """Start *queued* without queueing it, and return True; `finish_unqueued` must be called afterwards.

        Return False and change nothing if another command waits or runs, or if the deadline has passed at
        *now* (monotonic s).
        """
        if self._queue or self.running or queued.deadline_s <= now:
            return False
        self._overload.note_accepted(queued.robot.tenant, now)
        self._wait_per_position.note(0.0, 1)
        queued.started_s = now
        self.running = 1
        return True

    def finish_unqueued(self, queued: QueuedCommand, now: float) -> None:
        """Note that *queued*, which `start_unqueued` started, was computed at *now* (monotonic s)."""
        self.running = 0
        self._note_compute(now - queued.started_s)

    def done(self, queued: QueuedCommand, now: float) -> None:
        """Note that *queued*, which `start` returned, was computed at *now* (monotonic s).

        The next command of its robot may start from now on.
        """
        self.running -= 1
        self._note_compute(now - queued.started_s)
        self._queue.release(queued.robot)

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Remove the waiting commands of the closed connection *owner*, and return them."""
        return self._queue.remove(lambda queued: queued.owner is owner) if self._queue else []

    def oldest_wait_s(self, now: float) -> float:
        """Return the seconds from the arrival of the oldest waiting command to *now*; 0 if none waits."""
        return max(0.0, now - min((queued.received_s for queued in self._queue), default=now))

    def runs_inline(self, *, cheap: bool, size_bytes: int) -> bool:
        """Return whether the command that `start` returned last should be computed in the event loop.

        It should if all of this holds; otherwise a solver thread computes it:

        1. Its service is *cheap*, and its *size_bytes* on the wire are at most `INLINE_BYTES`.
        2. No other command runs in a thread.
        3. A thread would save no time: no other command waits, or at least `MIN_SHORT_SHARE` of the last
           commands were computed within `SHORT_COMPUTE_S`.
        """
        saves_time = not self._queue or self._short_share >= MIN_SHORT_SHARE
        return cheap and size_bytes <= INLINE_BYTES and saves_time and self.running <= 1

    def _pause_s(self, robot: RobotId, allowed_s: float) -> float:
        expected_wait_s = (self._queue.position(robot) - 1) * self._wait_per_position.mean_s
        return self._overload.pause_s(robot.tenant, expected_wait_s, allowed_s)

    def _note_compute(self, spent_s: float) -> None:
        """Update the share of short commands by one that took *spent_s* seconds."""
        self._short_share += SHORT_SHARE_SMOOTHING * ((spent_s <= SHORT_COMPUTE_S) - self._short_share)


def behind_error(pause_s: float) -> Busy:
    """Return the error of a command that is refused for overload; its robot has to pause for *pause_s*."""
    return Busy(BEHIND, hint=BEHIND_HINT, retry_after_ms=1e3 * pause_s)


def expired_error(queued: QueuedCommand, now: float) -> Expired:
    """Return the error of *queued*, whose deadline passed before its computation began, at *now* (s)."""
    waited_ms = (now - queued.received_s) * 1e3
    return Expired(
        f"the deadline passed after {waited_ms:.0f} ms in the queue",
        hint="set a longer deadline, or send fewer commands",
    )


def _refuse_late(queued: QueuedCommand, now: float) -> RefusedCommand:
    """Return the refusal of a command that waited until after its deadline, or for too long."""
    if queued.deadline_s <= now:
        return RefusedCommand(queued, expired_error(queued, now), "expired")
    return RefusedCommand(queued, behind_error(PAUSE_S), "behind")


def _frame_to_replace(waiting: deque[QueuedCommand], queued: QueuedCommand) -> QueuedCommand | None:
    """Return the waiting frame of the stream of *queued*, which *queued* replaces; None if there is none."""
    stream = queued.command.stream
    if not _is_replaceable(queued):
        return None
    return next((w for w in waiting if w.command.stream == stream and not w.command.keep), None)


def _is_replaceable(queued: QueuedCommand) -> bool:
    """Return whether a command is a frame, which newer frames of its stream replace."""
    return bool(queued.command.stream) and not queued.command.keep


def _stale(queued: QueuedCommand) -> RefusedCommand:
    return RefusedCommand(queued, Stale("a newer frame of the stream replaced this frame"), "stale")
