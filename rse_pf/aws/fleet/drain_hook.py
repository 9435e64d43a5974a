"""Leave a group in order: the server drains, then the lifecycle hook is completed.

The group has decided; this only makes sure that no robot pays for it.  Promises to complete the hook in any
case and well before its own timeout, also when no server runs any more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rse_pf.aws.clients import ask
from rse_pf.aws.fleet.instance import Machine
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from rse_pf.scaling.health import time_to_notice_s

__all__ = ["leave_group", "wait_before_move_s"]

_LOOK_S = 0.5
_SPARE_S = 15.0
"""Kept of the hook's time for the call that completes it, with its repeats."""


def wait_before_move_s(settings: PlatformSettings) -> float:
    """Return how long a load balancer may go on sending robots after the server says not ready."""
    return time_to_notice_s(settings.health, local=False)


def leave_group(
    machine: Machine,
    autoscaling: Any,
    *,
    group: str,
    hook: str,
    settings: PlatformSettings,
    clock: Callable[[], float],
    rest: Callable[[float], None],
    before_end: Callable[[], None] = lambda: None,
) -> bool:
    """Drain the server, complete *hook* of *group*; return whether the server left in time.

    *before_end* is called when the server is gone and raises nothing; the instance ends after the hook.
    """
    until = clock() + settings.cloud.drain_s - _SPARE_S
    gone = False
    try:
        machine.drain(min(wait_before_move_s(settings), settings.cloud.drain_s / 3))
        while clock() < until:
            machine.page()
            rest(_LOOK_S)
    except Disconnected:
        gone = True
    before_end()
    ask(
        autoscaling, "complete_lifecycle_action", AutoScalingGroupName=group, LifecycleHookName=hook,
        InstanceId=machine.instance_id(), LifecycleActionResult="CONTINUE",
    )  # fmt: skip
    return gone
