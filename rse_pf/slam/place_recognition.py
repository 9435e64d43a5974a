"""Recognise places: compute a VLAD vector for each image, and find keyframes with similar vectors.

The vector of an image aggregates its local descriptors by a vocabulary of 32 visual words.  ORB has a
vocabulary that was trained on rendered worlds; other kinds of descriptors have one of random directions.
Both are fixed, so that a vector never changes when a map grows.  Vectors are computed in integers that floats
hold exactly: the same descriptors give the same bytes on every machine.  A search only proposes candidates,
whose poses are then measured.
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

__all__ = ["PLACE_VECTOR_SIZE", "VOCABULARY_FILE", "PlaceIndex", "PlaceVector", "place_vector"]

WORDS = 32  # number of visual words of a vocabulary
DIRECTIONS = 16  # number of principal directions to which the residual of each word is reduced
PLACE_VECTOR_SIZE = WORDS * DIRECTIONS  # number of elements of the place recognition vector of an image
VOCABULARY_FILE = Path(__file__).with_name("place_words.bin")
"""The trained vocabulary of ORB, which ``scripts/train_places.py`` writes, as int8: the 32 words with 256
elements each (means of bits written as -1 and 1, times 127), then a 256 x 16 matrix, whose columns are the
principal directions of the residuals of all words together."""
_ORB_BITS = 256  # number of bits of an ORB descriptor
_WORD_SCALE = 127
"""Factor by which the words of the trained vocabulary are scaled, so that -1..1 fits int8."""
_DIRECTION_SCALE = 16  # factor by which principal directions are scaled before they are rounded to integers
_INITIAL_ROWS = 64
"""Number of vectors for which a new index has memory; the memory is doubled whenever it is full."""
_INDEX_ROW_BYTES = 8 + 4 * PLACE_VECTOR_SIZE
"""Size of an encoded index for each keyframe in bytes: its id (int64) and its vector (float32)."""
_MAX_BLAS_PRODUCTS = 1 << 18
"""Largest number of multiplications in one matrix product.  OpenBLAS computes a product of this size in the
calling thread; for a larger one it would use worker threads, which then keep other cores busy while they wait
for work."""

PlaceVector = npt.NDArray[np.float32]
"""The vector of an image for place recognition, with the Euclidean norm 1: ``(512,)`` from `place_vector`, of
any length from a place recogniser that a user passes to a robot (`client_sdk.plugins`)."""

_Vocabulary = tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]
"""Visual words ``(32, d)``; for each word the 16 directions to which its residual is reduced, ``(32, d,
16)``; and the squared lengths of the words, ``(32,)``, or zeros in a random vocabulary, whose words are
equally long."""


def place_vector(descriptors: Descriptors) -> PlaceVector:
    """Return the VLAD vector ``(512,)`` of an image: a unit vector, or zero without descriptors.

    Vectors of different kinds of descriptors cannot be compared.

    Args:
        descriptors: ``(n, d)`` of any kind.

    Source:
        VLAD: Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010;
        reduction by principal components and square roots: Jegou et al., PAMI 2012;
        intra-normalisation: Arandjelovic and Zisserman, "All about VLAD", CVPR 2013.
    """
    vectors = as_vectors(descriptors)
    is_orb = ORB.is_kind_of(descriptors)
    words, directions, squared_lengths = _orb_vocabulary() if is_orb else _random_vocabulary(vectors.shape[1])
    # 1. Subtract the mean of the image's descriptors, except for ORB.  Descriptors without negative elements,
    # such as SIFT, have a large component in common, which would otherwise decide which word is nearest.
    if not is_orb and len(vectors):
        vectors -= np.rint(vectors.sum(axis=0, dtype=np.float64) / len(vectors)).astype(np.float32)
    # 2. Assign each descriptor to its nearest word.  All products are integers below 2**24, so that float32
    # holds their sums exactly in whatever order a machine adds them.
    products = _multiply_in_one_thread(vectors, words.T)
    nearest = np.argmin(squared_lengths - (2.0 * _WORD_SCALE) * products, axis=1)
    # 3. Sum for each word the residuals of its descriptors: descriptor minus word for ORB, and the centred
    # descriptor itself for other kinds.
    counts = np.bincount(nearest, minlength=WORDS)
    residuals = np.zeros((WORDS, vectors.shape[1]))
    if len(vectors):
        order, used_words = np.argsort(nearest, kind="stable"), np.flatnonzero(counts)
        starts = (np.cumsum(counts) - counts)[used_words]
        sums = np.add.reduceat(vectors[order], starts, axis=0)
        residuals[used_words] = _WORD_SCALE * sums.astype(np.float64)
    if is_orb:
        residuals -= counts[:, None] * words
    # 4. Reduce each residual to 16 directions, and take signed square roots.
    reduced = np.matmul(residuals[:, None, :], directions)[:, 0]
    reduced = np.sign(reduced) * np.rint(np.sqrt(np.abs(reduced)))
    # 5. Normalise the part of each word, then the whole vector.
    lengths = np.sqrt((reduced * reduced).sum(axis=1))
    nonzero_words = max(1, int(np.count_nonzero(lengths)))
    reduced /= np.maximum(lengths, 1.0)[:, None] * math.sqrt(nonzero_words)
    vector: PlaceVector = reduced.astype(np.float32).ravel()
    return vector


def _multiply_in_one_thread(
    vectors: npt.NDArray[np.float32], words: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return ``vectors @ words``, in parts so small that OpenBLAS does not start threads."""
    rows = max(1, _MAX_BLAS_PRODUCTS // words.size)
    parts = [vectors[first : first + rows] @ words for first in range(0, len(vectors), rows)]
    return np.concatenate(parts) if parts else vectors @ words


class PlaceIndex:
    """The place vectors of keyframes by their ids, with a search for the most similar ones.

    Ids are whole numbers from 0; the memory of the index also grows with the largest id.
    The vectors lie in the rows of one matrix in no particular order, so that a search is one product.
    """

    def __init__(self) -> None:
        self._count = 0
        self._ids = np.empty(_INITIAL_ROWS, dtype=np.int64)
        self._vectors = np.empty((_INITIAL_ROWS, PLACE_VECTOR_SIZE), dtype=np.float32)
        self._row_of_id = np.full(_INITIAL_ROWS, -1, dtype=np.int64)

    @classmethod
    def from_pairs(cls, pairs: Iterable[tuple[int, PlaceVector]]) -> PlaceIndex:
        """Return an index of vectors with their ids; raises ValueError if an id occurs twice."""
        index = cls()
        for keyframe_id, vector in pairs:
            index.add(keyframe_id, vector)
        return index

    @classmethod
    def from_bytes(cls, data: bytes) -> PlaceIndex:
        """Return the index that `to_bytes` encoded.

        Raises:
            BadRequest: *data* has a length that no number of keyframes has.
            ValueError: An id occurs twice.
        """
        count, remainder = divmod(len(data), _INDEX_ROW_BYTES)
        if remainder:
            raise BadRequest(
                f"{len(data)} bytes are not an index of places, which has {_INDEX_ROW_BYTES} bytes for each "
                "keyframe",
                hint="restore the map from another snapshot",
            )
        ids = np.frombuffer(data, dtype="<i8", count=count)
        vectors = np.frombuffer(data, dtype="<f4", offset=8 * count).reshape(count, PLACE_VECTOR_SIZE)
        return cls.from_pairs(zip(ids.tolist(), vectors, strict=True))

    def to_bytes(self) -> bytes:
        """Return ids and vectors in ascending order of the ids, so that equal contents give equal bytes."""
        order = np.argsort(self._ids[: self._count])
        ids, vectors = self._ids[order].astype("<i8"), self._vectors[order].astype("<f4")
        return ids.tobytes() + vectors.tobytes()

    def __len__(self) -> int:
        return self._count

    def __contains__(self, keyframe_id: int) -> bool:
        return 0 <= keyframe_id < len(self._row_of_id) and self._row_of_id[keyframe_id] >= 0

    def vector_of(self, keyframe_id: int) -> PlaceVector:
        """Return a copy of the vector of a keyframe; raises KeyError if the index does not have it."""
        if keyframe_id not in self:
            raise KeyError(keyframe_id)
        vector: PlaceVector = self._vectors[self._row_of_id[keyframe_id]].copy()
        return vector

    def add(self, keyframe_id: int, vector: PlaceVector) -> None:
        """Add the vector of a keyframe; raises ValueError if the index already has this id."""
        if keyframe_id in self:
            raise ValueError(f"keyframe {keyframe_id} is in the index already")
        if self._count == len(self._ids):
            self._ids = np.concatenate([self._ids, np.empty_like(self._ids)])
            self._vectors = np.concatenate([self._vectors, np.empty_like(self._vectors)])
        if keyframe_id >= len(self._row_of_id):
            unused = np.full(keyframe_id + 1, -1, dtype=np.int64)
            self._row_of_id = np.concatenate([self._row_of_id, unused])
        self._ids[self._count], self._vectors[self._count] = keyframe_id, vector
        self._row_of_id[keyframe_id] = self._count
        self._count += 1

    def remove(self, keyframe_id: int) -> None:
        """Remove the vector of a keyframe; does nothing if the index does not have it."""
        if keyframe_id not in self:
            return
        # The last row takes the place of the removed one.
        row, last = int(self._row_of_id[keyframe_id]), self._count - 1
        self._ids[row], self._vectors[row] = self._ids[last], self._vectors[last]
        self._row_of_id[self._ids[row]] = row
        self._row_of_id[keyframe_id] = -1
        self._count = last

    def nearest(
        self, vector: PlaceVector, count: int, allowed: npt.NDArray[np.int64] | None = None
    ) -> list[tuple[int, float]]:
        """Return ids and cosine similarities of the keyframes most similar to *vector*, the best first.

        Keyframes of equal similarity are sorted by their ids.  A similarity is the scalar product of two
        vectors, within -1 to 1 for unit vectors; the list is empty where there is nothing to search.

        Args:
            vector: ``(512,)``.
            count: The largest number of keyframes that are returned.
            allowed: Ids among which to search; None means all.  Ids that the index does not have are ignored.
        """
        rows: npt.NDArray[np.int64] | None = None
        if allowed is not None:
            rows = self._row_of_id[allowed[allowed < len(self._row_of_id)]]
            rows = rows[rows >= 0]
        searched = self._count if rows is None else len(rows)
        count = min(count, searched)
        if count <= 0:
            return []
        # The product takes all rows, because selecting rows of the matrix first would copy them.
        similarity, ids = self._vectors[: self._count] @ vector, self._ids[: self._count]
        if rows is not None:
            similarity, ids = similarity[rows], ids[rows]
        min_similarity = np.partition(similarity, searched - count)[searched - count]
        best = np.flatnonzero(similarity >= min_similarity)
        best = best[np.lexsort((ids[best], -similarity[best]))][:count]
        return [(int(ids[row]), float(similarity[row])) for row in best]


@functools.cache
def _orb_vocabulary() -> _Vocabulary:
    """Return the trained vocabulary of ORB.

    The directions of each word are made orthogonal to the word.  The component of the residuals along the
    word does not distinguish places: it depends on how much an image differs from those of the training, by
    which all descriptors of the word are nearer to it, or all farther from it.
    """
    numbers = np.frombuffer(VOCABULARY_FILE.read_bytes(), dtype=np.int8)
    words = numbers[: WORDS * _ORB_BITS].reshape(WORDS, _ORB_BITS).astype(np.float64)
    principal = numbers[WORDS * _ORB_BITS :].reshape(_ORB_BITS, DIRECTIONS).astype(np.float64)
    squared_lengths = (words**2).sum(axis=1)
    along_word = words[:, :, None] * (words @ principal)[:, None, :] / squared_lengths[:, None, None]
    directions = np.rint(_DIRECTION_SCALE * (principal - along_word))
    return words.astype(np.float32), directions, squared_lengths.astype(np.float32)


@functools.lru_cache(maxsize=8)
def _random_vocabulary(dimensions: int) -> _Vocabulary:
    """Return a vocabulary of random signs, for kinds of descriptors without a trained vocabulary.

    The signs come from a hash, because the sequence of a random generator may change between its releases.

    Args:
        dimensions: Elements of a descriptor as a vector: bits if it is binary.
    """
    count = WORDS + WORDS * DIRECTIONS
    data = hashlib.shake_256(f"places {dimensions}".encode()).digest(count * dimensions // 8 + 1)
    bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8), count=count * dimensions)
    signs = (2.0 * bits.astype(np.float64) - 1.0).reshape(count, dimensions)
    words = signs[:WORDS].astype(np.float32)
    directions = signs[WORDS:].reshape(WORDS, DIRECTIONS, dimensions).transpose(0, 2, 1)
    # Make the directions orthogonal to their word, along which all descriptors of the word lie.  The factor
    # *dimensions*, the squared length of a word, keeps the numbers integers.
    along_word = signs[:WORDS, :, None] * np.einsum("wd,wdp->wp", signs[:WORDS], directions)[:, None, :]
    return words, dimensions * directions - along_word, np.zeros(WORDS, dtype=np.float32)
