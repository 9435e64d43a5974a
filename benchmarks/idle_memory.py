"""Measure the cost of an idle robot on a server: resident memory of all processes, and idle CPU.

    python benchmarks/idle_memory.py [--robots 2000] [--workers 2] [--out FILE]

Prints machine, n, KiB per robot, and CPU ms per second while all robots are connected and idle.
Defends: <= 64 KiB per robot in all processes of the server.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import json
import os
import platform
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import websockets

from rse_pf.wire import SUBPROTOCOLS, Hello, make_codec

WATCH_S = 2.0


def sibling(name: str) -> Any:
    """Return the module of another benchmark in this folder."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


async def measure(identity: dict[str, int], robots: int, status: Any) -> dict[str, Any]:
    codec, url = make_codec("bin"), f"ws://127.0.0.1:{identity['port']}/ws"
    hello = codec.encode(Hello())

    async def join() -> Any:
        socket = await websockets.connect(
            url, subprotocols=[SUBPROTOCOLS["bin"]], compression=None, ping_interval=None
        )
        await socket.send(hello)
        await socket.recv()
        return socket

    warm = [await join() for _ in range(4)]
    before = status(identity)
    sockets = [await join() for _ in range(robots)]
    joined = status(identity)
    await asyncio.sleep(WATCH_S)
    after = status(identity)
    began = time.monotonic()
    await asyncio.gather(*(socket.close() for socket in warm + sockets))
    print(f"machine {platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"command {' '.join(sys.argv)}, n {robots}, spread {joined['robots_of_workers']}")
    grown = joined["resident_bytes"] - before["resident_bytes"]
    report = {
        "robots": robots,
        "kib_per_robot": round(grown / robots / 1024, 2),
        "mib_without_robots": round(before["resident_bytes"] / 2**20, 1),
        "idle_cpu_ms_per_s": round((after["cpu_s"] - joined["cpu_s"]) / WATCH_S * 1e3, 2),
        "handshake_cpu_us": round((joined["cpu_s"] - before["cpu_s"]) / robots * 1e6),
        "closed_after_s": round(time.monotonic() - began, 2),
        "load": os.getloadavg(),
    }
    for name, value in report.items():
        print(f"{name:20} {value}")
    return report


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", type=int, default=2000, help="idle connections")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    options = parser.parse_args()
    round_trip = sibling("round_trip")
    with tempfile.TemporaryDirectory() as folder:
        process, identity = round_trip.start(folder, workers=options.workers, log_level="warning")
        try:
            report = asyncio.run(measure(identity, options.robots, round_trip.status))
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20)
    if options.out:
        options.out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
