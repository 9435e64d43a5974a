"""The sockets of a robot: connect, read, write, ping, reconnect, move; `ClientSession` holds the rules.

This is the only module that knows the WebSocket library.  There is one current socket, and a second one only
during a move.  Reconnects are delayed with full jitter.  Commands survive the loss of a socket.
"""

from __future__ import annotations

import asyncio
import random as random_module
import ssl
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import TYPE_CHECKING, Any

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as websocket_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from client_sdk.backoff import Backoff
from client_sdk.dialling import (
    CHECK_ADDRESS,
    CHECK_RUNNING,
    ISSUE,
    DialError,
    dial_error_of,
    shown_address,
    unreachable,
    untrusted,
)
from client_sdk.token_text import checked_token
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
    ClientSession,
    ConnectionLost,
    ConnectionState,
    Event,
    MoveRequested,
    Notice,
    Progressed,
    RenewalDue,
    Welcomed,
)
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated
from rse_pf.wire.server_session import CLOSE_RATE, CLOSE_REPLACED, CLOSE_REVOKED

if TYPE_CHECKING:
    from rse_pf.recording.robot_recorder import RobotRecorder

__all__ = [
    "Connection",
    "ForRobot",
    "OnChange",
    "Token",
    "cancel_all",
    "websocket_options",
]

Token = str | Callable[[], Awaitable[str]] | None
"""A robot's token, or an async callable that returns a fresh one for each connect and each renewal."""

ForRobot = Answered | Progressed | Updated | SubscriptionEnded
"""What concerns a command or a subscription, and not a connection."""

OnChange = Callable[[str, str], None] | None
"""Called with ``link-lost`` and a reason, or with ``link-back`` or ``moved`` and the server's name."""

_FIRST_TRIES = 4
_MIN_TICK_S = 0.001
# How long a server that was stopped may take to accept a connection attempt that was given up.
_LATE_WELCOME_S = 60.0


def websocket_options(settings: SessionSettings) -> dict[str, Any]:
    """Return the options of every WebSocket: no compression, no pings of the library, our size limit."""
    return {
        "compression": None,
        "max_size": settings.max_message_bytes,
        "ping_interval": None,
        "open_timeout": settings.connect_timeout_s,
        "close_timeout": settings.stall_timeout_s,
        "proxy": None,
    }


class _Socket:
    """One WebSocket with its state in the session and its two tasks."""

    def __init__(self, websocket: ClientConnection, state: ConnectionState) -> None:
        self.websocket = websocket
        self.state = state
        self.welcome: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.ended = asyncio.Event()
        self.dirty = asyncio.Event()
        self.tasks: list[asyncio.Task[None]] = []
        self.is_closing = False
        self.bad_messages = self.recorded = 0


class Connection:
    """Keep a `ClientSession` connected until it is closed."""

    def __init__(
        self,
        url: str,
        *,
        token: Token,
        session: ClientSession,
        on_answer: Callable[[ForRobot], None],
        clock: Callable[[], float],
        random: random_module.Random,
        on_change: OnChange = None,
        recorder: RobotRecorder | None = None,
    ) -> None:
        self.url = url
        self._recorder = recorder
        self._used_token: str | None = None
        self.reconnects = 0
        self.moves = 0
        self.bytes_in = 0
        self.bytes_out = 0
        self.last_error = ""
        self.fatal: RsePfError | None = None
        self._address = shown_address(url) if url else ""
        self.ssl_context: ssl.SSLContext | None = None
        self._token = token
        self._session = session
        self._settings = session.settings
        self._on_answer = on_answer
        self._on_change = on_change or (lambda what, why: None)
        self._clock = clock
        self._sockets: list[_Socket] = []
        self._tasks: set[asyncio.Task[Any]] = set()
        self._changed = asyncio.Event()
        self._wake = asyncio.Event()
        self._next_tick = 0.0
        self._backoff = Backoff(self._settings, random)
        self._adopted = 0.0
        self._move_request: tuple[_Socket, float] | None = None
        self._late_welcome_until = float("-inf")
        self._main_tasks: list[asyncio.Task[None]] = []
        self._closed = False

    def use(self, url: str, token: Token, ssl_context: ssl.SSLContext | None) -> None:
        """Connect to *url* from now on, trust what *ssl_context* trusts, and use *token*."""
        self.url, self._token = url, token
        self.ssl_context = ssl_context if url.startswith("wss:") else None
        self._address = shown_address(url)

    async def open(self, *, may_be_down: bool = False) -> None:
        """Connect to a server, with a few attempts.

        Args:
            may_be_down: Return after a first attempt that no server answered, and go on in the background.

        Raises:
            Unauthorized: The token is missing, wrong or expired.
            UnsupportedProtocol: Client and server share no sub-protocol.
            ConnectError: No server answers at the address.
        """
        for attempt in range(1, _FIRST_TRIES + 1):
            try:
                self._adopt(await self._dial())
                break
            except DialError as failed:
                if failed.is_final or failed.is_wrong_address:
                    raise failed.error from None
                if may_be_down:
                    self._on_change("link-lost", failed.error.message)
                    break
                if attempt == _FIRST_TRIES:
                    raise failed.error from None
                await asyncio.sleep(self._pause_s(failed))
        self._main_tasks = [self._spawn(self._tick()), self._spawn(self._keep_connected())]

    async def close(self) -> None:
        """Close every socket and end every task."""
        self._closed = True
        await cancel_all(self._main_tasks)
        await asyncio.gather(*(self._close_socket(socket) for socket in list(self._sockets)))
        await cancel_all(self._tasks)

    def flush(self) -> None:
        """Send what the session has to send, and wake up earlier if a deadline came closer."""
        for socket in list(self._sockets):
            if socket.state.outgoing:
                socket.dirty.set()
            done = socket.state.leaving and not self._session.unanswered_on(socket.state)
            if done and not socket.state.outgoing and not socket.is_closing:
                self._spawn(self._close_socket(socket))
        if self._session.next_due(self._clock()) < self._next_tick:
            self._wake.set()

    # --- the two main tasks -----------------------------------------------------------------

    async def _tick(self) -> None:
        """Call the session when something is due."""
        while not self._closed:
            now = self._clock()
            self._handle(None, self._session.due(now))
            for socket in list(self._sockets):
                self._handle(socket, self._session.check(socket.state, now))
            self._next_tick = self._session.next_due(now)
            self.flush()
            pause_s = max(_MIN_TICK_S, self._next_tick - self._clock())
            await _either(self._wake, pause_s)
            self._wake.clear()

    async def _keep_connected(self) -> None:
        """Reconnect when there is no socket, and move when a server asks for it."""
        while self.fatal is None and not self._closed:
            if self._session.current is None:
                await self._reconnect()
            elif self._move_request is not None:
                await self._move(*self._move_request)
                self._move_request = None
            else:
                self._changed.clear()
                await self._changed.wait()

    async def _reconnect(self) -> None:
        """Connect with full jitter until a server sends Welcome.

        The pause counts from the start of the last attempt, so none is added after one that timed out.
        """
        if self._clock() - self._adopted > self._settings.reconnect_max_s:
            self._backoff.restart()
        failed: DialError | None = None
        began = self._clock()
        while True:
            asked_s = 0.0 if failed is None else failed.after_s
            await asyncio.sleep(max(asked_s, self._pause_s(failed) - (self._clock() - began)))
            began = self._clock()
            try:
                socket = await self._dial()
            except DialError as error:
                failed = error
                if failed.is_final:
                    self._end(failed.error)
                    return
            else:
                self._reconnected(socket)
                return

    def _reconnected(self, socket: _Socket) -> None:
        self.reconnects += 1
        self._adopt(socket)
        self._on_change("link-back", socket.state.server)

    async def _move(self, old: _Socket, until: float) -> None:
        """Make before break: leave *old* once another server has sent Welcome."""
        self._backoff.restart()
        while self._session.current is old.state and self._clock() < until:
            failed: DialError | None = None
            try:
                fresh = await self._dial()
            except DialError as error:
                failed = error
            else:
                if self._session.current is not old.state:
                    self._reconnected(fresh)
                    return
                if fresh.state.server != old.state.server:
                    self.moves += 1
                    self._adopt(fresh)
                    self._on_change("moved", fresh.state.server)
                    return
                self._spawn(self._close_socket(fresh))
            pause_s = min(self._pause_s(failed), max(0.0, until - self._clock()))
            await _either(old.ended, pause_s)

    # --- one socket ------------------------------------------------------------------------------

    async def _dial(self) -> _Socket:
        """Open a socket through the load balancer and wait for the Welcome; raises DialError."""
        try:
            websocket = await self._handshake()
        except DialError as failed:
            if not callable(self._token) or not isinstance(failed.error, Unauthorized):
                self.last_error = failed.error.message
                raise
            websocket = await self._handshake()
        socket = _Socket(websocket, self._session.open_connection(self._clock()))
        self._sockets.append(socket)
        if self._recorder is not None:
            socket.recorded = self._recorder.opened(self._session.codec, self._used_token)
        socket.tasks = [self._spawn(self._read(socket)), self._spawn(self._write(socket))]
        socket.dirty.set()
        try:
            done, _ = await asyncio.wait({socket.welcome}, timeout=self._settings.connect_timeout_s)
            if not done:
                raise DialError(ConnectError(f"{self._address} sends no Welcome", hint=CHECK_ADDRESS))
            socket.welcome.result()
        except BaseException:
            self._late_welcome_until = self._clock() + _LATE_WELCOME_S
            self._abort(socket)
            raise
        return socket

    async def _handshake(self) -> ClientConnection:
        self._backoff.dialled(self._clock())
        subprotocol = SUBPROTOCOLS[self._session.codec.name]
        token = self._used_token = await self.read_token()
        options = websocket_options(self._settings)
        if self.ssl_context is not None:
            options["ssl"] = self.ssl_context
        try:
            websocket = await websocket_connect(
                self.url,
                subprotocols=[Subprotocol(subprotocol)],
                additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
                **options,
            )
        except InvalidStatus as error:
            told = error.response
            after = told.headers.get("Retry-After", "")
            raise dial_error_of(self._address, told.status_code, after, bytes(told.body or b"")) from error
        except ssl.SSLCertVerificationError as error:
            raise untrusted(self._address, error) from error
        except (OSError, asyncio.TimeoutError, WebSocketException, EOFError) as error:
            self._late_welcome_until = self._clock() + _LATE_WELCOME_S
            raise unreachable(self._address, error) from error
        if websocket.subprotocol != subprotocol:
            websocket.transport.abort()
            unsupported = UnsupportedProtocol(
                f"{self._address} does not speak {subprotocol}", hint=CHECK_ADDRESS
            )
            raise DialError(unsupported, is_wrong_address=True)
        return websocket

    async def read_token(self) -> str | None:
        """Return the token without the white space around it, which files and shells add."""
        if not callable(self._token):
            token = self._token
        else:
            try:
                token = await self._token()
            except Exception as error:
                told = ConnectError(
                    f"no token: the token callable raised {type(error).__name__}",
                    hint="fix the token callable",
                )
                raise DialError(told) from error
        if token is None:
            return None
        try:
            return checked_token(token)
        except Unauthorized as error:
            raise DialError(error, is_final=True) from None

    async def _renew(self, socket: _Socket) -> None:
        """Send a fresh token on a live socket; without one, the robot reconnects when the socket expires."""
        try:
            token = await self.read_token()
        except DialError as failed:
            self.last_error = failed.error.message
            return
        if token and not socket.ended.is_set() and not socket.is_closing:
            self._session.renew(socket.state, token)
            self.flush()

    async def _read(self, socket: _Socket) -> None:
        try:
            while True:
                data = await socket.websocket.recv(decode=False)
                self.bytes_in += len(data)
                if self._recorder is not None:
                    self._recorder.said(socket.recorded, "down", data)
                self._receive(socket, data)
        except (ConnectionClosed, OSError):
            if socket.websocket.close_code == CLOSE_RATE:
                self.last_error = "the server closed the connection: this robot exceeds its rate"
            elif socket.websocket.close_code == CLOSE_REVOKED and not callable(self._token):
                self._end(Unauthorized("the token was revoked, or the robot was disabled", hint=ISSUE))
            is_replaced = socket.websocket.close_code == CLOSE_REPLACED
            by_itself = self._move_request is not None or self._clock() < self._late_welcome_until
            if is_replaced and self._session.current is socket.state and not by_itself:
                message = "another connection of this robot replaced this one"
                self._end(Conflict(message, hint="give every robot a token of its own"))
        finally:
            self._forget(socket)

    def _receive(self, socket: _Socket, data: bytes) -> None:
        try:
            events = self._session.receive(socket.state, data, self._clock())
        except ProtocolError as error:
            self.last_error = error.message
            socket.bad_messages += 1
            if socket.bad_messages > self._settings.max_bad_messages:
                self._abort(socket)
            return
        self._handle(socket, events)
        self.flush()

    async def _write(self, socket: _Socket) -> None:
        is_text = self._session.codec.is_text
        try:
            while True:
                await socket.dirty.wait()
                socket.dirty.clear()
                while socket.state.outgoing:
                    data = socket.state.outgoing.pop(0)
                    self.bytes_out += len(data)
                    if self._recorder is not None:
                        self._recorder.said(socket.recorded, "up", data)
                    await socket.websocket.send(data, text=is_text)
        except (ConnectionClosed, OSError):
            return  # the reader handles the end, after the data that still arrived

    def _handle(self, socket: _Socket | None, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, ForRobot):
                self._on_answer(event)
            elif socket is not None:
                self._handle_socket_event(socket, event)

    def _handle_socket_event(self, socket: _Socket, event: Event) -> None:
        match event:
            case Welcomed() if not socket.welcome.done():
                socket.welcome.set_result(None)
            case ConnectionLost():
                self.last_error = f"connection lost: {event.reason}"
                if not socket.state.leaving and self._session.current is None:
                    self._on_change("link-lost", event.reason)
                self._abort(socket)
            case RenewalDue() if callable(self._token):
                self._spawn(self._renew(socket))
            case Notice():
                failure = event.failure
                self.last_error = failure.message
                if not socket.welcome.done():
                    error = UnsupportedProtocol(failure.message, hint=failure.hint)
                    socket.welcome.set_exception(DialError(error, is_final=failure.code == error.code))
            case MoveRequested() if socket.state is self._session.current and not self._move_request:
                self._move_request = (socket, self._clock() + event.within_s)
                self._changed.set()

    def _adopt(self, socket: _Socket) -> None:
        self._adopted = self._clock()
        if socket.ended.is_set():
            return
        self._handle(socket, self._session.adopt(socket.state, self._adopted))
        self._handle(socket, self._session.check(socket.state, self._adopted))
        self.flush()

    def _abort(self, socket: _Socket) -> None:
        socket.websocket.transport.abort()
        self._forget(socket)

    async def _close_socket(self, socket: _Socket) -> None:
        socket.is_closing = True
        await socket.websocket.close()
        self._forget(socket)

    def _forget(self, socket: _Socket) -> None:
        """Keep the socket's commands for the next one, and wake up the task that reconnects."""
        if socket.ended.is_set():
            return
        socket.ended.set()
        self._sockets.remove(socket)
        if self._recorder is not None:
            self._recorder.closed(socket.recorded)
        if self._session.current is socket.state and not self._closed:
            self._on_change("link-lost", "closed")
        self._session.close_connection(socket.state)
        for task in socket.tasks:
            if task is not asyncio.current_task():
                task.cancel()
        if not socket.welcome.done():
            error = ConnectError(f"{self._address} closed without a Welcome", hint=CHECK_RUNNING)
            socket.welcome.set_exception(DialError(error))
            socket.welcome.exception()
        self._changed.set()
        self._wake.set()

    def _end(self, error: RsePfError) -> None:
        """Stop reconnecting: every command ends with *error*."""
        self.fatal = error
        self.last_error = error.message
        self._handle(None, self._session.abandon(error.code, error.message, error.hint))
        self._changed.set()

    def _pause_s(self, failed: DialError | None) -> float:
        after_s, is_offline = (0.0, False) if failed is None else (failed.after_s, failed.is_offline)
        return self._backoff.pause_s(self._clock(), after_s, is_offline=is_offline)

    def _spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


async def cancel_all(tasks: Iterable[asyncio.Task[Any]]) -> None:
    """Cancel *tasks* and wait until all have ended."""
    ending = list(tasks)
    for task in ending:
        task.cancel()
    await asyncio.gather(*ending, return_exceptions=True)


async def _either(event: asyncio.Event, timeout_s: float) -> None:
    """Wait for *event*, at most *timeout_s*; unlike ``wait_for``, never swallow a cancellation."""
    waiting = asyncio.ensure_future(event.wait())
    try:
        await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
