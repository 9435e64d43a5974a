"""A real backend server: handshakes, messages, limits and metrics."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import socket
import time

import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed

from rse_pf.wire import CODECS, SUBPROTOCOLS, Command, Failure, Ping, Pong, Result

pytestmark = pytest.mark.system

LONG_S = 10.0


def handshake(server, *, path: str = "/ws", connection: str = "Upgrade", **headers: str) -> tuple[str, bytes]:
    """Return status line and body of the answer to a raw handshake."""
    lines = [
        f"GET {path} HTTP/1.1", "Host: a", "Upgrade: websocket", f"Connection: {connection}",
        "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        *(f"{name.replace('_', '-')}: {value}" for name, value in headers.items()),
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", server.port), timeout=5) as raw:
        raw.sendall("\r\n".join(lines).encode() + b"\r\n\r\n")
        answer = b""
        while b"\r\n\r\n" not in answer or (b" 101 " not in answer[:20] and (more := raw.recv(4096))):
            answer += more if b"\r\n\r\n" in answer else raw.recv(4096)
    head, _, body = answer.partition(b"\r\n\r\n")
    return head.decode(), body


async def closed_with(robot, within_s: float = LONG_S) -> int | None:
    """Return the close code once the server ended the socket."""
    await asyncio.wait_for(robot.socket.wait_closed(), within_s)
    return robot.socket.close_code


async def ask_for_ever(robot) -> None:
    """Ask for large replies until the socket ends."""
    for identity in itertools.count():
        await robot.send(Command(id=identity, service="work", payload={"fill": 200000}))


@pytest.mark.parametrize("codec", CODECS)
async def test_a_command_comes_back_with_its_times(start_server, codec):
    server = start_server()

    async with server.robot(codec) as robot:
        await robot.send(Ping(sent_s=4.5))
        welcome, pong = robot.welcome, await robot.receive()
        result = await robot.ask(7, "echo", {"value": [1, "é"]})
    assert (welcome.server, welcome.robot) == ("server-0", "anonymous-1")
    assert isinstance(pong, Pong)
    assert pong.sent_s == 4.5
    assert isinstance(result, Result)
    assert (result.id, result.reply, result.server) == (7, {"value": [1, "é"]}, "server-0")
    assert welcome.clock_s <= result.received_s <= result.sent_s
    assert result.queue_ms >= 0


async def test_rejected_handshakes_get_fixed_bodies(start_server):
    server = start_server(keys=True, serving={"max_robots": 1})
    good = {"Authorization": f"Bearer {server.token()}", "Sec_WebSocket_Protocol": SUBPROTOCOLS["bin"]}
    refused = [
        handshake(server, **{**good, **bad})
        for bad in (
            {"Authorization": ""},
            {"Authorization": "Basic abc"},
            {"Authorization": f"Bearer {server.token()[:-4]}AAAA"},
            {"Authorization": "Bearer " + "x" * 7000},
        )
    ]

    assert all(head.startswith("HTTP/1.1 401") for head, _ in refused)
    assert len({body for _, body in refused}) == 1
    assert json.loads(refused[0][1])["code"] == "unauthorized"
    assert handshake(server, path="/", **good)[0].startswith("HTTP/1.1 404")
    no_protocol = handshake(server, **{**good, "Sec_WebSocket_Protocol": "chat"})
    assert no_protocol[0].startswith("HTTP/1.1 400")
    assert json.loads(no_protocol[1])["code"] == "unsupported"

    async with server.robot(token=server.token()):
        head, body = await asyncio.to_thread(handshake, server, **good)
    assert head.startswith("HTTP/1.1 503")
    assert "Retry-After: 2" in head
    assert json.loads(body)["code"] == "full"


async def test_sockets_are_spread_evenly_over_the_workers(start_server):
    server = start_server(serving={"workers": 2})

    async with contextlib.AsyncExitStack() as stack:
        robots = [await stack.enter_async_context(server.robot()) for _ in range(20)]
        crowded = await asyncio.to_thread(server.status)
        for robot in robots[::2]:
            await robot.socket.close()
        halved = await asyncio.to_thread(server.status)
    assert crowded["robots_of_workers"] == [10, 10]
    assert crowded["robots"] == 20
    assert sum(halved["robots_of_workers"]) >= 10


async def test_a_socket_ends_with_its_token(start_server):
    server = start_server(keys=True)
    token = server.token("robot-9", ttl_s=2)

    async with server.robot(token=token) as robot:
        robot, code, ended = robot.welcome.robot, await closed_with(robot), time.time()
    assert (robot, code) == ("robot-9", 4401)
    assert ended - time.time() < 1.0


async def test_a_newer_frame_replaces_the_one_that_waits(start_server):
    server = start_server()

    async with server.robot() as robot:
        for identity in (1, 2, 3):
            payload = {"rest_s": 0.1} if identity == 1 else {}
            await robot.send(
                Command(id=identity, service="work", payload=payload, stream="cam", seq=identity)
            )
        answers = {answer.id: answer for answer in [await robot.receive() for _ in range(3)]}
    assert isinstance(answers[1], Result)
    assert isinstance(answers[2], Failure)
    assert answers[2].code == "stale"
    assert isinstance(answers[3], Result)


async def test_a_defect_is_a_failure_for_the_robot_and_a_traceback_in_the_log(start_server):
    server = start_server()

    async with server.robot() as robot:
        failure = await robot.ask(1, "work", {"fail": True}, trace="trace-77")
    assert (failure.code, failure.trace) == ("internal", "trace-77")
    assert "secret" not in failure.message + failure.hint
    line = server.wait_for_log("defect")
    assert line["trace"] == "trace-77"
    assert "ZeroDivisionError: secret of the service" in line["traceback"]


async def test_a_reply_above_the_limit_is_a_typed_failure(start_server):
    server = start_server(session={"max_message_bytes": 4096})

    async with server.robot() as robot:
        assert (await robot.ask(1, "work", {"fill": 5000})).code == "too-large"


async def test_one_line_is_logged_for_a_command_and_no_secret(start_server):
    server = start_server(keys=True, serving={"log_level": "debug"})
    token = server.token()

    async with server.robot(token=token) as robot:
        await robot.ask(5, "echo", {"value": "private-payload"}, trace="a\nb\x1b[31m")
    line = server.wait_for_log("command")
    assert (line["robot"], line["service"], line["id"], line["code"]) == ("robot-1", "echo", 5, "ok")
    assert line["trace"] == "a\nb\x1b[31m"
    assert line["bytes_in"] > 0
    assert line["bytes_out"] > 0
    assert "\x1b" not in server.text
    assert "private-payload" not in server.text
    assert token not in server.text


async def test_successful_commands_are_counted_and_logged_at_debug_level_only(start_server):
    server = start_server()

    async with server.robot() as robot:
        await robot.ask(5, "echo", {"value": 1})
        await robot.ask(6, "no-such-service")
    line = server.wait_for_log("command")
    assert (line["id"], line["code"], line["level"]) == (6, "unknown-service", "info")
    assert server.status()["results"]["ok"] == 1


async def test_the_control_port_serves_health_status_and_metrics(start_server):
    server = start_server(serving={"workers": 2})

    async with server.robot() as first, server.robot() as second:
        await first.ask(1, "echo")
        await second.ask(1, "nothing")
    health = json.loads(server.http("/healthz")[2])
    assert (health["server"], health["settings"]) == ("server-0", server.settings.digest())
    assert server.http("/readyz")[0] == 200
    assert server.http("/nowhere")[0] == 404
    assert server.http("/drain")[0] == 405
    text = server.http("/metrics")[2].decode()
    families = {family.name: family for family in text_string_to_metric_families(text)}
    requests = {
        (s.labels["service"], s.labels["result"]): s.value for s in families["rse_pf_requests"].samples
    }
    assert requests == {("echo", "ok"): 1, ("unknown", "unknown-service"): 1}
    counts = [s for s in families["rse_pf_duration_seconds"].samples if s.name.endswith("_count")]
    assert {s.labels["service"]: s.value for s in counts} == {"echo": 1, "unknown": 1}
    handshakes = {s.labels["result"]: s.value for s in families["rse_pf_handshakes"].samples}
    assert handshakes["ok"] == 2
    for gauge in ("robots", "queue", "queue_oldest_s", "in_flight", "loop_lag_s", "cpu_s", "resident_bytes"):
        assert f"rse_pf_{gauge}" in families
    assert [name for name, family in families.items() if len(family.documentation.split()) < 3] == []
    status = server.status()
    assert (status["pid"], status["workers"]) == (server.process.pid, server.workers)
    assert (status["requests"], status["state"]) == (2, "ready")


async def test_a_socket_without_hello_is_closed(start_server):
    server = start_server(session={"hello_timeout_s": 0.3})

    async with server.robot(hello=False) as robot:
        assert (await closed_with(robot)) == 4400


async def test_a_silent_robot_is_closed(start_server):
    server = start_server(
        session={
            "ping_interval_s": 0.1,
            "ping_timeout_s": 0.1,
            "hello_timeout_s": 0.4,
            "stall_timeout_s": 0.1,
        }
    )

    async with server.robot() as robot:
        assert (await closed_with(robot)) == 1001


async def test_a_robot_that_does_not_read_is_cut_off(start_server):
    server = start_server(serving={"slow_reader_timeout_s": 0.3}, session={"max_commands_per_s": 0.0})

    async with server.robot(max_queue=1, max_size=1 << 20) as robot:
        robot.socket.transport.pause_reading()
        with contextlib.suppress(ConnectionClosed):
            await asyncio.wait_for(ask_for_ever(robot), LONG_S)
        robot.socket.transport.abort()
    text = server.http("/metrics")[2].decode()
    assert 'rse_pf_closed_total{reason="slow-reader"} 1.0' in text


@pytest.mark.slow
async def test_an_emulated_server_uses_no_more_cpu_than_its_cores(start_server):
    server = start_server(serving={"emulated_cores": 0.25})

    async with server.robot() as robot:
        before, began = server.status()["worker_cpu_s"][0], time.monotonic()
        identity = 0
        while time.monotonic() - began < 4.0:
            identity += 1
            await robot.ask(identity, "work", {"burn_s": 0.01})
        used = server.status()["worker_cpu_s"][0] - before
        assert (used / (time.monotonic() - began)) == pytest.approx(0.25, rel=0.15)
