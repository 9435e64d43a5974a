"""Limited services on processes that a test scripts: what each end of a process means for its robot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from rse_pf.errors import Busy, WorkerLost
from rse_pf.identity import RobotId
from rse_pf.processes.limited import Overran
from rse_pf.server.compute.limited_services import LimitedServices
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.wire import Command, Failure, Result
from tests.kit.worker_parts import WorkerParts, worker_parts

ALICE, BOB = RobotId("default", "alice"), RobotId("default", "bob")


class ScriptedProcesses:
    """Raises or returns what stands next in ``script``, and keeps what it was asked."""

    def __init__(self) -> None:
        self.script: list[Any] = []
        self.timeouts_s: list[float] = []
        self.is_closed = False

    def call(self, data: bytes, timeout_s: float) -> bytes:
        self.timeouts_s.append(timeout_s)
        outcome = self.script.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def pids(self) -> list[int]:
        return []

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def worker() -> Iterator[WorkerParts]:
    with worker_parts() as parts:
        yield parts


@pytest.fixture
def processes() -> ScriptedProcesses:
    return ScriptedProcesses()


@pytest.fixture
def limited(worker: WorkerParts, processes: ScriptedProcesses) -> LimitedServices:
    return LimitedServices(worker.context, processes)  # type: ignore[arg-type]


def place(
    worker: WorkerParts, robot: RobotId = ALICE, *, within_s: float = 5.0, **more: Any
) -> QueuedCommand:
    now = worker.loop.now
    command = Command(id=7, service="place", trace="t", **{"payload": {"map": b"m"}, **more})
    return QueuedCommand(robot, robot, command, 100, now, now + 5.0)


def reply_of(compute_ms: float, reply: Any, failure: Any = None, defect: str = "") -> bytes:
    return msgspec.msgpack.encode([compute_ms, reply, failure, defect])


def code_of(message: Result | Failure) -> str:
    return message.code if isinstance(message, Failure) else "ok"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Overran(0.06, 0.05), "expired"),
        (Overran(60.0, 1.9), "expired"),
        (WorkerLost("no template"), "worker-lost"),
        (Busy("not started"), "busy"),
    ],
)
def test_only_crashes_are_evidence(
    worker: WorkerParts, processes: ScriptedProcesses, limited: LimitedServices, error: Exception, code: str
):
    processes.script = [error] * 5 + [reply_of(1.0, None)]

    codes = [code_of(limited.compute(place(worker))) for _ in range(6)]

    assert codes == [code] * 5 + ["ok"]


@pytest.mark.parametrize("reply", [b"", b"\xc1", b"\x90", reply_of(0.0, None, ["x"]), b"\x93\x01\x02\x03"])
def test_a_reply_of_no_known_form_is_internal(
    worker: WorkerParts, processes: ScriptedProcesses, limited: LimitedServices, reply: bytes
):
    processes.script = [reply]

    assert code_of(limited.compute(place(worker))) == "internal"


def test_long_work_that_ends_at_the_deadline_is_evidence_too(
    worker: WorkerParts, processes: ScriptedProcesses, limited: LimitedServices
):
    processes.script = [Overran(5.0, 4.5)] * 2

    codes = [code_of(limited.compute(place(worker))) for _ in range(3)]

    assert codes == ["expired", "expired", "busy"]
