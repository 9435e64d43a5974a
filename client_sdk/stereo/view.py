"""The right image of a rectified stereo pair, with the baseline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import UsageError

__all__ = ["StereoView"]

_MIN_BASELINE_M = 0.001
"""Smallest baseline of a stereo pair, in metres: a smaller one is most likely of another unit."""
_MAX_BASELINE_M = 10.0
"""Largest baseline of a stereo pair, in metres: a larger one is most likely of another unit."""


@dataclass(frozen=True, slots=True, eq=False)
class StereoView:
    """The rectified right image of a stereo pair, whose left image is that of the frame.

    Both images have the frame's camera.  A point at depth *z* that the left image shows at pixel ``(u, v)``
    is shown at ``(u - fx * baseline_m / z, v)`` by the right image.

    Attributes:
        gray: ``(h, w)`` uint8.
        baseline_m: Distance of the two cameras, in metres.

    Raises:
        UsageError: The image is not grey, or the baseline is not within 1 mm to 10 m.
    """

    gray: npt.NDArray[np.uint8]
    baseline_m: float

    def __post_init__(self) -> None:
        if self.gray.ndim != 2 or self.gray.dtype != np.uint8:
            raise UsageError(
                f"a right image of shape {self.gray.shape} and type {self.gray.dtype} is not (h, w) of uint8",
                hint="give a rectified grey image of one byte a pixel",
            )
        if not _MIN_BASELINE_M <= self.baseline_m <= _MAX_BASELINE_M:
            raise UsageError(
                f"a baseline of {self.baseline_m:g} m is not within {_MIN_BASELINE_M:g} to "
                f"{_MAX_BASELINE_M:g} m",
                hint="give the distance of the two cameras in metres",
            )
