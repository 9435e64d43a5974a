"""Statistics of a robot's own traffic, in bounded memory."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from random import Random

__all__ = ["Percentiles", "Stats", "StatsKeeper"]

# Number of commands of a run, drawn uniformly, from which percentiles are computed.
_SAMPLE_SIZE = 2048

# Number of the last round trips from which the next one is predicted.
_RECENT = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Over the run, from a uniform sample of up to 2,048 commands; None before the first."""

    p50: float | None
    p95: float | None
    p99: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Stats:
    """A snapshot; times in ms, clocks in s.  ``duplicates`` counts second answers to a command: 0.

    ``sent_to_burst`` counts the commands of the present 24 hours, also those that a server answered first.
    ``region`` is the address of the platform that is used now.  ``held_back`` counts the commands that were
    not sent at once although there was a connection: by ``busy`` (the server's answer to this command, or to
    another one of the stream) or ``own-limit`` (what the Welcome allows).  ``callback_errors`` counts the
    calls of the program's callables (*on_change*, *on_progress*, *token*) that raised or took longer than
    ``session.ping_timeout_s``; the log names them.
    """

    sent: int
    answered: int
    failed: int
    sent_to_burst: int
    answered_by_burst: int
    answered_by_robot: int
    failures_by_code: Mapping[str, int]
    unanswered: int
    resent: int
    dropped_answers: int
    held_back: Mapping[str, int]
    duplicates: int
    reconnects: int
    moves: int
    region_changes: int
    bytes_out: int
    bytes_in: int
    payload_bytes_median: float | None
    payload_bytes_max: int
    round_trip_ms: Percentiles
    up_ms: Percentiles
    queue_ms: Percentiles
    compute_ms: Percentiles
    down_ms: Percentiles
    clock_offset_s: float | None
    clock_uncertainty_s: float | None
    delay_up_s: float | None
    delay_down_s: float | None
    server: str
    region: str
    last_error: str
    callback_errors: int


class StatsKeeper:
    """Count and sample a robot's traffic; `Robot.stats` returns the snapshot."""

    def __init__(self, random: Random) -> None:
        self.sent = 0
        self.answered = 0
        self.answered_by_burst = 0
        self.answered_by_robot = 0
        self.duplicates = 0
        self.failures: Counter[str] = Counter()
        self.payload_bytes_max = 0
        self._random = random
        self._samples: dict[str, _Sample] = {}
        self._recent_round_trips_s: deque[float] = deque(maxlen=_RECENT)

    def add(self, name: str, value: float | None) -> None:
        """Record one measured value."""
        if value is not None:
            self._samples.setdefault(name, _Sample()).add(value, self._random)

    def add_payload(self, size: int) -> None:
        """Record the size of one command in bytes."""
        self.payload_bytes_max = max(self.payload_bytes_max, size)
        self.add("payload_bytes", size)

    def add_round_trip(self, seconds: float) -> None:
        """Record a round trip to the cloud, or the least that it took, for `expected_round_trip_s`."""
        self._recent_round_trips_s.append(seconds)

    def expected_round_trip_s(self) -> float | None:
        """Return the 95th percentile of the last few round trips, or None before the first."""
        return _percentile(sorted(self._recent_round_trips_s), 0.95)

    def percentile(self, name: str, share: float) -> float | None:
        """Return a percentile of the recorded values, by nearest rank; None without a value."""
        return _percentile(self._sort(name), share)

    def percentiles(self, name: str) -> Percentiles:
        """Return the 50th, 95th and 99th percentile of the recorded values."""
        values = self._sort(name)
        return Percentiles(
            p50=_percentile(values, 0.5), p95=_percentile(values, 0.95), p99=_percentile(values, 0.99)
        )

    def _sort(self, name: str) -> list[float]:
        return sorted(self._samples[name].values) if name in self._samples else []


class _Sample:
    """A uniform sample of a stream, in bounded memory (Vitter 1985, algorithm R)."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._seen = 0

    def add(self, value: float, random: Random) -> None:
        self._seen += 1
        if len(self.values) < _SAMPLE_SIZE:
            self.values.append(value)
            return
        place = random.randrange(self._seen)
        if place < _SAMPLE_SIZE:
            self.values[place] = value


def _percentile(ordered: Sequence[float], share: float) -> float | None:
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)] if ordered else None
