"""Sockets of a robot: dial, read, write, ping, reconnect, move; all rules are in `RobotSession`.

Promises to be the only file that knows the WebSocket library, to keep at most one current socket
(two during a move), and that no command is lost because a socket was.
"""

from __future__ import annotations

import asyncio
import contextlib
import random as random_module
from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as websocket_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from rse_pf.errors import ConnectError, ProtocolError, RsePfError, Unauthorized, UsageError
from rse_pf.settings import SessionSettings
from rse_pf.wire import SUBPROTOCOLS, codec_for
from rse_pf.wire.robot_session import (
    Answered,
    Event,
    Link,
    LinkLost,
    MoveAsked,
    Notice,
    RobotSession,
    Welcomed,
)

__all__ = ["Connection", "Token", "websocket_options"]

Token = str | Callable[[], Awaitable[str]] | None

_FIRST_TRIES = 4
_REFUSED_FOR_GOOD = (400, 401, 403, 404)


def websocket_options(settings: SessionSettings) -> dict[str, Any]:
    """Return how we open every WebSocket: no compression, no pings of the library, our size limit."""
    return {
        "compression": None,
        "max_size": settings.max_inflated_bytes,
        "ping_interval": None,
        "open_timeout": settings.connect_timeout_s,
        "close_timeout": 1.0,
        "proxy": None,
    }


class _Refused(Exception):
    """The door said no for now; carries how long it asks to wait."""

    def __init__(self, error: RsePfError, after_s: float = 0.0) -> None:
        super().__init__(str(error))
        self.error = error
        self.after_s = after_s


class _Socket:
    """One WebSocket with its link and its two tasks."""

    def __init__(self, websocket: ClientConnection, link: Link) -> None:
        self.websocket = websocket
        self.link = link
        self.welcomed = asyncio.Event()
        self.ended = asyncio.Event()
        self.dirty = asyncio.Event()
        self.tasks: list[asyncio.Task[None]] = []


class Connection:
    """Keeps a `RobotSession` connected until it is closed."""

    def __init__(
        self,
        url: str,
        *,
        token: Token,
        session: RobotSession,
        on_answer: Callable[[Answered], None],
        clock: Callable[[], float],
        random: random_module.Random,
    ) -> None:
        _check_url(url)
        self.url = url
        self.reconnects = 0
        self.moves = 0
        self.bytes_in = 0
        self.bytes_out = 0
        self.last_error = ""
        self.fatal: RsePfError | None = None
        self._token = token
        self._session = session
        self._settings = session.settings
        self._on_answer = on_answer
        self._clock = clock
        self._random = random
        self._sockets: list[_Socket] = []
        self._wake = asyncio.Event()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._dialling: asyncio.Task[None] | None = None
        self._moving: asyncio.Task[None] | None = None
        self._closed = False

    async def open(self) -> None:
        """Dial until a server says Welcome.

        Raises:
            Unauthorized: The token is refused.
            ConnectError: Nobody answers at the address.
        """
        for attempt in range(_FIRST_TRIES):
            try:
                socket = await self._dial()
            except _Refused as refused:
                if attempt + 1 == _FIRST_TRIES:
                    raise refused.error from None
                await asyncio.sleep(max(refused.after_s, self._back_off(attempt)))
            else:
                self._adopt(socket)
                break
        self._spawn(self._keep())

    async def close(self) -> None:
        """Close every socket and end every task."""
        self._closed = True
        for task in list(self._tasks):
            task.cancel()
        for socket in list(self._sockets):
            with contextlib.suppress(Exception):
                await socket.websocket.close()
            self._drop(socket)
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def flush(self) -> None:
        """Tell that the session has something to send, or a new deadline."""
        for socket in self._sockets:
            if socket.link.outgoing:
                socket.dirty.set()
        self._wake.set()

    async def _dial(self, *, retried: bool = False) -> _Socket:
        """Open a socket through the balancer and wait for its Welcome."""
        headers = {}
        token = await self._token() if callable(self._token) else self._token
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        codec = self._session.codec
        try:
            websocket = await websocket_connect(
                self.url,
                subprotocols=[Subprotocol(SUBPROTOCOLS[codec.name])],
                additional_headers=headers,
                **websocket_options(self._settings),
            )
        except InvalidStatus as error:
            status = error.response.status_code
            if status == 401 and callable(self._token) and not retried:
                return await self._dial(retried=True)
            raise _refusal(status, error.response.headers.get("Retry-After", "")) from error
        except (OSError, TimeoutError, WebSocketException) as error:
            self.last_error = str(error) or type(error).__name__
            raise _Refused(
                ConnectError(
                    f"cannot connect to {self.url}: {self.last_error}",
                    hint="is the platform running? start it with rse-pf local",
                )
            ) from error
        socket = _Socket(websocket, self._session.open_link(self._clock()))
        if codec_for([str(websocket.subprotocol)]) != codec.name:
            await websocket.close()
            raise ConnectError(f"{self.url} does not speak {SUBPROTOCOLS[codec.name]}", hint="check the URL")
        self._sockets.append(socket)
        socket.tasks = [self._spawn(self._read(socket)), self._spawn(self._write(socket))]
        socket.dirty.set()
        welcome, end = (
            asyncio.ensure_future(socket.welcomed.wait()),
            asyncio.ensure_future(socket.ended.wait()),
        )
        done, left = await asyncio.wait(
            {welcome, end}, timeout=self._settings.connect_timeout_s, return_when=asyncio.FIRST_COMPLETED
        )
        for task in left:
            task.cancel()
        if welcome not in done:
            self._abort(socket)
            raise _Refused(ConnectError(f"{self.url} does not say welcome", hint="is it an RSE-PF server?"))
        return socket

    async def _read(self, socket: _Socket) -> None:
        try:
            async for message in socket.websocket:
                data = message.encode() if isinstance(message, str) else message
                self.bytes_in += len(data)
                self._handle(socket, self._session.receive(socket.link, data, self._clock()))
        except (ConnectionClosed, OSError):
            pass
        except ProtocolError as error:
            self.last_error = error.message
            socket.websocket.transport.abort()
        finally:
            self._drop(socket)

    async def _write(self, socket: _Socket) -> None:
        is_text = self._session.codec.is_text
        try:
            while True:
                await socket.dirty.wait()
                socket.dirty.clear()
                while socket.link.outgoing:
                    data = socket.link.outgoing.pop(0)
                    self.bytes_out += len(data)
                    await socket.websocket.send(data.decode() if is_text else data)
        except (ConnectionClosed, OSError):
            self._drop(socket)

    async def _keep(self) -> None:
        """Call the session whenever something is due."""
        while not self._closed:
            now = self._clock()
            for event in self._session.due(now):
                self._one(None, event)
            for socket in list(self._sockets):
                self._handle(socket, self._session.tend(socket.link, now))
                leaving = socket.link.leaving and not self._session.unanswered_on(socket.link)
                if leaving and not socket.link.outgoing:
                    self._spawn(self._say_goodbye(socket))
                elif socket.link.outgoing:
                    socket.dirty.set()
            pause = max(0.0, self._session.next_due(now) - now)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), timeout=max(pause, 0.001))
            self._wake.clear()

    def _handle(self, socket: _Socket, events: list[Event]) -> None:
        for event in events:
            self._one(socket, event)
        if socket.link.leaving or events:
            self._wake.set()

    def _one(self, socket: _Socket | None, event: Event) -> None:
        if isinstance(event, Answered):
            self._on_answer(event)
        elif isinstance(event, Notice):
            self.last_error = event.failure.message
        elif socket is None:
            return
        elif isinstance(event, Welcomed):
            socket.welcomed.set()
        elif isinstance(event, LinkLost):
            self.last_error = event.reason
            self._abort(socket)
        elif isinstance(event, MoveAsked) and self._moving is None and socket.link is self._session.current:
            self._moving = self._spawn(self._move(socket, event.within_s))

    async def _move(self, old: _Socket, within_s: float) -> None:
        """Make before break: leave *old* once another server has said Welcome."""
        until, attempt = self._clock() + within_s, 0
        try:
            while not self._closed and not old.ended.is_set() and self._clock() < until:
                try:
                    fresh = await self._dial()
                except (_Refused, RsePfError):
                    fresh = None
                if fresh is not None and (
                    fresh.link.server != old.link.server or self._session.current is not old.link
                ):
                    self.moves += 1
                    self._adopt(fresh)
                    return
                if fresh is not None:
                    await self._say_goodbye(fresh)
                await asyncio.sleep(self._back_off(attempt))
                attempt += 1
        finally:
            self._moving = None

    async def _redial(self) -> None:
        """Dial with full jitter until somebody answers."""
        attempt, wait_s = 0, 0.0
        while not self._closed:
            await asyncio.sleep(max(wait_s, self._back_off(attempt)) if attempt else 0.0)
            attempt += 1
            try:
                socket = await self._dial()
            except _Refused as refused:
                wait_s = refused.after_s
                continue
            except RsePfError as error:
                self.fatal = error
                self._fail_all(error)
                return
            self.reconnects += 1
            self._adopt(socket)
            return

    def _adopt(self, socket: _Socket) -> None:
        for event in self._session.adopt(socket.link, self._clock()):
            self._one(socket, event)
        self.flush()

    def _drop(self, socket: _Socket) -> None:
        """Forget a socket that ended, and dial again if it was the current one."""
        if socket not in self._sockets:
            return
        self._sockets.remove(socket)
        was_current = self._session.current is socket.link
        self._session.close_link(socket.link)
        socket.ended.set()
        for task in socket.tasks:
            if task is not asyncio.current_task():
                task.cancel()
        nobody = self._session.current is None and (was_current or socket.link.lost)
        if nobody and socket.welcomed.is_set() and not self._closed:
            self._start_dialling()

    def _start_dialling(self) -> None:
        if (self._dialling is None or self._dialling.done()) and self._moving is None:
            self._dialling = self._spawn(self._redial())
        elif self._moving is not None:
            moving = self._moving
            moving.add_done_callback(lambda _: self._redial_if_alone())

    def _redial_if_alone(self) -> None:
        if self._session.current is None and not self._closed:
            self._start_dialling()

    def _abort(self, socket: _Socket) -> None:
        socket.websocket.transport.abort()
        self._drop(socket)

    async def _say_goodbye(self, socket: _Socket) -> None:
        with contextlib.suppress(ConnectionClosed, OSError):
            await socket.websocket.close()
        self._drop(socket)

    def _fail_all(self, error: RsePfError) -> None:
        for event in self._session.abandon(error.code, error.message, error.hint):
            self._one(None, event)

    def _back_off(self, attempt: int) -> float:
        longest = min(self._settings.reconnect_max_s, self._settings.reconnect_base_s * 2.0**attempt)
        return self._random.uniform(0.0, longest)

    def _spawn(self, work: Any) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _check_url(url: str) -> None:
    parts = urlsplit(url)
    if parts.scheme not in ("ws", "wss") or not parts.hostname:
        raise UsageError(
            f"{url!r} is not a WebSocket address", hint="write ws://HOST:PORT/ws or wss://HOST/ws"
        )


def _refusal(status: int, retry_after: str) -> Exception:
    if status in (401, 403):
        return Unauthorized("the token is missing or not valid", hint="issue one: rse-pf token issue ROBOT")
    if status in _REFUSED_FOR_GOOD:
        return ConnectError(
            f"the server answers {status}", hint="check the path of the URL: it ends with /ws"
        )
    after_s = float(retry_after) if retry_after.isdigit() else 0.0
    busy = ConnectError(f"the server answers {status}", hint="it is full or not ready; try again later")
    return _Refused(busy, min(after_s, 5.0))
