"""Silent connections to every port of a platform, and what connections that were used leave behind.

    python -m benchmarks hostile.connections silent [--count 5000] [--ports NAME ...]
    python -m benchmarks hostile.connections beside [--count 5000] [--pairs 5] [--ports NAME ...]
    python -m benchmarks hostile.connections leave [--times 500]

``silent`` starts a platform with its page, a live map and a cluster of Dask, and opens connections that
send nothing to one port after the other.  For each port it shows in how many seconds the server had closed
all of them (bar: 10), how much memory the processes of the platform took meanwhile (bar: 64 MiB), and how
long a new robot took to connect and to get an answer (bar: 1 s).  ``beside`` compares, for each port, p99 of
poses of four connected robots while the connections are opened, held and closed with that of as many seconds
without them, in turns (bar: the median of the ratios is at most 1.2).  ``leave`` lets robots, rosbridge
clients and readers of a live map connect, use what there is, and leave, and then browsers of the page; it
shows descriptors, threads and memory of the worker, and of the page, before and after (bars: as before; 1 KiB
a cycle).
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import os
import random
import resource
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from websockets.asyncio.client import connect as connect_socket

import client_sdk
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import median_ratio, percentile
from rse_pf.batch.cluster import LocalCluster, new_cluster_key
from rse_pf.cli.local_platform.page import new_address
from rse_pf.fleet_page.server import ANNOUNCEMENT
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request

_NAME = "silent-connections"
_OWNER = "rse-pf live map"
_LONGEST_S = 40.0
_WARM_UP = 100
_ROBOTS, _POSES_HZ = 4, 15.0
_WINDOW_S, _REST_S = 6.0, 1.0
MIB = 1 << 20


def family(root: int) -> list[int]:
    """Return *root* and the processes below it."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):
            parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
    found = [root]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def listening(pids: list[int]) -> dict[int, str]:
    """Return the TCP ports at which *pids* listen, with the names of their processes."""
    owners: dict[str, int] = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            for path in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    owners.setdefault(os.readlink(path), pid)
    found = {}
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        fields = line.split()
        owner = owners.get(f"socket:[{fields[9]}]")
        if fields[3] == "0A" and owner is not None:
            name = Path(f"/proc/{owner}/comm").read_text().strip()
            found[int(fields[1].split(":")[1], 16)] = name
    return found


def rss_bytes(pids: list[int]) -> int:
    total = 0
    for pid in pids:
        with contextlib.suppress(OSError):
            total += int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()
    return total


def open_at(port: int, peers: set[int]) -> int:
    """Return how many connections from *peers* the server's side of *port* has, its backlog included.

    Robots and the platform itself connect to the same port meanwhile.
    """
    local = f":{port:04X}"
    rows = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
    return sum(
        row[1].endswith(local) and row[3] in ("01", "03") and int(row[2].split(":")[1], 16) in peers
        for row in rows
    )


def open_silent(port: int, count: int) -> list[socket.socket]:
    opened = []
    for _ in range(count):
        each = socket.socket()
        each.setblocking(False)
        each.connect_ex(("127.0.0.1", port))
        opened.append(each)
    return opened


async def robot_s(url: str, token: str, name: str) -> float:
    """Return how long a new robot takes to connect and to get an answer."""
    began = time.monotonic()
    async with client_sdk.connect(url, token=token, random=random.Random(name)) as robot:
        await robot.call("echo", {"value": 1}, deadline_s=20.0)
    return time.monotonic() - began


def attack(port: int, count: int, pids: list[int], url: str, token: str) -> dict[str, float]:
    """Open *count* silent connections to *port*; return what was seen."""
    before = rss_bytes(pids)
    began = time.monotonic()
    opened = open_silent(port, count)
    peers = {silent_socket.getsockname()[1] for silent_socket in opened}
    robot = asyncio.run(asyncio.wait_for(robot_s(url, token, str(port)), 60))
    peak = rss_bytes(pids)
    while (left := open_at(port, peers)) > 0 and time.monotonic() - began < _LONGEST_S:
        peak = max(peak, rss_bytes(pids))
        time.sleep(0.1)
    closed_s = time.monotonic() - began
    for each in opened:
        each.close()
    memory_mib = (peak - before) / MIB
    return {"closed_s": closed_s, "left": left, "memory_mib": memory_mib, "robot_s": robot}


@contextlib.contextmanager
def platform(folder: Path) -> Iterator[tuple[int, str, Callable[[str], str]]]:
    """Yield pid and address of a platform with a live map, and what issues the token of a robot."""
    environment = {**os.environ, "XDG_STATE_HOME": str(folder)}
    command = [sys.executable, "-m", "rse_pf.cli.main"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [*command, "local", "--servers", "1", "--name", _NAME, "--port", "0"], env=environment,
            stdout=log, stderr=log, cwd=folder,
        )  # fmt: skip
    try:
        end = time.monotonic() + 60
        while "robots connect to" not in (said := (folder / "log").read_text()):
            if process.poll() is not None or time.monotonic() > end:
                raise SystemExit(said)
            time.sleep(0.1)
        url = next(line.split()[-1] for line in said.splitlines() if "robots connect to" in line)

        def issue(robot: str) -> str:
            issued = subprocess.run(
                [*command, "token", "issue", robot, "--name", _NAME], env=environment, capture_output=True,
                text=True, check=True,
            )  # fmt: skip
            return issued.stdout.split()[-1]

        yield process.pid, url, issue
    finally:
        subprocess.run(
            [*command, "local", "stop", "--name", _NAME], env=environment, capture_output=True, check=False
        )
        process.wait(60)


Attack = Callable[[int, list[int]], dict[str, Any]]
"""Takes a port and the processes of the platform; returns what was seen."""


def at_all_ports(
    only: list[str], prepare: Callable[[str, Callable[[str], str]], Attack]
) -> list[dict[str, Any]]:
    """Attack every port of a platform, one after the other; *prepare* takes its url and its issuer."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
    rows = []
    with (
        tempfile.TemporaryDirectory() as name,
        platform(Path(name)) as (pid, url, issue),
        contextlib.ExitStack() as stack,
    ):
        cluster = LocalCluster(new_cluster_key(), 1)
        stack.callback(cluster.stop)
        cluster.start()
        watcher = subprocess.Popen(
            [sys.executable, "-c", _WATCH, url, issue("watcher")], stdout=subprocess.PIPE, text=True
        )
        stack.callback(watcher.wait)
        stack.callback(watcher.kill)
        assert watcher.stdout is not None
        watcher.stdout.readline()
        deadline = time.monotonic() + 20
        while True:
            pids = [*family(pid), cluster.scheduler_pid, *cluster.worker_pids]
            late = {_OWNER, "batch-worker"} - set(listening(pids).values())
            if not late or time.monotonic() > deadline:
                break
            time.sleep(0.2)
        if late:
            say(f"not listening: {', '.join(sorted(late))}")
        attack = prepare(url, issue)
        # A map that is only watched gives its owner up, so that owner comes first.
        for port, owner in sorted(listening(pids).items(), key=lambda row: (row[1] != _OWNER, row[0])):
            if port not in listening(pids):
                say(f"listens no longer: {port} {owner}")
            elif not only or owner in only:
                row = {"port": port, "owner": owner, **attack(port, pids)}
                say(row)
                rows.append(row)
    return rows


def silent(count: int, only: list[str]) -> list[dict[str, Any]]:
    """Attack every port of a platform, one after the other."""

    def prepare(url: str, issue: Callable[[str], str]) -> Attack:
        token = issue("robot-1")
        return lambda port, pids: attack(port, count, pids, url, token)

    return at_all_ports(only, prepare)


def beside(count: int, pairs: int, only: list[str]) -> list[dict[str, Any]]:
    """Compare the poses of connected robots with and without silent connections, at every port."""

    def prepare(url: str, issue: Callable[[str], str]) -> Attack:
        tokens = [issue(f"robot-{number}") for number in range(_ROBOTS)]
        return lambda port, _: asyncio.run(compared(url, tokens, port, count, pairs))

    return at_all_ports(only, prepare)


async def compared(url: str, tokens: list[str], port: int, count: int, pairs: int) -> dict[str, Any]:
    """Return p99 of poses (ms) with and without *count* silent connections, and the median of the ratios."""
    problem = make_problem(seed=1, n=200, outlier_ratio=0.3)
    payload = make_request(problem.points_world, problem.pixels, problem.camera)
    took_ms: list[float] = []

    async def drive(robot: client_sdk.Robot) -> None:
        while True:
            began = time.monotonic()
            await robot.call("pnp", payload, deadline_s=20.0)
            took_ms.append((time.monotonic() - began) * 1e3)
            await asyncio.sleep(max(0.0, 1 / _POSES_HZ - (time.monotonic() - began)))

    async def window(is_attacked: bool) -> float:
        """Return p99 of the poses of a window; the connections are opened in a process of their own."""
        await asyncio.sleep(_REST_S)
        took_ms.clear()
        opener = None
        if is_attacked:
            opener = await asyncio.create_subprocess_exec(
                "nice", "-n", "19", sys.executable, "-c", _OPEN, str(port), str(count),
                stdout=subprocess.PIPE,
            )  # fmt: skip
            assert opener.stdout is not None
            await opener.stdout.readline()
            took_ms.clear()  # the start of the process is not the attack
        await asyncio.sleep(_WINDOW_S)
        for task in driving:
            if task.done():
                task.result()
        if opener is not None:
            opener.kill()
            await opener.wait()
        return float(percentile(took_ms, 99))

    async with contextlib.AsyncExitStack() as ends:
        fleet = [
            await ends.enter_async_context(client_sdk.connect(url, token=token, random=random.Random(token)))
            for token in tokens
        ]
        driving = [asyncio.create_task(drive(robot)) for robot in fleet]
        await window(False)  # warms up
        without_ms, with_ms = [], []
        for number in range(pairs):
            for is_attacked in (number % 2 == 0, number % 2 == 1):
                (with_ms if is_attacked else without_ms).append(await window(is_attacked))
        for task in driving:
            task.cancel()
    return {
        "without_p99_ms": [round(p99_ms, 2) for p99_ms in without_ms],
        "with_p99_ms": [round(p99_ms, 2) for p99_ms in with_ms],
        "ratio": median_ratio(with_ms, without_ms),
    }  # fmt: skip


_OPEN = """
import resource, socket, sys, time
limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
port, count = map(int, sys.argv[1:])
print("begins", flush=True)
opened = [socket.socket() for _ in range(count)]
for one in opened:
    one.setblocking(False)
    one.connect_ex(("127.0.0.1", port))
time.sleep(600)
"""


_WATCH = """
import asyncio, itertools, random, sys, client_sdk
from benchmarks.hostile.one_tenant import keyframe
async def watch():
    async with client_sdk.connect(sys.argv[1], token=sys.argv[2], random=random.Random(1)) as robot:
        updates = robot.subscribe("live/m")
        for number in itertools.count():  # a map that gets nothing has no owner
            await robot.call("live-keyframe", keyframe("m", number), deadline_s=20.0)
            if number == 0:
                print(await updates.next(), flush=True)
            await asyncio.sleep(2.0)
asyncio.run(watch())
"""


async def cycle(url: str, tokens: tuple[str, str], number: int) -> None:
    """Connect, use what there is, and leave."""
    async with client_sdk.connect(url, token=tokens[0], random=random.Random(number)) as robot:
        await robot.call("echo", {"value": number}, deadline_s=20.0)
        updates = robot.subscribe("live/m")
        await updates.next()
    headers = {"Authorization": f"Bearer {tokens[1]}"}
    address = url.replace("/ws", "/rosbridge")
    async with connect_socket(address, additional_headers=headers, compression=None) as client:
        for each in (
            {"op": "subscribe", "topic": "/t", "id": "s", "throttle_rate": 3_600_000, "queue_length": 10},
            *({"op": "publish", "topic": "/t", "msg": {"data": "x" * 50_000}} for _ in range(4)),
            {"op": "call_service", "id": "e", "service": "/echo", "args": {"value": 1}},
        ):
            await client.send(json.dumps(each))
        while "service_response" not in str(await asyncio.wait_for(client.recv(), 20)):
            pass


def count_held(pid: int) -> dict[str, int]:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {
        "descriptors": len(list(Path(f"/proc/{pid}/fd").iterdir())), "threads": int(status["Threads"]),
        "anonymous_kib": int(status["RssAnon"].split()[0]),
    }  # fmt: skip


def leave(times: int) -> dict[str, Any]:
    """Let clients come and go *times* times, after a warm-up."""
    from tests.guarded_server import GuardedServer

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "store").mkdir()
        groups: dict[str, Any] = {
            "serving": {"rosbridge": True}, "session": {"max_commands_per_s": 0.0},
            "data": {"store": f"dir:{folder / 'store'}"},
        }  # fmt: skip
        with GuardedServer(folder, workers=1, **groups) as server:
            tokens = (server.token("r", ttl_s=900), server.token("s", ttl_s=900))

            async def run(count: int) -> None:
                for number in range(count):
                    await asyncio.wait_for(cycle(server.url, tokens, number), 60)

            asyncio.run(run(_WARM_UP))
            root = server._process.pid  # type: ignore[union-attr]
            (worker,) = (
                each
                for each in family(root)
                if Path(f"/proc/{each}/comm").read_text().strip() == "rse-pf worker"
            )
            return count_growth(worker, times, lambda count: asyncio.run(run(count)))


def count_growth(pid: int, times: int, run: Callable[[int], None]) -> dict[str, Any]:
    """Return what the process *pid* holds before and after *times* cycles."""
    before = count_held(pid)
    run(times)
    deadline = time.monotonic() + 10
    while (after := count_held(pid))["descriptors"] > before["descriptors"] and time.monotonic() < deadline:
        time.sleep(0.1)
    grown = (after["anonymous_kib"] - before["anonymous_kib"]) / times
    return {"times": times, "before": before, "after": after, "kib_per_cycle": round(grown, 3)}


def browse(folder: Path) -> None:
    """Open the page with a key of its own, use it, and leave while it is being told what happens."""
    address = urlsplit(new_address(folder, "view"))
    key = address.fragment.rpartition("=")[2]
    page = http.client.HTTPConnection(address.netloc, timeout=20)

    def ask(method: str, path: str, body: str = "", session: str = "") -> http.client.HTTPResponse:
        page.request(method, path, body, {"Authorization": f"Bearer {session}"} if session else {})
        answer = page.getresponse()
        if answer.status != 200:
            raise SystemExit(f"{path}: {answer.status} {answer.read()!r}")
        return answer

    with contextlib.closing(page):
        ask("GET", "/").read()
        session = json.loads(ask("POST", "/session", json.dumps({"key": key})).read())["session"]
        with contextlib.closing(
            ask("GET", "/stream?topics=fleet,history,event,robots", session=session)
        ) as told:
            told.readline()


def leave_page(times: int) -> dict[str, Any]:
    """Let browsers of the page come and go *times* times, after a warm-up."""
    with tempfile.TemporaryDirectory() as name, platform(Path(name)):
        deadline = time.monotonic() + 20
        while not (announced := list(Path(name).rglob(ANNOUNCEMENT))) and time.monotonic() < deadline:
            time.sleep(0.1)

        def run(count: int) -> None:
            for _ in range(count):
                browse(announced[0].parent)

        run(_WARM_UP)
        return count_growth(int(json.loads(announced[0].read_text())["pid"]), times, run)


@benchmark(
    Bar("silent.*.closed_s", at_most=10, unit="s"),
    Bar("silent.*.left", equals=0),
    Bar("silent.*.memory_mib", at_most=64, unit="MiB"),
    Bar("silent.*.robot_s", at_most=1, unit="s"),
    Bar("beside.*.ratio", at_most=1.2, unit="times the p99"),
    Bar("leave.*.descriptors_left", at_most=0),
    Bar("leave.*.threads_left", at_most=0),
    Bar("leave.*.kib_per_cycle", at_most=1.0, unit="KiB"),
)
def run_benchmark(
    *, part: Literal["silent", "beside", "leave"], count: int = 5000, pairs: int = 5, times: int = 500,
    ports: Annotated[tuple[str, ...], "names of processes"] = (),
) -> dict[str, Any]:  # fmt: skip
    """Run a part."""
    if part == "beside":
        return {"beside": beside(count, pairs, list(ports))}
    if part == "silent":
        return {"silent": silent(count, list(ports))}
    rows = {"worker": leave(times), "page": leave_page(times)}
    for row in rows.values():
        for what in ("descriptors", "threads"):
            row[f"{what}_left"] = row["after"][what] - row["before"][what]
    return {"leave": rows}
