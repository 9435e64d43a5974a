"""How the process of a job is started."""

from __future__ import annotations

import os
import time

import pytest

from rse_pf.backend.jobs.process import JobProcess

pytestmark = pytest.mark.system


def test_a_job_process_has_the_lowest_priority_before_it_runs_any_code() -> None:
    began = time.monotonic()
    job = JobProcess({"worker": 0})  # it is not this process's child of 0, so it does nothing and ends
    policy, took_s = os.sched_getscheduler(job.pid), time.monotonic() - began
    job.kill()

    assert policy == os.SCHED_IDLE
    assert took_s < 0.2, "it had the time to step back by itself, so this proves nothing"
