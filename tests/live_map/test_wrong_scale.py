"""A robot whose metric scale differs from that of two others: its loop closures show it; it is excluded."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from rse_pf.live_map.events import KeyframeAdded, LoopClosuresMeasured, MeasuredLoopClosure, matrix_bytes
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.measure import measure_loop_closures
from rse_pf.live_map.outcomes import Outcome, Unaligned
from rse_pf.live_map.outlier_rejection import decide_exclusion, has_wrong_scale
from rse_pf.slam.keyframe import decode_keyframe, make_features
from tests.kit.generated_drives import GeneratedWorld, circle, first_view
from tests.kit.hostile_rig import generated_drives


def graph_of(*robots: str) -> MapGraph:
    """Return a graph with one keyframe of each robot, without loop closures."""
    graph = MapGraph()
    for robot in robots:
        graph.add_keyframe(first_view(robot))
    return graph


def link(other: int, off_scale: float, inliers: int = 100) -> MeasuredLoopClosure:
    return MeasuredLoopClosure(
        other=other, T_keyframe_other=matrix_bytes(np.eye(4)), information=matrix_bytes(np.eye(6)),
        inliers=inliers, matches=inliers, off_scale=off_scale,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("links", "is_other"),
    [
        ([link(1, 0.1), link(2, 0.08)], True),
        ([link(1, -0.1), link(2, -0.3)], True),
        ([link(1, 0.1)], False),  # of two robots nobody knows which one is wrong
        ([link(1, 0.1), link(2, 0.0)], False),
        ([link(1, 0.1), link(2, -0.1)], False),
        ([link(1, 0.1), link(2, 0.1), link(3, 0.0)], False),
        ([link(1, 0.1), link(2, 0.1, inliers=16)], False),
        ([link(0, 0.1), link(1, 0.1)], False),
        ([], False),
    ],
)
def test_a_scale_is_wrong_where_two_robots_differ_alike(
    links: list[MeasuredLoopClosure], is_other: bool
) -> None:
    graph = graph_of("x", "a", "b", "c")

    assert has_wrong_scale(graph, 0, links) is is_other


def test_robots_without_metric_scale_are_no_evidence() -> None:
    graph = graph_of("x", "a", "b")
    graph.segments[1].is_metric = False

    assert not has_wrong_scale(graph, 0, [link(1, 0.1), link(2, 0.1)])


def test_after_eight_keyframes_with_a_wrong_scale_a_robot_is_excluded() -> None:
    graph = graph_of("x", "a", "b")

    excluded = [
        graph.apply(decide_exclusion(graph, 0, is_contrary=True, is_scale_wrong=True)) for _ in range(8)
    ]

    assert [len(outcomes) for outcomes in excluded] == [0] * 7 + [1]
    assert graph.segments[0].is_excluded
    assert graph.segments[0].reason == "contradicting: its metres are not those of two other robots"
    assert not graph.segments[1].is_excluded


@pytest.mark.parametrize(("factor", "least"), [(1.0, 0.0), (1.1, 0.06), (1 / 1.1, 0.06), (1.5, 0.3)])
def test_depths_of_both_keyframes_give_the_ratio_of_their_scales(factor: float, least: float) -> None:
    sent = generated_drives(seed=1, keyframes=6)["a"]
    one, other = (decode_keyframe(data) for data in sent[2:4])
    seen = other.features
    false = make_features(seen.pixels, factor * seen.depths_m, seen.descriptors, seen.noise, seen.kind, 0.0)

    (measured,) = measure_loop_closures((0, one.features, one.camera), [(1, false, other.camera)]).links

    # The second robot's metre is shorter if its depths are too large.
    off_scale = measured.off_scale or 0.0
    assert -off_scale * math.copysign(1.0, math.log(factor)) >= least
    assert abs(off_scale) <= 1.3 * abs(math.log(factor))


@pytest.mark.parametrize(("off_scale", "gone"), [(0.1, {"x"}), (None, set())])
def test_a_map_unaligns_a_robot_whose_loop_closures_show_a_wrong_scale(
    off_scale: float | None, gone: set[str]
) -> None:
    world, live = GeneratedWorld(seed=1), LiveMap()
    drives = [world.drive(name, circle(0.5, 1.2, phase=row)) for row, name in enumerate(("a", "b", "x"))]
    outcomes: list[Outcome] = []
    robots: list[str] = []
    for event in world.play(drives):
        if isinstance(event, KeyframeAdded):
            robots.append(event.robot)
        if isinstance(event, LoopClosuresMeasured) and robots[event.keyframe] == "x":
            links = tuple(msgspec.structs.replace(each, off_scale=off_scale) for each in event.links)
            event = msgspec.structs.replace(event, links=links)
        outcomes += live.apply(event)

    said = [each for each in outcomes if isinstance(each, Unaligned) and "metres" in each.reason]
    assert {each.robot for each in said} == gone
