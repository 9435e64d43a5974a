"""The alarms that notify an operator, as data: metrics, expression, and meaning.

These alarms do not scale the fleet.  The stacks write them into a template, `rse_pf.extensions.costs.bill`
counts them, and each has a chapter in docs/operations.md.  A parked platform has no servers on purpose:
alarms about servers then stay in the state OK, because they compare with the wanted size of the group.
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
# Fraction of `LAMBDA_TIMEOUT_S` above which the 95th percentile of the execution times raises the alarm
# lambda-slow, before executions fail at the limit.
_SLOW_FRACTION = 0.8
# Requests in a minute that the web firewall must block for an alarm: as many as ten robots send that connect
# again at their full rate.
_BLOCKED_PER_PERIOD = 100.0
# Period of most alarms, in seconds: AWS publishes its own metrics each minute.
_PERIOD_S = 60
# Shortest period of the alarm on silent agents, in seconds: an agent that restarts misses a sample or two.
_MIN_SILENT_PERIOD_S = 300
# Metric that an agent publishes, as 1, while the bucket does not answer its server.  While nothing is
# published, the metric costs nothing.
STORE_ERRORS = "StoreErrors"
# Time between two checks of the bucket by an agent, in seconds: the shortest period that an alarm may have.
STORE_PERIOD_S = 10
# Metric of the number of workers that crashed in native code in a period; an agent does not publish 0.
NATIVE_CRASHES = "NativeCrashes"
# Metric that an agent publishes, as 1, while less than `LOW_DISK_PERCENT` of its server's disk is free.
DISK_LOW = "DiskLow"
# Percentage of free disk space below which an operator is notified: 0.8 GB, which last for days of logs.
LOW_DISK_PERCENT = 10.0

Source = str
"""The resource that a series is about, which determines its dimensions in CloudWatch.

One of ``group`` (Auto Scaling group), ``balancer`` (load balancer), ``targets`` (the robots' target group),
``firewall`` (web firewall), ``function`` (serverless PnP) and ``canary``.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """A CloudWatch metric with its statistic; ``name`` is its name in an `OperatorAlarm`'s expression."""

    name: str
    namespace: str
    metric: str
    statistic: str
    source: Source


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorAlarm:
    """An alarm whose *expression* over *series* is 1 while something is wrong, else 0.

    It notifies when the expression was 1 in *datapoints* of the last *periods* periods of *period_s* seconds.
    ``missing`` (the treatment of missing data) and ``comparison`` are CloudWatch's terms.
    """

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
        """Return the sources of the metrics that the alarm reads."""
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
    """Return the alarms of a deployment with *settings*.

    The alarm ``store`` exists only with ``data.enabled``, the alarm ``canary`` only with ``cloud.canary``.
    """
    floor, slow_ms = settings.scaling.min_servers, LAMBDA_TIMEOUT_S * 1e3 * _SLOW_FRACTION
    sample_s = cadence_of(settings.scaling).period_s
    silent_s = sample_s * math.ceil(_MIN_SILENT_PERIOD_S / sample_s)
    alarms = [
        OperatorAlarm(
            name="few-servers",
            meaning=f"fewer servers are healthy than scaling.min_servers = {floor}",
            series=(_HEALTHY, _WANTED),
            # A target group without targets publishes nothing: healthy counts as 0.  A parked group wants 0.
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
            # Each server reports once in a sample; the alarm needs more than half of one server's reports
            # to be missing, because some may be late.
            expression=f"IF(FILL(reports, 0) < (FILL(serving, 0) - 0.5) * {silent_s // sample_s}, 1, 0)",
            period_s=silent_s,
            periods=2,
            datapoints=2,
        ),
        OperatorAlarm(
            name="native-crashes",
            meaning="a worker of a server crashed in native code",
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
            period_s=max(_PERIOD_S, sample_s),  # agents publish only once in a sample
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
            meaning=f"executions of the serverless PnP take more than {_SLOW_FRACTION:.0%} of their time-out",
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
