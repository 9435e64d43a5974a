"""Measure what a correction is worth: the error of a drive with a fault, before and after ``check --write``.

Defends: after the correction the ATE is within 15 % of that of the drive without the fault, where the check
named a fault that intrinsics can say: focal length, principal point, distortion, depth scale.

    python -m benchmarks check.correction --seeds 0 1 --out correction.json
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.check.drives import CheckedDrive
from benchmarks.check.faults import FAULTS
from benchmarks.check.table import can_have, checked, drives
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.maps.recordings import track
from client_sdk.check.corrections import corrected
from client_sdk.check.motion import MotionReference
from client_sdk.frontend import Frame, FrontEndOptions
from client_sdk.rigs.intrinsics import Intrinsics, Undistortion
from client_sdk.tracking.tracker import Tracker
from rse_pf.experiments.results.trajectory_error import ate_m

__all__ = ["correction"]

_CORRECTED = ("fx", "f", "cx", "k1", "depth-scale")


@benchmark(Bar("worst_ratio", at_most=1.15))
def correction(
    seeds: Annotated[tuple[int, ...], "of rendered drives"] = (0,),
    frames: Annotated[int, "of a rendered drive"] = 100,
    recordings: Annotated[Path | None, "folder of recordings, whose parts are driven too"] = None,
    severities: Annotated[tuple[int, ...], "1, 2 or 3"] = (2,),
) -> dict[str, Any]:
    """Drive healthy, with each fault, and corrected; return the errors, and the worst ratio."""
    rows: list[dict[str, Any]] = []
    chosen = [
        fault
        for fault in FAULTS
        if fault.name.rpartition("-")[0] in _CORRECTED and fault.severity in severities
    ]
    for drive in drives(seeds, frames, recordings):
        healthy_cm, _ = _error(drive, drive.frames)
        for fault in (each for each in chosen if can_have(drive, each)):
            bent = list(fault.plant(drive.frames))
            reference = None if drive.odometry is None else MotionReference(path=drive.odometry)
            report, _ = checked(bent, reference)
            before = Intrinsics(camera=bent[0].camera)
            after, changed = corrected(before, report.findings)
            bent_cm, bent_lost = _error(drive, bent)
            straight_cm, straight_lost = _error(drive, _straightened(bent, before, after))
            rows.append(
                {
                    "drive": drive.name, "fault": fault.name, "changed": changed, "healthy_cm": healthy_cm,
                    "bent_cm": bent_cm, "corrected_cm": straight_cm, "lost": [bent_lost, straight_lost],
                }
            )  # fmt: skip
            say(
                f"{drive.name} {fault.name}: {healthy_cm:.2f}, bent {bent_cm:.2f}, "
                f"corrected {straight_cm:.2f} cm"
                f" ({'; '.join(changed) or 'nothing changed'})"
            )
    ratios = [row["corrected_cm"] / row["healthy_cm"] for row in rows if row["changed"]]
    return {
        "n": len(rows), "corrected": len(ratios), "worst_ratio": max(ratios, default=float("nan")),
        "within": sum(ratio <= 1.15 for ratio in ratios), "rows": rows,
    }  # fmt: skip


def _straightened(frames: Iterable[Frame], before: Intrinsics, after: Intrinsics) -> list[Frame]:
    """Return frames as a reader gives them with the corrected intrinsics."""
    lens, metres = Undistortion(after), np.float32(before.depth_scale / after.depth_scale)
    return [
        replace(
            frame, camera=after.camera, rgb=lens.colour(frame.rgb), depth_m=lens.depth(frame.depth_m) * metres
        )
        for frame in frames
    ]


def _error(drive: CheckedDrive, frames: Sequence[Frame]) -> tuple[float, int]:
    """Return the ATE in cm of the frames that have a pose, and how many have none."""
    tracker = Tracker(FrontEndOptions())
    results = [(frame.timestamp_s, track(tracker, frame).T_world_camera) for frame in frames]
    posed = [(stamp_s, pose) for stamp_s, pose in results if pose is not None]
    stamps_s = np.array([stamp_s for stamp_s, _ in posed])
    poses = np.array([pose for _, pose in posed])
    return 100.0 * ate_m(poses, drive.truth.at(stamps_s)), len(results) - len(posed)
