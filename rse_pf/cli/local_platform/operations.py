"""Request an operation, drain or roll, of a platform's control plane, and follow its events to the end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from rse_pf.auth.control_token import read_control_token
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.local.processes import is_alive
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.state import PlatformState

__all__ = ["operate"]

# Longest time without an event, in seconds, before the control plane counts as lost: longer than a server
# takes to start, or to drain.
_SILENCE_S = 300.0
# Name of the last event of an operation that succeeded.
_OVER = "operation-over"
# Name of the last event of an operation that failed.
_FAILED = "operation-failed"


def operate(
    state: PlatformState, action: str, take: Callable[[Mapping[str, Any]], None], **parameters: str
) -> None:
    """Have the control plane carry out *action*, and call *take* with each event until it is done.

    Args:
        state: The platform's state.
        action: Name of the operation: ``drain`` or ``roll``.
        take: Called with each event of the platform meanwhile.
        parameters: Parameters of the operation, such as ``server``.

    Raises:
        UsageError: The control plane does not run, or refuses the operation.
        CommandFailed: The operation failed, or the control plane exited or did not answer meanwhile.
    """
    if not is_alive(state.control_plane) or not state.status_port:
        raise UsageError(
            f"the control plane of platform {state.name!r} does not run",
            hint=f"start one, which takes over the servers that run: rse-pf local --name {state.name}",
        )
    port = ControlPort(state.status_port, read_control_token(Path(state.control_token_file)))
    last: Mapping[str, Any] = {}

    async def follow() -> None:
        nonlocal last
        async for event in port.follow(f"/{action}?{urlencode(parameters)}", silence_s=_SILENCE_S):
            last = event
            take(event)

    try:
        asyncio.run(follow())
    except ConnectionError as error:
        raise CommandFailed(
            f"the control plane does not answer: {error}", hint="see rse-pf local status"
        ) from error
    if last.get("event") == _FAILED:
        raise CommandFailed(f"{action} failed: {last['message']}", hint=str(last["hint"]))
    if last.get("event") != _OVER:
        raise CommandFailed(
            f"the control plane ended before {action} was over", hint="see rse-pf local status and logs"
        )
