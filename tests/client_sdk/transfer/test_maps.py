"""Maps by the data client: a new version of whatever is there, and the client of an enrolled robot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from client_sdk.transfer.data_client import DataClient
from rse_pf.auth.tokens import SigningKey
from rse_pf.enrolment import Enrolment
from rse_pf.errors import Conflict, UsageError
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_data_service import HttpServer, Service, small_settings


def encoded(points: int) -> bytes:
    cloud = np.zeros((points, 3))
    return encode_map(
        MapVersion(keyframes=(), points=cloud.astype(np.float32), colours=cloud.astype(np.uint8))
    )


def test_an_update_makes_the_first_version_and_follows_the_head_after_that() -> None:
    service = Service(small_settings(), MemoryStore())
    with HttpServer(service) as server:
        client = DataClient(server.url, service.token)
        first = client.update_map("kitchen", encoded(1), note="a drive")
        second = client.update_map("kitchen", encoded(2))

        assert client.maps() == {"kitchen": second}
        assert client.map_version("kitchen")["record"]["parent"] == first
        assert client.download_map("kitchen") == encoded(2)
        with pytest.raises(Conflict):
            client.commit_map("kitchen", encoded(3), parent=first)
        client.close()


def test_an_enrolled_robot_signs_tokens_for_the_data_service(tmp_path: Path) -> None:
    key = json.loads(SigningKey.of_robot(b"r" * 32).to_json())
    Enrolment(url="ws://127.0.0.1:9/ws", robot="robot-1", key=key).write(tmp_path / "robot-1.enrolment")

    client = DataClient.enrolled(tmp_path / "robot-1.enrolment")

    assert callable(client.token)
    assert client.token().count(".") == 2
    assert client._connection._parts.geturl() == "http://127.0.0.1:9"


def test_without_the_file_the_data_client_says_so(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot read the enrolment"):
        DataClient.enrolled(tmp_path / "none")
