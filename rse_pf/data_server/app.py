"""The data service as an ASGI application: find the route, check the token, call the handler, reply.

It is plain ASGI because it consists of one table of routes and bodies with limits.  Every request gets a
reply with a status and, on failure, a code; no token and no payload is logged.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import re
import time
import uuid
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from rse_pf.audit.entry import RefusalLimiter
from rse_pf.audit.log import AuditLog
from rse_pf.auth.claimed import claimed_by, source_address
from rse_pf.auth.origins import AllowedOrigins
from rse_pf.auth.roster import scopes_allow
from rse_pf.auth.tokens import Claims, KeySet, token_problem, verify_token
from rse_pf.config import PlatformSettings
from rse_pf.data_server import map_describer, photo_localiser
from rse_pf.data_server.cross_origin import is_preflight, preflight_reply, shared_reply
from rse_pf.data_server.handlers import Handler, Handlers, MapWork
from rse_pf.data_server.http import (
    HttpReply,
    HttpRequest,
    MethodNotAllowed,
    Receive,
    Send,
    failure_reply,
)
from rse_pf.data_server.map_describer import MapDescriber
from rse_pf.data_server.photo_localiser import PhotoLocaliser
from rse_pf.data_server.request_limits import RequestLimits
from rse_pf.data_server.robot_processes import RobotProcesses
from rse_pf.data_server.routes import PHOTO_COST, ROUTES, Route
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
from rse_pf.identity import RobotId
from rse_pf.maps.describe import MapSummary
from rse_pf.storage.object_store import ObjectStore

__all__ = ["DataServer"]

# The claims of a request for a route without a scope, whose token is not read.
_ANONYMOUS = Claims(robot=RobotId("", ""), token_id="", issued_s=0.0, expires_s=0.0, key_id="")
_PROBES = ("/data/healthz", "/data/readyz")  # paths of health checks, whose requests are not logged
_RETRY_AFTER_MS = 1000.0  # Retry-After while the server has no keys: the key file is read every 0.5 s
_REQUEST_TIMEOUT = 408  # HTTP status of a body that came too slowly
_REFUSAL_PAUSE_S = 0.25  # delay of a rate-limit refusal: each connection gets at most four of them a second


class DataServer:
    """The data service as an ASGI application: call it with ``(scope, receive, send)`` for each request."""

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
        describe: Callable[[RobotId, str], MapSummary] | None = None,
        localiser: PhotoLocaliser | None = None,
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        """Make the application; nothing is read or started yet.

        Args:
            settings: Groups data and auth.
            store: Holds objects and maps.
            keys: Returns the keys that may sign tokens, for each request; None refuses all.
            log: Gets one line for each request.
            clock: Monotonic seconds.
            wall_clock: Unix seconds.
            audit: Records refused tokens and changes of maps; None records nothing.
            describe: Returns the summary of the map in a robot's object, given the robot and the object's
                name; None computes the summary in a process with limits on memory and CPU time.
            localiser: Localises photos; None localises them in processes with limits on memory and CPU time.
            pause: Waits for a time in seconds; called before the refusal of a robot above its limits is sent.
        """
        self._audit = audit
        self._refusals = RefusalLimiter()
        self._settings = settings
        self._keys = keys
        self._log = log
        self._clock = clock
        self._wall_clock = wall_clock
        self._pause = pause
        self._limits = RequestLimits(settings.data)
        self._origins = AllowedOrigins(settings.serving.allowed_origins)
        self._closing = contextlib.ExitStack()
        if describe is None:
            describer = MapDescriber(RobotProcesses(map_describer.TARGET, settings, store, clock))
            describe = describer.describe
            self._closing.callback(describer.close)
        if localiser is None:
            processes = RobotProcesses(
                photo_localiser.TARGET, settings, store, clock, count=photo_localiser.PROCESSES
            )
            localiser = PhotoLocaliser(processes)
        self._closing.callback(localiser.close)
        self.handlers = Handlers(
            store, settings.data, MapWork(describe, localiser, self._charge_photo), clock=clock,
            wall_clock=wall_clock, audit=audit,
        )  # fmt: skip
        self._routes: dict[str, list[tuple[re.Pattern[str], Route, Handler]]] = {}
        for route in ROUTES:
            handler = getattr(self.handlers, route.operation)
            self._routes.setdefault(route.method, []).append((route.pattern, route, handler))

    async def __call__(self, scope: Mapping[str, Any], receive: Receive, send: Send) -> None:
        """Reply to one HTTP request and log it; raise BadRequest if *scope* is not one of HTTP.

        The server cancels this call when the robot closes the connection: then the work for the request
        stops, and no reply is sent.
        """
        if scope["type"] != "http":
            raise BadRequest(f"{scope['type']} is not supported", hint="use HTTP")
        began = self._clock()
        request = HttpRequest(scope, receive, self._clock)
        line: dict[str, Any] = {"event": "request", "method": request.method}
        try:
            reply = await self._reply(request, line)
            sent = await _send(reply, request, send)
            line |= {"status": reply.status, "sent_bytes": sent}
        except Disconnected:
            line["status"] = "disconnected"
        except asyncio.CancelledError:  # the robot closed the connection and waits for no reply
            line["status"] = "disconnected"
            raise
        finally:
            self._limits.end(request)
            line["received_bytes"] = request.received_bytes
            line["took_ms"] = round(1000 * (self._clock() - began), 2)
            if request.path not in _PROBES:
                self._log(line)

    async def _reply(self, request: HttpRequest, line: dict[str, Any]) -> HttpReply:
        origin, shared_with = request.headers.get("origin", ""), ""
        try:
            self._origins.check(origin, request.headers.get("host", ""))
            shared_with = origin
            reply = await self._handle(request, line)
        except Disconnected:
            raise
        except RsePfError as error:
            line["code"] = error.code
            reply = failure_reply(error)
        except Exception as error:  # noqa: BLE001 - a defect: the reply is 500 with the id of its log line
            trace = uuid.uuid4().hex
            line |= {"code": InternalError.code, "trace": trace, "error": repr(error)[:500]}
            reply = failure_reply(InternalError("the data server failed", hint=f"search its log for {trace}"))
        # A reply may be ready before the body was read.  If the rest of the body arrives within 0.1 s, the
        # connection stays open for the next request; otherwise it is closed after the reply.
        if not request.is_complete and (
            reply.status == _REQUEST_TIMEOUT or not await request.drain_soon(self._settings.data.part_bytes)
        ):
            reply = dataclasses.replace(reply, headers={**reply.headers, "Connection": "close"})
        return shared_reply(reply, shared_with)

    async def _handle(self, request: HttpRequest, line: dict[str, Any]) -> HttpReply:
        if is_preflight(request):
            line["operation"] = "preflight"
            return preflight_reply(self._methods(request.path))
        route, handler, path = self._find(request)
        line["operation"] = route.operation
        if route.scope is None:
            return await handler(request, _ANONYMOUS, path)
        claims = self._claims(request, route.scope, path.get("name", ""), line)
        has_body = route.body is not None
        try:
            self._limits.begin(request, claims.robot, route.cost, self._clock(), has_body=has_body)
        except Busy:
            await self._pause(
                _REFUSAL_PAUSE_S
            )  # the connection cannot send its next request before the reply
            raise
        if not has_body and not await request.drain(self._settings.data.part_bytes):
            raise BadRequest(
                "this request takes no body, and its body is too long or too slow", hint="leave it out"
            )
        try:
            return await handler(request, claims, path)
        except RsePfError:
            body_bytes = max(request.received_bytes, request.header_number("content-length") or 0)
            self._limits.charge_refused(claims.robot, body_bytes, self._clock())
            raise

    def _find(self, request: HttpRequest) -> tuple[Route, Handler, dict[str, str]]:
        for pattern, route, handler in self._routes.get(request.method, ()):
            match = pattern.fullmatch(request.path)
            if match:
                return route, handler, match.groupdict()
        raise MethodNotAllowed(", ".join(self._methods(request.path)))

    def _methods(self, path: str) -> list[str]:
        """Return the HTTP methods of all routes that match *path*; raises NotFound if no route does."""
        methods = [route.method for route in ROUTES if route.pattern.fullmatch(path)]
        if not methods:
            raise NotFound("no such path", hint="see /data/openapi.json")
        return methods

    def _claims(self, request: HttpRequest, scope: str, name: str, line: dict[str, Any]) -> Claims:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        token = token.strip() if kind.lower() == "bearer" else ""
        keys = self._keys()
        if keys is None:
            raise Busy("the service has no keys yet", hint="retry later", retry_after_ms=_RETRY_AFTER_MS)
        try:
            claims = verify_token(token, keys=keys, now=self._wall_clock(), settings=self._settings.auth)
        except Unauthorized as error:
            source = source_address(
                request.peer,
                request.headers.get("x-forwarded-for", ""),
                self._settings.serving.trusted_proxies,
            )
            about = {"reason": token_problem(error), "source": source, **claimed_by(token, keys)}
            line |= about
            if self._audit is not None and self._refusals.take(line["reason"], self._clock()):
                self.record_counted()
                self._audit.record("auth.refused", **about)
            raise
        line["tenant"], line["robot"] = claims.robot.tenant, claims.robot.name
        if not scopes_allow(claims.scopes, scope, name):
            raise Forbidden(f"this token does not have the scope {scope}", hint="issue another token")
        return claims

    def _charge_photo(self, robot: RobotId, cpu_s: float) -> None:
        self._limits.charge_cpu(robot, cpu_s, PHOTO_COST, self._clock())

    def close(self) -> None:
        """Stop the processes that read maps, then wait until the handlers' threads have finished."""
        self._closing.close()
        self.handlers.close()

    def record_counted(self) -> None:
        """Write the number of refused tokens that were not audited one by one since the last call, by reason.

        Nothing is written if there were none, or if there is no audit log.
        """
        counted = self._refusals.summary()
        if self._audit is not None and counted:
            self._audit.record("auth.refused-many", **counted)


async def _send(reply: HttpReply, request: HttpRequest, send: Send) -> int:
    """Send *reply* to the client; return how many bytes of its body were sent."""
    body = reply.body
    headers = {"Content-Type": reply.media_type, "Cache-Control": "no-store", **reply.headers}
    if isinstance(body, bytes) and reply.status not in (204, 304):
        headers.setdefault("Content-Length", str(len(body)))
    raw = [(name.lower().encode("latin-1"), value.encode("latin-1")) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": reply.status, "headers": raw})
    is_open = not request.is_complete  # the robot still sends its body while this reply is sent
    sent, body = 0, b"" if request.method == "HEAD" else body
    if isinstance(body, bytes):
        sent = len(body)
        await send({"type": "http.response.body", "body": body, "more_body": is_open})
    else:
        size = int(headers["Content-Length"])
        async for piece in body:
            sent += len(piece)
            # A client that has the last byte may send its next request at once, so no empty piece follows it.
            await send({"type": "http.response.body", "body": piece, "more_body": is_open or sent < size})
            await asyncio.sleep(0)  # other requests are served between two pieces, also if `send` never waits
    if is_open:  # the connection is closed after this reply
        if reply.status != _REQUEST_TIMEOUT:
            await request.discard()
        await send({"type": "http.response.body", "body": b"", "more_body": False})
    return sent
