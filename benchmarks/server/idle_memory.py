"""Measure the cost of an idle robot on a server: memory of all processes, kernel buffers, and idle CPU.

    python -m benchmarks server.idle_memory [--robots 10000] [--workers 2] [--tokens]

Robots are plain sockets from sixteen loopback addresses that have sent their Hello.  The memory is the growth
of the private pages of supervisor and workers; the TCP buffers of the kernel are reported as a separate
figure. The CPU time of a handshake does not include that of closing a connection.

Defends the promise that 10,000 connections need at most 16 KiB each in all processes of the server.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import socket
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.server.serving import UNLIMITED, BenchServer, private_bytes_of_tree, tree
from rse_pf.wire import SUBPROTOCOLS, Hello, make_codec

WATCH_S = 2.0  # duration of the measurement of idle CPU time
WARM_ROBOTS = 64  # robots that connect before the measurement begins
MAX_KIB_PER_ROBOT = 16.0  # bar: largest memory of an idle robot in all processes of the server
WAIT_S = 10.0  # time limit for an answer, and until the server is idle
CODEC = "bin"  # codec of the robots' messages
SOURCES = 16  # number of loopback addresses from which the robots connect
SILENCE_S = 600.0  # ping interval and Hello timeout of the server: robots send nothing while it is measured


def hello_frame() -> bytes:
    """Return the WebSocket frame with a robot's Hello, masked with 0."""
    payload = make_codec(CODEC).encode(Hello())
    assert len(payload) < 126
    return bytes([0x82, 0x80 | len(payload)]) + bytes(4) + payload


def join(server: BenchServer, number: int, *, has_token: bool) -> socket.socket:
    """Return the socket of robot *number* after its handshake and the Welcome."""
    connection = socket.create_connection(
        ("127.0.0.1", server.port), timeout=WAIT_S, source_address=(f"127.0.0.{2 + number % SOURCES}", 0)
    )
    bearer = f"Authorization: Bearer {server.token(f'robot-{number}')}\r\n" if has_token else ""
    head = (
        f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOLS[CODEC]}\r\n{bearer}"
        "User-Agent: Python/3.11 websockets/15.0\r\n\r\n"
    )
    connection.sendall(head.encode())
    seen = b""
    while b"\r\n\r\n" not in seen:
        seen += _received(connection)
    answer, _, seen = seen.partition(b"\r\n\r\n")
    if b"101" not in answer.partition(b"\r\n")[0]:
        raise SystemExit("the server refused a robot")
    connection.sendall(hello_frame())
    while len(seen) < 2 or len(seen) < 2 + seen[1]:
        seen += _received(connection)
    return connection


def _received(connection: socket.socket) -> bytes:
    data = connection.recv(4096)
    if not data:
        raise SystemExit("the server closed the connection")
    return data


def kernel_tcp_bytes() -> int:
    """Return the bytes of the kernel's TCP buffers in this network namespace."""
    lines = Path("/proc/net/sockstat").read_text(encoding="ascii").splitlines()
    (words,) = (line.split() for line in lines if line.startswith("TCP:"))
    return int(words[words.index("mem") + 1]) * os.sysconf("SC_PAGE_SIZE")


def robots_of_workers(server: BenchServer) -> list[int]:
    """Return the number of robots of each worker, as the server reports them."""
    with urllib.request.urlopen(f"http://127.0.0.1:{server.control_port}/status") as answer:
        found: list[int] = json.loads(answer.read())["robots_of_workers"]
    return found


def cpu_s(server: BenchServer) -> float:
    """Return the CPU seconds of all processes, by the kernel's clock of each (CPUCLOCK_SCHED of its pid)."""
    return sum(time.clock_gettime(~pid << 3 | 2) for pid in tree(server.pid))


def settled_cpu_s(server: BenchServer) -> float:
    """Wait until *server* uses no more CPU time, and return its CPU seconds."""
    before, deadline = -1.0, time.monotonic() + WAIT_S
    while before != (now := cpu_s(server)) and time.monotonic() < deadline:
        before = now
        time.sleep(0.004)  # polls until the deadline
    return now


def measure(server: BenchServer, robots: int, *, has_tokens: bool) -> dict[str, Any]:
    """Return the figures of *robots* idle connections."""
    numbers = itertools.count()
    connections = [join(server, next(numbers), has_token=has_tokens) for _ in range(WARM_ROBOTS)]
    before, kernel_before = private_bytes_of_tree(server.pid), kernel_tcp_bytes()
    cpu_before_s = settled_cpu_s(server)
    connections += [join(server, next(numbers), has_token=has_tokens) for _ in range(robots)]
    joined_s = settled_cpu_s(server)
    spread = robots_of_workers(server)
    assert sum(spread) == len(connections), spread
    idle_before_s = cpu_s(server)
    time.sleep(WATCH_S)  # the duration of the measurement
    idle_s = cpu_s(server) - idle_before_s
    return {
        "kib_per_robot": round((private_bytes_of_tree(server.pid) - before) / robots / 1024, 2),
        "kernel_kib_per_robot": round((kernel_tcp_bytes() - kernel_before) / robots / 1024, 2),
        "mib_without_robots": round(before / 2**20, 1),
        "idle_cpu_ms_per_s": round(idle_s / WATCH_S * 1e3, 2),
        "handshake_cpu_us": round((joined_s - cpu_before_s) / robots * 1e6),
        "spread": spread,
    }


@benchmark(Bar("kib_per_robot", at_most=MAX_KIB_PER_ROBOT, unit="KiB"))
def run_benchmark(
    *,
    robots: Annotated[int, "idle connections"] = 10_000,
    workers: int = 2,
    tokens: Annotated[bool, "each robot has a token of its own"] = False,
) -> dict[str, Any]:
    """Connect the robots once."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    groups = {
        "serving": {**UNLIMITED["serving"], "trusted_proxies": 0},
        "auth": {"required": tokens},
        "session": {"ping_interval_s": SILENCE_S, "hello_timeout_s": SILENCE_S},
    }
    with (
        tempfile.TemporaryDirectory() as folder,
        BenchServer(Path(folder), workers=workers, **groups) as server,
    ):
        return measure(server, robots, has_tokens=tokens)
