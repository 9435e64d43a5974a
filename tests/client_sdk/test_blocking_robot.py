"""The blocking robot has the methods of the asyncio robot, and ends every call in time."""

from __future__ import annotations

import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

import client_sdk
from rse_pf.errors import Disconnected, Expired, RsePfError, UnknownService
from tests.kit.server_thread import server_thread

LATE_S = 5.0
"""A call that has not ended this many seconds after its deadline hangs, also on a slow machine."""


@pytest.fixture
def url():
    with server_thread() as served:
        yield served.url


def test_has_the_public_methods_of_the_robot():
    def public(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    for_loops_only = {"post"}  # its callback would come in the robot's thread
    assert public(client_sdk.BlockingRobot) == public(client_sdk.Robot) - for_loops_only


def test_a_closed_robot_is_disconnected_and_may_be_closed_again(url):
    with client_sdk.connect_blocking(url) as robot:
        robot.close()
        with pytest.raises(Disconnected):
            robot.call("echo", {})
    assert robot.stats.sent == 0


def test_calls_and_raises_like_the_robot(url):
    with client_sdk.connect_blocking(url) as robot:
        assert robot.call("echo", {"value": 4}).reply == {"value": 4}
        with pytest.raises(UnknownService):
            robot.call("nothing", {})
        assert robot.stats.answered == 1


def test_a_call_ends_at_its_deadline_although_the_event_loop_hangs(url):
    hangs, may_go_on = threading.Event(), threading.Event()

    def clock():
        if hangs.is_set():
            may_go_on.wait(10)
            hangs.clear()
        return time.monotonic()

    with client_sdk.connect_blocking(url, clock=clock) as robot:
        hangs.set()
        began = time.monotonic()
        with pytest.raises(Expired, match=r"no answer within 0\.7 s"):
            robot.call("echo", {"value": 1}, deadline_s=0.2)
        assert time.monotonic() - began < 0.2 + LATE_S
        may_go_on.set()


def test_a_snapshot_is_returned_however_long_the_event_loop_was_busy(url):
    hangs, is_busy, may_go_on = threading.Event(), threading.Event(), threading.Event()

    def clock():
        if hangs.is_set():
            is_busy.set()
            may_go_on.wait(10)
            hangs.clear()
        return time.monotonic()

    with client_sdk.connect_blocking(url, clock=clock) as robot:
        hangs.set()
        calling = threading.Thread(target=robot.call, args=("echo", {"value": 1}))
        calling.start()
        assert is_busy.wait(10)
        threading.Timer(1.5, may_go_on.set).start()
        assert robot.stats.reconnects == 0
        calling.join(10)


def test_threads_that_call_while_the_robot_is_closed_all_end_with_an_answer_or_one_error(url):
    for _ in range(3):
        robot = client_sdk.connect_blocking(url).__enter__()
        running, ends, lates_s = threading.Semaphore(0), [], []

        def work(robot=robot, running=running, ends=ends, lates_s=lates_s):
            error = None
            while error is None:
                began = time.monotonic()
                try:
                    robot.call("echo", {"value": 1}, deadline_s=1.0)
                except RsePfError as raised:
                    error = raised
                lates_s.append(time.monotonic() - began - 1.0)
                running.release()
            ends.append(error)

        threads = [threading.Thread(target=work, daemon=True) for _ in range(40)]
        for thread in threads:
            thread.start()
        for _ in range(60):
            assert running.acquire(timeout=20)
        with ThreadPoolExecutor(2) as closers:
            list(closers.map(lambda robot: robot.close(), [robot, robot]))
        for thread in threads:
            thread.join(10)

        assert len(ends) == 40
        assert {type(error) for error in ends} <= {Disconnected, Expired}
        assert statistics.median(lates_s) < 0.2


def call_in_child(robot, pipe):
    began = time.monotonic()
    try:
        pipe.send(robot.call("echo", {"value": 2}, deadline_s=1.0).reply)
    except RsePfError as error:
        pipe.send((error.message, time.monotonic() - began))
    robot.close()


def test_a_child_of_a_fork_is_asked_to_connect_itself_and_the_parent_goes_on(url):
    fork = multiprocessing.get_context("fork")
    with client_sdk.connect_blocking(url) as robot, ThreadPoolExecutor(1) as threads:
        for _ in range(5):
            calling = threads.submit(lambda: [robot.call("echo", {"value": 1}) for _ in range(20)])
            here, there = fork.Pipe()
            process = fork.Process(target=call_in_child, args=(robot, there))
            process.start()
            assert here.poll(20), "the child hangs"
            message, took_s = here.recv()
            process.join(20)
            assert process.exitcode == 0
            assert message.startswith(
                f"this robot is connected in process {os.getpid()}, and this is process"
            )
            assert took_s < 0.5
            assert len(calling.result(20)) == 20
        assert robot.stats.resent == robot.stats.duplicates == 0


@pytest.mark.parametrize("end", ["pass", "os._exit(0)", "robot.call('echo', {}, deadline_s=60)"])
def test_a_program_ends_although_its_robot_is_open(url, end):
    program = (
        "import client_sdk, os, sys\n"
        "robot = client_sdk.connect_blocking(sys.argv[1]).__enter__()\n"
        "robot.call('echo', {'value': 1})\n"
        "print('ready', flush=True)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program + end, url], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        if "call" in end:
            process.send_signal(signal.SIGINT)
        process.wait(20)
    finally:
        process.kill()
        process.communicate()


def call_until_an_error(robot):
    while True:
        robot.call("echo", {"value": 1})


def test_a_robot_may_be_closed_by_a_signal_handler_while_the_same_thread_calls(url):
    with client_sdk.connect_blocking(url) as robot:
        before = signal.signal(signal.SIGUSR1, lambda *_: robot.close())
        try:
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGUSR1)).start()
            with pytest.raises(Disconnected):
                call_until_an_error(robot)
        finally:
            signal.signal(signal.SIGUSR1, before)
