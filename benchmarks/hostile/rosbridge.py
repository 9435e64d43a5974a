"""What rosbridge costs beside the platform's own JSON, and what attacks on it cost the robots beside it.

    python -m benchmarks hostile.rosbridge [--rounds 10] [--seconds 5]

First part: one robot solves the same poses by turns over the sub-protocol JSON and over rosbridge; the
figure is the ratio of the medians, which must be at most 1.3.  Second part: four robots solve ten poses a
second each, in windows with and without attacks, which run in a process of their own with the lowest
priority; the figure is the ratio of the p99, which must be at most 1.2.  Every attack must be ended by the
server, with a code in `MUST`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from benchmarks.frame.registry import Bar, benchmark, command_of
from benchmarks.frame.statistics import percentile, spread
from benchmarks.server.serving import BenchServer
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request
from rse_pf.wire import Command, make_codec

RESET = 1006
MUST = {
    "no-token": {4401}, "subscriptions": {4429, RESET}, "flood": {4429, RESET}, "garbage": {4400, RESET},
    "dead": {1001, RESET},
}  # fmt: skip
"""The codes that may end an attack; who sends on after the end gets a reset instead of its code."""
POINTS = (12, 200, 300)
ROBOTS, PER_S, STRANGERS, SUBSCRIPTIONS = 4, 10.0, 60, 10_000
DEAD_S = 8.0


def payloads() -> list[Any]:
    """Return the payloads of poses with `POINTS` matches, as JSON has them."""
    codec, texts = make_codec("json"), []
    for seed, points in enumerate(POINTS):
        problem = make_problem(n=points, seed=seed)
        request = make_request(problem.points_world, problem.pixels, problem.camera)
        texts.append(json.loads(codec.encode(Command(id=0, service="pnp", payload=request)))["payload"])
    return texts


def enter(port: int, token: str = "", *, rosbridge: bool = True, **more: Any) -> connect:
    """Return what connects to the server, by rosbridge or by JSON."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    offered = None if rosbridge else [Subprotocol("rse-pf.v1.json")]
    return connect(
        f"ws://127.0.0.1:{port}/{'rosbridge' if rosbridge else 'ws'}", additional_headers=headers,
        subprotocols=offered, compression=None, open_timeout=20, **more,
    )  # fmt: skip


async def time_answer_ms(socket: ClientConnection, message: str) -> float:
    """Return how long the answer to *message* took, in ms."""
    began = time.perf_counter()
    await socket.send(message)
    await socket.recv()
    return (time.perf_counter() - began) * 1e3


async def cost(server: BenchServer, rounds: int) -> dict[str, Any]:
    """Return the medians of both ways for each size, measured by turns."""
    times: dict[tuple[int, bool], list[float]] = {}
    poses = list(zip(POINTS, payloads(), strict=True))
    async with enter(server.port, server.token("json"), rosbridge=False) as own:
        await time_answer_ms(own, '{"type":"hello"}')
        async with enter(server.port, server.token("ros")) as ros:
            for number in range(rounds * 20):
                for points, payload in poses:
                    command = {"type": "command", "id": number, "service": "pnp", "payload": payload}
                    call = {"op": "call_service", "id": f"c:{number}", "service": "/pnp", "args": payload}
                    turns = [(own, command, False), (ros, call, True)]
                    for socket, message, is_ros in turns if number % 2 else turns[::-1]:
                        taken = await time_answer_ms(socket, json.dumps(message))
                        times.setdefault((points, is_ros), []).append(taken)
    medians = {key: statistics.median(times_ms) for key, times_ms in times.items()}
    return {
        str(points): {
            "n": len(times[points, True]), "json_ms": round(medians[points, False], 3),
            "rosbridge_ms": round(medians[points, True], 3),
            "ratio": round(medians[points, True] / medians[points, False], 2),
        }
        for points in POINTS
    }  # fmt: skip


# --- attacks -----------------------------------------------------------------------------------


async def no_token(port: int, token: str) -> int:
    async with enter(port) as socket:
        await socket.wait_closed()
    return socket.close_code or 0


async def subscriptions(port: int, token: str) -> int:
    async with enter(port, token) as socket:
        with contextlib.suppress(ConnectionClosed):
            for number in range(SUBSCRIPTIONS):
                await socket.send(json.dumps({"op": "subscribe", "topic": f"/t{number}", "id": number}))
        await socket.wait_closed()
    return socket.close_code or 0


async def flood(port: int, token: str) -> int:
    async with enter(port, token) as socket:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await socket.send(
                    json.dumps({"op": "publish", "topic": "/flood", "msg": {"data": "x" * 1000}})
                )
                await asyncio.sleep(0.001)  # the attack sends 1,000 messages a second
        await socket.wait_closed()
    return socket.close_code or 0


async def garbage(port: int, token: str) -> int:
    async with enter(port, token) as socket:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await socket.send('{"op":"launch"}')
                await asyncio.sleep(0.005)  # the pace of the attack
    return socket.close_code or 0


async def dead(port: int, token: str) -> int:
    """Subscribe, and then read nothing: not even the pings."""
    async with enter(port, token, ping_interval=None) as socket:
        await socket.send(json.dumps({"op": "subscribe", "topic": "/flood"}))
        socket.transport.pause_reading()
        await asyncio.sleep(DEAD_S)
        socket.transport.resume_reading()
        await asyncio.wait_for(socket.wait_closed(), 5.0)
    return socket.close_code or 0


ATTACKS: dict[str, Callable[[int, str], Awaitable[int]]] = {
    "no-token": no_token, "subscriptions": subscriptions, "flood": flood, "garbage": garbage, "dead": dead,
}  # fmt: skip


async def attack(port: int, tokens: list[str], rounds: int, seconds: float) -> dict[str, Any]:
    """Attack in every second window; return the windows and how the attacks ended."""
    ends: Counter[str] = Counter()

    async def one(name: str, token: str) -> None:
        try:
            ends[f"{name} {await ATTACKS[name](port, token)}"] += 1
        except ConnectionClosed as error:
            ends[f"{name} {error.rcvd.code if error.rcvd else RESET}"] += 1
        except (OSError, TimeoutError, InvalidHandshake) as error:
            ends[f"{name} {type(error).__name__}"] += 1

    windows = []
    for _ in range(rounds):
        quiet = time.monotonic()
        await asyncio.sleep(seconds)
        began = time.monotonic()
        named = [name for name in ATTACKS if name != "no-token"]
        work = [one(name, tokens.pop()) for name in named] + [one("no-token", "") for _ in range(STRANGERS)]
        running = [asyncio.ensure_future(coroutine) for coroutine in work]
        await asyncio.sleep(seconds)
        windows.append((quiet, began, time.monotonic()))
        await asyncio.gather(*running)
    return {"windows": windows, "ends": dict(ends)}


async def robot(port: int, token: str, payload: Any, times: list[tuple[float, float]]) -> None:
    """Solve poses until it is cancelled; append when, and how long each took in ms."""
    async with enter(port, token, rosbridge=False) as socket:
        await time_answer_ms(socket, '{"type":"hello"}')
        number = 0
        while True:
            number += 1
            message = {"type": "command", "id": number, "service": "pnp", "payload": payload}
            times.append((time.monotonic(), await time_answer_ms(socket, json.dumps(message))))
            await asyncio.sleep(1 / PER_S)


async def beside(server: BenchServer, rounds: int, seconds: float) -> dict[str, Any]:
    """Return the round trips of robots with and without attacks, and how the attacks ended."""
    times: list[tuple[float, float]] = []
    payload = payloads()[1]
    robots = [
        asyncio.ensure_future(robot(server.port, server.token(f"r-{number}"), payload, times))
        for number in range(ROBOTS)
    ]
    tokens = [server.token(f"hostile-{number}") for number in range(rounds * len(ATTACKS))]
    process = await asyncio.create_subprocess_exec(
        "nice", "-n", "19", *command_of(run_attacks, str(server.port), str(rounds), str(seconds)),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    output, _ = await process.communicate(json.dumps(tokens).encode())
    for task in robots:
        task.cancel()
    measured = json.loads(output)
    quiet = [ms for at, ms in times if any(a <= at < b for a, b, _ in measured["windows"])]
    attacked = [ms for at, ms in times if any(b <= at < c for _, b, c in measured["windows"])]
    ratio = percentile(attacked, 99) / percentile(quiet, 99)
    wrong = [end for end in measured["ends"] if end.split()[1] not in map(str, MUST[end.split()[0]])]
    return {
        "quiet_ms": spread(quiet), "attacked_ms": spread(attacked), "p99_ratio": ratio,
        "ends": measured["ends"], "wrong_ends": wrong,
    }  # fmt: skip


@benchmark(
    Bar("cost.*.ratio", at_most=1.3, unit="times JSON"),
    Bar("beside.p99_ratio", at_most=1.2, unit="times quiet"),
    Bar("beside.wrong_ends", equals=[]),
)
def run_benchmark(
    *, rounds: int = 10, seconds: Annotated[float, "length of a window"] = 5.0
) -> dict[str, Any]:
    """Measure both parts."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    serving = {"rosbridge": True}
    with tempfile.TemporaryDirectory() as folder:
        unlimited = {"max_commands_per_s": 0.0}
        with BenchServer(Path(folder), workers=2, serving=serving, session=unlimited) as server:
            paid = asyncio.run(cost(server, rounds))
        with BenchServer(Path(folder), workers=2, serving=serving) as server:
            figures = asyncio.run(beside(server, rounds, seconds))
    return {"cost": paid, "beside": figures}


def run_attacks(port: str, rounds: str, seconds: str) -> None:
    """Attack from a process of its own, with the tokens of its input."""
    tokens = json.load(sys.stdin)
    print(json.dumps(asyncio.run(attack(int(port), tokens, int(rounds), float(seconds)))))
