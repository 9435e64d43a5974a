"""What the check of a drive measures of each frame, in the native core; `client_sdk.check` has it in numpy.

The library is the one that `rse_pf.native` finds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.native import address_of, aligned, load_core, load_part

__all__ = ["CheckCore", "check_core", "open_check"]

_ABI = 1
_P, _I = ctypes.c_void_p, ctypes.c_int64


class CheckCore:
    """The part of one loaded library that a check needs; every thread may call it."""

    def __init__(self, edges: Callable[..., int], depths_at: Callable[..., int]) -> None:
        self._edges, self._depths_at = edges, depths_at

    def edges(
        self, lines: npt.NDArray[np.uint8], strong: int, least_step: int, most: int
    ) -> tuple[int, Array] | None:
        """Return how many strong edges ``(n, w)`` lines have, and the sharpness of at most *most* of them.

        None where the library does not read such lines.
        """
        sharpness = np.empty(most)
        count = self._edges(
            address_of(lines), *lines.shape, *lines.strides, strong, least_step, most, address_of(sharpness)
        )
        if count < 0:
            return None
        every = max(1, -(-count // most))
        return count, sharpness[: -(-count // every)]

    def depths_at(self, depth_m: npt.NDArray[np.float32], pixels: Array, share: float) -> Array | None:
        """Return the ``(n,)`` medians of five depths around pixels; None for an image that is too small."""
        pixels = aligned(pixels, np.float64)
        depths_m = np.empty(len(pixels))
        strides = (stride // depth_m.itemsize for stride in depth_m.strides)
        refused = self._depths_at(
            address_of(depth_m), *depth_m.shape, *strides, address_of(pixels), len(pixels), share,
            address_of(depths_m),
        )  # fmt: skip
        return None if refused else depths_m


def open_check(path: Path) -> CheckCore:
    """Load the library at *path*; raises ConfigurationError as `load_part` says."""
    edges, depths_at = load_part(path, "check", _ABI, "rse_pf_edges", "rse_pf_depths_at")
    edges.argtypes, edges.restype = (_P, *[_I] * 7, _P), _I
    depths_at.argtypes = (_P, *[_I] * 4, _P, _I, ctypes.c_double, _P)
    depths_at.restype = ctypes.c_int32
    return CheckCore(edges, depths_at)


@cache
def check_core() -> CheckCore:
    """Return the image checks of the native core, which is required."""
    return load_core(open_check)
