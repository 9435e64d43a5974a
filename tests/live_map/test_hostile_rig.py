"""A robot that lies about its rig or its IMU: it is refused, or the other robots of the map are not moved."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, inverse
from rse_pf.live_map.decisions import AddEdges, JoinComponents
from rse_pf.live_map.events import KeyframeAdded, LoopClosuresMeasured, MeasuredLoopClosure, matrix_bytes
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Culled
from rse_pf.live_map.outlier_rejection import find_weakest_connection, has_odometry_jump
from rse_pf.slam.keyframe import decode_keyframe
from tests.kit.generated_drives import first_view
from tests.kit.hostile_rig import (
    ACCEPTED,
    HOSTILE,
    REFUSED,
    Drives,
    Outcome,
    generated_drives,
    jump,
    play,
    tell_truth,
)


@pytest.fixture(scope="module")
def drives() -> Drives:
    return generated_drives(seed=1, keyframes=12)


@pytest.fixture(scope="module")
def alone(drives: Drives) -> Outcome:
    return play(drives, None)


@pytest.fixture(scope="module")
def truthful(drives: Drives) -> Outcome:
    return play(drives, tell_truth)


def same(one: Outcome, other: Outcome) -> bool:
    keys = sorted(one.poses)
    return keys == sorted(other.poses) and all(
        np.array_equal(one.poses[key], other.poses[key]) for key in keys
    )


def test_all_honest_robots_join(alone: Outcome, truthful: Outcome) -> None:
    assert len(alone.poses) == len(truthful.poses) == 36
    assert truthful.has_joined


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_what_cannot_be_true_is_refused_and_changes_nothing(
    name: str, drives: Drives, alone: Outcome
) -> None:
    attacked = play(drives, REFUSED[name])

    assert (attacked.accepted, attacked.refused) == (0, 12)
    assert attacked.why
    assert same(attacked, alone)


@pytest.mark.parametrize("name", sorted(ACCEPTED))
def test_false_blocks_move_nobody(name: str, drives: Drives, truthful: Outcome) -> None:
    attacked = play(drives, ACCEPTED[name])

    assert attacked.accepted == 12
    assert same(attacked, truthful)


def link(other: int, step: Array, inliers: int = 100) -> MeasuredLoopClosure:
    return MeasuredLoopClosure(
        other=other, T_keyframe_other=matrix_bytes(step), information=matrix_bytes(np.eye(6)),
        inliers=inliers, matches=inliers,
    )  # fmt: skip


def step_of(metres: float) -> Array:
    return exp_se3(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0]))


def path(metres: list[float], is_metric: bool = True) -> MapGraph:
    """Return a graph with one robot, whose odometry is at these metres along x, keyframe by keyframe."""
    graph = MapGraph()
    for number, at in enumerate(metres):
        graph.add_keyframe(first_view("x", 0, number, step_of(at), is_metric=is_metric))
    return graph


JUMPED = [0.0, 0.2, 0.4, 0.6, 0.8, 4.0]


@pytest.mark.parametrize(
    ("metres", "links", "is_off"),
    [
        (JUMPED, [link(4, step_of(-0.2))], True),
        (JUMPED, [link(4, step_of(-0.2)), link(3, step_of(-0.4))], True),
        (JUMPED, [link(4, step_of(-0.2)), link(3, step_of(-3.4))], False),  # one of two agrees
        (JUMPED, [link(4, step_of(-0.2), inliers=16)], False),
        (JUMPED, [link(0, step_of(-1.0))], False),  # long before: the place may look like another one
        (JUMPED, [], False),
        ([0.0, 0.2, 0.4, 0.6, 0.8, 1.7], [link(4, step_of(-0.2))], False),
        ([0.0, 5.0, 10.0, 15.0, 20.0, 25.0], [link(4, step_of(-3.8))], False),  # a car
    ],
)
def test_odometry_has_jumped_where_all_keyframes_just_before_contradict_it(
    metres: list[float], links: list[MeasuredLoopClosure], is_off: bool
) -> None:
    assert has_odometry_jump(path(metres), 5, links) is is_off
    assert not has_odometry_jump(path(metres, is_metric=False), 5, links)


def test_a_keyframe_after_a_jump_is_compared_with_nothing_and_counts_as_a_contradiction(
    drives: Drives,
) -> None:
    live_map = LiveMap()
    for number, data in enumerate(drives[HOSTILE][:5]):
        sent = jump(number, decode_keyframe(data))
        live_map.apply(KeyframeAdded(robot=HOSTILE, segment=0, number=number, data=sent))
    true = [decode_keyframe(each).T_odom_camera for each in drives[HOSTILE][3:5]]
    measured = LoopClosuresMeasured(keyframe=4, links=(link(3, inverse(true[1]) @ true[0]),), failed={})

    outcomes = live_map.apply(measured)

    assert Culled(ids=(4,)) in outcomes
    assert not live_map._graph.edges
    assert live_map._graph.segments[0].contradictions == 1
    assert not live_map._graph.has_features[4]
    assert LiveMap.restore(live_map.snapshot()).digest() == live_map.digest()


@pytest.mark.parametrize(("is_metric", "weakest"), [(True, ("a", "b")), (False, ("b", "x"))])
def test_a_robot_without_metres_separates_no_two_robots_with_metres(
    is_metric: bool, weakest: tuple[str, str]
) -> None:
    graph = MapGraph()
    for robot in ("a", "b", "x"):
        graph.add_keyframe(first_view(robot))
    graph.segments[2].is_metric = is_metric
    for one, other, count in ((0, 1, 1), (1, 2, 5)):
        numbers = list(range(graph.next_edge, graph.next_edge + count))
        graph.apply(
            [
                AddEdges(keyframe=one, measured=[link(other, np.eye(4))] * count),
                JoinComponents(moving=other, T_stay_moving=np.eye(4), scale=1.0, numbers=numbers),
            ]
        )

    numbers = find_weakest_connection(graph, 0, 2)

    ends = {(graph.edges[number].a, graph.edges[number].b) for number in numbers}
    assert ends == {tuple("abx".index(robot) for robot in weakest)}
