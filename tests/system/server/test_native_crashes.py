"""Native code that ends a worker: another one takes its place, and whose bytes do that is shut out."""

from __future__ import annotations

import asyncio
import signal
import time

import pytest
import websockets

from rse_pf.wire import Command, Move, Result

pytestmark = pytest.mark.system

PROMPT_S = 5.0


async def answered(server) -> None:
    """Connect until another robot is answered; a socket that the ended worker had taken is lost with it."""
    until_s = time.monotonic() + PROMPT_S
    while True:
        try:
            async with server.robot(token=server.token("witness")) as other:
                assert isinstance(await other.ask(1, "echo"), Result)
                return
        except (websockets.InvalidMessage, websockets.ConnectionClosed, OSError):
            assert time.monotonic() < until_s, "no robot is answered"


async def crash(server, robot: str) -> float:
    """Have *robot* end its worker; return the seconds until another robot is answered."""
    async with server.robot(token=server.token(robot)) as sender:
        await sender.send(Command(id=1, service="crash"))
        await asyncio.wait_for(sender.socket.wait_closed(), PROMPT_S)
        ended_s = time.monotonic()
    await answered(server)
    return time.monotonic() - ended_s


async def test_a_robot_that_crashes_twice_is_refused_and_others_are_answered_after_each_crash(start_server):
    server = start_server(keys=True, serving={"workers": 1})

    away_s = [await crash(server, "culprit"), await crash(server, "culprit")]
    with pytest.raises(websockets.InvalidStatus) as refused:
        await crash(server, "culprit")
    away_s.append(await crash(server, "third"))

    print(f"seconds until a robot is answered after a crash: {away_s}")
    assert max(away_s) < PROMPT_S
    assert refused.value.response.status_code == 429
    crashes = [line for line in server.lines if line["event"] == "worker-crashed"]
    assert [line["robot"] for line in crashes] == ["culprit", "culprit", "third"]
    assert all("string_at" in line["at"] and line["signal"] == signal.SIGSEGV for line in crashes)
    cut_off = server.wait_for_log("cut-off")
    assert (cut_off["robot"], cut_off["reason"]) == ("culprit", "crashes")
    metrics = server.http("/metrics")[2].decode()
    assert "rse_pf_worker_crashes 3" in metrics


async def test_the_other_worker_serves_on_during_a_crash_and_disconnects_who_is_shut_out(start_server):
    server = start_server(keys=True, serving={"workers": 2})

    async with server.robot(token=server.token("staying")) as staying:
        async with server.robot(token=server.token("culprit")) as sender:
            await sender.send(Command(id=1, service="crash"))
            await asyncio.wait_for(sender.socket.wait_closed(), PROMPT_S)
        assert isinstance((await staying.ask(1, "echo")), Result)
    assert server.process.poll() is None


async def test_a_crash_during_a_drain_takes_no_answer_from_the_robots_of_the_other_worker(start_server):
    server = start_server(keys=True, serving={"workers": 2})

    async with (
        server.robot(token=server.token("staying")) as staying,
        server.robot(token=server.token("culprit")) as culprit,
    ):
        await staying.send(Command(id=1, service="work", payload={"rest_s": 1.0}))
        await asyncio.to_thread(server.http, "/drain?wait=0", "POST")
        assert isinstance(await culprit.receive(), Move)
        await culprit.send(Command(id=1, service="crash"))
        await asyncio.wait_for(culprit.socket.wait_closed(), PROMPT_S)
        async with server.robot(token=server.token("late")) as late:
            assert isinstance(await late.receive(), Move)
            assert isinstance(await late.ask(1, "echo"), Result)
        assert [type(await staying.receive()) for _ in range(2)] == [Move, Result]
    assert await asyncio.to_thread(server.process.wait, 10.0) == 0
    assert server.wait_for_log("worker-crashed")["robot"] == "culprit"


@pytest.mark.slow
async def test_a_server_records_the_crash_that_it_does_not_survive(start_server):
    server = start_server(keys=True)

    for robot in ("a", "b", "c", "d", "e"):
        await crash(server, robot)
    async with server.robot(token=server.token("f")) as sender:
        await sender.send(Command(id=1, service="crash"))
        assert await asyncio.to_thread(server.process.wait, PROMPT_S) == 1

    server.wait_for_log("worker-lost")
    crashes = [line["robot"] for line in server.lines if line["event"] == "worker-crashed"]
    assert crashes == ["a", "b", "c", "d", "e", "f"]
