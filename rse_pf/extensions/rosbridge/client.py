"""Serve one rosbridge client: connect a robot with the client's token, and execute the client's operations.

The platform validates the token, and decides which services the client may call and how many commands it may
send.
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
from rse_pf.extensions.rosbridge.operations import Operation, read_head, read_operation, refusal, response
from rse_pf.extensions.rosbridge.sender import TopicSender
from rse_pf.extensions.rosbridge.topics import TopicClient, Topics
from rse_pf.limits.budget import Budget
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire.rate_limit import command_burst
from rse_pf.wire.server_session import CLOSE_REPLACED, CLOSE_TOKEN_OVER

__all__ = ["Client"]

# WebSocket close code (registry of RFC 6455) if the platform cannot be reached now.
_TRY_AGAIN_LATER = 1013
# Largest message of a client that has not sent its token yet, in bytes.
_MAX_AUTH_BYTES = 8192
# Largest number of messages of a client that has not sent its token; then it is closed.
_MAX_WITHOUT_TOKEN = 10
# Pause before a client with a rejected token is closed, in seconds, so that an address can try few tokens.
_REJECTION_PAUSE_S = 1.0
# Time, in ms, after which a client with too many unanswered calls may try again; stated in the error.
_BUSY_RETRY_MS = 200.0
# Levels of ``set_level`` with which a client receives status messages about errors.
_ERROR_LEVELS = ("error", "warning", "info")


class Client:
    """One rosbridge client, and the SDK robot that is connected to the platform for it."""

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
        """Describe a client whose WebSocket is open; `serve` reads from it.

        Args:
            socket: The WebSocket of the client.
            url: Address of the platform.
            token: The token in the client's handshake; empty if there is none.
            topics: The topics of all clients of this process.
            services: Names of the platform's services.
            session: Settings with the limits of a robot's connection.
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
        """Serve until the client disconnects or is rejected.

        Call *authenticated* when its token is accepted.
        """
        with contextlib.suppress(ConnectionClosed):
            try:
                if not self._token:
                    await self._await_token()
                if not await self._connect():
                    return
                identity = self._identity = self._identify()
            except RsePfError as error:
                await self._robot.close()
                await asyncio.sleep(_REJECTION_PAUSE_S)
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

    # --- authentication of the client ----------------------------------------------------------

    async def _connect(self) -> bool:
        """Connect the robot to the platform and return True; return False if the client disconnected first.

        An error of the connection is raised.
        """

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
        """Read messages until ``auth`` with a token arrives, and store the token.

        The server closes a client for which this takes too long.

        Raises:
            Unauthorized: The client sent ten other messages, or one of more than 8192 bytes.
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
        """Store *token*, which the client sent before the old one expires, for the next renewal.

        Raises:
            Unauthorized: The token names another robot.
        """
        if claimed_by(token).get("claimed_robot") != identity.robot:
            raise Unauthorized("this is no token of this robot", hint="the former token stays in use")
        self._token = token

    async def _fresh_token(self) -> str:
        return self._token

    def _identify(self) -> TopicClient:
        """Return robot, tenant and scopes of the client, as the platform's welcome states them.

        On a renewed connection only the scopes are updated.

        Raises:
            Disconnected: The platform closed the connection.
            UnsupportedProtocol: The backend server is of a version that does not name tenants.
            Unauthorized: The token is of another robot than that of the connection before.
        """
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
        """Handle a *change* of the robot's connection.

        A client that the platform rejects is closed.  After a reconnection or migration the identity is
        checked again.
        """
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
        """Send the client *error*, and close the WebSocket with a close code for it."""
        code = _TRY_AGAIN_LATER
        if isinstance(error, Unauthorized):
            code = CLOSE_TOKEN_OVER
        elif isinstance(error, Conflict):
            code = CLOSE_REPLACED
        with contextlib.suppress(ConnectionClosed):
            await self._write(refusal(Operation(op="auth"), error))
            await self._socket.close(code, error.code)

    # --- execution of the client's operations --------------------------------------------------

    async def _take(self, data: bytes, identity: TopicClient) -> None:
        """Execute the operation in the message *data*, or send the client the error."""
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
            # No message of this client is read during the pause.
            await asyncio.sleep(1e-3 * (error.retry_after_ms or 0.0))
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
                retry_after_ms=_BUSY_RETRY_MS,
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
        """Return the values for a call of ``/rosapi/<what>``, with which clients list services and topics.

        Raises:
            UnknownService: *what* is not supported.
        """
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
        """Send *text* to the client.

        Cut the connection if the client does not read it within the ping timeout.
        """
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
    """Return the decoded arguments of *call*; raises BadRequest if they are malformed."""
    try:
        return msgspec.json.decode(call.args)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise BadRequest(f"{call.service}: {str(error)[:150]}", hint="send finite numbers") from error


def _argument(call: Operation, name: str) -> str:
    """Return the argument *name* of a ``rosapi`` call without its leading slash, empty if it is missing.

    Raises:
        BadRequest: The arguments are no JSON object of texts.
    """
    try:
        value = msgspec.json.decode(call.args, type=dict[str, str]).get(name, "")
    except msgspec.DecodeError as error:
        raise BadRequest(
            f"rosapi: {str(error)[:150]}", hint=f'send the arguments {{"{name}": "NAME"}}'
        ) from error
    return value.removeprefix("/")
