"""Find faults of the images of a drive: blurred, dark, repeated or missing frames, and an uneven rate."""

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
# Action of findings on blurred images.
_SHARPEN_HINT = "drive more slowly, shorten the exposure or add light, and focus the lens"
# Action of findings on dark images.
_LIGHTEN_HINT = "add light, lengthen the exposure, or uncover the lens"
# Action for images with too few edges.
_SHOW_TEXTURE_HINT = "point the camera at things with texture, not at a bare wall or the sky alone"

# Approximate number of rows, and of columns, that are searched for edges: bounds the time.
_SAMPLED_LINES = 60
_THUMBNAIL_PX = 32  # approximate side, in pixels, of the thumbnails with which successive images are compared
_EDGE_HALF_WIDTH_PX = 8  # half of the distance, in pixels, over which the contrast of an edge is measured
_MIN_EDGE_STEP = 16  # smallest contrast of an edge, in grey levels of 255: noise has less
_EDGE_SHARE = 0.04  # share of the sampled pixels, those with the highest contrast, that count as edges
_MIN_EDGES = 40  # fewest edges from which the sharpness of an image is measured
_MAX_EDGES = 600  # largest number of edges of an image that are measured: bounds the time
_MIN_SHARPNESS = 0.31  # below this `sharpness`, an edge is wider than about 7 px, and an image may be blurred
# An image is blurred only if its sharpness is also below this share of that of its sharpest neighbours.
_MIN_SHARPNESS_RATIO = 0.6
_NEIGHBOURS = 15  # number of frames before, and after, a frame with which its sharpness is compared
_MAX_DARK_LEVEL = 40  # an image is dark if 98 % of its pixels are below this grey level of 255
_MIN_FRAMES = 10  # fewest frames, and fewest intervals between frames, with which a drive is checked
# Smallest share of the frames with a fault, by kind of the fault, that is reported.
_MIN_SHARES = {FaultKind.BLUR: 0.3, FaultKind.DARK: 0.05, FaultKind.REPEATED: 0.05, FaultKind.MISSING: 0.05}
_MIN_FAULTY_FRAMES = 3  # smallest number of faulty frames, or of gaps, that is reported
# A run of equal images is a fault if the next change is at least this share of the median change: after a
# stationary camera, images change less.
_MIN_CHANGE_RATIO = 0.3
_MAX_REPEATED_RUN = 10  # largest number of repeated images in a row; a longer run may be a stationary camera
# More than 10 equal images in a row are a fault if the next change of the image exceeds this many times the
# median change: a camera that starts to move changes the image less.
_MIN_FROZEN_JUMP = 1.7
# A cause of loss is named only if more than this share of the lost frames are dark, plain or blurred.
_MIN_COMMON_CAUSE_SHARE = 0.5
# Largest distance of 90 % of the intervals from a multiple of the camera's interval, as a share of it.
_MAX_INTERVAL_ERROR = 0.15
# Smallest standard deviation of the intervals between frames, as a share of the interval, that is a fault.
_MIN_JITTER = 0.15
_MAX_GAP_INTERVALS = 50.0  # a longer gap, in intervals of the camera, is a pause and not missing frames


class FrameStatistics:
    """Collect sharpness, brightness, change and time stamp of each frame, and find faults in them.

    Processing an image takes about a millisecond.  Of each image only five numbers are kept, of the last one
    also a thumbnail.
    """

    def __init__(self, *, is_thinned: bool = False) -> None:
        """Start without frames.

        *is_thinned* states that frames were left out on purpose: then neither gaps nor jitter are checked.
        """
        self._is_thinned = is_thinned
        self._stamps_s: list[float] = []
        self._sharpness: list[tuple[float, float]] = []
        self._bright: list[float] = []
        self._change: list[float] = []
        self._last: npt.NDArray[np.int16] | None = None

    def __len__(self) -> int:
        return len(self._stamps_s)

    def add(self, timestamp_s: float, rgb: _Image) -> None:
        """Add the next image ``(h, w, 3)`` uint8 with its time stamp in seconds."""
        green = rgb[:, :, 1]
        steps = [max(1, side // _THUMBNAIL_PX) for side in green.shape]
        small = rgb[:: steps[0], :: steps[1]].astype(np.int16)
        last = self._last
        change = math.inf if last is None or last.shape != small.shape else float(np.abs(small - last).mean())
        if change == 0.0 and (small == small[0, 0]).all():
            change = math.nan  # two images of one colour, dark or overexposed, do not show a repetition
        self._change.append(change)
        self._last = small
        self._stamps_s.append(timestamp_s)
        self._bright.append(_percentile(small[:, :, 1], 98))
        self._sharpness.append(sharpness(green))

    def findings(self) -> tuple[list[Finding], list[CannotTell]]:
        """Return the faults of the images and time stamps, and the faults that cannot be checked."""
        if len(self) < _MIN_FRAMES:
            reason = f"{len(self)} frames are too few to check the images"
            return [], [CannotTell(FaultKind.BLUR, reason)]
        found = [
            self._share_finding(
                FaultKind.BLUR, self.blurred(), "blurred: their edges are wider than 7 px",
                _SHARPEN_HINT,
            ),
            self._share_finding(
                FaultKind.DARK, self.dark(), "dark: they show nothing",
                _LIGHTEN_HINT,
            ),
            self._share_finding(
                FaultKind.REPEATED, self.repeated(), "the image before once more, with a new time stamp",
                "record at the rate of the camera, not above it, and look for a driver that repeats images",
            ),
        ]  # fmt: skip
        timing, undetermined = self._check_timing()
        return [*(each for each in found if each is not None), *timing], undetermined

    def blurred(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` are blurred: compared with their neighbours, or all of the drive.

        A frame without edges is not blurred.
        """
        values = np.array(self._sharpness).reshape(-1, 2)
        is_blurred = np.zeros(len(values), dtype=bool)
        for direction in values.T:
            known = np.flatnonzero(np.isfinite(direction))
            for row in known:
                near = direction[max(0, row - _NEIGHBOURS) : row + _NEIGHBOURS + 1]
                sharp = float(np.percentile(near[np.isfinite(near)], 90))
                # If no neighbour is sharp either, the scene may lack texture: the whole drive decides below.
                is_blurred[row] |= direction[row] < min(_MIN_SHARPNESS, _MIN_SHARPNESS_RATIO * sharp)
        best = values[np.isfinite(values).any(axis=1)]
        if len(best) >= _MIN_FRAMES and np.percentile(np.nanmax(best, axis=1), 90) < _MIN_SHARPNESS:
            is_blurred[np.isfinite(values).any(axis=1)] = True
        return is_blurred

    def dark(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` are dark: 98 % of their pixels are below grey level 40 of 255."""
        return np.array(self._bright) < _MAX_DARK_LEVEL

    def empty(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` have too few edges to measure sharpness, such as a plain wall."""
        empty: npt.NDArray[np.bool_] = np.isnan(np.array(self._sharpness).reshape(-1, 2)).all(axis=1)
        return empty

    def cause_of_loss(self, is_lost: npt.NDArray[np.bool_]) -> str | None:
        """Return the most frequent cause for which frames were lost, with an action, as one sentence.

        A lost frame counts as dark, else as plain (too few edges), else as blurred.  None if no more than
        half of the lost frames have one of these causes.

        Args:
            is_lost: ``(n,)``, which frames have no pose.
        """
        is_dark = self.dark()
        is_plain = self.empty() & ~is_dark
        causes = (
            (is_dark, "are dark", _LIGHTEN_HINT), (is_plain, "show no texture", _SHOW_TEXTURE_HINT),
            (self.blurred() & ~is_dark & ~is_plain, "are blurred", _SHARPEN_HINT),
        )  # fmt: skip
        counts = [int(np.count_nonzero(rows & is_lost)) for rows, *_ in causes]
        total = int(np.count_nonzero(is_lost))
        if sum(counts) <= _MIN_COMMON_CAUSE_SHARE * total:
            return None
        _, what, fix = causes[int(np.argmax(counts))]
        return f"{max(counts)} of {total} frames without a pose {what}: {fix}"

    def repeated(self) -> npt.NDArray[np.bool_]:
        """Return which frames ``(n,)`` repeat the image of the frame before although the camera moves.

        Only runs of at most 10 repeated images count; `frozen` finds longer ones.  Images of one colour, such
        as white or black ones, are never counted as repeated.
        """
        change = np.array(self._change)
        moving = change[(change > 0.0) & np.isfinite(change)]
        is_repeated: npt.NDArray[np.bool_] = np.zeros(len(change), dtype=bool)
        least = _MIN_CHANGE_RATIO * float(np.median(moving)) if len(moving) else math.inf
        end = len(change)
        for row in range(len(change) - 1, -1, -1):
            if change[row] == 0.0:
                continue
            # A stationary camera gives longer runs of equal images, or moves little after them.
            after = change[end] if end < len(change) else math.inf
            is_repeated[row + 1 : end] = end - row - 1 <= _MAX_REPEATED_RUN and after >= least
            end = row
        return is_repeated

    def frozen(self) -> tuple[Doubt, ...]:
        """Return a doubt if more than 10 images in a row repeat one image and the next one differs strongly.

        The doubt names the longest such run; the result is empty without one.
        """
        change = np.array(self._change)
        moving = change[(change > 0.0) & np.isfinite(change)]
        ends = np.flatnonzero(change != 0.0)
        runs = [
            (last, end - last - 1)
            for last, end in itertools.pairwise(ends)
            if end - last - 1 > _MAX_REPEATED_RUN and change[end] > _MIN_FROZEN_JUMP * np.median(moving)
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

    def _share_finding(
        self, kind: FaultKind, rows: npt.NDArray[np.bool_], what: str, fix: str
    ) -> Finding | None:
        n, count = len(rows), int(rows.sum())
        share = count / n
        if share < _MIN_SHARES[kind] or count < _MIN_FAULTY_FRAMES:
            return None
        # Dark and repeated frames are counted exactly; blur is measured, so its share has a binomial error.
        deviation = math.sqrt(share * (1.0 - share) / n) if kind is FaultKind.BLUR else 0.0
        doubt = f" +- {100 * deviation:.0f}" if deviation > 0.0 else ""
        return Finding(
            kind=kind, value=share, deviation=deviation, unit="share", cost_m=None,
            sentence=f"{count} of {n} frames ({100 * share:.0f}{doubt} %) are {what}", fix=fix,
        )  # fmt: skip

    def _check_timing(self) -> tuple[list[Finding], list[CannotTell]]:
        """Return the findings on missing frames and jitter of the stamps, or why they were not checked."""
        if self._is_thinned:
            reason = "frames were left out on purpose: gaps and jitter are not those of the camera"
            return [], [CannotTell(FaultKind.MISSING, reason), CannotTell(FaultKind.JITTER, reason)]
        steps_s = np.diff(np.array(self._stamps_s))
        steps_s = steps_s[steps_s > 0.0]
        if len(steps_s) < _MIN_FRAMES:
            return [], [CannotTell(FaultKind.JITTER, f"{len(steps_s)} intervals do not determine a rate")]
        interval_s = _interval_s(steps_s)
        steps = steps_s / interval_s
        whole = np.maximum(1.0, np.round(steps))
        lost = whole[whole <= _MAX_GAP_INTERVALS] - 1.0
        findings: list[Finding] = []
        missing, n = int(lost.sum()), len(self)
        share = missing / (missing + n)
        off = (steps - whole)[steps < _MAX_GAP_INTERVALS]
        low, high = np.percentile(off, (5, 95))
        jitter = float(np.std(np.clip(off, low, high)))
        is_even = jitter < _MIN_JITTER
        if (
            share >= _MIN_SHARES[FaultKind.MISSING]
            and np.count_nonzero(lost) >= _MIN_FAULTY_FRAMES
            and is_even
        ):
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
    """Return a percentile of *values* as `numpy.percentile` interpolates it, in a fifth of its time."""
    ordered = np.sort(values, axis=None)
    row, rest = divmod(percent * (len(ordered) - 1), 100)
    low, high = float(ordered[row]), float(ordered[min(row + 1, len(ordered) - 1)])
    return low + (high - low) * rest / 100.0


def sharpness(gray: _Image) -> tuple[float, float]:
    """Return the sharpness of the strongest edges of an image ``(h, w)`` uint8, along x and along y.

    The sharpness of an edge is its largest difference over two pixels, divided by its difference over 16
    pixels: 1 for a step within two pixels, about ``2 / n`` for a step that is blurred over *n* pixels.  The
    result is the median of the edges; NaN in a direction with fewer than 40 edges.
    """
    rows, columns = (max(1, side // _SAMPLED_LINES) for side in gray.shape)
    # Copy the sampled columns row by row, in the order of memory, before they are transposed to lines.
    upright = np.ascontiguousarray(gray[:, ::columns]).T
    return _edges(np.ascontiguousarray(gray[::rows])), _edges(np.ascontiguousarray(upright))


def _edges(lines: _Image) -> float:
    """Return the median sharpness of the edges along the rows of an image ``(n, w)`` uint8, see `sharpness`.

    NaN if there are fewer than 40 edges, or if the rows are shorter than 48 pixels.
    """
    if lines.shape[1] < 6 * _EDGE_HALF_WIDTH_PX:
        return math.nan
    strong = max(1, int(_EDGE_SHARE * len(lines) * (lines.shape[1] - 2 * _EDGE_HALF_WIDTH_PX)))
    sharpest = np.empty(_MAX_EDGES)
    count = _core_edges()(
        address_of(lines), *lines.shape, strong, _MIN_EDGE_STEP, _MAX_EDGES,
        address_of(sharpest),
    )  # fmt: skip
    if count < _MIN_EDGES:
        return math.nan
    every = -(-count // _MAX_EDGES)
    return float(np.median(sharpest[: -(-count // every)]))


@cache
def _core_edges() -> Any:
    arguments = (ctypes.c_void_p, *[ctypes.c_int64] * 5, ctypes.c_void_p)
    return core_function("check", "rse_pf_edges", arguments, ctypes.c_int64)


def _interval_s(steps_s: Array) -> float:
    """Return the interval between two frames of the camera, seconds, from the steps of its time stamps.

    The interval is a percentile (the 50th, 35th or 20th) of *steps_s* ``(n,)``: the first one of which 90 %
    of the steps are nearly integer multiples, and the median if no percentile fulfils this.
    """
    for percent in (50, 35, 20):
        interval_s = float(np.percentile(steps_s, percent))
        steps = steps_s / interval_s
        off = np.abs(steps - np.maximum(1.0, np.round(steps)))
        if np.percentile(off, 90) < _MAX_INTERVAL_ERROR:
            return interval_s
    return float(np.median(steps_s))
