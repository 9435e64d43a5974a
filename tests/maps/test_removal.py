"""Removal of map versions: which are chosen, and that concurrent commits and crashes harm nothing."""

from __future__ import annotations

import contextlib
import itertools
import subprocess
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from rse_pf.errors import Busy, Conflict, NotFound, StoreError, StoreFull
from rse_pf.identity import RobotId
from rse_pf.maps.format import encode_map
from rse_pf.maps.registry import MapRecord, MapRegistry
from rse_pf.maps.removal import ABANDONED_S, MAX_REMOVAL_S, Marks, choose_superseded, count_freed_bytes
from rse_pf.storage.object_store import DirectoryStore, MemoryStore, ObjectStore
from rse_pf.storage.quotas import charge_name, sum_charges
from tests.kit.fake_store import FakeStore
from tests.kit.sample_maps import make_map

NAME, FOLDER = "kitchen", "maps/default/kitchen/"
ROBOT = RobotId("default", "robot-1")


class SteppedStore(FakeStore):
    """A store that calls *act* before its operation number *at*, counted from 1 since `count_from_here`."""

    def __init__(self) -> None:
        super().__init__(self._step)
        self.count_from_here(0, lambda: None)

    def count_from_here(self, at: int, act: Callable[[], None]) -> None:
        self.steps, self._at, self._act = 0, at, act

    def _step(self, operation: str, name: str, data: bytes) -> None:
        self.steps += 1
        if self.steps == self._at:
            self._at = 0
            self._act()


def bytes_of(seed: int) -> bytes:
    return encode_map(make_map(seed))


def commit(maps: MapRegistry, seed: int, created_s: float | None = None) -> MapRecord:
    try:
        parent: str | None = maps.head(NAME).id
    except NotFound:
        parent = None
    created_s = 1e9 + seed if created_s is None else created_s
    return maps.commit(NAME, bytes_of(seed), parent=parent, author="robot-1", created_s=created_s)


def prune(maps: MapRegistry, keep: int = 2) -> list[MapRecord]:
    return maps.remove(NAME, lambda records, head: choose_superseded(records, head, keep=keep))


def assert_whole(maps: MapRegistry) -> None:
    """Assert that the head and every version that is listed can be read."""
    assert maps.data(NAME)
    for record in maps.versions(NAME):
        assert maps.data(NAME, record.id)


def names(store: ObjectStore) -> list[str]:
    return [info.name for info in store.list()]


def test_the_newest_versions_stay_and_of_the_others_neither_bytes_nor_record_nor_charge():
    store, told = MemoryStore(), []
    maps = MapRegistry(store, on_change=lambda action, name, record: told.append((action, record.number)))
    records = [commit(maps, seed) for seed in range(5)]
    for record in records:
        store.put(charge_name(ROBOT, NAME, record.id, record.size), b"")
    store.put(charge_name(ROBOT, "hall", records[0].id, 9), b"")
    before, told[:] = store.usage("maps/"), []

    removed = prune(maps, keep=2)

    assert [record.number for record in removed] == [1, 2, 3]
    assert told == [("map.remove", number) for number in (1, 2, 3)]
    assert [record.number for record in maps.versions(NAME)] == [4, 5]
    assert_whole(maps)
    after = store.usage("maps/")
    assert before.charged_bytes - after.charged_bytes == count_freed_bytes(removed)
    assert after.objects == 5, "two maps, two records and the head; no mark"
    assert sum_charges(store, ROBOT).objects == 3, "two versions, and one of another map"
    with pytest.raises(NotFound):
        maps.record(NAME, records[0].id)
    assert prune(maps, keep=2) == []
    assert commit(maps, 9).number == 6


def test_the_head_stays_after_a_rollback_and_so_do_bytes_that_another_version_shares():
    maps = MapRegistry(MemoryStore())
    first, second = commit(maps, 1), commit(maps, 2)
    commit(maps, 3)
    shared = commit(maps, 2, created_s=2e9)
    maps.move_head(NAME, first.id, expected=shared.id)

    assert [record.number for record in prune(maps, keep=1)] == [3]

    assert maps.head(NAME).id == first.id
    assert {record.id for record in maps.versions(NAME)} == {first.id, second.id, shared.id}
    assert_whole(maps)


def record(number: int, *, size: int = 10, note: str = "", digest: str = "") -> MapRecord:
    return MapRecord(
        digest=digest or f"d{number}",
        size=size,
        parent=None,
        number=number,
        author="r",
        created_s=float(number),
        note=note,
        keyframes=0,
        edges=0,
        points=0,
        robots=(),
    )


@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        ({"keep": 2}, [1, 2, 3]),
        ({"keep": 9}, []),
        ({"keep": 9, "max_bytes": 3 * 8192}, [1, 2]),
        ({"keep": 9, "max_bytes": 1}, [1, 2, 3, 4]),
        ({"keep": 1, "is_counted": lambda each: each.note == ""}, [1, 3, 4]),
        ({"keep": 2, "head": 2}, [1, 3]),
    ],
    ids=["number", "all", "bytes", "the newest always", "only some count", "the head"],
)
def test_versions_are_superseded_by_their_number_and_their_bytes(options: dict, numbers: list[int]):
    records = [record(number, note="asked for" if number == 2 else "") for number in range(1, 6)]
    head = records[options.pop("head", 5) - 1].id

    assert [each.number for each in choose_superseded(records, head, **options)] == numbers


def inner_commit(maps: MapRegistry) -> None:
    commit(maps, 1, created_s=3e9)  # the bytes of a version that is being removed


def inner_rollback(maps: MapRegistry) -> None:
    oldest = min(maps.versions(NAME), key=lambda each: each.number)
    maps.move_head(NAME, oldest.id, expected=maps.head(NAME).id)


class SteppedThread:
    """A thread that uses a store: it does the permitted number of operations, and then waits."""

    def __init__(self, act: Callable[[], object]) -> None:
        self._act, self._left, self._is_waiting, self._is_done = act, 0, False, False
        self._changed = threading.Condition()
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def allow(self, steps: int) -> bool:
        """Permit *steps* operations, wait until they are done, and return whether the thread has ended."""
        with self._changed:
            self._left, self._is_waiting = steps, False
            self._changed.notify_all()
            assert self._changed.wait_for(lambda: self._is_waiting or self._is_done, 20.0)
            return self._is_done

    def step(self) -> None:
        with self._changed:
            while not self._left:
                self._is_waiting = True
                self._changed.notify_all()
                assert self._changed.wait(20.0)
            self._left -= 1

    def _run(self) -> None:
        CURRENT.thread = self
        try:
            self._act()
        except (Busy, Conflict, NotFound) as error:
            self.error = error
        finally:
            with self._changed:
                self._is_done = True
                self._changed.notify_all()


CURRENT = threading.local()


def wait_for_permission(operation: str, name: str, data: bytes) -> None:
    """Wait until the thread that uses the store is permitted to go on."""
    thread = getattr(CURRENT, "thread", None)
    if thread is not None:
        thread.step()


ACTS = {"prune": prune, "commit": inner_commit, "rollback": inner_rollback}
PAIRS = [pair for pair in itertools.product(ACTS, ACTS) if "prune" in pair]


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_in_every_order_of_two_interruptions_the_head_and_every_version_stay_whole(first: str, second: str):
    codes = set()
    for before in itertools.count():
        for between in itertools.count():
            store = FakeStore(wait_for_permission)
            maps = MapRegistry(store)
            for seed in range(1, 4):
                commit(maps, seed)
            one = SteppedThread(lambda: ACTS[first](maps))  # noqa: B023  it ends within this round
            two = SteppedThread(lambda: ACTS[second](maps))  # noqa: B023
            one_ended = one.allow(before)
            two_ended = two.allow(between)
            assert one.allow(1000)
            assert two.allow(1000)
            assert_whole(maps)
            assert not any(".removing-" in name or ".held-" in name for name in names(store))
            codes |= {turns.error.code for turns in (one, two) if turns.error is not None}
            if two_ended:
                break
        if one_ended:
            break
    assert codes or first == second, "in some order they are in each other's way"


@pytest.mark.parametrize("step", range(1, 40))
def test_after_a_crash_at_any_step_all_is_whole_and_a_later_call_removes_the_rest(step: int):
    now = [1e9]
    store = SteppedStore()
    maps = MapRegistry(store, wall_clock=lambda: now[0])
    for seed in range(1, 5):
        version = commit(maps, seed)
        store.put(charge_name(ROBOT, NAME, version.id, version.size), b"")

    def crash() -> None:
        store.count_from_here(1, crash)  # nothing that follows reaches the store either
        raise StoreError("the process is killed")

    store.count_from_here(step, crash)
    with contextlib.suppress(StoreError):
        prune(maps)
    store.count_from_here(0, crash)

    assert_whole(maps)
    now[0] += ABANDONED_S + 2
    prune(maps)
    assert [each.number for each in maps.versions(NAME)] == [3, 4]
    assert_whole(maps)
    assert len([name for name in names(store) if name.startswith(FOLDER)]) == 5
    assert sum_charges(store, ROBOT).objects == 2


def test_who_removes_stops_before_its_marks_count_as_abandoned():
    assert MAX_REMOVAL_S * 2 < ABANDONED_S
    now = [1e9]
    store = SteppedStore()
    maps = MapRegistry(store, wall_clock=lambda: now[0])
    for seed in range(1, 5):
        commit(maps, seed)

    def pause() -> None:
        now[0] += MAX_REMOVAL_S

    def begin_at_the_first_mark(records: Sequence[MapRecord], head: str) -> list[MapRecord]:
        store.count_from_here(2, pause)
        return choose_superseded(records, head, keep=2)

    with pytest.raises(Busy, match="in 60 s"):
        maps.remove(NAME, begin_at_the_first_mark)
    assert len(maps.versions(NAME)) == 4
    assert_whole(maps)


def test_marks_of_a_process_that_crashed_keep_nobody_from_committing_for_ever():
    now = [1e9]
    store = MemoryStore()
    maps = MapRegistry(store, wall_clock=lambda: now[0])
    first = commit(maps, 1)
    commit(maps, 2)
    Marks(store, FOLDER + "blobs/", lambda: now[0]).put("removing", first.digest)

    with pytest.raises(Busy, match="being removed") as refused:
        inner_commit(maps)
    assert refused.value.retry_after_ms
    now[0] += ABANDONED_S + 2
    inner_commit(maps)

    assert maps.data(NAME) == bytes_of(1)


@pytest.mark.system
def test_versions_are_removed_from_a_disk_that_is_full(tmp_path: Path):
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("this test mounts a small disk, which takes the rights of root")
    try:
        store = DirectoryStore(folder / "store")
        maps = MapRegistry(store)
        for seed in range(1, 5):
            commit(maps, seed)
        with pytest.raises(StoreFull):
            store.put("objects/filler", bytes(2 << 20))
        for number in range(1000):
            try:
                store.put(f"objects/filler-{number}", bytes(4096))
            except StoreFull:
                break

        assert len(prune(maps)) == 2
        assert commit(maps, 9).number == 5
    finally:
        subprocess.run(["umount", str(folder)], check=True)
