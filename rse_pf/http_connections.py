"""The HTTP/1.1 protocol of services on uvicorn: one request at a time, and bounded connections.

uvicorn's own protocol waits for ever for the end of a request's head, and counts connections that sent none
against those that did.  Here both kinds are cut when there are too many, the oldest first, and never one in a
request.  `rse_pf.http_head` decides what is a request.
"""

from __future__ import annotations

import asyncio
import http
import logging
import re
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import unquote

from rse_pf.errors import MissingExtra
from rse_pf.http_head import MAX_HEAD_BYTES, BadRequestBytes, ChunkedBody, RequestHead, parse_head
from rse_pf.silent_connections import FIRST_REQUEST_S, KEEP_ALIVE_S, MAX_SILENT, SilentConnections

__all__ = ["OneRequestProtocol", "bounded_protocol"]

_MAX_BUFFERED = 1 << 18
"""Bytes of a body that wait for the application; above that nothing more is read."""
_UNSENT_HIGH, _UNSENT_LOW = 1 << 19, 1 << 18
"""Bytes of a reply that wait for the client: above the first the application waits until the second."""
_REPLY_HEAD = re.compile(
    rb"HTTP/1\.1 [1-5][0-9]{2} [ -~]*\r\n(?:[-!#$%&'*+.^_`|~0-9A-Za-z]+: [\t -~\x80-\xff]*\r\n)*\r\n"
)
_SCRATCH = memoryview(bytearray(_MAX_BUFFERED))
"""Where bytes are received, of all connections: they are taken from there at once."""
_WHOLE_FROM, _WHOLE_TO = 1 << 16, 8 << 20
"""A body between these lengths is received into one buffer; memory is taken as it comes."""
_PHRASES = {status.value: status.phrase.encode() for status in http.HTTPStatus}
_END = b"\r\n\r\n"
_REFUSAL = (
    b"HTTP/1.1 400 Bad Request\r\ncontent-type: text/plain; charset=utf-8\r\nconnection: close\r\n"
    b"content-length: 30\r\n\r\nInvalid HTTP request received."
)
_ERROR = b"Internal Server Error"
_log = logging.getLogger("uvicorn.error")


def bounded_protocol(
    *,
    seconds: float = FIRST_REQUEST_S,
    idle_s: float = KEEP_ALIVE_S,
    most: int = MAX_SILENT,
    most_idle: int,
    ends_with_client: bool = False,
) -> type[Any]:
    """Return a protocol for uvicorn with keep-alive, with bounds, and without pipelining.

    Load balancers and our own clients wait for a response before the next request.  Bytes that follow a
    request earlier than that are never taken for a request: they may be an attempt to make two readers
    disagree about where a request ends (request smuggling).  The request is answered, then the connection is
    closed.

    Args:
        seconds: Time for the head of a request, from the connection or from the head's first byte.
        idle_s: Time between an answer and the next request.
        most: Connections that have sent no whole head; above that the oldest is cut.
        most_idle: Connections that were answered and wait; above that the one that waited longest is cut.
        ends_with_client: Cancel the application when the client is gone.

    Raises:
        MissingExtra: uvicorn is not installed.
    """
    try:
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise MissingExtra("uvicorn", "data") from error
    silent, idle = _InLoop(seconds, most), _InLoop(idle_s, most_idle)

    class BoundedProtocol(OneRequestProtocol):
        def __init__(self, config: Any, server_state: Any, app_state: Any, _loop: Any = None) -> None:
            loop = _loop or asyncio.get_running_loop()
            super().__init__(
                config, server_state, loop, silent.of(loop), idle.of(loop), ends_with_client=ends_with_client
            )

    return BoundedProtocol


class OneRequestProtocol(asyncio.BufferedProtocol):
    """A connection that carries one request after the other, each after the reply to the one before."""

    def __init__(
        self,
        config: Any,
        server_state: Any,
        loop: asyncio.AbstractEventLoop,
        silent: SilentConnections[object],
        idle: SilentConnections[object],
        *,
        ends_with_client: bool,
    ) -> None:
        """Make the protocol of one connection for uvicorn's *config* and *server_state*."""
        if not config.loaded:
            config.load()
        self.loop = loop
        self.ends_with_client = ends_with_client
        self.can_write = asyncio.Event()
        self.can_write.set()
        self.transport: Any = None
        self._app = config.loaded_app
        self._most = config.limit_concurrency
        self._state = server_state
        self._silent, self._idle = silent, idle
        self._buffer = b""  # of a head that is not complete
        self._exchange: Exchange | None = None
        self._is_paused = False
        self._is_leaving = False
        self._addresses: tuple[Any, Any] = (None, None)

    # --- called by the transport ---------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count the connection as one that has sent nothing."""
        self.transport = transport
        self.transport.set_write_buffer_limits(_UNSENT_HIGH, _UNSENT_LOW)
        names = (transport.get_extra_info(name) for name in ("sockname", "peername"))
        own, peer = (tuple(name[:2]) if isinstance(name, tuple) else None for name in names)
        self._addresses = own, peer
        self._state.connections.add(self)
        self._silent.enter(self, transport.abort)  # type: ignore[attr-defined]

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell the application that nobody waits for its reply any more."""
        self._state.connections.discard(self)
        self._silent.leave(self)
        self._idle.leave(self)
        if self._exchange is not None:
            self._exchange.leave()
        self.can_write.set()

    def pause_writing(self) -> None:
        """Let the application wait for a slow client."""
        self.can_write.clear()

    def resume_writing(self) -> None:
        """Let the application go on."""
        self.can_write.set()

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return where the next bytes go: a long body is received where it stays."""
        exchange = self._exchange
        room = None if exchange is None else exchange.room()
        return room or _SCRATCH

    def buffer_updated(self, nbytes: int) -> None:
        """Take bytes that were received."""
        exchange = self._exchange
        if exchange is not None and exchange.room() is not None:
            exchange.take_in_place(nbytes)
        else:
            self.data_received(bytes(_SCRATCH[:nbytes]))

    def data_received(self, data: bytes) -> None:
        """Take a head, a piece of a body, or what no client sends that waits for its reply."""
        if self._exchange is not None:
            self._take_body(self._exchange, data)
            return
        if self.transport.is_closing():
            return
        seen = max(0, len(self._buffer) - 3)
        self._buffer = data = self._buffer + data if self._buffer else data
        end = data.find(_END, seen, MAX_HEAD_BYTES)
        if end < 0:
            if len(data) >= MAX_HEAD_BYTES or not data[:1].isupper():
                self._refuse()
            else:  # a head has begun
                self._idle.leave(self)
                self._silent.enter(self, self.transport.abort)
            return
        self._buffer = b""
        try:
            head = parse_head(data[: end + 4])
        except BadRequestBytes:
            self._refuse()
            return
        self._silent.leave(self)
        self._idle.leave(self)
        exchange = self._begin(head)
        if end + 4 < len(data):
            self._take_body(exchange, data[end + 4 :])

    # --- called by uvicorn ---------------------------------------------------------------------------

    def shutdown(self) -> None:
        """Close the connection now, or after the reply to the present request."""
        self._is_leaving = True
        if self._exchange is None:
            self.transport.close()

    # --- called by the exchange ----------------------------------------------------------------------

    @property
    def is_leaving(self) -> bool:
        """Whether the connection ends with the present reply."""
        return self._is_leaving

    def pause_reading(self) -> None:
        """Read no more for now."""
        if not self._is_paused:
            self._is_paused = True
            self.transport.pause_reading()

    def resume_reading(self) -> None:
        """Read on."""
        if self._is_paused and not self.transport.is_closing():
            self._is_paused = False
            self.transport.resume_reading()

    def on_answered(self, *, closes: bool) -> None:
        """Wait for the next request, or close the connection after what was written."""
        self._state.total_requests += 1
        self._exchange = None
        if closes or self._is_leaving:
            self.transport.close()
        if not self.transport.is_closing():
            self.resume_reading()
            self._idle.enter(self, self.transport.close)

    # -------------------------------------------------------------------------------------------------

    def _begin(self, head: RequestHead) -> Exchange:
        app, tasks = self._app, self._state.tasks
        if self._most is not None and max(len(self._state.connections), len(tasks)) >= self._most:
            from uvicorn.protocols.http.flow_control import service_unavailable

            app = service_unavailable
        exchange = self._exchange = Exchange(self, head, self._state.default_headers)
        exchange.task = task = self.loop.create_task(exchange.run(app, _scope(head, *self._addresses)))
        tasks.add(task)
        task.add_done_callback(tasks.discard)
        return exchange

    def _take_body(self, exchange: Exchange, data: bytes) -> None:
        try:
            exchange.take(data)
        except BadRequestBytes:
            exchange.leave()
            self._refuse()

    def _refuse(self) -> None:
        """Answer 400 unless a reply has begun, and close the connection."""
        exchange, self._exchange = self._exchange, None
        self._buffer = b""
        if exchange is None or not exchange.has_begun:
            self.transport.write(_REFUSAL)
        self.transport.close()


class Exchange:
    """One request and its reply, as the application sees them: ASGI's ``receive`` and ``send``."""

    __slots__ = (
        "_body", "_closes", "_default", "_expects", "_has_surplus", "_head", "_is_answered", "_is_chunked",
        "_is_gone", "_is_told", "_is_whole", "_left", "_pieces", "_protocol", "_start", "_unsent", "_waiter",
        "_waiting", "_whole", "has_begun", "task",
    )  # fmt: skip

    def __init__(
        self, protocol: OneRequestProtocol, head: RequestHead, default: list[tuple[bytes, bytes]]
    ) -> None:
        """Begin with a head; *default* are headers of every reply."""
        self.has_begun = False
        """Whether something of the reply was sent."""
        self.task: asyncio.Task[None] | None = None
        self._protocol, self._head, self._default = protocol, head, default
        self._expects, self._closes = head.expects_continue, head.closes
        self._body = ChunkedBody() if head.body_bytes is None else None
        self._left = head.body_bytes or 0
        self._is_whole = head.body_bytes == 0
        self._is_told = False  # that it is whole
        self._has_surplus = self._is_gone = self._is_answered = False
        is_long = self._body is None and _WHOLE_FROM <= self._left <= _WHOLE_TO
        self._whole = bytearray(self._left) if is_long else None
        self._pieces: list[bytes] = []
        self._waiting = 0
        self._waiter: asyncio.Future[None] | None = None
        self._start: Mapping[str, Any] | None = None
        self._is_chunked = False
        self._unsent: int | None = None

    def room(self) -> memoryview | None:
        """Return where the rest of a long body goes; None for other bytes."""
        if self._whole is None or self._is_whole:
            return None
        return memoryview(self._whole)[len(self._whole) - self._left :][:_MAX_BUFFERED]

    def take_in_place(self, count: int) -> None:
        """Take *count* bytes that are in `room`."""
        self._left -= count
        self._waiting += count
        self._is_whole, self._expects = not self._left, False
        if self._waiting > _MAX_BUFFERED and not self._is_whole:
            self._protocol.pause_reading()
        self._wake()

    def take(self, data: bytes) -> None:
        """Take bytes that follow the head; raises BadRequestBytes."""
        if self._is_whole:
            self._has_surplus = True
            self._protocol.pause_reading()
            return
        self._expects = False
        if self._body is not None:
            pieces, rest = self._body.decode(data)
            self._pieces += pieces
            self._waiting += sum(map(len, pieces))
            self._is_whole, self._has_surplus = rest is not None, bool(rest)
        else:
            if len(data) > self._left:
                data, self._has_surplus = data[: self._left], True
            if self._whole is not None:
                at = len(self._whole) - self._left
                self._whole[at : at + len(data)] = data
            else:
                self._pieces.append(data)
            self._left -= len(data)
            self._waiting += len(data)
            self._is_whole = not self._left
        if self._has_surplus or (self._waiting > _MAX_BUFFERED and not self._is_whole):
            self._protocol.pause_reading()
        self._wake()

    def leave(self) -> None:
        """End the exchange: the client is gone."""
        self._is_gone = True
        self._wake()
        if self._protocol.ends_with_client and self.task is not None and not self._is_answered:
            self.task.cancel()

    async def run(self, app: Callable[..., Any], scope: Mapping[str, Any]) -> None:
        """Let the application answer; a failure of it becomes a 500, or the end of the connection."""
        try:
            await app(scope, self.receive, self.send)
        except asyncio.CancelledError:
            if not self._is_gone:
                self._protocol.transport.abort()
            raise
        except Exception as error:  # noqa: BLE001 - a defect of the application, which the client learns as a 500
            _log.error("Exception in ASGI application\n", exc_info=error)
        if self._is_answered or self._is_gone:
            return
        if self.has_begun:
            self._protocol.transport.abort()  # the client must not take a part for the whole
            return
        self._start, self._closes = None, True
        headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", b"%d" % len(_ERROR))]
        await self.send({"type": "http.response.start", "status": 500, "headers": headers})
        await self.send({"type": "http.response.body", "body": _ERROR})

    async def receive(self) -> Mapping[str, Any]:
        """Return the next piece of the body, or that the client is gone or has its reply."""
        if self._expects and not self.has_begun:
            self._expects = False
            self._protocol.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")
        while not (self._is_gone or self._is_answered):
            if self._waiting or (self._is_whole and not self._is_told):
                return self._message()
            if not self._has_surplus:
                self._protocol.resume_reading()
            self._waiter = self._protocol.loop.create_future()
            await self._waiter
        return {"type": "http.disconnect"}

    def _message(self) -> Mapping[str, Any]:
        """Return what was received since the last message; ``whole`` is a long body, with the last piece."""
        pieces, self._pieces = self._pieces, []
        count, self._waiting = self._waiting, 0
        self._is_told = self._is_whole
        if not self._is_whole:
            self._protocol.resume_reading()
        message: dict[str, Any] = {"type": "http.request", "more_body": not self._is_whole}
        if self._whole is None:
            message["body"] = pieces[0] if len(pieces) == 1 else b"".join(pieces)
            return message
        end = len(self._whole) - self._left
        message["body"] = memoryview(self._whole)[end - count : end]
        if self._is_whole:
            message["whole"] = self._whole
        return message

    async def send(self, message: Mapping[str, Any]) -> None:
        """Send the head of the reply or a piece of its body."""
        if not self._protocol.can_write.is_set():
            await self._protocol.can_write.wait()
        if self._is_gone:
            return
        kind = message["type"]
        if self._start is None and kind == "http.response.start":
            self._start = message
        elif self._is_answered and kind == "http.response.body" and not message.get("body"):
            return  # the end of a body that was complete
        elif self._start is not None and kind == "http.response.body" and not self._is_answered:
            self._send_body(self._start, message.get("body", b""), bool(message.get("more_body")))
        else:
            raise RuntimeError(f"{kind} is sent out of its order")

    def _send_body(self, start: Mapping[str, Any], body: bytes, more: bool) -> None:
        has_no_body = self._head.method == b"HEAD" or start["status"] in (204, 304)
        parts = []
        if not self.has_begun:
            parts.append(self._reply_head(start))
            self.has_begun = True
        if has_no_body:
            body = b""
        elif self._unsent is not None:
            self._unsent -= len(body)
            if self._unsent < 0:
                raise RuntimeError("the body is longer than its Content-Length")
        if body and self._is_chunked:
            parts += (b"%x\r\n" % len(body), body, b"\r\n")
        elif body:
            parts.append(body)
        if not more and self._is_chunked and not has_no_body:
            parts.append(b"0\r\n\r\n")
        if len(parts) == 1:
            self._protocol.transport.write(parts[0])
        elif parts:
            self._protocol.transport.writelines(parts)
        # The client has its reply when it has the last byte, and may send the next request at once.
        if more and (self._unsent != 0 or not self._is_whole):
            return
        if self._unsent and not has_no_body:
            raise RuntimeError("the body is shorter than its Content-Length")
        self._is_answered = True
        self._wake()
        self._protocol.on_answered(closes=self._closes or self._has_surplus or not self._is_whole)

    def _reply_head(self, start: Mapping[str, Any]) -> bytes:
        status: int = start["status"]
        lines = [b"HTTP/1.1 %d %s" % (status, _PHRASES.get(status, b""))]
        says_close = False
        for name, value in (*self._default, *start.get("headers", ())):
            lines.append(b"%s: %s" % (name, value))
            if name == b"content-length":
                self._unsent = int(value)
            elif name == b"connection":
                says_close = says_close or value.lower() == b"close"
        self._closes = self._closes or says_close or self._protocol.is_leaving or self._has_surplus
        if self._unsent is None and status not in (204, 304):
            self._is_chunked = True
            lines.append(b"transfer-encoding: chunked")
        if self._closes and not says_close:
            lines.append(b"connection: close")
        head = b"\r\n".join((*lines, b"", b""))
        if not _REPLY_HEAD.fullmatch(head) or head.count(b"\r\n") != len(lines) + 1:
            raise RuntimeError("a header of the reply has letters that headers may not have")
        return head

    def _wake(self) -> None:
        waiter, self._waiter = self._waiter, None
        if waiter is not None and not waiter.done():
            waiter.set_result(None)


def _scope(head: RequestHead, server: Any, client: Any) -> dict[str, Any]:
    raw_path, _, query = head.target.partition(b"?")
    path = raw_path.decode("ascii")
    return {
        "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1",
        "server": server, "client": client, "scheme": "http", "method": head.method.decode("ascii"),
        "root_path": "", "path": unquote(path) if "%" in path else path, "raw_path": raw_path,
        "query_string": query, "headers": head.headers, "state": {},
    }  # fmt: skip


class _InLoop:
    """`SilentConnections` of the loop in which uvicorn runs, which begins later."""

    def __init__(self, seconds: float, most: int) -> None:
        self._seconds = seconds
        self._most = most
        self._made: SilentConnections[object] | None = None

    def of(self, loop: asyncio.AbstractEventLoop) -> SilentConnections[object]:
        if self._made is None:
            later: Callable[..., asyncio.TimerHandle] = loop.call_later
            self._made = SilentConnections(call_later=later, seconds=self._seconds, most=self._most)
        return self._made
