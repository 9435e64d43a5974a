"""The monitor box on one machine: samples of all servers, and their means over whole periods.

A `MonitorSample` is taken about once a second; `Periods` combines those of a whole period into one
`rse_pf.scaling.rules.Sample`, which the scaling policy evaluates.  A monitor sample stands for the time since
the sample before it, and belongs to the period in which the middle of that time lies; the same rule checks a
recorded run.  The functions here are pure: they use no clock and no socket.  The CPU load of a server that
does not answer is None, not 0.
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
# A period gives no sample if the CPU load is known for less than this share of it.
_MIN_OBSERVED_SHARE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The content of a server's /status page as ``status``, read at ``at_s`` (monotonic seconds)."""

    at_s: float
    status: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerSample:
    """One server in a `MonitorSample`.

    ``requests``, ``bytes_in`` and ``bytes_out`` count since the sample before it; ``queue_ms`` is the longest
    wait of a command in its queue in the last second or two.  ``cpu_percent`` is the CPU time that the server
    used of what it may use; None unless it answered now and at least once before.  ``warming`` is whether its
    CPU time does not count for scaling yet.
    """

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
    """All servers at one time: ``time``, in monotonic seconds.

    ``cpu_percent`` is the mean over the servers that are past their warm-up, None if no such server has a
    value; 100 is all the CPU time that a server may use (`capacity_cores`).  ``healthy_servers`` counts those
    that are healthy and get robots from the load balancer.  ``queue_ms`` is the largest of all servers, in
    ms; robots, requests and bytes are sums over all servers.
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
    """Return the CPU seconds per second that count as 100 % of a server with *workers* worker processes.

    These are the emulated cores of all workers if ``serving.emulated_cores`` is set, else one core for each
    worker, at most *machine_cores*.
    """
    if serving.emulated_cores > 0:
        return serving.emulated_cores * workers
    return float(min(workers, machine_cores))


def server_sample(
    silent: ServerSample, before: Observed | None, now: Observed | None, *, capacity: float
) -> ServerSample:
    """Return the sample of a server from its last two /status pages.

    Args:
        silent: The sample if the server does not answer: name, pid, phase and warm-up, all else 0 or None.
        before: The server's last page before this sample; None if there is none yet.
        now: The server's page of this sample; None if it did not answer, and *silent* is returned.
        capacity: CPU seconds per second that count as 100 %.
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
    """Return the sample of all *servers* at *time_s*; *in_balancer* names those that get new robots."""
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
    """Combines samples of the monitor into one sample for each period of *period_s* seconds.

    Periods begin at whole multiples of *period_s* on the monotonic clock; the newest *keep* periods are kept.
    """

    def __init__(self, period_s: float, keep: int) -> None:
        self._period_s = period_s
        self._keep = keep
        self._taken: dict[int, list[tuple[float, MonitorSample]]] = {}
        self._before_s: float | None = None

    def add(self, sample: MonitorSample) -> bool:
        """Add *sample*; return whether a period ended between the sample before it and *sample*.

        The first sample, and one that is not newer than the last, only set the time; they return False.
        """
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
        """Return one sample for each period that has ended by *now_s*, oldest first.

        Periods for most of which the CPU load is not known are left out.
        """
        ended = math.floor(now_s / self._period_s + 1e-6)
        return tuple(
            _period_sample(period * self._period_s, period_samples)
            for period, period_samples in sorted(self._taken.items())
            if period < ended and _observed_s(period_samples) >= _MIN_OBSERVED_SHARE * self._period_s
        )


def _period_sample(start_s: float, period_samples: Sequence[tuple[float, MonitorSample]]) -> Sample:
    """Return the sample of the period that began at *start_s*.

    CPU load and robots per server are means over the time for which the load is known; requests are a sum.
    Each element of *period_samples* is the seconds that a monitor sample stands for, and that sample.
    """
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
    """Return for how many seconds of a period the CPU load is known."""
    return sum(since_s for since_s, sample in period_samples if sample.cpu_percent is not None)
