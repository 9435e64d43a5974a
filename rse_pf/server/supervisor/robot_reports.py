"""Report robots from a worker to its supervisor: events of single robots, and a list for operators.

To wake the supervisor costs more CPU time than to handle an event, so several events are sent in one message.
Their order is kept, and none is lost.  A row of the list has no payload, no token and no address.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable
from typing import Any

from rse_pf.server.gateway.connection import RobotConnection

__all__ = ["MAX_ROBOT_ROWS", "RobotEvents", "robot_rows"]

MAX_ROBOT_ROWS = 500  # in one message, so that it stays below the 1 MiB that a line of the channel may have
_GATHER_S = 0.01  # an event waits this long for others
_MAX_EVENTS = 500  # in one message, so that it stays below the 1 MiB that a line of the channel may have


class RobotEvents:
    """The events of the robots of one worker that wait to be sent."""

    def __init__(self, loop: AbstractEventLoop, send: Callable[..., None]) -> None:
        """Hold no event yet; *send* sends a message to the supervisor."""
        self._loop = loop
        self._send = send
        self._held: list[dict[str, Any]] = []

    def add(self, **event: Any) -> None:
        """Send *event* together with those that follow within `_GATHER_S`."""
        if not self._held:
            self._loop.call_later(_GATHER_S, self.flush)
        self._held.append(event)

    def flush(self) -> None:
        """Send the waiting events now."""
        held, self._held = self._held, []
        for first in range(0, len(held), _MAX_EVENTS):
            self._send(event="robots", robots=held[first : first + _MAX_EVENTS])


def robot_rows(connections: Iterable[RobotConnection], now: float) -> list[dict[str, Any]]:
    """Return a row for each robot that an operator sees, by tenant and name, as plain JSON values.

    Args:
        connections: The connections of the worker.
        now: Monotonic seconds; ``connected_s`` is the age of the connection at that time.
    """
    rows = [
        {
            "robot": connection.robot.name,
            "tenant": connection.robot.tenant,
            "codec": connection.session.codec.name,
            "connected_s": round(now - connection.opened_s, 3),
            "commands": connection.commands,
            "last_result": connection.last_result,
        }
        for connection in connections
        if connection.session is not None and connection.is_shown and not connection.is_closing
    ]
    return sorted(rows, key=lambda row: (row["tenant"], row["robot"]))
