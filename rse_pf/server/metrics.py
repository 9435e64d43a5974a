"""Count the work of each worker, add the counts of all workers, and render the sums for Prometheus.

A worker only adds to numbers in memory.  The supervisor requests a `Metrics.snapshot` of each worker, adds
the snapshots (`merge`), and renders the sum as text (`render`).  No label contains the name of a robot.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from itertools import accumulate
from typing import Any

from rse_pf.errors import MissingExtra

__all__ = [
    "BUCKETS_S",
    "GAUGE_HELP",
    "MAX_TENANTS",
    "OTHER_TENANTS",
    "LongestRecently",
    "Metrics",
    "merge",
    "merge_isolation",
    "render",
    "tenant_cpu_s",
]

BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper bounds of the buckets of the duration histogram, in seconds; one more bucket has no upper bound."""

GAUGE_HELP = {
    "robots": "robots that are connected to the server now, without synthetic ones such as the canary",
    "queue": "commands to stateless services that wait to be computed",
    "queue_oldest_s": "age of the command that has waited longest, in seconds",
    "queue_ms": "longest wait of a command in the last second or two, in milliseconds",
    "in_flight": "commands that a solver thread computes now",
    "loop_lag_s": "longest delay of a worker's event loop since the last report, in seconds",
    "cpu_s": "processor time of all processes of the server since its start, in seconds",
    "log_lines_dropped": "log lines that were lost because they came faster than they were written",
    "compute_queue": "commands that wait for a limited process",
    "compute_running": "commands that a limited process computes now",
    "compute_cpu_s": "processor time of the limited processes since the start, in seconds",
    "compute_blocked_robots": "robots that are refused limited services because their commands crashed",
    "jobs": "long jobs that a worker knows and that wait or run, here or elsewhere",
    "jobs_pending": "long jobs that a worker knows and that run nowhere yet",
    "sandboxes": "sandboxes of installed services that exist now",
    "moved": "robots that were asked to move to another server since the start",
    "resident_bytes": "memory of the server's processes that is resident, in bytes",
    "subscriptions": "subscriptions of robots to live maps now",
    "updates": "updates of live maps that were sent to robots since the start",
    "updates_replaced": "updates of live maps that newer ones replaced before a slow reader got them",
    "live_waiting": "commands that wait for the map server of a live map now",
    "recording_dropped": "messages that were not recorded because the recorder was too slow or has ended",
    "ready": "whether the server accepts robots: 1, or 0 while it starts or drains",
    "accept_pauses": "pauses because sockets began to send faster than max_accepts_per_s",
    "worker_crashes": "workers that crashed in native code, and were replaced, since the start",
    "disk_free_percent": "free share of the disk of the server's working folder, in percent",
    "control_refused": "requests to the control port that were refused for lack of its token",
}
"""The help text of each gauge in the output of /metrics; a new gauge needs a line here."""
MAX_TENANTS = 100  # tenants whose CPU seconds a worker counts by name: the number of labels is bounded
OTHER_TENANTS = "(others)"  # label of the CPU seconds of all further tenants together
# For these gauges `merge` takes the greatest value of all workers; it adds the values of all other gauges.
_GAUGES_OF_WORST = ("queue_oldest_s", "queue_ms", "loop_lag_s")
_RECENT_S = 1.0  # seconds of each of the two intervals of `LongestRecently`


class Metrics:
    """The counters and gauges of one worker, from its start.

    ``requests`` counts answers by service and result, ``shed`` refused commands by reason, ``handshakes`` by
    result, ``closed`` connections by reason; ``durations`` has the histogram of each service.
    """

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, str]] = Counter()
        self.shed: Counter[str] = Counter()
        self.handshakes: Counter[str] = Counter()
        self.closed: Counter[str] = Counter()
        self.durations: dict[str, list[int]] = {}
        self.duration_sum_s: Counter[str] = Counter()
        self.bytes_in = 0
        self.bytes_out = 0
        self.gauges: dict[str, float] = {}
        self.tenant_cpu_s: dict[str, dict[str, float]] = {"commands": {}}
        """CPU seconds by kind of work (commands, sandboxes, jobs, live-maps), then by tenant."""
        self._commands_s = self.tenant_cpu_s["commands"]
        self._tenants: set[str] = set()

    def set_cpu(self, kind: str, seconds: Mapping[str, float]) -> None:
        """Set the CPU seconds of the kind of work *kind* to *seconds*, the totals so far by tenant.

        The tenants beyond `MAX_TENANTS` are added up under `OTHER_TENANTS`.
        """
        taken: defaultdict[str, float] = defaultdict(float)
        for tenant, taken_s in seconds.items():
            taken[self._label(tenant)] += taken_s
        self.tenant_cpu_s[kind] = taken

    def _label(self, tenant: str) -> str:
        """Return the label of *tenant*: its name, or `OTHER_TENANTS` if `MAX_TENANTS` others have labels."""
        if tenant not in self._tenants and len(self._tenants) >= MAX_TENANTS:
            return OTHER_TENANTS
        self._tenants.add(tenant)
        return tenant

    def count_answer(
        self, service: str, result: str, duration_s: float, tenant: str = "", computed_s: float = 0.0
    ) -> None:
        """Count the final answer to one command, and its duration.

        Args:
            service: Name of the service.
            result: ``ok``, or the code of the failure.
            duration_s: Seconds from the arrival of the command to its answer.
            tenant: The tenant of the robot.
            computed_s: Seconds of computation, added to the CPU seconds of *tenant*; 0 adds nothing.
        """
        if computed_s:
            try:
                self._commands_s[tenant] += computed_s
            except KeyError:
                label = self._label(tenant)
                self._commands_s[label] = self._commands_s.get(label, 0.0) + computed_s
        self.requests[service, result] += 1
        buckets = self.durations.get(service)
        if buckets is None:
            buckets = self.durations[service] = [0] * (len(BUCKETS_S) + 1)
        buckets[bisect_left(BUCKETS_S, duration_s)] += 1
        self.duration_sum_s[service] += duration_s  # type: ignore[assignment]

    def snapshot(self) -> dict[str, Any]:
        """Return all counters and gauges as JSON values, for the report to the supervisor."""
        return {
            "requests": [[service, result, n] for (service, result), n in self.requests.items()],
            "shed": dict(self.shed),
            "handshakes": dict(self.handshakes),
            "closed": dict(self.closed),
            "durations": self.durations,
            "duration_sum_s": dict(self.duration_sum_s),
            "bytes": {"in": self.bytes_in, "out": self.bytes_out},
            "gauges": self.gauges,
            "tenant_cpu_s": [
                [tenant, kind, taken_s]
                for kind, taken in self.tenant_cpu_s.items()
                for tenant, taken_s in taken.items()
            ],
        }


class LongestRecently:
    """The longest duration within the last one to two seconds, in constant memory.

    The maximum is kept for the present second of the clock and for the second before it.
    """

    def __init__(self) -> None:
        self._second = -1
        self._longest_s = [0.0, 0.0]

    def note(self, duration_s: float, now: float) -> None:
        """Add a duration that ended at *now* (monotonic seconds)."""
        if int(now // _RECENT_S) != self._second:
            self._advance_to(now)
        if duration_s > self._longest_s[1]:
            self._longest_s[1] = duration_s

    def longest_s(self, now: float) -> float:
        """Return the longest duration, in seconds, of this second and the one before; 0 if there was none."""
        self._advance_to(now)
        return max(self._longest_s)

    def _advance_to(self, now: float) -> None:
        """Make the second of *now* the present one; forget the maxima of seconds before the previous one."""
        second = int(now // _RECENT_S)
        if second != self._second:
            self._longest_s = [self._longest_s[1] if second == self._second + 1 else 0.0, 0.0]
            self._second = second


def merge(snapshots: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return one snapshot of the server: the sum of the *snapshots* of its workers.

    The gauges `_GAUGES_OF_WORST` (queue waits and event loop lag) are the greatest of all workers instead.
    """
    requests: Counter[tuple[str, str]] = Counter()
    sums: dict[str, Counter[str]] = {
        name: Counter() for name in ("shed", "handshakes", "closed", "duration_sum_s", "bytes", "gauges")
    }
    cpu_s: defaultdict[tuple[str, str], float] = defaultdict(float)
    durations: dict[str, list[int]] = {}
    worst = dict.fromkeys(_GAUGES_OF_WORST, 0.0)
    for snapshot in snapshots:
        for service, result, n in snapshot["requests"]:
            requests[service, result] += n
        for tenant, kind, taken_s in snapshot["tenant_cpu_s"]:
            cpu_s[tenant, kind] += taken_s
        for name, counter in sums.items():
            counter.update(snapshot[name])
        for service, buckets in snapshot["durations"].items():
            held = durations.setdefault(service, [0] * len(buckets))
            durations[service] = [a + b for a, b in zip(held, buckets, strict=True)]
        for name in worst:
            worst[name] = max(worst[name], snapshot["gauges"].get(name, 0.0))
    merged: dict[str, Any] = {name: dict(counter) for name, counter in sums.items()}
    merged["gauges"].update(worst)
    return {
        **merged,
        "requests": [[service, result, n] for (service, result), n in requests.items()],
        "durations": durations,
        "tenant_cpu_s": [[tenant, kind, taken_s] for (tenant, kind), taken_s in cpu_s.items()],
    }


def tenant_cpu_s(merged: Mapping[str, Any]) -> dict[str, float]:
    """Return the CPU seconds of each tenant, summed over all kinds of work; the largest sum comes first."""
    taken: defaultdict[str, float] = defaultdict(float)
    for tenant, _, taken_s in merged["tenant_cpu_s"]:
        taken[tenant] += taken_s
    return {tenant: round(taken[tenant], 3) for tenant in sorted(taken, key=taken.__getitem__, reverse=True)}


def merge_isolation(snapshots: Iterable[Mapping[str, Any] | None]) -> dict[str, Any]:
    """Return one report on sandboxes from those of all workers; zeros and empty lists if none has any.

    Numbers are added.  Missing means of isolation and open circuit breakers are those of any worker;
    ``services`` are the services that every worker runs.
    """
    reports = [snapshot["isolation"] for snapshot in snapshots if snapshot and "isolation" in snapshot]
    counts: Counter[str] = Counter()
    for report in reports:
        counts.update(report["counts"])
    return {
        "sandboxes": sum(report["sandboxes"] for report in reports),
        "missing_isolation": sorted({name for report in reports for name in report["missing_isolation"]}),
        "open_breakers": sorted({service for report in reports for service in report["open_breakers"]}),
        "counts": dict(counts),
        "services": sorted(
            set.intersection(*(set(report["services"]) for report in reports)) if reports else ()
        ),
    }


def render(merged: Mapping[str, Any]) -> bytes:
    """Return *merged*, the result of `merge`, in the text format of Prometheus.

    Raises:
        MissingExtra: The package prometheus-client is not installed.
    """
    try:
        from prometheus_client import CollectorRegistry, generate_latest
        from prometheus_client.core import (
            CounterMetricFamily,
            GaugeMetricFamily,
            HistogramMetricFamily,
            Metric,
        )
    except ImportError as error:
        raise MissingExtra("prometheus-client", "backend") from error

    def counter(name: str, doc: str, label: str, values: Mapping[str, float]) -> Metric:
        family = CounterMetricFamily(f"rse_pf_{name}", doc, labels=[label])
        for key, value in values.items():
            family.add_metric([key], value)
        return family

    class Families:
        def collect(self) -> Iterable[Metric]:
            requests = CounterMetricFamily(
                "rse_pf_requests",
                "final answers to commands of robots, without synthetic ones such as the canary, "
                "by service and result (ok or the code of a failure)",
                labels=["service", "result"],
            )
            for service, result, n in merged["requests"]:
                requests.add_metric([service, result], n)
            yield requests
            yield counter(
                "shed",
                "commands that were refused before they were computed, by reason",
                "reason",
                merged["shed"],
            )
            yield counter(
                "handshakes", "WebSocket handshakes of robots, by result", "result", merged["handshakes"]
            )
            yield counter(
                "closed", "sockets of robots that the server closed, by reason", "reason", merged["closed"]
            )
            yield counter(
                "bytes",
                "bytes of protocol messages, by direction as the server sees it",
                "direction",
                merged["bytes"],
            )
            taken = CounterMetricFamily(
                "rse_pf_tenant_cpu_seconds",
                "seconds of computing, by tenant and by what computed: commands, sandboxes, jobs, live-maps",
                labels=["tenant", "kind"],
            )
            for tenant, kind, taken_s in merged["tenant_cpu_s"]:
                taken.add_metric([tenant, kind], taken_s)
            yield taken
            for name, value in merged["gauges"].items():
                yield GaugeMetricFamily(f"rse_pf_{name}", GAUGE_HELP.get(name, name), value=value)
            histogram = HistogramMetricFamily(
                "rse_pf_duration_seconds",
                "time from the arrival of a command to its answer in the server, in seconds",
                labels=["service"],
            )
            for service, buckets in merged["durations"].items():
                histogram.add_metric([service], _cumulate(buckets), merged["duration_sum_s"][service])
            yield histogram

    registry = CollectorRegistry()
    registry.register(Families())
    return generate_latest(registry)


def _cumulate(buckets: list[int]) -> list[tuple[str, float]]:
    """Return the upper bound and the cumulative count of each bucket, as Prometheus requires."""
    bounds = [*map(str, BUCKETS_S), "+Inf"]
    return list(zip(bounds, map(float, accumulate(buckets)), strict=True))
