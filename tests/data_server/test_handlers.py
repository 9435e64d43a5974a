"""Maps over HTTP: commit, conflict, read, roll back."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import digest_of
from tests.kit.fake_data_service import Answer, Service, small_settings
from tests.kit.fake_store import FakeStore

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


def test_an_invalid_map_or_an_object_of_another_robot_is_refused(service: Service) -> None:
    service.ask("PUT", f"/data/v1/objects/{digest_of(b'x')}", b"x")
    body = json.dumps({"digest": digest_of(b"x")}).encode()

    assert service.ask("POST", f"{MAPS}/versions", body).status == 400
    assert service.ask("POST", f"{MAPS}/versions", body, robot="robot-2").status == 404
    assert service.ask("POST", f"{MAPS}/versions", b"{").status == 400
    assert service.ask("GET", "/data/v1/maps/none/versions").status == 404


def test_more_uploads_at_once_than_allowed_are_busy() -> None:
    def ask_while_it_writes(operation: str, name: str, data: bytes) -> None:
        if operation == "put" and not answers:
            with ThreadPoolExecutor(1) as pool:
                path = f"/data/v1/objects/{'0' * 64}"
                answers.append(pool.submit(service.ask, "PUT", path, b"y").result(30))

    answers: list[Answer] = []
    service = Service(small_settings(max_uploads=1), FakeStore(ask_while_it_writes))

    outer = service.ask("PUT", f"/data/v1/objects/{digest_of(b'x')}", b"x")

    (inner,) = answers
    assert (inner.status, inner.json["code"], outer.status) == (503, "busy", 201)
    assert inner.headers["retry-after"] == "1"
