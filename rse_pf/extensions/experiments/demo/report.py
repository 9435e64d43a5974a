"""The demo's report as JSON and Markdown: figures from the records, compared with those of the paper."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.trajectory_error import trajectory_figures
from rse_pf.command_line.drive_output import lost_line
from rse_pf.extensions.experiments.demo.robot import RobotFinished
from rse_pf.extensions.experiments.results.live_error import live_lines, live_table
from rse_pf.extensions.experiments.results.map_error import merged_lines, merged_table
from rse_pf.extensions.experiments.results.markdown import failures, page, slashed, table, three
from rse_pf.extensions.experiments.results.records import CommandRecord
from rse_pf.extensions.experiments.results.summary import PAPER, summarise
from rse_pf.terminal import counted

__all__ = ["advice", "closing_lines", "demo_page", "is_lost", "make_report"]

# Fraction of lost frames from which on the demo prints advice.
_ADVICE_FRACTION = 0.1
# Fraction of frames without a pose above which a run has failed.
_FAILED_FRACTION = 0.5


def make_report(
    finished: Sequence[RobotFinished],
    commands: Sequence[CommandRecord],
    asked: Mapping[str, Any],
    before: Mapping[str, Any],
    load_average_after: Sequence[float],
) -> dict[str, Any]:
    """Return the content of ``report.json``.

    ``ate_cm``, ``rpe_cm`` and other figures of robots are lists in the order of *finished*.  *asked* are the
    options, *before* is the environment before the run.
    """
    errors = [_errors(robot) for robot in finished]
    names = ("ate_cm", "rpe_cm", "rpe_deg", "ate_percent_of_path", "path_m")
    accuracy = {name: [error[name] for error in errors] for name in names}
    return {
        "experiment": "demo",
        "asked": dict(asked),
        "robots": len(finished),
        "frames": sum(robot.frames for robot in finished),
        "lost_frames": sum(robot.lost_frames for robot in finished),
        "frames_before_start": sum(robot.frames_before_start for robot in finished),
        "not_started_because": [robot.not_started_because for robot in finished],
        "keyframes": sum(robot.keyframes for robot in finished),
        "weak_poses": sum(robot.weak_poses for robot in finished),
        "truth": finished[0].truth_kind,
        "up_to_scale": [number for number, robot in enumerate(finished, start=1) if not robot.is_metric],
        **accuracy,
        "matches": _median([m for robot in finished for m in robot.matches]),
        "inliers": _median([i for robot in finished for i in robot.inliers]),
        "map_points": [robot.map_points for robot in finished],
        "fps_per_robot": round(float(np.mean([robot.fps for robot in finished])), 3),
        **summarise(commands),
        "reconnects": sum(robot.stats.get("reconnects", 0) for robot in finished),
        "resent": sum(robot.stats.get("resent", 0) for robot in finished),
        "paper": PAPER,
        "environment": {**before, "load_average_after": list(load_average_after)},
    }


def demo_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md`` for *report*."""
    paper, about, commands = report["paper"], report["environment"], report["commands"]
    trip, compute, payload = report["round_trip_ms"], report["compute_ms"], report["payload_bytes"]
    rows = [
        ("round trip, mean ms", trip["mean"], paper["round_trip_ms"]),
        ("round trip, p50 / p95 / p99 ms", three(trip), ""),
        ("server compute, mean ms", compute["mean"], paper["compute_ms"]),
        ("server compute, p50 / p95 / p99 ms", three(compute), ""),
        ("queue, p50 / p95 / p99 ms", three(report["queue_ms"]), ""),
        ("command, median / largest bytes", slashed(payload, "median", "max"), "< 10,000"),
        ("frames per second and robot", report["fps_per_robot"], f"near {paper['fps_per_robot']:g}"),
        ("frames / lost", slashed(report, "frames", "lost_frames"), ""),
        ("matches / inliers, median", slashed(report, "matches", "inliers"), ""),
        ("ATE cm, by robot", _list(report["ate_cm"]), "not measured"),
        ("RPE cm, by robot", _list(report["rpe_cm"]), "not measured"),
    ]
    options = ", ".join(f"{name} {value}" for name, value in report["asked"].items() if value is not None)
    return page(
        "# RSE-PF demo",
        f"{counted(report['robots'], 'robot')}, {counted(report['frames'], 'frame')}; {options}.",
        table(["figure", "here, one machine", "paper, Sect. 6 (Shenzhen to Seoul)"], rows),
        *([merged_table(report["merged"])] if "merged" in report else []),
        *([live_table(report["live"])] if "live" in report else []),
        f"Commands: {commands['sent']} sent, {commands['answered']} answered, {failures(report)} failed, "
        f"{commands['lost']} lost, {commands['twice']} answered twice.",
        f"Truth: {report['truth']}. Load average before the run {about['load_average']}, after "
        f"{about['load_average_after']}; settings digest {about['settings_digest']}.",
        "Robots and servers share one machine, so the round trip has no network delay. The raw records: "
        "commands.csv, events.jsonl and samples.csv.",
    )


def closing_lines(report: Mapping[str, Any], folder: Path, shown: Collection[str] = ()) -> str:
    """Return the text that the terminal shows at the end; the files of results in *folder* are named last.

    Findings about a recording that are in *shown* were printed before, and are left out.
    """
    trip, commands = report["round_trip_ms"], report["commands"]
    times = f"round trip p50 {trip['p50']} ms, p99 {trip['p99']} ms"
    first = (
        f"{counted(report['robots'], 'robot')} tracked {counted(report['frames'], 'frame')}, "
        f"{lost_line(report)}; {times if trip['p50'] is not None else 'no command was answered'}; "
        f"{commands['answered']} of {counted(commands['sent'], 'command')} answered, {commands['lost']} lost"
    )
    known = [value for value in report["ate_cm"] if value is not None]
    paths = [value for value in report["path_m"] if value is not None]
    second = f"ATE {_list(known)} cm over paths of {_list(paths)} m\n" if known else ""
    if report["up_to_scale"]:
        second += (
            f"up to scale, with neither depth, a second camera nor an IMU: {_robots(report['up_to_scale'])}\n"
        )
    out = _relative(folder)
    files = f"{out}/map.png, " if (folder / "map.png").exists() else ""
    third = ""
    if _without_pose(report) > _FAILED_FRACTION * report["frames"]:
        third = f"failed: {_without_pose(report)} of {counted(report['frames'], 'frame')} have no pose\n"
        if report["frames_before_start"]:
            third += "a camera without depth begins once it has moved, not only turned, over texture\n"
    for number, reason in enumerate(report.get("not_started_because", ()), start=1):
        third += f"robot {number} has no pose: {reason}\n" if reason else ""
    if "merged" in report:
        third += merged_lines(report["merged"])
        files = f"{out}/map_merged.png, {out}/merged.ply, "
        third += f"show the merged map: rse-pf map show merged --store dir:{out}/platform/objects\n"
    if "checks" in report:
        from client_sdk.check.drive_check import DriveCheck

        for name, result in report["checks"].items():
            third += "".join(f"{name}: {line}\n" for line in DriveCheck.lines(result, shown))
    if "live" in report:
        third += live_lines(report["live"], report["robots"])
    return (
        f"{first}\n{second}{third}{advice(report)}"
        f"results: {files}{out}/robot-*/{{map.ply,map.png,trajectory.txt}}; "
        f"{out}/report.md, report.json, commands.csv, events.jsonl, samples.csv"
    )


def is_lost(report: Mapping[str, Any]) -> bool:
    """Return whether a command got no final answer, or more than half of the frames got no pose."""
    return bool(report["commands"]["lost"] > 0 or _without_pose(report) > _FAILED_FRACTION * report["frames"])


def _without_pose(report: Mapping[str, Any]) -> int:
    return int(report["lost_frames"] + report["frames_before_start"])


def advice(report: Mapping[str, Any]) -> str:
    """Return a line of advice, with a newline, if at least a tenth of the frames was lost; otherwise ""."""
    asked = report["asked"]
    if report["lost_frames"] < _ADVICE_FRACTION * report["frames"] or not report["lost_frames"]:
        return ""
    rate = "" if asked.get("data") is None else f"play more of its frames (--rate above {asked['rate_hz']:g})"
    wide = "match over larger steps (--frontend wide-baseline)" * (asked.get("frontend") != "wide-baseline")
    ways = " or ".join(filter(None, (rate, wide))) or "let the robots drive more slowly"
    return f"many frames were lost, because they overlap too little with the frame before: {ways}\n"


def _robots(numbers: Sequence[int]) -> str:
    return ", ".join(f"robot-{number}" for number in numbers)


def _errors(robot: RobotFinished) -> dict[str, float | None]:
    """Return the errors and the length of the robot's path; all are None if its unit is unknown."""
    names = ("ate_cm", "rpe_cm", "rpe_deg", "ate_percent_of_path", "path_m")
    if not robot.is_metric:
        return dict.fromkeys(names)
    figures = trajectory_figures(robot.trajectory, robot.truth)
    ate_cm, path_m = figures["ate_cm"], figures["path_m"] or 1e-9
    return {**figures, "ate_percent_of_path": None if ate_cm is None else round(ate_cm / path_m, 4)}


def _median(values: Sequence[int]) -> int | None:
    return int(np.median(values)) if values else None


def _list(values: Sequence[float | None]) -> str:
    return ", ".join("-" if value is None else f"{value:.2f}" for value in values)


def _relative(folder: Path) -> str:
    try:
        return str(folder.relative_to(Path.cwd()))
    except ValueError:
        return str(folder)
