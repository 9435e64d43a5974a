"""CPU and latency of requests to one data server, and the rate of one stream, beside another checkout.

    python -m benchmarks data.requests [--base CHECKOUT] [--rounds 5] [--only small]

One data server on a folder, with an audit log, asked over loopback by raw sockets.  With `--base` the rounds
of this checkout and of the other one alternate; medians are given.

========  ===================================================================================  ===========
row       what                                                                                 bars
========  ===================================================================================  ===========
small     20 robots, together 100 requests a second of 4 kB, open loop: GET, then PUT; idle    see `BARS`
stream    60 MB in one stream: up in parts of 4 MiB and of 1 MiB, down in one GET
balancer  the same through the load balancer
greedy    a robot beside another one that uses its whole rate: GET and PUT, quiet and not      1.2 x quiet
========  ===================================================================================  ===========

Latency counts from the planned time of a request.  CPU is that of the server's process alone.

Defends: `BARS`, and that a greedy robot slows no other one.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import interleaved, percentile
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings, PlatformSettings
from rse_pf.local.balancer.envoy_config import DATA_CLUSTER, Target
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer

HERE = Path(__file__).resolve().parents[2]
KEY = SigningKey.from_seed(b"k" * 32, "key-1")
ROBOTS, PER_S, SECONDS, IDLE_S = 20, 100.0, 3.0, 3.0
OBJECT_BYTES, STREAM_BYTES, MIB = 4096, 60_000_000, 1 << 20
GREEDY_S, GREEDY_PER_S, VICTIM_PER_S = 8.0, 50.0, 20.0
BARS = {
    "get_cpu_us": 400.0, "put_cpu_us": 800.0, "idle_cpu_ms_per_s": 3.0,
    "get_p50_ms": 2.0, "get_p99_ms": 15.0, "put_p50_ms": 6.0, "put_p99_ms": 40.0,
}  # fmt: skip
GREEDY_RATIO = 1.2
_TIMEOUT_S = 60.0
_SETTLE_S = 1.0


class Server:
    """A data server of one checkout, in a process of its own; a context manager.

    *data* are settings of the group of that name beside the defaults.
    """

    def __init__(self, folder: Path, checkout: Path = HERE, **data: Any) -> None:
        self._checkout, self._folder, self._data = checkout, folder, data

    def __enter__(self) -> Server:
        folder = self._folder
        (folder / "keys.json").write_text(KEY.key_set().to_json())
        document = {"context": {"rse-pf": {"data": self._data}}}
        (folder / "settings.json").write_text(json.dumps(document))
        announcement = folder / "announce.json"
        command = [
            sys.executable, "-m", "rse_pf.cli.main", "data", "--settings", folder / "settings.json",
            "--keys", folder / "keys.json", "--port", "0",
            "--store", f"dir:{folder / 'objects'}", "--announce", announcement, "--audit", folder / "audit",
        ]  # fmt: skip
        self._log = (folder / "log").open("wb")
        self._process = subprocess.Popen(
            command,
            stderr=self._log,
            cwd=self._checkout,
            env=os.environ | {"PYTHONPATH": str(self._checkout)},
        )
        until = time.monotonic() + _TIMEOUT_S
        while not announcement.exists():
            if time.monotonic() > until or self._process.poll() is not None:
                raise SystemExit((folder / "log").read_text())
            time.sleep(0.01)  # polls, with a deadline
        self.port = int(json.loads(announcement.read_text())["port"])
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(_TIMEOUT_S)
        self._log.close()

    def cpu_s(self) -> float:
        """Return the CPU seconds of all threads of the server until now."""
        tasks = Path(f"/proc/{self._process.pid}/task").iterdir()
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


def token_of(robot: str) -> str:
    """Return a token of *robot*."""
    return KEY.issue(robot, now=time.time(), token_id="t", settings=AuthSettings())


def head_of(method: str, path: str, token: str, size: int | None = None, *lines: str) -> bytes:
    """Return the head of a request."""
    length = () if size is None else (f"Content-Length: {size}",)
    first = f"{method} {path} HTTP/1.1"
    return "\r\n".join([first, "Host: x", f"Authorization: Bearer {token}", *length, *lines, "", ""]).encode()


class Robot:
    """One connection, which sends one request after the other."""

    def __init__(self, port: int, name: str) -> None:
        self._port, self.token = port, token_of(name)

    async def open(self) -> Robot:
        """Connect."""
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)
        return self

    async def ask(self, request: bytes) -> int:
        """Send a request; return the status when the whole reply was read."""
        self._writer.write(request)
        head = await self._reader.readuntil(b"\r\n\r\n")
        lines = head.lower().split(b"\r\n")
        size = next((int(line[15:]) for line in lines if line.startswith(b"content-length:")), 0)
        await self._reader.readexactly(size)
        return int(head[9:12])

    async def close(self) -> None:
        """Disconnect."""
        self._writer.close()
        await self._writer.wait_closed()


def put_request(token: str, data: bytes) -> bytes:
    """Return the request that stores *data*."""
    path = f"/data/v1/objects/{hashlib.sha256(data).hexdigest()}"
    return head_of("PUT", path, token, len(data)) + data


async def open_loop(robot: Robot, requests: list[bytes], every_s: float, first_s: float) -> list[float]:
    """Send *requests* at their times; return how many ms after its time each was answered with success."""
    took_ms = []
    for number, request in enumerate(requests):
        planned = first_s + number * every_s
        await asyncio.sleep(max(0.0, planned - time.monotonic()))
        status = await robot.ask(request)
        assert status < 300, status
        took_ms.append(1e3 * (time.monotonic() - planned))
    return took_ms


async def small(server: Server) -> dict[str, float]:
    """Return the figures of small requests."""
    robots = [await Robot(server.port, f"robot-{number}").open() for number in range(ROBOTS)]
    each, every_s = round(SECONDS * PER_S / ROBOTS), ROBOTS / PER_S
    puts, gets = [], []
    for robot in robots:
        objects = [os.urandom(OBJECT_BYTES) for _ in range(each)]
        puts.append([put_request(robot.token, data) for data in objects])
        first = hashlib.sha256(objects[0]).hexdigest()
        gets.append([head_of("GET", f"/data/v1/objects/{first}", robot.token)] * each)
        assert await robot.ask(puts[-1][0]) == 201
    figures = {}
    await asyncio.sleep(_SETTLE_S)
    for name, requests in (("put", puts), ("get", gets)):
        before, first_s = server.cpu_s(), time.monotonic() + 0.1
        rows = await asyncio.gather(
            *(
                open_loop(robot, wanted, every_s, first_s + number * every_s / ROBOTS)
                for number, (robot, wanted) in enumerate(zip(robots, requests, strict=True))
            )
        )
        took_ms = [took for row in rows for took in row]
        figures[f"{name}_cpu_us"] = 1e6 * (server.cpu_s() - before) / len(took_ms)
        figures[f"{name}_p50_ms"], figures[f"{name}_p99_ms"] = percentile(took_ms, [50, 99]).tolist()
    await asyncio.sleep(_SETTLE_S)
    before, began = server.cpu_s(), time.monotonic()
    await asyncio.sleep(IDLE_S)
    figures["idle_cpu_ms_per_s"] = 1e3 * (server.cpu_s() - before) / (time.monotonic() - began)
    for robot in robots:
        await robot.close()
    return figures


def receive(connection: socket.socket, into: bytearray) -> tuple[int, int]:
    """Return the status of a reply, and how many bytes of body were read, into *into*."""
    head = b""
    while b"\r\n\r\n" not in head:
        got = connection.recv(65536)
        assert got, head
        head += got
    head, _, rest = head.partition(b"\r\n\r\n")
    size = next((int(x[15:]) for x in head.lower().split(b"\r\n") if x.startswith(b"content-length:")), 0)
    view, at = memoryview(into), len(rest)
    view[:at] = rest
    while at < size:
        at += connection.recv_into(view[at:size])
    return int(head[9:12]), at


def stream(port: int) -> dict[str, float]:
    """Return the MB/s of one stream, up by parts of two sizes, and down in one request."""
    figures = {}
    buffer = bytearray(STREAM_BYTES)
    for name, part_bytes in (("up", 4 * MIB), ("up_1mib", MIB)):
        data = os.urandom(STREAM_BYTES)
        digest, token = hashlib.sha256(data).hexdigest(), token_of(f"stream-{name}")
        path, view = f"/data/v1/uploads/{digest}", memoryview(data)
        connection = socket.create_connection(("127.0.0.1", port), timeout=_TIMEOUT_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        began = time.monotonic()
        body = json.dumps({"size": len(data)}).encode()
        connection.sendall(head_of("PUT", path, token, len(body)) + body)
        assert receive(connection, buffer)[0] == 200
        for offset in range(0, len(data), part_bytes):
            part = view[offset : offset + part_bytes]
            connection.sendall(head_of("PATCH", path, token, len(part), f"Upload-Offset: {offset}"))
            connection.sendall(part)
            status = receive(connection, buffer)[0]
        assert status == 201, status
        figures[f"{name}_mb_per_s"] = len(data) / 1e6 / (time.monotonic() - began)
        if name == "up":
            wanted, reader = digest, token
        connection.close()
    connection = socket.create_connection(("127.0.0.1", port), timeout=_TIMEOUT_S)
    began = time.monotonic()
    connection.sendall(head_of("GET", f"/data/v1/objects/{wanted}", reader))
    status, size = receive(connection, buffer)
    figures["down_mb_per_s"] = size / 1e6 / (time.monotonic() - began)
    connection.close()
    assert (status, size, hashlib.sha256(buffer).hexdigest()) == (200, STREAM_BYTES, wanted)
    return figures


@contextmanager
def balancer(server: Server, folder: Path) -> Iterator[int]:
    """Yield the port of a load balancer before *server*."""
    made = EnvoyLoadBalancer(PlatformSettings(), folder=folder, port=0)
    made.launch()

    async def wait() -> None:
        await made.wait_live(_TIMEOUT_S)
        made.set_targets([Target(name="data", port=server.port, control_port=server.port)], DATA_CLUSTER)
        while True:
            with socket.create_connection(("127.0.0.1", made.port)) as connection:
                connection.sendall(head_of("GET", "/data/v1/objects", token_of("probe")))
                if b" 200 " in connection.recv(4096):
                    return
            await asyncio.sleep(0.05)  # polls; the benchmark is ended from outside

    try:
        asyncio.run(wait())
        yield made.port
    finally:
        made.kill()


def through_balancer(server: Server) -> dict[str, float]:
    """Return the figures of `stream` through a load balancer."""
    with tempfile.TemporaryDirectory() as folder, balancer(server, Path(folder)) as port:
        return {f"balancer_{name}": value for name, value in stream(port).items()}


async def use_rate(robot: Robot, per_s: float, end_s: float, first_s: float) -> None:
    """Store an object at each time until *end_s*."""
    number = 0
    while (planned := first_s + number / per_s) < end_s:
        await asyncio.sleep(max(0.0, planned - time.monotonic()))
        await robot.ask(put_request(robot.token, os.urandom(OBJECT_BYTES)))
        number += 1


async def greedy(server: Server) -> dict[str, float]:
    """Return the p99 of one robot, alone and beside another that uses its whole rate for GET and PUT."""
    figures = {}
    for name in ("get", "put"):
        victim = await Robot(server.port, f"victim-{name}").open()
        others = [await Robot(server.port, f"greedy-{name}").open() for _ in range(4)]
        stored = os.urandom(OBJECT_BYTES)
        await victim.ask(put_request(victim.token, stored))
        count, every_s = round(GREEDY_S * VICTIM_PER_S), 1.0 / VICTIM_PER_S

        def requests(
            count: int = count, name: str = name, stored: bytes = stored, victim: Robot = victim
        ) -> list[bytes]:
            path = f"/data/v1/objects/{hashlib.sha256(stored).hexdigest()}"
            if name == "get":
                return [head_of("GET", path, victim.token)] * count
            return [put_request(victim.token, os.urandom(OBJECT_BYTES)) for _ in range(count)]

        rows: dict[bool, list[float]] = {False: [], True: []}
        for is_loaded in (False, True, False, True):
            wanted, first_s = requests(count // 2), time.monotonic() + 0.1
            ends_s = first_s + GREEDY_S / 2
            load = [
                use_rate(other, GREEDY_PER_S / len(others), ends_s, first_s + n / GREEDY_PER_S)
                for n, other in enumerate(others)
                if is_loaded
            ]
            took, *_ = await asyncio.gather(open_loop(victim, wanted, every_s, first_s), *load)
            rows[is_loaded] += took
        quiet, loaded = (percentile(rows[key], 99) for key in (False, True))
        figures |= {f"greedy_{name}_quiet_p99_ms": quiet, f"greedy_{name}_p99_ms": loaded}
        for robot in (victim, *others):
            await robot.close()
    return figures


ROWS: dict[str, Callable[[Server], dict[str, float]]] = {
    "small": lambda server: asyncio.run(small(server)),
    "stream": lambda server: stream(server.port),
    "balancer": through_balancer,
    "greedy": lambda server: asyncio.run(greedy(server)),
}


def measure(checkout: Path, rows: list[str]) -> dict[str, float]:
    """Return the figures of one round of a checkout."""
    figures: dict[str, float] = {}
    for row in rows:
        with (
            tempfile.TemporaryDirectory(dir=HERE / "build") as folder,
            Server(Path(folder), checkout) as server,
        ):
            figures |= ROWS[row](server)
    return figures


@benchmark(
    *(Bar(f"medians.here.{name}", at_most=bar) for name, bar in BARS.items()),
    Bar("greedy.*", at_most=GREEDY_RATIO, unit="times quiet"),
)
def run_benchmark(
    *, base: Annotated[Path | None, "another checkout, measured in turns with this one"] = None,
    rounds: int = 5, only: Annotated[tuple[str, ...], "measure these rows only", ROWS] = (),
) -> dict[str, Any]:  # fmt: skip
    """Measure the checkouts in turns."""
    checkouts = {"here": HERE, **({} if base is None else {"base": base.resolve()})}
    made: dict[str, list[dict[str, float]]] = {name: [] for name in checkouts}
    (HERE / "build").mkdir(exist_ok=True)
    for _, name in interleaved(list(checkouts), rounds):
        made[name].append(measure(checkouts[name], list(only or ROWS)))
    medians = {
        name: {key: statistics.median(row[key] for row in rows) for key in rows[0]}
        for name, rows in made.items()
    }
    here, base_median = medians["here"], medians.get("base")
    ratios = {
        f"greedy_{name}": here[f"greedy_{name}_p99_ms"] / here[f"greedy_{name}_quiet_p99_ms"]
        for name in ("get", "put")
        if f"greedy_{name}_p99_ms" in here
    }
    speed_ups = (
        {key: value / base_median[key] for key, value in here.items() if "mb_per_s" in key}
        if base_median
        else {}
    )
    return {"medians": medians, "rounds": made, "greedy": ratios, "times_as_fast": speed_ups}
