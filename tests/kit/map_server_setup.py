"""Run map servers without processes, sockets and time: a fake map, a store in memory, a manual clock."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound, StoreError
from rse_pf.identity import RobotId
from rse_pf.maps.registry import MapRegistry
from rse_pf.server.live_map.lease import LeaseRecord, MapLease, decode_lease, lease_name, map_folder
from rse_pf.server.live_map.map_server.environment import MapImplementation, MapServerEnvironment, Urgency
from rse_pf.server.live_map.map_server.keyframe_objects import KeyframeObjects
from rse_pf.server.live_map.map_server.log import LiveLog
from rse_pf.server.live_map.map_server.map_server import MapServer
from rse_pf.server.live_map.map_server.measurement import optimise_in_process
from rse_pf.server.live_map.map_server.state import MapState, take_over
from rse_pf.storage.lease import read_record
from rse_pf.storage.object_store import MemoryStore, ObjectStore
from rse_pf.storage.quotas import TenantAccount
from tests.kit.fake_map import FAKE_MAP
from tests.kit.fake_store import FakeStore
from tests.kit.fakes import FakeLog

__all__ = [
    "MAP",
    "ROBOT",
    "FailingStore",
    "HandClock",
    "InlineThreads",
    "MapServerSetup",
    "RunningMapServer",
    "settle",
]

MAP, TENANT = "warehouse", "default"
ROBOT = RobotId("default", "robot-1")
LEASE, FOLDER = lease_name(TENANT, MAP), map_folder(TENANT, MAP)
_T = TypeVar("_T")


class HandClock:
    """Time that passes only when the test says so."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._sleepers: list[tuple[float, asyncio.Future[None]]] = []

    def __call__(self) -> float:
        return self.now_s

    async def sleep(self, seconds: float) -> None:
        future = asyncio.get_running_loop().create_future()
        self._sleepers.append((self.now_s + seconds, future))
        await future

    async def advance(self, seconds: float, step_s: float = 0.1) -> None:
        """Let time pass in steps, and everything happen that is due."""
        for _ in range(round(seconds / step_s)):
            self.jump(step_s)
            await settle()

    def jump(self, seconds: float) -> None:
        """Let time pass at once, as for a process that was paused."""
        self.now_s += seconds
        for due_s, future in self._sleepers:
            if due_s <= self.now_s and not future.done():
                future.set_result(None)
        self._sleepers = [sleeper for sleeper in self._sleepers if not sleeper[1].done()]


class InlineThreads:
    """Threads that compute in the calling thread, at once."""

    async def compute(self, urgency: Urgency, act: Callable[[], _T]) -> _T:
        return act()

    async def store(self, act: Callable[[], _T]) -> _T:
        return act()

    match = lease = background = plan = store


class FailingStore(FakeStore):
    """Fails with a given probability, before a change or after it: then the change is made all the same."""

    def __init__(self, share: float = 0.0, seed: int = 0) -> None:
        super().__init__(self._fail, self._fail)
        self.share = share
        self.failures = 0
        self._random = random.Random(seed)

    def _fail(self, operation: str, name: str, data: bytes) -> None:
        if (
            operation in ("get", "get_range", "put", "compare_and_swap")
            and self._random.random() < self.share
        ):
            self.failures += 1
            raise StoreError("the store fails", hint="wait")


class RunningMapServer:
    """A running map server with all that it sent."""

    def __init__(self, bench: MapServerSetup, name: str) -> None:
        self.sent_updates: list[dict[str, Any]] = []
        self.renewals: list[int] = []
        self.uses: list[bool] = []
        self.lease = MapLease(bench.store, LEASE, owner=name, server=name, clock=bench.clock)
        self.claimed = self.lease.claim(read_record(bench.store, LEASE))
        record = self.lease.record
        self.log = LiveLog(
            bench.store, FOLDER, owner=name, epoch=record.epoch, base=record.base, keeps_all=bench.keeps_all
        )
        self.state: MapState = take_over(self.log, bench.implementation, owner=name, epoch=record.epoch)
        assert self.lease.serve("127.0.0.1", 1, "c")
        account = TenantAccount(
            bench.store, TENANT, bench.settings.data, wall_clock=lambda: 1e9 + bench.clock()
        )
        context = MapServerEnvironment(
            map_name=MAP,
            settings=bench.settings.live,
            implementation=bench.implementation,
            threads=bench.threads,
            maps=MapRegistry(bench.store, TENANT),
            clock=bench.clock,
            wall_clock=lambda: 1000.0,
            sleep=bench.clock.sleep,
            account=account,
            objects=KeyframeObjects(bench.store, account),
            log=bench.log,
            send_update=self.sent_updates.append,
            on_renewal=self.renewals.append,
            on_use=self.uses.append,
            optimise=optimise_in_process,
        )
        self.map_server = MapServer(context, self.state, self.log, self.lease)
        self.run = asyncio.ensure_future(self.map_server.run())

    async def keyframe(
        self, number: int, features: bytes = b"good", robot: RobotId = ROBOT
    ) -> dict[str, Any]:
        from tests.kit.fake_map import keyframe_request

        request = msgspec.msgpack.encode(keyframe_request(number, features))
        return await self.map_server.answer(robot, "live-keyframe", request)

    async def ask(
        self, operation: str, payload: dict[str, Any] | None = None, robot: RobotId = ROBOT
    ) -> dict[str, Any]:
        request = msgspec.msgpack.encode({"map": MAP, **(payload or {})})
        return await self.map_server.answer(robot, operation, request)

    def newest(self, kind: str) -> dict[str, Any]:
        return [payload for payload in self.sent_updates if payload["kind"] == kind][-1]


class MapServerSetup:
    """A store and a manual clock, on which a test starts map servers one after the other."""

    def __init__(
        self,
        store: ObjectStore | None = None,
        *,
        keeps_all: bool = False,
        data: dict[str, Any] | None = None,
        implementation: MapImplementation = FAKE_MAP,
        **live: Any,
    ) -> None:
        self.implementation = implementation
        self.store: ObjectStore = store or MemoryStore()
        self.clock = HandClock()
        self.settings = PlatformSettings.from_dict({"live": live, "data": data or {}})
        self.keeps_all = keeps_all
        self.threads = InlineThreads()
        self.log: Any = FakeLog()

    def lease_bytes(self) -> bytes | None:
        try:
            return self.store.get(LEASE)
        except NotFound:
            return None

    def lease(self) -> LeaseRecord:
        data = self.lease_bytes()
        assert data is not None
        return decode_lease(LEASE, data)

    async def start(self, name: str) -> RunningMapServer:
        server = RunningMapServer(self, name)
        await settle()
        return server

    def replayed(self) -> MapState:
        """Return the map that the entries of the log give, from the first one on."""
        log = LiveLog(self.store, FOLDER, owner="replay", epoch=10**6)
        state = MapState(self.implementation.empty(), 0)
        from rse_pf.live_map.events import decode_events

        for entry in log.read_entries():
            state.apply(log.position, decode_events(entry.events))
        return state


async def settle(rounds: int = 60) -> None:
    """Run all tasks of the event loop until each waits for something."""
    for _ in range(rounds):
        await asyncio.sleep(0)
