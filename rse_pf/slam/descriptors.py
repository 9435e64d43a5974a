"""Distances of descriptors, and matches between two sets of them; deterministic, one thread.

A descriptor is binary (uint8, compared by the Hamming distance) or a vector of whole numbers (int8, compared
by the squared Euclidean distance); the type of the array decides.  The Hamming distance is a quarter of the
squared Euclidean distance of bits written as -1 and 1.  A ratio of Hamming distances is therefore a ratio of
squared Euclidean distances, too, so that one limit of the ratio test suits both types.  The native core
matches ORB descriptors; numpy matches all other kinds, which a user's feature extractor computes.
"""

from __future__ import annotations

import ctypes
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.native import Workspace, core_function

__all__ = [
    "as_vectors",
    "best_matches",
    "distance_bound",
    "distance_matrix",
    "distances_of_pairs",
    "match_all",
    "match_orb",
    "measure_distinctiveness",
]

Rows = npt.NDArray[np.int64]

_DESCRIPTOR_DTYPES = (np.uint8, np.int8)
_INSTRUCTION_FLAGS = {"portable": 1, "avx2": 2, "avx512": 0}
"""Flag of a call of ``rse_pf_match`` of the native core, by the widest vector instructions that the core may
use: 1 forbids AVX2 and AVX-512, 2 forbids AVX-512, and 0 forbids nothing."""
_BLOCK_DISTANCES = 4_000_000
"""Largest number of distances in memory at a time where numpy matches descriptors: 16 MB of float32.  More
distances are computed in blocks of rows."""
_BIT_COUNTS = np.array([bin(value).count("1") for value in range(256)], dtype=np.uint8)
_WORKSPACE = Workspace()
_POINTER = ctypes.c_void_p
_SIZE = ctypes.c_int64
_MATCH_ARGUMENTS = (_POINTER, _SIZE, _POINTER, _SIZE, ctypes.c_double, ctypes.c_uint32, *[_POINTER] * 3)
"""Types of the arguments of the native core's ``rse_pf_match``."""
_DISTINCT_ARGUMENTS = (_POINTER, _POINTER, _SIZE, ctypes.c_double, _POINTER)
"""Types of the arguments of the native core's ``rse_pf_distinct``."""


def distance_bound(descriptors: Descriptors) -> int:
    """Return an upper bound of the distances between descriptors of the type and length of *descriptors*.

    *descriptors* is ``(n, d)``; only its type and *d* count.  For ORB descriptors (uint8, 32 bytes) the bound
    is 256, the distance of two descriptors without an equal bit.
    """
    size = int(descriptors.shape[1])
    return 8 * size if descriptors.dtype == np.uint8 else 4 * 128 * 128 * size


def distances_of_pairs(first: Descriptors, second: Descriptors) -> npt.NDArray[np.int64]:
    """Return the ``(n,)`` distances between row *i* of one and row *i* of another ``(n, d)`` array.

    They are Hamming distances of uint8, and squared Euclidean distances of int8.
    """
    if first.dtype == np.uint8:
        bits: npt.NDArray[np.int64] = _BIT_COUNTS[first ^ second].sum(axis=1, dtype=np.int64)
        return bits
    differences = first.astype(np.int32) - second.astype(np.int32)
    squares: npt.NDArray[np.int64] = np.einsum("nd,nd->n", differences, differences).astype(np.int64)
    return squares


def distance_matrix(first: Descriptors, second: Descriptors) -> npt.NDArray[np.float32]:
    """Return the ``(n, m)`` distances between all rows of ``(n, d)`` and all rows of ``(m, d)`` descriptors.

    They are Hamming distances of uint8, and squared Euclidean distances of int8.  Both are whole numbers;
    float32 holds them exactly up to 2**24, and larger ones, up to 2**25, as the nearest even number.
    """
    a, b = as_vectors(first), as_vectors(second)
    distances: npt.NDArray[np.float32]
    if first.dtype == np.uint8:
        distances = (np.float32(a.shape[1]) - a @ b.T) / 2
    else:
        squares = np.einsum("nd,nd->n", a, a)[:, None] + np.einsum("nd,nd->n", b, b)
        distances = squares - 2.0 * (a @ b.T)
    return distances


def as_vectors(descriptors: Descriptors) -> npt.NDArray[np.float32]:
    """Return descriptors as float32 vectors.

    Returns:
        ``(n, 8 d)`` bits written as -1 and 1 of binary ``(n, d)`` descriptors; ``(n, d)`` numbers of others.
    """
    if descriptors.dtype != np.uint8:
        return descriptors.astype(np.float32)
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    bits += bits
    bits -= 1.0
    return bits


def best_matches(reference: Descriptors, view: Descriptors, ratio: float) -> tuple[Rows, Rows]:
    """Match the descriptors of a reference with those of a view by Lowe's ratio test; best match first.

    Each descriptor of the reference is matched with the most similar one of the view.  The match is accepted
    if its distance is below *ratio* times the distance to the second most similar descriptor of the view.  Of
    several accepted matches with one descriptor of the view, only the one with the smallest distance is kept.

    Args:
        reference: ``(n, d)``.
        view: ``(m, d)``.
        ratio: Limit of the quotient of the smallest and the second smallest distance, above 0; a match is
            accepted if its quotient is below.

    Returns:
        Rows of the reference, and the row of the view that matches each of them, in ascending order of the
        distance; empty if the view has fewer than two descriptors, since the ratio test needs a second one.

    Raises:
        BadRequest: The two arrays hold descriptors of different types or lengths.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    if reference.dtype != view.dtype or reference.shape[1:] != view.shape[1:]:
        raise BadRequest(
            f"descriptors of {reference.dtype} x {reference.shape[1:]} and {view.dtype} x {view.shape[1:]} "
            "cannot be compared",
            hint="use features of one kind",
        )
    empty: Rows = np.empty(0, dtype=np.int64)
    if len(reference) == 0 or len(view) < 2:
        return empty, empty
    if not ORB.is_kind_of(reference):
        return _match_by_numpy(reference, view, ratio)
    return match_orb(reference, view, ratio)


def _match_by_numpy(reference: Descriptors, view: Descriptors, ratio: float) -> tuple[Rows, Rows]:
    """Match descriptors of a kind other than ORB, as `best_matches` describes."""
    step = max(1, _BLOCK_DISTANCES // len(view))
    blocks = [_find_two_nearest(reference[row : row + step], view) for row in range(0, len(reference), step)]
    best, second, nearest = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    is_clear = np.flatnonzero(best < ratio * second)
    best_first = is_clear[np.argsort(best[is_clear], kind="stable")]
    _, firsts = np.unique(nearest[best_first], return_index=True)
    chosen = best_first[np.sort(firsts)]
    return chosen, nearest[chosen].astype(np.int64)


def _find_two_nearest(
    reference: Descriptors, view: Descriptors
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return for each reference descriptor the smallest and second smallest distance to *view*, ``(n,)``.

    The third array has the row of *view* at the smallest distance, ``(n,)``.
    """
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
    n, m = len(reference), len(view)
    rows, view_rows = np.empty((2, min(n, m)), dtype=np.int64)
    workspace, flags = _WORKSPACE.words(n + 5 * m + 64), _INSTRUCTION_FLAGS[lanes]
    match = core_function("match", "rse_pf_match", _MATCH_ARGUMENTS, ctypes.c_int64)
    count = match(reference, n, view, m, ratio, flags, workspace, rows, view_rows)
    return rows[:count], view_rows[:count]


def match_all(
    first: Descriptors, second: Descriptors, *, ratio: float = 0.8, max_distance: int = 64
) -> tuple[Rows, Rows]:
    """Match all descriptors of two images by appearance alone, whatever their pixels.

    Args:
        first: ``(n, d)``.
        second: ``(m, d)``.
        ratio: Lowe's ratio test, as in `best_matches`.
        max_distance: Largest Hamming distance of a match of ORB descriptors, of 256 bits; a match with a
            larger one is left out.  The limit is proportional to the length of other binary descriptors, and
            does not apply to vectors.

    Returns:
        Ascending rows of *first*, and the row of *second* that matches each of them.

    Raises:
        BadRequest: The two arrays hold descriptors of different types or lengths.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    rows, second_rows = best_matches(first, second, ratio)
    if first.dtype == np.uint8:
        is_near = (
            distances_of_pairs(first[rows], second[second_rows]) <= max_distance * first.shape[1] // ORB.size
        )
        rows, second_rows = rows[is_near], second_rows[is_near]
    order = np.argsort(rows, kind="stable")
    return rows[order], second_rows[order]


def measure_distinctiveness(
    descriptors: Descriptors, pixels: Array, min_separation_px: float = 6.0
) -> npt.NDArray[np.int32]:
    """Return the distance of each descriptor to the most similar other one of the same image.

    Two features that are closer than *min_separation_px* both in columns and in rows count as the same point,
    and are not compared.

    Args:
        descriptors: ``(n, d)``, uint8 (Hamming distance) or int8 (squared Euclidean distance).
        pixels: ``(n, 2)``.
        min_separation_px: Features are compared if the difference of their columns or of their rows, in
            pixels, is at least this number.

    Returns:
        ``(n,)`` distances; for a feature that is compared with no other one, the bound that `distance_bound`
        returns (256 for ORB).

    Raises:
        BadRequest: Shapes do not fit, or descriptors are neither uint8 nor int8.
        MissingExtra: The descriptors are ORB, and the native core is not installed.
    """
    is_fit = descriptors.ndim == 2 and len(descriptors) == len(pixels) and pixels.shape[1:] == (2,)
    if not is_fit or descriptors.dtype not in _DESCRIPTOR_DTYPES:
        raise BadRequest(
            f"{len(pixels)} features cannot have descriptors of shape {descriptors.shape} and type "
            f"{descriptors.dtype}",
            hint="give one descriptor of uint8 or int8 and two pixel coordinates for each feature",
        )
    if ORB.is_kind_of(descriptors):
        nearest = np.full(len(pixels), distance_bound(descriptors), dtype=np.int32)
        measure = core_function("track", "rse_pf_distinct", _DISTINCT_ARGUMENTS, ctypes.c_int32)
        measure(
            descriptors, pixels.astype(np.float64, copy=False), len(pixels), float(min_separation_px), nearest
        )
        return nearest
    pixels = np.asarray(pixels, dtype=np.float64)
    distances, none = distance_matrix(descriptors, descriptors), distance_bound(descriptors)
    with np.errstate(invalid="ignore", over="ignore"):
        is_apart = (np.abs(pixels[:, None] - pixels[None]) >= min_separation_px).any(axis=2)
    distances[~is_apart | np.eye(len(pixels), dtype=bool)] = none
    most_similar: npt.NDArray[np.int32] = distances.min(axis=1, initial=none).astype(np.int32)
    return most_similar
