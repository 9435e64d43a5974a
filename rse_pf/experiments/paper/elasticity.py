"""The paper's Fig. 8 again: a fleet joins, the cloud grows, a server dies, all leave, the cloud shrinks.

The size of a server is chosen by measurement so that the whole fleet needs about five of them at 70 %.
Time may be compressed, never faked: `--speed` shortens the joining interval and the policy's periods, idle
time and warm-up by one factor; a robot's frame rate, its deadlines and the health checks stay as they are.
"""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed
from rse_pf.experiments.load.swarm import SwarmOptions
from rse_pf.experiments.paper.elasticity_report import judge_elasticity
from rse_pf.experiments.paper.harness import Harness, watch
from rse_pf.experiments.paper.result_folder import finish_report, fresh_folder, generator_of
from rse_pf.experiments.plots.figures import draw_elasticity, require_matplotlib
from rse_pf.experiments.results.markdown import elasticity_markdown
from rse_pf.experiments.results.records import read_records
from rse_pf.experiments.results.report import PAPER

__all__ = ["ElasticityOptions", "run_elasticity"]

PICTURE = "elasticity.png"
_JOIN_EVERY_S = 20.0  # the paper's Fig. 8
_SERVERS_AT_FULL = 5
_CALIBRATION_S = 4.0
_CALIBRATION_IDLE_S = 2.0
_CALIBRATION_ROBOTS = 20
_MIN_QUIET_S = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ElasticityOptions:
    """What the command line says; ``size`` None means measure first."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    speed: float = 1.0
    codec: str = "zlib"
    size: float | None = None
    rebalance: bool = True
    compare: bool = False
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What a server's work costs in CPU seconds: one command, and a second without any."""

    command_s: float
    idle_s_per_s: float
    commands: int

    def size(self, commands_per_s: float, busy_percent: float) -> float:
        """Return the size at which five servers carry the fleet at *busy_percent*."""
        each = commands_per_s * self.command_s / _SERVERS_AT_FULL + self.idle_s_per_s
        return round(each / (busy_percent / 100.0), 4)


def run_elasticity(options: ElasticityOptions, settings: PlatformSettings) -> int:
    """Run the experiment, write records, report and picture; return the exit code."""
    require_matplotlib()
    folder = fresh_folder(options.out, (PICTURE,))
    load_before = [round(value, 2) for value in os.getloadavg()]
    runs = _runs(options, folder)
    for part, _ in runs.values():
        part.mkdir(exist_ok=True)
    size, cost = asyncio.run(_size(options, settings, folder))
    chosen = settings.replace(
        serving={"emulated_cores": size}, local={"servers": settings.scaling.min_servers}
    )
    for part, rebalance in runs.values():
        asyncio.run(_run(options, chosen, part, rebalance))
    records = {name: read_records(part) for name, (part, _) in runs.items()}
    judged = {name: judge_elasticity(each) for name, each in records.items()}
    generator = {name: generator_of(each) for name, each in records.items()}
    asked = {**asdict(options), "out": options.out.name, "size": size}
    own = {"speed": options.speed, "size": size, "cost": None if cost is None else asdict(cost)}
    body: Mapping[str, Any] = {"runs": judged} if options.compare else next(iter(judged.values()))
    report = finish_report(
        folder,
        {"experiment": "elasticity", "asked": asked, **own, **body, "generator": generator, "paper": PAPER},
        chosen,
        load_before,
    )
    (folder / "report.md").write_text(elasticity_markdown(report, judged), encoding="utf-8")
    captions = {"": "with rebalancing" if options.rebalance else "without rebalancing"}
    draw_elasticity(folder / PICTURE, {captions.get(name, name): each for name, each in records.items()})
    print((folder / "report.md").read_text(encoding="utf-8"))
    print(f"wrote {PICTURE}, report.json, report.md and the raw records to {options.out}")
    return int(any(run["commands"]["lost"] or run["commands"]["twice"] for run in judged.values()))


def _runs(options: ElasticityOptions, folder: Path) -> dict[str, tuple[Path, bool]]:
    """Return folder and rebalancing of each run, by its name in the report."""
    if not options.compare:
        return {"": (folder, options.rebalance)}
    return {
        "with-rebalancing": (folder / "with-rebalancing", True),
        "without-rebalancing": (folder / "without-rebalancing", False),
    }


async def _size(
    options: ElasticityOptions, settings: PlatformSettings, folder: Path
) -> tuple[float, Cost | None]:
    if options.size is not None:
        return options.size, None
    scratch = folder / "calibration"
    scratch.mkdir(exist_ok=True)
    cost = await _measure(options, settings, scratch)
    shutil.rmtree(scratch)
    size = cost.size(options.robots * options.fps, settings.scaling.busy_cpu_percent)
    print(
        f"one command costs a server {1000 * cost.command_s:.2f} ms of CPU, an idle second "
        f"{1000 * cost.idle_s_per_s:.1f} ms (over {cost.commands} commands)\n"
        f"server size {size:g} cores: {options.robots} robots x {options.fps:g} fps need about "
        f"{_SERVERS_AT_FULL} servers at {settings.scaling.busy_cpu_percent:g} %",
        flush=True,
    )
    return size, cost


async def _measure(options: ElasticityOptions, settings: PlatformSettings, folder: Path) -> Cost:
    """Return what a command costs one server without an emulated size, under the robots' own load."""
    chosen = settings.replace(serving={"emulated_cores": 0.0})
    robots = min(options.robots, _CALIBRATION_ROBOTS)
    asked = {"kind": "calibration", "robots": robots, "fps": options.fps}
    async with Harness(folder, chosen, asked, elastic=False, servers=1) as stage:

        async def cpu() -> tuple[float, int]:
            told = (await stage.cloud.status())[0]
            return float(told["cpu_s"]), int(told["requests"])

        wanted = SwarmOptions(robots=robots, fps=options.fps, codec=options.codec, seed=options.seed)
        async with stage.swarm(wanted) as swarm:
            idle, began = await cpu(), stage.now()
            await watch(stage, _CALIBRATION_IDLE_S)
            rested, idle_took = await cpu(), stage.now() - began
            await swarm.start()
            await swarm.wait_joined(60.0)
            await watch(stage, 1.0)
            first, began = await cpu(), stage.now()
            await watch(stage, _CALIBRATION_S)
            last, took = await cpu(), stage.now() - began
            await swarm.finish(1.0)
    commands = last[1] - first[1]
    if commands < 10:
        raise CommandFailed(f"only {commands} commands were answered to measure with", hint="raise --fps")
    idle_rate = max(rested[0] - idle[0], 0.0) / idle_took
    cost_s = max(last[0] - first[0] - idle_rate * took, 0.0) / commands
    return Cost(command_s=round(cost_s, 6), idle_s_per_s=round(idle_rate, 6), commands=commands)


async def _run(options: ElasticityOptions, settings: PlatformSettings, folder: Path, rebalance: bool) -> None:
    """Play the whole story once."""
    scaling, speed = settings.scaling, options.speed
    period_s, join_every_s = scaling.period_s / speed, _JOIN_EVERY_S / speed
    asked = {
        "kind": "elasticity",
        "robots": options.robots,
        "fps": options.fps,
        "speed": speed,
        "join_every_s": join_every_s,
        "rebalance": rebalance,
    }
    quiet_s = max(_MIN_QUIET_S, 3 * period_s)
    async with Harness(folder, settings, asked, compress=speed, rebalance=rebalance) as stage:
        wanted = SwarmOptions(
            robots=options.robots,
            fps=options.fps,
            codec=options.codec,
            seed=options.seed,
            join_every_s=join_every_s,
        )
        async with stage.swarm(wanted) as swarm:
            _phase(stage, "joining")
            await swarm.start()
            await swarm.wait_joined(options.robots * join_every_s + 60.0)
            _phase(stage, "full")
            await stage.settled(quiet_s, within_s=10 * period_s + 40.0)
            await _crash(stage, quiet_s)
            _phase(stage, "leaving")
            await swarm.leave()
            await stage.close_books(await swarm.finish())
        _phase(stage, "idle")
        at_min = scaling.min_servers
        await stage.until(
            lambda: bool(stage.readings) and len(stage.readings[-1].servers) == at_min,
            (scaling.idle_s + 60 * scaling.max_servers) / speed + 60.0,
        )
        await watch(stage, max(3.0, 2 * period_s))
        _phase(stage, "over")


async def _crash(stage: Harness, quiet_s: float) -> None:
    _phase(stage, "crash")
    healthy = stage.readings[-1].healthy_servers
    began = stage.now()
    victim = stage.kill(quiet_s)
    await stage.until(lambda: bool(stage.happened("server-gone", began)), 10.0)
    await stage.until(lambda: stage.readings[-1].healthy_servers >= healthy, 60.0)
    await stage.settled(quiet_s, within_s=3 * quiet_s + 20.0)
    print(f"{victim} was killed at {began:.1f} s", flush=True)


def _phase(stage: Harness, name: str) -> None:
    stage.tell("phase", phase=name)
    healthy = stage.readings[-1].healthy_servers if stage.readings else 0
    print(f"{stage.now():7.1f} s  {name:<8}  {healthy} healthy servers", flush=True)
