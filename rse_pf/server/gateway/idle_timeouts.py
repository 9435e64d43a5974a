"""Close idle connections: no Hello in time, or no message for longer than ping interval and ping timeout.

Only the silence of the robot counts.  Time in which the worker itself was stopped is not counted, and a
connection is closed only after its socket was read once more.  A connection is closed at the first tick after
its limit, and ticks are far shorter than ``session.ping_timeout_s``.  Time is an argument: there is no clock
and no event loop here.
"""

from __future__ import annotations

from collections.abc import Iterable

from rse_pf.config import SessionSettings
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_PROTOCOL

__all__ = ["IdleTimeouts", "max_silence_s"]

_MAX_TICK_S = 0.25  # longest time between two ticks: a small part of every limit
_TICKS_PER_LIMIT = 4  # a short Hello timeout has this many ticks
_READ_S = 0.001  # time until the second look: an event loop reads its sockets before it waits for a timer
_STOPPED_S = 1.0  # a tick this late was not delayed by work: the process was stopped, swapped out or frozen


def max_silence_s(settings: SessionSettings) -> float:
    """Return how long a robot may send nothing, in seconds: ping interval and ping timeout together."""
    return settings.ping_interval_s + settings.ping_timeout_s


class IdleTimeouts:
    """The timeouts of all connections of a worker, checked at each tick."""

    def __init__(self, settings: SessionSettings, now: float) -> None:
        self._hello_s = settings.hello_timeout_s
        self._max_silence_s = max_silence_s(settings)
        self._tick_s = min(_MAX_TICK_S, settings.hello_timeout_s / _TICKS_PER_LIMIT)
        self._next_s = now + self._tick_s
        self._suspects: set[RobotConnection] = set()

    def until_tick_s(self, now: float) -> float:
        """Return the seconds until the next tick is due; negative if it is late already."""
        return self._next_s - now

    def close_idle(self, connections: Iterable[RobotConnection], now: float) -> None:
        """Close the connections that are idle at *now* (s); call this at each tick.

        A connection that seems idle is closed at the next tick, after its socket was read once more.
        """
        late_s = now - self._next_s
        suspects: set[RobotConnection] = set()
        for connection in list(connections):
            if connection.session is None or connection.is_closing:
                continue
            if late_s >= _STOPPED_S:
                connection.last_heard_s = min(now, connection.last_heard_s + late_s)
                connection.opened_s = min(now, connection.opened_s + late_s)
            is_opening = connection.is_opening
            idle_s = now - (connection.opened_s if is_opening else connection.last_heard_s)
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
