"""The data server is started, announced, and replaced on its own port; a bad start is told."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.local.processes import is_alive
from rse_pf.local.servers.single_servers import local_data_server
from rse_pf.local.servers.watched_server import NICENESS

pytestmark = pytest.mark.system

_PROGRAM = """
import json, os, signal, sys, time
args = dict(zip(sys.argv[2::2], sys.argv[3::2]))
port = int(args["--port"]) or 40001
with open("starts", "a") as file:
    file.write(f"{port} {args['--store']}\\n")
temporary = args["--announce"] + ".new"
json.dump({"pid": os.getpid(), "port": port}, open(temporary, "w"))
os.replace(temporary, args["--announce"])
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
signal.pause()
"""
"""Answers no question, so it must not live long where hanging servers are ended."""
PATIENT: dict[str, Any] = {"unhealthy_checks": 10}


class Box:
    """Data servers that run a program of the test, and what they told."""

    def __init__(
        self, folder: Path, program: str, *, health: dict[str, Any] = PATIENT, replaces: bool = True
    ) -> None:
        self.told: asyncio.Queue[str] = asyncio.Queue()
        self.servers = local_data_server(
            PlatformSettings().replace(local={"start_timeout_s": 15.0}, health=health),
            folder=folder, store="dir:objects",
            replaces=replaces, program=(sys.executable, "-W", "ignore", "-c", program),
            emit=lambda event, **_: self.told.put_nowait(event),
        )  # fmt: skip

    async def next(self) -> str:
        while (event := await asyncio.wait_for(self.told.get(), 15)) == "data-server-start":
            pass
        return event


async def test_the_server_of_an_earlier_control_plane_is_adopted_and_replaced(tmp_path: Path) -> None:
    earlier, later = Box(tmp_path, _PROGRAM), Box(tmp_path, _PROGRAM)
    await earlier.servers.start()
    server = earlier.servers.state
    assert server is not None
    later.servers.adopt(server.process, server.port)
    await earlier.servers.forget()

    assert later.servers.process.send(9)  # type: ignore[arg-type]
    assert [await later.next(), await later.next()] == ["data-server-down", "data-server-up"]
    await later.servers.stop(10.0)
    earlier.servers.kill_all()  # reaps its child

    assert later.servers.port == server.port
    assert earlier.told.qsize() == 2, "its start and its being up"


async def test_a_server_steps_back_behind_the_poses(tmp_path: Path) -> None:
    box = Box(tmp_path, _PROGRAM)
    await box.servers.start()
    server = box.servers.state
    assert server is not None

    ours, its = os.getpriority(os.PRIO_PROCESS, 0), os.getpriority(os.PRIO_PROCESS, server.process.pid)
    mine, policy = os.sched_getscheduler(0), os.sched_getscheduler(server.process.pid)
    await box.servers.stop(10.0)

    assert its == max(ours, NICENESS) > 0
    assert policy == {os.SCHED_OTHER: os.SCHED_BATCH}.get(mine, mine)


async def test_a_server_that_answers_nobody_is_ended_and_replaced(tmp_path: Path) -> None:
    box = Box(tmp_path, _PROGRAM, health={"unhealthy_checks": 2})
    await box.servers.start()
    first = box.servers.state
    assert first is not None
    assert await box.next() == "data-server-up"

    told = [await box.next(), await box.next(), await box.next()]
    assert told == ["data-server-silent", "data-server-down", "data-server-up"]
    assert not is_alive(first.process)
    await box.servers.stop(10.0)


async def test_a_server_that_ends_at_once_is_reported_with_its_last_words(tmp_path: Path) -> None:
    box = Box(tmp_path, "import sys; sys.exit('the disk is gone')")

    with pytest.raises(ConfigurationError, match=r"exit code 1.*the disk is gone"):
        await box.servers.start()

    box.servers.kill_all()
