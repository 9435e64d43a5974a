"""Convert a server's Prometheus page into the metrics that CloudWatch's alarms and dashboard read.

Pure functions.  A counter that fell was reset by a restart and counts from zero again.  Metric names are
those of `rse_pf.scaling.alarms` and `rse_pf.scaling.operator_alarms`; no robot's name is published.
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
"""The only metric that is also published for each server."""

_LINE = re.compile(r"^rse_pf_(\w+?)(?:\{(.*)\})? (\S+)$", flags=re.M)
_LABEL = re.compile(r'(\w+)="([^"]*)"')
_INF = "+Inf"
# An answer slower than the last bound counts as this many times that bound.
_BEYOND_FACTOR = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerMetrics:
    """One sample of a server: gauges as they are, counters since its start.

    ``answers`` maps an upper bound in milliseconds to the number of answers that took at most that long.
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
    """Return the sample in a page of /metrics, in Prometheus' text format."""
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
    """Return the busy time and the total time of the processors, in ticks, from /proc/stat.

    Time that the hypervisor took away counts as busy, as in CPUUtilization of EC2.
    """
    user, nice, system, idle, waiting, *others = (float(ticks) for ticks in stat.splitlines()[0].split()[1:9])
    busy = user + nice + system + sum(others)
    return busy, busy + idle + waiting


def dimensions_of(group: str, server: str = "") -> list[dict[str, str]]:
    """Return the dimensions of a group's metric or, where *server* is an instance id, of that instance's."""
    named = {"AutoScalingGroupName": group, **({"InstanceId": server} if server else {})}
    return [{"Name": name, "Value": value} for name, value in named.items()]


def datums(before: ServerMetrics, now: ServerMetrics, group: str, server: str) -> list[dict[str, Any]]:
    """Return the MetricData for PutMetricData of instance *server* between two samples.

    Crashes of native code and disks that are nearly full are left out while there are none: their metrics
    then cost nothing.
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
    """Return how many answers lie between each bound and the one below; empty intervals are left out."""
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
