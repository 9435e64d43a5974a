"""When a live map is published: at most once in an interval, and an unchanged map never again."""

from __future__ import annotations

import asyncio

import pytest

from rse_pf.errors import Busy, NotFound, StoreError, StoreFull
from rse_pf.maps.registry import MapRegistry
from tests.kit.fake_store import FakeStore, do_nothing, fail_with
from tests.kit.map_server_setup import MAP, MapServerSetup, settle


async def test_robots_that_leave_again_and_again_publish_one_version_in_an_interval_and_the_last_one_late():
    bench = MapServerSetup()

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


async def test_who_asks_for_a_version_waits_for_the_interval_and_all_who_ask_get_the_same_one():
    bench = MapServerSetup(publish_pause_s=5.0)

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
    bench = MapServerSetup(publish_pause_s=60.0)

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


async def test_a_drain_publishes_a_due_version_and_a_crash_leaves_it_to_the_next_map_server():
    bench = MapServerSetup(idle_s=3.0)

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


async def test_a_version_that_cannot_be_stored_stays_due_and_a_request_gets_the_reason():
    store = FakeStore()
    bench = MapServerSetup(store, publish_pause_s=1.0)

    server = await bench.start("a")
    server.map_server.users = 1
    await server.keyframe(0)
    store.before = fail_with(StoreFull("no space left", hint="free some space"), "put", part="maps/")
    with pytest.raises(StoreFull):
        await server.ask("live-publish")
    await server.ask("live-leave")
    await bench.clock.advance(3.0)
    with pytest.raises(NotFound):
        MapRegistry(store, "default").head(MAP)
    store.before = do_nothing
    await bench.clock.advance(30.0)
    assert MapRegistry(store, "default").head(MAP).keyframes == 1


async def test_of_versions_that_nobody_asked_for_the_newest_stay_and_the_others_give_their_bytes_back():
    bench = MapServerSetup(publish_pause_s=0.0, keep_versions=3)

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


async def test_a_version_that_cannot_be_removed_is_no_failure_of_the_one_that_was_published():
    store = FakeStore()
    bench = MapServerSetup(store, publish_pause_s=0.0, keep_versions=1)

    server = await bench.start("a")
    server.map_server.users = 1
    maps = MapRegistry(store, "default")
    store.before = fail_with(StoreError("the store is slow", hint="wait"), "delete", part="/versions/")
    for number in range(3):
        await server.keyframe(number)
        await server.ask("live-leave")
        await bench.clock.advance(1.0)
    assert [record.number for record in maps.versions(MAP)] == [1, 2, 3]
    store.before = do_nothing
    await server.keyframe(3)
    await server.ask("live-leave")
    await bench.clock.advance(1.0)
    assert [record.number for record in maps.versions(MAP)] == [4]
