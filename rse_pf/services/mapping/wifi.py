"""The wifi service: from a scan of access points and a survey to a position with its uncertainty.

No hardware address leaves the robot: identifiers are keyed hashes that `fingerprint_of` computes there, and
networks whose owner opted out by ``_nomap`` are left out.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import msgspec
import numpy as np

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array
from rse_pf.service import Registry
from rse_pf.services.mapping.wifi_signal import MAX_READINGS, SignalModel, fit_signals

__all__ = [
    "AccessPointReading",
    "Fingerprint",
    "Locator",
    "WifiOptions",
    "WifiReply",
    "WifiRequest",
    "fingerprint_of",
    "register",
]  # fmt: skip

_OPTED_OUT = "_nomap"
_MAC = re.compile(r"^(?:[0-9a-fA-F]{2}[:\-.]?){5}[0-9a-fA-F]{2}$")
_MIN_DBM, _MAX_DBM = -120.0, 0.0
_ONE_SIGMA = 0.68
_TEMPERS = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
_DEFAULT_TEMPER = 0.4
"""The exponent where a survey is too small to calibrate it."""
_MIN_HELD_OUT = 30
_FOLDS = 5
_CALIBRATION_GRID_M = 0.5

Survey = tuple[tuple[float, float, float], Mapping[str, float]]
MAX_FINGERPRINTS = 5000
"""Of one request."""
_MAX_FLOORS, _MAX_ACCESS_POINTS = 100, 300
_MAX_POSTERIORS, _MAX_PREDICTIONS = 5_000_000, 100_000_000
"""Grid points times positions, and times the readings of all access points: five seconds of work each."""
_DISTANCES_AT_ONCE = 1_000_000


class AccessPointReading(msgspec.Struct, frozen=True, kw_only=True):
    """One access point as a robot's radio hears it; it stays on the robot."""

    mac: str
    ssid: str
    rssi_dbm: float


class Fingerprint(msgspec.Struct, frozen=True, kw_only=True):
    """Strengths in dBm by hashed access point; *position* is ``(x, y, z)`` in metres, map frame."""

    rssi_dbm: dict[str, float]
    position: tuple[float, float, float] | None = None


class WifiOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to locate: the grid's pitch, how far from the survey to look, how many points to hear."""

    grid_m: float = 0.5
    reach_m: float = 3.0
    min_common: int = 3

    def __post_init__(self) -> None:
        if not (0.1 <= self.grid_m <= 5.0 and 0 < self.reach_m <= 50.0 and 1 <= self.min_common <= 100):
            raise BadRequest("an option of wifi is out of its range", hint="leave it out for the default")


class WifiRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A scan without a position, and the survey: fingerprints with theirs."""

    scan: Fingerprint
    survey: list[Fingerprint]
    options: WifiOptions | None = None


class WifiReply(msgspec.Struct, frozen=True, kw_only=True):
    """Where the scan was taken: mean, and the radius that holds the truth 68 times in 100.

    ``found`` is False, with a *reason*, where too few access points are known.  Position and radius
    (twice the sigma is sensible) fit into ``within`` of ``place`` and ``localise``.
    """

    found: bool
    reason: str = ""
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    sigma_m: float = 0.0
    common: int = 0


def fingerprint_of(
    readings: Iterable[AccessPointReading], key: bytes, position: tuple[float, float, float] | None = None
) -> Fingerprint:
    """Return the fingerprint of *readings* without hardware addresses; run it on the robot.

    Leaves out networks whose name ends in ``_nomap``, locally administered addresses (phones that
    share their connection change them) and impossible strengths.  Addresses become keyed hashes: with
    the team's *key* two robots give an access point the same name; without the key it cannot be traced.

    Raises:
        BadRequest: *key* is shorter than 16 bytes, or an address is not valid.
    """
    if len(key) < 16:
        raise BadRequest(f"the key has {len(key)} bytes, not 16 or more", hint="make a random key per team")
    kept: dict[str, float] = {}
    for reading in readings:
        if not _MAC.match(reading.mac):
            raise BadRequest("an address is not six bytes of hexadecimal", hint="send aa:bb:cc:dd:ee:ff")
        address = bytes.fromhex(re.sub(r"[^0-9a-fA-F]", "", reading.mac))
        local = bool(address[0] & 0x02)
        audible = _MIN_DBM <= reading.rssi_dbm <= _MAX_DBM
        if not reading.ssid.endswith(_OPTED_OUT) and not local and audible:
            kept[hashlib.blake2b(address, key=key[:64], digest_size=8).hexdigest()] = reading.rssi_dbm
    return Fingerprint(rssi_dbm=kept, position=position)


class Locator:
    """A survey that locates scans; immutable.

    The posterior over a grid around the surveyed positions: for each received access point a Gaussian
    with the mean and variance of the model there, and a uniform prior.  The errors of access points are
    correlated (walls, people), which a product of their likelihoods ignores; therefore the product is
    tempered by an exponent, chosen so that in a five-fold cross-validation of the survey 68 % of the
    positions lie within their stated radius.

    Source:
        Ferris, Haehnel and Fox, Gaussian processes for signal strength-based location estimation,
        RSS 2006; tempering after Grunwald and van Ommen, Bayesian Analysis 2017.
    """

    def __init__(self, survey: Sequence[Survey], options: WifiOptions | None = None) -> None:
        self._options = options or WifiOptions()
        _check_work(survey, self._options)
        model = fit_signals(survey, max_fields=_MAX_ACCESS_POINTS)
        self._grid = _grid(model.places, self._options.grid_m, self._options.reach_m)
        self._fields = {name: field.predict(self._grid) for name, field in model.fields.items()}
        self.temper = _calibrate_temper(survey, model, self._options)

    def position_of(self, scan: Mapping[str, float]) -> WifiReply:
        """Return the position of *scan* (dBm by access point) as the reply of the service."""
        known = sorted(name for name in scan if name in self._fields)
        if len(known) < self._options.min_common:
            return WifiReply(
                found=False,
                reason=f"{len(known)} known access points are fewer than {self._options.min_common}",
            )
        mean, sigma_m = _posterior(self._grid, _log_likelihood(scan, self._fields), self.temper)
        return WifiReply(
            found=True,
            x=float(mean[0]),
            y=float(mean[1]),
            z=float(mean[2]),
            sigma_m=max(sigma_m, 0.3 * self._options.grid_m),
            common=len(known),
        )


def register(registry: Registry) -> None:
    """Add ``wifi`` to *registry*."""

    @registry.service("wifi", limited=True)
    def wifi(request: WifiRequest) -> WifiReply:
        """Locate a robot by the access points it hears."""
        if len(request.survey) > MAX_FINGERPRINTS:
            raise LimitExceeded(
                f"{len(request.survey)} fingerprints are above {MAX_FINGERPRINTS}",
                hint="send those near the robot's last position",
            )
        for each in (request.scan, *request.survey):
            _check_fingerprint(each)
        survey = [(_position_of(each), each.rssi_dbm) for each in request.survey]
        return Locator(survey, request.options).position_of(request.scan.rssi_dbm)


def _log_likelihood(scan: Mapping[str, float], fields: Mapping[str, tuple[Array, Array]]) -> Array:
    """Return the log likelihood of *scan* on the grid that *fields* were predicted on."""
    parts = [
        (scan[name] - fields[name][0]) ** 2 / fields[name][1] + np.log(fields[name][1])
        for name in sorted(scan)
        if name in fields
    ]
    total: Array = -0.5 * np.sum(parts, axis=0)
    return total


def _posterior(grid: Array, log_likelihood: Array, temper: float) -> tuple[Array, float]:
    """Return the mean of the posterior and the radius around it that holds 68 %."""
    weight = np.exp(temper * (log_likelihood - log_likelihood.max()))
    weight /= weight.sum()
    mean = weight @ grid
    distance = np.linalg.norm(grid[:, :2] - mean[:2], axis=1)
    return mean, _quantile(distance, weight, _ONE_SIGMA)


def _calibrate_temper(survey: Sequence[Survey], model: SignalModel, options: WifiOptions) -> float:
    """Return the exponent at which 68 % of the held-out positions lie within their radius."""
    grid = _grid(model.places, max(options.grid_m, _CALIBRATION_GRID_M), options.reach_m)
    inside = np.zeros(len(_TEMPERS))
    count = 0
    for fold in range(_FOLDS):
        held_out = np.arange(fold, len(survey), _FOLDS)
        left = {name: field.without(held_out) for name, field in model.fields.items()}
        fields = {name: field.predict(grid) for name, field in left.items() if field is not None}
        for row in held_out.tolist():
            place, scan = survey[row]
            if sum(name in fields for name in scan) < options.min_common:
                continue
            log_likelihood = _log_likelihood(scan, fields)
            count += 1
            for number, temper in enumerate(_TEMPERS):
                mean, sigma_m = _posterior(grid, log_likelihood, temper)
                inside[number] += math.hypot(mean[0] - place[0], mean[1] - place[1]) <= sigma_m
    if count < _MIN_HELD_OUT:
        return _DEFAULT_TEMPER
    # A larger exponent makes the radius smaller, so the share inside falls.
    share = np.minimum.accumulate(inside / count)
    return float(np.interp(-_ONE_SIGMA, -share, _TEMPERS))


def _check_fingerprint(fingerprint: Fingerprint) -> None:
    if any(_MAC.match(name) for name in fingerprint.rssi_dbm):
        raise BadRequest("a fingerprint names a hardware address", hint="send what fingerprint_of returns")
    if not all(_MIN_DBM <= value <= _MAX_DBM for value in fingerprint.rssi_dbm.values()):
        raise BadRequest("a strength is not within -120..0 dBm", hint="send dBm")


def _position_of(fingerprint: Fingerprint) -> tuple[float, float, float]:
    position = fingerprint.position
    if position is None or not all(math.isfinite(value) and abs(value) < 1e5 for value in position):
        raise BadRequest("a fingerprint of the survey has no position", hint="send metres, map frame")
    return position


def _check_work(survey: Sequence[Survey], options: WifiOptions) -> None:
    """Raise LimitExceeded if *survey* would take too long."""
    if not survey:
        return
    places = np.array([place for place, _ in survey], dtype=np.float64)
    low, high = _bounds(places, options.reach_m)
    floors = len(np.unique(np.round(places[:, 2])))
    cells = float(np.prod((high - low) / _pitch(low, high, options.grid_m) + 1.0)) * floors
    heard_at = Counter(name for _, heard in survey for name in heard)
    readings = sum(min(count, MAX_READINGS) for count in heard_at.values())
    if (
        floors > _MAX_FLOORS
        or cells * len(survey) > _MAX_POSTERIORS
        or cells * readings > _MAX_PREDICTIONS
    ):  # fmt: skip
        raise LimitExceeded(
            f"{len(survey)} positions on {floors} floors with {readings} readings, on a grid of up to "
            f"{cells:.0f} points, are too much for one request",
            hint="send the fingerprints near the robot's last position, or a larger grid_m",
        )


def _bounds(places: Array, reach_m: float) -> tuple[Array, Array]:
    return places[:, :2].min(axis=0) - reach_m, places[:, :2].max(axis=0) + reach_m


def _pitch(low: Array, high: Array, grid_m: float) -> float:
    """Return the distance of grid points: *grid_m*, or more so that there are about 40,000."""
    area, longest = float(np.prod(high - low)), float((high - low).max())
    return max(grid_m, math.sqrt(area / 40_000.0), longest / 40_000.0)


def _grid(places: Array, grid_m: float, reach_m: float) -> Array:
    """Return ``(g, 3)`` grid points within reach of surveyed positions, at the height of the nearest one."""
    low, high = _bounds(places, reach_m)
    pitch = _pitch(low, high, grid_m)
    x, y = (np.arange(low[axis], high[axis] + pitch, pitch) for axis in (0, 1))
    flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    floors = np.round(places[:, 2])
    parts = []
    for floor in np.unique(floors):
        on_floor = places[floors == floor]
        step = max(1, _DISTANCES_AT_ONCE // len(on_floor))
        for begin in range(0, len(flat), step):
            part = flat[begin : begin + step]
            squared = ((part[:, None, :] - on_floor[None, :, :2]) ** 2).sum(axis=2)
            near = squared.min(axis=1) <= reach_m**2
            height = on_floor[np.argmin(squared, axis=1), 2]
            parts.append(np.column_stack([part[near], height[near]]))
    grid = np.concatenate(parts)
    if not len(grid):
        raise BadRequest(f"no point of the grid is within {reach_m:g} m of the survey", hint="raise reach_m")
    return grid


def _quantile(values: Array, weights: Array, share: float) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(np.interp(share, below, values[order]))
