"""Close the connections of robots that sent no Hello in time, or no message for too long.

The limits are ``session.hello_timeout_s`` for the Hello, and ping interval plus ping timeout for messages.

1. At each tick, at most `_MAX_TICK_S` apart, the connections whose limit has passed become suspects.
2. The next tick comes `_READ_S` later.  The event loop reads the sockets before it, and a suspect that has
   sent nothing meanwhile is closed.
3. If a tick is at least `_STOPPED_S` late, the process was stopped.  This delay is added to the limits of all
   connections, because only the silence of a robot counts.

Time is an argument: there is no clock and no event loop here.
"""

from __future__ import annotations

from collections.abc import Iterable

from rse_pf.config import SessionSettings
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_PROTOCOL

__all__ = ["IdleTimeouts", "max_silence_s"]

_MAX_TICK_S = 0.25  # longest time between two ticks, in seconds: a small part of the usual limits
_TICKS_PER_LIMIT = 4  # smallest number of ticks within the Hello timeout, which may be short
# Seconds from a tick with suspects to the next tick: the event loop reads its sockets in between.
_READ_S = 0.001
_STOPPED_S = 1.0  # seconds: work does not delay a tick by so much, so the process was stopped or swapped out


def max_silence_s(settings: SessionSettings) -> float:
    """Return the seconds for which a robot may send no message: ping interval plus ping timeout."""
    return settings.ping_interval_s + settings.ping_timeout_s


class IdleTimeouts:
    """Closes the idle connections of one worker, at ticks that its dispatcher calls."""

    def __init__(self, settings: SessionSettings, now: float) -> None:
        self._hello_s = settings.hello_timeout_s
        self._max_silence_s = max_silence_s(settings)
        self._tick_s = min(_MAX_TICK_S, settings.hello_timeout_s / _TICKS_PER_LIMIT)
        self._next_s = now + self._tick_s
        self._suspects: set[RobotConnection] = set()

    def until_tick_s(self, now: float) -> float:
        """Return the seconds from *now* until the next tick is due; negative if the tick is late."""
        return self._next_s - now

    def close_idle(self, connections: Iterable[RobotConnection], now: float) -> None:
        """Close the connections that were idle at the last tick and still are at *now* (s): one tick.

        Connections without a session (echo), and those that are closing, are left out.
        """
        late_s = now - self._next_s
        suspects: set[RobotConnection] = set()
        for connection in list(connections):
            if connection.session is None or connection.is_closing:
                continue
            if late_s >= _STOPPED_S:
                connection.last_message_s = min(now, connection.last_message_s + late_s)
                connection.opened_s = min(now, connection.opened_s + late_s)
            is_opening = connection.is_opening
            idle_s = now - (connection.opened_s if is_opening else connection.last_message_s)
            if idle_s < (self._hello_s if is_opening else self._max_silence_s):
                continue
            if connection not in self._suspects:
                suspects.add(connection)
            elif is_opening:
                connection.close(CLOSE_PROTOCOL, "no-hello")
            else:
                connection.close(CLOSE_GOING_AWAY, "silent")
        self._suspects = suspects
        self._next_s = now + (_READ_S if suspects else self._tick_s)
