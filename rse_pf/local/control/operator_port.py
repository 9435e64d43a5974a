"""The HTTP port on loopback at which an operator's commands and Prometheus reach one running platform."""

from __future__ import annotations

import asyncio
import functools
import json
from collections.abc import AsyncGenerator, Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.control.control_port import METRICS_TYPE, serve_control_port
from rse_pf.local.control.federation import federate_pages
from rse_pf.local.control.operations import OVER, Operations
from rse_pf.local.control.settings_change import SettingsChange
from rse_pf.local.servers.backend_servers import BackendServer
from rse_pf.local.servers.control_client import ControlPort

__all__ = ["OperatedPlatform", "OperatorPort"]

Event = Mapping[str, Any]
# Most robots that one operation may move: the default of `serving.max_robots`.
_MAX_MOVED = 10_000
# Time over which the robots of one operation are asked to move, in seconds, so that they do not reconnect at
# once.
_SPREAD_S = 1.0
# Time limit of the request that asks a server to move robots, in seconds.
_MOVE_TIMEOUT_S = 2.0


class OperatedPlatform(Protocol):
    """The part of `LocalPlatform` that this port uses.

    A protocol, since `LocalPlatform` imports this module.
    """

    @property
    def servers(self) -> Sequence[BackendServer]:
        """The servers that may get robots."""

    def status_document(self) -> dict[str, Any]:
        """Return the state of the platform as plain JSON values."""

    def check_drain(self, name: str) -> Any:
        """Raise UsageError if there is no server *name*, or it is the last one."""

    async def drain(self, name: str, reason: str = "asked") -> dict[str, Any]:
        """Have server *name* move its robots and exit; return the report of the drain."""

    def check_roll(self, settings: PlatformSettings) -> SettingsChange:
        """Return what a roll with *settings* changes; raises UsageError for changes that it cannot make."""

    async def roll(self, change: SettingsChange | None = None) -> None:
        """Replace every server by a new one, which has the settings of *change* if it is given."""

    def kill(self, name: str) -> None:
        """Kill server *name*, as a crash would end it; raises UsageError if there is none."""

    def pause(self, name: str) -> None:
        """Stop the processes of server *name* with SIGSTOP; raises UsageError if there is none."""

    def resume(self, name: str) -> None:
        """Continue the paused server *name*; raises UsageError if there is none."""


class OperatorPort:
    """The port of one platform for its operator; closed until `open`."""

    def __init__(
        self,
        platform: OperatedPlatform,
        *,
        metrics: Callable[[BackendServer], Coroutine[Any, Any, str | None]],
        disks: Callable[[], Sequence[Mapping[str, Any]]] = lambda: (),
        keep: Callable[[Coroutine[Any, Any, None]], None],
        emit: Callable[..., None],
    ) -> None:
        """Describe the port; nothing listens yet.

        Args:
            platform: The platform that is shown and operated.
            metrics: Returns the metrics page of a server for Prometheus; None if the server does not answer.
            disks: Returns the file systems of the platform, see `DiskWatch.document`.
            keep: Runs a coroutine in the background until it is done or the platform stops.
            emit: Called with the name of an event and its details as keywords.
        """
        self._platform = platform
        self._metrics_of = metrics
        self._disks = disks
        self._emit = emit
        self._token = ""
        self._operations = Operations(keep)
        self._server: asyncio.Server | None = None
        self.take_event = self._operations.take_event

    @property
    def port(self) -> int:
        """The number of the port on loopback; 0 before `open`."""
        return 0 if self._server is None else int(self._server.sockets[0].getsockname()[1])

    async def open(self, token: str, *, ports: Sequence[int]) -> None:
        """Listen on the first of *ports* that is free; the port number 0 takes any free one.

        Args:
            token: The token that every request must carry.
            ports: Port numbers, in the order in which they are tried.

        Raises:
            ConfigurationError: None of *ports* is free.
        """
        pages = {"/status": self._status, "/metrics": self._metrics}
        operations: dict[str, Callable[[Mapping[str, str]], AsyncGenerator[Event, None]]] = {
            "/drain": self._drain,
            "/roll": self._roll,
            "/move": self._move,
            "/kill": functools.partial(self._act_at_once, self._platform.kill),
            "/pause": functools.partial(self._act_at_once, self._platform.pause),
            "/resume": functools.partial(self._act_at_once, self._platform.resume),
        }
        streams = {"/watch": self._watch}
        self._token = token
        for port in ports:
            try:
                self._server = await serve_control_port(pages, operations, token, streams=streams, port=port)
                return
            except OSError:
                continue
        raise ConfigurationError(
            f"no port of {', '.join(map(str, ports))} is free", hint="choose another local.metrics_port"
        )

    def close(self) -> None:
        """Accept no further connection; those that are open stay."""
        if self._server is not None:
            self._server.close()

    async def _status(self) -> tuple[str, bytes]:
        return "application/json", json.dumps(self._platform.status_document(), default=str).encode() + b"\n"

    async def _metrics(self) -> tuple[str, bytes]:
        servers = list(self._platform.servers)
        pages = await asyncio.gather(*map(self._metrics_of, servers))
        return METRICS_TYPE, federate_pages(
            {server.name: page for server, page in zip(servers, pages, strict=True)}, self._disks()
        )

    def _drain(self, query: Mapping[str, str]) -> AsyncGenerator[Event, None]:
        name = query.get("server", "")
        self._platform.check_drain(name)
        return self._operations.begin("drain", lambda: self._platform.drain(name))

    def _roll(self, query: Mapping[str, str]) -> AsyncGenerator[Event, None]:
        file = query.get("settings")
        change = None if file is None else self._platform.check_roll(load_settings(Path(file)))
        return self._operations.begin("roll", lambda: self._platform.roll(change))

    def _move(self, query: Mapping[str, str]) -> AsyncGenerator[Event, None]:
        name, robots = query.get("server", ""), _count(query.get("robots", ""))
        target_server = next((server for server in self._platform.servers if server.name == name), None)
        if target_server is None:
            running = ", ".join(server.name for server in self._platform.servers) or "none"
            raise UsageError(f"no server named {name[:80]!r} takes robots", hint=f"these do: {running}")
        port = ControlPort(target_server.control_port, self._token)
        return self._operations.begin("move", lambda: self._ask_to_move(name, port, robots))

    async def _ask_to_move(self, name: str, port: ControlPort, robots: int) -> None:
        """Ask server *name* to move *robots*, and emit ``rebalance``; raises UsageError if it does not."""
        target = f"/move?robots={robots}&spread_s={_SPREAD_S:g}"
        reply = await port.ask_once(target, timeout_s=_MOVE_TIMEOUT_S, method="POST")
        answer = {} if reply is None else reply.document()
        if reply is None or reply.status >= 300 or answer.get("under_way"):
            raise UsageError(
                f"{name} moves no robots now",
                hint="its robots move already, or it drains; see rse-pf local status",
            )
        self._emit(
            "rebalance", server=name, robots=answer["robots"], spread_s=answer["spread_s"], reason="asked"
        )

    def _act_at_once(
        self, act: Callable[[str], None], query: Mapping[str, str]
    ) -> AsyncGenerator[Event, None]:
        """Call *act*, such as kill, with the server that the request names; return the event of success."""
        act(query.get("server", ""))
        return _yield_over()

    def _watch(self, query: Mapping[str, str]) -> AsyncGenerator[Event, None]:
        return self._operations.watch(self._platform.status_document)


async def _yield_over() -> AsyncGenerator[Event, None]:
    yield {"event": OVER}


def _count(text: str) -> int:
    """Return *text* as a number of robots, 1 to `_MAX_MOVED`; raises UsageError if it is none."""
    if not (text.isascii() and text.isdigit() and 0 < int(text[:6]) <= _MAX_MOVED):
        raise UsageError(f"{text[:20]!r} is no number of robots", hint=f"take one from 1 to {_MAX_MOVED}")
    return int(text[:6])
