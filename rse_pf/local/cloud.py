"""The whole platform on one machine: a real load balancer in front of real backend servers.

``async with LocalCloud(settings, state=folder) as cloud`` is everything that a demo, an experiment or a
test needs.  Promises that nothing it started is left running, however the block ends, unless it was told
to be adoptable and was killed with SIGKILL; and that it neither grows nor shrinks by itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import secrets
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from rse_pf.auth import SigningKey
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.backend_servers import RSE_PF, BackendServer, BackendServers
from rse_pf.local.firewall import check_front_door, ensure_key, key_file, key_set_file
from rse_pf.local.load_balancer import LoadBalancer
from rse_pf.local.processes import ProcessMark, is_alive, last_line, mark_of
from rse_pf.local.state import (
    PlatformLock,
    PlatformState,
    ServerState,
    read_state,
    remove_state,
    settings_file,
)
from rse_pf.settings import PlatformSettings

__all__ = ["LocalCloud"]

Event = Mapping[str, Any]

_LOOPBACK = "127.0.0.1"


class LocalCloud:
    """A local platform, started on entry and gone on exit."""

    def __init__(
        self,
        settings: PlatformSettings,
        *,
        state: Path,
        servers: int | None = None,
        port: int | None = None,
        name: str | None = None,
        adoptable: bool = False,
        on_event: Callable[[Event], None] | None = None,
        program: Sequence[str] = RSE_PF,
    ) -> None:
        """Describe a platform; nothing is started.

        Args:
            settings: For the front door and for every server.
            state: Folder of keys, logs and ``platform.json``; made with mode 0700.
            servers: How many; None means ``local.servers``.
            port: Of the front door, 0 takes a free one; None means ``local.port``.
            name: What people call this platform; None means the name of the folder.
            adoptable: Whether servers and balancer outlive a control plane that is killed.
            on_event: Called with each event, at once.
            program: The command that ``serve`` follows.
        """
        self.events: list[Event] = []
        self.url = ""
        self.name = name or state.name
        self.state = state.absolute()
        self.settings = settings
        self._server_settings = _for_servers(settings)
        self._count = settings.local.servers if servers is None else servers
        self._adoptable = adoptable
        self._on_event = on_event
        self._servers: dict[str, BackendServer] = {}
        self._lock = PlatformLock(self.state)
        self._key: SigningKey | None = None
        self._watchers: list[asyncio.Task[None]] = []
        self._wanted_port = settings.local.port if port is None else port
        self._settings_file = settings_file(self.state)
        self.backend_servers = BackendServers(
            self._server_settings,
            folder=self.state,
            settings_file=self._settings_file,
            keys_file=key_set_file(self.state),
            dies_with_parent=not adoptable,
            program=program,
        )
        self.load_balancer = LoadBalancer(
            self.settings, folder=self.state, port=self._wanted_port, dies_with_parent=not adoptable
        )

    @property
    def servers(self) -> tuple[BackendServer, ...]:
        """The servers that have announced themselves and not ended."""
        return tuple(self._servers.values())

    @property
    def port(self) -> int:
        """Port of the front door."""
        return self.load_balancer.port

    async def __aenter__(self) -> LocalCloud:
        """Start everything.

        Raises:
            ConfigurationError: A port is taken, the platform runs already, or a process did not start.
            MissingExtra: Envoy or the backend is not installed.
        """
        began = time.monotonic()
        if self._count < 1:
            raise UsageError(f"a platform of {self._count} servers serves nobody", hint="start at least 1")
        check_front_door(self.settings.serving.host, self._wanted_port)
        self._make_folder()
        self._lock.take(self.name)
        try:
            self._refuse_leftovers()
        except ConfigurationError:
            self._lock.release()
            raise
        try:
            await self._start(began + self.settings.local.start_timeout_s)
        except BaseException:
            await self._end()
            raise
        self._tell("platform-ready", url=self.url, seconds=round(time.monotonic() - began, 3))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End everything that was started."""
        await self._end()

    def issue_token(self, robot: str, life_s: float | None = None) -> str:
        """Return a token for *robot*, good from now; raises UsageError for a name that is none."""
        if self._key is None:
            raise UsageError("the platform has not started", hint="enter it with async with")
        return self._key.issue(
            robot,
            now=time.time(),
            token_id=secrets.token_hex(8),
            settings=self.settings.auth,
            life_s=life_s,
        )

    async def status(self) -> list[dict[str, Any]]:
        """Return what each server says of itself; one that does not answer is left out."""
        told = await asyncio.gather(*(self.backend_servers.status(server) for server in self.servers))
        return [status for status in told if status is not None]

    def kill(self, server: str) -> None:
        """End *server* with SIGKILL, as a crash would; raises UsageError for a name that is none."""
        if not self.backend_servers.send(server, signal.SIGKILL):
            raise UsageError(
                f"no server named {server!r} is running", hint=f"running are {', '.join(self._servers)}"
            )
        self._tell("server-killed", server=server)

    # --- the beginning -------------------------------------------------------------------------

    def _make_folder(self) -> None:
        try:
            self.state.mkdir(mode=0o700, parents=True, exist_ok=True)
            self.state.chmod(0o700)
        except OSError as error:
            raise ConfigurationError(
                f"cannot use the folder {self.state}: {error.strerror}",
                hint="make it writable for you, or set XDG_STATE_HOME",
            ) from error

    def _refuse_leftovers(self) -> None:
        state = read_state(self.state)
        if state is not None and any(map(is_alive, state.processes())):
            raise ConfigurationError(
                f"servers of platform {self.name!r} outlived their control plane",
                hint=f"end them with: rse-pf local stop --name {self.name}",
            )

    async def _start(self, end: float) -> None:
        self._key = ensure_key(self.state, seed=secrets.token_bytes(32), key_id=secrets.token_hex(4))
        document = {"context": {"rse-pf": self._server_settings.to_dict()}}
        self._settings_file.write_text(json.dumps(document, indent=1), encoding="utf-8")
        names = [f"server-{number + 1}" for number in range(self._count)]
        self.load_balancer.launch()
        for name in names:
            self.backend_servers.launch(name)
            self._write_state()
        await _all(
            self.load_balancer.wait_live(end - time.monotonic()),
            *(self._meet(name, end) for name in names),
        )
        self.load_balancer.set_targets([server.target for server in self.servers])
        if not await self.load_balancer.wait_healthy(names, max(end - time.monotonic(), 0.0)):
            raise ConfigurationError(
                f"the load balancer found no healthy server: {last_line(self.load_balancer.log)}",
                hint=f"look at the logs in {self.state}",
            )
        serving = self.settings.serving
        host = f"[{serving.host}]" if ":" in serving.host else serving.host
        self.url = f"ws://{host}:{self.port}{serving.path}"
        self._write_state()

    async def _meet(self, name: str, end: float) -> None:
        server = await self.backend_servers.wait_ready(name, end - time.monotonic())
        self._servers[name] = server
        self._watchers.append(asyncio.create_task(self._watch(server)))
        self._tell("server-ready", server=name, pid=server.pid, port=server.port)

    async def _watch(self, server: BackendServer) -> None:
        """Notice the end of *server*: nobody may be sent to it, or find it in the list."""
        code = await self.backend_servers.wait_over(server.name)
        del self._servers[server.name]
        self.load_balancer.set_targets([each.target for each in self.servers])
        self._write_state()
        self._tell("server-gone", server=server.name, pid=server.pid, exit_code=code)

    def _write_state(self) -> None:
        control_plane = mark_of(os.getpid())
        assert control_plane is not None
        PlatformState(
            name=self.name,
            control_plane=control_plane,
            url=self.url,
            settings_digest=self._server_settings.digest(),
            settings_file=str(self._settings_file),
            key_file=str(key_file(self.state)),
            servers=tuple(
                self._server_state(name, mark) for name, mark in self.backend_servers.marks.items()
            ),
            load_balancer=self.load_balancer.mark,
            port=self.load_balancer.port,
            admin_port=self.load_balancer.admin_port,
        ).write(self.state)

    def _server_state(self, name: str, mark: ProcessMark) -> ServerState:
        server = self._servers.get(name)
        if server is None:
            return ServerState(name=name, process=mark)
        return ServerState(name=name, process=mark, port=server.port, control_port=server.control_port)

    # --- the end -------------------------------------------------------------------------------

    async def _end(self) -> None:
        """Robots first hear their servers say goodbye; whatever fails or is cut short, all is killed."""
        timeout_s = self.settings.local.stop_timeout_s
        try:
            for watcher in self._watchers:
                watcher.cancel()
            await asyncio.gather(*self._watchers, return_exceptions=True)
            await self.backend_servers.stop(timeout_s)
            await self.load_balancer.stop(timeout_s)
        finally:
            self.backend_servers.kill_all()
            self.load_balancer.kill()
            self._servers.clear()
            with contextlib.suppress(OSError):  # the folder may have been removed under our feet
                remove_state(self.state)
                if not self._adoptable:  # nobody can come back to this platform: nor may its tokens
                    key_file(self.state).unlink(missing_ok=True)
            self._lock.release()
        self._tell("platform-gone")

    def _tell(self, event: str, **details: Any) -> None:
        told = {"event": event, **details}
        self.events.append(told)
        if self._on_event is not None:
            self._on_event(told)


def _for_servers(settings: PlatformSettings) -> PlatformSettings:
    """Return the settings of every local server: loopback, ephemeral ports, workers as on this machine."""
    address = {"host": _LOOPBACK, "port": 0, "control_host": _LOOPBACK, "control_port": 0}
    return settings.replace(serving={**address, "workers": settings.local.workers})


async def _all(*works: Any) -> None:
    """Wait for all, or for the first failure, after which none of them goes on."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
