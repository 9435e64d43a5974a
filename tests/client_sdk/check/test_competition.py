"""Causes that compete: one that explains a drive alone, two that look alike, and two faults at once."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.check.competition import Measured, explain
from client_sdk.check.findings import FaultKind
from rse_pf.geometry import Array

FOCAL, OFFSET = FaultKind.FOCAL_LENGTH, FaultKind.DEPTH_OFFSET


def measured(
    values: tuple[float, float], correlation: float, deviation: float = 0.02, unknown: float = 0.0
) -> Measured:
    """Return a relative focal length and an offset, metres, known equally well."""
    covariance: Array = deviation**2 * np.array([[1.0, correlation], [correlation, 1.0]])
    return Measured(
        values=np.array(values), covariance=covariance, unknown=np.full(2, unknown), usual=np.full(2, 0.005),
        widest=np.full(2, 0.15), causes={FOCAL: (0,), OFFSET: (1,)},
    )  # fmt: skip


def test_a_healthy_calibration_needs_no_cause() -> None:
    assert explain(measured((0.03, -0.02), 0.0)).causes == ()


def test_what_the_model_lacks_is_not_doubted_twice() -> None:
    """It is an error of a good calibration, too: on top of that it would hide faults of five deviations."""
    assert explain(measured((0.02, 0.0), 0.0, deviation=0.001, unknown=0.005)).causes == (FOCAL,)
    assert explain(measured((0.02, 0.0), 0.0, deviation=0.001, unknown=0.008)).causes == ()


def test_a_cause_that_explains_all_is_named_alone_although_another_is_tied_to_it() -> None:
    explained = explain(measured((0.1, 0.0), 0.5))

    assert explained.causes == (FOCAL,)
    assert explained.rivals[FOCAL] == ()


def test_two_causes_that_explain_a_drive_alike_are_rivals() -> None:
    explained = explain(measured((0.07, 0.065), -0.98, deviation=0.06))

    assert explained.causes
    assert explained.rivals[explained.causes[0]]


def test_two_faults_that_are_both_needed_are_both_named() -> None:
    explained = explain(measured((0.1, -0.12), 0.0))

    assert set(explained.causes) == {FOCAL, OFFSET}
    assert not any(explained.rivals.values())


def test_values_are_those_of_a_calibration_that_is_good_but_for_its_causes() -> None:
    values, covariance = measured((0.1, 0.01), 0.9).under([FOCAL])

    assert abs(values[1]) < 0.01
    assert values[0] == pytest.approx(0.09, abs=0.01)
    assert covariance[0, 0] < 0.02**2
