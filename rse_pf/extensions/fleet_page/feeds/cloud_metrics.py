"""Read the metrics of the Auto Scaling group and of its servers over the last periods from CloudWatch.

AWS charges 0.01 USD for 1000 requested metrics.  A value that was not published is None, never zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.metrics import ROBOTS, dimensions_of
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import NAMESPACE

__all__ = ["PERIODS", "GroupMetrics", "read_group_metrics"]

# Number of periods in a chart: an hour of one-minute samples.
PERIODS = 60
# A value that is older than this many periods is shown as unknown.
_FRESH_PERIODS = 3
# Largest number of servers whose metrics are requested, two for each: GetMetricData accepts 500 queries.
_MAX_SERVERS = 200
# Namespace of the metrics of EC2 in CloudWatch.
_EC2 = "AWS/EC2"
# Metrics of the group by our name: namespace, name and statistic in CloudWatch.
_GROUP_SERIES = {
    "cpu_percent": (_EC2, "CPUUtilization", "Average"),
    "requests": (NAMESPACE, "Requests", "Sum"),
    "queue_ms": (NAMESPACE, "QueueMs", "Maximum"),
    "bytes_in": (NAMESPACE, "BytesIn", "Sum"),
    "bytes_out": (NAMESPACE, "BytesOut", "Sum"),
    "p50_ms": (NAMESPACE, "AnswerMs", "p50"),
    "p95_ms": (NAMESPACE, "AnswerMs", "p95"),
    "p99_ms": (NAMESPACE, "AnswerMs", "p99"),
    "answers": (NAMESPACE, "AnswerMs", "SampleCount"),
}
# Metrics of each server by our name: namespace, name and statistic in CloudWatch.
_SERVER_SERIES = {
    "cpu_percent": (_EC2, "CPUUtilization", "Average"),
    "robots": (NAMESPACE, ROBOTS, "Maximum"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupMetrics:
    """Metrics of the last `PERIODS` complete periods of ``period_s`` seconds.

    ``times_s`` are the ends of the periods in Unix seconds; ``series`` maps the name of a metric to its value
    in each period.  ``servers`` maps an instance to its newest values within the last three periods.
    """

    period_s: int
    times_s: tuple[int, ...] = ()
    series: Mapping[str, tuple[float | None, ...]] = field(default_factory=dict)
    servers: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def newest(self, name: str) -> float | None:
        """Return the newest value of the metric *name* within the last three periods.

        None if there is none.
        """
        values = [value for value in self.series.get(name, ())[-_FRESH_PERIODS:] if value is not None]
        return values[-1] if values else None


def read_group_metrics(
    account: Account, settings: PlatformSettings, servers: Sequence[str], *, now: datetime
) -> GroupMetrics:
    """Return the metrics of the group and of the instances *servers* until *now* (UTC).

    The current period is left out, since some servers may not have published their values yet.

    Raises:
        ConfigurationError: AWS rejected the request.
        StoreError: AWS does not answer.
    """
    period_s, group = settings.scaling.period_s, ResourceNames(settings.cloud.name).group
    end_s = int(now.timestamp()) // period_s * period_s
    times_s = tuple(end_s - period_s * back for back in range(PERIODS - 1, -1, -1))
    queries = [("", name, source) for name, source in _GROUP_SERIES.items()]
    queries += [
        (server, name, source) for server in servers[:_MAX_SERVERS] for name, source in _SERVER_SERIES.items()
    ]
    end = datetime.fromtimestamp(end_s, now.tzinfo)
    rows = account.pages(
        "cloudwatch", "get_metric_data", "MetricDataResults",
        MetricDataQueries=[
            _make_query(f"q{at}", dimensions_of(group, server), server, source, period_s)
            for at, (server, _, source) in enumerate(queries)
        ],
        ScanBy="TimestampAscending", StartTime=end - timedelta(seconds=PERIODS * period_s), EndTime=end,
    )  # fmt: skip
    values_by_query: dict[int, dict[int, float]] = {}
    for row in rows:
        values = values_by_query.setdefault(int(row["Id"].removeprefix("q")), {})
        for begin, value in zip(row["Timestamps"], row["Values"], strict=False):
            values[int(begin.timestamp()) // period_s * period_s + period_s] = float(value)
    series: dict[str, tuple[float | None, ...]] = {}
    newest: dict[str, dict[str, float]] = {}
    for at, (server, name, _) in enumerate(queries):
        numbers = tuple(values_by_query.get(at, {}).get(time_s) for time_s in times_s)
        fresh = [value for value in numbers[-_FRESH_PERIODS:] if value is not None]
        if not server:
            series[name] = numbers
        elif fresh:
            newest.setdefault(server, {})[name] = fresh[-1]
    return GroupMetrics(period_s=period_s, times_s=times_s, series=series, servers=newest)


def _make_query(
    identity: str, of_group: list[dict[str, str]], server: str, source: tuple[str, str, str], period_s: int
) -> dict[str, Any]:
    namespace, metric, statistic = source
    dimensions = [{"Name": "InstanceId", "Value": server}] if server and namespace == _EC2 else of_group
    return {
        "Id": identity,
        "MetricStat": {
            "Metric": {"Namespace": namespace, "MetricName": metric, "Dimensions": dimensions},
            "Period": period_s,
            "Stat": statistic,
        },
    }
