"""Remove an instance from its group without losing robots: drain its server before the machine is terminated.

1. Auto Scaling sets the instance's target state to ``Terminated``, and the agent begins the drain.
2. The load balancer deregisters the instance.
3. The termination hook waits.  The agent completes it as soon as the server has exited, or shortly before the
   hook's own time limit, or at once if no server runs.
"""

from __future__ import annotations

from collections.abc import Callable

from rse_pf.aws.fleet.instance import Instance
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from rse_pf.scaling.health import DRAIN_S, time_to_notice_s

__all__ = ["drain_server"]

# Time between two checks whether the server has exited, in seconds.
_POLL_S = 0.5
# Seconds of the hook's time `DRAIN_S` that are reserved for the call that completes the hook, with retries.
_HOOK_RESERVE_S = 15.0


def drain_server(
    machine: Instance,
    *,
    settings: PlatformSettings,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> bool:
    """Drain the server of *machine* and wait until it has exited, for `DRAIN_S` - `_HOOK_RESERVE_S` at most.

    Return whether the server exited in time; True if no server runs.
    """
    until = clock() + DRAIN_S - _HOOK_RESERVE_S
    try:
        # The server takes robots until the load balancer has noticed that it is not ready, and then drains.
        machine.drain(min(time_to_notice_s(settings.health, local=False), DRAIN_S / 3))
        while clock() < until:
            machine.page()
            sleep(_POLL_S)
    except Disconnected:
        return True
    return False
