"""Fakes for tests: a server that speaks the protocol with the real `ServerSession`, on demand badly.

It answers ``echo`` through the real `dispatch`; what it does otherwise, a test decides.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from rse_pf.config import SessionSettings
from rse_pf.service import Registry, dispatch
from rse_pf.services import echo
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Result, codec_for, make_codec
from rse_pf.wire.server_session import Close, Send, ServerSession, Submit

Answerer = Callable[["FakeServer", "FakeRobot", Command], Result | Failure | None]


def answer_at_once(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
    """Answer like a real server."""
    return dispatch(server.registry, command, time.monotonic, server=server.name)


def answer_nothing(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
    """Keep silent about commands; pings are still answered."""
    return None


@dataclass(eq=False)
class FakeRobot:
    """One connection as the server sees it."""

    websocket: ServerConnection
    session: ServerSession
    commands: list[Command] = field(default_factory=list)

    async def send(self, decisions: list[Any]) -> None:
        for decision in decisions:
            if isinstance(decision, Send):
                text = self.session.codec.is_text
                await self.websocket.send(decision.data.decode() if text else decision.data)
            elif isinstance(decision, Close):
                await self.websocket.close(decision.code, decision.reason)


class FakeServer:
    """Start it with `running`; tests change ``answer``, ``refuse`` and ``deaf`` as they like."""

    def __init__(self, name: str = "fake", answer: Answerer = answer_at_once) -> None:
        self.name = name
        self.answer = answer
        self.refuse: tuple[int, dict[str, str]] | None = None
        self.deaf = False
        self.tokens: list[str] = []
        self.robots: list[FakeRobot] = []
        self.all_commands: list[Command] = []
        self.changed = asyncio.Condition()
        self.registry = Registry()
        echo.register(self.registry)
        self._server: Server | None = None
        self._limits = SessionSettings()

    @property
    def url(self) -> str:
        assert self._server is not None
        port = next(iter(self._server.sockets)).getsockname()[1]
        return f"ws://127.0.0.1:{port}/ws"

    @contextlib.asynccontextmanager
    async def running(self, port: int = 0) -> AsyncIterator[FakeServer]:
        async with serve(
            self._talk,
            "127.0.0.1",
            port,
            process_request=self._door,
            subprotocols=list(SUBPROTOCOLS.values()),  # type: ignore[arg-type]
            compression=None,
            ping_interval=None,
            close_timeout=0.2,
        ) as self._server:
            yield self
            for robot in list(self.robots):
                robot.websocket.transport.abort()

    async def until(self, condition: Callable[[], bool], deadline_s: float = 10.0) -> None:
        """Wait until *condition* holds; it is looked at whenever something happened."""

        async def wait() -> None:
            async with self.changed:
                await self.changed.wait_for(condition)

        await asyncio.wait_for(wait(), deadline_s)

    def cut(self) -> None:
        """End every connection without a goodbye."""
        for robot in list(self.robots):
            robot.websocket.transport.abort()

    async def _door(self, connection: ServerConnection, request: Request) -> Response | None:
        self.tokens.append(request.headers.get("Authorization", ""))
        if self.refuse is None:
            return None
        status, headers = self.refuse
        return Response(status, HTTPStatus(status).phrase, Headers(headers), b"{}")

    async def _talk(self, websocket: ServerConnection) -> None:
        codec = make_codec(codec_for([str(websocket.subprotocol)]) or "json")
        session = ServerSession(codec=codec, robot="r", server=self.name, session="s", limits=self._limits)
        robot = FakeRobot(websocket, session)
        self.robots.append(robot)
        await self._notify()
        with contextlib.suppress(ConnectionClosed):
            async for message in websocket:
                if self.deaf:
                    continue
                data = message.encode() if isinstance(message, str) else message
                for decision in session.receive(data, time.monotonic()):
                    if not isinstance(decision, Submit):
                        await robot.send([decision])
                        continue
                    robot.commands.append(decision.command)
                    self.all_commands.append(decision.command)
                    answer = self.answer(self, robot, decision.command)
                    if answer is not None:
                        await robot.send([session.answer(answer)])
                await self._notify()
        self.robots.remove(robot)
        await self._notify()

    async def _notify(self) -> None:
        async with self.changed:
            self.changed.notify_all()
