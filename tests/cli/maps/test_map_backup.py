"""Maps of one tenant are backed up in a file and restored, whole or not at all."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.storage import S3Store
from rse_pf.cli.main import main
from rse_pf.identity import RobotId
from rse_pf.local.firewall import ensure_key
from rse_pf.maps.format import encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.maps.removal import choose_superseded
from rse_pf.storage.object_store import DirectoryStore, ObjectStore, digest_of
from rse_pf.storage.quotas import charge_name, sum_charges
from tests.kit.fake_data_service import Service, small_settings
from tests.kit.sample_maps import make_map

Capture = pytest.CaptureFixture[str]
ROBOT = RobotId("acme", "robot-1")


@pytest.fixture
def store(platform: Path) -> DirectoryStore:
    """The objects of platform "default": maps hall (two versions) and attic of acme, hall of beta."""
    (platform / "objects").mkdir()
    store = DirectoryStore(platform / "objects")
    first = commit(store, "hall", 1)
    store.put(charge_name(ROBOT, "hall", first, 5000), b"")
    commit(store, "hall", 2)
    commit(store, "attic", 3)
    commit(store, "hall", 4, tenant="beta")
    return store


@pytest.fixture
def lab(platform: Path) -> DirectoryStore:
    """The store of another platform, which has stored nothing yet."""
    (platform.parent / "lab").mkdir()
    ensure_key(platform.parent / "lab", seed=b"l" * 32, key_id="l")
    return DirectoryStore(platform.parent / "lab" / "objects")


def commit(store: ObjectStore, name: str, seed: int, tenant: str = "acme") -> str:
    maps = MapRegistry(store, tenant)
    parent = maps.heads().get(name)
    data = encode_map(make_map(seed))
    return maps.commit(name, data, parent=parent, author="robot-1", created_s=float(seed)).id


def run(capsys: Capture, words: str) -> str:
    assert main(words.split()) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def refused(capsys: Capture, words: str) -> str:
    assert main(words.split()) in (1, 2)
    problem, hint = capsys.readouterr().err.splitlines()
    assert "hint: " in hint
    return f"{problem}\n{hint}"


def contents(store: DirectoryStore, tenant: str = "acme") -> dict[str, bytes]:
    return {info.name: store.get(info.name) for info in store.list() if info.name.split("/")[1] == tenant}


def without_account(objects: dict[str, bytes]) -> dict[str, bytes]:
    return {name: data for name, data in objects.items() if not name.startswith("accounts/")}


def test_maps_of_one_tenant_are_restored_with_all_versions_elsewhere(
    capsys: Capture, store: DirectoryStore, lab: DirectoryStore
) -> None:
    before = contents(store)

    said = run(capsys, "map backup acme.maps --tenant acme --name default")
    assert "2 maps of tenant 'acme' in dir:" in said
    assert "objects backed up in acme.maps" in said
    said = run(capsys, "map restore acme.maps --tenant acme --name lab")

    assert "objects: 3 versions written" in said
    assert without_account(contents(lab)) == before
    assert contents(lab, "beta") == {}
    assert sum_charges(lab, ROBOT).charged_bytes == 5000
    assert MapRegistry(lab, "acme").load("hall").keyframes
    assert Path("acme.maps").stat().st_mode & 0o077 == 0
    assert "0 versions written" in run(capsys, "map restore acme.maps --tenant acme --name lab")


def test_lost_versions_come_back_and_later_ones_stay(capsys: Capture, store: DirectoryStore) -> None:
    maps = MapRegistry(store, "acme")
    old = maps.head("hall")
    run(capsys, "map backup acme.maps --tenant acme")
    store.delete(maps.blob_name("attic", maps.head("attic")))
    for info in list(store.list("maps/acme/attic/")):
        store.delete(info.name)
    newer = commit(store, "hall", 5)
    before = contents(store)

    problem = refused(capsys, "map restore acme.maps --tenant acme")
    assert "maps exist and have another head: hall" in problem
    assert "--overwrite" in problem
    assert contents(store) == before
    run(capsys, "map restore acme.maps --tenant acme --overwrite")

    assert maps.head("hall").id == old.id
    assert maps.data("hall", newer)
    assert maps.data("attic")


def test_a_head_whose_record_was_lost_is_replaced(capsys: Capture, store: DirectoryStore) -> None:
    maps = MapRegistry(store, "acme")
    old = maps.head("hall").id
    run(capsys, "map backup acme.maps --tenant acme")
    lost = commit(store, "hall", 5)
    store.delete(next(info.name for info in store.list() if info.name.endswith(f"versions/{lost}")))

    run(capsys, "map restore acme.maps --tenant acme --overwrite")

    assert maps.head("hall").id == old


def test_maps_in_a_bucket_are_backed_up_and_restored(capsys: Capture, cloud: Any) -> None:
    bucket = S3Store(cloud, "maps")
    commit(bucket, "hall", 1)
    commit(bucket, "hall", 2)
    before = [(info.name, bucket.get(info.name)) for info in bucket.list()]
    run(capsys, "map backup acme.maps --tenant acme --store s3:maps")
    for name, _ in before:
        bucket.delete(name)

    assert "2 versions written" in run(capsys, "map restore acme.maps --tenant acme --store s3:maps")

    assert [(info.name, bucket.get(info.name)) for info in bucket.list("maps/")] == before


def test_a_damaged_version_is_repaired(capsys: Capture, store: DirectoryStore) -> None:
    maps = MapRegistry(store, "acme")
    record = maps.head("hall")
    run(capsys, "map backup acme.maps --tenant acme")
    whole = store.get(maps.blob_name("hall", record))
    store.put(maps.blob_name("hall", record), whole[:-1])

    assert "is damaged" in refused(capsys, "map backup damaged.maps --tenant acme")
    assert not Path("damaged.maps").exists()
    assert "1 version written" in run(capsys, "map restore acme.maps --tenant acme")

    assert maps.data("hall") == whole


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_file_that_was_cut_off_restores_nothing(
    capsys: Capture, store: DirectoryStore, lab: DirectoryStore, share: float
) -> None:
    run(capsys, "map backup acme.maps --tenant acme --name default")
    whole = Path("acme.maps").read_bytes()
    end = whole.index(b"backup.json") + 512  # behind it is only padding
    Path("acme.maps").write_bytes(whole[: int(end * share) // 512 * 512])

    assert "this is not a whole backup of maps" in refused(
        capsys, "map restore acme.maps --tenant acme --name lab"
    )
    assert list(lab.list()) == []


def test_a_file_that_was_changed_restores_nothing(
    capsys: Capture, store: DirectoryStore, lab: DirectoryStore
) -> None:
    run(capsys, "map backup acme.maps --tenant acme --name default")
    whole = Path("acme.maps").read_bytes()
    for at in range(600, len(whole), len(whole) // 40):
        if not whole[at]:
            continue  # padding
        Path("acme.maps").write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        code = main(["map", "restore", "acme.maps", "--tenant", "acme", "--name", "lab"])
        error = capsys.readouterr().err
        assert (code, len(error.splitlines())) == (2, 2), (at, error)
        assert list(lab.list()) == [], at


def archive_of(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return file.getvalue()


CONTENT = b'{"tenant":"acme","created_s":1,"heads":{%s}}'


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "not a whole backup"),
        (b"nonsense" * 200, "not a whole backup"),
        (archive_of({}), "its last member, backup.json, is missing"),
        (archive_of({"../../x": b""}), "does not belong into a backup"),
        (archive_of({f"hall/blobs/{digest_of(b'x')}": b"x"}), "its last member, backup.json, is missing"),
        (archive_of({f"hall/blobs/{digest_of(b'x')}": b"y", "backup.json": CONTENT % b""}), "sha256"),
        (archive_of({"backup.json": CONTENT % b'"hall":"%s"' % (b"0" * 64)}), "the head of a map is missing"),
        (archive_of({"backup.json": b"{}"}), "tenant"),
        (archive_of({"backup.json": CONTENT.replace(b"acme", b"beta") % b""}), "a backup of tenant 'beta'"),
    ],
)
def test_a_file_that_is_no_backup_is_one_line_and_a_hint(
    capsys: Capture, lab: DirectoryStore, data: bytes, problem: str
) -> None:
    Path("acme.maps").write_bytes(data)

    assert problem in refused(capsys, "map restore acme.maps --tenant acme --name lab")
    assert list(lab.list()) == []


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("map backup acme.maps --tenant acmee", "tenant 'acmee' has no maps"),
        ("map backup nowhere/acme.maps --tenant acme", "cannot write nowhere/acme.maps"),
        ("map restore missing.maps --tenant acme", "missing.maps"),
        ("map backup acme.maps --tenant acme --name nowhere", "there is no platform 'nowhere'"),
        ("map list --name default --store dir:.", "--store and --name"),
    ],
)
def test_a_wrong_command_is_one_line_and_a_hint(
    capsys: Capture, store: DirectoryStore, words: str, problem: str
) -> None:
    assert problem in refused(capsys, words)
    assert list(Path().glob("*.maps")) == []


def test_the_quota_of_the_tenant_holds_and_counts_what_was_restored(
    capsys: Capture, store: DirectoryStore, lab: DirectoryStore
) -> None:
    run(capsys, "map backup acme.maps --tenant acme --name default")
    lab.put("objects/acme/r/1", b"x")
    stored = sum(info.size for info in store.list("maps/acme/"))
    assert main(["tenant", "quota", "acme", "--quota", "data_bytes=9000", "--name", "lab"]) == 0
    capsys.readouterr()

    problem = refused(capsys, "map restore acme.maps --tenant acme --name lab")
    assert "above its own quota 9000" in problem
    assert MapRegistry(lab, "acme").names() == []
    assert list(lab.list("maps/")) == []
    run(capsys, "tenant quota acme --quota data_bytes=80000 --name lab")
    run(capsys, "map restore acme.maps --tenant acme --name lab")

    settings = small_settings(quota_bytes=1 << 30, part_bytes=1 << 20, max_object_bytes=1 << 20)
    service, data = Service(settings, lab), bytes(80_000 - stored)
    answer = service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, robot="r", tenant="acme")
    assert (answer.status, answer.json["code"]) == (413, "quota")


@pytest.mark.parametrize("read", range(12))
def test_a_backup_is_whole_when_a_robot_commits_and_removes_versions_before_any_of_its_reads(
    capsys: Capture, store: DirectoryStore, lab: DirectoryStore, monkeypatch: pytest.MonkeyPatch, read: int
) -> None:
    commit(store, "hall", 5)
    reads, get = iter(range(12)), DirectoryStore.get

    def late(self: DirectoryStore, name: str) -> bytes:
        if name.startswith("maps/acme/hall/") and next(reads, None) == read:
            monkeypatch.setattr(DirectoryStore, "get", get)
            commit(store, "hall", 6)
            maps = MapRegistry(store, "acme")
            maps.remove("hall", lambda records, head: choose_superseded(records, head, keep=1))
        return get(self, name)

    monkeypatch.setattr(DirectoryStore, "get", late)
    run(capsys, "map backup acme.maps --tenant acme --name default")
    run(capsys, "map restore acme.maps --tenant acme --name lab")

    maps = MapRegistry(lab, "acme")
    assert maps.data("hall")
    assert [maps.data("hall", record.id) for record in maps.versions("hall")]
