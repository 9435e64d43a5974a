"""Publish a metric while the bucket does not answer this server's data service; an alarm reads it.

No server is replaced for this reason: all servers share the bucket, and a new server could not boot without
it.  Meanwhile robots get errors for their data, and poses as before.
"""

from __future__ import annotations

from rse_pf.aws.clients import call_api
from rse_pf.aws.fleet.metrics import dimensions_of
from rse_pf.aws.fleet.task import AgentContext, Phase, Task
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.scaling.operator_alarms import STORE_ERRORS, STORE_PERIOD_S

__all__ = ["task"]

_HIGH_RESOLUTION_S = 1  # StorageResolution of CloudWatch in seconds: needed for periods below a minute


def task(context: AgentContext) -> Task:
    """Return the task that checks the bucket every ten seconds.

    It has a thread of its own, because a check blocks for seconds while the bucket does not answer.
    """
    failing = False

    def publish_failure() -> None:
        nonlocal failing
        if not context.settings.data.enabled:
            return
        fails = not context.machine.reaches_store()
        if fails != failing:
            context.log("store-silent" if fails else "store-back")
        failing = fails
        if not fails:
            return
        datum = {
            "MetricName": STORE_ERRORS, "Dimensions": dimensions_of(context.config.group), "Value": 1.0,
            "Unit": "Count", "StorageResolution": _HIGH_RESOLUTION_S,
        }  # fmt: skip
        call_api(
            context.clients["cloudwatch"], "put_metric_data", Namespace=NAMESPACE, MetricData=[datum]
        )  # fmt: skip

    return Task(
        name="store-errors", period_s=float(STORE_PERIOD_S), call=publish_failure,
        phases=frozenset({Phase.SERVING}), in_thread=True,
    )  # fmt: skip
