"""The data service as an ASGI application: find the route, ask for the token, answer.

Plain ASGI, because the whole of it is one table of routes and a body with limits; a framework would add
a second way to say each.  Promises that whatever comes in, an answer with a code goes out, and that no
token and no payload is logged.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

from rse_pf.audit.chain import Note, RefusalLimiter
from rse_pf.audit.log import AuditLog
from rse_pf.auth.roster import holds
from rse_pf.auth.tokens import Claims, KeySet, token_problem, verify_token
from rse_pf.config import PlatformSettings
from rse_pf.data_server.handlers import Handler, Handlers
from rse_pf.data_server.http import HttpReply, HttpRequest, MethodNotAllowed, Receive, Send, failure_reply
from rse_pf.data_server.routes import ROUTES, Route
from rse_pf.errors import (
    BadRequest,
    Busy,
    Disconnected,
    Forbidden,
    InternalError,
    NotFound,
    RsePfError,
    Unauthorized,
)
from rse_pf.object_store import ObjectStore

__all__ = ["DataServer"]

_NOBODY = Claims(robot="", token_id="", issued_s=0.0, expires_s=0.0, key_id="")
_PROBES = ("/data/healthz", "/data/readyz")
_COME_AGAIN_MS = 1000.0
_TOO_SLOW = 408


class DataServer:
    """The application; call it with ``(scope, receive, send)``."""

    def __init__(
        self,
        settings: PlatformSettings,
        store: ObjectStore,
        *,
        keys: Callable[[], KeySet | None],
        log: Callable[[dict[str, Any]], None],
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        audit: AuditLog | None = None,
    ) -> None:
        """Make the application.

        Args:
            settings: Groups data and auth.
            store: Where everything lives.
            keys: Who may sign tokens, asked for each request; None refuses all.
            log: Gets one line for each request.
            clock: Monotonic seconds.
            wall_clock: Unix seconds.
            audit: Gets refused tokens and changes of maps; None records nothing.
        """
        self._audit = audit
        self._refusals = RefusalLimiter()
        self._settings = settings
        self._keys = keys
        self._log = log
        self._clock = clock
        self._wall_clock = wall_clock
        self._bodies = 0
        self.handlers = Handlers(store, settings.data, clock=clock, wall_clock=wall_clock, audit=audit)
        self._routes = [(route.pattern, route, _handler(self.handlers, route)) for route in ROUTES]

    async def __call__(self, scope: Mapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            raise BadRequest(f"{scope['type']} is not offered here", hint="speak HTTP")
        began = self._clock()
        request = HttpRequest(scope, receive, self._clock, self._settings.data)
        said: dict[str, Any] = {"event": "request", "method": request.method}
        try:
            reply = await self._answer(request, said)
            sent = await _send(reply, request, send)
        except Disconnected:
            said["status"] = "left"
        else:
            said |= {"status": reply.status, "sent_bytes": sent}
        said |= {
            "received_bytes": request.received_bytes,
            "took_ms": round(1000 * (self._clock() - began), 2),
        }
        if request.path not in _PROBES:
            self._log(said)

    async def _answer(self, request: HttpRequest, said: dict[str, Any]) -> HttpReply:
        try:
            reply = await self._handled(request, said)
        except Disconnected:
            raise
        except RsePfError as error:
            said["code"] = error.code
            reply = failure_reply(error)
        except Exception as error:  # noqa: BLE001 - the last wall: it becomes a 500 with an id for the log
            trace = uuid.uuid4().hex
            said |= {"code": InternalError.code, "trace": trace, "error": repr(error)[:500]}
            reply = failure_reply(InternalError("the data server failed", hint=f"its log has {trace}"))
        if not request.over and (reply.status == _TOO_SLOW or not await self._drained(request)):
            reply = HttpReply(
                status=reply.status, body=reply.body, media_type=reply.media_type,
                headers={**reply.headers, "Connection": "close"},
            )  # fmt: skip
        return reply

    async def _drained(self, request: HttpRequest) -> bool:
        """Read the rest of a small body, so that the robot hears us before the connection closes."""
        try:
            return await request.drain(self._settings.data.part_bytes)
        except Disconnected:
            raise
        except RsePfError:
            return False

    async def _handled(self, request: HttpRequest, said: dict[str, Any]) -> HttpReply:
        route, handler, path = self._find(request)
        said["operation"] = route.operation
        who = _NOBODY if route.scope is None else self._who(request, route.scope, path.get("name", ""), said)
        if route.body is None:
            return await handler(request, who, path)
        if self._bodies >= self._settings.data.max_uploads:
            raise Busy("too many uploads at once", hint="come again", retry_after_ms=_COME_AGAIN_MS)
        self._bodies += 1
        try:
            return await handler(request, who, path)
        finally:
            self._bodies -= 1

    def _find(self, request: HttpRequest) -> tuple[Route, Handler, dict[str, str]]:
        others = []
        for pattern, route, handler in self._routes:
            found = pattern.fullmatch(request.path)
            if found and route.method == request.method:
                return route, handler, found.groupdict()
            if found:
                others.append(route.method)
        if others:
            refused = MethodNotAllowed("this method is not offered here", hint=f"use {', '.join(others)}")
            refused.allowed = ", ".join(others)
            raise refused
        raise NotFound("there is nothing here", hint="see /data/openapi.json")

    def _who(self, request: HttpRequest, scope: str, name: str, said: dict[str, Any]) -> Claims:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        keys = self._keys()
        if keys is None:
            raise Busy("no keys have arrived yet", hint="come again", retry_after_ms=_COME_AGAIN_MS)
        try:
            who = verify_token(
                token.strip() if kind.lower() == "bearer" else "",
                keys=keys, now=self._wall_clock(), settings=self._settings.auth,
            )  # fmt: skip
        except Unauthorized as error:
            said["reason"] = token_problem(error)
            self._record_refusal(said["reason"])
            raise
        said["robot"] = who.robot
        if not holds(who.scopes, scope, name):
            raise Forbidden(f"this token does not hold the scope {scope}", hint="issue one that does")
        return who

    def record_counted(self) -> None:
        """Record how many refusals were only counted since the last that was recorded."""
        counted = self._refusals.summary()
        if self._audit is not None and counted:
            now, who = self._wall_clock(), self._audit.who
            self._audit.add([Note(time=now, actor=who, action="auth.refused-many", detail=counted)])

    def _record_refusal(self, reason: str) -> None:
        if self._audit is not None and self._refusals.take(reason, self._clock()):
            self.record_counted()
            self._audit.record("auth.refused", reason=reason)


def _handler(handlers: Handlers, route: Route) -> Handler:
    found: Handler = getattr(handlers, route.operation)
    return found


async def _send(reply: HttpReply, request: HttpRequest, send: Send) -> int:
    """Send *reply*; return how many bytes of body went out."""
    body = reply.body
    headers = {"Content-Type": reply.media_type, "Cache-Control": "no-store", **reply.headers}
    if isinstance(body, bytes) and reply.status != 204:
        headers.setdefault("Content-Length", str(len(body)))
    raw = [(name.lower().encode("latin-1"), value.encode("latin-1")) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": reply.status, "headers": raw})
    sent = 0
    if request.method != "HEAD":
        async for piece in _pieces(body):
            await send({"type": "http.response.body", "body": piece, "more_body": True})
            sent += len(piece)
    await send({"type": "http.response.body", "body": b"", "more_body": False})
    return sent


async def _pieces(body: bytes | AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    if isinstance(body, bytes):
        if body:
            yield body
        return
    async for piece in body:
        yield piece
        await asyncio.sleep(0)  # a server whose send never waits must not starve the others
