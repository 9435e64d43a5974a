"""When a live map is published: at most once in an interval, and an unchanged map never again."""

from __future__ import annotations

import asyncio

import pytest

from rse_pf.errors import Busy, NotFound, StoreError, StoreFull
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import MemoryStore
from tests.kit.map_server_setup import MAP, Bench, settle


async def test_robots_that_leave_again_and_again_publish_one_version_in_an_interval_and_the_last_one_late():
    bench = Bench()

    server = await bench.start("a")
    server.map_server.users = 1
    maps = MapRegistry(bench.store, "default")
    for number in range(20):
        await server.keyframe(number)
        await server.ask("live-leave")
        await settle()
    assert [record.keyframes for record in maps.versions(MAP)] == [1]
    await bench.clock.advance(9.0)
    assert len(maps.versions(MAP)) == 1
    await bench.clock.advance(2.0)
    assert [record.keyframes for record in maps.versions(MAP)] == [1, 20]
    for _ in range(5):
        await server.ask("live-leave")
        await bench.clock.advance(11.0)
    assert len(maps.versions(MAP)) == 2, "nothing has changed"


async def test_a_map_that_changes_all_the_time_is_published_each_ten_minutes():
    bench = Bench(keep_versions=0)

    server = await bench.start("a")
    server.map_server.users = 1
    maps = MapRegistry(bench.store, "default")
    for number in range(60):
        await server.keyframe(number)
        await bench.clock.advance(30.0)

    assert 2 <= len(maps.versions(MAP)) <= 4, "of half an hour"


async def test_who_asks_for_a_version_waits_for_the_interval_and_all_who_ask_get_the_same_one():
    bench = Bench(publish_pause_s=5.0)

    server = await bench.start("a")
    await server.keyframe(0)
    assert (await server.ask("live-publish"))["number"] == 1
    assert (await server.ask("live-publish"))["number"] == 1
    await server.keyframe(1)
    asked = [asyncio.ensure_future(server.ask("live-publish")) for _ in range(3)]
    await bench.clock.advance(4.0)
    assert not any(request.done() for request in asked)
    await bench.clock.advance(2.0)
    assert [(await request)["number"] for request in asked] == [2, 2, 2]


async def test_a_request_that_would_wait_for_long_is_refused_with_a_time_and_the_map_goes_on():
    bench = Bench(publish_pause_s=60.0)

    server = await bench.start("a")
    await server.keyframe(0)
    await server.ask("live-publish")
    await bench.clock.advance(5.0)
    await server.keyframe(1)
    for operation in ("live-publish", "live-stop"):
        with pytest.raises(Busy) as refused:
            await server.ask(operation)
        assert refused.value.retry_after_ms == pytest.approx(55_000.0)
    assert (await server.keyframe(2))["number"] == 3


async def test_an_unchanged_map_is_not_published_again_by_the_next_map_server():
    bench = Bench()

    first = await bench.start("a")
    maps = MapRegistry(bench.store, "default")
    await first.keyframe(0)
    await first.ask("live-leave")
    await settle()
    await first.map_server.release()
    second = await bench.start("b")
    second.map_server.users = 1
    assert (await second.ask("live-publish"))["number"] == 1, "it is the same map"
    await second.keyframe(1)
    await second.ask("live-leave")
    await bench.clock.advance(11.0)
    assert maps.head(MAP).keyframes == 2


async def test_a_drain_publishes_a_due_version_and_a_crash_leaves_it_to_the_next_map_server():
    bench = Bench(idle_s=3.0)

    maps = MapRegistry(bench.store, "default")
    drained = await bench.start("a")
    await drained.keyframe(0)
    await drained.ask("live-leave")
    await drained.keyframe(1)
    await drained.ask("live-leave")
    await settle()
    assert maps.head(MAP).keyframes == 1
    await drained.map_server.release()
    assert maps.head(MAP).keyframes == 2
    crashed = await bench.start("b")
    crashed.map_server.users = 1
    for number in (2, 3):
        await crashed.keyframe(number)
        await crashed.ask("live-leave")
        await settle()
    crashed.map_server.lose("it crashed")
    assert maps.head(MAP).keyframes == 3
    await bench.clock.advance(3.0)
    following = await bench.start("c")
    await bench.clock.advance(15.0)
    assert await following.run == "released"
    assert maps.head(MAP).keyframes == 4


class FullRegistry(MemoryStore):
    """A store that refuses versions of maps while it is full."""

    is_full = False

    def put(self, name: str, data: bytes) -> None:
        if self.is_full and name.startswith("maps/"):
            raise StoreFull("no space left", hint="free some space")
        super().put(name, data)


class UndeletableMaps(MemoryStore):
    """A store that refuses to delete records of versions while it is slow."""

    is_slow = False

    def delete(self, name: str) -> None:
        if self.is_slow and "/versions/" in name:
            raise StoreError("the store is slow", hint="wait")
        super().delete(name)


async def test_a_version_that_cannot_be_stored_stays_due_and_a_request_gets_the_reason():
    store = FullRegistry()
    bench = Bench(store, publish_pause_s=1.0)

    server = await bench.start("a")
    server.map_server.users = 1
    await server.keyframe(0)
    store.is_full = True
    with pytest.raises(StoreFull):
        await server.ask("live-publish")
    await server.ask("live-leave")
    await bench.clock.advance(3.0)
    with pytest.raises(NotFound):
        MapRegistry(store, "default").head(MAP)
    store.is_full = False
    await bench.clock.advance(30.0)
    assert MapRegistry(store, "default").head(MAP).keyframes == 1


async def test_of_versions_that_nobody_asked_for_the_newest_stay_and_the_others_give_their_bytes_back():
    bench = Bench(publish_pause_s=0.0, keep_versions=3)

    server = await bench.start("a")
    server.map_server.users = 1
    maps = MapRegistry(bench.store, "default")
    numbers = []
    for number in range(8):
        await server.keyframe(number)
        if number == 1:
            await server.ask("live-publish")
        await server.ask("live-leave")
        await bench.clock.advance(1.0)
        numbers.append([record.number for record in maps.versions(MAP)])
    assert numbers[2] == [1, 2, 3]
    assert numbers[-1] == [2, 6, 7, 8], "number 2 was asked for"
    assert [maps.data(MAP, record.id) for record in maps.versions(MAP)]
    assert len(list(bench.store.list(f"maps/default/{MAP}/blobs/"))) == 4


async def test_an_operator_may_keep_all_versions():
    bench = Bench(publish_pause_s=0.0, keep_versions=0)

    server = await bench.start("a")
    server.map_server.users = 1
    for number in range(25):
        await server.keyframe(number)
        await server.ask("live-leave")
        await bench.clock.advance(1.0)
    assert len(MapRegistry(bench.store, "default").versions(MAP)) == 25


async def test_a_version_that_cannot_be_removed_is_no_failure_of_the_one_that_was_published():
    store = UndeletableMaps()
    bench = Bench(store, publish_pause_s=0.0, keep_versions=1)

    server = await bench.start("a")
    server.map_server.users = 1
    maps = MapRegistry(store, "default")
    store.is_slow = True
    for number in range(3):
        await server.keyframe(number)
        await server.ask("live-leave")
        await bench.clock.advance(1.0)
    assert [record.number for record in maps.versions(MAP)] == [1, 2, 3]
    store.is_slow = False
    await server.keyframe(3)
    await server.ask("live-leave")
    await bench.clock.advance(1.0)
    assert [record.number for record in maps.versions(MAP)] == [4]
