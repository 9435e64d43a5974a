"""The trajectories of robots in a merged map, their errors against the truth, and the text about them."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory
from rse_pf.extensions.experiments.results.map_error import (
    JoinedRobot,
    joined_robots,
    merge_section,
)
from rse_pf.geometry import exp_se3
from rse_pf.maps.format import MapVersion
from rse_pf.services.mapping.merge import MergeReply, NotJoined, Refusal
from tests.kit.synthetic_maps import make_world

WORLD = make_world(1)
REPLY = MergeReply(
    map=b"", joined=[0, 2], not_joined=[NotJoined(map=1, reason="fewer than 3 views agree")],
    refused=[
        Refusal(maps=(0, 1), reason="no-matches", count=7),
        Refusal(maps=(0, 0), reason="inconsistent", count=2),
    ],
    loops=1, merges=4, cost_before=2.0, cost_after=1.0,
)  # fmt: skip


def circle(turns, noise_m: float = 0.0, seed: int = 0) -> Trajectory:
    poses = np.array([WORLD.pose(turn) for turn in turns])
    poses[:, :3, 3] += np.random.default_rng(seed).normal(size=(len(poses), 3)) * noise_m
    return Trajectory(np.arange(len(poses)) / 5.0, poses)


def elsewhere(path: Trajectory, seed: int) -> Trajectory:
    """Return *path* in a world of its own."""
    T = exp_se3(np.random.default_rng(seed).normal(size=6))
    return Trajectory(path.timestamps_s, T @ path.T_world_camera)


def robot(name: str, own: Trajectory, merged: Trajectory, truth: Trajectory | None) -> JoinedRobot:
    return JoinedRobot(name=name, own=own, merged=merged, truth=truth)


def section(robots: list[JoinedRobot], reply: MergeReply = REPLY) -> dict[str, object]:
    names = ["robot-1", "robot-2", "robot-3"]
    return merge_section(names, robots, reply, MapVersion(keyframes=()), {"merged_by": "a test"})


def test_poses_are_found_by_the_maps_and_numbers_that_the_provenance_names() -> None:
    a, truth_a = WORLD.walk("a", np.linspace(0, 0.2, 3), seed=1)
    c, truth_c = WORLD.walk("c", np.linspace(0.3, 0.5, 3), seed=2)
    keyframes = (*a.keyframes, *c.keyframes)
    order = [4, 0, 5, 1, 2, 3]  # whatever order the service likes
    placed = [
        type(each)(
            id=row, robot=each.robot, timestamp_s=each.timestamp_s, T_world_camera=T, camera=each.camera,
            pixels=each.pixels, descriptors=each.descriptors, points_camera=each.points_camera,
        )
        for row, (each, T) in enumerate(zip(keyframes, np.concatenate([truth_a, truth_c]), strict=True))
    ]  # fmt: skip
    merged = MapVersion(
        keyframes=tuple(placed[row] for row in order),
        provenance={"from": [[0 if row < 3 else 2, row % 3] for row in order]},
    )
    paths = [Trajectory(np.arange(3.0), np.array([k.T_world_camera for k in m.keyframes])) for m in (a, a, c)]

    robots = joined_robots(["a", "b", "c"], paths, [None, None, None], [a, a, c], REPLY, merged)

    assert [each.name for each in robots] == ["a", "c"]
    np.testing.assert_allclose(robots[0].merged.T_world_camera, truth_a, atol=1e-6)
    np.testing.assert_allclose(robots[1].merged.T_world_camera, truth_c, atol=1e-6)


def test_a_right_merge_of_perfect_paths_has_no_error() -> None:
    one, other = circle(np.linspace(0, 0.4, 20)), circle(np.linspace(0.5, 0.9, 20))
    robots = [
        robot("a", elsewhere(one, 1), elsewhere(one, 3), one),
        robot("c", elsewhere(other, 2), elsewhere(other, 3), other),
    ]

    made = section(robots)

    assert made["ate_cm"] == made["ate_before_cm"] == made["ate_stiff_cm"] == 0.0
    assert made["origins"] == [{"robot": "c", "cm": 0.0, "deg": 0.0}]


def test_a_robot_at_the_wrong_place_changes_the_merged_error_and_its_origin_only() -> None:
    one, other = circle(np.linspace(0, 0.4, 20)), circle(np.linspace(0.5, 0.9, 20))
    off = elsewhere(other, 3)
    off.T_world_camera[:, 0, 3] += 0.10
    robots = [robot("a", one, elsewhere(one, 3), one), robot("c", other, off, other)]

    made = section(robots)

    assert made["ate_before_cm"] == 0.0
    assert 1.0 < made["ate_cm"] < 10.0  # type: ignore[operator]
    (origin,) = made["origins"]  # type: ignore[misc]
    assert origin["cm"] == pytest.approx(10.0, abs=0.01)
    assert origin["deg"] == pytest.approx(0.0, abs=0.01)


def test_drift_that_the_merge_removed_is_in_the_error_before_it_only() -> None:
    true = circle(np.linspace(0, 0.9, 60))
    drifted = circle(np.linspace(0, 0.9, 60), noise_m=0.02)

    made = section([robot("robot-1", drifted, elsewhere(true, 1), true)])

    assert made["ate_cm"] == pytest.approx(0.0, abs=1e-3)
    assert made["ate_before_cm"] == pytest.approx(2.0 * 3**0.5, rel=0.2)
