"""Let causes compete: which faults explain a calibration that was measured, and which it cannot tell apart.

Each cause may have any value while all others are as wrong as those of a good calibration are; causes are
compared by the squared residuals that they leave.  Nothing is adjusted here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from client_sdk.check.findings import FaultKind
from rse_pf.geometry import Array

__all__ = ["Explanation", "Measured", "explain"]

_LEAST_GAIN = 12.0
"""A cause is believed if it takes so much from the sum of squares, in units of the deviations."""
_LEAST_APART = 9.0
"""Two causes are told apart by three deviations: if one takes so much more than the other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """Errors of a calibration, all of them measured together.

    Attributes:
        values: ``(n,)``.
        covariance: ``(n, n)``, of what the drive shows.
        unknown: ``(n,)`` deviations that remain of any drive, since the model lacks something.
        usual: ``(n,)`` standard deviations of the errors of a good calibration.  They are not told from what
            the model lacks, and so do not come on top of it when a cause is judged.
        widest: ``(n,)`` standard deviations of errors that are faults.
        causes: Kinds of faults, and the rows of the errors that are each one's.
    """

    values: Array
    covariance: Array
    unknown: Array
    usual: Array
    widest: Array
    causes: Mapping[FaultKind, tuple[int, ...]]

    def under(self, causes: Iterable[FaultKind]) -> tuple[Array, Array]:
        """Return ``(n,)`` values and their ``(n, n)`` covariance where these causes may have any value."""
        prior = np.diag(self._prior(causes))
        gain = np.linalg.solve(self.covariance + np.diag(self.unknown**2) + prior, prior).T
        values: Array = gain @ self.values
        covariance: Array = prior - gain @ prior
        return values, covariance

    def left(self, causes: Iterable[FaultKind]) -> float:
        """Return the sum of squares that these causes leave."""
        rows = [row for name in causes for row in self.causes[name]]
        spread = np.square(np.maximum(self.usual, self.unknown))
        spread[rows] = np.square(np.hypot(self.widest, self.unknown))[rows]
        whole = self.covariance + np.diag(spread)
        return float(self.values @ np.linalg.solve(whole, self.values))

    def _prior(self, causes: Iterable[FaultKind]) -> Array:
        variances: Array = np.square(self.usual)
        for name in causes:
            rows = list(self.causes[name])
            variances[rows] = np.square(self.widest[rows])
        return variances


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explanation:
    """Causes that explain a measured calibration.

    ``causes`` are in the order of what they explain; ``rivals`` are those that explain nearly as much in the
    place of one of them, and nothing beside it.
    """

    causes: tuple[FaultKind, ...] = ()
    rivals: Mapping[FaultKind, tuple[FaultKind, ...]] = field(default_factory=dict)


def explain(measured: Measured) -> Explanation:
    """Return the fewest causes that explain what was measured."""
    found: list[FaultKind] = []
    rivals: dict[FaultKind, tuple[FaultKind, ...]] = {}
    while True:
        others = [name for name in measured.causes if name not in found]
        left = {name: measured.left([*found, name]) for name in others}
        best = min(left, key=lambda name: left[name], default=None)
        if best is None or measured.left(found) - left[best] < _LEAST_GAIN:
            return Explanation(causes=tuple(found), rivals=rivals)
        # One that still explains something beside the best is a second fault, and no rival.
        rivals[best] = tuple(
            name
            for name in others
            if name != best
            and left[name] - left[best] < _LEAST_APART
            and left[best] - measured.left([*found, best, name]) < _LEAST_GAIN
        )
        found.append(best)
