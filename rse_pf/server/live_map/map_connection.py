"""Connect one worker to the map server of one live map; start or replace the map server if necessary.

A worker finds the map server of a map by the lease of the map in the object store.  If there is no map
server, or it has failed, the worker lets a process of its own claim the map.  A connection is kept while
requests wait or robots subscribe, and for 10 s longer.  Requests without a reply are sent again after a
reconnection: an operation of a live map has the same effect if it is repeated.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.config import LiveSettings
from rse_pf.errors import (
    Busy,
    Conflict,
    NotFound,
    StoreError,
    Unauthorized,
    error_from_code,
)
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import FrameReader, encode_message
from rse_pf.server.live_map.connection_security import (
    MAX_MESSAGE_BYTES,
    TOKEN_S,
    ConnectionClaims,
    check_certificate,
    client_context,
    make_token,
)
from rse_pf.server.live_map.lease import (
    LeaseRecord,
    decode_lease,
    lease_name,
    next_action,
)
from rse_pf.server.live_map.process_pool import (
    ClaimOrder,
    MapServerPool,
    MapServerProcess,
)
from rse_pf.server.log import JsonLog
from rse_pf.storage.lease import Lease, read_record
from rse_pf.storage.object_store import ObjectStore
from rse_pf.wire.live_map import SHOW, KeyframeRequest, LiveRequest, LiveStart

__all__ = ["ConnectionContext", "MapConnection", "can_begin_map"]

_READ_BYTES = 1 << 18  # largest number of bytes that one read of a socket returns
_CONNECT_TIMEOUT_S = 1.0
"""Seconds within which a map server must accept a connection, and then as many to answer the hello; else the
connection counts as failed, and the worker reads the lease again."""
_POLL_S = 0.1
"""Seconds between two reads of the lease while the map has no connected map server but needs one, while the
store fails, or while the connected map server has not renewed its lease for `_PREPARE_SHARE` times
``live.lease_s``."""
_RECONNECT_S = 0.02
"""Seconds after the end of a connection until the lease is read again: a map server that gives the map up
refuses requests first, and releases its lease a moment later."""
_IDLE_POLL_S = 1.0
"""Seconds between two reads of the lease of a map that has no map server and needs none."""
_LINGER_S = 10.0
"""Seconds for which a worker keeps its connection to a map server after the last request or subscriber."""
_PREPARE_SHARE = 0.66
"""Fraction of ``live.lease_s``: a map server that has not renewed its lease for this long lets the worker
start a spare process, so that the spare has imported its modules when the lease expires."""
_BUSY_RETRY_MS = 500.0
"""Milliseconds after which a robot sends a request again that no map server answered in time."""
_EMPTY_MAP_UPDATE = {"kind": "map", "keyframes": 0, "version": 0, "owner": ""}
"""Fields of the update ``map``, without its state, that subscribers get before the first one of a map server.
The field ``owner`` is the id of the backend server on which the map server runs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionContext:
    """The values that all map connections of a worker share.

    Attributes:
        store: Object store that all servers share.
        settings: Section ``live`` of the settings.
        server_id: Id of this backend server.
        log: Log of the worker.
        call: Runs a blocking function in one of the worker's threads for the object store.
        key: Returns the key that signs tokens between servers; blocks on the store.
        pool: Map-server processes of this worker.
        clock: Returns monotonic time in seconds.
        wall_clock: Returns Unix time in seconds.
    """

    store: ObjectStore
    settings: LiveSettings
    server_id: str
    log: JsonLog
    call: Callable[[Callable[[], Any]], Awaitable[Any]]
    key: Callable[[], bytes]
    pool: MapServerPool
    clock: Callable[[], float]
    wall_clock: Callable[[], float]


@dataclass(slots=True, eq=False)
class _PendingRequest:
    """A request that waits for a reply of the map server; the reply or the error is set on ``future``."""

    robot: RobotId
    operation: str
    request: LiveRequest
    future: asyncio.Future[dict[str, Any]]

    def refuse(self, error: Exception) -> None:
        """Let the request fail with *error*, unless it has a reply or has failed already."""
        if not self.future.done():
            self.future.set_exception(error)


class MapConnection:
    """The connection of one worker to the map server of one live map; methods run in the event loop."""

    def __init__(
        self,
        context: ConnectionContext,
        tenant: str,
        map_name: str,
        *,
        on_update: Callable[[dict[str, Any]], None],
        on_end: Callable[[MapConnection], None],
    ) -> None:
        """Describe the connection; `start` begins to look for the map server.

        Args:
            context: Values shared by all connections of the worker.
            tenant: Tenant of the map.
            map_name: Name of the map.
            on_update: Called with the payload of each update while the map is watched.
            on_end: Called with this object when it is closed, or when nobody has used the map for 10 s; the
                object cannot be used afterwards.

        Raises:
            BadRequest: The name of the map is not valid.
        """
        self.tenant, self.map_name = tenant, map_name
        self.is_watched = False
        """Whether robots of this worker subscribe to the map."""
        self.may_start = False
        """Whether the subscribers may start a map server if the map has none; requests always may."""
        self._context = context
        self._on_update = on_update
        self._on_end = on_end
        self._lease = Lease(context.store, lease_name(tenant, map_name), decode_lease, context.clock)
        self._request_numbers = itertools.count(1)
        self._pending: dict[int, _PendingRequest] = {}
        self._writer: asyncio.StreamWriter | None = None
        # Epoch of the last map server of this map whose process is known to have exited.
        self._dead_epoch: int | None = None
        # Name of the last map server that accepted the token of this worker.
        self._reached_owner = ""
        self._newest_map_update: dict[str, Any] = {}  # last payload of the kind map, received or made here
        self._last_use_s = context.clock()
        self._is_closed = False
        self._had_requests = False
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None]

    def start(self) -> MapConnection:
        """Begin to look for the map server, and return this object."""
        self._task = asyncio.get_running_loop().create_task(self._run())
        return self

    async def request(
        self, robot: RobotId, operation: str, request: LiveRequest, deadline_s: float
    ) -> dict[str, Any]:
        """Send a request to the map server and return its reply.

        Until the reply arrives, the request is sent again over each new connection.

        Args:
            robot: Robot that asks.
            operation: Name of the service, such as ``live-keyframe``.
            request: The request.
            deadline_s: Seconds from now on within which the reply must arrive.

        Raises:
            Busy: There was no reply within *deadline_s*, or no map server can be started.
            NotFound, Conflict: The map does not exist, or was stopped, and the request does not begin it.
            RsePfError: The map server refused the request.
        """
        number = next(self._request_numbers)
        self._had_requests = True
        pending = _PendingRequest(robot, operation, request, asyncio.get_running_loop().create_future())
        self._pending[number] = pending
        self._send_request(number, pending)
        self._wake.set()
        try:
            return await asyncio.wait_for(pending.future, deadline_s)
        except asyncio.TimeoutError:
            raise Busy(
                f"the live map {self.map_name!r} did not answer within {deadline_s:.1f} s",
                hint="try again; if this happens repeatedly, look at the servers' logs and the store",
                retry_after_ms=_BUSY_RETRY_MS,
            ) from None
        finally:
            del self._pending[number]
            self._last_use_s = self._context.clock()

    def set_watched(self, is_watched: bool, *, may_start: bool = True) -> None:
        """Set whether *on_update* is called with the updates of the map.

        Args:
            is_watched: Whether updates are wanted.
            may_start: Whether a map server is started for the updates if the map has none; not used if no
                updates are wanted.
        """
        self.is_watched, self.may_start = is_watched, is_watched and may_start
        self._last_use_s = self._context.clock()
        self._send(["watch" if is_watched else "unwatch"])
        self._wake.set()

    @property
    def may_need_process(self) -> bool:
        """Whether the map may soon need a map server of this worker.

        This is so if this object ever had a request, or if a subscriber may start a map server.
        """
        return self._had_requests or self.may_start

    async def close(self) -> None:
        """Close the connection; requests without a reply fail with Busy."""
        # The flag ends the task even if `asyncio.wait_for` swallows the cancellation (Python before 3.12).
        self._is_closed = True
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        self._refuse_all("this server is shutting down")

    # --- Finding the map server of the map, or starting one ---

    async def _run(self) -> None:
        try:
            while self._is_needed():
                try:
                    self._lease.note(await self._context.call(self._read_lease))
                    await self._advance()
                except StoreError as error:
                    self._send_state("waiting for the store")
                    self._context.log.warning("live-link-store", map=self.map_name, error=error.message)
                    await self._pause(_POLL_S)
        finally:
            self._on_end(self)

    async def _advance(self) -> None:
        """Connect to the map server, claim the map, or wait, as the lease, which was just read, demands.

        Returns after one such step; after a connection, when it has ended.
        """
        record, lease_s = self._lease.record, self._context.settings.lease_s
        # 1. If the map does not exist or was stopped, answer all requests but those that begin the map; if no
        # request begins the map, wait.
        if record is None or record.state == "stopped":
            self._refuse_requests_without_map(is_stopped=record is not None)
            if not any(can_begin_map(pending.request) for pending in self._pending.values()):
                if self._context.settings.warm_standby:
                    self._prepare_spare()  # a robot that subscribes usually sends its first keyframe soon
                await self._pause(_IDLE_POLL_S)
                return
        # 2. Decide the next step.  If the process of the map server has certainly exited, its lease counts as
        # expired.
        unchanged_s = self._lease.unchanged_s
        if record is not None and record.epoch == self._dead_epoch:
            unchanged_s = max(lease_s, unchanged_s)
        action = next_action(record, unchanged_s=unchanged_s, lease_s=lease_s)
        # 3. Claim a map without a map server, unless there are only subscribers that may start none.
        if action == "claim" and not self._needs_map_server:
            self._send_state("idle")
            await self._pause(_IDLE_POLL_S)
        elif action == "claim":
            await self._claim_map()
        # 4. Use a map server that accepts connections until its connection or its lease ends; if it cannot be
        # reached, start a spare process and wait.
        elif action == "connect" and record is not None:
            if await self._use_map_server(record):
                await asyncio.sleep(_RECONNECT_S)
            elif record.epoch != self._dead_epoch:
                self._prepare_spare()
                await self._pause(_POLL_S)
        # 5. Otherwise wait until a starting map server accepts connections, or a failed one may be replaced.
        else:
            self._send_state("moving")
            await self._pause(_POLL_S)

    async def _claim_map(self) -> None:
        """Let a map-server process of this worker claim the map, unless another process claims it first.

        If no process is ready or free, wait for a moment and return; the caller then reads the lease again.
        """
        pool, is_watched_only = self._context.pool, not self._pending
        # 1. Wait until the spare process is ready.  While it imports, another process may claim the map, so
        # the lease is read again before the next try.
        spare = pool.prepare_spare()
        if spare is not None and not spare.is_ready:
            await spare.wait_ready(_POLL_S)
            return
        process = pool.take(self.tenant, self._on_process_exit, is_watched_only=is_watched_only)
        # 2. If no process is free, wait.  A map with subscribers only tries again after a second; requests
        # wait if another map is giving its process up, and are refused otherwise.
        if process is None and is_watched_only:
            self._send_state("idle")
            await self._pause(_IDLE_POLL_S)
            return
        self._send_state("moving")
        if process is None:
            if not pool.is_freeing_process:
                self._refuse_all("all map-server processes of this server are in use, or the server drains")
            await self._pause(_POLL_S)
            return
        # 3. Let the process claim the lease, which fails if the lease has changed since this worker read it.
        order = ClaimOrder(
            tenant=self.tenant,
            map_name=self.map_name,
            server=self._context.server_id,
            known=self._lease.known,
        )
        silent_s, began_s = self._lease.unchanged_s, self._context.clock()
        has_won = await process.claim(order)
        self._context.log.info(
            "live-map-claimed",
            map=self.map_name,
            tenant=self.tenant,
            has_won=has_won,
            silent_s=round(silent_s, 3),
            seconds=round(self._context.clock() - began_s, 3),
        )
        if not has_won:
            process.kill()

    def _on_process_exit(self, process: MapServerProcess, exit_code: int) -> None:
        """Note that a process that was taken for this map has exited.

        If it served the map, the map can be claimed at once, although its lease has not expired.
        """
        if process.epoch is not None:
            self._dead_epoch = process.epoch
            self._context.log.info("live-owner-ended", map=self.map_name, epoch=process.epoch, code=exit_code)
        self._wake.set()

    # --- Messages between this worker and the map server ---

    async def _use_map_server(self, record: LeaseRecord) -> bool:
        """Connect to the map server and pass requests on until the connection or its lease ends.

        All requests without a reply are sent first.

        Returns:
            False if no connection could be opened; True after the end of the connection.
        """
        connection = await self._connect(record)
        if connection is None:
            return False
        reader, writer, frames = connection
        self._writer = writer
        try:
            for number, pending in self._pending.items():
                self._send_request(number, pending)
            if self.is_watched:
                self._send(["watch"])
            await self._receive(record, reader, frames)
        finally:
            self._writer = None
            writer.close()
        return True

    async def _connect(
        self, record: LeaseRecord
    ) -> tuple[asyncio.StreamReader, asyncio.StreamWriter, FrameReader] | None:
        """Open an authenticated connection to the map server; return None if that fails.

        A failure after the handshake of TLS is logged.  Messages that come with the welcome are handled here.
        """
        # 1. Connect by TCP and TLS.  A refused connection proves that the process has exited only if this
        # worker has reached its port before: a firewall may refuse what other servers can reach.
        try:
            reader, writer = await asyncio.wait_for(
                asyncio.open_connection(record.address, record.port, ssl=client_context()),
                _CONNECT_TIMEOUT_S,
            )
        except (OSError, asyncio.TimeoutError) as error:
            if isinstance(error, ConnectionRefusedError) and self._reached_owner == record.owner:
                self._dead_epoch = record.epoch
            return None
        is_welcome = False
        try:
            # 2. Check the certificate of the map server.
            check_certificate(writer.get_extra_info("ssl_object"), record.certificate)
            # 3. Send a token of this worker.
            claims = ConnectionClaims(
                tenant=self.tenant,
                map_name=self.map_name,
                epoch=record.epoch,
                certificate=record.certificate,
                expires_s=self._context.wall_clock() + TOKEN_S,
            )
            key = await self._context.call(self._context.key)
            writer.write(encode_message(["hello", make_token(key, claims)]))
            # 4. Receive the answer of the map server, and handle messages that came with it.
            frames = FrameReader(MAX_MESSAGE_BYTES)
            messages = await asyncio.wait_for(_read_messages(reader, frames), _CONNECT_TIMEOUT_S)
            is_welcome = messages[0] == ["welcome"]
            if is_welcome:
                self._reached_owner = record.owner
                for message in messages[1:]:
                    self._handle(message)
                return reader, writer, frames
            self._context.log.warning("live-link-refused", map=self.map_name, why=str(messages[0])[:200])
        except (OSError, asyncio.TimeoutError, Unauthorized) as error:
            self._context.log.warning("live-link-failed", map=self.map_name, why=str(error)[:200])
        finally:
            if not is_welcome:  # the connection is closed after every failure, also after a cancellation
                writer.close()
        return None

    async def _receive(self, record: LeaseRecord, reader: asyncio.StreamReader, frames: FrameReader) -> None:
        """Handle messages of the map server until it disconnects, gives the map up, or may be replaced.

        Returns also when the connection is not needed any more.  While the map server is silent, a spare
        process is started, and the lease is read again and again.
        """
        prepare_after_s = _PREPARE_SHARE * self._context.settings.lease_s
        read: asyncio.Task[bytes] | None = None
        try:
            while self._is_needed():
                read = read or asyncio.ensure_future(reader.read(_READ_BYTES))
                silent_s = self._lease.unchanged_s
                await asyncio.wait({read}, timeout=max(_POLL_S, prepare_after_s - silent_s))
                if read.done():
                    with contextlib.suppress(OSError):
                        data = read.result()
                        read = None
                        continues = bool(data)
                        for message in frames.feed(data):
                            continues &= self._handle(message)
                        if continues:
                            continue
                    return
                if self._lease.unchanged_s >= prepare_after_s:
                    self._prepare_spare()
                    if await self._is_replaceable(record):
                        return
        finally:
            if read is not None:
                read.cancel()

    async def _is_replaceable(self, record: LeaseRecord) -> bool:
        """Read the lease; return whether a silent map server has lost or released it, or it has expired.

        While the store fails, the answer is False, because nobody can replace the map server.
        """
        try:
            self._lease.note(await self._context.call(self._read_lease))
        except StoreError:
            self._send_state("waiting for the store")
            return False
        current = self._lease.record
        if current is None or current.owner != record.owner or current.state != record.state:
            return True
        return self._lease.unchanged_s >= self._context.settings.lease_s

    def _handle(self, message: list[Any]) -> bool:
        """Handle a message of the map server; return False if it gives the map up.

        A request that it answers with ``again`` stays pending, and is sent over the next connection.
        """
        match message:
            case ["answer", int(number), dict(reply)]:
                pending = self._pending.get(number)
                if pending is not None and not pending.future.done():
                    pending.future.set_result(reply)
            case ["refused", int(number), str(code), str(text), str(hint), retry_after_ms]:
                pending = self._pending.get(number)
                if pending is not None:
                    pending.refuse(error_from_code(code, text, hint=hint, retry_after_ms=retry_after_ms))
            case ["again", int()]:
                return False
            case ["update", dict(payload)]:
                if payload.get("kind") == "map":
                    self._newest_map_update = payload
                if self.is_watched:
                    self._on_update(payload)
            case ["beat", int(number)]:
                self._lease.note_beat(number)
            case ["moving"]:
                return False
        return True

    def _send_request(self, number: int, pending: _PendingRequest) -> None:
        """Send a request to the map server if it is connected; otherwise do nothing (see `_send`)."""
        request = msgspec.msgpack.encode(pending.request)
        self._send(["request", number, list(pending.robot), pending.operation, request])

    def _send(self, message: list[Any]) -> None:
        """Send *message* over the connection to the map server, if there is one; else drop it.

        `_use_map_server` sends all pending requests when it has opened a connection.
        """
        if self._writer is not None:
            self._writer.write(encode_message(message))

    # --- Answers that this worker gives itself while the map has no map server ---

    def _refuse_requests_without_map(self, *, is_stopped: bool) -> None:
        """Answer the requests to a map that does not exist or was stopped, except those that begin the map.

        ``live-show`` gets a reply without robots; other requests fail with NotFound or Conflict.
        """
        for pending in self._pending.values():
            if pending.future.done() or can_begin_map(pending.request):
                continue
            if pending.operation == SHOW:
                pending.future.set_result(_show_reply_without_map(pending.robot))
            elif is_stopped:
                pending.refuse(
                    Conflict(
                        f"the live map {self.map_name!r} was stopped",
                        hint="begin it again with keyframe 0 of segment 0",
                    )
                )
            else:
                pending.refuse(
                    NotFound(
                        f"there is no live map {self.map_name!r}",
                        hint="begin it with keyframe 0 of segment 0; see rse-pf map live list",
                    )
                )

    def _refuse_all(self, reason: str) -> None:
        """Let all requests to this map that have no reply fail with Busy; *reason* is part of the message."""
        for pending in self._pending.values():
            pending.refuse(
                Busy(
                    f"the live map {self.map_name!r} has no map server now: {reason}",
                    hint="try again",
                    retry_after_ms=_BUSY_RETRY_MS,
                )
            )

    def _send_state(self, state: str) -> None:
        """Send the subscribers of this worker the update ``map`` with *state*, if the state has changed.

        Its other fields are those of the last update ``map``.
        """
        if self.is_watched and self._newest_map_update.get("state") != state:
            self._newest_map_update = {**(self._newest_map_update or _EMPTY_MAP_UPDATE), "state": state}
            self._on_update(self._newest_map_update)

    @property
    def _needs_map_server(self) -> bool:
        """Whether a request waits for the map, or a subscriber for whom a map server may be started."""
        return bool(self._pending) or self.may_start

    def _prepare_spare(self) -> None:
        """Start a spare map-server process, if the map needs a map server and there is no spare."""
        if self._needs_map_server:
            self._context.pool.prepare_spare()

    def _is_needed(self) -> bool:
        """Return whether the map has requests or subscribers, or had some within the last 10 s."""
        if self._is_closed:
            return False
        if self._pending or self.is_watched:
            return True
        return self._context.clock() - self._last_use_s < _LINGER_S

    def _read_lease(self) -> bytes | None:
        return read_record(self._context.store, self._lease.name)

    async def _pause(self, seconds: float) -> None:
        """Wait for *seconds*, or until a request or subscriber arrives or a process of this map exits."""
        self._wake.clear()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._wake.wait(), seconds)


def can_begin_map(request: LiveRequest) -> bool:
    """Return whether a request begins a live map that does not exist or was stopped.

    The first keyframe of a robot (number 0 of segment 0) and ``live-start`` do.  Later keyframes belong to
    the map that was stopped.
    """
    if isinstance(request, KeyframeRequest):
        return request.number == 0 and request.segment == 0
    return isinstance(request, LiveStart)


def _show_reply_without_map(robot: RobotId) -> dict[str, Any]:
    """Return the reply of ``live-show`` to *robot* about a map that does not exist or was stopped.

    Its field ``state`` is ``none``.
    """
    return {
        "keyframes": 0,
        "robots": [],
        "owner": "",
        "server": "",
        "epoch": 0,
        "version": 0,
        "links": 0,
        "state": "none",
        "you": {"robot": robot.name, "number": 0, "segment": 0},
    }


async def _read_messages(reader: asyncio.StreamReader, frames: FrameReader) -> list[Any]:
    """Return the next messages of the map server, at least one.

    Raises:
        ConnectionResetError: The map server has disconnected.
    """
    while True:
        data = await reader.read(_READ_BYTES)
        if not data:
            raise ConnectionResetError
        messages = list(frames.feed(data))
        if messages:
            return messages
