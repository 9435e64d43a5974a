"""Collect measurements of a drive frame by frame, and find its faults at the end.

No images are kept: only statistics of images, poses, and up to 56 keyframes with features and depths.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np

from client_sdk.check.calibration import CalibrationCheck, check_calibration
from client_sdk.check.findings import CannotTell, CheckReport, FaultKind, Finding, order
from client_sdk.check.frames import FrameStatistics
from client_sdk.check.keyframes import KeyframeStore
from client_sdk.check.motion import (
    MIN_ADJUSTED_KEYFRAMES,
    CameraMotion,
    MotionReference,
    check_imu,
    check_motion,
    nothing_to_compare,
)
from client_sdk.check.pairs import PairsCheck, check_pairs
from client_sdk.check.scene import SceneWatch, doubts_of_depth
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.imu.history import ImuHistory
from client_sdk.rigs.stereo_pair_checks import PairFault
from client_sdk.source_facts import Doubt, unresolved
from client_sdk.tracking.stereo_adjustment import StereoAdjustment
from rse_pf.geometry import Array

__all__ = ["DriveObserver"]

_MOTION_FALSIFYING_FAULTS = {FaultKind.MIRRORED, FaultKind.TWO_CAMERAS, FaultKind.REPEATED}
"""Faults that falsify the tracked motion, which is then not compared with a reference or an IMU."""


class DriveObserver:
    """Check a drive: `add` all frames in the order of time with their tracking results, then `finish`."""

    def __init__(self, reference: MotionReference | None = None, *, is_thinned: bool = False) -> None:
        """Start without frames.

        Args:
            reference: Odometry or ground truth to compare with; may also be set later, before `finish`.
            is_thinned: Whether frames of the recording were left out on purpose; then gaps are no fault.
        """
        self.reference = reference
        self._store = KeyframeStore()
        self._images = FrameStatistics(is_thinned=is_thinned)
        self._scene = SceneWatch()
        self._history: ImuHistory | None = None
        self._poses: list[tuple[float, Array, int]] = []
        self._is_lost: list[bool] = []
        self._has_depth = self._has_stereo = self._is_metric = False
        self._pair_fault: PairFault | None = None
        self._pair_offsets: Mapping[int, StereoAdjustment] = {}

    def add(self, frame: Frame, tracked: TrackedFrame | None = None) -> None:
        """Add the next frame, and the result of tracking it: None or a result without pose if it was lost.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        self._images.add(frame.timestamp_s, frame.rgb)
        self._is_lost.append(tracked is None or tracked.T_world_camera is None)
        found = None if tracked is None else tracked.features
        self._store.add(frame, None if tracked is None else tracked.T_world_camera, found)
        self._has_stereo |= frame.stereo is not None
        self._has_depth |= frame.stereo is None and bool(frame.depth_m[::16, ::16].any())
        if frame.imu is not None and len(frame.imu):
            self._history = self._history or ImuHistory(frame.imu.model)
            self._history.add(frame.imu)
        if tracked is not None:
            self._scene.add(frame, tracked)
        if tracked is not None and tracked.T_world_camera is not None:
            self._is_metric = tracked.scale == "metric"
            self._poses.append((frame.timestamp_s, tracked.T_world_camera, tracked.segment))

    def add_pairs(self, fault: PairFault | None) -> None:
        """Set the fault of the stereo rig; None if the rig has no fault.

        The fault is found by `client_sdk.rigs.stereo_pair_checks.find_fault_of_frames`.
        """
        self._pair_fault = fault

    def add_offsets(self, found: Mapping[int, StereoAdjustment]) -> None:
        """Set the results of `Mapper.adjust_pairs` for a stereo drive, by number of the segment."""
        self._pair_offsets = found

    def cause_of_loss(self) -> str | None:
        """Return why most frames without a pose were lost, and what to do; None if images do not show it."""
        return self._images.cause_of_loss(np.array(self._is_lost, dtype=bool))

    def finish(self, doubts: Sequence[Doubt] = (), accepted: Iterable[str] = ()) -> CheckReport:
        """Find the faults of the drive, and list those that it cannot show.

        If there are doubts about the source or its images, only these are reported, and the calibration is
        not estimated: it would be fitted to damaged data.

        Args:
            doubts: Doubts about the source that the user has not accepted.
            accepted: Names of doubts that the user has accepted, which also applies to those found here.
        """
        seen = [*self._images.frozen(), *self._scene.doubts()]
        if self._has_depth:
            seen += doubts_of_depth(self._store.keyframes)
        doubts = (*doubts, *unresolved(seen, accepted))
        if doubts:
            return CheckReport(frames=len(self._images), poses=len(self._poses), doubts=tuple(doubts))
        findings, undetermined = self._images.findings()
        calibration = check_calibration(self._store)
        findings += calibration.findings
        undetermined += calibration.cannot_tell
        if self._pair_fault is not None:
            findings.append(_of_pairs(self._pair_fault))
        # A wrong lens falsifies the disparities, so their offset is estimated only without such a finding.
        pairs = check_pairs({} if calibration.findings else self._pair_offsets)
        findings += pairs.findings
        undetermined += pairs.cannot_tell
        moved, cannot, noted = self._motion(calibration, findings, pairs)
        return CheckReport(
            findings=order([*findings, *moved], calibration.noise_m),
            cannot_tell=(*undetermined, *cannot),
            frames=len(self._images),
            poses=len(self._poses),
            notes=tuple(noted),
        )

    def _motion(
        self, calibration: CalibrationCheck, known: list[Finding], pairs: PairsCheck
    ) -> tuple[list[Finding], list[CannotTell], list[str]]:
        """Compare the motion with odometry, ground truth and IMU: findings, undetermined faults, and notes.

        *known* are the findings so far; one of `_MOTION_FALSIFYING_FAULTS` among them prevents the
        comparison.
        """
        by_depth = self._has_depth or self._has_stereo
        if self.reference is None and self._history is None:
            return [], nothing_to_compare(has_depth=by_depth), []
        hidden = _MOTION_FALSIFYING_FAULTS & {each.kind for each in order(known)}
        if hidden:
            reason = f"{min(each.value for each in hidden)} falsifies the motion that would be compared"
            return (
                [],
                [CannotTell(FaultKind.STAMP_DELAY, reason), CannotTell(FaultKind.DEPTH_SCALE, reason)],
                [],
            )
        if len(self._poses) < 2:
            reason = "no pose was tracked to be compared with another motion"
            return [], [CannotTell(FaultKind.STAMP_DELAY, reason), CannotTell(FaultKind.MIRRORED, reason)], []
        order_s = np.argsort([each[0] for each in self._poses], kind="stable")
        stamps_s = np.array([each[0] for each in self._poses])[order_s]
        poses = np.array([each[1] for each in self._poses])[order_s]
        segments = np.array([each[2] for each in self._poses])[order_s]
        findings: list[Finding] = []
        undetermined: list[CannotTell] = []
        notes: list[str] = []
        if self._history is not None:
            findings, notes = check_imu(self._history, stamps_s, poses)
        if self.reference is not None:
            adjusted = calibration.stamps_s, calibration.T_world_camera
            doubt = calibration.scale_deviation if len(adjusted[0]) >= MIN_ADJUSTED_KEYFRAMES else 0.0
            by_pairs = self._pair_offsets and not calibration.findings
            motion = CameraMotion(
                stamps_s=stamps_s, T_world_camera=pairs.moved(stamps_s, poses, segments), segments=segments,
                scale_source=self._scale_source(), adjusted=None if by_pairs else adjusted,
                scale_deviation=math.hypot(doubt, pairs.scale_deviation),
            )  # fmt: skip
            by_reference, undetermined = check_motion(motion, self.reference)
            findings = [*findings, *by_reference]
        elif by_depth:
            undetermined.append(nothing_to_compare(has_depth=True)[-1])
        return findings, undetermined, notes

    def _scale_source(self) -> Literal["depth", "stereo", "none"]:
        if not self._is_metric or not (self._has_depth or self._has_stereo):
            return "none"
        return "stereo" if self._has_stereo else "depth"


def _of_pairs(fault: PairFault) -> Finding:
    """Return the fault of a stereo rig as a finding."""
    kinds = {
        "swapped": FaultKind.SWAPPED_CAMERAS, "late": FaultKind.STAMP_DELAY,
        "rows": FaultKind.BASELINE,
    }  # fmt: skip
    return Finding(
        kind=kinds[fault.what], value=fault.value, deviation=0.0, unit=fault.unit, cost_m=None,
        sentence=fault.message, fix=fault.hint,
    )  # fmt: skip
