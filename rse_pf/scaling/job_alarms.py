"""The policy of job servers as CloudWatch data: one more for jobs that wait, one fewer when there are none.

The servers that robots are connected to publish both metrics, because a group without instances cannot.
"""

from __future__ import annotations

from rse_pf.config import CloudSettings
from rse_pf.scaling.alarms import NAMESPACE, Alarm, Metric, ScalingStep

__all__ = ["JOBS", "JOBS_WAITING", "JOB_IDLE_S", "JOB_PERIOD_S", "job_alarms_of"]

JOBS_WAITING = "JobsWaiting"
"""Long jobs for which no server has a slot; the sum over all servers."""
JOBS = "Jobs"
"""Long jobs that wait or run; the sum over all servers."""
JOB_PERIOD_S = 60
JOB_IDLE_S = 600
"""Without any job for this long job servers end, one each minute."""
_MANY = 4.0

_WAITING = Metric(name="waiting", namespace=NAMESPACE, metric=JOBS_WAITING, statistic="Sum")
_JOBS = Metric(name="jobs", namespace=NAMESPACE, metric=JOBS, statistic="Sum")


def job_alarms_of(cloud: CloudSettings) -> tuple[Alarm, ...]:
    """Return the alarms of the group of job servers; none without such a group.

    Jobs wait for a minute before a job server starts, which takes another.  Job servers end one by one after
    `JOB_IDLE_S` without any job, so that no job is interrupted.  Missing data never breaches.
    """
    if not cloud.job_servers:
        return ()
    waiting = Alarm(
        name="jobs-waiting", metrics=(_WAITING,), expression=_WAITING.name,
        comparison="GreaterThanOrEqualToThreshold", threshold=1.0, period_s=JOB_PERIOD_S, periods=1,
        missing="notBreaching",
        steps=(
            ScalingStep(lower=0.0, upper=_MANY - 1.0, change=1),
            ScalingStep(lower=_MANY - 1.0, upper=None, change=2),
        ),
        meaning="jobs wait for a job server",
    )  # fmt: skip
    idle = Alarm(
        name="jobs-idle", metrics=(_JOBS,), expression=f"IF({_JOBS.name} == 0, 1, 0)",
        comparison="GreaterThanOrEqualToThreshold", threshold=1.0, period_s=JOB_PERIOD_S,
        periods=JOB_IDLE_S // JOB_PERIOD_S, missing="notBreaching",
        steps=(ScalingStep(lower=0.0, upper=None, change=-1),),
        meaning="there are no jobs, and job servers are idle",
    )  # fmt: skip
    return waiting, idle
