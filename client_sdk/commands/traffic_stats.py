"""Count a robot's own commands, and compute percentiles of their times in bounded memory."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from random import Random

__all__ = ["Percentiles", "Stats", "TrafficCounter"]

SAMPLE_SIZE = 2048
"""Largest number of values in the uniform sample of each quantity, from which percentiles are computed."""
RECENT_ROUND_TRIPS = 32
"""Number of the last round trips to a server; their 95th percentile is the prediction of the next one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Percentiles of a quantity since the robot was made, from a uniform sample of at most 2,048 values.

    They are None while there is no value.
    """

    p50: float | None
    p95: float | None
    p99: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Stats:
    """A snapshot of the counters of one robot, which start at zero when the robot is made.

    Attributes:
        sent: Commands that the program gave to `Robot.call`, whether or not they have left the robot.
        answered: Commands that ended with an answer.
        failed: Commands that ended with an error.
        sent_to_burst: Commands that were sent to the burst function within the present 24 hours, also those
            that a server answered first.
        answered_by_burst: Commands that the burst function answered first.
        answered_by_robot: Commands that the robot answered itself.
        failures_by_code: Number of errors by their code, such as ``expired``.
        unanswered: Commands without a final answer at this moment.
        resent: How often a command was sent again, after a lost connection or a failure of its server.
        dropped_answers: Answers to commands that had ended already, such as expired ones.
        held_back: Commands that were not sent at once although there was a connection: by ``busy`` (the
            server's answer to this command or another one of its stream) or ``own-limit`` (limits of the
            Welcome).
        duplicates: Second answers to a command that passed the session, which drops them: 0 unless the SDK is
            faulty.
        reconnects: How often a lost connection was replaced.
        moves: How often a server asked the robot to change to another server, and the robot did.
        region_changes: How often the robot changed to another of its addresses.
        bytes_out: Payload of all WebSocket messages that were sent.
        bytes_in: Payload of all WebSocket messages that were received.
        payload_bytes_median: Median size of the message of a command that a server answered, in bytes.
        payload_bytes_max: Largest size of such a message, in bytes.
        round_trip_ms: From the call to the answer of a server.
        up_ms: Delay from robot to server.
        queue_ms: Time that commands waited on the server.
        compute_ms: Time of the computation on the server.
        down_ms: Delay from server to robot.
        clock_offset_s: Server clock minus robot clock, None if unknown.
        server: Name of the server that is connected now, empty without one.
        region: Address of the platform that is used now, empty without one.
        last_error: Last problem of the connection, empty without one.
        callback_errors: Calls of the program's functions (*on_change*, *on_progress*, *token*, a recorder)
            that raised or took longer than ``session.ping_timeout_s``; the log names them.
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
    server: str
    region: str
    last_error: str
    callback_errors: int


class TrafficCounter:
    """Count and sample the commands of one robot; `Robot.stats` makes a `Stats` of it."""

    def __init__(self, random: Random) -> None:
        """Begin with counters of zero; *random* draws the samples of commands."""
        self.sent = 0
        self.answered = 0
        self.answered_by_burst = 0
        self.answered_by_robot = 0
        self.duplicates = 0
        self.failures: Counter[str] = Counter()
        self.payload_bytes_max = 0
        self._random = random
        self._samples: dict[str, _ReservoirSample] = {}
        self._recent_round_trips_s: deque[float] = deque(maxlen=RECENT_ROUND_TRIPS)

    def add(self, quantity: str, value: float | None) -> None:
        """Add a measured value of *quantity*, such as ``queue_ms``, to its sample; None is ignored."""
        if value is not None:
            self._samples.setdefault(quantity, _ReservoirSample()).add(value, self._random)

    def add_payload(self, size_bytes: int) -> None:
        """Record the size of the message of one command, for its median and its maximum."""
        self.payload_bytes_max = max(self.payload_bytes_max, size_bytes)
        self.add("payload_bytes", size_bytes)

    def add_round_trip(self, round_trip_s: float) -> None:
        """Record the round trip of a command to a server; for an expired command, how long it waited."""
        self._recent_round_trips_s.append(round_trip_s)

    def expected_round_trip_s(self) -> float | None:
        """Return the 95th percentile of the last 32 round trips in seconds, None before the first."""
        return _percentile(sorted(self._recent_round_trips_s), 0.95)

    def percentile(self, quantity: str, share: float) -> float | None:
        """Return a percentile of *quantity* by nearest rank, None without a value; *share* is in 0..1."""
        return _percentile(self._sorted_values(quantity), share)

    def percentiles(self, quantity: str) -> Percentiles:
        """Return the 50th, 95th and 99th percentile of *quantity*."""
        values = self._sorted_values(quantity)
        return Percentiles(
            p50=_percentile(values, 0.5), p95=_percentile(values, 0.95), p99=_percentile(values, 0.99)
        )

    def _sorted_values(self, quantity: str) -> list[float]:
        return sorted(self._samples[quantity].values) if quantity in self._samples else []


class _ReservoirSample:
    """Draw a uniform sample from a stream of values in bounded memory (Vitter 1985, algorithm R)."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._seen = 0

    def add(self, value: float, random: Random) -> None:
        self._seen += 1
        if len(self.values) < SAMPLE_SIZE:
            self.values.append(value)
            return
        index = random.randrange(self._seen)
        if index < SAMPLE_SIZE:
            self.values[index] = value


def _percentile(ascending: Sequence[float], share: float) -> float | None:
    """Return the value at rank ``ceil(share * n)`` of *ascending*, None if it is empty."""
    return ascending[max(0, math.ceil(share * len(ascending)) - 1)] if ascending else None
