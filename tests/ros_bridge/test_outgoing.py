"""Tests of `ros_bridge.outgoing`: poses, covariances, frames and stamps of what ROS gets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import ODOMETRY, PATH, POSE_WITH_COVARIANCE, TF
from client_sdk.frontend import Frame, TrackedFrame
from ros_bridge import BridgeOptions, OutgoingMessages
from ros_bridge.outgoing import ros_covariance, with_alignment
from rse_pf.geometry import Array, Camera, exp_se3, inverse

CAMERA = Camera(fx=60, fy=60, cx=31.5, cy=23.5, width=64, height=48)
STAMP_NS = 1_700_000_000_123_456_789
POSE = exp_se3(np.array([0.4, -0.2, 1.1, 0.3, -0.6, 0.9]))
ALIGNMENT = exp_se3(np.array([2.0, 1.0, -0.5, 0.0, 0.0, 1.2]))


def tracked(pose: Array | None = POSE, covariance: Array | None = None) -> TrackedFrame:
    frame = Frame(
        timestamp_s=STAMP_NS / 1e9, rgb=np.zeros((48, 64, 3), np.uint8),
        depth_m=np.zeros((48, 64), np.float32), camera=CAMERA,
    )  # fmt: skip
    return TrackedFrame(
        frame=frame, T_world_camera=pose, keyframe=False, inliers=9, matches=10, covariance=covariance
    )


def made(options: BridgeOptions | None = None) -> tuple[MessageMaker, OutgoingMessages]:
    maker = MessageMaker(is_ros1=False)
    return maker, OutgoingMessages(maker, options or BridgeOptions())


def random_covariance(seed: int, scale: float) -> Array:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * scale
    found: Array = root @ root.T
    return found


def sampled_covariance(draw: np.random.Generator, covariance: Array, moved: object) -> Array:
    """Return the covariance of position and rotation about fixed axes of what *moved* gives, by drawing."""
    root = np.linalg.cholesky(covariance)
    middle = moved(np.zeros(6))  # type: ignore[operator]
    rows = []
    for _ in range(20_000):
        pose = moved(root @ draw.normal(size=6))  # type: ignore[operator]
        turn = pose[:3, :3] @ middle[:3, :3].T
        angles = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        rows.append([*(pose[:3, 3] - middle[:3, 3]), *angles])
    found: Array = np.cov(np.array(rows).T)
    return found


@pytest.mark.slow
def test_covariances_are_those_of_drawn_poses() -> None:
    covariance, alignment = random_covariance(0, 0.003), random_covariance(1, 0.003)
    draw = np.random.default_rng(2)

    own = sampled_covariance(draw, covariance, lambda xi: inverse(exp_se3(xi) @ inverse(POSE)))
    placed = sampled_covariance(draw, alignment, lambda xi: exp_se3(xi) @ ALIGNMENT @ POSE)

    size = np.abs(own).max()
    assert np.abs(ros_covariance(covariance, POSE) - own).max() < 0.05 * size
    T_map_camera = ALIGNMENT @ POSE
    assert (
        np.abs(with_alignment(np.zeros((6, 6)), T_map_camera, alignment) - placed).max()
        < 0.05 * np.abs(placed).max()
    )


def test_covariances_are_rotated_into_the_frame_of_the_pose() -> None:
    forward = np.diag([1e-4, 1e-4, 4e-2, 0, 0, 0])  # uncertain along the optical axis
    quarter = np.eye(4)
    quarter[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # the camera looks along x of the world
    assert np.allclose(np.diag(ros_covariance(forward, quarter))[:3], [4e-2, 1e-4, 1e-4])


def test_a_pose_has_the_stamp_of_its_images_and_is_in_the_map() -> None:
    maker, outgoing = made(BridgeOptions(namespace="robot1"))
    messages = outgoing.of_frame(
        tracked(covariance=random_covariance(0, 0.01)), STAMP_NS, "eye", T_map_odom=ALIGNMENT
    )

    pose = maker.decode(POSE_WITH_COVARIANCE, messages[0].data)
    moved = maker.decode(TF, messages[2].data)
    topics = ["/robot1/rse_pf/pose", "/robot1/rse_pf/odometry", "/tf"]
    assert [each.topic for each in messages] == topics
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == divmod(STAMP_NS, 1_000_000_000)
    assert pose.header.frame_id == "map"
    assert np.allclose(
        [pose.pose.pose.position.x, pose.pose.pose.position.y, pose.pose.pose.position.z],
        (ALIGNMENT @ POSE)[:3, 3],
    )
    assert pose.pose.covariance[0] > 0
    names = [(each.header.frame_id, each.child_frame_id) for each in moved.transforms]
    assert names == [("map", "robot1/odom"), ("robot1/odom", "eye")]
    assert moved.transforms[0].transform.translation.x == pytest.approx(ALIGNMENT[0, 3])


def test_odometry_is_in_the_odometry_frame_and_claims_no_velocity() -> None:
    maker, outgoing = made(BridgeOptions(namespace="robot1"))
    seen = tracked(covariance=random_covariance(0, 0.01))
    messages = outgoing.of_frame(seen, STAMP_NS, "eye", T_map_odom=ALIGNMENT, alignment=np.eye(6))

    odometry = maker.decode(ODOMETRY, messages[1].data)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("robot1/odom", "eye")
    place = odometry.pose.pose.position
    assert np.allclose([place.x, place.y, place.z], POSE[:3, 3])
    in_map = maker.decode(POSE_WITH_COVARIANCE, messages[0].data)
    assert odometry.pose.covariance[0] < in_map.pose.covariance[0]  # no doubt of the alignment is in it
    assert odometry.twist.covariance.reshape(6, 6).diagonal().tolist() == [1e6] * 6


def test_a_path_is_turned_with_its_world() -> None:
    maker, outgoing = made()
    outgoing.of_frame(tracked(), 1, "eye", T_map_odom=None)
    upright = exp_se3(np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.1]))
    turned = replace(tracked(), T_world_camera=upright @ POSE, T_new_old=upright)
    outgoing.of_frame(turned, 2, "eye", T_map_odom=None)

    first, second = maker.decode(PATH, outgoing.path()[0].data).poses
    assert np.allclose(
        [first.pose.position.x, first.pose.position.y, first.pose.position.z], (upright @ POSE)[:3, 3]
    )
    assert first.pose.orientation.w == pytest.approx(second.pose.orientation.w)


def test_a_long_path_is_thinned_and_stays_bounded() -> None:
    maker, outgoing = made(BridgeOptions(path_poses=10))
    for number in range(100):
        pose = np.eye(4)
        pose[0, 3] = number
        outgoing.of_frame(replace(tracked(), T_world_camera=pose), number, "eye", T_map_odom=None)

    path = maker.decode(PATH, outgoing.path()[0].data)
    places = [each.pose.position.x for each in path.poses]
    assert len(places) <= 10
    assert places[0] < 20
    assert places[-1] > 80
    assert np.all(np.diff(places) > 0)
