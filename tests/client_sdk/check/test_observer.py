"""The judges of a drive together."""

from __future__ import annotations

from benchmarks.check.drives import rendered_drive
from benchmarks.check.faults import plant
from client_sdk.check.findings import FaultKind
from client_sdk.check.motion import MotionReference
from client_sdk.check.observer import DriveObserver
from client_sdk.frontend import TrackedFrame


def test_repeated_images_are_not_told_as_late_stamps() -> None:
    drive = rendered_drive(1, 60)
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
