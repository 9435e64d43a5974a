"""Places, width and depth of the evidence; what else it says is compared with the native core."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.pnp import evidence
from rse_pf.pnp.problems import KINECT, make_problem


def exact(seed=1, n=100):
    return make_problem(seed=seed, n=n, outlier_ratio=0.0)


def view(problem):
    return evidence.view_of(problem.T_camera_world, problem.points_world, problem.pixels, problem.camera)


def at(pixels, depth_m=3.0):
    """A view of points that project to *pixels*."""
    pixels = np.asarray(pixels, dtype=np.float64)
    ones = np.ones(len(pixels))
    return np.vstack([pixels.T, ones, ones / depth_m, 0 * ones])


def shape(seen):
    return evidence.Shape(seen, KINECT)


def test_a_point_behind_the_camera_is_infinitely_wrong():
    problem = exact()
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ problem.T_camera_world

    seen = evidence.view_of(turned, problem.points_world, problem.pixels, problem.camera)

    assert np.isinf(seen[evidence.ERROR2]).all()


def test_copies_of_one_correspondence_count_once():
    rng = np.random.default_rng(0)
    four = np.array([[100.0, 100.0], [500.0, 80.0], [320.0, 400.0], [64.0, 320.0]])

    copies = four[rng.integers(0, 4, 200)] + rng.normal(size=(200, 2))

    assert evidence.independent_inliers(at(copies), KINECT) == 4


def test_scattered_correspondences_all_count():
    pixels = np.random.default_rng(0).uniform(0, [640, 480], (200, 2))

    assert evidence.independent_inliers(at(pixels), KINECT) == 200


def test_cells_on_a_corner_are_one_place():
    corner = [[15.9, 15.9], [16.1, 15.9], [15.9, 16.1], [16.1, 16.1]]

    assert evidence.independent_inliers(at(corner), KINECT) == 1


@pytest.mark.parametrize("strays", [0, 2, 4])
def test_a_few_outliers_do_not_make_a_line_wide(strays):
    rng = np.random.default_rng(1)
    pixels = np.column_stack([np.linspace(50, 600, 60), np.linspace(100, 400, 60)]) + rng.normal(size=(60, 2))
    pixels[:strays] = rng.uniform(0, [640, 480], (strays, 2))

    assert shape(at(pixels)).thinness < 0.05


def test_a_filled_image_is_wide_and_one_place_has_no_width():
    pixels = np.random.default_rng(0).uniform(0, [640, 480], (200, 2))

    assert shape(at(pixels)).thinness > 0.15
    assert evidence.width_to_length(np.ones((20, 2))) == 0.0


def test_depth_variation_is_that_of_the_inverse_depth():
    seen = view(exact())
    inverse_depth = seen[evidence.Z_INV]

    found = shape(seen).depth_variation

    assert found == pytest.approx(inverse_depth.std() / inverse_depth.mean())
