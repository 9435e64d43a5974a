"""Which settings a backend server on AWS reads: only these travel in its package.

Servers whose package has an equal digest are not replaced.  So a price, the threshold of an alarm or the
size of the fleet changes templates and leaves the servers alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from rse_pf.config.front_door import BURST_PATH
from rse_pf.config.settings import PlatformSettings

__all__ = ["READ_BY_SERVERS", "server_settings"]

READ_BY_SERVERS: dict[str, tuple[str, ...]] = {
    "cloud": (
        "name",
        "region",
        "spot",
    ),
    "scaling": ("period_s", "profile", "warm_up_s"),
    "burst": ("url", "robot_commands_per_day"),
    "health": ("unhealthy_checks",),
    "local": ("start_timeout_s",),
}
"""Of these groups the named settings; of every other group all settings."""


def server_settings(settings: PlatformSettings) -> dict[str, dict[str, Any]]:
    """Return what a server reads of *settings*, as plain JSON values by group.

    `PlatformSettings.from_dict` accepts it; what is left out has its default there and is not read.

    Raises:
        SettingsError: The parts that travel contradict a default of those that do not.
    """
    whole = settings.to_dict()
    chosen = {
        group.name: {
            name: value
            for name, value in whole[group.name].items()
            if name in READ_BY_SERVERS.get(group.name, (name,))
        }
        for group in dataclasses.fields(PlatformSettings)
    }
    chosen["burst"]["url"] = settings.burst.url or BURST_PATH  # the function is behind the load balancer
    # No server reads it, but it has to be a multiple of the period, whatever that is.
    chosen["scaling"]["idle_s"] = settings.scaling.period_s * 60
    PlatformSettings.from_dict(chosen)
    return chosen
