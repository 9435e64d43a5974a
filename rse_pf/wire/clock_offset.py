"""Offset between a robot's clock and a server's, and the two one-way delays of the paper's Sect. 3.3.

All four timestamps of an exchange are arguments.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

__all__ = ["ClockOffset", "Exchange"]


@dataclass(frozen=True, slots=True)
class Exchange:
    """One ping: robot sent, server received, server answered, robot received; seconds."""

    sent_s: float
    received_s: float
    answered_s: float
    returned_s: float

    @property
    def is_plausible(self) -> bool:
        """Whether the timestamps are finite and neither clock ran backwards."""
        return (
            math.isfinite(self.sent_s + self.received_s + self.answered_s + self.returned_s)
            and self.sent_s <= self.returned_s
            and self.received_s <= self.answered_s
        )

    @property
    def round_trip_s(self) -> float:
        """Time on the network, both ways together."""
        return max(0.0, (self.returned_s - self.sent_s) - (self.answered_s - self.received_s))

    @property
    def offset_s(self) -> float:
        """Server clock minus robot clock, if both directions take equally long."""
        return ((self.received_s - self.sent_s) + (self.answered_s - self.returned_s)) / 2


class ClockOffset:
    """The offset of the exchange with the shortest round trip among the last few.

    The shortest round trip waited least in queues, so its two directions differ least.

    Source:
        Mills, RFC 5905 (NTP), Sect. 10: the clock filter.
    """

    def __init__(self, window: int = 8) -> None:
        self._window: deque[Exchange] = deque(maxlen=window)

    def add(self, exchange: Exchange) -> None:
        """Take one exchange into account."""
        self._window.append(exchange)

    @property
    def offset_s(self) -> float | None:
        """Server clock minus robot clock, or None before the first exchange."""
        return self._best.offset_s if self._window else None

    def split_s(
        self, sent_s: float, received_s: float, answered_s: float, returned_s: float
    ) -> tuple[float, float] | tuple[None, None]:
        """Return the one-way delays of a command and its answer, by the best offset.

        A delay that the error of the offset makes negative is returned as 0; both are None without an offset
        or without the server's timestamps.
        """
        offset = self.offset_s
        if offset is None or not 0.0 < received_s <= answered_s:
            return None, None
        network = max(0.0, (returned_s - sent_s) - (answered_s - received_s))
        up = min(network, max(0.0, received_s - offset - sent_s))
        return up, network - up

    @property
    def _best(self) -> Exchange:
        return min(self._window, key=lambda exchange: exchange.round_trip_s)
