"""Say what is wrong with a rig from the pairs that it rectifies: swapped, not synchronised, badly rectified.

Features of both images are matched over the whole image, so that a wrong rig cannot hide its errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import DescribedPixels, Frame, describe, load_opencv
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = [
    "PairFault", "PairLook", "check_pairs", "fault_of_looks", "fault_of_pairs", "match_features",
    "measure_pair", "spread_pairs",
]  # fmt: skip

_FEATURES = 600
_RATIO = 0.8
_MAX_SIZE = 2.0
"""Features of coarser levels of the pyramid are placed too roughly."""
_MAX_ROWS_PX = 40.0
"""Matches that are farther apart in the rows are wrong ones."""
_FEWEST = 60
"""Below so many matches nothing is judged."""
_SWAPPED_PX, _SWAPPED_SHARE, _MAYBE_SWAPPED_SHARE = -1.5, 0.6, 0.2
_MAX_OFF_PX = 1.5
_LEAST_LATE_S, _LEAST_LATE_PX, _LEAST_EXPLAINED = 0.004, 0.7, 0.3
_FAST_PX_S, _KEPT_PX, _MOSTLY = 15.0, 2.0, 0.9
_PAIRS = 14


PairLook = tuple[Array, Array, Array]
"""Of the features of one pair: disparities and differences of the rows (px), motion of the rows (px/s)."""


def spread_pairs(rows: Sequence[int]) -> list[tuple[int, int]]:
    """Return some rows of a recording, each with the one after it."""
    places = np.unique(np.linspace(0, len(rows) - 2, _PAIRS).astype(int)) if len(rows) > 1 else ()
    return [(rows[place], rows[place + 1]) for place in places]


@dataclass(frozen=True, slots=True, kw_only=True)
class PairFault:
    """What is wrong with a rig; ``value`` is the share of swapped matches, the delay, s, or the rows, px."""

    what: Literal["swapped", "late", "rows"]
    value: float
    unit: str
    message: str
    hint: str


def check_pairs(pairs: Iterable[tuple[Frame, Frame]], name: str) -> None:
    """Refuse a rig that is wrong, see `fault_of_pairs`.

    Raises:
        UsageError: The images are swapped, the right one is of another time, or rows do not fit.
        MissingExtra: OpenCV is not installed.
    """
    fault = fault_of_pairs(pairs)
    if fault is not None:
        raise UsageError(f"{name}: {fault.message}", hint=fault.hint)


def fault_of_pairs(pairs: Iterable[tuple[Frame, Frame]]) -> PairFault | None:
    """Look at stereo frames, each with a later one, and return what is wrong with their rig.

    Where the images show too little, nothing is said.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    return fault_of_looks(measure_pair(frame, later) for frame, later in pairs)


def fault_of_looks(looks: Iterable[PairLook]) -> PairFault | None:
    """Return what is wrong with a rig, by what some of its pairs show; None where they show too little."""
    known_looks = list(looks)
    if not known_looks:
        return None
    across, off, flow = (np.concatenate([each[part] for each in known_looks]) for part in range(3))
    if len(off) < _FEWEST:
        return None
    swapped = float(np.mean(across < _SWAPPED_PX))
    if swapped > _SWAPPED_SHARE:
        return PairFault(
            what="swapped", value=swapped, unit="share",
            message=f"{100 * swapped:.0f} % of what both cameras see lies farther right in the right image: "
            "the cameras are swapped",
            hint="exchange left and right, in the rig or in the images",
        )  # fmt: skip
    known = np.isfinite(flow)
    low_px, high_px = np.percentile(off, (10, 90))
    # Rows that all differ the same way do so by a rotation: a delay shows as the motion goes.
    is_turned = bool(low_px * high_px > 0.0 and min(abs(low_px), abs(high_px)) > _MAX_OFF_PX)
    late_s = None if is_turned else _late_s(off[known], flow[known])
    if late_s is not None:
        return PairFault(
            what="late", value=late_s, unit="s",
            message=f"the right image is taken {1e3 * abs(late_s):.0f} ms "
            f"{'after' if late_s > 0 else 'before'} the left one: the cameras are not synchronised",
            hint="trigger both cameras together, or take one: --camera left",
        )  # fmt: skip
    typical_px = float(np.median(np.abs(off)))
    if typical_px > _MAX_OFF_PX:
        swap = "the cameras are swapped, or " if swapped > _MAYBE_SWAPPED_SHARE else ""
        return PairFault(
            what="rows", value=typical_px, unit="px",
            message=f"rows of the two images differ by {typical_px:.1f} px in the median, above "
            f"{_MAX_OFF_PX:g} px: {swap}the rectification does not fit",
            hint="calibrate the pair again: rse-pf camera calibrate --stereo; or take one: --camera left",
        )  # fmt: skip
    return None


def measure_pair(frame: Frame, later: Frame) -> PairLook:
    """Return what a stereo frame and a later one show of their rig; nothing of a frame without a pair.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    if frame.stereo is None:
        return np.empty(0), np.empty(0), np.empty(0)
    gray = np.repeat(frame.stereo.gray[:, :, None], 3, axis=2)
    left, right = (describe(image, _FEATURES) for image in (frame.rgb, gray))
    after = describe(later.rgb, _FEATURES)
    rows, others = match_features(left, right)
    offset = left.pixels[rows] - right.pixels[others]
    good = np.abs(offset[:, 1]) < _MAX_ROWS_PX
    moved = np.full(len(left.pixels), np.nan)
    seen, again = match_features(left, after)
    seconds = later.timestamp_s - frame.timestamp_s
    if seconds > 0.0:
        moved[seen] = (after.pixels[again, 1] - left.pixels[seen, 1]) / seconds
    return offset[good, 0], offset[good, 1], moved[rows[good]]


def _late_s(off_px: Array, flow_px_s: Array) -> float | None:
    """Return how much later the right image is, if that explains the differences of the rows; else None.

    A right image that is late by *t* shows a point ``t * flow`` farther down, so that ``off = -t * flow``.
    """
    fast = np.abs(flow_px_s) > _FAST_PX_S
    if fast.sum() < _FEWEST:
        return None
    # Where nothing moves, rows differ by what the rectification leaves.
    off_px = off_px - np.median(off_px if fast.mean() > _MOSTLY else off_px[~fast])
    late_s = -float(np.median(off_px[fast] / flow_px_s[fast]))
    kept = fast
    for _ in range(5):
        kept = np.abs(off_px + late_s * flow_px_s) <= _KEPT_PX
        if (kept & fast).sum() < _FEWEST // 2:
            return None
        x, y = flow_px_s[kept], off_px[kept]
        late_s = -float(((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum())
    explained = 1.0 - float(np.var(off_px[kept] + late_s * flow_px_s[kept]) / max(np.var(off_px[kept]), 1e-9))
    effect_px = abs(late_s) * float(np.std(flow_px_s[kept]))
    is_late = abs(late_s) > _LEAST_LATE_S and effect_px > _LEAST_LATE_PX and explained > _LEAST_EXPLAINED
    return late_s if is_late else None


def match_features(
    one: DescribedPixels, other: DescribedPixels
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the rows of features that are each other's nearest, and clearly so."""
    cv2 = load_opencv()
    mine, theirs = (np.flatnonzero(each.sizes <= _MAX_SIZE) for each in (one, other))
    if len(mine) < 2 or len(theirs) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    distances, nearest = cv2.batchDistance(
        one.descriptors[mine], other.descriptors[theirs], cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )
    _, back = cv2.batchDistance(
        other.descriptors[theirs], one.descriptors[mine], cv2.CV_32S, normType=cv2.NORM_HAMMING, K=1
    )
    clear = distances[:, 0] < _RATIO * distances[:, 1]
    mutual = back[nearest[:, 0], 0] == np.arange(len(mine))
    chosen = np.flatnonzero(clear & mutual)
    return mine[chosen], theirs[nearest[chosen, 0]]
