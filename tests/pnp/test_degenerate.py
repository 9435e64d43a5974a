"""Correspondences that determine no pose are refused with a typed error."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rse_pf.errors import BadRequest, DegenerateGeometry, NoConsensus, PnpError, RsePfError
from rse_pf.geometry import transform
from rse_pf.pnp import PnpOptions, solve_pnp
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate, make_problem
from tests.kit.native_reference import EVERY


def outcome(points, pixels, engine="native", **options):
    try:
        solution = solve_pnp(points, pixels, KINECT, PnpOptions(engine=engine, **options))
    except RsePfError as error:
        return type(error).__name__
    return solution.verdict


def outcomes(kind, engine="native", seeds=20, n=100, **options):
    made = (make_degenerate(kind, seed=seed, n=n) for seed in range(seeds))
    return {outcome(problem.points_world, problem.pixels, engine, **options) for problem in made}


@EVERY
@pytest.mark.parametrize("inlier_px", [3.0, 8.0])
@pytest.mark.parametrize("kind", DEGENERATE)
def test_degenerate_input_never_gives_a_pose_that_is_called_ok(kind, inlier_px, engine):
    assert "ok" not in outcomes(kind, engine, seeds=10, inlier_px=inlier_px)


@EVERY
@pytest.mark.parametrize(
    ("kind", "errors"),
    [
        ("collinear", {"DegenerateGeometry", "NoConsensus"}),
        ("coincident", {"DegenerateGeometry"}),
        ("same-pixel", {"DegenerateGeometry"}),
        ("line-of-sight", {"DegenerateGeometry", "NoConsensus"}),
        ("corner", {"DegenerateGeometry", "NoConsensus"}),
        ("duplicated", {"DegenerateGeometry", "NoConsensus"}),
        ("noise", {"NoConsensus"}),
        ("behind", {"DegenerateGeometry", "NoConsensus"}),
        ("mirrored", {"DegenerateGeometry", "NoConsensus"}),
        ("nan", {"BadRequest"}),
        ("infinite", {"BadRequest"}),
        ("huge", {"BadRequest"}),
    ],
)
def test_each_kind_has_its_error_and_no_pose_at_all(kind, errors, engine):
    assert outcomes(kind, engine, seeds=10) <= errors


@EVERY
@pytest.mark.parametrize("n", [4, 5, 6, 8, 13, 30, 100, 1000, 5000])
def test_pure_noise_is_never_a_pose(n, engine):
    seeds = 40 if n <= 1000 and engine != "opencv" else 3

    assert outcomes("noise", engine, seeds=seeds, n=n) == {"NoConsensus"}


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 5, 6, 10])
def test_small_pure_noise_is_never_a_pose_in_thousands_of_tries(n):
    assert outcomes("noise", seeds=3000, n=n) <= {"NoConsensus", "DegenerateGeometry"}


def noisy_line(seed, *, sideways_m, outliers):
    """Make 100 noisy points on a line 1 to 6 m away, with *outliers* random pixels."""
    rng = np.random.default_rng(seed)
    while True:
        direction = rng.normal(size=3)
        direction *= rng.uniform(0.3, 3.0) / np.linalg.norm(direction)
        middle = KINECT.back_project(rng.uniform([100, 100], [540, 380], (1, 2)), rng.uniform(1, 6, 1))
        points = middle + np.linspace(-0.5, 0.5, 100)[:, None] * direction
        if points[:, 2].min() > 0.8:
            break
    pixels = KINECT.project(points) + rng.normal(size=(100, 2)) * 0.7
    z = points[:, 2:]
    points = points * (1 + rng.normal(size=(100, 1)) * (0.0012 + 0.0019 * (z - 0.4) ** 2) / z)
    points += rng.normal(size=(100, 3)) * sideways_m
    pixels[:outliers] = rng.uniform(0, [640, 480], (outliers, 2))
    return points, pixels


@EVERY
@pytest.mark.parametrize("sideways_m", [0.0, 0.001, 0.005, 0.02])
@pytest.mark.parametrize("outliers", [0, 10, 30])
def test_a_noisy_line_is_never_ok(engine, sideways_m, outliers):
    found = {
        outcome(*noisy_line(seed, sideways_m=sideways_m, outliers=outliers), engine, inlier_px=inlier_px)
        for seed in range(15)
        for inlier_px in (3.0, 8.0)
    }

    assert "ok" not in found


@EVERY
def test_points_behind_the_camera_say_so(engine):
    found, messages = set(), []
    for seed in range(10):
        problem = make_problem(seed=seed, n=100, outlier_ratio=0.0)
        behind = -transform(problem.T_camera_world, problem.points_world)
        try:
            solve_pnp(behind, problem.pixels, KINECT, PnpOptions(engine=engine))
        except PnpError as error:
            found.add(type(error))
            messages.append(error.message)
    assert found <= {DegenerateGeometry, NoConsensus}
    assert any("behind the camera or mirrored" in message for message in messages)


numbers = st.floats(width=64, allow_nan=True, allow_infinity=True, allow_subnormal=True)
mild = st.floats(-10, 700, allow_nan=False)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data(), n=st.integers(0, 40), engine=st.sampled_from(["native", "opencv"]))
def test_any_numbers_give_a_solution_or_a_typed_error_in_time(data, n, engine):
    elements = data.draw(st.sampled_from([numbers, mild, st.integers(-3, 3).map(float)]))
    points = data.draw(hnp.arrays(np.float64, (n, 3), elements=elements))
    pixels = data.draw(hnp.arrays(np.float64, (n, 2), elements=elements))
    begin = time.thread_time()
    try:
        solution = solve_pnp(points, pixels, KINECT, PnpOptions(engine=engine))
    except (BadRequest, PnpError):
        pass
    else:
        assert np.isfinite(solution.T_camera_world).all()
        assert np.isfinite(solution.covariance).all()
    assert time.thread_time() - begin < 1.0
