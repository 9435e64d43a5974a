"""Uploads in parts: any server resumes them, and only bytes with the right digest become an object."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from rse_pf.data_server.uploads import UPLOAD_TTL_S
from rse_pf.storage.object_store import DirectoryStore, digest_of
from tests.kit.fake_data_service import Answer, Service, small_settings
from tests.kit.fake_store import FakeStore, do_nothing, fail_with

DATA = bytes(n % 251 for n in range(10_000))
DIGEST = digest_of(DATA)
UPLOAD, OBJECT = f"/data/v1/uploads/{DIGEST}", f"/data/v1/objects/{DIGEST}"


def begin(service: Service, size: int = len(DATA)) -> Answer:
    return service.ask("PUT", UPLOAD, json.dumps({"size": size}).encode())


def part(service: Service, start: int, end: int, data: bytes = DATA) -> Answer:
    return service.ask("PATCH", UPLOAD, data[start:end], headers={"upload-offset": str(start)})


def test_another_server_resumes_the_upload_of_a_killed_one(service: Service) -> None:
    begin(service)
    part(service, 0, 4096)

    service.restart()

    assert service.ask("HEAD", UPLOAD).headers["upload-offset"] == "4096"
    part(service, 4096, 8192)
    service.restart()
    assert part(service, 8192, 10_000).status == 201


def test_an_upload_whose_server_was_killed_after_the_last_part_is_completed(service: Service) -> None:
    begin(service)
    part(service, 0, 4096)
    part(service, 4096, 8192)
    (size,) = [info.name for info in service.store.list("uploads/") if info.name.endswith("/size")]
    service.store.put(size.replace("/size", f"/part-{8192:015d}"), DATA[8192:])  # stored, then killed

    assert begin(service).json["offset"] == 10_000

    assert service.ask("GET", OBJECT).body == DATA


def test_a_part_at_the_wrong_offset_is_a_conflict_that_names_the_right_one(service: Service) -> None:
    begin(service)
    part(service, 0, 4096)

    for start in (0, 100, 8192):
        answer = part(service, start, start + 10)
        assert answer.status == 409
        assert "4096" in answer.json["message"]
    assert part(service, 4096, 8192).status == 200


def test_wrong_bytes_never_become_an_object_and_are_removed(service: Service) -> None:
    begin(service)
    wrong = b"x" * 10_000
    part(service, 0, 4096, wrong)
    part(service, 4096, 8192, wrong)

    assert part(service, 8192, 10_000, wrong).status == 400

    assert [info.name for info in service.store.list() if not info.name.startswith("accounts/")] == []
    assert service.ask("GET", UPLOAD).status == 404


def test_more_bytes_than_announced_are_refused(service: Service) -> None:
    begin(service, 100)

    assert part(service, 0, 101).status == 400
    assert begin(service, 200).status == 409


def test_parts_are_not_flushed_to_the_disk_but_the_object_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, synced = DirectoryStore(tmp_path), []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(handle) or fsync(handle))
    service = Service(small_settings(), store)
    begin(service)
    at_begin = len(synced)

    part(service, 0, 4096)
    part(service, 4096, 8192)
    between = len(synced)
    assert part(service, 8192, 10_000).status == 201

    assert at_begin > 0, "that an upload was begun is promised"
    assert between == at_begin
    assert len(synced) > between
    assert store.get(next(store.list("objects/")).name) == DATA


def test_an_upload_resumes_after_a_part_that_a_crash_cut_short(service: Service) -> None:
    begin(service)
    part(service, 0, 4096)
    part(service, 4096, 8192)
    first = next(
        info.name for info in service.store.list("uploads/") if info.name.endswith("part-" + "0" * 15)
    )
    service.store.put(first, DATA[:1000])

    assert begin(service).json["offset"] == 1000
    assert part(service, 1000, 5000).json["offset"] == 5000
    assert part(service, 5000, 9000).json["offset"] == 9000
    assert part(service, 9000, 10_000).status == 201

    assert service.ask("GET", OBJECT).body == DATA


def test_a_robot_cannot_see_or_continue_the_upload_of_another(service: Service) -> None:
    begin(service)

    assert service.ask("GET", UPLOAD, robot="robot-2").status == 404
    headers = {"upload-offset": "0"}
    assert service.ask("PATCH", UPLOAD, b"x", robot="robot-2", headers=headers).status == 404
    assert service.ask("DELETE", UPLOAD, robot="robot-2").status == 204
    assert service.ask("GET", UPLOAD).status == 200


def test_old_uploads_and_orphaned_parts_are_removed_and_new_uploads_are_not(service: Service) -> None:
    begin(service)
    part(service, 0, 4096)
    service.store.put(f"uploads/default/robot-9/{DIGEST}/part-{0:015d}", b"left by a crash")

    assert service.app.handlers.objects.sweep() == 1
    assert service.ask("GET", UPLOAD).json["offset"] == 4096
    service.wall += UPLOAD_TTL_S + 1
    assert service.app.handlers.objects.sweep() == 1
    assert [info.name for info in service.store.list() if not info.name.startswith("accounts/")] == []


def test_a_crash_while_the_object_is_written_loses_no_part() -> None:
    store = FakeStore(fail_with(SystemExit(), "put", part="objects/"))
    service = Service(small_settings(), store)
    begin(service)
    part(service, 0, 4096)
    part(service, 4096, 8192)
    with pytest.raises(SystemExit):
        part(service, 8192, 10_000)

    store.before = do_nothing
    service.restart()

    assert begin(service).json["offset"] == 10_000
    assert service.ask("GET", OBJECT).body == DATA
