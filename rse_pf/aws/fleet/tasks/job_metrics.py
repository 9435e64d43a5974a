"""Publish how many long jobs wait and run, for the alarms of the job servers; nothing without job servers."""

from __future__ import annotations

import re

from rse_pf.aws.clients import call_api
from rse_pf.aws.fleet.metrics import dimensions_of
from rse_pf.aws.fleet.task import AgentContext, Phase, Task
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.scaling.job_alarms import JOB_PERIOD_S, JOBS, JOBS_WAITING

__all__ = ["job_counts", "task"]

_LINE = re.compile(r"^rse_pf_(jobs|jobs_pending) (\S+)$", flags=re.M)


def task(context: AgentContext) -> Task:
    """Publish the counts of this server once a minute."""

    def publish() -> None:
        if not context.settings.cloud.job_servers:
            return
        group = ResourceNames(context.settings.cloud.name).job_group
        jobs, waiting = job_counts(context.machine.page())
        data = [
            {"MetricName": name, "Dimensions": dimensions_of(group), "Value": value, "Unit": "Count"}
            for name, value in ((JOBS, jobs), (JOBS_WAITING, waiting))
        ]
        call_api(
            context.clients["cloudwatch"], "put_metric_data", Namespace=NAMESPACE, MetricData=data
        )  # fmt: skip

    return Task(
        name="jobs", period_s=float(JOB_PERIOD_S), call=publish, phases=frozenset({Phase.SERVING})
    )  # fmt: skip


def job_counts(page: str) -> tuple[float, float]:
    """Return the jobs of a server, and those of them that wait, from its page of metrics."""
    counts = dict(_LINE.findall(page))
    return float(counts.get("jobs", 0.0)), float(counts.get("jobs_pending", 0.0))
