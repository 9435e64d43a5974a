"""Estimate the monthly costs of a deployment: line by line, by component of the architecture (Fig. 2 of the
paper), and for the Lambda function alone.

Servers are loaded up to a CPU load of ``scaling.busy_cpu_percent``; the fleet has the number of servers that
the commands then need, and at least ``scaling.min_servers``.  Each line is rounded to a cent before lines are
added. `NOT_INCLUDED` lists the costs that the estimate leaves out.
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

# Hours of a month, as in the price calculator of AWS.
HOURS = 730.0
DAY_H = 24.0  # hours of a day
# Costs that the estimate leaves out, as the command prints them.
NOT_INCLUDED = (
    "taxes, data out to the robots (the same for fleet and Lambda), inspection by the firewall "
    "(except of burst commands), requests to S3, stored maps and logs, copies in other regions, "
    "live maps (0.04 USD an hour each, in S3), savings plans, the free tier"
)

_HOUR_S = 3600.0  # seconds of an hour
# Number of open connections that one capacity unit of the load balancer pays for.
_CONNECTIONS_OF_A_UNIT = 3000
# Number of bytes per hour that one capacity unit of the load balancer pays for.
_BYTES_OF_A_UNIT = 1e9
# Number of zones of the load balancer, in each of which it needs a public address.
_BALANCER_ZONES = 2
# Number of metrics that EC2 publishes each minute for a server with detailed monitoring.
_DETAILED_METRICS = 7
# Number of metrics that the agent of a server with robots reads in each period: robots, and servers.
_READ_METRICS = 2
# Number of rules of the web ACL in addition to the rate limits: one refuses burst commands without a token.
_FURTHER_ACL_RULES = 1
# Period, in seconds, below which AWS has a higher price for alarms.
_FAST_ALARM_PERIOD_S = 60
# Assumed duration of one call of the canary, seconds.
_CANARY_CALL_S = 1.0

Needs = Literal["servers", "balancer", "always"]
"""The resources for which a line is paid: ``servers``, ``balancer`` for load balancer, firewall and
endpoints, or ``always`` for lines that are paid even while the platform is parked (without servers)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """The load of a deployment.

    ``robots`` robots send ``fps`` commands per second each, for ``hours_per_day`` hours.  The Lambda function
    answers ``burst_commands_per_day`` more commands, of all robots together.
    """

    robots: int = 0
    fps: float = 0.0
    hours_per_day: float = DAY_H
    burst_commands_per_day: float = 0.0

    @property
    def commands_per_s(self) -> float:
        """The commands per second of all robots together while they work."""
        return self.robots * self.fps

    @property
    def hours(self) -> float:
        """The hours of a month in which the robots work."""
        return HOURS * self.hours_per_day / DAY_H


@dataclass(frozen=True, slots=True, kw_only=True)
class CostLine:
    """One line of a bill: *count* of *unit* in a month at *price* each.

    *box* is the component of the architecture (Fig. 2 of the paper), *what* the name of the line, and *needs*
    the resources for which it is paid.
    """

    box: str
    what: str
    count: float
    unit: str
    price: float
    needs: Needs

    @property
    def amount(self) -> float:
        """The costs of the line in a month, rounded to a cent, in the currency of the prices."""
        return round(self.count * self.price, 2)


@dataclass(frozen=True, slots=True)
class Bill:
    """The lines of a monthly bill, in the currency of the prices."""

    lines: tuple[CostLine, ...]

    @property
    def total(self) -> float:
        """The sum of the rounded amounts of all lines."""
        return round(sum(line.amount for line in self.lines), 2)

    def sum_by_box(self) -> dict[str, float]:
        """Return the sum of the lines of each component (`CostLine.box`), in the order of the lines."""
        sums: dict[str, float] = {}
        for line in self.lines:
            sums[line.box] = round(sums.get(line.box, 0.0) + line.amount, 2)
        return sums


def bill_of(settings: PlatformSettings, prices: Prices, load: Load | None = None) -> Bill:
    """Return the bill of a month with *load*, without robots for None; lines with the count 0 are left out.

    Raises:
        ConfigurationError: The table has no price of ``cloud.instance_type``.
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
    """Return the lines of *bill* that are paid while the platform is parked, without servers.

    If *deep*, load balancer, firewall and endpoints are removed, too.
    """
    gone: tuple[Needs, ...] = ("servers", "balancer") if deep else ("servers",)
    return Bill(tuple(line for line in bill.lines if line.needs not in gone))


def lambda_alone(prices: Prices, load: Load) -> float:
    """Return the unrounded costs of a month if the Lambda function answers every command of the robots."""
    commands = load.commands_per_s * load.hours * _HOUR_S
    return sum(line.count * line.price for line in _lambda_lines(prices, commands))


def lambda_executions(prices: Prices, load: Load) -> float:
    """Return the mean number of concurrent Lambda executions that answer every command of the robots."""
    return load.commands_per_s * _billed_ms(prices) / 1e3


def servers_needed(settings: PlatformSettings, prices: Prices, load: Load) -> int:
    """Return the number of servers of the fleet while the robots work.

    The result is the largest of ``scaling.min_servers``, the servers for the commands, and the servers for
    the connections of the robots (``serving.max_robots``).
    """
    vcpus = prices.server(settings.cloud.instance_type).vcpus
    capacity_per_s = vcpus * settings.scaling.busy_cpu_percent / 100 / (prices.command_cpu_ms / 1e3)
    return max(
        settings.scaling.min_servers,
        math.ceil(round(load.commands_per_s / capacity_per_s, 9)),  # rounding errors must not add a server
        math.ceil(load.robots / settings.serving.max_robots),
    )


def _server_lines(settings: PlatformSettings, prices: Prices, load: Load) -> list[CostLine]:
    """Return the lines of running servers with their metrics, and of the volumes of stopped servers."""
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
    # AWS bills connections or bytes, whichever costs more; each robot has one connection.
    by_connections = load.robots / _CONNECTIONS_OF_A_UNIT
    by_bytes = load.commands_per_s * _HOUR_S * prices.command_bytes / _BYTES_OF_A_UNIT
    units = max(by_connections, by_bytes) * load.hours
    addresses = _BALANCER_ZONES * HOURS
    rules = len(rate_rules(settings)) + _FURTHER_ACL_RULES
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
    """Return the lines that are paid even while the platform is parked: alarms, canary and secrets."""
    calling = [(len(alarm.series), alarm.period_s) for alarm in operator_alarms(settings)]
    scaling = [(len(alarm.metrics), alarm.period_s) for alarm in alarms_of(settings.scaling)]
    secrets = 2.0 if settings.cloud.canary else 1.0
    rows = [("data servers", "secrets", secrets, "secrets", prices.secret_per_month)]
    for box, what, alarms in (
        ("monitor", "alarms for the operator", calling),
        ("scale modifier", "alarms that scale", scaling),
    ):
        slow = float(sum(count for count, period_s in alarms if period_s >= _FAST_ALARM_PERIOD_S))
        fast = float(sum(count for count, period_s in alarms if period_s < _FAST_ALARM_PERIOD_S))
        rows.append((box, what, slow, "metrics", prices.alarm_metric_per_month))
        rows.append((box, f"{what}, of 10 s", fast, "metrics", prices.alarm_fast_metric_per_month))
    if settings.cloud.canary:
        calls = HOURS * _HOUR_S / CANARY_PERIOD_S
        gb_s = calls * _CANARY_CALL_S * CANARY_MB / 1024
        rows.append(("monitor", "canary, computing", gb_s, "GB-s", prices.lambda_per_gb_s))
        rows.append(("monitor", "canary, each minute", calls / 1e6, "million", prices.lambda_per_million))
    return _lines("always", rows)


def _lambda_lines(prices: Prices, commands: float) -> list[CostLine]:
    """Return the lines of the Lambda function for a number of *commands* in a month."""
    millions = commands / 1e6
    gb_s = commands * LAMBDA_MEMORY_MB / 1024 * _billed_ms(prices) / 1e3
    rows = (
        ("Lambda", "executions", millions, "million", prices.lambda_per_million),
        ("Lambda", "computing", gb_s, "GB-s", prices.lambda_per_gb_s),
        ("Lambda", "inspection by the firewall", millions, "million", prices.firewall_per_million),
    )
    return _lines("always", rows)


def _billed_ms(prices: Prices) -> int:
    """Return the billed time of a warm Lambda execution: ``command_cpu_ms``, rounded up to a millisecond."""
    return math.ceil(prices.command_cpu_ms)


def _count_published_metrics() -> tuple[int, int]:
    """Return the number of metrics that are published for the fleet, and that for each server."""
    data = datums(ServerMetrics(), ServerMetrics(answers={1.0: 1.0}), "fleet", "server")
    of_server = sum(len(datum["Dimensions"]) > 1 for datum in data)
    return len(data) - of_server, of_server


def _lines(needs: Needs, rows: Sequence[tuple[str, str, float, str, float]]) -> list[CostLine]:
    """Return a line for each row of box, what, count, unit and price."""
    return [
        CostLine(box=box, what=what, count=count, unit=unit, price=price, needs=needs)
        for box, what, count, unit, price in rows
    ]
