"""Cameras, poses and projection: round trips, and refusals of what is no camera."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.errors import InvalidCamera
from rse_pf.geometry import (
    Camera,
    adjoint,
    exp_se3,
    from_quaternion,
    log_se3,
    median_pose,
    pose_difference,
    skew,
    to_quaternion,
    transform,
)

KINECT: dict[str, Any] = {"fx": 518.86, "fy": 519.47, "cx": 325.58, "cy": 253.74, "width": 640, "height": 480}
ROUNDING = 1e-12
"""A few hundred roundings of float64 on numbers below 100."""

small = st.floats(-10, 10, allow_nan=False)
twists = st.lists(small, min_size=6, max_size=6).map(np.array)
angles = st.floats(0.0, math.pi)
axes = (
    st.lists(st.floats(-1, 1), min_size=3, max_size=3)
    .map(np.array)
    .filter(lambda axis: bool(np.linalg.norm(axis) > 0.1))
    .map(lambda axis: axis / np.linalg.norm(axis))
)


@given(twists)
def test_the_exponential_of_a_twist_is_a_rigid_pose(xi: npt.NDArray[np.float64]) -> None:
    T = exp_se3(xi)

    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=ROUNDING)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=ROUNDING)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@given(axes, st.floats(1e-12, 1e-5), st.lists(small, min_size=3, max_size=3))
def test_the_exponential_keeps_its_precision_near_zero(
    axis: npt.NDArray[np.float64], angle: float, rho: list[float]
) -> None:
    phi = axis * angle
    K = skew(phi)

    T = exp_se3(np.concatenate([rho, phi]))

    jacobian = np.eye(3) + K / 2 + K @ K / 6
    np.testing.assert_allclose(T[:3, :3], np.eye(3) + K + K @ K / 2 + K @ K @ K / 6, rtol=0, atol=1e-15)
    np.testing.assert_allclose(T[:3, 3], jacobian @ rho, rtol=0, atol=3e-14)


@given(axes, angles)
def test_a_rotation_survives_the_way_through_a_quaternion(
    axis: npt.NDArray[np.float64], angle: float
) -> None:
    rotation = exp_se3(np.concatenate([np.zeros(3), axis * angle]))[:3, :3]

    q = to_quaternion(rotation)

    assert np.linalg.norm(q) == pytest.approx(1.0, abs=ROUNDING)
    assert q[3] >= 0
    np.testing.assert_allclose(from_quaternion(q), rotation, atol=ROUNDING)
    np.testing.assert_allclose(from_quaternion(-3.0 * q), rotation, atol=ROUNDING)


def test_the_difference_of_two_poses_is_in_metres_and_degrees() -> None:
    T = exp_se3([1.0, 2.0, 3.0, 0.3, -0.2, 0.1])
    moved = T @ exp_se3([0.3, 0.0, 0.4, 0.0, 0.0, 0.0]) @ exp_se3([0, 0, 0, math.radians(2.0), 0, 0])

    metres, degrees = pose_difference(moved, T)

    assert metres == pytest.approx(0.5)
    assert degrees == pytest.approx(2.0)


def test_a_pose_maps_points_of_its_second_frame_into_its_first() -> None:
    T_a_b = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])

    np.testing.assert_allclose(
        transform(T_a_b, np.array([[1.0, 0, 0], [0, 1, 0]])), [[10, 21, 30], [9, 20, 30]]
    )


@given(
    st.lists(
        st.tuples(st.floats(-50, 700), st.floats(-50, 500), st.floats(0.01, 100)), min_size=1, max_size=20
    )
)
def test_a_pixel_with_its_depth_projects_onto_itself(rows: list[tuple[float, float, float]]) -> None:
    camera = Camera(**KINECT)
    pixels, depth_m = np.array(rows)[:, :2], np.array(rows)[:, 2]

    points = camera.back_project(pixels, depth_m)

    np.testing.assert_allclose(camera.project(points), pixels, atol=1e-9)
    np.testing.assert_array_equal(points[:, 2], depth_m)


def test_projection_is_the_matrix_of_the_camera_and_a_division() -> None:
    camera = Camera(**KINECT)
    point = np.array([0.4, -0.3, 2.0])

    homogeneous = camera.matrix @ point

    np.testing.assert_allclose(camera.project(point[None])[0], homogeneous[:2] / homogeneous[2])


def test_the_axes_of_a_camera_are_right_down_and_forward() -> None:
    camera = Camera(**KINECT)

    right, down = camera.project(np.array([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]))

    assert right[0] > camera.cx
    assert right[1] == camera.cy
    assert down[1] > camera.cy


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": float("nan")}, "finite"),
        ({"cy": float("inf")}, "finite"),
        ({"width": 0}, "image size 0x480"),
        ({"height": 20000}, "image size 640x20000"),
        ({"fx": 0.0}, "fx = 0 px is absurd"),
        ({"fx": -518.0}, "fx = -518 px is absurd"),
        ({"fy": 0.519}, "fy = 0.519 px is absurd"),
        ({"fy": 518860.0}, "fy = 518860 px is absurd"),
        ({"cx": 5000.0}, "principal point"),
        ({"cy": -700.0}, "principal point"),
    ],
)
def test_implausible_intrinsics_are_an_invalid_camera(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidCamera, match=words) as caught:
        Camera(**{**KINECT, **change})

    assert caught.value.hint


@given(st.lists(st.floats(), min_size=4, max_size=4), st.integers(-5, 20000), st.integers(-5, 20000))
def test_any_numbers_are_a_camera_or_an_invalid_camera(numbers: list[float], width: int, height: int) -> None:
    fx, fy, cx, cy = numbers
    try:
        camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    except InvalidCamera:
        return
    assert np.isfinite(camera.matrix).all()
    assert np.linalg.det(camera.matrix) > 0


@pytest.mark.parametrize("largest_rad", [1e-12, 1e-7, 1e-4, 0.3, 2.0, math.pi - 1e-3, math.pi - 1e-7])
def test_the_logarithm_is_the_inverse_of_the_exponential(largest_rad: float) -> None:
    rng = np.random.default_rng(0)
    xi = rng.normal(size=(200, 6))
    xi[:, 3:] *= largest_rad / np.linalg.norm(xi[:, 3:], axis=1, keepdims=True)

    np.testing.assert_allclose(log_se3(exp_se3(xi)), xi, atol=1e-8)


def test_the_adjoint_takes_a_twist_from_one_side_of_a_pose_to_the_other() -> None:
    T, xi = exp_se3([1.0, 2.0, 3.0, 0.3, -0.2, 0.1]), np.array([0.1, -0.2, 0.3, 0.02, 0.03, -0.01])

    np.testing.assert_allclose(T @ exp_se3(xi), exp_se3(adjoint(T) @ xi) @ T, atol=1e-12)


def test_the_median_pose_is_one_that_agrees_with_most() -> None:
    right = exp_se3(1e-3 * np.random.default_rng(1).normal(size=(5, 6)))
    wrong = exp_se3([[5.0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 2.0]])

    median = median_pose(np.concatenate([wrong, right]))

    assert any(np.array_equal(median, pose) for pose in right)
