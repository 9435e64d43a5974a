"""Take an instance out of its group without losing robots: drain the server, then complete the hook.

The lifecycle hook is completed in any case and well before its own timeout, even if no server is running.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rse_pf.aws.clients import call_api
from rse_pf.aws.fleet.instance import Instance
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from rse_pf.scaling.health import time_to_notice_s

__all__ = ["leave_group"]

_POLL_S = 0.5
# Kept of the hook's time for the call that completes it, with its retries.
_RESERVE_S = 15.0


def leave_group(
    machine: Instance,
    autoscaling: Any,
    *,
    group: str,
    hook: str,
    settings: PlatformSettings,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
    before_end: Callable[[], None] = lambda: None,
) -> bool:
    """Drain the server, then complete *hook* of *group*; return whether the server ended in time.

    *before_end* is called after the server has ended and must not raise; the hook ends the instance.
    """
    until = clock() + settings.cloud.drain_s - _RESERVE_S
    has_ended = False
    try:
        # The load balancer sends robots until it has noticed that the server is not ready.
        machine.drain(min(time_to_notice_s(settings.health, local=False), settings.cloud.drain_s / 3))
        while clock() < until:
            machine.page()
            sleep(_POLL_S)
    except Disconnected:
        has_ended = True
    before_end()
    call_api(
        autoscaling, "complete_lifecycle_action", AutoScalingGroupName=group, LifecycleHookName=hook,
        InstanceId=machine.instance_id(), LifecycleActionResult="CONTINUE",
    )  # fmt: skip
    return has_ended
