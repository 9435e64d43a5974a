"""Run an event loop in a thread, and let other threads wait for coroutines in it.

A waiting thread measures its own time limit, so a loop that hangs cannot delay it.  Whatever ends the loop
ends every call that waits.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rse_pf.errors import Disconnected, Expired, RsePfError, UsageError

__all__ = ["EventLoopThread", "wrong_process_error"]

T = TypeVar("T")

CLOSE_TIMEOUT_S = 5.0
"""How long the last coroutine of the event loop may take, in seconds: it closes connections and a
recording."""
THREAD_JOIN_S = 1.0
"""How long the thread of the loop may take to end after its last coroutine: a function of the program may
block it."""


def wrong_process_error(process: int) -> Disconnected:
    """Return the error of a robot that was connected in *process* and is used in a forked child of it."""
    return Disconnected(
        f"this robot is connected in process {process}, and this is process {os.getpid()}",
        hint="connect a robot in each process, after the fork",
    )


class EventLoopThread:
    """Run coroutines for other threads between `start` and `close`."""

    def __init__(self, at_end: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Prepare a thread for `start`; *at_end* makes the last coroutine of its loop, for 5 s at most."""
        self._at_end = at_end
        self._calls: set[_Call] = set()
        self._lock = (
            threading.RLock()
        )  # reentrant: a signal handler may call `close` in a thread that holds it
        self._process = os.getpid()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event
        self._started, self._ended = threading.Event(), threading.Event()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="rse-pf-robot", daemon=True)

    def start(self) -> None:
        """Start the thread, and return when its loop runs."""
        self._process = os.getpid()
        self._thread.start()
        self._started.wait()

    def wait(self, work: Coroutine[Any, Any, T], limit_s: float | None = None) -> T:
        """Run *work* in the loop, wait for it, and return its result or raise its exception.

        Args:
            work: Coroutine; it is cancelled if the wait ends before it does.
            limit_s: Longest wait in seconds, None without a limit.  The end of the loop ends every wait.

        Raises:
            Disconnected: The loop has ended or is ending, or another process started it.
            Expired: *work* took longer than *limit_s*.
            UsageError: The thread of the loop itself calls, and would wait for itself.
        """
        call = _Call(work)
        try:
            self._submit(call)
        except BaseException:
            work.close()
            raise
        try:
            if not call.done.wait(limit_s):
                raise Expired(
                    f"no answer within {limit_s:g} s, the deadline included",
                    hint="set a longer deadline_s, or give the robot more CPU time",
                )
        except BaseException:
            self._cancel(call)
            raise
        finally:
            self._calls.discard(call)
        if call.error is not None:
            raise call.error
        result: T = call.result
        return result

    def close(self) -> None:
        """End the loop and every call that waits, within 7 s; any thread may call this, repeatedly.

        The thread of the loop does not wait for its own end.  A forked child process does nothing.
        """
        if os.getpid() != self._process:
            return
        with self._lock:
            if self._loop is None:
                return
            if not self._is_closing:
                self._is_closing = True
                with contextlib.suppress(RuntimeError):  # the loop has ended by itself
                    self._loop.call_soon_threadsafe(self._stop.set)
        if self._thread is not threading.current_thread():
            self._ended.wait(CLOSE_TIMEOUT_S + THREAD_JOIN_S)
            self._thread.join(THREAD_JOIN_S)

    def _submit(self, call: _Call) -> None:
        if os.getpid() != self._process:
            raise wrong_process_error(self._process)
        if threading.current_thread() is self._thread:
            raise UsageError(
                "the event loop of the robot cannot wait for the robot",
                hint="call the robot in another thread",
            )
        with self._lock:
            if self._loop is None or self._is_closing:
                raise _not_connected_error()
            self._calls.add(call)
            self._loop.call_soon_threadsafe(call.begin)  # the loop begins it before it sees a later `close`

    def _cancel(self, call: _Call) -> None:
        with self._lock, contextlib.suppress(RuntimeError):
            if self._loop is not None:
                self._loop.call_soon_threadsafe(call.cancel)

    def _run(self) -> None:
        try:
            asyncio.run(self._main())
        finally:
            self._end_calls()

    async def _main(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self._started.set()
        try:
            await self._stop.wait()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._at_end(), CLOSE_TIMEOUT_S)
        finally:
            self._end_calls()

    def _end_calls(self) -> None:
        """End every wait, also if its coroutine is blocked in a function of the program."""
        with self._lock:
            self._is_closing = True
            calls = list(self._calls)
        for call in calls:
            call.end(error=_not_connected_error())
        self._started.set()  # `start` waits for this, also if no loop could be made
        self._ended.set()


class _Call:
    """Carry a coroutine into the loop, and its result back to the thread that waits."""

    def __init__(self, work: Coroutine[Any, Any, Any]) -> None:
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None
        self._work = work
        self._task: asyncio.Task[Any] | None = None

    def begin(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._work)
        self._task.add_done_callback(self._take_result)

    def cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    def end(self, result: Any = None, error: BaseException | None = None) -> None:
        if not self.done.is_set():
            self.result, self.error = result, error
            self.done.set()

    def _take_result(self, task: asyncio.Task[Any]) -> None:
        if task.cancelled():
            self.end(error=_not_connected_error())
        elif (error := task.exception()) is not None:
            self.end(error=error)
        else:
            self.end(task.result())


def _not_connected_error() -> RsePfError:
    return Disconnected(
        "the robot is not connected", hint="use with client_sdk.connect_blocking(...) as robot"
    )
