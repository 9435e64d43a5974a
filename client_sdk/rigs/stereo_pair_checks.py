"""Find faults of a stereo rig in its rectified images: swapped, not synchronised, or badly rectified.

In a correct pair, a point of the scene lies in the same row of both images, and farther left in the right
image.  ORB features are matched over the whole image, not only along rows, because the matches of a faulty
rig lie in other rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import DescribedKeypoints, Frame, describe, load_opencv
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = [
    "PairFault",
    "PairMeasurement",
    "check_stereo_pairs",
    "choose_pairs",
    "find_fault",
    "find_fault_of_frames",
    "match_features",
    "measure_pair",
]

_MAX_FEATURES = 600
"""Most ORB features of each image that are matched: enough for the medians of `find_fault`."""
_MAX_DISTANCE_RATIO = 0.8
"""Ratio of the Hamming distances of the nearest and the second nearest descriptor, from which on a match is
ambiguous and left out (Lowe's ratio test)."""
_MAX_PYRAMID_SCALE = 2.0
"""Largest scale of the image pyramid of a feature that is matched; features of coarser levels are left out,
because their positions are too imprecise."""
_MAX_ROW_OFFSET_PX = 40.0
"""A match whose rows differ by this or more is left out as a wrong match; a calibration that is wrong by so
much leaves few matches, so its fault is found only if matches with smaller offsets exist, too."""
_MIN_MATCHES = 60
"""Fewest matches of all measured pairs together for which a fault is reported.  For a delay it is also the
fewest fast features (`_FAST_PX_S`) among them, and half of it the fewest fast features that the delay
explains."""
_MIN_SWAPPED_DISPARITY_PX = -1.5
"""A match counts for swapped cameras if its disparity (column in the left minus column in the right image) is
below this.  The limit is below 0 because noise may make the disparity of a distant point a little
negative."""
_SWAPPED_SHARE = 0.6
"""The cameras are swapped if more than this share of the matches has a disparity below
`_MIN_SWAPPED_DISPARITY_PX`."""
_MAYBE_SWAPPED_SHARE = 0.2
"""The error about wrong rows also names swapped cameras as a possible cause if more than this share of the
matches has a disparity below `_MIN_SWAPPED_DISPARITY_PX`."""
_MAX_MEDIAN_ROW_OFFSET_PX = 1.5
"""The rectification is wrong if the median of the absolute row offsets of all matches is above this.  If even
the middle 80 % of the row offsets all lie beyond it on one side, this fault is certain, and no delay is
estimated."""
_MIN_DELAY_S = 0.004  # a shorter time between the two images of a pair is not reported as a delay
_MIN_DELAY_EFFECT_PX = 0.7
"""A delay is not reported if the standard deviation of the row offsets that it causes is not above this."""
# A delay is not reported unless it explains more than this share of the variance of row offsets.
_MIN_EXPLAINED_VARIANCE = 0.3
_FAST_PX_S = 15.0
"""A feature that moves up or down in the image faster than this is fast: a delay shows in it."""
_MAX_RESIDUAL_PX = 2.0  # a match whose row offset differs by more from that of the delay is an outlier
_ALL_FAST_SHARE = 0.9
"""If more than this share of the features is fast, the slow ones are too few to measure the row offset that
the rectification causes; the median row offset of all features is subtracted instead."""
_REFINEMENTS = 5  # number of least-squares fits of the delay, each to the inliers of the previous estimate
_MAX_PAIRS = 14  # most stereo pairs of a recording that are compared when it is opened, since each takes time


class PairMeasurement(NamedTuple):
    """The features that were matched between both images of one stereo pair, three arrays ``(n,)``.

    Attributes:
        disparities_px: Column in the left image minus column in the right one.
        row_offsets_px: Row in the left image minus row in the right one.
        row_rates_px_s: Vertical speed of the feature in the left image until the next frame, positive
            downwards; NaN if the feature was not found in the left image of the next frame.
    """

    disparities_px: Array
    row_offsets_px: Array
    row_rates_px_s: Array


def choose_pairs(rows: Sequence[int]) -> list[tuple[int, int]]:
    """Return at most 14 elements of *rows*, spread evenly, each in a pair with the element after it.

    *rows* are the indices of a recording's frames in the order of time; with fewer than two of them, the
    result is empty.
    """
    places = np.unique(np.linspace(0, len(rows) - 2, _MAX_PAIRS).astype(int)) if len(rows) > 1 else ()
    return [(rows[place], rows[place + 1]) for place in places]


@dataclass(frozen=True, slots=True, kw_only=True)
class PairFault:
    """What is wrong with a stereo rig.

    Attributes:
        what: ``swapped``, ``late`` (the images of a pair were taken at two times), or ``rows`` (the
            rectification is wrong).
        value: For ``swapped`` the share of matches that lie farther right in the right image; for ``late``
            the time by which the right image is later (s), negative if it is earlier; for ``rows`` the median
            of the absolute row offsets (px).
        unit: Unit of the value: ``share``, ``s`` or ``px``.
        message: One sentence for the user.
        hint: What the user can do.
    """

    what: Literal["swapped", "late", "rows"]
    value: float
    unit: str
    message: str
    hint: str


def check_stereo_pairs(pairs: Iterable[tuple[Frame, Frame]], name: str) -> None:
    """Refuse the source *name* if its stereo frames show a faulty rig, see `find_fault_of_frames`.

    *pairs* are stereo frames, each with the frame after it.  A source with too few features is accepted.

    Raises:
        UsageError: The cameras are swapped, the two images of a pair were taken at different times, or the
            rectification is wrong.
        MissingExtra: OpenCV is not installed.
    """
    fault = find_fault_of_frames(pairs)
    if fault is not None:
        raise UsageError(f"{name}: {fault.message}", hint=fault.hint)


def find_fault_of_frames(pairs: Iterable[tuple[Frame, Frame]]) -> PairFault | None:
    """Return the fault of the rig that stereo frames show.

    *pairs* are stereo frames, each with the frame after it, with which the motion in the image is measured.
    The result is None for a correct rig, and if the images have too few features.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    return find_fault(measure_pair(frame, later) for frame, later in pairs)


def find_fault(measurements: Iterable[PairMeasurement]) -> PairFault | None:
    """Return the fault of a stereo rig that *measurements* show together.

    The first fault in this order is returned: swapped cameras, images that were taken at two times, a wrong
    rectification.  The result is None without a fault, and with fewer than 60 matches in all measurements.
    """
    pairs = list(measurements)
    if not pairs:
        return None
    columns = (np.concatenate(column) for column in zip(*pairs, strict=True))
    disparities_px, row_offsets_px, row_rates_px_s = columns
    if len(row_offsets_px) < _MIN_MATCHES:
        return None
    # 1. Report swapped cameras if most points lie farther right in the right image.
    swapped_share = float(np.mean(disparities_px < _MIN_SWAPPED_DISPARITY_PX))
    if swapped_share > _SWAPPED_SHARE:
        return PairFault(
            what="swapped",
            value=swapped_share,
            unit="share",
            message=f"{100 * swapped_share:.0f} % of what both cameras see lies farther right in the right "
            "image: the cameras are swapped",
            hint="exchange left and right, in the rig or in the images",
        )
    # 2. Report a delay, which shifts the row of a feature in proportion to its vertical speed.  If nearly all
    #    rows are shifted far to the same side, the calibrated rotation of a camera is wrong, and a delay
    #    cannot be measured.
    has_rate = np.isfinite(row_rates_px_s)
    low_px, high_px = np.percentile(row_offsets_px, (10, 90))
    is_rotated = bool(low_px * high_px > 0.0 and min(abs(low_px), abs(high_px)) > _MAX_MEDIAN_ROW_OFFSET_PX)
    delay_s = None if is_rotated else _estimate_delay_s(row_offsets_px[has_rate], row_rates_px_s[has_rate])
    if delay_s is not None:
        return PairFault(
            what="late",
            value=delay_s,
            unit="s",
            message=f"the right image is taken {1e3 * abs(delay_s):.0f} ms "
            f"{'after' if delay_s > 0 else 'before'} the left one: the cameras are not synchronised",
            hint="trigger both cameras together, or take one: --camera left",
        )
    # 3. Report a wrong rectification if the rows differ for any other reason.
    median_offset_px = float(np.median(np.abs(row_offsets_px)))
    if median_offset_px > _MAX_MEDIAN_ROW_OFFSET_PX:
        swap = "the cameras are swapped, or " if swapped_share > _MAYBE_SWAPPED_SHARE else ""
        return PairFault(
            what="rows",
            value=median_offset_px,
            unit="px",
            message=f"rows of the two images differ by {median_offset_px:.1f} px in the median, above "
            f"{_MAX_MEDIAN_ROW_OFFSET_PX:g} px: {swap}the rectification does not fit",
            hint="calibrate the pair again: rse-pf camera calibrate --stereo; or take one: --camera left",
        )
    return None


def measure_pair(frame: Frame, later: Frame) -> PairMeasurement:
    """Match the left image of *frame* with the right one, and with the left one of *later*, the next frame.

    Matches between rows that are 40 px or more apart are left out.  A frame without a right image gives empty
    arrays.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    if frame.stereo is None:
        return PairMeasurement(np.empty(0), np.empty(0), np.empty(0))
    right_rgb = np.repeat(frame.stereo.gray[:, :, None], 3, axis=2)
    left, right, next_left = (describe(image, _MAX_FEATURES) for image in (frame.rgb, right_rgb, later.rgb))
    left_rows, right_rows = match_features(left, right)
    offsets_px = left.pixels[left_rows] - right.pixels[right_rows]
    is_plausible = np.abs(offsets_px[:, 1]) < _MAX_ROW_OFFSET_PX
    row_rates_px_s = np.full(len(left.pixels), np.nan)
    tracked_rows, next_rows = match_features(left, next_left)
    seconds = later.timestamp_s - frame.timestamp_s
    if seconds > 0.0:
        moved_px = next_left.pixels[next_rows, 1] - left.pixels[tracked_rows, 1]
        row_rates_px_s[tracked_rows] = moved_px / seconds
    return PairMeasurement(
        offsets_px[is_plausible, 0], offsets_px[is_plausible, 1], row_rates_px_s[left_rows[is_plausible]]
    )


def _estimate_delay_s(row_offsets_px: Array, row_rates_px_s: Array) -> float | None:
    """Return the delay of the right image, s, if a delay explains the row offsets ``(n,)``; else None.

    A right image that was taken *t* seconds after the left one shows a point ``t * rate`` farther down, so
    that ``offset = -t * rate``.  A negative delay means that the right image is the earlier one.  Both arrays
    are those of `PairMeasurement`, without NaN.
    """
    is_fast = np.abs(row_rates_px_s) > _FAST_PX_S
    if is_fast.sum() < _MIN_MATCHES:
        return None
    # 1. Subtract the row offset that the rectification causes: the median over the slow features, or over all
    #    features if nearly all are fast.
    is_reference = np.ones_like(is_fast) if is_fast.mean() > _ALL_FAST_SHARE else ~is_fast
    row_offsets_px = row_offsets_px - np.median(row_offsets_px[is_reference])
    # 2. Take as first estimate the median of the delays that explain each fast feature alone.
    delay_s = -float(np.median(row_offsets_px[is_fast] / row_rates_px_s[is_fast]))
    # 3. Fit a line to row offsets over speeds of the inliers: the delay is minus its slope.
    is_inlier = is_fast
    for _ in range(_REFINEMENTS):
        is_inlier = np.abs(row_offsets_px + delay_s * row_rates_px_s) <= _MAX_RESIDUAL_PX
        if (is_inlier & is_fast).sum() < _MIN_MATCHES // 2:
            return None
        x, y = row_rates_px_s[is_inlier], row_offsets_px[is_inlier]
        delay_s = -float(((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum())
    # 4. Return a delay only if it is long, changes row offsets visibly, and explains their variance.
    x, y = row_rates_px_s[is_inlier], row_offsets_px[is_inlier]
    explained_variance = 1.0 - float(np.var(y + delay_s * x) / max(np.var(y), 1e-9))
    effect_px = abs(delay_s) * float(np.std(x))
    is_significant = abs(delay_s) > _MIN_DELAY_S and effect_px > _MIN_DELAY_EFFECT_PX
    return delay_s if is_significant and explained_variance > _MIN_EXPLAINED_VARIANCE else None


def match_features(
    first: DescribedKeypoints, second: DescribedKeypoints
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the indices into *first* and into *second* of ORB features that match, two arrays ``(m,)``.

    Two features match if each is the nearest neighbour of the other, and Lowe's ratio test holds.  Features
    of coarse levels of the image pyramid are not used; the arrays are empty if an image has fewer than two
    other features.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    first_rows, second_rows = (
        np.flatnonzero(features.sizes <= _MAX_PYRAMID_SCALE) for features in (first, second)
    )
    if len(first_rows) < 2 or len(second_rows) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    first_descriptors = first.descriptors[first_rows]
    second_descriptors = second.descriptors[second_rows]
    distances, nearest = cv2.batchDistance(
        first_descriptors, second_descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )
    _, nearest_back = cv2.batchDistance(
        second_descriptors, first_descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=1
    )
    is_unambiguous = distances[:, 0] < _MAX_DISTANCE_RATIO * distances[:, 1]
    is_mutual = nearest_back[nearest[:, 0], 0] == np.arange(len(first_rows))
    matched = np.flatnonzero(is_unambiguous & is_mutual)
    return first_rows[matched], second_rows[nearest[matched, 0]]
