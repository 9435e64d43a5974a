"""The page as an ASGI application: static files, sessions, the stream of messages, and operations.

The static files are public and hold no data of the platform; every other request needs a session in the
header ``Authorization``.  A request with another host name than loopback, or from a page of another origin,
is rejected.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

from rse_pf.auth.control_token import carries_token
from rse_pf.errors import BadRequest, Busy, Forbidden, LimitExceeded, NotFound, RsePfError, Unauthorized
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.extensions.fleet_page.page_sessions import PageSessions, Role
from rse_pf.extensions.fleet_page.static_files import StaticFile
from rse_pf.terminal import printable

__all__ = ["CONTENT_SECURITY_POLICY", "FleetApp", "PageAccess", "PageActions"]

# Content security policy of the page: scripts and requests of this origin only.
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Headers of every answer, in addition to the media type and length.
_HEADERS = (
    (b"content-security-policy", CONTENT_SECURITY_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
# Largest body of a request, in bytes.
_MAX_BODY_BYTES = 4096
# Accepted values of the header Host: loopback with any port, since a port may be forwarded (ssh -L).  A page
# of another site whose name resolves to loopback (DNS rebinding) has the name of that site in Host.
_LOOPBACK_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
# Topics of the stream of the page, in addition to "live/MAP".
_TOPICS = frozenset(("fleet", "history", "robots", "event", "audit", "pose", "link", "maps"))
# Beginning of the topics of live maps; the name of the map follows.
_LIVE = "live/"
# HTTP status of an answer by the code of its error; other codes have the status 400.
_STATUS = {
    Unauthorized.code: 401,
    Forbidden.code: 403,
    NotFound.code: 404,
    LimitExceeded.code: 413,
    Busy.code: 503,
}

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PageActions:
    """The functions that the page calls in addition to its stream; both may raise RsePfError.

    ``operate(action, parameters)`` executes an operation on the platform and returns its result.
    ``page(name, parameters)`` returns the media type and the body of a document, such as a point cloud.
    """

    operate: Callable[[str, Mapping[str, str]], Awaitable[Mapping[str, Any]]]
    page: Callable[[str, Mapping[str, str]], Awaitable[tuple[str, bytes]]]


class _Request:
    def __init__(self, scope: Scope) -> None:
        self.method: str = scope["method"]
        self.path: str = scope["path"]
        self.query = dict(parse_qsl(scope["query_string"].decode("latin-1")))
        self.headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        self.session = self.headers.get("authorization", "").removeprefix("Bearer ")


@dataclass(frozen=True, slots=True, kw_only=True)
class PageAccess:
    """The authentication of the page's users.

    Attributes:
        sessions: The sessions and keys of users who may view or operate.
        admin_token: Returns the token of the control ports; a request with this token may ask for new keys.
    """

    sessions: PageSessions
    admin_token: Callable[[], str]


class FleetApp:
    """The ASGI application of the page."""

    def __init__(
        self,
        hub: Hub,
        access: PageAccess,
        files: Mapping[str, StaticFile],
        actions: PageActions,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Describe the application.

        Args:
            hub: The messages of the stream.
            access: The authentication of users.
            files: The static files of the page, by path.
            actions: The operations and documents that the page requests.
            clock: Returns seconds, monotonic, for the expiry of sessions and keys.
        """
        self._hub = hub
        self._sessions = access.sessions
        self._files = files
        self._actions = actions
        self._admin_token = access.admin_token
        self._clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one HTTP request; an RsePfError becomes a JSON body with code, message and hint."""
        if scope["type"] != "http":
            return
        try:
            request = _Request(scope)
            self._check_origin(request)
            await self._answer(request, receive, send)
        except RsePfError as error:
            # A part of another answer may have been sent already (RuntimeError), or the client may have left
            # (OSError): then nobody can receive the error.
            with contextlib.suppress(OSError, RuntimeError):
                await _send(send, _STATUS.get(error.code, 400), _error_document(error))

    def _check_origin(self, request: _Request) -> None:
        host = request.headers.get("host", "")
        if not _LOOPBACK_HOST.fullmatch(host):
            raise Forbidden(
                "this page is not served under that name", hint="open it under 127.0.0.1 or localhost"
            )
        origin = request.headers.get("origin", f"http://{host}")
        site = request.headers.get("sec-fetch-site", "none")
        wants_file = request.method == "GET" and request.path == "/"
        if origin != f"http://{host}" or (site not in ("same-origin", "none") and not wants_file):
            raise Forbidden("requests of other pages are refused", hint="open the page itself")

    async def _answer(self, request: _Request, receive: Receive, send: Send) -> None:
        endpoint = (request.method, request.path)
        if request.method in ("GET", "HEAD") and request.path in self._files:
            await self._send_file(request, self._files[request.path], send)
        elif endpoint == ("POST", "/session"):
            session, role = self._sessions.open(_text(await _body(receive), "key"), now_s=self._clock())
            await _send(send, 200, {"session": session, "role": role})
        elif endpoint == ("POST", "/keys"):
            await _send(send, 200, self._new_key(request, await _body(receive)))
        elif endpoint == ("POST", "/operator"):
            key = _text(await _body(receive), "key")
            self._sessions.promote(request.session, key, now_s=self._clock())
            await _send(send, 200, {"role": "operate"})
        elif endpoint == ("POST", "/act"):
            self._sessions.check_operator(request.session, now_s=self._clock())
            body = await _body(receive)
            action = _text(body, "action")
            rest = {name: str(value) for name, value in body.items() if name != "action"}
            await _send(send, 200, await self._actions.operate(action, rest))
        elif endpoint == ("GET", "/stream"):
            self._sessions.role_of(request.session, now_s=self._clock())
            await self._stream(request, receive, send)
        elif request.method == "GET" and request.path.startswith("/page/"):
            self._sessions.role_of(request.session, now_s=self._clock())
            kind, data = await self._actions.page(request.path.removeprefix("/page/"), request.query)
            await _send_bytes(send, 200, kind, data)
        else:
            raise NotFound("there is no such page", hint="open /")

    def _new_key(self, request: _Request, body: Mapping[str, Any]) -> dict[str, Any]:
        if not carries_token(request.headers.get("authorization", ""), self._admin_token()):
            raise Unauthorized("a key is made for the token of the control ports only", hint="rse-pf fleet")
        role: Role = "operate" if body.get("role") == "operate" else "view"
        return {"key": self._sessions.new_key(role, now_s=self._clock()), "role": role}

    async def _send_file(self, request: _Request, file: StaticFile, send: Send) -> None:
        same = request.headers.get("if-none-match") == file.etag
        headers = ((b"etag", file.etag.encode()), (b"cache-control", b"no-cache"))
        data = b"" if same or request.method == "HEAD" else file.data
        await _send_bytes(send, 304 if same else 200, file.media_type, data, headers)

    async def _stream(self, request: _Request, receive: Receive, send: Send) -> None:
        names = request.query.get("topics", "").split(",")
        topics = frozenset(topic for topic in names if topic in _TOPICS or topic.startswith(_LIVE))
        if not topics or len(topics) > len(_TOPICS) + 1:
            raise BadRequest("a stream needs topics", hint=f"some of {', '.join(sorted(_TOPICS))}, live/MAP")
        messages = self._hub.messages(topics)
        async with contextlib.aclosing(messages):
            # Raises Busy, before the answer begins, if too many pages are open.
            first = await messages.__anext__()
            await send(_start(200, b"text/event-stream", ((b"cache-control", b"no-store"),)))
            await send({"type": "http.response.body", "body": first, "more_body": True})
            sending = asyncio.ensure_future(self._send_messages(request, messages, send))
            leaving = asyncio.ensure_future(_wait_until_left(receive))
            try:
                await asyncio.wait({sending, leaving}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in (sending, leaving):
                    task.cancel()
                await asyncio.wait({sending, leaving})
        if not sending.cancelled():
            sending.result()

    async def _send_messages(self, request: _Request, messages: AsyncIterator[bytes], send: Send) -> None:
        async for message in messages:
            # uvicorn waits here for a slow browser, and raises no error for a closed connection.
            await send({"type": "http.response.body", "body": message, "more_body": True})
            self._sessions.role_of(request.session, now_s=self._clock())


async def _wait_until_left(receive: Receive) -> None:
    """Wait until the browser disconnects, so that its stream ends at once, and not at the next message."""
    while (await receive())["type"] != "http.disconnect":
        pass


async def _body(receive: Receive) -> dict[str, Any]:
    """Return the body of a request, a JSON object.

    Raises:
        BadRequest: The body is no JSON object, or the browser disconnected.
        LimitExceeded: The body has more than 4096 bytes.
    """
    data = b""
    while True:
        part = await receive()
        if part["type"] != "http.request":
            raise BadRequest("the browser disconnected before its request was complete", hint="try again")
        data += part.get("body", b"")
        if len(data) > _MAX_BODY_BYTES:
            raise LimitExceeded(f"a request has more than {_MAX_BODY_BYTES} bytes", hint="send less")
        if not part.get("more_body"):
            break
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        body = None
    if not isinstance(body, dict):
        raise BadRequest("the body of the request is no JSON object", hint="send a JSON object")
    return body


def _text(body: Mapping[str, Any], name: str) -> str:
    value = body.get(name)
    if not isinstance(value, str) or not value or len(value) > 200:
        raise BadRequest(f"{name} is no text of 1 to 200 letters", hint=f"send {name}")
    return value


def _error_document(error: RsePfError) -> dict[str, Any]:
    return {"code": error.code, "message": printable(error.message), "hint": printable(error.hint)}


def _start(status: int, kind: bytes, more: tuple[tuple[bytes, bytes], ...]) -> MutableMapping[str, Any]:
    headers = [(b"content-type", kind), *_HEADERS, *more]
    return {"type": "http.response.start", "status": status, "headers": headers}


async def _send(send: Send, status: int, value: Mapping[str, Any]) -> None:
    await _send_bytes(send, status, "application/json", json.dumps(value, default=str).encode())


async def _send_bytes(
    send: Send, status: int, kind: str, data: bytes,
    more: tuple[tuple[bytes, bytes], ...] = ((b"cache-control", b"no-store"),),
) -> None:  # fmt: skip
    length = (b"content-length", str(len(data)).encode())
    await send(_start(status, kind.encode(), (length, *more)))
    await send({"type": "http.response.body", "body": data})
