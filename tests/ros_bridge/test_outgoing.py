"""Tests of `ros_bridge.base_poses` and `ros_bridge.outgoing`: covariances, corrections and the path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import ODOMETRY, PATH, POSE_WITH_COVARIANCE
from client_sdk.frontend import Frame, TrackedFrame
from ros_bridge import BridgeOptions, OutgoingMessages
from ros_bridge.base_poses import BasePoses, with_alignment
from ros_bridge.robot_frames import RobotFrames
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference

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


def robot(**options: object) -> tuple[MessageMaker, BasePoses, OutgoingMessages]:
    """Return what a bridge has, for a robot whose base is the camera ``eye``."""
    chosen, maker = BridgeOptions.of(options), MessageMaker(is_ros1=False)
    frames = RobotFrames(chosen)
    frames.settle("eye", None)
    poses = BasePoses(frames, chosen.max_correction_m_s)
    return maker, poses, OutgoingMessages(maker, chosen, frames)


def random_covariance(seed: int, scale: float) -> Array:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * scale
    found: Array = root @ root.T
    return found


def sampled_covariance(
    draw: np.random.Generator, covariance: Array, moved: Callable[[Array], Array]
) -> Array:
    """Return the covariance of position and rotation about fixed axes of what *moved* gives, by drawing."""
    root = np.linalg.cholesky(covariance)
    middle = moved(np.zeros(6))
    rows = []
    for _ in range(20_000):
        pose = moved(root @ draw.normal(size=6))
        turn = pose[:3, :3] @ middle[:3, :3].T
        angles = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        rows.append([*(pose[:3, 3] - middle[:3, 3]), *angles])
    found: Array = np.cov(np.array(rows).T)
    return found


@pytest.mark.slow
def test_covariances_are_those_of_drawn_poses() -> None:
    covariance, alignment = random_covariance(0, 0.003), random_covariance(1, 0.003)
    draw = np.random.default_rng(2)
    _, poses, _ = robot()
    pose = poses.add(tracked(covariance=covariance), STAMP_NS, ALIGNMENT)
    assert pose is not None

    own = sampled_covariance(draw, covariance, lambda xi: ALIGNMENT @ inverse(exp_se3(xi) @ inverse(POSE)))
    placed = sampled_covariance(draw, alignment, lambda xi: exp_se3(xi) @ ALIGNMENT @ POSE)

    assert np.abs(pose.map_covariance - own).max() < 0.05 * np.abs(own).max()
    added = with_alignment(np.zeros((6, 6)), ALIGNMENT @ POSE, alignment)
    assert np.abs(added - placed).max() < 0.05 * np.abs(placed).max()


def test_the_covariance_of_a_camera_is_rotated_into_the_frame_of_the_pose() -> None:
    forward = np.diag([1e-4, 1e-4, 4e-2, 0, 0, 0])  # uncertain along the optical axis
    quarter = np.eye(4)
    quarter[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # the camera looks along x of the world
    _, poses, _ = robot()
    pose = poses.add(tracked(quarter, forward), STAMP_NS, np.eye(4))
    assert pose is not None
    assert np.allclose(np.diag(pose.map_covariance)[:3], [4e-2, 1e-4, 1e-4])


def test_a_pose_is_in_the_map_and_odometry_in_the_odometry_frame_with_the_stamp_of_the_images() -> None:
    maker, poses, outgoing = robot(namespace="robot1")
    pose = poses.add(tracked(covariance=random_covariance(0, 0.01)), STAMP_NS, ALIGNMENT, np.eye(6))
    assert pose is not None
    messages = outgoing.of_pose(pose, STAMP_NS)

    in_map, odometry = (
        maker.decode(kind, each.data)
        for kind, each in zip((POSE_WITH_COVARIANCE, ODOMETRY), messages, strict=True)
    )
    assert [each.topic for each in messages] == ["/robot1/rse_pf/pose", "/robot1/rse_pf/odometry"]
    stamps = [(each.header.stamp.sec, each.header.stamp.nanosec) for each in (in_map, odometry)]
    assert stamps == 2 * [divmod(STAMP_NS, 1_000_000_000)]
    assert in_map.header.frame_id == "map"
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("robot1/odom", "eye")
    for message, T in ((in_map, ALIGNMENT @ POSE), (odometry, POSE)):
        place = message.pose.pose.position
        assert np.allclose([place.x, place.y, place.z], T[:3, 3])
    assert odometry.pose.covariance[0] < in_map.pose.covariance[0]  # without that of the alignment
    assert odometry.twist.covariance.reshape(6, 6).diagonal().tolist() == [1e6] * 6


def test_without_an_alignment_there_is_odometry_only_and_no_transform_from_the_map() -> None:
    _, poses, outgoing = robot()
    for T_map_world, topics in (
        (ALIGNMENT, ["/rse_pf/pose", "/rse_pf/odometry"]),
        (None, ["/rse_pf/odometry"]),
    ):
        pose = poses.add(tracked(), STAMP_NS, T_map_world)
        assert pose is not None
        assert [each.topic for each in outgoing.of_pose(pose, STAMP_NS)] == topics
        found = poses.map_to_odom(0.1)
        assert (found is None) == (T_map_world is None)


def test_a_correction_moves_the_robot_no_faster_than_the_option_says() -> None:
    _, poses, _ = robot(max_correction_m_s=0.5)
    poses.add(tracked(), STAMP_NS, np.eye(4))
    before = poses.map_to_odom(0.1)
    poses.add(tracked(), STAMP_NS + 1, ALIGNMENT)
    steps_m = []
    for _ in range(200):
        after = poses.map_to_odom(0.1)
        assert before is not None
        assert after is not None
        steps_m.append(pose_difference(after @ POSE, before @ POSE)[0])
        before = after

    assert 0.045 < max(steps_m) <= 0.05
    assert before is not None
    assert np.allclose(before, ALIGNMENT)


def test_a_path_is_in_the_map_and_moves_with_world_and_alignment() -> None:
    maker, _, outgoing = robot()
    outgoing.extend_path(1, POSE)
    outgoing.path(np.eye(4))
    upright = exp_se3(np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.1]))
    outgoing.move_path(upright)
    outgoing.extend_path(2, upright @ POSE)

    path = maker.decode(PATH, outgoing.path(ALIGNMENT)[0].data)
    assert path.header.frame_id == "map"
    for each in path.poses:
        place = each.pose.position
        assert np.allclose([place.x, place.y, place.z], (ALIGNMENT @ upright @ POSE)[:3, 3])


def test_a_long_path_is_thinned_and_stays_bounded() -> None:
    maker, _, outgoing = robot(path_poses=10)
    for number in range(100):
        pose = np.eye(4)
        pose[0, 3] = number
        outgoing.extend_path(number, pose)
        outgoing.path(np.eye(4))

    path = maker.decode(PATH, outgoing.path(np.eye(4))[0].data)
    places = [each.pose.position.x for each in path.poses]
    assert len(places) <= 10
    assert places[0] < 20
    assert places[-1] > 80
    assert np.all(np.diff(places) > 0)


def test_a_world_that_turns_turns_the_pose() -> None:
    _, poses, _ = robot()
    upright = exp_se3(np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.1]))
    poses.add(tracked(), STAMP_NS, np.eye(4))
    turned = poses.add(replace(tracked(upright @ POSE), T_new_old=upright), STAMP_NS + 1, np.eye(4))
    assert turned is not None
    assert turned.T_map_base is not None
    assert np.allclose(turned.T_map_base, upright @ POSE)
