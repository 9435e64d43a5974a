"""The pages and operations of the control plane on its `rse_pf.http.control_port`, on loopback.

``GET /status`` is JSON, ``GET /metrics`` is for Prometheus; ``POST /drain?server=NAME`` and ``POST /roll``
are answered with the events of the operation, one JSON object a line, until it is over; ``GET /watch`` with
all events and states, in the same form, until the connection ends.  Every request needs the token of the
control ports, and none may come from a web page.  A slow or malformed request ends its own connection only.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Any

from rse_pf.auth.control_token import carries_token
from rse_pf.errors import RsePfError
from rse_pf.http.control_port import ControlReply, ControlRequest, json_reply, serve_control
from rse_pf.http.unauthenticated import FIRST_REQUEST_S

__all__ = ["METRICS_TYPE", "Page", "serve_control_port"]

METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
Page = Callable[[], Awaitable[tuple[str, bytes]]]
"""Returns the media type and the body of a page."""
Operation = Callable[[Mapping[str, str]], AsyncGenerator[Mapping[str, Any], None]]
"""Begins an operation with the parameters of the request, and returns its events; raises RsePfError.

One that is asked with GET changes nothing, and goes on until the connection ends.
"""

_LOOPBACK = "127.0.0.1"


async def serve_control_port(
    pages: Mapping[str, Page],
    operations: Mapping[str, Operation],
    token: str,
    *,
    streams: Mapping[str, Operation] | None = None,
    port: int = 0,
    first_request_s: float = FIRST_REQUEST_S,
) -> asyncio.Server:
    """Listen on loopback; *pages* are asked with GET, *operations* with POST, by their paths.

    Args:
        pages: By path; requested with GET.
        operations: By path; requested with POST.
        token: That every request must carry.
        streams: Streams of events until the connection ends; requested with GET.
        port: 0 takes a free one.
        first_request_s: A connection whose request is not complete by then is cut.

    Raises:
        OSError: Something else listens on *port*.
    """

    async def answer(ask: ControlRequest) -> ControlReply:
        asked = {"GET": streams or {}, "POST": operations}.get(ask.method, {})
        if not carries_token(ask.authorization, token):
            return json_reply({"code": "unauthorized"}, status=401, headers={"WWW-Authenticate": "Bearer"})
        if not ask.is_local:
            return json_reply({"code": "forbidden"}, status=403)
        if ask.method == "GET" and ask.path in pages:
            kind, body = await pages[ask.path]()
            return ControlReply(body=body, content_type=kind)
        if ask.path in asked:
            return _begin(asked[ask.path], ask.query)
        if ask.path in {*pages, *operations, *(streams or {})}:
            return json_reply({"code": "method"}, status=405)
        return json_reply({"code": "not-found"}, status=404)

    return await serve_control(_LOOPBACK, port, answer, first_request_s=first_request_s)


def _begin(operation: Operation, query: Mapping[str, str]) -> ControlReply:
    try:
        events = operation(query)
    except RsePfError as error:
        return json_reply({"code": error.code, "message": error.message, "hint": error.hint}, status=409)
    return ControlReply(content_type="application/jsonl", events=events)
