"""The ways from one worker to the owners of live maps: find an owner, connect, start one, and connect again.

A worker finds the owner of a map through its lease in the store, and starts one when there is none or when it
has stopped.  A link lasts while somebody waits for an answer or for updates, and a little longer.  A request
that was not answered when a connection ended is sent again on the next one: every operation can be done twice
without harm.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.config import LiveSettings, PlatformSettings
from rse_pf.errors import (
    BadRequest,
    Busy,
    Conflict,
    NotFound,
    RsePfError,
    StoreError,
    Unauthorized,
    error_from_code,
)
from rse_pf.identity import RobotId
from rse_pf.ipc import FrameReader, encode_message
from rse_pf.lease import Lease, read_record
from rse_pf.object_store import ObjectStore
from rse_pf.server.live_map.children import OwnerChild, OwnerChildren
from rse_pf.server.live_map.owner.lease import (
    LeaseRecord,
    decode_lease,
    lease_name,
    tenant_folder,
    verdict_on,
)
from rse_pf.server.live_map.owner.link_security import (
    TOKEN_S,
    LinkClaims,
    check_certificate,
    client_context,
    internal_key,
    make_token,
)
from rse_pf.server.live_map.owner.process import MAP_KIND, OwnerOrder, start_owner
from rse_pf.server.live_map.owner.replies import show_missing
from rse_pf.server.live_map.owner.server import MAX_LINK_BYTES
from rse_pf.server.log import JsonLog
from rse_pf.wire.live_map import SHOW, KeyframeRequest, LiveRequest, LiveStart

__all__ = ["LinkContext", "MapLink", "OwnerLinks", "begins_a_map"]

_READ_BYTES = 1 << 18
_CONNECT_S = 1.0
_POLL_S = 0.1
_RETRY_S = 0.02
"""An owner that is about to give its map up is asked again so often."""
_WATCH_POLL_S = 1.0
"""A map that nobody may begin is looked for so often."""
_LINGER_S = 10.0
_PREPARE_SHARE = 0.66
"""After this share of the lease without a renewal a process is started, so that it is ready in time."""
_BUSY_RETRY_MS = 500.0
_THREADS = 4
"""They wait for the store: for the leases of the maps that have no owner now."""
_RELEASE_S = 5.0
_STATES = {"serving": "live", "starting": "moving", "released": "idle", "stopped": "stopped"}
_NO_MAP = {"kind": "map", "keyframes": 0, "version": 0, "owner": ""}
"""What is told of a map whose owner has told nothing yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkContext:
    """What all links of a worker share.

    Attributes:
        call: Runs a blocking function in a thread.
        key: Returns the key of the tokens between servers; blocking.
        children: The owner processes of this worker.
        clock: Seconds, monotonic.
        wall_clock: Unix seconds.
        leeway_s: Of the clocks of two servers.
    """

    store: ObjectStore
    settings: LiveSettings
    server_id: str
    log: JsonLog
    call: Callable[[Callable[[], Any]], Awaitable[Any]]
    key: Callable[[], bytes]
    children: OwnerChildren
    clock: Callable[[], float]
    wall_clock: Callable[[], float]


@dataclass(slots=True, eq=False)
class _Pending:
    robot: RobotId
    operation: str
    request: LiveRequest
    future: asyncio.Future[dict[str, Any]]

    @property
    def begins(self) -> bool:
        return begins_a_map(self.request)


class MapLink:
    """One map of one tenant, as one worker uses it."""

    def __init__(
        self,
        context: LinkContext,
        tenant: str,
        map_name: str,
        *,
        on_update: Callable[[dict[str, Any]], None],
        on_end: Callable[[MapLink], None],
    ) -> None:
        """Describe the link; `start` begins to look for the owner.

        Args:
            context: Of the worker.
            tenant: Whose map.
            map_name: Its name.
            on_update: Gets each update while the map is watched.
            on_end: Called when nobody has needed the map for a while.

        Raises:
            BadRequest: The name is not valid.
        """
        self.tenant, self.map_name = tenant, map_name
        self.is_watched = self.may_start = False
        self.child: OwnerChild | None = None
        self._context = context
        self._on_update = on_update
        self._on_end = on_end
        self._lease = Lease(context.store, lease_name(tenant, map_name), decode_lease, context.clock)
        self._numbers = itertools.count(1)
        self._pending: dict[int, _Pending] = {}
        self._writer: asyncio.StreamWriter | None = None
        self._dead_epoch: int | None = None
        self._welcomed = ""
        self._newest_map: dict[str, Any] = {}
        self._used_s = context.clock()
        self._is_closed = self._was_asked = False
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None]

    def start(self) -> MapLink:
        """Begin to look for the owner; return this object."""
        self._task = asyncio.get_running_loop().create_task(self._run())
        return self

    async def request(
        self, robot: RobotId, operation: str, request: LiveRequest, deadline_s: float
    ) -> dict[str, Any]:
        """Return the answer of the owner; raises Busy after *deadline_s*, and what the owner refused."""
        number = next(self._numbers)
        self._was_asked = True
        pending = _Pending(robot, operation, request, asyncio.get_running_loop().create_future())
        self._pending[number] = pending
        self._send(number, pending)
        self._wake.set()
        try:
            return await asyncio.wait_for(pending.future, deadline_s)
        except asyncio.TimeoutError:
            raise Busy(
                f"the live map {self.map_name!r} did not answer within {deadline_s:.1f} s",
                hint="try again; if it lasts, look at the servers' logs and the store",
                retry_after_ms=_BUSY_RETRY_MS,
            ) from None
        finally:
            del self._pending[number]
            self._used_s = self._context.clock()

    def set_watched(self, is_watched: bool, *, may_start: bool = True) -> None:
        """Ask for updates from now on, or for none.

        Args:
            is_watched: Whether somebody reads them.
            may_start: Whether an owner is started for that if the map has none.
        """
        self.is_watched, self.may_start = is_watched, is_watched and may_start
        self._used_s = self._context.clock()
        self._say(["watch" if is_watched else "unwatch"])
        self._wake.set()

    @property
    def is_in_use(self) -> bool:
        """Whether it may need an owner: it is not only watched by those who may start none."""
        return self._was_asked or self.may_start

    async def close(self) -> None:
        """Close the connection; what is waited for ends with Busy."""
        self._is_closed = True  # a wait that ends as it is cancelled may ignore that (Python < 3.12)
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        self._refuse_all(lambda _: self._no_owner("the server ends"))

    # --- the owner ------------------------------------------------------------------------------------

    async def _run(self) -> None:
        try:
            while self._is_needed():
                try:
                    self._lease.note(await self._context.call(self._read_lease))
                    await self._advance()
                except StoreError as error:
                    self._tell_state("waiting for the store")
                    self._context.log.warning("live-link-store", map=self.map_name, error=error.message)
                    await self._pause(_POLL_S)
        finally:
            self._on_end(self)

    async def _advance(self) -> None:
        """Do what the lease asks for: connect, take the map over, or wait."""
        record, lease_s = self._lease.record, self._context.settings.lease_s
        if record is None or record.state == "stopped":
            self._refuse_what_needs_a_map(is_stopped=record is not None)
            if not any(each.begins for each in self._pending.values()):
                if self._context.settings.warm_standby:
                    self._prepare()  # robots join seconds before they drive
                await self._pause(_WATCH_POLL_S)
                return
        is_dead = record is not None and record.epoch == self._dead_epoch
        unchanged_s = max(lease_s, self._lease.unchanged_s) if is_dead else self._lease.unchanged_s
        verdict = verdict_on(record, unchanged_s=unchanged_s, lease_s=lease_s)
        if verdict == "claim" and not self._may_start:
            self._tell_state("idle")
            await self._pause(_WATCH_POLL_S)  # nobody who may start an owner needs one
        elif verdict == "claim":
            await self._take_over()
        elif verdict == "connect" and record is not None:
            if await self._use(record):
                await asyncio.sleep(_RETRY_S)
            elif record.epoch != self._dead_epoch:
                self._prepare()
                await self._pause(_POLL_S)
        else:
            self._tell_state("moving")
            await self._pause(_POLL_S)

    async def _take_over(self) -> None:
        """Let a process of this worker claim the map, unless another process is first."""
        children, only_watched = self._context.children, not self._pending
        spare = children.prepare()
        if spare is not None and not spare.is_ready:
            await spare.wait_ready(_POLL_S)
            return  # the lease is read again: meanwhile another process may serve the map
        child = children.take(self.tenant, self._note_end, only_watched=only_watched)
        if child is None and only_watched:
            self._tell_state("idle")
            await self._pause(_WATCH_POLL_S)  # when no other map needs a process, it is served again
            return
        self._tell_state("moving")
        if child is None:
            if not children.is_making_room:
                self._refuse_all(lambda _: self._no_owner("this server takes no further live map"))
            await self._pause(_POLL_S)
            return
        order = OwnerOrder(
            tenant=self.tenant,
            map_name=self.map_name,
            server=self._context.server_id,
            known=self._lease.known,
        )
        self.child = child
        silent_s, began_s = self._lease.unchanged_s, self._context.clock()
        has_won = await child.claim(order)
        self._context.log.info(
            "live-map-claimed", map=self.map_name, tenant=self.tenant, has_won=has_won,
            silent_s=round(silent_s, 3), seconds=round(self._context.clock() - began_s, 3),
        )  # fmt: skip
        if not has_won:
            child.kill()

    def _note_end(self, child: OwnerChild, code: int) -> None:
        """A process of this worker has ended: if it owned the map, nobody does."""
        if child.epoch is not None:
            self._dead_epoch = child.epoch
            self._context.log.info("live-owner-ended", map=self.map_name, epoch=child.epoch, code=code)
        if self.child is child:
            self.child = None
        self._wake.set()

    # --- the connection -------------------------------------------------------------------------------

    async def _use(self, record: LeaseRecord) -> bool:
        """Connect to the owner and pass on requests until the connection or the lease ends.

        Returns:
            Whether there was a connection.
        """
        opened = await self._open(record)
        if opened is None:
            return False
        reader, writer, frames = opened
        self._writer = writer
        try:
            for number, pending in self._pending.items():
                self._send(number, pending)
            if self.is_watched:
                self._say(["watch"])
            await self._listen(record, reader, frames)
        finally:
            self._writer = None
            writer.close()
        return True

    async def _open(
        self, record: LeaseRecord
    ) -> tuple[asyncio.StreamReader, asyncio.StreamWriter, FrameReader] | None:
        try:
            reader, writer = await asyncio.wait_for(
                asyncio.open_connection(record.address, record.port, ssl=client_context()), _CONNECT_S
            )
        except (OSError, asyncio.TimeoutError) as error:
            if isinstance(error, ConnectionRefusedError) and self._welcomed == record.owner:
                self._dead_epoch = record.epoch  # its port was open before: the process is gone
            return None
        is_welcome = False
        try:
            check_certificate(writer.get_extra_info("ssl_object"), record.certificate)
            claims = LinkClaims(
                tenant=self.tenant, map_name=self.map_name, epoch=record.epoch,
                certificate=record.certificate, expires_s=self._context.wall_clock() + TOKEN_S,
            )  # fmt: skip
            key = await self._context.call(self._context.key)
            writer.write(encode_message(["hello", make_token(key, claims)]))
            frames = FrameReader(MAX_LINK_BYTES)
            welcome = await asyncio.wait_for(_next_messages(reader, frames), _CONNECT_S)
            is_welcome = welcome[0] == ["welcome"]
            if is_welcome:
                self._welcomed = record.owner
                for message in welcome[1:]:
                    self._take(message)
                return reader, writer, frames
            self._context.log.warning("live-link-refused", map=self.map_name, why=str(welcome[0])[:200])
        except (OSError, asyncio.TimeoutError, Unauthorized) as error:
            self._context.log.warning("live-link-failed", map=self.map_name, why=str(error)[:200])
        finally:
            if not is_welcome:  # also if the task is cancelled, or the key cannot be read
                writer.close()
        return None

    async def _listen(self, record: LeaseRecord, reader: asyncio.StreamReader, frames: FrameReader) -> None:
        """Take messages until the owner is gone, moves the map, or another one has it."""
        lease_s = self._context.settings.lease_s
        reading: asyncio.Task[bytes] | None = None
        try:
            while self._is_needed():
                reading = reading or asyncio.ensure_future(reader.read(_READ_BYTES))
                silent_s = self._lease.unchanged_s
                await asyncio.wait({reading}, timeout=max(_POLL_S, _PREPARE_SHARE * lease_s - silent_s))
                if reading.done():
                    with contextlib.suppress(OSError):
                        data = reading.result()
                        reading = None
                        goes_on = bool(data)
                        for message in frames.feed(data):
                            goes_on &= self._take(message)
                        if goes_on:
                            continue
                    return
                if self._lease.unchanged_s >= _PREPARE_SHARE * lease_s:
                    self._prepare()
                    if await self._is_given_up(record):
                        return
        finally:
            if reading is not None:
                reading.cancel()

    async def _is_given_up(self, record: LeaseRecord) -> bool:
        """Whether the owner, which is silent, is the owner no more, or may be replaced.

        While the store fails it stays the owner: nobody can replace it.
        """
        try:
            self._lease.note(await self._context.call(self._read_lease))
        except StoreError:
            self._tell_state("waiting for the store")
            return False
        now = self._lease.record
        if now is None or now.owner != record.owner or now.state != record.state:
            return True
        return self._lease.unchanged_s >= self._context.settings.lease_s

    def _take(self, message: list[Any]) -> bool:
        """Take a message of the owner; return False if it gives the map up."""
        match message:
            case ["answer", int(number), dict(reply)]:
                pending = self._pending.get(number)
                if pending is not None and not pending.future.done():
                    pending.future.set_result(reply)
            case ["refused", int(number), str(code), str(text), str(hint), retry_after_ms]:
                pending = self._pending.get(number)
                if pending is not None and not pending.future.done():
                    error = error_from_code(code, text, hint=hint, retry_after_ms=retry_after_ms)
                    pending.future.set_exception(error)
            case ["again", int()]:
                return False
            case ["update", dict(payload)]:
                if payload.get("kind") == "map":
                    self._newest_map = payload
                if self.is_watched:
                    self._on_update(payload)
            case ["beat", int(beat)]:
                self._lease.note_beat(beat)
            case ["moving"]:
                return False
        return True

    def _send(self, number: int, pending: _Pending) -> None:
        request = msgspec.msgpack.encode(pending.request)
        self._say(["request", number, list(pending.robot), pending.operation, request])

    def _say(self, message: list[Any]) -> None:
        if self._writer is not None:
            self._writer.write(encode_message(message))

    # --- what is not passed on ------------------------------------------------------------------------

    def _refuse_what_needs_a_map(self, *, is_stopped: bool) -> None:
        for pending in self._pending.values():
            if pending.future.done() or pending.begins:
                continue
            if pending.operation == SHOW:
                pending.future.set_result(show_missing(pending.robot))
            elif is_stopped:
                stopped = f"the live map {self.map_name!r} was stopped"
                pending.future.set_exception(
                    Conflict(stopped, hint="begin it again with keyframe 0 of segment 0")
                )
            else:
                missing = f"there is no live map {self.map_name!r}"
                pending.future.set_exception(NotFound(missing, hint="see rse-pf map live list"))

    def _refuse_all(self, error: Callable[[_Pending], RsePfError]) -> None:
        for pending in self._pending.values():
            if not pending.future.done():
                pending.future.set_exception(error(pending))

    def _no_owner(self, why: str) -> Busy:
        return Busy(
            f"the live map {self.map_name!r} has no owner now: {why}",
            hint="try again", retry_after_ms=_BUSY_RETRY_MS,
        )  # fmt: skip

    def _tell_state(self, state: str) -> None:
        """Tell the robots of this worker what they wait for, while there is no owner to tell it."""
        if self.is_watched and self._newest_map.get("state") != state:
            self._newest_map = {**(self._newest_map or _NO_MAP), "state": state}
            self._on_update(self._newest_map)

    @property
    def _may_start(self) -> bool:
        """Whether somebody needs an owner, and not only its updates if there is one."""
        return bool(self._pending) or self.may_start

    def _prepare(self) -> None:
        """Start a process, so that it is ready in time, unless nobody may start an owner."""
        if self._may_start:
            self._context.children.prepare()

    def _is_needed(self) -> bool:
        if self._is_closed:
            return False
        if self._pending or self.is_watched:
            return True
        return self._context.clock() - self._used_s < _LINGER_S

    def _read_lease(self) -> bytes | None:
        return read_record(self._context.store, self._lease.name)

    async def _pause(self, seconds: float) -> None:
        """Wait, but not longer than until something is asked for."""
        self._wake.clear()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._wake.wait(), seconds)


def begins_a_map(request: LiveRequest) -> bool:
    """Return whether a request may begin a map that does not exist, or was stopped.

    A robot's first keyframe does; its later ones belong to the map that was stopped.
    """
    if isinstance(request, KeyframeRequest):
        return request.number == 0 and request.segment == 0
    return isinstance(request, LiveStart)


async def _next_messages(reader: asyncio.StreamReader, frames: FrameReader) -> list[Any]:
    """Return the next messages, one at least; raises OSError at the end."""
    while True:
        data = await reader.read(_READ_BYTES)
        if not data:
            raise ConnectionResetError
        messages = list(frames.feed(data))
        if messages:
            return messages


class OwnerLinks:
    """The connections of one worker to the owners of the maps that its robots use.

    All methods are called in the event loop.
    """

    def __init__(
        self,
        *,
        store: ObjectStore,
        settings: PlatformSettings,
        server_id: str,
        log: JsonLog,
        on_update: Callable[[str, str, dict[str, Any]], None],
        kind: str = MAP_KIND,
    ) -> None:
        """Connect to nobody yet.

        Args:
            store: Shared by all servers.
            settings: Of the platform.
            server_id: Of this server.
            log: Of the worker.
            on_update: Called with tenant, map and payload of each update of a watched map.
            kind: The logic of the maps, as ``module:name`` of a `MapKind`.
        """
        self._store = store
        self._settings = settings
        self._on_update = on_update
        self._links: dict[tuple[str, str], MapLink] = {}
        self._key: bytes | None = None
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="live-link")
        self._children = OwnerChildren(
            lambda calmly: start_owner(settings, kind, calmly=calmly),
            max_owners=settings.live.max_owners,
            keeps_spare=settings.live.warm_standby,
        )
        self._context = LinkContext(
            store=store,
            settings=settings.live,
            server_id=server_id,
            log=log,
            call=lambda act: asyncio.get_running_loop().run_in_executor(self._threads, act),
            key=self._internal_key,
            children=self._children,
            clock=time.monotonic,
            wall_clock=time.time,
        )

    async def request(
        self,
        tenant: str,
        map_name: str,
        robot: RobotId,
        operation: str,
        request: LiveRequest,
        deadline_s: float,
    ) -> dict[str, Any]:
        """Return the answer of the map's owner to a command.

        Args:
            tenant: Of the robot.
            map_name: Of the live map.
            robot: Who asks.
            operation: The service, such as ``live-keyframe``.
            request: Of the command; the owner checks it.
            deadline_s: Seconds from now on.

        Raises:
            Busy: The map has no owner in time; ``retry_after_ms`` says when to ask again.
            RsePfError: What the owner refused: Conflict, BadRequest, NotFound, Forbidden.
        """
        link = self._link(tenant, map_name)
        self._children.use(is_used=True)
        return await link.request(robot, operation, request, deadline_s)

    async def list_maps(self, tenant: str) -> list[dict[str, Any]]:
        """Return name, state, owner and server of each live map of *tenant*, from the store alone."""
        listed: list[dict[str, Any]] = await self._context.call(lambda: self._list(tenant))
        return listed

    def watch(self, tenant: str, map_name: str, *, may_start: bool = True) -> None:
        """Ask for the updates of a map; the present state comes first, and again from each new owner.

        Args:
            tenant: Whose map.
            map_name: Its name.
            may_start: Whether an owner is started for that if the map has none.
        """
        self._link(tenant, map_name).set_watched(True, may_start=may_start)
        self._keep_spare()

    def unwatch(self, tenant: str, map_name: str) -> None:
        """Ask for no more updates of a map."""
        link = self._links.get((tenant, map_name))
        if link is not None:
            link.set_watched(False)
            self._keep_spare()

    def give_up(self) -> None:
        """Let the owners that this worker started release their leases: the server drains."""
        self._children.release()

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return the processor time of the owners that this worker started, by tenant."""
        return self._children.cpu_by_tenant()

    @property
    def children(self) -> list[OwnerChild]:
        """The owner processes that this worker has started and that claim or serve a map."""
        return self._children.used

    async def close(self) -> None:
        """Release the leases of the owners that this worker started, and close all connections."""
        self.give_up()
        children = [child.ended for child in self._children.used]
        if children:
            await asyncio.wait(children, timeout=_RELEASE_S)
        for link in list(self._links.values()):
            await link.close()
        self._threads.shutdown(wait=False)

    def _link(self, tenant: str, map_name: str) -> MapLink:
        """Return the link of a map; raises BadRequest."""
        if self._settings.data.store == "memory:":
            raise BadRequest("live maps need a store that all servers share", hint="set data.store")
        link = self._links.get((tenant, map_name))
        if link is None:
            link = self._links[tenant, map_name] = MapLink(
                self._context, tenant, map_name,
                on_update=lambda payload: self._on_update(tenant, map_name, payload), on_end=self._forget,
            ).start()  # fmt: skip
        return link

    def _keep_spare(self) -> None:
        """Keep a process ready while some map may need it."""
        self._children.use(is_used=any(link.is_in_use for link in self._links.values()))

    def _forget(self, link: MapLink) -> None:
        self._links.pop((link.tenant, link.map_name), None)
        self._keep_spare()

    def _internal_key(self) -> bytes:
        if self._key is None:
            self._key = internal_key(self._store)
        return self._key

    def _list(self, tenant: str) -> list[dict[str, Any]]:
        found = []
        for name in self._store.folders(tenant_folder(tenant)):
            lease = Lease(self._store, lease_name(tenant, name), decode_lease, self._context.clock)
            record = lease.read()
            if record is None:
                continue
            found.append(
                {"name": name, "state": _STATES[record.state], "owner": record.owner, "server": record.server}
            )
        return found
