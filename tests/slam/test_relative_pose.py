"""Measurement of the relative pose of two keyframes, with the depths of both."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, inverse, pose_difference, transform
from rse_pf.maps.format import Keyframe
from rse_pf.pnp import DepthNoise
from rse_pf.pnp.problems import KINECT
from rse_pf.slam.relative_pose import (
    RelativePose,
    RelativePoseOptions,
    landmarks_of_keyframe,
    match_landmarks,
    measure_pose,
    measure_relative_pose,
    view_of_keyframe,
)

_NOISE = DepthNoise()


def keyframe(number: int, pixels: Array, depth_m: Array, rng: np.random.Generator) -> Keyframe:
    """Return a keyframe of these pixels and depths, with the noise of a Kinect."""
    pixels = pixels + rng.normal(size=pixels.shape) * 0.5
    depth_m = depth_m + rng.normal(size=len(depth_m)) * np.sqrt(_NOISE.variance_m2(depth_m))
    return Keyframe(
        id=number,
        robot="r",
        timestamp_s=float(number),
        T_world_camera=np.eye(4),
        camera=KINECT,
        pixels=pixels.astype(np.float32),
        descriptors=np.random.default_rng(0).integers(0, 256, (len(pixels), 32)).astype(np.uint8),
        points_camera=KINECT.back_project(pixels, depth_m).astype(np.float32),
    )


def pair(seed: int, n: int = 150, top: float = 80.0) -> tuple[Keyframe, Keyframe, Array]:
    """Return two keyframes a and b of the same points, and the true ``T_a_b``.

    All pixels are in rows from *top* to 400; with *top* at 385 they form a narrow strip.
    """
    rng = np.random.default_rng(seed)
    T_a_b = exp_se3(np.concatenate([rng.uniform(-0.2, 0.2, 3), rng.normal(size=3) * 0.08]))
    pixels, depth_m = rng.uniform([80.0, top], [560.0, 400.0], (n, 2)), rng.uniform(1.5, 4.5, n)
    seen = transform(inverse(T_a_b), KINECT.back_project(pixels, depth_m))
    return keyframe(0, pixels, depth_m, rng), keyframe(1, KINECT.project(seen), seen[:, 2], rng), T_a_b


def with_depths(b: Keyframe, depth_m: Array | float) -> Keyframe:
    """Return keyframe *b* with all depths replaced."""
    points = b.points_camera.copy()
    points[:, 2] = depth_m
    return Keyframe(
        id=b.id,
        robot=b.robot,
        timestamp_s=b.timestamp_s,
        T_world_camera=b.T_world_camera,
        camera=b.camera,
        pixels=b.pixels,
        descriptors=b.descriptors,
        points_camera=points,
    )


def measured(a: Keyframe, b: Keyframe) -> RelativePose:
    found = measure_relative_pose(landmarks_of_keyframe(a), view_of_keyframe(b))
    assert isinstance(found, RelativePose), found
    return found


def test_depth_in_both_keyframes_makes_the_error_smaller() -> None:
    pairs = [pair(seed) for seed in range(30)]

    with_both, with_one = (
        np.median([pose_difference(measured(a, change(b)).T_a_b, T)[0] for a, b, T in pairs])
        for change in (lambda b: b, lambda b: with_depths(b, np.nan))
    )

    assert with_both < 0.9 * with_one


@pytest.mark.parametrize("depth_m", [np.nan, 0.0, -1.0, 1e6, 3e38])
def test_depths_that_no_camera_measures_are_left_out(depth_m: float) -> None:
    a, b, _ = pair(1)

    found, without = measured(a, with_depths(b, depth_m)), measured(a, with_depths(b, np.nan))

    assert found.T_a_b.tobytes() == without.T_a_b.tobytes()


def test_a_reference_with_points_behind_its_camera_is_measured_by_pixels() -> None:
    a, b, T_a_b = pair(2)
    depth_m = a.points_camera[:, 2].copy()
    depth_m[3] = -2.0

    found = measured(with_depths(a, depth_m), b)

    assert pose_difference(found.T_a_b, T_a_b)[0] < 0.02


def test_a_weak_pose_is_no_link_unless_its_covariance_is_given_a_factor() -> None:
    a, b, _ = pair(4, top=385.0)
    sought, view = landmarks_of_keyframe(a), view_of_keyframe(b)
    options = RelativePoseOptions(weak_variance=4.0)
    pose = measure_pose(sought, view)

    refused, link = measure_relative_pose(sought, view), measure_relative_pose(sought, view, options)

    assert not isinstance(pose, str)
    assert refused == pose.solution.reason != ""
    assert isinstance(link, RelativePose)
    covariance = 4.0 * pose.solution.covariance + options.min_covariance()
    np.testing.assert_allclose(np.linalg.inv(link.information), covariance, rtol=1e-6)


def test_a_pose_that_is_not_weak_is_the_same_link_with_every_factor() -> None:
    a, b, _ = pair(5)

    links = [
        measure_relative_pose(
            landmarks_of_keyframe(a), view_of_keyframe(b), RelativePoseOptions(weak_variance=factor)
        )
        for factor in (0.0, 4.0)
    ]

    assert all(isinstance(link, RelativePose) for link in links)
    one, other = (link.information for link in links if isinstance(link, RelativePose))
    np.testing.assert_array_equal(one, other)


def test_fewer_matches_than_the_least_are_not_solved() -> None:
    a, b, _ = pair(6)
    sought, view = landmarks_of_keyframe(a), view_of_keyframe(b)
    matches = len(match_landmarks(sought, view)[0])

    few = measure_relative_pose(sought, view, RelativePoseOptions(min_inliers=15, min_matches=matches + 1))
    enough = measure_relative_pose(sought, view, RelativePoseOptions(min_inliers=15, min_matches=matches))

    assert few == "no-matches"
    assert isinstance(enough, RelativePose)
