"""What the owner of a live map acknowledges, tells and refuses, and what faults do to it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

import pytest

from rse_pf.errors import BadRequest, Conflict, InternalError, NotFound, StoreError
from rse_pf.identity import RobotId
from rse_pf.live_map.events import Event, KeyframeAdded, MapStarted, decode_events
from rse_pf.live_map.outcomes import Joined, Outcome, Unaligned
from rse_pf.maps.registry import MapRegistry
from rse_pf.object_store import MemoryStore
from rse_pf.server.live_map.lease import next_action
from rse_pf.server.live_map.map_server.environment import MapImplementation
from rse_pf.server.live_map.map_server.log import LiveLog
from rse_pf.server.live_map.map_server.map_server import MapMoving
from tests.server.live_map.fake_map import FAKE_MAP, FakeMap
from tests.server.live_map.map_server_bench import (
    FOLDER,
    MAP,
    ROBOT,
    Bench,
    FailingStore,
    InlineThreads,
    settle,
)

_T = TypeVar("_T")
OTHER = RobotId("default", "robot-2", "thumb")


class Store(MemoryStore):
    """Refuses leases while it is down."""

    is_down = False

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        if self.is_down:
            raise StoreError("down")
        super().compare_and_swap(name, expected, data)


async def test_a_keyframe_is_acknowledged_when_it_is_durable():
    bench = Bench(store := Store())

    owner = await bench.own("a")
    store.is_down = True
    sent = asyncio.ensure_future(owner.keyframe(0))
    await bench.clock.advance(1.0)
    assert not sent.done()
    assert owner.state.keyframes == 0
    assert owner.newest("map")["state"] == "waiting for the store"
    store.is_down = False
    await bench.clock.advance(2.0)
    assert (await sent)["number"] == 1
    assert owner.newest("map")["state"] == "live"
    assert bench.replayed().digest() == owner.state.digest()


async def test_a_keyframe_that_is_sent_again_is_acknowledged_and_not_added_twice():
    bench = Bench()

    owner = await bench.own("a")
    await asyncio.gather(owner.keyframe(0), owner.keyframe(0))
    assert (await owner.keyframe(0))["number"] == 1
    assert owner.state.keyframes == 1


async def test_the_log_says_when_a_robot_is_aligned_and_when_it_no_longer_is():
    class Joining(FakeMap):
        def apply(self, event: Event) -> list[Outcome]:
            outcomes = super().apply(event)
            if isinstance(event, KeyframeAdded) and event.number == 0:
                outcomes.append(Joined(robot=event.robot, segment=0, links=3))
            elif isinstance(event, KeyframeAdded):
                outcomes.append(Unaligned(robot=event.robot, segment=0, reason="no loop closure"))
            return outcomes

    bench = Bench(
        implementation=MapImplementation(
            empty=Joining, restore=Joining.restore, started_from=FAKE_MAP.started_from
        )
    )
    owner = await bench.own("a")
    for number in range(2):
        await owner.keyframe(number)

    about = {"map": MAP, "robot": ROBOT.name}
    assert ("info", "live-aligned", about) in bench.log.events
    assert ("warning", "live-alignment-lost", {**about, "reason": "no loop closure"}) in bench.log.events


async def test_keyframes_of_one_robot_may_be_on_their_way_at_the_same_time_but_none_ahead():
    bench = Bench()

    owner = await bench.own("a")
    await asyncio.gather(*(owner.keyframe(number) for number in range(5)))
    assert owner.state.keyframes == 5
    with pytest.raises(Conflict, match="keyframe 7 arrived, but 5 is the next one"):
        await owner.keyframe(7)


async def test_garbage_is_refused_before_it_is_logged_also_behind_a_keyframe_that_is_being_written():
    bench = Bench()

    owner = await bench.own("a")
    _, bad = await asyncio.gather(owner.keyframe(0), owner.keyframe(1, b"bad"), return_exceptions=True)
    assert isinstance(bad, BadRequest)
    await settle()
    assert owner.state.keyframes == 1
    for payload in ({}, {"number": "x"}, {"segment": 0, "number": 0}):
        with pytest.raises(BadRequest):
            await owner.ask("live-keyframe", payload)


async def test_keyframes_that_arrive_during_a_write_share_the_next_entry():
    bench = Bench()

    owner = await bench.own("a")
    robots = [RobotId("default", f"r{row}") for row in range(8)]
    before = owner.log.position
    await asyncio.gather(*(owner.keyframe(0, robot=robot) for robot in robots))
    await settle()
    assert owner.state.keyframes == 8
    assert owner.log.position - before < 8


async def test_keyframes_are_kept_while_the_links_of_an_earlier_one_are_measured():
    bench = Bench()
    may_look = asyncio.Event()

    class Threads(InlineThreads):
        async def match(self, act: Callable[[], _T]) -> _T:
            await may_look.wait()
            return act()

    bench.threads = Threads()

    owner = await bench.own("a")
    for number in range(3):
        assert (await owner.keyframe(number))["number"] == number + 1
    assert owner.state.keyframes == 3
    assert list(owner.state.unmeasured) == [0, 1, 2]
    may_look.set()
    await settle()
    assert not owner.state.unmeasured
    assert bench.replayed().digest() == owner.state.digest()


async def test_an_optimisation_that_fails_is_no_defect_of_the_owner():
    bench = Bench()

    owner = await bench.own("a")
    owner.state.live_map.prepare_optimisation = lambda solve: [].index(0)  # type: ignore[attr-defined]
    owner.owner._measurer.request_optimisation()
    await settle()
    assert not owner.run.done()
    assert (await owner.keyframe(0))["number"] == 1


async def test_an_owner_that_was_paused_acknowledges_nothing_more_and_ends():
    """SIGSTOP: while it stands still another process takes the map and writes."""
    bench = Bench()

    old = await bench.own("a")
    await old.keyframe(0)
    await settle()
    sent = asyncio.ensure_future(old.keyframe(1))  # arrives while it is paused: nothing ran yet
    bench.clock.now_s += 10.0
    new = await bench.own("b")
    assert (await new.keyframe(1))["number"] == 2
    old_told = len(old.told)
    await settle()
    bench.clock.jump(0.0)
    await settle()
    assert old.run.done()
    assert old.run.result() == "lost"
    with pytest.raises(MapMoving):
        await sent
    assert len(old.told) == old_told
    assert new.state.keyframes == 2
    assert bench.replayed().digest() == new.state.digest()


async def test_an_old_owner_acknowledges_nothing_even_where_its_number_was_deleted_meanwhile():
    """The new owner has written so much that the entry which the old one tries to write is free again."""
    bench = Bench()

    old = await bench.own("a")
    await old.keyframe(0)
    await settle()
    bench.clock.now_s += 10.0
    new = await bench.own("b")
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
    third = await bench.own("c")
    assert third.state.keyframes == keyframes
    assert third.state.digest() != digest  # one more owner is in the log, and nothing else
    assert third.lease.record.epoch == 3


async def test_a_new_owner_holds_the_same_map_and_goes_on_where_the_old_one_ended():
    bench = Bench(keeps_all=True)

    old = await bench.own("a")
    for number in range(230):
        await old.keyframe(number)
    await settle()
    bench.clock.now_s += 10.0
    new = await bench.own("b")
    assert new.log.position > 400
    assert new.state.keyframes == 230
    assert new.state.digest() == bench.replayed().digest()
    assert (await new.keyframe(229))["number"] == 230
    assert (await new.keyframe(230))["number"] == 231


async def test_keyframes_whose_links_were_not_logged_are_measured_by_the_next_owner():
    bench = Bench()

    old = await bench.own("a")
    old.state.prepare_measurement = lambda keyframe, parts: (_ for _ in ()).throw(KeyError)  # type: ignore[method-assign]
    sent = asyncio.ensure_future(old.keyframe(0))
    await settle()
    assert sent.done()
    assert list(bench.replayed().unmeasured) == [0]
    bench.clock.now_s += 10.0
    new = await bench.own("b")
    await settle()
    assert not new.state.unmeasured
    assert not bench.replayed().unmeasured


@pytest.mark.parametrize("seed", range(5))
async def test_a_store_that_fails_three_times_in_ten_loses_and_doubles_nothing(seed: int):
    """Before a change, and after it: then the owner does not know that its entry is there."""
    bench = Bench(store := FailingStore(seed=seed))

    owner = await bench.own("a")
    store.share = 0.3
    sent = [asyncio.ensure_future(owner.keyframe(number)) for number in range(20)]
    for _ in range(400):
        await bench.clock.advance(0.1)
        if all(each.done() for each in sent):
            break
    store.share = 0.0
    await bench.clock.advance(3.0)
    assert [each.result()["number"] for each in sent] == list(range(1, 21))
    assert store.failures > 20
    assert not owner.run.done()
    replayed = bench.replayed()
    assert replayed.keyframes == owner.state.keyframes == 20
    assert replayed.digest() == owner.state.digest()


async def test_a_crash_between_log_and_acknowledgement_is_a_known_keyframe_afterwards():
    bench = Bench()

    old = await bench.own("a")
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
    new = await bench.own("b")
    assert (await new.keyframe(0))["number"] == 1
    assert new.state.keyframes == 1


async def test_a_release_writes_a_snapshot_and_frees_the_map_at_once():
    bench = Bench()

    owner = await bench.own("a")
    await owner.keyframe(0)
    await settle()
    await owner.owner.release()
    assert await owner.run == "released"
    assert bench.lease().state == "released"
    assert next_action(bench.lease(), unchanged_s=0.0, lease_s=1.5) == "claim"
    assert [info.name for info in bench.store.list(f"{FOLDER}snapshot/")]
    with pytest.raises(MapMoving):
        await owner.keyframe(1)
    new = await bench.own("b")
    assert new.state.keyframes == 1
    assert new.lease.record.tries == 0


async def test_a_silent_lease_ends_what_is_told_until_it_is_renewed():
    bench = Bench(store := Store())

    owner = await bench.own("a")
    await owner.keyframe(0)
    await settle()
    store.is_down = True
    await bench.clock.advance(2.0)
    asked = asyncio.ensure_future(owner.ask("live-show"))
    await settle()
    assert not asked.done()  # another process might own the map
    assert owner.owner.current_updates() == []
    store.is_down = False
    await bench.clock.advance(1.0)
    assert (await asked)["keyframes"] == 1


async def test_an_owner_that_has_measured_a_keyframe_counts_no_longer_as_one_that_its_map_ended():
    """Else a busy machine, on which leases end, waits for a minute as after crashes."""
    bench = Bench()

    await bench.own("a")
    bench.clock.now_s += 10.0
    second = await bench.own("b")
    await bench.clock.advance(1.0)
    assert bench.lease().tries == 1
    await second.keyframe(0)
    await bench.clock.advance(1.0)
    assert bench.lease().tries == 0


async def test_what_a_robot_contributed_can_be_taken_out_and_a_stranger_is_not_found():
    bench = Bench()

    owner = await bench.own("a")
    await owner.keyframe(0)
    await owner.keyframe(0, robot=OTHER)
    with pytest.raises(NotFound, match="'robot-3' contributed nothing"):
        await owner.ask("live-forget", {"robot": "robot-3"})
    assert (await owner.ask("live-forget", {"robot": "robot-2"}))["forgotten"] == 1
    assert owner.state.keyframes == 1
    assert (await owner.keyframe(0, robot=OTHER))["number"] == 1


async def test_a_map_is_published_when_the_last_robot_leaves_and_the_same_map_only_once():
    bench = Bench()

    owner = await bench.own("a")
    maps = MapRegistry(bench.store, "default")
    await owner.keyframe(0)
    await owner.keyframe(0, robot=OTHER)
    await settle()
    await owner.ask("live-leave")
    await settle()
    assert maps.names() == []
    await owner.ask("live-leave", robot=OTHER)
    await settle()
    assert maps.head(MAP).number == 1
    assert maps.head(MAP).keyframes == 2
    reply = await owner.ask("live-publish")
    assert reply == {"name": MAP, "version": maps.head(MAP).id, "number": 1, "keyframes": 2}


async def test_a_map_that_changes_is_published_every_so_often(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rse_pf.server.live_map.map_server.map_server.PUBLISH_INTERVAL_S", 5.0)
    bench = Bench()

    owner = await bench.own("a")
    owner.owner.users = 1
    await owner.keyframe(0)
    await bench.clock.advance(6.0)
    maps = MapRegistry(bench.store, "default")
    assert maps.head(MAP).number == 1
    await bench.clock.advance(12.0)
    assert maps.head(MAP).number == 1  # unchanged
    await owner.keyframe(1)
    await bench.clock.advance(6.0)
    assert maps.head(MAP).number == 2


async def test_an_owner_tells_its_worker_whether_commands_come():
    bench = Bench()

    owner = await bench.own("a")
    owner.owner.users = 1
    await bench.clock.advance(11.0)
    assert owner.used == []
    await owner.keyframe(0)
    await owner.ask("live-show")
    await bench.clock.advance(9.0)
    assert owner.used == [True]
    await bench.clock.advance(2.0)
    assert owner.used == [True, False]


async def test_a_stopped_map_is_published_and_begins_anew_without_its_past():
    bench = Bench()

    owner = await bench.own("a")
    await owner.keyframe(0)
    await settle()
    reply = await owner.ask("live-stop")
    assert reply["keyframes"] == 1
    assert await owner.run == "stopped"
    assert list(bench.store.list(f"{FOLDER}log/")) == []
    base = bench.lease().base
    assert base == owner.log.position
    new = await bench.own("b")
    assert new.state.keyframes == 0
    assert new.log.position == base + 1
    started = await new.ask("live-start", {"from": MAP})
    assert started["keyframes"] == 1
    with pytest.raises(Conflict, match="has begun already"):
        await new.ask("live-start", {"from": MAP})


async def test_an_empty_map_is_told_that_rooms_look_the_same():
    bench = Bench()

    owner = await bench.own("a")
    with pytest.raises(BadRequest):
        await owner.ask("live-start", {"equal_rooms_m": -1.0})
    await owner.ask("live-start", {"equal_rooms_m": 5.0})
    log = LiveLog(bench.store, FOLDER, owner="replay", epoch=1)
    events = [each for entry in log.read_entries() for each in decode_events(entry.events)]
    assert [each.equal_rooms_m for each in events if isinstance(each, MapStarted)] == [5.0]


async def test_an_owner_that_nobody_uses_publishes_and_releases_its_map():
    bench = Bench(idle_s=3.0)

    owner = await bench.own("a")
    await owner.keyframe(0)
    owner.owner.users = 1
    await bench.clock.advance(5.0)
    assert not owner.run.done()
    owner.owner.users = 0
    await bench.clock.advance(5.0)
    assert await owner.run == "released"
    assert MapRegistry(bench.store, "default").head(MAP).keyframes == 1


async def test_a_defect_of_the_map_refuses_one_keyframe_and_the_next_one_is_taken():
    bench = Bench(keeps_all=True)

    owner = await bench.own("a")
    with pytest.raises(InternalError):
        await owner.keyframe(0, b"defect")
    assert (await owner.keyframe(0))["number"] == 1
    assert bench.replayed().keyframes == 1


async def test_updates_name_the_cause_and_a_new_reader_gets_the_present_state():
    bench = Bench()

    owner = await bench.own("a")
    await owner.keyframe(0)
    await bench.clock.advance(1.0)
    assert {payload["kind"] for payload in owner.owner.current_updates()} == {"map", "alignment", "pose"}
    await owner.keyframe(1)
    await bench.clock.advance(1.0)
    assert owner.newest("alignment")["cause"] == {"robot": "robot-1", "number": 1}
    assert owner.newest("pose")["timestamp_s"] == 1.0
    assert owner.owner.current_updates()[0]["kind"] == "map"
    shown = await owner.ask("live-show")
    assert shown["you"] == {"robot": "robot-1", "number": 2, "segment": 1}
    assert shown["robots"][0]["robot"] == ROBOT.name


@pytest.mark.parametrize("operation", ["live-publish", "live-stop"])
async def test_a_map_that_the_registry_refuses_is_an_internal_error_for_who_asks(operation, monkeypatch):
    bench = Bench()

    def refuse(*args: object, **named: object) -> None:
        raise BadRequest("keyframe 1 has no rigid pose", hint="leave it out")

    monkeypatch.setattr(MapRegistry, "commit_charged", refuse)

    owner = await bench.own("a")
    await owner.keyframe(0)
    with pytest.raises(InternalError, match="the live map cannot be published: keyframe 1"):
        await owner.ask(operation, {})
