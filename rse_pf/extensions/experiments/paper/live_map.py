"""The experiment on live maps: robots build one map together while they drive.

The experiment runs the demo with --live (real servers, a real load balancer, a process per robot).  In
addition to the records of every experiment it stores the poses that each robot reported while it drove, its
corrections and keyframes, and the published map, so that every figure can be computed again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo
from rse_pf.extensions.experiments.paper.mapping import asked_of
from rse_pf.extensions.experiments.plots.figures import draw_live, require_matplotlib
from rse_pf.extensions.experiments.results.live_error import (
    live_figures,
    live_table,
    read_live_drives,
    read_live_map,
)
from rse_pf.extensions.experiments.results.markdown import about_run, page, three
from rse_pf.extensions.experiments.results.records import Records, parameters_of, read_records, robot_names
from rse_pf.extensions.experiments.results.result_folder import finish_report, load_average
from rse_pf.extensions.experiments.results.summary import summarise
from rse_pf.terminal import show_page

__all__ = ["FIGURE", "live_experiment_figures", "live_page", "run_live"]

# Name of the file with the image of this experiment.
FIGURE = "live.png"


def run_live(options: DemoOptions, settings: PlatformSettings) -> int:
    """Run the demo, compute the figures from its files, write report and image.

    Return the demo's exit code.
    """
    require_matplotlib()
    load_before = load_average()
    code = run_demo(options, settings, kind="live")
    folder = options.out.resolve()
    records = read_records(folder)
    report = {"experiment": "live", "asked": asked_of(options), **live_experiment_figures(records)}
    drives = read_live_drives(folder, robot_names(options.robots))
    draw_live(folder / FIGURE, drives, read_live_map(folder), report["live"])
    show_page(finish_report(folder, report, live_page, settings, load_before))
    return code


def live_experiment_figures(records: Records) -> dict[str, Any]:
    """Return the figures of a run: those of its commands, and those of the live map as ``live``.

    Raises:
        UsageError: The events do not hold the parameters of the run, or a record cannot be read.
    """
    summary = summarise(records.commands)
    names = ("commands", "failures_by_code", "payload_bytes", "round_trip_ms", "compute_ms")
    drives = read_live_drives(records.folder, robot_names(int(parameters_of(records)["robots"])))
    return {
        **{name: summary[name] for name in names},
        "live": live_figures(drives, read_live_map(records.folder)),
    }


def live_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md`` for *report*."""
    return page(
        "# RSE-PF experiment: live map",
        live_table(report["live"]),
        f"![the run]({FIGURE})",
        f"Round trip of poses p50 / p95 / p99: {three(report['round_trip_ms'])} ms; "
        f"{report['commands']['sent']} commands, {report['commands']['lost']} lost. Errors are over all "
        "robots after one alignment to the truth, and only where all have joined.",
        about_run(report),
    )
