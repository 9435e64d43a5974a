"""Disparities of features between the two images of a rectified stereo pair, and the noise of their depths.

A feature of the left image is searched along its row of the right image; pixels between features are not
matched. The caller computes depths from disparities, and decides which of them are used.
"""

from __future__ import annotations

import ctypes
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.native import PART_ABIS, address_of, aligned, core_function
from rse_pf.pnp import DepthNoise

__all__ = ["StereoOptions", "StereoRequest", "disparities", "stereo_noise"]

Gray = npt.NDArray[np.uint8]

_PORTABLE_FLAG = 1
"""Flag of the native core's ``rse_pf_disparities`` that forbids AVX2."""
_BASE_NOISE_M = 1e-5
"""Constant part of the standard deviation of a stereo depth, in metres.  The standard deviation is
proportional to the square of the depth, so that this part should be 0; it is the smallest that `DepthNoise`
accepts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoOptions:
    """Which disparities of a stereo pair are searched, and which are accepted.

    Attributes:
        min_disparity_px: Smallest accepted disparity, above 0: the depths of smaller ones are nearly unknown.
        max_disparity_px: Largest searched disparity, at most 1,024.
        min_likeness: Smallest accepted likeness: the squared normalised correlation of the two patches.
        uniqueness: Limit of the ratio test, in which the distance of two patches is 1 minus their likeness:
            the smallest distance must be below this factor times the second smallest one.
        left_right_px: Largest difference between the disparities of the search from left to right and of the
            search back from right to left; with -1 there is no search back.

    Raises:
        BadRequest: A number is out of its range.
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
    """Return the noise model of depths ``f_baseline / d`` by the noise of their disparities ``d``.

    The standard deviation of a depth z is ``1e-5 m + growth * z^2``.  The growth is ``disparity_px /
    f_baseline`` (1/m), but at most 1, the largest that `DepthNoise` accepts.

    Args:
        f_baseline: Focal length in pixels times the baseline in metres.
        disparity_px: Standard deviation of a disparity, in pixels.
    """
    return DepthNoise(
        base_m=_BASE_NOISE_M, growth_per_m=float(min(1.0, disparity_px / f_baseline)), from_m=0.0
    )


class StereoRequest(ctypes.Structure):
    """The C struct ``rse_pf_stereo_request`` of ``rse_pf_stereo.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("width", ctypes.c_int64),
        ("height", ctypes.c_int64),
        ("left", ctypes.c_void_p),
        ("right", ctypes.c_void_p),
        ("rows", ctypes.c_int64),
        ("pixels", ctypes.c_void_p),
        ("min_disparity_px", ctypes.c_double),
        ("min_likeness", ctypes.c_double),
        ("uniqueness", ctypes.c_double),
        ("max_disparity_px", ctypes.c_int64),
        ("left_right_px", ctypes.c_int64),
    )


def disparities(
    left: Gray, right: Gray, pixels: Array, options: StereoOptions | None = None, *, portable: bool = False
) -> Array:
    """Measure the disparities of pixels of the left image: their column minus that in the right image.

    The patch of 11x11 pixels around the nearest whole pixel is compared with those along its row of the right
    image by the squared normalised correlation.  The best must be similar enough, unique, and found again
    from the right image to the left one.  It is refined to a fraction of a pixel by least squares in the
    horizontal direction, with a gain and an offset of brightness.

    Args:
        left: ``(h, w)``, the rectified left image.
        right: ``(h, w)``, the rectified right image, whose rows are those of the left.
        pixels: ``(n, 2)``, column and row in the left image.
        options: Limits; None for the defaults.
        portable: Forbid AVX2, which changes no byte of the result.

    Returns:
        ``(n,)`` pixels; NaN where no disparity is accepted.

    Raises:
        BadRequest: Shapes do not fit, or a side of the images is above 65,536 px.
        MissingExtra: The native core is not installed.

    Source:
        Refinement after Lucas and Kanade, IJCAI 1981, in the inverse form of Baker and Matthews, IJCV 2004,
        Sect. 3.2; the check from right to left after Fua, MVA 1993.
    """
    options = options or StereoOptions()
    is_image = left.ndim == 2 and left.shape == right.shape and left.dtype == right.dtype == np.uint8
    if not is_image or pixels.ndim != 2 or pixels.shape[1] != 2:
        raise BadRequest(
            f"a left image {left.shape} of {left.dtype}, a right image {right.shape} of {right.dtype} and "
            f"pixels {pixels.shape} do not fit together",
            hint="give two grey images of uint8 and of one size, and two numbers for each pixel",
        )
    left, right, pixels = aligned(left), aligned(right), aligned(pixels, np.float64)
    disparities_px = np.empty(len(pixels))
    height, width = left.shape
    request = StereoRequest(
        abi=PART_ABIS["stereo"],
        flags=_PORTABLE_FLAG if portable else 0,
        width=width,
        height=height,
        left=address_of(left),
        right=address_of(right),
        rows=len(pixels),
        pixels=address_of(pixels),
        **asdict(options),
    )
    measure = core_function("stereo", "rse_pf_disparities", (ctypes.c_void_p,) * 2, ctypes.c_int32)
    if measure(ctypes.byref(request), address_of(disparities_px)):
        raise BadRequest(
            f"a stereo pair of {width}x{height} px cannot be matched: a side is above 65536 px",
            hint="give smaller images",
        )
    return disparities_px
