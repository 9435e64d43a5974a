"""Read the connected robots from all servers of a platform, and format them for rse-pf local robots."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rse_pf.auth.control_token import read_control_token
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.state import PlatformState, ServerState

__all__ = ["connected_robots", "robots_table"]

# Time limit of the request to a server, in seconds.
_TIMEOUT_S = 3.0
_COLUMNS = ("robot", "tenant", "server", "codec", "connected for", "commands", "last result")
# Indices of the columns that are aligned to the right.
_RIGHT = (4, 5)
# Units in which a duration is shown, with their lengths in seconds, longest first.
_UNITS = ((86400, "d"), (3600, "h"), (60, "min"))


def connected_robots(state: PlatformState) -> dict[str, Any]:
    """Ask each server of the platform for its robots, and return them as plain JSON values.

    ``robots`` has a row for each robot that the servers name, sorted by tenant and name; ``count`` is the
    number of all connected robots, which may be larger; ``silent`` names the servers that did not answer.

    Raises:
        UsageError: The file of the control token cannot be read.
    """
    token = read_control_token(Path(state.control_token_file)) if state.control_token_file else None
    servers = [server for server in state.servers if server.control_port]
    replies = asyncio.run(_ask_all(servers, token))
    rows = [
        {**row, "server": server.name}
        for server, page in zip(servers, replies, strict=True)
        for row in (page or {}).get("robots", [])
    ]
    return {
        "robots": sorted(rows, key=lambda row: (row["tenant"], row["robot"])),
        "count": sum((page or {}).get("count", 0) for page in replies),
        "silent": [server.name for server, page in zip(servers, replies, strict=True) if page is None],
    }


def robots_table(document: Mapping[str, Any]) -> list[str]:
    """Return the result of `connected_robots` as the lines of a table."""
    rows = [_COLUMNS, *map(_row, document["robots"])]
    if not document["robots"]:
        return ["no robot is connected"]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    lines = [
        "  ".join(
            cell.rjust(width) if i in _RIGHT else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    left_out = document["count"] - len(document["robots"])
    return [*lines, *([f"and {left_out} more"] if left_out > 0 else [])]


async def _ask_all(servers: Sequence[ServerState], token: str | None) -> list[dict[str, Any] | None]:
    """Return the /robots page of each of *servers*, in their order; None for one that does not answer."""
    replies = await asyncio.gather(
        *(
            ControlPort(server.control_port, token).ask_once("/robots", timeout_s=_TIMEOUT_S)
            for server in servers
        )
    )
    return [None if reply is None or reply.status != 200 else reply.document() for reply in replies]


def _row(robot: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        str(robot["robot"]), str(robot["tenant"]), str(robot["server"]), str(robot["codec"]),
        _duration(float(robot["connected_s"])), str(robot["commands"]), str(robot["last_result"] or "-"),
    )  # fmt: skip


def _duration(seconds: float) -> str:
    for size_s, unit in _UNITS:
        if seconds >= size_s:
            return f"{seconds / size_s:.1f} {unit}"
    return f"{seconds:.0f} s"
