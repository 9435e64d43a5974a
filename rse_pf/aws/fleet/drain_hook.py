"""Take an instance out of its group without losing robots: drain the server before the machine ends.

1. Auto Scaling publishes the target state ``Terminated``, and the drain begins.
2. The load balancer deregisters the instance.
3. The hook starts to wait, and is completed as soon as the server has ended, or shortly before the hook's own
   time limit; also if no server runs.
"""

from __future__ import annotations

from collections.abc import Callable

from rse_pf.aws.fleet.instance import Instance
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from rse_pf.scaling.health import DRAIN_S, time_to_notice_s

__all__ = ["drain_server"]

# Time between two checks whether the server has ended, in seconds.
_POLL_S = 0.5
# Part of the hook's time, in seconds, that is reserved for the call that completes it, with its retries.
_RESERVE_S = 15.0


def drain_server(
    machine: Instance,
    *,
    settings: PlatformSettings,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> bool:
    """Drain the server of *machine* and wait for its end; return whether it ended in time."""
    until = clock() + DRAIN_S - _RESERVE_S
    try:
        # The load balancer sends robots until it has noticed that the server is not ready.
        machine.drain(min(time_to_notice_s(settings.health, local=False), DRAIN_S / 3))
        while clock() < until:
            machine.page()
            sleep(_POLL_S)
    except Disconnected:
        return True
    return False
