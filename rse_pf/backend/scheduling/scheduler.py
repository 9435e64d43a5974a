"""Decide which command runs next: fair between tenants and robots, newest frame of a stream first.

At most one command of a robot runs; tenants that wait take turns, and so do the robots of each.  Within a
stream the newest frame replaces the one that waits, unless it says ``keep``.  A command whose deadline passed
never runs.  When robots wait longer for their turn than `QUEUE_TARGET_S` for a whole `QUEUE_INTERVAL_S`,
the server is behind; `rse_pf.backend.gateway.admission` then refuses what cannot start in time.  The
scheduler has no thread and no clock: commands and times go in, commands and refusals come out.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec

from rse_pf.backend.scheduling.robot_shares import RobotShares
from rse_pf.backend.scheduling.turns import Turns
from rse_pf.errors import Busy, Expired, RsePfError, Stale
from rse_pf.identity import RobotId
from rse_pf.wire import Command

__all__ = [
    "BEHIND",
    "BEHIND_HINT",
    "INLINE_BYTES",
    "QUEUE_INTERVAL_S",
    "QUEUE_TARGET_S",
    "QueueBacklog",
    "QueuedCommand",
    "RefusedCommand",
    "Scheduler",
    "expired_error",
    "max_wait_s",
    "retry_after_ms",
]

BEHIND = "the server is behind with its work"
BEHIND_HINT = "try again later; the server list may grow meanwhile"

_SMOOTHING = 0.1
_MAX_JUMP = 4.0
"""One measurement counts for at most this many times the average: a process that was stopped for a moment is
not slower afterwards, and a service that became slow shows it again."""
_TURNS_S = 0.2
"""Turns are averaged over so long: many short ones are computed in a row before sockets are read again, and
the average of ten of them would be 0.1 ms at one moment and 4 ms at the next."""
_MIN_TURN_S = 0.005
"""The average counts as at least this long where `_MAX_JUMP` is applied."""
_MAX_RETRY_S = 5.0
_IMMEDIATE_S = 0.0005
"""A command that waited less found the server free."""
_MAX_SHARE_WAITED = 0.75
"""A queued command that waited for more than this share of its time is given up, while others can be in
time."""
_MAX_TARGETS_WAITED = 4.0
"""A command that was queued before the server fell behind may wait for this many targets."""
_SHARE_TO_WAIT = 0.4
"""Share of a command's time that it may wait even while the server is behind; the rest is for compute and
network."""
_RESERVE_S = 1.5
"""Enough for compute and network of any command: one that has more time may wait for all but this."""
_MAX_REFUSED_SHARE = 0.1
"""An interval in which at most this share of the commands was refused is calm."""
_CALM_INTERVALS, _EASY_COUNTS = 30, 5
"""A server is no longer behind after so many calm intervals in a row; one with clearly less to do than can be
served counts as the second number of them.  After fewer, robots that obey would all return: they would flood
the server every second, and leave it idle in between."""
_MANY_REFUSED, _LONGER, _SHORTER = 0.15, 1.5, 1.1
"""Robots are told to pause for longer, by these factors in each interval, while more than this share of
commands is refused, and for shorter at `_MAX_REFUSED_SHARE`: hardly more return than can be served."""
_FREE_INTERVAL_S, _LEAST_INTERVAL_S = 1.0, 0.3
"""The commands that a server serves while it is not behind are counted for so long, and the last ones before
it falls behind for the second at least."""
_MAX_PAUSE_S = 0.65
"""Half more with `RobotShares.next_spread`, so that no robot is told more than a second."""
QUEUE_TARGET_S, QUEUE_INTERVAL_S = 0.05, 0.1
"""A server whose robots wait longer than the target for a whole interval is behind.

Source:
    CoDel, Nichols and Jacobson 2012.
"""
_SHORT_COMPUTE_S, _SHORT_SHARE = 0.001, 0.8
"""Passing a command to a thread takes 0.1 ms of CPU, and up to 5 ms until the thread has the lock.  A share
and not an average decides, because a process that others interrupt is no slow service."""
INLINE_BYTES = 16_384
"""A command up to this size is computed in the event loop when nothing waits."""


class QueuedCommand(msgspec.Struct, eq=False):
    """One command from its arrival to its answer; ``owner`` is the connection that waits for the answer."""

    owner: Any
    robot: RobotId
    command: Command
    size_bytes: int
    received_s: float
    deadline_s: float
    started_s: float = 0.0


class QueueBacklog(NamedTuple):
    """The commands that would delay one more command of a robot.

    Attributes:
        waiting: How many commands of the robot wait in the same queue.
        delay_s: The time until the command's turn.
        turn_s: The time that each turn takes; 0 where it is not measured and nothing waits.
        max_delay_s: How long a command with little time may wait now; see `Scheduler.max_delay_s`.
        pause_s: Robots that are refused because of the delay pause for so long at least.
    """

    waiting: int = 0
    delay_s: float = 0.0
    turn_s: float = 0.0
    max_delay_s: float = math.inf
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RefusedCommand:
    """A command that ends without compute; ``reason`` is a label of the metric ``rse_pf_shed_total``."""

    queued: QueuedCommand
    error: RsePfError
    reason: str


@dataclass(slots=True)
class _Robot:
    waiting: deque[QueuedCommand] = field(default_factory=deque)
    running: QueuedCommand | None = None
    free_since: float = -math.inf


class Scheduler:
    """The queue of one worker."""

    def __init__(self) -> None:
        self.waiting = 0
        self.running = 0
        self.is_behind = False
        self.turn_s = 0.0
        """Average time between two starts while robots wait: threads and CPU throttle included."""
        self.shares = RobotShares()
        self._robots: dict[RobotId, _Robot] = {}
        self._turns = Turns()
        self._late_since: float | None = None
        self._judged_s = 0.0
        self._started = self._refused = self._early = 0
        self._calm = 0
        self._pause_s = QUEUE_INTERVAL_S
        self._gaps, self._gaps_s = 0.0, 0.0
        self._sweep_from_s = math.inf
        self._service_s = 0.0
        self._short_share = 0.0
        self._last_start = -math.inf

    @property
    def max_delay_s(self) -> float:
        """How long a command with little time may wait for its turn: without bound unless the server is
        behind.

        Half of the target is kept in reserve, so that a command that is queued is served.
        """
        return max(QUEUE_TARGET_S / 2, self._service_s) if self.is_behind else math.inf

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return the commands that would delay *queued*.

        All numbers are 0 for a frame that replaces another one, which does not make the queue longer.
        """
        robot = self._robots.get(queued.robot)
        if robot is not None and _replaceable(robot.waiting, queued) is not None:
            return QueueBacklog()
        waiting = 0 if robot is None else len(robot.waiting)
        return QueueBacklog(
            waiting, self._delay_s(queued.robot, robot), self.turn_s, self.max_delay_s, self.pause_s
        )

    def retry_unread_ms(self, robot_id: RobotId, allowed_s: float, *, keeps_share: bool = False) -> float:
        """Return when a robot may try again whose next command, not decoded yet, would wait too long.

        0 takes the command: the server is not behind, its turn comes in time, or it might replace a frame
        that waits.

        Args:
            robot_id: The robot that sent it.
            allowed_s: Time that the robot's last command had until its deadline; the next is taken for alike.
            keeps_share: Whether it keeps to the share that it is told, so that it need not pause for longer.
        """
        if not self.is_behind:
            return 0.0
        robot = self._robots.get(robot_id)
        delay_s = self._delay_s(robot_id, robot)
        if delay_s <= max_wait_s(allowed_s, self.max_delay_s):
            return 0.0
        if robot is not None and any(map(_is_replaceable, robot.waiting)):
            return 0.0
        longest_s = 1 / self.shares.per_s if keeps_share and self.shares.per_s else math.inf
        return retry_after_ms(min(max(delay_s, self.pause_s), longest_s))

    @property
    def pause_s(self) -> float:
        """How long a robot is told to pause that is refused because the server is behind; else 0."""
        return self._pause_s if self.is_behind else 0.0

    def submit(self, queued: QueuedCommand) -> list[RefusedCommand]:
        """Queue *queued*, which was admitted, for its turn; return the frame of its stream that ends
        instead."""
        robot = self._robots.get(queued.robot)
        if robot is None:
            robot = self._robots[queued.robot] = _Robot()
        self._sweep_from_s = min(self._sweep_from_s, _soonest_late_s(queued))
        older = _replaceable(robot.waiting, queued)
        if older is not None:
            if queued.command.seq < older.command.seq:
                return [_stale(queued)]
            robot.waiting[robot.waiting.index(older)] = queued
            return [_stale(older)]
        robot.waiting.append(queued)
        self.waiting += 1
        if robot.running is None and len(robot.waiting) == 1:
            self._turns.append(queued.robot)
        return []

    def note_refused(self, now: float, *, is_early: bool = False) -> None:
        """Count a command that was not queued because it would have waited too long.

        With *is_early* its robot was told to wait longer: that says nothing about the pauses of the others.
        """
        if is_early:
            self._early += 1
        else:
            self._refused += 1
        if self.is_behind:
            self._judge(now)

    def start(self, now: float) -> tuple[QueuedCommand | None, list[RefusedCommand]]:
        """Return the command whose turn it is, now running, and those that were given up on the way."""
        refusals: list[RefusedCommand] = []
        while self._turns:
            robot_id = self._turns.popleft()
            robot = self._robots[robot_id]
            queued = robot.waiting.popleft()
            self.waiting -= 1
            turn_wait_s = _turn_wait(robot, queued, now)
            self._note_turn_wait(turn_wait_s, now)
            if queued.deadline_s > now and not self._is_hopeless(robot, queued, now, len(self._turns)):
                robot.running, queued.started_s = queued, now
                self.running += 1
                self._started += 1
                self._measure_turn(turn_wait_s, now)
                return queued, refusals
            refusals.append(self._refuse_late(robot, queued, now))
            if robot.waiting:
                self._turns.append(robot_id)
            else:
                del self._robots[robot_id]
        self._note_turn_wait(0.0, now)
        return None, refusals

    def start_unqueued(self, queued: QueuedCommand, now: float) -> bool:
        """Start *queued*, which was admitted, without a place in the queue; False if others wait or run.

        The decision and the counts are those of `submit` and `start` for a command that finds the server
        idle.  `finish_unqueued` ends the command.
        """
        if self._robots or queued.deadline_s <= now:
            return False
        waited_s = now - queued.received_s
        if self.is_behind or waited_s > _IMMEDIATE_S:
            self._note_turn_wait(waited_s, now)
            self._measure_turn(waited_s, now)
        else:  # the same, for a command that did not wait
            self._late_since, self._last_start = None, now
            if now - self._judged_s >= _FREE_INTERVAL_S:
                self._note_free(now)
        queued.started_s = now
        self.running += 1
        self._started += 1
        return True

    def finish_unqueued(self, queued: QueuedCommand, now: float) -> None:
        """Note the end of the compute of a command that `start_unqueued` started."""
        self.running -= 1
        self._note_service(now - queued.started_s)

    def done(self, queued: QueuedCommand, now: float) -> None:
        """Note that the compute of *queued* ended; its robot may take another turn."""
        self.running -= 1
        self._note_service(now - queued.started_s)
        robot = self._robots[queued.robot]
        robot.running, robot.free_since = None, now
        if robot.waiting:
            self._turns.append(queued.robot)
        else:
            del self._robots[queued.robot]

    def sweep(self, now: float) -> list[RefusedCommand]:
        """Refuse the commands that expired or waited too long, and start none."""
        refusals: list[RefusedCommand] = []
        if self._turns:
            first = self._robots[self._turns.first]
            self._note_turn_wait(_turn_wait(first, first.waiting[0], now), now)
        if now < self._sweep_from_s:
            return refusals
        self._sweep_from_s = math.inf
        for robot_id, robot in list(self._robots.items()):
            still_waiting: deque[QueuedCommand] = deque()
            for queued in robot.waiting:
                too_late = queued.deadline_s <= now or (
                    robot.running is None and self._is_hopeless(robot, queued, now, len(self._turns) - 1)
                )
                if too_late:
                    refusals.append(self._refuse_late(robot, queued, now))
                else:
                    still_waiting.append(queued)
                    self._sweep_from_s = min(self._sweep_from_s, _soonest_late_s(queued, now))
            self._replace_waiting(robot_id, robot, still_waiting)
        return refusals

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Drop the waiting commands of a connection that ended, and return them."""
        dropped: list[QueuedCommand] = []
        for robot_id, robot in list(self._robots.items()):
            dropped += [queued for queued in robot.waiting if queued.owner is owner]
            still_waiting = deque(queued for queued in robot.waiting if queued.owner is not owner)
            self._replace_waiting(robot_id, robot, still_waiting)
        return dropped

    def oldest_wait_s(self, now: float) -> float:
        """Return the age of the oldest waiting command."""
        received = [robot.waiting[0].received_s for robot in self._robots.values() if robot.waiting]
        return max(0.0, now - min(received)) if received else 0.0

    def runs_inline(self, *, cheap: bool, size_bytes: int) -> bool:
        """Return whether the command just started may run in the event loop.

        It may if it is small and no thread would save time.

        While the server is behind, the one solver thread of a worker has nothing to overlap with but
        refusals, which cost less than passing the command to the thread.  So it is with services that answer
        sooner than two threads pass the interpreter lock to each other.
        """
        is_short = self._short_share >= _SHORT_SHARE
        saves_time = self.waiting == 0 or is_short or self.is_behind
        return cheap and size_bytes <= INLINE_BYTES and saves_time and self.running <= 1

    def _delay_s(self, robot_id: RobotId, robot: _Robot | None) -> float:
        """Return the wait (s) of a robot's next command: a round for each of its own, at most for all."""
        rounds = 1 + (len(robot.waiting) if robot is not None else 0)
        return min(rounds * self._turns.before(robot_id.tenant), self.waiting + 1) * self.turn_s

    @property
    def _accepted_wait_s(self) -> float:
        """The target, or twice the present compute time: a slow service alone is no overload."""
        return max(QUEUE_TARGET_S, 2 * self._service_s)

    def _is_hopeless(self, robot: _Robot, queued: QueuedCommand, now: float, others: int) -> bool:
        """Return whether to give *queued* up.

        Serving the oldest first would serve the commands that are about to be late.
        """
        allowed_s = queued.deadline_s - queued.received_s
        if others and self.is_behind:
            longest_s = max(_MAX_TARGETS_WAITED * self._accepted_wait_s, _spare_s(allowed_s))
            if _turn_wait(robot, queued, now) > min(longest_s, _MAX_SHARE_WAITED * allowed_s):
                return True
        newer_waits = bool(robot.waiting) and robot.waiting[-1] is not queued
        return newer_waits and now - queued.received_s > allowed_s / 2

    def _refuse_late(self, robot: _Robot, queued: QueuedCommand, now: float) -> RefusedCommand:
        self._refused += 1
        if queued.deadline_s <= now:
            return RefusedCommand(queued, expired_error(queued, now), "expired")
        retry_ms = retry_after_ms(max(_turn_wait(robot, queued, now), self.pause_s))
        return RefusedCommand(queued, Busy(BEHIND, hint=BEHIND_HINT, retry_after_ms=retry_ms), "behind")

    def _note_turn_wait(self, wait_s: float, now: float) -> None:
        """Enter *behind* after an interval above the target."""
        if self.is_behind:
            self._judge(now)
        elif wait_s <= QUEUE_TARGET_S or wait_s <= self._accepted_wait_s:
            self._late_since = None
            if now - self._judged_s >= _FREE_INTERVAL_S:
                self._note_free(now)
        elif self._late_since is None:
            self._late_since = now
        elif now - self._late_since >= QUEUE_INTERVAL_S:
            self._note_free(now)
            self.is_behind, self._late_since, self._calm = True, None, 0
            self.shares.begin(now)
            self._judged_s, self._started, self._refused, self._early = now, 0, 0, 0

    def _note_free(self, now: float) -> None:
        """Note how much was served while the server was not behind: at least that can be."""
        if now - self._judged_s >= _LEAST_INTERVAL_S:
            self.shares.note_free(now, self._started / (now - self._judged_s))
            self._judged_s, self._started = now, 0

    def _judge(self, now: float) -> None:
        """Leave *behind* after `_CALM_INTERVALS`.

        The waits say nothing then: admission keeps them short however much is offered.
        """
        if now - self._judged_s >= QUEUE_INTERVAL_S:
            judged = self._refused + self._started
            refused = self._refused + self._early
            shares = self.shares
            shares.judge(now, self._started, self._refused)
            is_calm = refused <= _MAX_REFUSED_SHARE * (judged + self._early)
            is_calm = is_calm and (shares.is_enough or shares.is_easy)
            counts = _EASY_COUNTS if shares.is_enough and shares.is_easy else 1
            self._calm = self._calm + counts if is_calm else 0
            self.is_behind = self._calm < _CALM_INTERVALS
            many = self._refused > _MANY_REFUSED * judged
            few = self._refused <= _MAX_REFUSED_SHARE * judged
            if many:
                self._pause_s = min(_MAX_PAUSE_S, _LONGER * self._pause_s)
            elif few:
                self._pause_s = max(QUEUE_INTERVAL_S, self._pause_s / _SHORTER)
            self._judged_s, self._started, self._refused, self._early = now, 0, 0, 0

    def _note_service(self, spent_s: float) -> None:
        self._short_share += _SMOOTHING * ((spent_s <= _SHORT_COMPUTE_S) - self._short_share)
        self._service_s = _smooth(self._service_s, spent_s) if self._service_s else spent_s

    def _measure_turn(self, waited_s: float, now: float) -> None:
        """Average the time between two starts while robots wait; what is before its arrival is no turn."""
        if waited_s > _IMMEDIATE_S and self._last_start > -math.inf:
            gap_s = _believed(self.turn_s, min(now - self._last_start, waited_s))
            kept = max(1.0 - _SMOOTHING, math.exp(-gap_s / _TURNS_S))
            self._gaps, self._gaps_s = 1.0 + kept * self._gaps, gap_s + kept * self._gaps_s
            self.turn_s = self._gaps_s / self._gaps
        self._last_start = now

    def _replace_waiting(self, robot_id: RobotId, robot: _Robot, still_waiting: deque[QueuedCommand]) -> None:
        if len(still_waiting) == len(robot.waiting):
            return
        self.waiting -= len(robot.waiting) - len(still_waiting)
        robot.waiting = still_waiting
        if not still_waiting and robot.running is None:
            self._turns.remove(robot_id)
            del self._robots[robot_id]


def _soonest_late_s(queued: QueuedCommand, now: float = -math.inf) -> float:
    """Return when a waiting command may be given up at the earliest; later than *now* if it was looked at.

    `Scheduler._is_hopeless` lets it wait for so long at least.
    """
    allowed_s = queued.deadline_s - queued.received_s
    waits_s = min(allowed_s / 2, max(_MAX_TARGETS_WAITED * QUEUE_TARGET_S, _spare_s(allowed_s)))
    return max(queued.received_s + waits_s, now + QUEUE_TARGET_S / 2)


def retry_after_ms(delay_s: float) -> float:
    """Return after how many milliseconds a robot may try again: *delay_s*, within the limits of a hint."""
    return 1e3 * min(_MAX_RETRY_S, max(QUEUE_INTERVAL_S, delay_s))


def expired_error(queued: QueuedCommand, now: float) -> Expired:
    """Return the error of a command whose deadline passed before its turn."""
    waited_ms = (now - queued.received_s) * 1e3
    return Expired(
        f"its deadline passed after {waited_ms:.0f} ms in the queue", hint="allow more time, or send fewer"
    )


def _smooth(average_s: float, measured_s: float) -> float:
    return average_s + _SMOOTHING * (_believed(average_s, measured_s) - average_s)


def _believed(average_s: float, measured_s: float) -> float:
    return min(measured_s, _MAX_JUMP * max(average_s, _MIN_TURN_S))


def max_wait_s(allowed_s: float, max_delay_s: float) -> float:
    """Return how long a command with *allowed_s* until its deadline may wait for its turn, in seconds.

    *max_delay_s* (see `Scheduler.max_delay_s`), or what it can spare if that is more: a command that can wait
    is served, not refused, when a server has the robots of another one for some seconds.  In any case at most
    half of its time, or what it can spare.
    """
    spare_s = _spare_s(allowed_s)
    return min(max(max_delay_s, spare_s), max(allowed_s / 2, spare_s))


def _spare_s(allowed_s: float) -> float:
    return max(_SHARE_TO_WAIT * allowed_s, allowed_s - _RESERVE_S)


def _turn_wait(robot: _Robot, queued: QueuedCommand, now: float) -> float:
    """How long *queued* has waited for others, not for its own robot."""
    return now - max(queued.received_s, robot.free_since)


def _replaceable(waiting: deque[QueuedCommand], queued: QueuedCommand) -> QueuedCommand | None:
    stream = queued.command.stream
    if not _is_replaceable(queued):
        return None
    return next((w for w in waiting if w.command.stream == stream and not w.command.keep), None)


def _is_replaceable(queued: QueuedCommand) -> bool:
    return bool(queued.command.stream) and not queued.command.keep


def _stale(queued: QueuedCommand) -> RefusedCommand:
    return RefusedCommand(queued, Stale("a newer frame of the stream took its place"), "stale")
