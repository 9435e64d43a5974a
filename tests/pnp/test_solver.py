"""`solve_pnp` finds the true pose of valid input, with a correct covariance and verdict."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rse_pf.errors import BadRequest, DegenerateGeometry
from rse_pf.geometry import exp_se3, inverse, pose_difference, transform
from rse_pf.pnp import PnpOptions, WeakLimits, solve_pnp, solver
from rse_pf.pnp.problems import KINECT, make_problem


def solve(problem, **options):
    return solve_pnp(problem.points_world, problem.pixels, problem.camera, PnpOptions(**options))


def test_recovers_the_pose_when_half_the_matches_are_wrong():
    problem = make_problem(seed=7, noise_px=0.5, outlier_ratio=0.5)

    solution = solve_pnp(problem.points_world, problem.pixels, problem.camera)

    np.testing.assert_allclose(solution.T_camera_world, problem.T_camera_world, atol=0.01)
    assert (solution.verdict, solution.reason) == ("ok", "")
    assert solution.engine == "native"


@pytest.mark.parametrize("engine", ["native", "opencv"])
def test_inliers_are_sorted_rows_that_project_within_the_limit_and_rmse_is_over_them(engine):
    problem = make_problem(seed=8, outlier_ratio=0.4)

    solution = solve(problem, engine=engine, inlier_px=6.0)

    points = transform(solution.T_camera_world, problem.points_world)
    error = np.linalg.norm(problem.camera.project(points) - problem.pixels, axis=1)
    assert np.array_equal(solution.inliers, np.flatnonzero((error <= 6.0) & (points[:, 2] > 0)))
    assert solution.rmse_px == pytest.approx(math.sqrt((error[solution.inliers] ** 2).mean()))
    assert np.isin(np.flatnonzero(problem.is_inlier), solution.inliers).mean() > 0.99


def test_the_order_of_the_rows_changes_the_inliers_numbers_only():
    problem = make_problem(seed=9)
    order = np.random.default_rng(0).permutation(200)

    one = solve(problem)
    other = solve_pnp(problem.points_world[order], problem.pixels[order], problem.camera)

    assert set(order[other.inliers]) == set(one.inliers)
    np.testing.assert_allclose(one.T_camera_world, other.T_camera_world, atol=1e-3)


@pytest.mark.parametrize("inliers", range(41, 48))
def test_the_pose_is_as_accurate_where_most_points_lie_behind_the_camera(inliers):
    """A pose is refined over its inliers alone, also where they do not fill the last vector of eight rows."""
    rng = np.random.default_rng(1)
    T = exp_se3([0.3, -0.2, 0.4, 0.1, 0.2, -0.1])
    exact_pixels = rng.uniform(20.0, 460.0, (inliers, 2))
    right = KINECT.back_project(exact_pixels, rng.uniform(1.0, 4.0, inliers))
    pixels = np.concatenate(
        [exact_pixels + rng.normal(size=(inliers, 2)) * 0.5, rng.uniform(0, 480, (100, 2))]
    )
    order = rng.permutation(len(pixels))
    solutions = []
    for depth_m in (3.0, -3.0):
        wrong = rng.uniform([-2.0, -2.0, depth_m], [2.0, 2.0, depth_m + 1.0], (100, 3))
        points_world = transform(inverse(T), np.concatenate([right, wrong]))
        solutions.append(solve_pnp(points_world[order], pixels[order], KINECT))

    in_front, behind = solutions

    assert np.array_equal(in_front.inliers, behind.inliers)
    # The refinement stops after a step below 1e-6.
    np.testing.assert_allclose(in_front.T_camera_world, behind.T_camera_world, rtol=0, atol=2e-6)


@pytest.mark.parametrize("n", [60, 80])
def test_thirteen_right_matches_among_many_wrong_ones_are_a_weak_pose(n):
    """As in the wide-baseline pairs of real recordings, which have 13 inliers at 3 px."""
    found = 0
    for seed in range(20):
        problem = make_problem(seed=seed, n=n, noise_px=0.7, outlier_ratio=1 - 13 / n)
        solution = solve(problem, inlier_px=3.0, max_iterations=5000)
        metres, degrees = pose_difference(solution.T_camera_world, problem.T_camera_world)
        found += solution.verdict == "weak" and metres < 0.15 and degrees < 3.0
    assert found >= 19


@pytest.mark.parametrize(
    ("kept", "limits", "reason"),
    [
        (slice(None, 9), WeakLimits(), "few-inliers"),
        (slice(None), WeakLimits(inliers=201), "few-inliers"),
        (slice(None), WeakLimits(inlier_ratio=0.9), "low-inlier-ratio"),
        (slice(None), WeakLimits(translation_m=1e-5), "poorly-constrained"),
        (slice(None), WeakLimits(rotation_rad=1e-6), "poorly-constrained"),
    ],
)
def test_a_weak_pose_says_why(kept, limits, reason):
    problem = make_problem(seed=2, outlier_ratio=0.0 if reason == "few-inliers" else 0.3)

    solution = solve_pnp(problem.points_world[kept], problem.pixels[kept], problem.camera, weak=limits)

    assert (solution.verdict, solution.reason) == ("weak", reason)


def test_five_right_matches_that_were_copied_are_clustered():
    rng = np.random.default_rng(0)
    five = np.array([[60.0, 60.0], [580.0, 90.0], [320.0, 240.0], [100.0, 420.0], [540.0, 400.0]])
    points = KINECT.back_project(five, np.array([1.5, 3.0, 2.0, 4.0, 2.5]))
    copy = np.arange(80) % 5

    solution = solve_pnp(points[copy], five[copy] + rng.normal(size=(80, 2)) * 0.3, KINECT)

    assert (solution.verdict, solution.reason) == ("weak", "clustered")


def test_a_patch_of_forty_pixels_is_refused_with_the_reason():
    rng = np.random.default_rng(0)
    pixels = rng.uniform(300, 340, (80, 2))
    points = KINECT.back_project(pixels, rng.uniform(1, 5, 80))

    with pytest.raises(DegenerateGeometry, match=r"80 correspondences that agree lie in \d places"):
        solve_pnp(points, pixels + rng.normal(size=(80, 2)) * 0.5, KINECT)


def test_a_far_tilted_plane_may_be_called_ambiguous_but_never_wrong_and_ok():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        flat = np.column_stack([rng.uniform(-0.3, 0.3, (60, 2)), np.zeros(60)])
        points = flat @ exp_se3([0, 0, 0, 0.5, 0.1, 0])[:3, :3].T + [0.0, 0.0, rng.uniform(1, 4)]
        pixels = KINECT.project(points) + rng.normal(size=(60, 2))
        try:
            solution = solve_pnp(points, pixels, KINECT)
        except solver.PnpError:
            continue
        metres, degrees = pose_difference(solution.T_camera_world, np.eye(4))
        assert solution.verdict == "weak" or (metres < 0.1 and degrees < 2.0)


@pytest.mark.parametrize(
    ("points", "pixels"),
    [
        ((9, 3), (8, 2)),
        ((9, 2), (9, 2)),
        ((9, 3), (9, 3)),
        ((27,), (18,)),
        ((0,), (0,)),
        ((2, 9, 3), (2, 9, 2)),
    ],
)
def test_shapes_that_do_not_fit_are_refused(points, pixels):
    with pytest.raises(BadRequest, match="are not"):
        solve_pnp(np.ones(points), np.ones(pixels), KINECT)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.1e6, -1e300])
@pytest.mark.parametrize("which", ["points_world", "pixels"])
def test_one_absurd_number_is_refused(which, value):
    problem = make_problem(seed=6)
    getattr(problem, which)[17, 1] = value

    with pytest.raises(BadRequest, match=which):
        solve(problem)


@pytest.mark.parametrize(
    ("option", "value", "limits"),
    [
        ("inlier_px", 0.0, "0.001..100"),
        ("inlier_px", 101.0, "0.001..100"),
        ("inlier_px", math.nan, "0.001..100"),
        ("max_iterations", 0, "1..100000"),
        ("max_iterations", 100_001, "1..100000"),
        ("min_iterations", -1, "1..100000"),
        ("confidence", 0.0, "1e-06..1"),
        ("confidence", 1.0, "1e-06..1"),
        ("confidence", 2.0, "1e-06..1"),
    ],
)
def test_an_option_out_of_range_names_both_numbers_and_a_way_out(option, value, limits):
    with pytest.raises(BadRequest) as caught:
        PnpOptions(**{option: value})

    assert option in caught.value.message
    assert limits in caught.value.message
    assert caught.value.hint


def test_the_server_chooses_the_engine_when_the_robot_does_not():
    problem = make_problem(seed=1)

    def engine(options, default):
        return solve_pnp(
            problem.points_world, problem.pixels, problem.camera, options, default_engine=default
        ).engine

    assert engine(None, "opencv") == "opencv"
    assert engine(PnpOptions(engine="native"), "opencv") == "native"
