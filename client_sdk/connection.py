"""Sockets of a robot: dial, read, write, ping, reconnect, move; the rules are in `ClientSession`.

Promises to be the only file that knows the WebSocket library, to keep one current socket (two
during a move), to dial with full jitter, and that no command is lost because a socket was.
"""

from __future__ import annotations

import asyncio
import random as random_module
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as websocket_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from client_sdk.dial_errors import DialError, again_after_s, dial_beside, refusal, shown_address
from rse_pf.config import SessionSettings
from rse_pf.errors import (
    Conflict,
    ConnectError,
    ProtocolError,
    RsePfError,
    Unauthorized,
    UnsupportedProtocol,
)
from rse_pf.wire import SUBPROTOCOLS
from rse_pf.wire.client_session import (
    Answered,
    ConnectionState,
    Event,
    ConnectionLost,
    MoveRequested,
    Notice,
    Progressed,
    RenewalDue,
    ClientSession,
    Welcomed,
)
from rse_pf.wire.server_session import CLOSE_RATE, CLOSE_REPLACED

__all__ = ["Connection", "OnChange", "Token", "websocket_options"]

Token = str | Callable[[], Awaitable[str]] | None
"""A robot's token, or what gives a fresh one whenever the robot dials, and before that is over."""

OnChange = Callable[[str, str], None] | None
"""Is told ``link-lost`` with a reason, and ``link-back`` or ``moved`` with the server's name."""

_FIRST_TRIES = 4
_DIALS_OF_A_ROW = 8
"""Time-outs after which a robot that lost its link begins anew, with a fresh token."""
_MIN_TICK_S = 0.001
_GHOST_S = 60.0
"""So long a dial that was given up may still be welcomed, by a server that was stopped meanwhile."""
_IS_IT_RUNNING = "is the platform running? start it with rse-pf local start"


def websocket_options(settings: SessionSettings) -> dict[str, Any]:
    """Return how we open every WebSocket: no compression, no pings of the library, our size limit."""
    return {
        "compression": None,
        "max_size": settings.max_message_bytes,
        "ping_interval": None,
        "open_timeout": settings.connect_timeout_s,
        "close_timeout": settings.stall_timeout_s,
        "proxy": None,
    }


class _Socket:
    """One WebSocket with its link and its two tasks."""

    def __init__(self, websocket: ClientConnection, link: ConnectionState) -> None:
        self.websocket = websocket
        self.link = link
        self.welcome: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.ended = asyncio.Event()
        self.dirty = asyncio.Event()
        self.tasks: list[asyncio.Task[None]] = []
        self.is_closing = False
        self.bad_messages = 0


class Connection:
    """Keeps a `ClientSession` connected until it is closed."""

    def __init__(
        self,
        url: str,
        *,
        token: Token,
        session: ClientSession,
        on_answer: Callable[[Answered | Progressed], None],
        clock: Callable[[], float],
        random: random_module.Random,
        on_change: OnChange = None,
    ) -> None:
        self.url = url
        self.reconnects = 0
        self.moves = 0
        self.bytes_in = 0
        self.bytes_out = 0
        self.last_error = ""
        self.fatal: RsePfError | None = None
        self._address = shown_address(url)
        self._token = token
        self._session = session
        self._settings = session.settings
        self._on_answer = on_answer
        self._on_change = on_change
        self._clock = clock
        self._random = random
        self._sockets: list[_Socket] = []
        self._tasks: set[asyncio.Task[Any]] = set()
        self._changed = asyncio.Event()
        self._wake = asyncio.Event()
        self._next_tick = 0.0
        self._attempt = 0
        self._adopted = 0.0
        self._move_asked: tuple[_Socket, float] | None = None
        self._ghost_until = float("-inf")
        self._lasting: list[asyncio.Task[None]] = []
        self._closed = False

    async def open(self) -> None:
        """Dial until a server says Welcome, a few times.

        Raises:
            Unauthorized: The token is refused.
            UnsupportedProtocol: The two sides share no protocol.
            ConnectError: Nobody answers at the address.
        """
        for attempt in range(1, _FIRST_TRIES + 1):
            try:
                self._adopt(await self._dial())
                break
            except DialError as refused:
                if attempt == _FIRST_TRIES or refused.for_good or refused.wrong_address:
                    raise refused.error from None
                await asyncio.sleep(self._pause_s(refused.after_s))
        self._lasting = [self._spawn(self._tick()), self._spawn(self._keep())]

    async def close(self) -> None:
        """Close every socket and end every task."""
        self._closed = True
        lasting = self._lasting
        for task in lasting:
            task.cancel()
        await asyncio.gather(*lasting, return_exceptions=True)
        await asyncio.gather(*(self._say_goodbye(socket) for socket in list(self._sockets)))
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def flush(self) -> None:
        """Tell that the session has something to send, or an earlier deadline."""
        for socket in list(self._sockets):
            if socket.link.outgoing:
                socket.dirty.set()
            done = socket.link.leaving and not self._session.unanswered_on(socket.link)
            if done and not socket.link.outgoing and not socket.is_closing:
                self._spawn(self._say_goodbye(socket))
        if self._session.next_due(self._clock()) < self._next_tick:
            self._wake.set()

    # --- the two tasks that last -----------------------------------------------------------------

    async def _tick(self) -> None:
        """Call the session whenever something is due."""
        while not self._closed:
            now = self._clock()
            self._take(None, self._session.due(now))
            for socket in list(self._sockets):
                self._take(socket, self._session.tend(socket.link, now))
            self._next_tick = self._session.next_due(now)
            self.flush()
            pause_s = max(_MIN_TICK_S, self._next_tick - self._clock())
            await _either(self._wake, pause_s)
            self._wake.clear()

    async def _keep(self) -> None:
        """Dial when there is no socket, and move when asked to."""
        while self.fatal is None and not self._closed:
            if self._session.current is None:
                await self._redial()
            elif self._move_asked is not None:
                await self._move(*self._move_asked)
                self._move_asked = None
            else:
                self._changed.clear()
                await self._changed.wait()

    async def _redial(self) -> None:
        """Dial with full jitter until a server says Welcome.

        The pause counts from the last dial's begin: one that found nobody for seconds was pause enough.
        """
        if self._clock() - self._adopted > self._settings.reconnect_max_s:
            self._attempt = 0
        after_s, spent_s = 0.0, 0.0
        while True:
            await asyncio.sleep(max(after_s, self._pause_s(after_s) - spent_s))
            began = self._clock()
            try:
                socket = await self._dial(_DIALS_OF_A_ROW)
            except DialError as refused:
                after_s, spent_s = refused.after_s, self._clock() - began
                if refused.for_good:
                    self._end(refused.error)
                    return
            else:
                self.reconnects += 1
                self._adopt(socket)
                self._changed_to("link-back", socket.link.server)
                return

    async def _move(self, old: _Socket, until: float) -> None:
        """Make before break: leave *old* once another server has said Welcome."""
        self._attempt = 0
        while self._session.current is old.link and self._clock() < until:
            after_s = 0.0
            try:
                fresh = await self._dial()
            except DialError as refused:
                after_s = refused.after_s
            else:
                if self._session.current is not old.link:
                    self.reconnects += 1
                    self._adopt(fresh)
                    self._changed_to("link-back", fresh.link.server)
                    return
                if fresh.link.server != old.link.server:
                    self.moves += 1
                    self._adopt(fresh)
                    self._changed_to("moved", fresh.link.server)
                    return
                self._spawn(self._say_goodbye(fresh))
            pause_s = min(self._pause_s(after_s), max(0.0, until - self._clock()))
            await _either(old.ended, pause_s)

    # --- one socket ------------------------------------------------------------------------------

    async def _dial(self, most: int = 2) -> _Socket:
        """Open a socket through the load balancer and wait for its Welcome."""
        try:
            websocket = await self._handshake(most)
        except DialError as refused:
            if not callable(self._token) or not isinstance(refused.error, Unauthorized):
                self.last_error = refused.error.message
                raise
            websocket = await self._handshake(most)
        socket = _Socket(websocket, self._session.open_link(self._clock()))
        self._sockets.append(socket)
        socket.tasks = [self._spawn(self._read(socket)), self._spawn(self._write(socket))]
        socket.dirty.set()
        try:
            done, _ = await asyncio.wait({socket.welcome}, timeout=self._settings.connect_timeout_s)
            if not done:
                mute = ConnectError(f"{self._address} does not say welcome", hint="is it an RSE-PF server?")
                raise DialError(mute)
            socket.welcome.result()
        except BaseException:
            self._ghost_until = self._clock() + _GHOST_S
            self._abort(socket)
            raise
        return socket

    async def _before_next_dial(self) -> None:
        again_s = self._settings.dial_again_s
        await (asyncio.sleep(again_after_s(again_s, self._random)) if again_s else asyncio.Event().wait())

    async def _handshake(self, most: int) -> ClientConnection:
        wanted = SUBPROTOCOLS[self._session.codec.name]
        token = await self._read_token()

        async def open_one() -> ClientConnection:
            return await websocket_connect(
                self.url,
                subprotocols=[Subprotocol(wanted)],
                additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
                **websocket_options(self._settings),
            )

        try:
            websocket = await dial_beside(open_one, _drop, self._before_next_dial, most=most)
        except InvalidStatus as error:
            response = error.response
            told = refusal(self._address, response.status_code, response.headers.get("Retry-After", ""))
            raise told from error
        except (OSError, asyncio.TimeoutError, WebSocketException, EOFError) as error:
            self._ghost_until = self._clock() + _GHOST_S
            cause = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise DialError(
                ConnectError(f"cannot connect to {self._address}: {cause}", hint=_IS_IT_RUNNING)
            ) from error
        if websocket.subprotocol != wanted:
            _drop(websocket)
            unsupported = UnsupportedProtocol(
                f"{self._address} does not speak {wanted}", hint="is it an RSE-PF server?"
            )
            raise DialError(unsupported, wrong_address=True)
        return websocket

    async def _read_token(self) -> str | None:
        if not callable(self._token):
            return self._token
        try:
            return await self._token()
        except Exception as error:
            told = ConnectError(
                f"no token: the token callable raised {type(error).__name__}", hint="mend the token callable"
            )
            raise DialError(told) from error

    async def _renew(self, socket: _Socket) -> None:
        """Show a fresh token on a live socket; without one its end brings a new dial, with a new try."""
        try:
            token = await self._read_token()
        except DialError as refused:
            self.last_error = refused.error.message
            return
        if token and not socket.ended.is_set() and not socket.is_closing:
            self._session.renew(socket.link, token)
            self.flush()

    async def _read(self, socket: _Socket) -> None:
        try:
            while True:
                data = await socket.websocket.recv(decode=False)
                self.bytes_in += len(data)
                self._hear(socket, data)
        except (ConnectionClosed, OSError):
            if socket.websocket.close_code == CLOSE_RATE:
                self.last_error = "the server cut this robot off: it sends more than its rate"
            replaced = socket.websocket.close_code == CLOSE_REPLACED
            by_ourselves = self._move_asked is not None or self._clock() < self._ghost_until
            if replaced and self._session.current is socket.link and not by_ourselves:
                self._end(
                    Conflict(
                        "another connection of this robot took its place",
                        hint="give every robot a token of its own",
                    )
                )
        finally:
            self._forget(socket)

    def _hear(self, socket: _Socket, data: bytes) -> None:
        try:
            events = self._session.receive(socket.link, data, self._clock())
        except ProtocolError as error:
            self.last_error = error.message
            socket.bad_messages += 1
            if socket.bad_messages > self._settings.max_bad_messages:
                self._abort(socket)
            return
        self._take(socket, events)
        self.flush()

    async def _write(self, socket: _Socket) -> None:
        is_text = self._session.codec.is_text
        try:
            while True:
                await socket.dirty.wait()
                socket.dirty.clear()
                while socket.link.outgoing:
                    data = socket.link.outgoing.pop(0)
                    self.bytes_out += len(data)
                    await socket.websocket.send(data, text=is_text)
        except (ConnectionClosed, OSError):
            return  # the reader sees the same end, after what still came in

    def _take(self, socket: _Socket | None, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, Answered | Progressed):
                self._on_answer(event)
            elif socket is not None:
                self._about(socket, event)

    def _about(self, socket: _Socket, event: Event) -> None:
        """Act on what concerns the socket itself."""
        if isinstance(event, Welcomed) and not socket.welcome.done():
            socket.welcome.set_result(None)
        elif isinstance(event, ConnectionLost):
            self.last_error = f"connection lost: {event.reason}"
            if not socket.link.leaving and self._session.current is None:
                self._changed_to("link-lost", event.reason)
            self._abort(socket)
        elif isinstance(event, RenewalDue) and callable(self._token):
            self._spawn(self._renew(socket))
        elif isinstance(event, Notice):
            failure = event.failure
            self.last_error = failure.message
            if not socket.welcome.done():
                unsupported = UnsupportedProtocol(failure.message, hint=failure.hint)
                socket.welcome.set_exception(DialError(unsupported, for_good=failure.code == unsupported.code))
        elif isinstance(event, MoveRequested) and socket.link is self._session.current and not self._move_asked:
            self._move_asked = (socket, self._clock() + event.within_s)
            self._changed.set()

    def _changed_to(self, what: str, why: str) -> None:
        if self._on_change is not None:
            self._on_change(what, why)

    def _adopt(self, socket: _Socket) -> None:
        self._adopted = self._clock()
        if socket.ended.is_set():
            return
        self._take(socket, self._session.adopt(socket.link, self._adopted))
        self._take(socket, self._session.tend(socket.link, self._adopted))
        self.flush()

    def _abort(self, socket: _Socket) -> None:
        socket.websocket.transport.abort()
        self._forget(socket)

    async def _say_goodbye(self, socket: _Socket) -> None:
        socket.is_closing = True
        await socket.websocket.close()
        self._forget(socket)

    def _forget(self, socket: _Socket) -> None:
        """Let the socket's commands wait for the next one, and have somebody dial."""
        if socket.ended.is_set():
            return
        socket.ended.set()
        self._sockets.remove(socket)
        if self._session.current is socket.link and not self._closed:
            self._changed_to("link-lost", "closed")
        self._session.close_link(socket.link)
        for task in socket.tasks:
            if task is not asyncio.current_task():
                task.cancel()
        if not socket.welcome.done():
            cut = ConnectError(f"{self._address} closed without a welcome", hint=_IS_IT_RUNNING)
            socket.welcome.set_exception(DialError(cut))
            socket.welcome.exception()
        self._changed.set()
        self._wake.set()

    def _end(self, error: RsePfError) -> None:
        """Give up for good: every command gets *error*."""
        self.fatal = error
        self.last_error = error.message
        self._take(None, self._session.abandon(error.code, error.message, error.hint))
        self._changed.set()

    def _pause_s(self, after_s: float) -> float:
        """Return the next back-off, with full jitter on top of what the server asked for."""
        s = self._settings
        longest = min(s.reconnect_max_s, s.reconnect_base_s * 2.0 ** min(self._attempt, 16))
        self._attempt += 1
        return after_s + self._random.uniform(0.0, longest)

    def _spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _drop(websocket: ClientConnection) -> None:
    websocket.transport.abort()


async def _either(event: asyncio.Event, timeout_s: float) -> None:
    """Wait for *event*, at most *timeout_s*; unlike ``wait_for``, never swallow a cancellation."""
    waiting = asyncio.ensure_future(event.wait())
    try:
        await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
