"""HTTP/1.1 connections of services that run on uvicorn: bounded, and with one request at a time.

uvicorn's `HttpToolsProtocol` reads requests with llhttp.  It waits for ever for the end of a request head,
has no bound on the size of a head, and accepts a request before it has answered the previous one.
`OneRequestProtocol` has these bounds, and refuses a request that two HTTP implementations could understand
differently (request smuggling).

Source:
    RFC 9112, sections 2.2, 3, 5, 6 and 7.1.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import re
from typing import Any

from rse_pf.errors import MissingExtra
from rse_pf.http.unauthenticated import FIRST_REQUEST_S, KEEP_ALIVE_S, MAX_SILENT, SilentConnections

_missing: ImportError | None = None
try:
    import httptools
    from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
except ImportError as error:  # as on a robot, where no server runs; `bounded_protocol` raises MissingExtra
    HttpToolsProtocol, _missing = object, error  # type: ignore[assignment, misc]

__all__ = ["MAX_HEADERS", "MAX_HEAD_BYTES", "OneRequestProtocol", "bounded_protocol"]

MAX_HEAD_BYTES = 16384  # largest head of a request: a token, the longest header, has at most 4 KiB
MAX_HEADERS = 64  # most headers of a request: browsers and load balancers send fewer than 30
# Most bytes of framing (sizes and line ends of the chunks) of a chunked body, in addition to those that
# `FRAMING_SHIFT` allows: a body of many tiny chunks costs much CPU time.
MAX_FRAMING_BYTES = 4096
# Bytes of framing that each byte of data in a chunked body allows, as a power of two: 2**-3, an eighth.
FRAMING_SHIFT = 3
PARSED_AT_ONCE_BYTES = 16384  # received bytes of a chunked body between two checks of `MAX_FRAMING_BYTES`
UNSENT_HIGH_BYTES = 1 << 19  # unsent bytes of a reply above which the application waits for the client
UNSENT_LOW_BYTES = 1 << 18  # unsent bytes of a reply at which an application that waits continues
_END_OF_HEAD = b"\r\n\r\n"
# A whole request head that is accepted: the form of RFC 9112 without its obsolete variants.
_HEAD = re.compile(
    rb"[A-Z]{1,16} /[!\"$-~]* HTTP/1\.1\r\n"  # no fragment: HTTP implementations treat "#" differently
    rb"(?:[-!#$%&'*+.^_`|~0-9A-Za-z]+:[\t -~\x80-\xff]*\r\n){1," + b"%d" % MAX_HEADERS + rb"}\r\n"
)


def bounded_protocol(
    *,
    seconds: float = FIRST_REQUEST_S,
    idle_s: float = KEEP_ALIVE_S,
    most: int = MAX_SILENT,
    most_idle: int,
    ends_with_client: bool = False,
) -> Any:
    """Return the factory that uvicorn calls to make the protocol object of each connection of one listener.

    Args:
        seconds: Longest time for the head of a request, from the start of the connection for the first one,
            otherwise from the first byte of the head.
        idle_s: Longest time between a reply and the first byte of the next request.
        most: Most connections that have not sent a whole head; above that the oldest one is closed.
        most_idle: Most connections that are idle after a reply; above that the one that has been idle for
            longest is closed.
        ends_with_client: Whether the application is cancelled when its client disconnects.

    Raises:
        MissingExtra: uvicorn or httptools is not installed.
    """
    if _missing is not None:
        raise MissingExtra(_missing.name or "uvicorn", "backend") from _missing
    silent: SilentConnections[object] = SilentConnections(call_later=_call_later, seconds=seconds, most=most)
    idle: SilentConnections[object] = SilentConnections(
        call_later=_call_later, seconds=idle_s, most=most_idle
    )
    return functools.partial(OneRequestProtocol, silent, idle, ends_with_client)


class OneRequestProtocol(HttpToolsProtocol):
    """An HTTP connection that accepts a request only after the reply to the previous one.

    Load balancers and our own clients wait for a reply before they send the next request.  If bytes arrive
    earlier, they are not read as a request: the present request is answered, then the connection is closed.
    """

    def __init__(
        self,
        silent: SilentConnections[object],
        idle: SilentConnections[object],
        ends_with_client: bool,
        *args: Any,
        **kwargs: Any,
    ) -> None:
        """Create the protocol object of one connection.

        *silent* and *idle* count the connections without a whole head and after a reply; the further
        arguments are those with which uvicorn creates an `HttpToolsProtocol`.
        """
        super().__init__(*args, **kwargs)
        self._silent, self._idle, self._ends_with_client = silent, idle, ends_with_client
        self._served, self.app = self.app, self._serve
        self._task: asyncio.Task[Any] | None = None
        self._head = b""  # the received part of a head that is not complete
        self._has_head = False
        self._is_chunked = False
        self._framing_bytes_left = 0

    # --- methods that the transport calls -------------------------------------------------------------

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to count the connection as one without a whole head, which is closed after `seconds`."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(UNSENT_HIGH_BYTES, UNSENT_LOW_BYTES)
        self._silent.enter(self, transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        """Report to the application that its client has disconnected; cancel it if ``ends_with_client``."""
        self._silent.leave(self)
        self._idle.leave(self)
        super().connection_lost(exc)
        self.app = self._served  # removes the object's reference to itself, which would keep it in memory
        if self._ends_with_client and self._task is not None and not self.cycle.response_complete:
            self._task.cancel()

    def data_received(self, data: bytes) -> None:
        """Process received bytes: a part of a head, a part of a body, or bytes that come too early."""
        if self.transport.is_closing():
            return
        if self._is_in_request():
            self._parse_body(data)
            return
        searched = max(0, len(self._head) - len(_END_OF_HEAD) + 1)
        data = self._head + data
        end = data.find(_END_OF_HEAD, searched, MAX_HEAD_BYTES) + len(_END_OF_HEAD)
        if end < len(_END_OF_HEAD):
            self._head = data
            if len(data) >= MAX_HEAD_BYTES or not data[:1].isupper():
                self._refuse()
            else:  # the first byte of a head: the connection is not idle, and has `seconds` for the head
                self._idle.leave(self)
                self._silent.enter(self, self.transport.abort)
            return
        self._head = b""
        head, body = data[:end], data[end:]
        if not _HEAD.fullmatch(head):
            self._refuse()
            return
        self._silent.leave(self)
        self._idle.leave(self)
        self._parse(head)
        self._parse_body(body)

    # --- methods that llhttp calls; after an exception in one, `_parse` refuses the request -------------

    def on_message_begin(self) -> None:
        """Begin a request; raise ValueError if the previous one is not answered yet."""
        if self._is_in_request():
            raise ValueError("a request came before the reply to the previous one")
        super().on_message_begin()
        self._has_head = False

    def on_header(self, name: bytes, value: bytes) -> None:
        """Add a header of the head; raise ValueError for a trailer (a header after a chunked body)."""
        if self._has_head:
            raise ValueError("a header follows a chunked body")
        super().on_header(name, value.rstrip(b" \t"))  # llhttp does not remove these spaces

    def on_headers_complete(self) -> None:
        """Start the application for a complete head, or raise ValueError.

        A valid head has one Host, at most one Content-Length or Transfer-Encoding, and no upgrade.
        """
        hosts = sum(name == b"host" for name, _ in self.headers)
        lengths = [each for each in self.headers if each[0] in (b"content-length", b"transfer-encoding")]
        self._is_chunked = [each[0] for each in lengths] == [b"transfer-encoding"]
        if hosts != 1 or len(lengths) > 1 or self.parser.should_upgrade():
            raise ValueError("the head has no or several hosts, several lengths of the body, or an upgrade")
        if self._is_chunked and lengths[0][1].lower() != b"chunked":
            raise ValueError("the transfer coding of the body is not chunked")
        self._has_head, self._framing_bytes_left = True, MAX_FRAMING_BYTES
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Pass a part of a body to the application, and allow more bytes of chunk framing for it."""
        self._framing_bytes_left += len(body) + (len(body) >> FRAMING_SHIFT)
        super().on_body(body)

    # --- the method that uvicorn calls after a reply ----------------------------------------------------

    def on_response_complete(self) -> None:
        """Wait for the next request, or close the connection if a part of the body was not read."""
        self.server_state.total_requests += 1
        if self.cycle.more_body:
            self.transport.close()
        if not self.transport.is_closing():
            self.flow.resume_reading()
            self._idle.enter(self, self.transport.close)

    # --- private methods: parse a body, refuse a request, run the application ----------------------------

    def _is_in_request(self) -> bool:
        """Return whether a request has begun whose reply is not complete."""
        return self.cycle is not None and not self.cycle.response_complete

    def _parse_body(self, data: bytes) -> None:
        """Parse bytes after a head; refuse the request if its chunks have too many bytes of framing."""
        step = PARSED_AT_ONCE_BYTES if self._is_chunked else max(len(data), 1)
        for start in range(0, len(data), step):
            if self.transport.is_closing():
                return
            if not self.cycle.more_body:
                self._close_after_reply()
                return
            part = data[start : start + step]
            self._framing_bytes_left -= len(part)
            self._parse(part)
            if self._is_chunked and self._framing_bytes_left < 0 and self.cycle.more_body:
                self._refuse()

    def _parse(self, data: bytes) -> None:
        """Pass *data* to llhttp.

        After an error the request is refused; if it was complete, its reply is sent before the connection is
        closed.
        """
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserError:
            if self._is_in_request() and not self.cycle.more_body:
                self._close_after_reply()
            else:
                self._refuse()

    def _close_after_reply(self) -> None:
        self.cycle.keep_alive = False
        self.flow.pause_reading()

    def _refuse(self) -> None:
        """Answer with the status 400, unless a reply has begun, and close the connection."""
        if self.transport.is_closing():
            return
        has_begun = False
        if self._is_in_request():
            has_begun = self.cycle.response_started
            self.cycle.disconnected = True  # the application sends nothing more
            self.cycle.message_event.set()
        if has_begun:
            self.transport.close()
        else:
            self.send_400_response("Invalid HTTP request received.")

    async def _serve(self, scope: Any, receive: Any, send: Any) -> None:
        """Run the application for one request; a cancellation by `connection_lost` is no error."""
        self._task = asyncio.current_task()
        if not self.cycle.disconnected:
            with contextlib.suppress(asyncio.CancelledError):
                await self._served(scope, receive, send)


def _call_later(*args: Any) -> asyncio.TimerHandle:
    return asyncio.get_running_loop().call_later(*args)
