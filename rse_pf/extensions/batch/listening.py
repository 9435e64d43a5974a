"""Close two gaps in the listening sockets of Dask's scheduler and workers.

Dask opens an HTTP page in each process, without TLS or token: `without_pages` removes it.  Dask also waits
without a time limit for the handshake of a new connection: `bound_handshakes` adds a limit.
"""

from __future__ import annotations

import asyncio
from typing import Any

from rse_pf.http.unauthenticated import SilentConnections

__all__ = ["bound_handshakes", "without_pages"]

# Largest number of connections of a listener with unfinished handshakes; above it, the oldest of these
# connections is closed.
_MAX_UNFINISHED = 128
# Largest number of connections with unfinished handshakes from one address; above it, the oldest one is
# closed.
_MAX_UNFINISHED_OF_ADDRESS = 64


def without_pages(kind: Any) -> Any:
    """Return a subclass of *kind*, Dask's Scheduler or Worker, that opens no HTTP port."""
    return type(kind.__name__, (kind,), {"start_http_server": lambda *_, **__: None})


def bound_handshakes() -> None:
    """Limit connections with unfinished handshakes at all TLS listeners that Dask opens from now on.

    A listener closes a connection whose handshakes (TLS, then Dask's) are not finished after 6 s
    (`FIRST_REQUEST_S`), and the oldest one if more than 128 are unfinished, or more than 64 of one address.
    Dask's registry of listeners is changed for the whole process; listeners that are open already have no
    limits.
    """
    from distributed.comm.registry import backends
    from distributed.comm.tcp import TLSListener

    class Listener(TLSListener):  # type: ignore[misc]
        """A TLS listener that limits connections whose handshakes (TLS, then Dask's) are not finished."""

        async def start(self) -> None:
            later = asyncio.get_running_loop().call_later
            self.silent: SilentConnections[Any] = SilentConnections(
                call_later=later, most=_MAX_UNFINISHED, most_per_source=_MAX_UNFINISHED_OF_ADDRESS
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
