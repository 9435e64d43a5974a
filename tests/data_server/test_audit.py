"""The audit log of the data service: who changed which map, and a bounded number of refused tokens."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.audit.entry import REFUSAL_BURST, Entry
from rse_pf.audit.log import AuditLog, read_entries
from rse_pf.data_server.app import DataServer
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import KEY, Service, small_settings

MAPS = "/data/v1/maps/kitchen"


class Recorded(Service):
    """A service with an audit log."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.log = AuditLog(folder, "data", wall_clock=lambda: 1e9, on_problem=pytest.fail).open()
        super().__init__(small_settings(), MemoryStore())

    def restart(self) -> None:
        self.app = DataServer(
            self.settings, self.store, keys=KEY.key_set, log=self.lines.append, clock=lambda: self.now,
            wall_clock=lambda: self.wall, describe=self.describe, audit=self.log,
        )  # fmt: skip

    def entries(self) -> list[Entry]:
        self.app.record_counted()
        self.log.flush()
        return list(read_entries(self.folder / "data.jsonl"))

    def commit(self, seed: int, parent: str | None, *, robot: str, tenant: str = "default") -> str:
        data = encode_map(MapVersion(keyframes=(), provenance={"seed": seed}))
        self.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, robot=robot, tenant=tenant)
        body = json.dumps({"digest": digest_of(data), "parent": parent, "note": "n"}).encode()
        return str(self.ask("POST", f"{MAPS}/versions", body, robot=robot, tenant=tenant).json["id"])


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    service = Recorded(tmp_path)
    yield service
    service.log.close()


def test_commits_and_rollbacks_are_recorded_with_robot_map_and_version(recorded: Recorded) -> None:
    first = recorded.commit(1, None, robot="robot-1")
    second = recorded.commit(2, first, robot="robot-2")
    body = json.dumps({"version": first, "expected": second}).encode()
    assert recorded.ask("PUT", f"{MAPS}/head", body, robot="robot-3").status == 200

    assert [(e.action, e.actor, e.subject, e.detail["version"]) for e in recorded.entries()] == [
        ("map.commit", "robot-1", "kitchen", first),
        ("map.commit", "robot-2", "kitchen", second),
        ("map.head", "robot-3", "kitchen", first),
    ]


def test_who_removed_a_version_is_recorded(recorded: Recorded) -> None:
    first = recorded.commit(1, None, robot="robot-1")
    recorded.commit(2, first, robot="robot-1")
    assert recorded.ask("DELETE", f"{MAPS}/versions", query="keep=1", robot="robot-2").status == 200

    last = list(recorded.entries())[-1]
    assert (last.action, last.actor, last.subject) == ("map.remove", "robot-2", "kitchen")
    assert (last.detail["version"], last.detail["number"]) == (first, 1)


def test_refused_tokens_are_recorded_and_a_flood_of_them_is_counted(recorded: Recorded) -> None:
    burst = REFUSAL_BURST
    for _ in range(burst + 30):
        assert recorded.ask("GET", "/data/v1/maps", token="nonsense").status == 401

    entries = recorded.entries()

    assert [entry.action for entry in entries] == ["auth.refused"] * burst + ["auth.refused-many"]
    assert sum(int(str(count)) for count in entries[-1].detail.values()) == 30
    assert entries[0].detail["reason"] != ""


def test_a_refused_token_is_recorded_with_its_address_and_what_it_claims(recorded: Recorded) -> None:
    forged = recorded.token("robot-9", "acme")[:-4] + "AAAA"
    headers = {"x-forwarded-for": "6.6.6.6, 192.0.2.7"}

    assert recorded.ask("GET", "/data/v1/maps", token=forged, headers=headers).status == 401

    (entry,) = recorded.entries()
    claimed = {name: entry.detail[name] for name in ("source", "claimed_robot", "claimed_tenant")}
    assert claimed == {"source": "192.0.2.7", "claimed_robot": "robot-9", "claimed_tenant": "acme"}
    assert {name: recorded.lines[-1][name] for name in claimed} == claimed
    assert "robot" not in recorded.lines[-1], "nobody verified the name"
