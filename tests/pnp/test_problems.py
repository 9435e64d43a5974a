"""The problems that everything else is measured against."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.geometry import transform
from rse_pf.pnp.problems import DEGENERATE, make_degenerate, make_problem


def test_equal_seeds_give_equal_problems_and_others_do_not():
    a, b, c = make_problem(seed=1), make_problem(seed=1), make_problem(seed=2)

    assert np.array_equal(a.points_world, b.points_world)
    assert np.array_equal(a.pixels, b.pixels)
    assert not np.array_equal(a.pixels, c.pixels)


def test_inliers_project_within_the_noise_and_outliers_are_as_many_as_asked():
    problem = make_problem(seed=3, n=1000, noise_px=1.0, outlier_ratio=0.3)

    projected = problem.camera.project(transform(problem.T_camera_world, problem.points_world))
    error = (projected - problem.pixels)[problem.is_inlier]

    assert problem.is_inlier.sum() == 700
    assert np.abs(error).max() < 5.0
    assert error.std() == pytest.approx(1.0, rel=0.1)


def test_points_lie_in_a_kinects_range_before_the_camera():
    problem = make_problem(seed=4, n=500)

    z = transform(problem.T_camera_world, problem.points_world)[:, 2]

    assert 0.8 <= z.min() < z.max() <= 6.0


def test_depth_noise_moves_far_points_along_their_rays():
    exact, noisy = make_problem(seed=5, n=500), make_problem(seed=5, n=500, depth_noise=True)

    def depths(problem):
        return transform(problem.T_camera_world, problem.points_world)[:, 2]

    error = np.abs(depths(noisy) - depths(noisy).clip(0.8, 6.0))
    assert error.max() < 0.4
    assert not np.array_equal(depths(exact), depths(noisy))


@pytest.mark.parametrize("kind", DEGENERATE)
def test_every_degenerate_kind_has_the_shape_of_a_problem(kind):
    problem = make_degenerate(kind, seed=0, n=40)

    assert problem.points_world.shape == (40, 3)
    assert problem.pixels.shape == (40, 2)
    assert not problem.is_inlier.any()


def test_an_unknown_degenerate_kind_is_refused():
    with pytest.raises(ValueError, match="unknown kind"):
        make_degenerate("round", seed=0)


@pytest.mark.parametrize("seed", range(5))
def test_pixels_of_noise_are_not_the_right_ones_in_other_rows(seed):
    noise, right = make_degenerate("noise", seed=seed), make_problem(seed=seed, n=100, outlier_ratio=0.0)

    def median_px(shift):
        return np.median(np.linalg.norm(np.roll(noise.pixels, shift, axis=0) - right.pixels, axis=1))

    assert min(map(median_px, range(-9, 10))) > 100
