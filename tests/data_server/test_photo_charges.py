"""A robot whose photos used much CPU time is refused at the door."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from rse_pf.data_server.photo_localiser import PhotoLocaliser
from rse_pf.errors import BadRequest
from rse_pf.identity import RobotId
from rse_pf.maps.photos import PhotoLens, PhotoLocation
from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_data_service import Service, small_settings

ROBOT = RobotId("acme", "robot-1")


class Localiser:
    """Takes as much CPU time as it is told."""

    count = 1

    def __init__(self) -> None:
        self.cpu_s, self.calls = 0.0, 0

    def localise(
        self, robot: RobotId, name: str, photo: bytes, lens: PhotoLens, charge: Callable[[float], None]
    ) -> PhotoLocation:
        self.calls += 1
        charge(self.cpu_s)
        if photo == b"bad":
            raise BadRequest("this is no photo", hint="send one")
        return PhotoLocation(version="ab", verdict="lost")

    def close(self) -> None:
        """End nothing."""


class PhotoService(Service):
    def photo(self, data: bytes = b"photo", robot: str = "robot-1") -> Any:
        query = "fx=500&fy=500&cx=320&cy=240"
        return self.ask("POST", "/localise/rooms", data, query=query, robot=robot)


@pytest.mark.parametrize(("data", "status"), [(b"photo", 200), (b"bad", 400)])
def test_who_used_its_cpu_time_is_refused_before_a_photo_is_read(data: bytes, status: int) -> None:
    localiser = Localiser()
    service = PhotoService(small_settings(max_requests_per_s=50), MemoryStore(), localiser=localiser)
    localiser.cpu_s = 0.9  # of the 250 ms a second that 50 requests a second are

    assert service.photo(data).status == status
    assert service.photo(data).status == status, "20 of 200 requests are left, of which it takes ten"
    refused = service.photo()

    assert (refused.status, localiser.calls) == (429, 2)
    assert int(refused.headers["retry-after"]) in (3, 4)
    assert service.photo(robot="robot-2").status == 200
    service.now += 3.5
    assert service.photo().status == 200


class _BrokenProcesses:
    """Processes of which each takes 0.3 s of CPU time, and fails."""

    count, private_store = 1, None

    def call(self, robot: RobotId, data: bytes, *, near: str, charge: Callable[[float], None]) -> bytes:
        charge(0.3)
        raise BadRequest("no image")


def test_a_photo_that_fails_is_charged_for_what_it_took() -> None:
    localiser = PhotoLocaliser(_BrokenProcesses())  # type: ignore[arg-type]
    charged: list[float] = []

    with pytest.raises(BadRequest):
        localiser.outline(ROBOT, "hall", charged.append)

    assert charged == [0.3]


def test_a_photo_never_counts_for_more_than_what_may_come_at_once() -> None:
    localiser = Localiser()
    service = PhotoService(small_settings(max_requests_per_s=50), MemoryStore(), localiser=localiser)
    localiser.cpu_s = 20.0  # the first photo of a large map

    assert service.photo().status == 200
    service.now += 0.1
    assert service.photo().status == 200
    refused = service.photo()
    assert int(refused.headers["retry-after"]) <= 5
