"""Which settings of scaling and capacity contradict each other; every refusal says what to change."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from rse_pf.config.schedule import parse_schedule, zone_named
from rse_pf.config.validation import WHERE
from rse_pf.errors import SettingsError

if TYPE_CHECKING:
    from rse_pf.config.settings import CloudSettings, ScalingSettings

__all__ = ["FAST_PERIOD_S", "FAST_SAMPLES", "check_elasticity", "instance_types"]

FAST_PERIOD_S = 10
"""One sample of the fast profile: the shortest period of a high-resolution alarm."""
FAST_SAMPLES = 3
"""Busy samples in a row before the fast profile grows."""

_TYPE = re.compile(r"[a-z][a-z0-9-]*\.[a-z0-9-]+")
_ARM = re.compile(r"a1|[a-z]+[0-9]+[a-z]*g[a-z]*")
"""Families of ARM processors: the letter g after the generation, such as m7g, c6gn and t4g."""


def instance_types(cloud: CloudSettings) -> tuple[str, ...]:
    """Return the EC2 types of a backend server, the preferred one first, each once."""
    return tuple(dict.fromkeys((cloud.instance_type, *cloud.other_instance_types.split())))


def check_elasticity(scaling: ScalingSettings, cloud: CloudSettings) -> None:
    """Raise SettingsError if two settings of *scaling* and *cloud* cannot both hold."""
    _check_periods(scaling)
    if scaling.underused_s and 2 * scaling.underused_cpu_percent > scaling.busy_cpu_percent:
        raise SettingsError(
            f"scaling.underused_cpu_percent = {scaling.underused_cpu_percent:g} is more than half of "
            f"scaling.busy_cpu_percent = {scaling.busy_cpu_percent:g}; one of two servers that leaves would "
            "make the other one busy",
            hint=f"lower scaling.underused_cpu_percent {WHERE}, or set scaling.underused_s to 0",
        )
    zone_named(scaling.time_zone)
    for entry in parse_schedule(scaling.schedule):
        if entry.min_servers > scaling.max_servers:
            raise SettingsError(
                f"scaling.schedule has min {entry.min_servers}, more than scaling.max_servers = "
                f"{scaling.max_servers}",
                hint=f"raise scaling.max_servers {WHERE}, or write a smaller number",
            )
    for name in instance_types(cloud):
        if _TYPE.fullmatch(name) is None:
            raise SettingsError(f"{name!r} is no EC2 type", hint=f"write types such as c7i.large {WHERE}")
        if _ARM.fullmatch(name.partition(".")[0]):
            raise SettingsError(
                f"{name} has an ARM processor; backend servers need x86-64",
                hint=f"choose such as c7i {WHERE}",
            )
    if cloud.warm_servers and (cloud.spot or len(instance_types(cloud)) > 1):
        other = "cloud.spot" if cloud.spot else "cloud.other_instance_types"
        raise SettingsError(
            f"cloud.warm_servers = {cloud.warm_servers} and {other} exclude each other: AWS refuses a warm "
            "pool in a group with a mixed instances policy",
            hint=f"choose one of the two {WHERE}",
        )


def _check_periods(scaling: ScalingSettings) -> None:
    fast = scaling.profile == "fast"
    period_s = FAST_PERIOD_S if fast else scaling.period_s
    if scaling.idle_s % period_s:
        told = f"the {FAST_PERIOD_S} s of the fast profile" if fast else f"scaling.period_s = {period_s}"
        raise SettingsError(
            f"scaling.idle_s = {scaling.idle_s} is no multiple of {told}", hint=f"make it a multiple {WHERE}"
        )
