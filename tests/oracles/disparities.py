"""Disparities of a rectified pair, pixel after pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
R = 5  # half of the patch's side


def disparities(
    left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8], pixels: Array, options: Any
) -> Array:
    """Return the disparities that are like enough, unique, checked from right to left, and refined."""
    images = left.astype(float), right.astype(float)
    return np.array([_disparity(*images, pixel, options) for pixel in pixels])


def _disparity(left: Array, right: Array, pixel: Array, options: Any) -> float:
    if not np.isfinite(pixel).all() or not _is_inside(left, *np.rint(pixel)):
        return np.nan
    u, v = np.rint(pixel).astype(int)
    best, likeness, rival = _search(left, right, u, v, options.max_disparity_px, -1)
    if likeness < options.min_likeness or 1.0 - likeness >= options.uniqueness * (1.0 - rival):
        return np.nan
    if options.left_right_px >= 0:
        back = _search(right, left, u - best, v, options.max_disparity_px, 1)[0]
        if abs(back - best) > options.left_right_px:
            return np.nan
    refined = _refine(left, right, u, v, best, options.min_likeness)
    return refined if refined >= options.min_disparity_px else np.nan


def _is_inside(image: Array, u: float, v: float) -> bool:
    return bool(R + 1 <= u <= image.shape[1] - R - 2 and R + 1 <= v <= image.shape[0] - R - 2)


def _patch(image: Array, u: int, v: int) -> Array:
    return image[v - R : v + R + 1, u - R : u + R + 1]


def _search(image: Array, other: Array, u: int, v: int, most: int, sign: int) -> tuple[int, float, float]:
    """Return the disparity of the most similar patch, its squared correlation, and that of its rival."""
    likeness = np.full(most + 1, -1.0)
    places = [d for d in range(most + 1) if _is_inside(other, u + sign * d, v)]
    if places:
        own = _patch(image, u, v) - _patch(image, u, v).mean()
        others = np.array([_patch(other, u + sign * d, v) for d in places])
        others -= others.mean(axis=(1, 2), keepdims=True)
        product, squares = (own * others).sum(axis=(1, 2)), (others**2).sum(axis=(1, 2)) * (own**2).sum()
        likeness[places] = np.where(squares > 1e-6, product * abs(product) / np.maximum(squares, 1e-6), -1.0)
    best = int(np.round(likeness, 12).argmax())
    return best, likeness[best], max([-1.0, *likeness[: max(0, best - 2)], *likeness[best + 3 :]])


def _refine(left: Array, right: Array, u: int, v: int, best: int, min_likeness: float) -> float:
    """Return the disparity with its fraction by Gauss-Newton steps in gain, offset and disparity."""
    own = _patch(left, u, v) - _patch(left, u, v).mean()
    slopes = (_patch(left, u + 1, v) - _patch(left, u - 1, v)) / 2.0
    slopes = slopes - slopes.mean()
    slopes = slopes - (slopes * own).sum() / (own**2).sum() * own
    if not (slopes**2).sum() > 0.0:
        return np.nan
    disparity = float(best)
    for _ in range(8):
        first, share = divmod(u - disparity, 1.0)
        near = int(first)
        if near - R < 0 or near + R + 1 >= right.shape[1]:
            return np.nan
        seen = (1.0 - share) * _patch(right, near, v) + share * _patch(right, near + 1, v)
        seen = seen - seen.mean()
        product, square = (own * seen).sum(), (seen**2).sum()
        if not (square > 0.0 and product > 0.0):
            return np.nan
        likeness = product**2 / ((own**2).sum() * square)
        step = product / square * (slopes * seen).sum() / (slopes**2).sum()
        disparity += step
        if abs(disparity - best) > 1.25:
            return np.nan
        if abs(step) < 0.002:
            break
    return disparity if abs(step) <= 0.05 and likeness >= min_likeness else np.nan
