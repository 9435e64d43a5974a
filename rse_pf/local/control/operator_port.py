"""The port of one running platform for its operator and for Prometheus, as `control_port` serves it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from typing import Any, Protocol

from rse_pf.errors import ConfigurationError
from rse_pf.local.control.control_port import METRICS_TYPE, serve_control_port
from rse_pf.local.control.federation import federated
from rse_pf.local.control.operations import Operations
from rse_pf.local.servers.backend_servers import BackendServer

__all__ = ["OperatedPlatform", "OperatorPort"]

Event = Mapping[str, Any]


class OperatedPlatform(Protocol):
    """What the port needs of a platform."""

    @property
    def servers(self) -> Sequence[BackendServer]:
        """The servers that serve."""

    def status_document(self) -> dict[str, Any]:
        """Return everything that is known, as plain JSON values."""

    def check_drain(self, name: str) -> Any:
        """Raise UsageError if *name* cannot be drained."""

    async def drain(self, name: str, reason: str = "asked") -> dict[str, Any]:
        """Let *name* leave."""

    async def roll(self) -> None:
        """Replace every server."""


class OperatorPort:
    """The port, closed at first.  ``port`` is 0 while it is closed."""

    def __init__(
        self,
        platform: OperatedPlatform,
        *,
        metrics: Callable[[BackendServer], Coroutine[Any, Any, str | None]],
        keep: Callable[[Coroutine[Any, Any, None]], None],
    ) -> None:
        """Describe the port.

        Args:
            platform: What it shows and operates.
            metrics: Returns the page of a server for Prometheus, None if it does not answer.
            keep: Lets work go on until it is done or the platform ends.
        """
        self._platform = platform
        self._metrics_of = metrics
        self._operations = Operations(keep)
        self._server: asyncio.Server | None = None
        self.heard = self._operations.heard

    @property
    def port(self) -> int:
        """Where it listens, on loopback."""
        return 0 if self._server is None else int(self._server.sockets[0].getsockname()[1])

    async def open(self, token: str, *, ports: Sequence[int]) -> None:
        """Listen on the first of *ports* that is free; 0 takes a free one.

        Raises:
            ConfigurationError: None is free.
        """
        pages = {"/status": self._status, "/metrics": self._metrics}
        operations = {"/drain": self._drain, "/roll": self._roll}
        for port in ports:
            try:
                self._server = await serve_control_port(pages, operations, token, port=port)
                return
            except OSError:
                continue
        raise ConfigurationError(
            f"no port of {', '.join(map(str, ports))} is free", hint="choose another local.metrics_port"
        )

    def close(self) -> None:
        """Take no further request."""
        if self._server is not None:
            self._server.close()

    async def _status(self) -> tuple[str, bytes]:
        return "application/json", json.dumps(self._platform.status_document(), default=str).encode() + b"\n"

    async def _metrics(self) -> tuple[str, bytes]:
        servers = list(self._platform.servers)
        pages = await asyncio.gather(*map(self._metrics_of, servers))
        return METRICS_TYPE, federated(
            {server.name: page for server, page in zip(servers, pages, strict=True)}
        )

    def _drain(self, query: Mapping[str, str]) -> AsyncIterator[Event]:
        name = query.get("server", "")
        self._platform.check_drain(name)
        return self._operations.begin("drain", lambda: self._platform.drain(name))

    def _roll(self, query: Mapping[str, str]) -> AsyncIterator[Event]:
        return self._operations.begin("roll", self._platform.roll)
