"""What tenants store: counted over all processes, reserved before it is written, bounded on a full disk."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from rse_pf.config import DataSettings
from rse_pf.errors import QuotaExceeded, StoreFull
from rse_pf.identity import RobotId, object_name
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore, MemoryStore, ObjectStore, charge_of, digest_of
from rse_pf.storage.quotas import Accounts, TenantAccount

MIB = 1 << 20


class Clock:
    """Unix time that passes only when the test says so."""

    def __init__(self) -> None:
        self.now_s = 1e9

    def __call__(self) -> float:
        return self.now_s


def account(store: ObjectStore, clock: Clock, quota: int, tenant: str = "acme") -> TenantAccount:
    return TenantAccount(store, tenant, DataSettings(tenant_quota_bytes=quota), wall_clock=clock)


class SmallDisk(DirectoryStore):
    """A folder on a disk of a given size, which really becomes full."""

    def __init__(self, folder: Path, size: int) -> None:
        super().__init__(folder)
        self._place, self._size = folder, size

    def space(self) -> tuple[int, int]:
        used = sum(charge_of(each.lstat().st_size) for each in self._place.rglob("*") if each.is_file())
        return max(0, self._size - used), self._size

    def put(self, name: str, data: bytes) -> None:
        if len(data) > self.space()[0]:
            raise StoreFull("no space left", hint="free some space")
        super().put(name, data)


def write(made: TenantAccount, store: ObjectStore, name: str, size: int) -> None:
    made.reserve(size)
    store.put(name, bytes(size))


def test_all_processes_together_stay_within_the_quota_of_a_tenant() -> None:
    store, clock = MemoryStore(), Clock()
    processes = [account(store, clock, 20 * MIB) for _ in range(4)]
    refused = 0

    for number in range(400):
        try:
            write(processes[number % 4], store, f"objects/acme/r/{number}", 100_000)
        except QuotaExceeded:
            refused += 1

    stored = sum(info.size for info in store.list("objects/acme/"))
    assert 18 * MIB < stored <= 20 * MIB
    assert refused > 0
    write(account(store, clock, 20 * MIB, "rival"), store, "objects/rival/r/1", 100_000)


def test_a_new_count_keeps_the_bytes_of_writes_in_progress_until_they_must_have_ended(tmp_path: Path) -> None:
    store, clock = DirectoryStore(tmp_path), Clock()
    writer, other = account(store, clock, 4 * MIB), account(store, clock, 4 * MIB)
    writer.reserve(3 * MIB)

    clock.now_s += 11.0  # a folder is counted again after 10 s, and the object may still be written
    with pytest.raises(QuotaExceeded):
        other.reserve(2 * MIB)

    clock.now_s += 20.0  # the writer was killed
    other.reserve(2 * MIB)


def test_threads_of_several_processes_stay_within_the_quota() -> None:
    store, clock = MemoryStore(), Clock()
    processes = [account(store, clock, 2 * MIB) for _ in range(3)]

    def work(own: int) -> None:
        for number in range(100):
            try:
                write(processes[own % 3], store, f"objects/acme/r/{own}-{number}", 8192)
            except QuotaExceeded:
                return

    threads = [threading.Thread(target=work, args=(own,)) for own in range(6)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()

    assert MIB < sum(info.size for info in store.list("objects/acme/")) <= 2 * MIB


def test_a_robot_of_the_same_name_in_another_tenant_has_a_quota_of_its_own() -> None:
    store = MemoryStore()
    accounts = Accounts(store, DataSettings(quota_bytes=MIB, tenant_quota_bytes=4 * MIB))
    robot, namesake = RobotId("acme", "r"), RobotId("rival", "r")
    with accounts.reservation(robot, 900_000):
        store.put(object_name(robot, digest_of(b"1")), bytes(900_000))

    with pytest.raises(QuotaExceeded):
        accounts.check_room(robot, 900_000)
    accounts.check_room(namesake, 900_000)
    accounts.release(namesake, 900_000)
    with pytest.raises(QuotaExceeded):
        accounts.check_room(robot, 900_000)


@pytest.mark.parametrize(
    "name",
    [
        "objects/acme/r/1", "maps/acme/kitchen/blobs/1", "live/acme/lab/log/000000000001",
        "live/acme/lab/features/000000001-1", "states/acme/r/keeper", "jobs/acme/r/1",
    ],
)  # fmt: skip
def test_whatever_lies_in_a_folder_of_the_tenant_is_charged_to_it(name: str) -> None:
    store, clock = MemoryStore(), Clock()
    store.put(name, bytes(MIB))

    with pytest.raises(QuotaExceeded, match="'acme' stores 1048576 bytes"):
        account(store, clock, MIB + 5000).reserve(6000)
    account(store, clock, MIB + 5000, "rival").reserve(6000)


def test_old_versions_of_a_map_and_unfinished_uploads_count() -> None:
    store, clock = MemoryStore(), Clock()
    store.put("uploads/acme/r/d/size", b"1000000 5")
    store.put("maps/acme/kitchen/blobs/old", bytes(500_000))
    store.put("maps/acme/kitchen/blobs/new", bytes(500_000))
    assert MapRegistry(store, "acme").names() == []

    with pytest.raises(QuotaExceeded):
        account(store, clock, 2_000_000).reserve(1)


def test_who_deletes_may_write_again_in_this_process_at_once_and_in_others_soon() -> None:
    store, clock = MemoryStore(), Clock()
    accounts = Accounts(store, DataSettings(tenant_quota_bytes=MIB), wall_clock=clock)
    robot = RobotId("acme", "r")
    name = object_name(robot, digest_of(b"x"))
    with accounts.reservation(robot, MIB - 8192):
        store.put(name, bytes(MIB - 8192))
    with pytest.raises(QuotaExceeded), accounts.reservation(robot, 20_000):
        pass

    store.delete(name)
    accounts.release(robot, MIB - 8192)
    with accounts.reservation(robot, 20_000):
        pass

    clock.now_s += 100.0
    account(store, clock, MIB).reserve(900_000)


def test_on_a_disk_that_fills_up_the_tenant_that_fills_it_is_refused_and_others_go_on(tmp_path: Path) -> None:
    store, clock = SmallDisk(tmp_path, 20 * MIB), Clock()
    filler, other = account(store, clock, 1 << 40), account(store, clock, 1 << 40, "rival")
    for number in range(165):
        write(filler, store, f"objects/acme/r/{number}", 100_000)

    def fill() -> None:
        for number in range(1000):
            write(filler, store, f"objects/acme/r/more-{number}", 100_000)

    with pytest.raises(StoreFull, match="'acme' holds"):
        fill()
    assert store.space()[0] >= 2 * MIB - 100_000
    for number in range(15):
        write(other, store, f"objects/rival/r/{number}", 100_000)
    clock.now_s += 60.0
    with pytest.raises(StoreFull):
        filler.reserve(100_000)


def test_a_write_that_fails_is_not_charged() -> None:
    store, clock = MemoryStore(), Clock()
    accounts = Accounts(store, DataSettings(tenant_quota_bytes=MIB), wall_clock=clock)
    for _ in range(50):
        with pytest.raises(StoreFull), accounts.reservation(RobotId("acme", "r"), 500_000):
            raise StoreFull("no space")


def test_a_damaged_account_is_counted_anew() -> None:
    store, clock = MemoryStore(), Clock()
    store.put("accounts/acme", b"no account")
    store.put("objects/acme/r/1", bytes(MIB))

    with pytest.raises(QuotaExceeded):
        account(store, clock, MIB).reserve(1)
