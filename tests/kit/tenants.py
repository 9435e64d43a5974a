"""Three tenants whose robots have one name: interleaved commands, and what one robot saw of another.

Each sends frames of the same streams (the rival's with far higher sequence numbers), keeps and reads a secret
in a stateful service, names its own and the others' stored objects, and asks for the same long job.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rse_pf.identity import RobotId, object_name
from rse_pf.pnp.problems import make_problem
from rse_pf.services.custom.installed import install
from rse_pf.services.pnp import make_request
from rse_pf.storage.object_store import DirectoryStore, digest_of
from rse_pf.wire import Command, Ping, Pong, Progress, Result
from tests.kit.attacks import AttackTarget, Socket

TENANTS = ("acme", "rival", "third")
NAME = "robot-1"
STREAMS = 4
JOBS = 2
"""Long jobs of each tenant; each starts a process."""
ANSWER_S, PING_S = 60.0, 1.0
FIRST_SEQ = {"acme": 0, "rival": 10**9, "third": 10**6}
KEEPER = """
import msgspec

class Request(msgspec.Struct):
    keep: str = ""

class Reply(msgspec.Struct):
    kept: str

class Service:
    def __init__(self):
        self.kept = ""
    def snapshot(self):
        return self.kept.encode()
    def restore(self, data):
        self.kept = data.decode()
    def serve(self, request: Request) -> Reply:
        self.kept = request.keep or self.kept
        return Reply(kept=self.kept)
"""
GRAPH = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n" + (
    "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
)


def settings_in(folder: Path) -> dict[str, Any]:
    """Return the settings of the server: its store and its services lie in *folder*."""
    return {
        "serving": {"log_level": "debug", "max_handshakes_per_source_per_s": 0.0, "max_accepts_per_s": 0.0},
        "session": {"max_commands_per_s": 0.0},
        "services": {"folder": str(folder / "services"), "accept_weak_isolation": True},
        "data": {"store": f"dir:{folder / 'store'}"},
    }


@dataclass(slots=True)
class Outcome:
    """What three robots saw.  ``shared`` names each case in which one saw something of another."""

    commands: Counter[str] = field(default_factory=Counter)
    """Answered commands of each tenant."""
    codes: Counter[str] = field(default_factory=Counter)
    shared: list[str] = field(default_factory=list)
    stale: int = 0


def secret_of(tenant: str) -> str:
    """Return what the robot of *tenant* keeps."""
    return f"{tenant}-secret"


def object_of(tenant: str) -> bytes:
    """Return what the robot of *tenant* has stored."""
    return f"the object of {tenant}".encode()


def prepare(folder: Path) -> None:
    """Install the stateful service and store one object of each robot."""
    source = folder / "keeper"
    source.mkdir()
    (source / "service.json").write_text(
        json.dumps({"name": "keeper", "language": "python", "entry": "service.py", "kind": "per_robot_state"})
    )
    (source / "service.py").write_text(KEEPER)
    install(source, folder / "services")
    store = DirectoryStore(folder / "store")
    for tenant in TENANTS:
        data = object_of(tenant)
        store.put(object_name(RobotId(tenant, NAME), digest_of(data)), data)


class _Robot:
    """One robot that sends several commands at once."""

    def __init__(self, tenant: str, socket: Socket, outcome: Outcome) -> None:
        self.tenant = tenant
        self._socket = socket
        self._outcome = outcome
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._id = 0
        self._tasks = [asyncio.create_task(self._read()), asyncio.create_task(self._ping())]

    async def ask(self, service: str, payload: Any, **more: Any) -> Any:
        """Return the final answer."""
        self._id += 1
        answer = self._waiting[self._id] = asyncio.get_running_loop().create_future()
        self._socket.say(Command(id=self._id, service=service, payload=payload, **more))
        message = await asyncio.wait_for(answer, ANSWER_S)
        code = "ok" if isinstance(message, Result) else message.code
        self._outcome.commands[self.tenant] += 1
        self._outcome.codes[f"{service} {code}"] += 1
        return message

    def end(self) -> None:
        """Leave."""
        for task in self._tasks:
            task.cancel()
        self._socket.end()

    async def _read(self) -> None:
        while (message := await self._socket.hear()) is not None:
            if not isinstance(message, Progress | Pong):
                self._waiting.pop(message.id).set_result(message)  # type: ignore[attr-defined]
        for answer in self._waiting.values():
            answer.set_exception(ConnectionError(f"closed with {self._socket.closed}"))

    async def _ping(self) -> None:
        """Show that the robot is there while it waits for its jobs."""
        while True:
            self._socket.say(Ping(sent_s=time.monotonic()))
            await asyncio.sleep(PING_S)


async def interleave(url: str, tokens: Mapping[str, str], commands: int, *, jobs: int = JOBS) -> Outcome:
    """Send *commands* in all from the robots of all tenants at once, and return what came back."""
    outcome = Outcome()
    target = AttackTarget(url)
    robots = [_Robot(tenant, await target.enter(tokens[tenant], "bin"), outcome) for tenant in TENANTS]
    problem = make_problem(seed=1)
    frame = make_request(problem.points_world, problem.pixels, problem.camera, binary=True)
    rounds = commands // (len(TENANTS) * STREAMS * 8)
    try:
        await asyncio.gather(
            *(
                _stream(robot, stream, frame, rounds, outcome)
                for robot in robots
                for stream in range(STREAMS)
            ),
            *(_jobs(robot, jobs) for robot in robots),
        )
    finally:
        for robot in robots:
            robot.end()
    return outcome


async def _stream(robot: _Robot, stream: int, frame: Any, rounds: int, outcome: Outcome) -> None:
    """Each round: five frames one after the other, a secret kept and read, one object."""
    seq, tenant = FIRST_SEQ[robot.tenant], robot.tenant
    secret = secret_of(tenant)
    for number in range(rounds):
        for _ in range(5):
            seq += 1
            answer = await robot.ask("pnp", frame, stream=f"camera-{stream}", seq=seq)
            outcome.stale += getattr(answer, "code", "") == "stale"
        for keep in (secret, ""):
            answer = await robot.ask("keeper", {"keep": keep}, keep=True, deadline_ms=ANSWER_S * 1e3)
            if isinstance(answer, Result) and answer.reply["kept"] != secret:
                outcome.shared.append(f"{tenant} read {answer.reply['kept']!r}")
        owner = TENANTS[number % len(TENANTS)]
        await _name_object(robot, owner, outcome)


async def _name_object(robot: _Robot, owner: str, outcome: Outcome) -> None:
    """Name the object of *owner* in a command; only its own robot may reach it."""
    reference = {"object": digest_of(object_of(owner))}
    view = {"camera": {"fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0}, "pixels": [], "descriptors": b""}
    answer = await robot.ask("place", {"map": reference, **view}, keep=True, deadline_ms=ANSWER_S * 1e3)
    is_missing = getattr(answer, "code", "") == "not-found"
    if is_missing == (owner == robot.tenant):
        outcome.shared.append(f"{robot.tenant} named an object of {owner}: {answer}")


async def _jobs(robot: _Robot, jobs: int) -> None:
    for number in range(jobs):
        await robot.ask("optimise", {"g2o": GRAPH, "options": {"max_iterations": 10 + number}})


def count_logged(log: str) -> Counter[str]:
    """Return how many commands the log of a server has of each tenant; "" counts lines that name none."""
    counts: Counter[str] = Counter()
    for line in log.splitlines():
        entry = json.loads(line) if line.startswith("{") else {}
        if entry.get("event") == "command":
            counts[entry.get("tenant", "")] += 1
    return counts


def owners(store: Path, area: str) -> list[str]:
    """Return the folders ``TENANT/ROBOT`` below an area of the store: states, jobs or objects."""
    return sorted(str(path.relative_to(store / area)) for path in (store / area).glob("*/*"))
