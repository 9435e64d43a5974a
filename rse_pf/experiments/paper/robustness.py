"""Section 6.2's robustness again, fault by fault: each on a platform of its own, under real PnP load.

Promises that every fault is a real one (a signal, a cut link), that each run's records stay in a folder of
their own, and that a missed bar is printed as missed.
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
from rse_pf.experiments.paper.control_plane_fault import play_control_plane
from rse_pf.experiments.paper.fault_scenarios import SCENARIOS, Scenario
from rse_pf.experiments.paper.harness import Harness, watch
from rse_pf.experiments.paper.result_folder import finish_report, fresh_folder, generator_of
from rse_pf.experiments.paper.robustness_report import judge_scenario
from rse_pf.experiments.plots.figures import draw_robustness, require_matplotlib
from rse_pf.experiments.results.markdown import robustness_markdown
from rse_pf.experiments.results.records import read_records
from rse_pf.experiments.results.report import PAPER

__all__ = ["RobustnessOptions", "chosen_scenarios", "run_robustness"]

PICTURE = "robustness.png"
_LEAD_S = 4.0
_JOIN_S = 60.0
_NO_DELAY = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustnessOptions:
    """What the command line says; *speed* shortens how long a fault lasts, nothing else."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    speed: float = 1.0
    codec: str = "zlib"
    only: tuple[str, ...] = ()
    repeat: int = 1
    seed: int = 0


def chosen_scenarios(only: tuple[str, ...]) -> dict[str, Scenario]:
    """Return what *only* names, or all but the slow ones."""
    if only:
        return {name: SCENARIOS[name] for name in only}
    return {name: scenario for name, scenario in SCENARIOS.items() if not scenario.slow}


def run_robustness(options: RobustnessOptions, settings: PlatformSettings) -> int:
    """Run the faults, write records, report and picture; return 1 if a command was lost or answered twice."""
    require_matplotlib()
    # One server must be able to carry the robots of another one: give it a worker for each of two cores.
    settings = settings.replace(local={"workers": max(settings.local.workers, min(2, os.cpu_count() or 1))})
    folder = fresh_folder(options.out, (PICTURE,))
    load_before = [round(value, 2) for value in os.getloadavg()]
    names: dict[str, tuple[str, Scenario]] = {}
    for scenario, what in chosen_scenarios(options.only).items():
        for turn in range(options.repeat):
            name = scenario if options.repeat == 1 else f"{scenario}-{turn + 1}"
            names[name] = (scenario, what)
    rows: dict[str, dict[str, Any]] = {}
    for turn, (name, (scenario, what)) in enumerate(names.items()):
        part = folder / name
        part.mkdir()
        asyncio.run(_run(options, settings, part, scenario, what, options.seed + turn))
        rows[name] = judge_scenario(read_records(part))
        print(_line(name, rows[name]), flush=True)
    records = {name: read_records(folder / name) for name in rows}
    asked = {**asdict(options), "out": options.out.name}
    body = {
        "experiment": "robustness",
        "asked": asked,
        "runs": rows,
        "generator": {name: generator_of(each) for name, each in records.items()},
        "paper": PAPER,
    }
    report = finish_report(folder, body, settings, load_before)
    (folder / "report.md").write_text(robustness_markdown(report), encoding="utf-8")
    draw_robustness(folder / PICTURE, records, rows)
    print(f"wrote {PICTURE}, report.json, report.md and the raw records to {options.out}")
    return int(any(row["commands"]["lost"] or row["commands"]["twice"] for row in rows.values()))


async def _run(
    options: RobustnessOptions,
    settings: PlatformSettings,
    folder: Path,
    name: str,
    scenario: Scenario,
    seed: int,
) -> None:
    seconds = scenario.seconds / options.speed
    if scenario.needs_link:  # a cut must outlast the robots' patience to be one
        session = settings.session
        seconds = max(seconds, 2 * (session.ping_interval_s + session.ping_timeout_s))
    asked = {
        "kind": "robustness",
        "scenario": name,
        "robots": options.robots,
        "fps": options.fps,
        "seconds": seconds,
        "deadline_s": settings.session.answer_timeout_s,
        "seed": seed,
    }
    robots = SwarmOptions(
        robots=options.robots,
        fps=options.fps,
        codec=options.codec,
        seed=options.seed,
        deadline_s=settings.session.answer_timeout_s,
        link=_NO_DELAY if scenario.needs_link else None,
    )
    if scenario.play is None:
        await play_control_plane(folder, settings, asked, robots, seconds)
        return
    async with (
        Harness(folder, settings, asked, servers=scenario.servers) as stage,
        stage.swarm(robots) as swarm,
    ):
        stage.link = swarm.link
        await swarm.start()
        await swarm.wait_joined(_JOIN_S)
        stage.tell("joined")
        await watch(stage, _LEAD_S)
        await scenario.play(stage, seconds, seed)
        await stage.close_books(await swarm.finish())


def _line(name: str, row: Mapping[str, Any]) -> str:
    missed = [what for what, bar in row["bars"].items() if not bar["held"]]
    commands, gap = row["commands"], row["gap_s"]
    verdict = f"missed {', '.join(missed)}" if missed else "every bar held"
    return (
        f"{name:<15} {commands['sent']} sent, {commands['lost']} lost, {commands['twice']} twice, "
        f"{commands['failed']} failed; gap p50 {gap['p50']} s, p99 {gap['p99']} s: {verdict}"
    )
