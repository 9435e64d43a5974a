"""The judges of a drive together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from client_sdk.check.findings import FaultKind, order
from client_sdk.check.motion import MotionReference
from client_sdk.check.observer import DriveObserver
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.imu.samples import ImuModel
from client_sdk.mapping import Trajectory
from client_sdk.simulator import make_world, render_along
from client_sdk.simulator.inertial import InertialDrive, Motion

SEED, FRAMES, RATE_HZ = 1, 60, 10.0


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """Move a camera in a hand about a point of the middle room."""
    noise = {"gyro_noise": 1e-3, "gyro_walk": 1e-5, "accel_noise": 1e-2, "accel_walk": 1e-4}
    model = ImuModel(T_imu_camera=np.eye(4), rate_hz=200.0, **noise)
    drive = InertialDrive(model, Motion(reach_m=0.5, turn_rad=0.5, fastest_hz=0.25), SEED)
    stamps_s = np.arange(FRAMES) / RATE_HZ
    T_world_camera = drive.T_world_camera(stamps_s).copy()
    T_world_camera[:, :3, 3] += np.array([7.5, 2.3, 1.3]) - T_world_camera[:, :3, 3].mean(axis=0)
    return Trajectory(stamps_s, T_world_camera)


@pytest.fixture(scope="module")
def frames(truth: Trajectory) -> list[Frame]:
    return list(render_along(truth, make_world(SEED), (SEED, 41)))


def repeated(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Give each image twice."""
    return (replace(frame, rgb=frames[row - row % 2].rgb) for row, frame in enumerate(frames))


def blurred_and_dark(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Blur every second image along its rows, and take the light from one of ten stretches of ten."""
    kernel = np.full((1, 25), 1 / 25, np.float32)
    for row, frame in enumerate(frames):
        rgb = cv2.filter2D(frame.rgb, -1, kernel) if row % 2 else frame.rgb
        is_dark = row % 20 < 2
        yield replace(frame, rgb=np.rint(rgb * 0.05).astype(np.uint8) if is_dark else rgb)


def test_repeated_images_are_not_told_as_late_stamps(frames: list[Frame], truth: Trajectory) -> None:
    observer = DriveObserver(MotionReference(path=truth))
    for seen, frame in enumerate(repeated(frames)):
        # What a tracker gives: the pose of the image, which is that of the frame before.
        pose = truth.T_world_camera[seen - seen % 2]
        tracked = TrackedFrame(frame=frame, T_world_camera=pose, keyframe=False, inliers=50, matches=60)
        observer.add(frame, tracked)

    report = observer.finish()

    assert report.frames == FRAMES
    assert report.findings[0].kind is FaultKind.REPEATED
    assert FaultKind.STAMP_DELAY not in {each.kind for each in report.findings}


def test_findings_of_all_judges_are_in_one_order(frames: list[Frame]) -> None:
    observer = DriveObserver()
    for row, frame in enumerate(blurred_and_dark(frames)):
        assert frame.timestamp_s == frames[row].timestamp_s
        observer.add(frame)

    findings = observer.finish().findings

    assert len(findings) >= 2
    assert findings == order(findings)
    assert findings[0].kind is FaultKind.DARK  # counted, and so better known than what is measured
