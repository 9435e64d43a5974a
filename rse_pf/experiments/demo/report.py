"""The demo's report: figures from the records, beside the paper's, as JSON and Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.experiments.demo.robot import Finished
from rse_pf.experiments.results.map_error import merged_lines, merged_rows
from rse_pf.experiments.results.report import PAPER, CommandRecord, summarise
from rse_pf.experiments.results.trajectory_error import absolute_error, relative_error

__all__ = ["as_markdown", "closing_lines", "make_report"]


def make_report(
    finished: Sequence[Finished],
    commands: Sequence[CommandRecord],
    asked: Mapping[str, Any],
    before: Mapping[str, Any],
    load_average_after: Sequence[float],
) -> dict[str, Any]:
    """Return ``report.json``; ``ate_cm`` and ``rpe_cm`` are lists in the robots' order."""
    errors = [_errors(robot) for robot in finished]
    names = ("ate_cm", "rpe_cm", "rpe_deg", "ate_percent_of_path", "path_m")
    accuracy = {name: [error[name] for error in errors] for name in names}
    return {
        "experiment": "demo",
        "asked": dict(asked),
        "robots": len(finished),
        "frames": sum(robot.frames for robot in finished),
        "lost_frames": sum(robot.lost_frames for robot in finished),
        "keyframes": sum(robot.keyframes for robot in finished),
        "weak_poses": sum(robot.weak_poses for robot in finished),
        "truth": finished[0].truth_kind,
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


def as_markdown(report: Mapping[str, Any]) -> str:
    """Return ``report.md``."""
    paper, around = report["paper"], report["environment"]
    trip, compute, payload = report["round_trip_ms"], report["compute_ms"], report["payload_bytes"]
    rows = [
        ("round trip, mean ms", trip["mean"], paper["round_trip_ms"]),
        ("round trip, p50 / p95 / p99 ms", _three(trip), ""),
        ("server compute, mean ms", compute["mean"], paper["compute_ms"]),
        ("server compute, p50 / p95 / p99 ms", _three(compute), ""),
        ("queue, p50 / p95 / p99 ms", _three(report["queue_ms"]), ""),
        ("command, median / largest bytes", f"{payload['median']} / {payload['max']}", "< 10,000"),
        ("frames per second and robot", report["fps_per_robot"], f"near {paper['fps_per_robot']:g}"),
        ("frames / lost", f"{report['frames']} / {report['lost_frames']}", ""),
        ("matches / inliers, median", f"{report['matches']} / {report['inliers']}", ""),
        ("ATE cm, by robot", _list(report["ate_cm"]), "not measured"),
        ("RPE cm, by robot", _list(report["rpe_cm"]), "not measured"),
    ]
    commands = report["commands"]
    lines = [
        "# RSE-PF demo",
        "",
        f"{report['robots']} robots, {report['frames']} frames; "
        + ", ".join(f"{name} {value}" for name, value in report["asked"].items() if value is not None)
        + ".",
        "",
        "| what | here, one machine | paper, Sect. 6 (Shenzhen to Seoul) |",
        "|---|---|---|",
        *(f"| {what} | {ours} | {theirs} |" for what, ours, theirs in rows),
        "",
        *merged_rows(report.get("merged")),
        f"Commands: {commands['sent']} sent, {commands['answered']} answered, {commands['failed']} failed "
        f"{report['failures_by_code'] or ''}, {commands['lost']} lost, {commands['twice']} answered twice.",
        "",
        f"Truth: {report['truth']}. Load average before {around['load_average']}, after "
        f"{around['load_average_after']}; settings {around['settings_digest']}.",
        "",
        "Here robots and servers share one machine: the round trip has no network in it. The raw records "
        "are in commands.csv, events.jsonl and samples.csv.",
        "",
    ]
    return "\n".join(lines)


def closing_lines(report: Mapping[str, Any], folder: Path) -> str:
    """Return what a person sees at the end; the last line names the files."""
    trip, commands = report["round_trip_ms"], report["commands"]
    first = (
        f"{report['robots']} robots mapped {report['frames']} frames, {report['lost_frames']} lost; "
        f"round trip p50 {trip['p50']} ms, p99 {trip['p99']} ms; "
        f"{commands['answered']} of {commands['sent']} commands answered, {commands['lost']} lost"
    )
    known = [value for value in report["ate_cm"] if value is not None]
    second = f"ATE {_list(known)} cm over paths of {_list(report['path_m'])} m\n" if known else ""
    shown = _relative(folder)
    pictures = f"{shown}/map.png and " if (folder / "map.png").exists() else ""
    third = ""
    if "merged" in report:
        third = merged_lines(report["merged"])
        pictures = f"{shown}/map_merged.png, {shown}/merged.ply and "
        third += f"look at it again: rse-pf map show merged --store dir:{shown}/platform/objects\n"
    return (
        f"{first}\n{second}{third}wrote {pictures}{shown}/robot-*/{{map.ply,map.png,trajectory.txt}}, "
        f"{shown}/report.md, report.json, commands.csv, events.jsonl, samples.csv"
    )


def _errors(robot: Finished) -> dict[str, float | None]:
    path_m = round(robot.trajectory.length_m, 3)
    nothing = {"ate_cm": None, "rpe_cm": None, "rpe_deg": None, "ate_percent_of_path": None, "path_m": path_m}
    if robot.truth is None:
        return nothing
    try:
        absolute = absolute_error(robot.trajectory, robot.truth)
        relative = relative_error(robot.trajectory, robot.truth)
    except UsageError:
        return nothing
    return {
        "ate_cm": round(100 * absolute.rmse_m, 4),
        "rpe_cm": round(100 * relative.rmse_m, 4),
        "rpe_deg": round(relative.rmse_deg, 4),
        "ate_percent_of_path": round(100 * absolute.rmse_m / max(path_m, 1e-9), 4),
        "path_m": path_m,
    }


def _median(values: Sequence[int]) -> int | None:
    return int(np.median(values)) if values else None


def _three(values: Mapping[str, Any]) -> str:
    return f"{values['p50']} / {values['p95']} / {values['p99']}"


def _list(values: Sequence[float | None]) -> str:
    return ", ".join("-" if value is None else f"{value:.2f}" for value in values)


def _relative(folder: Path) -> str:
    try:
        return str(folder.relative_to(Path.cwd()))
    except ValueError:
        return str(folder)
