"""How the process of a job is started."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.server.jobs.process import JobRequest, spawner

pytestmark = pytest.mark.system
REQUEST = JobRequest(
    service="long", payload={}, robot=RobotId("default", "robot-1"), key="ab" * 32, quota_bytes=1e6
)


def test_a_job_process_gives_way_to_robots_before_it_runs_any_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sleeper = tmp_path / "python"  # it never asks for a priority itself
    sleeper.write_text("#!/bin/sh\nexec sleep 60\n", encoding="utf-8")
    sleeper.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(sleeper))

    job = spawner("no.module:services", PlatformSettings())(REQUEST)
    policy = os.sched_getscheduler(job.pid)
    job.kill()

    assert policy == os.SCHED_BATCH
