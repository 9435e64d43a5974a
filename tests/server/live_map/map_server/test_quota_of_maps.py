"""The bytes of live maps are charged to their tenant; a tenant that fills a store is refused, others not."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from rse_pf.errors import Conflict, QuotaExceeded, StoreFull
from rse_pf.identity import RobotId
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import MemoryStore, ObjectStore, charge_of
from tests.kit.fake_store import FakeStore, do_nothing
from tests.kit.map_server_setup import FOLDER, MAP, MapServerSetup, RunningMapServer, settle

OTHER = RobotId("default", "robot-2", "thumb")
QUOTA = 1_000_000


async def fill(server: RunningMapServer, features: bytes = bytes(20_000), *, leaves: bool = False) -> int:
    """Send keyframes until one is refused; return its number."""
    number = 0
    while True:
        try:
            await server.keyframe(number, features)
        except QuotaExceeded:
            return number
        if leaves:
            await server.ask("live-leave")
        await settle()
        number += 1
        assert number < 1000


def stored(store: ObjectStore, *areas: str) -> int:
    return sum(charge_of(info.size) for area in areas for info in store.list(area))


@pytest.mark.parametrize("leaves", [False, True])
async def test_a_tenant_fills_its_quota_with_live_maps_and_no_more(leaves: bool) -> None:
    bench = MapServerSetup(MemoryStore(), data={"tenant_quota_bytes": QUOTA}, publish_pause_s=0.0)

    server = await bench.start("a")
    server.map_server.users = 1
    number = await fill(server, leaves=leaves)
    assert number >= 5
    for more in range(20):  # a snapshot leaves room for a few
        with contextlib.suppress(QuotaExceeded, Conflict):
            await server.keyframe(number + more, bytes(20_000))
        await server.ask("live-leave")
        await settle()
    assert stored(bench.store, "live/", "maps/") <= QUOTA


async def test_over_the_quota_a_map_is_shown_forgotten_and_stopped_and_then_there_is_room() -> None:
    bench = MapServerSetup(MemoryStore(), data={"tenant_quota_bytes": QUOTA})

    server = await bench.start("a")
    server.map_server.users = 1
    number = await fill(server)
    bench.store.put("objects/default/robot-1/other", bytes(QUOTA))
    assert (await server.ask("live-show"))["keyframes"] == number
    assert await server.ask("live-leave") == {}
    await bench.clock.advance(30.0)
    bench.store.delete("objects/default/robot-1/other")
    stopped = await server.ask("live-stop")
    assert stopped["keyframes"] == number
    assert list(bench.store.list(f"{FOLDER}log/")) == []
    await bench.clock.advance(30.0)
    new = await bench.start("b")
    assert (await new.keyframe(0, bytes(20_000)))["number"] == 1


async def test_a_robot_that_always_drives_fills_a_quarter_of_the_quota_with_versions_and_no_more() -> None:
    bench = MapServerSetup(
        MemoryStore(), data={"tenant_quota_bytes": QUOTA}, publish_pause_s=0.0, keep_versions=1000
    )

    server = await bench.start("a")
    server.map_server.users = 1
    for number in range(60):
        await server.keyframe(number, bytes(5_000))
        await server.ask("live-leave")
        await bench.clock.advance(1.0)
        assert stored(bench.store, "maps/") <= QUOTA / 4 + 4096, "the versions and the head"
    assert len(MapRegistry(bench.store, "default").versions(MAP)) == 30
    assert stored(bench.store, "live/", "maps/") <= QUOTA


async def test_a_keyframe_that_a_full_disk_cannot_take_is_refused_and_everything_else_goes_on() -> None:
    def refuse_long_entries(operation: str, name: str, data: bytes) -> None:
        if "/log/" in name and len(data) > 1000:
            raise StoreFull("no space left", hint="free some space")

    store = FakeStore()
    bench = MapServerSetup(store)

    server = await bench.start("a")
    await server.keyframe(0)
    store.before = refuse_long_entries
    sent = asyncio.gather(
        server.keyframe(1, bytes(5000)), server.keyframe(0, robot=OTHER), return_exceptions=True
    )
    refused, other = await sent
    assert isinstance(refused, StoreFull)
    assert isinstance(other, StoreFull | dict)
    assert await server.ask("live-leave") == {}
    assert (await server.keyframe(0, robot=OTHER))["number"] == 1
    store.before = do_nothing
    assert (await server.keyframe(1, bytes(5000)))["number"] == 2
    await settle()
    assert bench.replayed().digest() == server.state.digest()
