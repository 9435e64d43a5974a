"""Serve one rosbridge client: connect a robot with its token, and execute its operations.

The platform decides about the token, the services and the limits of commands; nothing is decided here that it
decides.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Any

import msgspec
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from client_sdk.robot import MAX_DEADLINE_S, Robot
from rse_pf.auth.claimed import claimed_by
from rse_pf.config import SessionSettings
from rse_pf.errors import (
    BadRequest,
    Busy,
    Conflict,
    Disconnected,
    RsePfError,
    Unauthorized,
    UnknownService,
    UnsupportedProtocol,
)
from rse_pf.extensions.rosbridge.messages import Operation, read_head, read_operation, refusal, response
from rse_pf.extensions.rosbridge.sender import TopicSender
from rse_pf.extensions.rosbridge.topics import TopicClient, Topics
from rse_pf.limits.budget import Budget
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire.rate_limit import command_burst
from rse_pf.wire.server_session import CLOSE_REPLACED, CLOSE_TOKEN_OVER

__all__ = ["Client"]

_TRY_AGAIN_LATER = 1013  # close code of RFC 6455's registry: the platform cannot be reached now
_MAX_AUTH_BYTES = 8192  # of a message that comes before the token
_MAX_WITHOUT_TOKEN = 10  # messages, after which a client without a token is closed
_REFUSED_S = 1.0  # an unauthenticated client is closed this much later: an address tries few tokens a second
_BUSY_MS = 200.0  # after this a client with too many unanswered calls may try again
_ERROR_LEVELS = ("error", "warning", "info")  # of set_level: those with which a client gets errors


class Client:
    """One client and its robot."""

    def __init__(
        self,
        socket: ServerConnection,
        *,
        url: str,
        token: str,
        topics: Topics,
        services: tuple[str, ...],
        session: SessionSettings,
    ) -> None:
        """Describe a client whose WebSocket is open; `serve` does the rest.

        Args:
            socket: The WebSocket.
            url: Of the platform.
            token: That the client sent in its handshake; empty if it sent none.
            topics: Of all clients.
            services: Names of the platform's services.
            session: The limits of a robot.
        """
        self._socket, self._topics, self._services, self._session = socket, topics, services, session
        self._token = token
        self._budget = Budget.of_messages(session)
        rate = session.max_commands_per_s
        self._rate = TokenBucket(rate, command_burst(rate)) if rate > 0 else None
        self._gets_errors = True
        self._sender = TopicSender(write=self._write, ping=socket.ping, clock=time.monotonic)
        self._robot = Robot(
            url, token=self._fresh_token, codec="json", settings=session, on_change=self._follow_robot
        )
        self._identity: TopicClient | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def serve(self, authenticated: Callable[[], object]) -> None:
        """Serve until the client leaves or is refused; call *authenticated* when its token is accepted."""
        with contextlib.suppress(ConnectionClosed):
            try:
                if not self._token:
                    await self._await_token()
                if not await self._connect():
                    return
                identity = self._identity = self._identify()
            except RsePfError as error:
                await self._robot.close()
                await asyncio.sleep(_REFUSED_S)
                await self._end(error)
                return
            authenticated()
            reading = asyncio.ensure_future(self._read(identity))
            sending = asyncio.ensure_future(self._sender.run())
            try:
                ended, _ = await asyncio.wait({reading, sending}, return_when=asyncio.FIRST_COMPLETED)
                ended.pop().result()
            finally:
                self._topics.leave(identity)
                tasks = {reading, sending, *self._tasks}
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                await self._robot.close()

    async def _read(self, identity: TopicClient) -> None:
        while True:
            await self._take(await self._socket.recv(decode=False), identity)

    # --- who it is -----------------------------------------------------------------------------

    async def _connect(self) -> bool:
        """Connect the robot, and return True; False if the client left meanwhile."""

        async def connect() -> None:
            await self._robot

        connecting = asyncio.ensure_future(connect())
        left = asyncio.ensure_future(self._socket.wait_closed())
        await asyncio.wait({connecting, left}, return_when=asyncio.FIRST_COMPLETED)
        left.cancel()
        if connecting.done():
            connecting.result()
            return True
        connecting.cancel()
        await asyncio.gather(connecting, return_exceptions=True)
        await self._robot.close()
        return False

    async def _await_token(self) -> None:
        """Read until ``auth`` brings a token; the server bounds the time.

        Raises:
            Unauthorized: Other messages came, too many or a long one.
        """
        for _ in range(_MAX_WITHOUT_TOKEN):
            data = await self._socket.recv(decode=False)
            if len(data) > _MAX_AUTH_BYTES:
                break
            try:
                operation = read_operation(data, self._budget)
                if operation.op != "auth" or not operation.mac:
                    raise Unauthorized("no token was sent yet", hint="send auth with the token as mac first")
                self._token = operation.mac
                return
            except RsePfError as error:
                await self._refuse(data, error)
        raise Unauthorized("no token was sent", hint="send auth with the token as mac first")

    def _take_fresh_token(self, token: str, identity: TopicClient) -> None:
        """Keep *token* for the next renewal; raise Unauthorized for one of another robot."""
        if claimed_by(token).get("claimed_robot") != identity.robot:
            raise Unauthorized("this is no token of this robot", hint="the former token stays in use")
        self._token = token

    async def _fresh_token(self) -> str:
        return self._token

    def _identify(self) -> TopicClient:
        """Return who the client is by its welcome; raises RsePfError if it was another robot before."""
        welcome, before = self._robot.welcome, self._identity
        if welcome is None:
            raise Disconnected("the platform closed the connection", hint="connect again")
        if welcome.tenant is None:
            raise UnsupportedProtocol("the server does not name tenants", hint="upgrade the backend servers")
        identity = TopicClient(
            robot=welcome.robot, tenant=welcome.tenant, scopes=welcome.scopes, sender=self._sender
        )
        if before is None:
            return identity
        if (before.tenant, before.robot) != (identity.tenant, identity.robot):
            raise Unauthorized("the fresh token is of another robot", hint="connect again with that token")
        before.scopes = identity.scopes
        return before

    def _follow_robot(self, change: str, _: str) -> None:
        """End a client that the platform refuses, and check who it is on a new connection."""
        if self._identity is None:
            return
        error = self._robot.failure if change == "refused" else None
        if change in ("link-back", "moved"):
            try:
                self._identify()
            except RsePfError as changed:
                error = changed if self._robot.connected else None
        if error is not None:
            self._spawn(self._end(error))

    async def _end(self, error: RsePfError) -> None:
        """Send the reason, and close the WebSocket."""
        code = _TRY_AGAIN_LATER
        if isinstance(error, Unauthorized):
            code = CLOSE_TOKEN_OVER
        elif isinstance(error, Conflict):
            code = CLOSE_REPLACED
        with contextlib.suppress(ConnectionClosed):
            await self._write(refusal(Operation(op="auth"), error))
            await self._socket.close(code, error.code)

    # --- operations ----------------------------------------------------------------------------

    async def _take(self, data: bytes, identity: TopicClient) -> None:
        """Execute the operation in one message, or say why not."""
        try:
            wait_s = 0.0 if self._rate is None else self._rate.take(time.monotonic())
            if wait_s > 0:
                raise Busy(
                    f"more than {self._session.max_commands_per_s:g} messages a second of this robot",
                    hint="send fewer, or raise session.max_commands_per_s",
                    retry_after_ms=1e3 * wait_s,
                )
            operation = read_operation(data, self._budget)
            if operation.op == "call_service":
                await self._begin_call(operation, identity)
            elif operation.op == "auth":
                self._take_fresh_token(operation.mac, identity)
            elif operation.op == "set_level":
                self._gets_errors = operation.level in _ERROR_LEVELS
            elif operation.op != "status":
                self._topics.execute(identity, operation)
        except Busy as error:
            await self._refuse(data, error)
            await asyncio.sleep(1e-3 * (error.retry_after_ms or 0.0))  # so that a flood is not read
        except RsePfError as error:
            await self._refuse(data, error)

    async def _begin_call(self, call: Operation, identity: TopicClient) -> None:
        name = call.service.removeprefix("/")
        if name.startswith("rosapi/"):
            await self._write(response(call, self._describe(name.removeprefix("rosapi/"), call, identity)))
            return
        if len(self._tasks) >= self._session.max_in_flight:
            raise Busy(
                f"{len(self._tasks)} calls of this robot are unanswered",
                hint="wait for answers before sending more",
                retry_after_ms=_BUSY_MS,
            )
        self._spawn(self._call(name, call))

    async def _call(self, name: str, call: Operation) -> None:
        timeout_s = call.timeout if call.timeout and 0 < call.timeout <= MAX_DEADLINE_S else None
        try:
            request = _decoded(call) if bytes(call.args) not in (b"", b"[]") else None
            answer = await self._robot.call(name, request, deadline_s=timeout_s)
            is_stored = answer.reply is None and answer.object
            reply = response(call, {"object": answer.object} if is_stored else answer.reply)
        except RsePfError as error:
            reply = refusal(call, error)
        with contextlib.suppress(ConnectionClosed):
            await self._write(reply)

    def _describe(self, what: str, call: Operation, identity: TopicClient) -> dict[str, Any]:
        """Answer one of the calls of ``rosapi`` that clients need to find services and topics."""
        services = [name for name in self._services if identity.may(f"services:{name}")]
        types = self._topics.readable_by(identity)
        if what == "services":
            return {"services": [f"/{name}" for name in services]}
        if what == "topics":
            return {"topics": [f"/{name}" for name in types], "types": list(types.values())}
        if what == "service_type":
            name = _argument(call, "service")
            return {"type": f"rse_pf/{name}" if name in services else ""}
        if what == "topic_type":
            return {"type": types.get(_argument(call, "topic"), "")}
        raise UnknownService(
            f"rosapi offers no {what[:40]!r} here",
            hint="choose /rosapi/services, /rosapi/topics, /rosapi/service_type or /rosapi/topic_type",
        )

    async def _refuse(self, data: bytes, error: RsePfError) -> None:
        head = read_head(data)
        if head.op == "call_service" or self._gets_errors:
            await self._write(refusal(head, error))

    async def _write(self, text: bytes) -> None:
        """Send a message; a client that takes none of it for long is cut off."""
        within_s = self._session.ping_interval_s + self._session.ping_timeout_s
        try:
            await asyncio.wait_for(self._socket.send(text, text=True), within_s)
        except asyncio.TimeoutError:
            self._socket.transport.abort()

    def _spawn(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _decoded(call: Operation) -> Any:
    """Return the arguments of a call; raises BadRequest."""
    try:
        return msgspec.json.decode(call.args)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise BadRequest(f"{call.service}: {str(error)[:150]}", hint="send finite numbers") from error


def _argument(call: Operation, name: str) -> str:
    """Return the argument *name* of a call of ``rosapi``, without a slash before it; raises BadRequest."""
    try:
        value = msgspec.json.decode(call.args, type=dict[str, str]).get(name, "")
    except msgspec.DecodeError as error:
        raise BadRequest(f"rosapi: {str(error)[:150]}", hint=f"send {name}") from error
    return value.removeprefix("/")
