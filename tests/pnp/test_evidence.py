"""Independent inliers and width over length; test_native compares all evidence with the oracle."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.geometry import Array
from rse_pf.pnp import PnpOptions, WeakLimits
from rse_pf.pnp.engines import native_options
from rse_pf.pnp.native_solver import Evidence, native_solver
from rse_pf.pnp.problems import KINECT, make_problem

OPTIONS = native_options(PnpOptions(), WeakLimits())


def evidence_at(pixels: Array) -> Evidence:
    """Return the evidence of the true pose for points that project exactly to *pixels*."""
    pixels = np.asarray(pixels, dtype=np.float64)
    points = KINECT.back_project(pixels, np.linspace(2.0, 4.0, len(pixels)))
    return native_solver().evaluate(points, pixels, KINECT, OPTIONS, np.eye(4))


def test_points_behind_the_camera_agree_with_no_pose() -> None:
    problem = make_problem(seed=1, n=100, outlier_ratio=0.0)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ problem.T_camera_world

    found = native_solver().evaluate(problem.points_world, problem.pixels, KINECT, OPTIONS, turned)

    assert not len(found.inliers)


def test_copies_of_one_correspondence_count_once() -> None:
    rng = np.random.default_rng(0)
    four = np.array([[100.0, 100.0], [500.0, 80.0], [320.0, 400.0], [64.0, 320.0]])

    copies = four[rng.integers(0, 4, 200)] + rng.normal(size=(200, 2))

    assert evidence_at(copies).independent_inliers == 4


@pytest.mark.parametrize("strays", [0, 2, 4])
def test_a_few_outliers_do_not_make_a_line_wide(strays: int) -> None:
    rng = np.random.default_rng(1)
    pixels = np.column_stack([np.linspace(50, 600, 60), np.linspace(100, 400, 60)]) + rng.normal(size=(60, 2))
    pixels[:strays] = rng.uniform(0, [640, 480], (strays, 2))

    assert evidence_at(pixels).inlier_width_to_length < 0.05
