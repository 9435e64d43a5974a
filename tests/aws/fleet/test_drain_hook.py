"""An instance leaves its group only after its robots, and always before the hook gives up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rse_pf.audit.log import SYNC_S
from rse_pf.aws.fleet.task import Phase
from rse_pf.aws.fleet.tasks import lifecycle
from rse_pf.config import PlatformSettings
from rse_pf.config.elasticity import MOVE_WITHIN_MS
from rse_pf.scaling.health import CLOUD_INTERVAL_S, CLOUD_TIMEOUT_S, DRAIN_S, time_to_notice_s
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context

SETTINGS = PlatformSettings()


def leave(machine: FakeMachine, scaling: object, settings: PlatformSettings = SETTINGS) -> bool:
    """Follow the lifecycle of a leaving instance once; return whether its server ended in time."""
    machine.leaving = True
    told: list[dict[str, Any]] = []
    context = agent_context(
        machine, Path(), clients={"autoscaling": scaling}, settings=settings,
        log=lambda event, **fields: told.append({"event": event, **fields}),
    )  # fmt: skip
    lifecycle.task(context).call()
    assert context.state.phase is Phase.LEFT
    return bool(told[-1]["drained"])


def test_the_hook_is_completed_once_the_server_has_ended() -> None:
    machine = FakeMachine(ends_after_s=20.0)
    scaling = FakeScaling(machine)

    assert leave(machine, scaling)

    ((at_s, told),) = scaling.completed
    assert 120.0 <= at_s <= 121.0 + 2 * SYNC_S
    assert told == {
        "AutoScalingGroupName": "rse-pf", "LifecycleHookName": "drain",
        "InstanceId": "i-0123456789abcdef0", "LifecycleActionResult": "CONTINUE",
    }  # fmt: skip


def test_the_hook_is_completed_before_its_timeout_when_the_server_does_not_end() -> None:
    machine = FakeMachine(ends_after_s=1e9)
    scaling = FakeScaling(machine)

    assert not leave(machine, scaling)

    ((at_s, _),) = scaling.completed
    waited_s, whole_s = at_s - 100.0, DRAIN_S
    assert waited_s <= whole_s - 10.0, "no time for the call and its retries"
    assert waited_s >= whole_s - 20.0, "robots had more time to move"


def test_without_a_server_the_hook_is_completed_at_once() -> None:
    machine = FakeMachine(runs=False)
    scaling = FakeScaling(machine)

    assert leave(machine, scaling)
    assert [at_s for at_s, _ in scaling.completed] == [100.0 + 2 * SYNC_S]


def test_robots_move_only_after_the_load_balancer_has_noticed() -> None:
    machine = FakeMachine()

    leave(machine, FakeScaling(machine))

    health = SETTINGS.health
    assert machine.waits == [CLOUD_INTERVAL_S * health.unhealthy_checks + CLOUD_TIMEOUT_S]


def test_a_slow_load_balancer_leaves_two_thirds_of_the_hooks_time_to_the_robots() -> None:
    machine = FakeMachine()

    leave(machine, FakeScaling(machine), SETTINGS.replace(health={"unhealthy_checks": 10}))

    assert machine.waits == [DRAIN_S / 3]


def test_the_whole_drain_fits_into_the_hook_by_default() -> None:
    longest_s = (
        time_to_notice_s(SETTINGS.health, local=False)
        + MOVE_WITHIN_MS / 1e3
        + SETTINGS.session.answer_timeout_s
    )

    assert longest_s < DRAIN_S - 15.0
