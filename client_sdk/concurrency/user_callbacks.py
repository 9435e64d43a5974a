"""Call the callables that a program gives to the SDK: whatever they do, the robot goes on.

Every such callable is called here, except those whose error their caller receives (`client_sdk.slots`).  An
exception is counted, and logged with its traceback once for each line that raises it.  A robot of asyncio
calls in its own event loop, never in the middle of a change of its own state; a blocking robot calls in a
thread, so that a callable that blocks does not cost the connection.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import inspect
import logging
import os
import queue
import threading
import time
import traceback
from collections.abc import Awaitable, Callable
from typing import Any

from rse_pf.errors import ConnectError, RsePfError, UsageError

__all__ = ["Callbacks"]

_log = logging.getLogger("client_sdk")

TOKEN_LIMIT_S = 30.0  # a service that issues tokens answers within seconds; a later answer is a failure
SLOW_S = 3.0  # the default of session.ping_timeout_s: a server closes a connection that is silent for longer
JOIN_S = 0.2  # `Callbacks.end_thread` waits this long for a callable that runs; it may block for ever


class Callbacks:
    """The callables of one program, and how many of their calls failed."""

    def __init__(self, slow_s: float = SLOW_S) -> None:
        """Call in the event loop that runs; a call that blocks it for longer than *slow_s* is reported."""
        self.errors = 0
        self._slow_s = slow_s
        self._reported: set[tuple[str, str, str]] = set()
        self._lock = threading.Lock()
        self._queue: queue.SimpleQueue[Callable[[], object] | None] | None = None
        self._thread: threading.Thread | None = None
        self._token_loop: asyncio.AbstractEventLoop | None = None

    def start_thread(self) -> None:
        """Call in a thread from now on, and token callables in the loop of another one."""
        self._queue = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=self._work, args=(self._queue,), name="rse-pf-callbacks", daemon=True
        )
        self._thread.start()

    def end_thread(self) -> None:
        """End the thread after the calls that wait; it does not wait for itself."""
        if self._queue is not None and self._thread is not None:
            self._queue.put(None)
            self._end_token_loop()
            if self._thread is not threading.current_thread():
                self._thread.join(JOIN_S)

    def notify(self, name: str, function: Callable[..., object], *arguments: Any) -> None:
        """Call *function* soon, in the order of these notifications; *name* is the word of the report."""
        work = functools.partial(self.call, name, function, *arguments)
        if self._queue is not None:
            self._queue.put(work)
        else:
            asyncio.get_running_loop().call_soon(work)

    def call(self, name: str, function: Callable[..., Any], *arguments: Any, default: Any = None) -> Any:
        """Call *function* now and return its value, or *default* after an exception."""
        began, process = time.monotonic(), os.getpid()
        try:
            value = function(*arguments)
            if inspect.iscoroutine(value):
                value.close()
                raise UsageError(f"{name} is an async function", hint="give a function that is not async")
        except BaseException as error:
            if _is_interrupt(error):
                raise
            self.report(name, error)
            return default
        finally:
            _end_child(process, name)
        if _has_running_loop():
            self._report_slow(name, time.monotonic() - began)
        return value

    async def fetch_token(self, function: Callable[[], Awaitable[str]]) -> Any:
        """Return the token of an async token callable.

        Raises:
            ConnectError: It raised, was cancelled, or did not return in time; the robot tries again later.
        """
        work: asyncio.Future[Any]
        if self._queue is None:
            work = asyncio.ensure_future(_awaited(function))
        else:
            work = asyncio.wrap_future(self._in_thread(function))
        try:
            await asyncio.wait({work}, timeout=TOKEN_LIMIT_S)
            is_late = not work.done()
        finally:
            work.cancel()  # without effect on a token that came
        error: BaseException
        if is_late:
            self._end_token_loop()  # the call may block it for ever
            error = TimeoutError(f"no token within {TOKEN_LIMIT_S:g} s")
        elif work.cancelled():
            error = asyncio.CancelledError()
        elif (raised := work.exception()) is not None:
            error = raised
        else:
            return work.result()
        raise self.token_error(error)

    def token_error(self, error: BaseException) -> ConnectError:
        """Report what a token callable raised, and return what it means for a connection."""
        if isinstance(error, RsePfError):  # its message is written for users, and says what to do
            self.report("the token callable", error, has_traceback=False)
            return ConnectError(f"no token: {error.message}", hint=error.hint)
        self.report("the token callable", error)
        return ConnectError(
            f"no token: the token callable raised {type(error).__name__}", hint="fix the token callable"
        )

    def report(self, name: str, error: BaseException, *, has_traceback: bool = True) -> None:
        """Count *error*, and log it unless the same line of the program raised its like before."""
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else ""
        if self._is_new((name, type(error).__name__, place)):
            if isinstance(error, RsePfError):
                cause = error.message
            else:  # str(error) may raise
                text = "".join(traceback.format_exception_only(type(error), error))
                cause = " ".join(text.partition(": ")[2].split())
            _log_error(
                "%s raised %s: %s; the robot goes on", name, type(error).__name__, cause,
                exc_info=error if has_traceback else None,
            )  # fmt: skip

    def _in_thread(self, function: Callable[[], Awaitable[str]]) -> concurrent.futures.Future[Any]:
        """Await *function* in the loop of a thread for which neither a robot nor an exit waits."""
        if self._token_loop is None:
            self._token_loop = asyncio.new_event_loop()
            threading.Thread(
                target=_run_loop, args=(self._token_loop,), name="rse-pf-token", daemon=True
            ).start()
        return asyncio.run_coroutine_threadsafe(_awaited(function), self._token_loop)

    def _end_token_loop(self) -> None:
        loop, self._token_loop = self._token_loop, None
        if loop is not None:
            loop.call_soon_threadsafe(loop.stop)

    def _report_slow(self, name: str, took_s: float) -> None:
        if took_s > self._slow_s and self._is_new((name, "slow", "")):
            _log_error(
                "%s took %.1f s, and session.ping_timeout_s is %.1f s; hint: do long work in a thread",
                name, took_s, self._slow_s,
            )  # fmt: skip

    def _is_new(self, key: tuple[str, str, str]) -> bool:
        with self._lock:
            self.errors += 1
            is_new = key not in self._reported
            self._reported.add(key)
        return is_new

    def _work(self, waiting: queue.SimpleQueue[Callable[[], object] | None]) -> None:
        while (work := waiting.get()) is not None:
            try:
                work()
            except BaseException as error:  # noqa: BLE001  the calls that wait are still due
                self.report("a callable", error)


def _log_error(text: str, *values: object, exc_info: BaseException | None = None) -> None:
    """Log by the handlers and filters of the program, which may raise as all of its callables."""
    with contextlib.suppress(Exception):
        _log.error(text, *values, exc_info=exc_info)


def _has_running_loop() -> bool:
    with contextlib.suppress(RuntimeError):
        return asyncio.get_running_loop().is_running()
    return False


def _is_interrupt(error: BaseException) -> bool:
    """Return whether *error* is to end the program: Ctrl-C or exit in the main thread."""
    is_exit = not isinstance(error, Exception | asyncio.CancelledError)
    return is_exit and threading.current_thread() is threading.main_thread()


def _run_loop(loop: asyncio.AbstractEventLoop) -> None:
    try:
        loop.run_forever()
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.run_until_complete(asyncio.sleep(0))
    finally:
        loop.close()


async def _awaited(function: Callable[[], Awaitable[str]]) -> Any:
    process = os.getpid()
    try:
        made = function()
        if not inspect.isawaitable(made):
            raise UsageError(
                f"the token callable returned a {type(made).__name__} and is not an async function",
                hint="pass an async function, such as read_enrolment(FILE).token",
            )
        return await made
    except (SystemExit, KeyboardInterrupt) as error:  # asyncio would end its loop by them
        if _is_interrupt(error):
            raise
        raise RuntimeError(f"the token callable raised {type(error).__name__}") from error
    finally:
        _end_child(process, "the token callable")


def _end_child(process: int, name: str) -> None:
    """End a child that *name* made by a fork and returned from: it would write on the parent's sockets."""
    if os.getpid() != process:
        _log_error("%s forked, and its child returned; hint: end the child by os._exit", name)
        os._exit(1)
