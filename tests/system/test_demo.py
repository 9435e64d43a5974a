"""The demo as a user runs it, and with a server killed under it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.system


def demo(out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-u", "-m", "rse_pf.cli.main", "demo", "--out", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def read_until(process: subprocess.Popen[str], pattern: str) -> re.Match[str]:
    assert process.stdout is not None
    heard = ""
    for line in process.stdout:
        heard += line
        if found := re.search(pattern, heard):
            return found
    raise AssertionError(f"no {pattern!r} in:\n{heard}")


def finish(process: subprocess.Popen[str], out: Path) -> dict:
    rest, _ = process.communicate(timeout=100)
    assert process.returncode == 0, rest
    return json.loads((out / "report.json").read_text())


def wait_for_requests(samples: Path, pid: int, at_least: int, within_s: float = 60.0) -> None:
    """Wait until the monitor has seen server *pid* answer so many requests."""
    end, pause = time.monotonic() + within_s, threading.Event()
    while time.monotonic() < end:
        rows = [line.split(",") for line in samples.read_text().splitlines()[1:]]
        if any(len(row) == 8 and row[2] == str(pid) and int(row[4]) >= at_least for row in rows):
            return
        pause.wait(0.05)
    raise AssertionError(f"server {pid} answered fewer than {at_least} requests in {within_s} s")


@pytest.mark.timeout(110)
def test_leaves_a_map_for_each_robot_and_nothing_running(tmp_path, gone):
    out = tmp_path / "out"
    process = demo(out, "--robots", "2", "--frames", "8", "--rate", "10")
    servers = re.findall(r"server-\d (\d+)", read_until(process, r"running at .*").group(0))
    report = finish(process, out)

    assert report["robots"] == 2
    assert report["frames"] == 16
    assert report["lost_frames"] == 0
    assert report["commands"]["sent"] == report["commands"]["answered"] == 14
    assert max(report["ate_percent_of_path"]) <= 2.0
    for robot in ("robot-1", "robot-2"):
        assert (out / robot / "map.ply").stat().st_size > 100_000
        assert (out / robot / "map.png").stat().st_size > 10_000
        assert len((out / robot / "trajectory.txt").read_text().splitlines()) == 1 + 8
    assert not (out / "platform" / "key.json").exists()
    assert len(servers) == 2
    for pid in servers:
        gone(int(pid))


@pytest.mark.timeout(110)
def test_a_killed_server_costs_no_command(tmp_path, gone):
    out = tmp_path / "out"
    process = demo(out, "--robots", "3", "--frames", "20", "--rate", "5")
    victim = int(re.findall(r"server-\d (\d+)", read_until(process, r"running at .*").group(0))[0])
    workers = [int(pid) for pid in Path(f"/proc/{victim}/task/{victim}/children").read_text().split()]
    read_until(process, "the robots start")
    handle = os.pidfd_open(victim)
    wait_for_requests(out / "samples.csv", victim, at_least=6)
    signal.pidfd_send_signal(handle, signal.SIGKILL)
    os.close(handle)
    report = finish(process, out)

    assert report["commands"]["lost"] == report["commands"]["failed"] == report["commands"]["twice"] == 0
    assert report["commands"]["answered"] == report["commands"]["sent"] >= 57
    assert report["lost_frames"] == 0
    assert report["reconnects"] >= 1
    assert workers
    for pid in workers:
        gone(pid)
