"""Goodput of one small server at 0.9, 2 and 5 times its capacity.

    python -m benchmarks server.overload [--seconds 20] [--emulated-cores 0.25]
        [--codec zlib]

Real PnP (200 matches, 30 % wrong), open loop: Poisson send times fixed before the run, latency from the
planned time, a deadline of 250 ms, every frame kept.  Phases 0.9, 2, 0.9, 5, 0.9 in one run, so that a slower
machine slows all of them.  Capacity is measured first, in a closed loop.  Messages are encoded before the
run and sent over plain sockets with a zero mask, so that the generator stays below half a core; its CPU is
printed.

Defends: goodput at 2x >= 95 % and at 5x >= 90 % of that at 0.9x; wasted work <= 5 %; refusals p99 <= 50 ms,
all busy or expired, with retry_after_ms; back to normal <= 2 s after the load; /readyz and /status < 250 ms.
"""

from __future__ import annotations

import asyncio
import base64
import os
import signal
import socket
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import percentile
from benchmarks.server.round_trip import start, status
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Hello, Result, make_codec

PHASES = (0.9, 2.0, 0.9, 5.0, 0.9)
ROBOTS = 40
IDS = 64
DEADLINE_S = 0.25
ANSWER_WINDOW_S = 0.5
REFUSED_PAUSE_S = 0.1
BINARY, TEXT, FIN, MASKED = 2, 1, 0x80, 0x80


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    seconds: Annotated[float, "of each phase"] = 20.0
    capacity_seconds: Annotated[float, "of the closed loop before"] = 6.0
    emulated_cores: Annotated[float, "emulated cores of the server"] = 0.25
    codec: Literal["zlib", "json", "bin"] = "zlib"
    seed: int = 1


def frame(payload: bytes, opcode: int) -> bytes:
    """Return one client frame; the mask is zero, which RFC 6455 cannot forbid."""
    size = len(payload)
    length = bytes([MASKED | size]) if size < 126 else bytes([MASKED | 126]) + size.to_bytes(2, "big")
    return bytes([FIN | opcode]) + length + bytes(4) + payload


class Wire(asyncio.Protocol):
    """One robot: frames out as they are, messages in."""

    def __init__(self, on_message: Any) -> None:
        self._on_message = on_message
        self._data = b""
        self._is_open = False
        self.opened = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: Any) -> None:
        self.transport = transport

    def connection_lost(self, error: Exception | None) -> None:
        if not self.opened.done():
            self.opened.set_exception(ConnectionError("no handshake"))

    def data_received(self, data: bytes) -> None:
        self._data += data
        if not self._is_open:
            head, blank, rest = self._data.partition(b"\r\n\r\n")
            if not blank:
                return
            self._is_open, self._data = True, rest
            self.opened.set_result(head)
        while len(self._data) >= 2:
            size, begin = self._data[1] & 127, 2
            if size == 126:
                size, begin = int.from_bytes(self._data[2:4], "big"), 4
            if len(self._data) < begin + size:
                return
            message, self._data = self._data[begin : begin + size], self._data[begin + size :]
            self._on_message(self, message)


class Generator:
    """All robots and what became of each command: planned, answered (s) and how."""

    def __init__(self, codec_name: str) -> None:
        self.codec = make_codec(codec_name)
        self.codec_name = codec_name
        self.opcode = TEXT if self.codec.is_text else BINARY
        self.wires: list[Wire] = []
        self.waiting: dict[tuple[Wire, int], int] = {}
        self.planned: list[float] = []
        self.sent: list[float] = []
        self.answered: list[float] = []
        self.outcome: list[str] = []
        self.retry_after: list[bool] = []
        self.compute_ms: list[float] = []
        self.on_done: Any = None
        problems = [make_problem(seed=seed, n=200) for seed in range(16)]
        payloads = [
            make_request(p.points_world, p.pixels, p.camera, binary=codec_name == "bin") for p in problems
        ]
        self.frames = [
            frame(
                self.codec.encode(
                    Command(
                        id=n, service="pnp", payload=payloads[n % 16], deadline_ms=DEADLINE_S * 1e3, keep=True
                    )
                ),
                self.opcode,
            )
            for n in range(IDS)
        ]

    async def open(self, port: int) -> None:
        """Connect all robots."""
        for _ in range(ROBOTS):
            _, wire = await asyncio.get_running_loop().create_connection(
                lambda: Wire(self._answer), "127.0.0.1", port
            )
            key = base64.b64encode(os.urandom(16)).decode()
            wire.transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            wire.transport.write(
                "GET /ws HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n"
                f"Sec-WebSocket-Protocol: {SUBPROTOCOLS[self.codec_name]}\r\n\r\n".encode()
            )
            await wire.opened
            wire.transport.write(frame(self.codec.encode(Hello()), self.opcode))
            self.wires.append(wire)

    def send(self, robot: int, number: int, planned: float) -> None:
        """Send one command of *robot*."""
        wire, index = self.wires[robot], len(self.planned)
        self.waiting[wire, number % IDS] = index
        self.planned.append(planned)
        self.sent.append(time.perf_counter())
        self.answered.append(float("nan"))
        self.outcome.append("lost")
        self.retry_after.append(False)
        self.compute_ms.append(0.0)
        wire.transport.write(self.frames[number % IDS])

    def _answer(self, wire: Wire, data: bytes) -> None:
        now = time.perf_counter()
        message = self.codec.decode_from_server(data)
        if not isinstance(message, Result | Failure):
            return
        index = self.waiting.pop((wire, message.id or 0), None)
        if index is None:  # so late that its id went round: it stays counted as lost
            return
        self.answered[index] = now
        if isinstance(message, Result):
            self.outcome[index], self.compute_ms[index] = "ok", message.compute_ms
        else:
            self.outcome[index] = message.code
            self.retry_after[index] = message.retry_after_ms is not None
        if self.on_done is not None:
            self.on_done(wire, index)

    async def capacity(self, seconds: float) -> float:
        """Return answers per second with always a dozen commands at work."""
        loop, end, done, numbers = asyncio.get_running_loop(), time.perf_counter() + seconds, [0], Counter()
        over = loop.create_future()

        def more(wire: Wire, index: int) -> None:
            done[0] += 1
            robot = self.wires.index(wire)
            numbers[robot] += 1
            pause_s = 0.0 if self.outcome[index] == "ok" else REFUSED_PAUSE_S
            if time.perf_counter() + pause_s < end:
                loop.call_later(pause_s, lambda: self.send(robot, numbers[robot], time.perf_counter()))
            elif not over.done():
                over.set_result(None)

        self.on_done = more
        begin = len(self.outcome)
        for robot in range(12):
            self.send(robot, 0, time.perf_counter())
        await over
        self.on_done = None
        await asyncio.sleep(ANSWER_WINDOW_S)
        ok = sum(outcome == "ok" for outcome in self.outcome[begin:])
        return ok / seconds

    async def play(self, plan: list[tuple[float, int, int]]) -> None:
        """Send along *plan*: (time, robot, number), in order of time."""
        for planned, robot, number in plan:
            pause = planned - time.perf_counter()
            if pause > 0:
                await asyncio.sleep(pause)
            self.send(robot, number, planned)
        await asyncio.sleep(2 * ANSWER_WINDOW_S)


def make_plan(begin: float, phases: tuple[float, ...], rate: float, seconds: float, seed: int) -> Any:
    """Return Poisson send times of every phase, shared among the robots."""
    random = np.random.default_rng(seed)
    plan: list[tuple[float, int, int]] = []
    borders = []
    for factor in phases:
        count = random.poisson(factor * rate * seconds)
        times = np.sort(random.uniform(begin, begin + seconds, count))
        plan += [(float(t), (len(plan) + i) % ROBOTS, (len(plan) + i) // ROBOTS) for i, t in enumerate(times)]
        borders.append((begin, begin + seconds))
        begin += seconds
    return plan, borders


async def probe(identity: dict[str, int], waits: dict[str, list[float]]) -> None:
    """Ask /readyz and /status four times a second, as a load balancer and a monitor would."""
    while True:
        for path in waits:
            began = time.perf_counter()
            reader, writer = await asyncio.open_connection("127.0.0.1", identity["control_port"])
            writer.write(f"GET {path} HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n".encode())
            answer = await reader.read()
            writer.close()
            assert answer.startswith(b"HTTP/1.1 200"), answer[:50]
            waits[path].append(time.perf_counter() - began)
        await asyncio.sleep(0.25)  # the pace of the questions, four a second


def judge(generator: Generator, borders: Any, first: int) -> list[dict[str, Any]]:
    """Return the figures of every phase."""
    planned, answered, sent = (
        np.array(times[first:]) for times in (generator.planned, generator.answered, generator.sent)
    )
    outcome = np.array(generator.outcome[first:])
    waits, retry = answered - planned, np.array(generator.retry_after[first:])
    good = (outcome == "ok") & (waits <= DEADLINE_S)
    rows = []
    for (begin, end), factor in zip(borders, PHASES, strict=True):
        inside = (planned >= begin) & (planned < end)
        ok = inside & (outcome == "ok")
        refused = inside & (outcome != "ok")
        answered_refusals = refused & (outcome != "lost")
        rows.append(
            {
                "offered_x": factor,
                "offered": int(inside.sum()),
                "goodput_per_s": round(float((good & inside).sum() / (end - begin)), 1),
                "wasted_percent": round(100 * float((ok & ~good).sum() / max(1, ok.sum())), 2),
                "good_p50_ms": percentile_ms(waits[ok], 50),
                "good_p99_ms": percentile_ms(waits[ok], 99),
                "refused_p50_ms": percentile_ms((answered - sent)[answered_refusals], 50),
                "refused_p99_ms": percentile_ms((answered - sent)[answered_refusals], 99),
                "late_sends_p99_ms": percentile_ms((sent - planned)[inside], 99),
                "outcomes": dict(Counter(outcome[inside].tolist())),
                "busy_without_retry_after": int((inside & (outcome == "busy") & ~retry).sum()),
            }
        )
    share = good[(planned >= borders[0][0]) & (planned < borders[0][1])].mean()
    for n in (2, 4):
        begin, end = borders[n]
        steps = [
            t
            for t in np.arange(begin, end - 0.5, 0.1)
            if good[(planned >= t) & (planned < t + 0.5)].mean() >= share - 0.05
        ]
        rows[n]["recovery_s"] = round(float(steps[0] - begin), 2) if steps else None
    return rows


def percentile_ms(values: Any, percent: float) -> float | None:
    """Return a percentile of seconds in ms, None of nothing."""
    return round(1e3 * float(percentile(values, percent)), 2) if len(values) else None


def judged(report: dict[str, Any]) -> dict[str, float]:
    """Return the figures that have a bar."""
    rows = report["phases"]
    normal = float(np.mean([row["goodput_per_s"] for row in rows if row["offered_x"] < 1]))
    busy = [row for row in rows if row["offered_x"] > 1]
    refused = Counter[str]()
    for row in busy:
        refused.update({code: n for code, n in row["outcomes"].items() if code != "ok"})
    return {
        "goodput_2x_percent": 100 * rows[1]["goodput_per_s"] / normal,
        "goodput_5x_percent": 100 * rows[3]["goodput_per_s"] / normal,
        "wasted_percent": max(row["wasted_percent"] for row in busy),
        "refused_p99_ms": max(row["refused_p99_ms"] or 0.0 for row in busy),
        "untyped_refusals": sum(n for code, n in refused.items() if code not in ("busy", "expired")),
        "busy_without_retry_after": sum(row["busy_without_retry_after"] for row in rows),
        "recovery_s": max(999.0 if rows[n]["recovery_s"] is None else rows[n]["recovery_s"] for n in (2, 4)),
        "control_max_ms": max(report["control_max_ms"].values()),
        "generator_cpu_percent": max(row["generator_cpu_percent"] for row in rows),
    }  # fmt: skip


async def run(args: Options, identity: dict[str, int]) -> dict[str, Any]:
    """Measure capacity, play all phases, return the report."""
    generator = Generator(args.codec)
    await generator.open(identity["port"])
    await generator.capacity(3.0)
    capacity = await generator.capacity(args.capacity_seconds)
    first, begin = len(generator.planned), time.perf_counter() + 0.3
    plan, borders = make_plan(begin, PHASES, capacity, args.seconds, args.seed)
    waits: dict[str, list[float]] = {"/readyz": [], "/status": []}
    probing = asyncio.create_task(probe(identity, waits))
    cpu = [(time.process_time(), await asyncio.to_thread(status, identity))]

    async def note() -> None:
        for _, end in borders:
            await asyncio.sleep(end - time.perf_counter())
            cpu.append((time.process_time(), await asyncio.to_thread(status, identity)))

    noting = asyncio.create_task(note())
    await generator.play(plan)
    await noting
    probing.cancel()
    await asyncio.gather(probing, return_exceptions=True)
    rows = judge(generator, borders, first)
    for row, before, after in zip(rows, cpu[:-1], cpu[1:], strict=True):
        row["generator_cpu_percent"] = round(100 * (after[0] - before[0]) / args.seconds, 1)
        row["server_cpu_percent"] = round(100 * (after[1]["cpu_s"] - before[1]["cpu_s"]) / args.seconds, 1)
        worker = sum(after[1]["worker_cpu_s"]) - sum(before[1]["worker_cpu_s"])
        row["worker_cpu_percent"] = round(100 * worker / args.seconds, 1)
    return {
        "capacity_per_s": round(capacity, 1),
        "phases": rows,
        "control_max_ms": {path: round(1e3 * max(times), 1) for path, times in waits.items()},
    }


@benchmark(
    Bar("judged.goodput_2x_percent", at_least=95, unit="%"),
    Bar("judged.goodput_5x_percent", at_least=90, unit="%"),
    Bar("judged.wasted_percent", at_most=5, unit="%"),
    Bar("judged.refused_p99_ms", at_most=50, unit="ms"),
    Bar("judged.untyped_refusals", equals=0),
    Bar("judged.busy_without_retry_after", equals=0),
    Bar("judged.recovery_s", at_most=2, unit="s"),
    Bar("judged.control_max_ms", at_most=250, unit="ms"),
    Bar("judged.generator_cpu_percent", at_most=50, unit="%"),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Play all phases on one small server."""
    with tempfile.TemporaryDirectory() as folder:
        process, identity = start(
            folder, workers=1, emulated_cores=args.emulated_cores, log_level="warning"
        )  # fmt: skip
        try:
            report = asyncio.run(run(args, identity))
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(10)
    return {**report, "judged": judged(report)}
