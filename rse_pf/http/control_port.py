"""Serve control ports: a very small HTTP/1.1 server for health checks, metrics, drain and other operations.

A request has a head of at most 8 KiB, and a body of at most 64 KiB that is not chunked.  The first request of
a connection must be complete within `FIRST_REQUEST_S`, and each later one within `KEEP_ALIVE_S` after the
previous reply.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from rse_pf.http.unauthenticated import BACKLOG, FIRST_REQUEST_S, KEEP_ALIVE_S, SilentConnections

__all__ = ["ControlReply", "ControlRequest", "json_reply", "number_of", "refused_reply", "serve_control"]

_MAX_HEAD_BYTES = 8192  # largest head of a request
_MAX_BODY_BYTES = 65536  # largest body of a request, which is read and ignored
_WRITE_S = 5.0
"""Seconds after which the connection of a client that does not read a reply, or an event, is closed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlRequest:
    """One request to a control port.

    ``method`` is GET for a HEAD request.  ``is_local`` is whether the request came from this machine and not
    from a web page (it has no header Origin).  ``authorization`` is the header's value, "" if absent.
    """

    method: str
    path: str
    query: Mapping[str, str]
    is_local: bool
    authorization: str = field(default="", repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlReply:
    """One reply of a control port: *body*, or *events*.

    Each of the *events* is sent as one line of JSON; after the last one the connection is closed.
    """

    status: int = 200
    body: bytes = b""
    content_type: str = "application/json"
    headers: Mapping[str, str] = field(default_factory=dict)
    events: AsyncGenerator[Mapping[str, Any], None] | None = None


def json_reply(value: Any, *, status: int = 200, headers: dict[str, str] | None = None) -> ControlReply:
    """Return a reply with *value* as one line of JSON."""
    return ControlReply(status=status, body=_line(value), headers=headers or {})


def refused_reply(status: int, code: str, hint: str) -> ControlReply:
    """Return a reply with the HTTP *status* that refuses a request: a stable code, and what to do."""
    return json_reply({"code": code, "hint": hint}, status=status)


def number_of(ask: ControlRequest, name: str, default: float, maximum: float) -> float:
    """Return the number in the query parameter *name* of a request, *default* if it is absent.

    Raises:
        ValueError: The parameter is no number from 0 to *maximum*.
    """
    value = float(ask.query.get(name, default))
    if not 0 <= value <= maximum:
        raise ValueError(name)
    return value


async def serve_control(
    host: str,
    port: int,
    answer: Callable[[ControlRequest], Awaitable[ControlReply]],
    *,
    first_request_s: float = FIRST_REQUEST_S,
) -> asyncio.Server:
    """Listen on *host* and *port* (0 takes a free port), and answer each request by *answer*.

    A connection whose first request is not complete after *first_request_s* seconds is closed.
    """
    silent: SilentConnections[asyncio.StreamWriter] = SilentConnections(
        call_later=asyncio.get_running_loop().call_later, seconds=first_request_s
    )
    idle: SilentConnections[asyncio.StreamWriter] = SilentConnections(
        call_later=asyncio.get_running_loop().call_later, seconds=KEEP_ALIVE_S
    )

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        silent.enter(writer, writer.transport.abort)

        async def answer_in_time(ask: ControlRequest) -> ControlReply:
            silent.leave(writer)
            idle.leave(writer)
            return await answer(ask)

        try:
            while await _exchange(reader, writer, answer_in_time):
                idle.enter(writer, writer.transport.abort)
        except (
            OSError,
            ValueError,
            EOFError,
            asyncio.LimitOverrunError,
            asyncio.TimeoutError,
            asyncio.CancelledError,
        ):
            # A malformed request closes its own connection only.  A cancellation is not raised again, because
            # asyncio would log an error for each open connection when the event loop ends.
            pass
        finally:
            silent.leave(writer)
            idle.leave(writer)
            writer.close()

    return await asyncio.start_server(talk, host, port, limit=_MAX_HEAD_BYTES, backlog=BACKLOG)


async def _exchange(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    answer: Callable[[ControlRequest], Awaitable[ControlReply]],
) -> bool:
    """Read one request and send the reply of *answer*; return whether the connection is kept for another.

    Raises:
        ValueError: The request is malformed.
        EOFError: The client has closed the connection.
        TimeoutError: The client did not read the reply within `_WRITE_S`.
    """
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    request_line, *lines = head.rstrip("\r\n").split("\r\n")
    method, target, version = request_line.split(" ")
    headers = {
        name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)
    }
    length = int(headers.get("content-length", "0"))
    if "transfer-encoding" in headers or not 0 <= length <= _MAX_BODY_BYTES:
        _write(writer, method, ControlReply(status=413), keep=False)
        return False
    await reader.readexactly(length)
    url = urlsplit(target)
    peer = writer.get_extra_info("peername")[0]
    ask = ControlRequest(
        method="GET" if method == "HEAD" else method,
        path=url.path,
        query=dict(parse_qsl(url.query)),
        is_local=ipaddress.ip_address(peer.partition("%")[0]).is_loopback and "origin" not in headers,
        authorization=headers.get("authorization", ""),
    )
    keep = version == "HTTP/1.1" and headers.get("connection", "").lower() != "close"
    reply = await answer(ask)
    _write(writer, method, reply, keep=keep and reply.events is None)
    if reply.events is not None:
        async with contextlib.aclosing(reply.events) as events:
            async for event in events:
                writer.write(_line(event))
                await asyncio.wait_for(writer.drain(), _WRITE_S)
        return False
    await asyncio.wait_for(writer.drain(), _WRITE_S)
    return keep


def _write(writer: asyncio.StreamWriter, method: str, answer: ControlReply, *, keep: bool) -> None:
    headers = {
        "Content-Type": answer.content_type,
        **({} if answer.events is not None else {"Content-Length": str(len(answer.body))}),
        "Cache-Control": "no-store",
        "Connection": "keep-alive" if keep else "close",
        **answer.headers,
    }
    lines = [f"HTTP/1.1 {answer.status} {HTTPStatus(answer.status).phrase}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    body = b"" if method == "HEAD" else answer.body
    writer.write("\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + body)


def _line(value: Any) -> bytes:
    return json.dumps(value, default=str).encode() + b"\n"
