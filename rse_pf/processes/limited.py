"""Run a function on untrusted bytes in processes that have limits and are killed at a timeout.

    with LimitedProcesses("rse_pf.maps.describe:describer", ProcessLimits(memory_bytes=1 << 28)) as processes:
        description = processes.call(data, timeout_s=5.0)

``describer`` is called once with the configuration, in a template process that has one thread.  It imports
the modules that the work needs, and returns the handler, a function from bytes to bytes.  Each process is
forked from the template and answers one call after the other, so values that the handler caches stay until
its process is killed.  A process that was killed is replaced in some milliseconds.  `LimitedProcesses.call`
blocks, and may be called by several threads.

Bytes that crash their process, or exhaust its memory or CPU time, damage no other process.  Only such bytes
raise Crashed, which the caller counts against their sender; the other errors do not count.  The processes are
no sandbox: code that takes over a process has the permissions of its user.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import socket
import struct
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

from rse_pf.errors import (
    Busy,
    Crashed,
    Expired,
    InternalError,
    RsePfError,
    WorkerLost,
    error_from_code,
)
from rse_pf.processes.fork_server import ForkPlan, read_packet, send_order, serve_forks, start_fork_server
from rse_pf.processes.ipc import receive_bytes
from rse_pf.processes.linux import be_killed_first, close_other_descriptors, die_with_parent, limit_memory
from rse_pf.processes.start import Child, ChildPlan, how_ended

__all__ = [
    "DEFAULT_NICENESS",
    "Handler",
    "LimitedProcesses",
    "Overran",
    "ProcessLimits",
    "limit_cpu",
    "run",
]

Handler = Callable[[bytes], bytes]
"""Computes the reply to the bytes of a call; an `RsePfError` that it raises is raised in the caller, too.

After a MemoryError the process exits, and the caller gets Crashed."""

DEFAULT_NICENESS = 5
"""Niceness of the processes above that of the process that starts them."""
_MAX_REPLY_BYTES = 1 << 20
"""Most bytes of a reply, if `ProcessLimits` sets no other limit."""
_ORDER_TIMEOUT_S = 10.0
"""Seconds within which the template must fork or kill a process; otherwise it hangs, and is replaced."""
_BUSY_RETRY_MS = 1000.0
"""Milliseconds after which a caller may try again if no process was free."""
_NEAR = 4
"""Number of the latest different keys (*near* of `LimitedProcesses.call`) that are remembered for each
process, which caches the data of a few calls only."""
_OUT_OF_MEMORY = 77
"""Exit code of a process whose handler raised MemoryError."""
_NO_MEMORY = how_ended(_OUT_OF_MEMORY)
"""How the fork server reports a process that exited at its memory limit."""
_NO_TIME = how_ended(-signal.SIGPROF)
"""How the fork server reports a process that was ended at its CPU limit: the kernel sends it this signal."""
_LENGTH = struct.Struct("<Q")
"""Head of a call: the number of bytes that follow."""
_REPLY = struct.Struct("<BQd")
"""Head of a reply: its kind, the number of bytes that follow, and the CPU seconds of the process so far."""
_DONE = 0
"""Kind of a reply: the result of the handler."""
_REFUSED = 1
"""Kind of a reply: an `RsePfError` that the handler raised."""
_DEFECT = 2
"""Kind of a reply: the handler raised another exception."""


class Overran(Expired):
    """The timeout of a call passed while its process worked on it, and the process was killed.

    ``cpu_s`` are the CPU seconds that the work had taken.
    """

    def __init__(self, timeout_s: float, cpu_s: float) -> None:
        super().__init__(f"the work took longer than {timeout_s:.3g} s and was ended", hint="allow more time")
        self.cpu_s = cpu_s


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessLimits:
    """The limits of one process."""

    memory_bytes: int
    """Most bytes that a process may allocate in addition to those that the template has allocated."""
    cpu_s: float = 60.0
    """Most CPU seconds of one call; the handler may set another limit by `limit_cpu`."""
    max_reply_bytes: int = _MAX_REPLY_BYTES
    """Most bytes of a reply; a longer reply counts as a crash of the process."""


class LimitedProcesses:
    """Up to *count* processes that answer calls; no process is started before the first call."""

    def __init__(
        self,
        target: str,
        limits: ProcessLimits,
        *,
        configuration: str = "",
        count: int = 1,
        niceness: int = DEFAULT_NICENESS,
    ) -> None:
        """Store the function and its limits; no process is started.

        Args:
            target: ``module:function``; the function takes *configuration* and returns a `Handler`.
            limits: The limits of one process.
            configuration: Text for *target*, such as settings in JSON; at most 100 kB.
            count: Most processes that work at the same time; further calls wait until one is free.
            niceness: Niceness of the processes above that of this process.
        """
        order = {
            "target": target, "configuration": configuration, "limits": [limits.memory_bytes, limits.cpu_s]
        }  # fmt: skip
        self._memory_bytes = limits.memory_bytes
        self._max_reply_bytes = limits.max_reply_bytes
        self._template = _Template(order, niceness)
        self._free = _FreeSlots(count)

    def __enter__(self) -> LimitedProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(
        self, data: bytes, timeout_s: float, *, near: str = "", charge: Callable[[float], None] | None = None
    ) -> bytes:
        """Return the handler's reply to *data*; block for at most *timeout_s* seconds and some milliseconds.

        If a process that has answered earlier calls exits, the call is repeated once in a new process,
        because an earlier call may be the cause.

        Args:
            data: The bytes that the handler receives.
            timeout_s: Longest time in seconds for the wait for a free process and the work together.
            near: A key of the data that the call needs.  A free process that lately worked on a call with the
                same key is preferred, because it may have cached these data.
            charge: Called with the CPU seconds that the call took, once for each process that worked on it.

        Raises:
            Crashed: *data* ended the process by a limit or a signal, which the message names.
            Overran: *timeout_s* passed during the work, and the process was killed.
            Busy: *timeout_s* passed before a process was free or started.
            WorkerLost: The processes cannot be started, or were closed; *data* is not the cause.
            InternalError: The handler raised an exception that is no `RsePfError`.
            RsePfError: The error that the handler raised.
        """
        until = time.monotonic() + timeout_s
        slot = self._free.take(near, until)
        try:
            while True:
                process = slot.process
                is_new = process is None or not self._template.has(process)
                if process is None or is_new:
                    slot.forget()
                    process = slot.process = self._template.fork(until)
                slot.note(near)
                before_s = process.cpu_s
                try:
                    return _exchange(process, data, until, self._max_reply_bytes)
                except TimeoutError:
                    _, cpu_s = self._end(slot, process)
                    raise Overran(timeout_s, cpu_s) from None
                except _ProcessEnded as ended:
                    how, cpu_s = self._end(slot, process)
                    if is_new or how == _NO_TIME:
                        raise self._crash(ended.reason or how, cpu_s) from None
                finally:
                    if charge is not None:
                        charge(process.cpu_s - before_s)
        finally:
            self._free.give(slot)

    def pids(self) -> list[int]:
        """Return the pids of the template, if it runs, and of its processes."""
        return self._template.pids()

    def close(self) -> None:
        """Kill the template and all processes; a call that is being answered raises WorkerLost."""
        self._template.close()
        self._free.forget_all()

    def _end(self, slot: _Slot, process: _Process) -> tuple[str, float]:
        """Kill *process* unless it has exited; return how it ended, and the CPU seconds of its last call.

        *slot* is free for a new process then.
        """
        slot.forget()
        return self._template.end(process)

    def _crash(self, how: str, cpu_s: float) -> Crashed:
        """Return the error about a process that ended as *how* says, after *cpu_s* CPU seconds of a call."""
        if how == _NO_MEMORY:
            how = f"it needs more than {self._memory_bytes / 1e6:.0f} MB of memory"
        elif how == _NO_TIME:
            how = f"it used {cpu_s:.1f} s of CPU time, which is more than it may"
        return Crashed(f"the process that worked on this request ended: {how}", hint="send less data at once")


class _Process:
    """One forked process, and the socket to it."""

    def __init__(self, number: int, pid: int, connection: socket.socket) -> None:
        self.number = number
        self.pid = pid
        self.connection = connection
        self.cpu_s = 0.0
        """CPU seconds of the process at the end of its last call."""


class _Slot:
    """The slot of one process: the process (None until a call forks one), and its latest values of *near*."""

    def __init__(self) -> None:
        self.process: _Process | None = None
        self.near: deque[str] = deque(maxlen=_NEAR)

    def note(self, near: str) -> None:
        """Remember that the process worked on a call with this value of *near*."""
        if near in self.near:
            self.near.remove(near)
        self.near.append(near)

    def forget(self) -> None:
        """Close the socket to the process, so that it exits, and make the slot empty."""
        self.near.clear()
        if self.process is not None:
            self.process.connection.close()
            self.process = None


class _FreeSlots:
    """The slots whose processes work on no call."""

    def __init__(self, count: int) -> None:
        self._slots = [_Slot() for _ in range(count)]
        self._changed = threading.Condition()

    def take(self, near: str, until: float) -> _Slot:
        """Wait for a free slot and take it.

        The slot that worked on a call with the same *near* last is preferred, otherwise the slot with the
        fewest remembered values.

        Raises:
            Busy: No slot was free until the monotonic time *until*.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._slots, max(0.0, until - time.monotonic())):
                raise _busy_error("no process was free in time")
            fitting = [row for row, slot in enumerate(self._slots) if near in slot.near]
            fewest = min(range(len(self._slots)), key=lambda row: len(self._slots[row].near))
            return self._slots.pop(fitting[-1] if fitting else fewest)

    def give(self, slot: _Slot) -> None:
        with self._changed:
            self._slots.append(slot)
            self._changed.notify()

    def forget_all(self) -> None:
        with self._changed:
            for slot in self._slots:
                slot.forget()
            self._slots.clear()


class _ProcessEnded(Exception):
    """A process closed its socket, or replied against the rules, which *reason* explains."""

    def __init__(self, reason: str = "") -> None:
        super().__init__(reason)
        self.reason = reason


class _Template:
    """The fork server, as the process that uses it sees it.

    It is started for the first fork, and again for the next fork after it has ended.
    """

    def __init__(self, order: dict[str, Any], niceness: int) -> None:
        self._order = order
        self._plan = ChildPlan(
            target=f"{__name__}:run", name="rse-pf limited", policy="batch", nice=niceness,
            outlives_parent=True,
        )  # fmt: skip
        self._lock = threading.Lock()
        self._server: Child | None = None
        self._is_ready = False
        self._is_closed = False
        self._number = 0
        """Number of the latest fork; a fork server that replaces another one continues the numbers."""
        self._forked: dict[int, int] = {}
        """The pids of the forks of the present fork server, by number."""
        self._ends: dict[int, tuple[str, float]] = {}
        """How reported forks ended, and their CPU seconds, by number."""

    def has(self, process: _Process) -> bool:
        """Return whether *process* was forked by the present fork server and was not ended."""
        return process.number in self._forked

    def pids(self) -> list[int]:
        return ([self._server.pid] if self._server is not None else []) + sorted(self._forked.values())

    def fork(self, until: float) -> _Process:
        """Fork and return a new process.

        Raises:
            Busy: The fork server was not ready at the monotonic time *until*; it continues to start.
            WorkerLost: The fork server cannot start, has ended, or was closed.
        """
        with self._hold_lock(until):
            if self._is_closed:
                raise WorkerLost("the processes for this work were closed", hint="try again elsewhere")
            try:
                server = self._server = self._server or start_fork_server(self._plan, self._order)
                self._wait_until_ready(server, until)
                ours, theirs = socket.socketpair()
            except OSError as error:
                raise WorkerLost(f"no process can be started: {error.strerror}", hint="try again") from error
            with theirs, contextlib.ExitStack() as undo:
                undo.enter_context(ours)
                self._number += 1
                number = self._number
                self._ask(server, "create", number, theirs.fileno())
                while number not in self._forked:
                    self._take_report(server)
                undo.pop_all()
            return _Process(number, self._forked[number], ours)

    def end(self, process: _Process) -> tuple[str, float]:
        """Kill *process* unless it has exited; return how it ended, and the CPU seconds of its last call.

        Raises:
            WorkerLost: The fork server has ended, and *process* with it.
        """
        number = process.number
        with self._lock:
            if self._server is None or not self.has(process):
                raise WorkerLost("the process ended, because its template ended", hint="try again")
            self._ask(self._server, "end", number)
            while number not in self._ends:
                self._take_report(self._server)
            del self._forked[number]
            how, cpu_s = self._ends.pop(number)
        used_s = max(0.0, cpu_s - process.cpu_s)
        process.cpu_s += used_s
        return how, used_s

    def close(self) -> None:
        with self._lock:
            self._is_closed = True
            self._stop()

    @contextlib.contextmanager
    def _hold_lock(self, until: float) -> Iterator[None]:
        if not self._lock.acquire(timeout=max(0.0, until - time.monotonic())):
            raise _busy_error("no process was free in time")
        try:
            yield
        finally:
            self._lock.release()

    def _wait_until_ready(self, server: Child, until: float) -> None:
        if self._is_ready:
            return
        server.connection.settimeout(max(1e-3, until - time.monotonic()))
        try:
            report, _ = read_packet(server.connection)
        except TimeoutError:
            raise _busy_error("the process was not started in time") from None
        if report is None:
            self._stop()
            raise WorkerLost(
                "the process cannot be started",
                hint="report it to the operator; the server's log has the cause",
            )
        server.connection.settimeout(_ORDER_TIMEOUT_S)
        self._is_ready = True

    def _ask(self, server: Child, do: str, number: int, *descriptors: int) -> None:
        try:
            send_order(server, do, number, *descriptors)
        except OSError:
            self._lose()

    def _take_report(self, server: Child) -> None:
        """Receive one report of the fork server; raises WorkerLost if it has ended or does not answer."""
        try:
            report, handles = read_packet(server.connection)
        except TimeoutError:
            report, handles = None, []
        for handle in handles:
            os.close(handle)
        if report is None:
            self._lose()
        elif report["event"] == "created":
            self._forked[report["id"]] = report["pid"]
        else:
            self._ends[report["id"]] = report["how"], report["cpu_s"]

    def _lose(self) -> NoReturn:
        """Stop the fork server, which does not answer, and raise WorkerLost."""
        self._stop()
        raise WorkerLost("the template from which processes are forked ended", hint="try again")

    def _stop(self) -> None:
        """Kill the fork server; Linux then kills all its forks."""
        if self._server is not None:
            self._server.kill()
        self._server = None
        self._is_ready = False
        self._forked.clear()
        self._ends.clear()


def _busy_error(why: str) -> Busy:
    return Busy(why, hint="try again later, or allow more time", retry_after_ms=_BUSY_RETRY_MS)


def _exchange(process: _Process, data: bytes, until: float, max_reply_bytes: int) -> bytes:
    """Send *data* to *process* and return its reply.

    Raises:
        TimeoutError: The monotonic time *until* passed.
        _ProcessEnded: The process exited, or its reply is longer than *max_reply_bytes*.
        InternalError: The handler raised an exception that is no `RsePfError`.
        RsePfError: The error that the handler raised.
    """
    connection = process.connection
    try:
        connection.settimeout(_left_s(until))
        connection.sendall(_LENGTH.pack(len(data)))
        connection.sendall(data)
        kind, length, process.cpu_s = _REPLY.unpack(_receive(connection, _REPLY.size, until))
        if length > max_reply_bytes:
            raise _ProcessEnded(f"it replied with {length} bytes, above {max_reply_bytes}")
        reply = _receive(connection, length, until)
    except TimeoutError:
        raise
    except OSError:
        raise _ProcessEnded from None
    if kind == _DONE:
        return reply
    if kind == _REFUSED:
        code, message, hint, retry_after_ms = json.loads(reply)
        raise error_from_code(code, message, hint=hint, retry_after_ms=retry_after_ms)
    raise InternalError("the work raised an unexpected error", hint="the server's log has the traceback")


def _receive(connection: socket.socket, size: int, until: float) -> bytes:
    """Return the next *size* bytes; raises TimeoutError at *until*, `_ProcessEnded` if there are fewer."""
    received = receive_bytes(connection, size, until)
    if len(received) < size:
        raise _ProcessEnded
    return received


def _left_s(until: float) -> float:
    """Return the seconds until the monotonic time *until*; raises TimeoutError if it has passed."""
    left_s = until - time.monotonic()
    if left_s <= 0:
        raise TimeoutError
    return left_s


# --- functions that run in the fork server and in its forks ---------------------------------------------


def run(parent: socket.socket) -> None:
    """Run as the fork server: make the handler, and fork processes as *parent* orders, until it exits."""
    order, _ = read_packet(parent)
    if order is None:
        return
    memory_bytes, cpu_s = order["limits"]
    module, _, function = order["target"].partition(":")
    handler: Handler = getattr(importlib.import_module(module), function)(order["configuration"])

    def fork(number: int, descriptors: list[int]) -> int:
        pid = os.fork()
        if pid == 0:
            _work(parent, handler, memory_bytes, cpu_s, socket.socket(fileno=descriptors[0]))
        return pid

    serve_forks(parent, ForkPlan(fork=fork, keeps_ended=True))


def _work(
    parent: socket.socket, handler: Handler, memory_bytes: int, cpu_s: float, connection: socket.socket
) -> NoReturn:
    """Answer calls in a fork until *connection* is closed, then exit; never return."""
    try:
        template = os.getppid()
        close_other_descriptors(connection.fileno())
        if die_with_parent(template):
            limit_memory(memory_bytes, beyond_now=True)
            be_killed_first()
            _silence_libraries()
            while _answer(connection, handler, cpu_s):
                pass
        os._exit(0)
    except MemoryError:
        os._exit(_OUT_OF_MEMORY)
    finally:
        os._exit(1)


def limit_cpu(cpu_s: float) -> None:
    """Set the CPU limit of the present call: after *cpu_s* more CPU seconds, this process is killed.

    0 removes the limit, as the reply to the call does.
    """
    signal.setitimer(signal.ITIMER_PROF, cpu_s)


def _silence_libraries() -> None:
    """Drop text that native code prints, which the bytes of a call may choose; keep tracebacks of Python."""
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def _answer(connection: socket.socket, handler: Handler, cpu_s: float) -> bool:
    """Answer one call; return False if the connection is closed.

    A call that uses more than *cpu_s* seconds of CPU time ends this process.
    """
    header = connection.recv(_LENGTH.size, socket.MSG_WAITALL)
    if len(header) < _LENGTH.size:
        return False
    (length,) = _LENGTH.unpack(header)
    data = connection.recv(length, socket.MSG_WAITALL)
    if len(data) < length:
        return False
    limit_cpu(cpu_s)
    try:
        kind, reply = _DONE, handler(data)
    except MemoryError:
        raise
    except RsePfError as error:
        fields = [error.code, error.message, error.hint, error.retry_after_ms]
        kind, reply = _REFUSED, json.dumps(fields).encode()
    except BaseException:  # noqa: BLE001  the reason goes to the log, and the process answers the next call
        traceback.print_exc()
        kind, reply = _DEFECT, b""
    limit_cpu(0.0)
    try:
        connection.sendall(_REPLY.pack(kind, len(reply), time.process_time()))
        connection.sendall(reply)
    except OSError:
        return False
    return True
