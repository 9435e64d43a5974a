"""Descriptors of any kind and their matches between two views; deterministic, one thread.

A descriptor is binary (uint8, compared by its Hamming distance) or a vector of whole numbers (int8, compared
by its squared Euclidean distance).  The array says which: nothing else has to be carried along to compare two
of them.  The Hamming distance is a quarter of the squared one of bits as -1 and 1, so one ratio fits both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra
from rse_pf.maps.descriptors import Descriptors

__all__ = [
    "as_vectors",
    "best_matches",
    "distance_matrix",
    "distances_of_pairs",
    "load_faiss",
    "no_distance",
]

Rows = npt.NDArray[np.int64]

_BLOCK = 4_000_000
"""Distances that are held at a time, 16 MB."""
_BITS = np.array([bin(value).count("1") for value in range(256)], dtype=np.uint8)


def no_distance(descriptors: Descriptors) -> int:
    """Return a number above every distance of such descriptors: 256 for 32 bytes."""
    size = int(descriptors.shape[1])
    return 8 * size if descriptors.dtype == np.uint8 else 4 * 128 * 128 * size


def distances_of_pairs(first: Descriptors, second: Descriptors) -> npt.NDArray[np.int64]:
    """Return the ``(n,)`` distances of the rows of two ``(n, d)`` arrays."""
    if first.dtype == np.uint8:
        bits: npt.NDArray[np.int64] = _BITS[first ^ second].sum(axis=1, dtype=np.int64)
        return bits
    apart = first.astype(np.int32) - second.astype(np.int32)
    squares: npt.NDArray[np.int64] = np.einsum("nd,nd->n", apart, apart).astype(np.int64)
    return squares


def distance_matrix(first: Descriptors, second: Descriptors) -> npt.NDArray[np.float32]:
    """Return the ``(n, m)`` distances of all rows; whole numbers, exact in float32 by whatever order."""
    a, b = as_vectors(first), as_vectors(second)
    distances: npt.NDArray[np.float32]
    if first.dtype == np.uint8:
        distances = (np.float32(a.shape[1]) - a @ b.T) / 2
    else:
        squares = np.einsum("nd,nd->n", a, a)[:, None] + np.einsum("nd,nd->n", b, b)
        distances = squares - 2.0 * (a @ b.T)
    return distances


def as_vectors(descriptors: Descriptors) -> npt.NDArray[np.float32]:
    """Return ``(n, 8 d)`` bits as -1 and 1 of binary descriptors, ``(n, d)`` numbers of vectors."""
    if descriptors.dtype != np.uint8:
        return descriptors.astype(np.float32)
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    bits += bits
    bits -= 1.0
    return bits


def best_matches(reference: Descriptors, view: Descriptors, ratio: float) -> tuple[Rows, Rows]:
    """Match ``(n, d)`` reference rows to ``(m, d)`` view rows; best match first.

    A match is kept if its distance is below *ratio* times that of the second best, and each row of
    the view is matched once, by the closest.

    Returns:
        Row numbers of the reference and of the view, of equal length.

    Raises:
        BadRequest: The two are descriptors of different kinds.
        MissingExtra: They are binary, and faiss is not installed.
    """
    if reference.dtype != view.dtype or reference.shape[1:] != view.shape[1:]:
        raise BadRequest(
            f"descriptors of {reference.dtype} x {reference.shape[1:]} and {view.dtype} x {view.shape[1:]} "
            "cannot be compared",
            hint="use features of one kind",
        )
    none: Rows = np.empty(0, dtype=np.int64)
    if len(reference) == 0 or len(view) < 2:
        return none, none
    distances, neighbours = _two_nearest(reference, view)
    clear = np.flatnonzero(distances[:, 0] < ratio * distances[:, 1])
    best_first = clear[np.argsort(distances[clear, 0], kind="stable")]
    _, firsts = np.unique(neighbours[best_first, 0], return_index=True)
    chosen = best_first[np.sort(firsts)]
    return chosen, neighbours[chosen, 0].astype(np.int64)


def _two_nearest(reference: Descriptors, view: Descriptors) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the ``(n, 2)`` distances and rows of the two nearest of *view*."""
    if reference.dtype == np.uint8:
        index = load_faiss().IndexBinaryFlat(8 * reference.shape[1])
        index.add(np.ascontiguousarray(view))
        found: tuple[npt.NDArray[Any], npt.NDArray[Any]] = index.search(np.ascontiguousarray(reference), 2)
        return found
    step = max(1, _BLOCK // len(view))
    parts = [_two_nearest_of(reference[row : row + step], view) for row in range(0, len(reference), step)]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _two_nearest_of(reference: Descriptors, view: Descriptors) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    distances = distance_matrix(reference, view)
    rows = np.arange(len(distances))
    nearest = np.argmin(distances, axis=1)
    best = distances[rows, nearest]
    distances[rows, nearest] = np.inf
    second = np.argmin(distances, axis=1)
    return np.stack([best, distances[rows, second]], axis=1), np.stack([nearest, second], axis=1)


def load_faiss() -> Any:
    """Return faiss, limited to one thread; raises MissingExtra."""
    try:
        import faiss
    except ImportError as error:
        raise MissingExtra("faiss-cpu", "maps") from error
    faiss.omp_set_num_threads(1)
    return faiss
