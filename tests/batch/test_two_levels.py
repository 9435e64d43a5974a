"""Pose graphs in two levels start the whole optimisation near its end."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.extensions.batch.two_levels import graph_between, graphs_within, poses_of_levels, stacked
from rse_pf.geometry import exp_se3
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph, robust_cost
from rse_pf.slam.pose_graph import PoseGraph
from tests.kit.synthetic_maps import make_sphere

pytest.importorskip("gtsam", reason="the extra maps is not installed")


def sphere_of_maps(maps: int) -> tuple[PoseGraph, np.ndarray]:
    """Return a sphere whose rings belong to *maps* maps, each of them moved as a whole."""
    graph, _ = make_sphere(3, rings=12, per_ring=12)
    of_map = np.arange(len(graph.T_world_pose)) * maps // len(graph.T_world_pose)
    rng = np.random.default_rng(4)
    moves = np.array([exp_se3(rng.normal(size=6) * 0.3) for _ in range(maps)])
    moved = moves[of_map] @ graph.T_world_pose
    return PoseGraph(
        T_world_pose=moved, a=graph.a, b=graph.b, T_a_b=graph.T_a_b, information=graph.information,
        robust=graph.robust, ids=graph.ids,
    ), of_map  # fmt: skip


def test_two_levels_come_near_the_optimum_of_the_whole_graph() -> None:
    graph, of_map = sphere_of_maps(4)
    options = OptimiseOptions()
    solved = [
        (rows, optimise_graph(inner, options, chordal=False).T_world_pose)
        for rows, inner in graphs_within(graph, of_map)
    ]
    poses = stacked(solved, len(of_map))

    body, between = graph_between(graph, of_map, poses)
    bodies = optimise_graph(between, options, chordal=False).T_world_pose

    two = poses_of_levels(body, bodies, poses)
    best = optimise_graph(graph, options)
    before = robust_cost(graph, graph.T_world_pose, options.cauchy)
    assert robust_cost(graph, two, options.cauchy) - best.cost_after < 0.05 * (before - best.cost_after)


def test_the_residuals_between_bodies_are_those_of_the_whole_graph() -> None:
    graph, of_map = sphere_of_maps(3)

    body, between = graph_between(graph, of_map, graph.T_world_pose)

    outer = body[graph.a] != body[graph.b]
    rng = np.random.default_rng(5)
    moves = np.array([exp_se3(rng.normal(size=6) * 0.1) for _ in range(3)])
    whole = graph.squared_residuals(poses_of_levels(body, moves, graph.T_world_pose))[outer]
    np.testing.assert_allclose(between.squared_residuals(moves), whole, rtol=1e-6)
