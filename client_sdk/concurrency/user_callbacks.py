"""Call the functions that a program gives to the SDK, so that the robot goes on whatever they do.

An exception is counted, and logged with its traceback once for each line that raises it.  An asyncio robot
calls the functions in its own event loop, never in the middle of a change of its own state.  A blocking robot
calls them in a thread, so that a function that blocks does not cost the connection.  Functions whose
exceptions their caller receives (parts of a tracker that a user replaces) are called elsewhere.
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

__all__ = ["UserCallbacks"]

_log = logging.getLogger("client_sdk")

TOKEN_TIMEOUT_S = 30.0
"""A token function that takes longer than this has failed: services that issue tokens answer within
seconds."""
SLOW_CALL_S = 3.0
"""Without another limit, a function that blocks the event loop for more than this many seconds is reported.
The limit of a robot is session.ping_timeout_s, after which a connection without an answer to a ping counts as
lost; its default is as long."""
THREAD_JOIN_S = 0.2
"""How long `UserCallbacks.end_thread` waits for a function that still runs, in seconds; such a function may
block for ever."""
TOKEN_FUNCTION = "the token callable"
"""Name of the program's token function in reports and errors."""


class UserCallbacks:
    """Call the functions of one program; `errors` counts the calls that failed or were too slow."""

    def __init__(self, slow_s: float = SLOW_CALL_S) -> None:
        """Prepare calls in the running event loop; report one that blocks it for more than *slow_s* s."""
        self.errors = 0
        self._slow_s = slow_s
        self._reported: set[tuple[str, str, str]] = set()
        self._lock = threading.Lock()
        self._calls: queue.SimpleQueue[Callable[[], object] | None] | None = None
        self._thread: threading.Thread | None = None
        self._token_loop: asyncio.AbstractEventLoop | None = None

    def start_thread(self) -> None:
        """Call user functions in a new thread from now on.

        Token functions are called in the event loop of a second thread, which starts when one is needed.
        """
        self._calls = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=self._run_calls, args=(self._calls,), name="rse-pf-callbacks", daemon=True
        )
        self._thread.start()

    def end_thread(self) -> None:
        """End the thread after the calls that wait in its queue.

        This waits `THREAD_JOIN_S` for the end, unless it is called in the thread itself; a function that
        still runs after that goes on.
        """
        if self._calls is not None and self._thread is not None:
            self._calls.put(None)
            self._end_token_loop()
            if self._thread is not threading.current_thread():
                self._thread.join(THREAD_JOIN_S)

    def notify(self, name: str, function: Callable[..., object], *arguments: Any) -> None:
        """Call *function* soon, in the order of these calls; the report of an exception says *name*."""
        call = functools.partial(self.call, name, function, *arguments)
        if self._calls is not None:
            self._calls.put(call)
        else:
            asyncio.get_running_loop().call_soon(call)

    def call(self, name: str, function: Callable[..., Any], *arguments: Any, default: Any = None) -> Any:
        """Call *function* now and return its value, or *default* after an exception, reported as *name*.

        An async function counts as one that raised.  Ctrl-C and ``sys.exit`` in the main thread are raised
        again.
        """
        began_s, process = time.monotonic(), os.getpid()
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
            _exit_forked_child(process, name)
        if _has_running_loop():
            self._report_slow(name, time.monotonic() - began_s)
        return value

    async def fetch_token(self, function: Callable[[], Awaitable[str]]) -> Any:
        """Call the async token function of the program and return its value, which may be no text.

        Raises:
            ConnectError: *function* raised, was cancelled, or took longer than 30 s.
        """
        result: asyncio.Future[Any]
        if self._calls is None:
            result = asyncio.ensure_future(_await_token(function))
        else:
            result = asyncio.wrap_future(self._run_in_token_thread(function))
        try:
            await asyncio.wait({result}, timeout=TOKEN_TIMEOUT_S)
            is_late = not result.done()
        finally:
            result.cancel()  # no effect on a token that has arrived
        error: BaseException
        if is_late:
            self._end_token_loop()  # the token function may block this event loop for ever
            error = TimeoutError(f"no token within {TOKEN_TIMEOUT_S:g} s")
        elif result.cancelled():
            error = asyncio.CancelledError()
        elif (raised := result.exception()) is not None:
            error = raised
        else:
            return result.result()
        raise self.token_error(error)

    def token_error(self, error: BaseException) -> ConnectError:
        """Report *error*, which a token function raised, and return it as an error of the connection."""
        if isinstance(error, RsePfError):  # its message and hint tell users enough without a traceback
            self.report(TOKEN_FUNCTION, error, has_traceback=False)
            return ConnectError(f"no token: {error.message}", hint=error.hint)
        self.report(TOKEN_FUNCTION, error)
        return ConnectError(
            f"no token: {TOKEN_FUNCTION} raised {type(error).__name__}",
            hint="repair the token callable: the log has its traceback",
        )

    def report(self, name: str, error: BaseException, *, has_traceback: bool = True) -> None:
        """Add 1 to `errors`; log *error* if its type was not yet logged for *name* and the source line.

        Args:
            name: The user function that raised *error*, as the log names it.
            error: What the function raised.
            has_traceback: Whether the log entry includes the traceback of *error*.
        """
        frames = traceback.extract_tb(error.__traceback__)
        source_line = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else ""
        if self._count((name, type(error).__name__, source_line)):
            if isinstance(error, RsePfError):
                cause = error.message
            else:  # `str(error)` may raise; `format_exception_only` does not
                text = "".join(traceback.format_exception_only(type(error), error))
                cause = " ".join(text.partition(": ")[2].split())
            _log_error(
                "%s raised %s: %s; the robot goes on",
                name,
                type(error).__name__,
                cause,
                exc_info=error if has_traceback else None,
            )

    def _run_in_token_thread(self, function: Callable[[], Awaitable[str]]) -> concurrent.futures.Future[Any]:
        """Await *function* in the event loop of a daemon thread, for whose end nobody waits."""
        if self._token_loop is None:
            self._token_loop = asyncio.new_event_loop()
            threading.Thread(
                target=_run_loop, args=(self._token_loop,), name="rse-pf-token", daemon=True
            ).start()
        return asyncio.run_coroutine_threadsafe(_await_token(function), self._token_loop)

    def _end_token_loop(self) -> None:
        loop, self._token_loop = self._token_loop, None
        if loop is not None:
            loop.call_soon_threadsafe(loop.stop)

    def _report_slow(self, name: str, took_s: float) -> None:
        if took_s > self._slow_s and self._count((name, "slow", "")):
            _log_error(
                "%s took %.1f s, and session.ping_timeout_s is %.1f s; hint: do long work in a thread",
                name,
                took_s,
                self._slow_s,
            )

    def _count(self, key: tuple[str, str, str]) -> bool:
        """Count a failed or slow call; return whether *key* is new, so that the call has to be logged."""
        with self._lock:
            self.errors += 1
            is_new = key not in self._reported
            self._reported.add(key)
        return is_new

    def _run_calls(self, calls: queue.SimpleQueue[Callable[[], object] | None]) -> None:
        while (call := calls.get()) is not None:
            try:
                call()
            except BaseException as error:  # noqa: BLE001  the calls that wait in the queue are still due
                self.report("a callable", error)


def _log_error(text: str, *values: object, exc_info: BaseException | None = None) -> None:
    """Log an error, and ignore exceptions of the program's own log handlers and filters."""
    with contextlib.suppress(Exception):
        _log.error(text, *values, exc_info=exc_info)


def _has_running_loop() -> bool:
    with contextlib.suppress(RuntimeError):
        return asyncio.get_running_loop().is_running()
    return False


def _is_interrupt(error: BaseException) -> bool:
    """Return whether *error* is meant to end the program: Ctrl-C or ``sys.exit`` in the main thread."""
    ends_program = not isinstance(error, Exception | asyncio.CancelledError)
    return ends_program and threading.current_thread() is threading.main_thread()


def _run_loop(loop: asyncio.AbstractEventLoop) -> None:
    try:
        loop.run_forever()
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.run_until_complete(asyncio.sleep(0))
    finally:
        loop.close()


async def _await_token(function: Callable[[], Awaitable[str]]) -> Any:
    process = os.getpid()
    try:
        token = function()
        if not inspect.isawaitable(token):
            raise UsageError(
                f"{TOKEN_FUNCTION} returned a {type(token).__name__} and is not an async function",
                hint="pass an async function, such as read_enrolment(FILE).token",
            )
        return await token
    except (SystemExit, KeyboardInterrupt) as error:  # they would end the event loop
        if _is_interrupt(error):
            raise
        raise RuntimeError(f"{TOKEN_FUNCTION} raised {type(error).__name__}") from error
    finally:
        _exit_forked_child(process, TOKEN_FUNCTION)


def _exit_forked_child(parent: int, name: str) -> None:
    """Exit a child process that the user function *name* forked: it shares sockets with *parent*."""
    if os.getpid() != parent:
        _log_error("%s forked, and its child returned; hint: end the child by os._exit", name)
        os._exit(1)
