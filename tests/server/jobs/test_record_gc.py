"""Old records of jobs are deleted without an effect on running jobs and new requests."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.errors import StoreError
from rse_pf.server.jobs.lease import JobLease, JobRecord, decode_record, verdict_on
from rse_pf.server.jobs.record_gc import RecordCollector
from rse_pf.storage.object_store import MemoryStore

LIFE_S, LEASE_S = 1000.0, 5.0
NAME = "jobs/default/robot-1/" + "ab" * 32


class Bench:
    """A store, a sweep, and clocks that go when the test says so."""

    def __init__(self, store: MemoryStore | None = None) -> None:
        self.store = store or MemoryStore()
        self.now = 1e9
        self.sweep = self.another()

    def another(self) -> RecordCollector:
        return RecordCollector(
            self.store, ttl_s=LIFE_S, clock=lambda: self.now, wall_clock=lambda: self.now
        )  # fmt: skip

    def lease(self) -> JobLease:
        lease = JobLease(self.store, NAME, "us", lambda: self.now)
        lease.read()
        return lease

    def after(self, seconds: float) -> int:
        """Let time pass, sweep with a fresh eye, and return how many records went."""
        self.now += seconds
        return self.another().collect()

    @property
    def names(self) -> list[str]:
        return [info.name for info in self.store.list("jobs/")]


def put(store: MemoryStore, record: JobRecord, name: str = NAME) -> None:
    store.put(name, msgspec.json.encode(record))


@pytest.mark.parametrize("state", ["done", "failed", "given-up", "running"])
def test_an_unchanged_record_is_deleted_after_its_ttl_and_not_before(state):
    bench = Bench()
    put(bench.store, JobRecord(state=state, owner="gone"))

    assert bench.after(0) == 0
    assert bench.after(LIFE_S - 1) == 0
    assert bench.names == [NAME]
    assert bench.after(1) == 1
    assert bench.names == []


def test_a_running_job_keeps_its_record_however_long_it_takes():
    bench = Bench()
    lease = bench.lease()
    assert lease.take()

    for _ in range(5):
        assert bench.after(LIFE_S / 2) == 0
        lease.renew(0.5, "half")  # the mark of the sweep costs one beat
        assert lease.renew(0.5, "half")

    assert lease.is_ours
    assert lease.end(JobRecord(state="done", owner="", reply="r"))


def test_a_request_between_tombstone_and_deletion_waits_and_then_gets_a_new_run():
    asked: list[str] = []

    class Watched(MemoryStore):
        def delete(self, name: str) -> None:
            reader = JobLease(self, NAME, "reader", lambda: bench.now)
            record = reader.read()
            asked.append(verdict_on(record, unchanged_s=0.0, lease_s=LEASE_S, is_watched=reader.is_watched))
            super().delete(name)

    bench = Bench(Watched())
    put(bench.store, JobRecord(state="done", owner="gone", reply="r", marked_s=bench.now))

    assert bench.after(LIFE_S) == 1
    assert asked == ["follow"]
    lease = bench.lease()
    assert verdict_on(lease.record, unchanged_s=0.0, lease_s=LEASE_S, is_watched=False) == "take"
    assert lease.take()


def test_a_job_taken_during_a_garbage_collection_keeps_its_record():
    class Quick(MemoryStore):
        races = 1

        def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
            if b'"swept"' in data and self.races:
                self.races -= 1
                assert taker.take()
            super().compare_and_swap(name, expected, data)

    bench = Bench(Quick())
    put(bench.store, JobRecord(state="given-up", owner="gone", marked_s=bench.now))
    taker = bench.lease()

    assert bench.after(LIFE_S) == 0
    record = decode_record(NAME, bench.store.get(NAME))
    assert (record.state, record.owner, record.marked_s) == ("running", "us", 0.0)
    assert taker.renew(0.1, "goes on")


def test_the_tombstone_of_an_interrupted_collection_delays_a_job_by_at_most_a_lease():
    record = JobRecord(state="swept", owner="")

    assert verdict_on(record, unchanged_s=LEASE_S - 0.1, lease_s=LEASE_S, is_watched=False) == "follow"
    assert verdict_on(record, unchanged_s=LEASE_S, lease_s=LEASE_S, is_watched=False) == "take"


def test_records_are_read_a_few_at_a_time_and_listed_once_an_hour():
    bench = Bench()
    names = [f"jobs/default/robot-1/{number:064x}" for number in range(100)]
    for name in names:
        put(bench.store, JobRecord(state="done", owner="", marked_s=1.0), name)

    assert bench.sweep.collect() == 64
    assert bench.sweep.collect() == 36
    put(bench.store, JobRecord(state="done", owner="", marked_s=1.0))
    assert bench.sweep.collect() == 0
    bench.now += 3600
    assert bench.sweep.collect() == 1


def test_after_a_failure_of_the_store_or_an_invalid_record_it_goes_on_later():
    class Gone(MemoryStore):
        def list(self, prefix: str = ""):
            raise StoreError("gone")

    assert Bench(Gone()).sweep.collect() == 0
    bench = Bench()
    bench.store.put("jobs/default/robot-0/0", b"nonsense")
    put(bench.store, JobRecord(state="done", owner="", marked_s=1.0))
    assert bench.sweep.collect() == 1
    assert bench.names == ["jobs/default/robot-0/0"]
