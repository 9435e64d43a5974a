"""Map services in real servers: what a hostile map costs, it costs the process that decodes it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from pathlib import Path
from typing import Any

import pytest

import client_sdk
from rse_pf.errors import Busy, Crashed, Expired
from rse_pf.pnp.problems import make_problem
from rse_pf.processes.linux import cpu_seconds, resident_bytes

pytestmark = pytest.mark.system

_SERVICES = """
import os, signal, time
import msgspec
from rse_pf.services.builtin import builtin_services

class Hostile(msgspec.Struct, frozen=True, kw_only=True):
    what: str

class Pid(msgspec.Struct, frozen=True, kw_only=True):
    pid: int

def make(settings):
    registry = builtin_services(settings)

    @registry.service("decode", limited=True)
    def decode(request: Hostile) -> Pid:
        if request.what == "memory":
            return [bytearray(16_384) for _ in range(1_000_000)]
        if request.what == "signal":
            os.kill(os.getpid(), signal.SIGSEGV)
        while request.what == "loop":
            pass
        return Pid(pid=os.getpid())

    return registry
"""
MEMORY_BYTES = 64 << 20
GROWTH_BYTES = 64 << 20
PROBLEM = make_problem(seed=5, n=60)


@pytest.fixture
def server(start_server, tmp_path):
    (tmp_path / "served_in_tests.py").write_text(_SERVICES)
    limits = {"max_compute_memory_bytes": MEMORY_BYTES, "max_compute_s": 0.5}
    return start_server(keys=True, serving=limits)


def robot_of(server: Any, name: str) -> client_sdk.Robot:
    return client_sdk.connect(server.url, token=server.token(name))


async def decode(robot: client_sdk.Robot, what: str, deadline_s: float = 20.0) -> int:
    return int((await robot.call("decode", {"what": what}, deadline_s=deadline_s)).reply["pid"])


async def solve(robot: client_sdk.Robot) -> None:
    """Get a pose; a refusal or a missing answer raises."""
    await robot.solve_pnp(PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera, keep=True)


async def test_poses_are_answered_while_hostile_commands_end_their_processes(server):
    worker = server.workers[0]
    async with robot_of(server, "hostile") as hostile, robot_of(server, "honest") as honest:
        await solve(honest)
        await decode(honest, "")
        before = most = resident_bytes(worker)
        solved = []
        for what, reason in (("loop", "s of CPU time"), ("memory", "MB of memory")):
            attack = asyncio.create_task(decode(hostile, what))
            answers = 0
            while not attack.done():
                await solve(honest)
                answers += 1
                most = max(most, resident_bytes(worker))
            with pytest.raises(Crashed, match=reason):
                await attack
            solved.append(answers)
        with pytest.raises(Busy) as kept_out:
            await decode(hostile, "")
        await solve(hostile)
        await decode(honest, "")

    assert solved[0] > 5, "poses waited for the command that loops"
    assert most - before <= GROWTH_BYTES
    assert kept_out.value.retry_after_ms is not None
    assert kept_out.value.retry_after_ms > 1e3
    assert server.http("/readyz")[0] == 200
    own_s = cpu_seconds(server.process.pid) + cpu_seconds(worker)
    assert server.status()["cpu_s"] - own_s > 0.4, "the scale modifier must see the CPU time of map services"
    line = server.wait_for_log("compute-crashed")
    assert (line["robot"], line["service"], line["blocked"]) == ("hostile", "decode", False)


@pytest.mark.slow
async def test_a_deadline_ends_the_work_and_is_no_evidence_against_the_robot(server):
    async with robot_of(server, "hasty") as robot:
        pid = await decode(robot, "")
        for _ in range(3):
            began = time.monotonic()
            with pytest.raises(Expired):
                await decode(robot, "loop", deadline_s=0.2)
            assert time.monotonic() - began < 2.0

        assert await decode(robot, "") != pid


async def test_the_processes_end_with_their_worker(server, gone):
    async with robot_of(server, "robot-1") as robot:
        pid = await decode(robot, "")
        template = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
        assert template not in (server.workers[0], server.process.pid)
        assert os.getpriority(os.PRIO_PROCESS, pid) > os.getpriority(os.PRIO_PROCESS, server.workers[0])
        assert os.sched_getscheduler(pid) == os.SCHED_BATCH
        with contextlib.suppress(ProcessLookupError):
            os.kill(server.workers[0], 9)

        gone(pid)
        gone(template)
