"""The rendered world: exact where it must be, flawed as a Kinect is, and the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.frontend import PoseQuery
from client_sdk.simulator import (
    SIMULATED_CAMERA,
    frames_to_overlap,
    render_frames,
    true_trajectory,
)
from client_sdk.simulator.renderer import Renderer, add_depth_noise
from client_sdk.simulator.world import DEPTH_M, DOOR_Y_M, HEIGHT_M, ROOM_M, make_world
from client_sdk.tracking.tracker import Tracker
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.errors import UsageError
from rse_pf.geometry import transform
from rse_pf.pnp import PnpOptions, solve_pnp


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(make_world(0), SIMULATED_CAMERA)


def test_the_same_arguments_give_the_same_frames_and_another_seed_others():
    first, again, other = (next(render_frames(1, 3, 1, seed)) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.rgb, again.rgb)
    np.testing.assert_array_equal(first.depth_m, again.depth_m)
    assert np.mean(first.rgb != other.rgb) > 0.5


def test_ten_rooms_have_a_loop_through_all_doors_past_all_tables():
    truth = true_trajectory(0, 1, 1500, 0, 10)
    at = truth.positions
    rooms = (at[:, 0] // ROOM_M).astype(int)
    along = at[:, 0] % ROOM_M
    at_table = (along > 2.0) & (along < 3.0) & (at[:, 1] > 1.85) & (at[:, 1] < 2.75)
    at_door = ((along < 0.2) | (along > ROOM_M - 0.2)) & (at[:, 0] > 1.0)

    assert frames_to_overlap(10, 10) == 158
    assert max(np.linalg.norm(np.diff(at, axis=0), axis=1)) <= 0.08
    assert set(rooms) == set(range(10))
    assert not at_table[rooms % 2 == 0].any()
    assert ((at[at_door, 1] > DOOR_Y_M[0] + 0.2) & (at[at_door, 1] < DOOR_Y_M[1] - 0.2)).all()
    assert at_door.any()
    with pytest.raises(UsageError, match="needs 2 rooms or more"):
        true_trajectory(0, 1, 5, 0, 1)


@pytest.mark.parametrize("robots", [1, 2, 3, 5])
def test_robots_that_merge_drive_past_the_start_of_the_next_one(robots: int):
    frames = frames_to_overlap(robots)

    paths = [true_trajectory(robot, robots, frames, 0).positions for robot in range(robots)]

    for own, following in zip(paths, paths[1:] + paths[:1], strict=True):
        for seen in (following[0], following[6]):
            assert np.linalg.norm(own[frames // 2 :] - seen, axis=1).min() < 0.1


def test_every_ray_ends_on_a_surface_of_the_world(renderer: Renderer):
    pose = true_trajectory(0, 1, 1, 0).T_world_camera[0]

    _, depth_m, _ = renderer.draw(pose)

    assert (depth_m > 0).mean() > 0.9999
    rows, columns = np.nonzero(depth_m[::7, ::7] > 0)
    pixels = np.column_stack((columns * 7, rows * 7)).astype(float)
    camera_points = SIMULATED_CAMERA.back_project(pixels, depth_m[rows * 7, columns * 7].astype(float))
    points = transform(pose, camera_points)
    assert (points > -0.001).all()
    assert (points < [3 * ROOM_M + 0.001, DEPTH_M + 0.001, HEIGHT_M + 0.001]).all()


def test_the_depth_of_a_wall_is_exact(renderer: Renderer):
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [1, 0, 0], [0, -1, 0]]  # looking along -x; x of the image is +y
    pose[:3, 3] = [1.0, 1.5, 0.5]

    _, depth_m, cosine = renderer.draw(pose)

    assert depth_m[240, 320] == pytest.approx(1.0, abs=1e-5)
    assert cosine[240, 320] == pytest.approx(1.0, abs=1e-4)
    # the floor, 0.5 m below: row 239.5 + 525 * 0.5 / z, so at row 449 z = 0.5 * 525 / 209.5
    assert depth_m[449, 320] == pytest.approx(0.5 * 525 / 209.5, abs=1e-4) or depth_m[449, 320] < 1.0001


def test_depth_noise_has_the_size_that_the_model_says():
    rng = np.random.default_rng(0)
    for z in (1.0, 2.0, 4.0):
        truth = np.full((400, 400), z, np.float32)

        errors = add_depth_noise(truth, np.ones_like(truth), rng)
        seen = errors > 0

        step = z * z / (8 * 0.075 * 580)  # 1/8 px of disparity, in metres
        sigma = np.hypot(0.0012 + 0.0019 * (z - 0.4) ** 2, step / np.sqrt(12))
        assert np.std(errors[seen] - z) == pytest.approx(sigma, rel=0.05)
        assert abs(np.mean(errors[seen]) - z) < 0.05 * sigma + step**2
        assert 0.001 < 1 - seen.mean() < 0.003


def test_depth_has_holes_at_edges_at_grazing_angles_and_out_of_range():
    truth = np.full((100, 100), 2.0, np.float32)
    truth[:, 50:] = 3.0
    truth[0], truth[1] = 0.39, 6.1
    cosine = np.ones_like(truth)
    cosine[60] = 0.05

    seen = add_depth_noise(truth, cosine, np.random.default_rng(0)) > 0

    assert not seen[[0, 1, 60]].any()
    assert not seen[3:59, 50:53].any()  # the shadow of the nearer surface
    assert seen[3:59, :50].mean() > 0.99
    assert seen[3:59, 53:].mean() > 0.99


def test_robots_that_do_not_exist_are_refused():
    for arguments in ((3, 3, 10, 0), (-1, 3, 10, 0), (0, 1, 0, 0)):
        with pytest.raises(UsageError):
            next(render_frames(*arguments))


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "robots", "seed"), [(0, 3, 0), (2, 3, 1), (4, 5, 2)])
def test_the_world_can_be_tracked(robot: int, robots: int, seed: int):
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    truth, tracker, poses = true_trajectory(robot, robots, 30, seed), Tracker(), []
    for frame in render_frames(robot, robots, 30, seed):
        step = tracker.prepare(frame)
        while isinstance(step, PoseQuery):
            found = step.correspondences
            solution = solve_pnp(
                found.points_world, found.pixels, step.camera, PnpOptions(inlier_px=step.inlier_px)
            )
            step = tracker.accept(step, solution.T_camera_world, len(solution.inliers))
        poses.append(step.T_world_camera)

    assert tracker.lost_frames == 0
    assert (
        100 * accuracy(Trajectory(truth.timestamps_s, np.array(poses)), truth).ate_m <= 2.0 * truth.length_m
    )
