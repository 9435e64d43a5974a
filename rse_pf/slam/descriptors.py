"""Descriptors of any kind and their matches between two views; deterministic, one thread.

The native core matches ORB descriptors; numpy matches all other kinds, which a user's function computes.  A
descriptor is binary (uint8, compared by its Hamming distance) or a vector of whole numbers (int8, compared
by its squared Euclidean distance).  The array says which: nothing else has to be carried along to compare two
of them.  The Hamming distance is a quarter of the squared one of bits as -1 and 1, so one ratio fits both.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.native import Workspace, address_of, aligned, core_function

__all__ = [
    "as_vectors",
    "best_matches",
    "distance_matrix",
    "distances_of_pairs",
    "match_all",
    "match_orb",
    "no_distance",
]

Rows = npt.NDArray[np.int64]

_LANES = {"portable": 1, "avx2": 2, "avx512": 0}  # the flags of `rse_pf_match`

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

    A match is accepted if its distance is below *ratio* times that of the second best, and each row of
    the view is matched once, by the closest.

    Returns:
        Row numbers of the reference and of the view, of equal length.

    Raises:
        BadRequest: The two are descriptors of different kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
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
    if ORB.is_kind_of(reference):
        return match_orb(reference, view, ratio)
    step = max(1, _BLOCK // len(view))
    blocks = [_two_nearest(reference[row : row + step], view) for row in range(0, len(reference), step)]
    best, second, nearest = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    is_clear = np.flatnonzero(best < ratio * second)
    best_first = is_clear[np.argsort(best[is_clear], kind="stable")]
    _, firsts = np.unique(nearest[best_first], return_index=True)
    chosen = best_first[np.sort(firsts)]
    return chosen, nearest[chosen].astype(np.int64)


def _two_nearest(
    reference: Descriptors, view: Descriptors
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the ``(n,)`` distances of the nearest and second nearest of *view*, and the nearest rows."""
    distances = distance_matrix(reference, view)
    rows = np.arange(len(distances))
    nearest = np.argmin(distances, axis=1)
    best = distances[rows, nearest]
    distances[rows, nearest] = np.inf
    return best, distances.min(axis=1), nearest


def match_orb(
    reference: npt.NDArray[np.uint8],
    view: npt.NDArray[np.uint8],
    ratio: float,
    *,
    lanes: Literal["portable", "avx2", "avx512"] = "avx512",
) -> tuple[Rows, Rows]:
    """Match ``(n, 32)`` to ``(m, 32)`` ORB descriptors as `best_matches` does, in the native core.

    *lanes* are the widest instructions that the core may use; they change no byte of the result.

    Raises:
        MissingExtra: The native core is not installed.
    """
    reference, view = aligned(reference), aligned(view)
    n, m = len(reference), len(view)
    rows, columns = np.empty((2, min(n, m)), dtype=np.int64)
    count = _match_function()(
        address_of(reference), n, address_of(view), m, ratio, _LANES[lanes],
        address_of(_WORKSPACE.words(n + 5 * m + 64)), address_of(rows), address_of(columns),
    )  # fmt: skip
    return rows[:count], columns[:count]


_WORKSPACE = Workspace()


@cache
def _match_function() -> Any:
    pointer, size = ctypes.c_void_p, ctypes.c_int64
    arguments = (pointer, size, pointer, size, ctypes.c_double, ctypes.c_uint32, pointer, pointer, pointer)
    return core_function("match", "rse_pf_match", arguments, size)


def match_all(
    first: Descriptors, second: Descriptors, *, ratio: float = 0.8, max_distance: int = 64
) -> tuple[Rows, Rows]:
    """Return rows of *first* and of *second* that match, by ascending rows of *first*.

    Args:
        first: ``(n, d)``.
        second: ``(m, d)``.
        ratio: As in `best_matches`.
        max_distance: Of 256 bits; other binary descriptors by their bits, vectors have no limit.

    Raises:
        As `best_matches`.
    """
    rows, columns = best_matches(first, second, ratio)
    if first.dtype == np.uint8:
        is_near = (
            distances_of_pairs(first[rows], second[columns]) <= max_distance * first.shape[1] // ORB.size
        )
        rows, columns = rows[is_near], columns[is_near]
    order = np.argsort(rows, kind="stable")
    return rows[order], columns[order]
