"""The mapping experiment (the paper's Fig. 7): robots build point clouds, and their errors are measured.

The experiment runs the demo (real servers, a real load balancer, a process per robot) and writes the true
trajectories to the same folders as the estimated ones, so that the errors can be computed again.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from client_sdk.point_map import read_ply
from client_sdk.trajectory import Trajectory, read_trajectory, write_trajectory
from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo
from rse_pf.extensions.experiments.paper.harness import policy_parameters
from rse_pf.extensions.experiments.results.bars import Bars
from rse_pf.extensions.experiments.results.markdown import about_run, number, page, table, three
from rse_pf.extensions.experiments.results.records import (
    EVENTS,
    SAMPLES,
    Records,
    SampleLog,
    parameters_of,
    read_records,
    run_sample,
)
from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_plan
from rse_pf.extensions.experiments.results.result_folder import finish_report, load_average
from rse_pf.extensions.experiments.results.summary import PAPER, summarise
from rse_pf.extensions.experiments.results.trajectory_error import trajectory_figures
from rse_pf.local.control.monitor import MonitorSample, ServerSample
from rse_pf.terminal import show_page

__all__ = ["CLOUD", "complete_records", "frames_of", "map_figures", "map_page", "run_map"]

CLOUD = "map.ply"
"""Name of the file with a robot's point cloud; the file is large, and shipped results may lack it."""
# Frames per robot of the short run with which ``verify --rerun`` checks this experiment.
_SHORT_FRAMES = 40


def run_map(options: DemoOptions, settings: PlatformSettings) -> int:
    """Run the demo, compute the figures from its files, write the report; return the demo's exit code."""
    load_before = load_average()
    code = run_demo(options, settings)
    folder = options.out.resolve()
    complete_records(options, settings, folder, _write_truth(options, folder), kind="map")
    asked = {
        "out": options.out.name,
        "robots": options.robots,
        "fps": options.rate_hz,
        "data": options.data and options.data.name,
        "frames": options.frame_count,
        "codec": options.codec,
        "seed": options.seed,
    }
    figures = map_figures(read_records(folder))
    report = {"experiment": "map", "asked": asked, **figures, "paper": PAPER}
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


def _write_truth(options: DemoOptions, folder: Path) -> dict[str, int]:
    """Write ``truth.txt`` of each robot whose true trajectory is known; return the frames of each robot."""
    frames = {}
    for row in range(options.robots):
        name = f"robot-{row + 1}"
        truth, frames[name] = _truth(options, row)
        if truth is not None:
            write_trajectory(folder / name / "truth.txt", truth)
    return frames


def _truth(options: DemoOptions, row: int) -> tuple[Trajectory | None, int]:
    if options.data is None:
        from client_sdk.simulator import true_trajectory

        truth = true_trajectory(row, options.robots, options.frame_count, options.seed)
        return truth, options.frame_count
    share = options.share(row)
    return share.truth, len(share)


def frames_of(options: DemoOptions) -> dict[str, int]:
    """Return the number of frames that each robot plays, by the robot's name."""
    return {f"robot-{row + 1}": _truth(options, row)[1] for row in range(options.robots)}


def complete_records(
    options: DemoOptions,
    settings: PlatformSettings,
    folder: Path,
    frames: dict[str, int],
    *,
    kind: str,
    **more: Any,
) -> None:
    """Turn the records of the demo in *folder* into those of an experiment, in place.

    An event with the parameters of the run, of which *more* are some, is put before the other events; the
    samples of the demo are converted to those of the monitor.  *frames* is the number of frames by robot.
    """
    first = {
        "time": 0.0,
        "action": "experiment",
        "kind": kind,
        "robots": options.robots,
        "fps": options.rate_hz,
        "frames": frames,
        **policy_parameters(settings, 1.0),
        **more,
    }
    events = (folder / EVENTS).read_text(encoding="utf-8")
    (folder / EVENTS).write_text(json.dumps(first) + "\n" + events, encoding="utf-8")
    with (folder / SAMPLES).open(newline="", encoding="utf-8") as file:
        samples = list(_samples(list(csv.DictReader(file))))
    with (folder / SAMPLES).open("w", newline="", encoding="utf-8") as file:
        log = SampleLog(file)
        for sample in samples:
            log.write(sample)


def _samples(rows: list[dict[str, Any]]) -> Iterator[MonitorSample]:
    """Yield a monitor sample for each time in *rows* but the first, with the CPU since the previous time."""
    moments: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        moments.setdefault(row["time"], {})[row["server"]] = row
    for (time_before, before), (time_s, now) in pairwise(moments.items()):
        took_s = max(float(time_s) - float(time_before), 1e-9)
        servers = [_server(row, before[name], took_s) for name, row in now.items() if name in before]
        yield run_sample(float(time_s), len(servers), servers)


def _server(row: dict[str, Any], before: dict[str, Any], took_s: float) -> ServerSample:
    used_s = float(row["cpu_s"]) - float(before["cpu_s"])
    return ServerSample(
        name=row["server"],
        pid=int(row["pid"]),
        state="healthy",
        robots=int(row["robots"]),
        cpu_percent=round(100.0 * used_s / took_s, 2),
        requests=int(row["requests"]) - int(before["requests"]),
        queue=int(row["queue"]),
        in_flight=int(row["in_flight"]),
    )


def map_figures(records: Records) -> dict[str, Any]:
    """Return the figures of a mapping run: those of its commands, and lists with a value for each robot.

    The lists are frames, lost frames, frame rate, length of the path, ATE and RPE, and points of the cloud.

    Raises:
        UsageError: The events do not hold the parameters of the run, or a trajectory cannot be read.
    """
    parameters = parameters_of(records)
    summary = summarise(records.commands)
    robots = [_robot(records, f"robot-{row + 1}", parameters) for row in range(int(parameters["robots"]))]
    names = ("commands", "failures_by_code", "payload_bytes", "round_trip_ms", "compute_ms")
    return {
        **{name: summary[name] for name in names},
        **{name: [robot[name] for robot in robots] for name in robots[0]},
    }


def map_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md`` for *report*."""
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
    planned = sorted({command.planned for command in records.commands if command.robot == name})
    sending_s = planned[-1] - planned[0] if planned else 0.0
    truth = read_trajectory(folder / "truth.txt") if (folder / "truth.txt").exists() else None
    return {
        "frames": frames,
        "lost_frames": frames - len(trajectory),
        "fps_per_robot": round((len(planned) - 1) / sending_s, 3) if sending_s > 0 else None,
        **trajectory_figures(trajectory, truth),
        "map_points": len(read_ply(folder / CLOUD)[0]) if (folder / CLOUD).exists() else None,
    }
