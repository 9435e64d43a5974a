"""What a control plane records of itself, and of the other audit logs beside its own."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

from rse_pf.audit.log import audit_folder, files_of, record_once
from rse_pf.audit.verify import entries_of
from rse_pf.local.control.audit_recorder import PlatformAudit


def actions(state: Path) -> list[str]:
    return [entry.action for entry in entries_of(files_of(audit_folder(state), "control-plane"))]


async def test_the_heads_of_the_other_logs_are_recorded_again_and_again_when_they_grew(
    tmp_path: Path,
) -> None:
    audit = PlatformAudit(tmp_path, heads_s=0.01)
    audit.open()

    async def recorded(count: int) -> None:
        while actions(tmp_path).count("log.heads") < count:
            await asyncio.sleep(0.01)

    watching = asyncio.create_task(audit.watch())
    for count in (1, 2):
        record_once(audit.folder, "operator", "robot.disabled", wall_clock=time.time)
        await asyncio.wait_for(recorded(count), 10)
    watching.cancel()
    audit.close()

    assert actions(tmp_path) == ["log.heads", "log.heads", "platform.over"]


def test_an_event_before_the_log_is_open_is_not_recorded(tmp_path: Path) -> None:
    audit = PlatformAudit(tmp_path)

    audit.record({"event": "server-ready", "server": "server-1"})
    audit.open()
    audit.record({"event": "server-ready", "server": "server-1", "ports": [1, 2]})
    audit.close()

    assert actions(tmp_path) == ["platform.server-ready", "platform.over"]
