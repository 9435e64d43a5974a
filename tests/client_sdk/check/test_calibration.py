"""Tests of the judges of a calibration, on drives of exact points with one fault each."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from client_sdk.check.calibration import CalibrationCheck, _Errors, check_calibration
from client_sdk.check.findings import FaultKind, Finding, order
from client_sdk.check.keyframes import KeyframeStore
from tests.kit.rendered_drives import Made, make_store


def judged(made: Made) -> CalibrationCheck:
    return check_calibration(make_store(made))


def first(made: Made) -> Finding:
    judgement = judged(made)
    return order(judgement.findings, judgement.noise_m)[0]


@pytest.mark.parametrize(
    ("made", "kind", "value"),
    [
        (Made(seed=1, fx=0.05), FaultKind.FOCAL_LENGTH, 0.05),
        (Made(seed=2, fx=-0.1), FaultKind.FOCAL_LENGTH, -0.1),
        (Made(seed=3, cx_px=15.0), FaultKind.PRINCIPAL_POINT, 15.0),
        (Made(seed=4, k1=-0.15), FaultKind.DISTORTION, -0.15),
        (Made(seed=5, offset_m=0.1), FaultKind.DEPTH_OFFSET, 0.1),
        (Made(seed=6, delay_s=0.1), FaultKind.DEPTH_DELAY, 0.1),
        (Made(seed=7, delay_s=-0.3), FaultKind.DEPTH_DELAY, -0.3),
        (Made(seed=8, flip=True), FaultKind.MIRRORED, 1.0),
        (Made(seed=9, zoom_after=1.1), FaultKind.TWO_CAMERAS, 0.1),
        (Made(seed=9, zoom_after=1.1, zoom_stretch=3), FaultKind.TWO_CAMERAS, 0.1),
        (Made(seed=10, fx=0.1, has_depth=False), FaultKind.FOCAL_LENGTH, 0.1),
    ],
)
def test_a_planted_fault_is_the_first_finding_with_its_value(
    made: Made, kind: FaultKind, value: float
) -> None:
    finding = first(made)

    assert finding.kind is kind
    assert abs(finding.value - value) < max(3.0 * finding.deviation, 0.01 * abs(value))
    assert abs(finding.value - value) <= 0.2 * abs(value)


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_drive_has_no_finding(seed: int) -> None:
    assert judged(Made(seed=20 + seed, has_depth=seed % 3 != 0)).findings == ()


def test_a_focal_length_comes_with_the_number_to_set() -> None:
    finding = first(Made(seed=1, fx=0.05))

    assert finding.correction["fx"] == pytest.approx(525.0 / 1.05, abs=6.0)
    assert "fx = " in finding.fix


@pytest.mark.parametrize(
    ("fy", "deviation", "rows"),
    [(0.05, 0.03, [0, 1]), (0.02, 0.03, [0]), (-0.05, 0.03, [0])],
    ids=["wrong alike", "not known", "wrong the other way"],
)
def test_both_focal_lengths_are_corrected_where_both_are_wrong_alike(
    fy: float, deviation: float, rows: list[int]
) -> None:
    """One of them alone bends the map more; only fx is certain here."""
    values, deviations = np.zeros(9), np.full(9, 0.01)
    values[:2], deviations[:2] = (0.06, fy), (0.01, deviation)
    errors = _Errors(values, deviations, adjusted=Mock(), camera=Mock())

    assert errors.with_the_other([0]) == rows


def test_a_drive_that_does_not_turn_does_not_determine_the_focal_length() -> None:
    reported = {each.kind: each for each in judged(Made(turn=0.02, roll=0.02)).cannot_tell}

    focal = reported[FaultKind.FOCAL_LENGTH]
    assert "turns by" in focal.reason
    assert "vertical axis" in focal.reason
    assert focal.within is not None
    assert focal.within > 0.06
    assert not judged(Made()).cannot_tell


def test_a_drive_of_few_views_determines_nothing_and_does_not_fail() -> None:
    for store in (KeyframeStore(), make_store(Made(views=3))):
        checked = check_calibration(store)

        assert checked.findings == ()
        assert FaultKind.FOCAL_LENGTH in {each.kind for each in checked.cannot_tell}
