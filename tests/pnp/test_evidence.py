"""Places in an image that count as one, and as many."""

from __future__ import annotations

import numpy as np

from rse_pf.pnp import evidence
from rse_pf.pnp.problems import KINECT


def at(pixels, depth_m=3.0):
    """A view of points that project to *pixels*."""
    pixels = np.asarray(pixels, dtype=np.float64)
    ones = np.ones(len(pixels))
    return np.vstack([pixels.T, ones, ones / depth_m, 0 * ones])


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
