"""The web client waits as an overloaded server demands, and reports that."""

from __future__ import annotations

import itertools
import json
import time
import zlib
from typing import Any

from client_web.test_failures import WELCOME, against, said


class Server:
    """Answers as *refuse* says for each command, and notes when each one came."""

    def __init__(self, *first: dict[str, Any], welcome: dict[str, Any] | None = None) -> None:
        self.first = [json.dumps(message) for message in first]
        self.welcome = welcome or WELCOME
        self.came: list[tuple[float, dict[str, Any]]] = []

    def answer(self, message: dict[str, Any]) -> bytes | None:
        """Answer the first commands with the given messages, and the next ones with their payload."""
        if message["type"] == "hello":
            return said(self.welcome)
        if message["type"] == "ping":
            return said({"type": "pong", "sent_s": message["sent_s"], "received_s": 1.0, "answered_s": 1.0})
        self.came.append((time.monotonic(), message["payload"]))
        if self.first:
            return zlib.compress(self.first.pop(0).encode())
        return said({"type": "result", "id": message["id"], "reply": message["payload"]})

    def pauses_s(self) -> list[float]:
        times = [at for at, _ in self.came]
        return [later - earlier for earlier, later in itertools.pairwise(times)]

    def payloads(self) -> list[Any]:
        return [payload for _, payload in self.came]


BUSY = {"code": "busy", "message": "too many commands wait"}
OPEN = 'const robot = await connect(url, { token: "t" });\n'


def test_after_busy_no_frame_of_its_stream_is_sent_before_the_pause_is_over() -> None:
    server = Server({"type": "failure", "id": 1, "retry_after_ms": 400, **BUSY})
    program = (
        OPEN
        + """
    const first = await codeOf(robot.call("echo", 1, { stream: "a", deadlineMs: 300 }));
    const fresh = codeOf(robot.call("echo", 2, { stream: "a", keep: true }));
    const other = codeOf(robot.call("echo", 3, { stream: "b" }));
    say([first, await fresh, await other, robot.stats.heldBack.busy]);
    """
    )

    assert against(server.answer, program) == ["busy", "ok", "ok", 1]
    assert server.payloads() == [1, 3, 2]
    (first, _), _, (fresh, _) = server.came
    assert fresh - first >= 0.38


def test_a_frame_that_the_pause_outlasts_ends_at_once_with_the_words_of_the_server() -> None:
    server = Server({"type": "failure", "id": 1, "retry_after_ms": 1500, "trace": "other", **BUSY})
    program = (
        OPEN
        + """
    const first = await codeOf(robot.call("echo", 1, { stream: "a", deadlineMs: 300 }));
    const began = performance.now();
    const options = { stream: "a", deadlineMs: 1000, trace: "t" };
    const second = await robot.call("echo", 2, options).catch((failed) => failed);
    const tookMs = performance.now() - began;
    const { code, message, trace, retryAfterMs } = second;
    const left = retryAfterMs > 1000 && retryAfterMs < 1500;
    const third = await codeOf(robot.call("echo", 3, { stream: "a", deadlineMs: 5000 }));
    say([first, code, message, trace, left, tookMs < 500, third, robot.stats.unanswered]);
    """
    )

    told = ["busy", "busy", BUSY["message"], "t", True, True, "ok", 0]
    assert against(server.answer, program) == told
    assert server.payloads() == [1, 3]


def test_what_a_server_said_of_a_stream_does_not_count_for_the_next_connection() -> None:
    busy, move = (
        {"type": "failure", "id": 1, "retry_after_ms": 3000, **BUSY},
        {"type": "move", "within_ms": 3000},
    )
    server = Server(busy, move)
    names = (f"server-{number}" for number in itertools.count(1))

    def answer(message: dict[str, Any]) -> bytes | None:
        if message["type"] == "hello":
            server.welcome = {**WELCOME, "server": next(names)}
        return server.answer(message)

    program = (
        OPEN
        + """
    const first = await codeOf(robot.call("echo", 1, { stream: "a", deadlineMs: 300 }));
    const second = await codeOf(robot.call("echo", 2, { stream: "a", deadlineMs: 300 }));
    robot.call("echo", "move").catch(() => 0);
    while (!robot.stats.moves) await new Promise((done) => setTimeout(done, 5));
    say([first, second, await codeOf(robot.call("echo", 3, { stream: "a", deadlineMs: 1000 }))]);
    """
    )

    assert against(answer, program) == ["busy", "busy", "ok"]


def test_what_the_limits_of_the_welcome_hold_back_is_counted_as_own() -> None:
    server = Server(welcome={**WELCOME, "limits": {"max_message_bytes": 262144, "max_in_flight": 2}})
    program = (
        OPEN
        + """
    await Promise.all([1, 2, 3, 4, 5].map((each) => robot.call("echo", each)));
    say([robot.stats.heldBack["own-limit"], robot.stats.heldBack.busy]);
    """
    )

    assert against(server.answer, program) == [3, 0]
