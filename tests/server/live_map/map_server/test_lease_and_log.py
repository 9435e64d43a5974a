"""The lease of a live map, its log in the object store, and the tokens between servers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import pytest

from rse_pf.errors import BadRequest, StoreError, Unauthorized
from rse_pf.live_map.events import MapServerChanged, encode_events
from rse_pf.server.live_map.connection_security import (
    TOKEN_S,
    ConnectionClaims,
    check_token,
    internal_key,
    make_token,
)
from rse_pf.server.live_map.lease import LeaseRecord, MapLease, decode_lease, map_folder, next_action
from rse_pf.server.live_map.map_server.log import LeaseLost, LiveLog, MapSnapshot
from rse_pf.server.live_map.map_server.state import MapState, restore
from rse_pf.storage.lease import Lease
from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_map import FAKE_MAP, FakeMap
from tests.kit.map_server_setup import FOLDER, LEASE, HandClock

LEASE_S = 1.5


def leased(store: MemoryStore, name: str, clock: HandClock) -> MapLease:
    return MapLease(store, LEASE, owner=name, server=name, clock=clock)


def log_of(store: MemoryStore, epoch: int = 1, **options: int) -> LiveLog:
    return LiveLog(store, FOLDER, owner=f"owner-{epoch}", epoch=epoch, **options)


def record(**changes: object) -> LeaseRecord:
    fields = {"state": "serving", "owner": "a", "epoch": 1, "server": "s", **changes}
    return msgspec.convert(fields, LeaseRecord)


@pytest.mark.parametrize(
    ("lease", "unchanged_s", "action"),
    [
        (None, 0.0, "claim"),
        (record(state="released"), 0.0, "claim"),
        (record(state="stopped"), 0.0, "claim"),
        (record(), 0.0, "connect"),
        (record(), 1.4, "connect"),
        (record(), 1.5, "claim"),
        (record(state="starting"), 1.4, "wait"),
        (record(state="starting"), 1.5, "claim"),
        (record(tries=2), 1.5, "claim"),
        (record(tries=4), 1.5, "wait"),
        (record(tries=4), 6.0, "claim"),
        (record(tries=50), 60.0, "claim"),
    ],
)
def test_a_map_is_taken_over_when_its_lease_has_ended(
    lease: LeaseRecord | None, unchanged_s: float, action: str
) -> None:
    assert next_action(lease, unchanged_s=unchanged_s, lease_s=LEASE_S) == action


def test_the_age_of_a_lease_counts_from_the_begin_of_its_last_write():
    store, clock = MemoryStore(), HandClock()
    lease = leased(store, "a", clock)

    assert lease.age_s > 1e9
    lease.claim(None)
    clock.now_s = 2.0

    assert lease.age_s == 2.0


def test_a_renewal_that_the_map_server_has_sent_is_no_change_when_it_is_read_later():
    """Otherwise the failure of a map server would be detected only after twice the lease."""
    store, clock = MemoryStore(), HandClock()
    lease, watch = leased(store, "a", clock), Lease(store, LEASE, decode_lease, clock)
    lease.claim(None)
    watch.read()
    lease.renew()
    clock.now_s = 1.0
    watch.note_beat(1)
    clock.now_s = 2.0
    watch.read()

    assert watch.unchanged_s == 1.0
    lease.renew()
    watch.read()
    assert watch.unchanged_s == 0.0


def test_a_map_server_that_finds_its_entry_number_taken_has_lost_the_lease():
    store = MemoryStore()
    old, new = log_of(store, 1), log_of(store, 2)
    assert old.write_entry(b"one") == 1

    assert [entry.events for entry in new.read_entries()] == [b"one"]
    assert new.write_entry(b"two") == 2
    with pytest.raises(LeaseLost):
        old.write_entry(b"other")
    assert [entry.events for entry in log_of(store, 3).read_entries()] == [b"one", b"two"]


def test_two_snapshots_are_kept_and_a_damaged_one_is_passed_over():
    store = MemoryStore()
    log = log_of(store)
    for number in range(1, 7):
        log.write_entry(b"x")
        if number % 2 == 0:
            log.write_snapshot(MapSnapshot(position=number, unmeasured=(number,), head=b"%d" % number))

    restored = log_of(store)
    assert next(restored.read_snapshots()) == MapSnapshot(position=6, unmeasured=(6,), head=b"6")
    assert restored.position == 6
    newest = f"{FOLDER}snapshot/{6:012d}"
    store.put(newest, store.get(newest)[:-1] + b"7")
    assert next(restored.read_snapshots()) == MapSnapshot(position=4, unmeasured=(4,), head=b"4")
    assert len(list(restored.read_entries())) == 2
    numbers = [int(info.name[-12:]) for info in store.list(f"{FOLDER}log/")]
    assert numbers == [5, 6]


def parts_in(store: MemoryStore) -> list[str]:
    """Return epoch and name of the parts of snapshots that are stored."""
    parts = [info.name.removeprefix(f"{FOLDER}features/") for info in store.list(f"{FOLDER}features/")]
    return [f"{int(name[:9])}{name[9:]}" for name in parts]


def test_snapshots_share_their_parts_and_none_is_kept_that_no_snapshot_needs():
    store = MemoryStore()
    log = log_of(store)

    def write(position: int, **parts: bytes | None) -> list[str]:
        log.write_entry(b"x")
        log.write_snapshot(MapSnapshot(position=position, unmeasured=(), head=b"h", parts=parts))
        return parts_in(store)

    assert write(1, a=b"1", b=b"2") == ["1-a", "1-b"]
    assert set(log.stored_parts) == {"a", "b"}
    assert write(2, a=None, c=b"3") == ["1-a", "1-b", "1-c"]
    assert write(3, a=None, d=b"4") == ["1-a", "1-c", "1-d"]
    assert next(log_of(store).read_snapshots()).parts == {"a": None, "d": None}
    log.delete_until(3)
    assert list(store.list(FOLDER)) == []


def test_an_old_map_server_deletes_no_part_of_a_snapshot_that_the_new_one_is_writing():
    store = MemoryStore()
    old = log_of(store, 1)
    old.write_snapshot(MapSnapshot(position=1, unmeasured=(), head=b"h", parts={"a": b"1", "b": b"2"}))
    new = log_of(store, 2)
    next(new.read_snapshots())
    half = MapSnapshot(position=2, unmeasured=(), head=b"h", parts={"a": None, "c": b"3"})
    store.put(f"{FOLDER}features/{2:09d}-c", b"3")  # the part of it, but not yet the snapshot

    old.write_snapshot(MapSnapshot(position=2, unmeasured=(), head=b"o", parts={"a": None, "d": b"4"}))
    old.write_snapshot(MapSnapshot(position=3, unmeasured=(), head=b"o", parts={"a": None, "d": None}))

    assert parts_in(store) == ["1-a", "1-d", "2-c"]
    new.write_snapshot(half)


def test_a_snapshot_that_this_version_cannot_read_costs_time_and_no_map():
    store = MemoryStore()
    log = log_of(store, keeps_all=True)
    for number in range(1, 5):
        log.write_entry(encode_events([MapServerChanged(owner="a", epoch=number)]))
    log.write_snapshot(MapSnapshot(position=4, unmeasured=(), head=b"of another version"))

    def refuse(head: bytes, part: Callable[[str], bytes]) -> FakeMap:
        raise BadRequest("of another version")

    kind = replace(FAKE_MAP, restore=refuse)
    assert restore(log_of(store), kind).position == 4
    store.delete(f"{FOLDER}log/{1:012d}")
    with pytest.raises(StoreError, match="entry 1 of the log is missing"):
        restore(log_of(store), kind)


@pytest.mark.parametrize("name", ["", "A", "a/b", "..", "x" * 65, "-a", "a b"])
def test_a_name_that_would_leave_the_folder_of_the_tenant_is_refused(name: str) -> None:
    with pytest.raises(BadRequest, match="not a valid name of a map"):
        map_folder("default", name)


CLAIMS = ConnectionClaims(tenant="t", map_name="m", epoch=3, certificate="c", expires_s=1000.0 + TOKEN_S)


def test_a_token_between_servers_is_valid_for_its_map_its_map_server_and_its_time_only():
    key = internal_key(MemoryStore())
    token = make_token(key, CLAIMS)
    check_token(key, token, CLAIMS, now_s=1000.0, leeway_s=1.0)
    check_token(key, token, CLAIMS, now_s=1030.5, leeway_s=1.0)

    for changes in ({"tenant": "u"}, {"map_name": "n"}, {"epoch": 4}, {"certificate": "d"}):
        with pytest.raises(Unauthorized):
            check_token(key, token, msgspec.structs.replace(CLAIMS, **changes), now_s=1000.0, leeway_s=1.0)
    for now_s in (1031.5, 998.0):
        with pytest.raises(Unauthorized):
            check_token(key, token, CLAIMS, now_s=now_s, leeway_s=1.0)
    for forged in (b"", token[:-1], token + b" ", b"\0" * 32 + token[32:]):
        with pytest.raises(Unauthorized):
            check_token(key, forged, CLAIMS, now_s=1000.0, leeway_s=1.0)
    with pytest.raises(Unauthorized):
        check_token(internal_key(MemoryStore()), token, CLAIMS, now_s=1000.0, leeway_s=1.0)


def test_all_servers_use_one_key_that_outlives_them():
    store = MemoryStore()

    assert internal_key(store) == internal_key(store)
    assert len(internal_key(store)) == 32


def test_a_missing_or_damaged_entry_ends_a_replay():
    store = MemoryStore()
    log = log_of(store)
    for _ in range(3):
        log.write_entry(b"x")
    store.delete(f"{FOLDER}log/{2:012d}")
    with pytest.raises(StoreError, match="entry 2 of the log is missing, but 3 is there"):
        list(log_of(store).read_entries())
    store.put(f"{FOLDER}log/{2:012d}", b"\xff")
    with pytest.raises(StoreError, match="damaged"):
        list(log_of(store).read_entries())


def test_a_snapshot_whose_part_is_missing_is_passed_over():
    store = MemoryStore()
    log, state = log_of(store, keeps_all=True), MapState(FAKE_MAP.empty(), 0)
    change = [MapServerChanged(owner="a", epoch=1)]
    newest = ""
    for _ in range(2):
        state.apply(log.write_entry(encode_events(change)), change)
        log.write_snapshot(state.make_snapshot(log.stored_parts))
        (newest,) = log.stored_parts.values()
    assert restore(log_of(store), FAKE_MAP).digest() == state.digest()
    store.delete(f"{FOLDER}features/{newest}")

    assert restore(log_of(store), FAKE_MAP).digest() == state.digest()
