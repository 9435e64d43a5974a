"""List the robots of one worker for an operator: names, time of connection, and result of the last command.

A row has no content of a command, no token and no address.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rse_pf.server.gateway.connection import RobotConnection

__all__ = ["MAX_ROBOT_ROWS", "robot_rows"]

MAX_ROBOT_ROWS = 500  # in one message, so that it stays below the 1 MiB that a line of the channel may have


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
