"""The life of a real backend server: drain, signals, and death together."""

from __future__ import annotations

import asyncio
import os
import re
import signal

import pytest

from rse_pf.wire import Command, Failure, Move, Result

pytestmark = pytest.mark.system

PROMPT_S = 5.0


async def in_thread(function, *arguments):
    return await asyncio.to_thread(function, *arguments)


async def test_a_drain_moves_the_robots_and_loses_nothing(start_server):
    server = start_server(serving={"workers": 2})

    async with server.robot() as first, server.robot() as second:
        for robot in (first, second):
            await robot.send(Command(id=1, service="work", payload={"rest_s": 0.5}))
            await robot.send(Command(id=2, service="work"))
        status, _, _ = await in_thread(server.http, "/drain?wait=0", "POST")
        answers = []
        for robot in (first, second):
            got = [await robot.receive() for _ in range(3)]
            assert isinstance(got[0], Move), "the move comes before the slow answer"
            answers += got
            await robot.socket.close()
    assert status == 202
    assert [a.id for a in answers if isinstance(a, Result)] == [1, 2, 1, 2]
    moves = [a for a in answers if isinstance(a, Move)]
    assert [(m.reason, m.within_ms) for m in moves] == [("drain", 5000.0)] * 2
    assert server.process.wait(PROMPT_S) == 0


async def test_robots_that_do_not_move_get_their_answers_before_the_socket_closes(start_server):
    server = start_server()

    async with server.robot() as robot:
        await robot.send(Command(id=1, service="work", payload={"rest_s": 0.8}))
        await in_thread(server.http, "/drain?wait=0", "POST")
        got = [await robot.receive(), await robot.receive()]
        await asyncio.wait_for(robot.socket.wait_closed(), PROMPT_S)
        (move, result), code = got, robot.socket.close_code
    assert isinstance(move, Move)
    assert isinstance(result, Result)
    assert code == 1001
    assert server.process.wait(PROMPT_S) == 0


async def test_a_server_on_a_full_disk_says_that_its_audit_log_fails_and_what_it_lacks_at_the_end(
    start_server, small_disk, fill
):
    disk = small_disk("4m")
    server = start_server(keys=True, audit=disk / "audit")
    fill(disk)

    for _ in range(50):  # the last block of the file has space for some entries
        async with server.robot(token=server.token()):
            pass
    await in_thread(server.wait_for_log, "audit-failed")
    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(PROMPT_S) == 0
    server.listener.join(PROMPT_S)
    reasons = [line["reason"] for line in server.lines if line["event"] == "audit-failed"]
    lacks = r"the audit log of server-0 ends without its last [1-9]\d* entries"
    assert reasons[0] == "the audit log of server-0 cannot be written: No space left on device"
    assert len(reasons) == 2
    assert re.fullmatch(lacks, reasons[1])


async def test_a_draining_server_is_not_ready_but_still_accepts(start_server):
    server = start_server(serving={"drain_wait_s": 600.0})

    server.process.send_signal(signal.SIGTERM)
    await in_thread(server.wait_for_log, "drain")
    ready = await in_thread(server.http, "/readyz")
    async with server.robot() as robot:
        (status, headers, _), answer, seen = ready, await robot.ask(1, "echo"), await in_thread(server.status)
    assert status == 503
    assert headers["x-envoy-immediate-health-check-fail"] == "1"
    assert isinstance(answer, Result)
    assert seen["state"] == "draining"


async def test_a_robot_that_connects_during_a_drain_is_asked_to_move_as_well(start_server):
    server = start_server()

    async with server.robot() as staying:
        await in_thread(server.http, "/drain?wait=0", "POST")
        assert isinstance(await staying.receive(), Move)
        async with server.robot() as late:
            assert isinstance((await late.receive()), Move)
    assert server.process.wait(PROMPT_S) == 0


@pytest.mark.parametrize("second", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_the_server_at_once(start_server, gone, second):
    server = start_server(serving={"drain_wait_s": 600.0})
    server.process.send_signal(signal.SIGTERM)
    server.wait_for_log("drain")

    server.process.send_signal(second)

    assert server.process.wait(PROMPT_S) == 0
    for pid in server.workers:
        gone(pid)


def test_a_lost_worker_ends_the_whole_server(start_server, gone):
    server = start_server(serving={"workers": 2})

    os.kill(server.workers[0], signal.SIGKILL)

    assert server.process.wait(PROMPT_S) == 1
    assert server.wait_for_log("worker-lost")["pid"] == server.workers[0]
    gone(server.workers[1])


async def test_workers_do_not_outlive_their_supervisor(start_server, gone):
    server = start_server(serving={"workers": 2})

    async with server.robot() as robot:
        await robot.send(Command(id=1, service="work", payload={"burn_s": 60.0}))
        os.kill(server.process.pid, signal.SIGKILL)
        await asyncio.wait_for(robot.socket.wait_closed(), PROMPT_S)
    for pid in server.workers:
        gone(pid)


async def test_signals_to_the_whole_group_leave_the_workers_to_the_supervisor(start_server):
    server = start_server(serving={"drain_wait_s": 0.0})

    async with server.robot() as robot:
        await robot.send(Command(id=1, service="work", payload={"rest_s": 0.3}))
        for pid in (*server.workers, server.process.pid):
            os.kill(pid, signal.SIGTERM)
        got = [await robot.receive(), await robot.receive()]
        assert sorted(type(each).__name__ for each in got) == ["Move", "Result"]
    assert server.process.wait(PROMPT_S) == 0


async def test_a_waiting_command_of_a_robot_that_left_is_dropped(start_server):
    server = start_server()

    async with server.robot() as leaver:
        await leaver.send(Command(id=1, service="work", payload={"rest_s": 0.3}))
        await leaver.send(Command(id=2, service="work", payload={"fail": True}))
    async with server.robot() as robot:
        # It is answered after the first command of the other robot has ended, whose second would fail then.
        assert not isinstance((await robot.ask(1, "work", {"rest_s": 0.6})), Failure)
    assert not [line for line in server.lines if line["event"] == "defect"]
