"""The port of the control plane on loopback: its state, its metrics, and the operations of an operator.

``GET /status`` is JSON, ``GET /metrics`` is for Prometheus; ``POST /drain?server=NAME`` and ``POST /roll``
are answered with the events of the operation, one JSON object a line, until it is over; ``GET /watch`` with
what happens, in the same form, until the connection ends.  Every request needs the token of the control
ports, and none may come from a web page.  A slow or malformed request ends its own connection only.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from rse_pf.auth.control_token import carries_token
from rse_pf.errors import RsePfError
from rse_pf.silent_connections import BACKLOG, SilentConnections

__all__ = ["METRICS_TYPE", "Page", "serve_control_port"]

METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
Page = Callable[[], Awaitable[tuple[str, bytes]]]
"""Returns the media type and the body of a page."""
Operation = Callable[[Mapping[str, str]], AsyncGenerator[Mapping[str, Any], None]]
"""Begins an operation with the parameters of the request, and returns its events; raises RsePfError.

One that is asked with GET changes nothing, and goes on until the connection ends.
"""

_LOOPBACK = "127.0.0.1"
_TIMEOUT_S = 5.0
_MAX_HEAD_BYTES = 16384


async def serve_control_port(
    pages: Mapping[str, Page],
    operations: Mapping[str, Operation],
    token: str,
    *,
    streams: Mapping[str, Operation] | None = None,
    port: int = 0,
    first_request_s: float = _TIMEOUT_S,
) -> asyncio.Server:
    """Listen on loopback; *pages* are asked with GET, *operations* with POST, by their paths.

    Args:
        pages: What is shown.
        operations: What is done.
        token: That every request must carry.
        streams: What is told for as long as somebody listens; asked with GET.
        port: 0 takes a free one.
        first_request_s: A connection whose request is not complete by then is cut.

    Raises:
        OSError: Something else listens on *port*.
    """

    silent: SilentConnections[asyncio.StreamWriter] = SilentConnections(
        call_later=asyncio.get_running_loop().call_later, seconds=first_request_s
    )

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        silent.enter(writer, writer.transport.abort)
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            silent.leave(writer)
            await _answer(writer, head.decode("latin-1"), pages, operations, streams or {}, token)
        except (OSError, ValueError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            pass  # see above
        finally:
            silent.leave(writer)
            writer.close()

    return await asyncio.start_server(talk, _LOOPBACK, port, limit=_MAX_HEAD_BYTES, backlog=BACKLOG)


async def _answer(
    writer: asyncio.StreamWriter,
    head: str,
    pages: Mapping[str, Page],
    operations: Mapping[str, Operation],
    streams: Mapping[str, Operation],
    token: str,
) -> None:
    request, *lines = head.split("\r\n")
    method, target, _ = request.split(" ")
    headers = {
        name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)
    }
    url = urlsplit(target)
    if not carries_token(headers.get("authorization", ""), token):
        await _send(writer, "401 Unauthorized\r\nWWW-Authenticate: Bearer", _json({"code": "unauthorized"}))
    elif "origin" in headers:
        await _send(writer, "403 Forbidden", _json({"code": "forbidden"}))
    elif method == "GET" and target in pages:
        kind, body = await pages[target]()
        await _send(writer, "200 OK", body, kind)
    elif method == "POST" and url.path in operations:
        await _operate(writer, operations[url.path], dict(parse_qsl(url.query)))
    elif method == "GET" and url.path in streams:
        await _operate(writer, streams[url.path], dict(parse_qsl(url.query)))
    elif target in pages or url.path in operations or url.path in streams:
        await _send(writer, "405 Method Not Allowed", _json({"code": "method"}))
    else:
        await _send(writer, "404 Not Found", _json({"code": "not-found"}))


async def _operate(writer: asyncio.StreamWriter, operation: Operation, query: Mapping[str, str]) -> None:
    try:
        events = operation(query)
    except RsePfError as error:
        document = {"code": error.code, "message": error.message, "hint": error.hint}
        await _send(writer, "409 Conflict", _json(document))
        return
    head = "HTTP/1.1 200 OK\r\nContent-Type: application/jsonl\r\nCache-Control: no-store\r\n"
    writer.write(f"{head}Connection: close\r\n\r\n".encode())
    async with contextlib.aclosing(events):
        async for event in events:
            writer.write(_json(event))
            await asyncio.wait_for(writer.drain(), _TIMEOUT_S)


async def _send(
    writer: asyncio.StreamWriter, status: str, body: bytes, kind: str = "application/json"
) -> None:
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    writer.write(head.encode() + body)
    await asyncio.wait_for(writer.drain(), _TIMEOUT_S)


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, default=str).encode() + b"\n"
