"""How the processes of a cluster listen: on one address, with TLS, for who shows the cluster's certificate.

Dask opens a page over HTTP in each process, without TLS or token, and waits for ever for a handshake.
"""

from __future__ import annotations

import asyncio
from typing import Any

from rse_pf.http.unauthenticated import SilentConnections

__all__ = ["bound_handshakes", "without_pages"]

_MAX_SILENT, _MAX_PER_SOURCE = 128, 64


def without_pages(kind: Any) -> Any:
    """Return the class *kind*, a Scheduler or a Worker of Dask, without its port for HTTP."""
    return type(kind.__name__, (kind,), {"start_http_server": lambda *_, **__: None})


def bound_handshakes() -> None:
    """Let every listener that Dask opens from now on cut connections that do not shake hands in time."""
    from distributed.comm.registry import backends
    from distributed.comm.tcp import TLSListener

    class Listener(TLSListener):  # type: ignore[misc]
        """Counts a connection until both handshakes, of TLS and of Dask, are done."""

        async def start(self) -> None:
            later = asyncio.get_running_loop().call_later
            self.silent: SilentConnections[Any] = SilentConnections(
                call_later=later, most=_MAX_SILENT, most_per_source=_MAX_PER_SOURCE
            )
            await super().start()

        async def _handle_stream(self, stream: Any, address: Any) -> None:
            self.silent.enter(stream, stream.close, str(address[0]))
            try:
                await super()._handle_stream(stream, address)
            finally:
                self.silent.leave(stream)

        async def on_connection(self, comm: Any, handshake_overrides: Any = None) -> None:
            await super().on_connection(comm, handshake_overrides)
            self.silent.leave(comm.stream)

    backends["tls"]._listener_class = Listener
