"""Offset between a robot's clock and a server's, and the two one-way delays of the paper's Sect. 3.3.

The caller passes all timestamps; this module reads no clock.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

__all__ = ["ClockOffset", "Exchange"]


@dataclass(frozen=True, slots=True)
class Exchange:
    """The four timestamps of a ping and its pong, in seconds.

    ``sent_s`` and ``returned_s`` are readings of the robot's clock, when it sent the ping and received the
    pong; ``received_s`` and ``answered_s`` are readings of the server's clock.
    """

    sent_s: float
    received_s: float
    answered_s: float
    returned_s: float

    @property
    def is_plausible(self) -> bool:
        """Whether all timestamps are finite and neither clock ran backwards between its two timestamps."""
        return (
            math.isfinite(self.sent_s + self.received_s + self.answered_s + self.returned_s)
            and self.sent_s <= self.returned_s
            and self.received_s <= self.answered_s
        )

    @property
    def round_trip_s(self) -> float:
        """The seconds on the network, both directions together, without the time in the server."""
        return max(0.0, (self.returned_s - self.sent_s) - (self.answered_s - self.received_s))

    @property
    def offset_s(self) -> float:
        """Server clock minus robot clock in seconds, as if both directions had taken equally long."""
        return ((self.received_s - self.sent_s) + (self.answered_s - self.returned_s)) / 2


class ClockOffset:
    """Estimates the clock offset by the exchange with the shortest round trip among the last *window*.

    This exchange waited least in queues, so the times of its two directions differ least.

    Source:
        Mills, RFC 5905 (NTP), Sect. 10: the clock filter.
    """

    def __init__(self, window: int = 8) -> None:
        self._window: deque[Exchange] = deque(maxlen=window)

    def add(self, exchange: Exchange) -> None:
        """Add *exchange*; the oldest one leaves the window if it is full."""
        self._window.append(exchange)

    @property
    def offset_s(self) -> float | None:
        """Server clock minus robot clock in seconds, None before the first exchange."""
        return self._best.offset_s if self._window else None

    def split_s(
        self, sent_s: float, received_s: float, answered_s: float, returned_s: float
    ) -> tuple[float, float] | tuple[None, None]:
        """Return the one-way delays (s) of a command and of its answer, computed with `offset_s`.

        The arguments are timestamps as in `Exchange`, of the command and its answer.  A delay that would be
        negative, because of the error of the offset, is returned as 0, and the other as the whole time on
        the network.  Both are None without an offset, or if ``received_s`` and ``answered_s`` are not times
        of a server.
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
