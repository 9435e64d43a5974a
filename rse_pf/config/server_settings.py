"""The settings that a backend server on AWS reads: only these are in the package that it installs.

A deployment replaces servers only if the digest of their package has changed.  A change of other settings,
such as a price, the threshold of an alarm or the size of the fleet, therefore replaces no server.
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
"""By group of settings: the names of the settings that a server reads.  Of a group that is not a key here, a
server reads all settings."""


def server_settings(settings: PlatformSettings) -> dict[str, dict[str, Any]]:
    """Return the settings of *settings* that a server reads, as plain JSON values by group and name.

    `PlatformSettings.from_dict` accepts the result; it gives the default to each setting that is left out,
    which no server reads.

    Raises:
        SettingsError: The result contradicts the default of a setting that is left out.
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
    # Without burst.url, robots send commands to the load balancer, which passes them to the Lambda function.
    chosen["burst"]["url"] = settings.burst.url or BURST_PATH
    # No server reads scaling.idle_s, but `PlatformSettings` accepts only a multiple of scaling.period_s.
    chosen["scaling"]["idle_s"] = settings.scaling.period_s * 60
    PlatformSettings.from_dict(chosen)
    return chosen
