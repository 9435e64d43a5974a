"""Decide when the next message of a topic may be sent to a client, by its answers to WebSocket pings.

A client answers a ping after it has read everything before the ping, so that the pong acknowledges all
earlier messages, also those in buffers of kernels and proxies.  To a client that answers in time, messages
are sent without waiting, with at most one ping on its way.  To a client that answers late, and to a new
client, each message is sent only after a pong and a pause.  The pause grows with each late pong and shrinks
with each prompt one, so that the rate approaches the rate at which the client reads.  The class is given all
times, and uses no socket and no clock.
"""

from __future__ import annotations

__all__ = ["Pacing"]

FIRST_PAUSE_S = 0.02  # pause (s) between messages to a new client; it is over after seven prompt pongs
NO_PAUSE_S = 0.005  # a pause that has shrunk below this time (s) becomes 0: messages are sent without waiting
SHRINKING = 0.8  # factor of the pause after each prompt pong: a pause of 0.5 s is over after about 2 s
LATE_SHARE = 0.5  # the pause becomes at least this fraction of a late pong's delay, in which the client reads
# A pong is late if it takes longer than this time (s) plus twice the shortest round trip.
PONG_TOLERANCE_S = 0.1


class Pacing:
    """The pacing of the messages to one client; times are seconds of a monotonic clock."""

    def __init__(self) -> None:
        self.is_slow = False
        """Whether the client's last pong was late, or the present one is."""
        self._pause_s = FIRST_PAUSE_S
        self._next_s = float("-inf")
        self._best_s = float("inf")

    @property
    def is_free(self) -> bool:
        """Whether messages are sent without waiting for a pong before each of them."""
        return self._pause_s == 0.0

    @property
    def late_s(self) -> float:
        """The time after a ping, in seconds, from which its pong is late: 0.2 s before the first pong."""
        return PONG_TOLERANCE_S + (2 * self._best_s if self._best_s < float("inf") else PONG_TOLERANCE_S)

    def wait_s(self, now: float) -> float:
        """Return the seconds until the ping before the next message may be sent.

        The result is 0 if the ping may be sent at *now*.
        """
        return max(0.0, self._next_s - now)

    def note_late(self) -> None:
        """Record that a pong has not arrived within `late_s`."""
        self.is_slow = True

    def note_pong(self, delay_s: float, now: float) -> None:
        """Record a pong that arrived at *now*, *delay_s* after its ping, and adapt the pause."""
        self.is_slow = delay_s > self.late_s
        self._best_s = min(self._best_s, delay_s)
        if self.is_slow:
            self._pause_s = max(self._pause_s, LATE_SHARE * delay_s)
        else:
            self._pause_s *= SHRINKING
            if self._pause_s < NO_PAUSE_S:
                self._pause_s = 0.0
        self._next_s = now + self._pause_s
