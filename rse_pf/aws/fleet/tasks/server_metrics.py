"""Publish the server's metrics to CloudWatch once per period of the alarms."""

from __future__ import annotations

from rse_pf.aws.clients import call_api
from rse_pf.aws.fleet.metrics import ServerMetrics, datums, read_page
from rse_pf.aws.fleet.task import AgentContext, Phase, Task
from rse_pf.scaling.alarms import NAMESPACE

__all__ = ["task"]


def task(context: AgentContext) -> Task:
    """Publish what the server did since the last call; the first call only takes the counts."""
    before: ServerMetrics | None = None

    def publish() -> None:
        nonlocal before
        now = read_page(context.machine.page())
        if before is None:
            before = now  # counts from before the agent's start do not belong to this period
        data = datums(before, now, context.config.group, context.machine.instance_id())
        call_api(context.clients["cloudwatch"], "put_metric_data", Namespace=NAMESPACE, MetricData=data)
        before = now

    return Task(
        name="metrics",
        period_s=context.settings.scaling.period_s,
        call=publish,
        phases=frozenset({Phase.SERVING}),
    )
