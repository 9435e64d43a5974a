"""The second pose of a plane."""

from __future__ import annotations

import numpy as np

from rse_pf.geometry import exp_se3, pose_difference
from rse_pf.pnp.planar_ambiguity import second_planar_pose
from rse_pf.pnp.problems import KINECT


def tilted_plane(size_m, tilt_rad, depth_m, seed=0, n=60):
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(-size_m / 2, size_m / 2, (n, 2)), np.zeros(n)])
    turned = flat @ exp_se3([0, 0, 0, tilt_rad, 0, 0])[:3, :3].T + [0.0, 0.0, depth_m]
    return turned, KINECT.project(turned)


def test_a_far_tilted_plane_has_a_second_pose_that_fits_almost_alike():
    points, pixels = tilted_plane(size_m=0.4, tilt_rad=0.6, depth_m=4.0)

    twin = second_planar_pose(np.eye(4), points, pixels, KINECT)

    assert twin is not None
    _, degrees = pose_difference(twin[0], np.eye(4))
    assert degrees > 30.0
    assert twin[1] / len(points) < 1.0


def test_a_near_tilted_plane_has_a_second_pose_that_fits_badly():
    points, pixels = tilted_plane(size_m=1.5, tilt_rad=0.6, depth_m=2.0)

    twin = second_planar_pose(np.eye(4), points, pixels, KINECT)

    assert twin is None or twin[1] / len(points) > 25.0


def test_a_plane_seen_head_on_has_no_second_pose():
    points, pixels = tilted_plane(size_m=1.0, tilt_rad=0.0, depth_m=3.0)

    assert second_planar_pose(np.eye(4), points, pixels, KINECT) is None


def test_points_that_fill_space_have_no_second_pose_that_fits():
    rng = np.random.default_rng(2)
    points = rng.uniform([-1, -1, 5], [1, 1, 7], (60, 3))

    twin = second_planar_pose(np.eye(4), points, KINECT.project(points), KINECT)

    assert twin is None or twin[1] / len(points) > 25.0
