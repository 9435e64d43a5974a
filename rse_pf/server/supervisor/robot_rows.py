"""The robots of one worker as rows for an operator: who, since when, and what the last answer was.

Nothing of a command but the result of the last one is in a row; no token, no address.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rse_pf.server.gateway.connection import RobotConnection

__all__ = ["MAX_ROBOT_ROWS", "robot_rows"]

MAX_ROBOT_ROWS = 500
"""Told at once; all of a server's fit into one answer of its control port."""


def robot_rows(connections: Iterable[RobotConnection], now: float) -> list[dict[str, Any]]:
    """Return a row for each robot that an operator sees, by tenant and name, as plain JSON values.

    Args:
        connections: Of the worker.
        now: Seconds, monotonic; ``connected_s`` is the age of the connection at that time.
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
