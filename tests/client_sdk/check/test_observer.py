"""The judges of a drive together."""

from __future__ import annotations

import pytest

from benchmarks.check.drives import CheckedDrive, rendered_drive
from benchmarks.check.faults import plant
from client_sdk.check.findings import FaultKind, order
from client_sdk.check.motion import MotionReference
from client_sdk.check.observer import DriveObserver
from client_sdk.frontend import TrackedFrame


@pytest.fixture(scope="module")
def drive() -> CheckedDrive:
    return rendered_drive(1, 60)


def test_repeated_images_are_not_told_as_late_stamps(drive: CheckedDrive) -> None:
    assert drive.odometry is not None
    observer = DriveObserver(MotionReference(path=drive.odometry))
    for seen, frame in enumerate(plant(drive.frames, FaultKind.REPEATED, 3)):
        # What a tracker gives: the pose of the image, which is that of the frame before.
        pose = drive.truth.T_world_camera[seen - seen % 2]
        tracked = TrackedFrame(frame=frame, T_world_camera=pose, keyframe=False, inliers=50, matches=60)
        observer.add(frame, tracked)

    report = observer.finish()

    assert report.frames == 60
    assert report.findings[0].kind is FaultKind.REPEATED
    assert FaultKind.STAMP_DELAY not in {each.kind for each in report.findings}


def test_findings_of_all_judges_are_in_one_order(drive: CheckedDrive) -> None:
    observer = DriveObserver()
    for row, frame in enumerate(plant(plant(drive.frames, FaultKind.BLUR, 3), FaultKind.DARK, 1)):
        assert frame.timestamp_s == drive.frames[row].timestamp_s
        observer.add(frame)

    findings = observer.finish().findings

    assert len(findings) >= 2
    assert findings == order(findings)
    assert findings[0].kind is FaultKind.DARK  # counted, and so better known than what is measured
