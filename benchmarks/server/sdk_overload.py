"""Measure the load that clients in three languages offer to a server with twice the robots that it can serve.

    python -m benchmarks server.sdk_overload [--sdk python js cpp] [--rounds 1] [--real] [--most N] [--obey]

The server is emulated: it answers `CAPACITY_PER_S` commands a second, and refuses the others as ``busy`` with
a random pause of 0.5 to 1.5 times `MEAN_PAUSE_MS`.  Robots send the frames of a camera, newest only, with a
deadline of 250 ms, at twice the capacity in all.  The offered load is the rate of commands that arrive after
`SETTLED_S`, as a share of the capacity.  The C++ client needs a compiler and its headers, the JavaScript
client needs Node; a client that cannot run is left out.

With ``--real`` the server has two workers that solve real PnP (200 matches, 30 % wrong), as in
``server.capacity``.  ``--most`` is the number of robots at 5 frames a second that the server carries; without
it, this number is searched.  Twice as many robots of the load generator in C drive all the time; with
``--obey`` they wait as refusals demand.  Concurrently `ROBOTS` robots of one client drive at 5 frames a
second. The fair rate of a robot is the capacity divided by all robots.  The offered load is then the rate of
commands of the client's robots after `SETTLED_S`, as a share of `ROBOTS` fair rates.  A relay before the
server counts these commands.  Relay and clients use processors of the same machine, so that the server
carries less than the most robots.

Defends the promise that clients of our SDKs keep an overloaded server useful: none offers more than its bar,
and the statistics of each client state the number of commands that the client held back.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import websockets
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.server.capacity import FRAMES_PER_S as REAL_FRAMES_PER_S
from benchmarks.server.capacity import SOURCES, WARM_UP_S, ServingSite, find_capacity, serving
from benchmarks.server.load import (
    LoadPlan,
    LoadProcess,
    RobotGroup,
    command_file,
    compile_generator,
    hello_file,
)
from client_sdk import connect
from rse_pf.config import SessionSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.load.payloads import make_payloads
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire import (
    SUBPROTOCOLS,
    Command,
    Failure,
    Hello,
    Limits,
    Ping,
    Pong,
    Result,
    Welcome,
    make_codec,
)

CAPACITY_PER_S = 100.0  # commands per second that the emulated server answers
ROBOTS = 20  # number of robots of one client
FRAMES_PER_S = 10.0  # frames per second of each robot with the emulated server: twice its capacity in all
SETTLED_S = 5.0  # time at the begin of a run that is not measured: clients adapt their rate
SECONDS = 10.0  # duration of a run
MEAN_PAUSE_MS = 1000.0  # mean pause that a refusal demands, some frames of a camera, as servers demand it
BURST_S = 0.1  # commands that the emulated server may answer at once, as seconds of its capacity
DEADLINE_S = 0.25  # deadline of a command
TIMES_THE_MOST = 2  # robots of the load generator as a multiple of the most that a real server carries
LONGEST_S = 120.0  # time limit for the robots of the load generator, and for those of a client
STEP_S = 5.0  # duration of a step of the search of the most robots
# Folder of this file, with the programs of the clients.
HERE = Path(__file__).parent
ROOT = HERE.parents[1]
# Names of the measured clients.
SDKS = ("python", "js", "cpp")
COMPILE_S = 300.0  # time limit for compiling the C++ client


@dataclass(slots=True)
class Counted:
    """The arrival times of all commands, and the times of all answers; monotonic seconds."""

    came_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)

    def per_s(self, times_s: list[float], first_s: float, last_s: float) -> float:
        """Return the rate of *times_s* per second between two times, in seconds after the first command."""
        return sum(first_s <= at - self.came_s[0] < last_s for at in times_s) / (last_s - first_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """The commands of the robots of one client, *frames_per_s* by each, and the fair rate of each robot."""

    service: str
    payload: Any
    frames_per_s: float
    share_per_s: float


class SmallServer(Counted):
    """An emulated server that answers `CAPACITY_PER_S` commands a second and refuses the others as busy."""

    def __init__(self) -> None:
        super().__init__()
        self._free = TokenBucket(CAPACITY_PER_S, BURST_S * CAPACITY_PER_S)
        self._random = random.Random(1)

    async def talk(self, connection: ServerConnection) -> None:
        """Serve the robot of one connection until it closes."""
        codec = codec_of(connection)
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
                        pause_ms = MEAN_PAUSE_MS * self._random.uniform(0.5, 1.5)
                        said = Failure(
                            id=message.id, code="busy", message="too much to do", retry_after_ms=pause_ms
                        )
                else:
                    continue
                await connection.send(codec.encode(said), text=codec.is_text)
        except ConnectionClosed:
            return


class Relay(Counted):
    """Pass messages between robots and the server at *port*, and count commands and answers."""

    def __init__(self, port: int) -> None:
        super().__init__()
        self._port = port

    async def talk(self, connection: ServerConnection) -> None:
        """Serve the robot of one connection until it closes."""
        codec, names = codec_of(connection), [str(connection.subprotocol)]
        url = f"ws://127.0.0.1:{self._port}/ws"

        async def pass_answers(server: Any) -> None:
            async for data in server:
                message = codec.decode_from_server(data.encode() if isinstance(data, str) else data)
                if isinstance(message, Result):
                    self.answered_s.append(time.monotonic())
                await connection.send(data)

        async with websockets.connect(url, subprotocols=names, compression=None) as server:  # type: ignore[arg-type]
            answers = asyncio.ensure_future(pass_answers(server))
            try:
                async for data in connection:
                    message = codec.decode_from_robot(data.encode() if isinstance(data, str) else data)
                    if isinstance(message, Command):
                        self.came_s.append(time.monotonic())
                    await server.send(data)
            except ConnectionClosed:
                return
            finally:
                answers.cancel()


def codec_of(connection: ServerConnection) -> Any:
    """Return the codec that the robot of *connection* chose."""
    return make_codec({name: short for short, name in SUBPROTOCOLS.items()}[str(connection.subprotocol)])


async def python_robots(url: str, drive: Drive) -> list[dict[str, Any]]:
    """Let `ROBOTS` robots of the Python SDK send the commands of *drive* for `SECONDS`.

    Return for each robot the number of its commands that were ``held_back``, by reason, and of its
    ``reconnects``.
    """
    robots = [await connect(url, codec="bin") for _ in range(ROBOTS)]
    began = time.monotonic()
    for turn in range(round(SECONDS * drive.frames_per_s)):
        for k, robot in enumerate(robots):
            due_s = (turn + k / ROBOTS) / drive.frames_per_s
            await asyncio.sleep(max(0.0, due_s - (time.monotonic() - began)))
            robot.post(
                drive.service, drive.payload, lambda _: None, stream="camera", deadline_s=DEADLINE_S
            )  # fmt: skip
    found = [robot.stats for robot in robots]
    for robot in robots:
        await robot.close()
    return [{"held_back": dict(each.held_back), "reconnects": each.reconnects} for each in found]


async def other_robots(program: list[str], url: str, drive: Drive) -> list[dict[str, Any]]:
    """Let the robots of a *program* send the same; return the same as `python_robots`."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump({"service": drive.service, "payload": drive.payload}, file)
        file.flush()
        words = [url, str(ROBOTS), str(drive.frames_per_s), str(SECONDS), file.name]
        process = await asyncio.create_subprocess_exec(*program, *words, stdout=asyncio.subprocess.PIPE)
        out, _ = await process.communicate()
    found: list[dict[str, Any]] = json.loads(out)
    return found


def program_of(sdk: str, folder: Path) -> list[str] | None:
    """Return the command line of the robots of *sdk*; None if this client cannot run on this machine."""
    if sdk == "js":
        own_node = Path(sys.executable).with_name("node")
        node = str(own_node) if own_node.exists() else shutil.which("node")
        return None if node is None else [node, str(HERE / "sdk_robots.mjs")]
    made = folder / "sdk_robots"
    compiler = shutil.which("c++")
    if compiler is None:
        return None
    command = [compiler, "-std=c++17", "-O1", f"-I{ROOT / 'client_cpp' / 'include'}"]
    command += [str(HERE / "sdk_robots.cpp"), "-lssl", "-lcrypto", "-pthread", "-o", str(made)]
    ended = subprocess.run(command, capture_output=True, timeout=COMPILE_S, check=False)
    return None if ended.returncode else [str(made)]


async def run_sdk(program: list[str] | None, peer: SmallServer | Relay, drive: Drive) -> dict[str, Any]:
    """Return the load that one client offered to *peer*; *program* None is the Python SDK in this process."""
    names: Any = list(SUBPROTOCOLS.values())
    async with serve(peer.talk, "127.0.0.1", 0, subprotocols=names, compression=None) as server:
        url = f"ws://127.0.0.1:{next(iter(server.sockets)).getsockname()[1]}/ws"
        robots = await (python_robots(url, drive) if program is None else other_robots(program, url, drive))
    share_per_s = drive.share_per_s
    held = sum((Counter(each["held_back"]) for each in robots), Counter[str]())
    return {
        "offered_at_first": peer.per_s(peer.came_s, 0.0, 0.5) / share_per_s,
        "offered": peer.per_s(peer.came_s, SETTLED_S, SECONDS) / share_per_s,
        "answered": peer.per_s(peer.answered_s, SETTLED_S, SECONDS) / share_per_s,
        "held_back": dict(held),
        "reconnects": sum(each["reconnects"] for each in robots),
    }


def run_emulated(program: list[str] | None) -> dict[str, Any]:
    """Return the load that one client offers to the emulated server."""
    drive = Drive(service="echo", payload={"value": 1}, frames_per_s=FRAMES_PER_S, share_per_s=CAPACITY_PER_S)
    return asyncio.run(run_sdk(program, SmallServer(), drive))


def run_real(program: list[str] | None, port: int, most: int, obeys: bool) -> dict[str, Any]:
    """Return the load that one client offers to the server at *port*, with twice the *most* robots."""
    crowd = TIMES_THE_MOST * most
    scenario = LoadScenario(codec="bin", deadline_s=DEADLINE_S, keep=False)
    as_json = make_payloads(replace(scenario, codec="json"), SessionSettings())[0].payload
    drive = Drive(
        service="pnp", payload=json.loads(as_json.encoded), frames_per_s=REAL_FRAMES_PER_S,
        share_per_s=ROBOTS * most * REAL_FRAMES_PER_S / (crowd + ROBOTS),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        group = RobotGroup(
            name="crowd", robots=crowd, mode="open", rate=REAL_FRAMES_PER_S,
            payload=command_file(folder, scenario),
        )  # fmt: skip
        plan = LoadPlan(
            port=port, codec="bin", hello=hello_file(folder, "bin"), obeys=obeys,
            groups=(group,), seconds=LONGEST_S, warm_up_s=WARM_UP_S, drain_s=1.0, opening_s=30.0,
            sources=SOURCES, samples=folder / "crowd.samples",
        )  # fmt: skip
        with LoadProcess(plan) as load:
            load.wait_begun()
            found = asyncio.run(run_sdk(program, Relay(port), drive))
            report = load.stop()
    crowded = report.groups[0]
    return {**found, "crowd": {"robots": crowd, "ok": crowded.ok, "failed": crowded.failed}}


@benchmark(
    Bar("offered.python", at_most=1.2),
    Bar("offered.js", at_most=1.2),
    Bar("offered.cpp", at_most=1.2),
)
def run_benchmark(
    *,
    sdk: Annotated[tuple[str, ...], "which clients"] = SDKS,
    rounds: Annotated[int, "over all clients"] = 1,
    real: Annotated[bool, "a server of two workers, and a crowd of robots in C"] = False,
    most: Annotated[int, "robots that the real server carries; 0 searches them"] = 0,
    obey: Annotated[bool, "the crowd keeps to the pauses of refusals"] = False,
) -> dict[str, Any]:
    """Let the robots of each client use the server, one client after the other."""
    if unknown := set(sdk) - set(SDKS):
        raise UsageError(f"no client named {sorted(unknown)[0]}", hint=f"name some of {', '.join(SDKS)}")
    if not real and (most or obey):
        raise UsageError("--most and --obey need the robots of a real server", hint="add --real")
    if most < 0:
        raise UsageError(f"--most {most} is below 0", hint="name a number of robots, or 0")
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as opened:
        made = opened.enter_context(tempfile.TemporaryDirectory())
        run = run_emulated
        if real:
            compile_generator()
            server, folder = opened.enter_context(serving(2))
            site = ServingSite(port=server.port, path="/ws", workers=2)
            most = most or int(find_capacity(site, folder, "bin", STEP_S)["robots"])
            run = partial(run_real, port=server.port, most=most, obeys=obey)
        programs = {name: None if name == "python" else program_of(name, Path(made)) for name in sdk}
        for number in range(rounds):
            for name, program in programs.items():
                if program is None and name != "python":
                    say(f"{name}: left out, it cannot run here")
                    continue
                rows.append({"round": number, "sdk": name, **run(program)})
                say(f"{name}: {rows[-1]}")
    offered = {name: [row["offered"] for row in rows if row["sdk"] == name] for name in sdk}
    return {
        "offered": {name: statistics.median(each) for name, each in offered.items() if each},
        "most": most,
        "rows": rows,
    }
