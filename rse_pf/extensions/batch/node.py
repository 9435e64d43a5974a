"""One process of a local Dask cluster: the scheduler, or a worker that computes one part at a time.

The parent sends a `NodeOrder` with the key of the cluster through the socket of the child process; a
scheduler answers with its address.  Both use TLS only, and accept only peers with the cluster's key: Dask's
messages are pickled, so that a peer could run any code.  Each process listens at one port of the loopback
interface.  Dask's messages contain no bytes of robots: a part names objects of the store, and its result is
an object of the store.
"""

from __future__ import annotations

import asyncio
import functools
import socket
import sys
import tempfile
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, message_of
from rse_pf.extensions.batch.listening import bound_handshakes, without_pages
from rse_pf.extensions.batch.part_kinds import compute_part
from rse_pf.extensions.batch.parts import decode_part
from rse_pf.processes.ipc import encode_message, receive
from rse_pf.storage.object_store import ObjectStore
from rse_pf.terminal import show

__all__ = ["NodeOrder", "compute", "run_scheduler", "run_worker", "security_of"]

# Address at which scheduler and workers listen, so that only processes of this machine can connect.
_HOST = "127.0.0.1"
# A worker without a connection to the scheduler exits after this time, in seconds.
_DEATH_TIMEOUT_S = 20.0


class NodeOrder(msgspec.Struct, frozen=True, kw_only=True):
    """The message to a new process of a cluster: certificate and key of the cluster, both PEM."""

    certificate: str
    key: str
    address: str = ""
    """Address of the scheduler to which a worker connects; empty for a scheduler."""


def security_of(certificate: str, key: str) -> Any:
    """Return Dask's Security for a cluster whose processes all use the same certificate and *key* (PEM).

    The certificate is its own authority, so that no other certificate is accepted.
    """
    from distributed.security import Security

    return Security(
        require_encryption=True, tls_ca_file=certificate, tls_client_key=key, tls_client_cert=certificate,
        tls_scheduler_key=key, tls_scheduler_cert=certificate, tls_worker_key=key,
        tls_worker_cert=certificate,
    )  # fmt: skip


def compute(settings: bytes, part: bytes) -> list[str]:
    """Compute a part on a worker and store its result.

    Return an empty list, or code, message and hint of an error.  No exception is raised, since Dask would
    pickle it.

    Args:
        settings: The platform's settings as JSON; ``data.store`` is the store of inputs and results.
        part: A part, encoded by `encode_part`.
    """
    try:
        compute_part(_store_of(settings), decode_part(part))
    except RsePfError as error:
        return [error.code, error.message, error.hint]
    except MemoryError:
        return ["crashed", "a part needs more memory than its worker has", "merge fewer maps at once"]
    except Exception as error:  # noqa: BLE001  a defect is reported where the command runs
        return ["internal", f"a part failed: {message_of(error)[:200]}", "report it with the maps' sizes"]
    return []


def run_scheduler(parent: socket.socket) -> None:
    """Run a Dask scheduler until the parent exits or closes the socket; entry point of the process."""
    _run(parent, functools.partial(_scheduler, parent))


def run_worker(parent: socket.socket) -> None:
    """Run a Dask worker until the parent or the scheduler exits; entry point of the process."""
    _run(parent, _worker)


def _run(parent: socket.socket, act: Callable[[NodeOrder], Awaitable[None]]) -> None:
    order = receive(parent)
    if order is None:
        return

    async def run() -> None:
        await act(msgspec.convert(order, NodeOrder))

    try:
        asyncio.run(run())
    except (OSError, asyncio.TimeoutError) as error:
        show(message_of(error)[:200], error=True)
        sys.exit(1)


async def _scheduler(parent: socket.socket, order: NodeOrder) -> None:
    from distributed import Scheduler

    security = security_of(order.certificate, order.key)
    bound_handshakes()
    async with without_pages(Scheduler)(
        host=_HOST, port=0, protocol="tls", security=security, dashboard=False
    ) as scheduler:
        parent.sendall(encode_message(scheduler.address))
        await scheduler.finished()


async def _worker(order: NodeOrder) -> None:
    from distributed import Worker

    bound_handshakes()
    security = security_of(order.certificate, order.key)
    with tempfile.TemporaryDirectory(prefix="rse-pf-batch-") as folder:
        async with without_pages(Worker)(
            order.address, host=_HOST, nthreads=1, security=security, local_directory=folder,
            memory_limit=0, death_timeout=_DEATH_TIMEOUT_S,
        ) as worker:  # fmt: skip
            await worker.finished()


@functools.lru_cache(maxsize=1)
def _store_of(settings: bytes) -> ObjectStore:
    return open_data_store(PlatformSettings.from_dict(msgspec.json.decode(settings)))
