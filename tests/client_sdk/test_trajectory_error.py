"""ATE and RPE: hand-computed values, invariances, and figures that another program computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory, read_trajectory
from client_sdk.trajectory_error import (
    accuracy,
    align,
    match_truth,
    trajectory_figures,
    with_truth,
)
from rse_pf.errors import UsageError
from rse_pf.geometry import exp_se3, inverse

RECORDED = Path(__file__).parents[4] / "shared" / "data" / "tum_trajectories"
EVO_MAX_DIFFERENCE_S = 0.01


def wander(seed: int, count: int = 40) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ exp_se3(rng.normal(0.0, 0.1, 6)))
    return Trajectory(np.arange(count) * 0.1, np.array(poses))


def test_a_known_error_is_measured():
    truth = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    truth.T_world_camera[:, :2, 3] = [[1, 1], [1, -1], [-1, -1], [-1, 1]]
    estimate = Trajectory(np.arange(4.0), truth.T_world_camera.copy())
    estimate.T_world_camera[:, 2, 3] = [0.1, -0.1, 0.1, -0.1]  # a saddle: no alignment removes it

    figures = trajectory_figures(estimate, truth)
    assert figures == {
        "path_m": pytest.approx(6.03, abs=0.01),
        "ate_cm": 10.0,
        "rpe_cm": 20.0,
        "rpe_deg": 0.0,
    }
    assert accuracy(estimate, truth).ate_max_m == pytest.approx(0.1)


def test_the_alignment_is_a_rotation_even_for_mirrored_points():
    points = np.random.default_rng(3).normal(size=(20, 3))

    _, pose = align(points, points * [1, 1, -1])

    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(pose @ inverse(pose), np.eye(4), atol=1e-12)


def test_poses_are_matched_by_time_and_not_by_row():
    truth = wander(4, 40)
    estimate = Trajectory(truth.timestamps_s[5:35:3] + 0.001, truth.T_world_camera[5:35:3])
    outside = Trajectory(
        np.append(estimate.timestamps_s, 9.0), np.append(estimate.T_world_camera, [np.eye(4)], 0)
    )

    rows, true_poses = match_truth(outside, truth)

    np.testing.assert_array_equal(rows, np.arange(10))
    np.testing.assert_allclose(true_poses, truth.at(estimate.timestamps_s))


def screw(stamps_s: np.ndarray) -> np.ndarray:
    """Return the poses of a camera that moves on one twist: 0.5 m and 40 degrees a second."""
    return exp_se3(np.asarray(stamps_s)[:, None] * np.array([0.3, 0.4, 0.0, 0.0, 0.0, np.radians(40.0)]))


def test_the_truth_is_interpolated_to_the_frames_and_not_the_nearest_one():
    known_s = np.arange(0.0, 5.0, 0.1)
    frames_s = np.sort(np.random.default_rng(2).uniform(0.0, 4.8, 60))
    truth, estimate = Trajectory(known_s, screw(known_s)), Trajectory(frames_s, screw(frames_s))

    errors = accuracy(estimate, truth)

    assert errors.poses == len(frames_s)
    assert errors.ate_m == pytest.approx(0.0, abs=1e-9)
    assert errors.rpe_m == pytest.approx(0.0, abs=1e-9)
    assert errors.rpe_deg == pytest.approx(0.0, abs=1e-5)


def test_the_relative_error_is_of_the_motion_over_one_second():
    stamps_s = np.arange(0.0, 5.0, 0.1)
    truth = Trajectory(stamps_s, np.tile(np.eye(4), (len(stamps_s), 1, 1)))
    turning = exp_se3(stamps_s[:, None] * np.array([0.02, 0, 0, 0, 0, np.radians(3.0)]))

    errors = accuracy(Trajectory(stamps_s, turning), truth)

    assert errors.rpe_deg == pytest.approx(3.0)
    assert errors.rpe_m == pytest.approx(0.02, rel=1e-3)


def test_the_body_is_compared_where_its_place_beside_the_camera_is_known():
    stamps_s = np.arange(0.0, 5.0, 0.1)
    T_body_camera = exp_se3(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    truth = Trajectory(stamps_s, screw(stamps_s))
    wrong = screw(stamps_s) @ exp_se3(np.array([0, 0, 0, 0, 0, np.radians(4.0)]) * np.sin(stamps_s)[:, None])
    estimate = Trajectory(stamps_s, wrong)

    of_camera, of_body = accuracy(estimate, truth), accuracy(estimate, truth, T_body_camera=T_body_camera)

    assert of_camera.ate_m == pytest.approx(0.0, abs=1e-9)
    assert of_body.ate_m > 0.005
    reported = trajectory_figures(estimate, truth, T_body_camera)["ate_cm"]
    assert reported == pytest.approx(100 * of_body.ate_m, abs=1e-3)
    assert trajectory_figures(estimate, truth)["ate_cm"] == pytest.approx(0.0, abs=1e-3)
    scaled = Trajectory(stamps_s, screw(stamps_s))
    scaled.T_world_camera[:, :3, 3] *= 3.0
    free = accuracy(scaled, truth, with_scale=True, T_body_camera=T_body_camera)
    assert (free.ate_m, free.scale) == (pytest.approx(0.0, abs=1e-9), pytest.approx(1 / 3))


def test_a_pose_in_a_gap_of_the_truth_or_outside_of_it_has_none():
    known_s = np.array([0.0, 0.1, 0.2, 1.0, 1.1])
    truth = Trajectory(known_s, screw(known_s))
    asked_s = np.array([-0.5, -0.001, 0.15, 0.5, 1.0, 1.101, 1.2])

    assert with_truth(truth, asked_s).tolist() == [False, True, True, False, True, True, False]
    with pytest.raises(UsageError, match="0 poses have a true one"):
        accuracy(Trajectory(known_s + 50.0, screw(known_s)), truth)


@pytest.mark.data
@pytest.mark.parametrize(
    ("estimate", "truth", "expected"),
    [
        ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", (0.013470, 0.034760, 0.005764, None)),
        ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", (0.008119, None, None, 0.006123)),
    ],
)
def test_figures_equal_those_of_another_program(
    estimate: str, truth: str, expected: tuple[float | None, ...]
):
    """The oracle is evo 1.38.1, which pairs poses within 10 ms, and compares the motion between pairs.

    The pairs get time stamps one second apart, so that this is the motion over one second.
    """
    if not RECORDED.exists():
        pytest.skip(f"no recordings at {RECORDED}")
    mine, true = read_trajectory(RECORDED / estimate), read_trajectory(RECORDED / truth)
    nearest = np.abs(mine.timestamps_s[:, None] - true.timestamps_s).argmin(axis=1)
    rows = np.flatnonzero(np.abs(mine.timestamps_s - true.timestamps_s[nearest]) <= EVO_MAX_DIFFERENCE_S)
    paired_mine = Trajectory(np.arange(len(rows)), mine.T_world_camera[rows])
    paired_true = Trajectory(np.arange(len(rows)), true.T_world_camera[nearest[rows]])

    metric, scaled = (accuracy(paired_mine, paired_true, with_scale=each) for each in (False, True))

    found = (metric.ate_m, metric.ate_max_m, metric.rpe_m, scaled.ate_m)
    for value, wanted in zip(found, expected, strict=True):
        assert wanted is None or value == pytest.approx(wanted, abs=1e-5)
