"""Model the signal strength of Wi-Fi access points: a path-loss trend, and a Gaussian process of residuals.

The predicted variance grows with the distance from surveyed positions; the variance of the noise of a reading
is estimated from the survey.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array

Rows = npt.NDArray[np.int64]

__all__ = ["MAX_READINGS", "SignalField", "SignalModel", "fit_signals"]

_MIN_READINGS = 5
"""Fewest readings of an access point with a signal field; one with fewer readings is ignored.  The number is
one more than the unknowns of the mean: two of the horizontal position, and two of the trend."""
_LENGTHS_M = (2.0, 4.0, 8.0, 16.0)
"""Candidate correlation lengths of the Gaussian process, metres: from a room to a hall."""
_SMOOTH_SHARES = (0.1, 0.3, 0.5, 0.7, 0.85)
"""Candidates for the share of the variance of the residuals that is explained by the Gaussian process, a
smooth function of the position.  The rest of the variance is independent noise of each reading."""
_MIN_VARIANCE_DBM2 = 1.0
"""Smallest variance of the noise (dBm^2), to which smaller ones are raised, so that no reading counts as
exact."""
_NEAR_M = 1.0
"""Length n in metres with which each distance d from an access point becomes sqrt(d^2 + n^2), since log10 of
0 is not finite."""
_BATCH = 8192
"""Positions whose covariances with all readings are computed at once, which bounds the memory."""
MAX_READINGS = 400
"""Most readings of an access point to which its trend and process are fitted, since time grows with their
cube; of more readings, this number is chosen evenly in the order of the survey."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SignalField:
    """The signal strength of one access point over space.

    Its mean is the trend ``c0 + c1 log10(distance to the access point in metres)`` plus a Gaussian process of
    the residuals.

    Attributes:
        source: ``(3,)``, estimated position of the access point, metres; its height is that of the strongest
            reading.
        trend: ``(2,)``, c0 in dBm and c1 in dBm per decade.
        positions: ``(r, 3)``, positions of the readings, metres.
        residuals: ``(r,)``, readings minus trend, dBm.
        rows: ``(r,)``, rows of the survey that the readings are from.
        weights: ``(r,)``, inverse covariance times residuals, 1/dBm.
        inverse: ``(r, r)``, inverse covariance of the readings, 1/dBm^2.
        signal_dbm2: Prior variance of the process, without any reading.
        noise_dbm2: Variance of the noise of a reading.
        length_m: Correlation length of the process.
    """

    source: Array
    trend: Array
    positions: Array
    residuals: Array
    rows: Rows
    weights: Array
    inverse: Array
    signal_dbm2: float
    noise_dbm2: float
    length_m: float

    def predict(self, positions: Array) -> tuple[Array, Array]:
        """Return ``(n,)`` means (dBm) and variances (dBm^2) of readings at ``(n, 3)`` positions (metres).

        The variances include the noise of a reading.
        """
        parts = [
            self._predict(positions[begin : begin + _BATCH]) for begin in range(0, len(positions), _BATCH)
        ]
        means, variances = [mean for mean, _ in parts], [variance for _, variance in parts]
        return np.concatenate(means), np.concatenate(variances)

    def _predict(self, positions: Array) -> tuple[Array, Array]:
        k = _kernel(positions, self.positions, self.signal_dbm2, self.length_m)
        mean = _trend(positions, self.source) @ self.trend + k @ self.weights
        variance = self.signal_dbm2 - ((k @ self.inverse) * k).sum(axis=1)
        return mean, np.maximum(variance, 0.0) + self.noise_dbm2

    def without(self, held_out: Rows) -> SignalField | None:
        """Return the field without the readings of the *held_out* survey rows; None if under five are left.

        Position, trend and parameters of the process stay those that were fitted to all readings.
        """
        remains = ~np.isin(self.rows, held_out)
        if remains.sum() < _MIN_READINGS:
            return None
        return _condition(
            self.positions[remains],
            self.residuals[remains],
            self.rows[remains],
            self.source,
            self.trend,
            signal_dbm2=self.signal_dbm2,
            noise_dbm2=self.noise_dbm2,
            length_m=self.length_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SignalModel:
    """The signal field of each access point by its name, and all ``(n, 3)`` surveyed positions in metres."""

    fields: Mapping[str, SignalField]
    positions: Array


def fit_signals(
    survey: Sequence[tuple[tuple[float, float, float], Mapping[str, float]]], *, max_fields: int | None = None
) -> SignalModel:
    """Fit the signal fields of all access points of a survey; equal surveys give equal models.

    Access points that were received at fewer than five positions get no field.

    Args:
        survey: For each surveyed position (metres) the received strengths (dBm) by access point.
        max_fields: Most access points with a field; None for any number.

    Raises:
        BadRequest: No access point was received at five positions or more.
        LimitExceeded: More than *max_fields* access points were received at five positions or more.

    Source:
        Path loss after Rappaport, Wireless Communications, 4.9; Gaussian processes after Ferris et al. 2006,
        with the parameters of largest marginal likelihood (Rasmussen and Williams 2006, eq. 5.8).
    """
    positions = np.array([place for place, _ in survey], dtype=np.float64).reshape(-1, 3)
    readings: dict[str, list[tuple[int, float]]] = {}
    for row, (_, received) in enumerate(survey):
        for name, dbm in received.items():
            readings.setdefault(name, []).append((row, dbm))
    access_points = sum(len(received) >= _MIN_READINGS for received in readings.values())
    if max_fields is not None and access_points > max_fields:
        raise LimitExceeded(
            f"{access_points} access points are above {max_fields}", hint="send those near the last position"
        )
    fields = {
        name: _fit(positions, np.array([row for row, _ in received]), np.array([dbm for _, dbm in received]))
        for name, received in sorted(readings.items())
        if len(received) >= _MIN_READINGS
    }
    if not fields:
        raise BadRequest(
            f"no access point was received at {_MIN_READINGS} positions of the survey",
            hint="survey more positions",
        )
    return SignalModel(fields=fields, positions=positions)


def _fit(all_positions: Array, rows: Rows, dbm: Array) -> SignalField:
    if len(rows) > MAX_READINGS:
        chosen = np.linspace(0, len(rows) - 1, MAX_READINGS).astype(np.int64)
        rows, dbm = rows[chosen], dbm[chosen]
    # 1. Estimate the position of the access point, and fit the trend over the distance from it by least
    # squares.
    positions = all_positions[rows]
    source = _estimate_source(positions, dbm)
    columns = _trend(positions, source)
    trend = np.linalg.lstsq(columns, dbm, rcond=None)[0].astype(np.float64)
    residuals = dbm - columns @ trend
    total = max(float(residuals.var()), _MIN_VARIANCE_DBM2) * len(residuals) / max(1, len(residuals) - 4)
    # 2. Choose the correlation length and the share of smooth variance with which the residuals have the
    # largest marginal likelihood.
    best: tuple[float, float, float] = (-math.inf, 0.0, 0.0)
    for length_m in _LENGTHS_M:
        for share in _SMOOTH_SHARES:
            likelihood = _log_likelihood(positions, residuals, share * total, (1.0 - share) * total, length_m)
            best = max(best, (likelihood, length_m, share))
    _, length_m, share = best
    return _condition(
        positions,
        residuals,
        rows,
        source,
        trend,
        signal_dbm2=share * total,
        noise_dbm2=max((1.0 - share) * total, _MIN_VARIANCE_DBM2),
        length_m=length_m,
    )


def _condition(
    positions: Array,
    residuals: Array,
    rows: Rows,
    source: Array,
    trend: Array,
    *,
    signal_dbm2: float,
    noise_dbm2: float,
    length_m: float,
) -> SignalField:
    """Return the field of a Gaussian process, given its *residuals* at *positions* ``(r, 3)``.

    The arguments are attributes of the field.
    """
    covariance = _kernel(positions, positions, signal_dbm2, length_m) + noise_dbm2 * np.eye(len(positions))
    inverse = np.linalg.inv(covariance).astype(np.float64)
    return SignalField(
        source=source,
        trend=trend,
        positions=positions,
        residuals=residuals,
        rows=rows,
        weights=inverse @ residuals,
        inverse=inverse,
        signal_dbm2=signal_dbm2,
        noise_dbm2=noise_dbm2,
        length_m=length_m,
    )


def _estimate_source(positions: Array, dbm: Array) -> Array:
    """Return the ``(3,)`` position of an access point: the grid point whose path-loss trend fits *dbm* best.

    The grid has 24 x 24 points at the height of the strongest reading, up to 5 m beyond the *positions*
    ``(n, 3)`` of the readings.  If the strength falls with the distance from no grid point, the result is the
    position of the strongest reading.
    """
    low, high = positions.min(axis=0) - 5.0, positions.max(axis=0) + 5.0
    axes = [np.linspace(low[axis], high[axis], 24) for axis in (0, 1)]
    height = float(positions[np.argmax(dbm), 2])
    best, best_error = positions[int(np.argmax(dbm))], math.inf
    for x in axes[0]:
        for y in axes[1]:
            candidate = np.array([x, y, height])
            log_m = _trend(positions, candidate)[:, 1]
            slope, offset = _fit_line(log_m, dbm)
            error = float(((dbm - offset - slope * log_m) ** 2).sum())
            if slope < 0 and error < best_error:
                best, best_error = candidate, error
    source: Array = best
    return source


def _fit_line(x: Array, y: Array) -> tuple[float, float]:
    """Return slope and offset of the line through points that has the least squared errors in y."""
    mean_x, mean_y = float(x.mean()), float(y.mean())
    spread = float(((x - mean_x) ** 2).sum())
    slope = float(((x - mean_x) * (y - mean_y)).sum()) / max(spread, 1e-12)
    return slope, mean_y - slope * mean_x


def _trend(positions: Array, source: Array) -> Array:
    """Return the ``(n, 2)`` design matrix of the trend: ones, and log10 of the distances to *source*.

    A distance d (metres) counts as ``sqrt(d**2 + _NEAR_M**2)``.
    """
    distance = np.sqrt(((positions - source) ** 2).sum(axis=1) + _NEAR_M**2)
    return np.column_stack([np.ones(len(positions)), np.log10(distance)])


def _kernel(a: Array, b: Array, signal: float, length_m: float) -> Array:
    """Return the Matern covariance of order 3/2 of two sets of positions; Rasmussen and Williams, eq. 4.17.

    Args:
        a: ``(n, 3)`` metres.
        b: ``(m, 3)`` metres.
        signal: Variance at distance 0, dBm^2.
        length_m: Correlation length.

    Returns:
        ``(n, m)``, dBm^2.
    """
    squared = np.maximum((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T, 0.0)
    scaled = math.sqrt(3.0) * np.sqrt(squared) / length_m
    kernel: Array = signal * (1.0 + scaled) * np.exp(-scaled)
    return kernel


def _log_likelihood(
    positions: Array, residuals: Array, signal: float, noise: float, length_m: float
) -> float:
    """Return the log marginal likelihood of *residuals* without its constant term.

    The variance *noise* is raised to `_MIN_VARIANCE_DBM2` if it is smaller.

    Source:
        Rasmussen and Williams 2006, eq. 5.8.
    """
    noise = max(noise, _MIN_VARIANCE_DBM2)
    factor = np.linalg.cholesky(
        _kernel(positions, positions, signal, length_m) + noise * np.eye(len(positions))
    )
    half = np.linalg.solve(factor, residuals)
    return -0.5 * float(half @ half) - float(np.log(np.diag(factor)).sum())
