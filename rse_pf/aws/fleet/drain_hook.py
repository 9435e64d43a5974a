"""Take an instance out of its group without losing robots: drain the server before the machine ends.

Auto Scaling names the new target state when the instance begins to leave, which is before the load balancer
has deregistered it; the hook waits only after that.  So the drain begins at once and the hook is completed
as soon as it waits, in any case well before its own timeout, even if no server is running.
"""

from __future__ import annotations

from collections.abc import Callable

from rse_pf.aws.fleet.instance import Instance
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from rse_pf.scaling.health import DRAIN_S, time_to_notice_s

__all__ = ["drain_server"]

_POLL_S = 0.5
# Kept of the hook's time for the call that completes it, with its retries.
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
