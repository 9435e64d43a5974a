"""Tests of undetermined faults: the stated reason is true, since a drive without that lack determines
them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from client_sdk.check.calibration import check_calibration
from client_sdk.check.findings import FaultKind
from tests.kit.rendered_drives import Made, make_store

FOCAL, PRINCIPAL = FaultKind.FOCAL_LENGTH, FaultKind.PRINCIPAL_POINT
OFFSET, DELAY, MOVING = FaultKind.DEPTH_OFFSET, FaultKind.DEPTH_DELAY, FaultKind.MOVING_FOCAL_LENGTH
STILL, MOVING_M = (0.0, 0.0, 0.0), (0.6, 0.6, 0.6)


def stiff(**like: Any) -> Made:
    """Return a drive that hardly turns."""
    return Made(turn=0.01, roll=0.01, **like)


def unchecked(made: Made) -> dict[FaultKind, str]:
    judgement = check_calibration(make_store(made))
    assert not judgement.findings
    return {each.kind: each.reason for each in judgement.cannot_tell}


@pytest.mark.parametrize(
    ("lacking", "kind", "reason", "better"),
    [
        (stiff(seed=61), FOCAL, "turns by 1 degrees only", {"turn": 0.5}),
        (stiff(seed=62), PRINCIPAL, "turns by 1 degrees only", {"turn": 0.5, "roll": 0.3}),
        (stiff(seed=63, moves_m=(0.0, 0.0, 0.6)), FOCAL, "turns by 1 degrees only", {"turn": 0.5}),
        (stiff(seed=64, moves_m=(0.6, 0.0, 0.0)), FOCAL, "turns by 1 degrees only", {"turn": 0.5}),
        (stiff(seed=65, is_wall=True), FOCAL, "turns by 1 degrees only", {"turn": 0.3}),
        (stiff(seed=66, has_depth=False), FOCAL, "turns by 1 degrees only", {"turn": 0.5}),
        (
            Made(seed=67, is_wall=True, turn=0.03, moves_m=(0.6, 0.6, 0.0)),
            OFFSET, "depths lie between 3.0 and 3.", {"moves_m": (0.6, 0.6, 1.6)},
        ),
        (Made(seed=68, size=8.0), OFFSET, "of the depth of what it sees only", {"size": 1.0}),
        (Made(seed=69, moves_m=STILL), OFFSET, "moves by 0.", {"moves_m": MOVING_M}),
        (Made(seed=70, moves_m=STILL, has_depth=False), FOCAL, "moves by 0.0%", {"moves_m": MOVING_M}),
        (Made(seed=71, moves_m=STILL, has_depth=False), MOVING, "views do not determine", {"moves_m":
        MOVING_M}), (Made(seed=72, speed=0.05), OFFSET, "of the depth of what it sees only", {"speed": 1.0}),
        (
            Made(seed=73, turn=0.0, roll=0.0, moves_m=STILL),
            PRINCIPAL, "neither moves nor turns", {"moves_m": MOVING_M, "turn": 0.5, "roll": 0.3},
        ),
        (Made(seed=74, depth_noise=8.0), OFFSET, "times what those of a Kinect do", {"depth_noise": 1.0}),
        (Made(seed=75, depth_noise=8.0), DELAY, "times what those of a Kinect do", {"depth_noise": 1.0}),
        (Made(seed=76, depth_share=0.0), FOCAL, "a depth at 0% of its features", {"depth_share": 1.0}),
        (Made(seed=77, depth_share=0.03), DELAY, "a depth at 3% of its features", {"depth_share": 1.0}),
        (Made(seed=78, points=120), FOCAL, "share enough features", {"points": 1500}),
        (Made(seed=79, views=4), OFFSET, "4 views that differ", {"views": 30}),
    ],
)  # fmt: skip
def test_the_reason_is_what_the_drive_lacks(
    lacking: Made, kind: FaultKind, reason: str, better: dict[str, Any]
) -> None:
    assert reason in unchecked(lacking)[kind]
    assert kind not in unchecked(replace(lacking, **better))


def test_a_drive_that_was_not_tracked_does_not_determine_its_lens() -> None:
    store = make_store(Made(seed=82, has_depth=False))
    assert FOCAL not in {each.kind for each in check_calibration(store).cannot_tell}
    for keyframe in store.keyframes[4:]:
        keyframe.T_world_camera = None

    reasons = {each.kind: each.reason for each in check_calibration(store).cannot_tell}

    assert "a pose in 4 of 30 views only" in reasons[FOCAL]


def test_an_undetermined_offset_of_depths_makes_the_scale_uncertain() -> None:
    flat = Made(seed=83, is_wall=True, turn=0.03, moves_m=(0.6, 0.6, 0.0))

    deviations = [check_calibration(make_store(made)).scale_deviation for made in (flat, Made(seed=83))]

    assert deviations[0] > 0.02 > deviations[1]
