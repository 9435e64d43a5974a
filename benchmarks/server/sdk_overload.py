"""What the clients in three languages offer to a small server that twice as many robots use as it can serve.

    python -m benchmarks server.sdk_overload [--sdk python js cpp] [--rounds 1]

The server is emulated: it answers `CAPACITY_PER_S` commands a second, ends the others as ``busy``, and for
`TOLD_MS` after a refusal it tells each robot that sends its share of the capacity.  Robots send the frames
of a camera, newest only, with a deadline of 250 ms, at twice the capacity in all.  Offered is what arrives
after `SETTLED_S`.  A client in C++ needs its compiler and headers, one in JavaScript Node; what is not there
is left out.

Defends: no client of ours keeps a server in overload, and its statistics say what it held back.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from client_sdk import connect
from rse_pf.errors import UsageError
from rse_pf.token_bucket import TokenBucket
from rse_pf.wire import (
    SUBPROTOCOLS,
    Command,
    Hello,
    Limits,
    Ping,
    Pong,
    Rate,
    Refused,
    Result,
    Welcome,
    make_codec,
)

CAPACITY_PER_S, ROBOTS, FRAMES_PER_S = 100.0, 20, 10.0
SETTLED_S, SECONDS = 5.0, 10.0
TOLD_MS, TOLD_EVERY_S = 2000.0, 1.0
BURST_S = 0.1
HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SDKS = ("python", "js", "cpp")
COMPILE_S = 300.0


class SmallServer:
    """Answers as many commands as it can, and notes when each one came."""

    def __init__(self) -> None:
        self.came_s: list[float] = []
        self.answered_s: list[float] = []
        self._free = TokenBucket(CAPACITY_PER_S, BURST_S * CAPACITY_PER_S)
        self._refused_s = float("-inf")

    async def talk(self, connection: ServerConnection) -> None:
        """Serve one robot."""
        codec = make_codec({name: short for short, name in SUBPROTOCOLS.items()}[str(connection.subprotocol)])
        told_s = float("-inf")
        try:
            async for data in connection:
                message = codec.decode_from_robot(data.encode() if isinstance(data, str) else data)
                now = time.monotonic()
                if isinstance(message, Hello):
                    limits = Limits(max_message_bytes=1 << 18, max_in_flight=8)
                    said: Any = Welcome(
                        server="small", session="s", robot="r", protocol=1, limits=limits, clock_s=now
                    )
                elif isinstance(message, Ping):
                    said = Pong(sent_s=message.sent_s, received_s=now, answered_s=now)
                elif isinstance(message, Command):
                    self.came_s.append(now)
                    if self._free.take(now) == 0.0:
                        self.answered_s.append(now)
                        said = Result(id=message.id)
                    else:
                        self._refused_s = now
                        said = Refused(ids=[message.id], code="busy", message="it has too much to do")
                    if now - told_s >= TOLD_EVERY_S and 1e3 * (now - self._refused_s) < TOLD_MS:
                        told_s = now
                        rate = Rate(commands_per_s=CAPACITY_PER_S / ROBOTS, for_ms=TOLD_MS)
                        await connection.send(codec.encode(rate), text=codec.is_text)
                else:
                    continue
                await connection.send(codec.encode(said), text=codec.is_text)
        except ConnectionClosed:
            return


async def python_robots(url: str) -> list[dict[str, Any]]:
    """Let robots of the Python SDK send; return their statistics."""
    robots = [await connect(url, codec="bin") for _ in range(ROBOTS)]
    began = time.monotonic()
    for turn in range(round(SECONDS * FRAMES_PER_S)):
        for k, robot in enumerate(robots):
            due_s = (turn + k / ROBOTS) / FRAMES_PER_S
            await asyncio.sleep(max(0.0, due_s - (time.monotonic() - began)))
            robot.post("echo", {"value": turn}, lambda _: None, stream="camera", deadline_s=0.25)
    found = [robot.stats for robot in robots]
    for robot in robots:
        await robot.close()
    return [
        {
            "held_back": dict(each.held_back),
            "told_rate_per_s": each.told_rate_per_s,
            "reconnects": each.reconnects,
        }
        for each in found
    ]


async def other_robots(program: list[str], url: str) -> list[dict[str, Any]]:
    """Let the robots of a *program* send; return their statistics."""
    process = await asyncio.create_subprocess_exec(
        *program, url, str(ROBOTS), str(FRAMES_PER_S), str(SECONDS), stdout=asyncio.subprocess.PIPE
    )
    out, _ = await process.communicate()
    found: list[dict[str, Any]] = json.loads(out)
    return found


def program_of(sdk: str, folder: Path) -> list[str] | None:
    """Return the command of the robots of *sdk*, None where it cannot run here."""
    if sdk == "js":
        beside = Path(sys.executable).with_name("node")
        node = str(beside) if beside.exists() else shutil.which("node")
        return None if node is None else [node, str(HERE / "sdk_robots.mjs")]
    made = folder / "sdk_robots"
    compiler = shutil.which("c++")
    if compiler is None:
        return None
    command = [compiler, "-std=c++17", "-O1", f"-I{ROOT / 'client_cpp' / 'include'}"]
    command += [str(HERE / "sdk_robots.cpp"), "-lssl", "-lcrypto", "-pthread", "-o", str(made)]
    ended = subprocess.run(command, capture_output=True, timeout=COMPILE_S, check=False)
    return None if ended.returncode else [str(made)]


async def run_sdk(program: list[str] | None) -> dict[str, Any]:
    """Return what one client offered; *program* None is the Python SDK, in this process."""
    small = SmallServer()
    names: Any = list(SUBPROTOCOLS.values())
    async with serve(small.talk, "127.0.0.1", 0, subprotocols=names, compression=None) as server:
        url = f"ws://127.0.0.1:{next(iter(server.sockets)).getsockname()[1]}/ws"
        robots = await (python_robots(url) if program is None else other_robots(program, url))
    begin_s = small.came_s[0]

    def per_s(times_s: list[float], first_s: float, last_s: float) -> float:
        return sum(first_s <= at - begin_s < last_s for at in times_s) / (last_s - first_s)

    held = sum((Counter(each["held_back"]) for each in robots), Counter[str]())
    return {
        "offered_at_first": per_s(small.came_s, 0.0, 0.5) / CAPACITY_PER_S,
        "offered": per_s(small.came_s, SETTLED_S, SECONDS) / CAPACITY_PER_S,
        "answered": per_s(small.answered_s, SETTLED_S, SECONDS) / CAPACITY_PER_S,
        "held_back": dict(held),
        "told": sum(each["told_rate_per_s"] is not None for each in robots),
        "reconnects": sum(each["reconnects"] for each in robots),
    }


@benchmark(
    Bar("offered.python", at_most=1.2),
    Bar("offered.js", at_most=1.2),
    Bar("offered.cpp", at_most=1.2),
)
def run_benchmark(
    *,
    sdk: Annotated[tuple[str, ...], "which clients"] = SDKS,
    rounds: Annotated[int, "over all clients"] = 1,
) -> dict[str, Any]:
    """Let the robots of each client use the server, one client after the other."""
    if unknown := set(sdk) - set(SDKS):
        raise UsageError(f"no client named {sorted(unknown)[0]}", hint=f"choose of {', '.join(SDKS)}")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made:
        programs = {name: None if name == "python" else program_of(name, Path(made)) for name in sdk}
        for number in range(rounds):
            for name, program in programs.items():
                if program is None and name != "python":
                    say(f"{name}: left out, it cannot run here")
                    continue
                rows.append({"round": number, "sdk": name, **asyncio.run(run_sdk(program))})
                say(f"{name}: {rows[-1]}")
    offered = {name: [row["offered"] for row in rows if row["sdk"] == name] for name in sdk}
    return {
        "offered": {name: statistics.median(each) for name, each in offered.items() if each},
        "rows": rows,
    }
