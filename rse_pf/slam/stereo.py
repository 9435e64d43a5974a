"""Disparities of features between the two images of a rectified stereo pair.

A feature of the left image is sought along its row of the right one; no pixel in between is matched.  Depths
and their noise follow from the disparities; which of them are used is decided by who tracks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.native_stereo import stereo_core
from rse_pf.pnp import DepthNoise

__all__ = ["StereoOptions", "disparities", "disparities_by_numpy", "stereo_noise"]

Gray = npt.NDArray[np.uint8]
_Ints = npt.NDArray[np.int64]

_RADIUS = 5
_SIDE = 2 * _RADIUS + 1
_COUNT = _SIDE * _SIDE
_BESIDE = 2
"""Disparities so near to the best one are no rivals of it."""
_STEPS = 8
_CONVERGED_PX, _FAR_PX, _STEP_PX = 0.002, 1.25, 0.05
"""A refinement ends below the first; it fails beyond the second, or if its last step exceeds the third."""
_BASE_M = 1e-5
"""The least deviation that `DepthNoise` takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoOptions:
    """Which disparities are sought, and which are believed.

    Attributes:
        min_disparity_px: Smaller ones are dropped: their depth is nearly unknown.
        max_disparity_px: Larger ones are not sought; at most 1,024.
        min_likeness: Least squared correlation of the two patches.
        uniqueness: What the best lacks of a likeness of 1 is less than this share of what the second best
            lacks.
        left_right_px: From the right image back to the left one, the best differs by this at most; below 0
            it is not sought.
    """

    min_disparity_px: float = 1.0
    max_disparity_px: int = 128
    min_likeness: float = 0.64
    uniqueness: float = 0.8
    left_right_px: int = 1

    def __post_init__(self) -> None:
        if not (
            0.0 < self.min_disparity_px <= self.max_disparity_px <= 1024
            and 0.0 < self.min_likeness < 1.0
            and 0.0 < self.uniqueness <= 1.0
            and -1 <= self.left_right_px <= 1024
        ):
            raise BadRequest(
                f"{self} cannot be used", hint="leave the options of a stereo pair out to get the defaults"
            )


def stereo_noise(f_baseline: float, disparity_px: float) -> DepthNoise:
    """Return the noise of depths *f_baseline* / d whose disparities d have a deviation of *disparity_px*.

    Args:
        f_baseline: Focal length in pixels times the baseline in metres.
        disparity_px: Pixels.
    """
    return DepthNoise(base_m=_BASE_M, growth_per_m=float(min(1.0, disparity_px / f_baseline)), from_m=0.0)


def disparities(left: Gray, right: Gray, pixels: Array, options: StereoOptions | None = None) -> Array:
    """Return the ``(n,)`` disparities of pixels of the left image, NaN where none is believed.

    The patch of 11x11 pixels around the nearest whole pixel is sought along its row of the right image by its
    squared normalised correlation.  The best must be like enough, unique, and lead back from the right image
    to the left one.  It is refined by least squares in the horizontal direction, with a gain and an offset of
    brightness.

    Args:
        left: ``(h, w)``, the rectified left image.
        right: ``(h, w)``, the right one, whose rows are those of the left.
        pixels: ``(n, 2)``, in the left image.
        options: Limits; None means the defaults.

    Raises:
        BadRequest: Shapes do not fit.

    Source:
        Refinement after Lucas and Kanade, IJCAI 1981, in the inverse form of Baker and Matthews, IJCV 2004,
        Sect. 3.2; the check from right to left after Fua, MVA 1993.
    """
    options = options or StereoOptions()
    is_image = left.ndim == 2 and left.shape == right.shape and left.dtype == right.dtype == np.uint8
    if not is_image or pixels.ndim != 2 or pixels.shape[1] != 2:
        raise BadRequest(
            f"images {left.shape} and {right.shape} and pixels {pixels.shape} do not fit",
            hint="give two grey images of one size, and two numbers for each pixel",
        )
    core = stereo_core()
    if core is None:
        return disparities_by_numpy(left, right, pixels, options)
    return core.disparities(
        left, right, pixels, (options.min_disparity_px, options.min_likeness, options.uniqueness),
        options.max_disparity_px, options.left_right_px,
    )  # fmt: skip


def disparities_by_numpy(left: Gray, right: Gray, pixels: Array, options: StereoOptions) -> Array:
    """Return what `disparities` does, without the native core, whose oracle this is."""
    found = np.full(len(pixels), np.nan)
    height, width = left.shape
    with np.errstate(invalid="ignore"):
        whole = np.rint(pixels)
        inside = (whole >= _RADIUS + 1) & (whole <= np.array([width, height]) - _RADIUS - 2)
    rows = np.flatnonzero(inside.all(axis=1))
    at = whole[rows].astype(np.int64)
    if not len(rows):
        return found
    best, likeness, rival = _searched(left, right, at, options.max_disparity_px, -1)
    is_clear = (likeness >= options.min_likeness) & (1.0 - likeness < options.uniqueness * (1.0 - rival))
    rows, at, best = rows[is_clear], at[is_clear], best[is_clear]
    if options.left_right_px >= 0 and len(rows):
        there = np.column_stack([at[:, 0] - best, at[:, 1]])
        back, _, _ = _searched(right, left, there, options.max_disparity_px, 1)
        agrees = np.abs(back - best) <= options.left_right_px
        rows, at, best = rows[agrees], at[agrees], best[agrees]
    refined = _refined(left, right, at, best, options.min_likeness)
    found[rows] = np.where(refined >= options.min_disparity_px, refined, np.nan)
    return found


def _searched(image: Gray, other: Gray, at: _Ints, most: int, sign: int) -> tuple[_Ints, Array, Array]:
    """Return the best whole disparity of each patch of *image* in *other*, its likeness, and its rival's.

    The patch at column u is sought at ``u + sign * d``; -1 stands for the likeness of what lies outside.
    """
    n, width, steps = len(at), image.shape[1], np.arange(-_RADIUS, _RADIUS + 1)
    patches = image[at[:, 1, None, None] + steps[:, None], at[:, 0, None, None] + steps].astype(np.int64)
    reach = np.arange(-_RADIUS, most + _RADIUS + 1)
    columns = at[:, 0, None] + sign * reach
    strips = other[at[:, 1, None, None] + steps[:, None], np.clip(columns, 0, width - 1)[:, None]]
    strips = strips.astype(np.int64)
    own1, own2 = patches.sum(axis=(1, 2)), (patches * patches).sum(axis=(1, 2))
    products = np.zeros((n, most + 1), dtype=np.int64)
    sums, squares = np.zeros_like(products), np.zeros_like(products)
    by_column, squares_by_column = strips.sum(axis=1), (strips * strips).sum(axis=1)
    for column in range(_SIDE):
        beside = slice(column, column + most + 1)
        for row in range(_SIDE):
            products += patches[:, row, ::sign][:, column, None] * strips[:, row, beside]
        sums += by_column[:, beside]
        squares += squares_by_column[:, beside]
    covariance = (_COUNT * products - own1[:, None] * sums).astype(np.float64)
    variance = (_COUNT * own2 - own1 * own1).astype(np.float64)[:, None]
    others = (_COUNT * squares - sums * sums).astype(np.float64)
    centres = at[:, 0, None] + sign * np.arange(most + 1)
    is_inside = (centres >= _RADIUS + 1) & (centres <= width - _RADIUS - 2)
    is_usable = is_inside & (variance > 0.0) & (others > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = np.where(is_usable, covariance * np.abs(covariance) / (variance * others), -1.0)
    best = likeness.argmax(axis=1)
    is_rival = np.abs(np.arange(most + 1) - best[:, None]) > _BESIDE
    rival = np.where(is_rival, likeness, -1.0).max(axis=1)
    return best, likeness[np.arange(n), best], rival


def _refined(left: Gray, right: Gray, at: _Ints, best: _Ints, min_likeness: float) -> Array:
    """Return the disparities with their fractions, NaN where the refinement fails."""
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    rows, columns = at[:, 1, None, None] + steps[:, None], at[:, 0, None, None] + steps
    n, width = len(at), left.shape[1]
    L = left[rows, columns].astype(np.float64)
    slopes = (left[rows, columns + 1].astype(np.float64) - left[rows, columns - 1]) / 2.0
    L, slopes = (each.reshape(n, _COUNT) for each in (L, slopes))
    L = L - L.mean(axis=1, keepdims=True)
    slopes = slopes - slopes.mean(axis=1, keepdims=True)
    own2 = (L * L).sum(axis=1)
    slopes = slopes - ((slopes * L).sum(axis=1) / own2)[:, None] * L
    information = (slopes * slopes).sum(axis=1)
    is_alive = information > 0.0
    found, last, likeness = best.astype(np.float64), np.full(n, np.inf), np.zeros(n)
    moving = is_alive.copy()
    for _ in range(_STEPS):
        go = np.flatnonzero(moving)
        if not len(go):
            break
        x = at[go, 0] - found[go]
        first = np.floor(x)
        share = (x - first)[:, None, None]
        near = first.astype(np.int64)[:, None, None] + steps
        is_inside = (near[:, 0, 0] >= 0) & (near[:, 0, -1] + 1 < width)
        near = np.clip(near, 0, width - 2)
        R = (1.0 - share) * right[rows[go], near] + share * right[rows[go], near + 1]
        R = R.reshape(len(go), _COUNT)
        R = R - R.mean(axis=1, keepdims=True)
        other2, product = (R * R).sum(axis=1), (L[go] * R).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = product / other2 * (slopes[go] * R).sum(axis=1) / information[go]
            likeness[go] = product * np.abs(product) / (own2[go] * other2)
        is_fine = (
            is_inside & (other2 > 0.0) & (product > 0.0) & (np.abs(found[go] + step - best[go]) <= _FAR_PX)
        )
        is_alive[go[~is_fine]] = False
        moving[go[~is_fine]] = False
        go, step = go[is_fine], step[is_fine]
        found[go] += step
        last[go] = np.abs(step)
        moving[go[last[go] < _CONVERGED_PX]] = False
    is_good = is_alive & (last <= _STEP_PX) & (likeness >= min_likeness)
    return np.where(is_good, found, np.nan)
