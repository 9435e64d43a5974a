"""Threads that work for robots in turn, so that the slow work of one robot delays no other for long.

Of the robots that wait, the one whose tenant uses the fewest threads goes first, then the one that uses the
fewest itself, then the one that was served least recently.  A robot never has more than `_PER_ROBOT` threads
and a tenant never all of them.  Work that is no longer wanted is not started; work that runs ends at its next
call of `check_wanted`.
"""

from __future__ import annotations

import asyncio
import contextvars
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from rse_pf.errors import Disconnected
from rse_pf.identity import RobotId

__all__ = ["FairThreads", "check_wanted", "while_wanted"]

_T = TypeVar("_T")
_THREADS = 8
_PER_ROBOT, _PER_TENANT = 1, 6


@dataclass(slots=True, eq=False)
class _Task:
    robot: RobotId
    function: Callable[[], Any]
    future: Future[Any] = field(default_factory=Future)
    is_wanted: bool = True


_current: contextvars.ContextVar[_Task | None] = contextvars.ContextVar("current", default=None)


def check_wanted() -> None:
    """Raise Disconnected if this thread works on a request whose robot has gone."""
    task = _current.get()
    if task is not None and not task.is_wanted:
        raise Disconnected("the robot closed the connection before the reply")


def while_wanted(items: Iterable[_T]) -> Iterator[_T]:
    """Yield *items* for as long as the robot waits for them; raises Disconnected."""
    for item in items:
        check_wanted()
        yield item


class FairThreads:
    """A pool of threads; `close` ends it."""

    def __init__(self, threads: int = _THREADS) -> None:
        self._pool = ThreadPoolExecutor(threads, "data")
        self._free = threads
        self._lock = threading.Lock()  # held for some microseconds, never during work
        self._waiting: OrderedDict[RobotId, deque[_Task]] = OrderedDict()
        self._robots: Counter[RobotId] = Counter()
        self._tenants: Counter[str] = Counter()

    async def run(self, robot: RobotId, function: Callable[..., _T], *arguments: Any) -> _T:
        """Return ``function(*arguments)``, computed in a thread when it is the robot's turn."""
        task = _Task(robot, lambda: function(*arguments))
        with self._lock:
            self._waiting.setdefault(robot, deque()).append(task)
            self._start()
        try:
            result: _T = await asyncio.wrap_future(task.future)
        except asyncio.CancelledError:
            task.is_wanted = False
            raise
        return result

    def close(self) -> None:
        """Wait for the work that runs, and start no more."""
        self._pool.shutdown(cancel_futures=True)

    def _start(self) -> None:
        """Start what may run now; the lock is held."""
        while self._free and (robot := self._next()) is not None:
            queue = self._waiting[robot]
            task = queue.popleft()
            if queue:
                self._waiting.move_to_end(robot)
            else:
                del self._waiting[robot]
            if task.future.set_running_or_notify_cancel():
                self._free -= 1
                self._robots[robot] += 1
                self._tenants[robot.tenant] += 1
                self._pool.submit(self._work, task)

    def _next(self) -> RobotId | None:
        """Return the robot whose turn it is; `_waiting` has the one first that was served least recently."""
        best, fewest = None, (_PER_TENANT, 0)
        for robot in self._waiting:
            used = self._tenants[robot.tenant], self._robots[robot]
            if used < fewest and used[1] < _PER_ROBOT:
                best, fewest = robot, used
        return best

    def _work(self, task: _Task) -> None:
        context = contextvars.Context()
        context.run(_current.set, task)
        try:
            result = context.run(task.function)
        except BaseException as error:  # noqa: BLE001 - it belongs to the one who waits
            self._end(task)
            task.future.set_exception(error)
        else:
            self._end(task)
            task.future.set_result(result)

    def _end(self, task: _Task) -> None:
        with self._lock:
            self._free += 1
            _decrease(self._robots, task.robot)
            _decrease(self._tenants, task.robot.tenant)
            self._start()


def _decrease(counter: Counter[_T], key: _T) -> None:
    counter[key] -= 1
    if not counter[key]:
        del counter[key]
