"""Maps are merged by consistent loop closures; other maps are left out with a reason."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from rse_pf.errors import Cancelled, MissingExtra
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference
from rse_pf.maps.format import MapVersion, decode_map, encode_map
from rse_pf.service import Report
from rse_pf.services.mapping.merge import MergeRequest, merge_maps
from rse_pf.slam.consistency import LoopClosure, OdometryNoise, find_consistent_set, find_maximum_clique
from rse_pf.slam.map_merge import (
    Atlas,
    LoopProposals,
    MergedMap,
    MergeOptions,
    MergeSteps,
    merge_versions,
    propose_loop_closures,
)
from rse_pf.slam.optimise import ignore_progress
from tests.kit.default_cases import first_by_default
from tests.kit.synthetic_maps import make_world

pytest.importorskip("gtsam", reason="the extra maps is not installed")

WORLD = make_world(1)


@functools.cache
def two_robots() -> tuple[list[MapVersion], list[Array]]:
    """Return the maps and true poses of two robots that both see the second quarter of the hall."""
    a, truth_a = WORLD.walk("a", np.linspace(0.0, 0.5, 13), seed=1)
    b, truth_b = WORLD.walk("b", np.linspace(0.3, 0.8, 13), seed=2)
    return [a, b], [truth_a, truth_b]


@functools.cache
def merged_without_wrong_links() -> MergedMap:
    """Return the map of `two_robots`."""
    return merge_versions(two_robots()[0])


def rmse_m(merged: MergedMap, truth: Array) -> float:
    """Return the root mean square error of keyframe positions in metres, in the frame of the first pose."""
    estimate = np.array([each.T_world_camera for each in merged.version.keyframes])
    start = inverse(estimate[0])
    true_start = inverse(truth[0])
    off = [(start @ e)[:3, 3] - (true_start @ t)[:3, 3] for e, t in zip(estimate, truth, strict=True)]
    return float(np.sqrt((np.array(off) ** 2).sum(axis=1).mean()))


def test_two_maps_that_share_views_become_one() -> None:
    _, truths = two_robots()

    merged = merged_without_wrong_links()

    assert merged.joined == (0, 1)
    assert merged.merges >= 3
    origin = merged.version.keyframes[13].T_world_camera
    metres, degrees = pose_difference(origin, inverse(truths[0][0]) @ truths[1][0])
    assert metres <= 0.1
    assert degrees <= 2.5
    assert {edge.kind for edge in merged.version.edges} >= {"odometry", "merge"}
    assert [row[0] for row in merged.version.provenance["from"]] == [0] * 13 + [1] * 13


def test_maps_that_share_no_view_are_not_joined_and_the_reason_is_reported() -> None:
    here, _ = WORLD.walk("a", np.linspace(0.0, 0.3, 8), seed=1)
    elsewhere, _ = make_world(2).walk("b", np.linspace(0.0, 0.3, 8), seed=2)

    merged = merge_versions([here, elsewhere])

    assert merged.joined == (0,)
    assert merged.merges == 0
    ((which, reason),) = merged.not_joined
    assert which == 1
    assert "no-matches" in reason
    assert len(merged.version.keyframes) == 8


def planted(share: float, seed: int):  # type: ignore[no-untyped-def]
    """Return a function that proposes loop closures, of which *share* are replaced by wrong ones."""

    def propose(atlas: Atlas, options: MergeOptions, report: Report) -> LoopProposals:
        found = propose_loop_closures(atlas, options, report)
        rng = np.random.default_rng(seed)
        links = list(found.loop_closures)
        for k in rng.choice(len(links), max(1, round(share * len(links))), replace=False).tolist():
            wrong = links[k].T_a_b @ exp_se3(rng.uniform(-1, 1, 6) * [1.5, 1.5, 1.5, 1, 1, 1])
            links[k] = LoopClosure(a=links[k].a, b=links[k].b, T_a_b=wrong, information=links[k].information)
        return LoopProposals(loop_closures=tuple(links), failed=found.failed)

    return propose


@pytest.mark.parametrize("seed", first_by_default(1, range(3)))
def test_wrong_loops_are_refused_and_do_not_deform_the_map(seed: int) -> None:
    maps, truths = two_robots()
    truth = np.concatenate(truths)

    clean, wrong = (
        merged_without_wrong_links(),
        merge_versions(maps, steps=MergeSteps(propose=planted(0.1, seed))),
    )

    assert wrong.joined == (0, 1)
    assert rmse_m(wrong, truth) <= max(1.1 * rmse_m(clean, truth), rmse_m(clean, truth) + 0.005)
    wrongs = planted(0.1, seed)(Atlas.of(maps), MergeOptions(), ignore_progress).loop_closures
    rights = propose_loop_closures(Atlas.of(maps), MergeOptions()).loop_closures
    fakes = {
        w.T_a_b.tobytes() for w, r in zip(wrongs, rights, strict=True) if not np.array_equal(w.T_a_b, r.T_a_b)
    }
    assert len(fakes) >= 1
    assert not fakes & {edge.T_a_b.tobytes() for edge in wrong.version.edges}
    refusals = sum(count for (_, _, why), count in wrong.refused.items() if why in JUDGED)
    assert refusals >= sum(count for (_, _, why), count in clean.refused.items() if why in JUDGED) + 1


JUDGED = ("inconsistent", "against-odometry")


def test_a_single_wrong_link_joins_nothing() -> None:
    maps, _ = two_robots()

    def propose(atlas: Atlas, options: MergeOptions, report: Report) -> LoopProposals:
        links = propose_loop_closures(atlas, options, report)
        across = [link for link in links.loop_closures if (link.a < 13) != (link.b < 13)]
        return LoopProposals(loop_closures=tuple(across[:1]), failed=links.failed)

    merged = merge_versions(maps, steps=MergeSteps(propose=propose))

    assert merged.joined == (0,)
    assert "too-few-agree" in merged.not_joined[0][1]


def test_closing_the_loop_of_one_robot_brings_its_ends_together() -> None:
    version, truth = WORLD.walk("a", np.linspace(0.0, 1.1, 30), seed=4, drift_m=0.02, drift_deg=0.7)

    without = merge_versions([version], MergeOptions(close_loops=False))
    merged = merge_versions([version])

    assert without.loops == 0
    assert merged.loops >= 1
    assert rmse_m(merged, truth) < 0.7 * rmse_m(without, truth)


def test_points_move_with_the_keyframes_that_observed_them() -> None:
    version, truth = WORLD.walk("a", np.linspace(0.0, 1.1, 30), seed=4, drift_m=0.02, drift_deg=0.7)
    seen = [
        k.points_camera[:40] @ k.T_world_camera[:3, :3].T + k.T_world_camera[:3, 3] for k in version.keyframes
    ]
    cloud = np.concatenate(seen).astype(np.float32)
    version = MapVersion(
        keyframes=version.keyframes, points=cloud, colours=np.zeros((len(cloud), 3), dtype=np.uint8)
    )
    T_first_world = inverse(truth[0])
    true_points = WORLD.points @ T_first_world[:3, :3].T + T_first_world[:3, 3]

    merged = merge_versions([version])

    assert median_distance(merged.version.points, true_points) < 0.8 * median_distance(cloud, true_points)


def median_distance(points: Array, others: Array) -> float:
    """Return the median distance in metres from a point to its nearest neighbour."""
    squared = ((points[:, None, :] - others[None]) ** 2).sum(axis=2).min(axis=1)
    return float(np.sqrt(np.median(squared)))


def test_the_service_takes_encoded_maps_and_reports_on_every_map() -> None:
    maps, _ = two_robots()

    reply = merge_maps(MergeRequest(maps=[encode_map(each) for each in maps]))

    assert reply.joined == [0, 1]
    assert reply.not_joined == []
    assert len(decode_map(reply.map).keyframes) == 26
    assert reply.cost_after <= reply.cost_before


def test_a_merge_can_be_cancelled_half_way() -> None:
    maps, _ = two_robots()
    heard: list[float] = []

    def stop(done: float, what: str) -> None:
        heard.append(done)
        if done > 0.2:
            raise Cancelled("the robot left")

    with pytest.raises(Cancelled):
        merge_versions(maps, report=stop)
    assert heard == sorted(heard)


@pytest.mark.parametrize("seed", range(3))
def test_the_clique_is_as_large_as_the_one_of_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    agree = rng.random((11, 11)) < 0.5
    agree = np.triu(agree, 1) | np.triu(agree, 1).T
    best = 0
    for mask in range(1 << 11):
        rows = [row for row in range(11) if mask >> row & 1]
        if len(rows) > best and all(agree[a, b] for a in rows for b in rows if a != b):
            best = len(rows)

    found = find_maximum_clique(agree)

    assert len(found) == best
    assert all(agree[a, b] for a in found for b in found if a != b)


def test_consistency_does_not_depend_on_the_world_frames() -> None:
    maps, _ = two_robots()
    atlas = Atlas.of(maps)
    links = propose_loop_closures(atlas, MergeOptions(close_loops=False)).loop_closures
    moved = atlas.T_world_camera.copy()
    moved[atlas.of_map == 1] = exp_se3([5.0, -3.0, 1.0, 1.0, 2.0, 0.5]) @ moved[atlas.of_map == 1]

    here = find_consistent_set(links, atlas.T_world_camera, OdometryNoise())

    np.testing.assert_array_equal(here, find_consistent_set(links, moved, OdometryNoise()))


def test_without_the_extra_the_answer_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "gtsam", None)

    with pytest.raises(MissingExtra, match="gtsam"):
        merge_versions(two_robots()[0])
