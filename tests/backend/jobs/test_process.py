"""How the process of a job is started."""

from __future__ import annotations

import os
import time

import pytest

from rse_pf.backend.jobs.process import JobRequest, spawner
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId

pytestmark = pytest.mark.system
REQUEST = JobRequest(
    service="long", payload={}, robot=RobotId("default", "robot-1"), key="ab" * 32, quota_bytes=1e6
)


def test_a_job_process_has_the_lowest_priority_before_it_runs_any_code() -> None:
    start = spawner("no.module:services", PlatformSettings())
    began = time.monotonic()
    job = start(REQUEST)
    policy, took_s = os.sched_getscheduler(job.pid), time.monotonic() - began
    job.kill()

    assert policy == os.SCHED_IDLE
    assert took_s < 0.2, "it had the time to step back by itself, so this proves nothing"
