"""One run of ``rse-pf swarm``: run the robots for a time, show progress, write the records and a report.

The folder of results gets ``commands.csv``, ``events.jsonl``, ``report.json``, and ``scenario.json``, with
which the run can be repeated.  The report is computed from the commands and the figures of the load
generator.  No key is written to the folder.
"""

from __future__ import annotations

import asyncio
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk import connect
from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.load.scenario import LoadScenario, write_scenario
from rse_pf.extensions.experiments.load.swarm import Swarm, SwarmResult
from rse_pf.extensions.experiments.load.swarm_process import ResultRows
from rse_pf.extensions.experiments.results.records import (
    COMMANDS,
    EVENTS,
    EventLog,
    write_commands,
)
from rse_pf.extensions.experiments.results.result_folder import (
    environment,
    fresh_folder,
    load_average,
    write_json,
)
from rse_pf.extensions.experiments.results.summary import (
    frame_rates,
    percent_answered,
    percentiles,
    summarise,
)
from rse_pf.extensions.recording.platform_recorder import make_platform_recorder
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.terminal import show, show_page

__all__ = ["FAST_MS", "TargetPlatform", "report_of", "run_swarm", "table_of"]

SCENARIO = "scenario.json"  # name of the file with the description of the load
FAST_MS = 150.0
"""A command that is answered within this many ms counts as answered in time.

The paper's mean is 156.36 ms.
"""

# Longest wait until all robots have joined, beyond their joining times, in seconds.
_JOIN_TIMEOUT_S = 30.0
# Time between two lines of progress, in seconds.
_PROGRESS_INTERVAL_S = 1.0


@dataclass(frozen=True, slots=True)
class TargetPlatform:
    """A platform that runs already: its address, and a function that returns a token for a robot's name."""

    url: str
    token_of: Callable[[str], str]


def run_swarm(
    scenario: LoadScenario,
    settings: PlatformSettings,
    *,
    out: Path,
    platform: TargetPlatform | None = None,
    quiet: bool = False,
) -> int:
    """Run *scenario* on *platform*, write records and report to *out*, and print the report.

    If *platform* is None, a local platform is started for the run.  *quiet* prints no progress.

    Returns:
        1 if a command was lost or answered twice, if a reply was wrong, or if nothing was answered; otherwise
        0.
    """
    if platform is not None:
        asyncio.run(_check(platform, settings))
    folder = fresh_folder(out, [SCENARIO, "report.json", COMMANDS, EVENTS])
    write_scenario(folder / SCENARIO, scenario)
    before = environment(settings)
    with (folder / EVENTS).open("w", encoding="utf-8") as file:
        result = asyncio.run(_run(scenario, settings, platform, EventLog(file), quiet))
    write_commands(folder / COMMANDS, result.commands)
    report = report_of(scenario, result, before)
    write_json(folder / "report.json", report)
    show_page(table_of(report, folder))
    commands = report["commands"]
    return 1 if commands["lost"] or result.duplicates or result.wrong_poses or not commands["answered"] else 0


def report_of(scenario: LoadScenario, result: SwarmResult, before: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of ``report.json``: figures of *result*, *scenario*, and the environment *before*.

    The frame rate of a robot is the number of its answered commands, divided by the time from its first to
    its last planned command and one frame interval.
    """
    sent = max(1, len(result.commands))
    return {
        **summarise(result.commands),
        "answered_percent": percent_answered(result.commands) or 0.0,
        "answered_in_time_percent": percent_answered(result.commands, FAST_MS) or 0.0,
        "in_time_ms": FAST_MS,
        "fps_per_robot": percentiles(frame_rates(result.commands)),
        "wrong_poses": result.wrong_poses,
        "twice": result.duplicates,
        "reconnects": result.reconnects,
        "resent": result.resent,
        "moves": result.moves,
        "held_back": result.held_back,
        "generator": {
            "cpu_s": result.cpu_s,
            "wall_s": result.wall_s,
            "cpu_percent": round(100.0 * result.cpu_s / max(result.wall_s, 1e-9), 2),
            "cpu_us_per_command": round(1e6 * result.cpu_s / sent, 1),
            "late_sends_ms_p99": result.late_sends_ms_p99,
            "load_average_after": load_average(),
        },
        "asked": asdict(scenario),
        "environment": dict(before),
    }


async def _run(
    scenario: LoadScenario,
    settings: PlatformSettings,
    platform: TargetPlatform | None,
    events: EventLog,
    quiet: bool,
) -> SwarmResult:
    origin = time.monotonic()
    async with AsyncExitStack() as stack:
        if platform is None:
            _say(quiet, "starting the platform")
            state = Path(tempfile.mkdtemp(prefix="rse-pf-swarm-"))
            stack.callback(shutil.rmtree, state, ignore_errors=True)
            local = await stack.enter_async_context(
                LocalPlatform(
                    settings,
                    state=state,
                    port=0,
                    name="swarm",
                    on_event=lambda event: events.copy(event, time.monotonic() - origin),
                    recorder=make_platform_recorder(settings, state),
                )
            )
            platform = TargetPlatform(local.url, local.issue_token)
        who = "1 robot sends" if scenario.robots == 1 else f"{scenario.robots} robots send"
        _say(quiet, f"{who} {scenario.fps:g} commands per second each to {platform.url}")
        swarm = await stack.enter_async_context(
            Swarm(
                scenario,
                url=platform.url,
                token_of=platform.token_of,
                session=settings.session,
                on_event=lambda event: events.copy(event, float(event["time"])),
                origin=origin,
            )
        )
        screen = asyncio.create_task(_show(swarm, quiet))
        stack.callback(screen.cancel)
        await swarm.start()
        await swarm.wait_joined(scenario.robots * scenario.join_every_s + _JOIN_TIMEOUT_S)
        await asyncio.sleep(scenario.seconds)
        return await swarm.finish(scenario.deadline_s)


async def _check(platform: TargetPlatform, settings: PlatformSettings) -> None:
    """Connect one robot, so that the error of a platform that cannot be reached is raised at once.

    Without this, the robots would retry for 30 s, and the error would not name the cause.
    """
    async with connect(platform.url, token=platform.token_of("swarm-check"), settings=settings.session):
        pass


async def _show(swarm: Swarm, quiet: bool) -> None:
    """Print each second, until cancelled: connected robots, answers per second and their round trips."""
    seen, last_s = 0, time.monotonic()
    while not quiet:
        await asyncio.sleep(_PROGRESS_INTERVAL_S)
        fresh, seen = swarm.rows[seen:], len(swarm.rows)
        elapsed_s, last_s = time.monotonic() - last_s, time.monotonic()
        trips = np.concatenate([_round_trips_ms(rows) for rows in fresh] or [np.empty(0)])
        count = len(swarm.joined) - len(swarm.left)
        line = f"{count:5} {'robot ' if count == 1 else 'robots'} {len(trips) / elapsed_s:7.0f} answered/s"
        if len(trips):
            p50, p99 = np.percentile(trips, [50, 99])
            line += f"   p50 {p50:7.1f} ms   p99 {p99:7.1f} ms"
        _say(quiet, line)


def _round_trips_ms(rows: ResultRows) -> np.ndarray[Any, np.dtype[np.float64]]:
    table = np.array(rows.numbers).reshape(-1, ResultRows.WIDTH)
    answered = np.array([code == "ok" for code in rows.codes], dtype=np.bool_)
    trips: np.ndarray[Any, np.dtype[np.float64]] = 1e3 * (table[answered, 4] - table[answered, 2])
    return trips


def table_of(report: Mapping[str, Any], folder: Path) -> str:
    """Return the main figures of *report* as the text that a terminal shows.

    The text also names *folder*, which holds the records.
    """
    commands, trip, own = report["commands"], report["round_trip_ms"], report["generator"]
    failures = ", ".join(f"{code} {count}" for code, count in report["failures_by_code"].items()) or "none"
    rows = [
        ("commands", f"{commands['sent']} sent, {commands['answered']} answered, {commands['lost']} lost"),
        ("failures", failures),
        (f"within {FAST_MS:g} ms", f"{report['answered_in_time_percent']:.2f} %"),
        ("round trip", f"p50 {_ms(trip['p50'])}, p95 {_ms(trip['p95'])}, p99 {_ms(trip['p99'])}"),
        ("frames per second", f"{report['fps_per_robot']['mean'] or 0.0:.2f} per robot"),
        ("wrong poses", f"{report['wrong_poses']}"),
        ("reconnects", f"{report['reconnects']} ({report['resent']} resent), {report['moves']} migrations"),
        ("held back", _held_back(report["held_back"])),
        ("load generator", f"{own['cpu_percent']:.0f} % of a core, late p99 {_ms(own['late_sends_ms_p99'])}"),
        ("records", str(folder)),
    ]  # fmt: skip
    return "\n".join(f"{name:<18} {value}" for name, value in rows)


def _held_back(counts: Mapping[str, int]) -> str:
    """Return the text that counts the commands which robots held back, by reason."""
    return f"{counts.get('busy', 0)} after busy, {counts.get('own-limit', 0)} by their own limit"


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} ms"


def _say(quiet: bool, text: str) -> None:
    if not quiet:
        show(text, error=True)
