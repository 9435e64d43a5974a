"""Binary descriptors: matches of two views, and one vector for a whole view; deterministic, one thread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra

__all__ = ["Descriptors", "descriptors_of", "hamming_matches", "load_faiss", "train_words", "view_vector"]

Descriptors = npt.NDArray[np.uint8]

BYTES = 32
_MAX_TRAINING = 20_000
_KMEANS_ITERATIONS = 12
_ROWS_AT_ONCE = 4096
"""Descriptors that are expanded to floats at once: a descriptor of 32 bytes becomes one of 1 KiB."""


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


def train_words(views: Sequence[Descriptors], words: int, seed: int) -> npt.NDArray[np.float32]:
    """Return ``(k, 256)`` cluster centres of the descriptors' bits (-1, 1); ``k <= words``.

    Trained from these views alone, so that a vocabulary belongs to one map version and holds no data of
    others.  Deterministic for a *seed*.
    """
    stacked = _sample(views, seed)
    if not len(stacked):
        raise BadRequest("the map holds no descriptors", hint="upload keyframes with their descriptors")
    k = int(min(words, len(stacked)))
    kmeans = load_faiss().Kmeans(
        8 * BYTES, k, niter=_KMEANS_ITERATIONS, seed=seed, verbose=False, min_points_per_centroid=1
    )
    kmeans.train(_bits(stacked))
    centres: npt.NDArray[np.float32] = np.asarray(kmeans.centroids, dtype=np.float32)
    return centres


def view_vector(view: Descriptors, words: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the ``(k * 256,)`` unit vector of a whole view; zero for a view without descriptors.

    Source:
        Jegou et al., Aggregating local descriptors (VLAD), CVPR 2010; with the intra-normalisation of
        Arandjelovic and Zisserman, CVPR 2013, and the square root of PAMI 2012.
    """
    sums = np.zeros_like(words)
    if len(view):
        squares = (words**2).sum(axis=1)
        for begin in range(0, len(view), _ROWS_AT_ONCE):
            bits = _bits(view[begin : begin + _ROWS_AT_ONCE])
            # Nearest centre: |b - c|^2 without the constant |b|^2.
            nearest = np.argmin(squares - 2.0 * (bits @ words.T), axis=1)
            np.add.at(sums, nearest, bits - words[nearest])
        sums = np.sign(sums) * np.sqrt(np.abs(sums))
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    flat: npt.NDArray[np.float32] = sums.ravel()
    flat /= np.float32(max(float(np.linalg.norm(flat)), 1e-9))
    return flat


def load_faiss() -> Any:
    """Return faiss, limited to one thread; raises MissingExtra."""
    try:
        import faiss
    except ImportError as error:
        raise MissingExtra("faiss-cpu", "maps") from error
    faiss.omp_set_num_threads(1)
    return faiss


def _sample(views: Sequence[Descriptors], seed: int) -> Descriptors:
    """Return the descriptors of all *views*, or `_MAX_TRAINING` of them, without copying the others."""
    ends = np.cumsum([len(view) for view in views], dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    if total == 0:
        return np.empty((0, BYTES), dtype=np.uint8)
    if total <= _MAX_TRAINING:
        return np.concatenate([np.asarray(view, dtype=np.uint8) for view in views])
    rows = np.sort(np.random.default_rng(seed).choice(total, _MAX_TRAINING, replace=False))
    borders = np.searchsorted(rows, ends)
    parts, begin = [], 0
    for view, end, border in zip(views, ends.tolist(), borders.tolist(), strict=True):
        parts.append(view[rows[begin:border] - (end - len(view))])
        begin = border
    return np.concatenate(parts)


def _bits(view: Descriptors) -> npt.NDArray[np.float32]:
    """Return the bits of ``(n, 32)`` descriptors as ``(n, 256)`` numbers -1 and 1."""
    bits: npt.NDArray[np.float32] = np.unpackbits(np.ascontiguousarray(view), axis=1).astype(np.float32)
    bits *= 2.0
    bits -= 1.0
    return bits
