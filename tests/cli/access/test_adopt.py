"""A robot gets what was stored under an older identity only when the operator says so."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.cli.access.adopt import adopt
from rse_pf.cli.main import main
from rse_pf.identity import RobotId, object_name, state_name
from rse_pf.storage.object_store import DirectoryStore, MemoryStore, ObjectStore, digest_of
from rse_pf.storage.quotas import charge_name
from tests.kit.fake_data_service import Service, small_settings

Capture = pytest.CaptureFixture[str]
OLD = RobotId("default", "robot-1")
DATA = b"a picture"


def run(capsys: Capture, *words: str) -> str:
    assert main(list(words)) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def enrol(capsys: Capture, name: str = "robot-1") -> RobotId:
    """Enrol *name* with a new key and return its identity."""
    key = Path(f"{len(list(Path().iterdir()))}.key")
    public = run(capsys, "robot", "keygen", "--out", str(key))
    key.with_suffix(".json").write_text(public)
    run(capsys, "robot", "enrol", name, "--public-key", str(key.with_suffix(".json")))
    x = public_key_of(public)
    return EnrolledRobot(robot=name, x=x).id


def stored_for(store: ObjectStore, robot: RobotId) -> str:
    name = object_name(robot, digest_of(DATA))
    store.put(name, DATA)
    store.put(charge_name(robot, "kitchen", "0" * 64, 5), b"")
    store.put(state_name(robot, "counter"), b"7")
    return name


def test_a_name_with_another_key_sees_nothing_and_after_adoption_everything(
    capsys: Capture, platform: Path
) -> None:
    store, first = DirectoryStore(platform / "objects"), enrol(capsys)
    stored_for(store, first)
    run(capsys, "robot", "remove", "robot-1")

    second = enrol(capsys)
    before = [info.name for info in store.list(f"objects/{second.folder}/")]
    said = run(capsys, "robot", "adopt", "robot-1", "--from-key", f"robot:{first.enrolment}")

    assert before == []
    assert "1 object more, 9 bytes, and 1 snapshot of" in said
    assert store.get(object_name(second, digest_of(DATA))) == DATA
    assert store.get(state_name(second, "counter")) == b"7"
    assert {info.name.split("/")[0] for info in store.list()} == {"objects", "charges", "states"}
    assert all(second.folder in info.name for info in store.list())


def test_a_second_enrolment_names_the_command_that_keeps_what_was_stored(
    capsys: Capture, platform: Path
) -> None:
    first = enrol(capsys)
    (platform / "objects").mkdir(exist_ok=True)
    stored_for(DirectoryStore(platform / "objects"), first)

    Path("second.json").write_text(run(capsys, "robot", "keygen", "--out", "second.key"))
    said = run(capsys, "robot", "enrol", "robot-1", "--public-key", "second.json")

    command = said.splitlines()[1].split("rse-pf ")[1].split()
    assert "1 object more" in run(capsys, *command)


def test_what_was_stored_without_a_key_is_adopted(capsys: Capture, platform: Path) -> None:
    store, robot = DirectoryStore(platform / "objects"), enrol(capsys)
    store.put(object_name(OLD, digest_of(DATA)), DATA)
    store.put(state_name(OLD, "counter"), b"7")

    run(capsys, "robot", "adopt", "robot-1")
    again = run(capsys, "robot", "adopt", "robot-1")

    assert store.get(object_name(robot, digest_of(DATA))) == DATA
    assert store.get(state_name(robot, "counter")) == b"7"
    assert "0 objects more" in again
    assert len(list(store.list())) == 2


def test_a_newer_snapshot_stays_and_the_older_one_is_not_removed(capsys: Capture, platform: Path) -> None:
    store, robot = DirectoryStore(platform / "objects"), enrol(capsys)
    store.put(state_name(OLD, "counter"), b"7")
    store.put(state_name(robot, "counter"), b"8")

    said = run(capsys, "robot", "adopt", "robot-1")

    assert "'counter' is newer" in said
    assert store.get(state_name(robot, "counter")) == b"8"
    assert store.get(state_name(OLD, "counter")) == b"7"


def test_an_interrupted_adoption_is_continued() -> None:
    store, robot = MemoryStore(), OLD._replace(enrolment="k" * 43)
    stored_for(store, OLD)
    store.put(object_name(robot, digest_of(DATA)), DATA)  # copied, and not yet removed
    store.put(state_name(robot, "counter"), b"7")

    adopted = adopt(store, robot, source=OLD)

    assert (adopted.objects, adopted.kept) == (1, ())
    assert all(robot.folder in info.name for info in store.list())


@pytest.mark.parametrize("key", ["robot-1", "robot:short", "../x"])
def test_a_key_that_is_none_is_refused(capsys: Capture, platform: Path, key: str) -> None:
    (platform / "objects").mkdir()

    assert main(["robot", "adopt", "robot-1", "--from-key", key]) == 2
    assert "hint" in capsys.readouterr().err


def test_a_new_key_under_an_old_name_reads_and_counts_nothing_of_the_old_one(tmp_path: Path) -> None:
    """The same as the data service sees it: objects, uploads and the quota."""
    store = DirectoryStore(tmp_path)
    stored_for(store, OLD._replace(enrolment="k" * 43))
    service = Service(small_settings(quota_bytes=4096), store)

    assert service.ask("GET", f"/data/v1/objects/{digest_of(DATA)}").status == 404
    assert service.ask("GET", "/data/v1/objects").json["objects"] == []
    assert service.ask("PUT", f"/data/v1/objects/{digest_of(b'x')}", b"x").status == 201


def test_a_robot_without_another_identity_adopts_nothing() -> None:
    store = MemoryStore()
    name = stored_for(store, OLD)

    adopted = adopt(store, OLD, source=OLD)

    assert (adopted.objects, adopted.snapshots) == (0, 0)
    assert store.get(name) == DATA
    assert store.get(state_name(OLD, "counter")) == b"7"


def test_another_tenants_robot_of_the_same_name_keeps_its_own() -> None:
    store, other = MemoryStore(), OLD._replace(tenant="rival")
    mine = stored_for(store, other)

    adopt(store, OLD._replace(enrolment="k" * 43), source=OLD)

    assert store.get(mine) == DATA
