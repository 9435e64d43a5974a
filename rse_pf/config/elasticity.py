"""Refuse settings of scaling and capacity that contradict each other."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rse_pf.config.schedule import parse_schedule, zone_named
from rse_pf.config.validation import WHERE
from rse_pf.errors import SettingsError

__all__ = [
    "FAST_PERIOD_S",
    "FAST_SAMPLES",
    "IDLE_CPU_PERCENT",
    "MOVES_PER_S",
    "MOVE_WITHIN_MS",
    "UNDERUSED_CPU_PERCENT",
    "check_elasticity",
    "instance_types",
]

MOVES_PER_S = 20.0
"""Robots that a server with too many robots asks to move to other servers each second: few enough that the
other servers accept their connections without a queue."""
MOVE_WITHIN_MS = 5000.0
"""Milliseconds that a robot has for its move to another server; reconnecting takes less than a second on a
bad network."""
FAST_PERIOD_S = 10
"""Seconds of one CPU sample in the scaling profile "fast": the shortest period of a CloudWatch alarm."""
FAST_SAMPLES = 3
"""Consecutive busy samples after which the scaling profile "fast" adds servers."""
# Average CPU below which a fleet that gets no commands counts as idle: a server without robots uses a few
# percent.
IDLE_CPU_PERCENT = 20.0
# Average CPU below which a server is removed although robots send commands, if the average stays below for
# `scaling.underused_s`.
UNDERUSED_CPU_PERCENT = 15.0

_TYPE = re.compile(r"[a-z][a-z0-9-]*\.[a-z0-9-]+")
"""The form of the name of an EC2 instance type: family, dot, size."""
_ARM = re.compile(r"a1|[a-z]+[0-9]+[a-z]*g[a-z]*")
"""EC2 families with ARM processors: a letter g follows the generation, as in m7g, c6gn and t4g."""


def instance_types(preferred: str, others: str) -> tuple[str, ...]:
    """Return the EC2 instance types of a backend server: *preferred*, then *others*, without duplicates.

    The names in *others* are separated by spaces.
    """
    return tuple(dict.fromkeys((preferred, *others.split())))


def check_elasticity(scaling: Mapping[str, Any], cloud: Mapping[str, Any]) -> None:
    """Raise SettingsError if settings of the groups *scaling* and *cloud* are malformed or contradictory.

    Args:
        scaling: The settings of the group ``scaling``, by name.
        cloud: The settings of the group ``cloud``, by name.
    """
    types = instance_types(cloud["instance_type"], cloud["other_instance_types"])
    _check_periods(scaling)
    if scaling["underused_s"] and scaling["busy_cpu_percent"] < 2 * UNDERUSED_CPU_PERCENT:
        raise SettingsError(
            f"scaling.busy_cpu_percent = {scaling['busy_cpu_percent']:g} is less than twice the "
            f"{UNDERUSED_CPU_PERCENT:g} % below which a server is removed; if one of two servers were "
            "removed, the other one would be busy",
            hint=f"raise scaling.busy_cpu_percent {WHERE}, or set scaling.underused_s to 0",
        )
    zone_named(scaling["time_zone"])
    for entry in parse_schedule(scaling["schedule"]):
        if entry.min_servers > scaling["max_servers"]:
            raise SettingsError(
                f"scaling.schedule has min {entry.min_servers}, more than scaling.max_servers = "
                f"{scaling['max_servers']}",
                hint=f"raise scaling.max_servers {WHERE}, or write a smaller number",
            )
    for name in types:
        if _TYPE.fullmatch(name) is None:
            raise SettingsError(f"{name!r} is no EC2 type", hint=f"write types such as c7i.large {WHERE}")
        if _ARM.fullmatch(name.partition(".")[0]):
            raise SettingsError(
                f"{name} has an ARM processor; backend servers need x86-64",
                hint=f"choose a type such as c7i.large {WHERE}",
            )
    if cloud["warm_servers"] and (cloud["spot"] or len(types) > 1):
        other = "cloud.spot" if cloud["spot"] else "cloud.other_instance_types"
        raise SettingsError(
            f"cloud.warm_servers = {cloud['warm_servers']} and {other} exclude each other: AWS refuses a "
            "warm pool in a group with a mixed instances policy",
            hint=f"choose one of the two {WHERE}",
        )


def _check_periods(scaling: Mapping[str, Any]) -> None:
    """Raise SettingsError if ``scaling.idle_s`` is not a multiple of the period of a CPU sample."""
    fast = scaling["profile"] == "fast"
    period_s = FAST_PERIOD_S if fast else scaling["period_s"]
    if scaling["idle_s"] % period_s:
        allowed = f"the {FAST_PERIOD_S} s of the fast profile" if fast else f"scaling.period_s = {period_s}"
        raise SettingsError(
            f"scaling.idle_s = {scaling['idle_s']} is no multiple of {allowed}",
            hint=f"make it a multiple {WHERE}",
        )
