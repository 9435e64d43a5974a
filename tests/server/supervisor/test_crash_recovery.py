"""What follows the crash of a worker: who takes its place and when, and which robot is refused."""

from __future__ import annotations

import signal
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from rse_pf.identity import RobotId
from rse_pf.limits.crash_record import BLOCK_S, WINDOW_S
from rse_pf.server.supervisor.crash_recovery import CrashRecovery
from rse_pf.server.supervisor.crash_report import Crash
from rse_pf.server.supervisor.orders import BanOrder
from rse_pf.server.supervisor.session_registry import SessionRegistry

ONE, TWO, THREE = (RobotId("acme", name) for name in ("one", "two", "three"))


@dataclass(eq=False)
class FakeWorker:
    """A worker process that is none."""

    pid: int
    code: int = -signal.SIGSEGV
    seen: Crash = field(default_factory=lambda: Crash(0, None, ""))
    lives: bool = True
    orders: list[Any] = field(default_factory=list)
    killed: bool = False
    cpu_s: float = 2.0

    @property
    def crash(self) -> SimpleNamespace:
        return SimpleNamespace(read=lambda: self.seen)

    def exit_code(self, how: int) -> int:
        assert how == 0, "it waits for the end"
        return self.code

    def order(self, order: Any) -> None:
        self.orders.append(order)

    def begin(self, order: Any) -> bool:
        self.orders.append(order)
        return self.lives

    def kill(self) -> None:
        self.killed = True


class Server:
    """A server of two workers and *spares* processes that wait."""

    def __init__(self, spares: int = 9) -> None:
        self.now = 1000.0
        self.workers = [FakeWorker(1), FakeWorker(2)]
        self.spares = [FakeWorker(100 + number) for number in range(spares)]
        self.registry = SessionRegistry()
        self.said: list[tuple[str, dict[str, Any]]] = []
        self.noted: list[tuple[str, dict[str, Any]]] = []

        def say(event: str, **about: Any) -> None:
            self.said.append((event, about))

        def note(action: str, **about: Any) -> None:
            self.noted.append((action, about))

        self.recovery = CrashRecovery(
            self.workers, self.spares, registry=self.registry, trust=None,  # type: ignore[arg-type]
            log=SimpleNamespace(info=say, warning=say, error=say), records=SimpleNamespace(note=note),
        )  # fmt: skip

    def crash(self, robot: RobotId | None = None, worker: int = 0) -> FakeWorker | None:
        ended = self.workers[worker]
        ended.seen = Crash(7, robot, "f.py:1 f")
        return self.recovery.replace(ended, self.now)  # type: ignore[arg-type,return-value]

    def actions(self) -> list[str]:
        return [action for action, _ in self.noted]


@pytest.mark.parametrize("code", [1, 0, -signal.SIGKILL, -signal.SIGTERM])
def test_a_worker_that_ended_otherwise_is_not_replaced(code: int) -> None:
    server = Server()
    server.workers[0].code = code

    assert server.crash(ONE) is None
    assert not server.noted


def test_processes_that_wait_and_have_ended_are_passed_over_until_none_is_left() -> None:
    server = Server(spares=3)
    server.spares[-1].lives = False

    first, second = server.crash(), server.crash()

    assert [worker.pid for worker in (first, second) if worker is not None] == [101, 100]
    assert server.crash() is None


def test_a_crash_that_no_spare_is_left_for_is_counted_and_blamed_like_any_other() -> None:
    server = Server(spares=1)
    server.crash(ONE)

    assert server.crash(ONE) is None
    assert server.recovery.count == 2
    assert server.actions() == ["server.worker-crashed", "server.worker-crashed", "server.robot-shut-out"]


def test_two_crashes_by_one_robot_shut_it_out_everywhere_for_a_while() -> None:
    server = Server()
    other = server.workers[1]
    server.crash(ONE)
    assert not other.orders

    heir = server.crash(ONE)

    assert other.orders == [BanOrder(ONE, BLOCK_S)]
    assert heir is not None
    assert heir.orders[0].banned == [(ONE, BLOCK_S)]
    assert ("server.robot-shut-out", {"robot": "acme/one", "seconds": BLOCK_S}) in server.noted
    assert ("cut-off", {"robot": ONE, "reason": "crashes"}) in server.said
    for later_s, other, banned in ((20.0, TWO, [(ONE, BLOCK_S - 20.0 - 1.0)]), (BLOCK_S - 20.0, THREE, [])):
        server.now += later_s
        successor = server.crash(other)
        assert successor is not None
        assert successor.orders[0].banned == banned, "its wait of 1 s counts"


@pytest.mark.parametrize("other", [TWO, RobotId("rival", "one")])
def test_two_crashes_by_two_robots_shut_nobody_out(other: RobotId) -> None:
    server = Server()
    server.crash(ONE)
    server.crash(other)
    server.crash(None)

    assert "server.robot-shut-out" not in server.actions()


@pytest.mark.parametrize(
    ("apart_s", "waits_s"), [(0.0, [0.0, 0.0, 1.0, 2.0, 4.0]), (WINDOW_S / 2 + 1, [0.0] * 5)]
)
def test_after_two_crashes_within_the_window_each_successor_waits_twice_as_long(
    apart_s: float, waits_s: list[float]
) -> None:
    server = Server()
    successors = []
    for _ in waits_s:
        successors.append(server.crash(None))
        server.now += apart_s

    assert [each.orders[0].wait_s for each in successors if each is not None] == waits_s
    assert server.recovery.count == 5


def test_a_robot_that_the_report_does_not_name_is_found_by_its_connection() -> None:
    server = Server()
    worker = server.workers[0]
    server.registry.handle(worker, {"event": "arrived", "robot": list(ONE), "number": 7})  # type: ignore[arg-type]

    server.crash(None)

    assert server.noted[0][1]["robot"] == "acme/one"
    assert server.registry.robot_of(7) is None
    assert len(server.registry) == 0
