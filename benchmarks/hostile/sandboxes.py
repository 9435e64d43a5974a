"""Measure what sandboxes cost, and what the crashes of one robot cost the others: the table of issue 5.

    python -m benchmarks hostile.sandboxes [--only cost released ...] [--crash-seconds 60]

Real servers and robots on this machine, on shared cores.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import statistics
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from benchmarks.frame.registry import benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import percentile
from benchmarks.server.serving import BenchServer
from client_sdk import connect
from rse_pf.cli.main import main as rse_pf
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.pnp.problems import make_problem
from rse_pf.services.custom.installed import install, read_service
from rse_pf.services.custom.runtime import open_runtime
from rse_pf.services.pnp import make_request

LANGUAGES = ("python", "cpp", "lua")
POINTS = {"points": [float(i % 7) for i in range(300)]}
HARD = """
import os
import msgspec

class Request(msgspec.Struct):
    do: str = "add"
    number: int = 0

class Reply(msgspec.Struct):
    count: int = 0

class Service:
    def __init__(self):
        self.count = 0
    def snapshot(self):
        return str(self.count).encode()
    def restore(self, data):
        self.count = int(data)
    def serve(self, request: Request) -> Reply:
        if request.do == "crash":
            os.abort()
        self.count += 1
        return Reply(count=self.count)
"""
Row = dict[str, Any]
ROWS = ("cost", "released", "poison", "state", "crashes")


class Server:
    """One backend server in processes of its own, without a load balancer."""

    def __init__(self, server: BenchServer) -> None:
        self._server = server
        self._url = f"ws://127.0.0.1:{server.port}/ws"

    def robot(self, name: str, tenant: str = DEFAULT_TENANT) -> Any:
        """Return a robot that is not yet connected."""
        return connect(self._url, token=self._server.token(name, tenant), codec="bin")

    def ready(self) -> Row:
        """Return the answer of /readyz."""
        return self.control("/readyz")

    def control(self, path: str) -> Row:
        """Return what the control port answers."""
        url = f"http://127.0.0.1:{self._server.control_port}{path}"
        try:
            with urllib.request.urlopen(url, timeout=5) as answer:
                return dict(json.loads(answer.read()))
        except urllib.error.HTTPError as error:
            with error:
                return dict(json.loads(error.read()))

    def processes(self) -> dict[int, str]:
        """Return the pids below the server, and what each is called."""
        return dict(_below(self._server.pid))

    def descriptors(self) -> int:
        """Return how many descriptors all of them hold."""
        count = 0
        for pid in self.processes():
            with contextlib.suppress(OSError):
                count += len(os.listdir(f"/proc/{pid}/fd"))
        return count


def _below(pid: int) -> Iterator[tuple[int, str]]:
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = stat.read_text().rpartition(")")
        except OSError:
            continue
        if int(rest.split()[1]) == pid:
            yield int(stat.parent.name), name.partition("(")[2]
            yield from _below(int(stat.parent.name))


def unique_mib(pid: int) -> float:
    """Return the memory that only this process holds (USS)."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) / 1024


@contextlib.asynccontextmanager
async def serving(folder: Path, **services: Any) -> AsyncIterator[Server]:
    """Serve for the length of a block."""
    chosen = {"folder": str(folder / "services"), "accept_weak_isolation": True, **services}
    session = {"max_commands_per_s": 0.0}  # calls follow one another at once
    store = {"store": f"dir:{folder / 'store'}"}
    with BenchServer(folder, workers=1, session=session, services=chosen, data=store) as server:
        yield Server(server)


async def cost(folder: Path, robots: int = 8, calls: int = 200) -> list[Row]:
    """First and following answers, and memory, of each language."""
    rows = []
    async with serving(folder) as server:
        echo = await _median_ms(server, "echo", {"value": "x" * 900}, calls)
        for language in LANGUAGES:
            name = f"bench-{language}"
            runtime = open_runtime(read_service(folder / "services" / name), folder)
            runtime.call(POINTS)
            began = time.perf_counter()
            for _ in range(calls):
                runtime.call(POINTS)
            direct = 1e3 * (time.perf_counter() - began) / calls
            first, before = [], set(server.processes())
            async with contextlib.AsyncExitStack() as stack:
                for i in range(robots):
                    robot = await stack.enter_async_context(server.robot(f"{language}-{i}"))
                    began = time.perf_counter()
                    await robot.call(name, POINTS, deadline_s=5)
                    first.append(time.perf_counter() - began)
                memory = [unique_mib(pid) for pid in set(server.processes()) - before]
            following = await _median_ms(server, name, POINTS, calls)
            rows.append({
                "row": f"cost, {language}", "first_answer_median_ms": 1e3 * percentile(first, 50),
                "first_answer_worst_ms": 1e3 * percentile(first, 100), "direct_ms": direct,
                "following_median_ms": following, "echo_median_ms": echo,
                "overhead_over_echo_and_direct_ms": following - echo - direct,
                "overhead_with_network_ms": following - direct,
                "processes_per_sandbox": len(memory) / robots,
                "unique_mib_per_sandbox": sum(memory) / robots,
            })  # fmt: skip
    return rows


async def _median_ms(server: Server, name: str, payload: Any, calls: int) -> float:
    times = []
    async with server.robot("median") as robot:
        for _ in range(calls + 10):
            began = time.perf_counter()
            await robot.call(name, payload, deadline_s=5)
            times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times[10:])


async def crashes(folder: Path, seconds: float, others: int = 20, count: int = 50) -> list[Row]:
    """Let one robot crash its sandbox while others do PnP, alternating with times without crashes."""
    rows, turns = [], 4
    for crash_limit in (100_000, None):
        limits = {} if crash_limit is None else {"breaker_crashes": crash_limit}
        async with serving(folder, **limits) as server:
            times: dict[bool, list[float]] = {False: [], True: []}
            failed: list[str] = []
            victims: list[tuple[str, float]] = []
            for _ in range(turns if crash_limit else 1):
                for crashing in (False, True):
                    part_s = seconds / turns
                    end = time.perf_counter() + part_s
                    each = [
                        pnp_robot(server, f"other-{i}", end, i / others, Answers(times[crashing], failed))
                        for i in range(others)
                    ]
                    if crashing:
                        each.append(_crash_robot(server, end, count // turns + 1, part_s, victims))
                    await asyncio.gather(*each)
            quiet, busy = 1e3 * percentile(times[False], 99), 1e3 * percentile(times[True], 99)
            codes = [code for code, _ in victims]
            rows.append({
                "row": f"{len(victims)} crashes, circuit breaker {'off' if crash_limit else 'as by default'}",
                "others_commands": len(times[False]) + len(times[True]), "others_failed": len(failed),
                "others_p99_quiet_ms": quiet, "others_p99_crashing_ms": busy, "ratio": busy / quiet,
                "victims": {code: codes.count(code) for code in sorted(set(codes))},
                "victim_worst_ms": 1e3 * max(took for _, took in victims),
                "readyz": server.ready(),
            })  # fmt: skip
    return rows


class Answers(NamedTuple):
    """How long requests took from their planned time on, and the codes of those that failed."""

    times_s: list[float]
    failed: list[str]


async def pnp_robot(
    server: Server, name: str, end: float, phase: float, answers: Answers, *, period_s: float = 1.0
) -> None:
    """Request a pose every *period_s*, from *phase* periods from now until *end*; fill *answers*."""
    problem = make_problem(n=200, outlier_ratio=0.3, seed=int(phase * 1000))
    request = make_request(problem.points_world, problem.pixels, problem.camera, binary=True)
    async with server.robot(name) as robot:
        planned = time.perf_counter() + phase * period_s
        while planned < end:
            await asyncio.sleep(max(0.0, planned - time.perf_counter()))
            try:
                await robot.call("pnp", request, deadline_s=5)
            except RsePfError as error:
                answers.failed.append(error.code)
            answers.times_s.append(time.perf_counter() - planned)
            planned += period_s


async def _crash_robot(
    server: Server, end: float, count: int, part_s: float, victims: list[tuple[str, float]]
) -> None:
    async with server.robot("victim") as robot:
        for i in range(count):
            await asyncio.sleep(max(0.0, end - part_s * (1 - i / count) - time.perf_counter()))
            began = time.perf_counter()
            try:
                await robot.call("hard", {"do": "crash", "number": len(victims)}, deadline_s=3)
                victims.append(("answered", time.perf_counter() - began))
            except RsePfError as error:
                victims.append((error.code, time.perf_counter() - began))


async def poison(folder: Path, requests: int = 5000) -> list[Row]:
    """Send one request that crashes its sandbox among many good ones."""
    codes: list[str] = []
    async with serving(folder) as server, server.robot("poisoner") as robot:
        for i in range(requests):
            deadly = i == requests // 2
            try:
                await robot.call("hard-stateless", {"do": "crash" if deadly else "add"}, deadline_s=3)
                codes.append("answered")
            except RsePfError as error:
                codes.append(error.code)
        ready = server.ready()
    return [{
        "row": f"one poison among {requests}",
        "answers": {code: codes.count(code) for code in sorted(set(codes))},
        "readyz": ready,
    }]  # fmt: skip


async def measure_release(folder: Path, robots: int = 10) -> list[Row]:
    """Count processes and descriptors before robots come and after they left."""
    async with serving(folder) as server:
        async with server.robot("first") as robot:
            await robot.call("hard", {}, deadline_s=5)
        await _wait_settled(server, 0)
        before = (len(server.processes()), server.descriptors())
        async with contextlib.AsyncExitStack() as stack:
            for i in range(robots):
                each = await stack.enter_async_context(server.robot(f"robot-{i}"))
                await each.call("hard", {}, deadline_s=5)
            during = (len(server.processes()), server.descriptors())
        began = time.monotonic()
        while (after := (len(server.processes()), server.descriptors())) != before:
            if time.monotonic() - began > 15:
                break
            await asyncio.sleep(0.1)  # looks again, with a deadline
    return [{
        "row": f"{robots} robots leave", "processes_and_descriptors_before": before, "during": during,
        "after": after, "released_after_s": time.monotonic() - began,
    }]  # fmt: skip


async def _wait_settled(server: Server, sandboxes: int) -> None:
    """Wait until only *sandboxes* are left (the grace period is 5 s)."""
    seen, end = -1, time.monotonic() + 12
    while time.monotonic() < end:
        await asyncio.sleep(1.0)
        seen = len(server.processes())
        if seen <= 2 + sandboxes:
            return


async def state(folder: Path, kills: int = 5) -> list[Row]:
    """Kill the server of a counter five times, behind the load balancer; its count must not go back."""
    from rse_pf.local.control.control_plane import ControlOptions
    from rse_pf.local.control.platform import LocalPlatform
    from rse_pf.local.faults.faults import signal_tree
    from rse_pf.local.state import read_state

    chosen = PlatformSettings().replace(
        services={"folder": str(folder / "services"), "accept_weak_isolation": True}
    )
    counts: list[int] = []
    failures: list[str] = []
    place = folder / "platform"
    async with (
        LocalPlatform(
            chosen, state=place, servers=2, port=0, name="bench", control=ControlOptions(elastic=True)
        ) as cloud,
        connect(cloud.url, token=cloud.issue_token("counter")) as robot,
    ):
        for _ in range(kills):
            holder = await _count(robot, 20, counts, failures)
            signal_tree(
                next(s for s in read_state(place).servers if s.name == holder).process, signal.SIGKILL
            )
            await _count(robot, 5, counts, failures)
        await _count(robot, 20, counts, failures)
    back = sum(b <= a for a, b in itertools.pairwise(counts))
    return [{
        "row": f"counter, {kills} servers killed", "answered": len(counts), "last_count": counts[-1],
        "went_back": back, "failures": {code: failures.count(code) for code in sorted(set(failures))},
    }]  # fmt: skip


async def _count(robot: Any, times: int, counts: list[int], failures: list[str]) -> str:
    """Ask so often, trying again for 20 s what failed; return who answered last."""
    holder = ""
    for _ in range(times):
        end = time.monotonic() + 20
        while time.monotonic() < end:
            try:
                answer = await robot.call("hard", {}, deadline_s=3)
            except RsePfError as error:
                failures.append(error.code)
                await asyncio.sleep(0.1)  # the robot's own pace after a failure
            else:
                counts.append(answer.reply["count"])
                holder = answer.server
                break
    return holder


def prepare(folder: Path) -> None:
    """Write and install the measured services, like an author."""
    here = Path.cwd()
    os.chdir(folder)
    try:
        for language in LANGUAGES:
            name = f"bench-{language}"
            if rse_pf(["service", "new", name, "--lang", language]) or rse_pf(
                ["service", "install", name, "--services", "services"]
            ):
                raise SystemExit(f"{name} was not installed")
    finally:
        os.chdir(here)
    for name, kind, text in (
        ("hard", "per_robot_state", HARD),
        ("hard-stateless", "stateless", HARD.replace("snapshot", "keep").replace("restore", "take")),
    ):
        made = folder / name
        made.mkdir()
        (made / "service.py").write_text(text)
        (made / "service.json").write_text(
            json.dumps({"name": name, "language": "python", "entry": "service.py", "kind": kind})
        )
        install(made, folder / "services")


async def measure(only: list[str], crash_s: float) -> list[Row]:
    """Return the rows and print each as soon as it is measured."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="rse-pf-sandboxes-") as temporary:
        folder = Path(temporary)
        prepare(folder)
        works = {
            "cost": lambda: cost(folder), "released": lambda: measure_release(folder),
            "poison": lambda: poison(folder), "state": lambda: state(folder),
            "crashes": lambda: crashes(folder, crash_s),
        }  # fmt: skip
        for name in only:
            for row in await works[name]():
                say(row)
                rows.append(row)
    return rows


@benchmark()
def run_benchmark(
    *, only: Annotated[tuple[str, ...], "rows", ROWS] = ROWS, crash_seconds: float = 60.0
) -> dict[str, Any]:
    """Measure the rows."""
    return {"rows": asyncio.run(measure(list(only), crash_seconds))}
