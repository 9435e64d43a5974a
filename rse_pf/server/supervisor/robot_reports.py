"""Report robots from a worker to its supervisor: events of single robots, and a list for operators.

Waking the supervisor costs more CPU time than handling an event, so the events of `_GATHER_S` are sent in one
message, in their order.  A row of the list contains no payload, no token and no address.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable
from typing import Any

from rse_pf.server.gateway.connection import RobotConnection

__all__ = ["MAX_ROBOT_ROWS", "RobotEvents", "robot_rows"]

MAX_ROBOT_ROWS = 500  # rows of robots in one message to the supervisor, which may have 1 MiB
_GATHER_S = 0.01  # seconds for which an event waits for others that are sent in the same message
_MAX_EVENTS = 500  # events in one message to the supervisor, which may have 1 MiB


class RobotEvents:
    """Collects the events of one worker's robots, and sends them to the supervisor in batches."""

    def __init__(self, loop: AbstractEventLoop, send: Callable[..., None]) -> None:
        """Hold no event yet; *send* sends its keyword arguments as a message to the supervisor."""
        self._loop = loop
        self._send = send
        self._held: list[dict[str, Any]] = []

    def add(self, **event: Any) -> None:
        """Send *event* within `_GATHER_S`, in one message with the events that are added until then."""
        if not self._held:
            self._loop.call_later(_GATHER_S, self.flush)
        self._held.append(event)

    def flush(self) -> None:
        """Send the waiting events now."""
        held, self._held = self._held, []
        for first in range(0, len(held), _MAX_EVENTS):
            self._send(event="robots", robots=held[first : first + _MAX_EVENTS])


def robot_rows(connections: Iterable[RobotConnection], now: float) -> list[dict[str, Any]]:
    """Return a row for each robot that has sent its Hello and is not synthetic, sorted by tenant and name.

    Args:
        connections: The connections of the worker; those that are closing are left out.
        now: Present time, monotonic seconds; the field ``connected_s`` is the age of the connection.
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
