"""Define the options of a PnP request, such as the number of RANSAC samples, and the limits of weak poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import msgspec

from rse_pf.errors import BadRequest

__all__ = ["MIN_CORRESPONDENCES", "PnpOptions", "WeakLimits", "require_within"]

MIN_CORRESPONDENCES = 4
"""Fewest correspondences of a pose, fewer are refused: three have up to four poses (P3P), and a fourth one
decides between them."""


def require_within(name: str, value: float, low: float, high: float) -> None:
    """Raise BadRequest unless *value* of the option *name* is in the closed interval from *low* to *high*."""
    if not low <= value <= high:
        raise BadRequest(
            f"{name} = {value:g} is not within {low:g}..{high:g}", hint="leave it out for the default"
        )


class PnpOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of a ``pnp`` command, which a robot may send with it.

    Attributes:
        engine: Name of the solver; None for the server's default.
        inlier_px: Largest reprojection error of an inlier, pixels.
        max_iterations: Most samples that RANSAC draws.
        min_iterations: Fewest samples that RANSAC draws.
        confidence: RANSAC stops before ``max_iterations`` when the probability that at least one of the drawn
            samples had no outlier reaches this value.

    Raises:
        BadRequest: A number is out of its range.
    """

    engine: Literal["native", "opencv"] | None = None
    inlier_px: float = 8.0
    max_iterations: int = 1000
    # A min_iterations above max_iterations counts as max_iterations; the engine ``opencv`` ignores it.
    min_iterations: int = 10
    confidence: float = 0.999

    def __post_init__(self) -> None:
        require_within("inlier_px", self.inlier_px, 1e-3, 100.0)
        require_within("max_iterations", self.max_iterations, 1, 100_000)
        require_within("min_iterations", self.min_iterations, 1, 100_000)
        require_within("confidence", self.confidence, 1e-6, 1.0 - 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakLimits:
    """Limits beyond which a pose is weak instead of ok.

    Attributes:
        inliers: Fewest inliers of a pose that is ok.  The number of its independent inliers, of which those
            close together in the image count once (`rse_pf.pnp.native_solver.Evidence`), must be at least
            half of this limit.
        inlier_ratio: Smallest share of the correspondences that are inliers, 0 to 1.
        translation_m: Largest root of the summed variances of the translation along the three axes, metres.
        rotation_rad: Largest root of the summed variances of the rotation about the three axes, radians.

    The benchmarks call a pose correct if its errors are at most 0.1 m and 2 degrees.  The default limits of
    the standard deviations are a third of these errors, 0.033 m and 0.67 degrees, so that three standard
    deviations of a pose that is ok are at most 0.1 m and 2 degrees.
    """

    inliers: int = 12
    inlier_ratio: float = 0.25
    translation_m: float = 0.1 / 3.0
    rotation_rad: float = math.radians(2.0 / 3.0)
