"""The operations that an operator starts from the page, as requests to the control plane's operator port."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from rse_pf.auth.control_token import read_control_token
from rse_pf.errors import BadRequest, Busy, CommandFailed
from rse_pf.local.processes import is_alive
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.state import read_state

__all__ = ["ACTIONS", "LocalOperations"]

ACTIONS = {
    "kill": ("server",),
    "pause": ("server",),
    "resume": ("server",),
    "drain": ("server",),
    "move": ("server", "robots"),
    "roll": (),
}
"""The operations, each with the names of its parameters."""
# Longest time without an event of a running operation, in seconds.
_SILENCE_S = 300.0
# Last event of an operation that failed.
_FAILED = "operation-failed"


class LocalOperations:
    """Executes operations of the platform whose state is in a folder."""

    def __init__(self, folder: Path) -> None:
        """Prepare operations of the platform whose state is in *folder*; nothing is requested yet."""
        self._folder = folder

    async def operate(self, action: str, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """Execute *action*, wait until it is finished, and return its last event.

        Raises:
            BadRequest: There is no such action, or a parameter is missing.
            Busy: The control plane is not running or does not answer.
            UsageError: The control plane rejected the request.
            CommandFailed: The operation failed.
        """
        if action not in ACTIONS or any(not parameters.get(name) for name in ACTIONS[action]):
            raise BadRequest(
                f"there is no action {action[:40]!r} like this", hint=f"there are {', '.join(ACTIONS)}"
            )
        state = await asyncio.to_thread(read_state, self._folder)
        if state is None or not state.status_port or not is_alive(state.control_plane):
            raise Busy("the control plane does not run", hint="start it: rse-pf local", retry_after_ms=1000)
        token = read_control_token(Path(state.control_token_file))
        query = urlencode({name: parameters[name] for name in ACTIONS[action]})
        try:
            return await self._ask(state.status_port, token, f"/{action}?{query}")
        except OSError as error:
            raise Busy(
                "the control plane does not answer", hint="see rse-pf local status", retry_after_ms=1000
            ) from error

    async def _ask(self, port: int, token: str, target: str) -> Mapping[str, Any]:
        last: Mapping[str, Any] = {}
        async for event in ControlPort(port, token).follow(target, silence_s=_SILENCE_S):
            last = event
        if last.get("event") == _FAILED:
            raise CommandFailed(str(last.get("message", "")), hint=str(last.get("hint", "")))
        return last
