"""Move robots away from this server when it has too many, so that all servers have about the same number.

Agents do not communicate.  Each agent reads from CloudWatch the number of robots of all servers and the
number of servers; `rse_pf.scaling.rebalance` computes how many robots of its own server are too many.  No
robot moves while these two numbers still change, and moves do not change them, so the agents need no
coordination.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

from rse_pf.aws.clients import call_api
from rse_pf.aws.fleet.metrics import ROBOTS, dimensions_of, read_page
from rse_pf.aws.fleet.task import AgentContext, Phase, Task
from rse_pf.config.elasticity import MOVE_WITHIN_MS
from rse_pf.errors import Disconnected
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rebalance import MoveOrder, Totals, pause_after_s, plan_order

__all__ = ["LATE_S", "read_totals", "task"]

# Seconds from the end of a period until its numbers are read: one for the agents to publish them, the rest
# for CloudWatch to process them.
LATE_S = 8.0
# Number of periods that are read: the newest two are compared, and CloudWatch may lack the last ones.
_PERIODS = 4


def task(context: AgentContext) -> Task:
    """Return the task that reads the totals once in each period, and has the server move surplus robots."""
    return Task(
        name="rebalancing",
        period_s=0.0,
        call=_Rebalancing(context).follow,
        phases=frozenset({Phase.SERVING}),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _LastOrder:
    """The last order, the number of robots that the server had then, and of failed orders in a row."""

    order: MoveOrder
    robots: int
    failures: int = 0


class _Rebalancing:
    def __init__(self, context: AgentContext) -> None:
        self._context = context
        self._period_s = cadence_of(context.settings.scaling).period_s
        self._period = -1
        self._quiet_until_s = -math.inf
        self._asked: _LastOrder | None = None

    def follow(self) -> None:
        """Read the totals and order moves once in each period, but not in the pause after an order."""
        context = self._context
        period = int((context.wall_clock() - LATE_S) // self._period_s)
        if period == self._period or context.clock() < self._quiet_until_s:
            return
        self._period = period
        try:
            robots = int(read_page(context.machine.page()).robots)
        except Disconnected:
            return  # no server runs; the task that publishes metrics logs this error
        if robots == 0:
            return  # no request to CloudWatch is needed, and each costs a fee
        totals = read_totals(
            context.clients["cloudwatch"], context.config.group, self._period_s, period * self._period_s
        )
        self._order_moves(robots, totals)

    def _order_moves(self, robots: int, totals: Sequence[Totals]) -> None:
        context = self._context
        order = plan_order(robots, totals)
        if order is None:
            self._asked = None
            return
        moving = context.machine.move(order.robots, order.spread_s)
        failures = 0 if self._asked is None else self._asked.failures
        stayed = self._asked is not None and robots >= self._asked.robots
        self._asked = _LastOrder(order=order, robots=robots, failures=failures + 1 if stayed else 0)
        pause_s = pause_after_s(order, within_s=MOVE_WITHIN_MS / 1e3, failures=self._asked.failures)
        self._quiet_until_s = context.clock() + pause_s
        newest = totals[0]
        context.log(
            "rebalance", robots=moving, of=robots, all_robots=newest.robots, servers=newest.servers,
            pause_s=round(pause_s, 1),
        )  # fmt: skip


def read_totals(cloudwatch: Any, group: str, period_s: int, end_s: float) -> tuple[Totals, ...]:
    """Return the totals of the last `_PERIODS` periods before *end_s*, the newest first.

    Periods that CloudWatch does not have are left out.

    Args:
        cloudwatch: A boto3 client of CloudWatch.
        group: Name of the Auto Scaling group.
        period_s: Length of a period in seconds.
        end_s: End of the newest period, Unix seconds, a multiple of *period_s*.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    end = datetime.fromtimestamp(end_s, timezone.utc)
    metric = {"Namespace": NAMESPACE, "MetricName": ROBOTS, "Dimensions": dimensions_of(group)}
    answer = call_api(
        cloudwatch, "get_metric_data", ScanBy="TimestampDescending", EndTime=end,
        StartTime=end - timedelta(seconds=_PERIODS * period_s),
        MetricDataQueries=[
            {"Id": identity, "MetricStat": {"Metric": metric, "Period": period_s, "Stat": stat}}
            for identity, stat in (("robots", "Sum"), ("servers", "SampleCount"))
        ],
    )  # fmt: skip
    sums = {
        row["Id"]: {
            int(at.timestamp()): float(value)
            for at, value in zip(row["Timestamps"], row["Values"], strict=False)
        }
        for row in answer["MetricDataResults"]
    }
    robots, servers = sums.get("robots", {}), sums.get("servers", {})
    return tuple(
        Totals(robots=round(robots[at]), servers=round(servers[at]))
        for at in sorted(robots, reverse=True)
        if at in servers
    )
