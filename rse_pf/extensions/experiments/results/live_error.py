"""The figures of robots that shared a live map, from their raw records and the map that was published.

Records are in the folder of each robot: ``live.jsonl`` has a line for each frame, correction and keyframe,
``truth.txt`` the true trajectory, if it is known.  The truth is used for errors alone.
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
from rse_pf.errors import RsePfError, UsageError
from rse_pf.extensions.experiments.results.map_error import move_frames
from rse_pf.extensions.experiments.results.markdown import number, table
from rse_pf.extensions.experiments.results.trajectory_error import align, match_truth
from rse_pf.geometry import Array
from rse_pf.maps.format import MapVersion, decode_map

__all__ = [
    "LIVE_MAP",
    "LIVE_RECORDS",
    "TRUTH",
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
LIVE_MAP = "live.rsemap"
"""The version that the live map published at the end, in the folder of the run."""
TRUTH = "truth.txt"


_UP_TO_SCALE = "up to scale"
_NO_METRES = (
    "no robot has metres, so a place in the map is known of none: all have one lens alone\n"
    "  hint: let one of them have depth, a stereo pair or an IMU: --camera stereo, --imu\n"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveDrive:
    """The records of one robot, in the order of time; times are seconds since the start of all robots."""

    name: str
    frames: list[dict[str, Any]]
    corrections: list[dict[str, Any]]
    keyframes: list[dict[str, Any]]
    end: dict[str, Any]
    truth: Trajectory | None


def read_live_drives(folder: Path, names: Sequence[str]) -> list[LiveDrive]:
    """Return the records of the robots in *folder*; raises UsageError."""
    return [_read_drive(folder / name, name) for name in names]


def read_live_map(folder: Path) -> MapVersion | None:
    """Return the map that was published, None if there was none; raises UsageError if it is damaged."""
    path = folder / LIVE_MAP
    if not path.exists():
        return None
    try:
        return decode_map(path.read_bytes())
    except (OSError, RsePfError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the --out of a run") from error


def live_figures(drives: Sequence[LiveDrive], version: MapVersion | None) -> dict[str, Any]:
    """Return ``live`` of ``report.json``.

    ``final_ate_cm`` is over all frames of the robots that are in the published map, ``online_ate_cm`` over
    the poses as they were given out, from each robot's alignment on; both after one rigid alignment of all
    robots to the truth.  They are None where a robot was not joined, since the others alone are easier.
    ``correction_ms`` is from the sending of a keyframe to the corrections that it caused, at each robot.
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
    """Return the time from the sending of each keyframe to each correction that it caused."""
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
    """Return the poses in the map as they were given out."""
    placed = [frame for frame in drive.frames if frame["T_map"] is not None]
    return _trajectory(placed, "T_map")


def final_trajectory(drive: LiveDrive, version: MapVersion | None) -> Trajectory:
    """Return the poses of all frames in the published map, by its keyframes of the same segment."""
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
    """Return, for each robot, times ``(n,)`` and distances ``(n,)`` (cm) of the poses given out to the truth.

    The map is placed by the final trajectories; a robot without a truth, or not in the map, has no rows.
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
        try:
            rows, true_poses = match_truth(path, _truth(drive))
        except UsageError:
            errors.append((np.empty(0), np.empty(0)))
            continue
        moved = path.positions[rows] @ T[:3, :3].T + T[:3, 3]
        distances = np.linalg.norm(moved - true_poses[:, :3, 3], axis=1)
        errors.append((np.array([placed[row]["t"] for row in rows]), 100.0 * distances))
    return errors


def live_lines(live: Mapping[str, Any], robots: int) -> str:
    """Return what the terminal shows of a live map, with its newline."""
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
        + (_NO_METRES if live.get("without_metres") == robots else "")
    )


def live_table(live: Mapping[str, Any]) -> list[str]:
    """Return the table of ``report.md``."""
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


def _truth(drive: LiveDrive) -> Trajectory:
    if drive.truth is None:
        raise UsageError("the truth is not known", hint="choose a recording with a ground truth")
    return drive.truth


def _join_frame(drive: LiveDrive) -> int | None:
    """Return the first of the robot's frames, from 0, whose pose the map itself had aligned."""
    return next((row for row, frame in enumerate(drive.frames) if frame["by"] == "map"), None)


def _match_positions(path: Trajectory, truth: Trajectory | None) -> tuple[Array, Array] | None:
    """Return estimated and true positions ``(n, 3)``, or None if they do not match in time."""
    if truth is None:
        return None
    try:
        rows, true_poses = match_truth(path, truth)
    except UsageError:
        return None
    return path.positions[rows], true_poses[:, :3, 3]


def _together_cm(paths: Iterable[Trajectory], drives: Sequence[LiveDrive]) -> float | None:
    pairs = [_match_positions(path, drive.truth) for path, drive in zip(paths, drives, strict=True)]
    known = [pair for pair in pairs if pair is not None]
    if not known or len(known) < len(pairs):
        return None
    points, wanted = (np.concatenate([pair[column] for pair in known]) for column in (0, 1))
    _, T = align(points, wanted)
    distances = np.linalg.norm(points @ T[:3, :3].T + T[:3, 3] - wanted, axis=1)
    return round(100.0 * float(np.sqrt(np.mean(np.square(distances)))), 4)


def _owners(drives: Sequence[LiveDrive]) -> list[str]:
    """Return who served the map, in the order in which robots heard of them."""
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
