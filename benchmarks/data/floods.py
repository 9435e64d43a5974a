"""One robot floods the data service with lists and tiny objects; another robot stores its pictures beside it.

    python -m benchmarks data.floods [--seconds 20] [--objects 100000] [--listers 12]

One data server (``rse-pf data``) on loopback, its store in a folder.  A robot stores 64 KiB five times a
second: first alone, then beside a hostile robot of another tenant, which already has *objects* objects of
eight bytes, lists them over *listers* connections (every second one with ``limit=1``) and sends new ones
over *writers* connections, all as fast as the service answers.  The two phases alternate, *rounds* times.  At
the end, the hostile robot sends objects to a server without a limit of rates, beyond its number of objects.

In a third kind of phase, *committers* hostile robots upload and commit the maps of
`tests/hostile/hostile_maps.py`, again and again, each robot all of them.

The hostile robots run at the lowest priority: in the field their work costs a server nothing.

Defends: the p99 of the PUT beside the flood is at most twice that of the quiet phases, and beside hostile
maps at most 1.5 times and 100 ms, with no 503; the flood stores not one object above ``data.max_objects``; a
page of 1,000 of 100,000 objects takes at most 50 ms; the server grows by at most 64 MiB.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import itertools
import json
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings, PlatformSettings
from rse_pf.identity import RobotId, object_name
from rse_pf.object_store import DirectoryStore

CORPUS = Path(__file__).resolve().parents[2] / "tests" / "hostile" / "hostile_maps.py"
KIB = 1024
RATIO, PAGE_MS, MAPS_RATIO, MAPS_MS, GROWTH_MIB = 2.0, 50.0, 1.5, 100.0, 64.0
VICTIM, HOSTILE = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")
_LOWEST_PRIORITY = 19
_TIMEOUT_S = 60.0
_PUT_EVERY_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    seconds: Annotated[float, "of each phase"] = 10.0
    rounds: int = 6
    objects: Annotated[int, "data.max_objects of the server"] = 100000
    margin: Annotated[int, "objects that the hostile robot may add"] = 2000
    attempts: Annotated[int, "new objects without a limit of rates"] = 4000
    listers: int = 12
    writers: int = 4
    committers: int = 4
    folder: Annotated[Path | None, "where the store is made (default: the system's)"] = None


class Server:
    """A data server in a process of its own; a context manager."""

    def __init__(self, folder: Path, key: SigningKey, **data: Any) -> None:
        self.folder = folder
        (folder / "keys.json").write_text(key.key_set().to_json())
        settings = PlatformSettings().replace(data={"store": f"dir:{folder / 'objects'}", "port": 0, **data})
        (folder / "settings.json").write_text(json.dumps({"context": {"rse-pf": settings.to_dict()}}))
        self._announcement = folder / "announce.json"
        self._announcement.unlink(missing_ok=True)

    def __enter__(self) -> Server:
        self._log = (self.folder / "log").open("wb")
        command = [
            sys.executable, "-m", "rse_pf.cli.main", "data", "--settings", self.folder / "settings.json",
            "--keys", self.folder / "keys.json", "--announce", self._announcement,
        ]  # fmt: skip
        self._process = subprocess.Popen(command, stderr=self._log)
        until = time.monotonic() + _TIMEOUT_S
        while not self._announcement.exists():
            if time.monotonic() > until or self._process.poll() is not None:
                raise SystemExit((self.folder / "log").read_text())
            time.sleep(0.01)  # polls, with a deadline
        self.port = json.loads(self._announcement.read_text())["port"]
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(_TIMEOUT_S)
        self._log.close()

    def memory_mib(self) -> float:
        """Return the largest resident size of the process until now."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / KIB


class Client:
    """One connection of a robot."""

    def __init__(self, port: int, token: str) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT_S)
        self._headers = {"Authorization": f"Bearer {token}"}

    def ask(self, method: str, path: str, body: bytes | None = None) -> tuple[int, bytes]:
        """Return status and content."""
        self._connection.request(method, path, body, self._headers)
        answer = self._connection.getresponse()
        content = answer.read()
        if answer.will_close:
            self._connection.close()
        return answer.status, content

    def put(self, data: bytes) -> tuple[int, bytes]:
        """Store an object."""
        return self.ask("PUT", f"/data/v1/objects/{hashlib.sha256(data).hexdigest()}", data)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def token_of(key: SigningKey, robot: RobotId) -> str:
    """Return a token of *robot*."""
    return key.issue(robot.name, now=time.time(), token_id="t", settings=AuthSettings(), tenant=robot.tenant)


class Crowd(NamedTuple):
    """How many connections list objects, and how many write them."""

    listers: int
    writers: int


def flood(port: int, token: str, crowd: Crowd, begun: Event, stop: Event, results: Any) -> None:
    """List and write over many connections until *stop*; put the statuses into *results*."""
    listers, writers = crowd
    os.nice(_LOWEST_PRIORITY)
    statuses: Counter[str] = Counter()

    def work(row: int) -> None:
        client, number = Client(port, token), 0
        while not stop.is_set():
            number += 1
            try:
                if row < listers:
                    status, _ = client.ask("GET", f"/data/v1/objects?limit={1 if row % 2 else 1000}")
                else:
                    status, _ = client.put(f"{row} {number} {time.time_ns()}".encode())
                statuses[f"{'list' if row < listers else 'put'} {status}"] += 1
            except (OSError, http.client.HTTPException):
                statuses["cut"] += 1
                client.close()
        client.close()

    run_threads(work, listers + writers, begun)
    results.put(dict(statuses))


def run_threads(work: Callable[[int], None], count: int, begun: Event) -> None:
    """Run *work* of each number below *count* in a thread, set *begun*, and wait for them."""
    threads = [threading.Thread(target=work, args=(row,)) for row in range(count)]
    for thread in threads:
        thread.start()
    begun.set()
    for worker in threads:
        worker.join()


def flood_of_maps(port: int, tokens: list[str], begun: Event, stop: Event, results: Any) -> None:
    """Upload and commit hostile maps, each robot all of them, until *stop*."""
    os.nice(_LOWEST_PRIORITY)
    statuses: Counter[str] = Counter()
    maps = list(runpy.run_path(str(CORPUS))["hostile_maps"]().values())

    def work(row: int) -> None:
        client = Client(port, tokens[row])
        for number in itertools.count(row * len(maps) // len(tokens)):
            if stop.is_set():
                break
            data = maps[number % len(maps)]
            status, _ = client.put(data)
            statuses[f"put {status}"] += 1
            body = json.dumps({"digest": hashlib.sha256(data).hexdigest()}).encode()
            status, _ = client.ask("POST", f"/data/v1/maps/m-{row}-{number}/versions", body)
            statuses[f"commit {status}"] += 1
        client.close()

    run_threads(work, len(tokens), begun)
    results.put(dict(statuses))


@contextlib.contextmanager
def hostile(
    target: Callable[..., None], arguments: tuple[Any, ...], statuses: Counter[str]
) -> Iterator[None]:
    """Run a flood in a process meanwhile, and add its statuses."""
    context = multiprocessing.get_context("spawn")
    begun, stop, results = context.Event(), context.Event(), context.Queue()
    process = context.Process(target=target, args=(*arguments, begun, stop, results))
    process.start()
    try:
        if not begun.wait(_TIMEOUT_S):
            raise TimeoutError("the flood did not begin")
        yield
    finally:
        stop.set()
        statuses.update(results.get(timeout=_TIMEOUT_S))
        process.join()


def store_pictures(client: Client, seconds: float) -> list[float]:
    """Store 64 KiB five times a second; return how long each took (ms); raises SystemExit if one fails."""
    times, until, due = [], time.monotonic() + seconds, time.monotonic()
    while due < until:
        time.sleep(max(0.0, due - time.monotonic()))  # the rate is a parameter of the measurement
        data = os.urandom(64 * KIB)
        began = time.monotonic()
        status, content = client.put(data)
        times.append(1000 * (time.monotonic() - began))
        if status != 201:
            raise SystemExit(f"the other robot's PUT ended in {status}: {content[:200]!r}")
        due += _PUT_EVERY_S
    return times


def page_times(client: Client, pages: int) -> list[float]:
    """Return how long pages of 1,000 objects took (ms), one after the other."""
    times, after = [], ""
    for _ in range(pages):
        began = time.monotonic()
        status, content = client.ask("GET", f"/data/v1/objects?limit=1000&after={after}")
        times.append(1000 * (time.monotonic() - began))
        page = json.loads(content)
        if status != 200 or page["next"] is None:
            break
        after = page["next"]
        time.sleep(0.1)  # within the rate of the robot
    return times


def fill(store: DirectoryStore, robot: RobotId, count: int) -> None:
    """Store *count* objects of eight bytes, without waiting for the disk."""
    for number in range(count):
        data = f"{number:08x}".encode()
        store.put_scratch(object_name(robot, hashlib.sha256(data).hexdigest()), data)


def reach_the_count(folder: Path, key: SigningKey, attempts: int, max_objects: int) -> dict[str, Any]:
    """Send *attempts* new objects to a server without a limit of rates; return the statuses and the rate."""
    statuses: Counter[int] = Counter()
    with Server(folder, key, max_requests_per_s=1e9, max_objects=max_objects) as server:
        client = Client(server.port, token_of(key, HOSTILE))
        began, refused_s = time.monotonic(), 0.0
        for number in range(attempts):
            at = time.monotonic()
            status, _ = client.put(f"more {number}".encode())
            statuses[status] += 1
            refused_s += (time.monotonic() - at) * (status == 413)
        took_s = time.monotonic() - began
        client.close()
    return {
        "attempts": attempts, "statuses": dict(statuses), "seconds": took_s,
        "refusals_per_s": statuses[413] / refused_s if refused_s else 0.0,
    }  # fmt: skip


def run(args: Options) -> dict[str, Any]:
    """Return every figure."""
    key = SigningKey.from_seed(os.urandom(32), "key-1")
    statuses: Counter[str] = Counter()
    map_statuses: Counter[str] = Counter()
    quiet: list[float] = []
    beside: list[float] = []
    beside_maps: list[float] = []
    with tempfile.TemporaryDirectory(dir=args.folder) as made:
        folder = Path(made)
        store = DirectoryStore(folder / "objects")
        fill(store, HOSTILE, args.objects - args.margin)
        with Server(folder, key, max_objects=args.objects) as server:
            victim = Client(server.port, token_of(key, VICTIM))
            store_pictures(victim, 2.0)
            before_mib = server.memory_mib()
            lists = server.port, token_of(key, HOSTILE), Crowd(args.listers, args.writers)
            robots = [RobotId("rival", f"mapper-{row}") for row in range(args.committers)]
            maps = server.port, [token_of(key, robot) for robot in robots]
            for _ in range(args.rounds):
                quiet += store_pictures(victim, args.seconds)
                with hostile(flood, lists, statuses):
                    beside += store_pictures(victim, args.seconds)
                with hostile(flood_of_maps, maps, map_statuses):
                    beside_maps += store_pictures(victim, args.seconds)
            grown_mib = server.memory_mib() - before_mib
            victim.close()
        with Server(folder, key) as server:
            lister = Client(server.port, token_of(key, HOSTILE))
            pages = page_times(lister, 100)
            lister.close()
        count = reach_the_count(folder, key, args.attempts, args.objects)
        stored = store.usage(object_name(HOSTILE, "")).objects
    figures = {
        "quiet": spread(quiet), "lists": spread(beside), "maps": spread(beside_maps), "pages": spread(pages),
        "statuses": {"lists": dict(sorted(statuses.items())), "maps": dict(sorted(map_statuses.items()))},
        "count": count, "stored": stored, "server_grown_mib": grown_mib,
        "stored_above_limit": max(0, stored - args.objects),
    }  # fmt: skip
    for name in ("lists", "maps"):
        figures[f"{name}_p99_ratio"] = figures[name]["p99"] / figures["quiet"]["p99"]
    return figures


@benchmark(
    Bar("lists_p99_ratio", at_most=RATIO, unit="times quiet"),
    Bar("maps_p99_ratio", at_most=MAPS_RATIO, unit="times quiet"),
    Bar("maps.p99", at_most=MAPS_MS, unit="ms"),
    Bar("pages.p50", at_most=PAGE_MS, unit="ms"),
    Bar("stored_above_limit", equals=0),
    Bar("server_grown_mib", at_most=GROWTH_MIB, unit="MiB"),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Measure the phases in turns."""
    return run(args)
