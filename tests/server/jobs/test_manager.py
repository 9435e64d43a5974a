"""Which commands wait for which job, their progress and their answers, in a loop whose time stands still."""

from __future__ import annotations

import errno
import itertools
import os
import queue
import socket
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import encode_message
from rse_pf.server.jobs.manager import JobManager
from rse_pf.server.jobs.process import JobRequest
from rse_pf.server.jobs.runner import JobContext
from rse_pf.server.jobs.slots import JobSlots, make_slot_file
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire import Command, Failure, Result
from tests.kit.fakes import FakeLog, FakeLoop

WAIT_S = 20.0


class FakeProcess:
    """The process of a job, which does what the test says."""

    pid = 0

    def __init__(self, request: JobRequest) -> None:
        self.request = request
        self.connection, self._theirs = socket.socketpair()

    def say(self, message: list[str]) -> None:
        self.connection.sendall(encode_message(message))

    def tell(self, *message: Any) -> None:
        self._theirs.sendall(encode_message(list(message)))

    def done(self, value: int = 1) -> None:
        self.tell("done", 5.0, msgspec.msgpack.encode({"value": value}))

    def kill(self) -> int:
        self._theirs.close()
        self.connection.close()
        return 0


class ManagedJobs:
    """A job manager with processes that do what the test says."""

    def __init__(self, **serving: Any) -> None:
        self.settings = PlatformSettings.from_dict({"serving": {"job_lease_s": 0.25, **serving}})
        self.loop = FakeLoop()
        self.failing_starts = 0
        self.started: queue.SimpleQueue[FakeProcess] = queue.SimpleQueue()
        self.answers: dict[int, Result | Failure] = {}
        self.progress: list[tuple[int, float, str]] = []
        self.store = MemoryStore()
        context = JobContext(
            store=self.store, server_id="s",
            slots=JobSlots(make_slot_file(), self.settings.serving.max_running_jobs),
            settings=self.settings, start=self.start, clock=lambda: self.loop.now,
        )  # fmt: skip
        self.jobs = JobManager(
            context, loop=self.loop, log=FakeLog(),
            owner="s-1",
            answer=lambda job, answer: self.answers.__setitem__(job.command.id, answer),
            progress=lambda _, told: self.progress.append((told.id, told.done, told.what)),
        )  # fmt: skip

    def start(self, request: JobRequest) -> FakeProcess:
        if self.failing_starts:
            self.failing_starts -= 1
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        process = FakeProcess(request)
        self.started.put(process)
        return process

    def run_until(self, condition: Callable[[], object]) -> None:
        """Run the loop, while time stands still, until the threads of jobs made *condition* true."""
        self.loop.run_until(condition, WAIT_S)

    def process(self) -> FakeProcess:
        """Return the process that started next."""
        return self.started.get(timeout=WAIT_S)

    def close(self) -> None:
        self.jobs.close()


@pytest.fixture
def make():
    benches: list[ManagedJobs] = []

    def make(**serving: Any) -> ManagedJobs:
        benches.append(ManagedJobs(**serving))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


def robot(name: str = "robot-1", tenant: str = "default") -> Any:
    return SimpleNamespace(robot=RobotId(tenant, name), claims=None)


def ask(bench: ManagedJobs, owner: Any, identity: int, value: int = 1) -> None:
    command = Command(id=identity, service="long", payload={"value": value})
    bench.jobs.submit(QueuedCommand(owner, owner.robot, command, 10, 100.0, 105.0), 100.0)


def known(bench: ManagedJobs) -> float:
    return bench.jobs.report().gauges["jobs"]


def code(answer: Result | Failure) -> str:
    return "ok" if isinstance(answer, Result) else answer.code


def test_two_commands_with_the_same_request_wait_for_the_same_run(make, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rse_pf.server.jobs.runner.cpu_seconds", lambda pid: 3.25)
    bench, owner = make(), robot(tenant="acme")
    ask(bench, owner, 1)
    process = bench.process()
    ask(bench, owner, 2)

    process.done()
    bench.run_until(lambda: len(bench.answers) == 2)

    assert {each.reply["value"] for each in bench.answers.values()} == {1}
    assert len({each.object for each in bench.answers.values()}) == 1
    assert bench.started.empty()
    assert known(bench) == 0
    assert bench.jobs.report().cpu_s == {"jobs": {"acme": 3.25}}, "it was computed once"


def test_a_process_that_cannot_be_started_does_not_count_as_a_crash_of_the_server(make):
    bench, owner = make(), robot()
    bench.failing_starts = 5
    for identity in range(5):
        ask(bench, owner, identity)
        bench.run_until(lambda identity=identity: identity in bench.answers)

    ask(bench, owner, 5)
    bench.process().done()
    bench.run_until(lambda: 5 in bench.answers)

    assert [code(bench.answers[identity]) for identity in range(6)] == ["error"] * 5 + ["ok"]


def test_the_newest_job_of_a_robot_with_many_is_displaced_by_another_robot(
    make, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("rse_pf.server.jobs.manager.MAX_WAITING_JOBS", 3)
    bench, busy_robot, other_robot = make(), robot("greedy"), robot("modest")
    ask(bench, busy_robot, 0, value=0)
    bench.process()
    bench.run_until(lambda: bench.loop.advance(0.5) or any(what == "starts" for _, _, what in bench.progress))
    for identity in range(1, 4):
        ask(bench, busy_robot, identity, value=identity)

    ask(bench, other_robot, 10, value=10)

    assert code(bench.answers[3]) == "busy"
    assert bench.answers[3].retry_after_ms == 5000.0
    ask(bench, other_robot, 11, value=11)
    assert code(bench.answers[2]) == "busy"
    ask(bench, other_robot, 12, value=12)
    assert code(bench.answers[12]) == "busy"
    ask(bench, busy_robot, 4, value=3)
    bench.run_until(lambda: 4 in bench.answers)
    assert code(bench.answers[4]) == "busy"
    assert set(bench.answers) == {2, 3, 4, 12}


def test_progress_is_sent_at_once_then_at_most_twice_a_second_and_never_repeated(make):
    bench, owner = make(), robot()
    ask(bench, owner, 1)
    assert bench.progress == [(1, 0.0, "waits for its turn")]
    process = bench.process()
    for step in range(5):
        process.tell("progress", step / 10, f"step {step}")
    others = itertools.count(2)

    def a_new_command_is_told_step_4() -> bool:
        ask(bench, owner, next(others))
        return bench.progress[-1][2] == "step 4"

    def progress_of_1() -> list[tuple[int, float, str]]:
        return [each for each in bench.progress if each[0] == 1]

    bench.run_until(a_new_command_is_told_step_4)
    assert len(progress_of_1()) == 1

    bench.loop.advance(0.5)

    assert progress_of_1()[1:] == [(1, 0.4, "step 4")]
    bench.loop.advance(10.0)
    assert len(progress_of_1()) == 2


def test_cancelling_the_last_command_ends_the_job_and_a_request_meanwhile_gets_a_new_run(make):
    bench, owner = make(), robot()
    ask(bench, owner, 1)
    process = bench.process()
    bench.jobs.withdraw(owner, 1)
    ask(bench, owner, 2)

    process.tell("failed", "cancelled", "the robot took the command back", "")
    bench.run_until(lambda: 1 in bench.answers)
    bench.process().done()
    bench.run_until(lambda: 2 in bench.answers)

    assert [code(bench.answers[identity]) for identity in (1, 2)] == ["cancelled", "ok"]


def test_a_robot_cannot_cancel_the_commands_of_another(make):
    bench, owner = make(), robot()
    ask(bench, owner, 1)
    ask(bench, owner, 2)
    process = bench.process()

    bench.jobs.withdraw(robot("robot-2"), 1)
    assert bench.answers == {}
    process.done()
    bench.run_until(lambda: len(bench.answers) == 2)

    assert {code(answer) for answer in bench.answers.values()} == {"ok"}


def test_the_same_request_of_another_robot_or_tenant_is_another_job(make):
    bench = make(max_running_jobs=3)
    for identity, owner in enumerate((robot(), robot("robot-2"), robot(tenant="another"))):
        ask(bench, owner, identity)

    asked = [bench.process() for _ in range(3)]

    assert len({each.request.robot for each in asked}) == 3
