"""The offset of disparities, and the baseline that bends a path alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from client_sdk.check import observer
from client_sdk.check.calibration import CalibrationCheck
from client_sdk.check.findings import CheckReport, FaultKind, Finding
from client_sdk.check.motion import MotionReference
from client_sdk.check.observer import DriveObserver
from client_sdk.check.pairs import check_pairs
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.stereo.view import StereoView
from client_sdk.tracking.stereo_adjustment import StereoAdjustment
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, Camera, exp_se3

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=40.0, fy=40.0, cx=31.5, cy=23.5, width=64, height=48)
KEYFRAMES = 20
STAMPS_S = np.arange(80) / 10.0
GROWTH = -0.1
"""Of a path, for each pixel: as in a room of 5 m with 58 m px."""


def path(scale: float = 1.0) -> Array:
    """Return ``(80, 4, 4)`` poses of a hand that moves to and fro, in metres of that scale."""
    t = STAMPS_S[:, None]
    rates = np.array([1.3, 0.9, 1.7, 0.8, 1.1, 0.7])
    poses = exp_se3(np.sin(t * rates) * np.array([0.6, 0.3, 0.5, 0.3, 0.4, 0.2]))
    poses[:, :3, 3] *= scale
    return poses


def adjustment(offset_px: float, deviation_px: float = 0.02, keyframes: int = KEYFRAMES) -> StereoAdjustment:
    """Return what an adjustment finds in a drive whose path is wrong by that offset alone."""
    rows = np.linspace(0, len(STAMPS_S) - 1, keyframes).astype(int)
    T_new_old = np.tile(np.eye(4), (keyframes, 1, 1))
    old, new = path(1.0 - GROWTH * offset_px)[rows], path()[rows]
    T_new_old[:, :3, 3] = new[:, :3, 3] - old[:, :3, 3]
    return StereoAdjustment(
        stamps_s=STAMPS_S[rows], T_new_old=T_new_old, f_baseline=58.0, offset_px=offset_px,
        deviation_px=deviation_px, bend_m_per_px=0.05, growth_per_px=GROWTH, noise_m=0.001,
    )  # fmt: skip


@pytest.mark.parametrize("offset_px", [0.3, -0.3])
def test_an_offset_is_reported_with_its_cost_and_what_to_set(offset_px: float) -> None:
    judged = check_pairs({0: adjustment(offset_px)})

    (finding,) = judged.findings
    assert finding.kind is FaultKind.DISPARITY_OFFSET
    assert finding.value == pytest.approx(offset_px, rel=0.05)
    assert finding.deviation == pytest.approx(0.042, abs=0.005)
    assert finding.cost_m == pytest.approx(0.015, rel=0.1)
    assert ("too small" in finding.sentence, "px larger" in finding.fix) == ((offset_px > 0,) * 2)
    assert list(judged.adjusted) == [0]


@pytest.mark.parametrize(
    "found",
    [adjustment(0.05, 0.005), adjustment(0.3, 0.1), replace(adjustment(0.3), bend_m_per_px=0.001)],
    ids=["of a good calibration", "not certain", "without effect"],
)
def test_an_offset_that_is_small_doubtful_or_harmless_is_no_finding(found: StereoAdjustment) -> None:
    assert check_pairs({0: found}).findings == ()


def test_few_keyframes_tell_no_offset_but_leave_metres_in_doubt() -> None:
    judged = check_pairs({0: adjustment(0.5, 0.02, keyframes=8)})

    assert judged.findings == ()
    assert [each.kind for each in judged.cannot_tell] == [FaultKind.DISPARITY_OFFSET]
    assert not judged.adjusted
    assert judged.scale_deviation == pytest.approx(0.05)


def checked(scale: float, offsets: dict[int, StereoAdjustment]) -> CheckReport:
    """Return what is said of a stereo drive whose path is too large by *scale* compared with its odometry."""
    drive = DriveObserver(MotionReference(path=Trajectory(STAMPS_S, path())))
    image = np.full((CAMERA.height, CAMERA.width), 90, dtype=np.uint8)
    for stamp_s, pose in zip(STAMPS_S, path(scale), strict=True):
        frame = Frame(
            timestamp_s=float(stamp_s), rgb=np.repeat(image[:, :, None], 3, axis=2), camera=CAMERA,
            depth_m=np.zeros(image.shape, np.float32), stereo=StereoView(image, 0.11),
        )  # fmt: skip
        drive.add(
            frame,
            TrackedFrame(frame=frame, T_world_camera=pose, keyframe=False, inliers=50, matches=60),
        )
    drive.add_offsets(offsets)
    return drive.finish()


def kinds(report: CheckReport) -> set[FaultKind]:
    return {FaultKind.BASELINE, FaultKind.DISPARITY_OFFSET} & {each.kind for each in report.findings}


@pytest.mark.parametrize("share", [0.03, -0.03])
def test_a_baseline_is_reported_where_disparities_lack_nothing(share: float) -> None:
    report = checked(1.0 + share, {0: adjustment(0.0)})

    assert kinds(report) == {FaultKind.BASELINE}
    baseline = next(each for each in report.findings if each.kind is FaultKind.BASELINE)
    assert baseline.value == pytest.approx(share, rel=0.2)


def test_a_baseline_is_not_told_where_an_offset_could_be_the_cause() -> None:
    report = checked(1.03, {0: adjustment(0.0, 0.25)})

    assert kinds(report) == set()
    undetermined = next(each for each in report.cannot_tell if each.kind is FaultKind.BASELINE)
    assert "uncertainty of the calibration" in undetermined.reason


def test_a_wrong_lens_leaves_no_word_about_disparities(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = Finding(
        kind=FaultKind.FOCAL_LENGTH, value=0.1, deviation=0.01, unit="relative", cost_m=0.1,
        sentence="the focal length is 10 % too large", fix="calibrate", correction={},
    )  # fmt: skip
    monkeypatch.setattr(observer, "check_calibration", lambda store: CalibrationCheck(findings=(lens,)))

    report = checked(1.03, {0: adjustment(0.3)})

    assert FaultKind.DISPARITY_OFFSET not in kinds(report)
    assert FaultKind.FOCAL_LENGTH in {each.kind for each in report.findings}
