"""Measure the cost of an idle robot on a server: memory of all processes, kernel buffers, and idle CPU.

    python -m benchmarks server.idle_memory [--robots 10000] [--workers 2] [--tokens] [--base TREE]


Robots are plain sockets of sixteen loopback addresses that said Hello.  The memory is the growth of the
private pages of supervisor and workers; the TCP buffers of the kernel are reported beside it.  The CPU
of a handshake here has no close; ``benchmarks/server/handshakes.py`` has all of it.
Defends: <= 16 KiB per robot in all processes of the server.
"""

from __future__ import annotations

import itertools
import os
import resource
import time
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.server import handshakes
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings

WATCH_S = 2.0
WARM = 64
BAR_KIB = 16.0


def private_bytes(pids: list[int]) -> int:
    """Return the private pages of processes; pages that a fork shares count for nobody."""
    total = 0
    for pid in pids:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
        total += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Private_"))
    return total


def kernel_tcp_bytes() -> int:
    """Return what the kernel holds in TCP buffers of this network namespace."""
    lines = Path("/proc/net/sockstat").read_text(encoding="ascii").splitlines()
    (words,) = (line.split() for line in lines if line.startswith("TCP:"))
    return int(words[words.index("mem") + 1]) * os.sysconf("SC_PAGE_SIZE")


def measure(server: Any, robots: int, tokens: bool) -> dict[str, Any]:
    """Return the figures of *robots* idle connections."""
    numbers, settings, now = itertools.count(), AuthSettings(), time.time()
    key = SigningKey.from_seed(handshakes.PLATFORM_SEED, "platform")

    def join() -> Any:
        number = next(numbers)
        client = handshakes.Client(server.address, f"127.0.0.{2 + number % 16}")
        name = f"robot-{number}"
        token = key.issue(name, now=now, token_id=name, settings=settings) if tokens else ""
        client.send(handshakes.request(server.address, token))
        if b"101" not in client.head():
            raise SystemExit("the server refused a robot")
        client.send(handshakes.HELLO)
        client.frame()
        return client

    clients = [join() for _ in range(WARM)]
    before, kernel_before = private_bytes(server.pids), kernel_tcp_bytes()
    cpu_before = handshakes.wait_settled(server)
    clients += [join() for _ in range(robots)]
    joined_s = handshakes.wait_settled(server)
    spread = server.status()["robots_of_workers"]
    idle_before = server.cpu_s()
    time.sleep(WATCH_S)
    idle_s = server.cpu_s() - idle_before
    assert sum(spread) == robots + WARM, spread
    return {
        "robots": robots,
        "tokens": tokens,
        "kib_per_robot": round((private_bytes(server.pids) - before) / robots / 1024, 2),
        "kernel_kib_per_robot": round((kernel_tcp_bytes() - kernel_before) / robots / 1024, 2),
        "mib_without_robots": round(before / 2**20, 1),
        "idle_cpu_ms_per_s": round(idle_s / WATCH_S * 1e3, 2),
        "handshake_cpu_us": round((joined_s - cpu_before) / robots * 1e6),
        "spread": spread,
    }


@benchmark(Bar("this tree.kib_per_robot", at_most=BAR_KIB, unit="KiB"))
def run_benchmark(
    *,
    robots: Annotated[int, "idle connections"] = 10000,
    workers: int = 2,
    tokens: Annotated[bool, "each robot has a token of its own"] = False,
    base: Annotated[Path | None, "another tree of the sources, measured first"] = None,
) -> dict[str, Any]:
    """Connect the robots to each tree once."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    figures: dict[str, Any] = {}
    for name, tree in (*((("base", base),) if base else ()), ("this tree", None)):
        idle = {"ping_interval_s": 600.0, "hello_timeout_s": 600.0}
        with handshakes.serve_tree(tree, workers, tokens=tokens, audit=False, **idle) as server:
            figures[name] = measure(server, robots, tokens)
    return figures
