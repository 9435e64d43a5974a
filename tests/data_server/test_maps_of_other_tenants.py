"""Maps of another tenant: no method of the data service reads or changes them, or says that they exist."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import Answer, Service, small_settings

OWNER, RIVAL = "acme", "rival"
MAPS = "/data/v1/maps/kitchen"
DATA = encode_map(MapVersion(keyframes=(), provenance={"seed": 1}))


def commit(service: Service, tenant: str) -> Answer:
    """Store `DATA` as an object of a robot of *tenant*, and make it the next version of the map."""
    service.ask("PUT", f"/data/v1/objects/{digest_of(DATA)}", DATA, tenant=tenant)
    head = service.ask("GET", f"{MAPS}/versions/head", tenant=tenant).json.get("id")
    body = json.dumps({"digest": digest_of(DATA), "parent": head, "note": tenant}).encode()
    return service.ask("POST", f"{MAPS}/versions", body, tenant=tenant)


def contents(service: Service) -> dict[str, bytes]:
    """Return all that is stored, by name."""
    return {info.name: service.store.get(info.name) for info in service.store.list("")}


def move_head(version: str) -> bytes:
    return json.dumps({"version": version, "expected": version}).encode()


Request = tuple[str, str, bytes, str]
REQUESTS: dict[str, Callable[[str], Request]] = {
    "list versions": lambda version: ("GET", f"{MAPS}/versions", b"", ""),
    "read the head": lambda version: ("GET", f"{MAPS}/versions/head", b"", ""),
    "read a version": lambda version: ("GET", f"{MAPS}/versions/{version}", b"", ""),
    "download the head": lambda version: ("GET", f"{MAPS}/versions/head/content", b"", ""),
    "download a version": lambda version: ("GET", f"{MAPS}/versions/{version}/content", b"", ""),
    "move the head": lambda version: ("PUT", f"{MAPS}/head", move_head(version), ""),
    "remove versions": lambda version: ("DELETE", f"{MAPS}/versions", b"", "keep=1"),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_map_of_another_tenant_is_as_a_map_that_does_not_exist(service: Service, name: str) -> None:
    empty = Service(small_settings(), MemoryStore())
    version = commit(service, OWNER).json["id"]
    method, path, body, query = REQUESTS[name](version)
    before = contents(service)

    answer = service.ask(method, path, body, tenant=RIVAL, query=query)

    nowhere = empty.ask(method, path, body, tenant=RIVAL, query=query)
    assert (answer.status, answer.body) == (nowhere.status, nowhere.body)
    assert answer.status == 404
    assert contents(service) == before
    assert service.ask(method, path, body, tenant=OWNER, query=query).status == 200


def test_robots_of_one_name_commit_maps_of_one_name_in_two_tenants(service: Service) -> None:
    owned = commit(service, OWNER).json["record"]

    rivals = commit(service, RIVAL)

    assert (rivals.status, rivals.json["record"]["number"], rivals.json["record"]["note"]) == (201, 1, RIVAL)
    for tenant, note in ((OWNER, OWNER), (RIVAL, RIVAL)):
        listed = service.ask("GET", f"{MAPS}/versions", tenant=tenant).json
        assert [each["record"]["note"] for each in listed] == [note]
    assert service.ask("GET", f"{MAPS}/versions/head", tenant=OWNER).json["record"] == owned
