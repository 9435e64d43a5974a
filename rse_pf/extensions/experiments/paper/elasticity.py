"""The elasticity experiment (the paper's Fig. 8): robots join, servers are added, one crashes, robots leave.

A server emulates a number of cores that is chosen by a measurement, so that all robots together need about
five servers at 70 % CPU.  `--speed` divides the joining interval and the policy's periods, idle time and
warm-up by the same factor; frame rates, deadlines and health checks do not change.
"""

from __future__ import annotations

import asyncio
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed
from rse_pf.extensions.experiments.harness import Harness, generator_of
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.plots.figures import draw_elasticity, require_matplotlib
from rse_pf.extensions.experiments.results.bars import Bars
from rse_pf.extensions.experiments.results.markdown import (
    about_run,
    failures,
    number,
    page,
    slashed,
    table,
    three,
)
from rse_pf.extensions.experiments.results.records import Event, Records, parameters_of, read_records
from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_plan
from rse_pf.extensions.experiments.results.result_folder import (
    RUN_FILES,
    finish_report,
    fresh_folder,
    load_average,
)
from rse_pf.extensions.experiments.results.summary import PAPER, summarise, summary_of
from rse_pf.local.control.monitor import MonitorSample
from rse_pf.terminal import show, show_page

__all__ = [
    "ElasticityOptions",
    "busy_periods_before",
    "crashes",
    "elasticity_figures",
    "elasticity_page",
    "emulated_cores",
    "find_unjustified_scale_outs",
    "run_elasticity",
    "slowest_replacement_s",
]

# Targets of the short run with which ``verify --rerun`` checks this experiment.
_SHORT_BARS: Bars = {
    **{f"commands/{name}": (0.0, "<=") for name in ("lost", "twice", "failed")},
    **dict.fromkeys(("scale_outs", "scale_ins", "crashes"), (1.0, ">=")),
    "replaced_in_s": (5.0, "<="),
}
# Name of the file with the image of this experiment.
FIGURE = "elasticity.png"
# Seconds between two robots that join, before ``--speed``: that of the paper's Fig. 8.
_JOIN_EVERY_S = 20.0
# Number of servers that all robots together should need; the emulated cores of a server are computed from it.
_SERVERS_AT_FULL = 5
# Seconds for which the CPU time of a server under load is measured.
_CALIBRATION_S = 4.0
# Seconds for which the CPU time of a server without commands is measured.
_CALIBRATION_IDLE_S = 2.0
# Largest number of robots in the measurement of CPU time: one server must be able to serve them all.
_CALIBRATION_ROBOTS = 20
# Shortest time without a change of the servers before the next phase begins, in seconds.
_MIN_QUIET_S = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ElasticityOptions:
    """Options of the experiment; ``emulated_cores`` None means that the number is chosen by a measurement."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    speed: float = 1.0
    codec: str = "zlib"
    emulated_cores: float | None = None
    rebalance: bool = True
    compare: bool = False
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class CpuCost:
    """CPU seconds that a server uses for one command, and for a second without commands.

    ``commands`` is the number of commands over which the first value was measured.
    """

    command_s: float
    idle_s_per_s: float
    commands: int

    def emulated_cores(self, commands_per_s: float, busy_percent: float) -> float:
        """Return the cores per server with which five servers handle all commands at *busy_percent*."""
        needed_s = commands_per_s * self.command_s / _SERVERS_AT_FULL + self.idle_s_per_s
        return round(needed_s / (busy_percent / 100.0), 4)


def run_elasticity(options: ElasticityOptions, settings: PlatformSettings) -> int:
    """Run the experiment, write records, report and figure to ``options.out``, and print the report.

    Return 1 if a command was lost or answered twice, else 0.
    """
    require_matplotlib()
    folder = fresh_folder(
        options.out, [*RUN_FILES, FIGURE, "with-rebalancing", "without-rebalancing", "calibration"]
    )
    load_before = load_average()
    runs = _runs(options, folder)
    for part, _ in runs.values():
        part.mkdir(exist_ok=True)
    cores, cost = asyncio.run(emulated_cores(options, settings, folder))
    chosen = settings.replace(
        serving={"emulated_cores": cores},
        local={"servers": settings.scaling.min_servers},
        scaling={"profile": "paper", "underused_s": 0, "schedule": ""},  # the scaling rules of the paper only
    )
    for part, rebalance in runs.values():
        asyncio.run(_run(options, chosen, part, rebalance))
    records = {name: read_records(part) for name, (part, _) in runs.items()}
    figures = {name: elasticity_figures(record) for name, record in records.items()}
    body: Mapping[str, Any] = {"runs": figures} if options.compare else next(iter(figures.values()))
    asked = {**asdict(options), "out": options.out.name, "size": cores}
    del asked["emulated_cores"]  # its key in reports is "size"
    report = {
        "experiment": "elasticity",
        "asked": asked,
        "speed": options.speed,
        "size": cores,
        "cost": None if cost is None else asdict(cost),
        **body,
        "generator": {name: generator_of(record) for name, record in records.items()},
        "paper": PAPER,
    }
    if not options.compare:
        report[RERUN] = rerun_plan(["--speed", "30", "--robots", "40"], _SHORT_BARS)
    show_page(
        finish_report(folder, report, lambda whole: elasticity_page(whole, figures), chosen, load_before)
    )
    captions = {"": "with rebalancing" if options.rebalance else "without rebalancing"}
    draw_elasticity(folder / FIGURE, {captions.get(name, name): record for name, record in records.items()})
    show(f"wrote {FIGURE}, report.json, report.md and the raw records to {options.out}")
    return int(any(run["commands"]["lost"] or run["commands"]["twice"] for run in figures.values()))


def _runs(options: ElasticityOptions, folder: Path) -> dict[str, tuple[Path, bool]]:
    """Return the folder of each run and whether it rebalances robots, by the run's name in the report."""
    if not options.compare:
        return {"": (folder, options.rebalance)}
    return {
        "with-rebalancing": (folder / "with-rebalancing", True),
        "without-rebalancing": (folder / "without-rebalancing", False),
    }


async def emulated_cores(
    options: ElasticityOptions, settings: PlatformSettings, folder: Path
) -> tuple[float, CpuCost | None]:
    """Return the cores that a server emulates, so that all robots need five servers, and the measured cost.

    The cost is None if the options state the number of cores.
    """
    if options.emulated_cores is not None:
        return options.emulated_cores, None
    scratch = folder / "calibration"
    scratch.mkdir(exist_ok=True)
    cost = await _measure(options, settings, scratch)
    shutil.rmtree(scratch)
    cores = cost.emulated_cores(options.robots * options.fps, settings.scaling.busy_cpu_percent)
    show(
        f"one command costs a server {1000 * cost.command_s:.2f} ms of CPU, an idle second "
        f"{1000 * cost.idle_s_per_s:.1f} ms (measured over {cost.commands} commands)",
        f"each server emulates {cores:g} cores, so that {options.robots} robots x {options.fps:g} fps need "
        f"about {_SERVERS_AT_FULL} servers at {settings.scaling.busy_cpu_percent:g} %",
    )
    return cores, cost


async def _measure(options: ElasticityOptions, settings: PlatformSettings, folder: Path) -> CpuCost:
    """Measure the CPU time of a command on one server without emulated cores, under the load of the robots.

    Raises:
        CommandFailed: Fewer than ten commands were answered.
    """
    chosen = settings.replace(serving={"emulated_cores": 0.0})
    robots = min(options.robots, _CALIBRATION_ROBOTS)
    parameters = {"kind": "calibration", "robots": robots, "fps": options.fps}
    async with Harness(folder, chosen, parameters, elastic=False, servers=1) as harness:

        async def cpu() -> tuple[float, int]:
            status = (await harness.platform.status())[0]
            return float(status["cpu_s"]), int(status["requests"])

        swarm_options = LoadScenario(robots=robots, fps=options.fps, codec=options.codec, seed=options.seed)
        async with harness.swarm(swarm_options) as swarm:
            idle, began = await cpu(), harness.now()
            await harness.run_for(_CALIBRATION_IDLE_S)
            rested, idle_took = await cpu(), harness.now() - began
            await swarm.start()
            await swarm.wait_joined(60.0)
            await harness.run_for(1.0)
            first, began = await cpu(), harness.now()
            await harness.run_for(_CALIBRATION_S)
            last, took = await cpu(), harness.now() - began
            await swarm.finish(1.0)
    commands = last[1] - first[1]
    if commands < 10:
        raise CommandFailed(
            f"only {commands} commands were answered during the measurement", hint="raise --fps"
        )
    idle_rate = max(rested[0] - idle[0], 0.0) / idle_took
    cost_s = max(last[0] - first[0] - idle_rate * took, 0.0) / commands
    return CpuCost(command_s=round(cost_s, 6), idle_s_per_s=round(idle_rate, 6), commands=commands)


async def _run(options: ElasticityOptions, settings: PlatformSettings, folder: Path, rebalance: bool) -> None:
    """Run the phases of the experiment once: joining, full load, crash, leaving, idle."""
    scaling, speed = settings.scaling, options.speed
    period_s, join_every_s = scaling.period_s / speed, _JOIN_EVERY_S / speed
    parameters = {
        "kind": "elasticity",
        "robots": options.robots,
        "fps": options.fps,
        "speed": speed,
        "join_every_s": join_every_s,
        "rebalance": rebalance,
    }
    quiet_s = max(_MIN_QUIET_S, 3 * period_s)
    async with Harness(folder, settings, parameters, compress=speed, rebalance=rebalance) as harness:
        swarm_options = LoadScenario(
            robots=options.robots,
            fps=options.fps,
            codec=options.codec,
            seed=options.seed,
            join_every_s=join_every_s,
        )
        async with harness.swarm(swarm_options) as swarm:
            _phase(harness, "joining")
            await swarm.start()
            await swarm.wait_joined(options.robots * join_every_s + 60.0)
            _phase(harness, "full")
            await harness.wait_quiet(quiet_s, timeout_s=10 * period_s + 40.0)
            await _crash(harness, quiet_s)
            _phase(harness, "leaving")
            await swarm.leave()
            await harness.save_result(await swarm.finish())
        _phase(harness, "idle")
        at_min = scaling.min_servers
        await harness.wait_for(
            lambda: bool(harness.samples) and len(harness.samples[-1].servers) == at_min,
            (scaling.idle_s + 60 * scaling.max_servers) / speed + 60.0,
        )
        await harness.run_for(max(3.0, 2 * period_s))
        _phase(harness, "over")


async def _crash(harness: Harness, quiet_s: float) -> None:
    _phase(harness, "crash")
    healthy = harness.samples[-1].healthy_servers
    began = harness.now()
    victim = harness.kill(quiet_s)
    await harness.wait_for(lambda: bool(harness.events_since("server-gone", began)), 10.0)
    await harness.wait_for(lambda: harness.samples[-1].healthy_servers >= healthy, 60.0)
    await harness.wait_quiet(quiet_s, timeout_s=3 * quiet_s + 20.0)
    show(f"{victim} was killed at {began:.1f} s")


def _phase(harness: Harness, name: str) -> None:
    harness.log("phase", phase=name)
    healthy = harness.samples[-1].healthy_servers if harness.samples else 0
    show(f"{harness.now():7.1f} s  {name:<8}  {healthy} healthy servers")


# Begin of the scaling policy's reason when it adds servers because some are missing, not because of load.
_MISSING_SERVERS_REASON = "fewer than"
# Distance below the CPU limit, in percent, at which a mean CPU counts as reaching it: samples are rounded.
_ROUNDING_PERCENT = 0.01


def elasticity_figures(records: Records) -> dict[str, Any]:
    """Return the figures of ``report.json`` for an elasticity run, computed from its records.

    Raises:
        UsageError: The events do not hold the parameters of the run.
    """
    parameters, samples = parameters_of(records), records.samples
    summary = summary_of(records)
    crash_rows = crashes(records.events)
    return {
        "scale_outs": len(_scale_outs(records.events)),
        "scale_ins": sum(event["action"] == "shrink" for event in records.events),
        "min_servers": parameters["min_servers"],
        "max_servers": max((sample.healthy_servers for sample in samples), default=0),
        "final_servers": samples[-1].healthy_servers if samples else 0,
        "crashes": len(crash_rows),
        "replaced_in_s": slowest_replacement_s(crash_rows),
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "round_trip_ms": summary["round_trip_ms"],
        "phases": _phases(records),
        "queue_ms": summary["queue_ms"],
        "compute_ms": summary["compute_ms"],
        "commands_by_server": summary["commands_by_server"],
        "scale_events": [
            {
                "time": round(event["time"], 3),
                "action": event["action"],
                "servers": event.get("servers"),
                "reason": event.get("reason", ""),
            }
            for event in records.events
            if event["action"] in ("grow", "shrink", "replace")
        ],
        "crash_list": crash_rows,
        "cpu_percent_series": [
            [round(sample.time, 3), round(sample.cpu_percent, 2)]
            for sample in samples
            if sample.cpu_percent is not None
        ],
        "healthy_servers_series": [[round(sample.time, 3), sample.healthy_servers] for sample in samples],
        "robots_per_server_series": [
            [round(sample.time, 3), {server.name: server.robots for server in sample.servers}]
            for sample in samples
        ],
    }


def elasticity_page(report: Mapping[str, Any], runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the text of ``report.md`` for *report*.

    *runs* holds the figures of each run by its name; a run is a column of the table.
    """
    asked, cost = report["asked"], report.get("cost")
    cells: dict[str, Callable[[Mapping[str, Any]], Any]] = {
        "scale-outs / scale-ins": lambda run: slashed(run, "scale_outs", "scale_ins"),
        "servers: minimum / most / at the end": lambda run: slashed(
            run, "min_servers", "max_servers", "final_servers"
        ),
        "crashes (kill -9)": lambda run: run["crashes"],
        "replacement healthy after, s": lambda run: number(run["replaced_in_s"]),
        "commands sent / answered": lambda run: slashed(run["commands"], "sent", "answered"),
        "failed, by code": failures,
        "lost / answered twice": lambda run: slashed(run["commands"], "lost", "twice"),
        "round trip p50 / p95 / p99 ms": lambda run: three(run["round_trip_ms"]),
        **{
            f"  while {phase}: p50 / p95 / p99 ms": partial(_phase_round_trip, phase)
            for phase in ("joining", "full", "crash")
        },
    }
    measured = f", because one command costs {1000 * cost['command_s']:.2f} ms of CPU" if cost else ""
    return page(
        "# RSE-PF experiment: elasticity (the paper's Fig. 8)",
        f"{asked['robots']} robots x {asked['fps']:g} fps; time compressed {asked['speed']:g}x "
        "(joining interval, the policy's periods, idle time and warm-up; nothing else).",
        f"Each server emulates {report['size']:g} cores{measured}.",
        table(
            ["figure", *(name or "here" for name in runs)],
            [[label, *(cell(run) for run in runs.values())] for label, cell in cells.items()],
        ),
        "The paper: a robot every 20 s up to a hundred, scale-out above 70 % CPU, scale-in after "
        "5 minutes idle, one crash; it gives no figures for p99, recovery or loss.",
        about_run(report),
    )


def _phase_round_trip(phase: str, run: Mapping[str, Any]) -> str:
    return three(run["phases"].get(phase, {}).get("round_trip_ms", {}))


def crashes(events: Sequence[Event]) -> list[dict[str, Any]]:
    """Return a row for each server that exited without a drain.

    ``time`` is that of the fault that killed it (s since the start of the run), ``by`` the first healthy
    server that was launched after that, and ``replaced_in_s`` the time until then; both are None if there was
    none.
    """
    leaving = {event["server"] for event in events if event["action"] == "drain-start"}
    launched = {event["server"]: event["time"] for event in events if event["action"] == "server-launched"}
    taken: set[str] = set()
    rows = []
    for event in events:
        if event["action"] != "server-gone" or event["server"] in leaving:
            continue
        began = _fault_before(events, event)
        healthy = [
            later
            for later in events
            if later["action"] == "server-healthy"
            and later["time"] >= began
            and launched.get(later["server"], -math.inf) >= began
            and later["server"] not in taken
        ]
        if healthy:
            taken.add(healthy[0]["server"])
        rows.append(
            {
                "server": event["server"],
                "pid": event.get("pid"),
                "time": round(began, 3),
                "by": healthy[0]["server"] if healthy else None,
                "replaced_in_s": round(healthy[0]["time"] - began, 3) if healthy else None,
            }
        )
    return rows


def slowest_replacement_s(replacements: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the longest ``replaced_in_s`` of the rows of `crashes`.

    None if there are no rows, or if a server was never replaced.
    """
    times = [crash["replaced_in_s"] for crash in replacements]
    return max(times) if times and None not in times else None


def busy_periods_before(
    samples: Sequence[MonitorSample], time_s: float, *, origin_s: float, period_s: float, periods: int
) -> list[float | None]:
    """Return the mean CPU (percent) of each of the last whole *periods* before *time_s*, oldest first.

    A period without a sample has None.  Periods begin at multiples of *period_s* of the monitor's clock,
    which was *origin_s* at the start of the run.  A sample stands for the time since the previous sample, and
    belongs to the period in which the middle of that time lies.
    """
    sums: dict[int, list[float]] = {}
    before = None
    for sample in samples:
        since = sample.time - (before if before is not None else sample.time)
        before = sample.time
        if sample.cpu_percent is None:
            continue
        period = math.floor((sample.time - since / 2 + origin_s) / period_s)
        seconds, weighted = sums.setdefault(period, [0.0, 0.0])
        sums[period] = [seconds + since, weighted + since * sample.cpu_percent]
    ended = math.floor((time_s + origin_s) / period_s + 1e-6)
    return [
        sums[number][1] / sums[number][0] if number in sums and sums[number][0] > 0 else None
        for number in range(ended - periods, ended)
    ]


def find_unjustified_scale_outs(records: Records) -> list[str]:
    """Return a line for each scale-out for high CPU before which the CPU was not high for long enough.

    A scale-out is justified by a mean CPU of at least the policy's limit in each of the ``busy_periods``
    periods before it.
    """
    parameters = parameters_of(records)
    wrong = []
    for event in _scale_outs(records.events):
        if not str(event.get("reason", "")).startswith("CPU"):
            continue
        seen = busy_periods_before(
            records.samples,
            float(event["time"]),
            origin_s=float(parameters["origin_s"]),
            period_s=float(parameters["period_s"]),
            periods=int(parameters["busy_periods"]),
        )
        limit = float(parameters["busy_cpu_percent"])
        if any(value is None or value < limit - _ROUNDING_PERCENT for value in seen):
            values = ", ".join("none" if value is None else f"{value:.1f} %" for value in seen)
            wrong.append(f"at {event['time']:.2f} s: {values} before it, {limit:g} % is required")
    return wrong


def _scale_outs(events: Sequence[Event]) -> list[Event]:
    """Return the events of scale-outs, but for those that replace missing servers."""
    return [
        event
        for event in events
        if event["action"] == "grow" and not str(event.get("reason", "")).startswith(_MISSING_SERVERS_REASON)
    ]


def _fault_before(events: Sequence[Event], gone: Event) -> float:
    """Return the time of the last injected fault of *gone*'s server, or the time of *gone* without one."""
    times = [
        float(event["time"])
        for event in events
        if event["action"] == "fault"
        and event.get("server") == gone["server"]
        and event["time"] <= gone["time"]
    ]
    return times[-1] if times else float(gone["time"])


def _phases(records: Records) -> dict[str, Any]:
    """Return the counts, failures and round trips of each phase, by its name.

    A command belongs to the phase that holds its planned send time.
    """
    marks = [event for event in records.events if event["action"] == "phase"]
    figures = {}
    ends = [*(float(mark["time"]) for mark in marks[1:]), math.inf]
    for mark, end in zip(marks, ends, strict=False):
        within = [command for command in records.commands if float(mark["time"]) <= command.planned < end]
        if within:
            summary = summarise(within)
            names = ("commands", "failures_by_code", "round_trip_ms")
            figures[str(mark["phase"])] = {name: summary[name] for name in names}
    return figures
