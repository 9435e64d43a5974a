"""The smoother finds true poses from noisy edges, some of which are wrong, and moves no held pose."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, inverse, log_se3
from rse_pf.live_map.decisions import AcceptEdges, AddEdges
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.smoothing import smooth_around
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.pose_graph import PoseGraph
from rse_pf.slam.smoother import SmoothedPoses, smooth
from tests.kit.generated_drives import GeneratedWorld, circle, make_link

FREE = 12


def problem(seed: int) -> tuple[Array, Array, PoseGraph]:
    """Return true poses, a start, and a graph: the last pose is to be held, and one loop is wrong."""
    rng = np.random.default_rng(seed)
    step = exp_se3([0.25, 0.0, 0.0, 0.0, 0.0, 0.3])
    true = [np.eye(4)]
    for _ in range(FREE):
        true.append(true[-1] @ step)
    T = np.array(true)
    pairs = [(i, i + 1) for i in range(FREE)] + [(i, j) for i in range(0, FREE, 2) for j in (FREE, FREE - 3)]
    pairs = [(i, j) for i, j in pairs if i < j]
    a, b = np.array(pairs).T
    measured = inverse(T[a]) @ T[b] @ exp_se3(0.004 * rng.normal(size=(len(a), 6)))
    measured[-1] = measured[-1] @ exp_se3([1.0, -0.7, 0.4, 0.3, 0.0, 0.5])
    start = T @ exp_se3(0.03 * rng.normal(size=(FREE + 1, 6)))
    start[-1] = T[-1]
    graph = PoseGraph(
        T_world_pose=start, a=a, b=b, T_a_b=measured,
        information=np.tile(np.eye(6) / 0.004**2, (len(a), 1, 1)),
        robust=np.arange(len(a)) >= FREE, ids=np.arange(FREE + 1),
    )  # fmt: skip
    return T, start, graph


def fit(graph: PoseGraph, start: Array) -> SmoothedPoses:
    return smooth(
        start, FREE, graph.a, graph.b, graph.T_a_b, graph.information, graph.robust,
        cauchy=3.0, wanted=np.empty(0, dtype=np.int64),
    )  # fmt: skip


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_wrong_loop_closure_does_not_move_the_poses(seed: int) -> None:
    true, start, graph = problem(seed)

    off = log_se3(inverse(true) @ fit(graph, start).T)

    assert np.abs(off).max() < 0.03


def test_an_accepted_loop_closure_that_is_wrong_does_not_move_the_map() -> None:
    """The map itself says which of its edges may be wrong."""
    world = GeneratedWorld(seed=3)
    drive, live = world.drive("a", circle(0.3, 1.4)), LiveMap()
    for event in world.play([drive]):
        live.apply(event)
    graph, last = live._graph, len(world.seen) - 1
    before = graph.T_component_camera.copy()
    wrong = world.step(last, last - 10) @ exp_se3([0.5, -0.4, 0.0, 0.0, 0.3, 0.0])
    number = graph.next_edge
    planted = AddEdges(keyframe=last, measured=[make_link(last - 10, wrong, inliers=60)])
    graph.apply([planted, AcceptEdges(numbers=[number])])
    done = smooth_around(graph, [last, last - 10], [0], LiveMapOptions())

    assert max(done.squared_misfits.values()) > 100.0
    assert np.abs(log_se3(inverse(before) @ graph.T_component_camera)).max() < 0.02


def test_it_finds_what_the_optimiser_of_whole_graphs_finds() -> None:
    pytest.importorskip("gtsam")
    _, start, graph = problem(4)
    ours = fit(graph, start).T

    # Which holds the first pose, so the frames of both differ.
    theirs = optimise_graph(graph, OptimiseOptions(cauchy=3.0)).T_world_pose
    theirs = ours[-1] @ np.linalg.inv(theirs[-1]) @ theirs

    assert np.abs(log_se3(inverse(theirs) @ ours)).max() < 1e-3
