"""Priority, end and name of processes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from rse_pf.processes.linux import proportional_bytes, resident_bytes, run_as_batch

pytestmark = pytest.mark.system


def test_a_child_gives_way_before_it_does_anything() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        run_as_batch(child.pid, 10)
        try:
            assert os.sched_getscheduler(child.pid) == os.SCHED_BATCH
            assert os.getpriority(os.PRIO_PROCESS, child.pid) == max(10, os.nice(0))
        finally:
            child.kill()


def test_a_process_that_is_gone_is_no_error() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()

    run_as_batch(child.pid, 10)


@pytest.mark.skipif(os.getuid() != 0, reason="needs root, to become a plain user")
def test_the_memory_of_a_process_that_this_user_may_not_look_into_is_still_counted() -> None:
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgid(12345)
            os.setuid(12345)
            os.write(write, str(proportional_bytes(os.getppid())).encode())
        finally:
            os._exit(0)
    os.close(write)
    os.waitpid(child, 0)
    counted = int(os.read(read, 32) or b"0")
    os.close(read)

    assert resident_bytes(os.getpid()) // 4 < counted < 2 * resident_bytes(os.getpid())
