"""The demo as a user runs it, and with a server killed during the run."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.extensions.experiments.results.records import read_samples

pytestmark = pytest.mark.system

WAIT_S = 60.0


@contextlib.contextmanager
def demo(out: Path, *options: str, within_s: float = WAIT_S) -> Iterator[subprocess.Popen[str]]:
    """Run the demo; what is left of it at the end is interrupted, then killed."""
    command = [sys.executable, "-u", "-m", "rse_pf.cli.main", "demo", "--out", str(out), *options]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        overdue = threading.Timer(within_s, os.killpg, (process.pid, signal.SIGKILL))
        overdue.start()
        try:
            yield process
        finally:
            overdue.cancel()
            end(process)


def end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)  # the demo ends its platform
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(20)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def read_until(process: subprocess.Popen[str], pattern: str) -> str:
    assert process.stdout is not None
    heard = ""
    for line in process.stdout:
        heard += line
        if found := re.search(pattern, heard):
            return found.group(0)
    raise AssertionError(f"no {pattern!r} in:\n{heard}")


def finish(process: subprocess.Popen[str], out: Path, within_s: float = WAIT_S) -> dict[str, Any]:
    rest, _ = process.communicate(timeout=within_s)
    assert process.returncode == 0, rest
    return json.loads((out / "report.json").read_text())


def pids_of(line: str) -> list[int]:
    return [int(pid) for pid in re.findall(r"server-\d (\d+)", line)]


def wait_for_robot_on_server(samples: Path, process: subprocess.Popen[str]) -> int:
    """Return the pid of the first server in the samples that has a robot and has answered it."""
    end, pause = time.monotonic() + WAIT_S, threading.Event()
    while process.poll() is None and time.monotonic() < end:
        for sample in read_samples(samples):
            for server in sample.servers:
                if server.robots and server.requests:
                    return server.pid
        pause.wait(0.02)
    raise AssertionError(f"no server with a robot in:\n{samples.read_text()}")


def commands_after_the_longest(records: Path) -> int:
    """Return how many commands were sent after the answer to the one with the longest round trip."""
    with records.open(newline="") as file:
        rows = list(csv.DictReader(file))
    longest = max(rows, key=lambda row: float(row["round_trip_ms"]))
    return sum(float(row["sent"]) > float(longest["answered"]) for row in rows)


def test_writes_a_map_for_each_robot_and_ends_every_process(tmp_path, gone):
    out = tmp_path / "out"
    with demo(out, "--robots", "2", "--frames", "6", "--rate", "10") as process:
        servers = pids_of(read_until(process, r"running at .*"))
        report = finish(process, out)

    assert report["robots"] == 2
    assert report["frames"] == 12
    assert report["lost_frames"] == 0
    assert report["commands"]["sent"] == report["commands"]["answered"] == 10
    assert max(report["ate_percent_of_path"]) <= 2.0
    for robot in ("robot-1", "robot-2"):
        assert (out / robot / "map.ply").stat().st_size > 100_000
        assert (out / robot / "map.png").stat().st_size > 10_000
        assert len((out / robot / "trajectory.txt").read_text().splitlines()) == 1 + 6
    assert not (out / "platform" / "key.json").exists()
    assert len(servers) == 2
    for pid in servers:
        gone(pid)


@pytest.mark.slow
def test_a_killed_server_costs_no_command(tmp_path, gone):
    out = tmp_path / "out"
    with demo(out, "--robots", "2", "--frames", "20", "--rate", "5") as process:
        read_until(process, "the robots start")
        victim = wait_for_robot_on_server(out / "samples.csv", process)
        handle = os.pidfd_open(victim)
        workers = [int(pid) for pid in Path(f"/proc/{victim}/task/{victim}/children").read_text().split()]
        for pid in workers:  # the next commands, at most a period of 0.2 s later, stay unanswered
            os.kill(pid, signal.SIGSTOP)
        threading.Event().wait(0.3)
        signal.pidfd_send_signal(handle, signal.SIGKILL)
        os.close(handle)
        report = finish(process, out)

    assert report["commands"]["lost"] == report["commands"]["failed"] == report["commands"]["twice"] == 0
    assert report["commands"]["answered"] == report["commands"]["sent"] >= 38
    assert report["lost_frames"] == 0
    assert report["reconnects"] >= 1
    assert report["resent"] >= 1, "no command was in flight when the server was killed"
    assert commands_after_the_longest(out / "commands.csv") >= 5
    assert workers
    for pid in workers:
        gone(pid)
