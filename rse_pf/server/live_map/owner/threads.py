"""The threads of an owner process, and how long it waits before it asks a store again that failed.

One thread holds the map, some look, some wait for the store.
"""

from __future__ import annotations

import asyncio
import enum
import itertools
import os
import threading
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from queue import PriorityQueue
from typing import Any, TypeVar

__all__ = ["FIRST_RETRY_S", "OwnerThreads", "Sleep", "Urgency", "next_retry_s"]

_LOOKING = 3
"""Two measure keyframes, one may look for a robot that is lost; matching and solving free the GIL."""
_BACKGROUND_NICE = 10
"""Nobody waits for snapshots.  Corrections wait for measurements, whose threads keep the normal priority."""
FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
Sleep = Callable[[float], Coroutine[Any, Any, None]]
"""Waits for seconds."""
_T = TypeVar("_T")


class Urgency(enum.IntEnum):
    """What is computed first when several things wait."""

    APPLY = 0
    JUDGE = 1
    ANSWER = 2
    MEASURE = 3
    BACKGROUND = 4


class OwnerThreads:
    """Where an owner computes and waits; each thread but those of `look` does one thing at a time.

    They end with the process.
    """

    def __init__(self) -> None:
        self._store, self._lease = (
            ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("store", "lease")
        )
        self._background = ThreadPoolExecutor(1, thread_name_prefix="background", initializer=_lower_priority)
        self._look = ThreadPoolExecutor(_LOOKING, thread_name_prefix="look")
        self._waiting: PriorityQueue[tuple[int, int, Callable[[], None]]] = PriorityQueue()
        self._count = itertools.count()

    def start(self) -> None:
        """Start the thread of the map; the others start with their first work."""
        threading.Thread(target=self._compute_on, name="map", daemon=True).start()

    def compute(self, urgency: Urgency, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act* in the thread of the map, after what is more urgent or came before."""
        future: Future[_T] = Future()

        def run() -> None:
            try:
                result = act()
            except BaseException as error:  # noqa: BLE001  it is the caller's
                future.set_exception(error)
            else:
                future.set_result(result)

        self._waiting.put((urgency, next(self._count), run))
        return asyncio.shield(asyncio.wrap_future(future))

    def look(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act*, which works on what the map's thread has handed out, while the map changes."""
        return self._run(self._look, act)

    def store(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act* in the thread that writes the log."""
        return self._run(self._store, act)

    def lease(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act* in the thread that renews the lease."""
        return self._run(self._lease, act)

    def background(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act* in the thread for snapshots and versions."""
        return self._run(self._background, act)

    def _run(self, pool: ThreadPoolExecutor, act: Callable[[], Any]) -> Awaitable[Any]:
        return asyncio.get_running_loop().run_in_executor(pool, act)

    def _compute_on(self) -> None:
        while True:
            self._waiting.get()[2]()


def _lower_priority() -> None:
    """Lower the priority of the calling thread, which Linux has for each thread."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _BACKGROUND_NICE)


def next_retry_s(wait_s: float) -> float:
    """Return how long to wait after a wait of *wait_s* has not helped."""
    return min(_LAST_RETRY_S, 2 * wait_s)
