"""Judge a mapping run by what it left: commands, trajectories and the true paths, robot by robot.

The paper's Fig. 7 shows one robot's cloud; this adds what it leaves out, how wrong each path is.  Promises
to compute every error from the trajectory files, not from what a robot said at its end.
"""

from __future__ import annotations

from typing import Any

from client_sdk.mapping import read_ply, read_trajectory
from rse_pf.errors import UsageError
from rse_pf.experiments.results.records import Records, asked_of
from rse_pf.experiments.results.report import summarise
from rse_pf.experiments.results.trajectory_error import absolute_error, relative_error

__all__ = ["judge_map"]


def judge_map(records: Records) -> dict[str, Any]:
    """Return figures of commands, and by robot: frames, lost frames, path, ATE, RPE, points of the cloud.

    Raises:
        UsageError: The events do not say what was asked, or a trajectory cannot be read.
    """
    asked = asked_of(records)
    summary = summarise(records.commands)
    robots = [_robot(records, f"robot-{number + 1}", asked) for number in range(int(asked["robots"]))]
    return {
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "payload_bytes": summary["payload_bytes"],
        "round_trip_ms": summary["round_trip_ms"],
        "compute_ms": summary["compute_ms"],
        **{name: [robot[name] for robot in robots] for name in robots[0]},
    }


def _robot(records: Records, name: str, asked: dict[str, Any]) -> dict[str, Any]:
    folder = records.folder / name
    frames = int(asked["frames"][name])
    trajectory = read_trajectory(folder / "trajectory.txt")
    own = sorted({each.planned for each in records.commands if each.robot == name})
    asked_s = own[-1] - own[0] if len(own) > 1 else 0.0
    try:
        truth = read_trajectory(folder / "truth.txt") if (folder / "truth.txt").exists() else None
        ate = None if truth is None else round(100 * absolute_error(trajectory, truth).rmse_m, 4)
        step = None if truth is None else relative_error(trajectory, truth)
    except UsageError:  # too few poses match in time
        ate, step = None, None
    return {
        "frames": frames,
        "lost_frames": frames - len(trajectory),
        "fps_per_robot": round((len(own) - 1) / asked_s, 3) if asked_s > 0 else None,
        "path_m": round(trajectory.length_m, 3),
        "ate_cm": ate,
        "rpe_cm": None if step is None else round(100 * step.rmse_m, 4),
        "rpe_deg": None if step is None else round(step.rmse_deg, 4),
        "map_points": len(read_ply(folder / "map.ply")[0]),
    }
