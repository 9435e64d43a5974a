"""Percentiles of answer times over the last minute, from the servers' histograms of durations.

A server's histogram counts since the server started: the answers of the last minute are the difference of two
readings.  A percentile is interpolated within its bucket.  For a server that restarted or is new, the
difference is taken from its first reading.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["LastMinute", "buckets_of", "percentile"]

_COVERED_TIME_S = 60.0  # time over which percentiles are computed, in seconds
# A line of Prometheus metrics with a bucket of the histogram of durations.
_BUCKET = re.compile(r"rse_pf_duration_seconds_bucket\{([^}]*)\} ([0-9.eE+]+)")
# The upper bound of a bucket in its labels.
_BOUND = re.compile(r'le="([^"]+)"')

Buckets = dict[float, float]
"""A cumulative histogram: the number of answers that took at most the key, in seconds."""


def buckets_of(page: str) -> Buckets:
    """Return the histogram of durations in *page*, a server's Prometheus metrics, summed over services."""
    buckets: Buckets = {}
    for labels, value in _BUCKET.findall(page):
        bound = _BOUND.search(labels)
        if bound:
            least_s = math.inf if bound[1] == "+Inf" else float(bound[1])
            buckets[least_s] = buckets.get(least_s, 0.0) + float(value)
    return buckets


def percentile(buckets: Mapping[float, float], share: float) -> float | None:
    """Return the time in seconds within which the fraction *share* of the answers arrived.

    The result is None without answers.  Answers beyond the last finite bound count as that bound.
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
        """Start without histograms."""
        self._taken: dict[str, deque[tuple[float, Buckets]]] = {}

    def add(self, server: str, buckets: Buckets, *, now_s: float) -> None:
        """Add the histogram of *server* that was read at *now_s* (s).

        If a count is lower than before, the server was restarted, and its older histograms are dropped.
        """
        snapshots = self._taken.setdefault(server, deque())
        if snapshots and any(buckets.get(bound, 0.0) < count for bound, count in snapshots[-1][1].items()):
            snapshots.clear()  # a count decreased: the server was restarted
        snapshots.append((now_s, buckets))

    def document(self, *, now_s: float, servers: Sequence[str]) -> dict[str, Any]:
        """Return p50, p95 and p99 (ms) of the answers of *servers* in the last minute, and their count.

        ``covered_s`` is the time between the readings, at most 60 s.  Percentiles are None without answers.
        """
        for gone in set(self._taken) - set(servers):
            del self._taken[gone]
        summed: Buckets = {}
        covered_s = 0.0
        for snapshots in self._taken.values():
            while len(snapshots) > 1 and snapshots[1][0] <= now_s - _COVERED_TIME_S:
                snapshots.popleft()
            (began_s, first), (ended_s, last) = snapshots[0], snapshots[-1]
            covered_s = max(covered_s, ended_s - began_s)
            for bound, count in last.items():
                summed[bound] = summed.get(bound, 0.0) + count - first.get(bound, 0.0)
        count = max(summed.values(), default=0.0)

        def percentile_ms(share: float) -> float | None:
            value = percentile(summed, share)
            return None if value is None else round(1e3 * value, 2)

        return {
            "p50_ms": percentile_ms(0.5), "p95_ms": percentile_ms(0.95), "p99_ms": percentile_ms(0.99),
            "count": int(count), "covered_s": round(min(covered_s, _COVERED_TIME_S), 1),
        }  # fmt: skip
