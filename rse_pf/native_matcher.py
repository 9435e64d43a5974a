"""Matches of binary descriptors in the native core: points of one view, seen in another.

The library is the one that `rse_pf.native` finds.  Who finds none matches in another way.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.native import address_of, aligned, load_core, load_part

__all__ = ["MATCH_ABI", "Lanes", "MatchCore", "Workspace", "match_core", "open_matcher"]

MATCH_ABI = 3
"""Of the library's part ``match``."""
_FLAGS = {"portable": 1, "avx2": 2, "avx512": 0}
_BYTES = 32

Lanes = Literal["portable", "avx2", "avx512"]


class Workspace(threading.local):
    """What a thread lends to the library, so that a call allocates no more than its results."""

    _words = np.empty(0, dtype=np.uint64)

    def words(self, count: int) -> npt.NDArray[np.uint64]:
        """Return *count* numbers and more, whose values mean nothing."""
        if len(self._words) < count:
            self._words = np.empty(count, dtype=np.uint64)
        return self._words


class MatchCore:
    """The matcher of one loaded library; every thread may call it.

    ``lanes`` are the widest instructions it may use, which changes no byte of the results.
    """

    def __init__(self, matches: Callable[..., int], lanes: Lanes) -> None:
        self._matches = matches
        self._workspace = Workspace()
        self._flags = _FLAGS[lanes]

    def matches(
        self,
        reference: npt.NDArray[np.uint8],
        points_camera: Array,
        descriptors: npt.NDArray[np.uint8],
        pixels: Array,
        frame_points: Array,
        *,
        ratio: float,
        max_matches: int,
    ) -> tuple[Array, Array, Array] | None:
        """Match the points of a reference view to the pixels of a frame.

        Args:
            reference: ``(n, 32)``, the descriptors of the reference view.
            points_camera: ``(n, 3)`` metres; a point whose third coordinate is not finite is not matched.
            descriptors: ``(m, 32)``, those of the frame.
            pixels: ``(m, 2)``.
            frame_points: ``(m, 3)`` metres, the points that the frame shows at *pixels*.
            ratio: The nearest descriptor must be this much nearer than the second nearest.
            max_matches: The nearest are kept.

        Returns:
            Points, pixels, and depths of the pixels (0 where they are not finite), from left to right in the
            frame, rounded as they are sent; None where the arrays are not uint8 and float64 of these shapes.
        """
        n, m = len(reference), len(descriptors)
        if not (
            _is(reference, np.uint8, 2) and _is(descriptors, np.uint8, 2)
            and reference.shape == (n, _BYTES) and descriptors.shape == (m, _BYTES)
            and _is(points_camera, np.float64, 2) and points_camera.shape == (n, 3)
            and _is(pixels, np.float64, 2) and pixels.shape == (m, 2)
            and _is(frame_points, np.float64, 2) and frame_points.shape == (m, 3)
        ):  # fmt: skip
            return None
        reference, points_camera = aligned(reference), aligned(points_camera)
        descriptors, pixels = aligned(descriptors), aligned(pixels)
        frame_points = aligned(frame_points)
        room = min(n, m, max(max_matches, 0))
        points_world, matched, depths_m = np.empty((room, 3)), np.empty((room, 2)), np.empty(room)
        workspace = self._workspace.words(3 * n + 5 * m + 64)
        count = self._matches(
            address_of(reference), address_of(points_camera), n, address_of(descriptors), address_of(pixels),
            address_of(frame_points), m, ratio, room, self._flags, address_of(workspace),
            address_of(points_world), address_of(matched), address_of(depths_m),
        )  # fmt: skip
        return None if count < 0 else (points_world[:count], matched[:count], depths_m[:count])


def _is(array: npt.NDArray[Any], kind: type, dimensions: int) -> bool:
    return array.dtype == kind and array.ndim == dimensions


def open_matcher(path: Path, lanes: Lanes = "avx512") -> MatchCore:
    """Load the library at *path*; *lanes* are the widest instructions it may use.

    Raises:
        ConfigurationError: As `load_part` says.
    """
    (matches,) = load_part(path, "match", MATCH_ABI, "rse_pf_match")
    pointer, size = ctypes.c_void_p, ctypes.c_int64
    matches.argtypes = (
        pointer, pointer, size, *[pointer] * 3, size, ctypes.c_double, size, ctypes.c_uint32, *[pointer] * 4
    )  # fmt: skip
    matches.restype = size
    return MatchCore(matches, lanes)


@cache
def match_core() -> MatchCore:
    """Return the matcher of the native core, which is required."""
    return load_core(open_matcher)
