"""Select the faults that explain the estimated errors of a calibration, and those that explain them equally.

This is a forward selection among Gaussian priors: an error that belongs to a selected fault has the wide
prior of a fault, every other error the narrow prior of a good calibration.  Faults are compared by the
squared Mahalanobis distance of the estimated errors from 0 under these priors.  Nothing is adjusted here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from client_sdk.check.findings import FaultKind
from rse_pf.geometry import Array

__all__ = ["Explanation", "Measured", "explain"]

_MIN_GAIN = 12.0
"""A fault is selected if it lowers the squared Mahalanobis distance by at least this much: 3.5 standard
deviations, squared."""
_MIN_DIFFERENCE = 9.0
"""A fault whose squared Mahalanobis distance exceeds that of the best one by less than this (three standard
deviations, squared) is its rival: the estimate does not distinguish them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """Errors of a calibration that were estimated together, with the priors of their true values.

    Attributes:
        values: ``(n,)``, the estimated errors.
        covariance: ``(n, n)`` of the estimate.
        unknown: ``(n,)``, standard deviations of effects that the model of the estimate leaves out; they
            remain in every drive.
        usual: ``(n,)``, standard deviations of the errors of a good calibration.  They cannot be separated
            from *unknown*: `left` takes the larger of both, not their sum.
        widest: ``(n,)``, standard deviations of errors that are faults.
        causes: The faults that may explain the errors, each with the indices of its errors.
    """

    values: Array
    covariance: Array
    unknown: Array
    usual: Array
    widest: Array
    causes: Mapping[FaultKind, tuple[int, ...]]

    def under(self, causes: Iterable[FaultKind]) -> tuple[Array, Array]:
        """Return errors ``(n,)`` and their covariance ``(n, n)`` a posteriori, if *causes* are the faults.

        The errors of *causes* have the prior *widest*, all others the prior *usual*.
        """
        prior = np.diag(self._prior(causes))
        gain = np.linalg.solve(self.covariance + np.diag(self.unknown**2) + prior, prior).T
        values: Array = gain @ self.values
        covariance: Array = prior - gain @ prior
        return values, covariance

    def left(self, causes: Iterable[FaultKind]) -> float:
        """Return the squared Mahalanobis distance of the values from 0, if *causes* are the faults."""
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
    """The faults that explain the estimated errors of a calibration.

    ``causes`` are the selected faults; the fault that explains most is the first.  ``rivals`` maps each
    selected fault to the faults that explain nearly as much in its place, and nothing in addition to it.
    """

    causes: tuple[FaultKind, ...] = ()
    rivals: Mapping[FaultKind, tuple[FaultKind, ...]] = field(default_factory=dict)


def explain(measured: Measured) -> Explanation:
    """Select faults greedily, until no other lowers the squared Mahalanobis distance by `_MIN_GAIN`."""
    found: list[FaultKind] = []
    rivals: dict[FaultKind, tuple[FaultKind, ...]] = {}
    while True:
        others = [name for name in measured.causes if name not in found]
        left = {name: measured.left([*found, name]) for name in others}
        best = min(left, key=lambda name: left[name], default=None)
        if best is None or measured.left(found) - left[best] < _MIN_GAIN:
            return Explanation(causes=tuple(found), rivals=rivals)
        # A fault that explains errors in addition to the best fault is a second fault, not a rival.
        rivals[best] = tuple(
            name
            for name in others
            if name != best
            and left[name] - left[best] < _MIN_DIFFERENCE
            and left[best] - measured.left([*found, best, name]) < _MIN_GAIN
        )
        found.append(best)
