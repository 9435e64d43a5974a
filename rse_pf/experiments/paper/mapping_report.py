"""Figures and report of a mapping run: frame rates, path lengths and trajectory errors of each robot.

The paper's Fig. 7 shows the cloud of one robot and no error.  Every error here is computed from the
trajectory files, not from what a robot reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from client_sdk.mapping import read_ply, read_trajectory
from rse_pf.experiments.results.markdown import about_run, number, page, table, three
from rse_pf.experiments.results.records import Records, parameters_of
from rse_pf.experiments.results.summary import summarise
from rse_pf.experiments.results.trajectory_error import trajectory_figures

__all__ = ["map_figures", "map_page"]


def map_figures(records: Records) -> dict[str, Any]:
    """Return figures of the commands, and for each robot frames, path, errors and points of its cloud.

    Raises:
        UsageError: The events do not hold the parameters of the run, or a trajectory cannot be read.
    """
    parameters = parameters_of(records)
    summary = summarise(records.commands)
    robots = [
        _robot(records, f"robot-{number + 1}", parameters) for number in range(int(parameters["robots"]))
    ]
    names = ("commands", "failures_by_code", "payload_bytes", "round_trip_ms", "compute_ms")
    return {
        **{name: summary[name] for name in names},
        **{name: [robot[name] for robot in robots] for name in robots[0]},
    }


def map_page(report: Mapping[str, Any]) -> str:
    """Return ``report.md``."""
    names = ("frames", "lost_frames", "fps_per_robot", "path_m", "ate_cm", "rpe_cm", "rpe_deg", "map_points")
    rows = [
        [f"robot-{row + 1}", *(number(report[name][row]) for name in names)]
        for row in range(len(report["frames"]))
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
    planned = sorted({each.planned for each in records.commands if each.robot == name})
    sending_s = planned[-1] - planned[0] if planned else 0.0
    truth = read_trajectory(folder / "truth.txt") if (folder / "truth.txt").exists() else None
    return {
        "frames": frames,
        "lost_frames": frames - len(trajectory),
        "fps_per_robot": round((len(planned) - 1) / sending_s, 3) if sending_s > 0 else None,
        **trajectory_figures(trajectory, truth),
        "map_points": len(read_ply(folder / "map.ply")[0]),
    }
