"""Tests of `ros_bridge.frame_tree`: which frames are joined, and poses between time stamps."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from ros_bridge.frame_tree import FrameTree, PoseHistory
from rse_pf.geometry import Array, exp_se3, inverse

SECOND_NS = 1_000_000_000
MAKER = MessageMaker(is_ros1=False)
A, B = (exp_se3(np.array(xi)) for xi in ([1.0, 0.2, 0.0, 0.0, 0.5, 0.3], [0.0, 0.1, 0.4, -0.7, 0.0, 1.1]))


def add(tree: FrameTree, edges: list[tuple[int, str, str, Array]], *, is_static: bool) -> None:
    tree.add(MAKER.transforms([MAKER.transform(*edge) for edge in edges]), is_static=is_static)


def test_static_transforms_join_frames_up_and_down_the_tree() -> None:
    tree = FrameTree()
    add(tree, [(0, "base_link", "mast", A), (0, "base_link", "wheel", B)], is_static=True)
    add(tree, [(0, "mast", "/eye", B)], is_static=True)

    for frame, other, expected in (
        ("base_link", "eye", A @ B),
        ("wheel", "eye", inverse(B) @ A @ B),
        ("eye", "base_link", inverse(A @ B)),
        ("base_link", "base_link", np.eye(4)),
    ):
        found = tree.static_pose(frame, other)
        assert found is not None
        assert np.allclose(found, expected)
    assert tree.static_pose("base_link", "hand") is None


def test_a_joint_that_moves_is_no_static_transform() -> None:
    tree = FrameTree()
    add(tree, [(0, "base_link", "head", A)], is_static=False)
    add(tree, [(0, "head", "eye", B)], is_static=True)
    assert tree.static_pose("base_link", "eye") is None


def test_a_chain_of_moving_and_static_frames_is_interpolated() -> None:
    tree, T_end = FrameTree(), exp_se3(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.2]))
    add(tree, [(0, "base_footprint", "base_link", A)], is_static=True)
    add(
        tree,
        [(0, "odom", "base_footprint", np.eye(4)), (10**8, "odom", "base_footprint", T_end)],
        is_static=False,
    )

    found = tree.pose("odom", "base_link", 10**8 // 4)
    assert found is not None
    assert np.allclose(found, exp_se3(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.05])) @ A)
    assert tree.pose("odom", "base_link", 2 * 10**8) is None
    assert tree.pose("map", "base_link", 0) is None


@pytest.mark.parametrize("cycle", [["a", "b"], ["a", "a"]])
def test_a_cycle_of_frames_ends(cycle: list[str]) -> None:
    tree = FrameTree()
    add(tree, [(0, cycle[0], cycle[1], A), (0, cycle[1], cycle[0], B)], is_static=True)
    assert tree.static_pose("a", "eye") is None
    assert tree.pose("odom", "a", 0) is None


def test_a_transform_that_is_no_rigid_motion_is_ignored() -> None:
    tree, message = FrameTree(), MAKER.transforms([MAKER.transform(0, "odom", "base_link", A)])
    message.transforms[0].transform.rotation.w = float("nan")
    tree.add(message, is_static=False)
    assert not tree.parent_of("base_link")


def test_poses_are_not_interpolated_over_a_gap_nor_after_the_clock_was_set_back() -> None:
    history = PoseHistory()
    for second in (10, 10.4, 12):
        history.add(round(second * SECOND_NS), A)
    assert history.at(round(10.2 * SECOND_NS)) is not None
    assert history.at(11 * SECOND_NS) is None
    assert history.at(13 * SECOND_NS) is None

    history.add(5 * SECOND_NS, B)
    assert history.newest_ns == 5 * SECOND_NS
    assert history.at(10 * SECOND_NS) is None
