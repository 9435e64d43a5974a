"""Every alarm leads to a chapter that exists."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any


def test_every_alarm_has_a_chapter_in_the_runbook(assembly: Any, repository: Path) -> None:
    page = (repository / "docs" / "operations.md").read_text(encoding="utf-8")
    chapters = set(re.findall(r"^## (\S+)$", page, flags=re.M))
    alarms = assembly.all("AWS::CloudWatch::Alarm")

    assert len(alarms) >= 4
    for alarm in alarms:
        name = alarm["AlarmName"].removeprefix("rse-pf/")
        assert alarm["AlarmDescription"].endswith(f"runbook: docs/operations.md#{name}")
        assert name in chapters
