"""Pose graph optimisation: it fits as well as the true poses, never worsens the cost, and reads g2o."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.pose_graph import PoseGraph, connected_components, read_g2o, write_g2o
from tests.kit.synthetic_maps import make_sphere

pytest.importorskip("gtsam", reason="the extra maps is not installed")


def rmse_m(T_estimate: Array, T_truth: Array) -> float:
    """Return the root mean square error of positions in metres; both trajectories start at the same pose."""
    return float(np.sqrt(((T_estimate - T_truth)[:, :3, 3] ** 2).sum(axis=1).mean()))


def chi2(graph: PoseGraph, T_world_pose: Array) -> float:
    """Return the sum of the squared Mahalanobis norms of all residuals at *T_world_pose*."""
    return float(graph.squared_residuals(T_world_pose).sum())


def small_sphere(seed: int = 1) -> tuple[PoseGraph, Array]:
    """Return a sphere of 200 poses."""
    return make_sphere(seed, rings=10, per_ring=20)


@pytest.mark.parametrize("cauchy", [0.0, 3.0])
def test_fits_a_drifted_sphere_better_than_the_truth_does(cauchy: float) -> None:
    graph, truth = small_sphere()

    found = optimise_graph(graph, OptimiseOptions(cauchy=cauchy))

    assert chi2(graph, found.T_world_pose) <= chi2(graph, truth)
    assert rmse_m(found.T_world_pose, truth) <= 0.2 * rmse_m(graph.T_world_pose, truth)


def test_wrong_loops_hardly_move_the_poses() -> None:
    graph, truth = small_sphere()
    clean = rmse_m(optimise_graph(graph).T_world_pose, truth)
    rng = np.random.default_rng(3)
    steps = graph.T_a_b.copy()
    loops = np.flatnonzero(graph.robust)
    for k in rng.choice(loops, len(loops) // 10, replace=False):
        steps[k] = exp_se3(rng.uniform(-3, 3, 6))
    wrong = PoseGraph(
        T_world_pose=graph.T_world_pose,
        a=graph.a,
        b=graph.b,
        T_a_b=steps,
        information=graph.information,
        robust=graph.robust,
        ids=graph.ids,
    )

    assert rmse_m(optimise_graph(wrong).T_world_pose, truth) <= 1.1 * clean


def test_the_answer_never_costs_more_than_the_start() -> None:
    graph, _ = small_sphere()
    best = replace(graph, T_world_pose=optimise_graph(graph).T_world_pose)

    again = optimise_graph(best, OptimiseOptions(max_iterations=1))

    assert again.cost_after <= again.cost_before


def test_each_connected_component_keeps_its_first_pose() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = [0.0, 1.1, 9.0, 10.2, 11.0]
    step = exp_se3([1.0, 0, 0, 0, 0, 0])
    graph = PoseGraph(
        T_world_pose=poses,
        a=np.array([0, 2, 3]),
        b=np.array([1, 3, 4]),
        T_a_b=np.array([step] * 3),
        information=np.tile(np.eye(6), (3, 1, 1)),
        robust=np.zeros(3, dtype=bool),
        ids=np.arange(5),
    )

    found = optimise_graph(graph)

    assert connected_components(5, graph.a, graph.b).tolist() == [0, 0, 2, 2, 2]
    assert found.components == 2
    np.testing.assert_allclose(found.T_world_pose[:, 0, 3], [0, 1, 9, 10, 11], atol=1e-6)


def test_reading_written_g2o_text_gives_the_same_graph() -> None:
    graph, _ = small_sphere()

    again = read_g2o(write_g2o(graph))

    np.testing.assert_allclose(again.T_world_pose, graph.T_world_pose, atol=1e-12)
    np.testing.assert_allclose(again.information, graph.information, rtol=1e-9)
    assert chi2(again, again.T_world_pose) == pytest.approx(chi2(graph, graph.T_world_pose), rel=1e-9)
    np.testing.assert_array_equal(again.robust, graph.robust)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0", "line 1"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 nan", "line 1"),
        ("VERTEX_SE2 0 0 0 0", "line 1"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + "1 " * 21, "vertex 1"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 0 1", "line 2"),
        ("", "do not agree"),
    ],
)
def test_invalid_g2o_text_is_refused_with_its_line(text: str, complaint: str) -> None:
    with pytest.raises(BadRequest, match=complaint):
        read_g2o(text)


def test_an_information_matrix_that_is_not_positive_definite_is_refused() -> None:
    graph, _ = small_sphere()

    with pytest.raises(BadRequest, match="positive definite"):
        PoseGraph(
            T_world_pose=graph.T_world_pose,
            a=graph.a,
            b=graph.b,
            T_a_b=graph.T_a_b,
            information=-graph.information,
            robust=graph.robust,
            ids=graph.ids,
        )


@pytest.mark.slow
def test_a_sphere_of_2500_poses_ends_below_the_truth_and_near_it() -> None:
    graph, truth = make_sphere(7)

    found = optimise_graph(graph)

    assert chi2(graph, found.T_world_pose) <= chi2(graph, truth)
    assert rmse_m(found.T_world_pose, truth) <= 0.1 * rmse_m(graph.T_world_pose, truth)
