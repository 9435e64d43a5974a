"""Measure how often the check of a drive names a planted fault, with which value, and how often it errs.

Each rendered or recorded drive is checked without a fault and with each planted fault.  Poses are solved in
this process.  A fault counts as named if a certain finding has its kind; otherwise it counts as missed.

Defends the promise that the check names planted faults as the first finding in at least 9 of 10 drives and
is silent about healthy drives.  The bars: the first finding names the planted fault in >= 95 % of rendered
drives and >= 85 % of recordings, with the value within 20 %; of 200 healthy drives at most 4 have a finding;
and the check of 250 frames takes <= 10 s of CPU time in addition to tracking.

    python -m benchmarks check.table --seeds 0 1 --out check.json
    python -m benchmarks check.table --seeds 20 21 --recordings ../shared/data --out check.json
    python -m benchmarks check.table --seeds --pairs 20 21 --out pairs.json
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

from benchmarks.check.drives import CheckedDrive, recorded_drive, rendered_drive
from benchmarks.check.faults import FAULTS, Fault
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.recorded_drives import track
from client_sdk.check.findings import CheckReport, FaultKind
from client_sdk.check.motion import MotionReference
from client_sdk.check.observer import DriveObserver
from client_sdk.frontend import Frame, FrontEndOptions
from client_sdk.rigs.stereo_pair_checks import choose_pairs, find_fault_of_frames
from client_sdk.tracking.tracker import Tracker

__all__ = ["table"]

_PARTS = (("7scenes_redkitchen", 0, 125), ("7scenes_redkitchen", 125, 125), ("tum_fr1_rpy_start", 0, 150),
          ("tum_fr1_rpy_start", 150, 150), ("euroc_mh01_start", 60, 100), ("euroc_mh01_start", 220, 100),
          ("kitti_06_start", 0, 51))  # fmt: skip
"""Checked parts of recordings: name of the recording, first frame, number of frames."""
# Names of the checked recordings.
_RECORDINGS = {name for name, _, _ in _PARTS}
# Largest relative error of the value of a finding that counts as near the planted value.
_MAX_VALUE_ERROR = 0.2
_OF_ONE_IMAGE = {FaultKind.DISTORTION, FaultKind.DEPTH_SCALE, FaultKind.MIRRORED, FaultKind.TWO_CAMERAS,
                 FaultKind.MOVING_FOCAL_LENGTH}  # fmt: skip
"""Faults that are planted only into the colour or depth image, and so not into drives of stereo pairs."""


def checked(frames: Sequence[Frame], reference: MotionReference | None) -> tuple[CheckReport, float]:
    """Track and check frames; return the report, and the CPU seconds of the check without the tracking."""
    observer, tracker, took_s = DriveObserver(reference), Tracker(FrontEndOptions()), 0.0
    if _has_stereo(frames):
        observer.add_pairs(
            find_fault_of_frames(
                (frames[row], frames[after]) for row, after in choose_pairs(range(len(frames)))
            )
        )
    for frame in frames:
        result = track(tracker, frame)
        began_s = time.process_time()
        observer.add(frame, result)
        took_s += time.process_time() - began_s
    began_s = time.process_time()
    tracker.adjust_pairs()
    observer.add_offsets(tracker.pair_offsets)
    report = observer.finish()
    return report, took_s + time.process_time() - began_s


def _has_stereo(frames: Sequence[Frame]) -> bool:
    return any(frame.stereo is not None for frame in frames)


def can_have(drive: CheckedDrive, fault: Fault) -> bool:
    """Return whether a drive has the sensor into whose data the fault is planted."""
    if not _has_stereo(drive.frames):
        return fault.needs != "stereo"
    return fault.needs != "depth" and fault.kind not in _OF_ONE_IMAGE


def row_of(drive: CheckedDrive, fault: Fault | None) -> dict[str, Any]:
    """Check a drive with *fault*, if it is not None; return the findings as a row of the table."""
    reference = None if drive.odometry is None else MotionReference(path=drive.odometry)
    frames = list(drive.frames if fault is None else fault.plant(drive.frames))
    report, took_s = checked(frames, reference)
    found = [
        {"kind": each.kind.value, "value": each.value, "deviation": each.deviation, "cost": each.cost_m}
        for each in report.findings
    ]
    row: dict[str, Any] = {
        "drive": drive.name, "frames": len(frames), "check_s": took_s, "findings": found,
        "cannot_tell": [each.kind.value for each in report.cannot_tell],
        "doubts": [each.name.value for each in report.doubts],
    }  # fmt: skip
    if fault is not None:
        own = next((each for each in found if each["kind"] == fault.kind.value), None)
        is_near = fault.value is None or (
            own is not None and abs(own["value"] - fault.value) <= _MAX_VALUE_ERROR * abs(fault.value)
        )
        row |= {
            "fault": fault.name, "wanted": fault.kind.value, "value": fault.value,
            "is_named": own is not None, "is_near": own is not None and is_near,
            "is_first": bool(found) and found[0]["kind"] == fault.kind.value,
            "is_declared": fault.kind.value in row["cannot_tell"],
        }  # fmt: skip
    return row


def drives(
    seeds: Iterable[int], frames: int, recordings: Path | None, pairs: Iterable[int] = ()
) -> Iterator[CheckedDrive]:
    """Yield rendered drives, rendered drives of stereo pairs, then parts of recordings."""
    for seed in seeds:
        yield rendered_drive(seed, frames)
    for seed in pairs:
        yield rendered_drive(seed, frames, stereo=True)
    for name, first, count in _PARTS if recordings is not None else ():
        assert recordings is not None
        yield recorded_drive(recordings / name, first, count)


@benchmark(
    Bar("rendered.first_share", at_least=0.95),
    Bar("rendered.near_share", at_least=0.95),
    Bar("recorded.first_share", at_least=0.85),
    Bar("healthy.share_with_finding", at_most=0.02),
    Bar("check_s.*", at_most=10.0, unit="s"),
)
def table(
    seeds: Annotated[tuple[int, ...], "of rendered drives"] = (0,),
    frames: Annotated[int, "of a rendered drive"] = 120,
    recordings: Annotated[Path | None, "folder of recordings, whose parts are driven too"] = None,
    pairs: Annotated[tuple[int, ...], "seeds of rendered drives of stereo pairs"] = (),
    only: Annotated[tuple[str, ...], "names of faults, such as fx k1 (default: all)"] = (),
) -> dict[str, Any]:
    """Check every drive without and with each fault; return shares, counts by fault, and all rows."""
    chosen = [fault for fault in FAULTS if not only or fault.name.rpartition("-")[0] in only]
    rows: list[dict[str, Any]] = []
    for drive in drives(seeds, frames, recordings, pairs):
        for fault in (None, *(each for each in chosen if can_have(drive, each))):
            row = row_of(drive, fault) | {"is_recorded": drive.name in _RECORDINGS}
            rows.append(row)
            said = ", ".join(
                [f"{e['kind']} {e['value']:.3g}+-{e['deviation']:.2g}" for e in row["findings"]]
                + [f"doubt {name}" for name in row["doubts"]]
            )
            say(f"{drive.name} {'healthy' if fault is None else fault.name}: {said or 'nothing'}")
    planted = [row for row in rows if "fault" in row]
    healthy = [row for row in rows if "fault" not in row]
    with_finding = sum(bool(row["findings"] or row["doubts"]) for row in healthy)
    by_fault: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in planted:
        by_fault[row["fault"].rpartition("-")[0]].append(row)
    return {
        **{
            name: shares([row for row in planted if row["is_recorded"] is is_recorded])
            for name, is_recorded in (("rendered", False), ("recorded", True))
        },
        "healthy": {
            "n": len(healthy), "with_finding": with_finding,
            "share_with_finding": with_finding / max(len(healthy), 1),
        },
        "check_s": {"worst_of_250_frames": max(row["check_s"] * 250 / row["frames"] for row in rows)},
        "by_fault": {name: counts(each) for name, each in by_fault.items()},
        "rows": rows,
    }  # fmt: skip


def counts(rows: Iterable[dict[str, Any]]) -> dict[str, int]:
    """Return the number of *rows*, and in how many of them the fault is first, named, near and declared."""
    kept = list(rows)
    keys = ("is_first", "is_named", "is_near", "is_declared")
    return {"n": len(kept), **{key: sum(row[key] for row in kept) for key in keys}}


def shares(rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the counts of planted faults and the shares that have bars; an empty result without rows."""
    each = counts(rows)
    if not each["n"]:
        return {}
    return each | {
        "first_share": each["is_first"] / each["n"],
        "near_share": each["is_near"] / max(each["is_named"], 1),
    }
