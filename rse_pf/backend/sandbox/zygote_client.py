"""The worker's side of the warm template (`zygote`): start it, order environments, hear how they ended.

Promises not to block once it is warm: orders to a template that starts again wait in its channel.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.services.custom.installed import InstalledService

__all__ = ["Reading", "SandboxLog", "ZygoteClient"]

_MAX_MESSAGE = 1 << 16


class SandboxLog(Protocol):
    """Where events go; `rse_pf.backend.log.JsonLog` is one."""

    def info(self, event: str, **fields: Any) -> None:
        """Write what happened."""

    def warning(self, event: str, **fields: Any) -> None:
        """Write what an operator should look at."""

    def error(self, event: str, **fields: Any) -> None:
        """Write a defect."""


class Reading(Protocol):
    """What watches descriptors."""

    def add_reader(self, fd: int, callback: Callable[..., object], *args: Any) -> None:
        """Call *callback* whenever *fd* can be read."""

    def remove_reader(self, fd: int) -> bool:
        """Stop that."""


class ZygoteClient:
    """The template process of one worker; ``missing`` names the walls that this machine lacks."""

    def __init__(
        self,
        services: Sequence[InstalledService],
        settings: PlatformSettings,
        *,
        loop: Reading,
        log: SandboxLog,
        on_gone: Callable[[int, str], None],
        on_lost: Callable[[], None],
    ) -> None:
        """Start it and wait until it is warm.

        Args:
            services: That environments may load.
            settings: Limits of environments.
            loop: Of the worker.
            log: Of the worker.
            on_gone: Told the number of an environment that ended, and how.
            on_lost: Told when the template died, and every environment with it; a new one is starting then.

        Raises:
            ConfigurationError: It did not start, or a wall is missing and weak isolation was not accepted.
        """
        self._services = services
        self._settings = settings
        self._loop = loop
        self._log = log
        self._on_gone = on_gone
        self._on_lost = on_lost
        self._launch()
        self.missing: tuple[str, ...] = self._wait_until_warm()
        self._listen()

    def create(self, number: int, conversation: socket.socket, output: int) -> bool:
        """Order environment *number* with its descriptors; return False if the channel is full."""
        order = json.dumps({"do": "create", "id": number}).encode()
        try:
            socket.send_fds(self._channel, [order], [conversation.fileno(), output])
        except OSError:
            return False
        return True

    def end(self, number: int) -> None:
        """Let environment *number* be killed; one that is gone already is no error."""
        with contextlib.suppress(OSError):
            self._channel.send(json.dumps({"do": "end", "id": number}).encode())

    def close(self) -> None:
        """End the template, which takes every environment along."""
        self._loop.remove_reader(self._channel.fileno())
        self._stop()

    def _launch(self) -> None:
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        limits = self._settings.services
        config = {
            "worker": os.getpid(),
            "services": [
                {
                    "name": s.name, "language": s.language, "entry": s.entry, "kind": s.kind,
                    "folder": str(s.folder),
                }
                for s in self._services
            ],
            "memory_bytes": limits.memory_bytes, "scratch_bytes": limits.scratch_bytes,
            "first_uid": limits.first_uid, "max_bytes": self._settings.session.max_inflated_bytes,
        }  # fmt: skip
        # No credentials, and no threads of the linear algebra library: it will be forked.
        environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rse_pf.backend.sandbox.zygote", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, env=environment,
            )  # fmt: skip
        self._channel.send(json.dumps(config).encode())

    def _wait_until_warm(self) -> tuple[str, ...]:
        self._channel.settimeout(self._settings.local.start_timeout_s)
        try:
            told = json.loads(self._channel.recv(_MAX_MESSAGE) or b"{}")
        except OSError:
            told = {}
        missing = tuple(told.get("missing", ()))
        if told.get("event") != "ready":
            self._stop()
            raise ConfigurationError(
                "the template of environments did not start", hint="the server's log says why"
            )
        if missing and not self._settings.services.accept_weak_isolation:
            self._stop()
            raise ConfigurationError(
                f"installed services need walls that this machine lacks: {', '.join(missing)}",
                hint="allow unprivileged user namespaces and seccomp, or start with --accept-weak-isolation",
            )
        if missing:
            self._log.warning("weak-isolation", missing=", ".join(missing))
        return missing

    def _listen(self) -> None:
        self._channel.setblocking(False)
        self._loop.add_reader(self._channel.fileno(), self._hear)

    def _hear(self) -> None:
        while True:
            try:
                message = self._channel.recv(_MAX_MESSAGE)
            except BlockingIOError:
                return
            except OSError:
                message = b""
            if not message:
                self._loop.remove_reader(self._channel.fileno())
                self._stop()
                self._log.error("template-lost")
                self._launch()
                self._listen()
                self._on_lost()
                return
            told = json.loads(message)
            if told["event"] == "gone":
                self._on_gone(told["id"], told["how"])

    def _stop(self) -> None:
        self._channel.close()
        self._process.kill()
        self._process.wait()
