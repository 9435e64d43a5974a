"""The service ``wifi``: position with a calibrated radius, and no hardware address in a request."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.mapping.wifi import (
    AccessPointReading,
    Fingerprint,
    Locator,
    WifiReply,
    WifiRequest,
    fingerprint_of,
)
from rse_pf.wire import Command, Failure, Result
from tests.kit.synthetic_maps import Building, make_building

KEY = b"a key of the team"


def surveyed(building: Building, seed: int, pitch_m: float = 2.0) -> list[Fingerprint]:
    """Return a fingerprint for each point of a grid over the building."""
    rng = np.random.default_rng(seed)
    places = [(x, y, 0.3) for x in np.arange(1, 40, pitch_m) for y in np.arange(1, 20, pitch_m)]
    return [fingerprint_of(building.scan(np.array(place), rng), KEY, place) for place in places]


def asked(request: WifiRequest) -> Result | Failure:
    """Return the answer of the service."""
    command = Command(id=1, service="wifi", payload=request)
    return dispatch(builtin_services(PlatformSettings()), command, lambda: 0.0)


def located(building: Building, locator: Locator, scans: int, seed: int) -> tuple[list[float], list[float]]:
    """Return the errors and the stated radii of scans at random positions."""
    rng = np.random.default_rng(seed)
    errors, radii = [], []
    for _ in range(scans):
        place = np.array([rng.uniform(1, 39), rng.uniform(1, 19), 0.3])
        found = locator.position_of(fingerprint_of(building.scan(place, rng), KEY).rssi_dbm)
        assert found.found, found.reason
        errors.append(float(np.hypot(found.x - place[0], found.y - place[1])))
        radii.append(found.sigma_m)
    return errors, radii


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_sixty_eight_in_a_hundred_lie_inside_the_stated_radius() -> None:
    inside = []
    for seed in range(4):
        building = make_building(seed)
        survey = [(each.position, each.rssi_dbm) for each in surveyed(building, seed + 100)]
        errors, radii = located(building, Locator(survey), 250, seed + 200)  # type: ignore[arg-type]
        inside += [error <= radius for error, radius in zip(errors, radii, strict=True)]
        assert np.median(errors) <= 2.0

    assert 0.63 <= np.mean(inside) <= 0.73


def test_the_service_answers_with_a_position_and_a_radius() -> None:
    building = make_building(2)
    scan = fingerprint_of(building.scan(np.array([10.0, 10.0, 0.3]), np.random.default_rng(1)), KEY)
    request = WifiRequest(scan=scan, survey=surveyed(building, 3, pitch_m=5.0))

    answer = asked(request)

    assert isinstance(answer, Result), answer
    assert isinstance(answer.reply, WifiReply)
    assert answer.reply.found
    assert np.hypot(answer.reply.x - 10.0, answer.reply.y - 10.0) <= 4 * answer.reply.sigma_m


def test_a_scan_of_unknown_access_points_has_no_position() -> None:
    survey = surveyed(make_building(2), 3, pitch_m=8.0)
    request = WifiRequest(scan=Fingerprint(rssi_dbm={"nobody": -50.0}), survey=survey)

    answer = asked(request)

    assert isinstance(answer, Result), answer
    assert not answer.reply.found
    assert "0 known access points" in answer.reply.reason


def test_networks_that_opted_out_and_phones_never_leave_the_robot() -> None:
    readings = [
        AccessPointReading(mac="00:16:3e:00:00:01", ssid="hall", rssi_dbm=-50),
        AccessPointReading(mac="00:16:3e:00:00:02", ssid="flat_nomap", rssi_dbm=-50),
        AccessPointReading(mac="02:16:3e:00:00:03", ssid="phone", rssi_dbm=-50),
        AccessPointReading(mac="00:16:3e:00:00:04", ssid="broken", rssi_dbm=17),
    ]

    found = fingerprint_of(readings, KEY)

    assert found == fingerprint_of(readings[:1], KEY)
    assert len(found.rssi_dbm) == 1


def test_names_depend_on_the_key_and_not_on_the_spelling() -> None:
    spelt = AccessPointReading(mac="00:16:3E:0A:00:01", ssid="x", rssi_dbm=-50)
    other = AccessPointReading(mac="00-16-3e-0a-00-01", ssid="x", rssi_dbm=-50)

    assert fingerprint_of([spelt], KEY) == fingerprint_of([other], KEY)
    assert fingerprint_of([spelt], KEY) != fingerprint_of([spelt], b"another team's key")
    assert "00163e0a0001" not in str(fingerprint_of([spelt], KEY))


@pytest.mark.parametrize(
    "scan",
    [{"00:16:3e:00:00:01": -50.0}, {"00163e000001": -50.0}, {"abc": 40.0}],
)
def test_hardware_addresses_and_impossible_strengths_are_refused(scan: dict[str, float]) -> None:
    request = WifiRequest(scan=Fingerprint(rssi_dbm=scan), survey=[])

    answer = asked(request)

    assert isinstance(answer, Failure)
    assert answer.code == BadRequest.code


def test_a_short_key_is_refused() -> None:
    with pytest.raises(BadRequest, match="key has 3 bytes"):
        fingerprint_of([], b"abc")
