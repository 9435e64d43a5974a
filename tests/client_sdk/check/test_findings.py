"""Findings of a drive: which are reported, in which order, and the content of a report."""

from __future__ import annotations

import json
from typing import Any

import pytest

from client_sdk.check.drive_check import check_lines
from client_sdk.check.findings import CannotTell, CheckReport, FaultKind, Finding, order
from rse_pf.errors import UsageError


def finding(kind: FaultKind = FaultKind.BLUR, value: float = 0.5, **changed: Any) -> Finding:
    given = {
        "deviation": 0.05, "unit": "share", "cost_m": 0.1, "sentence": "half of it is blurred",
        "fix": "hold still",
    }  # fmt: skip
    return Finding(kind=kind, value=value, **{**given, **changed})


def test_worst_is_first_and_what_is_uncertain_or_below_the_noise_is_left_out() -> None:
    small = finding(FaultKind.DARK, cost_m=0.05)
    large = finding(FaultKind.FOCAL_LENGTH, cost_m=0.4)
    unknown = finding(FaultKind.JITTER, cost_m=None)
    uncertain = finding(FaultKind.DISTORTION, 0.1, deviation=0.04, cost_m=3.0)
    harmless = finding(FaultKind.MISSING, cost_m=0.001)

    ordered = order([uncertain, unknown, small, harmless, large], noise_m=0.01)

    assert ordered == (large, small, unknown)


def test_a_fault_that_changes_what_the_others_mean_is_first() -> None:
    mirrored = finding(FaultKind.MIRRORED, 1.0, cost_m=None)
    dear = finding(FaultKind.FOCAL_LENGTH, cost_m=5.0)

    assert order([dear, mirrored]) == (mirrored, dear)


def test_of_one_kind_the_more_certain_finding_is_reported() -> None:
    rough = finding(FaultKind.DEPTH_SCALE, 0.5, deviation=0.1)
    fine = finding(FaultKind.DEPTH_SCALE, 0.45, deviation=0.01)

    assert order([rough, fine]) == order([fine, rough]) == (fine,)


def test_a_report_says_what_is_wrong_and_what_to_do() -> None:
    report = CheckReport(findings=(finding(correction={"fx": 525.0}),), frames=9)

    assert check_lines(report.to_dict()) == [
        "check: half of it is blurred; it bends the path by about 10.0 cm; hold still"
    ]
    (reported,) = json.loads(json.dumps(report.to_dict()))["findings"]
    assert {
        "kind": "blur",
        "value": 0.5,
        "deviation": 0.05,
        "cost": 0.1,
        "fix": "hold still",
    }.items() <= reported.items()
    assert reported["correction"] == {"fx": 525.0}


def test_a_report_without_findings_names_the_undetermined_faults() -> None:
    undetermined = CannotTell(FaultKind.FOCAL_LENGTH, "no turn about the vertical axis: within 6 %", 0.06)
    report = CheckReport(cannot_tell=(undetermined,), frames=30)

    assert check_lines(report.to_dict()) == [
        "check: nothing wrong found in 30 frames; this drive does not determine focal_length"
    ]
    assert report.to_dict()["cannot_tell"][0]["within"] == 0.06


@pytest.mark.parametrize(
    "changed", [{"deviation": float("nan")}, {"deviation": -1.0}, {"cost_m": float("inf")}]
)
def test_numbers_that_are_no_finding_are_refused(changed: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="is no finding"):
        finding(**changed)
