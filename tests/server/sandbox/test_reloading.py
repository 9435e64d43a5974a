"""Services that are replaced while robots are connected: no command is lost, doubled or out of order."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rse_pf.errors import ConfigurationError
from rse_pf.identity import RobotId
from rse_pf.server.sandbox.manager import SandboxHost
from rse_pf.server.sandbox.reloading import ReloadingSandboxes
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.services.custom.installed import InstalledService
from rse_pf.wire import Command, Failure, Result
from tests.kit.fakes import FakeLog, FakeLoop

ROBOT, OTHER = RobotId("default", "r"), RobotId("acme", "r")
"""Two robots of one name."""


class Sandboxes:
    """Stands for one `SandboxManager`: it answers when the test says so."""

    def __init__(self, names: list[str], answer: Any, on_ready: Any) -> None:
        self.names, self.answer, self.on_ready = names, answer, on_ready
        self.queued: list[QueuedCommand] = []
        self.robots: list[RobotId] = []
        self.is_retired = False

    held = property(lambda self: len(self.queued))

    def submit(self, queued: QueuedCommand) -> None:
        assert queued.command.service in self.names
        self.queued.append(queued)

    def reply(self) -> None:
        queued = self.queued.pop(0)
        self.answer(queued, Result(id=queued.command.id, reply={}))

    def add_connection(self, robot: RobotId) -> None:
        self.robots.append(robot)

    def remove_connection(self, robot: RobotId) -> None:
        self.robots.remove(robot)

    def waiting_of(self, robot: RobotId) -> int:
        return sum(each.robot == robot for each in self.queued)

    def report(self) -> dict[str, Any]:
        return {"sandboxes": 1, "missing_isolation": [], "open_breakers": [], "counts": {"crashes": 1}}

    def cpu_by_tenant(self) -> dict[str, float]:
        return {"acme": 1.5}

    def retire(self) -> None:
        self.is_retired = True

    close = retire


def queued(command: Command, robot: RobotId = ROBOT) -> QueuedCommand:
    return QueuedCommand(None, robot, command, 0, 0.0, 1.0)


class Parts:
    """Sandboxes that may be replaced, and what they made, answered and logged."""

    def __init__(self, *names: str, accepts_weak_isolation: bool = False) -> None:
        self.loop, self.log = FakeLoop(), FakeLog()
        self.made: list[Sandboxes] = []
        self.answers: list[tuple[int | None, str]] = []
        self.offered: list[tuple[str, ...]] = []
        self.host = SandboxHost(
            server_id="s",
            loop=self.loop,
            monotonic=time.monotonic,
            log=self.log,
            answer=self._answer,  # type: ignore[arg-type]
        )
        self.sandboxes = ReloadingSandboxes(
            self._make, accepts_weak_isolation=accepts_weak_isolation,
            start_timeout_s=20.0, host=self.host, on_change=self.offered.append,
        )  # fmt: skip
        self.sandboxes.start(services(*names))

    def _make(self, found: Sequence[InstalledService], *, answer: Any, on_ready: Any) -> Any:
        self.made.append(Sandboxes([each.name for each in found], answer, on_ready))
        return self.made[-1]

    def _answer(self, queued: QueuedCommand, message: Result | Failure) -> None:
        self.answers.append((message.id, message.code if isinstance(message, Failure) else "ok"))

    def call(self, number: int, service: str = "a", robot: RobotId = ROBOT) -> None:
        command = Command(id=number, service=service, payload={})
        self.sandboxes.submit(queued(command, robot), 0.0)

    def waiting(self) -> int:
        probe = queued(Command(id=0, service="a", payload={}))
        return self.sandboxes.backlog(probe).waiting

    def settle(self) -> None:
        self.loop.advance(0.001)


def services(*names: str) -> list[InstalledService]:
    return [
        InstalledService(name=name, language="lua", entry="x", kind="stateless", folder=Path(name))
        for name in names
    ]


CONNECTION = SimpleNamespace(robot=ROBOT)


def test_the_former_services_answer_until_the_new_ones_are_ready() -> None:
    parts = Parts("a")
    parts.sandboxes.enter(CONNECTION)
    parts.sandboxes.replace(services("a", "b"))

    parts.call(1)
    assert parts.made[0].held == 1
    assert not parts.sandboxes.offers("b")

    parts.made[1].on_ready(())
    assert parts.sandboxes.offers("b")
    assert parts.offered == [("a", "b")]
    assert parts.made[1].robots == [ROBOT]


def test_a_robots_commands_keep_their_order_and_others_do_not_wait_for_them() -> None:
    parts = Parts("a")
    parts.call(1)
    parts.sandboxes.replace(services("a"))
    parts.made[1].on_ready(())

    parts.call(2)
    parts.call(3, robot=OTHER)

    former, fresh = parts.made
    assert [each.command.id for each in fresh.queued] == [3]
    assert (parts.sandboxes.held, parts.waiting()) == (3, 2)
    former.reply()
    parts.settle()
    assert [each.command.id for each in fresh.queued] == [3, 2]
    assert former.is_retired
    fresh.reply()
    fresh.reply()
    assert parts.answers == [(1, "ok"), (3, "ok"), (2, "ok")]
    assert parts.sandboxes.report().sections["isolation"]["counts"] == {"crashes": 2}, (
        "counts of Prometheus never fall"
    )
    assert parts.sandboxes.report().cpu_s == {"sandboxes": {"acme": 3.0}}


def test_a_service_that_was_removed_is_unknown_also_to_who_waited_for_it() -> None:
    parts = Parts("a")
    parts.call(1)
    parts.sandboxes.replace([])

    parts.call(2)
    parts.made[0].reply()
    parts.settle()

    assert parts.answers == [(1, "ok"), (2, "unknown-service")]
    assert parts.sandboxes.names == ()
    assert parts.made[0].is_retired


@pytest.mark.parametrize(
    ("missing", "accepts", "is_taken"),
    [((), False, True), (("seccomp",), False, False), (("seccomp",), True, True), (None, True, False)],
)
def test_new_services_run_only_in_full_isolation(missing: Any, accepts: bool, is_taken: bool) -> None:
    parts = Parts("a", accepts_weak_isolation=accepts)
    parts.sandboxes.replace(services("b"))

    parts.made[1].on_ready(missing)
    parts.settle()

    assert parts.sandboxes.names == (("b",) if is_taken else ("a",))
    assert parts.log.names() == ["services-loaded" if is_taken else "services-refused"]
    assert parts.made[0].is_retired == is_taken


def test_services_that_never_get_ready_are_given_up_and_a_newer_list_replaces_them() -> None:
    parts = Parts("a")
    parts.sandboxes.replace(services("b"))
    parts.loop.advance(20.1)
    assert parts.made[1].is_retired
    parts.made[1].on_ready(())
    assert parts.sandboxes.names == ("a",)

    parts.sandboxes.replace(services("c"))
    parts.sandboxes.replace(services("d"))
    assert parts.made[2].is_retired
    parts.made[2].on_ready(())
    parts.made[3].on_ready(())
    assert parts.sandboxes.names == ("d",)


def test_the_first_services_are_started_when_they_come_and_a_failure_of_the_start_is_reported() -> None:
    parts = Parts()
    assert parts.made == []
    assert parts.sandboxes.report().gauges["sandboxes"] == 0

    parts.sandboxes.replace(services("a"))
    parts.made[0].on_ready(())
    parts.call(1)
    parts.made[0].reply()
    assert parts.answers == [(1, "ok")]

    def refuse(*_: Any, **__: Any) -> Any:
        raise ConfigurationError("no zygote")

    make: Callable[..., Any] = refuse
    with pytest.raises(ConfigurationError):
        ReloadingSandboxes(
            make, accepts_weak_isolation=False, start_timeout_s=1.0, host=parts.host,
            on_change=parts.offered.append,
        ).start(services("a"))  # fmt: skip
