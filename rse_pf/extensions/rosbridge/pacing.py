"""Decide when the next message of a topic may be sent to a client, from how it answers WebSocket pings.

A client answers a ping after it has read everything before it, so that its pong also acknowledges what waits
in the buffers of kernels and proxies.  Times go in, decisions come out: there is no socket and no clock here.
A client that answers in time is sent messages freely, with one ping on its way.  To a client that does not,
and to a new one, each message is sent only after a pong, and pauses that grow with late pongs and shrink with
prompt ones bring the rate down to what the client reads.
"""

from __future__ import annotations

__all__ = ["Pacing"]

FIRST_PAUSE_S = 0.02  # to a new client: after seven prompt pongs it is known to read
NO_PAUSE_S = 0.005  # a pause below this is none
SHRINKING = 0.8  # of the pause with each prompt pong: one of 0.5 s is over after 2 s
LATE_SHARE = 0.5  # of a late pong's delay is the next pause: what the client buffers is read meanwhile
SLACK_S = 0.1  # a pong later than this and twice the best round trip is late


class Pacing:
    """The pacing of one client; times are in seconds of a monotonic clock."""

    def __init__(self) -> None:
        self.is_slow = False
        """Whether the client was late with its last pong, or is now."""
        self._pause_s = FIRST_PAUSE_S
        self._next_s = float("-inf")
        self._best_s = float("inf")

    @property
    def is_free(self) -> bool:
        """Whether messages are sent without a ping before each of them."""
        return self._pause_s == 0.0

    @property
    def late_s(self) -> float:
        """After this time without a pong, the client is slow."""
        return SLACK_S + (2 * self._best_s if self._best_s < float("inf") else SLACK_S)

    def wait_s(self, now: float) -> float:
        """Return the seconds until the next message may be prepared by a ping."""
        return max(0.0, self._next_s - now)

    def note_late(self) -> None:
        """Note that a pong has not come within `late_s`."""
        self.is_slow = True

    def note_pong(self, delay_s: float, now: float) -> None:
        """Note a pong, which came *delay_s* after its ping, at *now*."""
        self.is_slow = delay_s > self.late_s
        self._best_s = min(self._best_s, delay_s)
        if self.is_slow:
            self._pause_s = max(self._pause_s, LATE_SHARE * delay_s)
        else:
            self._pause_s *= SHRINKING
            if self._pause_s < NO_PAUSE_S:
                self._pause_s = 0.0
        self._next_s = now + self._pause_s
