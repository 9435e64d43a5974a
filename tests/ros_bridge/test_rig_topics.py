"""Stereo topics and an IMU: pairs are rectified as in bags, samples travel with the frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import CAMERA_INFO, IMAGE, IMU
from client_sdk.frontend import Frame
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from client_sdk.rigs.rig_file import write_rig
from ros_bridge import BridgeOptions, IncomingFrames
from ros_bridge.incoming import Role
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3
from tests.kit.small_bags import (
    CX,
    CY,
    FX,
    HEIGHT,
    WIDTH,
    camera_info,
    raw_image,
    scene,
    stamp_of,
)

pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")

SHOWN = scene()
BASELINE_M = 0.12
CAMERA = Camera(fx=FX, fy=FX, cx=CX, cy=CY, width=WIDTH, height=HEIGHT)
STEREO = {
    "right": "/rig/right/image_raw",
    "right_info": "/rig/right/camera_info",
    "colour": "/rig/left/image_raw",
}
KINDS = {"info": CAMERA_INFO, "right_info": CAMERA_INFO, "imu": IMU}


class StereoMessageStream:
    """The messages of a robot with a pair, as bytes of ROS 1 or CDR."""

    def __init__(self, *, is_ros1: bool = True, **options: object) -> None:
        self.maker = MessageMaker(is_ros1=is_ros1)
        self.frames = IncomingFrames(self.maker, BridgeOptions.of(STEREO | options))

    def send(self, role: Role, message: object) -> bool:
        return self.frames.add(role, self.maker.encode(KINDS.get(role, IMAGE), message))

    def infos(self, step: float) -> None:
        """Send both cameras; *step* is P[3] of the right one."""
        for role, P3 in (("info", 0.0), ("right_info", step)):
            message: Any = camera_info(self.maker, stamp_of(0))
            P = np.array([FX, 0, CX, 0, 0, FX, CY, 0, 0, 0, 1.0, 0])
            P[3] = P3
            setattr(message, "P" if hasattr(message, "P") else "p", P)
            self.send(role, message)  # type: ignore[arg-type]

    def pair(self, row: int) -> Frame | None:
        self.send("colour", raw_image(self.maker, stamp_of(row), SHOWN.colours[row], "rgb8"))
        self.send("right", raw_image(self.maker, stamp_of(row), SHOWN.colours[row + 1], "rgb8"))
        images = self.frames.take()
        return None if images is None else self.frames.decode(images)

    def imu(self, stamp_ns: int, rate: float = 0.1) -> None:
        gyro, accel = np.array([rate, 0.0, 0.0]), np.array([0.0, 0.0, 9.81])
        self.send("imu", self.maker.imu(stamp_ns, "imu", gyro, accel))


def rig_file(folder: Path, *, right: bool = True, imu: bool = True) -> tuple[Path, Rig]:
    lens = Intrinsics(camera=CAMERA, distortion=(-0.1, 0.02, 0.0, 0.0))
    mount: Array = exp_se3(np.array([0.1, 0.0, 0.2, 0.3, -1.0, 0.5]))
    left = RigCamera(name="left", lens=lens, T_body_camera=mount)
    aside = exp_se3(np.array([BASELINE_M, 0.0, 0.0, 0.0, 0.01, 0.0]))
    beside = RigCamera(name="right", lens=lens, T_body_camera=mount @ aside)
    sensor = RigImu(
        T_body_imu=np.eye(4),
        gyro_noise=1e-3,
        gyro_walk=1e-4,
        accel_noise=6e-3,
        accel_walk=3e-3,
        rate_hz=200.0,
    )
    rig = Rig(cameras=(left, beside) if right else (left,), imu=sensor if imu else None)
    write_rig(folder / "rig.json", rig)
    return folder / "rig.json", rig


@pytest.mark.parametrize("is_ros1", [True, False])
def test_a_pair_has_the_baseline_of_both_camera_infos(is_ros1: bool) -> None:
    robot = StereoMessageStream(is_ros1=is_ros1)
    robot.infos(-FX * BASELINE_M)

    frame = robot.pair(1)

    assert frame is not None, robot.frames.check.fault
    assert frame.stereo is not None
    assert frame.stereo.baseline_m == pytest.approx(BASELINE_M)
    assert not frame.depth_m.any()
    assert frame.timestamp_s == stamp_of(1) / 1e9


def test_swapped_cameras_are_reported_and_give_no_frame() -> None:
    robot = StereoMessageStream()
    robot.infos(FX * BASELINE_M)

    assert "swapped" in robot.frames.check.fault
    assert robot.pair(1) is None


def test_a_file_of_a_rig_rectifies_the_pair_and_places_the_imu(tmp_path: Path) -> None:
    path, rig = rig_file(tmp_path)
    robot = StereoMessageStream(rig=str(path), imu="/imu")
    robot.infos(-FX * 0.05)  # the file is believed, not P
    assert rig.right is not None
    wanted = Rectification(rig.left, rig.right)
    step_ns = 5_000_000
    for number in range(-4, 50):
        robot.imu(stamp_of(0) + number * step_ns)
    first, second = robot.pair(0), robot.pair(1)

    assert first is not None, robot.frames.check.fault
    assert second is not None, robot.frames.check.fault
    assert second.stereo is not None
    assert second.imu is not None
    assert first.imu is not None
    assert second.camera == wanted.camera
    assert second.stereo.baseline_m == pytest.approx(wanted.baseline_m)
    np.testing.assert_allclose(second.T_body_camera, wanted.T_body_camera)
    np.testing.assert_allclose(second.imu.model.T_imu_camera, wanted.T_body_camera)
    # One sample at or before the last frame, one at or after this one.
    assert second.imu.timestamps_s[0] <= first.timestamp_s < second.imu.timestamps_s[1]
    assert second.imu.timestamps_s[-2] < second.timestamp_s <= second.imu.timestamps_s[-1]


def test_a_frame_waits_for_the_sample_after_it_but_not_for_a_silent_imu(tmp_path: Path) -> None:
    path, _ = rig_file(tmp_path)
    robot = StereoMessageStream(rig=str(path), imu="/imu")
    robot.infos(-FX * BASELINE_M)
    robot.imu(stamp_of(0) - 5_000_000)
    assert robot.pair(0) is None

    robot.imu(stamp_of(0) + 5_000_000)
    images = robot.frames.take()
    assert images is not None
    frame = robot.frames.decode(images)
    assert frame is not None, robot.frames.check.fault
    assert frame.imu is not None
    assert frame.imu.timestamps_s[-1] > frame.timestamp_s

    assert robot.pair(1) is None  # a sample may still come
    assert robot.pair(2) is not None  # the next frame is here: it will not
    assert robot.pair(3) is not None
    assert robot.frames.take() is not None  # 0.3 s after the last sample: the IMU is silent


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"right": "/right"}, "camera_info of its right images"),
        ({"imu": "/imu"}, "where the IMU sits"),
        ({"map": "hall", "depth": ""}, "depth, or of right images"),
        ({"transform_tolerance_s": "-1"}, "is not a finite number of 0 or above"),
        ({"transform_tolerance_s": "inf"}, "is not a finite number of 0 or above"),
    ],
)
def test_what_is_missing_is_one_line(options: dict[str, str], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        BridgeOptions.of(options)
