"""Matches of 256-bit descriptors by the definition: all distances, sorted."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[np.int64]


def hamming(first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Return the ``(n, m)`` distances of ``(n, 32)`` and ``(m, 32)`` descriptors."""
    a, b = (np.unpackbits(bits, axis=1).astype(np.float32) for bits in (first, second))
    return (a.sum(axis=1)[:, None] + b.sum(axis=1) - 2.0 * a @ b.T).astype(np.int64)


def best_matches(
    reference: npt.NDArray[np.uint8], view: npt.NDArray[np.uint8], ratio: float
) -> tuple[Rows, Rows]:
    """Return the rows that match, the nearest first, equals by the row of the reference."""
    taken: dict[int, tuple[int, int]] = {}
    if len(view) >= 2:
        for row, distances in enumerate(hamming(reference, view)):
            least, second = np.sort(distances)[:2]
            if least < ratio * second:
                _take(taken, int(distances.argmin()), (int(least), row))
    chosen = sorted((distance, row, column) for column, (distance, row) in taken.items())
    rows = np.array([(row, column) for _, row, column in chosen], dtype=np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def measure_distinctiveness(
    descriptors: npt.NDArray[np.uint8], pixels: npt.NDArray[Any], apart_px: float
) -> npt.NDArray[np.int64]:
    """Return the distance of each feature to the most similar one at another place, 256 without any."""
    with np.errstate(invalid="ignore", over="ignore"):
        is_apart = (np.abs(pixels[:, None] - pixels[None]) >= apart_px).any(axis=2)
    np.fill_diagonal(is_apart, False)
    return np.where(is_apart, hamming(descriptors, descriptors), 256).min(axis=1, initial=256)


def match_predictions(sought: Any, image: Any, limits: Any) -> tuple[Rows, Rows]:
    """Return what `rse_pf.slam.tracking.match_predictions` does of ORB descriptors."""
    x, y = np.asarray(sought.pixels, np.float64), np.asarray(image.pixels, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        u, v = np.moveaxis(y - x[:, None], 2, 0)
        expected = np.asarray(sought.sizes, np.float64)[:, None]
        is_candidate = (u * u + v * v <= limits.radius_px * limits.radius_px) & (np.abs(x) <= 1e9).all(1)[
            :, None
        ]
        if image.is_scaled:
            is_candidate &= image.sizes <= limits.max_size_ratio * expected
            is_candidate &= expected <= limits.max_size_ratio * image.sizes
        if image.is_oriented:
            a, b = (
                np.asarray(sought.orientations, np.float64)[:, None],
                np.asarray(image.orientations, np.float64),
            )
            is_candidate &= a[..., 0] * b[:, 0] + a[..., 1] * b[:, 1] >= limits.min_orientation_cosine
    taken: dict[int, tuple[int, int]] = {}
    for row, distances in enumerate(hamming(sought.descriptors, image.descriptors)):
        near = np.flatnonzero(is_candidate[row])
        near = near[np.argsort(distances[near], kind="stable")][:2]
        if not len(near) or distances[near[0]] > limits.max_distance:
            continue
        least = distances[near[0]]
        is_clear = len(near) == 1 or least < limits.lowe_ratio * distances[near[1]]
        if is_clear and least < limits.distinctiveness_ratio * image.distinctiveness[near[0]]:
            _take(taken, int(near[0]), (int(least), row))
    rows = np.array(sorted((row, column) for column, (_, row) in taken.items()), dtype=np.int64).reshape(
        -1, 2
    )
    return rows[:, 0], rows[:, 1]


def _take(taken: dict[int, tuple[int, int]], column: int, candidate: tuple[int, int]) -> None:
    """Give a column to the nearest row, the first one of equals."""
    taken[column] = min(taken.get(column, candidate), candidate)
