"""Old records of jobs are deleted without an effect on running jobs and new requests."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.server.jobs.lease import JobLease, JobRecord, decode_record, verdict_on
from rse_pf.server.jobs.record_gc import RecordCollector
from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_store import FakeStore, do_nothing

LIFE_S, LEASE_S = 1000.0, 5.0
NAME = "jobs/default/robot-1/" + "ab" * 32


class CollectedRecords:
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
    bench = CollectedRecords()
    put(bench.store, JobRecord(state=state, owner="gone"))

    assert bench.after(0) == 0
    assert bench.after(LIFE_S - 1) == 0
    assert bench.names == [NAME]
    assert bench.after(1) == 1
    assert bench.names == []


def test_a_request_between_tombstone_and_deletion_waits_and_then_gets_a_new_run():
    asked: list[str] = []

    def read_before_deletion(operation: str, name: str, data: bytes) -> None:
        if operation == "delete":
            reader = JobLease(bench.store, NAME, "reader", lambda: bench.now)
            record = reader.read()
            asked.append(verdict_on(record, unchanged_s=0.0, lease_s=LEASE_S, is_watched=reader.is_watched))

    bench = CollectedRecords(FakeStore(read_before_deletion))
    put(bench.store, JobRecord(state="done", owner="gone", reply="r", marked_s=bench.now))

    assert bench.after(LIFE_S) == 1
    assert asked == ["follow"]
    lease = bench.lease()
    assert verdict_on(lease.record, unchanged_s=0.0, lease_s=LEASE_S, is_watched=False) == "take"
    assert lease.take()


def test_a_job_taken_during_a_garbage_collection_keeps_its_record():
    def take_before_the_tombstone(operation: str, name: str, data: bytes) -> None:
        if operation == "compare_and_swap" and b'"swept"' in data:
            bench.store.before = do_nothing
            assert taker.take()

    bench = CollectedRecords(FakeStore(take_before_the_tombstone))
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
