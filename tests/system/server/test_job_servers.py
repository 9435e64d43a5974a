"""Job servers take the jobs of servers that have no slots, and a job outlives the job server that runs it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import client_sdk
from rse_pf.object_store import DirectoryStore

pytestmark = pytest.mark.system

_SERVICES = '''
import os, time
from pathlib import Path
import msgspec
from rse_pf.service import Registry, Report

FOLDER = Path(__file__).parent

class Work(msgspec.Struct, frozen=True, kw_only=True):
    name: str = "job"

class Done(msgspec.Struct, frozen=True, kw_only=True):
    parent: int

def make(settings):
    registry = Registry()

    @registry.service("long", kind="long")
    def long(request: Work, *, report: Report) -> Done:
        """Report until a file appears."""
        with (FOLDER / "runs").open("a") as runs:
            runs.write(f"{os.getppid()}\\n")
        while not (FOLDER / request.name).exists():
            report(0.5, "half")
            time.sleep(0.01)
        return Done(parent=os.getppid())

    return registry
'''
_SERVE = """
import json, sys
from pathlib import Path
from rse_pf.backend.supervisor.serve_jobs import serve_jobs
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import ServerPlacement
order = json.loads(sys.argv[1])
settings = PlatformSettings.from_dict(order["settings"])
sys.exit(serve_jobs(
    settings, placement=ServerPlacement.of(settings), server_id=order["server"],
    announce=Path(order["announce"]), services="served_in_tests:make",
))
"""
StartJobServer = Callable[[], subprocess.Popen[bytes]]


def settings_of(folder: Path, **serving: Any) -> dict[str, Any]:
    return {
        "serving": {
            "port": 0, "control_port": 0, "workers": 1, "max_running_jobs": 0, "offer_jobs": True,
            "job_lease_s": 1.0, "job_poll_s": 0.1, "drain_wait_s": 0.0, **serving,
        },
        "data": {"store": f"dir:{folder / 'store'}"},
        "auth": {"required": False},
    }  # fmt: skip


@pytest.fixture
def start_job_server(tmp_path: Path) -> Iterator[StartJobServer]:
    started: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        announce = tmp_path / f"jobs-{len(started)}.json"
        order = {
            "settings": settings_of(tmp_path),
            "server": f"jobs-{len(started)}",
            "announce": str(announce),
        }
        process = subprocess.Popen(
            [sys.executable, "-c", _SERVE, json.dumps(order)], env={**os.environ, "PYTHONPATH": str(tmp_path)}
        )
        started.append(process)
        wait_until(announce.exists, 40.0)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def wait_until(is_so: Callable[[], bool], within_s: float = 50.0) -> None:
    """Wait for what a job does: its process gets what others leave of the processors."""
    until = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < until, "it did not happen in time"
        time.sleep(0.01)


def runs(folder: Path) -> list[int]:
    file = folder / "runs"
    return [int(line) for line in file.read_text().split()] if file.exists() else []


async def test_a_job_restarts_elsewhere_when_its_job_server_is_killed_and_ends_once(
    start_server, start_job_server: StartJobServer, tmp_path: Path
) -> None:
    (tmp_path / "served_in_tests.py").write_text(_SERVICES)
    groups = settings_of(tmp_path)
    server = start_server(serving=groups["serving"], data=groups["data"])

    async with client_sdk.connect(server.url) as robot:
        task = asyncio.create_task(robot.call("long", {"name": "go"}))
        first = await asyncio.to_thread(start_job_server)
        await asyncio.to_thread(wait_until, lambda: runs(tmp_path) == [first.pid])
        first.send_signal(signal.SIGKILL)
        second = await asyncio.to_thread(start_job_server)
        await asyncio.to_thread(wait_until, lambda: runs(tmp_path) == [first.pid, second.pid])
        (tmp_path / "go").touch()
        answer = await asyncio.wait_for(task, 30.0)
        assert answer.reply["parent"] == second.pid

    assert len(runs(tmp_path)) == 2
    assert not list(DirectoryStore(tmp_path / "store").list("job-queue/"))


async def test_a_job_server_that_is_told_to_end_leaves_its_job_at_once(
    start_server, start_job_server: StartJobServer, tmp_path: Path
) -> None:
    (tmp_path / "served_in_tests.py").write_text(_SERVICES)
    groups = settings_of(tmp_path, job_lease_s=60.0)
    server = start_server(serving=groups["serving"], data=groups["data"])

    async with client_sdk.connect(server.url) as robot:
        task = asyncio.create_task(robot.call("long", {"name": "go"}))
        first = await asyncio.to_thread(start_job_server)
        await asyncio.to_thread(wait_until, lambda: len(runs(tmp_path)) == 1)
        first.send_signal(signal.SIGTERM)
        assert await asyncio.to_thread(first.wait, 20) == 0
        (tmp_path / "go").touch()
        second = await asyncio.to_thread(start_job_server)
        assert (await asyncio.wait_for(task, 30.0)).reply["parent"] == second.pid
