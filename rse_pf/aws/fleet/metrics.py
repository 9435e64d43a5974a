"""Convert a server's Prometheus page into the metrics that CloudWatch's alarms and dashboard read.

Pure functions.  A counter whose value fell was reset by a restart of the server and counts from zero again.
Metric names are those of `rse_pf.scaling.alarms` and `rse_pf.scaling.operator_alarms`; names of robots are
not published.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rse_pf.scaling.operator_alarms import DISK_LOW, LOW_DISK_PERCENT, NATIVE_CRASHES

__all__ = ["ROBOTS", "ServerMetrics", "datums", "dimensions_of", "read_cpu_times", "read_page"]

ROBOTS = "Robots"
"""Metric of the number of connected robots: the only one that is also published for each single server."""

_LINE = re.compile(r"^rse_pf_(\w+?)(?:\{(.*)\})? (\S+)$", flags=re.M)
_LABEL = re.compile(r'(\w+)="([^"]*)"')
_INF = "+Inf"  # the upper bound of the last bucket of a histogram in Prometheus' text format
# An answer slower than the largest bound of the histogram is published as this many times that bound.
_BEYOND_FACTOR = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerMetrics:
    """One reading of a server's metrics page.

    ``requests``, ``bytes_in``, ``bytes_out``, ``worker_crashes`` and ``answers`` count since the server's
    start; the others are current values.  ``answers`` is a cumulative histogram: it maps an upper bound in ms
    to the number of answers that took at most that long.
    """

    robots: float = 0.0
    in_flight: float = 0.0
    queue_ms: float = 0.0
    requests: float = 0.0
    bytes_in: float = 0.0
    bytes_out: float = 0.0
    worker_crashes: float = 0.0
    disk_free_percent: float = 100.0
    answers: Mapping[float, float] = field(default_factory=dict)


def read_page(text: str) -> ServerMetrics:
    """Return the metrics in the text of a /metrics page, which is in Prometheus' text format."""
    totals: Counter[str] = Counter()
    answers: Counter[float] = Counter()
    bounds_ms: list[float] = []
    for name, labels, value in _LINE.findall(text):
        values = dict(_LABEL.findall(labels))
        if name == "duration_seconds_bucket":
            bound_ms = float(values["le"]) * 1e3
            answers[bound_ms] += float(value)  # type: ignore[assignment]
            if values["le"] != _INF:
                bounds_ms.append(bound_ms)
        else:
            totals[f"{name} {values['direction']}" if "direction" in values else name] += float(value)  # type: ignore[assignment]
    if bounds_ms:
        answers[max(bounds_ms) * _BEYOND_FACTOR] = answers.pop(float("inf"))
    return ServerMetrics(
        robots=totals["robots"],
        in_flight=totals["in_flight"],
        queue_ms=totals["queue_oldest_s"] * 1e3,
        requests=totals["requests_total"],
        bytes_in=totals["bytes_total in"],
        bytes_out=totals["bytes_total out"],
        worker_crashes=totals["worker_crashes"],
        disk_free_percent=totals.get("disk_free_percent", 100.0),
        answers=dict(answers),
    )


def read_cpu_times(stat: str) -> tuple[float, float]:
    """Return the busy time and the total time of the processors, in ticks, from the text of /proc/stat.

    Stolen time, which the hypervisor gave to other machines, counts as busy, as in EC2's CPUUtilization.
    """
    user, nice, system, idle, waiting, *others = (float(ticks) for ticks in stat.splitlines()[0].split()[1:9])
    busy = user + nice + system + sum(others)
    return busy, busy + idle + waiting


def dimensions_of(group: str, server: str = "") -> list[dict[str, str]]:
    """Return the CloudWatch dimensions of a metric of the Auto Scaling group *group*.

    If *server* is an instance id, return those of a metric of that instance.
    """
    named = {"AutoScalingGroupName": group, **({"InstanceId": server} if server else {})}
    return [{"Name": name, "Value": value} for name, value in named.items()]


def datums(before: ServerMetrics, now: ServerMetrics, group: str, server: str) -> list[dict[str, Any]]:
    """Return the MetricData of PutMetricData for the time between two readings of instance *server*.

    Counters are published as their growth, other values as in *now*.  The metrics of crashes in native code
    and of a nearly full disk are left out while they are 0, because they then cost nothing.
    """
    values = {
        ROBOTS: (now.robots, "Count"),
        "InFlight": (now.in_flight, "Count"),
        "QueueMs": (now.queue_ms, "Milliseconds"),
        "Requests": (_counter_growth(before.requests, now.requests), "Count"),
        "BytesIn": (_counter_growth(before.bytes_in, now.bytes_in), "Bytes"),
        "BytesOut": (_counter_growth(before.bytes_out, now.bytes_out), "Bytes"),
    }
    faults = {
        NATIVE_CRASHES: _counter_growth(before.worker_crashes, now.worker_crashes),
        DISK_LOW: float(now.disk_free_percent < LOW_DISK_PERCENT),
    }
    values.update({name: (value, "Count") for name, value in faults.items() if value})
    dimensions = dimensions_of(group)
    data: list[dict[str, Any]] = [
        {"MetricName": name, "Dimensions": dimensions, "Value": value, "Unit": unit}
        for name, (value, unit) in values.items()
    ]
    of_server = dimensions_of(group, server)
    data.append({"MetricName": ROBOTS, "Dimensions": of_server, "Value": now.robots, "Unit": "Count"})
    slots = _count_answers(before.answers, now.answers)
    if slots:
        data.append(
            {
                "MetricName": "AnswerMs",
                "Dimensions": dimensions,
                "Values": list(slots),
                "Counts": list(slots.values()),
                "Unit": "Milliseconds",
            }
        )
    return data


def _count_answers(before: Mapping[float, float], now: Mapping[float, float]) -> dict[float, float]:
    """Return the number of answers between each bound of the histogram and the next lower bound.

    Only answers between the two readings count; intervals without answers are left out.
    """
    slots, below = {}, 0.0
    restarted = any(now.get(bound, 0.0) < count for bound, count in before.items())
    for bound in sorted(now):
        passed = now[bound] - (0.0 if restarted else before.get(bound, 0.0))
        if passed > below:
            slots[bound] = passed - below
        below = passed
    return slots


def _counter_growth(before: float, now: float) -> float:
    return now - before if now >= before else now
