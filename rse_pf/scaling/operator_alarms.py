"""The alarms that notify an operator, as data: metrics, expression, and meaning.

They scale nothing.  The stacks write them into a template, `rse_pf.extensions.costs.bill` counts them, and
each has a chapter of its own in docs/operations.md.  A parked platform has no servers on purpose: alarms
about servers then stay in the state OK, because they compare with the wanted size of the group.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.config import PlatformSettings
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.scaling.profile import cadence_of

__all__ = [
    "DISK_LOW",
    "LAMBDA_TIMEOUT_S",
    "LOW_DISK_PERCENT",
    "NATIVE_CRASHES",
    "STORE_ERRORS",
    "STORE_PERIOD_S",
    "OperatorAlarm",
    "Series",
    "Source",
    "operator_alarms",
]

# Time limit of one execution of the serverless PnP, in seconds: twice the deadline of a command.
LAMBDA_TIMEOUT_S = 10
# An execution is slow that takes more of its time limit than this share: the next ones may fail by the limit.
_SLOW_SHARE = 0.8
# Blocked requests in a minute that notify: as many as ten robots send that dial at their full rate.
_BLOCKED_PER_PERIOD = 100.0
# Period of most alarms, in seconds: AWS publishes its own metrics each minute.
_PERIOD_S = 60
# Shortest period of the alarm on silent agents, in seconds: an agent that restarts misses a sample or two.
_LONG_PERIOD_S = 300
# Metric that an agent publishes while the bucket does not answer its server; it costs nothing otherwise.
STORE_ERRORS = "StoreErrors"
# Time between two checks of the bucket, in seconds: the shortest period that an alarm may have.
STORE_PERIOD_S = 10
# Metric of the workers that a crash in native code ended in a period; an agent does not publish 0.
NATIVE_CRASHES = "NativeCrashes"
# Metric that an agent publishes, as 1, while less than `LOW_DISK_PERCENT` of its server's disk are free.
DISK_LOW = "DiskLow"
# Free share of a disk below which an operator is notified: 0.8 GB of a server's volume, for days of logs.
LOW_DISK_PERCENT = 10.0

Source = str
"""Origin of a series: ``group``, ``balancer``, ``targets``, ``firewall``, ``function`` or ``canary``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """One metric; ``name`` is its name in an expression, and the dimensions are those of *source*."""

    name: str
    namespace: str
    metric: str
    statistic: str
    source: Source


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorAlarm:
    """An alarm whose expression is 1 while something is wrong, in *datapoints* of *periods*."""

    name: str
    meaning: str
    series: tuple[Series, ...]
    expression: str
    period_s: int = _PERIOD_S
    periods: int = 3
    datapoints: int = 3
    missing: str = "notBreaching"

    threshold: float = 1.0
    comparison: str = "GreaterThanOrEqualToThreshold"

    @property
    def sources(self) -> set[Source]:
        """Return whose metrics the alarm needs."""
        return {series.source for series in self.series}


def _balancer(name: str, metric: str, statistic: str, source: Source = "balancer") -> Series:
    return Series(
        name=name, namespace="AWS/ApplicationELB", metric=metric, statistic=statistic, source=source
    )  # fmt: skip


def _group(name: str, metric: str) -> Series:
    return Series(
        name=name, namespace="AWS/AutoScaling", metric=metric, statistic="Average", source="group"
    )  # fmt: skip


def _function(name: str, metric: str, statistic: str, source: Source = "function") -> Series:
    return Series(name=name, namespace="AWS/Lambda", metric=metric, statistic=statistic, source=source)


_WANTED = _group("wanted", "GroupDesiredCapacity")
_SERVING = _group("serving", "GroupInServiceInstances")
_HEALTHY = _balancer("healthy", "HealthyHostCount", "Minimum", "targets")
_UNHEALTHY = _balancer("unhealthy", "UnHealthyHostCount", "Maximum", "targets")
_TARGET_ERRORS = _balancer("errors", "HTTPCode_Target_5XX_Count", "Sum", "targets")
_BALANCER_ERRORS = _balancer("errors", "HTTPCode_ELB_5XX_Count", "Sum")
_REPORTS = Series(
    name="reports", namespace=NAMESPACE, metric="Robots", statistic="SampleCount", source="group"
)  # fmt: skip
_STORE_ERRORS = Series(
    name="errors", namespace=NAMESPACE, metric=STORE_ERRORS, statistic="Sum", source="group"
)  # fmt: skip
_NATIVE_CRASHES = Series(
    name="crashes", namespace=NAMESPACE, metric=NATIVE_CRASHES, statistic="Sum", source="group"
)  # fmt: skip
_DISK_LOW = Series(
    name="low", namespace=NAMESPACE, metric=DISK_LOW, statistic="Maximum", source="group"
)  # fmt: skip
_BLOCKED = Series(
    name="blocked", namespace="AWS/WAFV2", metric="BlockedRequests", statistic="Sum", source="firewall"
)  # fmt: skip


def operator_alarms(settings: PlatformSettings) -> tuple[OperatorAlarm, ...]:
    """Return the alarms of a deployment with *settings*."""
    floor, slow_ms = settings.scaling.min_servers, LAMBDA_TIMEOUT_S * 1e3 * _SLOW_SHARE
    sample_s = cadence_of(settings.scaling).period_s
    silent_s = sample_s * math.ceil(_LONG_PERIOD_S / sample_s)
    alarms = [
        OperatorAlarm(
            name="few-servers",
            meaning=f"fewer servers are healthy than scaling.min_servers = {floor}",
            series=(_HEALTHY, _WANTED),
            # A target group without targets publishes nothing; a group that is gone wants nothing.
            expression=f"IF(FILL(wanted, {floor}) > 0 AND FILL(healthy, 0) < {floor}, 1, 0)",
            periods=5,
            datapoints=5,
            missing="breaching",
        ),
        OperatorAlarm(
            name="unhealthy",
            meaning="a server fails its health checks",
            series=(_UNHEALTHY,),
            expression="IF(unhealthy >= 1, 1, 0)",
        ),
        OperatorAlarm(
            name="errors",
            meaning="servers answer handshakes with 5xx",
            series=(_TARGET_ERRORS,),
            expression="IF(errors >= 1, 1, 0)",
        ),
        OperatorAlarm(
            name="balancer-errors",
            meaning="the load balancer answers with 5xx itself: it finds no server, or servers do not answer",
            series=(_BALANCER_ERRORS, _WANTED),
            expression=f"IF(FILL(wanted, {floor}) > 0 AND FILL(errors, 0) >= 1, 1, 0)",
        ),
        OperatorAlarm(
            name="silent-agent",
            meaning="a server in service publishes no metrics: its agent is down, or cannot reach AWS",
            series=(_REPORTS, _SERVING),
            # Each server reports once in a sample; half of the reports of one server may be late.
            expression=f"IF(FILL(reports, 0) < (FILL(serving, 0) - 0.5) * {silent_s // sample_s}, 1, 0)",
            period_s=silent_s,
            periods=2,
            datapoints=2,
        ),
        OperatorAlarm(
            name="native-crashes",
            meaning="native code ended a worker of a server",
            series=(_NATIVE_CRASHES,),
            expression="IF(crashes >= 1, 1, 0)",
            periods=1,
            datapoints=1,
        ),
        OperatorAlarm(
            name="disk",
            meaning=f"less than {LOW_DISK_PERCENT:g} % of a server's disk are free",
            series=(_DISK_LOW,),
            expression="IF(low >= 1, 1, 0)",
            period_s=max(_PERIOD_S, sample_s),  # agents publish once in a sample
        ),
        OperatorAlarm(
            name="lambda-errors",
            meaning="executions of the serverless PnP fail",
            series=(_function("errors", "Errors", "Sum"),),
            expression="IF(errors >= 1, 1, 0)",
            datapoints=2,
        ),
        OperatorAlarm(
            name="lambda-throttles",
            meaning="calls of the serverless PnP exceed cloud.lambda_concurrency",
            series=(_function("throttles", "Throttles", "Sum"),),
            expression="IF(throttles >= 1, 1, 0)",
            datapoints=2,
        ),
        OperatorAlarm(
            name="lambda-slow",
            meaning=f"executions of the serverless PnP take more than {_SLOW_SHARE:.0%} of their time-out",
            series=(_function("duration", "Duration", "p95"),),
            expression=f"IF(duration >= {slow_ms:g}, 1, 0)",
            datapoints=2,
        ),
        OperatorAlarm(
            name="blocked",
            meaning=f"the firewall blocks {_BLOCKED_PER_PERIOD:g} requests a minute or more",
            series=(_BLOCKED,),
            expression=f"IF(blocked >= {_BLOCKED_PER_PERIOD:g}, 1, 0)",
        ),
    ]
    if settings.data.enabled:
        alarms.append(
            OperatorAlarm(
                name="store",
                meaning="the bucket of objects and maps does not answer servers",
                series=(_STORE_ERRORS,),
                expression="IF(errors >= 1, 1, 0)",
                period_s=STORE_PERIOD_S,
                datapoints=2,
            )
        )
    if settings.cloud.canary:
        calls = (
            _function("calls", "Invocations", "Sum", "canary"),
            _function("errors", "Errors", "Sum", "canary"),
            _WANTED,
        )
        alarms.append(
            OperatorAlarm(
                name="canary",
                meaning="the canary gets no correct pose through the load balancer",
                series=calls,
                expression=f"IF(FILL(wanted, {floor}) > 0 AND FILL(calls, 0) - FILL(errors, 0) < 1, 1, 0)",
                missing="breaching",
            )
        )
    return tuple(alarms)
