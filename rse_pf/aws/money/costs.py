"""Estimate what a deployment costs a month: line by line, by box of Fig. 2, on the fleet and on the Lambda.

A server accepts commands up to ``scaling.busy_cpu_percent``; the fleet has as many servers as that needs, but
never fewer than ``scaling.min_servers``.  A sum is always the sum of its lines, each rounded to a cent.  What
the estimate leaves out is in `NOT_INCLUDED`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.aws.fleet.tasks.audit import AUDIT_SHIP_S
from rse_pf.aws.fleet.tasks.journals import JOURNAL_SHIP_S
from rse_pf.aws.money.prices import Prices
from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import CANARY_MB, CANARY_PERIOD_S, ENDPOINT_SERVICES, zone_count
from rse_pf.config.front_door import rate_rules
from rse_pf.scaling.alarms import alarms_of
from rse_pf.scaling.job_alarms import JOB_PERIOD_S, JOBS, JOBS_WAITING, job_alarms_of
from rse_pf.scaling.operator_alarms import operator_alarms
from rse_pf.scaling.profile import cadence_of

__all__ = [
    "HOURS",
    "NOT_INCLUDED",
    "Bill",
    "CostLine",
    "Costs",
    "Load",
    "bill_of",
    "compare",
    "crossing_commands_per_s",
    "parked",
    "parked_at_night",
]

HOURS = 730.0
"""Hours of a month, as in the calculator of AWS."""
NOT_INCLUDED = (
    "taxes, data out to the robots (the same for both), stored maps and logs, copies in other regions, live "
    "maps (0.04 USD an hour each, in S3), savings plans, the free tier"
)
VOLUME_GB = 8
"""Of a server."""

_DAY_H = 24.0
_MONTH_S = HOURS * 3600
_CONNECTIONS_OF_A_UNIT, _BYTES_OF_A_UNIT = 3000, 1e9
_MB_OF_A_VCPU = 1769
_DETAILED_METRICS = 7
"""That EC2 publishes each minute for a server with detailed monitoring."""
_OTHER_RULES = 1
"""Of the firewall: a burst without a token; tests/stacks/test_money.py counts those of the template."""
_READ_METRICS = 2
"""That the agent of a server with robots reads each period: robots and servers."""
_FAST_BELOW_S = 60
"""An alarm with a shorter period is priced higher."""
_UNITS = "capacity units"
_CANARY_S = 1.0
_JOB_METRICS = (JOBS, JOBS_WAITING)

Needs = Literal["servers", "balancer", "nothing"]
"""What a line is paid for: running servers, the load balancer with firewall and endpoints, or anyway."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """How many robots send how many commands, and for how long each day.

    ``burst_commands_per_day`` are answered by the Lambda beside the fleet; ``job_hours_per_day`` are the
    hours of all job servers together.
    """

    robots: int
    fps: float
    hours_per_day: float = _DAY_H
    burst_commands_per_day: float = 0.0
    job_hours_per_day: float = 0.0

    @property
    def commands_per_s(self) -> float:
        """Return the commands per second of all robots together, in their hours."""
        return self.robots * self.fps

    @property
    def robot_hours(self) -> float:
        """Return the hours of all robots in a month."""
        return self.robots * HOURS * self.hours_per_day / _DAY_H


@dataclass(frozen=True, slots=True, kw_only=True)
class CostLine:
    """One line of a bill: *count* units of *unit* in a month at *price* each; *box* is one of Fig. 2."""

    box: str
    what: str
    count: float
    unit: str
    price: float
    needs: Needs = "nothing"
    all_day: bool = True
    """Whether the line is paid in every hour, and not in the hours of the load alone."""

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


def bill_of(settings: PlatformSettings, prices: Prices, load: Load | None = None) -> Bill:
    """Return the bill of a month with *load*; without it, of a month without any robot.

    Raises:
        ConfigurationError: The price of ``cloud.instance_type`` is not known, or that of every type of job
            servers, and there are hours of job servers.
    """
    load = load or Load(robots=0, fps=0.0)
    lines = (
        *_server_lines(settings, prices, load),
        *_front_lines(settings, prices, load),
        *_monitor_lines(settings, prices),
        *_data_lines(settings, prices),
        *_function_lines(settings, prices, load),
        *_job_lines(settings, prices, load),
    )
    return Bill(tuple(line for line in lines if line.count))


def parked(bill: Bill, *, deep: bool) -> Bill:
    """Return what is left of *bill* without servers.

    If *deep*, load balancer, firewall and endpoints are gone, too.
    """
    gone: tuple[Needs, ...] = ("servers", "balancer") if deep else ("servers",)
    return Bill(tuple(line for line in bill.lines if line.needs not in gone))


def parked_at_night(bill: Bill, load: Load, *, deep: bool) -> Bill:
    """Return *bill* of a platform that is parked outside the hours of *load*."""
    gone: tuple[Needs, ...] = ("servers", "balancer") if deep else ("servers",)
    share = load.hours_per_day / _DAY_H
    return Bill(
        tuple(
            replace(line, count=line.count * share) if line.needs in gone and line.all_day else line
            for line in bill.lines
        )
    )


def compare(settings: PlatformSettings, prices: Prices, load: Load) -> Costs:
    """Return what *load* costs on the fleet and on the Lambda."""
    tariff = _Tariff(settings, prices, load.fps)
    seconds = _MONTH_S * load.hours_per_day / _DAY_H
    return Costs(
        floor=bill_of(settings, prices).total,
        fleet=bill_of(settings, prices, load).total,
        serverless=load.commands_per_s * tariff.serverless_per_command * seconds,
        servers=_servers(settings, tariff, load),
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
    idle = bill_of(settings, prices, Load(robots=1, fps=0.0, hours_per_day=hours_per_day))
    floor, floor_servers = idle.total, settings.scaling.min_servers
    most, below = min(tariff.capacity_per_s, settings.serving.max_robots * fps), 0.0
    for servers in range(floor_servers, settings.scaling.max_servers + 1):
        more = _added_server_lines(settings, prices, servers - floor_servers, hours)
        rate = max(below, (floor + sum(line.amount for line in more)) / saved)
        if rate <= servers * most:
            return rate
        below = servers * most
    return None


class _Tariff:
    """The cost of a command and of an execution under *settings*, for robots of *fps*."""

    def __init__(self, settings: PlatformSettings, prices: Prices, fps: float) -> None:
        busy = settings.scaling.busy_cpu_percent / 100
        memory_mb = settings.cloud.lambda_memory_mb
        vcpus = prices.server(settings.cloud.instance_type).vcpus
        self.capacity_per_s = vcpus * busy / (prices.command_cpu_ms / 1e3)
        # AWS counts connections or bytes of the load balancer, whichever costs more.
        connections = 1 / fps / _CONNECTIONS_OF_A_UNIT if fps else 0.0
        units = max(connections, 3600 * prices.command_bytes / _BYTES_OF_A_UNIT)
        self.units_per_command = prices.balancer_unit_per_hour * units
        # A warm execution; less memory is less of a vCPU.
        self.billed_ms = math.ceil(prices.command_cpu_ms * max(1.0, _MB_OF_A_VCPU / memory_mb))
        self.gb_s = memory_mb / 1024 * self.billed_ms / 1e3
        inspected = (prices.lambda_per_million + prices.firewall_per_million) / 1e6
        self.serverless_per_command = inspected + self.gb_s * prices.lambda_per_gb_s


def _servers(settings: PlatformSettings, tariff: _Tariff, load: Load) -> int:
    return max(
        settings.scaling.min_servers,
        math.ceil(round(load.commands_per_s / tariff.capacity_per_s, 9)),
        math.ceil(load.robots / settings.serving.max_robots),
    )


def _server_lines(settings: PlatformSettings, prices: Prices, load: Load) -> Iterable[CostLine]:
    floor = settings.scaling.min_servers
    servers = _servers(settings, _Tariff(settings, prices, load.fps), load)
    yield from _running_lines(settings, prices, "always", 0, floor, HOURS)
    hours = HOURS * load.hours_per_day / _DAY_H
    yield from _added_server_lines(settings, prices, servers - floor, hours)
    if load.robots:  # an agent without robots reads nothing
        yield _reading_line(settings, prices, floor, hours)
    box, running = "backend servers", settings.cloud.warm_servers
    yield CostLine(
        box=box, what="volumes of stopped warm servers", count=running * VOLUME_GB, unit="GB",
        price=prices.volume_per_gb_month,
    )  # fmt: skip


def _added_server_lines(
    settings: PlatformSettings, prices: Prices, count: int, hours: float
) -> tuple[CostLine, ...]:
    floor = settings.scaling.min_servers
    lines = _running_lines(settings, prices, "in busy hours", floor, floor + count, hours)
    return (*lines, _reading_line(settings, prices, count, hours, "of further servers"))


def _reading_line(
    settings: PlatformSettings, prices: Prices, servers: int, hours: float, whose: str = "of servers"
) -> CostLine:
    """Return what the agents of *servers* pay to see how many robots there are in all."""
    reads = hours * 3600 / cadence_of(settings.scaling).period_s * _READ_METRICS
    return CostLine(
        box="monitor", what=f"reading metrics {whose}, in busy hours", count=servers * reads / 1e3,
        unit="thousand", price=prices.metric_calls_per_thousand, needs="servers", all_day=False,
    )  # fmt: skip


def _running_lines(
    settings: PlatformSettings, prices: Prices, when: str, first: int, last: int, hours: float
) -> Iterable[CostLine]:
    """Yield what the servers *first* to *last* of the fleet cost in *hours* of a month."""
    kind, count = settings.cloud.instance_type, last - first
    server = prices.server(kind)
    demanded = max(0, min(last, settings.cloud.on_demand_servers) - first) if settings.cloud.spot else count
    months = hours / HOURS
    servers = {"on demand": (demanded, server.per_hour), "Spot": (count - demanded, server.spot_per_hour)}
    for how, (some, price) in servers.items():
        yield CostLine(
            box="backend servers", what=f"{some} {kind} {how}, {when}", count=some * hours, unit="h",
            price=price, needs="servers", all_day=not first,
        )  # fmt: skip
    for box, what, number, unit, price in (
        ("backend servers", f"volumes, {when}", count * VOLUME_GB, "GB", prices.volume_per_gb_month),
        ("monitor", f"metrics of each server, {when}", count * _count_metrics_of_server(), "metrics",
         prices.metric_per_month),
        ("monitor", f"publishing metrics, {when}", count * _thousand_metric_requests(settings), "thousand",
         prices.metric_calls_per_thousand),
        ("data servers", f"audit logs and journals, {when}", count * _thousand_puts(),
         "thousand", prices.put_per_thousand),
    ):  # fmt: skip
        yield CostLine(
            box=box, what=what, count=number * months, unit=unit, price=price, needs="servers",
            all_day=not first,
        )  # fmt: skip


def _front_lines(settings: PlatformSettings, prices: Prices, load: Load) -> Iterable[CostLine]:
    hours = HOURS * load.hours_per_day / _DAY_H
    units = load.commands_per_s * _Tariff(settings, prices, load.fps).units_per_command
    rows: tuple[tuple[str, str, float, str, float], ...] = (
        ("load balancer", "load balancer", HOURS, "h", prices.balancer_per_hour),
        ("load balancer", "its public addresses, in two zones", 2 * HOURS, "h", prices.address_per_hour),
        ("load balancer", _UNITS, 0 if not units else units / prices.balancer_unit_per_hour * hours,
         "h", prices.balancer_unit_per_hour),
        ("firewall", "web ACL", 1, "", prices.firewall_per_month),
        ("firewall", "its rules", len(rate_rules(settings)) + _OTHER_RULES, "rules",
         prices.firewall_rule_per_month),
        *(
            (box, f"endpoint of {service}, in {zone_count(settings)} zone(s)",
             zone_count(settings) * HOURS, "h", prices.endpoint_per_hour)
            for service, box in ENDPOINT_SERVICES.items()
        ),
    )  # fmt: skip
    for box, what, count, unit, price in rows:
        yield CostLine(
            box=box, what=what, count=count, unit=unit, price=price, needs="balancer",
            all_day=what != _UNITS,
        )  # fmt: skip


def _monitor_lines(settings: PlatformSettings, prices: Prices) -> Iterable[CostLine]:
    yield CostLine(
        box="monitor", what="metrics of the fleet", count=len(_published_metrics("")), unit="metrics",
        price=prices.metric_per_month, needs="servers",
    )  # fmt: skip
    calling = [(len(alarm.series), alarm.period_s) for alarm in operator_alarms(settings)]
    scaling = [(len(alarm.metrics), alarm.period_s) for alarm in alarms_of(settings.scaling)]
    jobs = [(len(alarm.metrics), alarm.period_s) for alarm in job_alarms_of(settings.cloud)]
    for box, what, alarms in (
        ("monitor", "alarms for the operator", calling), ("scale modifier", "alarms that scale", scaling),
        ("scale modifier", "alarms that scale job servers", jobs),
    ):  # fmt: skip
        for some, price, how in (
            ([count for count, period_s in alarms if period_s >= _FAST_BELOW_S],
             prices.alarm_metric_per_month, ""),
            ([count for count, period_s in alarms if period_s < _FAST_BELOW_S],
             prices.alarm_fast_metric_per_month, ", of 10 s"),
        ):  # fmt: skip
            yield CostLine(box=box, what=what + how, count=sum(some), unit="metrics", price=price)
    if settings.cloud.canary:
        calls = _MONTH_S / CANARY_PERIOD_S
        gb_s = calls * _CANARY_S * CANARY_MB / 1024
        yield CostLine(
            box="monitor", what="canary, each minute", count=gb_s, unit="GB-s",
            price=prices.lambda_per_gb_s + prices.lambda_per_million / 1e6 * calls / gb_s,
        )  # fmt: skip


def _data_lines(settings: PlatformSettings, prices: Prices) -> Iterable[CostLine]:
    secrets = 2 if settings.cloud.canary else 1
    yield CostLine(
        box="data servers", what="secrets", count=secrets, unit="secrets", price=prices.secret_per_month
    )  # fmt: skip


def _function_lines(settings: PlatformSettings, prices: Prices, load: Load) -> Iterable[CostLine]:
    commands = load.burst_commands_per_day * HOURS / _DAY_H
    tariff = _Tariff(settings, prices, load.fps)
    for what, count, unit, price in (
        ("executions of bursts", commands / 1e6, "million", prices.lambda_per_million),
        ("computing of bursts", commands * tariff.gb_s, "GB-s", prices.lambda_per_gb_s),
        ("inspecting bursts", commands / 1e6, "million", prices.firewall_per_million),
    ):
        yield CostLine(box="Lambda", what=what, count=count, unit=unit, price=price)


def _job_lines(settings: PlatformSettings, prices: Prices, load: Load) -> Iterable[CostLine]:
    """Yield what job servers cost: their metrics always, and Spot instances while there are jobs."""
    if not settings.cloud.job_servers:
        return
    yield CostLine(
        box="monitor", what="metrics of jobs", count=len(_JOB_METRICS), unit="metrics",
        price=prices.metric_per_month, needs="servers",
    )  # fmt: skip
    if not load.job_hours_per_day:
        return
    hours = load.job_hours_per_day * HOURS / _DAY_H
    kinds = settings.cloud.job_instance_types.split()
    priced = [kind for kind in kinds if kind in prices.servers]
    cheapest = min(priced or kinds, key=lambda kind: prices.server(kind).spot_per_hour)
    for what, count, unit, price in (
        (f"job servers, {cheapest} Spot", hours, "h", prices.server(cheapest).spot_per_hour),
        ("volumes of job servers", VOLUME_GB * hours / HOURS, "GB", prices.volume_per_gb_month),
        ("detailed metrics of job servers", _DETAILED_METRICS * hours / HOURS, "metrics",
         prices.metric_per_month),
        ("looks for jobs", hours * 3600 / settings.serving.job_poll_s / 1e3, "thousand",
         prices.put_per_thousand),
    ):  # fmt: skip
        yield CostLine(
            box="backend servers", what=what, count=count, unit=unit, price=price, needs="servers",
            all_day=False,
        )  # fmt: skip


def _published_metrics(server: str) -> set[tuple[str, bool]]:
    """Return the metrics that an agent publishes: name, and whether it is of one server."""
    some = ServerMetrics(answers={1.0: 1.0})
    data = datums(ServerMetrics(), some, "group", server)
    return {(datum["MetricName"], len(datum["Dimensions"]) > 1) for datum in data}


def _count_metrics_of_server() -> int:
    return _DETAILED_METRICS + sum(is_of_one for _, is_of_one in _published_metrics("server"))


def _thousand_metric_requests(settings: PlatformSettings) -> float:
    """Return the thousands of requests that publish the metrics of a server for a month."""
    periods = [float(cadence_of(settings.scaling).period_s)]
    if settings.cloud.job_servers:
        periods.append(float(JOB_PERIOD_S))
    return sum(_MONTH_S / period_s for period_s in periods) / 1e3


def _thousand_puts() -> float:
    """Return the thousands of objects that a server writes in a month, if it always has something new."""
    return (_MONTH_S / AUDIT_SHIP_S + _MONTH_S / JOURNAL_SHIP_S) / 1e3
