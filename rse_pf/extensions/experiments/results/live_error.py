"""The figures of robots that built a live map together, from their raw records and the published map.

The folder of each robot holds its records: ``live.jsonl`` has a line for each frame, correction and keyframe,
and ``truth.txt`` the true trajectory, if it is known.  The truth is used for errors only.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.trajectory import Trajectory, read_trajectory
from client_sdk.trajectory_error import align, matched_poses, residuals_m, rms
from rse_pf.errors import RsePfError, UsageError
from rse_pf.extensions.experiments.results.map_error import move_frames
from rse_pf.extensions.experiments.results.markdown import number, table
from rse_pf.extensions.experiments.results.records import TRUTH
from rse_pf.geometry import Array
from rse_pf.maps.format import MapVersion, decode_map

__all__ = [
    "LIVE_MAP",
    "LIVE_RECORDS",
    "LiveDrive",
    "alignment_errors",
    "correction_delays_ms",
    "final_trajectory",
    "live_figures",
    "live_lines",
    "live_table",
    "online_trajectory",
    "read_live_drives",
    "read_live_map",
]

LIVE_RECORDS = "live.jsonl"
"""Name of the file with a robot's records, in the folder of the robot."""
LIVE_MAP = "live.rsemap"
"""Name of the file with the map that was published at the end, in the folder of the run."""

# Scale in the records of a robot that measures lengths in an unknown unit.
_UP_TO_SCALE = "up to scale"
# Printed if no robot has a metric scale.
_NO_METRIC_SCALE = (
    "no robot has metres, so that no robot could be aligned with the map: each has one camera without depth\n"
    "  hint: let one of them have depth, a stereo pair or an IMU: --camera stereo, --imu\n"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveDrive:
    """The records of one robot in the order of time; their times are seconds since the robots started.

    ``end`` holds the figures that the robot recorded at the end; ``truth`` is None if it is not known.
    """

    name: str
    frames: list[dict[str, Any]]
    corrections: list[dict[str, Any]]
    keyframes: list[dict[str, Any]]
    end: dict[str, Any]
    truth: Trajectory | None


def read_live_drives(folder: Path, names: Sequence[str]) -> list[LiveDrive]:
    """Return the records of the robots *names* below *folder*; raises UsageError if a file cannot be read."""
    return [_read_drive(folder / name, name) for name in names]


def read_live_map(folder: Path) -> MapVersion | None:
    """Return the published map in *folder*; None if there is none; raises UsageError if it is damaged."""
    path = folder / LIVE_MAP
    if not path.exists():
        return None
    try:
        return decode_map(path.read_bytes())
    except (OSError, RsePfError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the --out of a run") from error


def live_figures(drives: Sequence[LiveDrive], version: MapVersion | None) -> dict[str, Any]:
    """Return the member ``live`` of ``report.json``, the figures of a live map.

    ``final_ate_cm`` is the ATE of all frames, with their poses in the published map.  ``online_ate_cm`` is
    the ATE of the poses that the robots reported while they drove, from the alignment of each robot with the
    map on.  Both are computed after one rigid alignment of all robots together to the truth; they are None if
    a robot is not in the map or has no truth, since the ATE of the other robots alone would be smaller.
    ``correction_ms`` is the time from sending a keyframe to the arrival of the corrections that it caused at
    each robot.
    """
    final = [final_trajectory(drive, version) for drive in drives]
    online = [online_trajectory(drive) for drive in drives]
    given = [frame for drive in drives for frame in drive.frames if frame["T_odom"] is not None]
    delays_ms = correction_delays_ms(drives)
    return {
        "final_ate_cm": _together_cm(final, drives),
        "online_ate_cm": _together_cm(online, drives),
        "joined": sum(_join_frame(drive) is not None for drive in drives),
        "join_frame": [_join_frame(drive) for drive in drives],
        "without_metres": sum(drive.end.get("scale") == _UP_TO_SCALE for drive in drives),
        "aligned_percent": _percent(sum(frame["T_map"] is not None for frame in given), len(given)),
        "aligned_percent_by_robot": [
            _percent(
                sum(frame["T_map"] is not None for frame in drive.frames),
                sum(frame["T_odom"] is not None for frame in drive.frames),
            )
            for drive in drives
        ],
        "relocalisations": _sum(drive.end["relocalisations"] for drive in drives),
        "keyframes_waiting": sum(drive.end["keyframes_waiting"] for drive in drives),
        "by_relocalisation": sum(frame["by"] == "relocalisation" for frame in given),
        "correction_ms": {
            **{
                f"p{q}": round(float(np.percentile(delays_ms, q)), 2) if delays_ms else None for q in (50, 99)
            },
            "n": len(delays_ms),
        },
        "corrections": sum(len(drive.corrections) for drive in drives),
        "keyframes": sum(len(drive.keyframes) for drive in drives),
        "keyframes_in_map": None if version is None else len(version.keyframes),
        "points": None if version is None else len(version.points),
        "points_bytes_by_robot": [drive.end.get("points", {}).get("bytes", 0) for drive in drives],
        "keyframe_kept_ms": _percentiles(
            [1e3 * (keyframe["kept"] - keyframe["sent"]) for drive in drives for keyframe in drive.keyframes]
        ),
        "owners": _owners(drives),
        "lost_frames": sum(frame["T_odom"] is None for drive in drives for frame in drive.frames),
        "segments": [max((frame["segment"] for frame in drive.frames), default=0) + 1 for drive in drives],
    }


def correction_delays_ms(drives: Sequence[LiveDrive]) -> list[float]:
    """Return the time (ms) from sending a keyframe to the arrival of each correction that it caused."""
    sent = {
        (drive.name, keyframe["number"]): keyframe["sent"] for drive in drives for keyframe in drive.keyframes
    }
    return [
        1e3 * (correction["t"] - sent[tuple(correction["cause"])])
        for drive in drives
        for correction in drive.corrections
        if correction["cause"] is not None and tuple(correction["cause"]) in sent
    ]


def online_trajectory(drive: LiveDrive) -> Trajectory:
    """Return the poses in the map that the robot reported while it drove; empty if it was never aligned."""
    placed = [frame for frame in drive.frames if frame["T_map"] is not None]
    return _trajectory(placed, "T_map")


def final_trajectory(drive: LiveDrive, version: MapVersion | None) -> Trajectory:
    """Return the poses of the robot's frames in the published map *version*.

    A frame moves with the nearest keyframes of its segment; frames of a segment without a keyframe in the map
    are left out, and all frames if *version* is None.
    """
    keyframes = (
        []
        if version is None
        else [keyframe for keyframe in version.keyframes if keyframe.robot == drive.name]
    )
    T_map = {round(keyframe.timestamp_s, 6): keyframe.T_world_camera for keyframe in keyframes}
    parts = []
    for segment in sorted({frame["segment"] for frame in drive.frames}):
        known = [
            frame for frame in drive.frames if frame["segment"] == segment and frame["T_odom"] is not None
        ]
        path = _trajectory(known, "T_odom")
        rows = [row for row, stamp in enumerate(path.timestamps_s) if round(stamp, 6) in T_map]
        if rows:
            stamps = path.timestamps_s[rows]
            after = np.array([T_map[round(stamp, 6)] for stamp in stamps])
            parts.append(move_frames(path, stamps, path.T_world_camera[rows], after))
    if not parts:
        return _trajectory([], "T_odom")
    return Trajectory(
        np.concatenate([part.timestamps_s for part in parts]),
        np.concatenate([part.T_world_camera for part in parts]),
    )


def alignment_errors(drives: Sequence[LiveDrive], version: MapVersion | None) -> list[tuple[Array, Array]]:
    """Return for each robot the times ``(n,)`` (s) and position errors ``(n,)`` (cm) of its reported poses.

    One rigid transform, which aligns the final trajectories of all robots with the truth, is applied to the
    map. The arrays of a robot without a truth, or that is not in the map, are empty.
    """
    final = [_match_positions(final_trajectory(drive, version), drive.truth) for drive in drives]
    known = [pair for pair in final if pair is not None]
    if not known:
        return [(np.empty(0), np.empty(0)) for _ in drives]
    _, T = align(np.concatenate([pair[0] for pair in known]), np.concatenate([pair[1] for pair in known]))
    errors = []
    for drive in drives:
        placed = [frame for frame in drive.frames if frame["T_map"] is not None]
        path = _trajectory(placed, "T_map")
        matched = matched_poses(path, drive.truth)
        if matched is None:
            errors.append((np.empty(0), np.empty(0)))
            continue
        rows, true_poses = matched
        moved = path.positions[rows] @ T[:3, :3].T + T[:3, 3]
        distances = np.linalg.norm(moved - true_poses[:, :3, 3], axis=1)
        errors.append((np.array([placed[row]["t"] for row in rows]), 100.0 * distances))
    return errors


def live_lines(live: Mapping[str, Any], robots: int) -> str:
    """Return the text about a live map for the terminal; *live* are its figures; it ends with a newline."""
    delay = live["correction_ms"]
    errors = (
        f"ATE {live['final_ate_cm']:.2f} cm at the end, {live['online_ate_cm']:.2f} cm as given out; "
        if live["final_ate_cm"] is not None and live["online_ate_cm"] is not None
        else ""
    )
    times = f"corrections after {delay['p50']} ms (p50), {delay['p99']} ms (p99)"
    return (
        f"{live['joined']} of {robots} in one live map of {live['keyframes']} keyframes, "
        f"{live.get('points') or 0:,} points; {errors}"
        f"{live['aligned_percent']} % of the poses aligned; {times if delay['n'] else 'no correction'}\n"
        + (_NO_METRIC_SCALE if live.get("without_metres") == robots else "")
    )


def live_table(live: Mapping[str, Any]) -> list[str]:
    """Return the lines of the Markdown table with the figures *live*."""
    delay, acknowledged_ms = live["correction_ms"], live["keyframe_kept_ms"]
    rows = [
        ("joined", live["joined"]),
        ("own frame of the join, by robot", ", ".join(map(number, live["join_frame"]))),
        ("poses given out aligned, %", number(live["aligned_percent"])),
        ("ATE cm, at the end", number(live["final_ate_cm"])),
        ("ATE cm, as given out", number(live["online_ate_cm"])),
        ("keyframe sent to correction, p50 / p99 ms, n", f"{delay['p50']} / {delay['p99']}, {delay['n']}"),
        ("keyframe sent to kept, p50 / p99 ms", f"{acknowledged_ms['p50']} / {acknowledged_ms['p99']}"),
        ("keyframes / in the published map", f"{live['keyframes']} / {number(live['keyframes_in_map'])}"),
        ("points in the published map", number(live.get("points"))),
        ("owners", ", ".join(live["owners"]) or "-"),
    ]
    return table(["live map", ""], rows)


def _read_drive(folder: Path, name: str) -> LiveDrive:
    path = folder / LIVE_RECORDS
    kinds: dict[str, list[dict[str, Any]]] = {"frame": [], "correction": [], "keyframe": [], "end": []}
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            event = json.loads(line)
            kinds[event.pop("event")].append(event)
        end = kinds["end"][-1]
    except (OSError, ValueError, LookupError, AttributeError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the --out of a run") from error
    truth = read_trajectory(folder / TRUTH) if (folder / TRUTH).exists() else None
    return LiveDrive(
        name=name, frames=kinds["frame"], corrections=kinds["correction"], keyframes=kinds["keyframe"],
        end=end, truth=truth,
    )  # fmt: skip


def _trajectory(frames: Sequence[Mapping[str, Any]], which: str) -> Trajectory:
    poses = np.array([frame[which] for frame in frames], dtype=np.float64).reshape(-1, 4, 4)
    return Trajectory(np.array([frame["stamp"] for frame in frames], dtype=np.float64), poses)


def _join_frame(drive: LiveDrive) -> int | None:
    """Return the number (from 0) of the robot's first frame aligned by the map server.

    None if there is none.
    """
    return next((row for row, frame in enumerate(drive.frames) if frame["by"] == "map"), None)


def _match_positions(path: Trajectory, truth: Trajectory | None) -> tuple[Array, Array] | None:
    """Return estimated and true positions ``(n, 3)`` at the same times.

    None if there are fewer than three.
    """
    matched = matched_poses(path, truth)
    return None if matched is None else (path.positions[matched[0]], matched[1][:, :3, 3])


def _together_cm(paths: Iterable[Trajectory], drives: Sequence[LiveDrive]) -> float | None:
    pairs = [_match_positions(path, drive.truth) for path, drive in zip(paths, drives, strict=True)]
    known = [pair for pair in pairs if pair is not None]
    if not known or len(known) < len(pairs):
        return None
    points, wanted = (np.concatenate([pair[column] for pair in known]) for column in (0, 1))
    return round(100.0 * rms(residuals_m(points, wanted)), 4)


def _owners(drives: Sequence[LiveDrive]) -> list[str]:
    """Return the names of the map servers, in the order in which they first appear in the robots' records."""
    seen = sorted(
        (frame["t"], frame["owner"]) for drive in drives for frame in drive.frames if frame["owner"]
    )
    return list(dict.fromkeys(owner for _, owner in seen))


def _sum(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total = Counter[str]()
    for count in counts:
        total.update(count)
    return dict(sorted(total.items()))


def _percent(part: int, whole: int) -> float | None:
    return round(100.0 * part / whole, 2) if whole else None


def _percentiles(values: Sequence[float]) -> dict[str, float | None]:
    return {f"p{q}": round(float(np.percentile(values, q)), 2) if values else None for q in (50, 99)}
