"""What a robot may store: bytes, number of objects, unfinished uploads, and versions of maps."""

from __future__ import annotations

import json
import os
import urllib.parse
from pathlib import Path

import pytest

from rse_pf.config import DataSettings
from rse_pf.errors import QuotaExceeded, StoreFull
from rse_pf.identity import RobotId, object_name
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import DirectoryStore, MemoryStore, ObjectStore, digest_of
from rse_pf.storage.quotas import Accounts
from tests.kit.fake_data_service import Answer, Service, small_settings
from tests.kit.fake_store import FakeStore, fail_with

ROBOT = RobotId("default", "robot-1")


def put(service: Service, data: bytes, robot: str = "robot-1") -> Answer:
    return service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, robot=robot)


def commit(service: Service, seed: int, parent: str | None, *, name: str = "kitchen") -> Answer:
    data = encode_map(MapVersion(keyframes=(), provenance={"seed": seed, "filler": os.urandom(3000).hex()}))
    stored = put(service, data)
    if stored.status != 201:
        return stored
    body = json.dumps({"digest": digest_of(data), "parent": parent}).encode()
    answer = service.ask("POST", f"/data/v1/maps/{name}/versions", body)
    service.ask("DELETE", f"/data/v1/objects/{digest_of(data)}")
    return answer


def ledger(store: ObjectStore, now: list[float], **settings: int) -> Accounts:
    return Accounts(
        store,
        DataSettings(**{"quota_bytes": 20_480, **settings}),
        clock=lambda: now[0],
        wall_clock=lambda: 1e9 + now[0],
    )


def write(made: Accounts, store: ObjectStore, data: bytes) -> None:
    with made.reservation(ROBOT, len(data)):
        store.put(object_name(ROBOT, digest_of(data)), data)


def test_short_objects_end_at_the_quota_of_four_kib_each(service: Service) -> None:
    answers = [put(service, bytes([number])) for number in range(14)]  # 50,000 bytes

    assert [answer.status for answer in answers] == [201] * 12 + [413] * 2
    assert answers[-1].json["code"] == "quota"
    assert put(service, b"x", robot="robot-2").status == 201


def test_objects_end_at_their_number_also_after_a_restart() -> None:
    service = Service(small_settings(max_objects=3), MemoryStore())
    for number in range(3):
        assert put(service, bytes([number])).status == 201

    refused = put(service, b"x")
    service.restart()

    assert (refused.status, refused.json["code"]) == (413, "quota")
    assert "the limit is 3" in refused.json["message"]
    assert put(service, b"x").status == 413
    assert service.ask("DELETE", f"/data/v1/objects/{digest_of(bytes([0]))}").status == 204
    assert service.ask("DELETE", f"/data/v1/objects/{digest_of(bytes([0]))}").status == 204
    assert put(service, b"x").status == 201
    assert put(service, b"y").status == 413, "what was missing when it was deleted counts for nothing"


def test_committed_maps_count_for_their_author_although_the_objects_were_deleted() -> None:
    service = Service(small_settings(quota_bytes=30_000), MemoryStore())
    head, answers = None, []
    for seed in range(12):
        answers.append(commit(service, seed, head))
        head = answers[-1].json.get("id", head)
        if answers[-1].status != 201:
            break

    assert [answer.status for answer in answers[:-1]] == [201] * (len(answers) - 1)
    charged = sum(max(4096, answer.json["record"]["size"]) for answer in answers[:-1])
    assert 15_000 < charged <= 30_000
    assert (answers[-1].status, answers[-1].json["code"]) == (413, "quota")
    service.restart()
    begin = f"/data/v1/uploads/{0:064d}", b'{"size": 20000}'
    assert service.ask("PUT", *begin).status == 413
    assert service.ask("PUT", *begin, robot="robot-2").status == 200


VERSIONS = "/data/v1/maps/kitchen/versions"


def test_a_tenant_over_its_quota_removes_old_versions_and_commits_again() -> None:
    limits = {"tenant_quota_bytes": 60_000, "quota_bytes": 1_000_000, "max_requests_per_s": 1e6}
    service = Service(small_settings(**limits), MemoryStore())
    head, answer = None, commit(service, 0, None)
    while answer.status == 201:
        head = answer.json["id"]
        answer = commit(service, 1, head)
    assert (answer.status, answer.json["code"]) == (413, "quota")
    before = service.store.usage("").charged_bytes

    pruned = service.ask("DELETE", VERSIONS, query="keep=2", robot="robot-2")

    assert pruned.status == 200
    assert pruned.json["removed"] >= 2
    assert before - service.store.usage("maps/").charged_bytes >= pruned.json["freed_bytes"] > 0
    listed = service.ask("GET", VERSIONS).json
    assert [version["id"] for version in listed][-1] == head
    assert len(listed) == 2
    assert len(list(service.store.list("charges/"))) == 2
    again = commit(service, 2, head)
    assert again.status == 201, again.json
    assert service.ask("DELETE", VERSIONS, query="keep=2").json["removed"] == 1


def test_a_robot_whose_versions_were_removed_may_store_as_much_again() -> None:
    service = Service(small_settings(quota_bytes=30_000), MemoryStore())
    head, answer = None, commit(service, 0, None)
    while answer.status == 201:
        head = answer.json["id"]
        answer = commit(service, 1, head)

    assert service.ask("DELETE", VERSIONS, query="keep=1", robot="robot-2").status == 200

    assert commit(service, 2, head).status == 201


@pytest.mark.parametrize("query", ["", "keep=", "keep=0", "keep=-1", "keep=1e3", "keep=99999999", "keep=²"])
def test_how_many_versions_stay_is_a_number_above_zero(service: Service, query: str) -> None:
    commit(service, 1, None)

    answer = service.ask("DELETE", VERSIONS, query=urllib.parse.quote(query, safe="="))

    assert (answer.status, answer.json["code"]) == (400, "bad-request")
    assert len(service.ask("GET", VERSIONS).json) == 1


def test_another_tenant_removes_nothing(service: Service) -> None:
    first = commit(service, 1, None)
    commit(service, 2, first.json["id"])

    assert service.ask("DELETE", VERSIONS, query="keep=1", tenant="rival").status == 404
    assert len(service.ask("GET", VERSIONS).json) == 2


def test_a_refused_commit_charges_nothing(service: Service) -> None:
    first = commit(service, 1, None)
    before = [info.name for info in service.store.list("charges/")]

    assert commit(service, 2, None).status == 409
    assert commit(service, 3, "0" * 64).status == 409, "it may have been removed"

    assert first.status == 201
    assert [info.name for info in service.store.list("charges/")] == before
    (name,) = before
    assert name == f"charges/default/robot-1/kitchen/{first.json['id']}.{first.json['record']['size']}"


def test_a_commit_that_finds_the_disk_full_charges_nothing() -> None:
    service = Service(small_settings(), FakeStore(fail_with(StoreFull("no space"), "put", part="maps/")))

    assert commit(service, 1, None).status == 507
    assert [info.name for info in service.store.list()] == ["accounts/default"]


def test_a_robot_has_a_limit_of_unfinished_uploads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.data_server.uploads._MAX_OPEN_UPLOADS", 3)
    service = Service(small_settings(quota_bytes=1_000_000), MemoryStore())

    def begin(number: int) -> int:
        return service.ask("PUT", f"/data/v1/uploads/{number:064d}", b'{"size": 9}').status

    assert [begin(number) for number in range(4)] == [200, 200, 200, 413]
    assert begin(0) == 200
    service.ask("DELETE", f"/data/v1/uploads/{1:064d}")
    assert begin(4) == 200


def test_an_upload_in_many_short_parts_is_refused(service: Service) -> None:
    data = bytes(range(100))
    path = f"/data/v1/uploads/{digest_of(data)}"
    service.ask("PUT", path, b'{"size": 100}')

    def part(at: int) -> int:
        return service.ask("PATCH", path, data[at : at + 1], headers={"upload-offset": str(at)}).status

    statuses = [part(at) for at in range(65)]

    assert statuses == [200] * 64 + [413]
    assert sum(1 for _ in service.store.list("uploads/")) == 65


def test_the_ledger_sees_what_other_processes_stored_after_a_while(tmp_path: Path) -> None:
    now, store = [0.0], DirectoryStore(tmp_path)
    made = ledger(store, now)
    write(made, store, b"a")
    for number in range(4):
        store.put(object_name(ROBOT, digest_of(bytes([number]))), bytes([number]))

    write(made, store, b"b")  # within the error that the module states
    now[0] += 10.0

    with pytest.raises(QuotaExceeded):
        write(made, store, b"c")


def test_counting_again_reads_only_folders_that_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, store = [0.0], DirectoryStore(tmp_path)
    made = ledger(store, now, quota_bytes=10_000_000)
    for number in range(300):
        store.put(object_name(ROBOT, digest_of(b"%d" % number)), b"x")
    for folder in (tmp_path / object_name(ROBOT, "")).glob("**/"):
        os.utime(folder, (1, 1))
    write(made, store, b"first")
    read: list[str] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: read.append(str(path)) or scandir(path))

    now[0] += 10.0
    write(made, store, b"second")

    assert len({path for path in read if "+" in path}) <= 1, "the folder of the first write"


def test_an_object_that_is_written_while_the_robot_is_counted_counts_once() -> None:
    now, store = [0.0], MemoryStore()
    made = ledger(store, now, max_objects=4)
    with made.reservation(ROBOT, 1):
        store.put(object_name(ROBOT, "0" * 64), b"x")
        now[0] += 1000.0
        write(made, store, b"a")

    write(made, store, b"b")
    write(made, store, b"c")

    with pytest.raises(QuotaExceeded):
        write(made, store, b"d")


def test_a_refused_upload_costs_its_sender_the_rate_that_its_body_is_worth_and_nobody_else() -> None:
    service = Service(small_settings(max_requests_per_s=1.0), MemoryStore())  # four at once
    large = f"/data/v1/objects/{digest_of(b'large')}"

    assert put(service, b"small").status == 201
    assert service.ask("PUT", large, bytes(10 << 16)).status == 413
    service.now += 7.5  # 4 - 1 - 1 - 10 + 7.5 is below one
    refused = put(service, b"other")
    assert put(service, b"other", robot="robot-2").status == 201
    service.now += 2.0

    assert (refused.status, refused.headers["retry-after"]) == (429, "2")
    assert put(service, b"other").status == 201
