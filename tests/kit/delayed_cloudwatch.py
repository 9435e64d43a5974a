"""CloudWatch as far as the agents need it: it stores numbers and shows them after a delay.

High-resolution metrics of a known name are usually readable a few seconds after they were published; AWS
promises no limit.  The default of 5 s is an assumption, not a measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Any

DELAY_S = 5.0

_STATISTICS: dict[str, Callable[[list[float]], float]] = {
    "Sum": sum, "SampleCount": lambda values: float(len(values)),
}  # fmt: skip


class DelayedCloudWatch:
    """Answers put_metric_data and get_metric_data; *clock* may be a fake one."""

    def __init__(self, clock: Callable[[], float], delay_s: float = DELAY_S) -> None:
        self._clock = clock
        self._delay_s = delay_s
        self.data: list[tuple[float, dict[str, Any]]] = []
        self.reads = 0

    def put_metric_data(self, **arguments: Any) -> dict[str, Any]:
        """Store the numbers of one agent."""
        self.data += [(self._clock() + self._delay_s, argument) for argument in arguments["MetricData"]]
        return {}

    def get_metric_data(self, **arguments: Any) -> dict[str, Any]:
        """Return what is old enough, the newest first."""
        self.reads += 1
        return {
            "MetricDataResults": [
                self._row(argument, arguments) for argument in arguments["MetricDataQueries"]
            ]
        }

    def _row(self, query: dict[str, Any], asked: dict[str, Any]) -> dict[str, Any]:
        metric, reduce = query["MetricStat"]["Metric"], _STATISTICS[query["MetricStat"]["Stat"]]
        series: dict[datetime, list[float]] = {}
        for visible_s, datum in self.data:
            is_it = (datum["MetricName"], datum["Dimensions"]) == (metric["MetricName"], metric["Dimensions"])
            begin = datum["Timestamp"]
            if is_it and visible_s <= self._clock() and asked["StartTime"] <= begin < asked["EndTime"]:
                series.setdefault(begin, []).append(datum["Value"])
        times = sorted(series, reverse=True)
        return {"Id": query["Id"], "Timestamps": times, "Values": [reduce(series[at]) for at in times]}
