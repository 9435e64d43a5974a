"""The bridge over DDS: images in and poses out between two processes, and the bytes of ROS 2."""

from __future__ import annotations

import asyncio
import queue
import sys
from pathlib import Path

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import (
    CAMERA_INFO,
    DIAGNOSTICS,
    IMAGE,
    PATH,
    POINT_CLOUD,
    POSE_WITH_COVARIANCE,
    TF,
)
from client_sdk.cameras import open_camera
from client_sdk.frontend import Frame
from ros_bridge.dds import DdsTopics
from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.client_sdk.bags.small_bags import camera_info, raw_image, scene, stamp_of

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make ros")

_DOMAIN = 87
_FRAMES = 200
_BOUND_S = 10.0


def test_the_bytes_of_dds_are_those_of_ros2() -> None:
    maker, topics = MessageMaker(is_ros1=False), DdsTopics(_DOMAIN)
    draw, stamp = np.random.default_rng(3), 1_700_000_000_123_456_789
    pose = np.eye(4)
    pose[:3, 3] = draw.normal(size=3)
    messages = {
        CAMERA_INFO: camera_info(maker, stamp_of(1), (0.1, 0.2, 0.3, 0.4, 0.5)),
        IMAGE: raw_image(maker, stamp, scene().colours[0], "rgb8", frame="a", pad=3),
        POSE_WITH_COVARIANCE: maker.pose_with_covariance(stamp, "map", pose, draw.normal(size=(6, 6))),
        PATH: maker.path_of(stamp, "odom", [maker.pose(stamp + n, "od", pose) for n in range(3)]),
        TF: maker.transforms([maker.transform(stamp, "map", "odom", pose)]),
        DIAGNOSTICS: maker.diagnostics(stamp, "rse_pf", 1, "why", {"frames": "7", "a": ""}),
        POINT_CLOUD: maker.cloud(
            stamp, "odom", draw.normal(size=(9, 3)).astype(np.float32),
            draw.integers(0, 255, (9, 3)).astype(np.uint8),
        ),
    }  # fmt: skip
    for kind, message in messages.items():
        data = maker.encode(kind, message)
        assert topics.class_of(kind).deserialize(data).serialize() == data, kind
    topics.close()


def test_images_become_poses_between_two_processes(recordings: Path, tmp_path: Path) -> None:
    frames = list(open_camera(str(recordings / "7scenes_redkitchen")))[:_FRAMES]
    answered = asyncio.run(_drive(frames, tmp_path))
    assert answered == _FRAMES


async def _drive(frames: list[Frame], folder: Path) -> int:
    """Send each image when the pose of the one before has come; return how many poses came."""
    maker, topics = MessageMaker(is_ros1=False), DdsTopics(_DOMAIN)
    poses: queue.Queue[bytes] = queue.Queue()
    names = {"colour": "/eye/colour", "depth": "/eye/depth", "info": "/eye/info"}
    token_file = folder / "token"
    async with LocalPlatform(PlatformSettings(), port=0, servers=1, state=folder / "platform") as platform:
        token_file.write_text(platform.issue_token("dds-1"), encoding="ascii")
        bridge = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "ros_bridge", "dds", "--url", platform.url, "--token-file", str(token_file),
            "--dds-domain", str(_DOMAIN), *(f"--{role}={topic}" for role, topic in names.items()),
            stdout=asyncio.subprocess.PIPE, cwd=Path(__file__).parents[2],
        )  # fmt: skip
        try:
            assert bridge.stdout is not None
            assert b"bridging" in await asyncio.wait_for(bridge.stdout.readline(), 60)
            for role, topic in names.items():
                topics.advertise(topic, CAMERA_INFO if role == "info" else IMAGE)
            topics.subscribe("/rse_pf/pose", POSE_WITH_COVARIANCE, poses.put, depth=100)
            return await asyncio.to_thread(_send_all, maker, topics, frames, poses)
        finally:
            bridge.terminate()
            await bridge.wait()
            topics.close()


def _send_all(maker: MessageMaker, topics: DdsTopics, frames: list[Frame], poses: queue.Queue[bytes]) -> int:
    answered = 0
    for frame in frames:
        stamp = round(1e9 * frame.timestamp_s) + 1_700_000_000_000_000_000
        camera = frame.camera
        info = camera_info(
            maker, stamp, height=camera.height, width=camera.width, k=camera.matrix.ravel(),
            p=np.hstack((camera.matrix, np.zeros((3, 1)))).ravel(),
        )  # fmt: skip
        depth = np.round(1000 * frame.depth_m).astype(np.uint16)
        # The first ones are sent until the readers have found the writers.
        for _ in range(20 if not answered else 1):
            topics.publish("/eye/info", maker.encode(CAMERA_INFO, info))
            topics.publish("/eye/colour", maker.encode(IMAGE, raw_image(maker, stamp, frame.rgb, "rgb8")))
            topics.publish("/eye/depth", maker.encode(IMAGE, raw_image(maker, stamp, depth, "16UC1")))
            try:
                data = poses.get(timeout=_BOUND_S if answered else 1.0)
            except queue.Empty:
                continue
            header = maker.decode(POSE_WITH_COVARIANCE, data).header
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp
            answered += 1
            break
    return answered
