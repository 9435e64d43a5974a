"""Findings of a drive: which are told, in which order, and what a report holds."""

from __future__ import annotations

import json
from typing import Any

from client_sdk.check.drive_check import check_lines
from client_sdk.check.findings import CannotTell, CheckReport, FaultKind, Finding


def finding(kind: FaultKind = FaultKind.BLUR, value: float = 0.5, **changed: Any) -> Finding:
    given = {
        "deviation": 0.05, "unit": "share", "cost_m": 0.1, "sentence": "half of it is blurred",
        "fix": "hold still",
    }  # fmt: skip
    return Finding(kind=kind, value=value, **{**given, **changed})


def test_a_report_says_what_is_wrong_and_what_to_do() -> None:
    report = CheckReport(findings=(finding(correction={"fx": 525.0}),), frames=9)

    assert check_lines(report.to_dict()) == [
        "check: half of it is blurred; it bends the path by about 10.0 cm; hold still"
    ]
    (told,) = json.loads(json.dumps(report.to_dict()))["findings"]
    assert {
        "kind": "blur",
        "value": 0.5,
        "deviation": 0.05,
        "cost": 0.1,
        "fix": "hold still",
    }.items() <= told.items()
    assert told["correction"] == {"fx": 525.0}


def test_a_report_without_findings_names_what_the_drive_cannot_tell() -> None:
    untold = CannotTell(FaultKind.FOCAL_LENGTH, "no turn about the vertical axis: within 6 %", 0.06)
    report = CheckReport(cannot_tell=(untold,), frames=30)

    assert check_lines(report.to_dict()) == [
        "check: nothing wrong found in 30 frames; this drive cannot tell focal_length"
    ]
    assert report.to_dict()["cannot_tell"][0]["within"] == 0.06
