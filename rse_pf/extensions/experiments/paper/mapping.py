"""The mapping experiment (the paper's Fig. 7): robots build point clouds, and their errors are measured.

The experiment runs the demo (real servers, a real load balancer, a process per robot), which writes the true
trajectories to the same folders as the estimated ones, so that the errors can be computed again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from client_sdk.point_map import read_ply
from client_sdk.trajectory import read_trajectory
from client_sdk.trajectory_error import trajectory_figures
from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo
from rse_pf.extensions.experiments.results.bars import Bars
from rse_pf.extensions.experiments.results.markdown import about_run, number, page, table, three
from rse_pf.extensions.experiments.results.records import (
    TRUTH,
    Records,
    parameters_of,
    read_records,
    robot_names,
)
from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_plan
from rse_pf.extensions.experiments.results.result_folder import finish_report, load_average
from rse_pf.extensions.experiments.results.summary import PAPER, summarise
from rse_pf.terminal import show_page

__all__ = ["CLOUD", "asked_of", "map_figures", "map_page", "run_map"]

CLOUD = "map.ply"
"""Name of the file with a robot's point cloud; the file is large, and shipped results may lack it."""
# Frames per robot of the short run with which ``verify --rerun`` checks this experiment.
_SHORT_FRAMES = 40


def run_map(options: DemoOptions, settings: PlatformSettings) -> int:
    """Run the demo, compute the figures from its files, write the report; return the demo's exit code."""
    load_before = load_average()
    code = run_demo(options, settings, kind="map")
    folder = options.out.resolve()
    figures = map_figures(read_records(folder))
    report = {"experiment": "map", "asked": asked_of(options), **figures, "paper": PAPER}
    if options.data is None:  # a recording may not be at hand where the report is read
        arguments = ["--robots", "1", "--frames", str(min(options.frame_count, _SHORT_FRAMES))]
        report[RERUN] = rerun_plan(arguments, _bars(figures))
    show_page(finish_report(folder, report, map_page, settings, load_before))
    return code


def _bars(figures: Mapping[str, Any]) -> Bars:
    """Return the targets of a short run.

    The targets are no lost or duplicated command, and the largest number of lost frames and the largest ATE
    in *figures*.
    """
    bars = {f"commands/{name}": (0.0, "<=") for name in ("lost", "twice")}
    return {**bars, **{name: (max(figures[name]), "<=") for name in ("lost_frames", "ate_cm")}}


def asked_of(options: DemoOptions) -> dict[str, Any]:
    """Return the options of an experiment that runs the demo, for its report."""
    return {
        "out": options.out.name,
        "robots": options.robots,
        "fps": options.rate_hz,
        "data": options.data and options.data.name,
        "frames": options.frame_count,
        "codec": options.codec,
        "seed": options.seed,
    }


def map_figures(records: Records) -> dict[str, Any]:
    """Return the figures of a mapping run: those of its commands, and lists with a value for each robot.

    The lists are frames, lost frames, frame rate, length of the path, ATE and RPE, and points of the cloud.

    Raises:
        UsageError: The events do not hold the parameters of the run, or a trajectory cannot be read.
    """
    parameters = parameters_of(records)
    summary = summarise(records.commands)
    robots = [_robot(records, name, parameters) for name in robot_names(int(parameters["robots"]))]
    names = ("commands", "failures_by_code", "payload_bytes", "round_trip_ms", "compute_ms")
    return {
        **{name: summary[name] for name in names},
        **{name: [robot[name] for robot in robots] for name in robots[0]},
    }


def map_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md`` for *report*."""
    names = ("frames", "lost_frames", "fps_per_robot", "path_m", "ate_cm", "rpe_cm", "rpe_deg", "map_points")
    rows = [
        [robot, *(number(report[name][row]) for name in names)]
        for row, robot in enumerate(robot_names(len(report["frames"])))
    ]
    return page(
        "# RSE-PF experiment: map (the paper's Fig. 7)",
        table(["robot", *names], rows),
        f"Round trip p50 / p95 / p99: {three(report['round_trip_ms'])} ms; {report['commands']['sent']} "
        f"commands, {report['commands']['lost']} lost. The paper shows the cloud of one robot, near 5 fps, "
        "and measures no error.",
        about_run(report),
    )


def _robot(records: Records, name: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    folder = records.folder / name
    frames = int(parameters["frames"][name])
    trajectory = read_trajectory(folder / "trajectory.txt")
    planned = sorted({command.planned for command in records.commands if command.robot == name})
    sending_s = planned[-1] - planned[0] if planned else 0.0
    truth = read_trajectory(folder / TRUTH) if (folder / TRUTH).exists() else None
    return {
        "frames": frames,
        "lost_frames": frames - len(trajectory),
        "fps_per_robot": round((len(planned) - 1) / sending_s, 3) if sending_s > 0 else None,
        **trajectory_figures(trajectory, truth),
        "map_points": len(read_ply(folder / CLOUD)[0]) if (folder / CLOUD).exists() else None,
    }
