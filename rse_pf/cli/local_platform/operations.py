"""The actions drain and roll: ask the control plane, and show what it does until it is done."""

from __future__ import annotations

import http.client
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.local.processes import is_alive
from rse_pf.local.state import PlatformState

__all__ = ["operate"]

_LOOPBACK = "127.0.0.1"
_SILENCE_S = 300.0
"""Longer than a server takes to start, and a drain to end."""
_OVER, _FAILED = "operation-over", "operation-failed"


def operate(
    state: PlatformState, action: str, take: Callable[[Mapping[str, Any]], None], **parameters: str
) -> None:
    """Let the control plane do *action*, and give every event to *take* until it is done.

    Raises:
        UsageError: The control plane does not run, or refuses.
        CommandFailed: The operation failed, or the control plane ended meanwhile.
    """
    if not is_alive(state.control_plane) or not state.status_port:
        raise UsageError(
            f"the control plane of platform {state.name!r} does not run",
            hint=f"start it, it takes over what runs: rse-pf local --name {state.name}",
        )
    last: Mapping[str, Any] = {}
    for event in _events(state, f"/{action}?{urlencode(parameters)}"):
        last = event
        take(event)
    if last.get("event") == _FAILED:
        raise CommandFailed(f"{action} failed: {last['message']}", hint=str(last["hint"]))
    if last.get("event") != _OVER:
        raise CommandFailed(
            f"the control plane ended before {action} was over", hint="see rse-pf local status and logs"
        )


def _events(state: PlatformState, target: str) -> Iterator[Mapping[str, Any]]:
    connection = http.client.HTTPConnection(_LOOPBACK, state.status_port, timeout=_SILENCE_S)
    token = read_control_token(Path(state.control_token_file))
    try:
        connection.request("POST", target, headers={"Authorization": bearer(token)})
        reply = connection.getresponse()
        if reply.status != 200:
            document = json.loads(reply.read())
            raise UsageError(
                str(document.get("message", f"the control plane answers {reply.status}")),
                hint=str(document.get("hint", "is it of this version?")),
            )
        for line in reply:
            yield json.loads(line)
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise CommandFailed(
            f"the control plane does not answer: {error}", hint="see rse-pf local status"
        ) from error
    finally:
        connection.close()
