"""Fork the workers of a server, and control them from the supervisor by two channels each.

Sockets are sent on the data channel, and orders on the control channel.  Workers are forked after the
supervisor's imports, which take most of the time of a start, and before its event loop and its threads.  A
worker inherits neither the listener nor the channels of other workers.  Calls do not block the supervisor: a
socket is refused if the channel is full, and waiting for an answer has a timeout.
"""

from __future__ import annotations

import asyncio
import gc
import importlib
import os
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.errors import MissingExtra
from rse_pf.processes.event_loop import event_loop_maker
from rse_pf.server.supervisor.orders import (
    BeginOrder,
    BlocksOrder,
    ReportOrder,
    RobotsOrder,
    UnblockOrder,
    WorkerOrder,
    encode_order,
)
from rse_pf.server.supervisor.worker import BEGIN_LENGTH, HANDOVER, WorkerPlan, run_worker
from rse_pf.services.loading import load_services

__all__ = ["BUILTIN", "RowsOrder", "WorkerProcess", "fork_workers", "warm_up"]

RowsOrder = BlocksOrder | RobotsOrder | UnblockOrder
"""Orders that a worker answers with a list of rows for an operator."""
BUILTIN = "rse_pf.services.builtin:builtin_services"
"""The ``module:function`` that returns the registry of the platform's own services."""
_DESCRIPTOR = struct.Struct("@i")
_MAX_LINE_BYTES = 1 << 20  # bytes of the longest message of a worker
_READ_BYTES = 4096  # bytes read at a time, each of which reports a closed socket


def warm_up(services: str = BUILTIN, settings: PlatformSettings | None = None) -> None:
    """Import the modules that every worker needs, and load *services* once; most of a server's start time.

    Raises:
        ConfigurationError: The services cannot be loaded.
        MissingExtra: The extra ``backend`` is not installed.
    """
    event_loop_maker()
    try:
        importlib.import_module("rse_pf.server.gateway.websocket")
    except ModuleNotFoundError as error:
        raise MissingExtra(error.name or "picows", "backend") from error
    load_services(services, settings or PlatformSettings())


def fork_workers(plans: Sequence[WorkerPlan], *, listener: socket.socket) -> list[WorkerProcess]:
    """Import the modules that every worker needs, then fork a worker for each plan, and return the workers.

    Call this before any thread is started and any event loop is made.  A worker closes its copy of
    *listener*.

    Raises:
        ConfigurationError: The services cannot be loaded.
        MissingExtra: The extra ``backend`` is not installed.
    """
    warm_up(plans[0].services, plans[0].settings)
    gc.collect()
    gc.freeze()  # otherwise the first garbage collection of a worker would copy every shared memory page
    workers: list[WorkerProcess] = []
    try:
        for plan in plans:
            channels = [end for worker in workers for end in worker.channels]
            workers.append(WorkerProcess(plan).start(unshared=[listener, *channels]))
    except OSError:
        for worker in workers:
            worker.kill()
        raise
    return workers


class WorkerProcess:
    """A worker process as its supervisor sees it: `start` forks it, `connect` waits until it is ready.

    Attributes:
        channels: The supervisor's ends of the data channel and the control channel.
        pid: The process id.
        load: Number of sockets that were sent to the worker and are not closed.
        is_ready: Whether the worker accepts sockets.
        report: The last report of its metrics; None before the first.
        empty: Set when a draining worker has no robot any more, or the worker has exited.
        exited: Set when the worker has exited.
    """

    def __init__(self, plan: WorkerPlan) -> None:
        """Fork nothing yet."""
        self._plan = plan
        self.load = 0
        self.is_ready = False
        self.cpu_s = 0.0
        """CPU seconds of the process; 0 until its exit code was read."""
        self.crash = plan.crash
        self.report: dict[str, Any] | None = None
        self.empty = asyncio.Event()
        self.exited = asyncio.Event()
        self._exit_code: int | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self._reported: asyncio.Future[None] | None = None
        self._rows: asyncio.Future[dict[str, Any]] | None = None
        self._rows_number = 0

    def start(self, *, unshared: Sequence[socket.socket]) -> WorkerProcess:
        """Fork the process, and return this object in the parent; the child never returns.

        The child closes the sockets *unshared*, which belong to its parent only.
        """
        self._data, data = socket.socketpair()
        self._control, control = socket.socketpair()
        self.channels = (self._data, self._control)
        with data, control:
            self.pid = os.fork()
            if self.pid == 0:
                _be_worker(self._plan, data, control, [*unshared, *self.channels])
        self._data.setblocking(False)
        return self

    def exit_code(self, how: int = os.WNOHANG) -> int | None:
        """Return the exit code of the process (negative for a signal), None while it runs.

        With 0 for *how*, wait until the process has ended.
        """
        if self._exit_code is None:
            try:
                pid, status, used = os.wait4(self.pid, how)
                self.cpu_s = used.ru_utime + used.ru_stime
            except ChildProcessError:
                pid, status = self.pid, 0  # other code has reaped the process, so its exit code is unknown
            if pid:
                self._exit_code = os.waitstatus_to_exitcode(status)
        return self._exit_code

    def begin(self, order: BeginOrder) -> bool:
        """Send *order* to a spare process, before `connect`; return False if the process has exited."""
        data = encode_order(order)
        try:
            self._control.sendall(BEGIN_LENGTH.pack(len(data)) + data)
        except OSError:
            return False
        return True

    async def connect(
        self,
        *,
        on_lost: Callable[[WorkerProcess], None],
        on_message: Callable[[WorkerProcess, dict[str, Any]], None],
    ) -> None:
        """Connect to the control channel, and wait until the worker is ready for sockets.

        Args:
            on_lost: Called when the worker exits, also if it was never ready.
            on_message: Called with each event of a robot, and with each message of notes for the audit log.
        """
        self._on_lost, self._on_message = on_lost, on_message
        reader, self._writer = await asyncio.open_unix_connection(sock=self._control, limit=_MAX_LINE_BYTES)
        loop = asyncio.get_running_loop()
        ready = asyncio.Event()
        self._reading = loop.create_task(self._listen(reader, ready))
        await ready.wait()
        self.is_ready = True
        loop.add_reader(self._data.fileno(), self._count_ended)

    def give(self, fd: int, number: int, peer: str) -> bool:
        """Send an accepted socket to the worker.

        Args:
            fd: Descriptor of the socket, which stays open in this process.
            number: Number of the socket on this server, in the order of acceptance.
            peer: Address of the other end.

        Returns:
            True if the socket was sent; False if the channel is full or closed.
        """
        try:
            self._data.sendmsg(
                [HANDOVER.pack(number, peer.encode())],
                [(socket.SOL_SOCKET, socket.SCM_RIGHTS, _DESCRIPTOR.pack(fd))],
            )
        except OSError:
            return False
        self.load += 1
        return True

    def order(self, order: WorkerOrder) -> None:
        """Send *order* to the worker; the order is lost if the worker has exited."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(encode_order(order))

    async def ask_report(self, timeout_s: float) -> None:
        """Ask the worker for its metrics, and set ``report``; without an answer in time it stays as it is."""
        self._reported = asyncio.get_running_loop().create_future()
        self.order(ReportOrder())
        await asyncio.wait([self._reported], timeout=timeout_s)

    async def ask_rows(self, order: RowsOrder, timeout_s: float) -> dict[str, Any] | None:
        """Send *order* and return the worker's answer; None if no answer comes within *timeout_s*.

        There may be only one such call at a time.
        """
        self._rows = asyncio.get_running_loop().create_future()
        self._rows_number = order.number
        self.order(order)
        await asyncio.wait([self._rows], timeout=timeout_s)
        return self._rows.result() if self._rows.done() else None

    def kill(self) -> None:
        """Kill the process and close the channels; a second call does nothing."""
        if self._data.fileno() < 0:
            return
        if self._reading is not None:
            self._reading.cancel()
            self._reading.get_loop().remove_reader(self._data.fileno())
        if self.exit_code() is None:
            os.kill(self.pid, signal.SIGKILL)
            self.exit_code(0)
        self.crash.close()
        self._data.close()
        if self._writer is not None:
            self._writer.close()
        else:
            self._control.close()

    async def _listen(self, reader: asyncio.StreamReader, ready: asyncio.Event) -> None:
        """Handle the messages of the worker until its exit, then call ``on_lost``."""
        try:
            while line := await reader.readline():
                self._handle(msgspec.json.decode(line), ready)
        except OSError:
            pass  # a killed worker resets its channel, which is handled as the end of the channel
        self.exited.set()
        self.empty.set()
        self._on_lost(self)

    def _handle(self, message: dict[str, Any], ready: asyncio.Event) -> None:
        """Handle one message of the worker; events of robots and notes are passed to ``on_message``."""
        match message["event"]:
            case "ready":
                ready.set()
            case "empty":
                self.empty.set()
            case "rows":
                waiting = self._rows
                if waiting is not None and not waiting.done() and message["number"] == self._rows_number:
                    waiting.set_result(message)
            case "robots":
                for event in message["robots"]:
                    self._on_message(self, event)
            case "report":
                self.report = message["report"]
                if self._reported is not None and not self._reported.done():
                    self._reported.set_result(None)
            case _:
                self._on_message(self, message)

    def _count_ended(self) -> None:
        """Reduce the load by the sockets that the worker reports as closed, one byte each."""
        try:
            ended = self._data.recv(_READ_BYTES)
        except OSError:
            ended = b""
        if ended:
            self.load -= len(ended)
        else:
            asyncio.get_running_loop().remove_reader(self._data.fileno())


def _be_worker(
    plan: WorkerPlan, data: socket.socket, control: socket.socket, unshared: Sequence[socket.socket]
) -> NoReturn:
    """Run a worker in the forked child, and exit, so that the child never runs the supervisor's code."""
    try:
        for inherited in unshared:
            inherited.close()
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
        os.close(nothing)
        run_worker(plan, data, control)
        os._exit(0)
    except BaseException:  # noqa: BLE001  the child must not continue as a second supervisor
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(1)
