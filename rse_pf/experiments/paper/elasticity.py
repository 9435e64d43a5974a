"""The elasticity experiment (the paper's Fig. 8): robots join, servers are added, one crashes, robots leave.

The emulated cores of a server are chosen by measurement so that all robots need about five servers at 70 %.
`--speed` compresses the joining interval and the policy's periods, idle time and warm-up by one factor; frame
rates, deadlines and health checks stay as they are.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed
from rse_pf.experiments.load.swarm import SwarmOptions
from rse_pf.experiments.paper.elasticity_report import elasticity_figures, elasticity_page
from rse_pf.experiments.paper.harness import Harness, generator_of
from rse_pf.experiments.plots.figures import draw_elasticity, require_matplotlib
from rse_pf.experiments.results.records import read_records
from rse_pf.experiments.results.result_folder import finish_report, fresh_folder, load_average
from rse_pf.experiments.results.summary import PAPER

__all__ = ["ElasticityOptions", "run_elasticity"]

FIGURE = "elasticity.png"
_JOIN_EVERY_S = 20.0  # the paper's Fig. 8
_SERVERS_AT_FULL = 5
_CALIBRATION_S = 4.0
_CALIBRATION_IDLE_S = 2.0
_CALIBRATION_ROBOTS = 20
_MIN_QUIET_S = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ElasticityOptions:
    """Options of the command line; ``emulated_cores`` None means that they are measured first."""

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
    """CPU seconds of a server: for one command, and for a second without commands."""

    command_s: float
    idle_s_per_s: float
    commands: int

    def emulated_cores(self, commands_per_s: float, busy_percent: float) -> float:
        """Return the cores per server with which five servers handle all commands at *busy_percent*."""
        each = commands_per_s * self.command_s / _SERVERS_AT_FULL + self.idle_s_per_s
        return round(each / (busy_percent / 100.0), 4)


def run_elasticity(options: ElasticityOptions, settings: PlatformSettings) -> int:
    """Run the experiment, write records, report and figure; return 1 if a command was lost or duplicated."""
    require_matplotlib()
    folder = fresh_folder(options.out, [FIGURE])
    load_before = load_average()
    runs = _runs(options, folder)
    for part, _ in runs.values():
        part.mkdir(exist_ok=True)
    cores, cost = asyncio.run(_emulated_cores(options, settings, folder))
    chosen = settings.replace(
        serving={"emulated_cores": cores}, local={"servers": settings.scaling.min_servers}
    )
    for part, rebalance in runs.values():
        asyncio.run(_run(options, chosen, part, rebalance))
    records = {name: read_records(part) for name, (part, _) in runs.items()}
    figures = {name: elasticity_figures(each) for name, each in records.items()}
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
        "generator": {name: generator_of(each) for name, each in records.items()},
        "paper": PAPER,
    }
    print(finish_report(folder, report, lambda whole: elasticity_page(whole, figures), chosen, load_before))
    captions = {"": "with rebalancing" if options.rebalance else "without rebalancing"}
    draw_elasticity(folder / FIGURE, {captions.get(name, name): each for name, each in records.items()})
    print(f"wrote {FIGURE}, report.json, report.md and the raw records to {options.out}")
    return int(any(run["commands"]["lost"] or run["commands"]["twice"] for run in figures.values()))


def _runs(options: ElasticityOptions, folder: Path) -> dict[str, tuple[Path, bool]]:
    """Return folder and rebalancing of each run, by its name in the report."""
    if not options.compare:
        return {"": (folder, options.rebalance)}
    return {
        "with-rebalancing": (folder / "with-rebalancing", True),
        "without-rebalancing": (folder / "without-rebalancing", False),
    }


async def _emulated_cores(
    options: ElasticityOptions, settings: PlatformSettings, folder: Path
) -> tuple[float, CpuCost | None]:
    if options.emulated_cores is not None:
        return options.emulated_cores, None
    scratch = folder / "calibration"
    scratch.mkdir(exist_ok=True)
    cost = await _measure(options, settings, scratch)
    shutil.rmtree(scratch)
    cores = cost.emulated_cores(options.robots * options.fps, settings.scaling.busy_cpu_percent)
    print(
        f"one command costs a server {1000 * cost.command_s:.2f} ms of CPU, an idle second "
        f"{1000 * cost.idle_s_per_s:.1f} ms (measured over {cost.commands} commands)\n"
        f"each server emulates {cores:g} cores, so that {options.robots} robots x {options.fps:g} fps need "
        f"about {_SERVERS_AT_FULL} servers at {settings.scaling.busy_cpu_percent:g} %",
        flush=True,
    )
    return cores, cost


async def _measure(options: ElasticityOptions, settings: PlatformSettings, folder: Path) -> CpuCost:
    """Return what a command costs one server at full speed, under the load of the robots."""
    chosen = settings.replace(serving={"emulated_cores": 0.0})
    robots = min(options.robots, _CALIBRATION_ROBOTS)
    parameters = {"kind": "calibration", "robots": robots, "fps": options.fps}
    async with Harness(folder, chosen, parameters, elastic=False, servers=1) as harness:

        async def cpu() -> tuple[float, int]:
            status = (await harness.platform.status())[0]
            return float(status["cpu_s"]), int(status["requests"])

        swarm_options = SwarmOptions(robots=robots, fps=options.fps, codec=options.codec, seed=options.seed)
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
    """Run the experiment once: joining, full load, crash, leaving, idle."""
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
        swarm_options = SwarmOptions(
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
    print(f"{victim} was killed at {began:.1f} s", flush=True)


def _phase(harness: Harness, name: str) -> None:
    harness.log("phase", phase=name)
    healthy = harness.samples[-1].healthy_servers if harness.samples else 0
    print(f"{harness.now():7.1f} s  {name:<8}  {healthy} healthy servers", flush=True)
