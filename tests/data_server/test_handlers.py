"""Maps over HTTP: commit, conflict, read, roll back."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import Answer, Service, small_settings

MAPS = "/data/v1/maps/kitchen"


def send(service: Service, seed: int, parent: str | None, robot: str = "robot-1") -> Answer:
    data = encode_map(MapVersion(keyframes=(), provenance={"seed": seed}))
    service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, robot=robot)
    body = {"digest": digest_of(data), "parent": parent, "note": f"seed {seed}"}
    return service.ask("POST", f"{MAPS}/versions", json.dumps(body).encode(), robot=robot)


def test_every_robot_of_the_tenant_sees_a_committed_map(service: Service) -> None:
    first = send(service, 1, None)
    second = send(service, 2, first.json["id"], robot="robot-2")

    assert (first.status, second.status) == (201, 201)
    assert second.json["record"]["author"] == "robot-2"
    maps = service.ask("GET", "/data/v1/maps", robot="robot-3").json["maps"]
    assert maps == [{"name": "kitchen", "head": second.json["id"]}]
    numbers = [each["record"]["number"] for each in service.ask("GET", f"{MAPS}/versions").json]
    assert numbers == [1, 2]
    assert service.ask("GET", f"{MAPS}/versions/head", robot="robot-3").json == second.json
    content = service.ask("GET", f"{MAPS}/versions/head/content", robot="robot-3")
    assert digest_of(content.body) == second.json["record"]["digest"]
    assert service.ask("GET", "/data/v1/maps", tenant="other").json["maps"] == []


def test_the_second_commit_on_one_head_is_a_conflict_and_changes_nothing(service: Service) -> None:
    first = send(service, 1, None)
    send(service, 2, first.json["id"])

    assert send(service, 3, first.json["id"]).status == 409
    assert service.ask("GET", f"{MAPS}/versions/head").json["record"]["note"] == "seed 2"


def test_a_map_survives_the_deletion_of_its_object(service: Service) -> None:
    made = send(service, 1, None).json["record"]["digest"]

    service.ask("DELETE", f"/data/v1/objects/{made}")

    assert digest_of(service.ask("GET", f"{MAPS}/versions/head/content").body) == made


def test_a_rollback_moves_the_head(service: Service) -> None:
    first = send(service, 1, None).json["id"]
    second = send(service, 2, first).json["id"]

    body = json.dumps({"version": first, "expected": second}).encode()
    assert service.ask("PUT", f"{MAPS}/head", body).status == 200
    assert service.ask("PUT", f"{MAPS}/head", body).status == 409
    assert service.ask("GET", f"{MAPS}/versions/head").json["id"] == first


def test_an_invalid_map_or_an_object_of_another_robot_is_refused(service: Service) -> None:
    service.ask("PUT", f"/data/v1/objects/{digest_of(b'x')}", b"x")
    body = json.dumps({"digest": digest_of(b"x")}).encode()

    assert service.ask("POST", f"{MAPS}/versions", body).status == 400
    assert service.ask("POST", f"{MAPS}/versions", body, robot="robot-2").status == 404
    assert service.ask("POST", f"{MAPS}/versions", b"{").status == 400
    assert service.ask("GET", "/data/v1/maps/none/versions").status == 404


class AsksWhileItWrites(MemoryStore):
    """A store that sends another request while it writes the first object."""

    service: Service
    inner: Answer | None = None

    def put(self, name: str, data: bytes) -> None:
        if self.inner is None:
            with ThreadPoolExecutor(1) as pool:
                path = f"/data/v1/objects/{'0' * 64}"
                self.inner = pool.submit(self.service.ask, "PUT", path, b"y").result(30)
        super().put(name, data)


def test_more_uploads_at_once_than_allowed_are_busy() -> None:
    store = AsksWhileItWrites()
    service = store.service = Service(small_settings(max_uploads=1), store)

    outer = service.ask("PUT", f"/data/v1/objects/{digest_of(b'x')}", b"x")

    assert store.inner is not None
    assert (store.inner.status, store.inner.json["code"], outer.status) == (503, "busy", 201)
    assert store.inner.headers["retry-after"] == "1"
