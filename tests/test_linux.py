"""Priority, end and name of processes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from rse_pf.linux import run_when_idle

pytestmark = pytest.mark.system


def test_a_child_runs_only_when_the_processor_is_idle_before_it_does_anything() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        run_when_idle(child.pid)
        try:
            assert os.sched_getscheduler(child.pid) == os.SCHED_IDLE
            assert os.getpriority(os.PRIO_PROCESS, child.pid) == 19
        finally:
            child.kill()


def test_a_process_that_is_gone_is_no_error() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()

    run_when_idle(child.pid)
