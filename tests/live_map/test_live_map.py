"""The live map as a state machine: generated drives with known true poses and wrong loop closures."""

from __future__ import annotations

import copy as copy_module
import dataclasses
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference
from rse_pf.live_map.candidates import choose_candidates
from rse_pf.live_map.events import (
    Event,
    LoopClosuresMeasured,
    MapStarted,
    Optimised,
    RobotForgotten,
    RobotLeft,
    decode_events,
    encode_events,
    matrix_bytes,
)
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.outcomes import (
    Added,
    Ambiguous,
    Corrected,
    Joined,
    LoopClosureRejected,
    Outcome,
    Unaligned,
)
from rse_pf.live_map.versions import started_from
from rse_pf.slam.keyframe import encode_keyframe
from tests.kit.generated_drives import GeneratedDrive, GeneratedWorld, circle, make_link, straight

ROUND = circle(0.5, 1.2)


class Run:
    """A map, its events, and the outcomes of each event."""

    def __init__(self, world: GeneratedWorld) -> None:
        self.world, self.map = world, LiveMap()
        self.log: list[Event] = []
        self.outcomes: list[tuple[int, Outcome]] = []

    def apply(self, event: Event) -> list[Outcome]:
        found = self.map.apply(event)
        self.log.append(event)
        self.outcomes += [(len(self.world.seen), each) for each in found]
        return found

    def play(self, drives: list[GeneratedDrive], wrong: float = 0.0) -> Run:
        for event in self.world.play(drives, wrong):
            self.apply(event)
        return self

    def of(self, kind: type[Outcome]) -> list[Outcome]:
        return [each for _, each in self.outcomes if isinstance(each, kind)]

    def worst_error(self, ids: range) -> tuple[float, float]:
        """Return how far keyframes are from their true place relative to keyframe 0: metres, degrees."""
        map_0, true_0 = inverse(self.map.pose(0)), inverse(self.world.seen[0])
        apart = [pose_difference(map_0 @ self.map.pose(i), true_0 @ self.world.seen[i]) for i in ids]
        return max(each[0] for each in apart), max(each[1] for each in apart)


def two_robots(seed: int = 1, wrong: float = 0.0) -> Run:
    world = GeneratedWorld(seed=seed)
    return Run(world).play([world.drive("a", ROUND), world.drive("b", circle(0.5, 1.2, phase=3.0))], wrong)


def copy_of(run: Run) -> Run:
    """Return a run that goes on from *run* without changing it."""
    copy = Run(copy_module.copy(run.world))
    copy.world.seen = list(run.world.seen)
    copy.map = LiveMap.restore(run.map.snapshot())
    return copy


@pytest.fixture(scope="module")
def joined() -> Run:
    return two_robots(wrong=0.3)


def test_two_robots_in_one_place_share_one_frame(joined: Run) -> None:
    metres, degrees = joined.worst_error(range(len(joined.world.seen)))

    assert [each.robot for each in joined.of(Joined)] == ["a", "b"]
    assert metres < 0.05
    assert degrees < 2.0


def test_random_wrong_loop_closures_are_not_accepted(joined: Run) -> None:
    true = joined.world
    for link in joined.map._graph.edges.values():
        if link.state == "accepted":
            metres, degrees = pose_difference(link.T_a_b, inverse(true.seen[link.a]) @ true.seen[link.b])
            assert metres < 0.2
            assert degrees < 10.0


def test_a_replay_is_equal_to_the_byte(joined: Run) -> None:
    again = LiveMap()
    for event in decode_events(encode_events(joined.log)):
        again.apply(event)

    assert again.digest() == joined.map.digest()
    assert again.snapshot() == joined.map.snapshot()


@pytest.mark.parametrize("share", [0.6, pytest.param(0.3, marks=pytest.mark.slow)])
def test_a_snapshot_and_the_events_after_it_give_the_same_map(joined: Run, share: float) -> None:
    half = int(share * len(joined.log))
    first = LiveMap()
    for event in joined.log[:half]:
        first.apply(event)
    second = LiveMap.restore(first.snapshot())
    for event in joined.log[half:]:
        second.apply(event)

    assert second.digest() == joined.map.digest()


def test_a_snapshot_in_parts_is_the_same_map_and_writes_what_is_new() -> None:
    world = GeneratedWorld(seed=6)
    run = _unmeasured(world, 135)
    store: dict[str, bytes] = {}

    first = run.map.snapshot_parts()
    store |= {name: data for name, data in first.parts.items() if data is not None}
    again = LiveMap.restore_parts(first.head, store.__getitem__)
    late = world.drive("b", ROUND[:2])
    run.apply(world.keyframe(late, 0))
    again.apply(run.log[-1])
    second = again.snapshot_parts(store)

    assert again.snapshot() == run.map.snapshot()
    assert [data is None for data in second.parts.values()] == [True, False]
    assert len(first.parts) == 2


def test_a_part_is_encoded_again_when_half_of_its_features_were_dropped() -> None:
    run = _unmeasured(GeneratedWorld(seed=6), 128)
    first = run.map.snapshot_parts()
    for i in range(64):
        run.map._graph.drop_features(i)
        run.map._places.remove(i)
    second = run.map.snapshot_parts(first.parts)
    run.map._graph.drop_features(64)
    run.map._places.remove(64)
    third = run.map.snapshot_parts(first.parts)
    again = LiveMap.restore_parts(second.head, lambda name: first.parts[name] or b"")

    assert second.parts == dict.fromkeys(first.parts)
    assert third.parts.keys() != first.parts.keys()
    assert again.keyframes == 64


def test_what_a_forgotten_robot_saw_is_in_no_part() -> None:
    world = GeneratedWorld(seed=6)
    run = _unmeasured(world, 130)
    before = run.map.snapshot_parts()
    run.apply(RobotForgotten(robot="a"))
    after = run.map.snapshot_parts(before.parts)

    assert not set(before.parts) & set(after.parts)
    assert max(len(data) for data in after.parts.values() if data is not None) < 16


def test_a_missing_or_damaged_part_is_refused(joined: Run) -> None:
    whole = joined.map.snapshot_parts()
    with pytest.raises(BadRequest):
        LiveMap.restore_parts(whole.head, lambda name: b"\x90")
    with pytest.raises(BadRequest):
        LiveMap.restore_parts(whole.head[:-9], lambda name: whole.parts[name] or b"")


@pytest.mark.parametrize("version", [1, 3])
def test_a_snapshot_of_another_version_is_refused_with_how_to_publish_first(
    joined: Run, version: int
) -> None:
    packed = msgspec.msgpack.decode(joined.map.snapshot())
    packed["version"] = version

    with pytest.raises(BadRequest, match=f"the snapshot is of version {version}, not 2") as refused:
        LiveMap.restore(msgspec.msgpack.encode(packed))

    assert "rse-pf map publish MAP" in refused.value.hint


def test_a_damaged_snapshot_is_refused(joined: Run) -> None:
    with pytest.raises(BadRequest):
        LiveMap.restore(joined.map.snapshot()[:-100])


@pytest.mark.parametrize(
    "damage",
    [
        lambda packed: packed["segments"][0][2].append(10**6),
        lambda packed: packed["arrays"].pop(),
        lambda packed: packed.update(arrays=[packed["arrays"][0][:-8], *packed["arrays"][1:]]),
        lambda packed: packed["links"][0].__setitem__(3, b"short"),
        lambda packed: packed["extra"].clear(),
        lambda packed: packed.update(extra=[["places", 2 * dict(packed["extra"])["places"]]]),
    ],
)
def test_a_snapshot_whose_tables_contradict_each_other_is_refused(
    joined: Run, damage: Callable[[dict[str, Any]], None]
) -> None:
    packed = msgspec.msgpack.decode(joined.map.snapshot())
    damage(packed)

    with pytest.raises(BadRequest, match="the snapshot is damaged") as refused:
        LiveMap.restore(msgspec.msgpack.encode(packed))

    assert refused.value.hint


def test_inconsistent_loop_closures_join_nothing() -> None:
    run, world = _two_apart()
    rng = np.random.default_rng(3)
    for k in range(12, 18):
        off = exp_se3(np.r_[rng.uniform(-2, 2, 3), rng.uniform(-1, 1, 3)])
        run.apply(LoopClosuresMeasured(keyframe=k, links=(make_link(k - 12, world.step(k, k - 12) @ off),)))

    assert [each.robot for each in run.of(Joined)] == ["a"]


def test_loop_closures_of_one_keyframe_join_nothing() -> None:
    run, world = _two_apart()
    links = tuple(world.true_link(12, other) for other in (0, 1, 2, 3))
    run.apply(LoopClosuresMeasured(keyframe=12, links=links))

    assert run.of(Ambiguous) == []
    assert [each.robot for each in run.of(Joined)] == ["a"]


def test_robots_of_one_component_need_one_loop_closure_only() -> None:
    """Robot c is in the component of robot a through robot b, so one loop closure with a is accepted."""
    world = GeneratedWorld(seed=5, links=0)
    drives = [world.drive(name, ROUND[:12]) for name in ("a", "b", "c")]
    run = Run(world)
    for drive in drives:
        for number in range(12):
            run.apply(world.keyframe(drive, number))
    for k, others in ((12, range(4)), (24, range(12, 16))):
        for step, other in enumerate(others):
            run.apply(LoopClosuresMeasured(keyframe=k + step, links=(world.true_link(k + step, other),)))
    believed = run.map.loop_closure_count
    run.apply(LoopClosuresMeasured(keyframe=27, links=(world.true_link(27, 3),)))

    assert len(run.of(Joined)) == 3
    assert run.map.loop_closure_count == believed + 1


def test_planted_loop_closures_are_rejected_soon_after_contrary_evidence() -> None:
    run, world = _two_apart()
    wrong = exp_se3([1.5, 0.3, 0.0, 0.0, 0.4, 0.0])
    for k in range(12, 16):
        planted = inverse(world.seen[k]) @ _moved(world, wrong) @ world.seen[k - 12]
        run.apply(LoopClosuresMeasured(keyframe=k, links=(make_link(k - 12, planted),)))
    assert [each.robot for each in run.of(Joined)] == ["a", "b"]
    later = 0
    while not run.of(LoopClosureRejected) and later < 20:
        k = 16 + later
        links = tuple(world.true_link(k, k - 12 + near) for near in (0, 1))
        run.apply(LoopClosuresMeasured(keyframe=k, links=links))
        later += 1

    assert later <= 20
    assert len(run.of(LoopClosureRejected)) == 4
    assert run.worst_error(range(len(world.seen)))[0] < 0.1


def test_a_robot_keeps_its_alignment_when_the_first_robot_is_forgotten(joined: Run) -> None:
    run = copy_of(joined)
    told = run.apply(RobotForgotten(robot="a"))
    aligned = {each.robot: each.aligned for each in run.map.alignments()}

    assert aligned == {"b": True}  # robot b defines the frame of the map now
    assert not [each for each in told if isinstance(each, Unaligned)]
    assert run.map.contributors == ("b",)


def test_a_robot_that_drives_between_equal_rooms_proves_them_ambiguous() -> None:
    world = GeneratedWorld(seed=2, twin_m=6.0, links=2)
    way = np.column_stack([np.arange(0.0, 7.2, 0.1), np.zeros(72)])
    run = Run(world).play([world.drive("a", way[:12]), world.drive("c", way), world.drive("b", way[60:])])
    aligned = {each.robot: each for each in run.map.alignments()}

    assert run.of(Ambiguous)
    assert not aligned["b"].aligned
    assert aligned["b"].reason.startswith("ambiguous")


def test_a_robot_that_meets_in_the_second_of_equal_rooms_whom_it_met_in_the_first_proves_it() -> None:
    """Its new views match those of the other robot, not its own of the first room."""
    world = GeneratedWorld(seed=3, links=0)
    c, b = world.drive("c", straight(0.0, 8.0)), world.drive("b", straight(6.0, 8.0))
    steps = len(b.T_world_camera)
    live_map, outcomes = LiveMap(), list[Outcome]()
    for drive, count in ((c, len(c.T_world_camera)), (b, steps)):
        for number in range(count):
            live_map.apply(world.keyframe(drive, number))
    first_b, in_second = len(c.T_world_camera), len(c.T_world_camera) - steps
    shift = world.seen[0] @ inverse(world.seen[in_second])
    for near in range(3 * steps):  # more than the map ever tests at once
        k = first_b + near % steps
        other = (near % steps + near // steps) % steps
        link = make_link(other, inverse(world.seen[k]) @ inverse(shift) @ world.seen[other])
        live_map.apply(LoopClosuresMeasured(keyframe=k, links=(link,)))
    assert live_map.alignment_of("b", 0).aligned  # type: ignore[union-attr]
    for number in range(steps):
        link = world.true_link(in_second + number, first_b + number)
        outcomes += live_map.apply(LoopClosuresMeasured(keyframe=in_second + number, links=(link,)))

    found = live_map.alignment_of("b", 0)
    assert found is not None
    assert not found.aligned
    assert found.reason.startswith("ambiguous")
    assert any(isinstance(each, Unaligned) for each in outcomes)


def test_robots_in_rooms_that_may_be_equal_are_joined_by_more_than_a_room() -> None:
    """Two equal rooms and one room give the same loop closures, so an operator states the size of rooms."""
    world = GeneratedWorld(seed=2, links=2)
    way = np.column_stack([np.arange(0.0, 3.0, 0.1), np.zeros(30)])
    run = Run(world)
    run.apply(MapStarted(source="", keyframes=(), equal_rooms_m=1.5))
    run.play([world.drive("a", way), world.drive("b", way)])
    joined_m = [world.seen[at - 1][0, 3] for at, each in run.outcomes if isinstance(each, Joined)]

    assert run.of(Ambiguous)[0].reason.endswith("within 1.5 m, the size of equal rooms")
    assert len(joined_m) == 2
    assert 1.5 < joined_m[1] < 2.2
    assert LiveMap.restore(run.map.snapshot()).snapshot() == run.map.snapshot()


def test_an_overloaded_map_server_compares_a_keyframe_with_few_and_none_of_just_before() -> None:
    world = GeneratedWorld(seed=1)
    live_map, drive = LiveMap(LiveMapOptions(candidates=1000)), world.drive("a", straight(0.0, 9.0))
    for number in range(60):
        live_map.apply(world.keyframe(drive, number))
    assert len(live_map.prepare_measurement(59, 100, 4)) == 4
    graph, places = live_map._graph, live_map._places
    assert max(choose_candidates(graph, places, 59, 1000)) > 50
    assert max(choose_candidates(graph, places, 59, 1000, is_overloaded=True)) < 50


def test_a_keyframe_is_new_known_or_ahead() -> None:
    world = GeneratedWorld(seed=1)
    drive = world.drive("a", ROUND)
    live = LiveMap()
    first, second = world.keyframe(drive, 0), world.keyframe(drive, 1)

    assert (live.check_keyframe(first), live.check_keyframe(second)) == ("new", "ahead")
    live.apply(first)
    assert (live.check_keyframe(first), live.check_keyframe(second)) == ("known", "new")
    assert live.next_number("a") == 1


@pytest.mark.parametrize(
    "change",
    [
        {"data": b"short"},
        {"T_odom_camera": np.full((4, 4), np.nan)},
        {"T_odom_camera": 2.0 * np.eye(4)},
        {"T_odom_camera": exp_se3([2e6, 0, 0, 0, 0, 0])},
        {"timestamp_s": float("nan")},
        {"timestamp_s": 2e12},
        {"segment": -1},
    ],
)
def test_malformed_keyframes_are_refused_before_they_are_logged(change: dict[str, Any]) -> None:
    world = GeneratedWorld(seed=1)
    good = world.keyframe(world.drive("a", ROUND), 0)
    live = LiveMap()
    before = live.digest()
    in_event = {name: value for name, value in change.items() if name in good.__struct_fields__}
    in_keyframe = {name: value for name, value in change.items() if name not in in_event}
    data = encode_keyframe(dataclasses.replace(good.keyframe, **in_keyframe))
    event = msgspec.structs.replace(good, **{"data": data, **in_event})

    with pytest.raises(BadRequest):
        live.check_keyframe(event)
    assert live.digest() == before


def test_loop_closures_of_forgotten_keyframes_change_nothing(joined: Run) -> None:
    run = copy_of(joined)
    newest = len(run.world.seen) - 1
    late = LoopClosuresMeasured(
        keyframe=newest, links=tuple(run.world.true_link(newest, i) for i in (0, 2, 4))
    )
    run.apply(RobotForgotten(robot="b"))
    believed = run.map.loop_closure_count

    measured = len(run.map._graph.edges)
    assert run.apply(late) == []
    assert len(run.map._graph.edges) == measured
    assert run.apply(LoopClosuresMeasured(keyframe=10_000)) == []
    assert run.map.loop_closure_count == believed


def test_a_forgotten_robot_that_drives_on_is_a_new_trajectory(joined: Run) -> None:
    run = copy_of(joined)
    number = run.map.next_number("b")
    run.apply(RobotForgotten(robot="b"))
    world = run.world
    drive = world.drive("b", ROUND)
    added = run.apply(world.keyframe(drive, 0, first=number))

    assert isinstance(added[0], Added)
    assert run.map.next_number("b") == number + 1


def test_a_robot_that_left_has_no_alignment_but_stays_in_the_map(joined: Run) -> None:
    run = copy_of(joined)
    keyframes = run.map.keyframes
    run.apply(RobotLeft(robot="b"))

    assert [each.robot for each in run.map.alignments()] == ["a"]
    assert run.map.keyframes == keyframes
    assert run.map.contributors == ("a", "b")


def test_an_optimisation_moves_later_keyframes_along(joined: Run) -> None:
    run = copy_of(joined)
    found = run.map.optimise()
    ids, poses = found.ids[:-1], np.frombuffer(found.T_map_camera).reshape(-1, 4, 4)[:-1]
    shifted = exp_se3([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]) @ poses
    old = run.map.pose(found.ids[-1])
    told = run.apply(Optimised(up_to=found.up_to, ids=ids, T_map_camera=matrix_bytes(shifted)))

    assert len([each for each in told if isinstance(each, Corrected)]) == 2
    assert run.map.pose(found.ids[-1])[2, 3] - old[2, 3] == pytest.approx(0.1, abs=0.03)


def test_a_map_goes_on_from_the_version_that_it_became(joined: Run) -> None:
    run = copy_of(joined)
    version = run.map.to_version()
    started = LiveMap()
    started.apply(started_from(version, "kitchen@1"))
    newest = len(version.keyframes)
    world = run.world
    drive = world.drive("c", ROUND[:8])
    again = Run(world)
    again.map = started
    held = [each.id for each in version.keyframes]
    offset = len(world.seen)
    for number in range(8):
        again.apply(world.keyframe(drive, number))
        here = world.seen[offset + number]
        rows = sorted(range(newest), key=lambda row: _apart(world.seen[held[row]], here))[:3]
        links = tuple(make_link(row, inverse(here) @ world.seen[held[row]]) for row in rows)
        again.apply(LoopClosuresMeasured(keyframe=newest + number, links=links))

    assert [each.robot for each in again.of(Joined)] == ["c"]
    assert started.alignment_of("c", 0).aligned
    assert again.map.to_version().keyframes[0].robot == version.keyframes[0].robot


@pytest.mark.slow
def test_redundant_keyframes_lose_their_features_only() -> None:
    world = GeneratedWorld(seed=4)
    run = Run(world).play([world.drive("a", circle(0.3, 5.0))])

    assert run.map.keyframes < 0.8 * len(world.seen)
    assert run.worst_error(range(len(world.seen)))[0] < 0.05


def _unmeasured(world: GeneratedWorld, count: int) -> Run:
    """Return a map of one robot whose keyframes were never measured."""
    run, drive = Run(world), world.drive("a", circle(0.8, 3.0)[:count])
    for number in range(count):
        run.apply(world.keyframe(drive, number))
    return run


def _two_apart() -> tuple[Run, GeneratedWorld]:
    """Return a map of two robots, 12 and 36 keyframes, without any loop closure."""
    world = GeneratedWorld(seed=5, links=0, drift_m=0.001, drift_deg=0.05)
    run = Run(world)
    a, b = world.drive("a", ROUND[:12]), world.drive("b", ROUND[:36])
    for number in range(12):
        run.apply(world.keyframe(a, number))
    for number in range(36):
        run.apply(world.keyframe(b, number))
    return run, world


def _moved(world: GeneratedWorld, off: Array) -> Array:
    """Return the motion of the world that is *off* in the frame of its first keyframe."""
    moved: Array = world.seen[0] @ off @ inverse(world.seen[0])
    return moved


def _apart(one: Array, other: Array) -> float:
    metres, degrees = pose_difference(one, other)
    return metres + 0.02 * degrees
