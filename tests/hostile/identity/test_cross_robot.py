"""Fifty robots try each other's objects and uploads: nothing is read, nothing written, always 404 (T5)."""

from __future__ import annotations

import hashlib

import pytest

from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_data_service import Service, small_settings

ROBOTS = 50


def secret_of(number: int) -> bytes:
    return f"what only robot-{number} knows".encode()


def digest_of(number: int) -> str:
    return hashlib.sha256(secret_of(number)).hexdigest()


@pytest.fixture(scope="module")
def service() -> Service:
    """Every robot has an object and an unfinished upload."""
    made = Service(small_settings(), MemoryStore())
    for number in range(ROBOTS):
        robot, digest = f"robot-{number}", digest_of(number)
        assert made.ask("PUT", f"/data/v1/objects/{digest}", secret_of(number), robot=robot).status == 201
    return made


@pytest.mark.parametrize("tenant", ["default", "another"])
def test_the_objects_of_others_are_not_found_by_any_method(service: Service, tenant: str) -> None:
    before = {info.name: service.store.get(info.name) for info in service.store.list("")}
    answers: list[tuple[int, str]] = []
    first = 1 if tenant == "default" else 0  # in another tenant, a robot of the same name is a thief, too
    for thief in range(ROBOTS):
        for step in range(first, 3):
            owner = (thief + step * 17) % ROBOTS
            for method, place in (("GET", "objects"), ("HEAD", "objects"), ("GET", "uploads")):
                path = f"/data/v1/{place}/{digest_of(owner)}"
                answer = service.ask(method, path, robot=f"robot-{thief}", tenant=tenant)
                assert secret_of(owner) not in answer.body
                answers.append((answer.status, method))
            gone = service.ask(
                "DELETE", f"/data/v1/objects/{digest_of(owner)}", robot=f"robot-{thief}", tenant=tenant
            )
            assert gone.status in (204, 404)

    after = {info.name: service.store.get(info.name) for info in service.store.list("")}
    assert {status for status, _ in answers} == {404}
    assert len(answers) == ROBOTS * 3 * (3 - first)
    assert after == before


def test_a_list_names_what_the_robot_has_and_nothing_else(service: Service) -> None:
    for number in range(ROBOTS):
        listed = service.ask("GET", "/data/v1/objects", robot=f"robot-{number}").body.decode()

        assert digest_of(number) in listed
        assert not any(digest_of(other) in listed for other in range(ROBOTS) if other != number)


def test_a_thief_gets_the_same_answer_for_what_is_there_and_what_is_not(service: Service) -> None:
    nowhere = hashlib.sha256(b"nobody has this").hexdigest()

    there = service.ask("GET", f"/data/v1/objects/{digest_of(1)}", robot="robot-2")
    not_there = service.ask("GET", f"/data/v1/objects/{nowhere}", robot="robot-2")

    assert (there.status, there.body, there.headers) == (not_there.status, not_there.body, not_there.headers)


def test_a_robot_of_the_same_name_in_another_tenant_lists_stores_and_deletes_its_own() -> None:
    service, path = Service(small_settings(), MemoryStore()), f"/data/v1/objects/{digest_of(1)}"
    for tenant in ("default", "another"):
        assert service.ask("PUT", path, secret_of(1), tenant=tenant).status == 201

    assert service.ask("DELETE", path, tenant="another").status == 204

    assert service.ask("GET", path).body == secret_of(1)
    assert digest_of(1) not in service.ask("GET", "/data/v1/objects", tenant="another").body.decode()


def test_what_a_robot_writes_under_the_digest_of_another_is_its_own(service: Service) -> None:
    answer = service.ask("PUT", f"/data/v1/objects/{digest_of(3)}", b"another text", robot="robot-4")

    assert answer.status == 400
    owner = service.ask("GET", f"/data/v1/objects/{digest_of(3)}", robot="robot-3")
    assert owner.body == secret_of(3)
