"""The lease of a job: one owner at a time, and another one when it stops renewing."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.identity import RobotId
from rse_pf.server.jobs.lease import MAX_TRIES, JobLease, JobRecord, job_key, record_name, verdict_on
from rse_pf.storage.object_store import MemoryStore

NAME = record_name(RobotId("default", "robot-1"), "ab" * 32)
LEASE_S = 5.0


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store() -> MemoryStore:
    return MemoryStore()


def looked(store: MemoryStore, owner: str, clock: Clock) -> JobLease:
    lease = JobLease(store, NAME, owner, clock)
    lease.read()
    return lease


def verdict(lease: JobLease) -> str:
    return verdict_on(
        lease.read(), unchanged_s=lease.unchanged_s, lease_s=LEASE_S, is_watched=lease.is_watched,
        is_ours=lease.is_ours,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("record", "unchanged_s", "is_watched", "expected"),
    [
        (None, 0.0, False, "take"),
        (JobRecord(state="running", owner="a"), 4.9, True, "follow"),
        (JobRecord(state="running", owner="a"), 5.0, True, "take"),
        (JobRecord(state="running", owner="a", tries=MAX_TRIES), 4.9, True, "follow"),
        (JobRecord(state="running", owner="a", tries=MAX_TRIES), 5.0, True, "poison"),
        (JobRecord(state="given-up", owner="a", tries=MAX_TRIES), 0.0, False, "take"),
        (JobRecord(state="done", owner="a", reply="cd"), 99.0, False, "done"),
        (JobRecord(state="failed", owner="a", code="crashed"), 0.0, True, "failed"),
        (JobRecord(state="failed", owner="a", code="crashed"), 0.0, False, "take"),
    ],
)
def test_the_verdict_follows_from_the_record(record, unchanged_s, is_watched, expected):
    found = verdict_on(record, unchanged_s=unchanged_s, lease_s=LEASE_S, is_watched=is_watched)

    assert found == expected


def test_of_two_processes_that_take_a_job_one_succeeds(store, clock):
    one, other = looked(store, "one", clock), looked(store, "other", clock)

    assert [one.take(), other.take()] == [True, False]
    assert (one.is_ours, other.is_ours) == (True, False)
    assert verdict(other) == "follow"


def test_an_owner_that_renews_keeps_the_job_and_one_that_does_not_loses_it(store, clock):
    one, other = looked(store, "one", clock), looked(store, "other", clock)
    one.take()
    for _ in range(20):
        clock.now += LEASE_S - 0.1
        assert one.renew(0.5, "half")
        assert verdict(other) == "follow"
    assert other.record is not None
    assert (other.record.share, other.record.what) == (0.5, "half")

    clock.now += LEASE_S
    assert verdict(other) == "take"
    assert other.take()

    assert not one.renew(0.6, "late")
    assert not one.is_ours
    assert not one.end(JobRecord(state="done", owner="", reply="cd"))
    assert verdict(one) == "follow"


def test_a_process_that_reads_a_record_for_the_first_time_waits_a_whole_lease(store, clock):
    looked(store, "one", clock).take()
    clock.now += 1000.0

    late = looked(store, "late", clock)

    assert verdict(late) == "follow"


def test_crashes_of_owners_are_counted_but_not_orderly_ends(store, clock):
    for number in range(MAX_TRIES):
        lease = looked(store, f"owner-{number}", clock)
        clock.now += LEASE_S
        assert verdict(lease) == "take"
        lease.take()
        assert lease.record is not None
        assert lease.record.tries == number + 1
    clock.now += LEASE_S
    last = looked(store, "last", clock)
    clock.now += LEASE_S
    assert verdict(last) == "poison"

    assert lease.end(JobRecord(state="given-up", owner=""))
    assert verdict(last) == "take"
    last.take()
    assert last.record is not None
    assert last.record.tries == 1


def test_a_process_that_takes_its_own_job_again_counts_no_crash(store, clock):
    owner = looked(store, "one", clock)
    assert owner.take()  # its run fails, and the store fails when the outcome is written

    for _ in range(MAX_TRIES):
        assert verdict(owner) == "take"
        assert owner.take()

    assert owner.record is not None
    assert owner.record.tries == 1


def test_the_key_of_a_job_is_the_digest_of_its_request(store):
    asked = {"a": 1, "b": [1.5]}
    key = job_key("merge", asked, "s")

    assert key == job_key("merge", {"b": [1.5], "a": 1}, "s")
    others = [("optimise", asked, "s"), ("merge", {"a": 2, "b": [1.5]}, "s"), ("merge", asked, "t")]
    assert len({key, *(job_key(*other) for other in others)}) == 4
    arrays = [job_key("merge", {"a": np.array([value])}, "s") for value in (0.5, 0.5, 0.25)]
    assert arrays[0] == arrays[1] != arrays[2]
    with pytest.raises(BadRequest):
        job_key("merge", {"a": object()}, "s")


def test_no_robot_gets_the_job_of_another_robot_or_of_a_namesake_of_another_tenant():
    robots = [RobotId("acme", "robot-1"), RobotId("acme", "robot-2"), RobotId("rival", "robot-1")]

    assert len({record_name(robot, "ab" * 32) for robot in robots}) == 3
