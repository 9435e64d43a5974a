"""Fakes for tests: an event loop whose time stands still, the wire of a robot, and a server.

`FakeLoop` behaves as asyncio's loop does.  `FakeServer` speaks the protocol with the real `ServerSession` and
answers ``echo`` through the real `dispatch`; a test can make it misbehave.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import heapq
import itertools
import select
import threading
import time
from collections import deque
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
from rse_pf.wire import SUBPROTOCOLS, Codec, Command, Failure, Result, codec_for, make_codec
from rse_pf.wire.refusal import refusal_body
from rse_pf.wire.server_session import Close, Send, ServerSession, Submit
from tests.kit import server_sessions


class FakeTimer:
    """What `FakeLoop.call_later` returns."""

    def __init__(self, due_s: float, callback: Callable[..., object], args: tuple[Any, ...]) -> None:
        self.due_s = due_s
        self._callback = callback
        self._args = args
        self._is_cancelled = False

    def cancel(self) -> None:
        self._is_cancelled = True
        self._callback, self._args = int, ()  # as asyncio and uvloop do: what is cancelled holds nothing

    def cancelled(self) -> bool:
        return self._is_cancelled

    def run(self) -> None:
        if not self._is_cancelled:
            self._callback(*self._args)


class FakeLoop:
    """An event loop whose clock moves only when a test calls `advance`.

    Callbacks, timers, descriptors and futures come in the order of asyncio's loop.  An exception of a
    callback reaches the test.  `run_in_executor` runs its function in the thread of the test, in the next
    round of the loop.
    """

    def __init__(self, now: float = 100.0) -> None:
        self.now = now
        self._ready: deque[FakeTimer] = deque()
        self._timers: list[tuple[float, int, FakeTimer]] = []
        self._numbers = itertools.count()
        self._watched: dict[tuple[int, int], FakeTimer] = {}
        self._woken = threading.Event()

    def time(self) -> float:
        return self.now

    def get_debug(self) -> bool:
        return False

    @property
    def timers(self) -> int:
        """How many timers have not run and are not cancelled."""
        return sum(not timer.cancelled() for _, _, timer in self._timers)

    def call_soon(self, callback: Callable[..., object], *args: Any, context: Any = None) -> FakeTimer:
        handle = FakeTimer(self.now, callback, args)
        self._ready.append(handle)
        return handle

    def call_soon_threadsafe(self, callback: Callable[..., object], *args: Any) -> FakeTimer:
        handle = self.call_soon(callback, *args)
        self._woken.set()
        return handle

    def call_later(self, delay: float, callback: Callable[..., object], *args: Any) -> FakeTimer:
        timer = FakeTimer(self.now + delay, callback, args)
        heapq.heappush(self._timers, (timer.due_s, next(self._numbers), timer))
        return timer

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)  # type: ignore[arg-type]

    def run_in_executor(
        self, executor: None, function: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        future = self.create_future()

        def work() -> None:
            try:
                result = function(*args)
            except Exception as error:  # noqa: BLE001  it belongs to the code that waits for the future
                self.call_soon(future.set_exception, error)
            else:
                self.call_soon(future.set_result, result)

        self.call_soon(work)
        return future

    def add_reader(self, fd: int, callback: Callable[..., object], *args: Any) -> None:
        self._watched[fd, select.POLLIN] = FakeTimer(0.0, callback, args)

    def remove_reader(self, fd: int) -> bool:
        return self._watched.pop((fd, select.POLLIN), None) is not None

    def add_writer(self, fd: int, callback: Callable[..., object], *args: Any) -> None:
        self._watched[fd, select.POLLOUT] = FakeTimer(0.0, callback, args)

    def remove_writer(self, fd: int) -> bool:
        return self._watched.pop((fd, select.POLLOUT), None) is not None

    def turn(self) -> bool:
        """Run one round: descriptors, timers that are due, callbacks.  Return whether anything ran."""
        self._poll()
        return self._run_ready()

    def advance(self, seconds: float = 0.0) -> None:
        """Let *seconds* pass and run all that becomes due; descriptors are looked at once in each step."""
        until = self.now + seconds
        while True:
            self._poll()
            while self._run_ready():
                pass
            if not self._timers or self._timers[0][0] > until:
                break
            self.now = max(self.now, self._timers[0][0])
        self.now = until

    def run_until(self, condition: Callable[[], object], deadline_s: float = 10.0) -> None:
        """Run rounds, while time stands still, until threads and descriptors made *condition* true."""
        deadline = time.monotonic() + deadline_s
        while not condition():
            assert time.monotonic() < deadline, "the condition did not come true"
            if not self.turn():
                self._woken.wait(0.005)
                self._woken.clear()

    def _run_ready(self) -> bool:
        while self._timers and self._timers[0][0] <= self.now:
            self._ready.append(heapq.heappop(self._timers)[2])
        count = len(self._ready)
        for _ in range(count):
            self._ready.popleft().run()
        return count > 0

    def _poll(self) -> None:
        if not self._watched:
            return
        poll = select.poll()
        for fd in {fd for fd, _ in self._watched}:
            poll.register(fd, sum(event for watched, event in self._watched if watched == fd))
        for fd, events in poll.poll(0):
            both = events & (select.POLLHUP | select.POLLERR)
            for event in (select.POLLIN, select.POLLOUT):
                handle = self._watched.get((fd, event))
                if handle is not None and events & (event | both):
                    self._ready.append(handle)


class FakeWire:
    """The socket of one robot as a worker sees it; keeps what was sent, decoded."""

    def __init__(self, codec: Codec | None = None) -> None:
        self.sent: list[Any] = []
        self.closed: tuple[int, str] | None = None
        self.pauses: list[float] = []
        self.holds = 0
        self.unsent = 0
        self.max_unsent: int | None = None
        self._codec = codec or make_codec("bin")

    def send(self, data: bytes, is_text: bool) -> None:
        self.sent.append(self._codec.decode_from_server(data))

    def unsent_bytes(self) -> int:
        return self.unsent

    def bound_unsent(self, max_bytes: int) -> None:
        self.max_unsent = max_bytes

    def send_pong(self, data: bytes) -> None:
        self.sent.append(data)

    def pause(self, seconds: float) -> None:
        self.pauses.append(seconds)

    def hold(self) -> None:
        self.holds += 1

    def read_on(self) -> None:
        self.holds -= 1

    def close(self, code: int, reason: str) -> None:
        self.closed = (code, reason)


class FakeLog:
    """Keeps the events that a `JsonLog` would write, as level, event and fields."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str, dict[str, Any]]] = []
        for level in ("debug", "info", "warning", "error"):
            setattr(self, level, functools.partial(self._note, level))

    def names(self) -> list[str]:
        """Return the names of the events."""
        return [event for _, event, _ in self.events]

    def _note(self, level: str, event: str, **fields: Any) -> None:
        self.events.append((level, event, fields))


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
        body = refusal_body({401: "unauthorized", 403: "forbidden"}.get(status, "full"), "refused", "")
        sized = Headers({**headers, "Content-Length": str(len(body))})
        return Response(status, HTTPStatus(status).phrase, sized, body)

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
                for decision in server_sessions.receive(session, data, time.monotonic()):
                    if not isinstance(decision, Submit):
                        await robot.send([decision])
                        continue
                    robot.commands.append(decision.command)
                    self.all_commands.append(decision.command)
                    answer = self.answer(self, robot, decision.command)
                    if answer is not None:
                        await robot.send([server_sessions.answer(session, answer)])
                await self._notify()
        self.robots.remove(robot)
        await self._notify()

    async def _notify(self) -> None:
        async with self.changed:
            self.changed.notify_all()
