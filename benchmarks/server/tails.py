"""p99 of robots beside hostile or heavy neighbours, as a ratio to quiet windows of the same run.

    python -m benchmarks server.tails [--only bombs] [--rounds 7]

Robots request 5 poses a second each (200 matches, 30 % wrong, every frame kept), from one run of the load
generator; quiet and loaded windows alternate, so that a slower machine slows both.  Latency counts from the
planned time.  A row's ratio is the median of its loaded windows' p99 over that of its quiet ones.

==========  ===========================================================================  ======
row         beside the robots                                                            bar
==========  ===========================================================================  ======
bombs       20 robots; 1,000 messages of 255 KB that would inflate to 256 MiB            2
rate        99 robots; one robot at 100 times their rate, back when it is cut off        1.5
silent      100 robots; 1,000 TCP connections that say nothing, 50 from each address     2
returns     500 robots; 1,000 others connect with new tokens, 150 at a time              2
uploads     20 robots; objects of 1 MiB to the data service, which is killed meanwhile   1.1
==========  ===========================================================================  ======

The thousand must be connected again within 5 s.  All rows but the last meet one server of two workers
directly, the last one the whole platform through the load balancer.  The neighbours run at the lowest
priority: in the field their work costs a server nothing.

Defends: those bars, and that every command of the robots is answered by a pose.
"""

from __future__ import annotations

import asyncio
import json
import statistics
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from benchmarks.data.faults import Uploads, kill_during_uploads
from benchmarks.frame.registry import Bar, benchmark, command_of
from benchmarks.frame.report import say
from benchmarks.frame.statistics import percentile
from benchmarks.hostile import attacks
from benchmarks.server.load import (
    LoadPlan,
    LoadProcess,
    RobotGroup,
    compile_generator,
    hello_file,
    plan_of,
    read_samples,
    run_load,
)
from benchmarks.server.serving import BenchServer, private_bytes_of_tree
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform

CODEC = "bin"
FRAMES_PER_S = 5.0
"""The paper's rate (Sect. 6.2)."""
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "bombs": {}, "rate": {}, "silent": {"serving": {"trusted_proxies": 0}}, "returns": {},
    "uploads": {},
}  # fmt: skip
"""Settings of each row beside the defaults: without a proxy, limits for each address count."""
WORKERS = 2
LONGEST_S = 600.0
SETTLE_S, PAUSE_S = 1.0, 0.5
NEIGHBOURS_FIRST_SOURCE = 100
BOMBERS, BOMB_WINDOW_S, BOMB_ROUNDS = 100, 6.0, 5
RATE_WINDOW_S, RATE_FACTOR, RATE_REOPEN_S = 4.0, 100.0, 0.1
SILENT_WINDOW_S, SILENT, SILENT_SOURCES = 5.0, 1000, 20
RETURN_WINDOW_S, DRIVING, RETURNING, BACK_S = 6.0, 500, 1000, 5.0
RETURNING_AT_ONCE = 150
"""A server cuts sockets above serving.max_unauthenticated, 200, that have not sent yet."""
UPLOAD_WINDOW_S, UPLOADS, UPLOAD_ROUNDS, MIB = 5.0, 24, 5, 1 << 20
_LOWEST_PRIORITY = ("nice", "-n", "19")
_ATTACK_S = 60.0

Neighbour = Callable[[], dict[str, Any]]
"""What begins at once, and returns what came of it when it has ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadWindow:
    """One window of a run, by the monotonic clock."""

    is_loaded: bool
    begin_s: float
    end_s: float


def summarise(samples: npt.NDArray[np.void], windows: Sequence[LoadWindow]) -> list[dict[str, Any]]:
    """Return what the robots saw in each window."""
    rows = []
    for window in windows:
        planned = samples["planned_s"]
        chosen = samples[(planned >= window.begin_s) & (planned < window.end_s)]
        took_ms = 1e3 * chosen["latency_s"][chosen["outcome"] == 0]
        p50, p99 = percentile(took_ms, [50, 99])
        rows.append(
            {
                "is_loaded": window.is_loaded, "seconds": window.end_s - window.begin_s, "n": len(chosen),
                "not_ok": int(len(chosen) - len(took_ms)), "p50_ms": float(p50), "p99_ms": float(p99),
            }
        )  # fmt: skip
    return rows


def summary(name: str, windows: list[dict[str, Any]], outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return one row of the table."""
    row: dict[str, Any] = {"row": name, "outcomes": _add_up(outcomes), "windows": windows}
    for kind, is_loaded in (("quiet", False), ("loaded", True)):
        chosen = [window for window in windows if window["is_loaded"] == is_loaded]
        row[kind] = {
            "windows": len(chosen), "n": sum(window["n"] for window in chosen),
            "not_ok": sum(window["not_ok"] for window in chosen),
            "p50_ms": statistics.median(window["p50_ms"] for window in chosen),
            "p99_ms": statistics.median(window["p99_ms"] for window in chosen),
        }  # fmt: skip
    row["ratio"] = row["loaded"]["p99_ms"] / row["quiet"]["p99_ms"]
    return row


def _add_up(outcomes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return counts added up, and the largest of all other figures."""
    made: dict[str, Any] = {}
    for outcome in outcomes:
        for name, value in outcome.items():
            if isinstance(value, dict):
                made[name] = dict(Counter(made.get(name, {})) + Counter(value))
            elif isinstance(value, int):
                made[name] = made.get(name, 0) + value
            else:
                made[name] = max(made.get(name, value), value)
    return made


def robots_of(name: str, count: int, folder: Path, token_of: Callable[[str], str], port: int) -> LoadPlan:
    """Return the plan of the robots that are measured."""
    scenario = LoadScenario(robots=count, fps=FRAMES_PER_S, seconds=LONGEST_S, codec=CODEC)
    tokens = folder / f"{name}.tokens"
    tokens.write_text("\n".join(token_of(f"{name}-{number}") for number in range(count)))
    return replace(
        plan_of(scenario, folder, port), tokens=tokens, sources=4, warm_up_s=SETTLE_S, drain_s=1.0,
        samples=folder / f"{name}.samples",
    )  # fmt: skip


def alternate(
    plan: LoadPlan, rounds: int, window_s: float, prepare: Callable[[int], Neighbour]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return what the robots saw in quiet and loaded windows in turn, and what came of the neighbours."""
    windows: list[LoadWindow] = []
    outcomes = []
    with LoadProcess(plan) as load:
        load.wait_begun()
        for number in range(rounds):
            neighbour = prepare(number)
            time.sleep(PAUSE_S)  # pauses and windows are parameters of the measurement
            began = time.monotonic()
            time.sleep(window_s)
            middle = time.monotonic()
            outcomes.append(neighbour())
            time.sleep(max(0.0, middle + window_s - time.monotonic()))
            windows.append(LoadWindow(is_loaded=False, begin_s=began, end_s=middle))
            windows.append(LoadWindow(is_loaded=True, begin_s=middle, end_s=time.monotonic()))
        load.stop()
    assert plan.samples is not None
    return summarise(read_samples(plan.samples), windows), outcomes


@contextmanager
def one_server(row: str) -> Iterator[tuple[BenchServer, Path]]:
    """Yield a server that requires tokens, and a folder for files."""
    with (
        tempfile.TemporaryDirectory() as folder,
        BenchServer(Path(folder), workers=WORKERS, **SETTINGS[row]) as server,
    ):
        yield server, Path(folder)


def bombs(rounds: int) -> dict[str, Any]:
    """Measure 20 robots beside 1,000 zip bombs."""
    with one_server("bombs") as (server, folder):
        url = f"ws://127.0.0.1:{server.port}/ws"

        def prepare(number: int) -> Neighbour:
            tokens = json.dumps([server.token(f"hostile-{number}-{row}") for row in range(BOMBERS)])
            process = subprocess.Popen(
                [*_LOWEST_PRIORITY, *command_of(attacks.run_attack, "zip-bombs", url)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(tokens + "\n")
            process.stdin.flush()
            process.stdout.readline()
            memory = private_bytes_of_tree(server.pid)

            def go() -> dict[str, Any]:
                try:
                    output, _ = process.communicate("go\n", timeout=_ATTACK_S)
                finally:
                    process.kill()
                    process.wait()
                if not output:
                    raise ConfigurationError("the process with the bombs failed", hint="see its output above")
                document: dict[str, Any] = json.loads(output)
                grown = private_bytes_of_tree(server.pid) - memory
                return {name: document[name] for name in ("tried", "refused", "ends", "slowest_s")} | {
                    "grown_mib": grown / MIB
                }

            return go

        plan = robots_of("calm", 20, folder, server.token, server.port)
        return summary("bombs", *alternate(plan, min(rounds, BOMB_ROUNDS), BOMB_WINDOW_S, prepare))


def generator(plan: LoadPlan) -> dict[str, Any]:
    """Run a second load generator at the lowest priority, and return its counts."""
    report = run_load(plan, prefix=_LOWEST_PRIORITY)
    group = report.groups[0]
    return {
        "ok": group.ok, "failed": group.failed, "lost": group.lost, "unsent": group.unsent,
        "closed": report.closed, "refused": report.refused, "codes": report.codes,
    }  # fmt: skip


def rate(rounds: int) -> dict[str, Any]:
    """Measure 99 robots beside one at 100 times their rate."""
    with one_server("rate") as (server, folder):
        fast = LoadScenario(robots=1, fps=RATE_FACTOR * FRAMES_PER_S, seconds=RATE_WINDOW_S, codec=CODEC)

        def prepare(number: int) -> Neighbour:
            tokens = folder / "fast.tokens"
            tokens.write_text(server.token(f"fast-{number}"))
            plan = replace(
                plan_of(fast, folder, server.port), tokens=tokens, warm_up_s=0.0, drain_s=0.1,
                reopen_s=RATE_REOPEN_S, first_source=NEIGHBOURS_FIRST_SOURCE,
            )  # fmt: skip
            return lambda: generator(plan)

        plan = robots_of("calm", 99, folder, server.token, server.port)
        return summary("rate", *alternate(plan, rounds, RATE_WINDOW_S, prepare))


def silent(rounds: int) -> dict[str, Any]:
    """Measure 100 robots beside 1,000 connections that say nothing."""
    with one_server("silent") as (server, folder):
        group = RobotGroup(name="silent", robots=SILENT, mode="silent")
        neighbours = LoadPlan(
            port=server.port, groups=(group,), seconds=SILENT_WINDOW_S, warm_up_s=0.0, drain_s=0.0,
            sources=SILENT_SOURCES, first_source=NEIGHBOURS_FIRST_SOURCE, opening_s=SILENT_WINDOW_S,
        )  # fmt: skip
        plan = robots_of("calm", 100, folder, server.token, server.port)
        figures = alternate(plan, rounds, SILENT_WINDOW_S, lambda number: lambda: generator(neighbours))
        return summary("silent", *figures)


def returns(rounds: int) -> dict[str, Any]:
    """Measure 500 robots beside 1,000 that come back at once."""
    with one_server("returns") as (server, folder):
        group = RobotGroup(name="returning", robots=RETURNING, mode="idle")
        tokens = folder / "returning.tokens"
        neighbours = LoadPlan(
            port=server.port, groups=(group,), codec=CODEC, hello=hello_file(folder, CODEC), tokens=tokens,
            seconds=0.5, warm_up_s=0.0, drain_s=0.0, sources=SILENT_SOURCES, opening_s=RETURN_WINDOW_S,
            first_source=NEIGHBOURS_FIRST_SOURCE, at_once=RETURNING_AT_ONCE, reopen_s=0.1,
        )  # fmt: skip

        def come_back() -> dict[str, Any]:
            report = run_load(neighbours, prefix=_LOWEST_PRIORITY)
            return {"missing": RETURNING - report.connected, "back_s": report.opening_s}

        def prepare(number: int) -> Neighbour:
            tokens.write_text("\n".join(server.token(f"returning-{row}") for row in range(RETURNING)))
            return come_back

        plan = robots_of("driving", DRIVING, folder, server.token, server.port)
        return summary("returns", *alternate(plan, rounds, RETURN_WINDOW_S, prepare))


async def uploads(rounds: int) -> dict[str, Any]:
    """Measure 20 robots beside uploads to a data service that is killed."""
    windows: list[LoadWindow] = []
    outcomes: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        async with LocalPlatform(
            PlatformSettings(), state=folder / "state", port=0, servers=WORKERS, data=True,
            control=ControlOptions(elastic=True),
        ) as cloud:  # fmt: skip
            plan = robots_of("calm", 20, folder, cloud.issue_token, cloud.port)
            with LoadProcess(plan) as load:
                await asyncio.to_thread(load.wait_begun)
                for number in range(rounds):
                    numbers = list(range(number * UPLOADS, (number + 1) * UPLOADS))
                    neighbour = Uploads(cloud, numbers, MIB)
                    await asyncio.sleep(SETTLE_S + PAUSE_S)
                    began = time.monotonic()
                    await asyncio.sleep(UPLOAD_WINDOW_S)
                    middle = time.monotonic()
                    neighbour.begin()
                    back_s = await kill_during_uploads(cloud, neighbour, 1, UPLOADS)
                    await neighbour.until(lambda: False)
                    await asyncio.sleep(max(0.0, middle + UPLOAD_WINDOW_S - time.monotonic()))
                    windows.append(LoadWindow(is_loaded=False, begin_s=began, end_s=middle))
                    windows.append(LoadWindow(is_loaded=True, begin_s=middle, end_s=time.monotonic()))
                    neighbour.close()
                    outcomes.append(
                        {"acknowledged": len(neighbour.acknowledged), "ready_after_s": max(back_s)}
                    )
                await asyncio.to_thread(load.stop)
            assert plan.samples is not None
            return summary("uploads", summarise(read_samples(plan.samples), windows), outcomes)


ROWS: dict[str, Callable[[int], dict[str, Any]]] = {
    "bombs": bombs,
    "rate": rate,
    "silent": silent,
    "returns": returns,
    "uploads": lambda rounds: asyncio.run(uploads(min(rounds, UPLOAD_ROUNDS))),
}


@benchmark(
    Bar("bombs.ratio", at_most=2.0),
    Bar("rate.ratio", at_most=1.5),
    Bar("silent.ratio", at_most=2.0),
    Bar("returns.ratio", at_most=2.0),
    Bar("returns.outcomes.back_s", at_most=BACK_S, unit="s"),
    Bar("returns.outcomes.missing", equals=0),
    Bar("uploads.ratio", at_most=1.1),
    Bar("*.loaded.not_ok", equals=0),
)
def run_benchmark(
    *, only: Annotated[tuple[str, ...], "measure these rows only", ROWS] = (),
    rounds: Annotated[int, "of the short rows; the others have five"] = 7,
) -> dict[str, Any]:  # fmt: skip
    """Measure the rows."""
    compile_generator()
    figures = {}
    for name in only or ROWS:
        figures[name] = ROWS[name](rounds)
        say({"row": name, "ratio": figures[name]["ratio"]})
    return figures
