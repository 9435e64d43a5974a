"""Poses of honest robots while others send hostile maps; and what limited processes cost an honest map.

    python -m benchmarks hostile.maps flood [--workers 1] [--robots 10] [--seconds 20]
    python -m benchmarks hostile.maps honest --before DIR [--n 300]

``flood`` starts `rse-pf serve`.  Robots request 5 poses per second each; latency counts from the planned
time.  After a quiet window, robots of their own identity each send every map of
``tests/hostile/hostile_maps.py`` as a stored object to ``place`` and ``localise``, hostile clouds to ``icp``,
and then the maps to the job ``merge``.  Memory is that of the supervisor and its workers without their
limited processes and jobs, which are counted apart.

``honest`` asks two servers in turns, in random order: one of this tree, one of the sources in DIR.

Defends: others' p99 <= 1.5x of quiet and <= 100 ms, no 503, serving processes grow by <= 64 MiB.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import json
import os
import random
import re
import runpy
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

import client_sdk
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from benchmarks.hostile.robots import summarise_window
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.experiments.load.swarm import Swarm
from rse_pf.geometry import exp_se3
from rse_pf.maps.format import Keyframe, encode_map
from rse_pf.object_store import digest_of
from tests.synthetic_maps import make_room, make_world

ROOT = Path(__file__).resolve().parents[2]
CORPUS = ROOT / "tests" / "hostile" / "hostile_maps.py"
KEY = SigningKey.from_seed(b"m" * 32, "bench-1")
START_S, SETTLE_S, GRACE_S = 60.0, 3.0, 6.0
ATTACKERS = 4
P99_BAR, P99_BAR_MS, MEMORY_BAR_MIB = 1.5, 100.0, 64.0


_PUT = """
import sys
from rse_pf.identity import RobotId, object_name
from rse_pf.object_store import open_store
place, digest, *robots = sys.argv[1:]
store, data = open_store(place), sys.stdin.buffer.read()
for robot in robots:
    store.put(object_name(RobotId("default", robot), digest), data)
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    what: Literal["flood", "honest"]
    workers: int = 1
    robots: int = 10
    seconds: Annotated[float, "length of the quiet windows"] = 20.0
    n: Annotated[int, "commands of each kind with each server"] = 300
    rate: Annotated[float, "hostile commands per second, at most"] = 10.0
    only: Annotated[str, "regular expression of the names of hostile maps"] = ""
    without_jobs: bool = False
    tree: Annotated[Path, "sources of the server, or of the later one"] = ROOT
    before: Annotated[Path | None, "sources of the other server"] = None


class Server:
    """`rse-pf serve` of one tree of sources, with a store of its own."""

    def __init__(self, folder: Path, *, workers: int, tree: Path = ROOT) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self._tree = tree
        changes = {"serving": {"max_robots": 2000}, "session": {"max_commands_per_s": 0.0}}
        (folder / "settings.json").write_text(json.dumps({"context": {"rse-pf": changes}}))
        (folder / "keys.json").write_text(KEY.key_set().to_json())
        announce = folder / "announce.json"
        self._log = (folder / "server.log").open("wb")
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "rse_pf.cli.main", "serve", "--settings", str(folder / "settings.json"),
                "--keys", str(folder / "keys.json"), "--port", "0", "--control-port", "0",
                "--workers", str(workers), "--server-id", "bench", "--announce", str(announce),
                "--store", f"dir:{folder / 'objects'}",
            ],
            stdout=subprocess.DEVNULL, stderr=self._log, cwd=tree,
            env={**os.environ, "PYTHONPATH": str(tree)},
        )  # fmt: skip
        end = time.monotonic() + START_S
        while not announce.exists():
            if self._process.poll() is not None or time.monotonic() > end:
                raise SystemExit((folder / "server.log").read_text()[-2000:])
            time.sleep(0.05)  # looks again, with a deadline: the file comes by rename
        announced = json.loads(announce.read_text())
        self.url = f"ws://127.0.0.1:{announced['port']}/ws"
        self.serving = [self._process.pid, *announced["workers"]]

    def token(self, robot: str) -> str:
        """Return a token that this server accepts."""
        settings = PlatformSettings().auth
        return KEY.issue(robot, now=time.time(), token_id=f"{robot}-{time.monotonic()}", settings=settings)

    def store_all(self, robots: Iterable[str], data: bytes) -> dict[str, str]:
        """Store *data* as an object of each of *robots*, and return the reference to it."""
        place, digest = f"dir:{self.folder / 'objects'}", digest_of(data)
        # Other sources may lay out their objects in another way, so they store them themselves.
        subprocess.run(
            [sys.executable, "-c", _PUT, place, digest, *robots], input=data, cwd=self._tree, check=True,
            env={**os.environ, "PYTHONPATH": str(self._tree)},
        )  # fmt: skip
        return {"object": digest}

    def robot(self, name: str) -> client_sdk.Robot:
        """Return the robot *name*, to be connected."""
        return client_sdk.connect(self.url, token=self.token(name), codec="bin")

    def stop(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait(30)
        self._log.close()


@benchmark(
    Bar("attacks.*.p99_ratio", at_most=P99_BAR, unit="times quiet"),
    Bar("attacks.*.p99_ms", at_most=P99_BAR_MS, unit="ms"),
    Bar("attacks.*.grown_mib", at_most=MEMORY_BAR_MIB, unit="MiB"),
    Bar("attacks.*.others_failed", equals={}),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Measure one of both."""
    if args.what == "honest" and args.before is None:
        raise UsageError("honest needs --before", hint="name the sources of the other server")
    with tempfile.TemporaryDirectory() as folder:
        work = flood(args, Path(folder)) if args.what == "flood" else honest(args, Path(folder))
        return asyncio.run(work)


async def flood(args: Options, folder: Path) -> dict[str, Any]:
    """Measure quiet, attacked by commands, quiet, attacked by jobs."""
    server = Server(folder / "server", workers=args.workers, tree=args.tree.absolute())
    origin = time.monotonic()
    options = LoadScenario(robots=args.robots, fps=5.0, seed=7)
    windows: dict[str, tuple[float, float]] = {}
    rows: dict[str, dict[str, Any]] = {}

    def now() -> float:
        return time.monotonic() - origin

    try:
        async with Swarm(
            options, url=server.url, token_of=server.token, session=PlatformSettings().session, origin=origin
        ) as swarm:  # fmt: skip
            await swarm.start()
            await swarm.wait_joined(START_S)
            requests = hostile_requests(server, args.only)
            for name in ("commands",) if args.without_jobs else ("commands", "jobs"):
                mine = [request for request in requests if (request[1] == "merge") == (name == "jobs")]
                await asyncio.sleep(SETTLE_S)
                began = now()
                await asyncio.sleep(args.seconds)
                windows[f"quiet before {name}"] = began, now()
                began = now()
                rows[name] = await attack(server, mine, seconds=args.seconds, per_s=args.rate)
                windows[name] = began, now()
            result = await swarm.finish(GRACE_S)
    finally:
        server.stop()
    others = {name: summarise_window(result.commands, *window) for name, window in windows.items()}
    for name, row in rows.items():
        quiet, beside = others[f"quiet before {name}"], others[name]
        row |= {
            "p99_ratio": beside["p99_ms"] / quiet["p99_ms"], "p99_ms": beside["p99_ms"],
            "others_failed": {code: n for code, n in beside["codes"].items() if code not in ("ok", "")},
        }  # fmt: skip
    return {"attacks": rows, "others": others}


def hostile_requests(server: Server, only: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Return a robot, a service and a payload for each hostile request; each map has a robot of its own."""
    keyframe = honest_view()
    view = {
        "camera": keyframe.camera, "pixels": keyframe.pixels.ravel().astype(float),
        "descriptors": keyframe.descriptors.tobytes(),
    }  # fmt: skip
    corpus = runpy.run_path(str(CORPUS))["hostile_maps"]()
    chosen = [data for name, data in corpus.items() if re.search(only, name)]
    made: list[tuple[str, str, dict[str, Any]]] = []
    honest_map = encode_map(make_world(3).walk("honest", np.linspace(0, 0.2, 8), 3)[0])
    beside = server.store_all([f"hostile-merge-{number}" for number in range(len(chosen))], honest_map)
    for number, data in enumerate(chosen):
        robots = {service: f"hostile-{service}-{number}" for service in ("place", "localise", "merge")}
        reference = server.store_all(robots.values(), data)
        for service, robot in robots.items():
            payload = {"maps": [reference, beside]} if service == "merge" else {"map": reference, **view}
            made.append((robot, service, payload))
    for number, cloud in enumerate(hostile_clouds()):
        request = {"target": cloud, "source": cloud, "T_target_source": np.eye(4).ravel()}
        made.append((f"hostile-icp-{number}", "icp", request))
    return made


def hostile_clouds() -> Iterable[np.ndarray]:
    """Yield clouds that are expensive or absurd: one point, one line, far apart, not numbers."""
    rng = np.random.default_rng(5)
    yield np.zeros(9_000)
    yield np.repeat(np.linspace(0, 1e300, 3_000), 3)
    yield rng.normal(size=9_000) * 1e12
    yield np.full(9_000, 1e-300)
    yield rng.normal(size=9_000)


def honest_view() -> Keyframe:
    """Return what a camera in the simulated hall sees."""
    world = make_world(3)
    return world.keyframe(0, "view", world.pose(0.05), world.pose(0.05), np.random.default_rng(9))


async def attack(
    server: Server, requests: list[tuple[str, str, dict[str, Any]]], *, seconds: float, per_s: float
) -> dict[str, Any]:
    """Send *requests*, several at a time, again and again for *seconds*, each at least once.

    Returns:
        How they ended, and by how much memory grew.
    """
    waiting = collections.deque(requests)
    sent = 0
    codes: collections.Counter[str] = collections.Counter()
    slowest_s = 0.0
    before, began = _own_mib(server.serving), time.monotonic()
    most = {"serving": before, "all": _own_mib(_family(server.serving))}
    all_before = most["all"]

    async def work() -> None:
        nonlocal slowest_s, sent
        while sent < len(requests) or time.monotonic() < began + seconds:
            robot_name, service, payload = waiting[0]
            waiting.rotate(-1)
            sent += 1
            await asyncio.sleep(began + sent / per_s - time.monotonic())
            asked = time.monotonic()
            try:
                async with server.robot(robot_name) as robot:
                    if service == "merge":
                        await robot.call(service, payload, on_progress=lambda done, what: None)
                    else:
                        await robot.call(service, payload)
                codes[f"{service} ok"] += 1
            except RsePfError as error:
                codes[f"{service} {error.code}"] += 1
            slowest_s = max(slowest_s, time.monotonic() - asked)

    working = asyncio.gather(*(work() for _ in range(ATTACKERS)))
    while not working.done():
        await asyncio.wait({working}, timeout=0.05)
        most["serving"] = max(most["serving"], _own_mib(server.serving))
        most["all"] = max(most["all"], _own_mib(_family(server.serving)))
    working.result()
    return {
        "n": sent, "codes": dict(sorted(codes.items())), "took_s": time.monotonic() - began,
        "slowest_s": slowest_s, "grown_mib": most["serving"] - before,
        "all_grown_mib": most["all"] - all_before, "kept_mib": _own_mib(server.serving) - before,
    }  # fmt: skip


def _family(pids: Sequence[int]) -> list[int]:
    """Return these processes and all that they and their threads started."""
    family = list(pids)
    for pid in family:
        for children in Path(f"/proc/{pid}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                family += [int(child) for child in children.read_text().split() if int(child) not in family]
    return family


def _own_mib(pids: Iterable[int]) -> float:
    """Return the resident memory of these processes alone, MiB."""
    total = 0
    for pid in pids:
        with contextlib.suppress(OSError):
            total += int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return total * os.sysconf("SC_PAGE_SIZE") / 2**20


# --- the cost of a limited process ----------------------------------------------------------------------


async def honest(args: Options, folder: Path) -> dict[str, Any]:
    """Ask two servers the same, in turns."""
    trees = {"after": args.tree.absolute(), "before": args.before.absolute()}
    servers = {name: Server(folder / name, workers=1, tree=tree) for name, tree in trees.items()}
    draw, report = random.Random(7), {}
    try:
        for kind, (service, make) in HONEST.items():
            payloads = {name: make(server) for name, server in servers.items()}
            took: dict[str, list[float]] = {name: [] for name in servers}
            robots = {name: await server.robot("honest").__aenter__() for name, server in servers.items()}
            first = {}
            for number in range(-5, args.n):
                for name in draw.sample(sorted(servers), len(servers)):
                    began = time.perf_counter()
                    await robots[name].call(service, payloads[name], deadline_s=30.0)
                    took_ms = (time.perf_counter() - began) * 1e3
                    first.setdefault(name, took_ms)
                    if number >= 0:
                        took[name].append(took_ms)
            for robot in robots.values():
                await robot.close()
            report[kind] = {
                name: {"first_ms": first[name], **spread(values)} for name, values in took.items()
            }
            before, after = report[kind]["before"], report[kind]["after"]
            ratios = {name: after[name] / before[name] for name in ("p50", "p95", "p99")}
            report[kind]["ratio"] = ratios
            say({"kind": kind, **report[kind]})
    finally:
        for server in servers.values():
            server.stop()
    return {"n": args.n, "honest": report}


def _place(keyframes: int, *, service_options: dict[str, Any]) -> Callable[..., Any]:
    def make(server: Server) -> dict[str, Any]:
        world = make_world(3)
        version, _ = world.walk("honest", np.linspace(0, 1, keyframes), 3)
        data, view = encode_map(version), honest_view()
        return {
            "map": server.store_all(["honest"], data), "camera": view.camera,
            "pixels": view.pixels.ravel().astype(float), "descriptors": view.descriptors.tobytes(),
            **service_options,
        }  # fmt: skip

    return make


def _icp(server: Server) -> dict[str, Any]:
    target = make_room(5, points=1000)
    motion = exp_se3(np.array([0.03, -0.02, 0.01, 0.01, 0.0, 0.02]))
    source = target @ motion[:3, :3].T + motion[:3, 3]
    return {"target": target.ravel(), "source": source.ravel(), "T_target_source": np.eye(4).ravel()}


HONEST: dict[str, tuple[str, Callable[..., Any]]] = {
    "place, 20 keyframes": ("place", _place(20, service_options={})),
    "place, unchecked": ("place", _place(20, service_options={"check": False})),
    "localise, 20 keyframes": ("localise", _place(20, service_options={})),
    "localise, 200 keyframes": ("localise", _place(200, service_options={})),
    "icp, 3,000 points": ("icp", _icp),
}
