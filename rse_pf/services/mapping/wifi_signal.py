"""Signal strength of access points over space: a path-loss trend and a Gaussian process of its residuals.

The uncertainty grows with the distance from surveyed positions; the noise is estimated from the survey.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array

Rows = npt.NDArray[np.int64]

__all__ = ["MAX_READINGS", "SignalField", "SignalModel", "fit_signals"]

_MIN_READINGS = 5
_LENGTHS_M = (2.0, 4.0, 8.0, 16.0)
_SHARES = (0.1, 0.3, 0.5, 0.7, 0.85)
"""Candidate shares of the residual variance that are smooth in space; the rest is noise."""
_FLOOR_DBM2 = 1.0
_NEAR_M = 1.0
_PLACES_AT_ONCE = 8192
"""Places whose covariances with all readings are computed at once."""
MAX_READINGS = 400
"""Readings of one access point in the Gaussian process, evenly chosen: its cost is cubic."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SignalField:
    """One access point: trend ``c0 - c1 log10(distance to source)`` and a process of its residuals (dBm)."""

    source: Array
    trend: Array
    places: Array
    residuals: Array
    rows: Rows
    """Survey rows of the readings."""
    weights: Array
    inverse: Array
    signal_dbm2: float
    noise_dbm2: float
    length_m: float

    def predict(self, places: Array) -> tuple[Array, Array]:
        """Return mean (dBm) and variance of a new reading at ``(n, 3)`` places."""
        parts = [
            self._predict(places[begin : begin + _PLACES_AT_ONCE])
            for begin in range(0, len(places), _PLACES_AT_ONCE)
        ]
        return np.concatenate([mean for mean, _ in parts]), np.concatenate([sigma for _, sigma in parts])

    def _predict(self, places: Array) -> tuple[Array, Array]:
        k = _kernel(places, self.places, self.signal_dbm2, self.length_m)
        mean = _trend(places, self.source) @ self.trend + k @ self.weights
        variance = self.signal_dbm2 - ((k @ self.inverse) * k).sum(axis=1)
        return mean, np.maximum(variance, 0.0) + self.noise_dbm2

    def without(self, held_out: Rows) -> SignalField | None:
        """Return the field without the readings at *held_out* survey rows, with the same parameters."""
        kept = ~np.isin(self.rows, held_out)
        if kept.sum() < _MIN_READINGS:
            return None
        kernel = _Kernel(self.signal_dbm2, self.noise_dbm2, self.length_m)
        return _condition(
            self.places[kept], self.residuals[kept], self.rows[kept], self.source, self.trend, kernel
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SignalModel:
    """The fields by access point, and the ``(n, 3)`` surveyed positions in metres."""

    fields: Mapping[str, SignalField]
    places: Array


def fit_signals(
    survey: Sequence[tuple[tuple[float, float, float], Mapping[str, float]]], *, max_fields: int | None = None
) -> SignalModel:
    """Return the model of *survey*: places (metres) with strengths (dBm); deterministic.

    Raises:
        BadRequest: No access point was heard at five places or more.
        LimitExceeded: More than *max_fields* were.

    Source:
        Path loss after Rappaport, Wireless Communications, 4.9; processes after Ferris et al. 2006,
        with parameters of largest marginal likelihood (Rasmussen and Williams 2006, eq. 5.8).
    """
    places = np.array([place for place, _ in survey], dtype=np.float64).reshape(-1, 3)
    readings: dict[str, list[tuple[int, float]]] = {}
    for row, (_, heard) in enumerate(survey):
        for name, dbm in heard.items():
            readings.setdefault(name, []).append((row, dbm))
    heard_often = sum(len(heard) >= _MIN_READINGS for heard in readings.values())
    if max_fields is not None and heard_often > max_fields:
        raise LimitExceeded(
            f"{heard_often} access points are above {max_fields}", hint="send those near the last position"
        )
    fields = {
        name: _fit(places, np.array([row for row, _ in heard]), np.array([dbm for _, dbm in heard]))
        for name, heard in sorted(readings.items())
        if len(heard) >= _MIN_READINGS
    }
    if not fields:
        raise BadRequest(
            f"no access point was heard at {_MIN_READINGS} places of the survey", hint="survey more places"
        )
    return SignalModel(fields=fields, places=places)


def _fit(all_places: Array, rows: Rows, dbm: Array) -> SignalField:
    if len(rows) > MAX_READINGS:
        chosen = np.linspace(0, len(rows) - 1, MAX_READINGS).astype(np.int64)
        rows, dbm = rows[chosen], dbm[chosen]
    places = all_places[rows]
    source = _source(places, dbm)
    columns = _trend(places, source)
    trend = np.linalg.lstsq(columns, dbm, rcond=None)[0].astype(np.float64)
    residuals = dbm - columns @ trend
    total = max(float(residuals.var()), _FLOOR_DBM2) * len(residuals) / max(1, len(residuals) - 4)
    best: tuple[float, float, float] = (-math.inf, 0.0, 0.0)
    for length_m in _LENGTHS_M:
        for share in _SHARES:
            likelihood = _log_likelihood(places, residuals, share * total, (1.0 - share) * total, length_m)
            best = max(best, (likelihood, length_m, share))
    _, length_m, share = best
    noise = max((1.0 - share) * total, _FLOOR_DBM2)
    kernel = _Kernel(share * total, noise, length_m)
    return _condition(places, residuals, rows, source, trend, kernel)


class _Kernel(NamedTuple):
    """The parameters of a Gaussian process: variances of signal and noise, and the length of its kernel."""

    signal_dbm2: float
    noise_dbm2: float
    length_m: float


def _condition(
    places: Array, residuals: Array, rows: Rows, source: Array, trend: Array, kernel: _Kernel
) -> SignalField:
    """Return the field of a process with *kernel* that was read with *residuals* at *places*."""
    signal, noise, length_m = kernel
    covariance = _kernel(places, places, signal, length_m) + noise * np.eye(len(places))
    inverse = np.linalg.inv(covariance).astype(np.float64)
    return SignalField(
        source=source, trend=trend, places=places, residuals=residuals, rows=rows,
        weights=inverse @ residuals, inverse=inverse, signal_dbm2=signal, noise_dbm2=noise, length_m=length_m,
    )  # fmt: skip


def _source(places: Array, dbm: Array) -> Array:
    """Return the estimated position of the access point: the grid point whose trend fits best."""
    low, high = places.min(axis=0) - 5.0, places.max(axis=0) + 5.0
    axes = [np.linspace(low[axis], high[axis], 24) for axis in (0, 1)]
    height = float(places[np.argmax(dbm), 2])
    best, best_error = places[int(np.argmax(dbm))], math.inf
    for x in axes[0]:
        for y in axes[1]:
            trial = np.array([x, y, height])
            log_m = _trend(places, trial)[:, 1]
            slope, offset = _line(log_m, dbm)
            error = float(((dbm - offset - slope * log_m) ** 2).sum())
            if slope < 0 and error < best_error:
                best, best_error = trial, error
    found: Array = best
    return found


def _line(x: Array, y: Array) -> tuple[float, float]:
    mean_x, mean_y = float(x.mean()), float(y.mean())
    spread = float(((x - mean_x) ** 2).sum())
    slope = float(((x - mean_x) * (y - mean_y)).sum()) / max(spread, 1e-12)
    return slope, mean_y - slope * mean_x


def _trend(places: Array, source: Array) -> Array:
    distance = np.sqrt(((places - source) ** 2).sum(axis=1) + _NEAR_M**2)
    return np.column_stack([np.ones(len(places)), np.log10(distance)])


def _kernel(a: Array, b: Array, signal: float, length_m: float) -> Array:
    """Return Matern's covariance of order 3/2; Rasmussen and Williams 2006, eq. 4.17."""
    squared = np.maximum((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T, 0.0)
    scaled = math.sqrt(3.0) * np.sqrt(squared) / length_m
    kernel: Array = signal * (1.0 + scaled) * np.exp(-scaled)
    return kernel


def _log_likelihood(places: Array, residuals: Array, signal: float, noise: float, length_m: float) -> float:
    noise = max(noise, _FLOOR_DBM2)
    factor = np.linalg.cholesky(_kernel(places, places, signal, length_m) + noise * np.eye(len(places)))
    half = np.linalg.solve(factor, residuals)
    return -0.5 * float(half @ half) - float(np.log(np.diag(factor)).sum())
