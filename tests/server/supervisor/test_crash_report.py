"""For whom a process computed that native code ended, as its parent reads it."""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal
import threading
from collections.abc import Callable

import pytest

from rse_pf.identity import RobotId
from rse_pf.server.supervisor.crash_report import Crash, CrashReport

ROBOT = RobotId("acme", "r-ü", "thumbprint")


def crash_after(act: Callable[[CrashReport], object]) -> Crash:
    """Return what is read of a child that does *act* and then nothing more."""
    report = CrashReport()
    pid = os.fork()
    if pid == 0:
        try:
            faulthandler.disable()  # a library of another test may have set handlers above it
            signal.signal(signal.SIGSEGV, signal.SIG_DFL)
            report.begin()
            act(report)
        finally:
            os._exit(0)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGSEGV
    crash = report.read()
    report.close()
    return crash


def read_at_zero() -> None:
    ctypes.string_at(0)


def in_thread(act: Callable[[], object]) -> None:
    thread = threading.Thread(target=act)
    thread.start()
    thread.join()


@pytest.mark.parametrize("runs", [lambda act: act(), in_thread])
def test_the_robot_is_named_for_which_the_crashing_thread_computed(
    runs: Callable[[Callable[[], object]], None],
) -> None:
    def act(report: CrashReport) -> None:
        report.enter(7, RobotId("acme", "another"))
        report.enter(300, ROBOT)
        report.compute_for(7)
        working = threading.Barrier(2)

        def work_for_another() -> None:
            report.compute_for(7)
            working.wait()
            threading.Event().wait()

        def compute() -> None:
            report.compute_for(300)
            read_at_zero()

        threading.Thread(target=work_for_another, daemon=True).start()
        working.wait()
        runs(compute)

    crash = crash_after(act)

    assert (crash.number, crash.robot) == (300, ROBOT)
    assert "string_at" in crash.place


def test_nobody_is_named_for_a_crash_of_another_thread_or_after_the_work() -> None:
    def elsewhere(report: CrashReport) -> None:
        report.enter(7, ROBOT)
        report.compute_for(7)
        in_thread(read_at_zero)

    def afterwards(report: CrashReport) -> None:
        report.enter(7, ROBOT)
        report.compute_for(report.compute_for(7))
        read_at_zero()

    for act in (elsewhere, afterwards):
        crash = crash_after(act)
        assert (crash.number, crash.robot) == (0, None)


def test_a_robot_whose_place_another_one_took_is_not_confused_with_it() -> None:
    def act(report: CrashReport) -> None:
        report.enter(7, ROBOT)
        report.enter(7 + 128, RobotId("acme", "another"))
        report.compute_for(7)
        read_at_zero()

    crash = crash_after(act)

    assert (crash.number, crash.robot) == (7, None)


def test_a_name_that_is_too_long_is_not_written_over_its_neighbour() -> None:
    def act(report: CrashReport) -> None:
        report.enter(8, ROBOT)
        report.enter(7, RobotId("t" * 700, "r"))
        report.compute_for(8)
        read_at_zero()

    assert crash_after(act).robot == ROBOT
