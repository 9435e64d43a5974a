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
_FRAGILE = """
import asyncio
from rse_pf.wire import make_codec

make_whole = make
kind = type(make_codec("bin"))
decode = kind.decode_from_robot

def decode_or_crash(self, data):
    if b"crash-decoder" in data:
        ctypes.string_at(0)
    return decode(self, data)

kind.decode_from_robot = decode_or_crash

def make(settings):
    registry = make_whole(settings)

    @registry.service("burn", cheap=True)
    def burn(request: Work) -> Done:
        time.sleep(0.01)
        return Done()

    @registry.service("fuse", cheap=True)
    def fuse(request: Work) -> Done:
        asyncio.get_event_loop().call_soon(ctypes.string_at, 0)
        return Done()

    return registry
"""
"""Makes the decoder of a server crash where a message says so; the service `fuse` crashes after it."""


@pytest.fixture
def fragile(start_server, tmp_path):
    """A server whose decoder crashes where a message says so."""
    services = tmp_path / "served_in_tests.py"
    services.write_text(services.read_text() + _FRAGILE)
    return start_server(keys=True)


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
    assert 60.0 - PROMPT_S < float(refused.value.response.headers["Retry-After"]) <= 60.0
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


@pytest.mark.parametrize(
    "letters", [(10,), (50_000,), (50_000, 10)], ids=["short", "long", "short and deferred by a long one"]
)
async def test_a_crash_while_a_message_is_decoded_is_blamed_on_its_robot(fragile, letters):
    texts = ["x" * length for length in letters[:-1]] + ["crash-decoder" + "x" * letters[-1]]
    async with (
        fragile.robot(token=fragile.token("innocent")) as innocent,
        fragile.robot(token=fragile.token("culprit")) as culprit,
    ):
        await innocent.ask(1, "echo")
        for number, text in enumerate(texts):
            await culprit.send(Command(id=number + 1, service="echo", payload=text))
        await asyncio.wait_for(innocent.socket.wait_closed(), PROMPT_S)

    assert fragile.wait_for_log("worker-crashed")["robot"] == "culprit"


async def test_a_crash_between_two_messages_is_blamed_on_nobody(fragile):
    async with fragile.robot(token=fragile.token("innocent")) as innocent:
        await asyncio.gather(
            innocent.send(Command(id=1, service="burn")), innocent.send(Command(id=2, service="fuse"))
        )
        await asyncio.wait_for(innocent.socket.wait_closed(), PROMPT_S)

    assert "robot" not in fragile.wait_for_log("worker-crashed")


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
