"""What a load costs a month, on the EC2 fleet and on the Lambda, from one dated table of prices.

Pure: settings and a load in, money out.  A server carries commands up to ``scaling.busy_cpu_percent``; the
fleet has as many servers as that needs, never fewer than ``scaling.min_servers``.  Promises no more than list
prices allow: `NOT_INCLUDED` is part of every answer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.config import PlatformSettings

__all__ = [
    "HOURS",
    "NOT_INCLUDED",
    "Costs",
    "Load",
    "compare",
    "crossing_commands_per_s",
    "interface_endpoints",
]

HOURS = 730.0
"""Hours of a month, as AWS counts."""
NOT_INCLUDED = (
    "taxes, data out to the robots (the same for both), stored maps and logs, WAF by the handshake, "
    "savings plans, the free tier"
)
_DAY_H = 24.0
_ZONES = 2
_ENDPOINTS = {"minimal": 3, "full": 5}
_SOCKETS_OF_A_UNIT, _BYTES_OF_A_UNIT = 3000, 1e9
_MB_OF_A_VCPU = 1769


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What robots ask, while they are at work."""

    robots: int
    fps: float
    hours_per_day: float = _DAY_H

    @property
    def commands_per_s(self) -> float:
        """All robots together, in their hours."""
        return self.robots * self.fps


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """USD a month, and what it buys.

    ``servers`` is what the fleet needs in its busy hours; ``at_once`` how many executions the Lambda needs.
    """

    floor_usd: float
    fleet_usd: float
    lambda_usd: float
    servers: int
    at_once: float
    crossing_commands_per_s: float | None


def interface_endpoints(settings: PlatformSettings) -> int:
    """Return how many interface endpoints stand in the VPC, counted in each zone."""
    return _ENDPOINTS[settings.cloud.endpoints] * _ZONES


def compare(settings: PlatformSettings, load: Load) -> Costs:
    """Return what *load* costs either way; the floor is what the fleet costs when nobody asks."""
    servers = max(
        settings.scaling.min_servers,
        math.ceil(round(load.commands_per_s / _capacity_per_s(settings), 9)),
        math.ceil(load.robots / settings.serving.max_robots),
    )
    hours = HOURS * load.hours_per_day / _DAY_H
    lambda_usd = load.commands_per_s * 3600 * hours * _lambda_usd(settings)
    per_robot = settings.prices.balancer_unit_hour_usd * _units_per_command_s(settings, load.fps)
    return Costs(
        floor_usd=_floor_usd(settings),
        fleet_usd=_servers_usd(settings, servers, hours) + load.commands_per_s * per_robot * hours,
        lambda_usd=lambda_usd,
        servers=servers,
        at_once=load.commands_per_s * _billed_ms(settings) / 1e3,
        crossing_commands_per_s=crossing_commands_per_s(settings, load.fps, load.hours_per_day),
    )


def crossing_commands_per_s(
    settings: PlatformSettings, fps: float, hours_per_day: float = _DAY_H
) -> float | None:
    """Return the smallest rate in the busy hours at which the fleet costs no more than the Lambda.

    None if that never happens with ``scaling.max_servers`` or fewer.
    """
    hours = HOURS * hours_per_day / _DAY_H
    units = settings.prices.balancer_unit_hour_usd * _units_per_command_s(settings, fps)
    saved_usd = hours * (3600 * _lambda_usd(settings) - units)  # a month, for each command a second
    if saved_usd <= 0 or hours <= 0:
        return None
    most, below = min(_capacity_per_s(settings), settings.serving.max_robots * fps), 0.0
    for servers in range(settings.scaling.min_servers, settings.scaling.max_servers + 1):
        rate = max(below, _servers_usd(settings, servers, hours) / saved_usd)
        if rate <= servers * most:
            return rate
        below = servers * most
    return None


def _capacity_per_s(settings: PlatformSettings) -> float:
    busy = settings.scaling.busy_cpu_percent / 100
    return settings.prices.server_vcpus * busy / (settings.prices.command_cpu_ms / 1e3)


def _floor_usd(settings: PlatformSettings) -> float:
    prices = settings.prices
    hourly = prices.balancer_hour_usd + prices.endpoint_hour_usd * interface_endpoints(settings)
    each = prices.server_hour_usd * HOURS + prices.server_month_usd
    return prices.fixed_month_usd + hourly * HOURS + settings.scaling.min_servers * each


def _servers_usd(settings: PlatformSettings, servers: int, hours: float) -> float:
    """Return the floor and what the servers beyond it cost in the busy hours."""
    each = settings.prices.server_hour_usd + settings.prices.server_month_usd / HOURS
    return _floor_usd(settings) + (servers - settings.scaling.min_servers) * each * hours


def _units_per_command_s(settings: PlatformSettings, fps: float) -> float:
    """Return the capacity units of the balancer for one command a second: sockets or bytes."""
    return max(1 / fps / _SOCKETS_OF_A_UNIT, 3600 * settings.prices.command_bytes / _BYTES_OF_A_UNIT)


def _billed_ms(settings: PlatformSettings) -> int:
    """Return what one warm execution is billed for; less memory is less of a vCPU."""
    slower = max(1.0, _MB_OF_A_VCPU / settings.cloud.lambda_memory_mb)
    return math.ceil(settings.prices.command_cpu_ms * slower)


def _lambda_usd(settings: PlatformSettings) -> float:
    """Return the price of one command on the Lambda."""
    gb_s = settings.cloud.lambda_memory_mb / 1024 * _billed_ms(settings) / 1e3
    return settings.prices.lambda_million_usd / 1e6 + gb_s * settings.prices.lambda_gb_s_usd
