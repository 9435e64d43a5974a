"""The backend servers box on one machine: ``rse-pf serve`` processes, the command that EC2 runs too.

Starts, ends and kills them; the caller decides how many and when.  Only processes whose id and start time are
known are signalled.
"""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.audit.log import audit_folder
from rse_pf.auth.control_token import read_control_token
from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.processes import ProcessMark, ended, is_alive, last_line, mark_of, send_signal, spawn
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.servers.warm_standby import WarmStandby

__all__ = ["RSE_PF", "BackendServer", "LocalBackendServers"]

RSE_PF = (sys.executable, "-m", "rse_pf.cli.main")
"""The program; ``serve`` and its options follow."""

_LOOK_AGAIN_S = 0.01
_ASK_S = 1.0


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
        settings_file: Path,
        keys_file: Path,
        control_token_file: Path | None = None,
        dies_with_parent: bool = True,
        warm_standby: bool = False,
        program: Sequence[str] = RSE_PF,
    ) -> None:
        self._folder = folder
        self._settings_file = settings_file
        self._keys_file = keys_file
        self._control_token_file = control_token_file
        self._control_token: str | None = None
        self._dies_with_parent = dies_with_parent
        self._program = tuple(program)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._marks: dict[str, ProcessMark] = {}
        self._standby: WarmStandby | None = None
        if warm_standby and self._program == RSE_PF:
            self._standby = WarmStandby(folder, dies_with_parent=dies_with_parent)

    @property
    def marks(self) -> dict[str, ProcessMark]:
        """Every process that was launched and not yet ended by us, by server name."""
        return dict(self._marks)

    def launch(self, name: str) -> None:
        """Start the process of server *name*, and return before it listens."""
        self._announce(name).unlink(missing_ok=True)
        command = ["serve", "--settings", str(self._settings_file), "--server-id", name]
        command += ["--keys", str(self._keys_file), "--announce", str(self._announce(name))]
        command += ["--audit", str(audit_folder(self._folder))]
        if self._control_token_file is not None:
            command += ["--control-token", str(self._control_token_file)]
        log = self._log(name)
        process = None if self._standby is None else self._standby.take(command, log)
        if process is None:
            command = [*self._program, *command]
            process = spawn(command, log=log, folder=self._folder, dies_with_parent=self._dies_with_parent)
        self._processes[name] = process
        mark = mark_of(process.pid)
        if mark is not None:
            self._marks[name] = mark

    def start_standby(self) -> bool:
        """Start one more process that becomes the next server, unless there is one; return whether it did."""
        return self._standby is not None and self._standby.warm()

    @property
    def standby_pid(self) -> int | None:
        """The id of the standby process; None if there is none."""
        return None if self._standby is None else self._standby.pid

    async def wait_warm(self, timeout_s: float) -> None:
        """Wait until the standby is warm, at most *timeout_s*; return at once if this platform has none."""
        end = time.monotonic() + timeout_s
        self.start_standby()
        while self._standby is not None and not self._standby.is_warm and time.monotonic() < end:
            await asyncio.sleep(_LOOK_AGAIN_S)

    def adopt(self, name: str, mark: ProcessMark) -> None:
        """Know a server that an earlier control plane launched as *name*, ready or not."""
        self._marks[name] = mark

    async def wait_ready(self, name: str, timeout_s: float) -> BackendServer:
        """Return server *name* once it has announced itself.

        Raises:
            ConfigurationError: It ended or was not ready in time; its last log line is in the message.
        """
        end = time.monotonic() + timeout_s
        process, announce = self._processes.get(name), self._announce(name)
        while not announce.exists():
            if not self._runs(name):
                code = None if process is None else process.poll()
                raise self._failed(name, "ended" if code is None else f"ended with exit code {code}")
            if time.monotonic() >= end:
                raise self._failed(name, f"was not ready within {timeout_s:g} s")
            await asyncio.sleep(_LOOK_AGAIN_S)
        told = json.loads(announce.read_text(encoding="utf-8"))
        mark = self._marks.get(name)
        if mark is None or told["pid"] != mark.pid:
            started = "nothing" if mark is None else mark.pid
            raise self._failed(name, f"announced pid {told['pid']}, but was started as {started}")
        worker_marks = (mark_of(pid) for pid in told["workers"])
        return BackendServer(
            name=name, pid=mark.pid, port=told["port"], control_port=told["control_port"],
            workers=tuple(told["workers"]), log=self._log(name), mark=mark,
            worker_marks=tuple(worker for worker in worker_marks if worker is not None),
        )  # fmt: skip

    def control(self, port: int) -> ControlPort:
        """Return a client of the control port *port* of one of these servers, with its token.

        Raises:
            UsageError: The file of the token is missing, or holds none.
        """
        return ControlPort(port, self._token())

    async def status(self, server: BackendServer) -> dict[str, Any] | None:
        """Return what the server says of itself on its control port; None when it does not answer."""
        reply = await self.control(server.control_port).ask_once("/status", timeout_s=_ASK_S)
        return None if reply is None or reply.status != 200 else reply.document()

    async def wait_over(self, name: str) -> int | None:
        """Wait until the process of *name* has ended; return its exit code, negative for a signal.

        None means that it is not known: the server was adopted, and is no child of this process.
        """
        mark = self._marks.get(name)
        if mark is not None:
            await ended(mark)
        process = self._processes.get(name)
        return None if process is None else process.wait()

    def send(self, name: str, number: signal.Signals) -> bool:
        """Signal server *name*; return False if it is gone."""
        mark = self._marks.get(name)
        return mark is not None and send_signal(mark, number)

    def forget(self, name: str) -> None:
        """Drop a server whose process is over, and reap it; kills it first if it is not."""
        self.send(name, signal.SIGKILL)
        process = self._processes.pop(name, None)
        if process is not None:
            process.kill()  # a no-operation for one that was reaped
            process.wait()
        self._marks.pop(name, None)
        self._announce(name).unlink(missing_ok=True)

    async def stop(self, timeout_s: float) -> None:
        """Let all servers leave at once, and kill what has not left after *timeout_s*."""
        for name in self._marks:
            self.send(name, signal.SIGINT)
        await asyncio.gather(*(ended(mark, timeout_s) for mark in self._marks.values()))
        self.kill_all()

    def kill_all(self) -> None:
        """End what is left, at once, and reap it."""
        if self._standby is not None:
            self._standby.close()
        for name in {**self._marks, **self._processes}:
            self.send(name, signal.SIGKILL)
        for name in {**self._marks, **self._processes}:
            self.forget(name)

    def _token(self) -> str | None:
        if self._control_token is None and self._control_token_file is not None:
            self._control_token = read_control_token(self._control_token_file)
        return self._control_token

    def _runs(self, name: str) -> bool:
        process, mark = self._processes.get(name), self._marks.get(name)
        if process is not None:
            return process.poll() is None
        return mark is not None and is_alive(mark)

    def _announce(self, name: str) -> Path:
        return self._folder / f"{name}.json"

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _failed(self, name: str, what: str) -> ConfigurationError:
        last = last_line(self._log(name))
        return ConfigurationError(
            f"{name} {what}{': ' if last else ''}{last}", hint=f"its log is {self._log(name)}"
        )
