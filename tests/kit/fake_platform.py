"""A fake load balancer with any number of servers behind it, in the event loop of the test.

Real sockets, the real `ServerSession`, the real `dispatch`.
"""

from __future__ import annotations

import asyncio
import http
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from rse_pf.config import BurstSettings, SessionSettings
from rse_pf.service import Registry, dispatch
from rse_pf.services import echo
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Result, Update, codec_for, make_codec
from rse_pf.wire.refusal import refusal_body
from rse_pf.wire.server_session import BeginUpdates, Close, EndUpdates, Send, ServerSession, Submit
from tests.kit import server_sessions

__all__ = ["FakePlatform", "FakeSocket", "echo_services"]

Answer = Result | Failure


def echo_services() -> Registry:
    """Return a registry with the echo service alone."""
    registry = Registry()
    echo.register(registry)
    return registry


class FakeSocket:
    """One robot's connection to one of the servers."""

    def __init__(self, platform: FakePlatform, server: str, websocket: ServerConnection) -> None:
        codec_name = codec_for([str(websocket.subprotocol)]) or "zlib"
        self.server = server
        self.websocket = websocket
        self.session = ServerSession(
            codec=make_codec(codec_name),
            robot="robot-1",
            server=server,
            session=f"s-{len(platform.sockets)}",
            limits=platform.settings,
            burst=platform.burst,
        )
        self.commands: list[Command] = []
        self.topics: dict[int, str] = {}
        self.muted = False
        self._platform = platform
        self._seq = 0

    async def serve(self) -> None:
        """Answer until the socket ends."""
        try:
            while True:
                data = await self.websocket.recv(decode=False)
                if not self.muted:
                    was_open = self.is_welcomed
                    await self._apply(server_sessions.receive(self.session, data, self._platform.clock()))
                    if not was_open:
                        self._platform.noticed()
        except ConnectionClosed:
            return

    async def _apply(self, decisions: list[Any]) -> None:
        for decision in decisions:
            if isinstance(decision, Send):
                await self.send(decision.data)
            elif isinstance(decision, Close):
                await self.websocket.close(decision.code, decision.reason)
            elif isinstance(decision, Submit):
                self.commands.append(decision.command)
                self._platform.submitted(self, decision.command)
            elif isinstance(decision, BeginUpdates):
                self.topics[decision.id] = decision.topic
                self._platform.noticed()
            elif isinstance(decision, EndUpdates):
                del self.topics[decision.id]
                self._platform.noticed()

    async def update(self, key: str, value: Any) -> None:
        """Send a value to every subscription of the socket."""
        self._seq += 1
        for identity, topic in self.topics.items():
            message = Update(id=identity, topic=topic, seq=self._seq, key=key, payload=value)
            await self.send(self.session.codec.encode(message))

    async def answer(self, message: Answer) -> None:
        """Send the final answer to a command, as the session would."""
        await self.send(server_sessions.answer(self.session, message).data)

    async def move(self, within_ms: float = 5000.0) -> None:
        """Ask the robot to leave this server."""
        await self._apply(self.session.move("drain", within_ms))

    async def send(self, data: bytes) -> None:
        """Write one WebSocket message, whatever it says."""
        try:
            await self.websocket.send(data, text=self.session.codec.is_text)
        except ConnectionClosed:
            return

    def cut(self) -> None:
        """End the socket as kill -9 of its server does."""
        self.websocket.transport.abort()

    @property
    def is_welcomed(self) -> bool:
        """Whether the robot said hello, and a Welcome was sent."""
        return self.session.state == "open"

    @property
    def is_open(self) -> bool:
        """Whether the robot could still send on it."""
        return self.websocket.close_code is None and not self.websocket.transport.is_closing()


class FakePlatform:
    """A load balancer on 127.0.0.1; ``landing`` names the server that the next robot meets.

    ``token`` is the only one accepted (None accepts any); ``refusals`` are HTTP statuses (with a
    Retry-After in seconds or None) for the next handshakes, with the mark of a server unless it
    ``refuses_as_firewall``, and with what is ``told`` in its body; ``hold`` keeps commands unanswered.
    """

    def __init__(
        self,
        *,
        settings: SessionSettings | None = None,
        registry: Registry | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = settings or SessionSettings()
        self.registry = registry or echo_services()
        self.clock = clock
        self.burst: BurstSettings | None = None
        self.landing = "server-a"
        self.token: str | None = None
        self.tokens_seen: list[str] = []
        self.refusals: list[tuple[int, int | None]] = []
        self.refuses_as_firewall = False
        self.refusal_members: dict[str, Any] = {}
        self.hold = False
        self.welcomes = True
        self.on_command: Callable[[FakeSocket, Command], Awaitable[Answer | None]] | None = None
        self.sockets: list[FakeSocket] = []
        self.handshakes: list[float] = []
        self._listener: Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._changed = asyncio.Condition()

    @property
    def port(self) -> int:
        """Where the listener listens."""
        assert self._listener is not None
        port: int = next(iter(self._listener.sockets)).getsockname()[1]
        return port

    @property
    def url(self) -> str:
        """What a robot connects to."""
        return f"ws://127.0.0.1:{self.port}/ws"

    async def __aenter__(self) -> FakePlatform:
        """Listen."""
        await self.listen()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Cut every socket and stop listening."""
        await self.stop()

    async def listen(self, port: int = 0) -> None:
        """Open the listener, at *port* if it matters."""
        self._listener = await serve(
            self._serve, "127.0.0.1", port, compression=None, ping_interval=None, close_timeout=1,
            process_request=self._check_handshake, subprotocols=list(SUBPROTOCOLS.values()),  # type: ignore[arg-type]
        )  # fmt: skip

    async def stop(self) -> None:
        """Close the listener and cut every socket: the load balancer dies."""
        assert self._listener is not None
        for socket in self.sockets:
            socket.cut()
        self._listener.close()
        await self._listener.wait_closed()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def open_sockets(self) -> list[FakeSocket]:
        """Return the sockets that are still open."""
        return [socket for socket in self.sockets if socket.is_open]

    def commands(self) -> Iterator[Command]:
        """Yield every command that any server got, resent ones again."""
        for socket in self.sockets:
            yield from socket.commands

    async def until(self, true: Callable[[], bool], within_s: float = 5.0) -> None:
        """Wait until *true*, looking whenever something happened at a server."""

        async def wait() -> None:
            async with self._changed:
                await self._changed.wait_for(true)

        await asyncio.wait_for(wait(), within_s)

    def noticed(self) -> None:
        """Let `until` look again."""
        self._spawn(self._notify())

    def submitted(self, socket: FakeSocket, command: Command) -> None:
        """Answer *command* in a task of its own, unless commands are held."""
        self._spawn(self._answer(socket, command))

    async def _answer(self, socket: FakeSocket, command: Command) -> None:
        await self._notify()
        if self.on_command is not None:
            answer = await self.on_command(socket, command)
            if answer is not None:
                await socket.answer(answer)
        elif not self.hold:
            await socket.answer(self.result(command, socket.server))

    def result(self, command: Command, server: str = "") -> Answer:
        """Return what the registry says to *command*, stamped."""
        received_s = self.clock()
        answer = dispatch(self.registry, command, self.clock, server=server)
        if isinstance(answer, Failure):
            return answer
        return Result(
            id=answer.id, reply=answer.reply, server=server, compute_ms=answer.compute_ms,
            received_s=received_s, sent_s=self.clock(),
        )  # fmt: skip

    def _check_handshake(self, connection: ServerConnection, request: Request) -> Response | None:
        self.handshakes.append(self.clock())
        self._spawn(self._notify())
        given = request.headers.get("Authorization", "").removeprefix("Bearer ")
        self.tokens_seen.append(given)
        if self.refusals:
            status, retry_after = self.refusals.pop(0)
            return _refusal(status, retry_after, is_firewall=self.refuses_as_firewall, **self.refusal_members)
        if self.token is not None and given != self.token:
            return _refusal(401, None)
        if request.path != "/ws":
            return _refusal(404, None)
        return None

    async def _serve(self, websocket: ServerConnection) -> None:
        socket = FakeSocket(self, self.landing, websocket)
        socket.muted = not self.welcomes
        self.sockets.append(socket)
        await self._notify()
        await socket.serve()
        await self._notify()

    async def _notify(self) -> None:
        async with self._changed:
            self._changed.notify_all()

    def _spawn(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _refusal(status: int, retry_after: int | None, *, is_firewall: bool = False, **told: Any) -> Response:
    code = {401: "unauthorized", 403: "forbidden"}.get(status, "full")
    body = b"<html>no</html>" if is_firewall else refusal_body(code, "refused", "", **told)
    headers = Headers({"Content-Length": str(len(body)), "Connection": "close"})
    if retry_after is not None:
        headers["Retry-After"] = str(retry_after)
    return Response(status, http.HTTPStatus(status).phrase, headers, body)
