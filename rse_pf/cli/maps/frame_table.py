"""The table of all frames of a drive, ``frames.csv``: which frame has no pose or a weak one, and why."""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.terminal import counted

if TYPE_CHECKING:
    from client_sdk import TrackedFrame

__all__ = ["FRAMES_FILE", "FrameTable", "named_frames"]

# Name of the table in the folder of results.
FRAMES_FILE = "frames.csv"
_COLUMNS = (
    "frame", "timestamp_s", "status", "verdict", "reason", "keyframe", "matches", "inliers", "sigma_position",
    "source", "round_trip_ms",
)  # fmt: skip
# Numbers or ranges of frames that a printed line names; further ones become ``...``.
_MOST_NAMED = 8


class FrameTable:
    """Collects the tracking result of each frame, and writes all as a table and the worst as a few lines."""

    def __init__(self) -> None:
        self._rows: list[tuple[str, ...]] = []
        self._weak: list[int] = []
        self._lost: list[int] = []
        self._reasons: Counter[str] = Counter()

    def add(self, tracked: TrackedFrame) -> None:
        """Add the result of the next frame; frames are numbered from 1."""
        number = len(self._rows) + 1
        has_pose = tracked.T_world_camera is not None
        verdict = ("weak" if tracked.reason else "ok") if has_pose else "none"
        if tracked.status == "lost":
            self._lost.append(number)
            self._reasons[tracked.reason] += 1
        elif verdict == "weak":
            self._weak.append(number)
        trip, covariance = tracked.round_trip_ms, tracked.covariance
        sigma = None if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3])))
        self._rows.append(
            (
                str(number), f"{tracked.frame.timestamp_s:.6f}", tracked.status, verdict, tracked.reason,
                str(int(tracked.keyframe)), str(tracked.matches), str(tracked.inliers),
                "" if sigma is None else f"{sigma:.6f}",
                tracked.source, "" if trip is None else f"{trip:.3f}",
            )
        )  # fmt: skip

    def lines(self) -> Iterator[str]:
        """Yield a line on lost frames with the most frequent reason, and a line on weak poses, if any."""
        if self._lost:
            (reason, _), *others = self._reasons.most_common()
            more = f" (and {counted(len(others), 'other reason')}: see {FRAMES_FILE})" if others else ""
            yield f"lost: {named_frames(self._lost)}; because: {reason}{more}"
        if self._weak:
            yield f"weak poses: {named_frames(self._weak)}; {FRAMES_FILE} says why"

    def write(self, path: Path) -> None:
        """Write the table as CSV to *path*.

        Raises:
            UsageError: The file cannot be written.
        """
        try:
            with path.open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(_COLUMNS)
                writer.writerows(self._rows)
        except OSError as error:
            raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another --out") from error


def named_frames(numbers: list[int]) -> str:
    """Return words such as ``frames 3, 7-9`` for sorted *numbers*; after 8 numbers or ranges, ``...``."""
    ranges = []
    for _, group in itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        ranges.append(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}")
    named = ", ".join(ranges[:_MOST_NAMED]) + (", ..." if len(ranges) > _MOST_NAMED else "")
    return f"{'frame' if len(numbers) == 1 else 'frames'} {named}"
