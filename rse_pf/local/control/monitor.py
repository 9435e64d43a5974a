"""The monitor box on one machine: samples of all servers, and their means over whole periods.

A `MonitorSample` is taken about once a second; `Periods` combines them into the
`rse_pf.scaling.rules.Sample`s that the policy evaluates, by the rule with which a report can be checked
later: a sample stands for the time since the one before it, and belongs to the period in which the middle
of that time lies.  The functions here are pure: they use no clock and no socket, and a server that does
not answer has no numbers rather than zeros.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from rse_pf.config import ServingSettings
from rse_pf.scaling.rules import Sample

__all__ = [
    "MonitorSample",
    "Observed",
    "Periods",
    "ServerSample",
    "capacity_cores",
    "monitor_sample",
    "sample_interval_s",
    "server_sample",
]

ServerPhase = Literal["starting", "healthy", "unhealthy", "draining"]

# Longest time between two samples, in seconds: the fleet page shows a change within about a second.
_MAX_INTERVAL_S = 1.0
# Shortest time between two samples, in seconds: reading all servers more often would take noticeable CPU.
_MIN_INTERVAL_S = 0.25
# A period of which less than this share was observed gives no sample: most of its load is unknown.
_MIN_OBSERVED_SHARE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The /status page of a server as ``status``, and when it was read: ``at_s``, in monotonic seconds."""

    at_s: float
    status: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerSample:
    """One server.  Counts are of this interval; CPU is relative to its size, None when it did not answer."""

    name: str
    pid: int
    state: ServerPhase
    robots: int = 0
    cpu_percent: float | None = None
    requests: int = 0
    queue: int = 0
    queue_ms: float = 0.0
    in_flight: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    warming: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorSample:
    """All servers at one time.

    ``cpu_percent`` is the mean over the servers past their warm-up, None if there are none; 100 is all the
    CPU time that a server may use (`capacity_cores`).
    """

    time: float
    cpu_percent: float | None
    healthy_servers: int
    servers_count: int
    robots: int
    requests: int
    queue_ms: float
    bytes_in: int
    bytes_out: int
    servers: tuple[ServerSample, ...]

    def document(self) -> dict[str, Any]:
        """Return the sample as plain JSON values."""
        return {**asdict(self), "servers": [asdict(server) for server in self.servers]}


def sample_interval_s(period_s: float) -> float:
    """Return the time between samples: a whole part of the period, near 1 s, and never below 0.25 s."""
    return max(period_s / math.ceil(period_s / _MAX_INTERVAL_S), _MIN_INTERVAL_S)


def capacity_cores(serving: ServingSettings, workers: int, machine_cores: int) -> float:
    """Return the CPU seconds per second that count as 100 % of a server."""
    if serving.emulated_cores > 0:
        return serving.emulated_cores * workers
    return float(min(workers, machine_cores))


def server_sample(
    silent: ServerSample, before: Observed | None, now: Observed | None, *, capacity: float
) -> ServerSample:
    """Return what a server did between *before* and *now*; None means that it did not answer.

    Args:
        silent: Its sample without an answer: name, pid, phase, and whether its CPU does not count yet.
        before: Its last answer.
        now: Its answer of this sample.
        capacity: CPU seconds per second that are 100 %.
    """
    if now is None:
        return silent
    status = now.status
    then: Mapping[str, Any] = {} if before is None else before.status

    def more(field: str) -> int:
        return max(int(status.get(field, 0)) - int(then.get(field, 0)), 0)

    cpu_percent = None
    if before is not None and now.at_s > before.at_s:
        spent_s = float(status["cpu_s"]) - float(then["cpu_s"])
        cpu_percent = round(100.0 * max(spent_s, 0.0) / (capacity * (now.at_s - before.at_s)), 2)
    return replace(
        silent,
        robots=int(status.get("robots", 0)),
        cpu_percent=cpu_percent,
        requests=more("requests"),
        queue=int(status.get("queue", 0)),
        queue_ms=round(float(status.get("queue_ms", 1e3 * float(status.get("queue_oldest_s", 0.0)))), 3),
        in_flight=int(status.get("in_flight", 0)),
        bytes_in=more("bytes_in"),
        bytes_out=more("bytes_out"),
    )


def monitor_sample(
    time_s: float, servers: Sequence[ServerSample], in_balancer: frozenset[str]
) -> MonitorSample:
    """Return the sample of all *servers*; *in_balancer* are those the balancer sends robots to."""
    percents = [
        server.cpu_percent for server in servers if server.cpu_percent is not None and not server.warming
    ]
    return MonitorSample(
        time=time_s,
        cpu_percent=round(sum(percents) / len(percents), 2) if percents else None,
        healthy_servers=sum(server.state == "healthy" and server.name in in_balancer for server in servers),
        servers_count=len(servers),
        robots=sum(server.robots for server in servers),
        requests=sum(server.requests for server in servers),
        queue_ms=max((server.queue_ms for server in servers), default=0.0),
        bytes_in=sum(server.bytes_in for server in servers),
        bytes_out=sum(server.bytes_out for server in servers),
        servers=tuple(servers),
    )


class Periods:
    """Combines samples of the monitor into samples of whole periods, of which the newest *keep* stay."""

    def __init__(self, period_s: float, keep: int) -> None:
        self._period_s = period_s
        self._keep = keep
        self._taken: dict[int, list[tuple[float, MonitorSample]]] = {}
        self._before_s: float | None = None

    def add(self, sample: MonitorSample) -> bool:
        """Add *sample*; return whether a period ended since the sample before it."""
        before_s, self._before_s = self._before_s, sample.time
        if before_s is None or sample.time <= before_s:
            return False
        since_s = sample.time - before_s
        period = math.floor((sample.time - since_s / 2) / self._period_s)
        self._taken.setdefault(period, []).append((since_s, sample))
        for old in sorted(self._taken)[: -self._keep]:
            del self._taken[old]
        return math.floor(sample.time / self._period_s) > math.floor(before_s / self._period_s)

    def samples(self, now_s: float) -> tuple[Sample, ...]:
        """Return the samples of the periods that have ended by *now_s*, oldest first."""
        ended = math.floor(now_s / self._period_s + 1e-6)
        return tuple(
            _period_sample(period * self._period_s, period_samples)
            for period, period_samples in sorted(self._taken.items())
            if period < ended and _observed_s(period_samples) >= _MIN_OBSERVED_SHARE * self._period_s
        )


def _period_sample(start_s: float, period_samples: Sequence[tuple[float, MonitorSample]]) -> Sample:
    """Return the sample of one period: means over time, and the sum of the requests."""
    loads = [(since_s, sample) for since_s, sample in period_samples if sample.cpu_percent is not None]
    known_s = _observed_s(period_samples)
    return Sample(
        start_s=start_s,
        cpu_percent=sum(since_s * (sample.cpu_percent or 0.0) for since_s, sample in loads) / known_s,
        requests=sum(sample.requests for _, sample in period_samples),
        robots_per_server=sum(since_s * sample.robots / sample.servers_count for since_s, sample in loads)
        / known_s,
    )


def _observed_s(period_samples: Sequence[tuple[float, MonitorSample]]) -> float:
    """Return for how many seconds of the period the CPU is known."""
    return sum(since_s for since_s, sample in period_samples if sample.cpu_percent is not None)
