"""The backend servers box on one machine: ``rse-pf serve`` processes, the command that EC2 runs too.

Starts, ends and kills them.  Promises to decide nothing (how many, and when, is the caller's matter),
and to signal only processes that it knows by pid and time of birth.
"""

from __future__ import annotations

import asyncio
import http.client
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
from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.processes import ProcessMark, ended, is_alive, last_line, mark_of, send_signal, spawn
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.servers.warm_standby import WarmStandby

__all__ = ["RSE_PF", "BackendServer", "LocalBackendServers"]

RSE_PF = (sys.executable, "-m", "rse_pf.cli.main")
"""The program; ``serve`` and its options follow."""

_LOOPBACK = "127.0.0.1"
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
        settings: PlatformSettings,
        *,
        folder: Path,
        settings_file: Path,
        keys_file: Path,
        control_token_file: Path | None = None,
        dies_with_parent: bool = True,
        program: Sequence[str] = RSE_PF,
    ) -> None:
        self._settings = settings
        self._folder = folder
        self._settings_file = settings_file
        self._keys_file = keys_file
        self._control_token_file = control_token_file
        self._control_token: str | None = None
        self._dies_with_parent = dies_with_parent
        self._program = tuple(program)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._marks: dict[str, ProcessMark] = {}
        self._spare: WarmStandby | None = None
        if self._program == RSE_PF and settings.local.warm_standby:
            self._spare = WarmStandby(folder, dies_with_parent=dies_with_parent)

    @property
    def marks(self) -> dict[str, ProcessMark]:
        """Every process that was launched and not yet ended by us, by server name."""
        return dict(self._marks)

    def launch(self, name: str) -> None:
        """Start the process of server *name*, and return before it listens."""
        self._announce(name).unlink(missing_ok=True)
        serving = self._settings.serving
        command = ["serve", "--settings", str(self._settings_file), "--server-id", name]
        # Where it runs is said beside the settings, whose digest is then the same on every machine.
        command += ["--host", serving.host, "--port", str(serving.port), "--workers", str(serving.workers)]
        command += ["--control-host", serving.control_host, "--control-port", str(serving.control_port)]
        command += ["--store", self._settings.data.store]
        command += ["--keys", str(self._keys_file), "--announce", str(self._announce(name))]
        command += ["--audit", str(audit_folder(self._folder))]
        if self._control_token_file is not None:
            command += ["--control-token", str(self._control_token_file)]
        log = self._log(name)
        process = None if self._spare is None else self._spare.take(command, log)
        if process is None:
            command = [*self._program, *command]
            process = spawn(command, log=log, folder=self._folder, dies_with_parent=self._dies_with_parent)
        self._processes[name] = process
        mark = mark_of(process.pid)
        if mark is not None:
            self._marks[name] = mark

    def warm_spare(self) -> bool:
        """Let one more process wait, warm, to become the next server; return whether one was started."""
        return self._spare is not None and self._spare.warm()

    @property
    def spare_pid(self) -> int | None:
        """Of the process that waits to become a server, if there is one."""
        return None if self._spare is None else self._spare.pid

    async def wait_warm(self, timeout_s: float) -> None:
        """Wait until a process waits warm, for a launch that is in no hurry; not where there is none."""
        end = time.monotonic() + timeout_s
        self.warm_spare()
        while self._spare is not None and not self._spare.is_warm and time.monotonic() < end:
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
        """Return the control port *port* of one of these servers, with what must be carried to it.

        Raises:
            UsageError: The token's file is gone, or is none.
        """
        return ControlPort(port, self._token())

    async def status(self, server: BackendServer) -> dict[str, Any] | None:
        """Return what the server says of itself on its control port; None when it does not answer."""
        return await asyncio.to_thread(_ask_status, server.control_port, self._token())

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
        if self._spare is not None:
            self._spare.close()
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


def _ask_status(port: int, token: str | None) -> dict[str, Any] | None:
    headers = {} if token is None else {"Authorization": bearer(token)}
    connection = http.client.HTTPConnection(_LOOPBACK, port, timeout=_ASK_S)
    try:
        connection.request("GET", "/status", headers=headers)
        answer = connection.getresponse()
        status: dict[str, Any] | None = json.loads(answer.read()) if answer.status == 200 else None
    except (OSError, ValueError, http.client.HTTPException):
        return None
    finally:
        connection.close()
    return status
