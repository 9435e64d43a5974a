"""Parts extend one file, which becomes the object, by any server and after any end of one."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path

import pytest

from rse_pf.errors import Busy, Conflict, NotFound
from rse_pf.storage.object_store import DirectoryStore, digest_of
from tests.kit.fake_data_service import Answer, Service, small_settings

DATA = bytes(n % 251 for n in range(10_000))
DIGEST = digest_of(DATA)
UPLOAD, OBJECT = f"/data/v1/uploads/{DIGEST}", f"/data/v1/objects/{DIGEST}"
PART = f"uploads/default/robot-1/{DIGEST}/part-{0:015d}"


@pytest.fixture
def store(tmp_path: Path) -> DirectoryStore:
    return DirectoryStore(tmp_path)


@pytest.fixture
def service(store: DirectoryStore) -> Service:
    made = Service(small_settings(), store)
    made.ask("PUT", UPLOAD, json.dumps({"size": len(DATA)}).encode())
    return made


def part(service: Service, start: int, end: int, data: bytes = DATA) -> Answer:
    return service.ask("PATCH", UPLOAD, data[start:end], headers={"upload-offset": str(start)})


def test_parts_extend_one_file_that_becomes_the_object(service: Service, store: DirectoryStore) -> None:
    part(service, 0, 4096)
    part(service, 4096, 8192)
    names = [info.name for info in store.list("uploads/")]
    before = os.stat(store._path(PART)).st_ino

    assert names == [PART, PART.replace(f"part-{0:015d}", "size")]
    assert part(service, 8192, 10_000).status == 201

    (info,) = store.list("objects/")
    assert os.stat(store._path(info.name)).st_ino == before
    assert service.ask("GET", OBJECT).body == DATA
    assert list(store.list("uploads/")) == []


@pytest.mark.parametrize("restarts", [(0,), (1,), (0, 1)])
def test_another_server_continues_the_file_and_judges_all_of_it(
    service: Service, store: DirectoryStore, restarts: tuple[int, ...]
) -> None:
    for number, (start, end) in enumerate([(0, 4096), (4096, 8192), (8192, 10_000)]):
        last = part(service, start, end)
        if number in restarts:
            service.restart()

    assert last.status == 201
    assert service.ask("GET", OBJECT).body == DATA


def test_an_upload_goes_on_behind_a_part_of_which_a_half_was_written(
    service: Service, store: DirectoryStore
) -> None:
    part(service, 0, 4096)
    store.append(PART, 4096, DATA[4096:5000])  # then the server was killed
    service.restart()

    assert service.ask("HEAD", UPLOAD).headers["upload-offset"] == "5000"
    assert part(service, 4096, 8192).status == 409
    part(service, 5000, 9000)
    assert part(service, 9000, 10_000).status == 201


@pytest.mark.parametrize("method", ["HEAD", "PUT"])
def test_an_upload_is_complete_whose_server_ended_when_the_object_had_its_name(
    service: Service, store: DirectoryStore, method: str
) -> None:
    store.append(PART, 0, DATA)
    store.adopt(f"objects/default/robot-1/{DIGEST}", PART, len(DATA))

    body = json.dumps({"size": len(DATA)}).encode() if method == "PUT" else b""
    assert service.ask(method, UPLOAD, body).headers["upload-offset"] == "10000"
    assert list(store.list("uploads/")) == []
    assert service.ask("GET", OBJECT).body == DATA


def test_only_one_writer_extends_a_file_and_nobody_after_it_became_an_object(store: DirectoryStore) -> None:
    store.append("uploads/a", 0, b"ab")
    with open(store._path("uploads/a"), "rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(Busy):
            store.append("uploads/a", 2, b"c")
        with pytest.raises(Busy):
            store.adopt("objects/a", "uploads/a", 2)
    for offset in (0, 1, 3):
        with pytest.raises(Conflict):
            store.append("uploads/a", offset, b"c")
    with pytest.raises(Conflict):
        store.adopt("objects/a", "uploads/a", 1)
    store.append("uploads/a", 2, b"c")
    store.adopt("objects/a", "uploads/a", 3)

    with pytest.raises(NotFound):
        store.append("uploads/a", 3, b"d")
    with pytest.raises(NotFound):
        store.adopt("objects/b", "uploads/a", 3)
    assert store.get("objects/a") == b"abc"


def test_the_digest_is_checked_over_bytes_that_another_server_wrote(
    service: Service, store: DirectoryStore
) -> None:
    part(service, 0, 4096)
    store.append(PART, 4096, b"x" * 4096)  # by another server; this one knows a hash of the first part

    assert part(service, 8192, 10_000).status == 400
    assert list(store.list("objects/")) == list(store.list("uploads/")) == []


def test_an_upload_that_another_server_completed_before_it_was_killed_becomes_an_object(
    service: Service, store: DirectoryStore
) -> None:
    part(service, 0, 4096)
    store.append(PART, 4096, DATA[4096:])  # by another server, which was then killed

    assert service.ask("HEAD", UPLOAD).headers["upload-offset"] == "10000"
    assert service.ask("GET", OBJECT).body == DATA


def test_parts_of_an_earlier_version_are_assembled(service: Service, store: DirectoryStore) -> None:
    store.put(PART, DATA[:4096])
    store.put(PART.replace(f"{0:015d}", f"{4096:015d}"), DATA[4096:8192])

    assert part(service, 8192, 10_000).status == 201
    assert service.ask("GET", OBJECT).body == DATA
