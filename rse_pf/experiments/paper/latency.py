"""Section 6.2's latency again: a hundred robots behind a link as long as Shenzhen to Seoul.

The link is real delay on loopback, profile ``paper``; the split into up, queue, compute and down is by the
robots' own clocks.  Promises that the report names the link, and the generator's own lateness.
"""

from __future__ import annotations

import asyncio
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.swarm import SwarmOptions
from rse_pf.experiments.paper.harness import Harness, watch
from rse_pf.experiments.paper.latency_report import judge_latency
from rse_pf.experiments.paper.result_folder import finish_report, fresh_folder, generator_of
from rse_pf.experiments.plots.figures import draw_latency, require_matplotlib
from rse_pf.experiments.results.markdown import latency_markdown
from rse_pf.experiments.results.records import read_records
from rse_pf.experiments.results.report import PAPER
from rse_pf.local.faults.network_emulator import profile_named

__all__ = ["LatencyOptions", "run_latency"]

PICTURE = "latency.png"
_JOIN_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyOptions:
    """What the command line says; *link* None is no link at all."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    seconds: float = 30.0
    link: str | None = "paper"
    codec: str = "zlib"
    seed: int = 0


def run_latency(options: LatencyOptions, settings: PlatformSettings) -> int:
    """Run the experiment, write records, report and picture; return the exit code."""
    require_matplotlib()
    folder = fresh_folder(options.out, (PICTURE,))
    load_before = [round(value, 2) for value in os.getloadavg()]
    asyncio.run(_run(options, settings, folder))
    records = read_records(folder)
    judged = judge_latency(records)
    body = {
        "experiment": "latency",
        "asked": {**asdict(options), "out": options.out.name},
        **judged,
        "generator": {"": generator_of(records)},
        "paper": PAPER,
    }
    report = finish_report(folder, body, settings, load_before)
    (folder / "report.md").write_text(latency_markdown(report), encoding="utf-8")
    where = f"link profile {options.link}" if options.link else "no link"
    caption = f"RSE-PF, latency: {options.robots} robots x {options.fps:g} fps, {where}"
    draw_latency(folder / PICTURE, judged, caption)
    print((folder / "report.md").read_text(encoding="utf-8"))
    print(f"wrote {PICTURE}, report.json, report.md and the raw records to {options.out}")
    return int(judged["commands"]["lost"] > 0 or judged["commands"]["twice"] > 0)


async def _run(options: LatencyOptions, settings: PlatformSettings, folder: Path) -> None:
    delay_ms = _round_trip_ms(options.link)
    asked = {
        "kind": "latency",
        "robots": options.robots,
        "fps": options.fps,
        "link": options.link,
        "link_round_trip_ms": delay_ms,
    }
    async with Harness(folder, settings, asked) as stage:
        robots = SwarmOptions(
            robots=options.robots,
            fps=options.fps,
            codec=options.codec,
            seed=options.seed,
            link=options.link,
            deadline_s=settings.session.answer_timeout_s,
        )
        async with stage.swarm(robots) as swarm:
            await swarm.start()
            await swarm.wait_joined(_JOIN_S)
            await watch(stage, options.seconds)
            await stage.close_books(await swarm.finish())


def _round_trip_ms(link: str | None) -> float:
    """Return what the profile alone costs there and back, jitter aside."""
    return 0.0 if link is None else 1000.0 * profile_named(link).round_trip_s
