"""Match binary descriptors: all against all, or only near predicted pixels.

Deterministic.  Every match is one to one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.opencv import load_opencv
from rse_pf.geometry import Array

__all__ = ["match_all", "match_near"]

Descriptors = npt.NDArray[np.uint8]
Rows = npt.NDArray[np.int64]

_BAND = 1e6
_BITS = np.array([bin(value).count("1") for value in range(256)], dtype=np.uint8)


def match_all(
    first: Descriptors, second: Descriptors, *, ratio: float = 0.8, max_distance: int = 64
) -> tuple[Rows, Rows]:
    """Return rows of *first* and of *second* that match: ratio test, both ways nearest.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    if not len(first) or len(second) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    cv2 = load_opencv()
    distances, neighbours = cv2.batchDistance(first, second, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    clear = (distances[:, 0] < ratio * distances[:, 1]) & (distances[:, 0] <= max_distance)
    return _one_to_one(np.flatnonzero(clear), neighbours[clear, 0].astype(np.int64), distances[clear, 0])


def match_near(
    predicted: Array,
    wanted: Descriptors,
    pixels: Array,
    descriptors: Descriptors,
    *,
    radius_px: float | Array,
    ratio: float = 0.9,
    max_distance: int = 50,
) -> tuple[Rows, Rows]:
    """Return rows of *wanted* and rows of *descriptors* that match within a radius of the prediction.

    Args:
        predicted: ``(m, 2)`` pixels where the wanted descriptors are expected.
        wanted: ``(m, 32)``.
        pixels: ``(n, 2)`` of the features of the image.
        descriptors: ``(n, 32)``.
        radius_px: Of the search; one number, or one for each row.
        ratio: The best must be this much closer than the second best within the radius.
        max_distance: Largest Hamming distance.
    """
    empty = np.empty(0, dtype=np.int64)
    if not len(predicted) or not len(pixels):
        return empty, empty
    limit = np.broadcast_to(np.asarray(radius_px, dtype=np.float64), len(predicted))
    rows, columns = _pairs_within(predicted, pixels, limit)
    if not len(rows):
        return empty, empty
    distances = _BITS[wanted[rows] ^ descriptors[columns]].sum(axis=1, dtype=np.int64)
    order = np.lexsort((distances, rows))
    rows, columns, distances = rows[order], columns[order], distances[order]
    starts = np.flatnonzero(np.concatenate(([True], rows[1:] != rows[:-1])))
    follows = np.minimum(starts + 1, len(rows) - 1)
    has_second = (rows[follows] == rows[starts]) & (follows > starts)
    second = np.where(has_second, distances[follows], 1 << 20)
    best = distances[starts]
    clear = (best <= max_distance) & (best < ratio * second)
    return _one_to_one(rows[starts][clear], columns[starts][clear], best[clear])


def _pairs_within(predicted: Array, pixels: Array, limit: Array) -> tuple[Rows, Rows]:
    """Return all pairs (row of predicted, row of pixels) within the limit.

    The pixels are sorted by bands of rows, and by column within a band, so that each prediction looks at a
    stretch of three bands only.
    """
    height = max(float(limit.max()), 1.0)
    key = _key(np.floor(pixels[:, 1] / height), pixels[:, 0])
    order = np.argsort(key, kind="stable")
    key = key[order]
    band = np.floor(predicted[:, 1] / height)
    found: list[tuple[Rows, Rows]] = []
    for offset in (-1, 0, 1):
        first = np.searchsorted(key, _key(band + offset, predicted[:, 0] - limit))
        last = np.searchsorted(key, _key(band + offset, predicted[:, 0] + limit), side="right")
        counts = last - first
        rows = np.repeat(np.arange(len(predicted)), counts)
        offsets = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        columns = order[np.repeat(first, counts) + offsets]
        near = np.square(pixels[columns] - predicted[rows]).sum(axis=1) <= np.square(limit[rows])
        found.append((rows[near], columns[near].astype(np.int64)))
    return np.concatenate([rows for rows, _ in found]), np.concatenate([columns for _, columns in found])


def _key(band: Array, x: Array) -> Array:
    """Return numbers that sort by band, then by column; columns far outside stay in their band."""
    key: Array = band * _BAND + np.clip(x, -0.4 * _BAND, 0.4 * _BAND)
    return key


def _one_to_one(rows: Rows, columns: Rows, distances: npt.NDArray[Any]) -> tuple[Rows, Rows]:
    """Keep, for each column, the pair with the smallest distance; rows are distinct already."""
    order = np.argsort(distances, kind="stable")
    _, firsts = np.unique(columns[order], return_index=True)
    kept = np.sort(order[firsts])
    return rows[kept].astype(np.int64), columns[kept]
