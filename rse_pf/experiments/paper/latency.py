"""The latency experiment: the paper's Sect. 6.2 with a hundred robots behind an emulated long link.

The link profile ``paper`` delays real packets on the loopback interface.  The report names the profile and
the lateness of the load generator itself.
"""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.swarm import SwarmOptions
from rse_pf.experiments.paper.harness import Harness, generator_of
from rse_pf.experiments.paper.latency_report import latency_figures, latency_page
from rse_pf.experiments.plots.figures import draw_latency, require_matplotlib
from rse_pf.experiments.results.records import read_records
from rse_pf.experiments.results.result_folder import finish_report, fresh_folder, load_average
from rse_pf.experiments.results.summary import PAPER
from rse_pf.local.faults.network_emulator import profile_named

__all__ = ["LatencyOptions", "run_latency"]

FIGURE = "latency.png"
_JOIN_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyOptions:
    """Options of the command line; *link* None means no emulated link."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    seconds: float = 30.0
    link: str | None = "paper"
    codec: str = "zlib"
    seed: int = 0


def run_latency(options: LatencyOptions, settings: PlatformSettings) -> int:
    """Run the experiment, write records, report and figure; return 1 if a command was lost or duplicated."""
    require_matplotlib()
    folder = fresh_folder(options.out, [FIGURE])
    load_before = load_average()
    asyncio.run(_run(options, settings, folder))
    records = read_records(folder)
    figures = latency_figures(records)
    report = {
        "experiment": "latency",
        "asked": {**asdict(options), "out": options.out.name},
        **figures,
        "generator": {"": generator_of(records)},
        "paper": PAPER,
    }
    print(finish_report(folder, report, latency_page, settings, load_before))
    link = f"link profile {options.link}" if options.link else "no emulated link"
    draw_latency(
        folder / FIGURE, figures, f"RSE-PF, latency: {options.robots} robots x {options.fps:g} fps, {link}"
    )
    print(f"wrote {FIGURE}, report.json, report.md and the raw records to {options.out}")
    return int(figures["commands"]["lost"] > 0 or figures["commands"]["twice"] > 0)


async def _run(options: LatencyOptions, settings: PlatformSettings, folder: Path) -> None:
    parameters = {
        "kind": "latency",
        "robots": options.robots,
        "fps": options.fps,
        "link": options.link,
        "link_round_trip_ms": 1000.0 * profile_named(options.link).round_trip_s if options.link else 0.0,
    }
    robots = SwarmOptions(
        robots=options.robots,
        fps=options.fps,
        codec=options.codec,
        seed=options.seed,
        link=options.link,
        deadline_s=settings.session.answer_timeout_s,
    )
    async with Harness(folder, settings, parameters) as harness, harness.swarm(robots) as swarm:
        await swarm.start()
        await swarm.wait_joined(_JOIN_TIMEOUT_S)
        await harness.run_for(options.seconds)
        await harness.save_result(await swarm.finish())
