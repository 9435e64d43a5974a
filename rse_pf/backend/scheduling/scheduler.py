"""Decide which command runs next: fair between robots, fresh within a stream, quick to refuse.

At most one command of a robot runs; waiting robots take turns.  Within a stream the newest frame
replaces the one that waits, unless it says ``keep``.  Expired commands never cost compute.  When
robots have waited for their turn above the target for a whole interval, the server is behind, and
what cannot start in time is refused with ``retry_after_ms``.  Time is an argument everywhere.
Promises no clock, no thread, no loop and no socket: jobs go in, jobs and refusals come out.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from rse_pf.config import ServingSettings
from rse_pf.errors import Busy, Expired, RsePfError, Stale
from rse_pf.wire import Command

__all__ = ["BEHIND", "BEHIND_HINT", "QueuedCommand", "RefusedCommand", "Scheduler"]

BEHIND = "the server is behind with its work"
BEHIND_HINT = "try again later; the server list may grow meanwhile"
_SMOOTHING = 0.1
_JUMP = 4.0
"""One measurement counts for at most so many times the expected: who did not run for a moment is not slower
afterwards, and who is slower shows it again."""
_EXPECTED_S = 0.005
"""At least so much is expected of a command."""
_MAX_RETRY_MS = 5000.0
_AT_ONCE_S = 0.0005
"""A command that waited less found the server free."""
_LAST_CHANCE = 0.75
"""What was let in and waited longer than this share of its time is given up, while others can be in time."""
_PATIENCE = 4.0
"""What was let in before the server fell behind is served up to so many targets later."""
_SHARE_OF_TIME = 0.4
"""Of a command's time may pass in the queue, even behind; the rest is for the work and the way."""
_RESERVE_S = 1.5
"""Enough for the work and the way of any command: who has more time may wait for longer than that share."""
_CALM_SHARE = 0.1
"""A server that refuses a smaller share of its commands has caught up."""


@dataclass(slots=True, eq=False)
class QueuedCommand:
    """One command on its way; ``owner`` is the connection that waits for the answer."""

    owner: Any
    robot: str
    command: Command
    size_bytes: int
    received_s: float
    deadline_s: float
    started_s: float = 0.0

    def patience_s(self, longest_s: float) -> float:
        """How long it may wait for its turn; see `_patience_s`."""
        return _patience_s(self.deadline_s - self.received_s, longest_s)


@dataclass(frozen=True, slots=True)
class RefusedCommand:
    """A job that ends without compute.  ``reason`` is one of a closed list, for the metrics."""

    job: QueuedCommand
    error: RsePfError
    reason: str


@dataclass(slots=True)
class _Robot:
    waiting: deque[QueuedCommand] = field(default_factory=deque)
    running: QueuedCommand | None = None
    free_since: float = 0.0


class Scheduler:
    """The queue of one worker."""

    def __init__(self, settings: ServingSettings) -> None:
        self.waiting = 0
        self.running = 0
        self.is_behind = False
        self._target_s = settings.queue_target_ms / 1e3
        self._interval_s = settings.queue_interval_ms / 1e3
        self._max_waiting = settings.max_queue_per_robot
        self._is_serial = settings.solver_threads == 1 or 0 < settings.emulated_cores <= 1
        self._robots: dict[str, _Robot] = {}
        self._round: deque[str] = deque()
        self._late_since: float | None = None
        self._judged_s = 0.0
        self._started = self._refused = 0
        self._turn_s = 0.0
        self._service_s = 0.0
        self._last_start = float("-inf")

    def submit(self, job: QueuedCommand, now: float) -> list[RefusedCommand]:
        """Let *job* wait for its turn; return the jobs that end instead, maybe *job* itself."""
        if job.deadline_s <= now:
            return [_expired(job, now)]
        robot = self._robots.setdefault(job.robot, _Robot())
        older = _replaceable(robot.waiting, job)
        if older is not None:
            return [self._replace(robot, older, job)]
        refusal = self._refuse_at_the_door(robot, job)
        if refusal is not None:
            self._forget_if_idle(job.robot)
            return [refusal]
        robot.waiting.append(job)
        self.waiting += 1
        if robot.running is None and len(robot.waiting) == 1:
            self._round.append(job.robot)
        return []

    def refuse_unread(self, robot_name: str, allowed_s: float, now: float) -> float | None:
        """Return ``retry_after_ms`` if the next command of a robot is refused unless its deadline is longer.

        Only while the server is behind, and never where the command might replace one that waits.

        Args:
            robot_name: Who sends it.
            allowed_s: What the robot's last command allowed.
            now: The clock of `submit`.
        """
        if not self.is_behind:
            return None
        robot = self._robots.get(robot_name)
        ahead_s = self._ahead_s(robot)
        if robot is not None and any(map(_is_replaceable, robot.waiting)):
            return None
        if ahead_s <= _patience_s(allowed_s, self._wanted_s / 2):
            return None
        self._refused += 1
        self._judge(now)
        return self._retry_after_ms(1e3 * ahead_s)

    def start(self, now: float) -> tuple[QueuedCommand | None, list[RefusedCommand]]:
        """Return the job whose turn it is, now running, and the jobs given up on the way."""
        refusals: list[RefusedCommand] = []
        while self._round:
            name = self._round.popleft()
            robot = self._robots[name]
            job = robot.waiting.popleft()
            self.waiting -= 1
            refusal = self._give_up(robot, job, now)
            if refusal is None:
                robot.running, job.started_s = job, now
                self.running += 1
                self._started += 1
                self._measure_turn(_turn_wait(robot, job, now), now)
                return job, refusals
            refusals.append(refusal)
            if robot.waiting:
                self._round.append(name)
            else:
                self._forget_if_idle(name)
        self._note_turn_wait(0.0, now)
        return None, refusals

    def done(self, job: QueuedCommand, now: float) -> None:
        """Note that the compute of *job* ended; its robot may take another turn."""
        self.running -= 1
        spent_s = now - job.started_s
        self._service_s = _averaged(self._service_s, spent_s) if self._service_s else spent_s
        robot = self._robots[job.robot]
        robot.running, robot.free_since = None, now
        if robot.waiting:
            self._round.append(job.robot)
        else:
            self._forget_if_idle(job.robot)

    def sweep(self, now: float) -> list[RefusedCommand]:
        """Give up what expired or waited too long, without starting anything."""
        refusals: list[RefusedCommand] = []
        if self._round:
            first = self._robots[self._round[0]]
            self._note_turn_wait(_turn_wait(first, first.waiting[0], now), now)
        for name, robot in list(self._robots.items()):
            kept: deque[QueuedCommand] = deque()
            for job in robot.waiting:
                too_late = job.deadline_s <= now or (
                    robot.running is None and self._is_hopeless(robot, job, now, len(self._round) - 1)
                )
                if too_late:
                    refusals.append(self._refused_late(robot, job, now))
                else:
                    kept.append(job)
            self._rewait(name, robot, kept)
        return refusals

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Drop the waiting jobs of a connection that ended, and return them."""
        dropped: list[QueuedCommand] = []
        for name, robot in list(self._robots.items()):
            gone = [job for job in robot.waiting if job.owner is owner]
            if gone:
                dropped += gone
                self._rewait(name, robot, deque(job for job in robot.waiting if job.owner is not owner))
        return dropped

    def oldest_wait_s(self, now: float) -> float:
        """Return the age of the oldest waiting job."""
        received = [robot.waiting[0].received_s for robot in self._robots.values() if robot.waiting]
        return max(0.0, now - min(received)) if received else 0.0

    def runs_inline(self, *, cheap: bool, size_bytes: int, inline_bytes: int) -> bool:
        """Whether the job just started may run in the event loop: small, and nobody could do it meanwhile.

        Behind, a lone solver thread and a server of one core have nothing to overlap with but refusals, which
        cost less than the hand-over.
        """
        saves_time = self.waiting == 0 or (self.is_behind and self._is_serial)
        return cheap and size_bytes <= inline_bytes and saves_time and self.running <= 1

    def _refuse_at_the_door(self, robot: _Robot, job: QueuedCommand) -> RefusedCommand | None:
        if len(robot.waiting) >= self._max_waiting:
            error = Busy(
                f"{len(robot.waiting)} commands of this robot wait already",
                hint="send slower, or let newer frames replace older ones",
                retry_after_ms=self._retry_after_ms(len(robot.waiting) * self._turn_s * 1e3),
            )
            return RefusedCommand(job, error, "robot-queue")
        ahead_s = self._ahead_s(robot)
        # With half of the target kept in hand, what is let in is served: nobody waits for a refusal.
        longest_s = self._wanted_s / 2 if self.is_behind else math.inf
        if ahead_s > job.patience_s(longest_s):
            self._refused += 1
            return RefusedCommand(job, self._busy(ahead_s), "behind")
        return None

    def _replace(self, robot: _Robot, older: QueuedCommand, newer: QueuedCommand) -> RefusedCommand:
        if newer.command.seq < older.command.seq:
            return _stale(newer)
        robot.waiting[robot.waiting.index(older)] = newer
        return _stale(older)

    def _give_up(self, robot: _Robot, job: QueuedCommand, now: float) -> RefusedCommand | None:
        self._note_turn_wait(_turn_wait(robot, job, now), now)
        if job.deadline_s <= now or self._is_hopeless(robot, job, now, len(self._round)):
            return self._refused_late(robot, job, now)
        return None

    def _ahead_s(self, robot: _Robot | None) -> float:
        """How long the next command of *robot* will wait: a round for each of its own, at most for all."""
        rounds = 1 + (len(robot.waiting) if robot is not None else 0)
        return min(rounds * len(self._round), self.waiting + 1) * self._turn_s

    @property
    def _wanted_s(self) -> float:
        """The target, or what two of the present commands take: slow services are no overload."""
        return max(self._target_s, 2 * self._service_s)

    def _is_hopeless(self, robot: _Robot, job: QueuedCommand, now: float, others: int) -> bool:
        """Serving the oldest first serves those that are about to be late; give those up instead."""
        allowed_s = job.deadline_s - job.received_s
        patience_s = max(_PATIENCE * self._wanted_s, _spare_s(allowed_s))
        patience_s = min(patience_s, _LAST_CHANCE * allowed_s)
        if others and self.is_behind and _turn_wait(robot, job, now) > patience_s:
            return True
        newer_waits = bool(robot.waiting) and robot.waiting[-1] is not job
        return newer_waits and now - job.received_s > (job.deadline_s - job.received_s) / 2

    def _refused_late(self, robot: _Robot, job: QueuedCommand, now: float) -> RefusedCommand:
        self._refused += 1
        if job.deadline_s <= now:
            return _expired(job, now)
        return RefusedCommand(job, self._busy(_turn_wait(robot, job, now)), "behind")

    def _busy(self, delay_s: float) -> Busy:
        return Busy(BEHIND, hint=BEHIND_HINT, retry_after_ms=self._retry_after_ms(1e3 * delay_s))

    def _retry_after_ms(self, wanted_ms: float) -> float:
        return min(_MAX_RETRY_MS, max(self._interval_s * 1e3, wanted_ms))

    def _note_turn_wait(self, wait_s: float, now: float) -> None:
        """Enter *behind* after an interval above the target."""
        if self.is_behind:
            self._judge(now)
        elif wait_s <= self._wanted_s:
            self._late_since = None
        elif self._late_since is None:
            self._late_since = now
        elif now - self._late_since >= self._interval_s:
            self.is_behind, self._late_since = True, None
            self._judged_s, self._started, self._refused = now, 0, 0

    def _judge(self, now: float) -> None:
        """Leave *behind* after an interval that refused hardly any.

        The waits say nothing then: what is refused at the door keeps them short however much is offered.
        """
        if now - self._judged_s >= self._interval_s:
            self.is_behind = self._refused > _CALM_SHARE * (self._refused + self._started)
            self._judged_s, self._started, self._refused = now, 0, 0

    def _measure_turn(self, waited_s: float, now: float) -> None:
        """Average the time between two starts while robots wait: threads and size gate included."""
        if waited_s > _AT_ONCE_S and self._last_start > float("-inf"):
            self._turn_s = _averaged(self._turn_s, now - self._last_start)
        self._last_start = now

    def _rewait(self, name: str, robot: _Robot, kept: deque[QueuedCommand]) -> None:
        if len(kept) == len(robot.waiting):
            return
        self.waiting -= len(robot.waiting) - len(kept)
        robot.waiting = kept
        if not kept:
            if robot.running is None:
                self._round.remove(name)
            self._forget_if_idle(name)

    def _forget_if_idle(self, name: str) -> None:
        robot = self._robots.get(name)
        if robot is not None and robot.running is None and not robot.waiting:
            del self._robots[name]


def _averaged(average_s: float, measured_s: float) -> float:
    believed_s = min(measured_s, _JUMP * max(average_s, _EXPECTED_S))
    return average_s + _SMOOTHING * (believed_s - average_s)


def _patience_s(allowed_s: float, longest_s: float) -> float:
    """How long a command may wait for its turn on a server that is behind.

    *longest_s*, or what it can spare if that is more: who can wait is served, not refused, when a server has
    the robots of another one for some seconds.  In any case at most half of its time, or what it can spare.
    """
    spare_s = _spare_s(allowed_s)
    return min(max(longest_s, spare_s), max(allowed_s / 2, spare_s))


def _spare_s(allowed_s: float) -> float:
    return max(_SHARE_OF_TIME * allowed_s, allowed_s - _RESERVE_S)


def _turn_wait(robot: _Robot, job: QueuedCommand, now: float) -> float:
    """How long *job* has waited for others, not for its own robot."""
    return now - max(job.received_s, robot.free_since)


def _replaceable(waiting: deque[QueuedCommand], job: QueuedCommand) -> QueuedCommand | None:
    stream = job.command.stream
    if not _is_replaceable(job):
        return None
    return next((w for w in waiting if w.command.stream == stream and not w.command.keep), None)


def _is_replaceable(job: QueuedCommand) -> bool:
    return bool(job.command.stream) and not job.command.keep


def _stale(job: QueuedCommand) -> RefusedCommand:
    return RefusedCommand(job, Stale("a newer frame of the stream took its place"), "stale")


def _expired(job: QueuedCommand, now: float) -> RefusedCommand:
    waited_ms = (now - job.received_s) * 1e3
    error = Expired(
        f"its deadline passed after {waited_ms:.0f} ms in the queue", hint="allow more time, or send fewer"
    )
    return RefusedCommand(job, error, "expired")
