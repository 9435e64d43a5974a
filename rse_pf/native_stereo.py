"""Disparities of a rectified stereo pair in the native core.

The library is the one that `rse_pf.native` finds.  `rse_pf.slam.stereo` has the same in numpy.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.native import address_of, aligned, load_core, load_part

__all__ = ["StereoCore", "StereoRequest", "open_stereo", "stereo_core"]

_ABI, _PORTABLE = 1, 1
_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class StereoRequest(ctypes.Structure):
    """``rse_pf_stereo_request`` of ``rse_pf_stereo.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("width", _I), ("height", _I), ("left", _P),
        ("right", _P), ("rows", _I), ("pixels", _P), ("min_disparity_px", _D), ("min_likeness", _D),
        ("uniqueness", _D), ("max_disparity_px", _I), ("left_right_px", _I),
    )  # fmt: skip


class StereoCore:
    """The stereo part of one loaded library; every thread may call it.

    ``portable`` forbids AVX2, which changes no byte of the result.
    """

    def __init__(self, disparities: Callable[..., int], *, portable: bool = False) -> None:
        self._disparities = disparities
        self._flags = _PORTABLE if portable else 0

    def disparities(
        self,
        left: npt.NDArray[np.uint8],
        right: npt.NDArray[np.uint8],
        pixels: Array,
        limits: tuple[float, float, float],
        most_px: int,
        left_right_px: int,
    ) -> Array:
        """Return the ``(n,)`` disparities of pixels as `rse_pf.slam.stereo`, which has checked the shapes.

        Args:
            left: ``(h, w)``.
            right: ``(h, w)``.
            pixels: ``(n, 2)``.
            limits: Least disparity, least likeness, uniqueness.
            most_px: The largest disparity that is sought.
            left_right_px: Tolerance of the check from right to left.

        Raises:
            BadRequest: An image is larger than 65,536 px, or a limit means nothing.
        """
        left, right, pixels = aligned(left), aligned(right), aligned(pixels, np.float64)
        found = np.empty(len(pixels))
        height, width = left.shape
        request = StereoRequest(
            _ABI, self._flags, width, height, address_of(left), address_of(right), len(pixels),
            address_of(pixels), *limits, most_px, left_right_px,
        )  # fmt: skip
        if self._disparities(ctypes.byref(request), address_of(found)):
            raise BadRequest(
                f"a stereo pair of {width}x{height} px cannot be matched", hint="send smaller images"
            )
        return found


def open_stereo(path: Path, *, portable: bool = False) -> StereoCore:
    """Load the library at *path*; *portable* forbids AVX2; raises ConfigurationError as `load_part` says."""
    (disparities,) = load_part(path, "stereo", _ABI, "rse_pf_disparities")
    disparities.argtypes, disparities.restype = (_P, _P), ctypes.c_int32
    return StereoCore(disparities, portable=portable)


@cache
def stereo_core() -> StereoCore:
    """Return the stereo matcher of the native core, which is required."""
    return load_core(open_stereo)
