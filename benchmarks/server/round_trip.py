"""Round trip and CPU per command through a real server: 1 robot, and 100 robots at 5 frames per second.

    python -m benchmarks server.round_trip [--seconds 4] [--workers 2]

Echo and real PnP (200 matches, 30 % wrong), JSON+zlib and binary.  One robot asks as fast as it is
answered; a hundred send at times that were fixed before the run, and their round trip counts from those.
CPU is that of all processes of the server.  The CPU of the robots, which share the cores, is printed too.
"""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import websockets

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request
from rse_pf.wire import SUBPROTOCOLS, Command, Hello, Result, make_codec

FRAMES_PER_S = 5.0
"""The paper's rate (Sect. 6.2)."""
ROWS = [
    ("echo", "bin", 1),
    ("pnp", "zlib", 1),
    ("pnp", "bin", 1),
    ("echo", "bin", 100),
    ("pnp", "zlib", 100),
    ("pnp", "bin", 100),
]

SERVE = """
import json, sys
from pathlib import Path
from rse_pf.backend.supervisor import serve
from rse_pf.config import PlatformSettings
settings = PlatformSettings.from_dict(json.loads(sys.argv[2]))
sys.exit(serve(settings, keys=None, server_id="bench", announce=Path(sys.argv[1])))
"""


def start(folder: str, **serving: object) -> tuple[subprocess.Popen[bytes], dict[str, int]]:
    """Start a server without tokens on free ports; return it and where it listens."""
    announce = Path(folder) / "announce.json"
    settings = {
        "serving": {"port": 0, "control_port": 0, **serving},
        "auth": {"required": False},
        # A benchmark asks for all that a server can do, from few sockets.
        "session": {"ping_interval_s": 600.0, "hello_timeout_s": 600.0, "max_commands_per_s": 0.0},
    }
    with (Path(folder) / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", SERVE, str(announce), json.dumps(settings)], stdout=log, stderr=log
        )
    deadline = time.monotonic() + 30
    while not announce.exists():
        if time.monotonic() > deadline or process.poll() is not None:
            raise SystemExit("the server did not start")
        time.sleep(0.02)  # looks again, with a deadline
    return process, json.loads(announce.read_text())


def status(identity: dict[str, int]) -> dict[str, float]:
    """Return the server's own numbers."""
    with urllib.request.urlopen(f"http://127.0.0.1:{identity['control_port']}/status") as answer:
        document: dict[str, float] = json.loads(answer.read())
    return document


async def robot(url: str, codec_name: str, messages: list[bytes], times: list[float], plan: Plan) -> int:
    """Send commands along *plan*, append round trips in seconds, return how many failed."""
    codec, failed = make_codec(codec_name), 0
    async with websockets.connect(
        url, subprotocols=[SUBPROTOCOLS[codec_name]], compression=None, ping_interval=None
    ) as socket:  # fmt: skip
        hello = codec.encode(Hello())
        await socket.send(hello.decode() if codec.is_text else hello)
        await socket.recv()
        for number, planned in enumerate(plan):
            await asyncio.sleep(max(0.0, planned - time.perf_counter()))
            began = planned if plan.is_open else time.perf_counter()
            await socket.send(messages[number % len(messages)])
            answer = await socket.recv(decode=False)
            times.append(time.perf_counter() - began)
            failed += not isinstance(codec.decode_from_server(answer), Result)
    return failed


class Plan:
    """When to send: at fixed times (open loop), or at once until the end (closed loop)."""

    def __init__(self, start: float, end: float, every_s: float | None, phase: float = 0.0) -> None:
        self.is_open = every_s is not None
        self._next, self._end, self._every_s = start + phase * (every_s or 0.0), end, every_s

    def __iter__(self) -> Iterator[float]:
        while (time.perf_counter() if self._every_s is None else self._next) < self._end:
            yield self._next
            self._next += self._every_s or 0.0


def commands(service: str, codec_name: str) -> list[bytes]:
    """Return encoded commands of one robot, made beforehand."""
    codec, payloads = make_codec(codec_name), []
    for seed in range(16):
        if service == "echo":
            payloads.append({"value": "x" * 3200})
            continue
        p = make_problem(seed=seed)
        payloads.append(make_request(p.points_world, p.pixels, p.camera, binary=codec_name == "bin"))
    return [
        codec.encode(Command(id=number, service=service, payload=payload, keep=True))
        for number, payload in enumerate(payloads)
    ]


async def measure(
    identity: dict[str, int], service: str, codec: str, robots: int, seconds: float
) -> dict[str, Any]:
    """Return one row."""
    url, times = f"ws://127.0.0.1:{identity['port']}/ws", []
    messages = commands(service, codec)
    every_s = None if robots == 1 else 1.0 / FRAMES_PER_S
    begin = time.perf_counter() + 0.5
    await robot(url, codec, messages, [], Plan(time.perf_counter(), begin - 0.2, None))
    before, own = status(identity), time.process_time()
    plans = [Plan(begin, begin + seconds, every_s, i / robots) for i in range(robots)]
    failed = sum(await asyncio.gather(*(robot(url, codec, messages, times, plan) for plan in plans)))
    after, own = status(identity), time.process_time() - own
    requests = after["requests"] - before["requests"]
    return {
        "service": service, "codec": codec, "robots": robots, "failed": failed,
        "ms": spread(1e3 * time_s for time_s in times),
        "server_cpu_us": round((after["cpu_s"] - before["cpu_s"]) / requests * 1e6),
        "robots_cpu_percent": round(100 * own / seconds),
    }  # fmt: skip


@benchmark(Bar("rows.*.failed", equals=0))
def run_benchmark(
    *,
    seconds: Annotated[float, "length of each row"] = 4.0,
    workers: Annotated[int, "worker processes of the server"] = 2,
) -> dict[str, Any]:
    """Measure every row on one server."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        process, identity = start(folder, workers=workers, log_level="info")
        try:
            for service, codec, robots in ROWS:
                rows.append(asyncio.run(measure(identity, service, codec, robots, seconds)))
                say(rows[-1])
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20)
    return {"rows": rows}
