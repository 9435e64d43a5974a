"""Threads that work for robots in turn, so that the slow work of one robot delays no other for long.

Of the robots that wait, the one whose tenant uses the fewest threads goes first, then the one that uses the
fewest itself, then the one that was served least recently.  A robot never has more than `_PER_ROBOT` threads
and a tenant never all of them, if there are several.  Work that is no longer wanted is not started; work that
runs ends at its next call of `check_wanted`.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
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
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    loop: asyncio.AbstractEventLoop
    future: asyncio.Future[Any]
    is_wanted: bool = True


class _OfThread(threading.local):
    task: _Task | None = None


_current = _OfThread()


def check_wanted() -> None:
    """Raise Disconnected if this thread works on a request whose robot has gone."""
    task = _current.task
    if task is not None and not task.is_wanted:
        raise Disconnected("the robot closed the connection before the reply")


def while_wanted(items: Iterable[_T]) -> Iterator[_T]:
    """Yield *items* for as long as the robot waits for them; raises Disconnected."""
    for item in items:
        check_wanted()
        yield item


class FairThreads:
    """A pool of threads, which start when they are needed; `close` ends it.

    An executor of the standard library takes three times as long to hand work to a thread and back.
    """

    def __init__(self, threads: int = _THREADS) -> None:
        self._most = threads
        self._per_tenant = min(_PER_TENANT, max(1, threads - 1))
        self._threads: list[threading.Thread] = []
        self._started: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._free = threads
        self._lock = threading.Lock()  # held for some microseconds, never during work
        self._waiting: OrderedDict[RobotId, deque[_Task]] = OrderedDict()
        self._robots: Counter[RobotId] = Counter()
        self._tenants: Counter[str] = Counter()

    async def run(self, robot: RobotId, function: Callable[..., _T], *arguments: Any) -> _T:
        """Return ``function(*arguments)``, computed in a thread when it is the robot's turn."""
        loop = asyncio.get_running_loop()
        task = _Task(robot, function, arguments, loop, loop.create_future())
        with self._lock:
            self._waiting.setdefault(robot, deque()).append(task)
            self._start()
        try:
            result: _T = await task.future
        except asyncio.CancelledError:
            task.is_wanted = False
            raise
        return result

    def close(self) -> None:
        """Wait for the work that runs, and start no more."""
        with self._lock:
            self._free = 0
            self._waiting.clear()
        for _ in self._threads:
            self._started.put(None)
        for thread in self._threads:
            thread.join()

    def _start(self) -> None:
        """Start what may run now; the lock is held."""
        while self._free > 0 and (robot := self._next()) is not None:
            waiting = self._waiting[robot]
            task = waiting.popleft()
            if waiting:
                self._waiting.move_to_end(robot)
            else:
                del self._waiting[robot]
            if task.is_wanted:
                self._free -= 1
                self._robots[robot] += 1
                self._tenants[robot.tenant] += 1
                self._started.put(task)
                if len(self._threads) < min(self._most, self._most - self._free):
                    thread = threading.Thread(target=self._work_on, name="data", daemon=True)
                    self._threads.append(thread)
                    thread.start()

    def _next(self) -> RobotId | None:
        """Return the robot whose turn it is; `_waiting` has the one first that was served least recently."""
        best, fewest = None, (self._per_tenant, 0)
        for robot in self._waiting:
            used = self._tenants[robot.tenant], self._robots[robot]
            if used < fewest and used[1] < _PER_ROBOT:
                best, fewest = robot, used
        return best

    def _work_on(self) -> None:
        while (task := self._started.get()) is not None:
            self._work(task)

    def _work(self, task: _Task) -> None:
        _current.task = task
        result, problem = None, None
        try:
            result = task.function(*task.arguments)
        except BaseException as error:  # noqa: BLE001 - it belongs to the one who waits
            problem = error
        self._end(task)
        with contextlib.suppress(RuntimeError):  # the loop was closed: nobody waits
            task.loop.call_soon_threadsafe(_settle, task.future, result, problem)

    def _end(self, task: _Task) -> None:
        with self._lock:
            self._free += 1
            _decrease(self._robots, task.robot)
            _decrease(self._tenants, task.robot.tenant)
            self._start()


def _settle(future: asyncio.Future[Any], result: Any, problem: BaseException | None) -> None:
    if future.done():
        return  # it was cancelled
    if problem is None:
        future.set_result(result)
    else:
        future.set_exception(problem)


def _decrease(counter: Counter[_T], key: _T) -> None:
    counter[key] -= 1
    if not counter[key]:
        del counter[key]
