"""When a worker gives a socket up: no Hello in time, a token that is over, or silence.

Silence is the robot's, not the worker's: what the worker slept does not count, and nobody is given up before
what the kernel holds of him was read.  A socket is so noticed within a tick of its limit, which is far below
what `session.ping_timeout_s` allows.  Promises no clock and no loop: times go in, closes come out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rse_pf.config import SessionSettings
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_PROTOCOL, CLOSE_TOKEN_OVER

if TYPE_CHECKING:
    from rse_pf.backend.gateway.connection import RobotConnection

__all__ = ["IdleTimeouts", "longest_silence_s"]

_SLOWEST_TICK_S = 0.25
_TICKS_PER_LIMIT = 4
_READING_S = 0.001
"""A loop that has a timer to wait for, however short, reads its sockets before."""
_SLEPT_S = 1.0
"""A tick that comes later than this was not late but away: stopped, swapped out, or on a frozen machine."""


def longest_silence_s(settings: SessionSettings) -> float:
    """Return how long a robot may say nothing: it pings in time, and its ping may take a while."""
    return settings.ping_interval_s + settings.ping_timeout_s


class IdleTimeouts:
    """Looks at all connections of a worker, again and again."""

    def __init__(self, settings: SessionSettings, now: float) -> None:
        self._settings = settings
        self._silence_s = longest_silence_s(settings)
        self._tick_s = min(_SLOWEST_TICK_S, settings.hello_timeout_s / _TICKS_PER_LIMIT)
        self._next_s = now + self._tick_s
        self._suspects: set[RobotConnection] = set()

    def left_s(self, now: float) -> float:
        """Return when to look again, in seconds; negative if it is late already."""
        return self._next_s - now

    def look(self, connections: Iterable[RobotConnection], now: float) -> None:
        """Close what is to be closed at *now*, and note whom to look at again once the sockets were read."""
        slept_s = now - self._next_s
        suspects: set[RobotConnection] = set()
        for connection in list(connections):
            if connection.session is None or connection.assembler.closed:
                continue
            if slept_s >= _SLEPT_S:
                connection.last_heard_s = min(now, connection.last_heard_s + slept_s)
                connection.opened_s = min(now, connection.opened_s + slept_s)
            if connection.expires_s is not None and now >= connection.expires_s:
                connection.close(CLOSE_TOKEN_OVER, "token-over")
            elif self._is_mute(connection, now):
                if connection in self._suspects:
                    _give_up(connection)
                else:
                    suspects.add(connection)
        self._suspects = suspects
        self._next_s = now + (_READING_S if suspects else self._tick_s)

    def _is_mute(self, connection: RobotConnection, now: float) -> bool:
        if connection.session is not None and connection.session.state == "opening":
            return now - connection.opened_s >= self._settings.hello_timeout_s
        return now - connection.last_heard_s >= self._silence_s


def _give_up(connection: RobotConnection) -> None:
    if connection.session is not None and connection.session.state == "opening":
        connection.close(CLOSE_PROTOCOL, "no-hello")
    else:
        connection.close(CLOSE_GOING_AWAY, "silent")
