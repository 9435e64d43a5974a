"""Binary descriptors and their matches between two views; deterministic, one thread."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra

__all__ = ["Descriptors", "descriptors_of", "hamming_matches", "load_faiss"]

Descriptors = npt.NDArray[np.uint8]

BYTES = 32


def descriptors_of(data: bytes, rows: int) -> Descriptors:
    """Return raw bytes as ``(rows, 32)`` uint8 descriptors; raises BadRequest."""
    if len(data) != BYTES * rows:
        raise BadRequest(
            f"{len(data)} bytes are not {rows} descriptors of {BYTES} bytes", hint="send one for each pixel"
        )
    return np.frombuffer(data, dtype=np.uint8).reshape(rows, BYTES)


def hamming_matches(
    reference: Descriptors, view: Descriptors, ratio: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Match ``(n, 32)`` reference rows to ``(m, 32)`` view rows; best match first.

    A match is kept if its distance is below *ratio* times that of the second best, and each row of
    the view is matched once, by the closest.

    Returns:
        Row numbers of the reference and of the view, of equal length.
    """
    none: npt.NDArray[np.int64] = np.empty(0, dtype=np.int64)
    if len(reference) == 0 or len(view) < 2:
        return none, none
    index = load_faiss().IndexBinaryFlat(8 * BYTES)
    index.add(np.ascontiguousarray(view))
    distances, neighbours = index.search(np.ascontiguousarray(reference), 2)
    clear = np.flatnonzero(distances[:, 0] < ratio * distances[:, 1])
    best_first = clear[np.argsort(distances[clear, 0], kind="stable")]
    _, firsts = np.unique(neighbours[best_first, 0], return_index=True)
    chosen = best_first[np.sort(firsts)]
    return chosen, neighbours[chosen, 0].astype(np.int64)


def load_faiss() -> Any:
    """Return faiss, limited to one thread; raises MissingExtra."""
    try:
        import faiss
    except ImportError as error:
        raise MissingExtra("faiss-cpu", "maps") from error
    faiss.omp_set_num_threads(1)
    return faiss
