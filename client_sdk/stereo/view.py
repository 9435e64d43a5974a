"""The right image of a rectified stereo pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import UsageError

__all__ = ["StereoView"]

_LEAST_BASELINE_M, _MOST_BASELINE_M = 0.001, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class StereoView:
    """The rectified right image beside a frame's left one: ``(h, w)`` uint8, and the baseline in metres.

    Both images have the frame's camera: the point at depth *z* of left pixel ``(u, v)`` is seen at
    ``(u - fx * baseline_m / z, v)`` here.

    Raises:
        UsageError: The image is not grey, or the baseline is not within 1 mm to 10 m.
    """

    gray: npt.NDArray[np.uint8]
    baseline_m: float

    def __post_init__(self) -> None:
        if self.gray.ndim != 2 or self.gray.dtype != np.uint8:
            raise UsageError(
                f"a right image of shape {self.gray.shape} and type {self.gray.dtype} cannot be used",
                hint="give a rectified grey image of one byte a pixel",
            )
        if not _LEAST_BASELINE_M <= self.baseline_m <= _MOST_BASELINE_M:
            raise UsageError(
                f"a baseline of {self.baseline_m:g} m is not within {_LEAST_BASELINE_M:g} to "
                f"{_MOST_BASELINE_M:g} m",
                hint="give it in metres, from the left camera to the right one",
            )
