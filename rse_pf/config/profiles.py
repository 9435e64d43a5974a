"""What a profile sets that the operator did not set: other defaults for a deployment of another size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["PROFILES", "with_profile"]

PROFILES: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "standard": {},
    # The smallest fleet that serves: one burstable server, so CPU above its credits costs extra.
    "small": {"scaling": {"min_servers": 1}, "cloud": {"instance_type": "t3a.medium"}},
}
"""``cloud.profile`` to group to setting to its default there."""


def with_profile(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return *overrides* with the defaults of the profile that they name; what they set stays."""
    cloud = overrides.get("cloud")
    name = cloud.get("profile") if isinstance(cloud, Mapping) else None
    made = dict(overrides)
    for group, values in PROFILES.get(name, {}).items() if isinstance(name, str) else ():
        given = made.get(group, {})
        if isinstance(given, Mapping):
            made[group] = {**values, **given}
    return made
