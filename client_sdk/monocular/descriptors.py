"""Match binary descriptors, all against all.

Deterministic.  Every match is one to one; matches near predicted pixels are found by `rse_pf.slam.tracking`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.opencv import load_opencv
from rse_pf.native_matcher import MatchCore, match_core

__all__ = ["match_all"]

Descriptors = npt.NDArray[np.uint8]
Rows = npt.NDArray[np.int64]

_BITS = np.array([bin(value).count("1") for value in range(256)], dtype=np.uint8)


def match_all(
    first: Descriptors, second: Descriptors, *, ratio: float = 0.8, max_distance: int = 64
) -> tuple[Rows, Rows]:
    """Return rows of *first* and of *second* that match: ratio test, one to one.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    if not len(first) or len(second) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    core = match_core()
    if core is not None:
        return _all_by_core(core, first, second, ratio, max_distance)
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
    distances = _BITS[first[rows] ^ second[columns]].sum(axis=1, dtype=np.int64)
    order = np.argsort(rows, kind="stable")
    order = order[distances[order] <= max_distance]
    return rows[order], columns[order]


def _one_to_one(rows: Rows, columns: Rows, distances: npt.NDArray[Any]) -> tuple[Rows, Rows]:
    """Keep, for each column, the pair with the smallest distance; rows are distinct already."""
    order = np.argsort(distances, kind="stable")
    _, firsts = np.unique(columns[order], return_index=True)
    kept = np.sort(order[firsts])
    return rows[kept].astype(np.int64), columns[kept]
