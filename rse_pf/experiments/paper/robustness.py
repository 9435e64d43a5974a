"""The robustness experiment: the paper's Sect. 6.2 fault by fault, each on a platform of its own.

Every fault is a real one (a signal, a cut link), under real PnP load; the records of each run stay in a
folder of their own, and a missed target is reported as missed.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.swarm import SwarmOptions
from rse_pf.experiments.paper.control_plane_fault import run_control_plane_fault
from rse_pf.experiments.paper.fault_scenarios import SCENARIOS
from rse_pf.experiments.paper.harness import Harness, generator_of
from rse_pf.experiments.paper.robustness_report import missed_bars, robustness_figures, robustness_page
from rse_pf.experiments.plots.figures import draw_robustness, require_matplotlib
from rse_pf.experiments.results.records import read_records
from rse_pf.experiments.results.result_folder import finish_report, fresh_folder, load_average
from rse_pf.experiments.results.summary import PAPER

__all__ = ["RobustnessOptions", "run_robustness"]

FIGURE = "robustness.png"
_BEFORE_FAULT_S = 4.0
_JOIN_TIMEOUT_S = 60.0
_NO_DELAY = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustnessOptions:
    """Options of the command line; *speed* shortens the duration of the faults, nothing else."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    speed: float = 1.0
    codec: str = "zlib"
    only: tuple[str, ...] = ()
    repeat: int = 1
    seed: int = 0


def run_robustness(options: RobustnessOptions, settings: PlatformSettings) -> int:
    """Run the faults, write records, report and figure; return 1 if a command was lost or duplicated."""
    require_matplotlib()
    # One server must be able to serve the robots of another one: give it a worker for each of two cores.
    settings = settings.replace(local={"workers": max(settings.local.workers, min(2, os.cpu_count() or 1))})
    folder = fresh_folder(options.out, [FIGURE])
    load_before = load_average()
    runs: dict[str, dict[str, Any]] = {}
    for scenario in options.only or [name for name, each in SCENARIOS.items() if not each.slow]:
        for turn in range(options.repeat):
            name = scenario if options.repeat == 1 else f"{scenario}-{turn + 1}"
            (folder / name).mkdir()
            asyncio.run(_run(options, settings, folder / name, scenario, options.seed + len(runs)))
            runs[name] = robustness_figures(read_records(folder / name))
            print(_line(name, runs[name]), flush=True)
    records = {name: read_records(folder / name) for name in runs}
    report = {
        "experiment": "robustness",
        "asked": {**asdict(options), "out": options.out.name},
        "runs": runs,
        "generator": {name: generator_of(each) for name, each in records.items()},
        "paper": PAPER,
    }
    finish_report(folder, report, robustness_page, settings, load_before)
    draw_robustness(folder / FIGURE, records, runs)
    print(f"wrote {FIGURE}, report.json, report.md and the raw records to {options.out}")
    return int(any(run["commands"]["lost"] or run["commands"]["twice"] for run in runs.values()))


async def _run(
    options: RobustnessOptions, settings: PlatformSettings, folder: Path, name: str, seed: int
) -> None:
    scenario, session = SCENARIOS[name], settings.session
    seconds = scenario.seconds / options.speed
    if scenario.needs_link:  # a cut must last longer than the ping timeout of the robots
        seconds = max(seconds, 2 * (session.ping_interval_s + session.ping_timeout_s))
    parameters = {
        "kind": "robustness",
        "scenario": name,
        "robots": options.robots,
        "fps": options.fps,
        "seconds": seconds,
        "deadline_s": session.answer_timeout_s,
        "seed": seed,
    }
    robots = SwarmOptions(
        robots=options.robots,
        fps=options.fps,
        codec=options.codec,
        seed=options.seed,
        deadline_s=session.answer_timeout_s,
        link=_NO_DELAY if scenario.needs_link else None,
    )
    if scenario.inject is None:
        await run_control_plane_fault(folder, settings, parameters, robots, seconds)
        return
    async with (
        Harness(folder, settings, parameters, servers=scenario.servers) as harness,
        harness.swarm(robots) as swarm,
    ):
        harness.link = swarm.link
        await swarm.start()
        await swarm.wait_joined(_JOIN_TIMEOUT_S)
        harness.log("joined")
        await harness.run_for(_BEFORE_FAULT_S)
        await scenario.inject(harness, seconds, seed)
        await harness.save_result(await swarm.finish())


def _line(name: str, run: Mapping[str, Any]) -> str:
    commands, outage, missed = run["commands"], run["gap_s"], missed_bars(run)
    return (
        f"{name:<15} {commands['sent']} commands, {commands['lost']} lost, {commands['twice']} twice, "
        f"{commands['failed']} failed; outage p50 {outage['p50']} s, p99 {outage['p99']} s; "
        + (f"missed targets: {', '.join(missed)}" if missed else "all targets met")
    )
