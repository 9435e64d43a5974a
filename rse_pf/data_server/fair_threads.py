"""A thread pool that is fair between tenants and robots, so that slow work of one robot delays no other.

Work starts in the order of `FairQueue`, and a robot has at most one thread.  The last free thread is given
only to a tenant for which no thread works, so that two tenants with slow work do not delay a third.
Work whose robot has disconnected is not started; running work stops at its next call of `check_wanted`.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from rse_pf.errors import Disconnected
from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import FairQueue

__all__ = ["FairThreads", "check_wanted", "while_wanted"]

_T = TypeVar("_T")
_THREADS = 8  # more than the cores of a machine, because these threads mostly wait for the store
_MAX_PER_TENANT = 6  # threads that may work for one tenant: two of the eight stay free for other tenants


@dataclass(slots=True, eq=False)
class _Task:
    robot: RobotId
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    loop: asyncio.AbstractEventLoop
    future: asyncio.Future[Any]
    is_wanted: bool = True


class _WorkOfThread(threading.local):
    task: _Task | None = None


_current = _WorkOfThread()


def check_wanted() -> None:
    """Raise Disconnected if this thread works on a request whose robot has disconnected.

    In a thread that does not belong to a `FairThreads`, do nothing.
    """
    task = _current.task
    if task is not None and not task.is_wanted:
        raise Disconnected("the robot closed the connection before the reply")


def while_wanted(items: Iterable[_T]) -> Iterator[_T]:
    """Yield *items*; call `check_wanted` before each, which raises Disconnected once the robot has left."""
    for item in items:
        check_wanted()
        yield item


class FairThreads:
    """At most *threads* threads, started when needed, for the work of robots in the order of `FairQueue`."""

    def __init__(self, threads: int = _THREADS) -> None:
        self._max_threads = threads
        self._threads: list[threading.Thread] = []
        self._started: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._free = threads
        self._lock = threading.Lock()  # guards the queue and the counts; never held while a function runs
        self._queue: FairQueue[_Task] = FairQueue(
            max_running_per_robot=1, max_running_per_tenant=_MAX_PER_TENANT
        )

    async def run(self, robot: RobotId, function: Callable[..., _T], *arguments: Any) -> _T:
        """Return ``function(*arguments)``, computed in a thread when the queue has reached *robot*.

        Raises what *function* raises.  If this call is cancelled, waiting work is dropped, and running work
        stops at its next call of `check_wanted`.
        """
        loop = asyncio.get_running_loop()
        task = _Task(robot, function, arguments, loop, loop.create_future())
        with self._lock:
            self._queue.add(robot, task)
            self._start()
        try:
            result: _T = await task.future
        except asyncio.CancelledError:
            task.is_wanted = False
            raise
        return result

    def close(self) -> None:
        """Drop the waiting work, whose calls of `run` are cancelled, and wait for the running work."""
        with self._lock:
            self._free = 0
            dropped = self._queue.remove(lambda task: True)
        for task in dropped:
            with contextlib.suppress(RuntimeError):  # the event loop was closed: no call of `run` waits
                task.loop.call_soon_threadsafe(task.future.cancel)
        for _ in self._threads:
            self._started.put(None)
        for thread in self._threads:
            thread.join()

    def _start(self) -> None:
        """Give waiting tasks to free threads, as far as the limits allow; the caller holds the lock."""
        while self._free > 0:
            task = self._queue.take(only_newcomers=self._free == 1 < self._max_threads)
            if task is None:
                return
            if not task.is_wanted:
                self._queue.release(task.robot)
                continue
            self._free -= 1
            self._started.put(task)
            if len(self._threads) < min(self._max_threads, self._max_threads - self._free):
                thread = threading.Thread(target=self._work_on, name="data", daemon=True)
                self._threads.append(thread)
                thread.start()

    def _work_on(self) -> None:
        while (task := self._started.get()) is not None:
            self._work(task)

    def _work(self, task: _Task) -> None:
        _current.task = task
        result, problem = None, None
        try:
            result = task.function(*task.arguments)
        except BaseException as error:  # noqa: BLE001 - `run` raises it to its caller
            problem = error
        self._end(task)
        with contextlib.suppress(RuntimeError):  # the event loop was closed: no call of `run` waits any more
            task.loop.call_soon_threadsafe(_settle, task.future, result, problem)

    def _end(self, task: _Task) -> None:
        with self._lock:
            self._free += 1
            self._queue.release(task.robot)
            self._start()


def _settle(future: asyncio.Future[Any], result: Any, problem: BaseException | None) -> None:
    if future.done():
        return  # the call of `run` was cancelled
    if problem is None:
        future.set_result(result)
    else:
        future.set_exception(problem)
