"""An event loop in a thread of its own, and callers in other threads that never wait for it in vain.

A caller keeps its time limit itself.  Whatever ends the loop ends every call.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rse_pf.errors import Disconnected, Expired, RsePfError, UsageError

__all__ = ["LoopThread", "not_connected_here"]

T = TypeVar("T")

CLOSE_S = 5.0  # `LoopThread.close` waits this long for the close handshakes and the recorder
JOIN_S = 1.0  # and then this long for the thread, which may wait for a function of the program


def not_connected_here(process: int) -> Disconnected:
    """Return the error of a robot that *process* connected, and a child of it uses."""
    return Disconnected(
        f"this robot is connected in process {process}, and this is process {os.getpid()}",
        hint="connect a robot in each process, after the fork",
    )


class LoopThread:
    """Runs coroutines for other threads between `start` and `close`."""

    def __init__(self, at_end: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Start nothing yet; *at_end* is the last coroutine that the loop runs."""
        self._at_end = at_end
        self._calls: set[_Call] = set()
        self._lock = threading.RLock()  # a signal handler may close while the same thread calls
        self._process = os.getpid()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event
        self._started, self._ended = threading.Event(), threading.Event()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="rse-pf-robot", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._process = os.getpid()
        self._thread.start()
        self._started.wait()

    def wait(self, work: Coroutine[Any, Any, T], limit_s: float | None = None) -> T:
        """Run *work* in the loop and return its result, or raise its exception.

        Args:
            work: Cancelled if this call ends before it does.
            limit_s: Seconds; None for what has no deadline.  The end of the loop always ends the call.

        Raises:
            Disconnected: The loop has ended or ends now, or another process started it.
            Expired: The result did not come within *limit_s*.
            UsageError: The thread of the loop calls, which would wait for itself.
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
        """End the loop and every call; from any thread, and again.

        The thread of the loop does not wait for its own end.  In a child of a fork nothing happens.
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
            self._ended.wait(CLOSE_S + JOIN_S)
            self._thread.join(JOIN_S)

    def _submit(self, call: _Call) -> None:
        if os.getpid() != self._process:
            raise not_connected_here(self._process)
        if threading.current_thread() is self._thread:
            raise UsageError(
                "the event loop of the robot cannot wait for the robot",
                hint="call the robot in another thread",
            )
        with self._lock:
            if self._loop is None or self._is_closing:
                raise _closed()
            self._calls.add(call)
            self._loop.call_soon_threadsafe(call.begin)  # before the stop of a later close

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
                await asyncio.wait_for(self._at_end(), CLOSE_S)
        finally:
            self._end_calls()

    def _end_calls(self) -> None:
        """Let every caller go, also those whose work goes on in a function of the program."""
        with self._lock:
            self._is_closing = True
            calls = list(self._calls)
        for call in calls:
            call.end(error=_closed())
        self._started.set()  # also if no loop could be made
        self._ended.set()


class _Call:
    """One call: its work in the loop, and its end in the thread that waits."""

    def __init__(self, work: Coroutine[Any, Any, Any]) -> None:
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None
        self._work = work
        self._task: asyncio.Task[Any] | None = None

    def begin(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._work)
        self._task.add_done_callback(self._take)

    def cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    def end(self, result: Any = None, error: BaseException | None = None) -> None:
        if not self.done.is_set():
            self.result, self.error = result, error
            self.done.set()

    def _take(self, task: asyncio.Task[Any]) -> None:
        if task.cancelled():
            self.end(error=_closed())
        elif (error := task.exception()) is not None:
            self.end(error=error)
        else:
            self.end(task.result())


def _closed() -> RsePfError:
    return Disconnected(
        "the robot is not connected", hint="use with client_sdk.connect_blocking(...) as robot"
    )
