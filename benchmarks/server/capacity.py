"""Measure how many active robots one server carries, and the memory of 10,000 mostly idle robots.

    python -m benchmarks server.capacity [--workers 1 2] [--codec bin] [--balancer] [--connected 10000]

Each active robot sends 5 real PnP commands a second (200 matches, 30 % wrong, no frame is dropped) in an open
loop: send times are fixed before each step, and latency counts from the planned time.  A server carries the
robots of a step if every command in the step's window returned a pose, with a p99 of the latency <= 150 ms.
The number is doubled until a step fails twice, and then bisected to 7 %.  Robots, server and load generator
share the cores.  With ``--balancer`` the robots connect through Envoy to one server of one worker for each of
*workers*, with tokens.

Then 10,000 robots are connected, of which 500 send one frame a second and the others a ping every 2 s, as
the SDK does.  The figure is the growth of the private memory of the server's processes since before the first
robot.

Defends the promises that 10,000 connections need at most 16 KiB each and that the capacity does not shrink:
two workers on two cores carry >= 1,000 robots at 5 frames a second, and no command of the active ones of
10,000 connected robots fails.
"""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.server.load import (
    LoadPlan,
    RobotGroup,
    compile_generator,
    group_of,
    hello_file,
    ping_file,
    plan_of,
    run_load,
)
from benchmarks.server.serving import BenchServer, cpu_of_tree_s, private_bytes_of_tree
from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.local.control.platform import LocalPlatform

SETTINGS: dict[str, dict[str, Any]] = {
    "auth": {"required": False},
    "serving": {
        "max_robots": 12_000, "max_accepts_per_s": 0.0, "max_handshakes_per_source_per_s": 0.0,
        "max_unauthenticated": 2000, "max_unauthenticated_per_source": 0,
    },
}  # fmt: skip
"""Settings of the server: a limit of 0 is off.  All robots of a measurement come from few addresses and at
once; every other limit is the default."""

FRAMES_PER_S = 5.0
"""Frames that each robot sends in a second: the rate of the paper (Sect. 6.2)."""
MAX_P99_MS = 150.0  # largest p99 of the latency at which the robots of a step count as carried
MIN_ROBOTS = 1000  # bar: fewest robots that two workers have to carry
MAX_KIB_PER_ROBOT = 16.0  # bar: largest memory of a connected robot
FIRST_ROBOTS = 250  # number of robots of the first step of a search
MAX_ROBOTS = 8000  # largest number of robots that a search tries
PRECISION = 1.07  # a search ends at this ratio of the fewest robots that failed to the most that were carried
CONNECTED = 10_000  # robots that are connected after the searches
CONNECTED_TO_ONE_ACTIVE = 20  # number of connected robots for each active one: 500 of 10,000 are active
PING_EVERY_S = 2.0  # time between two pings of an idle robot
SOURCES = 8  # number of loopback addresses from which the robots connect
WARM_UP_S = 1.0  # time at the beginning of a step that is not measured
DRAIN_S = 1.0  # time after a step in which answers still count
SEARCH_S = 85.0  # time, from the begin of a search, after which no further step begins


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingSite:
    """The port and path to which robots connect, and the number of worker processes that serve them."""

    port: int
    path: str
    workers: int
    tokens: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CapacityStep:
    """The result of one step: how many commands of *robots* robots were answered, and how fast."""

    robots: int
    ok: int
    failed: int
    lost: int
    unsent: int
    p50_ms: float
    p99_ms: float
    late_p99_ms: float
    codes: dict[str, int]
    generator_cores: float

    @property
    def is_carried(self) -> bool:
        """Whether every command returned a pose, and the p99 of the latency is at most `MAX_P99_MS`."""
        return self.ok > 0 and not (self.failed or self.lost or self.unsent) and self.p99_ms <= MAX_P99_MS


def step(site: ServingSite, folder: Path, codec: str, robots: int, seconds: float) -> CapacityStep:
    """Connect *robots* robots to *site*, let them send frames for *seconds*, and return the result."""
    scenario = LoadScenario(robots=robots, fps=FRAMES_PER_S, seconds=seconds, codec=codec)
    plan = replace(
        plan_of(scenario, folder, site.port), path=site.path, tokens=site.tokens, sources=SOURCES,
        warm_up_s=WARM_UP_S, drain_s=DRAIN_S, opening_s=30.0, seed=robots,
    )  # fmt: skip
    report = run_load(plan)
    load = report.groups[0]
    return CapacityStep(
        robots=robots, ok=load.ok, failed=load.failed, lost=load.lost, unsent=load.unsent,
        p50_ms=load.latency_ms.p50, p99_ms=load.latency_ms.p99, late_p99_ms=load.late_ms.p99,
        codes=report.codes, generator_cores=report.cpu_s / seconds,
    )  # fmt: skip


def search(
    try_robots: Callable[[int], CapacityStep], clock: Callable[[], float], search_s: float
) -> list[CapacityStep]:
    """Search the largest number of robots that a server carries; return all steps in their order.

    The number is doubled from `FIRST_ROBOTS` until a step fails twice, then bisected to `PRECISION`.

    Args:
        try_robots: Makes a step with a number of robots.
        clock: Returns seconds.
        search_s: No step begins later than this time, seconds, after the start.
    """
    steps: list[CapacityStep] = []
    until = clock() + search_s

    def is_carried(robots: int) -> bool:
        for _ in range(2):
            steps.append(try_robots(robots))
            say(steps[-1])
            if steps[-1].is_carried or clock() > until:
                break
        return steps[-1].is_carried

    carried, failed, robots = 0, 0, FIRST_ROBOTS
    while not failed and robots <= MAX_ROBOTS and clock() < until:
        if is_carried(robots):
            carried, robots = robots, 2 * robots
        else:
            failed = robots
    while failed > PRECISION * max(carried, 1) and failed > 1 and clock() < until:
        robots = (carried + failed) // 2
        if is_carried(robots):
            carried = robots
        else:
            failed = robots
    return steps


def most_robots(workers: int, codec: str, seconds: float, search_s: float) -> dict[str, Any]:
    """Return the most robots that a server of *workers* processes carries, connected without a balancer.

    Robots are carried if each of their commands returned a pose, with a p99 of at most `MAX_P99_MS`.

    Args:
        workers: Worker processes of the server.
        codec: Codec of the messages: zlib, json or bin.
        seconds: Duration of each step of the search.
        search_s: No step begins later than this time, seconds, after the start of the search.

    Returns:
        See `find_capacity`.
    """
    with serving(workers) as (server, folder):
        site = ServingSite(port=server.port, path="/ws", workers=workers)
        return find_capacity(site, folder, codec, seconds, search_s)


async def most_robots_behind_balancer(
    servers: int, codec: str, seconds: float, search_s: float
) -> dict[str, Any]:
    """Return the most robots, as `most_robots` does, for robots that connect through Envoy with tokens.

    Behind Envoy are *servers* servers of one worker each.
    """
    settings = PlatformSettings.from_dict({"serving": SETTINGS["serving"]})
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        async with LocalPlatform(settings, state=folder / "state", port=0, servers=servers) as cloud:
            tokens = folder / "tokens"
            names = [cloud.issue_token(f"robot-{number}") for number in range(MAX_ROBOTS)]
            tokens.write_text("\n".join(names))
            site = ServingSite(port=cloud.port, path="/ws", workers=servers, tokens=tokens)
            return await asyncio.to_thread(find_capacity, site, folder, codec, seconds, search_s)


def find_capacity(
    site: ServingSite, folder: Path, codec: str, seconds: float, search_s: float = SEARCH_S
) -> dict[str, Any]:
    """Return the most robots that *site* carries (``robots``, 0 for none), ``workers``, and all ``steps``.

    *seconds* and *search_s* are as in `most_robots`.
    """
    step(site, folder, codec, 20, 1.0)  # warms the server up
    steps = search(lambda robots: step(site, folder, codec, robots, seconds), time.monotonic, search_s)
    most = max((tested.robots for tested in steps if tested.is_carried), default=0)
    return {"workers": site.workers, "robots": most, "steps": [asdict(tested) for tested in steps]}


def measure_connected(codec: str, seconds: float, connected: int) -> dict[str, Any]:
    """Connect *connected* robots to a server of two workers; return its memory and CPU, and their answers.

    One robot in twenty is active and sends one frame a second; the others send a ping every 2 s.  The load
    is measured for *seconds*.
    """
    active = connected // CONNECTED_TO_ONE_ACTIVE
    memory: dict[str, int] = {}
    cpu: dict[str, float] = {}
    with serving(2) as (server, folder):
        groups = (
            RobotGroup(
                name="idle", robots=connected - active, mode="early", rate=1 / PING_EVERY_S,
                payload=ping_file(folder, codec),
            ),
            group_of(LoadScenario(robots=active, fps=1.0, codec=codec), folder, "active"),
        )  # fmt: skip
        site = ServingSite(port=server.port, path="/ws", workers=2)
        step(site, folder, codec, 20, 1.0)  # warms the server up
        memory["before"] = private_bytes_of_tree(server.pid)

        def at(mark: str) -> None:
            memory[mark], cpu[mark] = private_bytes_of_tree(server.pid), cpu_of_tree_s(server.pid)

        report = run_load(
            LoadPlan(
                port=server.port, codec=codec, hello=hello_file(folder, codec), groups=groups,
                seconds=seconds, warm_up_s=2 * WARM_UP_S, drain_s=DRAIN_S, sources=2 * SOURCES,
            ),
            at,
        )  # fmt: skip
    idle, awake = report.group("idle"), report.group("active")
    return {
        "robots": report.robots, "connected": report.connected, "opening_s": report.opening_s,
        "kib_per_robot": (memory["end"] - memory["before"]) / report.robots / 1024,
        "server_cores": (cpu["end"] - cpu["begin"]) / seconds, "generator_cores": report.cpu_s / seconds,
        "active": asdict(awake), "idle": asdict(idle), "closed": report.closed, "refused": report.refused,
        "codes": report.codes,
    }  # fmt: skip


@contextlib.contextmanager
def serving(workers: int) -> Iterator[tuple[BenchServer, Path]]:
    """Yield a server of *workers* and a folder for files."""
    with (
        tempfile.TemporaryDirectory() as folder,
        BenchServer(Path(folder), workers=workers, **SETTINGS) as server,
    ):
        yield server, Path(folder)


@benchmark(
    Bar("robots_carried.2", at_least=MIN_ROBOTS, unit="robots at 5 fps"),
    Bar("connected.kib_per_robot", at_most=MAX_KIB_PER_ROBOT, unit="KiB"),
    Bar("connected.active.failed", at_most=0),
    Bar("connected.active.lost", at_most=0),
)
def run_benchmark(
    *,
    workers: Annotated[tuple[int, ...], "workers of each search"] = (1, 2),
    codec: Literal["zlib", "json", "bin"] = "bin",
    balancer: Annotated[bool, "through Envoy, with tokens"] = False,
    connected: Annotated[int, "robots that are connected after the searches; 0 leaves this out"] = CONNECTED,
    seconds: Annotated[float, "of each step"] = 5.0,
    search_s: Annotated[float, "no step of a search begins after this time"] = SEARCH_S,
) -> dict[str, Any]:
    """Search the most robots for each number of workers, then connect robots that are mostly idle."""
    compile_generator()
    searches = []
    for count in workers:
        if balancer:
            searches.append(asyncio.run(most_robots_behind_balancer(count, codec, seconds, search_s)))
        else:
            searches.append(most_robots(count, codec, seconds, search_s))
    return {
        "settings": {"serving": SETTINGS["serving"]} if balancer else SETTINGS, "searches": searches,
        "robots_carried": {str(found["workers"]): found["robots"] for found in searches},
        **({"connected": measure_connected(codec, 2 * seconds, connected)} if connected else {}),
    }  # fmt: skip
