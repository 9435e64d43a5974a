"""Run the process of a map server, which a worker starts: claim one live map, serve it, exit.

The process talks with its worker over a socket (`rse_pf.processes.ipc`):

1. The worker sends the settings and the implementation of the map (`start_map_server`).
2. The process imports everything, opens the store and sends ``ready``.  A worker starts it before a map
   needs it, so that a takeover does not wait for imports.
3. The worker sends a `ClaimOrder`.
4. The process claims the lease, restores the map, and sends ``serving``; or ``lost`` if another process was
   first, and exits.
5. While it serves, it sends ``used`` with true when commands begin to arrive, and with false when none has
   arrived for a while.
6. When the worker sends ``release``, the process gives the map up and exits.  If the worker exits, Linux
   kills the process.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import importlib
import importlib.util
import os
import secrets
import socket
import ssl
import sys
import time
import traceback
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import live_ports
from rse_pf.errors import MissingExtra, StoreError
from rse_pf.maps.registry import MapRegistry
from rse_pf.processes.ipc import FrameReader, encode_message, receive
from rse_pf.server.live_map.connection_security import (
    ConnectionClaims,
    check_token,
    internal_key,
    server_context,
)
from rse_pf.server.live_map.lease import MapLease, lease_name, map_folder, renewal_s
from rse_pf.server.live_map.map_server.environment import (
    MapImplementation,
    MapServerEnvironment,
    MapServerThreads,
    Urgency,
)
from rse_pf.server.live_map.map_server.keyframe_objects import KeyframeObjects
from rse_pf.server.live_map.map_server.log import LeaseLost, LiveLog
from rse_pf.server.live_map.map_server.map_server import MapServer
from rse_pf.server.live_map.map_server.measurement import optimise_in_child
from rse_pf.server.live_map.map_server.state import MapState, take_over
from rse_pf.server.live_map.map_server.worker_connections import WorkerConnections, listen
from rse_pf.server.live_map.process_pool import ClaimOrder
from rse_pf.server.log import JsonLog
from rse_pf.storage.object_store import ObjectStore
from rse_pf.storage.quotas import TenantAccount

__all__ = ["advertised_address", "run", "warn_without_optimiser"]

_READ_BYTES = 1 << 16  # largest number of bytes that one read of the worker's socket returns
_RETRY_S = 0.1
"""Seconds between two tries of a failing object store while the map is claimed and restored."""
_SWITCH_INTERVAL_S = 0.0005
"""Seconds after which a running thread passes the interpreter lock (GIL) to a waiting one.  Python's default
of 5 ms would delay each step of a keyframe while other threads compute."""
_MAX_VERSION_OBJECTS = 4
"""Largest size of a decompressed version of a map, in units of ``data.max_object_bytes``; a map server
refuses to read a larger version, and to publish one."""
_PROBES = {
    "0.0.0.0": (socket.AF_INET, "192.0.2.1", "127.0.0.1"),
    "::": (socket.AF_INET6, "2001:db8::1", "::1"),
}
"""For each address that stands for all interfaces: its family, an address reserved for documentation (RFC
5737, RFC 3849), to which nothing is sent, and the loopback address.  The operating system's route to the
second address gives the address of this machine's main network interface."""
_PROBE_PORT = 9  # any port: nothing is sent to it
_T = TypeVar("_T")


def advertised_address(host: str) -> str:
    """Return the address under which other servers reach a socket that listens on *host*.

    For ``0.0.0.0`` and ``::`` this is the address of the main network interface, or the loopback address if
    the machine has no route to other networks; any other *host* is returned unchanged.
    """
    if host not in _PROBES:
        return host
    family, address, loopback = _PROBES[host]
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, _PROBE_PORT))
        except OSError:
            return loopback
        return str(probe.getsockname()[0])


def warn_without_optimiser(log: JsonLog, map_name: str) -> None:
    """Log that the map stays less accurate if gtsam is not installed, which optimises its whole pose graph.

    Such a map is served all the same: the smoother, which needs no gtsam, still corrects it in parts.
    """
    if importlib.util.find_spec("gtsam") is None:
        missing = MissingExtra("gtsam", "maps")
        log.warning("live-map-not-optimised", map=map_name, reason=missing.message, fix=missing.hint)


def run(worker: socket.socket) -> None:
    """Claim and serve the map that the worker orders over its socket *worker*; the child's entry point.

    This function returns only if the worker closes the socket before it has sent an order.  After an order,
    it exits the process: with code 0, or with 1 after an error.
    """
    # 1. Read the settings, import the modules of the map, and make a certificate.
    start = receive(worker)
    if start is None:
        return
    settings = PlatformSettings.from_dict(start["settings"])
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    module, _, name = start["kind"].partition(":")
    implementation: MapImplementation = getattr(importlib.import_module(module), name)
    store = open_data_store(settings)
    address = advertised_address(settings.live.host)
    context, certificate = server_context(address, now_s=time.time())
    # 2. Report to the worker that the process is ready, and wait for an order.
    worker.sendall(encode_message(["ready"]))
    order = receive(worker)
    if order is None:
        return
    # 3. Listen for connections of workers only now: the process accepts none before, so unauthenticated
    # clients could have filled the backlog of the socket.
    endpoint = _Endpoint(
        address=address,
        listener=listen(settings.live.host, live_ports(settings.live)),
        context=context,
        certificate=certificate,
    )
    process = _MapServerProcess(
        worker, settings, store, implementation, msgspec.convert(order, ClaimOrder), endpoint
    )
    # 4. Claim and serve the map.
    exit_code = 1
    try:
        asyncio.new_event_loop().run_until_complete(process.run())
        exit_code = 0
    except MemoryError:
        pass
    except Exception:  # noqa: BLE001  standard error goes to the log of the server
        traceback.print_exc()
    finally:
        os._exit(exit_code)  # a normal exit would wait for threads that are blocked by the store


@dataclass(frozen=True, slots=True, kw_only=True)
class _Endpoint:
    """Where the map server listens.

    Attributes:
        address: Address under which the workers of other servers reach it.
        listener: The listening socket.
        context: TLS context with the certificate.
        certificate: SHA-256 in hex of the certificate.
    """

    address: str
    listener: socket.socket
    context: ssl.SSLContext
    certificate: str

    @property
    def port(self) -> int:
        """TCP port on which the socket listens."""
        return int(self.listener.getsockname()[1])


class _MapServerProcess:
    """The steps of a map server's process, from the claim of the lease to its exit."""

    def __init__(
        self,
        worker: socket.socket,
        settings: PlatformSettings,
        store: ObjectStore,
        implementation: MapImplementation,
        order: ClaimOrder,
        endpoint: _Endpoint,
    ) -> None:
        self._worker = worker
        self._settings = settings
        self._store = store
        self._implementation = implementation
        self._order = order
        self._endpoint = endpoint
        self._name = f"{order.server}-{secrets.token_hex(8)}"
        self._threads = MapServerThreads()
        self._log = JsonLog(
            level=settings.serving.log_level,
            server=order.server,
            wall_clock=time.time,
            tenant=order.tenant,
        )
        self._lease = MapLease(
            store,
            lease_name(order.tenant, order.map_name),
            owner=self._name,
            server=order.server,
            clock=time.monotonic,
        )

    async def run(self) -> None:
        """Claim the lease, restore the map and serve it; return when the process has to exit."""
        self._threads.start()
        self._log.start()
        warn_without_optimiser(self._log, self._order.map_name)
        # 1. Claim the lease; if another process was first, report ``lost`` and exit.
        if not await self._retry(self._threads.lease, lambda: self._lease.claim(self._order.known)):
            self._worker.sendall(encode_message(["lost"]))
            return
        # 2. Restore the map, while the lease is renewed; if either fails, report ``lost`` and exit.
        renewal = asyncio.ensure_future(self._renew_until_lost())
        takeover = asyncio.ensure_future(self._take_over())
        await asyncio.wait({renewal, takeover}, return_when=asyncio.FIRST_COMPLETED)
        if not takeover.done() or takeover.exception() is not None:
            error = takeover.exception() if takeover.done() else None
            if error is not None and not isinstance(error, LeaseLost):
                traceback.print_exception(error)
                self._log.error("live-map-unreadable", map=self._order.map_name, error=str(error))
                self._log.close()
            self._worker.sendall(encode_message(["lost"]))
            return
        renewal.cancel()
        # 3. Serve the map until it is lost, released or stopped.
        await self._serve(*takeover.result())

    async def _renew_until_lost(self) -> None:
        """Renew the lease at intervals; return when another process has taken it."""
        lease_s = self._settings.live.lease_s
        while await self._retry(self._threads.lease, self._lease.renew):
            await asyncio.sleep(renewal_s(lease_s))

    async def _take_over(self) -> tuple[MapState, LiveLog]:
        """Restore the map from its log, and write a log entry, after which its predecessor can write none.

        This is tried again as long as the store fails, or an entry of the log is missing or damaged.

        Raises:
            LeaseLost: Another process has taken the map over meanwhile.
            BadRequest: The events of an entry are damaged.
        """
        record = self._lease.record
        log = LiveLog(
            self._store,
            map_folder(self._order.tenant, self._order.map_name),
            owner=self._name,
            epoch=record.epoch,
            base=record.base,
            keeps_all=self._settings.live.keep_log,
        )
        began_s = time.monotonic()
        state = await self._retry(
            lambda act: self._threads.compute(Urgency.APPLY, act),
            lambda: take_over(log, self._implementation, owner=self._name, epoch=record.epoch),
        )
        self._log.info(
            "live-map-owned",
            map=self._order.map_name,
            epoch=record.epoch,
            version=state.position,
            keyframes=state.keyframes,
            seconds=round(time.monotonic() - began_s, 3),
        )
        return state, log

    async def _serve(self, state: MapState, log: LiveLog) -> None:
        settings, endpoint = self._settings, self._endpoint
        key = await self._retry(self._threads.store, lambda: internal_key(self._store))
        claims = ConnectionClaims(
            tenant=self._order.tenant,
            map_name=self._order.map_name,
            epoch=self._lease.record.epoch,
            certificate=endpoint.certificate,
            expires_s=0.0,
        )
        # 1. Make the map server and the connections of workers, which refer to each other, and accept
        # connections.
        environment = self._make_environment(
            send_update=lambda payload: connections.send_update(payload),
            on_renewal=lambda number: connections.send_renewal(number),
        )
        map_server = MapServer(environment, state, log, self._lease)
        connections = WorkerConnections(
            map_server,
            check_token=lambda token: check_token(
                key, token, claims, now_s=time.time(), leeway_s=settings.auth.leeway_s
            ),
            on_defect=traceback.print_exception,
        )
        connections.open(endpoint.listener, endpoint.context)
        # 2. Write into the lease where the map server listens, and notify the worker that it serves the map.
        publish_endpoint = functools.partial(
            self._lease.serve, endpoint.address, endpoint.port, endpoint.certificate
        )
        if not await self._retry(self._threads.lease, publish_endpoint):
            self._worker.sendall(encode_message(["lost"]))
            return
        self._worker.sendall(encode_message(["serving", self._lease.record.epoch]))
        # 3. Answer requests until the service ends.
        release_order = asyncio.ensure_future(self._release_on_order(map_server))
        end = await map_server.run()
        release_order.cancel()
        if end != "lost":
            await connections.close()
        self._log.info("live-map-given-up", map=self._order.map_name, how=end)
        self._log.close()

    def _make_environment(
        self, send_update: Callable[[dict[str, Any]], None], on_renewal: Callable[[int], None]
    ) -> MapServerEnvironment:
        max_version_bytes = _MAX_VERSION_OBJECTS * self._settings.data.max_object_bytes
        account = TenantAccount(self._store, self._order.tenant, self._settings.data)
        return MapServerEnvironment(
            map_name=self._order.map_name,
            settings=self._settings.live,
            implementation=self._implementation,
            threads=self._threads,
            maps=MapRegistry(self._store, self._order.tenant, max_bytes=max_version_bytes),
            clock=time.monotonic,
            wall_clock=time.time,
            sleep=asyncio.sleep,
            account=account,
            objects=KeyframeObjects(self._store, account),
            log=self._log,
            send_update=send_update,
            on_renewal=on_renewal,
            on_use=self._send_use,
            optimise=optimise_in_child,
        )

    def _send_use(self, is_used: bool) -> None:
        """Send the worker whether the map gets commands; the worker may need this process for another map."""
        with contextlib.suppress(OSError):  # the worker has exited, and Linux kills this process
            self._worker.sendall(encode_message(["used", is_used]))

    async def _release_on_order(self, map_server: MapServer) -> None:
        """Read messages of the worker until it disconnects, and release the map when it orders that."""
        self._worker.setblocking(False)
        frames = FrameReader(_READ_BYTES)
        while data := await asyncio.get_running_loop().sock_recv(self._worker, _READ_BYTES):
            if any(message == {"do": "release"} for message in frames.feed(data)):
                await map_server.release()

    async def _retry(
        self, run_in_thread: Callable[[Callable[[], _T]], Awaitable[_T]], act: Callable[[], _T]
    ) -> _T:
        """Return the result of *act*, called in a thread and repeated after 0.1 s if it raises StoreError.

        Raises:
            LeaseLost: Another process has taken the map over.
        """
        while True:
            try:
                return await run_in_thread(act)
            except LeaseLost:
                raise
            except StoreError as error:
                self._log.warning("live-store-retry", map=self._order.map_name, error=error.message)
                await asyncio.sleep(_RETRY_S)
