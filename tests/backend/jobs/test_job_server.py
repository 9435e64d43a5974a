"""Jobs that wait are offered, taken by one job server, and withdrawn when they have an outcome."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from fakes import FakeLog

from rse_pf.backend.jobs.job_server import JobServer
from rse_pf.backend.jobs.lease import JobLease, record_name
from rse_pf.backend.jobs.process import JobRequest
from rse_pf.backend.jobs.queue import JobQueue, interleave
from rse_pf.backend.jobs.runner import JobContext, JobOutcome, JobSignals, run_job
from rse_pf.backend.jobs.slots import JobSlots, make_pipe
from rse_pf.config import PlatformSettings
from rse_pf.errors import StoreError
from rse_pf.identity import RobotId
from rse_pf.ipc import encode_message
from rse_pf.lease import ObjectRecords
from rse_pf.object_store import MemoryStore
from tests.backend.jobs.test_runner import FakeProcess

SETTINGS = PlatformSettings.from_dict(
    {"serving": {"job_lease_s": 0.3, "max_running_jobs": 0, "offer_jobs": True}}
)
DONE = ["done", 12.5, msgspec.msgpack.encode({"value": 1})]


def a_request(number: int = 0, tenant: str = "default") -> JobRequest:
    return JobRequest(
        service="long", payload={"n": number}, robot=RobotId(tenant, f"robot-{number}"),
        key=f"{number:02d}" * 32, quota_bytes=1e6,
    )  # fmt: skip


class Bench:
    """A store with a serving server that has no slots, and job servers whose processes follow a script."""

    def __init__(self) -> None:
        self.store = MemoryStore()
        self.queue = JobQueue(self.store, SETTINGS)
        self.log: Any = FakeLog()
        self.started: list[FakeProcess] = []
        self.signals = JobSignals()

    def context(self, script: list[object], *, ends: bool = True, **of: object) -> JobContext:
        def start(request: JobRequest) -> FakeProcess:
            self.started.append(FakeProcess(script, ends=ends))
            return self.started[-1]

        return JobContext(
            store=self.store, settings=SETTINGS, server_id="s", start=start, clock=time.monotonic, **of
        )  # fmt: skip

    def job_server(self, script: list[object], *, ends: bool = True, slots: int = 1) -> JobServer:
        context = self.context(
            script, ends=ends, slots=JobSlots(make_pipe(slots)), finished=self.queue.withdraw, follows=False
        )
        return JobServer(context, self.queue, self.log, lambda: os.urandom(4).hex(), slots)

    def ask(self, request: JobRequest) -> tuple[threading.Thread, list[JobOutcome]]:
        """Ask a server without slots for a job."""
        context = self.context([], slots=JobSlots(make_pipe(0)), queue=self.queue)
        outcomes: list[JobOutcome] = []

        def work() -> None:
            outcomes.append(run_job(request, context, self.signals, lambda *_: None, "serving"))

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        return thread, outcomes


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.signals.give_up()


def wait_until(is_so: Callable[[], bool], within_s: float = 20.0) -> None:
    until = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < until, "it did not happen in time"
        threading.Event().wait(0.005)


def test_a_server_without_slots_gets_the_result_of_a_job_server(bench: Bench) -> None:
    thread, outcomes = bench.ask(a_request())
    wait_until(lambda: bench.queue.waiting() == 1)

    bench.job_server([DONE]).step()
    thread.join(20)

    assert outcomes[0].error is None
    assert msgspec.msgpack.decode(outcomes[0].reply or b"") == {"value": 1}
    wait_until(lambda: not list(bench.store.list("job-queue/")))


def test_a_job_server_takes_no_more_jobs_than_it_has_slots(bench: Bench) -> None:
    for number in range(3):
        bench.queue.offer(a_request(number))
    server = bench.job_server([], ends=False, slots=2)

    server.step()
    wait_until(lambda: len(bench.started) == 2)
    server.step()

    assert server.running == 2
    wait_until(lambda: bench.queue.waiting() == 1)
    server.leave()
    assert bench.queue.waiting() == 3


def test_equal_jobs_of_robots_of_one_name_in_two_tenants_both_run(bench: Bench) -> None:
    for tenant in ("acme", "rival"):
        bench.queue.offer(a_request(tenant=tenant))
    server = bench.job_server([], ends=False, slots=2)

    server.step()

    wait_until(lambda: len(bench.started) == 2)
    assert server.running == 2
    server.leave()


def test_the_job_of_a_job_server_that_died_is_taken_after_its_lease(bench: Bench) -> None:
    request = a_request()
    bench.queue.offer(request)
    dead = JobLease(
        ObjectRecords(bench.store), record_name(request.robot, request.key), "dead", time.monotonic
    )
    dead.read()
    assert dead.take()
    server = bench.job_server([DONE])

    server.step()

    assert not bench.started
    assert server.running == 0
    wait_until(lambda: server.step() or bench.started)
    wait_until(lambda: server.running == 0)
    assert len(bench.started) == 1
    assert bench.queue.waiting() == 0


def test_a_job_that_another_job_server_runs_takes_no_slot_of_this_one(bench: Bench) -> None:
    for number in range(3):
        bench.queue.offer(a_request(number))
    servers = [bench.job_server([], ends=False) for _ in range(2)]

    for count, server in enumerate(servers, start=1):
        server.step()
        wait_until(lambda count=count: len(bench.started) == count)  # the first process is the first server's

    assert [server.running for server in servers] == [1, 1]
    bench.started[0].theirs.sendall(encode_message(DONE))
    wait_until(lambda: servers[0].running == 0)
    servers[0].step()
    wait_until(lambda: len(bench.started) == 3)
    assert [server.running for server in servers] == [1, 1]
    for server in servers:
        server.leave()


def test_two_job_servers_that_look_at_the_same_time_take_a_job_each(bench: Bench) -> None:
    for number in range(2):
        bench.queue.offer(a_request(number))
    servers = [bench.job_server([], ends=False) for _ in range(2)]
    threads = [threading.Thread(target=server.step) for server in servers]

    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert [server.running for server in servers] == [1, 1]
    assert bench.queue.waiting() == 0
    for server in servers:
        server.leave()


def test_the_offer_of_a_job_that_the_store_kept_from_running_stays(bench: Bench) -> None:
    bench.queue.offer(a_request())
    swap = bench.store.compare_and_swap
    bench.store.compare_and_swap = fail  # type: ignore[method-assign]
    server = bench.job_server([DONE])

    server.step()
    wait_until(lambda: server.running == 0)

    assert bench.queue.waiting() == 1
    bench.store.compare_and_swap = swap  # type: ignore[method-assign]
    server.step()
    wait_until(lambda: len(bench.started) == 1 and not list(bench.store.list("job-queue/")))


def test_a_damaged_record_does_not_keep_other_jobs_waiting(bench: Bench) -> None:
    for number in range(2):
        bench.queue.offer(a_request(number))
    bench.store.put(record_name(a_request(0).robot, a_request(0).key), b"what")
    server = bench.job_server([], ends=False)

    server.step()

    assert server.running == 1
    assert bench.queue.waiting() == 1
    server.leave()


def test_a_job_that_its_robot_cancels_is_offered_no_more(bench: Bench) -> None:
    thread, outcomes = bench.ask(a_request())
    wait_until(lambda: bench.queue.waiting() == 1)

    bench.signals.cancel()
    thread.join(20)

    assert outcomes[0].error is not None
    assert outcomes[0].error.code == "cancelled"
    assert bench.queue.waiting() == 0


def test_robots_take_turns_however_many_jobs_they_offer() -> None:
    names = [f"job-queue/t/{robot}/{key}" for robot, keys in (("a", "123"), ("b", "1")) for key in keys]

    assert [name[-3:] for name in interleave(names, {})] == ["a/1", "b/1", "a/2", "a/3"]
    assert interleave(names, {"t/a": 7, "t/b": 5})[0] == names[-1]


def test_a_job_of_servers_with_other_settings_is_not_taken(bench: Bench) -> None:
    other = SETTINGS.replace(pnp={"max_iterations": 17})
    JobQueue(bench.store, other).offer(a_request())

    assert list(bench.queue.offers()) == []


def test_a_payload_with_arrays_comes_back_from_the_queue(bench: Bench) -> None:
    request = with_payload(a_request(), {"points": np.arange(6.0), "map": b"bytes"})
    bench.queue.offer(request)

    (offer,) = bench.queue.offers()

    assert np.array_equal(np.asarray(offer.request.payload["points"]), np.arange(6.0))
    assert offer.request.payload["map"] == b"bytes"
    assert offer.request.robot == request.robot


def test_a_damaged_offer_is_told_once_and_does_not_hide_the_others(bench: Bench) -> None:
    told: list[str] = []
    queue = JobQueue(bench.store, SETTINGS, told.append)
    bench.store.put("job-queue/default/robot/ab", b"what")
    queue.offer(a_request())

    found = [list(queue.offers()) for _ in range(2)]

    assert [[offer.request.key for offer in each] for each in found] == [[a_request().key]] * 2
    assert told == ["job-queue/default/robot/ab"]


def test_many_offers_of_other_settings_and_of_one_robot_hide_no_job(bench: Bench) -> None:
    others = JobQueue(bench.store, SETTINGS.replace(pnp={"max_iterations": 17}))
    for number in range(250):
        others.offer(a_job_of("a", number))
        bench.queue.offer(a_job_of("b", number))
    bench.queue.offer(a_job_of("z", 0))

    list(bench.queue.offers())  # learns which are those of others
    first = [offer.request.robot.name for offer in bench.queue.offers()][:2]

    assert first == ["b", "z"]


def a_job_of(robot: str, number: int) -> JobRequest:
    return JobRequest(
        service="long", payload={}, robot=RobotId("default", robot), key=f"{number:064x}", quota_bytes=1e6
    )


def fail(*_: object) -> None:
    raise StoreError("the store does not answer")


def with_payload(request: JobRequest, payload: object) -> JobRequest:
    return JobRequest(
        service=request.service, payload=payload, robot=request.robot, key=request.key,
        quota_bytes=request.quota_bytes,
    )  # fmt: skip
