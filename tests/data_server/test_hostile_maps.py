"""Hostile maps at the data service: each is refused, the server stays small, and others are served."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.data_server.map_describer import TARGET, MapDescriber
from rse_pf.data_server.robot_processes import RobotProcesses
from rse_pf.identity import RobotId
from rse_pf.maps.describe import MapSummary
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import DirectoryStore, digest_of
from tests.kit.fake_data_service import Service, small_settings
from tests.kit.hostile_maps import DECODABLE, hostile_maps

MIB = 1 << 20
COSTLY = ("ten million empty lists", "one keyframe of 500,000 features", "300 keyframes")


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


class MapService(Service):
    """A data service that reads maps in a process with limits."""

    def describe(self, robot: RobotId, name: str) -> MapSummary:
        return self.describer.describe(robot, name)

    describer: MapDescriber

    def commit(self, data: bytes, robot: str = "robot-1", parent: str | None = None, name: str = "a") -> int:
        digest = digest_of(data)
        status = self.ask("PUT", f"/data/v1/objects/{digest}", data, robot=robot).status
        assert status in (200, 201)
        body = json.dumps({"digest": digest, "parent": parent}).encode()
        self.now += 10.0
        return self.ask("POST", f"/data/v1/maps/{name}/versions", body, robot=robot).status


@pytest.fixture
def service(tmp_path: Path) -> Iterator[MapService]:
    store = f"dir:{tmp_path}"
    settings = small_settings(
        store=store, part_bytes=MIB, max_object_bytes=1 << 28, quota_bytes=1 << 30, max_requests_per_s=1000
    )
    made = MapService(settings, DirectoryStore(tmp_path))
    made.describer = MapDescriber(RobotProcesses(TARGET, settings, made.store, lambda: made.now))
    yield made
    made.describer.close()


def check(service: MapService, maps: dict[str, bytes]) -> None:
    """Commit each map as a robot of its own; all but the decodable ones are refused with a code."""
    assert service.commit(encode_map(MapVersion(keyframes=())), name="before") == 201
    before = resident_bytes()
    for number, (name, data) in enumerate(maps.items()):
        status = service.commit(data, robot=f"hostile-{number}", name=f"m{number}")
        assert status == 201 if name in DECODABLE else status in (400, 413), name
    assert resident_bytes() - before < 64 * MIB
    assert service.commit(encode_map(MapVersion(keyframes=())), name="after") == 201


def test_costly_maps_are_refused_and_the_server_stays_small(service: MapService) -> None:
    costly = {name: data for name, data in hostile_maps().items() if name.startswith(COSTLY)}

    assert len(costly) >= len(COSTLY)
    check(service, costly)


@pytest.mark.slow
def test_every_hostile_map_is_refused_and_the_server_stays_small(service: MapService) -> None:
    maps = hostile_maps()

    assert len(maps) >= 40
    check(service, maps)
