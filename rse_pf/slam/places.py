"""Find the keyframes that look like a view: one short vector for each, and a search over all of them.

The vocabulary is fixed and comes with the package, so a vector never changes when a map grows.  Vectors are
computed in whole numbers: the same descriptors give the same bytes on every machine.  A search only proposes;
poses decide.

ORB has a vocabulary that was trained; descriptors of other kinds have one of random directions.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.slam.descriptors import as_vectors

__all__ = ["PLACE_NUMBERS", "PLACE_WORDS_FILE", "PlaceIndex", "PlaceVector", "place_vector"]

WORDS, PARTS = 32, 16
_BITS, _SCALE, _FINENESS = 256, 127, 16
PLACE_NUMBERS = WORDS * PARTS
"""Of one vector."""
PLACE_WORDS_FILE = Path(__file__).with_name("place_words.bin")
"""``(32, 256)`` centres of descriptors' bits (-1, 1) and ``(256, 16)`` directions of what is left, as int8;
written by ``scripts/train_places.py``."""
_FIRST_ROWS = 64
_ROW_BYTES = 8 + 4 * PLACE_NUMBERS
_ONE_THREAD_PRODUCTS = 1 << 18
"""Products of matrices with at most this number of multiplications take OpenBLAS one thread."""

PlaceVector = npt.NDArray[np.float32]


def place_vector(descriptors: Descriptors) -> PlaceVector:
    """Return the ``(512,)`` unit vector of a view with ``(n, d)`` descriptors of any kind; zero without any.

    Source:
        Jegou et al., Aggregating local descriptors (VLAD), CVPR 2010, with their reduction by principal
        components (PAMI 2012) for each residual, its square root, and the intra-normalisation of Arandjelovic
        and Zisserman, CVPR 2013.
    """
    numbers = as_vectors(descriptors)
    is_orb = ORB.is_kind_of(descriptors)
    words, directions, squares = _vocabulary() if is_orb else _random_vocabulary(numbers.shape[1])
    if not is_orb and len(numbers):
        # Vectors that are never negative lie all in one direction.
        numbers -= np.rint(numbers.sum(axis=0, dtype=np.float64) / len(numbers)).astype(np.float32)
    # Whole numbers below 2**24, so float32 is exact, in whatever order a machine adds them.
    nearest = np.argmin(squares - (2.0 * _SCALE) * _product(numbers, words.T), axis=1)
    counts = np.bincount(nearest, minlength=WORDS)
    residuals = np.zeros((WORDS, numbers.shape[1]))
    if len(numbers):
        order, used = np.argsort(nearest, kind="stable"), np.flatnonzero(counts)
        starts = (np.cumsum(counts) - counts)[used]
        residuals[used] = _SCALE * np.add.reduceat(numbers[order], starts, axis=0).astype(np.float64)
    if is_orb:
        residuals -= counts[:, None] * words
    parts = np.matmul(residuals[:, None, :], directions)[:, 0]
    parts = np.sign(parts) * np.rint(np.sqrt(np.abs(parts)))
    lengths = np.sqrt((parts * parts).sum(axis=1))
    parts /= np.maximum(lengths, 1.0)[:, None] * math.sqrt(max(1, int(np.count_nonzero(lengths))))
    vector: PlaceVector = parts.astype(np.float32).ravel()
    return vector


def _product(numbers: npt.NDArray[np.float32], words: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the product by parts that BLAS does not share among threads: these spin for longer."""
    rows = max(1, _ONE_THREAD_PRODUCTS // words.size)
    parts = [numbers[first : first + rows] @ words for first in range(0, len(numbers), rows)]
    return np.concatenate(parts) if parts else numbers @ words


class PlaceIndex:
    """The vectors of keyframes by id, which is a position in the log; rows have no order of their own."""

    def __init__(self) -> None:
        self._count = 0
        self._ids = np.empty(_FIRST_ROWS, dtype=np.int64)
        self._vectors = np.empty((_FIRST_ROWS, PLACE_NUMBERS), dtype=np.float32)
        self._row_of = np.full(_FIRST_ROWS, -1, dtype=np.int64)

    @classmethod
    def from_bytes(cls, data: bytes) -> PlaceIndex:
        """Return the index that `to_bytes` was called on; raises BadRequest."""
        count, odd = divmod(len(data), _ROW_BYTES)
        if odd:
            raise BadRequest(
                f"{len(data)} bytes are not an index of places", hint="restore the map from another snapshot"
            )
        ids = np.frombuffer(data, dtype="<i8", count=count)
        vectors = np.frombuffer(data, dtype="<f4", offset=8 * count).reshape(count, PLACE_NUMBERS)
        index = cls()
        for number, vector in zip(ids.tolist(), vectors, strict=True):
            index.add(number, vector)
        return index

    def to_bytes(self) -> bytes:
        """Return ids and vectors in the order of the ids: equal for equal contents."""
        order = np.argsort(self._ids[: self._count])
        ids, vectors = self._ids[order].astype("<i8"), self._vectors[order].astype("<f4")
        return ids.tobytes() + vectors.tobytes()

    def __len__(self) -> int:
        return self._count

    def __contains__(self, number: int) -> bool:
        return 0 <= number < len(self._row_of) and self._row_of[number] >= 0

    @classmethod
    def of(cls, vectors: Iterable[PlaceVector]) -> PlaceIndex:
        """Return an index of *vectors*, whose ids are their row numbers."""
        index = cls()
        for number, vector in enumerate(vectors):
            index.add(number, vector)
        return index

    @staticmethod
    def vector(descriptors: Descriptors) -> PlaceVector:
        """Return `place_vector` of *descriptors*."""
        return place_vector(descriptors)

    def vector_of(self, number: int) -> PlaceVector:
        """Return the vector of keyframe *number*; raises KeyError."""
        if number not in self:
            raise KeyError(number)
        found: PlaceVector = self._vectors[self._row_of[number]].copy()
        return found

    def add(self, number: int, vector: PlaceVector) -> None:
        """Add keyframe *number*, which is not there yet."""
        if number in self:
            raise ValueError(f"keyframe {number} is there already")
        if self._count == len(self._ids):
            self._ids = np.concatenate([self._ids, np.empty_like(self._ids)])
            self._vectors = np.concatenate([self._vectors, np.empty_like(self._vectors)])
        if number >= len(self._row_of):
            more = np.full(number + 1, -1, dtype=np.int64)
            self._row_of = np.concatenate([self._row_of, more])
        self._ids[self._count], self._vectors[self._count] = number, vector
        self._row_of[number] = self._count
        self._count += 1

    def remove(self, number: int) -> None:
        """Remove keyframe *number*, if it is there."""
        if number not in self:
            return
        row, last = int(self._row_of[number]), self._count - 1
        self._ids[row], self._vectors[row] = self._ids[last], self._vectors[last]
        self._row_of[self._ids[row]] = row
        self._row_of[number] = -1
        self._count = last

    def nearest(
        self, vector: PlaceVector, count: int, allowed: npt.NDArray[np.int64] | None = None
    ) -> list[tuple[int, float]]:
        """Return up to *count* ``(id, cosine)``, the most similar first, equals by id.

        *allowed* are ids; those that are not in the index are ignored.
        """
        rows: npt.NDArray[np.int64] | None = None
        if allowed is not None:
            rows = self._row_of[allowed[allowed < len(self._row_of)]]
            rows = rows[rows >= 0]
        among = self._count if rows is None else len(rows)
        count = min(count, among)
        if count <= 0:
            return []
        # All rows at once: to pick rows out of the matrix first would copy them.
        similarity, ids = self._vectors[: self._count] @ vector, self._ids[: self._count]
        if rows is not None:
            similarity, ids = similarity[rows], ids[rows]
        least = np.partition(similarity, among - count)[among - count]
        best = np.flatnonzero(similarity >= least)
        best = best[np.lexsort((ids[best], -similarity[best]))][:count]
        return [(int(ids[row]), float(similarity[row])) for row in best]


@functools.cache
def _vocabulary() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return ``(32, 256)`` words, ``(32, 256, 16)`` directions, and the squared lengths of the words.

    The directions of a word are rounded to whole numbers, and lie across it: descriptors of another kind than
    those of the training are all nearer to a word or farther from it, which tells no place from another.
    """
    numbers = np.frombuffer(PLACE_WORDS_FILE.read_bytes(), dtype=np.int8)
    words = numbers[: WORDS * _BITS].reshape(WORDS, _BITS).astype(np.float64)
    common = numbers[WORDS * _BITS :].reshape(_BITS, PARTS).astype(np.float64)
    squares = (words**2).sum(axis=1)
    along = words[:, :, None] * (words @ common)[:, None, :] / squares[:, None, None]
    directions = np.rint(_FINENESS * (common - along))
    return words.astype(np.float32), directions, squares.astype(np.float32)


@functools.lru_cache(maxsize=8)
def _random_vocabulary(
    dimensions: int,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return what `_vocabulary` does, of random signs, for descriptors that nothing was trained for.

    They come from a hash, since the numbers of a random generator may change with its release.
    """
    count = WORDS + WORDS * PARTS
    data = hashlib.shake_256(f"places {dimensions}".encode()).digest(count * dimensions // 8 + 1)
    bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8), count=count * dimensions)
    signs = (2.0 * bits.astype(np.float64) - 1.0).reshape(count, dimensions)
    words = signs[:WORDS].astype(np.float32)
    directions = signs[WORDS:].reshape(WORDS, PARTS, dimensions).transpose(0, 2, 1)
    # Across the word, times the number of dimensions: along it lies all that is nearest to it.
    along = signs[:WORDS, :, None] * np.einsum("wd,wdp->wp", signs[:WORDS], directions)[:, None, :]
    return words, dimensions * directions - along, np.zeros(WORDS, dtype=np.float32)
