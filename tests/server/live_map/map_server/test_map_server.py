"""What the map server of a live map acknowledges, sends and refuses, and how it behaves under faults."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

import pytest

from rse_pf.errors import BadRequest, Conflict, InternalError, NotFound, StoreError
from rse_pf.identity import RobotId
from rse_pf.live_map.events import Event, KeyframeAdded
from rse_pf.live_map.outcomes import Joined, Outcome, Unaligned
from rse_pf.maps.registry import MapRegistry
from rse_pf.server.live_map.map_server.environment import MapImplementation
from rse_pf.server.live_map.map_server.map_server import MapMoving
from tests.kit.fake_map import FAKE_MAP, FakeMap
from tests.kit.fake_store import FakeStore, do_nothing, fail_with
from tests.kit.map_server_setup import (
    FOLDER,
    MAP,
    ROBOT,
    FailingStore,
    InlineThreads,
    MapServerSetup,
    settle,
)

_T = TypeVar("_T")
OTHER = RobotId("default", "robot-2", "thumb")


async def test_the_log_says_when_a_robot_is_aligned_and_when_it_no_longer_is():
    class Joining(FakeMap):
        def apply(self, event: Event) -> list[Outcome]:
            outcomes = super().apply(event)
            if isinstance(event, KeyframeAdded) and event.number == 0:
                outcomes.append(Joined(robot=event.robot, segment=0, links=3))
            elif isinstance(event, KeyframeAdded):
                outcomes.append(Unaligned(robot=event.robot, segment=0, reason="no loop closure"))
            return outcomes

    bench = MapServerSetup(
        implementation=MapImplementation(
            empty=Joining, restore=Joining.restore, started_from=FAKE_MAP.started_from
        )
    )
    server = await bench.start("a")
    for number in range(2):
        await server.keyframe(number)

    about = {"map": MAP, "robot": ROBOT.name}
    assert ("info", "live-aligned", about) in bench.log.events
    assert ("warning", "live-alignment-lost", {**about, "reason": "no loop closure"}) in bench.log.events


async def test_keyframes_of_one_robot_may_be_on_their_way_at_the_same_time_but_none_ahead():
    bench = MapServerSetup()

    server = await bench.start("a")
    await asyncio.gather(*(server.keyframe(number) for number in range(5)))
    assert server.state.keyframes == 5
    with pytest.raises(Conflict, match="keyframe 7 arrived, but 5 is the next one"):
        await server.keyframe(7)


async def test_malformed_keyframes_are_refused_before_they_are_logged_also_behind_one_that_is_being_written():
    bench = MapServerSetup()

    server = await bench.start("a")
    _, bad = await asyncio.gather(server.keyframe(0), server.keyframe(1, b"bad"), return_exceptions=True)
    assert isinstance(bad, BadRequest)
    await settle()
    assert server.state.keyframes == 1
    for payload in ({}, {"number": "x"}, {"segment": 0, "number": 0}):
        with pytest.raises(BadRequest):
            await server.ask("live-keyframe", payload)


async def test_keyframes_that_arrive_during_a_write_share_the_next_entry():
    bench = MapServerSetup()

    server = await bench.start("a")
    robots = [RobotId("default", f"r{row}") for row in range(8)]
    before = server.log.position
    await asyncio.gather(*(server.keyframe(0, robot=robot) for robot in robots))
    await settle()
    assert server.state.keyframes == 8
    assert server.log.position - before < 8


async def test_keyframes_are_acknowledged_while_loop_closures_of_an_earlier_one_are_measured():
    bench = MapServerSetup()
    may_look = asyncio.Event()

    class Threads(InlineThreads):
        async def match(self, act: Callable[[], _T]) -> _T:
            await may_look.wait()
            return act()

    bench.threads = Threads()

    server = await bench.start("a")
    for number in range(3):
        assert (await server.keyframe(number))["number"] == number + 1
    assert server.state.keyframes == 3
    assert list(server.state.unmeasured) == [0, 1, 2]
    may_look.set()
    await settle()
    assert not server.state.unmeasured
    assert bench.replayed().digest() == server.state.digest()


async def test_an_optimisation_that_fails_does_not_end_the_map_server():
    bench = MapServerSetup()

    server = await bench.start("a")
    server.state.live_map.prepare_optimisation = lambda solve: [].index(0)  # type: ignore[attr-defined]
    server.map_server._measurer.request_optimisation()
    await settle()
    assert not server.run.done()
    assert (await server.keyframe(0))["number"] == 1


async def test_a_map_server_that_was_paused_acknowledges_nothing_more_and_ends():
    """As after SIGSTOP: another process takes the map and writes while this one is paused."""
    bench = MapServerSetup()

    old = await bench.start("a")
    await old.keyframe(0)
    await settle()
    sent = asyncio.ensure_future(old.keyframe(1))  # arrives while it is paused: nothing ran yet
    bench.clock.now_s += 10.0
    new = await bench.start("b")
    assert (await new.keyframe(1))["number"] == 2
    sent_before = len(old.sent_updates)
    await settle()
    bench.clock.jump(0.0)
    await settle()
    assert old.run.done()
    assert old.run.result() == "lost"
    with pytest.raises(MapMoving):
        await sent
    assert len(old.sent_updates) == sent_before
    assert new.state.keyframes == 2
    assert bench.replayed().digest() == new.state.digest()


async def test_an_old_map_server_acknowledges_nothing_even_if_its_entry_number_is_free_again():
    """The new map server has deleted the entry whose number the old one tries to write."""
    bench = MapServerSetup()

    old = await bench.start("a")
    await old.keyframe(0)
    await settle()
    bench.clock.now_s += 10.0
    new = await bench.start("b")
    for number in range(1, 320):
        await new.keyframe(number)
    await settle()
    name = f"{FOLDER}log/{old.log.position + 1:012d}"
    with pytest.raises(NotFound):
        bench.store.get(name)
    digest, keyframes = new.state.digest(), new.state.keyframes
    sent = asyncio.ensure_future(old.keyframe(1))
    await settle()
    assert bench.store.get(name)  # it could write
    bench.clock.jump(1.0)
    await settle()
    with pytest.raises(MapMoving):
        await sent
    assert old.run.result() == "lost"
    bench.clock.now_s += 10.0
    third = await bench.start("c")
    assert third.state.keyframes == keyframes
    assert third.state.digest() != digest  # one more server is in the log, and nothing else
    assert third.lease.record.epoch == 3


async def test_keyframes_without_logged_loop_closures_are_measured_by_the_next_map_server():
    bench = MapServerSetup()

    old = await bench.start("a")
    old.state.prepare_measurement = lambda keyframe, parts: (_ for _ in ()).throw(KeyError)  # type: ignore[method-assign]
    sent = asyncio.ensure_future(old.keyframe(0))
    await settle()
    assert sent.done()
    assert list(bench.replayed().unmeasured) == [0]
    bench.clock.now_s += 10.0
    new = await bench.start("b")
    await settle()
    assert not new.state.unmeasured
    assert not bench.replayed().unmeasured


@pytest.mark.parametrize("seed", range(5))
async def test_a_store_that_fails_three_times_in_ten_loses_and_doubles_nothing(seed: int):
    """The store fails before a change, or after it, so that the map server does not know of its entry."""
    bench = MapServerSetup(store := FailingStore(seed=seed))

    server = await bench.start("a")
    store.share = 0.3
    sent = [asyncio.ensure_future(server.keyframe(number)) for number in range(20)]
    for _ in range(400):
        await bench.clock.advance(0.1)
        if all(request.done() for request in sent):
            break
    store.share = 0.0
    await bench.clock.advance(3.0)
    assert [request.result()["number"] for request in sent] == list(range(1, 21))
    assert store.failures > 20
    assert not server.run.done()
    replayed = bench.replayed()
    assert replayed.keyframes == server.state.keyframes == 20
    assert replayed.digest() == server.state.digest()


async def test_a_crash_between_log_and_acknowledgement_is_a_known_keyframe_afterwards():
    bench = MapServerSetup()

    old = await bench.start("a")
    real = old.log.write_entry

    def write_and_die(events: bytes) -> int:
        real(events)
        raise StoreError("the process dies here")

    old.log.write_entry = write_and_die  # type: ignore[method-assign]
    sent = asyncio.ensure_future(old.keyframe(0))
    await settle()
    assert not sent.done()
    old.run.cancel()
    bench.clock.now_s += 10.0
    new = await bench.start("b")
    assert (await new.keyframe(0))["number"] == 1
    assert new.state.keyframes == 1


async def test_nothing_is_sent_while_the_lease_is_not_renewed():
    bench = MapServerSetup(store := FakeStore())

    server = await bench.start("a")
    await server.keyframe(0)
    await settle()
    store.before = fail_with(StoreError("down"), "compare_and_swap")
    await bench.clock.advance(2.0)
    asked = asyncio.ensure_future(server.ask("live-show"))
    await settle()
    assert not asked.done()  # another process might own the map
    store.before = do_nothing
    await bench.clock.advance(1.0)
    assert (await asked)["keyframes"] == 1


async def test_a_subscriber_that_comes_while_the_lease_is_too_old_gets_the_updates_after_its_renewal():
    bench = MapServerSetup(store := FakeStore())

    server = await bench.start("a")
    await server.keyframe(0)
    await settle()
    store.before = fail_with(StoreError("down"), "compare_and_swap")
    await bench.clock.advance(2.0)
    assert server.map_server.current_updates() == []
    server.sent_updates.clear()
    store.before = do_nothing
    await bench.clock.advance(1.0)
    assert {payload["kind"] for payload in server.sent_updates} == {"map", "alignment", "pose"}


async def test_a_map_is_published_when_the_last_robot_leaves_and_the_same_map_only_once():
    bench = MapServerSetup()

    server = await bench.start("a")
    maps = MapRegistry(bench.store, "default")
    await server.keyframe(0)
    await server.keyframe(0, robot=OTHER)
    await settle()
    await server.ask("live-leave")
    await settle()
    assert maps.names() == []
    await server.ask("live-leave", robot=OTHER)
    await settle()
    assert maps.head(MAP).number == 1
    assert maps.head(MAP).keyframes == 2
    reply = await server.ask("live-publish")
    assert reply == {"name": MAP, "version": maps.head(MAP).id, "number": 1, "keyframes": 2}


async def test_a_map_server_notifies_its_worker_whether_commands_arrive():
    bench = MapServerSetup()

    server = await bench.start("a")
    server.map_server.users = 1
    await bench.clock.advance(11.0)
    assert server.uses == []
    await server.keyframe(0)
    await server.ask("live-show")
    await bench.clock.advance(9.0)
    assert server.uses == [True]
    await bench.clock.advance(2.0)
    assert server.uses == [True, False]


async def test_a_stopped_map_is_published_and_begins_anew_without_its_past():
    bench = MapServerSetup()

    server = await bench.start("a")
    await server.keyframe(0)
    await settle()
    reply = await server.ask("live-stop")
    assert reply["keyframes"] == 1
    assert await server.run == "stopped"
    assert list(bench.store.list(f"{FOLDER}log/")) == []
    base = bench.lease().base
    assert base == server.log.position
    new = await bench.start("b")
    assert new.state.keyframes == 0
    assert new.log.position == base + 1
    started = await new.ask("live-start", {"from": MAP})
    assert started["keyframes"] == 1
    with pytest.raises(Conflict, match="has begun already"):
        await new.ask("live-start", {"from": MAP})


async def test_a_defect_of_the_map_refuses_one_keyframe_and_the_next_one_is_taken():
    bench = MapServerSetup(keeps_all=True)

    server = await bench.start("a")
    with pytest.raises(InternalError):
        await server.keyframe(0, b"defect")
    assert (await server.keyframe(0))["number"] == 1
    assert bench.replayed().keyframes == 1


async def test_updates_name_the_cause_and_a_new_reader_gets_the_present_state():
    bench = MapServerSetup()

    server = await bench.start("a")
    await server.keyframe(0)
    await bench.clock.advance(1.0)
    assert {payload["kind"] for payload in server.map_server.current_updates()} == {
        "map",
        "alignment",
        "pose",
    }
    await server.keyframe(1)
    await bench.clock.advance(1.0)
    assert server.newest("alignment")["cause"] == {"robot": "robot-1", "number": 1}
    assert server.newest("pose")["timestamp_s"] == 1.0
    assert server.map_server.current_updates()[0]["kind"] == "map"
    shown = await server.ask("live-show")
    assert shown["you"] == {"robot": "robot-1", "number": 2, "segment": 1}
    assert shown["robots"][0]["robot"] == ROBOT.name


@pytest.mark.parametrize("operation", ["live-publish", "live-stop"])
async def test_a_map_that_the_registry_refuses_is_an_internal_error_for_who_asks(operation, monkeypatch):
    bench = MapServerSetup()

    def refuse(*args: object, **named: object) -> None:
        raise BadRequest("keyframe 1 has no rigid pose", hint="leave it out")

    monkeypatch.setattr(MapRegistry, "commit", refuse)

    server = await bench.start("a")
    await server.keyframe(0)
    with pytest.raises(InternalError, match="the live map cannot be published: keyframe 1"):
        await server.ask(operation, {})
