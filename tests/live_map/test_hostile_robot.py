"""A hostile robot in a live map: it separates nobody for good, and is excluded soon."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np
import pytest

from rse_pf.geometry import inverse
from rse_pf.live_map.decisions import ExcludeSegment, RecordContradictions
from rse_pf.live_map.events import RobotForgotten
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.outcomes import Ambiguous, LoopClosureRejected, Unaligned
from rse_pf.live_map.smoothing import smooth_changes
from tests.kit.generated_drives import GeneratedWorld, circle, first_view
from tests.kit.hostile_robot import HOSTILE, error_cm, joins, play, scenario, without

JOINED = {"a": True, "b": True, "c": True}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_forgetting_a_robot_that_proved_false_aliases_joins_the_others_again(seed: int) -> None:
    events, true = scenario("aliases", seed)
    attacked, clean = play(events), play(without(events, HOSTILE))
    assert joins(attacked.live_map) != JOINED
    restored = LiveMap.restore(attacked.live_map.snapshot())

    for live_map in (attacked.live_map, restored):
        live_map.apply(RobotForgotten(robot=HOSTILE))

    assert joins(attacked.live_map) == joins(clean.live_map) == JOINED
    assert restored.digest() == attacked.live_map.digest()
    assert not attacked.live_map._graph.aliased_keyframes
    assert abs(error_cm(attacked, true[attacked.ids]) - error_cm(clean, true[attacked.ids])) <= 0.1


def test_a_robot_whose_odometry_is_random_is_excluded_and_notified() -> None:
    events, _ = scenario("random-odometry", seed=0, rounds=0.7)
    live_map = LiveMap()
    outcomes = [each for event in events for each in live_map.apply(event)]
    [lying] = [each for each in live_map.alignments() if each.robot == HOSTILE]
    measured_links = [len(each().links) for each in live_map.prepare_measurement(len(live_map._graph) - 1)]

    assert joins(live_map) == JOINED
    assert not lying.aligned
    assert lying.reason.startswith("contradicting: 16 of the last 32 keyframes")
    assert [each for each in outcomes if isinstance(each, Ambiguous | Unaligned) and each.robot == HOSTILE]
    assert measured_links == [0]
    assert LiveMap.restore(live_map.snapshot()).digest() == live_map.digest()


@pytest.mark.parametrize("slip", [0.9, 1.1])
def test_robots_whose_wheels_slip_are_not_excluded(slip: float) -> None:
    world = GeneratedWorld(seed=4, links=3)
    drives = [world.drive(name, circle(1.2, 1.1, phase=phase)) for name, phase in (("a", 0.0), ("b", 2.0))]
    for drive in drives:
        steps = [inverse(one) @ other for one, other in pairwise(drive.T_odom_camera)]
        for number, step in enumerate(steps):
            step[:3, 3] *= slip
            drive.T_odom_camera[number + 1] = drive.T_odom_camera[number] @ step
    live_map = play([*world.play(drives, wrong=0.2)]).live_map

    assert joins(live_map) == {"a": True, "b": True}
    assert max(each.contradictions.bit_count() for each in live_map._graph.segments) <= 4


def test_smoothing_that_a_robot_causes_has_a_budget_of_its_own() -> None:
    world = GeneratedWorld(seed=3, links=4)
    drives = [
        world.drive(name, circle(0.8, 0.6, phase=phase)) for name, phase in (("a", 0.0), (HOSTILE, 0.3))
    ]
    live_map = play([*world.play(drives)]).live_map
    graph = live_map._graph
    assert not graph.smoothing_debt
    # No window is large enough, as if the robot's links moved the graph each time.
    options = LiveMapOptions(
        window_sizes=(5, 10, 20),
        max_border_shift_m=0.0,
        max_border_rotation_deg=0.0,
        smoothing_allowance=10,
        max_smoothing_debt=60,
    )

    def smoothed(robot: str) -> int:
        graph.T_component_camera[:, :3, 3] *= 1.01
        return smooth_changes(graph, [len(graph) // 2], options, robot).keyframe_count

    assert [smoothed(HOSTILE) for _ in range(6)] == [35, 35, 35, 5, 5, 5]
    restored = LiveMap.restore(live_map.snapshot())
    assert restored._graph.smoothing_debt == graph.smoothing_debt == {HOSTILE: 60}
    assert restored.digest() == live_map.digest()
    assert smoothed("a") == 35
    live_map.apply(RobotForgotten(robot=HOSTILE))
    assert HOSTILE not in graph.smoothing_debt


def test_a_robot_that_opens_segments_does_not_lose_its_record() -> None:
    graph = MapGraph()
    graph.add_keyframe(first_view(HOSTILE))
    graph.apply([RecordContradictions(row=0, contradictions=0xFFFFFFFF), ExcludeSegment(row=0, reason="x")])

    later = [first_view(HOSTILE, segment=1, number=1), first_view("a")]
    second, honest = (graph.segment_of(graph.add_keyframe(event)) for event in later)

    assert (second.contradictions, second.is_excluded) == (0xFFFF, False)
    assert (honest.contradictions, honest.is_excluded) == (0, False)


def test_a_snapshot_of_an_earlier_release_is_read() -> None:
    events, _ = scenario("scaled-rotations", seed=0, rounds=0.2)
    live_map = play(events).live_map
    packed = msgspec.msgpack.decode(live_map.snapshot())
    for name in ("removed", "trust", "smoothing"):
        del packed[name]

    restored = LiveMap.restore(msgspec.msgpack.encode(packed))

    assert np.array_equal(restored._graph.T_component_camera, live_map._graph.T_component_camera)
    assert restored.loop_closure_count == live_map.loop_closure_count
    assert not any(
        isinstance(each, LoopClosureRejected) for each in restored.apply(RobotForgotten(robot=HOSTILE))
    )
