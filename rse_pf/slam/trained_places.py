"""Find the keyframes that look like a view, with a vocabulary that is trained from these keyframes alone."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.maps.format import Keyframe
from rse_pf.slam.descriptors import Descriptors, load_faiss, train_words, view_vector

__all__ = ["PlaceIndex", "VectorIndex", "Within", "view_vectors"]

WORDS = 32
SEED = 20


class Within(msgspec.Struct, frozen=True, kw_only=True):
    """A prior: the camera is within *radius_m* of ``(x, y, z)``, metres, map frame."""

    x: float
    y: float
    z: float
    radius_m: float


class VectorIndex:
    """An index of the vectors of keyframes; immutable."""

    def __init__(self, vectors: npt.NDArray[np.float32]) -> None:
        """Copy *vectors* ``(n, d)``, unit or zero."""
        self._index = load_faiss().IndexFlatIP(vectors.shape[1])
        self._index.add(vectors)
        self._count = len(vectors)

    def vector(self, row: int) -> npt.NDArray[np.float32]:
        """Return the vector of the keyframe at *row*."""
        found: npt.NDArray[np.float32] = self._index.reconstruct(row)
        return found

    def nearest_to(
        self, vector: npt.NDArray[np.float32], count: int, allowed: npt.NDArray[np.int64] | None = None
    ) -> list[tuple[int, float]]:
        """Return up to *count* ``(row, score)`` for the vector of a view, best first, of *allowed* rows."""
        count = min(count, self._count if allowed is None else len(allowed))
        if count == 0:
            return []
        faiss, parameters = load_faiss(), None
        if allowed is not None:
            parameters = faiss.SearchParameters(sel=faiss.IDSelectorBatch(allowed))
        scores, rows = self._index.search(vector[None, :], count, params=parameters)
        return [
            (int(row), float(score)) for row, score in zip(rows[0], scores[0], strict=True) if row >= 0
        ]  # fmt: skip


class PlaceIndex:
    """An index of keyframes by their descriptors; immutable."""

    def __init__(self, keyframes: Sequence[Keyframe], *, words: int = WORDS, seed: int = SEED) -> None:
        self.keyframes = tuple(keyframes)
        self._words = train_words([each.descriptors for each in self.keyframes], words, seed)
        self.vectors = VectorIndex(view_vectors(self.keyframes, self._words))

    def vector(self, row: int) -> npt.NDArray[np.float32]:
        """Return the vector of the keyframe at *row*."""
        return self.vectors.vector(row)

    def nearest(
        self, descriptors: Descriptors, count: int, allowed: npt.NDArray[np.int64] | None = None
    ) -> list[tuple[int, float]]:
        """Return up to *count* ``(row, score)``, best first, among the *allowed* rows."""
        return self.vectors.nearest_to(view_vector(descriptors, self._words), count, allowed)

    def rows_within(self, within: Within | None) -> npt.NDArray[np.int64] | None:
        """Return the rows of keyframes in the sphere of *within*; None means all."""
        if within is None:
            return None
        centre = np.array([within.x, within.y, within.z])
        places = np.array([each.T_world_camera[:3, 3] for each in self.keyframes])
        return np.flatnonzero(np.linalg.norm(places - centre, axis=1) <= within.radius_m).astype(np.int64)


def view_vectors(keyframes: Sequence[Keyframe], words: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the ``(n, k * 256)`` vectors of *keyframes* in the vocabulary *words*."""
    vectors = np.empty((len(keyframes), words.size), dtype=np.float32)
    for row, each in enumerate(keyframes):
        vectors[row] = view_vector(each.descriptors, words)
    return vectors
