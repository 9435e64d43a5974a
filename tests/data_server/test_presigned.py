"""Stores with presigned URLs: robots and bucket exchange the bytes, the service only sends the URL."""

from __future__ import annotations

import json

import pytest

from rse_pf.data_server.handlers import PRESIGNED_URL_TTL_S
from rse_pf.identity import RobotId, object_name
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import Service, small_settings

DATA = bytes(range(256)) * 40
DIGEST = digest_of(DATA)
NAME = object_name(RobotId("default", "robot-1"), DIGEST)
BEGIN = json.dumps({"size": len(DATA)}).encode()


class Bucket(MemoryStore):
    """A store in memory that signs addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.signed: list[tuple[str, int, str, int]] = []

    def presigned_put(self, name: str, *, size: int, sha256: str, ttl_s: int) -> tuple[str, dict[str, str]]:
        self.signed.append((name, size, sha256, ttl_s))
        return f"https://bucket/{name}?signed", {"Content-Length": str(size), "x-checksum": sha256}

    def presigned_get(self, name: str, *, ttl_s: int) -> str:
        return f"https://bucket/{name}?life={ttl_s}"


@pytest.fixture
def bucket() -> Bucket:
    """An empty bucket."""
    return Bucket()


@pytest.fixture
def direct(bucket: Bucket) -> Service:
    """A service on it."""
    return Service(small_settings(), bucket)


def test_after_a_direct_upload_the_object_exists_and_the_upload_is_closed(
    direct: Service, bucket: Bucket
) -> None:
    direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    bucket.put(NAME, DATA)

    told = direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN).json

    assert (told["offset"], told.get("direct")) == (len(DATA), None)
    assert list(bucket.list("uploads/")) == []
    assert direct.ask("GET", f"/data/v1/objects/{DIGEST}").body == DATA


def test_an_object_counts_once_against_the_quota_however_it_was_uploaded(bucket: Bucket) -> None:
    service = Service(small_settings(quota_bytes=2 * len(DATA)), bucket)
    service.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    bucket.put(NAME, DATA)
    service.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)

    same_again = service.ask("PUT", f"/data/v1/uploads/{'0' * 64}", BEGIN).status
    one_more = service.ask("PUT", f"/data/v1/uploads/{'1' * 64}", BEGIN).status

    assert (same_again, one_more) == (200, 413)


def test_a_refused_size_gets_no_url(direct: Service, bucket: Bucket) -> None:
    size = direct.settings.data.max_object_bytes + 1

    assert direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", json.dumps({"size": size}).encode()).status == 413
    assert bucket.signed == []


def test_a_download_is_redirected_only_on_request_and_only_to_own_objects(
    direct: Service, bucket: Bucket
) -> None:
    bucket.put(NAME, DATA)
    path, asks = f"/data/v1/objects/{DIGEST}", {"X-Accept-Direct": "1"}

    shown = direct.ask("GET", path, headers=asks)

    assert (shown.status, shown.body) == (307, b"")
    assert shown.headers["location"] == f"https://bucket/{NAME}?life={PRESIGNED_URL_TTL_S}"
    assert direct.ask("GET", path).body == DATA
    foreign = direct.ask("GET", path, headers=asks, robot="robot-2")
    assert (foreign.status, "location" in foreign.headers) == (404, False)


def test_no_presigned_url_is_logged(direct: Service, bucket: Bucket) -> None:
    direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    bucket.put(NAME, DATA)
    direct.ask("GET", f"/data/v1/objects/{DIGEST}", headers={"X-Accept-Direct": "1"})

    assert "bucket" not in json.dumps(direct.lines)
