"""The report of the demo, without running it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory
from rse_pf.extensions.experiments.demo.report import advice, closing_lines, is_lost, make_report
from rse_pf.extensions.experiments.demo.robot import RobotFinished, _is_metric
from rse_pf.extensions.experiments.results.records import CommandRecord

COMMAND = CommandRecord(
    id=1, robot="robot-1", planned=0.0, sent=0.0, answered=0.01, server="a", code="ok",
    payload_bytes=4000, round_trip_ms=9.0, queue_ms=0.1, compute_ms=2.0,
)  # fmt: skip


def walk(wrong_m: float = 0.0) -> Trajectory:
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 0.9, 10)
    poses[:, 1, 3] = np.where(np.arange(10) % 2, wrong_m, -wrong_m)
    return Trajectory(np.arange(10) / 5.0, poses)


def finished(truth: Trajectory | None) -> RobotFinished:
    return RobotFinished(
        frames=10, lost_frames=1, keyframes=2, weak_poses=0, map_points=5, fps=4.9, matches=[300, 310],
        inliers=[290, 300], commands=[COMMAND], trajectory=walk(0.01), truth=truth, truth_kind="ground truth",
    )  # fmt: skip


def report(truth: Trajectory | None):
    return make_report(
        [finished(truth)], [COMMAND], {"rate_hz": 5.0}, {"settings_digest": "d", "load_average": [0]}, [0]
    )


@pytest.mark.parametrize(
    ("mapper", "expected"),
    [
        (SimpleNamespace(scale="metric, by depth"), True),
        (SimpleNamespace(scale="up to scale"), False),
        (SimpleNamespace(scale="metric, by stereo", metres_per_unit=1.0), True),
        (SimpleNamespace(scale="metric, by the live map", metres_per_unit=0.28), False),
        (SimpleNamespace(scale="up to scale", metres_per_unit=None), False),
    ],
)
def test_a_drive_is_in_metres_if_its_odometry_is(mapper: SimpleNamespace, expected: bool) -> None:
    assert _is_metric(mapper) is expected


def with_lost(lost: int, **asked: object):
    made = report(walk())
    return {**made, "lost_frames": lost, "asked": {"rate_hz": 5.0, "frontend": "standard", **asked}}


@pytest.mark.parametrize(
    ("lost", "asked", "words"),
    [
        (0, {"data": "fr1"}, ()),
        (4, {"data": "fr1"}, ("--rate above 5", "--frontend wide-baseline")),
        (4, {"data": "fr1", "frontend": "wide-baseline"}, ("--rate above 5",)),
        (4, {}, ("--frontend wide-baseline",)),
        (4, {"frontend": "wide-baseline"}, ("more slowly",)),
    ],
)
def test_when_frames_are_lost_the_last_lines_say_what_helps(
    lost: int, asked: dict[str, object], words: tuple[str, ...]
) -> None:
    made = with_lost(lost, **asked)

    assert bool(advice(made)) == bool(words)
    assert all(word in closing_lines(made, Path("out")) for word in words)
    assert ("--rate" in advice(made)) == ("--rate above 5" in words)


@pytest.mark.parametrize(
    ("lost", "before", "failed"), [(0, 0, False), (5, 0, False), (6, 0, True), (2, 3, False), (0, 10, True)]
)
def test_a_run_in_which_most_frames_have_no_pose_has_failed(lost: int, before: int, failed: bool) -> None:
    made = {**with_lost(lost), "frames_before_start": before}
    assert is_lost(made) is failed
    assert (
        f"failed: {lost + before} of 10 frames have no pose" in closing_lines(made, Path("out"))
    ) is failed
