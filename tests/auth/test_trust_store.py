"""The access control store: changed by compare-and-swap, read without ever forgetting."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.auth.roster import DenyList, EnrolledRobot
from rse_pf.auth.tokens import Claims, SigningKey
from rse_pf.auth.trust_store import DENY_NAME, AccessControlStore, TrustStore, key_set_from_snapshot
from rse_pf.errors import ConfigurationError, Conflict
from rse_pf.identity import RobotId
from rse_pf.storage.object_store import DirectoryStore, MemoryStore

KEY = SigningKey.from_seed(b"p" * 32, "p1")
CLAIMS = Claims(robot=RobotId("default", "r"), token_id="t", issued_s=0.0, expires_s=9.0, key_id="p1")


def with_robot(denied: DenyList) -> DenyList:
    return denied.with_robot("default", "r", 1.0)


@pytest.fixture
def keys_file(tmp_path: Path) -> Path:
    file = tmp_path / "keys.json"
    file.write_text(KEY.key_set().to_json())
    return file


@pytest.fixture
def room(keys_file: Path) -> AccessControlStore:
    return AccessControlStore(DirectoryStore(keys_file.parent))


class Racing(MemoryStore):
    """Another operator writes between our read and our write, *races* times."""

    def __init__(self, races: int) -> None:
        super().__init__()
        self.races = races

    def get(self, name: str) -> bytes:
        try:
            return super().get(name)
        finally:
            if self.races:
                self.races -= 1
                other = AccessControlStore(_Quiet(self))
                other.change_deny_list(
                    lambda denied: denied.with_robot("default", f"other-{self.races}", 1.0)
                )


class _Quiet:
    """The same store without its races."""

    def __init__(self, store: MemoryStore) -> None:
        self._store = store

    def get(self, name: str) -> bytes:
        return MemoryStore.get(self._store, name)

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        MemoryStore.compare_and_swap(self._store, name, expected, data)


def test_two_operators_at_once_lose_nothing():
    store = Racing(races=3)

    AccessControlStore(store).change_deny_list(with_robot)

    assert {each.robot for each in AccessControlStore(store).deny_list().disabled} == {
        "r", "other-0", "other-1", "other-2",
    }  # fmt: skip


def test_endless_races_end_with_an_error():
    with pytest.raises(Conflict):
        AccessControlStore(Racing(races=1000)).change_deny_list(with_robot)


def test_a_refresh_finds_changes_and_the_snapshot_holds_them(keys_file: Path, room: AccessControlStore):
    trust = TrustStore(keys_file)
    trust.load()
    room.change_deny_list(with_robot)
    room.change_roster(lambda roster: roster.enrolled(EnrolledRobot(robot="n", x="A" * 43)))

    assert trust.refresh() is True
    keys = key_set_from_snapshot(trust.snapshot)
    assert keys.denies(CLAIMS) == "disabled"
    assert keys.robot_of(EnrolledRobot(robot="n", x="A" * 43).key_id) is not None
    assert trust.refresh() is False


@pytest.mark.parametrize("harm", ["nonsense", "empty", "gone", "folder"])
def test_a_list_that_becomes_unreadable_stays_as_it_was_known(
    keys_file: Path, room: AccessControlStore, harm: str
):
    room.change_deny_list(with_robot)
    trust = TrustStore(keys_file)
    trust.load()
    file = keys_file.parent / DENY_NAME
    if harm in ("gone", "folder"):
        file.unlink()
        if harm == "folder":
            file.mkdir()
    else:
        file.write_bytes(b"{" if harm == "nonsense" else b"")

    assert trust.refresh() is False
    assert trust.problem
    assert trust.keys is not None
    assert trust.keys.denies(CLAIMS) == "disabled"


def test_keys_that_vanish_stay_known_and_new_denials_are_still_seen(
    keys_file: Path, room: AccessControlStore
):
    trust = TrustStore(keys_file)
    trust.load()
    keys_file.unlink()
    room.change_deny_list(with_robot)

    assert trust.refresh() is True
    assert trust.keys is not None
    assert trust.keys.get("p1") is not None
    assert trust.keys.denies(CLAIMS) == "disabled"


@pytest.mark.parametrize("name", ["keys.json", "control/deny.json", "control/robots.json"])
def test_a_first_load_with_an_unreadable_part_is_an_error(keys_file: Path, name: str):
    (keys_file.parent / "control").mkdir()
    (keys_file.parent / name).write_text("nonsense")

    with pytest.raises(
        ConfigurationError, match="cannot read the keys, the roster or the deny list"
    ) as caught:
        TrustStore(keys_file).load()

    assert str(keys_file) in caught.value.hint


def test_the_snapshot_holds_no_private_key(keys_file: Path):
    trust = TrustStore(keys_file)
    trust.load()

    assert "d" not in json.loads(json.loads(trust.snapshot)["keys"])["keys"][0]
