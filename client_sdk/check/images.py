"""What is wrong with the images of a drive: blurred, dark, repeated, missing, or at an uneven rate."""

from __future__ import annotations

import ctypes
import itertools
import math
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.check.findings import CannotTell, FaultKind, Finding
from client_sdk.source_facts import Doubt, DoubtName
from rse_pf.geometry import Array
from rse_pf.native import address_of, core_function

__all__ = ["FrameStatistics", "sharpness"]

_Image = npt.NDArray[np.uint8]
_SHARPEN = "drive more slowly, shorten the exposure or add light, and focus the lens"
_LIGHTEN = "add light, lengthen the exposure, or uncover the lens"
_SHOW_TEXTURE = "point the camera at things with texture, not at a bare wall or the sky alone"

_LINES, _THUMBNAIL = 60, 32
"""So many rows and columns of an image are looked at, and pixels along a side are compared with the last."""
_HALF_PX, _LEAST_STEP, _STRONGEST, _FEWEST_EDGES, _MOST_EDGES = 8, 16, 0.04, 40, 600
_BLURRED, _OF_NEIGHBOURS, _NEIGHBOURS = 0.31, 0.6, 15
_DARK_LEVEL = 40
_FEWEST_FRAMES = 10
_LEAST_SHARE = {FaultKind.BLUR: 0.3, FaultKind.DARK: 0.05, FaultKind.REPEATED: 0.05, FaultKind.MISSING: 0.05}
_LEAST_FRAMES = 3
_STILL, _LONGEST_RUN = 0.3, 10
_FROZEN_JUMP = 1.7  # times the usual change; a camera that was at rest drives on with less
_MOSTLY = 0.5  # of the lost frames have a cause in common
_NEAR_WHOLE, _LEAST_JITTER, _LONGEST_GAP = 0.15, 0.15, 50.0


class FrameStatistics:
    """Small figures of each frame, in the order of time, and what they say together.

    An image takes about a millisecond; a dozen numbers of each are kept.
    """

    def __init__(self, *, is_thinned: bool = False) -> None:
        """Start without frames; of those that are thinned out on purpose, gaps and rate are not judged."""
        self._is_thinned = is_thinned
        self._stamps_s: list[float] = []
        self._sharpness: list[tuple[float, float]] = []
        self._bright: list[float] = []
        self._change: list[float] = []
        self._last: npt.NDArray[np.int16] | None = None

    def __len__(self) -> int:
        return len(self._stamps_s)

    def add(self, timestamp_s: float, rgb: _Image) -> None:
        """Add the next image ``(h, w, 3)`` uint8."""
        green = rgb[:, :, 1]
        steps = [max(1, side // _THUMBNAIL) for side in green.shape]
        small = rgb[:: steps[0], :: steps[1]].astype(np.int16)
        last = self._last
        self._change.append(
            math.inf if last is None or last.shape != small.shape else float(np.abs(small - last).mean())
        )
        self._last = small
        self._stamps_s.append(timestamp_s)
        self._bright.append(_percentile(small[:, :, 1], 98))
        self._sharpness.append(sharpness(green))

    def findings(self) -> tuple[list[Finding], list[CannotTell]]:
        """Return what is wrong with the images, and what cannot be told of them."""
        if len(self) < _FEWEST_FRAMES:
            reason = f"{len(self)} frames are too few to judge the images"
            return [], [CannotTell(FaultKind.BLUR, reason)]
        found = [
            self._share(
                FaultKind.BLUR, self.blurred(), "blurred: their edges are wider than 7 px",
                _SHARPEN,
            ),
            self._share(
                FaultKind.DARK, self.dark(), "dark: they show nothing",
                _LIGHTEN,
            ),
            self._share(
                FaultKind.REPEATED, self.repeated(), "the image before once more, with a new time stamp",
                "record at the rate of the camera, not above it, and look for a driver that repeats images",
            ),
        ]  # fmt: skip
        timing, untold = self._timing()
        return [*(each for each in found if each is not None), *timing], untold

    def blurred(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` are blurred: beside their neighbours, or all of the drive."""
        values = np.array(self._sharpness).reshape(-1, 2)
        is_blurred = np.zeros(len(values), dtype=bool)
        for direction in values.T:
            known = np.flatnonzero(np.isfinite(direction))
            for row in known:
                near = direction[max(0, row - _NEIGHBOURS) : row + _NEIGHBOURS + 1]
                sharp = float(np.percentile(near[np.isfinite(near)], 90))
                # Where no neighbour is sharp either, texture and blur look alike: see below.
                is_blurred[row] |= direction[row] < min(_BLURRED, _OF_NEIGHBOURS * sharp)
        best = values[np.isfinite(values).any(axis=1)]
        if len(best) >= _FEWEST_FRAMES and np.percentile(np.nanmax(best, axis=1), 90) < _BLURRED:
            is_blurred[np.isfinite(values).any(axis=1)] = True
        return is_blurred

    def dark(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` are too dark to show anything."""
        return np.array(self._bright) < _DARK_LEVEL

    def empty(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` show no edge at all: a plain wall, or nothing."""
        empty: npt.NDArray[np.bool_] = np.isnan(np.array(self._sharpness).reshape(-1, 2)).all(axis=1)
        return empty

    def cause_of_loss(self, is_lost: npt.NDArray[np.bool_]) -> str | None:
        """Return what most of the lost frames ``(n,)`` lack and what to do; None if they show enough.

        A dark image has no edges either, and a strong blur leaves few, so that darkness counts first, and the
        most frequent cause is named.
        """
        is_dark = self.dark()
        is_plain = self.empty() & ~is_dark
        causes = (
            (is_dark, "are dark", _LIGHTEN), (is_plain, "show no texture", _SHOW_TEXTURE),
            (self.blurred() & ~is_dark & ~is_plain, "are blurred", _SHARPEN),
        )  # fmt: skip
        counts = [int(np.count_nonzero(rows & is_lost)) for rows, *_ in causes]
        total = int(np.count_nonzero(is_lost))
        if sum(counts) <= _MOSTLY * total:
            return None
        _, what, fix = causes[int(np.argmax(counts))]
        return f"{max(counts)} of {total} frames without a pose {what}: {fix}"

    def repeated(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` have the image of the frame before, while the camera moves."""
        change = np.array(self._change)
        moving = change[(change > 0.0) & np.isfinite(change)]
        is_repeated: npt.NDArray[np.bool_] = np.zeros(len(change), dtype=bool)
        least = _STILL * float(np.median(moving)) if len(moving) else math.inf
        end = len(change)
        for row in range(len(change) - 1, -1, -1):
            if change[row] == 0.0:
                continue
            # A camera that stands still gives equal images for long, or moves little after them.
            after = change[end] if end < len(change) else math.inf
            is_repeated[row + 1 : end] = end - row - 1 <= _LONGEST_RUN and after >= least
            end = row
        return is_repeated

    def frozen(self) -> tuple[Doubt, ...]:
        """Return a doubt about runs of one image that are longer than `repeated` takes, and end in a jump."""
        change = np.array(self._change)
        moving = change[(change > 0.0) & np.isfinite(change)]
        ends = np.flatnonzero(change != 0.0)
        runs = [
            (last, end - last - 1)
            for last, end in itertools.pairwise(ends)
            if end - last - 1 > _LONGEST_RUN and change[end] > _FROZEN_JUMP * np.median(moving)
        ]
        if not runs:
            return ()
        row, length = max(runs, key=lambda run: run[1])
        sentence = (
            f"one image is repeated {length} times after {self._stamps_s[row]:.3f} s, with new time stamps, "
            "and the next one shows another place"
        )
        hint = "look for a driver or a recorder that repeats its last image"
        return (Doubt(name=DoubtName.FROZEN_IMAGES, sentence=sentence, hint=hint),)

    def _share(self, kind: FaultKind, rows: npt.NDArray[np.bool_], what: str, fix: str) -> Finding | None:
        n, count = len(rows), int(rows.sum())
        share = count / n
        if share < _LEAST_SHARE[kind] or count < _LEAST_FRAMES:
            return None
        # What is dark or repeated is counted; whether an image is blurred is measured.
        deviation = math.sqrt(share * (1.0 - share) / n) if kind is FaultKind.BLUR else 0.0
        doubt = f" +- {100 * deviation:.0f}" if deviation > 0.0 else ""
        return Finding(
            kind=kind, value=share, deviation=deviation, unit="share", cost_m=None,
            sentence=f"{count} of {n} frames ({100 * share:.0f}{doubt} %) are {what}", fix=fix,
        )  # fmt: skip

    def _timing(self) -> tuple[list[Finding], list[CannotTell]]:
        """Return gaps and jitter of the time stamps."""
        if self._is_thinned:
            reason = "frames were left out on purpose: gaps and jitter are not those of the camera"
            return [], [CannotTell(FaultKind.MISSING, reason), CannotTell(FaultKind.JITTER, reason)]
        steps_s = np.diff(np.array(self._stamps_s))
        steps_s = steps_s[steps_s > 0.0]
        if len(steps_s) < _FEWEST_FRAMES:
            return [], [CannotTell(FaultKind.JITTER, f"{len(steps_s)} intervals tell no rate")]
        interval_s = _interval_s(steps_s)
        steps = steps_s / interval_s
        whole = np.maximum(1.0, np.round(steps))
        lost = whole[whole <= _LONGEST_GAP] - 1.0
        findings: list[Finding] = []
        missing, n = int(lost.sum()), len(self)
        share = missing / (missing + n)
        off = (steps - whole)[steps < _LONGEST_GAP]
        low, high = np.percentile(off, (5, 95))
        jitter = float(np.std(np.clip(off, low, high)))
        is_even = jitter < _LEAST_JITTER
        if share >= _LEAST_SHARE[FaultKind.MISSING] and np.count_nonzero(lost) >= _LEAST_FRAMES and is_even:
            findings.append(
                Finding(
                    kind=FaultKind.MISSING, value=share, deviation=0.0, unit="share", cost_m=None,
                    sentence=f"{missing} of {missing + n} frames ({100 * share:.0f} %) are missing at "
                    f"{1.0 / interval_s:.1f} Hz, in gaps of up to {int(lost.max())}",
                    fix="look for what drops them: a slow disk, a USB hub, or a queue that is too short",
                )
            )  # fmt: skip
        if not is_even:
            deviation = jitter / math.sqrt(2.0 * len(off))
            findings.append(
                Finding(
                    kind=FaultKind.JITTER, value=jitter, deviation=deviation, unit="relative", cost_m=None,
                    sentence=f"intervals between frames vary by {100 * jitter:.0f} +- "
                    f"{100 * deviation:.0f} % of {1e3 * interval_s:.0f} ms",
                    fix="take the time of the exposure from the driver, not the time of arrival",
                )
            )  # fmt: skip
        return findings, []


def _percentile(values: npt.NDArray[np.int16], percent: int) -> float:
    """Return what `numpy.percentile` does of some numbers, in a fifth of its time."""
    ordered = np.sort(values, axis=None)
    row, rest = divmod(percent * (len(ordered) - 1), 100)
    low, high = float(ordered[row]), float(ordered[min(row + 1, len(ordered) - 1)])
    return low + (high - low) * rest / 100.0


def sharpness(gray: _Image) -> tuple[float, float]:
    """Return how sharp the strongest edges of ``(h, w)`` uint8 are, along x and along y; NaN without edges.

    It is the steepest difference over two pixels beside the whole step over 16: 1 for a step within two
    pixels, and about ``2 / n`` for one that is blurred over *n*.  Texture changes it little.
    """
    rows, columns = (max(1, side // _LINES) for side in gray.shape)
    # Copied row by row, as the image lies in memory, before its columns become lines.
    upright = np.ascontiguousarray(gray[:, ::columns]).T
    return _edges(np.ascontiguousarray(gray[::rows])), _edges(np.ascontiguousarray(upright))


def _edges(lines: _Image) -> float:
    """Return the sharpness along the rows of ``(n, w)`` uint8."""
    if lines.shape[1] < 6 * _HALF_PX:
        return math.nan
    strong = max(1, int(_STRONGEST * len(lines) * (lines.shape[1] - 2 * _HALF_PX)))
    sharpest = np.empty(_MOST_EDGES)
    count = _core_edges()(
        address_of(lines), *lines.shape, strong, _LEAST_STEP, _MOST_EDGES,
        address_of(sharpest),
    )  # fmt: skip
    if count < _FEWEST_EDGES:
        return math.nan
    every = -(-count // _MOST_EDGES)
    return float(np.median(sharpest[: -(-count // every)]))


@cache
def _core_edges() -> Any:
    arguments = (ctypes.c_void_p, *[ctypes.c_int64] * 5, ctypes.c_void_p)
    return core_function("check", "rse_pf_edges", arguments, ctypes.c_int64)


def _interval_s(steps_s: Array) -> float:
    """Return the interval of the camera: that of which all are multiples, else the median."""
    for percent in (50, 35, 20):
        interval_s = float(np.percentile(steps_s, percent))
        steps = steps_s / interval_s
        off = np.abs(steps - np.maximum(1.0, np.round(steps)))
        if np.percentile(off, 90) < _NEAR_WHOLE:
            return interval_s
    return float(np.median(steps_s))
