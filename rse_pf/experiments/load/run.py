"""One run of a swarm from the command line: play for a while, show how it goes, write every record.

Leaves ``commands.csv``, ``events.jsonl`` and ``report.json``; the report is computed from the commands and
the generator's own account.  Promises to leave nothing running, and no key in the folder of results.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.experiments.load.swarm import Swarm, SwarmOptions, SwarmResult
from rse_pf.experiments.load.swarm_process import Rows
from rse_pf.experiments.results.report import (
    CommandRecord,
    EventLog,
    environment,
    percentiles,
    summarise,
    write_commands,
    write_json,
)
from rse_pf.local.control.platform import LocalPlatform

__all__ = ["FAST_MS", "Platform", "SwarmRun", "report_of", "run_swarm"]

FAST_MS = 150.0
"""An answer within this is in time: below the paper's mean round trip of 156.36 ms."""

_JOIN_S = 30.0
_SHOW_EVERY_S = 1.0
_FILES = ("commands.csv", "events.jsonl", "report.json")


@dataclass(frozen=True, slots=True)
class Platform:
    """One that runs already: its address, and who issues tokens."""

    url: str
    token_of: Callable[[str], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmRun:
    """What the command line says; ``platform`` None starts one for the run."""

    options: SwarmOptions
    seconds: float
    out: Path
    platform: Platform | None = None
    quiet: bool = False


def run_swarm(run: SwarmRun, settings: PlatformSettings) -> int:
    """Run it and return the exit code: 0 if every command came to an end, once, with a right pose."""
    folder = _folder(run.out)
    before = environment(settings)
    with (folder / "events.jsonl").open("w", encoding="utf-8") as file:
        result = asyncio.run(_play(run, settings, EventLog(file)))
    write_commands(folder / "commands.csv", result.commands)
    report = report_of(run, result, before)
    write_json(folder / "report.json", report)
    print(_table(report, folder))
    commands = report["commands"]
    return 1 if commands["lost"] or result.twice or result.wrong_poses or not commands["answered"] else 0


def report_of(run: SwarmRun, result: SwarmResult, before: Mapping[str, Any]) -> dict[str, Any]:
    """Return the report of a run.

    Frames per second of a robot are its answers over the time from its first planned to its last.
    """
    answered = [command for command in result.commands if command.code == "ok"]
    in_time = sum((command.round_trip_ms or 0.0) <= FAST_MS for command in answered)
    sent = max(1, len(result.commands))
    return {
        **summarise(result.commands),
        "answered_percent": round(100.0 * len(answered) / sent, 3),
        "answered_in_time_percent": round(100.0 * in_time / sent, 3),
        "in_time_ms": FAST_MS,
        "fps_per_robot": percentiles(_frame_rates(result.commands, run.options.fps)),
        "wrong_poses": result.wrong_poses,
        "twice": result.twice,
        "reconnects": result.reconnects,
        "resent": result.resent,
        "moves": result.moves,
        "generator": {
            "cpu_s": result.cpu_s,
            "wall_s": result.wall_s,
            "cpu_percent": round(100.0 * result.cpu_s / max(result.wall_s, 1e-9), 2),
            "cpu_us_per_command": round(1e6 * result.cpu_s / sent, 1),
            "late_sends_ms_p99": result.late_sends,
            "load_average_after": [round(value, 2) for value in os.getloadavg()],
        },
        "asked": {**asdict(run.options), "seconds": run.seconds},
        "environment": dict(before),
    }


async def _play(run: SwarmRun, settings: PlatformSettings, events: EventLog) -> SwarmResult:
    origin = time.monotonic()

    def tell(event: Mapping[str, Any]) -> None:
        details = {key: value for key, value in event.items() if key not in ("event", "time")}
        events.write(float(event.get("time", time.monotonic() - origin)), str(event["event"]), **details)

    def tell_platform(event: Mapping[str, Any]) -> None:
        tell({key: value for key, value in event.items() if key != "time"})

    options = run.options
    async with AsyncExitStack() as stack:
        platform = run.platform
        if platform is None:
            _say(run, "starting the platform")
            state = Path(tempfile.mkdtemp(prefix="rse-pf-swarm-"))
            stack.callback(shutil.rmtree, state, ignore_errors=True)
            cloud = await stack.enter_async_context(
                LocalPlatform(settings, state=state, port=0, name="swarm", on_event=tell_platform)
            )
            platform = Platform(cloud.url, cloud.issue_token)
        _say(run, f"{options.robots} robots ask {platform.url} {options.fps:g} times a second each")
        swarm = await stack.enter_async_context(
            Swarm(
                options,
                url=platform.url,
                token_of=platform.token_of,
                session=settings.session,
                on_event=tell,
                origin=origin,
            )
        )
        screen = asyncio.create_task(_show(run, swarm))
        stack.callback(screen.cancel)
        await swarm.start()
        await swarm.wait_joined(options.robots * options.join_every_s + _JOIN_S)
        await asyncio.sleep(run.seconds)
        return await swarm.finish(options.deadline_s)


async def _show(run: SwarmRun, swarm: Swarm) -> None:
    """Print a line a second: what was answered since the last."""
    seen, last_s = 0, time.monotonic()
    while not run.quiet:
        await asyncio.sleep(_SHOW_EVERY_S)
        fresh, seen = swarm.rows[seen:], len(swarm.rows)
        elapsed_s, last_s = time.monotonic() - last_s, time.monotonic()
        trips = np.concatenate([_round_trips_ms(rows) for rows in fresh] or [np.empty(0)])
        line = f"{len(swarm.joined) - len(swarm.left):5} robots {len(trips) / elapsed_s:7.0f} answered/s"
        if len(trips):
            p50, p99 = np.percentile(trips, [50, 99])
            line += f"   p50 {p50:7.1f} ms   p99 {p99:7.1f} ms"
        _say(run, line)


def _round_trips_ms(rows: Rows) -> np.ndarray[Any, np.dtype[np.float64]]:
    table = np.array(rows.numbers).reshape(-1, Rows.WIDTH)
    good = np.array([code == "ok" for code in rows.codes], dtype=np.bool_)
    trips: np.ndarray[Any, np.dtype[np.float64]] = 1e3 * (table[good, 4] - table[good, 2])
    return trips


def _frame_rates(commands: list[CommandRecord], fps: float) -> list[float]:
    planned: dict[str, list[float]] = {}
    answered: dict[str, int] = {}
    for command in commands:
        planned.setdefault(command.robot, []).append(command.planned)
        answered[command.robot] = answered.get(command.robot, 0) + (command.code == "ok")
    return [answered[robot] / (max(times) - min(times) + 1.0 / fps) for robot, times in planned.items()]


def _table(report: Mapping[str, Any], folder: Path) -> str:
    commands, trip, own = report["commands"], report["round_trip_ms"], report["generator"]
    failures = ", ".join(f"{code} {count}" for code, count in report["failures_by_code"].items()) or "none"
    rows = [
        ("commands", f"{commands['sent']} sent, {commands['answered']} answered, {commands['lost']} lost"),
        ("failures", failures),
        (f"within {FAST_MS:g} ms", f"{report['answered_in_time_percent']:.2f} %"),
        ("round trip", f"p50 {_ms(trip['p50'])}, p95 {_ms(trip['p95'])}, p99 {_ms(trip['p99'])}"),
        ("frames per second", f"{report['fps_per_robot']['mean'] or 0.0:.2f} per robot"),
        ("wrong poses", f"{report['wrong_poses']}"),
        ("reconnects", f"{report['reconnects']}, {report['resent']} resent, {report['moves']} moves"),
        ("generator", f"{own['cpu_percent']:.0f} % of a core, p99 {_ms(own['late_sends_ms_p99'])} late"),
        ("records", str(folder)),
    ]  # fmt: skip
    return "\n".join(f"{name:<18} {value}" for name, value in rows)


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} ms"


def _say(run: SwarmRun, text: str) -> None:
    if not run.quiet:
        print(text, file=sys.stderr, flush=True)


def _folder(folder: Path) -> Path:
    """Make *folder*; only the records of an earlier run are replaced."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", hint="name a folder with --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        strangers = [each.name for each in folder.iterdir() if each.name not in _FILES]
        if strangers:
            raise UsageError(f"{folder} holds other files", hint="name an empty folder with --out")
        for name in _FILES:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise RsePfError(f"cannot write {folder}: {error.strerror}", hint="name another --out") from error
    return folder.resolve()
