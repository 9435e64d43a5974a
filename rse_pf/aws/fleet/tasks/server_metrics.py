"""Publish the server's metrics to CloudWatch once per period of the alarms.

All servers publish at the ends of the same periods, on the wall clock, and each number carries the begin of
its period: so the sum over a period counts every server once.  In the fast profile the metrics are of high
resolution, and the machine's CPU is one of them.
"""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

from rse_pf.aws.clients import call_api
from rse_pf.aws.fleet.metrics import ServerMetrics, datums, dimensions_of, read_page
from rse_pf.aws.fleet.task import AgentContext, Phase, Task
from rse_pf.scaling.alarms import CPU, NAMESPACE
from rse_pf.scaling.profile import cadence_of

__all__ = ["task"]

_HIGH_RESOLUTION = 1


def task(context: AgentContext) -> Task:
    """Publish the metrics of each period; the first call only reads the counters."""
    return Task(
        name="metrics", period_s=0.0, call=_Publisher(context).publish, phases=frozenset({Phase.SERVING})
    )


class _Publisher:
    """Keeps the counters at the end of the last published period."""

    def __init__(self, context: AgentContext) -> None:
        self._context = context
        self._cadence = cadence_of(context.settings.scaling)
        self._period = -1
        self._before = ServerMetrics()
        self._cpu_before = (0.0, 0.0)
        self._began_s = 0.0

    def publish(self) -> None:
        """Publish the period that has ended since the last call, if one has."""
        context, machine = self._context, self._context.machine
        period = int(context.wall_clock()) // self._cadence.period_s
        if period == self._period:
            return
        now, cpu = read_page(machine.page()), machine.cpu_times() if self._cadence.is_fast else (0.0, 0.0)
        if self._period < 0:
            self._began_s = context.clock()  # counts before the agent's start belong to no period
        else:
            data = datums(self._before, now, context.config.group, machine.instance_id())
            if self._cadence.is_fast:
                data += self._measure_cpu_percent(cpu)
            call_api(
                context.clients["cloudwatch"], "put_metric_data", Namespace=NAMESPACE,
                MetricData=[self._with_period(datum, period - 1) for datum in data],
            )  # fmt: skip
        self._period, self._before, self._cpu_before = period, now, cpu

    def _measure_cpu_percent(self, now: tuple[float, float]) -> list[dict[str, Any]]:
        """Return the CPU of the machine, once the server is past its warm-up."""
        busy, total = (ticks - before for ticks, before in zip(now, self._cpu_before, strict=True))
        warm = self._context.clock() - self._began_s >= self._context.settings.scaling.warm_up_s
        if not warm or total <= 0:
            return []
        value = round(100.0 * min(max(busy / total, 0.0), 1.0), 2)
        dimensions = dimensions_of(self._context.config.group)
        return [{"MetricName": CPU, "Dimensions": dimensions, "Value": value, "Unit": "Percent"}]

    def _with_period(self, datum: dict[str, Any], period: int) -> dict[str, Any]:
        begin = datetime.fromtimestamp(period * self._cadence.period_s, timezone.utc)
        fast = {"StorageResolution": _HIGH_RESOLUTION} if self._cadence.is_fast else {}
        return {**datum, "Timestamp": begin, **fast}
