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
"""Robots that a crowded server asks to move each second, so that the others accept them without a queue."""
MOVE_WITHIN_MS = 5000.0
"""Time that a robot gets to move to another server: reconnecting takes less than one on a bad network."""
FAST_PERIOD_S = 10
"""One sample of the fast profile: the shortest period of a high-resolution alarm."""
FAST_SAMPLES = 3
"""Busy samples in a row before the fast profile grows."""
# Average CPU below which a fleet without commands is idle; a server without robots needs a few percent.
IDLE_CPU_PERCENT = 20.0
# Average CPU below which one server fewer is enough although robots send commands; `scaling.underused_s`.
UNDERUSED_CPU_PERCENT = 15.0

_TYPE = re.compile(r"[a-z][a-z0-9-]*\.[a-z0-9-]+")
_ARM = re.compile(r"a1|[a-z]+[0-9]+[a-z]*g[a-z]*")
"""Families of ARM processors: the letter g after the generation, such as m7g, c6gn and t4g."""


def instance_types(preferred: str, others: str) -> tuple[str, ...]:
    """Return the EC2 types of a backend server, the *preferred* one first, each once.

    The *others* are separated by spaces.
    """
    return tuple(dict.fromkeys((preferred, *others.split())))


def check_elasticity(scaling: Mapping[str, Any], cloud: Mapping[str, Any]) -> None:
    """Raise SettingsError if two settings of *scaling* and *cloud*, by name, cannot both hold."""
    types = instance_types(cloud["instance_type"], cloud["other_instance_types"])
    _check_periods(scaling)
    if scaling["underused_s"] and scaling["busy_cpu_percent"] < 2 * UNDERUSED_CPU_PERCENT:
        raise SettingsError(
            f"scaling.busy_cpu_percent = {scaling['busy_cpu_percent']:g} is less than twice the "
            f"{UNDERUSED_CPU_PERCENT:g} % below which a server is spared; one of two servers that leaves "
            "would make the other one busy",
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
    fast = scaling["profile"] == "fast"
    period_s = FAST_PERIOD_S if fast else scaling["period_s"]
    if scaling["idle_s"] % period_s:
        allowed = f"the {FAST_PERIOD_S} s of the fast profile" if fast else f"scaling.period_s = {period_s}"
        raise SettingsError(
            f"scaling.idle_s = {scaling['idle_s']} is no multiple of {allowed}",
            hint=f"make it a multiple {WHERE}",
        )
