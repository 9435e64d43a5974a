"""One job from the first read of its record to its outcome, with a process that follows a script."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import threading
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import Conflict, StoreError
from rse_pf.identity import RobotId, object_name
from rse_pf.processes.ipc import encode_message
from rse_pf.processes.linux import raise_descriptor_limit
from rse_pf.server.jobs.lease import JobLease, JobRecord, record_name
from rse_pf.server.jobs.process import JobRequest
from rse_pf.server.jobs.runner import JobContext, JobOutcome, JobSignals, run_job
from rse_pf.server.jobs.slots import JobSlots, make_slot_file
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_store import FakeStore, fail_with

SETTINGS = PlatformSettings.from_dict(
    {
        "serving": {"job_lease_s": 0.25},
        "session": {"max_message_bytes": 1024},
        "data": {"max_object_bytes": 4096},
    }
)
WANTED = JobRequest(
    service="long", payload={}, robot=RobotId("default", "robot-1"), key="ab" * 32, quota_bytes=1e6
)
NAME = record_name(RobotId("default", "robot-1"), WANTED.key)
REPLY = msgspec.msgpack.encode({"value": 1})
DONE = ["done", 12.5, REPLY]


class FakeProcess:
    """Sends *script* at once; then ends with *code* if *ends*."""

    pid = 0

    def __init__(self, script: list[Any], *, ends: bool = True, code: int = 0) -> None:
        self.connection, self.theirs = socket.socketpair()
        self.killed = threading.Event()
        self._code = code
        for message in script:
            self.theirs.sendall(encode_message(message))
        if ends:
            self.theirs.close()

    def say(self, message: list[str]) -> None:
        with contextlib.suppress(OSError):
            self.connection.sendall(encode_message(message))

    def kill(self) -> int:
        self.killed.set()
        self.theirs.close()
        self.connection.close()
        return self._code


class Clock:
    """Advances by a hundredth of a second with each reading, so that nothing waits for long."""

    def __init__(self) -> None:
        self._ticks = itertools.count()

    def __call__(self) -> float:
        return next(self._ticks) * 0.01


class RunJobs:
    def __init__(self) -> None:
        self.store: MemoryStore = MemoryStore()
        self.processes: list[FakeProcess] = []
        self.scripts: list[Callable[[], FakeProcess]] = []
        self.told: list[tuple[float, str]] = []
        self.signals = JobSignals()
        self.slots = JobSlots(make_slot_file(), 1)

    def start(self, wanted: JobRequest) -> FakeProcess:
        self.processes.append(self.scripts.pop(0)())
        return self.processes[-1]

    def run(self, *scripts: Callable[[], FakeProcess]) -> JobOutcome:
        self.scripts += scripts
        context = JobContext(
            store=self.store, slots=self.slots, settings=SETTINGS, server_id="s",
            start=self.start, clock=Clock(),
        )  # fmt: skip

        def tell(share: float, what: str) -> None:
            self.told.append((share, what))
            self.on_tell(share, what)

        return run_job(WANTED, context, self.signals, tell, "us")

    def on_tell(self, share: float, what: str) -> None: ...

    @property
    def record(self) -> JobRecord:
        return msgspec.json.decode(self.store.get(NAME), type=JobRecord)


@pytest.fixture
def bench():
    bench = RunJobs()
    yield bench
    bench.signals.close()
    for process in bench.processes:
        assert process.killed.is_set(), "a process outlived its job"


def code(outcome: JobOutcome) -> str:
    return "ok" if outcome.error is None else outcome.error.code


def another(bench: RunJobs) -> JobLease:
    lease = JobLease(bench.store, NAME, "another", Clock())
    lease.read()
    return lease


@pytest.mark.parametrize("script", [[DONE], [], [["failed", "bad-request", "no", ""]]])
def test_an_outcome_says_what_its_process_took_whatever_came_of_it(
    bench, monkeypatch: pytest.MonkeyPatch, script: list[Any]
):
    monkeypatch.setattr("rse_pf.server.jobs.runner.cpu_seconds", lambda pid: 3.25)

    assert bench.run(lambda: FakeProcess(script)).cpu_s == 3.25
    if script == [DONE]:
        assert bench.run().cpu_s == 0.0, "a stored result was not computed again"


def test_a_job_runs_in_a_worker_with_more_than_1024_descriptors():
    raise_descriptor_limit()
    with contextlib.ExitStack() as opened, open(os.devnull) as file:
        for _ in range(1100):
            opened.callback(os.close, os.dup(file.fileno()))
        bench = RunJobs()

        assert code(bench.run(lambda: FakeProcess([DONE]))) == "ok"
        bench.signals.close()


def test_a_result_whose_object_was_deleted_is_computed_again(bench):
    outcome = bench.run(lambda: FakeProcess([DONE]))
    bench.store.delete(object_name(RobotId("default", "robot-1"), outcome.object))

    assert bench.run(lambda: FakeProcess([DONE])) == outcome
    assert len(bench.processes) == 2


def test_a_process_that_ignores_the_cancel_is_killed(bench):
    bench.on_tell = lambda share, what: bench.signals.cancel() if what == "half" else None

    outcome = bench.run(lambda: FakeProcess([["progress", 0.5, "half"]], ends=False))

    assert code(outcome) == "cancelled"
    assert (bench.record.state, bench.record.code) == ("failed", "cancelled")


def test_a_result_that_arrives_before_the_cancel_is_processed_is_kept(bench):
    bench.on_tell = lambda share, what: bench.signals.cancel() if what == "half" else None

    assert code(bench.run(lambda: FakeProcess([["progress", 0.5, "half"], DONE]))) == "ok"


def test_the_failure_of_a_followed_job_is_reported_and_not_retried(bench):
    owner = another(bench)
    owner.take()
    failed = JobRecord(state="failed", owner="", code="crashed", message="it ended")
    bench.on_tell = lambda share, what: owner.end(failed)

    assert code(bench.run()) == "crashed"
    assert bench.processes == []


def test_a_server_that_lost_the_lease_kills_its_process_and_follows_the_new_owner(bench):
    def overtake(share: float, what: str) -> None:
        if what == "half" and bench.record.owner == "us":
            other = another(bench)
            other.take()
            bench.store.put(object_name(RobotId("default", "robot-1"), digest_of(REPLY)), REPLY)
            other.end(JobRecord(state="done", owner="", reply=digest_of(REPLY), reply_bytes=len(REPLY)))

    bench.on_tell = overtake

    outcome = bench.run(lambda: FakeProcess([["progress", 0.5, "half"]], ends=False))

    assert outcome.object == digest_of(REPLY)
    assert bench.record.owner == "another"


@pytest.mark.parametrize("failures", [2, 20], ids=["shorter than the lease", "longer than the lease"])
def test_a_failure_of_the_store_does_not_end_a_job(bench, failures):
    renewals = 0

    def fail_first_renewals(operation: str, name: str, data: bytes) -> None:
        nonlocal renewals
        if operation == "compare_and_swap" and bench.processes and renewals < failures:
            renewals += 1
            if renewals == failures:
                bench.processes[0].theirs.sendall(encode_message(DONE))
            raise StoreError("503")

    bench.store = FakeStore(fail_first_renewals)

    assert code(bench.run(lambda: FakeProcess([], ends=False))) == "ok"
    assert renewals == failures
    assert bench.record.tries == 1


def test_a_store_that_fails_is_a_typed_failure(bench):
    bench.store = FakeStore(fail_with(StoreError("gone"), "get"))

    assert code(bench.run()) == "store"


def test_the_outcome_is_written_again_after_a_conflict(bench):
    conflicts = [Conflict("somebody asked to cancel")]

    def conflict_once(operation: str, name: str, data: bytes) -> None:
        if operation == "compare_and_swap" and b'"done"' in data and conflicts:
            raise conflicts.pop()

    bench.store = FakeStore(conflict_once)

    assert code(bench.run(lambda: FakeProcess([DONE]))) == "ok"
    assert bench.record.state == "done"


def test_a_reply_above_the_robots_quota_is_a_typed_failure_and_not_stored(bench):
    bench.store.put(object_name(RobotId("default", "robot-1"), "full"), bytes(10**6 - 1))

    assert code(bench.run(lambda: FakeProcess([DONE]))) == "quota"
    assert bench.record.code == "quota"
    assert len(list(bench.store.list("objects/"))) == 1
