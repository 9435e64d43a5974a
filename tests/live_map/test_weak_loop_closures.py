"""A loop closure with few inliers has partial weight: it joins robots together with others only."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from rse_pf.geometry import exp_se3, inverse
from rse_pf.live_map.events import LoopClosuresMeasured, MeasuredLoopClosure
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.smoothing import select_edges
from rse_pf.slam.consistency import evidence_weight
from tests.kit.generated_drives import GeneratedWorld, circle, make_link

WEAK_INLIERS = 20
"""Inliers of a loop closure with a weight of two thirds."""


@pytest.mark.parametrize(
    ("inliers", "matches", "weight"), [(30, 60, 1.0), (90, 100, 1.0), (15, 20, 0.5), (60, 240, 0.5)]
)
def test_the_weight_is_the_smaller_one_by_inliers_and_by_inlier_ratio(
    inliers: int, matches: int, weight: float
) -> None:
    assert evidence_weight(inliers, matches) == weight


def test_three_weak_loop_closures_that_agree_join_nothing_and_five_do() -> None:
    live_map, world = two_apart()

    joined = [add(live_map, 12 + k, weak(world.true_link(12 + k, k))) for k in range(5)]

    assert joined == [False, False, False, False, True]
    assert live_map.loop_closure_count == 5


def test_weak_loop_closures_add_to_those_of_full_weight() -> None:
    live_map, world = two_apart()

    joined = [add(live_map, 12 + k, world.true_link(12 + k, k)) for k in range(2)]
    joined += [add(live_map, 12 + k, weak(world.true_link(12 + k, k))) for k in (2, 3)]

    assert joined == [False, False, False, True]


def test_full_weight_joins_although_more_weak_loop_closures_agree_on_another_place() -> None:
    live_map, world = two_apart()
    off = exp_se3([1.5, 0.3, 0.0, 0.0, 0.4, 0.0])
    moved = world.seen[0] @ off @ inverse(world.seen[0])
    for k in range(4):
        planted = make_link(k, inverse(world.seen[12 + k]) @ moved @ world.seen[k], 15)
        add(live_map, 12 + k, weak(planted, 15))

    joined = [add(live_map, 16 + k, world.true_link(16 + k, 4 + k)) for k in range(3)]

    assert joined == [False, False, True]
    assert {(a, b) for a, b, _ in live_map.accepted_loop_closures()} == {(16, 4), (17, 5), (18, 6)}


def test_a_weak_loop_closure_is_accepted_where_no_full_weight_one_connects_its_keyframe() -> None:
    live_map, world = joined_robots()
    before = live_map.loop_closure_count

    add(
        live_map, 15, weak(world.true_link(15, 4))
    )  # keyframe 15 has a full-weight loop closure with the other robot
    tied = live_map.loop_closure_count
    add(live_map, 17, weak(world.true_link(17, 5)))

    assert (tied, live_map.loop_closure_count) == (before, before + 1)


def test_weak_loop_closures_that_contradict_the_map_do_not_exclude_their_robot() -> None:
    live_map, world = joined_robots()
    rng = np.random.default_rng(2)

    for k in range(16, 48):
        off = exp_se3(np.r_[rng.uniform(1.0, 2.0, 3), rng.uniform(-1.0, 1.0, 3)])
        add(live_map, k, make_link(k - 12, world.step(k, k - 12) @ off, WEAK_INLIERS))

    assert [each.aligned for each in live_map.alignments()] == [True, True]
    assert not any(segment.is_excluded for segment in live_map._graph.segments)
    assert live_map.loop_closure_count == 4


def test_the_information_of_a_weak_loop_closure_is_reduced() -> None:
    live_map, world = joined_robots()
    strong, few = world.true_link(17, 5), weak(world.true_link(18, 6))
    for k, link in ((17, strong), (18, few)):
        add(live_map, k, link)

    edges = select_edges(live_map._graph, [17, 18])
    of_links = edges.information[edges.numbers >= 0]

    np.testing.assert_allclose(of_links[1], of_links[0] * (2.0 / 3.0) ** 2)


def test_random_wrong_loop_closures_with_few_inliers_are_not_accepted() -> None:
    world = GeneratedWorld(seed=4, wrong_inliers=WEAK_INLIERS)
    live_map = LiveMap()
    drives = [world.drive(name, circle(0.5, 1.2, phase)) for name, phase in (("a", 0.0), ("b", 3.0))]

    for event in world.play(drives, wrong=0.4):
        live_map.apply(event)

    assert world.wrong_sent > 20
    for a, b, T_a_b in live_map.accepted_loop_closures():
        off = inverse(T_a_b) @ inverse(world.seen[a]) @ world.seen[b]
        assert float(np.linalg.norm(off[:3, 3])) < 0.2


def weak(link: MeasuredLoopClosure, inliers: int = WEAK_INLIERS) -> MeasuredLoopClosure:
    return msgspec.structs.replace(link, inliers=inliers, matches=3 * inliers // 2)


def add(live_map: LiveMap, keyframe: int, link: MeasuredLoopClosure) -> bool:
    """Add a measured loop closure of *keyframe* to the map; return whether all robots are aligned now."""
    live_map.apply(LoopClosuresMeasured(keyframe=keyframe, links=(link,)))
    return all(each.aligned for each in live_map.alignments())


def two_apart() -> tuple[LiveMap, GeneratedWorld]:
    """Return a map of two robots, 12 and 36 keyframes along the same path, without any loop closure."""
    world = GeneratedWorld(seed=5, links=0, drift_m=0.001, drift_deg=0.05)
    live_map = LiveMap()
    way = circle(0.5, 1.2)
    for name, count in (("a", 12), ("b", 36)):
        drive = world.drive(name, way[:count])
        for number in range(count):
            live_map.apply(world.keyframe(drive, number))
    return live_map, world


def joined_robots() -> tuple[LiveMap, GeneratedWorld]:
    """Return the map of `two_apart` after full-weight loop closures of the keyframes 12 to 15 joined it."""
    live_map, world = two_apart()
    for k in range(12, 16):
        add(live_map, k, world.true_link(k, k - 12))
    assert live_map.loop_closure_count == 4
    return live_map, world
