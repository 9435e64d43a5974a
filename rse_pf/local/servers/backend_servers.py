"""The backend servers box on one machine: ``rse-pf serve`` processes, the command that EC2 runs too.

Starts, ends and kills them; the caller decides how many and when.  Only processes whose id and start time are
known are signalled.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.audit.log import audit_folder
from rse_pf.auth.control_token import read_control_token
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import ServerPlacement
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.firewall import key_set_file
from rse_pf.local.processes import ProcessMark, ServerProcess, mark_of
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.servers.warm_standby import STANDBY, WarmStandby
from rse_pf.local.state import control_token_file, recording_key_file, settings_file

__all__ = ["RSE_PF", "BackendServer", "LocalBackendServers", "local_placement"]

RSE_PF = (sys.executable, "-m", "rse_pf.cli.main")
"""The program; ``serve`` and its options follow."""

_LOOPBACK = "127.0.0.1"
# Time limit of a request to a server's control port, in seconds.
_STATUS_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BackendServer:
    """A server that has announced itself."""

    name: str
    pid: int
    port: int
    control_port: int
    workers: tuple[int, ...]
    log: Path
    mark: ProcessMark
    worker_marks: tuple[ProcessMark, ...] = ()

    @property
    def target(self) -> Target:
        """This server as the load balancer sees it."""
        return Target(name=self.name, port=self.port, control_port=self.control_port)


class LocalBackendServers:
    """The server processes of one platform, by name."""

    def __init__(
        self,
        *,
        folder: Path,
        dies_with_parent: bool = True,
        warm_standby: bool = False,
        program: Sequence[str] = RSE_PF,
    ) -> None:
        self._folder = folder
        self._dies_with_parent = dies_with_parent
        self._program = tuple(program)
        self._processes: dict[str, ServerProcess] = {}
        self.standby = WarmStandby(
            folder,
            dies_with_parent=dies_with_parent,
            program=STANDBY if warm_standby and self._program == RSE_PF else (),
        )

    @property
    def marks(self) -> dict[str, ProcessMark]:
        """Every process that was launched and not yet ended by us, by server name."""
        marks = ((name, process.mark) for name, process in self._processes.items())
        return {name: mark for name, mark in marks if mark is not None}

    def launch(self, name: str) -> None:
        """Start the process of server *name*, and return before it listens."""
        server = self._processes[name] = ServerProcess(name, self._folder)
        server.prepare()
        command = ["serve", "--settings", str(settings_file(self._folder)), "--server-id", name]
        command += ["--keys", str(key_set_file(self._folder)), "--announce", str(server.announcement)]
        command += ["--audit", str(audit_folder(self._folder))]
        command += ["--control-token", str(control_token_file(self._folder))]
        if recording_key_file(self._folder).exists():
            command += ["--record-key", str(recording_key_file(self._folder))]
        standby = self.standby.take(command, server.log)
        if standby is not None:
            server.use(standby)
        else:
            server.start([*self._program, *command], dies_with_parent=self._dies_with_parent)

    def adopt(self, name: str, mark: ProcessMark) -> None:
        """Take over a server that an earlier control plane launched as *name*, ready or not."""
        self._processes[name] = ServerProcess(name, self._folder)
        self._processes[name].mark = mark

    async def wait_ready(self, name: str, timeout_s: float) -> BackendServer:
        """Return server *name* once it has announced itself.

        Raises:
            ConfigurationError: It ended or was not ready in time; its last log line is in the message.
        """
        process = self._processes[name]
        announcement = await process.wait_announced(timeout_s)
        mark = process.mark
        assert mark is not None
        worker_marks = (mark_of(pid) for pid in announcement["workers"])
        return BackendServer(
            name=name, pid=mark.pid, port=announcement["port"], control_port=announcement["control_port"],
            workers=tuple(announcement["workers"]), log=process.log, mark=mark,
            worker_marks=tuple(worker for worker in worker_marks if worker is not None),
        )  # fmt: skip

    def control(self, port: int) -> ControlPort:
        """Return a client of the control port *port* of one of these servers, with its token.

        Raises:
            UsageError: The file of the token is missing, or holds none.
        """
        return ControlPort(port, read_control_token(control_token_file(self._folder)))

    async def status(self, server: BackendServer) -> dict[str, Any] | None:
        """Return the /status page of *server*; None when it does not answer."""
        reply = await self.control(server.control_port).ask_once("/status", timeout_s=_STATUS_TIMEOUT_S)
        return None if reply is None or reply.status != 200 else reply.document()

    async def metrics(self, server: BackendServer) -> str | None:
        """Return the server's page for Prometheus; None when it does not answer."""
        reply = await self.control(server.control_port).ask_once("/metrics", timeout_s=_STATUS_TIMEOUT_S)
        return None if reply is None or reply.status != 200 else reply.body.decode("utf-8", "replace")

    async def wait_over(self, name: str) -> int | None:
        """Wait until the process of *name* has ended; return its exit code, negative for a signal.

        None means that it is not known: the server was adopted, and is no child of this process.
        """
        process = self._processes.get(name)
        return None if process is None else await process.wait_over()

    def send(self, name: str, number: signal.Signals) -> bool:
        """Signal server *name*; return False if it is gone."""
        process = self._processes.get(name)
        return process is not None and process.send(number)

    def forget(self, name: str) -> None:
        """Drop a server whose process is over, and reap it; kills it first if it is not."""
        process = self._processes.pop(name, None)
        if process is not None:
            process.kill()

    async def stop(self, timeout_s: float) -> None:
        """Let all servers leave at once, and kill what has not left after *timeout_s*."""
        stops = (process.stop(signal.SIGINT, timeout_s) for process in self._processes.values())
        await asyncio.gather(*stops)
        self.kill_all()

    def kill_all(self) -> None:
        """End what is left, at once, and reap it."""
        self.standby.close()
        for process in self._processes.values():
            process.send(signal.SIGKILL)
        for name in list(self._processes):
            self.forget(name)


def local_placement(settings: PlatformSettings, state: Path) -> ServerPlacement:
    """Return the placement of every local server: loopback, free ports, the workers of this machine.

    Servers come and go, so objects are in the folder of the platform if they were to be in memory.
    """
    store = settings.data.store
    return ServerPlacement.of(
        settings,
        host=_LOOPBACK,
        port=0,
        control_host=_LOOPBACK,
        control_port=0,
        workers=settings.serving.workers or 1,  # the servers share the cores of one machine
        store=f"dir:{state / 'objects'}" if store == "memory:" else store,
    )
