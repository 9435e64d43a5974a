"""What the web client does with payloads that have no JSON, and with messages that it cannot read."""

from __future__ import annotations

import asyncio
import itertools
import json
import shutil
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection, serve

MODULE = Path(__file__).resolve().parents[2] / "client_web" / "rse-pf.js"
WITHIN_S = 30.0
WELCOME = {
    "type": "welcome", "server": "s", "session": "x", "robot": "r", "protocol": 1, "clock_s": 1.0,
    "limits": {"max_message_bytes": 262144, "max_in_flight": 8},
}  # fmt: skip
HEAD = """
const { connect, codecs } = await import(process.argv[1]);
const url = process.argv[2];
const codeOf = (call) => call.then(() => "ok", (error) => error.code || error.name);
const say = (value) => console.log(JSON.stringify(value));
"""


def node() -> str:
    beside = Path(sys.executable).with_name("node")
    found = str(beside) if beside.exists() else shutil.which("node")
    if found is None:
        pytest.skip("no Node.js: make setup installs it")
    return found


async def printed(program: str, url: str = "") -> Any:
    """Return what *program* prints last; it is ended when it takes too long."""
    process = await asyncio.create_subprocess_exec(
        node(), "--input-type=module", "-e", HEAD + program + "\nprocess.exit(0);", str(MODULE), url,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        out, errors = await asyncio.wait_for(process.communicate(), WITHIN_S)
    except asyncio.TimeoutError:
        process.kill()
        await process.wait()
        pytest.fail(f"not over within {WITHIN_S} s")
    assert process.returncode == 0, errors.decode()
    return json.loads(out.splitlines()[-1])


Answers = Callable[[dict[str, Any]], bytes | None]


def against(answers: Answers, program: str) -> Any:
    """Return what *program* prints against a server that sends what *answers* returns for each message."""

    async def serves(socket: ServerConnection) -> None:
        async for data in socket:
            assert isinstance(data, bytes)
            sent = answers(json.loads(zlib.decompress(data)))
            if sent is not None:
                await socket.send(sent)

    async def run() -> Any:
        options: dict[str, Any] = {"subprotocols": ["rse-pf.v1.json+zlib"], "compression": None}
        async with serve(serves, "127.0.0.1", 0, **options) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            return await printed(program, f"ws://127.0.0.1:{port}/ws")

    return asyncio.run(run())


def said(message: dict[str, Any]) -> bytes:
    return zlib.compress(json.dumps(message).encode())


def echo(message: dict[str, Any]) -> bytes | None:
    """Answer as a server does."""
    if message["type"] == "hello":
        return said(WELCOME)
    if message["type"] == "ping":
        return said({"type": "pong", "sent_s": message["sent_s"], "received_s": 1.0, "answered_s": 1.0})
    return said({"type": "result", "id": message["id"], "reply": message.get("payload")})


def test_an_answer_that_cannot_be_read_ends_the_calls_that_wait_with_a_typed_error() -> None:
    def answers(message: dict[str, Any]) -> bytes | None:
        is_bad = message["type"] == "command" and message["payload"] == "bad"
        return b"no zlib stream" if is_bad else echo(message)

    program = """
    const robot = await connect(url, { token: "t" });
    const began = performance.now();
    const first = await codeOf(robot.call("echo", "bad"));
    const isSoon = performance.now() - began < 2000;
    say([first, isSoon, await codeOf(robot.call("echo", 1)), robot.stats.unanswered]);
    """

    assert against(answers, program) == ["protocol", True, "ok", 0]


def test_a_welcome_that_cannot_be_read_rejects_connect_with_a_typed_error() -> None:
    program = """
    const failed = await connect(url, { token: "t" }).catch((error) => error);
    say([failed.code, failed.message.includes("cannot read"), failed.hint !== ""]);
    """

    assert against(lambda _: b"no zlib stream", program) == ["protocol", True, True]


# The time limit of a token function, 30 s, is 30 ms.
QUICK = """
const { setTimeout } = globalThis;
globalThis.setTimeout = (work, ms, ...words) => setTimeout(work, ms === 30e3 ? 30 : ms, ...words);
console.error = () => {};
const never = new Promise(() => {});
"""


def test_a_token_function_that_never_answers_counts_as_failed_and_is_asked_again() -> None:
    program = f"""{QUICK}
    let asked = 0;
    const robot = await connect(url, {{ token: () => asked++ ? "t" : never }});
    say([await codeOf(robot.call("echo", 1)), asked, robot.stats.callbackErrors]);
    """

    assert against(echo, program) == ["ok", 2, 1]


def test_callbacks_that_fail_are_counted_and_the_robot_goes_on() -> None:
    servers = (f"server-{number}" for number in itertools.count(1))
    is_first = itertools.chain([True], itertools.repeat(False))

    def answers(message: dict[str, Any]) -> bytes | None:
        if message["type"] == "hello":
            return said({**WELCOME, "server": next(servers)})
        if message.get("topic") == "move" and next(is_first):
            return said({"type": "move", "within_ms": 20000})
        if message["type"] == "subscribe":
            return said({"type": "update", "id": message["id"], "key": "k", "payload": 1, "seq": 1})
        return echo(message)

    program = """
    console.error = () => {};
    const fail = () => { throw new Error("of a callback"); };
    let isUp = false;
    const token = () => isUp ? "t" : (isUp = true, fail());
    let finish;
    const change = new Promise((done) => finish = done);
    const onChange = (what) => { finish(what); return Promise.reject(new Error("of a promise")); };
    const robot = await connect(url, { token, onChange });
    robot.subscribe("move", () => {});
    const what = await change;
    await new Promise((done) => robot.subscribe("a", (key) => { done(); fail(); }));
    const codes = [await codeOf(robot.call("echo", 1))];
    const own = await new Promise((done) =>
      robot.subscribe("b", () => {
        robot.call("echo", 2).then(({ reply }) => done(reply)).then(robot.close);
        fail();
      }));
    while (!robot.error) await new Promise((done) => setTimeout(done, 5));
    const { callbackErrors, sent, answered } = robot.stats;
    say([codes, own, what, callbackErrors, sent, answered]);
    """

    assert against(answers, program) == [["ok"], 2, "moved", 4, 2, 2]


def test_a_program_that_blocks_for_long_connects_again_and_sends_nothing_twice() -> None:
    commands: list[int] = []

    def answers(message: dict[str, Any]) -> bytes | None:
        if message["type"] == "command":
            commands.append(message["id"])
        return echo(message)

    program = """
    const robot = await connect(url, { token: "t" });
    const until = performance.now() + 10e3;
    while (performance.now() < until);
    say([await codeOf(robot.call("echo", 1)), robot.stats.resent]);
    """

    assert against(answers, program) == ["ok", 0]
    assert len(commands) == 1


@pytest.mark.parametrize("size", [(1 << 20) + 1, 5_000_000])
def test_a_message_that_inflates_to_more_than_a_megabyte_is_refused(size: int) -> None:
    data = list(zlib.compress(b'"' + b"a" * size))
    program = f"say(await codeOf(codecs.zlib.decode(Uint8Array.from({data}))));"

    assert asyncio.run(printed(program)) == "protocol"
