"""What a control plane records of itself."""

from __future__ import annotations

from pathlib import Path

from rse_pf.audit.log import audit_folder, read_entries
from rse_pf.local.control.audit_recorder import PlatformAudit


def test_the_events_of_the_platform_are_recorded_while_the_log_is_open(tmp_path: Path) -> None:
    audit = PlatformAudit(tmp_path)

    audit.record({"event": "early"})
    audit.open()
    audit.record({"event": "server-ready", "server": "server-1", "ports": [1, 2]})
    audit.close()
    audit.record({"event": "late"})

    entries = read_entries(audit_folder(tmp_path) / "control-plane.jsonl")
    assert [(entry.action, entry.subject, entry.detail) for entry in entries] == [
        ("platform.server-ready", "server-1", {"ports": "1,2"}),
        ("platform.over", "", {}),
    ]
