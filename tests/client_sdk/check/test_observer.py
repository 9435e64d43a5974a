"""The judges of a drive together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from client_sdk.check.findings import FaultKind, order
from client_sdk.check.motion import MotionReference
from client_sdk.check.observer import DriveObserver
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.imu.samples import ImuModel
from client_sdk.simulator import make_world, render_along, true_trajectory
from client_sdk.trajectory import Trajectory
from tests.kit.inertial_drive import InertialDrive, Motion

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


def dotted(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Lay the dots of a projector that moves with the camera over each second image."""
    rng = np.random.default_rng(0)
    dots = np.zeros(frames[0].rgb.shape[:2], np.int16)
    for row, column in zip(*(rng.integers(1, side - 1, 4000) for side in dots.shape), strict=True):
        dots[row - 1 : row + 2, column - 1 : column + 2] = 90
    for row, frame in enumerate(frames):
        rgb = frame.rgb * 0.6 + (row % 2) * dots[:, :, None]
        yield replace(frame, rgb=np.clip(rgb, 0, 255).astype(np.uint8))


def covered_in_part(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Show a part of the robot on the left, as the camera sees it at all times."""
    for frame in frames:
        rgb = frame.rgb.copy()
        rgb[:, :160] = frames[0].rgb[:, :160]
        yield replace(frame, rgb=rgb)


def passed_by(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Let a textured box pass before a camera at rest."""
    texture = np.random.default_rng(0).integers(0, 255, (80, 60, 3)).astype(np.uint8)
    box = cv2.resize(texture, (360, frames[0].rgb.shape[0]), interpolation=cv2.INTER_NEAREST)
    for row, frame in enumerate(frames):
        rgb, first = frames[0].rgb.copy(), 14 * row - 340
        shown = slice(max(0, first), max(0, min(rgb.shape[1], first + box.shape[1])))
        rgb[:, shown] = box[:, shown.start - first : shown.stop - first]
        yield replace(frame, rgb=rgb)


def frozen(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Repeat one image 20 times."""
    return (replace(frame, rgb=frames[20 if 20 <= row < 40 else row].rgb) for row, frame in enumerate(frames))


def along_the_ray(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Measure depth along the ray of each pixel."""
    camera = frames[0].camera
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    rays = np.linalg.norm(camera.back_project(pixels, np.ones(len(pixels))), axis=1).reshape(rows.shape)
    return (replace(frame, depth_m=(frame.depth_m * rays).astype(np.float32)) for frame in frames)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (iter, []),
        (dotted, ["static-pattern"]),
        (covered_in_part, ["static-pattern"]),
        (passed_by, ["moving-objects"]),
        (frozen, ["frozen-images"]),
        (along_the_ray, ["depth-along-ray"]),
    ],
)
def test_what_is_wrong_in_the_view_is_found_and_silences_the_advice(
    frames: list[Frame],
    truth: Trajectory,
    change: Callable[[Sequence[Frame]], Iterator[Frame]],
    expected: list[str],
) -> None:
    observer = DriveObserver()
    for frame, pose in zip(change(frames), truth.T_world_camera, strict=True):
        tracked = TrackedFrame(frame=frame, T_world_camera=pose, keyframe=False, inliers=50, matches=60)
        observer.add(frame, tracked)

    report = observer.finish()

    assert [doubt.name.value for doubt in report.doubts] == expected
    assert not (report.doubts and report.findings)
    assert not observer.finish(accepted=expected).doubts


def test_depth_images_that_are_upside_down_are_not_taken_for_depth_along_the_ray() -> None:
    truth = true_trajectory(0, 1, 40, 3)
    observer = DriveObserver()
    for frame, pose in zip(render_along(truth, make_world(3), (3, 41)), truth.T_world_camera, strict=True):
        turned = replace(frame, depth_m=np.ascontiguousarray(frame.depth_m[::-1, ::-1]))
        tracked = TrackedFrame(frame=turned, T_world_camera=pose, keyframe=False, inliers=50, matches=60)
        observer.add(turned, tracked)

    assert not observer.finish().doubts
