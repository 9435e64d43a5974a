"""Bundle adjustment, two views and matching, on points whose places are known."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.monocular.bundle import Bundle, adjust
from client_sdk.monocular.scale import MarkerScale, OdometryScale
from client_sdk.monocular.two_view import start_from_two_views
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.slam.triangulation import reprojection_errors, triangulate

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=500.0, fy=500.0, cx=319.5, cy=239.5, width=640, height=480)


def scene(seed: int = 1, points: int = 120, cameras: int = 5) -> tuple[Array, Array, Array]:
    """Return points, poses ``T_camera_world`` of a sideways path, and exact pixels ``(c, p, 2)``."""
    rng = np.random.default_rng(seed)
    world = np.column_stack(
        (rng.uniform(-1, 1, points), rng.uniform(-0.7, 0.7, points), rng.uniform(2, 4, points))
    )
    poses = np.stack([exp_se3([-0.15 * k, 0.01 * k, 0.02 * k, 0.0, 0.02 * k, 0.0]) for k in range(cameras)])
    pixels = np.stack([CAMERA.project(transform(pose, world)) for pose in poses])
    return world, poses, pixels


def bundle_of(world: Array, poses: Array, pixels: Array, fixed: int) -> Bundle:
    cameras, points = len(poses), len(world)
    return Bundle(
        T_camera_world=poses, is_fixed=np.arange(cameras) < fixed, points_world=world,
        cameras=np.repeat(np.arange(cameras), points), points=np.tile(np.arange(points), cameras),
        pixels=pixels.reshape(-1, 2), sigma_px=np.ones(cameras * points),
    )  # fmt: skip


def test_finds_the_true_poses_and_points_from_disturbed_ones() -> None:
    world, poses, pixels = scene()
    rng = np.random.default_rng(2)
    disturbed = np.stack([*poses[:2], *(exp_se3(rng.normal(0, 0.02, 6)) @ pose for pose in poses[2:])])

    found, points = adjust(
        bundle_of(world + rng.normal(0, 0.05, world.shape), disturbed, pixels, 2), CAMERA, iterations=20
    )

    assert np.abs(points - world).max() < 1e-4
    assert max(pose_difference(*pair)[0] for pair in zip(found, poses, strict=True)) < 1e-4
    np.testing.assert_array_equal(found[:2], poses[:2])


def test_wrong_observations_hardly_move_the_adjusted_poses() -> None:
    world, poses, pixels = scene()
    rng = np.random.default_rng(3)
    pixels = pixels + rng.normal(0, 0.3, pixels.shape)
    pixels[4, ::10] += 60.0

    found, _ = adjust(bundle_of(world, poses, pixels, 2), CAMERA, iterations=15)

    assert pose_difference(found[4], poses[4])[0] < 0.02


def test_a_point_behind_the_camera_is_infinitely_far_from_every_pixel() -> None:
    _, poses, _ = scene()

    distances, depths = reprojection_errors(poses[3], np.array([[0.0, 0.0, -3.0]]), np.zeros((1, 2)), CAMERA)

    assert np.isinf(distances).all()
    assert depths[0] < 0


def test_two_views_give_direction_rotation_and_points_up_to_scale() -> None:
    _, poses, pixels = scene(points=200)
    rng = np.random.default_rng(4)
    second = pixels[3] + rng.normal(0, 0.2, pixels[3].shape)
    second[:40] = rng.uniform(0, 480, (40, 2))

    views = start_from_two_views(pixels[0], second, CAMERA)

    truth = poses[3] @ inverse(poses[0])
    direction = truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    assert views.reason == ""
    assert np.linalg.norm(views.T_second_first[:3, 3] - direction) < 0.05
    assert pose_difference(views.T_second_first, truth)[1] < 0.3
    assert len(views.rows) > 140


@pytest.mark.parametrize(
    ("twist", "why"),
    [([0.0, 0, 0, 0.0, 0.1, 0.0], "only turns"), ([-0.002, 0, 0, 0, 0, 0], "does not move")],
)
def test_a_turn_or_a_tiny_step_is_no_start(twist: list[float], why: str) -> None:
    world, _, pixels = scene(points=200)
    rng = np.random.default_rng(5)
    second = CAMERA.project(transform(exp_se3(twist), world)) + rng.normal(0, 0.2, (200, 2))

    assert why in start_from_two_views(pixels[0], second, CAMERA).reason


def test_too_few_matches_are_no_start() -> None:
    assert "only 5 matches" in start_from_two_views(np.zeros((5, 2)), np.zeros((5, 2)), CAMERA).reason


def test_triangulates_and_refuses_what_disagrees() -> None:
    world, poses, pixels = scene()
    second = pixels[4].copy()
    second[0] += [0.0, 30.0]

    points, good = triangulate(poses[0], poses[4], pixels[0], second, CAMERA)

    assert not good[0]
    assert good[1:].all()
    np.testing.assert_allclose(points[1:], world[1:], atol=1e-6)


def test_odometry_gives_the_scale_after_its_first_metre() -> None:
    stamps = np.arange(20) / 10
    positions_m = np.column_stack((0.1 * np.arange(20), np.zeros(20), np.zeros(20)))
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 2, 3] = positions_m[:, 0] / 2.5
    scale = OdometryScale(stamps, positions_m)

    nothing = np.empty((0, 0, 3), dtype=np.uint8)
    known = []
    for row, stamp in enumerate(stamps):
        scale.observe(float(stamp), nothing, None)
        known.append(scale.metres_per_unit(stamps[: row + 1], poses[: row + 1], CAMERA, 2.0))

    assert known[9] is None
    assert known[11] == pytest.approx(2.5)


def test_a_marker_gives_the_scale() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.aruco.generateImageMarker(dictionary, 7, 200)
    board = np.full((280, 280), 255, np.uint8)
    board[40:240, 40:240] = marker
    size_m, unit_m = 0.2, 0.5  # the map's unit is half a metre
    poses = np.tile(np.eye(4), (6, 1, 1))
    scale = MarkerScale(size_m)
    for k in range(6):
        poses[k, 0, 3] = 0.1 * k
        pose = inverse(poses[k])
        # The board spans 0.28 m, 1 m before the first camera.
        corners = np.array([[-0.14, -0.14, 1.0], [0.14, -0.14, 1.0], [0.14, 0.14, 1.0], [-0.14, 0.14, 1.0]])
        seen = CAMERA.project(transform(pose, corners)).astype(np.float32)
        H = cv2.getPerspectiveTransform(np.float32([[0, 0], [279, 0], [279, 279], [0, 279]]), seen)
        image = cv2.warpPerspective(board, H, (640, 480), borderValue=128)
        scale.observe(k / 10, np.repeat(image[..., None], 3, axis=2), None)
    poses[:, :3, 3] /= unit_m

    found = scale.metres_per_unit(np.arange(6) / 10, poses, CAMERA, 2.0)

    assert found == pytest.approx(unit_m, rel=0.02)
    assert scale.metres_per_unit(np.arange(2) / 10, poses[:2], CAMERA, 2.0) is None


@pytest.mark.parametrize(
    "make",
    [
        lambda: MarkerScale(25.0),
        lambda: OdometryScale(first_m=0.0),
        lambda: OdometryScale(np.zeros(3), np.zeros((2, 3))),
        lambda: OdometryScale(np.zeros(3)),
    ],
)
def test_a_length_that_cannot_be_is_refused(make: object) -> None:
    with pytest.raises(UsageError):
        make()  # type: ignore[operator]
