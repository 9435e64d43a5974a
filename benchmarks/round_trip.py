"""Measure what the platform itself costs: echo through a real server, CPU of its whole process tree.

    python benchmarks/round_trip.py [--robots 8] [--seconds 2] [--codec bin] [--bytes 3200] [--workers 1]

Prints machine, n, p50/p95/p99 of the round trip (closed loop, so the client's own Python is in it),
and CPU microseconds a request of the server (supervisor and workers).  Defends: <= 120 us CPU a
request of 3.2 kB with `bin`, which is a third of one solve.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import websockets

from rse_pf.wire import CODECS, SUBPROTOCOLS, Command, Hello, make_codec

SERVE = """
import json, sys
from pathlib import Path
from rse_pf.backend import serve
from rse_pf.settings import PlatformSettings
settings = PlatformSettings.from_dict(json.loads(sys.argv[2]))
sys.exit(serve(settings, keys=None, server_id="bench", announce=Path(sys.argv[1])))
"""


def start(folder: str, **serving: object) -> tuple[subprocess.Popen[bytes], dict[str, int]]:
    """Start a server without tokens on free ports; return it and where it listens."""
    announce = Path(folder) / "announce.json"
    settings = {
        "serving": {"port": 0, "control_port": 0, **serving},
        "auth": {"required": False},
        "session": {"ping_interval_s": 600.0, "hello_timeout_s": 600.0},
    }
    process = subprocess.Popen([sys.executable, "-c", SERVE, str(announce), json.dumps(settings)])
    deadline = time.monotonic() + 30
    while not announce.exists():
        if time.monotonic() > deadline or process.poll() is not None:
            raise SystemExit("the server did not start")
        time.sleep(0.02)
    return process, json.loads(announce.read_text())


def status(identity: dict[str, int]) -> dict[str, float]:
    """Return the server's own numbers."""
    with urllib.request.urlopen(f"http://127.0.0.1:{identity['control_port']}/status") as answer:
        found: dict[str, float] = json.loads(answer.read())
    return found


async def robot(url: str, codec_name: str, value: str, until: float, times: list[float]) -> None:
    codec = make_codec(codec_name)

    async def send(message: Hello | Command) -> None:
        data = codec.encode(message)
        await socket.send(data.decode() if codec.is_text else data)
        await socket.recv()

    async with websockets.connect(
        url, subprotocols=[SUBPROTOCOLS[codec_name]], compression=None, ping_interval=None
    ) as socket:  # fmt: skip
        await send(Hello())
        identity = 0
        while (began := time.perf_counter()) < until:
            identity += 1
            await send(Command(id=identity, service="echo", payload={"value": value}, keep=True))
            times.append(time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--codec", choices=CODECS, default="bin")
    parser.add_argument("--bytes", type=int, default=3200)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--log-level", default="info")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        process, identity = start(folder, workers=options.workers, log_level=options.log_level)
        try:
            asyncio.run(drive(identity, options))
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20)


async def drive(identity: dict[str, int], options: argparse.Namespace) -> None:
    url, value, times = f"ws://127.0.0.1:{identity['port']}/ws", "x" * options.bytes, []
    load = os.getloadavg()[0]
    await robot(url, options.codec, value, time.perf_counter() + 0.3, [])
    before = status(identity)
    until = time.perf_counter() + options.seconds
    await asyncio.gather(*(robot(url, options.codec, value, until, times) for _ in range(options.robots)))
    after = status(identity)
    times.sort()
    n = len(times)
    requests = after["requests"] - before["requests"]
    p50, p95, p99 = (times[int(q * n)] * 1e3 for q in (0.5, 0.95, 0.99))
    print(f"machine {platform.machine()}, {os.cpu_count()} cores, load before {load:.1f}")
    print(f"command {' '.join(sys.argv)}")
    print(f"n {n}, {n / options.seconds:.0f}/s, round trip p50 {p50:.2f} p95 {p95:.2f} p99 {p99:.2f} ms")
    print(f"server CPU {(after['cpu_s'] - before['cpu_s']) / requests * 1e6:.0f} us a request, whole tree")


if __name__ == "__main__":
    main()
