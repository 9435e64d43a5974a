"""Options of a PnP request, such as the iterations of RANSAC, and the limits below which a pose is weak."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import msgspec

from rse_pf.errors import BadRequest

__all__ = ["PnpOptions", "WeakLimits"]


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise BadRequest(
            f"{name} = {value:g} is not within {low:g}..{high:g}", hint="leave it out for the default"
        )


class PnpOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to solve; it travels with a command.

    Raises:
        BadRequest: A number is out of its range.
    """

    engine: Literal["native", "opencv"] | None = None
    inlier_px: float = 8.0
    max_iterations: int = 1000
    min_iterations: int = 10
    confidence: float = 0.999

    def __post_init__(self) -> None:
        _within("inlier_px", self.inlier_px, 1e-3, 100.0)
        _within("max_iterations", self.max_iterations, 1, 100_000)
        _within("min_iterations", self.min_iterations, 1, 100_000)
        _within("confidence", self.confidence, 1e-6, 1.0 - 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakLimits:
    """Limits below which a pose is weak: inliers, inlier ratio; above which: standard deviations.

    Fewer independent inliers than half of *inliers* are weak, too.  Three standard deviations are 0.1 m
    and 2 degrees, which the benchmarks use as the limit of a correct pose.
    """

    inliers: int = 12
    inlier_ratio: float = 0.25
    translation_m: float = 0.1 / 3.0
    rotation_rad: float = math.radians(2.0 / 3.0)
