"""Pause the work of robots that used most, so that a photo waits for nobody who used more.

Two threads of a core share it: work on both makes each of them up to 1.6 times slower.  So one process for
each two processors works at a time; those of the tenants that used least of late, and of their robots that
used least, are let run, and the others are paused with SIGSTOP until one ends.  Work that goes on is judged
again by what it has taken meanwhile.  A robot that sends a few photos a second has used nothing: one that
comes anew with many does not go before it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator

from rse_pf.identity import RobotId
from rse_pf.token_bucket import TokenBucket

__all__ = ["PhotoTurns", "RecentUse"]

_SHARE = 0.125
"""CPU seconds a second that count for nothing: of four photos a second."""
_MOST_S = 2.0
_MOST_KNOWN = 10_000
_JUDGED_EVERY_S = 0.05
"""Longer than most photos take: few are paused twice."""


class RecentUse:
    """CPU seconds that each key has used beyond its share, at most two.  Time is an argument."""

    def __init__(self) -> None:
        self._buckets: OrderedDict[Hashable, TokenBucket] = OrderedDict()

    def __len__(self) -> int:
        """Return how many keys are remembered; bounded."""
        return len(self._buckets)

    def of(self, key: Hashable, now: float) -> float:
        """Return what *key* used beyond its share."""
        bucket = self._buckets.get(key)
        if bucket is None:
            return 0.0
        bucket.fill(now)
        return bucket.burst - bucket.tokens

    def add(self, key: Hashable, cpu_s: float, now: float) -> None:
        """Count *cpu_s* seconds; the key that used nothing for longest is forgotten above 10,000."""
        bucket = self._buckets.setdefault(key, TokenBucket(_SHARE, burst=_MOST_S))
        bucket.fill(now)
        bucket.spend(min(cpu_s, bucket.tokens), now)
        self._buckets.move_to_end(key)
        if len(self._buckets) > _MOST_KNOWN:
            self._buckets.popitem(last=False)


class PhotoTurns:
    """The calls of one data server that are worked on; used by several threads."""

    def __init__(
        self,
        clock: Callable[[], float],
        *,
        at_once: int | None = None,
        send_signal: Callable[[int, int], None] = os.kill,
        judge_later: Callable[[Callable[[], None]], None] | None = None,
    ) -> None:
        """Know no call.

        Args:
            clock: Monotonic seconds.
            at_once: How many processes work; None means one for each two processors of this process.
            send_signal: Sends a signal to a process.
            judge_later: Calls a function some time later; None means a thread that waits 50 ms.
        """
        self._clock = clock
        self._at_once = at_once or max(1, len(os.sched_getaffinity(0)) // 2)
        self._send_signal = send_signal
        self._judge_later = judge_later or _call_in_a_thread
        self._lock = threading.Lock()  # held for some microseconds, never during work
        self._use = RecentUse()
        self._calls: list[_Call] = []
        self._is_due = False

    def call_of(self, robot: RobotId) -> _Call:
        """Return what watches a call of *robot* (`rse_pf.child.limited.CallWatch`)."""
        return _Call(self, robot)

    def begin(self, call: _Call) -> None:
        """Let *call* work, or pause it."""
        with self._lock:
            call.counted_at = self._clock()
            self._calls.append(call)
            self._judge()

    def end(self, call: _Call) -> None:
        """Let others work that waited for *call*."""
        with self._lock:
            self._calls.remove(call)
            self._resume(call)
            self._judge()

    def count(self, robot: RobotId, cpu_s: float) -> None:
        """Remember that *robot* used *cpu_s* seconds."""
        with self._lock:
            for key in (robot.tenant, robot):
                self._use.add(key, cpu_s, self._clock())

    def _judge(self) -> None:
        """Pause and resume; the lock is held."""
        now = self._clock()
        for call in self._calls:
            if not call.is_paused:
                call.ran_s += now - call.counted_at
            call.counted_at = now
        if len(self._calls) > self._at_once:
            self._calls = sorted(self._calls, key=lambda call: self._used(call, now))
            self._judge_again()
        for place, call in enumerate(self._calls):
            if place < self._at_once:
                self._resume(call)
            elif not call.is_paused:
                call.is_paused = True
                self._send(call, signal.SIGSTOP)

    def _used(self, call: _Call, now: float) -> tuple[float, float]:
        """Return what tenant and robot of *call* used beyond their shares, with what is worked on."""
        robot, calls = call.robot, self._calls
        of_tenant = sum(each.ran_s for each in calls if each.robot.tenant == robot.tenant)
        of_robot = sum(each.ran_s for each in calls if each.robot == robot)
        return self._use.of(robot.tenant, now) + of_tenant, self._use.of(robot, now) + of_robot

    def _judge_again(self) -> None:
        if not self._is_due:
            self._is_due = True
            self._judge_later(self._on_time)

    def _on_time(self) -> None:
        with self._lock:
            self._is_due = False
            self._judge()

    def _resume(self, call: _Call) -> None:
        if call.is_paused:
            call.is_paused = False
            self._send(call, signal.SIGCONT)

    def _send(self, call: _Call, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):  # its template was killed, and it ended with it
            self._send_signal(call.pid, number)


class _Call:
    """One call of *robot*, which tells `PhotoTurns` when a process works on it."""

    def __init__(self, turns: PhotoTurns, robot: RobotId) -> None:
        self._turns = turns
        self.robot = robot
        self.pid = 0
        self.ran_s = 0.0
        """Seconds without pauses until *counted_at*."""
        self.counted_at = 0.0
        self.is_paused = False
        self.cpu_s = 0.0

    @contextlib.contextmanager
    def working(self, pid: int) -> Iterator[None]:
        self.pid, self.ran_s = pid, 0.0
        self._turns.begin(self)
        try:
            yield
        finally:
            self._turns.end(self)

    def used(self, cpu_s: float) -> None:
        self.cpu_s += cpu_s
        self._turns.count(self.robot, cpu_s)


def _call_in_a_thread(function: Callable[[], None]) -> None:
    timer = threading.Timer(_JUDGED_EVERY_S, function)
    timer.daemon = True
    timer.start()
