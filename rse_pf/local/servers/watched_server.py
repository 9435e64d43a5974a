"""A server of one process on one machine: started, watched and replaced; of data, or of rosbridge clients.

A replacement takes the port of the process before it, so the load balancer's configuration does not change.
A process that answers no health check any more is killed and replaced like one that has ended.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.processes import ProcessMark, ServerProcess
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.state import ServerState
from rse_pf.processes.linux import run_as_batch

__all__ = ["CHECK_S", "NICENESS", "WatchedServer"]

# Time between two checks of the service, and time limit of one, in seconds.
CHECK_S = 1.0
# First pause between two failed starts, in seconds; each next one is twice as long.
_FIRST_PAUSE_S = 0.1
# Longest pause between two failed starts, in seconds.
_MAX_PAUSE_S = 5.0
# Time between two checks whether a full disk has space again, in seconds.
_WAIT_FOR_SPACE_S = 0.5
# Niceness of these servers: on one machine poses have priority.
NICENESS = 10


class WatchedServer:
    """One process with a name, and its replacements.

    ``port`` is that of the process and of its replacements, 0 before the first start.
    """

    def __init__(
        self,
        name: str,
        *,
        folder: Path,
        command: Sequence[str],
        ready: str,
        alive: str,
        event: str,
        unhealthy_checks: int,
        start_timeout_s: float,
        dies_with_parent: bool = True,
        replaces: bool = True,
        is_full: Callable[[], bool] = lambda: False,
        emit: Callable[..., None] = lambda event, **details: None,
    ) -> None:
        """Remember what to start.

        Args:
            name: Of the process, in log and events.
            folder: Gets the log and the announcement.
            command: What to run; ``--announce`` and ``--port`` with their values follow.
            ready: Path that answers 200 while requests can be served.
            alive: Path that answers 200 unless the process must be replaced.
            event: Prefix of the names of events.
            unhealthy_checks: After more failed checks than these, the process is killed.
            start_timeout_s: How long a start may take.
            dies_with_parent: Whether the process ends when this one does.
            replaces: Whether one that ends or hangs is replaced; else only the event is emitted.
            is_full: Whether the disk is full now; no process is started then.
            emit: Gets EVENT-start with name and pid, EVENT-up with port, too, EVENT-down with name and code,
                EVENT-silent and EVENT-failed.
        """
        self._ready, self._alive, self._event = ready, alive, event
        self._unhealthy_checks = unhealthy_checks
        self._start_timeout_s = start_timeout_s
        self._dies_with_parent = dies_with_parent
        self._replaces = replaces
        self._is_full = is_full
        self._emit = emit
        self.port = 0
        self.process = ServerProcess(name, folder)
        self._watching: asyncio.Task[None] | None = None
        self._command = [*command, "--announce", str(self.process.announcement)]

    @property
    def target(self) -> Target:
        """The service as the load balancer sees it."""
        return Target(name=self.process.name, port=self.port, control_port=self.port)

    @property
    def state(self) -> ServerState | None:
        """The entry of the state file; None if there is no process."""
        name, mark = self.process.name, self.process.mark
        return None if mark is None else ServerState(name=name, process=mark, port=self.port)

    def document(self) -> list[dict[str, Any]]:
        """Return name, pid, port and whether it runs, as plain JSON values; empty before the first start."""
        name, mark = self.process.name, self.process.mark
        running = self.process.is_running()
        return (
            [] if mark is None else [{"name": name, "pid": mark.pid, "port": self.port, "running": running}]
        )

    async def start(self, port: int = 0) -> None:
        """Start the process at *port* (0: a free one), wait until it answers, and watch it from then on.

        Raises:
            ConfigurationError: It ended or was not ready in time.
        """
        self.port = port
        try:
            await self._launch()
        except ConfigurationError:
            if not port:
                raise
            self.port = 0  # another program has it now
            await self._launch()
        self._watching = asyncio.create_task(self._watch())

    async def restart(self, timeout_s: float) -> None:
        """Replace the process, if there is one, by one that reads the settings anew, at the same port.

        Raises:
            ConfigurationError: It did not start; that is tried again from now on.
        """
        if self._watching is None:
            return
        await self.forget()
        await self.process.stop(signal.SIGTERM, timeout_s)
        try:
            await self._launch()
        finally:
            self._watching = asyncio.create_task(self._watch())

    def adopt(self, mark: ProcessMark, port: int) -> None:
        """Watch the process of an earlier control plane, and replace it when it ends."""
        self.process.mark, self.port = mark, port
        self._watching = asyncio.create_task(self._watch())

    async def is_ready(self) -> bool:
        """Return whether the service answers and its store does."""
        return self.port > 0 and await self._is_answering(self._ready)

    async def forget(self) -> None:
        """Stop watching, and leave the process running."""
        if self._watching is not None:
            self._watching.cancel()
            await asyncio.gather(self._watching, return_exceptions=True)
        self._watching = None

    async def stop(self, timeout_s: float) -> None:
        """Let the service leave, and kill it after *timeout_s*."""
        await self.forget()
        await self.process.stop(signal.SIGTERM, timeout_s)
        self.kill_all()

    def kill_all(self) -> None:
        """End what is left, at once, and reap it."""
        self.process.kill()
        self.process.mark = None

    async def _watch(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while True:
            code = await self._wait_over()
            self._emit(f"{self._event}-down", name=self.process.name, code=code)
            if not self._replaces:
                return
            while self._is_full():
                pause_s = _FIRST_PAUSE_S
                await asyncio.sleep(_WAIT_FOR_SPACE_S)
            try:
                await self._launch()
                pause_s = _FIRST_PAUSE_S
            except ConfigurationError as error:
                self._emit(f"{self._event}-failed", name=self.process.name, error=error.message)
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, _MAX_PAUSE_S)
                self.port = 0  # another program may hold the old port

    async def _wait_over(self) -> int | None:
        """Wait for the end of the process and return its exit code; kill it when it fails too many checks."""
        over = asyncio.ensure_future(self.process.wait_over())
        failed = 0
        try:
            while not over.done():
                await asyncio.wait({over}, timeout=CHECK_S)
                failed = 0 if await self._is_answering(self._alive) else failed + 1
                if failed > self._unhealthy_checks and self._replaces and not over.done():
                    self._emit(f"{self._event}-silent", name=self.process.name, pid=self.process.pid)
                    self.process.send(signal.SIGKILL)
            return over.result()
        finally:
            over.cancel()

    async def _is_answering(self, path: str) -> bool:
        reply = await ControlPort(self.port).ask_once(path, timeout_s=CHECK_S)
        return reply is not None and reply.status == 200

    async def _launch(self) -> None:
        command = [*self._command, "--port", str(self.port)]
        self.process.start(command, dies_with_parent=self._dies_with_parent)
        pid = self.process.pid
        run_as_batch(pid, NICENESS)
        self._emit(f"{self._event}-start", name=self.process.name, pid=pid)
        try:
            announcement = await self.process.wait_announced(self._start_timeout_s)
        except BaseException:
            self.process.kill()
            raise
        self.port = announcement["port"]
        self._emit(f"{self._event}-up", name=self.process.name, pid=pid, port=self.port)
