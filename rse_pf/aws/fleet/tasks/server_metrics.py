"""Publish the server's metrics to CloudWatch once per period of the alarms.

All servers publish at the ends of the same periods of the wall clock, and each value has the begin of its
period as its timestamp: so CloudWatch's sum over a period counts every server once.  In the fast profile the
metrics have CloudWatch's high resolution, and the machine's CPU utilisation is published, too.
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

_HIGH_RESOLUTION_S = 1  # StorageResolution of CloudWatch in seconds: needed for periods below a minute


def task(context: AgentContext) -> Task:
    """Return the task that publishes the metrics of each period; the first call only reads the counters."""
    return Task(
        name="metrics", period_s=0.0, call=_Publisher(context).publish, phases=frozenset({Phase.SERVING})
    )


class _Publisher:
    """Publishes the metrics of each period; keeps the counters that were read at the end of the last one."""

    def __init__(self, context: AgentContext) -> None:
        self._context = context
        self._cadence = cadence_of(context.settings.scaling)
        self._period = -1
        self._before = ServerMetrics()
        self._cpu_before = (0.0, 0.0)
        self._began_s = 0.0

    def publish(self) -> None:
        """Publish the metrics of the period that has ended since the last call; do nothing if none has."""
        context, machine = self._context, self._context.machine
        period = int(context.wall_clock()) // self._cadence.period_s
        if period == self._period:
            return
        now, cpu = read_page(machine.page()), machine.cpu_times() if self._cadence.is_fast else (0.0, 0.0)
        if self._period < 0:
            self._began_s = context.clock()  # what was counted before the agent's start is not published
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
        """Return the metric of the machine's CPU utilisation since the last call; none during the warm-up.

        *now* holds the busy and the total time of the processors, in ticks.
        """
        busy, total = (ticks - before for ticks, before in zip(now, self._cpu_before, strict=True))
        warm = self._context.clock() - self._began_s >= self._context.settings.scaling.warm_up_s
        if not warm or total <= 0:
            return []
        value = round(100.0 * min(max(busy / total, 0.0), 1.0), 2)
        dimensions = dimensions_of(self._context.config.group)
        return [{"MetricName": CPU, "Dimensions": dimensions, "Value": value, "Unit": "Percent"}]

    def _with_period(self, datum: dict[str, Any], period: int) -> dict[str, Any]:
        begin = datetime.fromtimestamp(period * self._cadence.period_s, timezone.utc)
        fast = {"StorageResolution": _HIGH_RESOLUTION_S} if self._cadence.is_fast else {}
        return {**datum, "Timestamp": begin, **fast}
