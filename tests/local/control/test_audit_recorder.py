"""What a control plane records of itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rse_pf.audit.log import audit_folder, read_entries
from rse_pf.local.control.audit_recorder import PlatformAudit


def test_an_operator_learns_that_entries_cannot_be_written_and_how_many_are_lacking_at_the_end(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
) -> None:
    state = small_disk("4m")
    problems: list[str] = []
    audit = PlatformAudit(state, on_problem=problems.append)
    audit.open()
    fill(state)
    for number in range(200):
        audit.record({"event": "server-ready", "server": f"server-{number}"})

    audit.close()

    written = len(list(read_entries(audit_folder(state) / "control-plane.jsonl")))
    assert problems == [
        "the audit log of control-plane cannot be written: No space left on device",
        f"the audit log of control-plane ends without its last {201 - written} entries",
    ]
