"""How a worker finds, starts and replaces the map server of a map, with fake processes."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import Busy, NotFound
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import encode_message
from rse_pf.server.live_map.connection_security import server_context
from rse_pf.server.live_map.lease import LeaseRecord, MapLease, decode_lease, lease_name
from rse_pf.server.live_map.map_connection import ConnectionContext, MapConnection, can_begin_map
from rse_pf.server.live_map.process_pool import ClaimOrder, MapServerPool, MapServerProcess
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire.live_map import KeyframeRequest, LiveMapRequest, LiveStart
from tests.kit.fake_map import keyframe_request
from tests.kit.fakes import FakeLog

LEASE = lease_name("default", "warehouse")
FIRST = KeyframeRequest(map="warehouse", segment=0, number=0, keyframe=b"")
ROBOT = RobotId("default", "robot-1")


class FakeProcess:
    """A fake process that sends what the test wants, and claims a map as a real one does."""

    def __init__(self, store: MemoryStore) -> None:
        self.connection, self._theirs = socket.socketpair()
        self.pid = 1
        self.claims = 0
        self._store = store

    def tell(self, *message: Any) -> None:
        self._theirs.sendall(encode_message(list(message)))

    def say(self, message: dict[str, Any]) -> None:
        if "do" in message:
            return
        self.claims += 1
        order = ClaimOrder(**message)
        lease = MapLease(
            self._store,
            LEASE,
            owner=f"owner-{id(self)}",
            server=order.server,
            clock=time.monotonic,
        )
        if lease.claim(order.known) and lease.serve("127.0.0.1", 1, "c"):
            self.tell("serving", lease.record.epoch)
        else:
            self.tell("lost")

    def kill(self) -> int:
        self.connection.close()
        self._theirs.close()
        return 0


class ConnectedWorker:
    """One worker with its connection to one map."""

    def __init__(self) -> None:
        self.store = MemoryStore()
        self.started: list[FakeProcess] = []
        self.updates: list[dict[str, Any]] = []
        self.pool = MapServerPool(self._spawn, max_processes=2, keeps_spare=False)
        context = ConnectionContext(
            store=self.store,
            settings=PlatformSettings().live,
            server_id="here",
            log=FakeLog(),
            call=self._call,
            key=lambda: b"k" * 32,
            pool=self.pool,
            clock=time.monotonic,
            wall_clock=time.time,
        )
        self.map = MapConnection(
            context, "default", "warehouse", on_update=self.updates.append, on_end=lambda connection: None
        ).start()

    def lease(self) -> LeaseRecord | None:
        with contextlib.suppress(NotFound):
            return decode_lease(LEASE, self.store.get(LEASE))
        return None

    async def __aenter__(self) -> ConnectedWorker:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.map.close()
        self.pool.kill_spare()
        for child in self.pool.in_use:
            child.kill()

    def _spawn(self, at_low_priority: bool) -> FakeProcess:
        self.started.append(FakeProcess(self.store))
        return self.started[-1]

    async def _call(self, act: Callable[[], Any]) -> Any:
        return act()


async def until(is_so: Callable[[], Any]) -> None:
    while not is_so():
        await asyncio.sleep(0)


async def test_a_process_is_started_as_soon_as_a_map_that_nobody_has_begun_is_watched() -> None:
    async with ConnectedWorker() as worker:
        worker.map.set_watched(True)
        await until(lambda: worker.started)
        worker.started[0].tell("ready")
        spare = worker.pool.prepare_spare()
        assert isinstance(spare, MapServerProcess)
        await until(lambda: spare.is_ready)
        assert worker.lease() is None  # the first keyframe begins the map

        sent = asyncio.ensure_future(worker.map.request(ROBOT, "live-keyframe", FIRST, 5.0))
        await until(lambda: (lease := worker.lease()) is not None and lease.state == "serving")
        assert len(worker.started) == 1
        sent.cancel()


def owner_on_a_closed_port(worker: ConnectedWorker) -> None:
    """Write a lease of another server with a port at which nobody listens."""
    elsewhere = MapLease(worker.store, LEASE, owner="b", server="there", clock=time.monotonic)
    assert elsewhere.claim(None)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    assert elsewhere.serve("127.0.0.1", port, "c")


async def test_a_map_server_whose_port_is_closed_is_replaced_at_once_by_workers_that_were_connected() -> None:
    async with ConnectedWorker() as worker:
        owner_on_a_closed_port(worker)
        worker.map._reached_owner = "b"
        began_s = time.monotonic()
        sent = asyncio.ensure_future(worker.map.request(ROBOT, "live-keyframe", FIRST, 5.0))
        await until(lambda: worker.started)
        worker.started[0].tell("ready")
        await until(lambda: (lease := worker.lease()) is not None and lease.epoch == 2)
        assert time.monotonic() - began_s < PlatformSettings().live.lease_s
        sent.cancel()


async def test_a_connection_that_is_closed_before_its_welcome_closes_its_socket() -> None:
    async with ConnectedWorker() as worker:
        is_greeted, is_gone = asyncio.Event(), asyncio.Event()

        async def owner(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read(1)
            is_greeted.set()
            while await reader.read(1024):
                pass
            is_gone.set()
            writer.close()

        context, certificate = server_context("127.0.0.1", now_s=time.time())
        server = await asyncio.start_server(owner, "127.0.0.1", 0, ssl=context)
        elsewhere = MapLease(worker.store, LEASE, owner="b", server="there", clock=time.monotonic)
        assert elsewhere.claim(None)
        assert elsewhere.serve("127.0.0.1", server.sockets[0].getsockname()[1], certificate)
        worker.map.set_watched(True)
        await asyncio.wait_for(is_greeted.wait(), 10.0)
        await worker.map.close()
        await asyncio.wait_for(is_gone.wait(), 10.0)
        server.close()


async def test_a_map_server_whose_port_was_never_reached_keeps_its_lease() -> None:
    """A firewall may refuse what the other servers can reach."""

    async with ConnectedWorker() as worker:
        owner_on_a_closed_port(worker)
        sent = asyncio.ensure_future(worker.map.request(ROBOT, "live-keyframe", FIRST, 0.3))
        await until(lambda: worker.started)
        worker.started[0].tell("ready")
        await asyncio.wait({sent})
        assert isinstance(sent.exception(), Busy)
        assert decode_lease(LEASE, worker.store.get(LEASE)).epoch == 1


async def test_who_may_only_watch_starts_no_process_and_gets_the_state_idle() -> None:
    async with ConnectedWorker() as worker:
        lease = MapLease(worker.store, LEASE, owner="b", server="there", clock=time.monotonic)
        assert lease.claim(None)
        assert lease.release()
        worker.map.set_watched(True, may_start=False)
        await until(lambda: worker.updates)
        assert worker.updates[-1]["state"] == "idle"
        assert not worker.map.may_need_process

        worker.map.set_watched(True, may_start=True)
        await until(lambda: worker.started)
        worker.started[0].tell("ready")
        await until(lambda: (lease := worker.lease()) is not None and lease.state == "serving")
        assert worker.updates[-1]["state"] == "moving"


async def test_who_may_only_watch_a_map_that_is_driven_in_takes_no_part_in_a_takeover() -> None:
    async with ConnectedWorker() as worker:
        owner_on_a_closed_port(worker)
        worker.map._reached_owner = "b"
        worker.map.set_watched(True, may_start=False)
        await until(lambda: worker.updates and worker.updates[-1]["state"] == "idle")
        assert worker.started == []
        assert decode_lease(LEASE, worker.store.get(LEASE)).epoch == 1


def test_only_a_first_keyframe_or_an_operator_begins_a_map():
    assert can_begin_map(keyframe_request(0))
    assert can_begin_map(LiveStart(map="m"))
    assert not can_begin_map(keyframe_request(1))
    assert not can_begin_map(keyframe_request(0, segment=1))
    assert not can_begin_map(LiveMapRequest(map="m"))
