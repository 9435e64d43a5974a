"""Percentiles of the last minute from the servers' histograms of durations, which count since their start.

A percentile is as exact as the buckets are: it is interpolated within its bucket.  The histogram of a server
that restarted, or that was not there a minute ago, counts from zero.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["LastMinute", "buckets_of", "percentile"]

_MINUTE_S = 60.0
_BUCKET = re.compile(r"rse_pf_duration_seconds_bucket\{([^}]*)\} ([0-9.eE+]+)")
_BOUND = re.compile(r'le="([^"]+)"')

Buckets = dict[float, float]
"""Upper bound in seconds to how many answers took at most that long."""


def buckets_of(page: str) -> Buckets:
    """Return the histogram of all services on a server's page of metrics."""
    buckets: Buckets = {}
    for labels, value in _BUCKET.findall(page):
        bound = _BOUND.search(labels)
        if bound:
            least_s = math.inf if bound[1] == "+Inf" else float(bound[1])
            buckets[least_s] = buckets.get(least_s, 0.0) + float(value)
    return buckets


def percentile(buckets: Mapping[float, float], share: float) -> float | None:
    """Return the time that *share* of the answers took at most, in seconds; None if there are none.

    An answer beyond the last bound counts as that bound.
    """
    bounds = sorted(buckets)
    total = buckets[bounds[-1]] if bounds else 0.0
    if total <= 0:
        return None
    below_s, below = 0.0, 0.0
    for bound in bounds:
        if buckets[bound] >= share * total:
            if math.isinf(bound):
                return below_s
            within = buckets[bound] - below
            part = 1.0 if within <= 0 else (share * total - below) / within
            return below_s + part * (bound - below_s)
        below_s, below = bound, buckets[bound]
    return below_s


class LastMinute:
    """The histograms of all servers over the last minute."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self._taken: dict[str, deque[tuple[float, Buckets]]] = {}

    def add(self, server: str, buckets: Buckets, *, now_s: float) -> None:
        """Take the present histogram of *server*."""
        snapshots = self._taken.setdefault(server, deque())
        if snapshots and any(buckets.get(bound, 0.0) < count for bound, count in snapshots[-1][1].items()):
            snapshots.clear()  # it restarted
        snapshots.append((now_s, buckets))

    def document(self, *, now_s: float, servers: Sequence[str]) -> dict[str, Any]:
        """Return p50, p95 and p99 in milliseconds, the count, and how many seconds they cover."""
        for gone in set(self._taken) - set(servers):
            del self._taken[gone]
        summed: Buckets = {}
        covered_s = 0.0
        for snapshots in self._taken.values():
            while len(snapshots) > 1 and snapshots[1][0] <= now_s - _MINUTE_S:
                snapshots.popleft()
            (began_s, first), (ended_s, last) = snapshots[0], snapshots[-1]
            covered_s = max(covered_s, ended_s - began_s)
            for bound, count in last.items():
                summed[bound] = summed.get(bound, 0.0) + count - first.get(bound, 0.0)
        count = max(summed.values(), default=0.0)

        def told(share: float) -> float | None:
            value = percentile(summed, share)
            return None if value is None else round(1e3 * value, 2)

        return {
            "p50_ms": told(0.5), "p95_ms": told(0.95), "p99_ms": told(0.99), "count": int(count),
            "covered_s": round(min(covered_s, _MINUTE_S), 1),
        }  # fmt: skip
