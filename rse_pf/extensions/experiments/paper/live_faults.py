"""The experiment on faults of live maps, each fault on a platform of its own.

A run is the demo with --live and one fault at a moment drawn from a seed.  Its figures say how long the
robots were affected, and whether the map lost a keyframe.  The complete log of the map stays in the folder of
the run, so that ``verify`` can replay the log and compute every figure again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.demo.live_faults import LIVE_FAULTS, LiveFault
from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo
from rse_pf.extensions.experiments.paper.mapping import asked_of
from rse_pf.extensions.experiments.plots.figures import draw_live, require_matplotlib
from rse_pf.extensions.experiments.results.bars import bars_blocks
from rse_pf.extensions.experiments.results.live_error import read_live_drives, read_live_map
from rse_pf.extensions.experiments.results.live_faults import fault_rows, live_fault_figures
from rse_pf.extensions.experiments.results.markdown import about_run, page, table
from rse_pf.extensions.experiments.results.records import read_records, robot_names
from rse_pf.extensions.experiments.results.result_folder import (
    RUN_FILES,
    finish_report,
    fresh_folder,
    load_average,
)
from rse_pf.terminal import show

__all__ = ["LIVE_FAULTS", "live_faults_page", "run_live_fault", "run_live_faults"]

# Name of the image in the folder of each run.
_FIGURE = "live.png"


def run_live_faults(
    options: DemoOptions, settings: PlatformSettings, faults: Sequence[str], repeat: int = 1
) -> int:
    """Run each of *faults* *repeat* times, write the report, and print a row for each run.

    Return 1 if an acknowledged keyframe was lost or stored twice, or if a frame got no pose; else 0.
    """
    require_matplotlib()
    folder = fresh_folder(
        options.out, [*RUN_FILES, *LIVE_FAULTS, *(f"{name}-[1-9]*" for name in LIVE_FAULTS)]
    )
    load_before = load_average()
    runs: dict[str, dict[str, Any]] = {}
    for fault in faults:
        for repetition in range(repeat):
            name = fault if repeat == 1 else f"{fault}-{repetition + 1}"
            runs[name] = run_live_fault(
                replace(options, out=folder / name),
                settings,
                LiveFault(name=fault, seed=options.seed + repetition),
            )
            show(*_lines(runs))
    report = {
        "experiment": "live",
        "asked": {**asked_of(options), "repeat": repeat},
        "runs": runs,
    }
    finish_report(folder, report, live_faults_page, settings, load_before)
    show(f"wrote report.json, report.md and the records of each run to {options.out}")
    keyframe_counts = [run["keyframes"] for run in runs.values()]
    lost = any(counts["lost"] or counts["twice"] for counts in keyframe_counts)
    return int(lost or any(run["frames_lost"] for run in runs.values()))


def run_live_fault(options: DemoOptions, settings: PlatformSettings, fault: LiveFault) -> dict[str, Any]:
    """Run the demo with one fault, write records and image to ``options.out``, and return the figures."""
    run_demo(options, settings, fault, kind="live-fault")
    folder = options.out.resolve()
    figures = live_fault_figures(read_records(folder))
    drives = read_live_drives(folder, robot_names(options.robots))
    draw_live(folder / _FIGURE, drives, read_live_map(folder), figures["live"])
    return figures


def live_faults_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md``: rows of all runs, the targets and whether they were met, images."""
    runs: Mapping[str, Mapping[str, Any]] = report["runs"]
    head, *rows = fault_rows(runs)
    met, bars = bars_blocks(runs)
    return page(
        "# RSE-PF experiment: faults of a live map",
        f"{report['asked']['robots']} robots x {report['asked']['fps']:g} Hz; {met}",
        table(head, rows),
        bars,
        *(f"![{name}]({name}/{_FIGURE})" for name in runs),
        about_run(report),
    )


def _lines(runs: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the table row of the newest run; for the first run, preceded by the head of the table."""
    head, *rows = fault_rows(runs)
    lines = table(head, [rows[-1]])
    return lines if len(rows) == 1 else lines[2:]
