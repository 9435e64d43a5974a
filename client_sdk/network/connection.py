"""Keep a robot connected: dial, reconnect, move between servers, and choose among regions.

`rse_pf.wire.client_session.ClientSession` holds the rules of the protocol and all commands; this module holds
the WebSockets and decides when they are opened, used and closed.  A robot has one address (region) or
several; for each region a task keeps one WebSocket open.

States of a WebSocket (`RegionSocket`):

    OPENING   The handshake is over and Hello is sent; no Welcome of the server has arrived.
    STANDBY   Welcomed; it is pinged, and it carries no command.
    CURRENT   Welcomed; new commands are sent on it (``session.current``).  At most one socket is CURRENT.
    LEAVING   Another socket became CURRENT; answers to commands that were sent here still arrive here.
    CLOSING   This robot began the close handshake (``is_closing``).
    ENDED     The socket is gone (``has_ended``); its unanswered commands wait for the next CURRENT socket.

Transitions:

    1. Open: `_dial` opens a socket.  A Welcome within ``connect_timeout_s`` makes it STANDBY; without one it
       is ENDED and the attempt has failed.
    2. Adopt: `_adopt` makes a STANDBY socket CURRENT.  The session sends every unanswered command on it that
       has no open socket, under its old id.  A socket that was CURRENT is LEAVING.
    3. Drain: `flush` closes a LEAVING socket once all commands that were sent on it are answered.
    4. Lose: a close, an error or a missing pong makes a socket ENDED (`_discard_socket`).  If it was CURRENT,
       the nearest STANDBY socket of another region is adopted at once (`_switch_to_standby`).
    5. Reconnect: the task of each region (`_maintain_region`) dials while its region has no socket,
       after the pauses of `client_sdk.network.backoff`; `_adopt_if_disconnected` then adopts the
       socket.
    6. Move: when a server asks for it, `_move_to_other_server` opens a socket to another server of the same
       region first, adopts it, and leaves the old one to drain (make before break).
    7. Change of region: `_record_round_trip` adopts the socket of a region that has been nearer for long
       enough; the earlier one drains and its region dials a new STANDBY socket.
    8. Refusal: while every region refuses this robot, its commands end with the typed refusal, and are not
       sent again (`_fail_refused_commands`); the regions go on dialling.
    9. Close: `close` ends all tasks and sockets.  Only the program ends a robot that was connected once.

Promises, and what keeps them:

    - Every command is answered exactly once: ids live in the session, across sockets; a second answer to an
      id is dropped there.
    - A command that has not ended is sent again after a reconnect: steps 2 and 4.
    - A planned change of server or region loses no command and interrupts none: steps 3, 6 and 7.
    - A robot never gives up: steps 5 and 8.
"""

from __future__ import annotations

import asyncio
import random as random_module
import ssl
import time
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from websockets.exceptions import ConnectionClosed

from client_sdk.concurrency.tasks import cancel_tasks, wait_for_event
from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.network.backoff import Backoff
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.dial_errors import (
    CHECK_ADDRESS,
    CHECK_RUNNING,
    DialError,
    replaced_connection_error,
    revoked_token_error,
)
from client_sdk.network.handshake import Dialler, Token
from client_sdk.network.message_tap import MessageTap
from client_sdk.network.region_choice import MAX_REGIONS, RegionChoice
from client_sdk.network.region_sockets import Region, RegionSocket
from rse_pf.errors import ConnectError, ProtocolError, RsePfError, UnsupportedProtocol, UsageError
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

__all__ = [
    "Connection",
    "OnChange",
    "RobotEvent",
]

RobotEvent = Answered | Progressed | Updated | SubscriptionEnded
"""An event of the session that concerns a command or a subscription, and not a single WebSocket."""

OnChange = Callable[[str, str], None] | None
"""Called with the name of a change of the connection and its detail.

``link-lost`` and ``refused`` come with the reason, ``link-back`` and ``moved`` with the name of the server
that gets the commands now, ``stands-by`` with the name of a server of another region, to which a connection
is open that carries no command.
"""

FIRST_CONNECT_ATTEMPTS = 4
"""How many attempts a robot's first connect makes before it raises; later reconnects have no limit."""
MIN_TIMER_PAUSE_S = 0.001
"""Shortest pause of the timer task, so that deadlines that are due at once do not make it spin."""
OTHER_REGIONS_MAX_WAIT_S = 0.7
"""Longest wait for the other regions of a first connect once one of them can be used, in seconds; attempts
that take longer go on in the background."""
DUPLICATE_REGION_S = 5.0
"""A platform keeps one connection of a robot, and closes the older one as replaced when a newer one opens.
If it does so within this many seconds after the robot opened a connection in another region, both addresses
lead to the same platform."""
LATE_WELCOME_S = 60.0
"""A stalled server may accept an attempt to connect up to this many seconds after the robot gave it up.  The
platform then closes the robot's newer connection as replaced; within this time the robot reconnects after
such a close, and does not report that another program uses its token."""
TOKEN_CLOCK_STEP_S = 1.0
"""After a revocation the robot waits this many seconds before it signs a new token: a token states its time
in whole seconds, which must be later than the revocation."""
CLOCK_POLL_S = 1.0
"""Seconds between two comparisons of the wall clock with the monotonic clock while a robot waits to dial."""
CLOCK_STEP_S = 0.5
"""A wall clock that moved by more than this many seconds against the monotonic clock was set by somebody;
the robot then dials at once, because a server may have refused a token that was signed by the wrong time."""


class Connection:
    """Keep the `ClientSession` of one robot connected until `close`; the module text lists states and rules.

    The counters `reconnects`, `moves`, `region_changes`, `bytes_in` and `bytes_out` (payload of WebSocket
    messages) start at 0 and only grow.
    """

    def __init__(
        self,
        urls: Sequence[str],
        *,
        token: Token,
        session: ClientSession,
        timings: ConnectTimings,
        on_event: Callable[[RobotEvent], None],
        clock: Callable[[], float],
        random: random_module.Random,
        wall_clock: Callable[[], float] = time.time,
        on_change: OnChange = None,
        callbacks: UserCallbacks,
        tap: MessageTap | None = None,
    ) -> None:
        """Prepare the connections of one robot; `open` makes them.

        Args:
            urls: WebSocket address of each region, 1 to `MAX_REGIONS` different ones.
            token: Text of the robot's token, an async function that returns one, or None.
            session: Holds the commands and the rules of the protocol.
            timings: Timeouts and longest pauses of attempts to connect.
            on_event: Receives the events of commands and subscriptions, in the event loop.
            clock: Monotonic seconds.
            random: Source of the jitter of pauses.
            wall_clock: Unix seconds; the clock by which *token* signs.
            on_change: Function of the program that is notified when the connection changes.
            callbacks: Calls *on_change* and *token*, and survives their exceptions.
            tap: Observes every message, such as a recorder, and raises nothing; None observes nothing.

        Raises:
            UsageError: An address is no WebSocket address or appears twice, or there are too many.
        """
        self.reconnects = 0
        self.moves = 0
        self.region_changes = 0
        self.bytes_in = 0
        self.bytes_out = 0
        self.last_error = ""
        self.refusal: RsePfError | None = None
        """The refusal of the first region while all regions refuse this robot, else None."""
        self._tap = tap
        self._session = session
        self._settings = session.settings
        self._timings = timings
        self.dialler = Dialler(
            token, codec=session.codec.name, settings=session.settings, timings=timings, callbacks=callbacks
        )
        self._on_event = on_event
        self._on_change = on_change
        self._callbacks = callbacks
        self._clock = clock
        self._wall_clock = wall_clock
        self._sockets: list[RegionSocket] = []
        self._tasks: set[asyncio.Task[Any]] = set()
        self._timer_changed = asyncio.Event()
        self._next_timer_s = 0.0
        self._random = random
        self._regions, self._choice = self._make_regions(urls)
        self._last_region: Region | None = None
        self._late_welcome_until_s = float("-inf")
        self._main_tasks: list[asyncio.Task[None]] = []
        self._is_closed = False

    def set_access(self, urls: Sequence[str], token: Token, ssl_context: ssl.SSLContext | None) -> None:
        """Replace addresses, token and TLS context before `open`; a context of None is the default one."""
        self._regions, self._choice = self._make_regions(urls)
        self.dialler.token = token
        self.dialler.ssl_context = ssl_context

    @property
    def url(self) -> str:
        """The address whose socket carries the commands; while none does, the first address."""
        return self._current_region().url

    @property
    def region(self) -> str:
        """The address of `url` without user name and password, as the name of the region."""
        return self._current_region().shown_url

    async def open(self, *, may_be_down: bool = False) -> None:
        """Connect for the first time, with at most four attempts in each region, and start the tasks.

        Args:
            may_be_down: If the first attempt fails by a cause that may pass, such as no answer, return and go
                on dialling in the background.

        Raises:
            Unauthorized: The token is missing, wrong or expired.
            UnsupportedProtocol: Client and server share no sub-protocol.
            ConnectError: No server answers at the address.
        """
        for attempt in range(1, FIRST_CONNECT_ATTEMPTS + 1):
            failures = await self._join_nearest_region()
            nearest = self._choice.nearest(self._usable_sockets())
            if nearest is not None:
                self._adopt(self._usable_sockets()[nearest])
                break
            failure = min(failures, key=self._is_hopeless)
            if self._is_hopeless(failure):
                raise failure.error from None
            if may_be_down:
                self._notify_change("link-lost", failure.error.message)
                break
            if attempt == FIRST_CONNECT_ATTEMPTS:
                raise failure.error from None
            await asyncio.sleep(self._regions[0].backoff.pause_s(self._clock(), failure))
        region_tasks = [self._start_task(self._maintain_region(region)) for region in self._regions]
        self._main_tasks = [self._start_task(self._run_timers()), *region_tasks]
        for socket in self._usable_sockets().values():
            if socket.state is not self._session.current:
                self._notify_change("stands-by", socket.state.server)

    async def close(self) -> None:
        """End all tasks and close all sockets; unanswered commands stay in the session."""
        self._is_closed = True
        await cancel_tasks(self._main_tasks)
        await asyncio.gather(*(self._close_socket(socket) for socket in list(self._sockets)))
        await cancel_tasks(self._tasks)

    def flush(self) -> None:
        """Send the messages that the session has written, and close drained sockets.

        Call this after each method of the session.  The timer task is woken if a deadline came closer.
        """
        for socket in list(self._sockets):
            if socket.state.outgoing:
                socket.has_outgoing.set()
            is_drained = socket.state.leaving and not self._session.unanswered_on(socket.state)
            if is_drained and not socket.state.outgoing and not socket.is_closing:
                self._start_task(self._close_socket(socket))
        if self._session.next_due(self._clock()) < self._next_timer_s:
            self._timer_changed.set()

    # --- Choice among several regions -----------------------------------------------------------

    def _make_regions(self, urls: Sequence[str]) -> tuple[list[Region], RegionChoice]:
        if len(set(urls)) != len(urls) or not 0 < len(urls) <= MAX_REGIONS:
            raise UsageError(
                f"{len(urls)} addresses were given, of which {len(set(urls))} are different",
                hint=f"give connect 1 to {MAX_REGIONS} different addresses",
            )
        regions = []
        for number, url in enumerate(urls):
            backoff = Backoff(self._timings, self._random, self._wall_clock)
            regions.append(Region(number, url, backoff))
        return regions, RegionChoice(len(regions), hold_s=self._timings.region_hold_s)

    def _current_region(self) -> Region:
        current = self._session.current
        regions = (socket.region for socket in self._sockets if socket.state is current)
        return next(regions, self._regions[0])

    def _is_hopeless(self, failure: DialError) -> bool:
        """Return whether another attempt of a first connect would fail in the same way."""
        return failure.is_wrong_address or failure.is_lasting_refusal(self._wall_clock())

    def _usable_sockets(self) -> dict[int, RegionSocket]:
        """Return the STANDBY and CURRENT sockets by the number of their region."""
        usable = {region.number: region.usable_socket for region in self._regions}
        return {number: socket for number, socket in usable.items() if socket is not None}

    async def _join_nearest_region(self) -> list[DialError]:
        """Dial all regions at once, and return the failures once the nearest usable region is known.

        Attempts that still run are left to `Region.first_join`.  If no attempt has failed, the list holds an
        error for a caller that then finds no usable socket, because all were closed again.
        """
        # 1. Dial every region, and wait until the first one can be used or all have failed.
        began_s = self._clock()
        joins = [self._start_task(self._join_region(region)) for region in self._regions]
        running = set(joins)
        try:
            while running and not self._usable_sockets():
                _, running = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            # 2. Wait for the other regions as long again, at most 0.7 s: one that needs longer is not the
            # nearest.
            if running:
                others_s = min(OTHER_REGIONS_MAX_WAIT_S, self._clock() - began_s)
                _, running = await asyncio.wait(running, timeout=others_s)
        except asyncio.CancelledError:
            await cancel_tasks(joins)
            raise
        # 3. Store the failure of each region; attempts that still run go on in the background.
        for region, task in zip(self._regions, joins, strict=True):
            region.first_join = task if task in running else None
            region.last_failure = None if task in running else task.result()
        failures = [region.last_failure for region in self._regions if region.last_failure is not None]
        lost = DialError(ConnectError(f"{self.region} closed the connection at once", hint=CHECK_RUNNING))
        return failures or [lost]

    async def _join_region(self, region: Region) -> DialError | None:
        """Dial *region*, and make the new socket its STANDBY socket; return the failure, or None.

        A robot with several regions also waits for the first round trip, at most ``session.ping_timeout_s``.
        """
        try:
            socket = await self._dial(region)
        except DialError as failure:
            return failure
        if len(self._regions) > 1:
            self._handle_events(socket, self._session.check(socket.state, self._clock()))
            self.flush()
            await wait_for_event(socket.has_round_trip, self._settings.ping_timeout_s)
        self._hold_socket(socket)
        return None

    def _hold_socket(self, socket: RegionSocket) -> None:
        """Make a welcomed *socket* the one of its region, in the state STANDBY, unless it has ended."""
        region = socket.region
        if not socket.has_ended.is_set():
            region.socket = socket
            region.connected_since_s = self._clock()
            region.last_failure = None
            region.is_duplicate = False
            if self._session.current is not None and self._main_tasks:
                self._notify_change("stands-by", socket.state.server)

    def _record_round_trip(self, socket: RegionSocket) -> None:
        """Count the last pong of *socket*, and adopt the socket of a region that has long been nearer."""
        exchange = socket.state.last_exchange
        if exchange is None or exchange is socket.measured_exchange:
            return
        socket.measured_exchange = exchange
        socket.has_round_trip.set()
        # The time between ping and pong that the server states as its own is not subtracted: a server that
        # states the whole time would seem to be the nearest one.
        self._choice.add_round_trip(socket.region.number, exchange.returned_s - exchange.sent_s)
        usable, current = self._usable_sockets(), self._current_region()
        if len(self._regions) > 1 and current.number in usable:
            nearer = self._choice.find_nearer_region(current.number, usable, self._clock())
            if nearer is not None:
                self._adopt(usable[nearer])
                self._notify_change("moved", usable[nearer].state.server)

    def _switch_to_standby(self) -> None:
        """Adopt the nearest STANDBY socket, if there is one, after the CURRENT socket was lost."""
        usable = self._usable_sockets()
        nearest = self._choice.nearest(usable)
        if nearest is not None and self._main_tasks:
            self._choice.restart_comparison()
            self._adopt_after_loss(usable[nearest])

    # --- Tasks that run from open to close ------------------------------------------------------

    async def _run_timers(self) -> None:
        """Let the session act whenever a deadline, a ping or the repeat of a command is due."""
        while not self._is_closed:
            now_s = self._clock()
            self._handle_events(None, self._session.due(now_s))
            for socket in list(self._sockets):
                self._handle_events(socket, self._session.check(socket.state, now_s))
            self._next_timer_s = self._session.next_due(now_s)
            self.flush()
            pause_s = max(MIN_TIMER_PAUSE_S, self._next_timer_s - self._clock())
            await wait_for_event(self._timer_changed, pause_s)
            self._timer_changed.clear()

    async def _maintain_region(self, region: Region) -> None:
        """Reconnect *region* when it has no socket, and move when its server asks for it."""
        if region.first_join is not None:
            region.last_failure = await region.first_join
            self._adopt_if_disconnected(region)
        while not self._is_closed:
            is_needed = not (region.is_duplicate and self._usable_sockets())
            if region.socket is None and is_needed:
                await self._reconnect(region)
            elif region.move_request is not None:
                await self._move_to_other_server(region, *region.move_request)
                region.move_request = None
            else:
                region.has_changed.clear()
                await region.has_changed.wait()

    async def _reconnect(self, region: Region) -> None:
        """Dial *region*, with a pause before each attempt, until a server sends Welcome."""
        if self._clock() - region.connected_since_s > self._timings.reconnect_max_s:
            region.backoff.reset()
        began_s, clock_offset_s = self._clock(), self._clock_offset_s()
        while True:
            # 1. Pause for as long as the last failure demands, or until the wall clock is set.
            now_s = self._clock()
            pause_s = region.backoff.pause_s(now_s, region.last_failure, spent_s=now_s - began_s)
            await self._sleep_until_clock_step(pause_s, clock_offset_s)
            # 2. Dial the region, and wait for the Welcome.
            began_s, clock_offset_s = self._clock(), self._clock_offset_s()
            region.last_failure = await self._join_region(region)
            # 3. Continue the commands on the new socket, or end them if every region refuses the robot.
            if region.last_failure is None:
                self._adopt_if_disconnected(region)
                return
            self._fail_refused_commands()

    def _clock_offset_s(self) -> float:
        """Return wall clock minus monotonic clock in seconds; it changes only if the wall clock is set."""
        return self._wall_clock() - asyncio.get_running_loop().time()

    async def _sleep_until_clock_step(self, pause_s: float, clock_offset_s: float) -> None:
        """Wait for *pause_s* seconds at most; end if the wall clock was set since it had *clock_offset_s*."""
        until_s = asyncio.get_running_loop().time() + pause_s
        while (left_s := until_s - asyncio.get_running_loop().time()) > 0:
            if abs(self._clock_offset_s() - clock_offset_s) > CLOCK_STEP_S:
                return
            await asyncio.sleep(min(left_s, CLOCK_POLL_S))

    def _fail_refused_commands(self) -> None:
        """End all commands with the reason if every region refuses this robot; dialling goes on."""
        now_unix_s = self._wall_clock()
        failures = [region.last_failure for region in self._regions if region.last_failure is not None]
        refusals = [failure for failure in failures if failure.is_lasting_refusal(now_unix_s)]
        if len(refusals) < len(self._regions):
            return
        error, earlier = refusals[0].error, self.refusal
        self.refusal = error
        self.last_error = error.message
        self._handle_events(None, self._session.end_commands(error.code, error.message, error.hint))
        if earlier is None or (earlier.code, earlier.hint) != (error.code, error.hint):
            self._notify_change("refused", error.message)

    def _adopt_if_disconnected(self, region: Region) -> None:
        """Adopt the socket of *region* if no other socket carries the commands."""
        if region.socket is not None and self._session.current is None:
            self._adopt_after_loss(region.socket)

    def _adopt_after_loss(self, socket: RegionSocket) -> None:
        self.reconnects += 1
        self._adopt(socket)
        self._notify_change("link-back", socket.state.server)

    async def _move_to_other_server(self, region: Region, old: RegionSocket, until_s: float) -> None:
        """Replace *old* by a socket to another server of its region, until *until_s* of the monotonic clock.

        The load balancer may choose the same server again; the attempt is then repeated after a pause.
        """
        region.backoff.reset()
        while self._session.current is old.state and self._clock() < until_s:
            failure: DialError | None = None
            try:
                fresh = await self._dial(region)
            except DialError as error:
                failure = error
            else:
                if self._session.current is not old.state:  # *old* was lost during the attempt
                    self._hold_socket(fresh)
                    self._adopt_if_disconnected(region)
                    return
                if fresh.state.server != old.state.server:
                    self.moves += 1
                    region.socket = fresh
                    self._adopt(fresh)
                    self._notify_change("moved", fresh.state.server)
                    return
                self._start_task(self._close_socket(fresh))
            pause_s = region.backoff.pause_s(self._clock(), failure, is_move=True)
            await wait_for_event(old.has_ended, min(pause_s, max(0.0, until_s - self._clock())))

    # --- One WebSocket, from its handshake to its end -------------------------------------------

    async def _dial(self, region: Region) -> RegionSocket:
        """Return a new socket to *region* after its Welcome; raises DialError."""
        # 1. Open the WebSocket with the robot's token.
        try:
            websocket, token = await self.dialler.open(
                region.url, lambda: region.backoff.count_attempt(self._clock())
            )
        except DialError as failure:
            self.last_error = failure.error.message
            if failure.may_be_accepted_late:
                self._late_welcome_until_s = self._clock() + LATE_WELCOME_S
            raise
        # 2. Start the tasks that read and write the socket; the first message is Hello.
        socket = RegionSocket(region, websocket, self._session.open_connection(self._clock()))
        self._sockets.append(socket)
        if self._tap is not None:
            socket.tap_number = self._tap.open_connection(self._session.codec, token)
        socket.tasks = [
            self._start_task(self._read_messages(socket)),
            self._start_task(self._write_messages(socket)),
        ]
        socket.has_outgoing.set()
        # 3. Wait for the Welcome of the server.
        try:
            done, _ = await asyncio.wait({socket.welcomed}, timeout=self._timings.connect_timeout_s)
            if not done:
                error = ConnectError(f"{region.shown_url} sends no Welcome message", hint=CHECK_ADDRESS)
                raise DialError(error)
            socket.welcomed.result()
        except BaseException:
            self._late_welcome_until_s = self._clock() + LATE_WELCOME_S
            self._abort_socket(socket)
            raise
        return socket

    async def _renew_token(self, socket: RegionSocket) -> None:
        """Send a fresh token on *socket*, which the session requests before the old token expires.

        Without a fresh token the server closes the socket later, and the robot reconnects.
        """
        try:
            token = await self.dialler.read_token()
        except DialError as failure:
            self.last_error = failure.error.message
            return
        if token and not socket.has_ended.is_set() and not socket.is_closing:
            self._session.renew(socket.state, token)
            self.flush()

    async def _read_messages(self, socket: RegionSocket) -> None:
        try:
            while True:
                data = await socket.websocket.recv(decode=False)
                self.bytes_in += len(data)
                if self._tap is not None:
                    self._tap.observe_message(socket.tap_number, "down", data)
                self._receive(socket, data)
        except (ConnectionClosed, OSError):
            code = socket.websocket.close_code
            is_held = socket.region.socket is socket
            if code == CLOSE_RATE:
                self.last_error = "the server closed the connection: this robot exceeds its rate limit"
            elif is_held and code == CLOSE_REVOKED:
                is_fresh = callable(self.dialler.token)
                valid_from_s = self._wall_clock() + TOKEN_CLOCK_STEP_S if is_fresh else None
                socket.region.last_failure = revoked_token_error(valid_from_s)
            elif is_held and code == CLOSE_REPLACED and self._is_replaced_by_another_program(socket):
                socket.region.last_failure = replaced_connection_error()
            elif is_held and code == CLOSE_REPLACED:
                socket.region.last_failure = None
        finally:
            self._discard_socket(socket)

    def _is_replaced_by_another_program(self, socket: RegionSocket) -> bool:
        """Return whether a connection of another program, and none of this robot, has replaced *socket*.

        The region of *socket* is marked if it is a duplicate of another one.
        """
        is_own = self._detect_duplicate_region(socket) or socket.region.move_request is not None
        is_late_welcome = self._clock() < self._late_welcome_until_s
        return not is_own and not is_late_welcome and self._session.current is socket.state

    def _detect_duplicate_region(self, socket: RegionSocket) -> bool:
        """Mark the region of *socket* if another region has the same platform; return whether it is marked.

        A platform keeps the newest connection of a robot only.  So the mark is set if a socket of another
        region was opened after *socket* and within the last `DUPLICATE_REGION_S`.
        """
        region = socket.region
        since_s = max(socket.state.opened, self._clock() - DUPLICATE_REGION_S)
        if any(other.state.opened >= since_s for other in self._sockets if other.region is not region):
            region.is_duplicate = True
        return region.is_duplicate

    def _receive(self, socket: RegionSocket, data: bytes) -> None:
        try:
            events = self._session.receive(socket.state, data, self._clock())
        except ProtocolError as error:
            self.last_error = error.message
            socket.malformed_messages += 1
            if socket.malformed_messages > MAX_BAD_MESSAGES:
                self._abort_socket(socket)
            return
        self._handle_events(socket, events)
        self._record_round_trip(socket)
        self.flush()

    async def _write_messages(self, socket: RegionSocket) -> None:
        is_text = self._session.codec.is_text
        try:
            while True:
                await socket.has_outgoing.wait()
                socket.has_outgoing.clear()
                while socket.state.outgoing:
                    data = socket.state.outgoing.pop(0)
                    self.bytes_out += len(data)
                    if self._tap is not None:
                        self._tap.observe_message(socket.tap_number, "up", data)
                    await socket.websocket.send(data, text=is_text)
        except (ConnectionClosed, OSError):
            return  # the reading task discards the socket, after it has read the messages that still arrive

    def _handle_events(self, socket: RegionSocket | None, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, RobotEvent):
                self._on_event(event)
            elif socket is not None:
                self._handle_socket_event(socket, event)

    def _handle_socket_event(self, socket: RegionSocket, event: Event) -> None:
        region = socket.region
        match event:
            case Welcomed() if not socket.welcomed.done():
                socket.welcomed.set_result(None)
            case ConnectionLost():
                self.last_error = f"connection lost: {event.reason}"
                if not socket.state.leaving and self._session.current is None:
                    self._notify_change("link-lost", event.reason)
                self._abort_socket(socket)
            case RenewalDue() if callable(self.dialler.token):
                self._start_task(self._renew_token(socket))
            case Notice():
                failure = event.failure
                self.last_error = failure.message
                if not socket.welcomed.done():
                    error = UnsupportedProtocol(failure.message, hint=failure.hint)
                    is_refusal = failure.code == error.code
                    socket.welcomed.set_exception(DialError(error, is_refusal=is_refusal))
            case MoveRequested() if socket.state is self._session.current:
                if region.move_request is None:
                    region.move_request = (socket, self._clock() + event.within_s)
                    region.has_changed.set()
            case MoveRequested() if len(self._regions) > 1 and not socket.state.leaving:
                self._start_task(self._close_socket(socket))  # STANDBY, so it carries no command

    def _adopt(self, socket: RegionSocket) -> None:
        """Make *socket* CURRENT, and send the waiting commands on it; does nothing if it has ended."""
        now_s = self._clock()
        if socket.has_ended.is_set():
            return
        self.refusal = None
        self.region_changes += self._last_region not in (None, socket.region)
        self._last_region = socket.region
        self._handle_events(socket, self._session.adopt(socket.state, now_s))
        self._handle_events(socket, self._session.check(socket.state, now_s))
        self.flush()

    def _abort_socket(self, socket: RegionSocket) -> None:
        """End *socket* without a close handshake: its server is silent or breaks the protocol."""
        socket.websocket.transport.abort()
        self._discard_socket(socket)

    async def _close_socket(self, socket: RegionSocket) -> None:
        socket.is_closing = True
        await socket.websocket.close()
        self._discard_socket(socket)

    def _discard_socket(self, socket: RegionSocket) -> None:
        """Make *socket* ENDED: its commands wait in the session, and its region dials again."""
        if socket.has_ended.is_set():
            return
        # 1. Forget the socket; the session keeps its unanswered commands.
        socket.has_ended.set()
        self._sockets.remove(socket)
        if self._tap is not None:
            self._tap.close_connection(socket.tap_number)
        if self._session.current is socket.state and not self._is_closed:
            self._notify_change("link-lost", "closed")
        self._session.close_connection(socket.state)
        # 2. End the tasks of the socket, and every wait for its Welcome or its first pong.
        for task in socket.tasks:
            if task is not asyncio.current_task():
                task.cancel()
        if not socket.welcomed.done():
            shown_url = socket.region.shown_url
            error = ConnectError(f"{shown_url} closed without a Welcome message", hint=CHECK_RUNNING)
            socket.welcomed.set_exception(DialError(error))
            socket.welcomed.exception()  # asyncio would log an exception that nobody retrieves
        socket.has_round_trip.set()
        # 3. Remove the socket from its region.
        region = socket.region
        if region.socket is socket:
            region.socket = None
            if not socket.is_closing:
                self._choice.add_loss(region.number, self._clock())
        # 4. Continue in another region, and wake up the tasks that reconnect.
        if self._session.current is None and not self._is_closed:
            self._switch_to_standby()
            self._fail_refused_commands()
        for any_region in self._regions:
            any_region.has_changed.set()
        self._timer_changed.set()

    def _notify_change(self, change: str, detail: str) -> None:
        if self._on_change is not None:
            self._callbacks.notify("on_change", self._on_change, change, detail)

    def _start_task(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Run *work* as a task that is referenced until it ends, and that `close` cancels."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task
