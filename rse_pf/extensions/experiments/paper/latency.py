"""The latency experiment: the paper's Sect. 6.2 with a hundred robots behind an emulated long-distance link.

The link profile ``paper`` delays the bytes of real connections on the loopback interface.  The report names
the profile, and the delay that the load generator itself added.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.faults.network_emulator import profile_named
from rse_pf.extensions.experiments.harness import Harness, generator_of
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.plots.figures import draw_latency, require_matplotlib
from rse_pf.extensions.experiments.results.bars import Bars
from rse_pf.extensions.experiments.results.markdown import about_run, number, page, slashed, table, three
from rse_pf.extensions.experiments.results.records import CommandRecord, Records, parameters_of, read_records
from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_plan
from rse_pf.extensions.experiments.results.result_folder import (
    RUN_FILES,
    finish_report,
    fresh_folder,
    load_average,
)
from rse_pf.extensions.experiments.results.summary import (
    PAPER,
    ROUND_TRIP_PARTS,
    frame_rates,
    percent_answered,
    summary_of,
)
from rse_pf.terminal import show, show_page

__all__ = ["LatencyOptions", "latency_figures", "latency_page", "run_latency"]

# Name of the file with the image of this experiment.
FIGURE = "latency.png"
# Arguments of the short run with which ``verify --rerun`` checks this experiment.
_SHORT = ("--robots", "20", "--seconds", "5")
# Longest wait until all robots have joined, in seconds.
_JOIN_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyOptions:
    """Options of the experiment.

    ``link`` names a profile of the network emulator, None means no emulated link.
    """

    out: Path
    robots: int = 100
    fps: float = 5.0
    seconds: float = 30.0
    link: str | None = "paper"
    codec: str = "zlib"
    seed: int = 0


def run_latency(options: LatencyOptions, settings: PlatformSettings) -> int:
    """Run the experiment, write records, report and figure to ``options.out``, and print the report.

    Return 1 if a command was lost or answered twice, else 0.
    """
    require_matplotlib()
    folder = fresh_folder(options.out, [*RUN_FILES, FIGURE])
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
        RERUN: rerun_plan([*_SHORT, "--link", options.link or "none"], _bars(figures)),
    }
    show_page(finish_report(folder, report, latency_page, settings, load_before))
    link = f"link profile {options.link}" if options.link else "no emulated link"
    draw_latency(
        folder / FIGURE, figures, f"RSE-PF, latency: {options.robots} robots x {options.fps:g} fps, {link}"
    )
    show(f"wrote {FIGURE}, report.json, report.md and the raw records to {options.out}")
    return int(figures["commands"]["lost"] > 0 or figures["commands"]["twice"] > 0)


def _bars(figures: Mapping[str, Any]) -> Bars:
    """Return the targets of a short run: no lost, duplicated or failed command, and the round trips."""
    return {
        **{f"commands/{name}": (0.0, "<=") for name in ("lost", "twice", "failed")},
        "round_trip_ms/p50": (figures["round_trip_ms"]["p50"], "<="),
        "answered_within_150_ms_percent": (figures["answered_within_150_ms_percent"], ">="),
    }


async def _run(options: LatencyOptions, settings: PlatformSettings, folder: Path) -> None:
    parameters = {
        "kind": "latency",
        "robots": options.robots,
        "fps": options.fps,
        "link": options.link,
        "link_round_trip_ms": 1000.0 * profile_named(options.link).round_trip_s if options.link else 0.0,
    }
    robots = LoadScenario(
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


def latency_figures(records: Records) -> dict[str, Any]:
    """Return the figures of a latency run: counts, round trips and their parts, and frame rates.

    Raises:
        UsageError: The events do not hold the parameters of the run.
    """
    link_ms = float(parameters_of(records).get("link_round_trip_ms") or 0.0)
    summary = summary_of(records)
    trip = summary["round_trip_ms"]
    parts = [summary[name]["mean"] for name in ROUND_TRIP_PARTS]
    return {
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "payload_bytes": summary["payload_bytes"],
        "round_trip_ms": trip,
        **{name: summary[name] for name in ROUND_TRIP_PARTS},
        "rest_ms_mean": _difference(trip["mean"], None if None in parts else sum(parts)),
        "over_the_link_ms_p50": _difference(trip["p50"], link_ms),
        "answered_within_150_ms_percent": percent_answered(records.commands, 150.0),
        "fps_per_robot": _frame_rates(records.commands),
        "against_paper": {
            name: _difference(summary[name]["mean"], PAPER[name]) for name in ("round_trip_ms", "compute_ms")
        },
    }


def latency_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md`` for *report*."""
    paper, trip, link = report["paper"], report["round_trip_ms"], report["asked"]["link"]
    transmission = paper["round_trip_ms"] - paper["compute_ms"]
    rows = [
        ["round trip, mean ms", number(trip["mean"]), f"{paper['round_trip_ms']} (abstract: 153)"],
        ["round trip p50 / p95 / p99 ms", three(trip), "not given"],
        ["up, mean ms", number(report["up_ms"]["mean"]), f"up and down: {transmission:.2f} (near 130)"],
        ["queue, mean ms", number(report["queue_ms"]["mean"]), "not given"],
        ["compute, mean ms", number(report["compute_ms"]["mean"]), paper["compute_ms"]],
        ["down, mean ms", number(report["down_ms"]["mean"]), ""],
        ["in the robot, mean ms", number(report["rest_ms_mean"]), ""],
        ["round trip p50 minus the delay of the link, ms", number(report["over_the_link_ms_p50"]), ""],
        ["answered within 150 ms, %", number(report["answered_within_150_ms_percent"]), ""],
        [
            "frames per second, mean / slowest robot",
            slashed(report["fps_per_robot"], "mean", "least"),
            "near 5",
        ],
        ["lost / failed", slashed(report["commands"], "lost", "failed"), "not given"],
    ]
    return page(
        "# RSE-PF experiment: latency (the paper's Sect. 6.2)",
        f"{report['asked']['robots']} robots x {report['asked']['fps']:g} fps, "
        + (f"link profile `{link}`." if link else "no emulated link between robots and platform."),
        table(["figure", "here", "the paper"], rows),
        "The paper gives two means: 153 ms in the abstract and the conclusion, 156.36 ms in Sect. 6.2.",
        about_run(report),
    )


def _difference(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else round(value - other, 3)


def _frame_rates(commands: Sequence[CommandRecord]) -> dict[str, float | None]:
    rates = frame_rates(commands)
    if not rates:
        return {"mean": None, "least": None}
    return {"mean": round(float(np.mean(rates)), 3), "least": round(min(rates), 3)}
