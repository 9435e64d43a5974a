"""The load generator: `Swarm` runs many robots in child processes and collects their records.

``round_trip_ms`` of a record counts from the time for which the command was *planned*, so that the time in
which the platform or the generator stalled is included.
"""

from __future__ import annotations

import asyncio
import math
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from rse_pf.config import SessionSettings
from rse_pf.errors import CommandFailed
from rse_pf.extensions.experiments.child_process import (
    ChildFailed,
    ChildReady,
    IssuedToken,
    TokenRequest,
    end_process,
    start_process,
)
from rse_pf.extensions.experiments.faults.network_emulator import LinkProcess, profile_named
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.load.swarm_process import (
    FinishSwarm,
    ResultRows,
    RobotsLeave,
    StartSwarm,
    SwarmEnded,
    SwarmEvent,
    SwarmSpec,
    run_swarm_process,
)
from rse_pf.extensions.experiments.results.records import CommandRecord
from rse_pf.wire.rate_limit import REASONS

__all__ = ["Swarm", "SwarmResult", "records_of"]

# Longest wait until all child processes have encoded their payloads, in seconds.
_READY_TIMEOUT_S = 60.0
# Longest wait for the answer of a child process to an order, beyond the time that the order itself takes.
_ORDER_TIMEOUT_S = 30.0
# Time, in seconds, from the order to start to the planned start, so that every child has the order in time.
_START_DELAY_S = 0.2

Event = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmResult:
    """The commands of all robots, and the cost of generating them.

    ``cpu_s`` is the CPU time of all processes of the generator during ``wall_s`` seconds.  ``reconnects``,
    ``resent`` and ``moves`` (migrations to another server) are sums over the robots, ``duplicates`` counts
    answers that arrived twice, and ``held_back`` counts by reason the commands that the SDK did not send at
    once, as `client_sdk.Stats` does.  ``late_sends_ms_p99`` is the 99th percentile of the delay between the
    planned and the real send time, which the generator itself causes.  ``link`` names the profile of the
    emulated network.
    """

    commands: list[CommandRecord]
    cpu_s: float
    wall_s: float
    wrong_poses: int
    reconnects: int
    resent: int
    moves: int
    duplicates: int
    link: str | None
    late_sends_ms_p99: float
    held_back: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class _Child:
    """What the parent knows about a process that runs the robots with these ``numbers``."""

    process: Any
    pipe: Connection
    numbers: tuple[int, ...]
    ready: bool = False
    ended: SwarmEnded | None = None


class Swarm:
    """Robots in child processes: ``async with`` starts the processes, `start` connects the robots."""

    def __init__(
        self,
        scenario: LoadScenario,
        *,
        url: str,
        token_of: Callable[[str], str],
        session: SessionSettings,
        on_event: Callable[[Event], None] | None = None,
        origin: float | None = None,
    ) -> None:
        """Describe the robots; nothing is started.

        Args:
            scenario: Number of robots and what they do.
            url: Address of the platform; an emulated network, if the scenario has one, is put before it.
            token_of: Returns a token for a robot; called in this process whenever a robot connects.
            session: Limits and timeouts of the robots.
            on_event: Called with an event for each robot that joins, leaves, loses its connection or
                migrates; its ``time`` is in seconds since *origin*, as in the records.
            origin: The `time.monotonic` from which all records count; None means the time of `start`.
        """
        self.scenario = scenario
        self.joined: set[str] = set()
        self.left: set[str] = set()
        self.rows: list[ResultRows] = []
        self.link: LinkProcess | None = None
        self._url = url
        self._token_of = token_of
        self._session = session
        self._on_event = on_event
        self._origin_s = origin
        self._start_s = 0.0
        self._staying = list(range(scenario.robots))
        self._children: list[_Child] = []
        self._changed = asyncio.Event()
        self._problem: CommandFailed | None = None

    async def __aenter__(self) -> Swarm:
        """Start the emulated network and the processes; return when every process has encoded its payloads.

        Raises:
            CommandFailed: A process failed, or was not ready within 60 s.
        """
        try:
            await self._launch()
            await self._until(
                lambda: all(child.ready for child in self._children), _READY_TIMEOUT_S, "get ready"
            )
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop every child process and the emulated network."""
        await self._end()

    async def start(self) -> None:
        """Order the robots to connect and send: robot k connects ``k * join_every_s`` seconds from now."""
        self._start_s = time.monotonic() + _START_DELAY_S
        if self._origin_s is None:
            self._origin_s = self._start_s
        for child in self._children:
            child.pipe.send(StartSwarm(self._start_s, self._origin_s))

    async def wait_joined(self, timeout_s: float) -> None:
        """Wait until every robot has sent its first command; raises CommandFailed after *timeout_s*."""
        wanted = self.scenario.robots
        await self._until(lambda: len(self.joined) >= wanted, timeout_s, "join")

    async def wait_answered(self, count: int, timeout_s: float) -> None:
        """Wait until *count* more commands were answered or failed.

        Raises CommandFailed after *timeout_s*.
        """
        wanted = count + sum(map(len, self.rows))
        await self._until(lambda: sum(map(len, self.rows)) >= wanted, timeout_s, f"answer {count} times")

    async def leave(self, n: int | None = None) -> None:
        """Disconnect the *n* robots that joined last, or all if *n* is None.

        Return when they have disconnected.

        Raises:
            CommandFailed: They did not disconnect within 30 s after the deadline of their commands.
        """
        count = len(self._staying) if n is None else min(n, len(self._staying))
        leaving = set(self._staying[len(self._staying) - count :])
        self._staying = [number for number in self._staying if number not in leaving]
        for child in self._children:
            child.pipe.send(RobotsLeave(tuple(sorted(leaving & set(child.numbers)))))
        names = {f"robot-{number + 1}" for number in leaving}
        await self._until(lambda: names <= self.left, self.scenario.deadline_s + _ORDER_TIMEOUT_S, "leave")

    async def finish(self, grace_s: float = 5.0) -> SwarmResult:
        """Stop sending, wait up to *grace_s* seconds for answers, and return the result.

        The child processes exit.  A command without an answer by then counts as lost.

        Raises:
            CommandFailed: A process failed, or did not report its result in time.
        """
        for child in self._children:
            child.pipe.send(FinishSwarm(grace_s))
        await self._until(
            lambda: all(child.ended is not None for child in self._children),
            grace_s + _ORDER_TIMEOUT_S,
            "end",
        )
        wall_s = time.monotonic() - self._start_s
        ended = [child.ended for child in self._children if child.ended is not None]
        totals = sum((end.counts for end in ended), Counter[str]())
        commands = [command for rows in self.rows for command in records_of(rows)]
        late_ms = [1e3 * (command.sent - command.planned) for command in commands]
        return SwarmResult(
            commands=commands,
            cpu_s=round(sum(end.cpu_s for end in ended), 3),
            wall_s=round(wall_s, 3),
            wrong_poses=totals["wrong_poses"],
            reconnects=totals["reconnects"],
            resent=totals["resent"],
            moves=totals["moves"],
            duplicates=totals["duplicates"]
            + len(commands)
            - len({(command.robot, command.id) for command in commands}),
            link=self.scenario.link,
            late_sends_ms_p99=round(float(np.percentile(late_ms, 99)), 3) if late_ms else 0.0,
            held_back={reason: totals[reason] for reason in REASONS},
        )

    async def _launch(self) -> None:
        url = self._url
        if self.scenario.link is not None:
            profile, parts = profile_named(self.scenario.link), urlsplit(url)
            port = parts.port or (443 if parts.scheme == "wss" else 80)
            link = LinkProcess(profile, parts.hostname or "", port, seed=self.scenario.seed)
            self.link = await link.__aenter__()
            url = parts._replace(netloc=f"127.0.0.1:{self.link.port}").geturl()
        count = min(self.scenario.processes, self.scenario.robots)
        loop = asyncio.get_running_loop()
        for share in range(count):
            numbers = tuple(range(share, self.scenario.robots, count))
            spec = SwarmSpec(numbers=numbers, url=url, session=self._session, scenario=self.scenario)
            process, pipe = await asyncio.to_thread(start_process, run_swarm_process, spec, "swarm")
            child = _Child(process, pipe, numbers)
            self._children.append(child)
            loop.add_reader(pipe.fileno(), self._receive, child)

    def _receive(self, child: _Child) -> None:
        try:
            while child.pipe.poll():
                self._handle(child, child.pipe.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(child.pipe.fileno())
            if child.ended is None and self._problem is None:
                self._problem = CommandFailed(
                    "a process of the swarm exited early", hint="check the memory of this machine"
                )
        self._changed.set()

    def _handle(self, child: _Child, message: Any) -> None:
        if isinstance(message, ResultRows):
            self.rows.append(message)
        elif isinstance(message, TokenRequest):
            child.pipe.send(IssuedToken(message.robot, self._token_of(message.robot)))
        elif isinstance(message, SwarmEvent):
            members = {"robot-joined": self.joined, "robot-left": self.left}.get(message.event["event"])
            if members is not None:
                members.add(message.event["robot"])
            if self._on_event is not None:
                self._on_event(message.event)
        elif isinstance(message, ChildReady):
            child.ready = True
        elif isinstance(message, ChildFailed):
            self._problem = message.error("the swarm failed")
        elif isinstance(message, SwarmEnded):
            child.ended = message

    async def _until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        end = time.monotonic() + timeout_s
        while not condition():
            left_s = end - time.monotonic()
            if self._problem is not None:
                raise self._problem
            if left_s <= 0:
                raise CommandFailed(
                    f"the robots did not {what} within {timeout_s:g} s ({len(self.joined)} of "
                    f"{self.scenario.robots} had joined)",
                    hint="check that the platform runs and accepts their tokens",
                )
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), left_s)
            except asyncio.TimeoutError:
                continue

    async def _end(self) -> None:
        loop = asyncio.get_running_loop()
        for child in self._children:
            loop.remove_reader(child.pipe.fileno())
        for child in self._children:
            timeout_s = _START_DELAY_S if child.ended is None else 5.0
            await asyncio.to_thread(end_process, child.process, child.pipe, timeout_s)
        self._children.clear()
        link, self.link = self.link, None
        if link is not None:
            await link.__aexit__(None, None, None)


def records_of(rows: ResultRows) -> Iterator[CommandRecord]:
    """Yield a record for each of *rows*; the code of a command that was never answered is empty."""
    for place, (server, code) in enumerate(zip(rows.servers, rows.codes, strict=True)):
        row: array[float] = rows.numbers[place * ResultRows.WIDTH : (place + 1) * ResultRows.WIDTH]
        number, identity, planned, sent, answered, size, up_ms, queue_ms, compute_ms, down_ms = row
        yield CommandRecord(
            id=int(identity),
            robot=f"robot-{int(number) + 1}",
            planned=round(planned, 6),
            sent=round(sent, 6),
            answered=_round_or_none(answered, 6),
            server=server,
            code=code,
            payload_bytes=int(size),
            round_trip_ms=_round_or_none(1e3 * (answered - planned), 3) if code == "ok" else None,
            up_ms=_round_or_none(up_ms, 3),
            queue_ms=_round_or_none(queue_ms, 3),
            compute_ms=_round_or_none(compute_ms, 3),
            down_ms=_round_or_none(down_ms, 3),
        )


def _round_or_none(value: float, digits: int) -> float | None:
    return None if math.isnan(value) else round(value, digits)
