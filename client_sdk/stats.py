"""What a robot knows about its own traffic, in bounded memory."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["Percentiles", "Stats", "StatsKeeper"]

_KEPT = 2048
"""The last so many commands are remembered for percentiles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Of the last 2,048 commands; None before the first."""

    p50: float | None
    p95: float | None
    p99: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Stats:
    """A snapshot; times in ms, clocks in s."""

    sent: int
    answered: int
    failed: int
    answered_by_robot: int
    failures_by_code: Mapping[str, int]
    unanswered: int
    resent: int
    dropped_answers: int
    reconnects: int
    moves: int
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
    last_error: str


class StatsKeeper:
    """Counts and remembers; `Robot.stats` makes the snapshot."""

    def __init__(self) -> None:
        self.sent = 0
        self.answered = 0
        self.answered_by_robot = 0
        self.failures: Counter[str] = Counter()
        self.payload_bytes_max = 0
        self._values: dict[str, deque[float]] = {}

    def add(self, name: str, value: float | None) -> None:
        """Remember one measured value."""
        if value is not None:
            self._values.setdefault(name, deque(maxlen=_KEPT)).append(value)

    def add_payload(self, size: int) -> None:
        """Remember the bytes of one command."""
        self.payload_bytes_max = max(self.payload_bytes_max, size)
        self.add("payload_bytes", size)

    def percentile(self, name: str, share: float) -> float | None:
        """Return a percentile of the remembered values: the nearest rank."""
        values = sorted(self._values.get(name, ()))
        if not values:
            return None
        return values[min(len(values) - 1, int(share * len(values)))]

    def percentiles(self, name: str) -> Percentiles:
        """Return the three that everybody asks for."""
        return Percentiles(
            p50=self.percentile(name, 0.5), p95=self.percentile(name, 0.95), p99=self.percentile(name, 0.99)
        )
