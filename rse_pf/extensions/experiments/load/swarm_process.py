"""Many robots in one process: they use the real SDK, and send encoded payloads at times fixed before the run.

The load is open: a late answer delays no later command.  Every latency counts from the planned send time, so
that the commands which were planned while the platform stalled include the time of the stall.  Every reply is
compared with the correct one.
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
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from rse_pf.config import SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.experiments.child_process import ChildFailed, ChildReady, IssuedToken, TokenRequest
from rse_pf.extensions.experiments.load.payloads import SolvedPayload, is_right, make_payloads
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.wire import Result
from rse_pf.wire.client_session import Answered

__all__ = [
    "FinishSwarm",
    "ResultRows",
    "RobotsLeave",
    "StartSwarm",
    "SwarmEnded",
    "SwarmEvent",
    "SwarmSpec",
    "plan_s",
    "run_swarm_process",
]  # fmt: skip

# Up, queue, compute and down time (ms) in the row of a command without a result: they are not known.
_UNKNOWN_PARTS = (math.nan,) * 4
# Largest number of rows of commands that are sent to the parent in one message.
_MAX_ROWS_OF_MESSAGE = 256
# Longest time, in seconds, that rows of commands wait before they are sent to the parent.
_FLUSH_EVERY_S = 0.5
# Pause before a robot whose first connection failed connects again, in seconds.
_REJOIN_S = 1.0
# Golden ratio: multiples of it, modulo 1, spread the send times of any number of robots evenly over a frame
# interval.
_GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmSpec:
    """The part of a load that one process generates: the robots with these ``numbers`` of ``scenario``."""

    numbers: tuple[int, ...]
    url: str
    session: SessionSettings
    scenario: LoadScenario


@dataclass(frozen=True, slots=True)
class StartSwarm:
    """Order of the parent: robot k connects at ``start_s + k * join_every_s``.

    Both times are of `time.monotonic`; times in records count from ``origin_s``.
    """

    start_s: float
    origin_s: float


@dataclass(frozen=True, slots=True)
class RobotsLeave:
    """Order of the parent: the robots with these numbers stop sending, wait for answers and disconnect."""

    numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class FinishSwarm:
    """Order of the parent: all robots wait up to ``grace_s`` s for open answers, and the process exits."""

    grace_s: float


@dataclass(frozen=True, slots=True)
class SwarmEvent:
    """Message to the parent: an event of a robot, with its ``time`` in seconds since the records' origin."""

    event: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmEnded:
    """Last message of a process to the parent, after its robots have disconnected.

    ``cpu_s`` is the CPU time of the process since the start of the load.  ``counts`` are the sums over its
    robots of the counts of `SwarmResult`, by their names, and of the commands held back, by the reasons.
    """

    cpu_s: float
    counts: Counter[str]


@dataclass(slots=True)
class ResultRows:
    """Commands that were answered, failed or were lost, in a form that is small in memory and on the pipe.

    ``numbers`` holds `WIDTH` values for each command, one command after the other: robot, id; planned, sent
    and answered time (s since the origin); payload bytes; up, queue, compute and down time (ms).  NaN stands
    for a time that is not known.  ``servers`` and ``codes`` have an entry for each command.
    """

    numbers: array[float] = field(default_factory=lambda: array("d"))
    servers: list[str] = field(default_factory=list)
    codes: list[str] = field(default_factory=list)

    WIDTH = 10

    def __len__(self) -> int:
        return len(self.codes)


def plan_s(scenario: LoadScenario, number: int, start_s: float, frame: int) -> float:
    """Return the time (s, `time.monotonic`) for which command *frame* (from 0) of robot *number* is planned.

    Robots have different phases within the frame interval, so that they do not send at the same moment.
    """
    phase = (number * _GOLDEN_RATIO) % 1.0
    return start_s + number * scenario.join_every_s + (frame + phase) / scenario.fps


def run_swarm_process(spec: SwarmSpec, pipe: Connection) -> None:
    """Run the robots of *spec* until the parent orders the end or closes *pipe*; entry point of the process.

    An `RsePfError` is sent to the parent as `ChildFailed`.
    """
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
        return  # the parent has exited, and this process will exit soon


class _Process:
    """All robots of a process, the rows of their commands, and the messages to and from the parent."""

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
        """Encode the payloads, send `ChildReady`, follow the parent's orders, and send `SwarmEnded`."""
        self.pool = await asyncio.to_thread(make_payloads, self.spec.scenario, self.spec.session)
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
            self.send(self._report_end(cpu_s))
        flushing.cancel()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(flushing, *self._tasks, return_exceptions=True)
        loop.remove_reader(self._pipe.fileno())

    def send(self, message: Any) -> None:
        """Send a message to the parent."""
        _send(self._pipe, message)

    def report(self, event: str, **details: Any) -> None:
        """Send the parent an *event* that happens now, with *details*."""
        now_s = round(time.monotonic() - self.origin_s, 4)
        self.send(SwarmEvent({"event": event, "time": now_s, **details}))

    async def token(self, robot: str) -> str:
        """Request a new token for *robot* from the parent and return it.

        Concurrent calls share one request.
        """
        future = self._tokens.get(robot)
        if future is None or future.done():
            future = self._tokens[robot] = asyncio.get_running_loop().create_future()
            self.send(TokenRequest(robot))
        return await future

    def spawn(self, work: Any) -> None:
        """Run the coroutine *work* as a task, which is cancelled when the process finishes."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def write(self, row: tuple[float, ...], server: str, code: str) -> None:
        """Add the row of an answered, failed or lost command; send all rows once there are 256."""
        self.rows.numbers.extend(row)
        self.rows.servers.append(server)
        self.rows.codes.append(code)
        if len(self.rows) >= _MAX_ROWS_OF_MESSAGE:
            self._flush()

    def _receive(self) -> None:
        try:
            while self._pipe.poll():
                self._follow(self._pipe.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(self._pipe.fileno())
            self._over.set()

    def _follow(self, order: Any) -> None:
        if isinstance(order, StartSwarm):
            self.origin_s = order.origin_s
            self._cpu_s = time.process_time()
            for robot in self._robots.values():
                self.spawn(robot.join(order.start_s))
        elif isinstance(order, RobotsLeave):
            for number in order.numbers:
                self.spawn(self._robots[number].leave())
        elif isinstance(order, IssuedToken):
            future = self._tokens.pop(order.robot, None)
            if future is not None and not future.done():
                future.set_result(order.token)
        elif isinstance(order, FinishSwarm):
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

    def _report_end(self, cpu_s: float) -> SwarmEnded:
        counts = Counter(wrong_poses=self.wrong_poses)
        for robot in self._robots.values():
            if robot.client is not None:
                names = ("reconnects", "resent", "moves", "duplicates")
                stats = robot.client.stats
                counts.update({name: getattr(stats, name) for name in names})
                counts.update(stats.held_back)
        return SwarmEnded(cpu_s=cpu_s, counts=counts)


class _Robot:
    """One robot: it connects, sends each command at its time, and disconnects."""

    def __init__(self, process: _Process, number: int) -> None:
        self.client: Any = None
        self.name = f"robot-{number + 1}"
        self._process = process
        self._number = number
        self._waiting: dict[int, tuple[float, float]] = {}
        self._idle = asyncio.Event()
        self._next: asyncio.TimerHandle | None = None
        self._stopping = False
        self._has_joined = False
        self._ids = itertools.count(1)

    async def join(self, start_s: float) -> None:
        """Connect at the planned time of this robot, retry every second until connected, and begin to send.

        Frames that were planned before the robot was connected are skipped.
        """
        from client_sdk import connect

        process, spec, scenario = self._process, self._process.spec, self._process.spec.scenario
        await asyncio.sleep(max(0.0, start_s + self._number * scenario.join_every_s - time.monotonic()))
        jitter = random.Random(f"{scenario.seed}/{self.name}")
        while not self._stopping:
            self.client = connect(
                spec.url, token=self._token, codec=scenario.codec, settings=spec.session,
                on_change=self._take_change, random=jitter,
            )  # fmt: skip
            try:
                await self.client
                break
            except RsePfError as error:
                process.report("join-failed", robot=self.name, code=error.code, why=error.message)
                await asyncio.sleep(_REJOIN_S)
        first = plan_s(scenario, self._number, start_s, 0)
        missed = max(0, math.ceil((time.monotonic() - first) * scenario.fps))
        if self._stopping:
            await self.close()
        else:
            self._plan(start_s, missed)

    async def stop(self, grace_s: float) -> None:
        """Stop sending, wait up to *grace_s* seconds for answers, and write open commands as lost."""
        self._stopping = True
        if self._next is not None:
            self._next.cancel()
        if self._waiting:
            self._idle.clear()
            waiting = asyncio.ensure_future(self._idle.wait())
            await asyncio.wait({waiting}, timeout=grace_s)
            waiting.cancel()
        for identity, times in self._waiting.items():
            self._write(identity, (*times, math.nan), "", "")
        self._waiting.clear()

    async def leave(self) -> None:
        """Stop sending, wait for open answers until their deadline, disconnect, and report ``robot-left``."""
        await self.stop(self._process.spec.scenario.deadline_s)
        await self.close()
        self._process.report("robot-left", robot=self.name)

    async def close(self) -> None:
        """Close the connection, if there is one."""
        if self.client is not None:
            await self.client.close()

    def _plan(self, start_s: float, frame: int) -> None:
        planned = plan_s(self._process.spec.scenario, self._number, start_s, frame)
        loop = asyncio.get_running_loop()
        self._next = loop.call_at(planned, self._send, start_s, frame, planned)

    def _send(self, start_s: float, frame: int, planned: float) -> None:
        self._plan(start_s, frame + 1)
        process, scenario = self._process, self._process.spec.scenario
        problem = process.pool[(frame + 7 * self._number) % len(process.pool)]
        identity = next(self._ids)
        sent = time.monotonic()
        try:
            self.client.post(
                scenario.service, problem.payload, functools.partial(self._take_answer, identity, problem),
                deadline_s=max(0.0, scenario.deadline_s - (sent - planned)), stream="pose",
                keep=scenario.keep,
            )  # fmt: skip
        except RsePfError as error:
            self._write(identity, (planned, sent, sent), "", error.code)
            return
        self._waiting[identity] = (planned, sent)
        if not self._has_joined:
            self._has_joined = True
            process.report("robot-joined", robot=self.name, server=self.client.stats.server)

    def _take_answer(self, identity: int, problem: SolvedPayload, event: Answered) -> None:
        times = self._waiting.pop(identity, None)
        if times is None:
            return  # the robot has left, and the command counts as lost
        answer, parts_ms, code = event.answer, _UNKNOWN_PARTS, "ok"
        if isinstance(answer, Result):
            up_ms, down_ms = (math.nan if s is None else s * 1e3 for s in (event.up_s, event.down_s))
            parts_ms = (up_ms, answer.queue_ms, answer.compute_ms, down_ms)
            self._process.wrong_poses += not is_right(problem, answer.reply)
        else:
            code = answer.code
        self._write(identity, (*times, time.monotonic()), answer.server, code, event.wire_bytes, parts_ms)
        if not self._waiting:
            self._idle.set()

    def _write(
        self,
        identity: int,
        times: tuple[float, float, float],
        server: str,
        code: str,
        wire_bytes: int = 0,
        parts_ms: tuple[float, ...] = _UNKNOWN_PARTS,
    ) -> None:
        seconds = (time_s - self._process.origin_s for time_s in times)
        self._process.write((self._number, identity, *seconds, wire_bytes, *parts_ms), server, code)

    async def _token(self) -> str:
        return await self._process.token(self.name)

    def _take_change(self, what: str, why: str) -> None:
        details = {"reason": why} if what == "link-lost" else {"server": why}
        self._process.report(what, robot=self.name, **details)
