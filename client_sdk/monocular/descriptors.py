"""Match descriptors of any kind, all against all.

Deterministic.  Every match is one to one; matches near predicted pixels are found by `rse_pf.slam.tracking`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.images import load_opencv
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.native_matcher import MatchCore, match_core
from rse_pf.slam.descriptors import best_matches, distances_of_pairs

__all__ = ["match_all"]

Rows = npt.NDArray[np.int64]


def match_all(
    first: Descriptors, second: Descriptors, *, ratio: float = 0.8, max_distance: int = 64
) -> tuple[Rows, Rows]:
    """Return rows of *first* and of *second* that match: ratio test, one to one.

    Args:
        first: ``(n, d)``.
        second: ``(m, d)``.
        ratio: The nearest must be this much nearer than the second nearest.
        max_distance: Of 256 bits; other binary descriptors by their bits, vectors have none.

    Raises:
        MissingExtra: OpenCV is not installed, and the native core cannot match them.
    """
    if not len(first) or len(second) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    if first.dtype != np.uint8:
        rows, columns = best_matches(first, second, ratio)
        order = np.argsort(rows, kind="stable")
        return rows[order], columns[order]
    core = match_core()
    if core is not None and ORB.describes(first):
        return _all_by_core(core, first, second, ratio, max_distance)
    max_distance = max_distance * first.shape[1] // ORB.size
    cv2 = load_opencv()
    distances, neighbours = cv2.batchDistance(first, second, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    clear = (distances[:, 0] < ratio * distances[:, 1]) & (distances[:, 0] <= max_distance)
    return _one_to_one(np.flatnonzero(clear), neighbours[clear, 0].astype(np.int64), distances[clear, 0])


def _all_by_core(
    core: MatchCore, first: Descriptors, second: Descriptors, ratio: float, max_distance: int
) -> tuple[Rows, Rows]:
    """Return what `match_all` does by the native core, which carries the rows as coordinates."""
    points, pixels = np.zeros((len(first), 3)), np.zeros((len(second), 2))
    points[:, 0], pixels[:, 0] = np.arange(len(first)), np.arange(len(second))
    matched = core.matches(
        first, points, second, pixels, np.zeros((len(second), 3)), ratio=ratio, max_matches=len(first)
    )
    assert matched is not None  # the arrays are of the kinds that it takes
    rows, columns = matched[0][:, 0].astype(np.int64), matched[1][:, 0].astype(np.int64)
    distances = distances_of_pairs(first[rows], second[columns])
    order = np.argsort(rows, kind="stable")
    order = order[distances[order] <= max_distance]
    return rows[order], columns[order]


def _one_to_one(rows: Rows, columns: Rows, distances: npt.NDArray[Any]) -> tuple[Rows, Rows]:
    """Keep, for each column, the pair with the smallest distance; rows are distinct already."""
    order = np.argsort(distances, kind="stable")
    _, firsts = np.unique(columns[order], return_index=True)
    kept = np.sort(order[firsts])
    return rows[kept].astype(np.int64), columns[kept]
