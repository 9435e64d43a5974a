"""Decide when a worker closes an idle connection: no Hello in time, or no message for too long.

Only the robot's silence counts.  Time in which the worker itself did not run is not counted, and a connection
is closed only after the sockets were read once more.  It is noticed within one tick of its limit, which is
far below ``session.ping_timeout_s``.  Times go in and closes come out: there is no clock and no loop here.
"""

from __future__ import annotations

from collections.abc import Iterable

from rse_pf.config import SessionSettings
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_PROTOCOL

__all__ = ["IdleTimeouts", "max_silence_s"]

_MAX_TICK_S = 0.25
_TICKS_PER_LIMIT = 4
_READ_S = 0.001
"""A loop that has a timer to wait for, however short, reads its sockets before."""
_STOPPED_S = 1.0
"""A tick that is later than this was not delayed by work: the process was stopped, swapped out or frozen."""


def max_silence_s(settings: SessionSettings) -> float:
    """Return how long a robot may send nothing: its ping interval, and the time a ping may take."""
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
        """Close the connections that are idle at *now*, s; call it at each tick.

        A connection that seems idle is closed only at the next tick, after the sockets were read once more.
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
