"""The process of an owner: a worker starts it with `start_owner`, it claims one map, serves it and ends.

It is started before it is known whether it is needed, and says ``ready`` when all is imported; ordered to
claim a map, it says ``serving`` or ``lost``.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import ipaddress
import os
import secrets
import socket
import ssl
import sys
import time
import traceback
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import msgspec

from rse_pf.accounts import TenantAccount
from rse_pf.aws.storage import open_data_store
from rse_pf.child.start import Child, ChildPlan, start_child
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import live_ports
from rse_pf.errors import StoreError
from rse_pf.ipc import FrameReader, encode_message, receive
from rse_pf.maps.registry import MapRegistry
from rse_pf.object_store import ObjectStore
from rse_pf.server.live_map.owner.context import OwnerContext
from rse_pf.server.live_map.owner.keyframe_objects import KeyframeObjects
from rse_pf.server.live_map.owner.lease import OwnerLease, lease_name, map_folder, renewal_s
from rse_pf.server.live_map.owner.link_security import (
    LinkClaims,
    check_token,
    internal_key,
    server_context,
)
from rse_pf.server.live_map.owner.live_owner import LiveOwner
from rse_pf.server.live_map.owner.log import LiveLog, OwnershipLost
from rse_pf.server.live_map.owner.server import OwnerServer, listen
from rse_pf.server.live_map.owner.state import MapKind, MapState, take_over
from rse_pf.server.live_map.owner.threads import OwnerThreads, Urgency
from rse_pf.server.live_map.owner.whole_fit import fit_apart
from rse_pf.server.log import JsonLog

__all__ = ["MAP_KIND", "OwnerOrder", "advertised_address", "run", "start_owner"]

MAP_KIND = "rse_pf.server.live_map.owner.state:LIVE_MAP"
"""Where the `MapKind` of real maps is, as ``module:name``."""
# Memory of the process of one live map; a process that needs more is ended.
_MAX_MEMORY_BYTES = 2 << 30
_READ_BYTES = 1 << 16
_RETRY_S = 0.1
_CALM_NICE = 10
_SWITCH_S = 0.0005
"""A thread that has something to do waits at most so long for the interpreter; by default 5 ms each time."""
_OUTSIDE = ("192.0.2.1", 9)
"""An address of documentation: nothing is sent there, but the route to it names the main interface."""
_T = TypeVar("_T")


class OwnerOrder(msgspec.Struct, frozen=True, kw_only=True):
    """Claim this map if its lease still holds ``known``."""

    tenant: str
    map_name: str
    server: str
    known: bytes | None


def start_owner(settings: PlatformSettings, kind: str = MAP_KIND, *, calmly: bool = False) -> Child:
    """Start the process of an owner, *calmly* if nobody waits for it yet.

    Only for the main thread of a process, with which it ends.
    """
    child = start_child(
        ChildPlan(
            target=f"{__name__}:run", name="rse-pf live map", memory_bytes=_MAX_MEMORY_BYTES,
            import_nice=_CALM_NICE if calmly else 0,
        )
    )  # fmt: skip
    child.say({"settings": settings.to_dict(), "kind": kind})
    return child


def advertised_address(host: str) -> str:
    """Return the address under which other servers reach a socket that listens on *host*."""
    try:
        is_anywhere = ipaddress.ip_address(host).is_unspecified
    except ValueError:
        is_anywhere = False
    if not is_anywhere:
        return host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_OUTSIDE if family == socket.AF_INET else ("2001:db8::1", 9))
        except OSError:
            return "127.0.0.1" if family == socket.AF_INET else "::1"
        return str(probe.getsockname()[0])


def run(worker: socket.socket) -> None:
    """Claim and serve the map that the *worker* orders."""
    order = receive(worker)
    if order is None:
        return
    settings = PlatformSettings.from_dict(order["settings"])
    sys.setswitchinterval(_SWITCH_S)
    module, _, name = order["kind"].partition(":")
    kind: MapKind = getattr(importlib.import_module(module), name)
    store = open_data_store(settings)
    address = advertised_address(settings.live.host)
    context, certificate = server_context(address, now_s=time.time())
    worker.sendall(encode_message(["ready"]))
    claim = receive(worker)
    if claim is None:
        return
    # Not before: strangers would fill the backlog of a process that does not accept yet.
    listener = listen(settings.live.host, live_ports(settings.live))
    process = _Process(
        worker,
        settings,
        store,
        kind,
        msgspec.convert(claim, OwnerOrder),
        (address, listener, context, certificate),
    )
    code = 1
    try:
        asyncio.new_event_loop().run_until_complete(process.run())
        code = 0
    except MemoryError:
        pass
    except Exception:  # noqa: BLE001  the log of the server has the reason
        traceback.print_exc()
    finally:
        os._exit(code)  # threads may wait for the store for long


class _Process:
    def __init__(
        self, worker: socket.socket, settings: PlatformSettings, store: ObjectStore, kind: MapKind,
        order: OwnerOrder,
        socket_: tuple[str, Any, ssl.SSLContext, str],
    ) -> None:  # fmt: skip
        self._worker = worker
        self._settings = settings
        self._store = store
        self._kind = kind
        self._order = order
        self._socket = socket_
        self._name = f"{order.server}-{secrets.token_hex(8)}"
        self._threads = OwnerThreads()
        self._log = JsonLog(
            level=settings.serving.log_level, server=order.server, wall_clock=time.time, tenant=order.tenant
        )  # fmt: skip
        self._lease = OwnerLease(
            store, lease_name(order.tenant, order.map_name), owner=self._name,
            server=order.server, clock=time.monotonic,
        )  # fmt: skip

    async def run(self) -> None:
        self._threads.start()
        self._log.start()
        if not await self._retry(self._threads.lease, lambda: self._lease.claim(self._order.known)):
            self._worker.sendall(encode_message(["lost"]))
            return
        renewing = asyncio.ensure_future(self._renew())
        taking = asyncio.ensure_future(self._take_over())
        await asyncio.wait({renewing, taking}, return_when=asyncio.FIRST_COMPLETED)
        if not taking.done() or taking.exception() is not None:
            error = taking.exception() if taking.done() else None
            if error is not None and not isinstance(error, OwnershipLost):
                traceback.print_exception(error)
                self._log.error("live-map-unreadable", map=self._order.map_name, error=str(error))
                self._log.close()
            self._worker.sendall(encode_message(["lost"]))
            return
        renewing.cancel()
        await self._serve(*taking.result())

    async def _renew(self) -> None:
        """Renew the lease while the map is being restored; return when it is lost."""
        settings = self._settings.live
        while await self._retry(self._threads.lease, self._lease.renew):
            await asyncio.sleep(renewal_s(settings.lease_s))

    async def _take_over(self) -> tuple[MapState, LiveLog]:
        record = self._lease.record
        log = LiveLog(
            self._store, map_folder(self._order.tenant, self._order.map_name), owner=self._name,
            epoch=record.epoch, base=record.base, keeps_all=self._settings.live.keep_log,
        )  # fmt: skip
        began_s = time.monotonic()

        def take() -> MapState:
            return take_over(log, self._kind, owner=self._name, epoch=record.epoch)

        state = await self._retry(lambda act: self._threads.compute(Urgency.APPLY, act), take)
        self._log.info(
            "live-map-owned", map=self._order.map_name, epoch=record.epoch, version=state.position,
            keyframes=state.keyframes, seconds=round(time.monotonic() - began_s, 3),
        )  # fmt: skip
        return state, log

    async def _serve(self, state: MapState, log: LiveLog) -> None:
        settings, order = self._settings, self._order
        address, listener, context, certificate = self._socket
        key = await self._retry(self._threads.store, lambda: internal_key(self._store))
        claims = LinkClaims(
            tenant=order.tenant, map_name=order.map_name, epoch=self._lease.record.epoch,
            certificate=certificate, expires_s=0.0,
        )  # fmt: skip
        owner = LiveOwner(
            self._context(lambda payload: server.tell(payload), lambda n: server.beat(n)),
            state,
            log,
            self._lease,
        )
        server = OwnerServer(
            owner,
            check=lambda token: check_token(
                key, token, claims, now_s=time.time(), leeway_s=settings.auth.leeway_s
            ),
            on_defect=traceback.print_exception,
        )
        server.open(listener, context)
        port = listener.getsockname()[1]
        if not await self._retry(self._threads.lease, lambda: self._lease.serve(address, port, certificate)):
            self._worker.sendall(encode_message(["lost"]))
            return
        self._worker.sendall(encode_message(["serving", self._lease.record.epoch]))
        orders = asyncio.ensure_future(self._obey(owner))
        how = await owner.run()
        orders.cancel()
        if how != "lost":
            await server.close()
        self._log.info("live-map-given-up", map=order.map_name, how=how)
        self._log.close()

    def _context(
        self, tell: Callable[[dict[str, Any]], None], on_beat: Callable[[int], None]
    ) -> OwnerContext:
        maps = MapRegistry(
            self._store, self._order.tenant, max_bytes=4 * self._settings.data.max_object_bytes
        )
        account = TenantAccount(self._store, self._order.tenant, self._settings.data)
        return OwnerContext(
            map_name=self._order.map_name, settings=self._settings.live, kind=self._kind,
            threads=self._threads, maps=maps, clock=time.monotonic, wall_clock=time.time,
            sleep=asyncio.sleep, account=account, objects=KeyframeObjects(self._store, account),
            log=self._log, tell=tell, on_beat=on_beat, on_use=self._tell_use, fit=fit_apart,
        )  # fmt: skip

    def _tell_use(self, is_used: bool) -> None:
        """Tell the worker, which may need the process for another map."""
        with contextlib.suppress(OSError):  # it does not read: it ends
            self._worker.sendall(encode_message(["used", is_used]))

    async def _obey(self, owner: LiveOwner) -> None:
        """Release the map when the worker says so."""
        self._worker.setblocking(False)
        frames = FrameReader(_READ_BYTES)
        while data := await asyncio.get_running_loop().sock_recv(self._worker, _READ_BYTES):
            if any(message == {"do": "release"} for message in frames.feed(data)):
                await owner.release()

    async def _retry(self, where: Callable[[Callable[[], _T]], Awaitable[_T]], act: Callable[[], _T]) -> _T:
        """Return what *act* returns, however long the store fails; ownership that is lost stays lost."""
        while True:
            try:
                return await where(act)
            except OwnershipLost:
                raise
            except StoreError as error:
                self._log.warning("live-store-retry", map=self._order.map_name, error=error.message)
                await asyncio.sleep(_RETRY_S)
