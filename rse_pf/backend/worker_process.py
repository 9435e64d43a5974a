"""A worker as its supervisor sees it: a process, its load, and two channels.

Promises never to block the supervisor: a full channel is a refusal, a silent worker a time-out.
"""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["NUMBER_BYTES", "WorkerProcess"]

_MOST_LINE_BYTES = 1 << 20
_READ_BYTES = 4096
NUMBER_BYTES = 8
"""Length of a socket's number, which travels with its descriptor."""


class WorkerProcess:
    """One worker process, started at once; `connect` waits until it is ready."""

    def __init__(
        self,
        config: Mapping[str, Any],
        on_lost: Callable[[WorkerProcess], None],
        on_robot: Callable[[WorkerProcess, dict[str, Any]], None],
    ) -> None:
        self.load = 0
        self.report: dict[str, Any] | None = None
        self.empty = asyncio.Event()
        self.gone = asyncio.Event()
        self._on_lost = on_lost
        self._on_robot = on_robot
        self._data, data = socket.socketpair()
        self._control, control = socket.socketpair()
        with data, control:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rse_pf.backend.worker", str(data.fileno()), str(control.fileno())],
                pass_fds=(data.fileno(), control.fileno(), *config["job_slots"]),
                stdin=subprocess.DEVNULL,
            )
        self._control.sendall(json.dumps(config).encode() + b"\n")
        self._data.setblocking(False)
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self._reported: asyncio.Future[None] | None = None

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def exit_code(self) -> int | None:
        """Return how the process ended, None while it runs or is not reaped."""
        return self._process.poll()

    async def connect(self, first_order: Mapping[str, Any]) -> None:
        """Wait until the worker takes sockets; `on_lost` is called if it never does."""
        reader, self._writer = await asyncio.open_unix_connection(sock=self._control, limit=_MOST_LINE_BYTES)
        loop = asyncio.get_running_loop()
        self.order(**first_order)
        ready = asyncio.Event()
        self._reading = loop.create_task(self._listen(reader, ready))
        await ready.wait()
        loop.add_reader(self._data.fileno(), self._count_ends)

    def give(self, accepted: socket.socket, number: int) -> bool:
        """Hand over the *number*-th accepted socket; False if the worker's channel is full or gone."""
        try:
            socket.send_fds(self._data, [number.to_bytes(NUMBER_BYTES, "big")], [accepted.fileno()])
        except OSError:
            return False
        self.load += 1
        return True

    def order(self, **what: Any) -> None:
        """Send an order; one to a worker that is gone is lost."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(json.dumps(what).encode() + b"\n")

    async def ask_report(self, timeout_s: float) -> None:
        """Renew `report`, or leave it as it is when the worker does not answer in time."""
        self._reported = asyncio.get_running_loop().create_future()
        self.order(do="report")
        await asyncio.wait([self._reported], timeout=timeout_s)

    def kill(self) -> None:
        """End the process, whatever it does, and close the channels."""
        if self._reading is not None:
            self._reading.cancel()
        if self._data.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self._data.fileno())
        self._process.kill()
        self._process.wait()
        self._data.close()
        if self._writer is not None:
            self._writer.close()
        else:
            self._control.close()

    async def _listen(self, reader: asyncio.StreamReader, ready: asyncio.Event) -> None:
        try:
            while line := await reader.readline():
                self._hear(json.loads(line), ready)
        except OSError:
            pass  # a killed worker resets its channel: the same end as below
        self.gone.set()
        self.empty.set()
        self._on_lost(self)

    def _hear(self, message: dict[str, Any], ready: asyncio.Event) -> None:
        if message["event"] == "ready":
            ready.set()
        elif message["event"] == "empty":
            self.empty.set()
        elif message["event"] != "report":
            self._on_robot(self, message)
        else:
            self.report = message["report"]
            if self._reported is not None and not self._reported.done():
                self._reported.set_result(None)

    def _count_ends(self) -> None:
        try:
            ended = self._data.recv(_READ_BYTES)
        except OSError:
            ended = b""
        if ended:
            self.load -= len(ended)
        else:
            asyncio.get_running_loop().remove_reader(self._data.fileno())
