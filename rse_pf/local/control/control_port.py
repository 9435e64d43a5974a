"""Serve the pages and operations of a local control plane over HTTP on loopback (`rse_pf.http.control_port`).

``GET /status`` is JSON, ``GET /metrics`` is for Prometheus; ``POST /drain?server=NAME`` and ``POST /roll``
are answered with the events of the operation, one JSON object a line, until it is over; ``GET /watch`` with
all events and states, in the same form, until the connection closes.  Every request needs the token of the
control ports, and none may come from a web page.  A slow or malformed request closes its own connection only.
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
"""A function that returns the media type and the body of a page; called for each request."""
Operation = Callable[[Mapping[str, str]], AsyncGenerator[Mapping[str, Any], None]]
"""A function that begins an operation with the query parameters of the request, and returns its events.

It raises RsePfError if it refuses; the reply is then 409 with code, message and hint.  An operation for GET
(a stream) changes nothing, and its events continue until the connection closes.
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
    """Listen on loopback, and answer requests by their path: pages and streams by GET, operations by POST.

    A request without the token gets 401, one from a web page 403, another path 404, and another method 405.

    Args:
        pages: Function that makes each page, by path.
        operations: Function that begins each operation, by path.
        token: Token that every request must carry as its bearer.
        streams: Functions that begin a stream of events, by path; None means no streams.
        port: Port to listen on; 0 takes a free one.
        first_request_s: Seconds after which a connection whose first request is incomplete is closed.

    Raises:
        OSError: Another program listens on *port*.
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
    """Return the reply that streams the events of *operation*, or 409 with the error if it refuses."""
    try:
        events = operation(query)
    except RsePfError as error:
        return json_reply({"code": error.code, "message": error.message, "hint": error.hint}, status=409)
    return ControlReply(content_type="application/jsonl", events=events)
