"""Estimate what a deployment costs a month: line by line, by box of Fig. 2, and on the Lambda alone.

A server accepts commands up to ``scaling.busy_cpu_percent``; the fleet has as many servers as that needs, but
never fewer than ``scaling.min_servers``.  A sum is always the sum of its lines, each rounded to a cent.  What
the estimate leaves out is in `NOT_INCLUDED`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import (
    CANARY_MB,
    CANARY_PERIOD_S,
    ENDPOINT_SERVICES,
    LAMBDA_MEMORY_MB,
    ON_DEMAND_SERVERS,
    VOLUME_GB,
    zone_count,
)
from rse_pf.config.front_door import rate_rules
from rse_pf.extensions.costs.prices import Prices
from rse_pf.scaling.alarms import alarms_of
from rse_pf.scaling.operator_alarms import operator_alarms
from rse_pf.scaling.profile import cadence_of

__all__ = [
    "DAY_H",
    "HOURS",
    "NOT_INCLUDED",
    "Bill",
    "CostLine",
    "Load",
    "bill_of",
    "lambda_alone",
    "lambda_executions",
    "parked",
    "servers_needed",
]

# Hours of a month, as in the calculator of AWS.
HOURS = 730.0
DAY_H = 24.0
NOT_INCLUDED = (
    "taxes, data out to the robots (the same for fleet and Lambda), inspection by the firewall "
    "(except of burst commands), requests to S3, stored maps and logs, copies in other regions, "
    "live maps (0.04 USD an hour each, in S3), savings plans, the free tier"
)

_HOUR_S = 3600.0
# A capacity unit of the load balancer holds this many open connections, or passes this many bytes in an hour.
_CONNECTIONS_OF_A_UNIT = 3000
_BYTES_OF_A_UNIT = 1e9
# The load balancer needs a public address in each of two zones.
_BALANCER_ZONES = 2
# Metrics that EC2 publishes each minute for a server with detailed monitoring.
_DETAILED_METRICS = 7
# Metrics that the agent of a server with robots reads each period: the numbers of robots and of servers.
_READ_METRICS = 2
# Rules of the web ACL in addition to the rate limits: one refuses burst commands without a token.
_TOKEN_RULES = 1
# An alarm with a shorter period than this is priced higher.
_FAST_BELOW_S = 60
# Time that one call of the canary takes.
_CANARY_S = 1.0

Needs = Literal["servers", "balancer", "always"]
"""The resources whose removal ends the costs of a line; ``always`` lines stay while parked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """How many robots send how many commands, and for how long each day.

    ``burst_commands_per_day`` are answered by the Lambda in addition to the fleet.
    """

    robots: int = 0
    fps: float = 0.0
    hours_per_day: float = DAY_H
    burst_commands_per_day: float = 0.0

    @property
    def commands_per_s(self) -> float:
        """Return the commands per second of all robots together, in their hours."""
        return self.robots * self.fps

    @property
    def hours(self) -> float:
        """Return the hours of a month in which the robots are at work."""
        return HOURS * self.hours_per_day / DAY_H


@dataclass(frozen=True, slots=True, kw_only=True)
class CostLine:
    """One line of a bill: *count* units of *unit* in a month at *price* each; *box* is one of Fig. 2."""

    box: str
    what: str
    count: float
    unit: str
    price: float
    needs: Needs

    @property
    def amount(self) -> float:
        """Return what the line costs a month, rounded to a cent."""
        return round(self.count * self.price, 2)


@dataclass(frozen=True, slots=True)
class Bill:
    """What a month costs, in the currency of the prices."""

    lines: tuple[CostLine, ...]

    @property
    def total(self) -> float:
        """Return the sum of the lines."""
        return round(sum(line.amount for line in self.lines), 2)

    def sum_by_box(self) -> dict[str, float]:
        """Return the sum of each box, in the order of the lines."""
        sums: dict[str, float] = {}
        for line in self.lines:
            sums[line.box] = round(sums.get(line.box, 0.0) + line.amount, 2)
        return sums


def bill_of(settings: PlatformSettings, prices: Prices, load: Load | None = None) -> Bill:
    """Return the bill of a month with *load*; without it, of a month without any robot.

    Raises:
        ConfigurationError: The price of ``cloud.instance_type`` is not known.
    """
    load = load or Load()
    lines = (
        *_server_lines(settings, prices, load),
        *_balancer_lines(settings, prices, load),
        *_standing_lines(settings, prices),
        *_lambda_lines(prices, load.burst_commands_per_day * HOURS / DAY_H),
    )
    return Bill(tuple(line for line in lines if line.count))


def parked(bill: Bill, *, deep: bool) -> Bill:
    """Return what is left of *bill* without servers.

    If *deep*, load balancer, firewall and endpoints are gone, too.
    """
    gone: tuple[Needs, ...] = ("servers", "balancer") if deep else ("servers",)
    return Bill(tuple(line for line in bill.lines if line.needs not in gone))


def lambda_alone(prices: Prices, load: Load) -> float:
    """Return what a month costs if the Lambda answers every command of *load*."""
    commands = load.commands_per_s * load.hours * _HOUR_S
    return sum(line.count * line.price for line in _lambda_lines(prices, commands))


def lambda_executions(prices: Prices, load: Load) -> float:
    """Return how many executions the Lambda needs at the same time to answer every command of *load*."""
    return load.commands_per_s * _billed_ms(prices) / 1e3


def servers_needed(settings: PlatformSettings, prices: Prices, load: Load) -> int:
    """Return how many servers the fleet has while the robots are at work."""
    vcpus = prices.server(settings.cloud.instance_type).vcpus
    capacity_per_s = vcpus * settings.scaling.busy_cpu_percent / 100 / (prices.command_cpu_ms / 1e3)
    return max(
        settings.scaling.min_servers,
        math.ceil(round(load.commands_per_s / capacity_per_s, 9)),  # 3.0000000001 servers are three
        math.ceil(load.robots / settings.serving.max_robots),
    )


def _server_lines(settings: PlatformSettings, prices: Prices, load: Load) -> list[CostLine]:
    """Return what running servers cost, and the volumes of stopped ones."""
    kind, price = settings.cloud.instance_type, prices.server(settings.cloud.instance_type)
    floor, busy = settings.scaling.min_servers, servers_needed(settings, prices, load)
    hours = HOURS * floor + load.hours * (busy - floor)
    on_demand = ON_DEMAND_SERVERS if settings.cloud.spot else busy
    on_demand_hours = HOURS * min(on_demand, floor) + load.hours * (
        min(on_demand, busy) - min(on_demand, floor)
    )
    months = hours / HOURS
    period_s = cadence_of(settings.scaling).period_s
    reading_hours = load.hours * busy if load.robots else 0.0  # an agent without robots reads nothing
    requests = (hours + _READ_METRICS * reading_hours) * _HOUR_S / period_s
    of_fleet, of_server = _count_published_metrics()
    metrics = of_fleet + months * (of_server + _DETAILED_METRICS)
    rows = (
        ("backend servers", f"{kind} on demand", on_demand_hours, "h", price.per_hour),
        ("backend servers", f"{kind} as Spot instances", hours - on_demand_hours, "h", price.spot_per_hour),
        ("backend servers", "volumes", months * VOLUME_GB, "GB", prices.volume_per_gb_month),
        ("monitor", "metrics", metrics, "metrics", prices.metric_per_month),
        ("monitor", "requests for metrics", requests / 1e3, "thousand", prices.metric_calls_per_thousand),
    )
    warm_gb = settings.cloud.warm_servers * VOLUME_GB
    warm_row = ("backend servers", "volumes of stopped servers", warm_gb, "GB", prices.volume_per_gb_month)
    return [*_lines("servers", rows), *_lines("always", [warm_row])]


def _balancer_lines(settings: PlatformSettings, prices: Prices, load: Load) -> list[CostLine]:
    """Return the lines of load balancer, firewall, and interface endpoints."""
    # AWS counts connections or bytes, whichever costs more; a robot connects once.
    by_connections = load.robots / _CONNECTIONS_OF_A_UNIT
    by_bytes = load.commands_per_s * _HOUR_S * prices.command_bytes / _BYTES_OF_A_UNIT
    units = max(by_connections, by_bytes) * load.hours
    addresses = _BALANCER_ZONES * HOURS
    rules = len(rate_rules(settings)) + _TOKEN_RULES
    zones = zone_count(settings)
    rows = [
        ("load balancer", "load balancer", HOURS, "h", prices.balancer_per_hour),
        ("load balancer", "its public addresses, in two zones", addresses, "h", prices.address_per_hour),
        ("load balancer", "capacity units", units, "h", prices.balancer_unit_per_hour),
        ("firewall", "web ACL", 1.0, "", prices.firewall_per_month),
        ("firewall", "its rules", float(rules), "rules", prices.firewall_rule_per_month),
    ]
    for service, box in ENDPOINT_SERVICES.items():
        what = f"endpoint of {service}, in {zones} zone(s)"
        rows.append((box, what, zones * HOURS, "h", prices.endpoint_per_hour))
    return _lines("balancer", rows)


def _standing_lines(settings: PlatformSettings, prices: Prices) -> list[CostLine]:
    """Return what a parked platform pays as well: alarms, canary and secrets."""
    calling = [(len(alarm.series), alarm.period_s) for alarm in operator_alarms(settings)]
    scaling = [(len(alarm.metrics), alarm.period_s) for alarm in alarms_of(settings.scaling)]
    secrets = 2.0 if settings.cloud.canary else 1.0
    rows = [("data servers", "secrets", secrets, "secrets", prices.secret_per_month)]
    for box, what, alarms in (
        ("monitor", "alarms for the operator", calling),
        ("scale modifier", "alarms that scale", scaling),
    ):
        slow = float(sum(count for count, period_s in alarms if period_s >= _FAST_BELOW_S))
        fast = float(sum(count for count, period_s in alarms if period_s < _FAST_BELOW_S))
        rows.append((box, what, slow, "metrics", prices.alarm_metric_per_month))
        rows.append((box, f"{what}, of 10 s", fast, "metrics", prices.alarm_fast_metric_per_month))
    if settings.cloud.canary:
        calls = HOURS * _HOUR_S / CANARY_PERIOD_S
        gb_s = calls * _CANARY_S * CANARY_MB / 1024
        rows.append(("monitor", "canary, computing", gb_s, "GB-s", prices.lambda_per_gb_s))
        rows.append(("monitor", "canary, each minute", calls / 1e6, "million", prices.lambda_per_million))
    return _lines("always", rows)


def _lambda_lines(prices: Prices, commands: float) -> list[CostLine]:
    """Return what the Lambda costs for *commands* in a month."""
    millions = commands / 1e6
    gb_s = commands * LAMBDA_MEMORY_MB / 1024 * _billed_ms(prices) / 1e3
    rows = (
        ("Lambda", "executions", millions, "million", prices.lambda_per_million),
        ("Lambda", "computing", gb_s, "GB-s", prices.lambda_per_gb_s),
        ("Lambda", "inspection by the firewall", millions, "million", prices.firewall_per_million),
    )
    return _lines("always", rows)


def _billed_ms(prices: Prices) -> int:
    """Return the time of a warm execution, rounded up to a millisecond; it was measured on a server."""
    return math.ceil(prices.command_cpu_ms)


def _count_published_metrics() -> tuple[int, int]:
    """Return how many metrics the agents publish for the fleet, and how many more for each server."""
    data = datums(ServerMetrics(), ServerMetrics(answers={1.0: 1.0}), "fleet", "server")
    of_server = sum(len(datum["Dimensions"]) > 1 for datum in data)
    return len(data) - of_server, of_server


def _lines(needs: Needs, rows: Sequence[tuple[str, str, float, str, float]]) -> list[CostLine]:
    """Return a line for each row of box, what, count, unit and price."""
    return [
        CostLine(box=box, what=what, count=count, unit=unit, price=price, needs=needs)
        for box, what, count, unit, price in rows
    ]
