"""Profiles of deployments: other defaults for the settings of a deployment of another size.

A setting that the operator sets is not changed by a profile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["PROFILES", "with_profile"]

PROFILES: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "standard": {},
    # The smallest fleet that serves: one burstable server, so CPU above its credits costs extra.
    "small": {"scaling": {"min_servers": 1}, "cloud": {"instance_type": "t3a.medium"}},
}
"""By value of ``cloud.profile``, group and name: the settings with another default in this profile."""


def with_profile(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return *overrides* completed by the defaults of the profile that their ``cloud.profile`` names.

    A setting in *overrides* keeps its value.  An unknown profile adds nothing.
    """
    cloud = overrides.get("cloud")
    name = cloud.get("profile") if isinstance(cloud, Mapping) else None
    made = dict(overrides)
    for group, values in PROFILES.get(name, {}).items() if isinstance(name, str) else ():
        given = made.get(group, {})
        if isinstance(given, Mapping):
            made[group] = {**values, **given}
    return made
