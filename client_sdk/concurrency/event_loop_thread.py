"""Run an event loop in a thread, and let other threads wait for coroutines in it.

A waiting thread measures its own time limit, so a loop that hangs cannot delay it.  Whatever ends the loop
ends every call that waits.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import os
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rse_pf.errors import Disconnected, Expired, RsePfError, UsageError

__all__ = ["EventLoopThread", "wrong_process_error"]

T = TypeVar("T")

CLOSE_TIMEOUT_S = 5.0
"""Longest time for the coroutine of *at_end*, which closes connections and a recording, in seconds; it is
cancelled after that."""
THREAD_JOIN_S = 1.0
"""How long `EventLoopThread.close` waits after `CLOSE_TIMEOUT_S` for the loop, and then for its thread, in
seconds: a function of the program may block them."""


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
        self._calls: set[concurrent.futures.Future[Any]] = set()
        # Reentrant: a signal handler may call `close` in a thread that holds this lock.
        self._lock = threading.RLock()
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
        try:
            future = self._submit(work)
        except BaseException:
            work.close()
            raise
        try:
            return future.result(limit_s)
        except concurrent.futures.CancelledError:
            raise _not_connected_error() from None
        except concurrent.futures.TimeoutError:
            if future.done():  # *work* itself raised this TimeoutError
                raise
            raise Expired(
                f"no answer within {limit_s:g} s, which is deadline_s and a little more",
                hint="set a longer deadline_s, or give the robot more CPU time",
            ) from None
        finally:
            future.cancel()
            self._calls.discard(future)

    def close(self) -> None:
        """End the loop and every call that waits, and return within 7 s; any thread may call this,
        repeatedly.

        The thread of the loop does not wait for its own end.  A forked child process does nothing.
        """
        if os.getpid() != self._process:
            return
        with self._lock:
            if self._loop is None:
                return
            if not self._is_closing:
                self._is_closing = True
                with contextlib.suppress(RuntimeError):  # the loop has ended already
                    self._loop.call_soon_threadsafe(self._stop.set)
        if self._thread is not threading.current_thread():
            self._ended.wait(CLOSE_TIMEOUT_S + THREAD_JOIN_S)
            self._thread.join(THREAD_JOIN_S)

    def _submit(self, work: Coroutine[Any, Any, T]) -> concurrent.futures.Future[T]:
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
            future = asyncio.run_coroutine_threadsafe(work, self._loop)
            self._calls.add(future)
        return future

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
            call.cancel()
        self._started.set()  # `start` waits for this, also if no loop could be made
        self._ended.set()


def _not_connected_error() -> RsePfError:
    return Disconnected(
        "the robot is not connected", hint="use with client_sdk.connect_blocking(...) as robot"
    )
