"""Stores that sign addresses: bytes go straight to the bucket, and the service only says where."""

from __future__ import annotations

import json

import pytest
from fake_data_service import Service, small_settings

from rse_pf.object_store import MemoryStore, digest_of, object_name

DATA = bytes(range(256)) * 40
DIGEST = digest_of(DATA)
NAME = object_name("default", "robot-1", DIGEST)
BEGIN = json.dumps({"size": len(DATA)}).encode()


class Bucket(MemoryStore):
    """A store in memory that signs addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.signed: list[tuple[str, int, str, int]] = []

    def presigned_put(self, name: str, *, size: int, sha256: str, life_s: int) -> tuple[str, dict[str, str]]:
        self.signed.append((name, size, sha256, life_s))
        return f"https://bucket/{name}?signed", {"Content-Length": str(size), "x-checksum": sha256}

    def presigned_get(self, name: str, *, life_s: int) -> str:
        return f"https://bucket/{name}?life={life_s}"


@pytest.fixture
def bucket() -> Bucket:
    """An empty bucket."""
    return Bucket()


@pytest.fixture
def direct(bucket: Bucket) -> Service:
    """A service on it."""
    return Service(small_settings(presigned_url_ttl_s=60), bucket)


def test_an_upload_that_begins_may_go_straight_to_the_bucket(direct: Service, bucket: Bucket) -> None:
    told = direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN).json

    assert told["direct"]["url"] == f"https://bucket/{NAME}?signed"
    assert told["direct"]["headers"] == {"Content-Length": str(len(DATA)), "x-checksum": DIGEST}
    assert told["direct"]["life_s"] == 60
    assert bucket.signed == [(NAME, len(DATA), DIGEST, 60)], "name, length and digest are fixed"


def test_what_came_straight_is_an_object_and_its_upload_is_over(direct: Service, bucket: Bucket) -> None:
    direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    bucket.put(NAME, DATA)

    told = direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN).json

    assert (told["offset"], told.get("direct")) == (len(DATA), None)
    assert list(bucket.list("uploads/")) == []
    assert direct.ask("GET", f"/data/v1/objects/{DIGEST}").body == DATA


def test_an_object_counts_once_however_it_came(bucket: Bucket) -> None:
    service = Service(small_settings(quota_bytes=2 * len(DATA)), bucket)
    service.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    bucket.put(NAME, DATA)
    service.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)

    same_again = service.ask("PUT", f"/data/v1/uploads/{'0' * 64}", BEGIN).status
    one_more = service.ask("PUT", f"/data/v1/uploads/{'1' * 64}", BEGIN).status

    assert (same_again, one_more) == (200, 413)


def test_what_began_in_parts_goes_on_in_parts(direct: Service) -> None:
    direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    direct.ask("PATCH", f"/data/v1/uploads/{DIGEST}", DATA[:4096], headers={"Upload-Offset": "0"})

    told = direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN).json

    assert (told["offset"], told.get("direct")) == (4096, None)


def test_a_refused_size_gets_no_address(direct: Service, bucket: Bucket) -> None:
    size = direct.settings.data.max_object_bytes + 1

    assert direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", json.dumps({"size": size}).encode()).status == 413
    assert bucket.signed == []


def test_a_download_is_shown_the_way_only_if_it_asks_and_only_to_its_own(
    direct: Service, bucket: Bucket
) -> None:
    bucket.put(NAME, DATA)
    path, asks = f"/data/v1/objects/{DIGEST}", {"X-Accept-Direct": "1"}

    shown = direct.ask("GET", path, headers=asks)

    assert (shown.status, shown.body) == (307, b"")
    assert shown.headers["location"] == f"https://bucket/{NAME}?life=60"
    assert direct.ask("GET", path).body == DATA
    foreign = direct.ask("GET", path, headers=asks, robot="robot-2")
    assert (foreign.status, "location" in foreign.headers) == (404, False)


def test_a_store_without_addresses_carries_the_bytes_itself(service: Service) -> None:
    service.store.put(NAME, DATA)
    other = digest_of(b"other")

    assert service.ask("GET", f"/data/v1/objects/{DIGEST}", headers={"X-Accept-Direct": "1"}).body == DATA
    assert service.ask("PUT", f"/data/v1/uploads/{other}", b'{"size": 5}').json.get("direct") is None


def test_no_signed_address_is_logged(direct: Service, bucket: Bucket) -> None:
    direct.ask("PUT", f"/data/v1/uploads/{DIGEST}", BEGIN)
    bucket.put(NAME, DATA)
    direct.ask("GET", f"/data/v1/objects/{DIGEST}", headers={"X-Accept-Direct": "1"})

    assert "bucket" not in json.dumps(direct.lines)
