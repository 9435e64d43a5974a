"""Start, watch and replace a server of one process on one machine: the data or the rosbridge server.

A replacement takes the port of the process before it, so the load balancer's configuration does not change.
A process that fails its health checks is killed, and replaced like one that has exited.
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

# Time between two health checks of the server, and time limit of a check, in seconds.
CHECK_S = 1.0
# Pause after the first failed start of a replacement, in seconds; each further pause is twice as long.
_FIRST_PAUSE_S = 0.1
# Longest pause after a failed start of a replacement, in seconds.
_MAX_PAUSE_S = 5.0
# Time between two checks whether a full disk has space again, in seconds.
_WAIT_FOR_SPACE_S = 0.5
# Niceness of the data server and the rosbridge server: on a busy machine, backend servers, which compute
# poses, get CPU time first.
NICENESS = 10


class WatchedServer:
    """One server process, and its replacements, which have the same name.

    ``port`` is the port of the process; 0 before the first start.  A replacement takes the same port, or a
    free one if another program has it.
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
        """Describe the server; nothing is started.

        Args:
            name: Name of the process in its log and in events.
            folder: Folder of the log and the announcement.
            command: The command to which ``--announce``, ``--port`` and their values are appended.
            ready: Path that answers 200 while requests can be served.
            alive: Path that answers 200 unless the process must be replaced.
            event: Prefix of the names of events, EVENT below.
            unhealthy_checks: The process is killed when more checks of *alive* than these fail in a row.
            start_timeout_s: Longest time from the start of a process to its announcement, in seconds.
            dies_with_parent: Whether Linux kills the process when this one exits.
            replaces: Whether a process that exits or fails its checks is replaced; else EVENT-down is emitted
                when it exits, and nothing more.
            is_full: Returns whether the disk is full; then a replacement waits.
            emit: Called with an event and its details: EVENT-start with name and pid, EVENT-up also with
                port, EVENT-down with name and code, EVENT-silent with name and pid, EVENT-failed with name
                and error.
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
        """This server as a target of the load balancer."""
        return Target(name=self.process.name, port=self.port, control_port=self.port)

    @property
    def state(self) -> ServerState | None:
        """This server as an entry of the state file; None if there is no process."""
        name, mark = self.process.name, self.process.mark
        return None if mark is None else ServerState(name=name, process=mark, port=self.port)

    def document(self) -> list[dict[str, Any]]:
        """Return a list with name, pid, port and ``running`` of the process; empty before the first start."""
        name, mark = self.process.name, self.process.mark
        running = self.process.is_running()
        return (
            [] if mark is None else [{"name": name, "pid": mark.pid, "port": self.port, "running": running}]
        )

    async def start(self, port: int = 0) -> None:
        """Start the process at *port* (0: a free one), wait for its announcement, and watch it from then on.

        If it does not start at *port*, it is started once more at a free one.

        Raises:
            ConfigurationError: The process exited, or was not ready in time.
        """
        self.port = port
        try:
            await self._launch()
        except ConfigurationError:
            if not port:
                raise
            self.port = 0  # perhaps another program has taken the port
            await self._launch()
        self._watching = asyncio.create_task(self._watch())

    async def restart(self, timeout_s: float) -> None:
        """Replace the process by one that reads the settings anew, at the same port.

        Does nothing if no process is watched.  The old process is killed if it runs *timeout_s* after
        SIGTERM.

        Raises:
            ConfigurationError: The new process did not start; the start is tried again from now on.
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
        """Watch the process *mark*, which an earlier control plane started at *port*, from now on."""
        self.process.mark, self.port = mark, port
        self._watching = asyncio.create_task(self._watch())

    async def is_ready(self) -> bool:
        """Return whether the server answers its path *ready* with 200."""
        return self.port > 0 and await self._is_answering(self._ready)

    async def forget(self) -> None:
        """Stop watching, and leave the process running."""
        if self._watching is not None:
            self._watching.cancel()
            await asyncio.gather(self._watching, return_exceptions=True)
        self._watching = None

    async def stop(self, timeout_s: float) -> None:
        """Stop watching, send the process SIGTERM, and kill it if it runs after *timeout_s*."""
        await self.forget()
        await self.process.stop(signal.SIGTERM, timeout_s)
        self.kill_all()

    def kill_all(self) -> None:
        """Kill the process, if it runs, and reap it."""
        self.process.kill()
        self.process.mark = None

    async def _watch(self) -> None:
        """Replace the process each time it has exited; without *replaces*, only report its first exit."""
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
        """Wait until the process has exited, and return its exit code; None if it was adopted.

        If the process is to be replaced, it is killed once it fails too many checks in a row.
        """
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
        """Start a process at ``port``, wait for its announcement, and set ``port``; kill it if that fails."""
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
