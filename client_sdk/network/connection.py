"""The sockets of a robot: connect, read, write, ping, reconnect, move; `ClientSession` holds the rules.

There is one current socket, a second one during a move, and one that stands by for each further address.
Reconnects are delayed (`client_sdk.network.reconnect_wait`).  Commands survive the loss of a socket.
Nothing is final once the robot was connected: while its servers refuse it, commands end with the reason, and
it goes on
trying.
"""

from __future__ import annotations

import asyncio
import random as random_module
import ssl
import time
from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any

from websockets.exceptions import ConnectionClosed

from client_sdk.concurrency.user_callbacks import Callbacks
from client_sdk.network.backoff import Backoff
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.dial_errors import CHECK_ADDRESS, CHECK_RUNNING, ISSUE, DialError
from client_sdk.network.handshake import Dialler, Token
from client_sdk.network.reconnect_wait import Pauses
from client_sdk.network.region_choice import MAX_REGIONS, RegionChoice
from client_sdk.network.region_sockets import Region, RegionSocket, cancel_all, either
from rse_pf.errors import (
    Conflict,
    ConnectError,
    ProtocolError,
    RsePfError,
    Unauthorized,
    UnsupportedProtocol,
    UsageError,
)
from rse_pf.wire.client_session import (
    Answered,
    ClientSession,
    ConnectionLost,
    Event,
    MoveRequested,
    Notice,
    Progressed,
    RenewalDue,
    Welcomed,
)
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated
from rse_pf.wire.server_session import CLOSE_RATE, CLOSE_REPLACED, CLOSE_REVOKED, MAX_BAD_MESSAGES

if TYPE_CHECKING:
    from rse_pf.recording.robot_recorder import RobotRecorder

__all__ = [
    "Connection",
    "ForRobot",
    "OnChange",
]

ForRobot = Answered | Progressed | Updated | SubscriptionEnded
"""What concerns a command or a subscription, and not a connection."""

OnChange = Callable[[str, str], None] | None
"""Called with ``link-lost`` or ``refused`` and a reason, or with ``link-back``, ``moved`` or, for a further
region, ``stands-by`` and the server's name."""

_FIRST_TRIES = 4
_MIN_TICK_S = 0.001
# How long the answers of other regions are waited for, in times of the first one, and at the most.
_OTHERS_TIMES, _OTHERS_MAX_S = 1.0, 0.7
# Within this time after a robot opened another connection, that one is what replaced the earlier one.
_DOUBLE_S = 5.0
# How long a server that was stopped may take to accept a connection attempt that was given up.
_LATE_WELCOME_S = 60.0
# Tokens have whole seconds: one that is signed so much later than a cut-off is issued after it.
_LATER_SECOND_S = 1.0


class Connection:
    """Keep a `ClientSession` connected until it is closed."""

    def __init__(
        self,
        urls: Sequence[str],
        *,
        token: Token,
        session: ClientSession,
        timings: ConnectTimings,
        on_answer: Callable[[ForRobot], None],
        clock: Callable[[], float],
        random: random_module.Random,
        wall_clock: Callable[[], float] = time.time,
        on_change: OnChange = None,
        callbacks: Callbacks,
        recorder: RobotRecorder | None = None,
    ) -> None:
        self._recorder = recorder
        self.reconnects = 0
        self.moves = 0
        self.region_changes = 0
        self.bytes_in = 0
        self.bytes_out = 0
        self.last_error = ""
        self.refusal: RsePfError | None = None
        self._session = session
        self._settings = session.settings
        self._timings = timings
        self.dialler = Dialler(
            token, codec=session.codec.name, settings=session.settings, timings=timings, callbacks=callbacks
        )
        self._on_answer = on_answer
        self._report_change, self._callbacks = on_change, callbacks
        self._clock = clock
        self._pauses = Pauses(clock, wall_clock)
        self._sockets: list[RegionSocket] = []
        self._tasks: set[asyncio.Task[Any]] = set()
        self._wake = asyncio.Event()
        self._next_tick = 0.0
        self._random = random
        self._regions, self._choice = self._regions_of(urls)
        self._last_region: Region | None = None
        self._late_welcome_until = float("-inf")
        self._main_tasks: list[asyncio.Task[None]] = []
        self._closed = False

    def use(self, urls: Sequence[str], token: Token, ssl_context: ssl.SSLContext | None) -> None:
        """Connect to *urls* from now on, trust what *ssl_context* trusts, and use *token*."""
        self._regions, self._choice = self._regions_of(urls)
        self.dialler.token = token
        self.dialler.ssl_context = ssl_context

    @property
    def url(self) -> str:
        """The address that is used now, or else the first one."""
        return self._current_region().url

    @property
    def region(self) -> str:
        """The same, as shown to users."""
        return self._current_region().address

    async def open(self, *, may_be_down: bool = False) -> None:
        """Connect to a server, with a few attempts; a refusal ends this first connect.

        Args:
            may_be_down: Return after a first attempt that no server answered, and go on in the background.

        Raises:
            Unauthorized: The token is missing, wrong or expired.
            UnsupportedProtocol: Client and server share no sub-protocol.
            ConnectError: No server answers at the address.
        """
        for attempt in range(1, _FIRST_TRIES + 1):
            failures = await self._join_nearest()
            best = self._choice.best(self._usable())
            if best is not None:
                self._adopt(self._usable()[best])
                break
            failed = min(failures, key=self._is_hopeless)
            if self._is_hopeless(failed):
                raise failed.error from None
            if may_be_down:
                self._on_change("link-lost", failed.error.message)
                break
            if attempt == _FIRST_TRIES:
                raise failed.error from None
            await asyncio.sleep(self._pauses.pause_s(self._regions[0].backoff, failed))
        self._pauses.open()
        self._main_tasks = [self._spawn(self._tick()), *map(self._spawn, map(self._keep, self._regions))]
        for socket in self._usable().values():
            if socket.state is not self._session.current:
                self._on_change("stands-by", socket.state.server)

    async def close(self) -> None:
        """Close every socket and end every task."""
        self._closed = True
        self._pauses.close()
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

    # --- several regions -------------------------------------------------------------------------

    def _regions_of(self, urls: Sequence[str]) -> tuple[list[Region], RegionChoice]:
        if len(set(urls)) != len(urls) or not 0 < len(urls) <= MAX_REGIONS:
            raise UsageError(
                f"{len(urls)} addresses, of which {len(set(urls))} differ",
                hint=f"name 1 to {MAX_REGIONS} different addresses",
            )
        made = [Region(n, url, Backoff(self._timings, self._random)) for n, url in enumerate(urls)]
        return made, RegionChoice(len(made), hold_s=self._timings.region_hold_s)

    def _current_region(self) -> Region:
        current = self._session.current
        held = (socket.region for socket in self._sockets if socket.state is current)
        return next(held, self._regions[0])

    def _is_hopeless(self, failed: DialError) -> bool:
        """Return whether further attempts of a first connect are of no use."""
        return failed.is_wrong_address or self._pauses.is_lasting(failed)

    def _usable(self) -> dict[int, RegionSocket]:
        """Return the sockets that may carry the commands, by the number of their region."""
        usable = {region.number: region.usable for region in self._regions}
        return {number: socket for number, socket in usable.items() if socket is not None}

    async def _join_nearest(self) -> list[DialError]:
        """Dial every region until one is measured, and those that are not much later; return what failed."""
        began = self._clock()
        joining = [self._spawn(self._join(region)) for region in self._regions]
        waiting = set(joining)
        try:
            while waiting and not self._usable():
                _, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            if waiting:
                others_s = min(_OTHERS_MAX_S, _OTHERS_TIMES * (self._clock() - began))
                _, waiting = await asyncio.wait(waiting, timeout=others_s)
        except asyncio.CancelledError:
            await cancel_all(joining)
            raise
        for region, task in zip(self._regions, joining, strict=True):
            region.joining = task if task in waiting else None
            region.failed = None if task in waiting else task.result()
        ended = (task.result() for task in joining if task not in waiting)
        lost = DialError(ConnectError(f"{self.region} closed at once", hint=CHECK_RUNNING))
        return [failed for failed in ended if failed is not None] or [lost]

    async def _join(self, region: Region) -> DialError | None:
        """Dial *region*, and measure it if there are others; return what failed."""
        try:
            socket = await self._dial(region)
        except DialError as failed:
            return failed
        if len(self._regions) > 1:
            self._handle(socket, self._session.check(socket.state, self._clock()))
            self.flush()
            await either(socket.measured, self._settings.ping_timeout_s)
        self._hold(socket)
        return None

    def _hold(self, socket: RegionSocket) -> None:
        """Keep *socket* for its region: it carries the commands, or stands by."""
        region = socket.region
        if not socket.ended.is_set():
            region.socket = socket
            region.since = self._clock()
            region.failed = None
            region.is_double = False
            if self._session.current is not None and self._main_tasks:
                self._on_change("stands-by", socket.state.server)

    def _measure(self, socket: RegionSocket) -> None:
        """Take the last pong into account, and change to a region that has been better for long enough."""
        exchange = socket.state.last_exchange
        if exchange is None or exchange is socket.exchange:
            return
        socket.exchange = exchange
        socket.measured.set()
        # By the robot's clock alone: a server may say that all of the time was its own.
        self._choice.measured(socket.region.number, exchange.returned_s - exchange.sent_s)
        usable, current = self._usable(), self._current_region()
        if len(self._regions) > 1 and current.number in usable:
            better = self._choice.better(current.number, usable, self._clock())
            if better is not None:
                self._adopt(usable[better])
                self._on_change("moved", usable[better].state.server)

    def _use_standby(self) -> None:
        """Continue in the best region that stands by, if there is one."""
        usable = self._usable()
        best = self._choice.best(usable)
        if best is not None and self._main_tasks:
            self._choice.changed()
            self._take_socket(usable[best])

    # --- the main tasks -------------------------------------------------------------------------

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
            await either(self._wake, pause_s)
            self._wake.clear()

    async def _keep(self, region: Region) -> None:
        """Reconnect to *region* when there is no socket, and move when a server asks for it."""
        if region.joining is not None:
            region.failed = await region.joining
            self._resume(region)
        while not self._closed:
            if region.socket is None and not (region.is_double and self._usable()):
                await self._reconnect(region)
            elif region.move_request is not None:
                await self._move(region, *region.move_request)
                region.move_request = None
            else:
                region.changed.clear()
                await region.changed.wait()

    async def _reconnect(self, region: Region) -> None:
        """Connect to *region*, with pauses, until a server sends Welcome."""
        if self._clock() - region.since > self._timings.reconnect_max_s:
            region.backoff.restart()
        began = self._clock()
        offset_s = self._pauses.offset_s()
        while True:
            failed = region.failed
            pause_s = self._pauses.pause_s(region.backoff, failed, spent_s=self._clock() - began)
            await self._pauses.wait(pause_s, failed, offset_s)
            began = self._clock()
            offset_s = self._pauses.offset_s()
            region.failed = await self._join(region)
            if region.failed is None:
                self._resume(region)
                return
            self._note_refusal()

    def _note_refusal(self) -> None:
        """End the commands with the reason if every region refuses this robot; it goes on trying."""
        if not all(self._pauses.is_lasting(region.failed) for region in self._regions):
            return
        failed = self._regions[0].failed
        assert failed is not None
        error, before = failed.error, self.refusal
        self.refusal = error
        self.last_error = error.message
        self._handle(None, self._session.end_commands(error.code, error.message, error.hint))
        if before is None or (before.code, before.hint) != (error.code, error.hint):
            self._on_change("refused", error.message)

    def _resume(self, region: Region) -> None:
        """Send the commands to *region* if no other one carries them."""
        if region.socket is not None and self._session.current is None:
            self._take_socket(region.socket)

    def _take_socket(self, socket: RegionSocket) -> None:
        self.reconnects += 1
        self._adopt(socket)
        self._on_change("link-back", socket.state.server)

    async def _move(self, region: Region, old: RegionSocket, until: float) -> None:
        """Make before break: leave *old* once another server of its region has sent Welcome."""
        region.backoff.restart()
        while self._session.current is old.state and self._clock() < until:
            failed: DialError | None = None
            try:
                fresh = await self._dial(region)
            except DialError as error:
                failed = error
            else:
                if self._session.current is not old.state:
                    self._hold(fresh)
                    self._resume(region)
                    return
                if fresh.state.server != old.state.server:
                    self.moves += 1
                    region.socket = fresh
                    self._adopt(fresh)
                    self._on_change("moved", fresh.state.server)
                    return
                self._spawn(self._close_socket(fresh))
            pause_s = self._pauses.pause_s(region.backoff, failed, is_move=True)
            await either(old.ended, min(pause_s, max(0.0, until - self._clock())))

    # --- one socket ------------------------------------------------------------------------------

    async def _dial(self, region: Region) -> RegionSocket:
        """Open a socket through the load balancer and wait for the Welcome; raises DialError."""
        try:
            websocket, token = await self.dialler.open(
                region.url, lambda: region.backoff.dialled(self._clock())
            )
        except DialError as failed:
            self.last_error = failed.error.message
            if failed.is_late:
                self._late_welcome_until = self._clock() + _LATE_WELCOME_S
            raise
        socket = RegionSocket(region, websocket, self._session.open_connection(self._clock()))
        self._sockets.append(socket)
        if self._recorder is not None:
            socket.recorded = self._recorder.opened(self._session.codec, token)
        socket.tasks = [self._spawn(self._read(socket)), self._spawn(self._write(socket))]
        socket.dirty.set()
        try:
            done, _ = await asyncio.wait({socket.welcome}, timeout=self._timings.connect_timeout_s)
            if not done:
                raise DialError(ConnectError(f"{region.address} sends no Welcome", hint=CHECK_ADDRESS))
            socket.welcome.result()
        except BaseException:
            self._late_welcome_until = self._clock() + _LATE_WELCOME_S
            self._abort(socket)
            raise
        return socket

    async def _renew(self, socket: RegionSocket) -> None:
        """Send a fresh token on a live socket; without one, the robot reconnects when the socket expires."""
        try:
            token = await self.dialler.read_token()
        except DialError as failed:
            self.last_error = failed.error.message
            return
        if token and not socket.ended.is_set() and not socket.is_closing:
            self._session.renew(socket.state, token)
            self.flush()

    async def _read(self, socket: RegionSocket) -> None:
        try:
            while True:
                data = await socket.websocket.recv(decode=False)
                self.bytes_in += len(data)
                if self._recorder is not None:
                    self._recorder.said(socket.recorded, "down", data)
                self._receive(socket, data)
        except (ConnectionClosed, OSError):
            code = socket.websocket.close_code
            if code == CLOSE_RATE:
                self.last_error = "the server closed the connection: this robot exceeds its rate"
            elif socket.region.socket is socket and code == CLOSE_REVOKED:
                socket.region.failed = self._cut_off_error()
            elif socket.region.socket is socket and code == CLOSE_REPLACED:
                socket.region.failed = self._replaced_error(socket)
        finally:
            self._forget(socket)

    def _cut_off_error(self) -> DialError:
        """Return what a cut-off means: a token of a later second may be accepted, the same one never."""
        is_fresh = callable(self.dialler.token)
        valid_from_s = self._pauses.wall_clock() + _LATER_SECOND_S if is_fresh else None
        error = Unauthorized("the token was revoked, or the robot was disabled", hint=ISSUE)
        return DialError(error, is_refusal=True, valid_from_s=valid_from_s)

    def _replaced_error(self, socket: RegionSocket) -> DialError | None:
        """Return the conflict with another program, None if this robot itself opened the newer connection."""
        is_double = self._is_double(socket)
        is_moving = socket.region.move_request is not None
        by_itself = is_double or is_moving or self._clock() < self._late_welcome_until
        if by_itself or self._session.current is not socket.state:
            return None
        message = "another connection of this robot replaced this one"
        return DialError(Conflict(message, hint="give every robot a token of its own"), is_refusal=True)

    def _is_double(self, socket: RegionSocket) -> bool:
        """Note if two addresses lead to one platform, which keeps the newest connection of a robot only."""
        since = max(socket.state.opened, self._clock() - _DOUBLE_S)
        others = (
            region_socket for region_socket in self._sockets if region_socket.region is not socket.region
        )
        if any(other.state.opened >= since for other in others):
            socket.region.is_double = True
        return socket.region.is_double

    def _receive(self, socket: RegionSocket, data: bytes) -> None:
        try:
            events = self._session.receive(socket.state, data, self._clock())
        except ProtocolError as error:
            self.last_error = error.message
            socket.bad_messages += 1
            if socket.bad_messages > MAX_BAD_MESSAGES:
                self._abort(socket)
            return
        self._handle(socket, events)
        self._measure(socket)
        self.flush()

    async def _write(self, socket: RegionSocket) -> None:
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

    def _handle(self, socket: RegionSocket | None, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, ForRobot):
                self._on_answer(event)
            elif socket is not None:
                self._handle_socket_event(socket, event)

    def _handle_socket_event(self, socket: RegionSocket, event: Event) -> None:
        match event:
            case Welcomed() if not socket.welcome.done():
                socket.welcome.set_result(None)
            case ConnectionLost():
                self.last_error = f"connection lost: {event.reason}"
                if not socket.state.leaving and self._session.current is None:
                    self._on_change("link-lost", event.reason)
                self._abort(socket)
            case RenewalDue() if callable(self.dialler.token):
                self._spawn(self._renew(socket))
            case Notice():
                failure = event.failure
                self.last_error = failure.message
                if not socket.welcome.done():
                    error = UnsupportedProtocol(failure.message, hint=failure.hint)
                    socket.welcome.set_exception(DialError(error, is_refusal=failure.code == error.code))
            case MoveRequested() if socket.state is self._session.current:
                if socket.region.move_request is None:
                    socket.region.move_request = (socket, self._clock() + event.within_s)
                    socket.region.changed.set()
            case MoveRequested() if len(self._regions) > 1 and not socket.state.leaving:
                self._spawn(self._close_socket(socket))  # it stands by: nothing is lost

    def _adopt(self, socket: RegionSocket) -> None:
        now = self._clock()
        if socket.ended.is_set():
            return
        self.refusal = None
        self.region_changes += self._last_region not in (None, socket.region)
        self._last_region = socket.region
        self._handle(socket, self._session.adopt(socket.state, now))
        self._handle(socket, self._session.check(socket.state, now))
        self.flush()

    def _abort(self, socket: RegionSocket) -> None:
        socket.websocket.transport.abort()
        self._forget(socket)

    async def _close_socket(self, socket: RegionSocket) -> None:
        socket.is_closing = True
        await socket.websocket.close()
        self._forget(socket)

    def _forget(self, socket: RegionSocket) -> None:
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
            error = ConnectError(f"{socket.region.address} closed without a Welcome", hint=CHECK_RUNNING)
            socket.welcome.set_exception(DialError(error))
            socket.welcome.exception()
        socket.measured.set()
        self._release(socket)
        self._wake.set()

    def _release(self, socket: RegionSocket) -> None:
        """Take an ended socket from its region, and continue in another region that stands by."""
        region = socket.region
        if region.socket is socket:
            region.socket = None
            if not socket.is_closing:
                self._choice.lost(region.number, self._clock())
        if self._session.current is None and not self._closed:
            self._use_standby()
            self._note_refusal()
        for known in self._regions:
            known.changed.set()

    def _on_change(self, change: str, why: str) -> None:
        if self._report_change is not None:
            self._callbacks.notify("on_change", self._report_change, change, why)

    def _spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task
