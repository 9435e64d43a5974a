"""Watch a drive frame by frame, and say at its end what is wrong with it.

It keeps small things only: features of some frames, and depths around them.
"""

from __future__ import annotations

from client_sdk.check.calibration import judge_calibration
from client_sdk.check.findings import CheckReport, order
from client_sdk.check.keyframes import KeyframeStore
from client_sdk.frontend import Frame, TrackedFrame

__all__ = ["DriveObserver"]


class DriveObserver:
    """Take all frames of a drive in order, with what was tracked of them, and judge them together."""

    def __init__(self) -> None:
        self._store = KeyframeStore()

    def add(self, frame: Frame, tracked: TrackedFrame | None = None) -> None:
        """Look at the next frame; *tracked* has the pose that a mapper gave it, if there is one.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        self._store.add(frame, None if tracked is None else tracked.T_world_camera)

    def finish(self) -> CheckReport:
        """Return what is wrong with the drive, worst first, and what it cannot tell."""
        calibration = judge_calibration(self._store)
        return CheckReport(
            findings=order(calibration.findings, calibration.noise_m),
            cannot_tell=calibration.cannot_tell,
            frames=self._store.frames,
        )
