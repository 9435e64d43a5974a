"""The service ``wifi``: find the position of a robot by the signal strengths of Wi-Fi access points.

Each request has a scan and a survey, which is a list of scans with known positions; the server stores
neither.  No hardware address leaves the robot: `fingerprint_of` replaces addresses by keyed hashes, and
leaves out networks whose owners opted out by ``_nomap``.
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
]

_SurveyScan = tuple[tuple[float, float, float], Mapping[str, float]]
"""One scan of a survey: its position (metres, map frame), and the received strengths (dBm) by hashed access
point."""

# --- What a scan may hold ---
_OPT_OUT_SUFFIX = "_nomap"  # end of a network's name by which its owner opts out of localisation
_MAC = re.compile(r"^(?:[0-9a-fA-F]{2}[:\-.]?){5}[0-9a-fA-F]{2}$")  # pattern of a hardware address
# Weakest plausible signal, dBm, below the thermal noise of a radio: `fingerprint_of` leaves out a weaker one,
# and the service refuses it.
_MIN_DBM = -120.0
# Strongest plausible signal, dBm, which is 1 mW at the antenna: `fingerprint_of` leaves out a stronger one,
# and the service refuses it.
_MAX_DBM = 0.0

# --- Calibration of the uncertainty ---
_RADIUS_PROBABILITY = 0.68
"""Probability that the true position lies horizontally within sigma_m of the reply: sigma_m is this quantile
of the horizontal distances of the posterior, and the exponent of the likelihood is calibrated by it."""
# Candidate exponents of the likelihood, ascending: 1 takes the errors of access points as independent.
_TEMPERS = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
_DEFAULT_TEMPER = 0.4  # exponent of the likelihood where a survey is too small to calibrate the exponent
_MIN_HELD_OUT = 30  # fewest held-out positions from which the exponent is calibrated
_FOLDS = 5  # folds of the cross-validation that calibrates the exponent
# Smallest distance of grid points in the calibration, metres: a smaller ``grid_m`` of the request is used
# only for the reply, which saves time.
_CALIBRATION_GRID_M = 0.5

# --- Limits of a request, beyond which it is refused with LimitExceeded ---
MAX_FINGERPRINTS = 5000  # most fingerprints (surveyed positions) of a request; with more it is refused
_MAX_FLOORS = 100  # most floors, which are surveyed heights rounded to 1 m; each floor has a grid of its own
# Most access points with five or more readings in a survey, which is refused with more, to bound the time;
# access points with fewer readings are ignored.
_MAX_ACCESS_POINTS = 300
# Largest product of the numbers of grid points and of surveyed positions of a request, which is refused
# beyond it: the calibration then takes five seconds.
_MAX_POSTERIORS = 5_000_000
# Largest product of the numbers of grid points and of readings of a request, which is refused beyond it: the
# predictions then take five seconds.
_MAX_PREDICTIONS = 100_000_000

# Number of distances between grid points and surveyed positions that are computed at once, which bounds the
# memory.
_BATCH = 1_000_000


class AccessPointReading(msgspec.Struct, frozen=True, kw_only=True):
    """An access point that a robot's radio received, as an argument of `fingerprint_of`; it is never sent.

    Attributes:
        mac: Hardware address: six bytes of hexadecimal, with or without ``:``, ``-`` or ``.`` between them.
        ssid: Name of the network.
        rssi_dbm: Received strength, dBm.
    """

    mac: str
    ssid: str
    rssi_dbm: float


class Fingerprint(msgspec.Struct, frozen=True, kw_only=True):
    """A scan: received strengths (dBm, -120..0) by hashed access point.

    A scan of a survey has the position (metres, map frame) at which it was taken.
    """

    rssi_dbm: dict[str, float]
    position: tuple[float, float, float] | None = None


class WifiOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of a Wi-Fi localisation.

    Attributes:
        grid_m: Distance of the points of the grid over which the position is estimated, metres, 0.1..5;
            larger on a floor that would otherwise have more than about 40,000 grid points.
        reach_m: Largest horizontal distance of a grid point from the nearest surveyed position of its floor,
            metres, up to 50.  The robot is assumed to be at a grid point.
        min_common: Fewest access points of the scan, 1..100, that the survey must have at five positions or
            more; with fewer of them, no position is found.

    Raises:
        BadRequest: A number is out of its range.
    """

    grid_m: float = 0.5
    reach_m: float = 3.0
    min_common: int = 3

    def __post_init__(self) -> None:
        if not (0.1 <= self.grid_m <= 5.0 and 0 < self.reach_m <= 50.0 and 1 <= self.min_common <= 100):
            raise BadRequest("an option of wifi is out of its range", hint="leave it out for the default")


class WifiRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A scan whose position is wanted, and a survey of up to 5,000 fingerprints with positions.

    A position in *scan* is ignored.
    """

    scan: Fingerprint
    survey: list[Fingerprint]
    options: WifiOptions | None = None


class WifiReply(msgspec.Struct, frozen=True, kw_only=True):
    """The estimated position at which a scan was taken, or the reason why it was not estimated.

    Position and radius are a prior for the field ``within`` of the services ``place`` and ``localise``; a
    radius of twice *sigma_m* is sensible.

    Attributes:
        found: Whether the position was estimated; if not, all numbers are 0.
        reason: Empty if *found*; else that the survey has too few access points of the scan.
        x: Mean of the posterior, metres, map frame.
        y: Mean of the posterior, metres, map frame.
        z: Mean of the posterior, metres, map frame.
        sigma_m: Radius in metres of the horizontal circle around ``(x, y)`` that holds 68 % of the posterior,
            at least 0.3 times ``grid_m``.  The posterior is calibrated on the survey, so that the circle
            holds the true position with this probability.  The height is not part of the radius.
        common: Number of access points of the scan that the survey has at five positions or more.
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
    """Return a fingerprint of *readings* without hardware addresses; the robot calls this function.

    Left out are networks whose name ends in ``_nomap``, access points with a locally administered address,
    and strengths outside -120..0 dBm.  Locally administered addresses are mostly those of phones that share
    their connection: they change at random, and the phones move.  Of several readings of an
    address the last one counts.  An address becomes a keyed BLAKE2b hash: robots with the same *key* give an
    access point the same name, and without the key the address cannot be found out.

    Args:
        readings: Received access points.
        key: Secret of the team, at least 16 bytes; bytes after the 64th are not used.
        position: ``(x, y, z)`` in metres, map frame, for a survey; None for a scan.

    Raises:
        BadRequest: *key* is shorter than 16 bytes, or an address is not valid.
    """
    if len(key) < 16:
        raise BadRequest(f"the key has {len(key)} bytes, not 16 or more", hint="make a random key per team")
    strengths_dbm: dict[str, float] = {}
    for reading in readings:
        if not _MAC.match(reading.mac):
            raise BadRequest("an address is not six bytes of hexadecimal", hint="send aa:bb:cc:dd:ee:ff")
        address = bytes.fromhex(re.sub(r"[^0-9a-fA-F]", "", reading.mac))
        is_local = bool(address[0] & 0x02)
        is_plausible = _MIN_DBM <= reading.rssi_dbm <= _MAX_DBM
        if not reading.ssid.endswith(_OPT_OUT_SUFFIX) and not is_local and is_plausible:
            name = hashlib.blake2b(address, key=key[:64], digest_size=8).hexdigest()
            strengths_dbm[name] = reading.rssi_dbm
    return Fingerprint(rssi_dbm=strengths_dbm, position=position)


class Locator:
    """Estimates positions of scans by one survey, which is fitted once; immutable.

    The posterior over a grid around the surveyed positions has a uniform prior, and for each received access
    point a Gaussian likelihood with the mean and variance of its signal field.  The errors of access points
    are correlated (walls, people), which the product of their likelihoods ignores.  The product is therefore
    raised to a power of at most 1.  The power is chosen so that, in a five-fold cross-validation of the
    survey, 68 % of the true positions lie within the radius ``sigma_m`` around the estimated ones.

    Attributes:
        temper: The power, 0.1..1; 0.4 if fewer than 30 positions of the survey could be located in the
            cross-validation.

    Source:
        Ferris, Haehnel and Fox, Gaussian processes for signal strength-based location estimation,
        RSS 2006; the power ("tempering") after Grunwald and van Ommen, Bayesian Analysis 2017.
    """

    def __init__(self, survey: Sequence[_SurveyScan], options: WifiOptions | None = None) -> None:
        """Fit the signal fields of *survey*, predict them at the grid points, and calibrate the power.

        Raises:
            BadRequest: No access point was received at five positions or more, or no grid point is within
                ``reach_m`` of a surveyed position.
            LimitExceeded: The survey has too many floors or access points, or would take too long.
        """
        self._options = options or WifiOptions()
        _check_work(survey, self._options)
        model = fit_signals(survey, max_fields=_MAX_ACCESS_POINTS)
        self._grid = _make_grid(model.positions, self._options.grid_m, self._options.reach_m)
        self._fields = {name: field.predict(self._grid) for name, field in model.fields.items()}
        self.temper = _calibrate_temper(survey, model, self._options)

    def position_of(self, scan: Mapping[str, float]) -> WifiReply:
        """Return the position at which *scan* (dBm by hashed access point) was taken.

        Access points without a signal field are ignored; if fewer than ``min_common`` are left, the reply has
        no position.  The radius ``sigma_m`` is never less than 0.3 times ``grid_m``.
        """
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
    """Add the service ``wifi`` to *registry*."""

    @registry.service("wifi", limited=True)
    def wifi(request: WifiRequest) -> WifiReply:
        """Find the position of a robot by the Wi-Fi access points that it receives.

        The request brings the survey along.  If the survey has too few access points of the scan, the reply
        has ``found`` false and the reason.
        """
        if len(request.survey) > MAX_FINGERPRINTS:
            raise LimitExceeded(
                f"{len(request.survey)} fingerprints are above {MAX_FINGERPRINTS}",
                hint="send those near the robot's last position",
            )
        for fingerprint in (request.scan, *request.survey):
            _check_fingerprint(fingerprint)
        survey = [(_surveyed_position(fingerprint), fingerprint.rssi_dbm) for fingerprint in request.survey]
        return Locator(survey, request.options).position_of(request.scan.rssi_dbm)


def _log_likelihood(scan: Mapping[str, float], fields: Mapping[str, tuple[Array, Array]]) -> Array:
    """Return ``(g,)`` log likelihoods of *scan* at the grid points, without their constant term.

    *fields* has the predicted means (dBm) and variances (dBm^2), ``(g,)`` each, by access point.  Access
    points of *scan* that *fields* lacks are ignored; at least one must be known.
    """
    parts = [
        (scan[name] - fields[name][0]) ** 2 / fields[name][1] + np.log(fields[name][1])
        for name in sorted(scan)
        if name in fields
    ]
    total: Array = -0.5 * np.sum(parts, axis=0)
    return total


def _posterior(grid: Array, log_likelihood: Array, temper: float) -> tuple[Array, float]:
    """Return the ``(3,)`` mean of the posterior, and the horizontal radius around it that holds 68 %, metres.

    The prior is uniform over *grid* ``(g, 3)``, and the likelihood is raised to the power *temper*.
    """
    weight = np.exp(temper * (log_likelihood - log_likelihood.max()))
    weight /= weight.sum()
    mean = weight @ grid
    distance = np.linalg.norm(grid[:, :2] - mean[:2], axis=1)
    return mean, _weighted_quantile(distance, weight, _RADIUS_PROBABILITY)


def _calibrate_temper(survey: Sequence[_SurveyScan], model: SignalModel, options: WifiOptions) -> float:
    """Return the power of the likelihood at which 68 % of the held-out positions lie within their radius.

    The radius is that of `_posterior` around the position that is estimated for the held-out scan.  A scan is
    left out if fewer than ``min_common`` of its access points have a field; of fewer than 30 other scans, the
    result is 0.4.
    """
    # 1. Locate the scans of each fold by the readings of the other folds, with each candidate power.  Trends
    # and parameters of the fields stay those of the whole survey.
    grid = _make_grid(model.positions, max(options.grid_m, _CALIBRATION_GRID_M), options.reach_m)
    inside = np.zeros(len(_TEMPERS))
    count = 0
    for fold in range(_FOLDS):
        held_out = np.arange(fold, len(survey), _FOLDS)
        remaining = {name: field.without(held_out) for name, field in model.fields.items()}
        fields = {name: field.predict(grid) for name, field in remaining.items() if field is not None}
        for row in held_out.tolist():
            position, scan = survey[row]
            if sum(name in fields for name in scan) < options.min_common:
                continue
            log_likelihood = _log_likelihood(scan, fields)
            count += 1
            for number, temper in enumerate(_TEMPERS):
                mean, sigma_m = _posterior(grid, log_likelihood, temper)
                inside[number] += math.hypot(mean[0] - position[0], mean[1] - position[1]) <= sigma_m
    if count < _MIN_HELD_OUT:
        return _DEFAULT_TEMPER
    # 2. Interpolate the power between the candidates.  A larger power makes the radius smaller, so the share
    # of positions inside should fall from candidate to candidate.  Where it rises by chance, it is replaced
    # by the smallest share of the smaller powers, so that the interpolation has one result.
    share = np.minimum.accumulate(inside / count)
    return float(np.interp(-_RADIUS_PROBABILITY, -share, _TEMPERS))


def _check_fingerprint(fingerprint: Fingerprint) -> None:
    if any(_MAC.match(name) for name in fingerprint.rssi_dbm):
        raise BadRequest("a fingerprint names a hardware address", hint="send what fingerprint_of returns")
    if not all(_MIN_DBM <= value <= _MAX_DBM for value in fingerprint.rssi_dbm.values()):
        raise BadRequest("a strength is not within -120..0 dBm", hint="send dBm")


def _surveyed_position(fingerprint: Fingerprint) -> tuple[float, float, float]:
    position = fingerprint.position
    if position is None or not all(math.isfinite(value) and abs(value) < 1e5 for value in position):
        raise BadRequest("a fingerprint of the survey has no position", hint="send metres, map frame")
    return position


def _check_work(survey: Sequence[_SurveyScan], options: WifiOptions) -> None:
    """Raise LimitExceeded if *survey* is beyond `_MAX_FLOORS`, `_MAX_POSTERIORS` or `_MAX_PREDICTIONS`."""
    if not survey:
        return
    positions = np.array([position for position, _ in survey], dtype=np.float64)
    low, high = _bounds(positions, options.reach_m)
    floors = len(np.unique(np.round(positions[:, 2])))
    grid_points = float(np.prod((high - low) / _grid_pitch(low, high, options.grid_m) + 1.0)) * floors
    readings_by_name = Counter(name for _, strengths in survey for name in strengths)
    readings = sum(min(count, MAX_READINGS) for count in readings_by_name.values())
    if (
        floors > _MAX_FLOORS
        or grid_points * len(survey) > _MAX_POSTERIORS
        or grid_points * readings > _MAX_PREDICTIONS
    ):
        raise LimitExceeded(
            f"{len(survey)} positions on {floors} floors with {readings} readings, on a grid of up to "
            f"{grid_points:.0f} points, are too much for one request",
            hint="send the fingerprints near the robot's last position, or a larger grid_m",
        )


def _bounds(positions: Array, reach_m: float) -> tuple[Array, Array]:
    return positions[:, :2].min(axis=0) - reach_m, positions[:, :2].max(axis=0) + reach_m


def _grid_pitch(low: Array, high: Array, grid_m: float) -> float:
    """Return the distance of grid points in metres: *grid_m*, or more for a large area.

    The distance is increased until a floor has at most about 40,000 grid points.  *low* and *high* are the
    ``(2,)`` corners of the area of the grid, metres.
    """
    area, longest = float(np.prod(high - low)), float((high - low).max())
    return max(grid_m, math.sqrt(area / 40_000.0), longest / 40_000.0)


def _make_grid(positions: Array, grid_m: float, reach_m: float) -> Array:
    """Return ``(g, 3)`` grid points on all floors, metres.

    A floor is the surveyed positions whose heights round to the same metre.  Its grid points lie within a
    horizontal distance of *reach_m* of one of its positions, and at the height of the nearest one.

    Raises:
        BadRequest: There is no grid point within *reach_m*.
    """
    low, high = _bounds(positions, reach_m)
    pitch = _grid_pitch(low, high, grid_m)
    x, y = (np.arange(low[axis], high[axis] + pitch, pitch) for axis in (0, 1))
    flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    floors = np.round(positions[:, 2])
    parts = []
    for floor in np.unique(floors):
        on_floor = positions[floors == floor]
        step = max(1, _BATCH // len(on_floor))
        for begin in range(0, len(flat), step):
            part = flat[begin : begin + step]
            squared = ((part[:, None, :] - on_floor[None, :, :2]) ** 2).sum(axis=2)
            is_near = squared.min(axis=1) <= reach_m**2
            height = on_floor[np.argmin(squared, axis=1), 2]
            parts.append(np.column_stack([part[is_near], height[is_near]]))
    grid = np.concatenate(parts)
    if not len(grid):
        raise BadRequest(f"no point of the grid is within {reach_m:g} m of the survey", hint="raise reach_m")
    return grid


def _weighted_quantile(values: Array, weights: Array, probability: float) -> float:
    order = np.argsort(values)
    cumulated = np.cumsum(weights[order])
    return float(np.interp(probability, cumulated, values[order]))
