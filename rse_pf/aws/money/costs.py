"""Estimate what a load costs a month on the EC2 fleet and on the Lambda.

A server accepts commands up to ``scaling.busy_cpu_percent``; the fleet has as many servers as that needs, but
never fewer than ``scaling.min_servers``.  What the estimate leaves out is in `NOT_INCLUDED`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.aws.money.prices import Prices
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
"""Hours of a month, as in the calculator of AWS."""
NOT_INCLUDED = (
    "taxes, data out to the robots (the same for both), stored maps and logs, WAF by the handshake, "
    "savings plans, the free tier"
)
_DAY_H = 24.0
_ZONES = 2
_ENDPOINTS = {"minimal": 3, "full": 5}
_CONNECTIONS_OF_A_UNIT, _BYTES_OF_A_UNIT = 3000, 1e9
_MB_OF_A_VCPU = 1769


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """How many robots send how many commands, and for how long each day."""

    robots: int
    fps: float
    hours_per_day: float = _DAY_H

    @property
    def commands_per_s(self) -> float:
        """Return the commands per second of all robots together, in their hours."""
        return self.robots * self.fps


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """What a load costs a month, in the currency of the prices, and the capacity that it needs."""

    floor: float
    """Cost of the fleet without any command."""
    fleet: float
    serverless: float
    servers: int
    """Servers that the fleet needs in the busy hours."""
    executions: float
    """Concurrent executions that the Lambda needs."""
    crossing_commands_per_s: float | None


def interface_endpoints(settings: PlatformSettings) -> int:
    """Return how many interface endpoints the VPC has, counted in each zone."""
    return _ENDPOINTS[settings.cloud.endpoints] * _ZONES


def compare(settings: PlatformSettings, prices: Prices, load: Load) -> Costs:
    """Return what *load* costs on the fleet and on the Lambda."""
    tariff = _Tariff(settings, prices, load.fps)
    servers = max(
        settings.scaling.min_servers,
        math.ceil(round(load.commands_per_s / tariff.capacity_per_s, 9)),
        math.ceil(load.robots / settings.serving.max_robots),
    )
    hours = HOURS * load.hours_per_day / _DAY_H
    return Costs(
        floor=tariff.fleet(settings.scaling.min_servers, hours),
        fleet=tariff.fleet(servers, hours) + load.commands_per_s * tariff.units_per_command * hours,
        serverless=load.commands_per_s * tariff.serverless_per_command * 3600 * hours,
        servers=servers,
        executions=load.commands_per_s * tariff.billed_ms / 1e3,
        crossing_commands_per_s=crossing_commands_per_s(settings, prices, load.fps, load.hours_per_day),
    )


def crossing_commands_per_s(
    settings: PlatformSettings, prices: Prices, fps: float, hours_per_day: float = _DAY_H
) -> float | None:
    """Return the smallest rate in the busy hours at which the fleet costs no more than the Lambda.

    None if that never happens with ``scaling.max_servers`` or fewer.
    """
    tariff = _Tariff(settings, prices, fps)
    hours = HOURS * hours_per_day / _DAY_H
    saved = hours * (3600 * tariff.serverless_per_command - tariff.units_per_command)  # by 1 command/s
    if saved <= 0 or hours <= 0:
        return None
    most, below = min(tariff.capacity_per_s, settings.serving.max_robots * fps), 0.0
    for servers in range(settings.scaling.min_servers, settings.scaling.max_servers + 1):
        rate = max(below, tariff.fleet(servers, hours) / saved)
        if rate <= servers * most:
            return rate
        below = servers * most
    return None


class _Tariff:
    """The cost of a server, a command and an execution under *settings*, for robots of *fps*."""

    def __init__(self, settings: PlatformSettings, prices: Prices, fps: float) -> None:
        busy = settings.scaling.busy_cpu_percent / 100
        memory_mb = settings.cloud.lambda_memory_mb
        self.capacity_per_s = prices.server_vcpus * busy / (prices.command_cpu_ms / 1e3)
        # AWS counts connections or bytes of the load balancer, whichever costs more.
        units = max(1 / fps / _CONNECTIONS_OF_A_UNIT, 3600 * prices.command_bytes / _BYTES_OF_A_UNIT)
        self.units_per_command = prices.balancer_unit_per_hour * units
        # A warm execution; less memory is less of a vCPU.
        self.billed_ms = math.ceil(prices.command_cpu_ms * max(1.0, _MB_OF_A_VCPU / memory_mb))
        gb_s = memory_mb / 1024 * self.billed_ms / 1e3
        self.serverless_per_command = prices.lambda_per_million / 1e6 + gb_s * prices.lambda_per_gb_s
        self._settings, self._prices = settings, prices

    def fleet(self, servers: int, hours: float) -> float:
        """Return the floor, and what *servers* cost beyond it in the busy *hours* of a month."""
        prices, min_servers = self._prices, self._settings.scaling.min_servers
        hourly = prices.balancer_per_hour + prices.endpoint_per_hour * interface_endpoints(self._settings)
        each = prices.server_per_hour + prices.server_per_month / HOURS
        floor = prices.fixed_per_month + (hourly + min_servers * each) * HOURS
        return floor + (servers - min_servers) * each * hours
