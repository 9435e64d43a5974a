"""Commands that crash the process of a map service: after two, their robot alone is refused for 60 s."""

from __future__ import annotations

from typing import Any

import pytest

import client_sdk
from rse_pf.errors import Busy, Crashed
from rse_pf.pnp.problems import make_problem

pytestmark = pytest.mark.system

SERVICES = """
import os, signal
import msgspec
from rse_pf.services.builtin import builtin_services

class Ask(msgspec.Struct, frozen=True, kw_only=True):
    crashes: bool = False

class Answer(msgspec.Struct, frozen=True, kw_only=True):
    pid: int

def make(settings):
    registry = builtin_services(settings)

    @registry.service("decode", limited=True)
    def decode(request: Ask) -> Answer:
        if request.crashes:
            os.kill(os.getpid(), signal.SIGSEGV)
        return Answer(pid=os.getpid())

    return registry
"""
REFUSED_MS = 60e3
PROBLEM = make_problem(seed=5, n=60)


async def test_two_crashes_refuse_a_robot_for_60_s_and_cost_neither_server_nor_others(
    start_server: Any, tmp_path: Any
) -> None:
    (tmp_path / "served_in_tests.py").write_text(SERVICES)
    server = start_server(keys=True)

    def connect(name: str) -> client_sdk.Robot:
        return client_sdk.connect(server.url, token=server.token(name))

    async with connect("culprit") as culprit, connect("witness") as witness:
        for _ in range(2):
            with pytest.raises(Crashed):
                await culprit.call("decode", {"crashes": True}, deadline_s=20.0)
            await witness.call("decode", {}, deadline_s=20.0)
        with pytest.raises(Busy) as refused:
            await culprit.call("decode", {}, deadline_s=20.0)
        await witness.call("decode", {}, deadline_s=20.0)
        for robot in (culprit, witness):
            await robot.solve_pnp(PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera, deadline_s=20.0)
            assert robot.stats.reconnects == 0
    assert refused.value.retry_after_ms is not None
    retry_after_ms = refused.value.retry_after_ms

    assert REFUSED_MS / 2 < retry_after_ms <= REFUSED_MS
    assert server.http("/readyz")[0] == 200
