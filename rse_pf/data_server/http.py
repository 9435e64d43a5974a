"""HTTP requests and replies as values; a request body has limits on its size, its pauses and its rate.

An error is sent as a status, a code, a message and a hint, never as a traceback.  Of a body that is longer
than its limit nothing is kept in memory.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar
from urllib.parse import parse_qsl

import msgspec

from rse_pf.config.front_door import BODY_TIMEOUT_S
from rse_pf.errors import (
    Archived,
    BadRequest,
    Busy,
    Conflict,
    Crashed,
    Disconnected,
    Expired,
    Forbidden,
    InvalidCamera,
    LimitExceeded,
    MissingExtra,
    NotFound,
    QuotaExceeded,
    RsePfError,
    StoreError,
    StoreFull,
    Unauthorized,
    WorkerLost,
)

__all__ = [
    "HttpFailure",
    "HttpReply",
    "HttpRequest",
    "MethodNotAllowed",
    "PreconditionFailed",
    "Receive",
    "Send",
    "TooManyRequests",
    "check_preconditions",
    "failure_reply",
    "has_conditions",
    "json_reply",
    "requested_range",
    "wants_range",
]

_T = TypeVar("_T")
Receive = Callable[[], Awaitable[Mapping[str, Any]]]
Send = Callable[[Mapping[str, Any]], Awaitable[None]]
_MIN_BODY_BYTES_PER_S = 1024  # least average rate of a request body; a slower body is refused with 408
_BODY_GRACE_S = 5.0  # the average rate is checked only after this time: a moving robot may lose its network
_MIN_RATE_TIME_S = 0.1  # shortest time over which the rate of a body is computed, so that it stays finite
_PARTS_HINT = "send the object in parts: PUT an upload"
_DRAIN_S = 0.1  # time to read the rest of a body before a refusal is sent, so that the connection stays open
_DISCARD_S = 2.0  # time to read the rest of a body after a refusal was sent, before the connection is closed
_MAX_DROPPED_BYTES = 32 << 20  # longest body that is read and dropped when it is above its limit


class MethodNotAllowed(BadRequest):
    """The path has no such HTTP method; *allowed* lists its methods, separated by commas (status 405)."""

    def __init__(self, allowed: str) -> None:
        super().__init__("the path does not support this method", hint=f"use {allowed}")
        self.allowed = allowed


class PreconditionFailed(Conflict):
    """``If-Match`` or ``If-None-Match`` does not hold, so nothing was read or changed (status 412)."""


class TooManyRequests(Busy):
    """This robot sends more requests than its rate limit allows (status 429); other robots are served."""


# HTTP status of the reply to an error; a class without an entry has that of its base class, or 500.
_STATUS: dict[type[RsePfError], int] = {
    MethodNotAllowed: 405, PreconditionFailed: 412, TooManyRequests: 429,
    Unauthorized: 401, Forbidden: 403, NotFound: 404, Expired: 408, Conflict: 409, LimitExceeded: 413,
    QuotaExceeded: 413, Crashed: 413, BadRequest: 400, InvalidCamera: 400, Busy: 503, WorkerLost: 503,
    Archived: 409, StoreFull: 507, StoreError: 503, MissingExtra: 501,
}  # fmt: skip
_BODY_HEADERS = {"content-length", "transfer-encoding"}
"""The headers that announce a body: a request with none of them has no body."""
_BYTE_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.IGNORECASE)
_TAG_LISTS = frozenset({"if-match", "if-none-match"})  # headers that hold a list of entity tags
_ENTITY_TAG = re.compile(r'(W/)?"([^"]*)"')


class HttpFailure(msgspec.Struct, frozen=True, kw_only=True):
    """The body of a reply that reports an error: a stable code, a message, and what to do (*hint*)."""

    code: str
    message: str
    hint: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpReply:
    """A reply to a request.

    *body* is bytes, or an iterator whose pieces are read while they are sent; then *headers* must hold
    ``Content-Length``.
    """

    status: int
    body: bytes | AsyncIterator[bytes] = b""
    headers: Mapping[str, str] = field(default_factory=dict)
    media_type: str = "application/json"


class HttpRequest:
    """One HTTP request: its head, and methods that read or drop its body."""

    def __init__(self, scope: Mapping[str, Any], receive: Receive, clock: Callable[[], float]) -> None:
        self.method = str(scope["method"])
        self.path = str(scope["path"])
        self.peer = str((scope.get("client") or ("",))[0])
        self.headers: dict[str, str] = {}
        for raw_name, raw_value in scope["headers"]:
            name, value = raw_name.decode("latin-1").lower(), raw_value.decode("latin-1")
            # A list of entity tags may come in several headers, which are joined (RFC 9110, Sect. 5.3).
            is_continued = name in _TAG_LISTS and name in self.headers
            self.headers[name] = f"{self.headers[name]}, {value}" if is_continued else value
        query = scope["query_string"]
        self.query = dict(parse_qsl(query.decode("latin-1"), keep_blank_values=True)) if query else {}
        self.received_bytes = 0
        self.is_complete = not self.headers.keys() & _BODY_HEADERS
        """Whether the whole body was read, there is none, or the client closed the connection."""
        self._reader: asyncio.Task[Any] | None = None
        self._began_s = clock()
        self._refusal: RsePfError | None = None
        self._receive = receive
        self._clock = clock

    def header_number(self, name: str) -> int | None:
        """Return the number in the header *name*, None if the header is missing.

        Raises:
            BadRequest: The header is not a whole number of at most 18 decimal digits.
        """
        text = self.headers.get(name.lower())
        if text is None:
            return None
        if not re.fullmatch(r"[0-9]{1,18}", text):
            raise BadRequest(f"{name}: {text[:40]!r} is not a number of bytes", hint="send decimal digits")
        return int(text)

    async def body(self, max_bytes: int, *, hint: str = _PARTS_HINT) -> bytes:
        """Read and return the whole body; *hint* is the error's hint if the body is too long.

        Most clients read the reply only after they have sent the whole body, and lose the reply if the
        connection is reset before.  A body that is too long is therefore read to its end and dropped, up to
        `_MAX_DROPPED_BYTES`.

        Raises:
            LimitExceeded: The body is longer than *max_bytes*.
            Expired: No data came for `BODY_TIMEOUT_S`, or the average rate is below `_MIN_BODY_BYTES_PER_S`.
            Disconnected: The robot closed the connection before the end of the body.
            RsePfError: The error that `end_body` was called with meanwhile.
        """
        announced = self.header_number("content-length") or 0
        is_sent = "expect" not in self.headers  # else the client waits for "100 Continue" before the body
        if announced > (_MAX_DROPPED_BYTES if is_sent else max_bytes):
            raise _too_long(announced, max_bytes, hint)
        pieces = []
        self._reader = asyncio.current_task()
        try:
            async for piece in self._pieces():
                pieces.append(piece)
                if self.received_bytes > max_bytes:
                    pieces.clear()
                if self.received_bytes > _MAX_DROPPED_BYTES:
                    break
                if self._refusal is not None:  # `wait_for` of Python 3.10 may lose the cancel of `end_body`
                    raise self._refusal
        except asyncio.CancelledError:
            if self._refusal is None:  # the server cancelled the request: the client has disconnected
                raise
            raise self._refusal from None
        finally:
            self._reader = None
        if self.received_bytes > max_bytes:
            raise _too_long(max(announced, self.received_bytes), max_bytes, hint)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    @property
    def is_receiving(self) -> bool:
        """Whether a call of `body` is running and has not received the whole body yet."""
        return self._reader is not None and not self.is_complete

    def received_bytes_per_s(self, now: float) -> float:
        """Return the average rate of the body from the arrival of the request until *now* (s, monotonic)."""
        return self.received_bytes / max(now - self._began_s, _MIN_RATE_TIME_S)

    def end_body(self, refusal: RsePfError) -> None:
        """Stop the running call of `body`, which then raises *refusal*; call only while `is_receiving`."""
        assert self._reader is not None
        self._refusal = refusal
        self._reader.cancel()

    async def drain_soon(self, max_bytes: int) -> bool:
        """Call `drain` for at most `_DRAIN_S` seconds; return whether the whole body was read."""
        try:
            return await _within(_DRAIN_S, self.drain(max_bytes))
        except asyncio.TimeoutError:
            return False

    async def discard(self) -> None:
        """Read and drop the rest of the body after the reply was sent, before the connection is closed.

        At most `_MAX_DROPPED_BYTES` are read, for at most `_DISCARD_S`.  Closing the connection without this
        would reset it, and the client would lose the reply.  Nothing is read from a client that waits for
        "100 Continue", because it sends no body.
        """
        if "expect" in self.headers and not self.received_bytes:
            return
        with contextlib.suppress(asyncio.TimeoutError):
            await _within(_DISCARD_S, self._drop())

    async def _drop(self) -> None:
        remaining = _MAX_DROPPED_BYTES
        while remaining > 0:
            message = await self._receive()
            if message["type"] == "http.disconnect" or not message.get("more_body", False):
                return
            remaining -= len(message.get("body", b""))

    async def drain(self, max_bytes: int) -> bool:
        """Read and drop the rest of the body, so that the robot reads the reply; return whether all was read.

        False if the body is longer than *max_bytes* or came too slowly; raises Disconnected.
        """
        try:
            if (self.header_number("content-length") or 0) > max_bytes:
                return False
            async for _ in self._pieces():
                if self.received_bytes > max_bytes:
                    return False
        except (BadRequest, Expired):
            return False
        return True

    async def _pieces(self) -> AsyncIterator[bytes]:
        while not self.is_complete:
            try:
                message = await _within(BODY_TIMEOUT_S, self._receive())
            except asyncio.TimeoutError:
                raise _too_slow(f"no data for {BODY_TIMEOUT_S:g} s") from None
            if message["type"] == "http.disconnect":
                self.is_complete = True
                raise Disconnected("the robot closed the connection within its request")
            piece: bytes = message.get("body", b"")
            self.received_bytes += len(piece)
            if not message.get("more_body", False):
                self.is_complete = True
            yield piece
            took_s, min_rate = self._clock() - self._began_s, _MIN_BODY_BYTES_PER_S
            if not self.is_complete and took_s > _BODY_GRACE_S and self.received_bytes < min_rate * took_s:
                raise _too_slow(
                    f"{self.received_bytes} bytes in {took_s:.1f} s; at least {min_rate} a second"
                )


def json_reply(status: int, value: Any, headers: Mapping[str, str] | None = None) -> HttpReply:
    """Return a reply with *status* and *headers* whose body is *value* as JSON."""
    return HttpReply(status=status, body=msgspec.json.encode(value), headers=headers or {})


def failure_reply(error: RsePfError) -> HttpReply:
    """Return the reply that reports *error*: its HTTP status, 500 for other errors, and a `HttpFailure`.

    The header Retry-After is the error's time rounded up to whole seconds, at least 1.
    """
    status = next((_STATUS[kind] for kind in type(error).__mro__ if kind in _STATUS), 500)
    headers: dict[str, str] = {}
    if isinstance(error, MethodNotAllowed):
        headers["Allow"] = error.allowed
    if status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    if error.retry_after_ms is not None:
        headers["Retry-After"] = str(max(1, math.ceil(error.retry_after_ms / 1000)))
    return json_reply(status, HttpFailure(code=error.code, message=error.message, hint=error.hint), headers)


def has_conditions(request: HttpRequest) -> bool:
    """Return whether *request* has the header ``If-Match`` or ``If-None-Match``."""
    return not _TAG_LISTS.isdisjoint(request.headers)


def check_preconditions(request: HttpRequest, tag: str | None) -> bool:
    """Return whether to carry *request* out; False means that the client has the object: reply 304.

    Args:
        request: With ``If-Match`` or ``If-None-Match``, or without both.
        tag: The opaque part of the strong entity tag of the object; None: there is no object.

    Raises:
        PreconditionFailed: The object is not in the state that the client expects.

    Source:
        RFC 9110, Sect. 13.2.2.  Objects have no date, so conditions by date are ignored.
    """
    expected, unwanted = (request.headers.get(name) for name in ("if-match", "if-none-match"))
    if expected is not None and not _names_tag(expected, tag, is_weak_enough=False):
        raise PreconditionFailed(
            f"If-Match: {expected[:100]} does not name the object, whose entity tag is {_shown(tag)}",
            hint="read it again, or leave the header out",
        )
    if unwanted is None or not _names_tag(unwanted, tag, is_weak_enough=True):
        return True
    if request.method in ("GET", "HEAD"):
        return False
    raise PreconditionFailed(
        f"If-None-Match: {unwanted[:100]} names the object, whose entity tag is {_shown(tag)}",
        hint="leave the header out to carry the request out nevertheless",
    )


def wants_range(request: HttpRequest, tag: str) -> bool:
    """Return whether the header ``Range`` counts: there is no ``If-Range``, or it holds the entity tag *tag*.

    Source:
        RFC 9110, Sect. 13.1.5: strong comparison.  A date in ``If-Range`` never matches, because objects have
        no date.
    """
    condition = request.headers.get("if-range")
    return condition is None or condition.strip() == f'"{tag}"'


def _names_tag(text: str, tag: str | None, *, is_weak_enough: bool) -> bool:
    """Return whether the header value *text*, a list of entity tags or ``*``, names *tag*.

    Weak tags (``W/"..."``) match only if *is_weak_enough*.  *tag* None means that there is no object: False.
    """
    if tag is None or text.strip() == "*":
        return tag is not None
    return any(named == tag and (is_weak_enough or not weak) for weak, named in _ENTITY_TAG.findall(text))


def _shown(tag: str | None) -> str:
    return "none, since it does not exist" if tag is None else f'"{tag}"'


def requested_range(text: str | None, size: int) -> tuple[int, int] | None:
    """Return ``(start, end)`` of the bytes that the header ``Range`` names, end excluded; None for all bytes.

    Args:
        text: The header, None if there is none.  A header that is not one single byte range is ignored, as
            RFC 9110 Sect. 14.2 allows.
        size: Length of the object in bytes.

    Raises:
        BadRequest: The range lies outside the object; the caller replies 416.
    """
    match = _BYTE_RANGE.fullmatch(text.strip()) if text else None
    if match is None or match[1] == match[2] == "":
        return None
    if match[1] == "":
        start, end = max(0, size - int(match[2])), size
    else:
        start = int(match[1])
        end = size if match[2] == "" else min(size, int(match[2]) + 1)
        if match[2] and int(match[2]) < start:
            return None
    if start >= size or start >= end:
        raise BadRequest(f"{text!r} lies outside of {size} bytes", hint="HEAD returns the size")
    return start, end


async def _within(seconds: float, work: Awaitable[_T]) -> _T:
    """Return the result of *work*; cancel it and raise asyncio.TimeoutError after *seconds*."""
    if sys.version_info >= (3, 11):  # `asyncio.timeout` starts no task, as `wait_for` of Python 3.10 does
        async with asyncio.timeout(seconds):
            return await work
    return await asyncio.wait_for(work, seconds)


def _too_long(got: int, max_bytes: int, hint: str) -> LimitExceeded:
    return LimitExceeded(f"the body has {got} bytes, the limit is {max_bytes}", hint=hint)


def _too_slow(subject: str) -> Expired:
    return Expired(f"the body is too slow: {subject}", hint="send smaller parts and resume")
