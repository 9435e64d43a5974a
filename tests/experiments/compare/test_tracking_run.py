"""A run: its errors, what lost frames do to its figures, and that it can be repeated."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import Dataset
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.compare.configurations import Configuration, configurations_of
from rse_pf.extensions.experiments.compare.solvers import InProcessSolver
from rse_pf.extensions.experiments.compare.tracking_run import TrackingRun, longest_gap_s, track
from tests.client_sdk.mapper.test_imu import leaning_first, with_imu  # noqa: F401
from tests.kit.compare_recordings import flat_drive

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

DEFAULT = Configuration(name="default")


def run(drive: Dataset, configuration: Configuration = DEFAULT) -> TrackingRun:
    return asyncio.run(track(configuration, drive, InProcessSolver(PlatformSettings())))


def test_all_frames_of_an_easy_drive_have_a_pose_near_the_truth() -> None:
    done = run(flat_drive())

    assert (done.figures["posed"], done.figures["frames"], done.is_metric) == (10, 10, True)
    assert done.figures["ate_cm"] is not None
    assert done.figures["ate_cm"] < 0.5
    assert done.figures["ate_online_cm"] == pytest.approx(done.figures["ate_cm"])
    assert done.figures["longest_gap_s"] == pytest.approx(0.1)
    assert 1_000 < (done.figures["bytes_a_frame"] or 0) < 10_000
    assert (done.figures["bytes_a_keyframe"] or 0) > 1_000
    assert done.times_ms["robot"] > 0
    assert done.times_ms["server"] > 0


@pytest.mark.usefixtures("leaning_first")
def test_a_world_that_is_turned_in_mid_drive_is_no_error_of_the_poses_before() -> None:
    done = run(flat_drive(change=lambda row, frame: with_imu(frame)))

    assert done.figures["ate_cm"] is not None
    assert done.figures["ate_cm"] < 0.5
    assert done.figures["ate_online_cm"] == pytest.approx(done.figures["ate_cm"])


def test_frames_without_a_pose_at_the_ends_are_a_gap() -> None:
    stamps_s = np.arange(10) / 10

    assert longest_gap_s(stamps_s, stamps_s[3:5]) == pytest.approx(0.5)
    assert longest_gap_s(stamps_s, stamps_s[5:]) == pytest.approx(0.5)
    assert longest_gap_s(stamps_s, stamps_s[:0]) == pytest.approx(0.9)


def test_without_depth_the_scale_is_estimated() -> None:
    (configuration,) = configurations_of(["without-depth"])

    done = run(flat_drive(20), configuration)

    assert not done.is_metric
    assert done.errors is not None
    assert done.errors.scale != 1.0
    assert not done.errors.has_unit
    assert done.figures["bytes_a_keyframe"] is None


def test_a_recording_without_truth_has_all_other_figures_and_says_why() -> None:
    done = run(flat_drive(has_truth=False))

    assert (done.figures["posed"], done.figures["ate_cm"], done.errors) == (10, None, None)
    assert "no truth" in done.why


def test_a_recording_in_which_nothing_is_tracked_says_so() -> None:
    done = run(flat_drive(change=lambda row, frame: replace(frame, rgb=np.zeros_like(frame.rgb))))

    assert (done.figures["posed"], done.figures["longest_gap_s"]) == (0, pytest.approx(0.9))
    assert done.why == "0 of 10 frames have a pose, an evaluation needs 3"


def test_a_function_of_the_user_that_fails_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("def features(rgb):\n    return rgb / 'x'\n")

    with pytest.raises(UsageError, match=r"frame 1 of flat at 10 Hz: .*mine\.py, line 2: \w*TypeError"):
        run(flat_drive(), configurations_of([str(path)])[0])
