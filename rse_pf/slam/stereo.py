"""Disparities of features between the two images of a rectified stereo pair.

A feature of the left image is sought along its row of the right one; no pixel in between is matched.  Depths
and their noise follow from the disparities; which of them are used is decided by who tracks.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.native import PART_ABIS, address_of, aligned, core_function
from rse_pf.pnp import DepthNoise

__all__ = ["StereoOptions", "StereoRequest", "disparities", "stereo_noise"]

Gray = npt.NDArray[np.uint8]

_PORTABLE = 1
_BASE_M = 1e-5
"""The least deviation that `DepthNoise` takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoOptions:
    """Which disparities are sought, and which are believed.

    Attributes:
        min_disparity_px: Smaller ones are dropped: their depth is nearly unknown.
        max_disparity_px: Larger ones are not sought; at most 1,024.
        min_likeness: Least squared correlation of the two patches.
        uniqueness: What the best lacks of a likeness of 1 is less than this share of what the second best
            lacks.
        left_right_px: From the right image back to the left one, the best differs by this at most; below 0
            it is not sought.
    """

    min_disparity_px: float = 1.0
    max_disparity_px: int = 128
    min_likeness: float = 0.64
    uniqueness: float = 0.8
    left_right_px: int = 1

    def __post_init__(self) -> None:
        if not (
            0.0 < self.min_disparity_px <= self.max_disparity_px <= 1024
            and 0.0 < self.min_likeness < 1.0
            and 0.0 < self.uniqueness <= 1.0
            and -1 <= self.left_right_px <= 1024
        ):
            raise BadRequest(
                f"{self} cannot be used", hint="leave the options of a stereo pair out to get the defaults"
            )


def stereo_noise(f_baseline: float, disparity_px: float) -> DepthNoise:
    """Return the noise of depths *f_baseline* / d whose disparities d have a deviation of *disparity_px*.

    Args:
        f_baseline: Focal length in pixels times the baseline in metres.
        disparity_px: Pixels.
    """
    return DepthNoise(base_m=_BASE_M, growth_per_m=float(min(1.0, disparity_px / f_baseline)), from_m=0.0)


class StereoRequest(ctypes.Structure):
    """``rse_pf_stereo_request`` of ``rse_pf_stereo.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("width", ctypes.c_int64),
        ("height", ctypes.c_int64), ("left", ctypes.c_void_p), ("right", ctypes.c_void_p),
        ("rows", ctypes.c_int64), ("pixels", ctypes.c_void_p), ("min_disparity_px", ctypes.c_double),
        ("min_likeness", ctypes.c_double), ("uniqueness", ctypes.c_double),
        ("max_disparity_px", ctypes.c_int64), ("left_right_px", ctypes.c_int64),
    )  # fmt: skip


def disparities(
    left: Gray, right: Gray, pixels: Array, options: StereoOptions | None = None, *, portable: bool = False
) -> Array:
    """Return the ``(n,)`` disparities of pixels of the left image, NaN where none is believed.

    The patch of 11x11 pixels around the nearest whole pixel is sought along its row of the right image by its
    squared normalised correlation.  The best must be like enough, unique, and lead back from the right image
    to the left one.  It is refined by least squares in the horizontal direction, with a gain and an offset of
    brightness.

    Args:
        left: ``(h, w)``, the rectified left image.
        right: ``(h, w)``, the right one, whose rows are those of the left.
        pixels: ``(n, 2)``, in the left image.
        options: Limits; None means the defaults.
        portable: Forbid AVX2, which changes no byte of the result.

    Raises:
        BadRequest: Shapes do not fit, or an image is larger than 65,536 px.
        MissingExtra: The native core is not installed.

    Source:
        Refinement after Lucas and Kanade, IJCAI 1981, in the inverse form of Baker and Matthews, IJCV 2004,
        Sect. 3.2; the check from right to left after Fua, MVA 1993.
    """
    options = options or StereoOptions()
    is_image = left.ndim == 2 and left.shape == right.shape and left.dtype == right.dtype == np.uint8
    if not is_image or pixels.ndim != 2 or pixels.shape[1] != 2:
        raise BadRequest(
            f"images {left.shape} and {right.shape} and pixels {pixels.shape} do not fit",
            hint="give two grey images of one size, and two numbers for each pixel",
        )
    left, right, pixels = aligned(left), aligned(right), aligned(pixels, np.float64)
    found = np.empty(len(pixels))
    height, width = left.shape
    request = StereoRequest(
        PART_ABIS["stereo"], _PORTABLE if portable else 0, width, height, address_of(left), address_of(right),
        len(pixels), address_of(pixels), options.min_disparity_px, options.min_likeness, options.uniqueness,
        options.max_disparity_px, options.left_right_px,
    )  # fmt: skip
    if _function()(ctypes.byref(request), address_of(found)):
        raise BadRequest(
            f"a stereo pair of {width}x{height} px cannot be matched", hint="send smaller images"
        )
    return found


@cache
def _function() -> Any:
    pointer = ctypes.c_void_p
    return core_function("stereo", "rse_pf_disparities", (pointer, pointer), ctypes.c_int32)
