"""Start, stop and kill backend servers on one machine: processes of ``rse-pf serve``, as on EC2.

The caller decides how many servers there are, and when.  Only processes whose id and start time are known are
signalled.
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
"""The command line of this package, to which a verb and its options are appended."""

_LOOPBACK = "127.0.0.1"
# Time limit of a request to a server's control port, in seconds.
_STATUS_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BackendServer:
    """A backend server that has announced itself.

    ``pid`` and ``mark`` are of its supervisor process, ``workers`` and ``worker_marks`` of its worker
    processes; a worker that had exited when it was looked up has no mark.  Robots connect to ``port``.
    """

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
        """This server as a target of the load balancer."""
        return Target(name=self.name, port=self.port, control_port=self.control_port)


class LocalBackendServers:
    """The backend server processes of one platform, by name, and its warm standby."""

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
        """The mark of each server that was launched or adopted and not forgotten yet, by name."""
        marks = ((name, process.mark) for name, process in self._processes.items())
        return {name: mark for name, mark in marks if mark is not None}

    def launch(self, name: str) -> None:
        """Start the process of server *name*, and return before it listens.

        The warm standby becomes the server if there is one; else a new process is started.
        """
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
        """Take over the server *name*, which an earlier control plane launched; it may still be starting."""
        self._processes[name] = ServerProcess(name, self._folder)
        self._processes[name].mark = mark

    async def wait_ready(self, name: str, timeout_s: float) -> BackendServer:
        """Wait until server *name* has announced itself, and return it.

        Raises:
            ConfigurationError: It exited, or was not ready within *timeout_s*; its last log line is in the
                message.
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
        """Return a client of the control port *port* of one of these servers, with the platform's token.

        Raises:
            UsageError: The file of the token is missing, or holds no token.
        """
        return ControlPort(port, read_control_token(control_token_file(self._folder)))

    async def status(self, server: BackendServer) -> dict[str, Any] | None:
        """Return the /status page of *server*; None if it does not answer with 200 within 1 s."""
        reply = await self.control(server.control_port).ask_once("/status", timeout_s=_STATUS_TIMEOUT_S)
        return None if reply is None or reply.status != 200 else reply.document()

    async def metrics(self, server: BackendServer) -> str | None:
        """Return the metrics page of *server* for Prometheus; None if it does not answer 200 within 1 s."""
        reply = await self.control(server.control_port).ask_once("/metrics", timeout_s=_STATUS_TIMEOUT_S)
        return None if reply is None or reply.status != 200 else reply.body.decode("utf-8", "replace")

    async def wait_over(self, name: str) -> int | None:
        """Wait until the process of server *name* has exited; return its exit code, negative for a signal.

        None if the code is not known, because the server was adopted and is no child of this process, or if
        there is no such server.
        """
        process = self._processes.get(name)
        return None if process is None else await process.wait_over()

    def send(self, name: str, number: signal.Signals) -> bool:
        """Send signal *number* to server *name*; return False if it has exited, or there is none."""
        process = self._processes.get(name)
        return process is not None and process.send(number)

    def forget(self, name: str) -> None:
        """Remove server *name*, and reap its process; a process that still runs is killed first."""
        process = self._processes.pop(name, None)
        if process is not None:
            process.kill()

    async def stop(self, timeout_s: float) -> None:
        """Ask all servers with SIGINT to stop, at the same time; kill those that run after *timeout_s*."""
        stops = (process.stop(signal.SIGINT, timeout_s) for process in self._processes.values())
        await asyncio.gather(*stops)
        self.kill_all()

    def kill_all(self) -> None:
        """Kill all servers and the warm standby at once, and reap them."""
        self.standby.close()
        for process in self._processes.values():
            process.send(signal.SIGKILL)
        for name in list(self._processes):
            self.forget(name)


def local_placement(settings: PlatformSettings, state: Path) -> ServerPlacement:
    """Return the placement of every server of a local platform: loopback, free ports, and one object store.

    A store ``memory:`` becomes the folder ``objects`` in *state*, since several processes use it and each may
    exit; ``serving.workers`` 0 becomes one worker.
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
