"""Measure CPU time and memory of the most expensive input of a fuzz target.

CPU time of the thread is measured, not elapsed time, and an expensive call is repeated before it counts, so
that a pause of the machine is not taken for cost.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

__all__ = ["BARS", "MAX_MIB", "MAX_MS", "Meter"]

MAX_MS = 10.0  # largest CPU time of one message of a robot
MAX_MIB = 2.0  # largest memory of one message of a robot
BARS = {
    "codec": (MAX_MS, MAX_MIB),
    "snapshots": (MAX_MS, 16.0),
    "maps": (100.0, 64.0),
    "live": (MAX_MS, MAX_MIB),
}
"""Limits of CPU time (ms) and memory (MiB) of one input, for the targets whose input a robot sends."""

_TRACED_FROM_MS = 0.5
"""Shortest CPU time of a call whose memory is measured: a shorter call cannot allocate 2 MiB."""
_TRIES = 3  # number of repetitions of an expensive call, of which the shortest counts


@dataclass(slots=True)
class Meter:
    """Keeps the largest CPU time and memory of many calls, with the inputs that caused them."""

    calls: int = 0
    worst_ms: float = 0.0
    worst_mib: float = 0.0
    slowest: bytes = b""
    largest: bytes = b""
    refusals: dict[str, int] = field(default_factory=dict)

    def call(self, function: Callable[[bytes], Any], data: bytes, allowed: type[Exception]) -> Any:
        """Measure ``function(data)``, and return its result, or None if it raised an *allowed* error.

        Raises:
            Exception: Any other exception that *function* raised.
        """
        self.calls += 1
        took_ms, answer, refusal = _timed(function, data, allowed)
        if refusal:
            self.refusals[refusal] = self.refusals.get(refusal, 0) + 1
        if took_ms > self.worst_ms:
            took_ms = min([took_ms, *(_timed(function, data, allowed)[0] for _ in range(_TRIES))])
            if took_ms > self.worst_ms:
                self.worst_ms, self.slowest = took_ms, data
        if took_ms > _TRACED_FROM_MS:
            mib = _peak_mib(function, data, allowed)
            if mib > self.worst_mib:
                self.worst_mib, self.largest = mib, data
        return answer

    def line(self) -> str:
        """Return the largest CPU time and memory, with their inputs, as one line of text."""
        refused = ", ".join(f"{code} {count}" for code, count in sorted(self.refusals.items())) or "nothing"
        return (
            f"{self.calls} calls; slowest {self.worst_ms:.2f} ms ({len(self.slowest)} bytes, "
            f"{self.slowest[:24]!r}...); most memory {self.worst_mib:.2f} MiB "
            f"({len(self.largest)} bytes, {self.largest[:24]!r}...); refused: {refused}"
        )


def _timed(function: Callable[[bytes], Any], data: bytes, allowed: type[Exception]) -> tuple[float, Any, str]:
    answer, refusal = None, ""
    begin = time.thread_time()
    try:
        answer = function(data)
    except allowed as error:
        refusal = str(getattr(error, "code", type(error).__name__))
    return (time.thread_time() - begin) * 1e3, answer, refusal


def _peak_mib(function: Callable[[bytes], Any], data: bytes, allowed: type[Exception]) -> float:
    tracemalloc.start()
    try:
        _timed(function, data, allowed)
        return tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
