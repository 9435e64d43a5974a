"""Many robots in one process: the real SDK, encoded payloads, and send times that are fixed before the run.

The load is open: a late answer delays no command, and every latency counts from the planned time, so that all
commands that were planned during a stall include it.  Every pose is compared with the true one.
"""

from __future__ import annotations

import asyncio
import functools
import gc
import itertools
import math
import random
import time
from array import array
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from rse_pf.config import SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.experiments.child_process import ChildFailed, ChildReady, IssuedToken, TokenRequest
from rse_pf.geometry import Array
from rse_pf.wire import Result, make_codec
from rse_pf.wire.client_session import Answered
from rse_pf.wire.preencoded import PreencodedCommand, preencode

__all__ = [
    "FinishOrder", "LeaveOrder", "ResultRows", "RobotJoined", "SolvedPayload", "StartOrder", "SwarmEnded",
    "SwarmEvent", "SwarmSpec", "is_right", "make_payloads", "planned_s", "run_swarm_process",
]  # fmt: skip

_POOL = 64
_ROWS = 256
_FLUSH_EVERY_S = 0.5
_PHASE = (math.sqrt(5.0) - 1.0) / 2.0
_POSE_M, _POSE_RAD = 0.05, math.radians(1.0)
"""A pose with a larger error is wrong; with 200 matches the error is one or two centimetres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmSpec:
    """The robots of a process and what they do; ``numbers`` are its robots among all ``robots``."""

    numbers: tuple[int, ...]
    robots: int
    prefix: str
    url: str
    service: str
    codec: str
    fps: float
    matches: int
    outliers: float
    seed: int
    join_every_s: float
    deadline_s: float
    keep: bool
    session: SessionSettings


@dataclass(frozen=True, slots=True)
class StartOrder:
    """From the parent: robot k connects at ``start_s + k * join_every_s``; ``origin_s`` is 0 in records."""

    start_s: float
    origin_s: float


@dataclass(frozen=True, slots=True)
class LeaveOrder:
    """From the parent: these robots stop sending, wait for their answers and disconnect."""

    numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class FinishOrder:
    """From the parent: all robots stop sending, wait up to ``grace_s`` for answers, and the process ends."""

    grace_s: float


@dataclass(frozen=True, slots=True)
class RobotJoined:
    """From the process: a robot is connected and has sent its first command."""

    robot: str


@dataclass(frozen=True, slots=True)
class SwarmEvent:
    """From the process: an event of the run; ``time`` as in the records."""

    event: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmEnded:
    """From the process: its robots have ended; ``duplicates`` counts answers that were delivered twice."""

    cpu_s: float
    wrong_poses: int
    reconnects: int
    resent: int
    moves: int
    duplicates: int


@dataclass(slots=True)
class ResultRows:
    """Commands that have ended, as columns, which are small in memory and on the pipe; NaN stands for none.

    Columns of ``numbers``, row after row: robot, id, planned, sent, answered, bytes, up, queue, compute
    and down; seconds from the origin, then milliseconds.
    """

    numbers: array[float] = field(default_factory=lambda: array("d"))
    servers: list[str] = field(default_factory=list)
    codes: list[str] = field(default_factory=list)

    WIDTH = 10

    def __len__(self) -> int:
        return len(self.codes)


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedPayload:
    """An encoded payload and the true answer: a pose, or the numbers of an echo."""

    payload: PreencodedCommand
    T_camera_world: Array | None = None
    echo: list[float] | None = None


def make_payloads(spec: SwarmSpec) -> list[SolvedPayload]:
    """Return a pool of seeded problems with known answers, encoded for the codec of *spec*."""
    from rse_pf.pnp.problems import make_problem
    from rse_pf.services.pnp import make_request

    codec = make_codec(spec.codec, spec.session)
    if spec.service == "echo":
        numbers = np.random.default_rng(spec.seed).integers(0, 1000, (_POOL, max(1, spec.matches)))
        return [SolvedPayload(payload=preencode(codec, {"value": row}), echo=row) for row in numbers.tolist()]
    pool = []
    for number in range(_POOL):
        problem = make_problem(seed=spec.seed + number, n=spec.matches, outlier_ratio=spec.outliers)
        request = make_request(
            problem.points_world, problem.pixels, problem.camera, binary=spec.codec == "bin"
        )
        pool.append(SolvedPayload(payload=preencode(codec, request), T_camera_world=problem.T_camera_world))
    return pool


def is_right(problem: SolvedPayload, reply: Any) -> bool:
    """Return whether a reply agrees with the truth: 5 cm and 1 degree for a pose."""
    try:
        if problem.T_camera_world is None:
            return bool(reply["value"] == problem.echo)
        T = np.asarray(reply["T_camera_world"], dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        return False
    truth = problem.T_camera_world
    centres = T[:3, :3].T @ T[:3, 3] - truth[:3, :3].T @ truth[:3, 3]
    cosine = (float(np.vdot(T[:3, :3], truth[:3, :3])) - 1.0) / 2.0
    return float(centres @ centres) <= _POSE_M**2 and cosine >= math.cos(_POSE_RAD)


def planned_s(spec: SwarmSpec, number: int, start_s: float, frame: int) -> float:
    """Return when robot *number* sends *frame*: fixed before the run, spread evenly over the robots."""
    phase = (number * _PHASE) % 1.0
    return start_s + number * spec.join_every_s + (frame + phase) / spec.fps


def run_swarm_process(spec: SwarmSpec, pipe: Connection) -> None:
    """Run the robots of *spec* until the parent ends them; the entry point of the process."""
    try:
        asyncio.run(_Process(spec, pipe).run())
    except RsePfError as error:
        _send(pipe, ChildFailed(error.report()))
    except KeyboardInterrupt:
        pass
    finally:
        pipe.close()


def _send(pipe: Connection, message: Any) -> None:
    try:
        pipe.send(message)
    except OSError:
        return  # the parent has ended, and this process ends soon


class _Process:
    """All robots of a process, and the rows of their commands."""

    def __init__(self, spec: SwarmSpec, pipe: Connection) -> None:
        self.spec = spec
        self.origin_s = 0.0
        self.wrong_poses = 0
        self.pool: list[SolvedPayload] = []
        self.rows = ResultRows()
        self._pipe = pipe
        self._robots = {number: _Robot(self, number) for number in spec.numbers}
        self._tokens: dict[str, asyncio.Future[str]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._over = asyncio.Event()
        self._grace_s: float | None = None
        self._cpu_s = 0.0

    async def run(self) -> None:
        """Encode the payloads, follow the orders of the parent, and report the end."""
        self.pool = await asyncio.to_thread(make_payloads, self.spec)
        gc.collect()
        gc.freeze()
        loop = asyncio.get_running_loop()
        loop.add_reader(self._pipe.fileno(), self._receive)
        self.send(ChildReady())
        flushing = asyncio.create_task(self._flush_often())
        await self._over.wait()
        if self._grace_s is not None:
            await asyncio.gather(*(robot.stop(self._grace_s) for robot in self._robots.values()))
            cpu_s = time.process_time() - self._cpu_s
            await asyncio.gather(*(robot.close() for robot in self._robots.values()))
            self._flush()
            self.send(self._ended(cpu_s))
        flushing.cancel()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(flushing, *self._tasks, return_exceptions=True)
        loop.remove_reader(self._pipe.fileno())

    def send(self, message: Any) -> None:
        """Send a message to the parent."""
        _send(self._pipe, message)

    def report(self, event: str, **details: Any) -> None:
        """Report an event, with its time."""
        now_s = round(time.monotonic() - self.origin_s, 4)
        self.send(SwarmEvent({"event": event, "time": now_s, **details}))

    async def token(self, robot: str) -> str:
        """Return a fresh token from the parent."""
        future = self._tokens.get(robot)
        if future is None or future.done():
            future = self._tokens[robot] = asyncio.get_running_loop().create_future()
            self.send(TokenRequest(robot))
        return await future

    def spawn(self, work: Any) -> None:
        """Run *work* until it ends or the process does."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def write(self, row: tuple[float, ...], server: str, code: str) -> None:
        """Add the row of a command that has ended."""
        self.rows.numbers.extend(row)
        self.rows.servers.append(server)
        self.rows.codes.append(code)
        if len(self.rows) >= _ROWS:
            self._flush()

    def _receive(self) -> None:
        try:
            while self._pipe.poll():
                self._follow(self._pipe.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(self._pipe.fileno())
            self._over.set()

    def _follow(self, order: Any) -> None:
        if isinstance(order, StartOrder):
            self.origin_s = order.origin_s
            self._cpu_s = time.process_time()
            for robot in self._robots.values():
                self.spawn(robot.join(order.start_s))
        elif isinstance(order, LeaveOrder):
            for number in order.numbers:
                self.spawn(self._robots[number].leave())
        elif isinstance(order, IssuedToken):
            future = self._tokens.pop(order.robot, None)
            if future is not None and not future.done():
                future.set_result(order.token)
        elif isinstance(order, FinishOrder):
            self._grace_s = order.grace_s
            self._over.set()

    async def _flush_often(self) -> None:
        while True:
            await asyncio.sleep(_FLUSH_EVERY_S)
            self._flush()

    def _flush(self) -> None:
        if len(self.rows):
            self.send(self.rows)
            self.rows = ResultRows()

    def _ended(self, cpu_s: float) -> SwarmEnded:
        stats = [robot.client.stats for robot in self._robots.values() if robot.client is not None]
        return SwarmEnded(
            cpu_s=cpu_s,
            wrong_poses=self.wrong_poses,
            reconnects=sum(each.reconnects for each in stats),
            resent=sum(each.resent for each in stats),
            moves=sum(each.moves for each in stats),
            duplicates=sum(each.duplicates for each in stats),
        )


class _Robot:
    """One robot: it connects, sends each command at its time, and disconnects."""

    def __init__(self, process: _Process, number: int) -> None:
        self.client: Any = None
        self.name = f"{process.spec.prefix}-{number + 1}"
        self._process = process
        self._number = number
        self._waiting: dict[int, tuple[float, float]] = {}
        self._idle = asyncio.Event()
        self._next: asyncio.TimerHandle | None = None
        self._stopping = False
        self._has_joined = False
        self._ids = itertools.count(1)

    async def join(self, start_s: float) -> None:
        """Connect at the time of this robot, retry until that works, and begin to send."""
        from client_sdk import connect

        process, spec = self._process, self._process.spec
        await asyncio.sleep(max(0.0, start_s + self._number * spec.join_every_s - time.monotonic()))
        jitter = random.Random(f"{spec.seed}/{self.name}")
        while not self._stopping:
            self.client = connect(
                spec.url, token=self._token, codec=spec.codec, settings=spec.session,
                on_change=self._changed, random=jitter,
            )  # fmt: skip
            try:
                await self.client
                break
            except RsePfError as error:
                process.report("join-failed", robot=self.name, code=error.code, why=error.message)
                await asyncio.sleep(spec.session.reconnect_max_s)
        first = planned_s(spec, self._number, start_s, 0)
        missed = max(0, math.ceil((time.monotonic() - first) * spec.fps))
        if self._stopping:
            await self.close()
        else:
            self._plan(start_s, missed)

    async def stop(self, grace_s: float) -> None:
        """Stop sending, and wait for the answers to what was sent."""
        self._stopping = True
        if self._next is not None:
            self._next.cancel()
        if self._waiting:
            self._idle.clear()
            waiting = asyncio.ensure_future(self._idle.wait())
            await asyncio.wait({waiting}, timeout=grace_s)
            waiting.cancel()
        for identity, (planned, sent) in self._waiting.items():
            self._write(identity, planned, sent, None, math.nan)
        self._waiting.clear()

    async def leave(self) -> None:
        """Stop, then disconnect."""
        await self.stop(self._process.spec.deadline_s)
        await self.close()
        self._process.report("robot-left", robot=self.name)

    async def close(self) -> None:
        """Disconnect."""
        if self.client is not None:
            await self.client.close()

    def _plan(self, start_s: float, frame: int) -> None:
        planned = planned_s(self._process.spec, self._number, start_s, frame)
        loop = asyncio.get_running_loop()
        self._next = loop.call_at(planned, self._send, start_s, frame, planned)

    def _send(self, start_s: float, frame: int, planned: float) -> None:
        self._plan(start_s, frame + 1)
        process, spec = self._process, self._process.spec
        problem = process.pool[(frame + 7 * self._number) % len(process.pool)]
        identity = next(self._ids)
        sent = time.monotonic()
        try:
            self.client.post(
                spec.service, problem.payload, functools.partial(self._answered, identity, problem),
                deadline_s=max(0.0, spec.deadline_s - (sent - planned)), stream="pose", keep=spec.keep,
            )  # fmt: skip
        except RsePfError as error:
            row = (identity, planned, sent, sent)
            process.write(self._row(*row), "", error.code)
            return
        self._waiting[identity] = (planned, sent)
        if not self._has_joined:
            self._has_joined = True
            process.send(RobotJoined(self.name))
            process.report("robot-joined", robot=self.name, server=self.client.stats.server)

    def _answered(self, identity: int, problem: SolvedPayload, event: Answered) -> None:
        times = self._waiting.pop(identity, None)
        if times is None:
            return  # the robot has left, and the command counts as lost
        self._write(identity, *times, event, time.monotonic())
        if isinstance(event.answer, Result) and not is_right(problem, event.answer.reply):
            self._process.wrong_poses += 1
        if not self._waiting:
            self._idle.set()

    def _write(
        self, identity: int, planned: float, sent: float, event: Answered | None, now_s: float
    ) -> None:
        if event is None:
            self._process.write(self._row(identity, planned, sent, now_s), "", "")
            return
        answer = event.answer
        if not isinstance(answer, Result):
            row = self._row(identity, planned, sent, now_s, event.wire_bytes)
            self._process.write(row, answer.server, answer.code)
            return
        up_ms, down_ms = (math.nan if s is None else s * 1e3 for s in (event.up_s, event.down_s))
        row = self._row(
            identity, planned, sent, now_s, event.wire_bytes, up_ms, answer.queue_ms, answer.compute_ms,
            down_ms,
        )  # fmt: skip
        self._process.write(row, answer.server, "ok")

    def _row(
        self,
        identity: int,
        planned: float,
        sent: float,
        answered: float,
        wire_bytes: int = 0,
        up_ms: float = math.nan,
        queue_ms: float = math.nan,
        compute_ms: float = math.nan,
        down_ms: float = math.nan,
    ) -> tuple[float, ...]:
        zero = self._process.origin_s
        return (
            self._number, identity, planned - zero, sent - zero, answered - zero, wire_bytes, up_ms, queue_ms,
            compute_ms, down_ms,
        )  # fmt: skip

    async def _token(self) -> str:
        return await self._process.token(self.name)

    def _changed(self, what: str, why: str) -> None:
        details = {"reason": why} if what == "link-lost" else {"server": why}
        self._process.report(what, robot=self.name, **details)
