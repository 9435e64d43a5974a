"""An instance joins its group only when its server takes work, and a warmed one stays silent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.fleet.agent import Agent, AgentContext
from rse_pf.aws.fleet.task import Phase, Task
from rse_pf.aws.fleet.tasks import lifecycle
from rse_pf.config import PlatformSettings
from rse_pf.scaling.boot_time import BOOT_LIMIT_S, BOOT_S, ready_within_s, retry_within_s
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context

SETTINGS = PlatformSettings()
LAUNCH, DRAIN = "launch", "drain"


class Setup:
    """An agent of a new instance, and a task that counts when it may publish."""

    def __init__(self, tmp_path: Path) -> None:
        self.machine = FakeMachine()
        self.scaling = FakeScaling(self.machine)
        self.log: list[tuple[str, dict[str, Any]]] = []
        self.published: list[float] = []
        self.context = agent_context(
            self.machine, tmp_path, clients={"autoscaling": self.scaling},
            log=lambda event, **fields: self.log.append((event, fields)),
        )  # fmt: skip
        self.agent = Agent(self.context, (lifecycle.task, self._publisher))

    def _publisher(self, context: AgentContext) -> Task:
        def publish() -> None:
            self.published.append(self.machine.now_s)

        return Task(name="p", period_s=0.0, call=publish, phases=frozenset({Phase.SERVING}))

    def steps(self, count: int, pause_s: float = 5.0) -> None:
        for _ in range(count):
            self.agent.step()
            self.machine.sleep(pause_s)

    def results(self) -> list[tuple[str, str]]:
        return [(a["LifecycleHookName"], a["LifecycleActionResult"]) for _, a in self.scaling.completed]


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return Setup(tmp_path)


def test_an_instance_joins_once_and_only_when_its_server_is_ready(setup: Setup) -> None:
    setup.machine.ready = False
    setup.steps(4)
    assert setup.results() == []
    assert setup.published == [], "a server that takes no robots has no load"

    setup.machine.ready = True
    setup.steps(10)

    assert setup.results() == [(LAUNCH, "CONTINUE")]
    assert len(setup.published) == 10


def test_a_server_that_never_gets_ready_is_abandoned_within_its_budget(setup: Setup) -> None:
    setup.machine.ready = False
    began_s = setup.machine.now_s

    setup.steps(100)

    assert setup.results() == [(LAUNCH, "ABANDON")]
    ((at_s, _),) = setup.scaling.completed
    assert at_s - began_s <= ready_within_s() + 5.0
    assert [event for event, _ in setup.log] == ["not-ready"]
    assert setup.published == []


def test_a_restart_beside_a_dead_server_ends_no_instance_and_does_not_stop_the_agent(setup: Setup) -> None:
    setup.scaling.waits = lambda hook: False
    setup.machine.ready = False

    setup.steps(100)

    assert setup.context.state.phase is Phase.SERVING


@pytest.mark.parametrize("warmed", ["Warmed:Stopped", "Warmed:Running", "Warmed:Hibernated"])
def test_a_warmed_instance_is_prepared_and_silent_and_joins_when_it_is_used(
    setup: Setup, warmed: str
) -> None:
    setup.machine.target = warmed
    setup.steps(5)
    assert setup.results() == [(LAUNCH, "CONTINUE")]
    assert setup.context.state.phase is Phase.WARMED
    assert setup.published == []

    setup.machine.target, setup.machine.ready = "InService", False
    setup.steps(2)
    assert setup.results() == [(LAUNCH, "CONTINUE")], "it joined before its server was ready again"
    setup.machine.ready = True
    setup.steps(2)

    assert setup.results() == [(LAUNCH, "CONTINUE")] * 2
    assert setup.published


def test_a_drain_begins_before_the_hook_waits_and_is_done_once(setup: Setup) -> None:
    """The load balancer deregisters first, for up to its delay; the hook waits only after that."""
    setup.steps(1)
    setup.machine.leaving = True
    hook_waits_at_s = setup.machine.now_s + 60.0
    setup.scaling.waits = lambda hook: hook != DRAIN or setup.machine.now_s >= hook_waits_at_s

    setup.steps(30)

    assert len(setup.machine.waits) == 1
    assert setup.results() == [(LAUNCH, "CONTINUE"), (DRAIN, "CONTINUE")]
    assert setup.scaling.completed[-1][0] <= hook_waits_at_s + 6.0
    assert [event for event, _ in setup.log].count("leaving") == 1


def test_retries_boot_and_readiness_fit_into_the_hook() -> None:
    late_role_s, late_server_s = retry_within_s(), ready_within_s()

    assert late_role_s + late_server_s + 0.2 * BOOT_LIMIT_S < BOOT_LIMIT_S
    assert late_role_s >= 2 * 20, "a role that comes 20 s late is no reason to end a machine"
    assert BOOT_LIMIT_S >= 2 * BOOT_S
