"""The rules of a robot's side of the protocol, over any number of connections, without input or output.

A `ClientSession` lives as long as the robot, a `ConnectionState` as long as one WebSocket.  Commands survive
the end of a connection: they are sent again on the next one, under the same id.  Every command gets exactly
one final answer, no stale answer is delivered as fresh, and no more are unanswered than the server accepts.
The caller passes the time as ``now``: seconds of the robot's monotonic clock.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.config import SessionSettings
from rse_pf.errors import LimitExceeded
from rse_pf.wire.client_subscriptions import ClientSubscriptions, SubscriptionEnded, Updated
from rse_pf.wire.clock_offset import ClockOffset, Exchange
from rse_pf.wire.codec import Codec
from rse_pf.wire.messages import (
    Cancel,
    Command,
    Failure,
    Hello,
    Message,
    Move,
    Ping,
    Pong,
    Progress,
    Renew,
    Renewed,
    Result,
    Update,
    Welcome,
)
from rse_pf.wire.preencoded import encode_command
from rse_pf.wire.rate_limit import MAX_PAUSE_S, Backlog, RateLimiter, Reason, is_long_outage, send_order
from rse_pf.wire.renewal_timer import RenewalTimer
from rse_pf.wire.server_session import PROGRESS, UPDATES

__all__ = [
    "Answered",
    "ClientSession",
    "ConnectionLost",
    "ConnectionState",
    "Event",
    "MoveRequested",
    "Notice",
    "Progressed",
    "RenewalDue",
    "Welcomed",
]

_CAPABILITIES = ("move", PROGRESS, UPDATES)
_MAX_TRIES_AFTER_LOSS = 2
"""Times that a command is sent again after the answer ``worker-lost``: the command may be the cause."""
_RETRY_BURST = 5.0
"""Retries after busy that a robot may make at once, before `RETRY_SHARE` limits them."""
_PINGS_PER_STALL_TIMEOUT = 3.0
_MAX_DEADLINE_MS = 3.6e6
RETRY_SHARE = 0.1
"""Retries after busy, as a share of the commands.  Source: Google SRE book, ch. 21."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A command ended.

    ``sent_s`` is when the robot accepted it (its clock); ``up_s`` and ``down_s`` are the paper's two
    one-way delays, None where no clock offset is known; ``wire_bytes`` is the size of its message.
    """

    id: int
    answer: Result | Failure
    sent_s: float
    wire_bytes: int = 0
    up_s: float | None = None
    down_s: float | None = None


@dataclass(frozen=True, slots=True)
class Welcomed:
    """The server accepted the connection; the session sends on it from now on."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class MoveRequested:
    """The server asks the robot to connect to another server."""

    reason: str
    within_s: float


@dataclass(frozen=True, slots=True)
class ConnectionLost:
    """The connection is lost, although its socket may still be open."""

    reason: str


@dataclass(frozen=True, slots=True)
class Notice:
    """The server reports a failure of a message or of the session, not of one command."""

    failure: Failure


@dataclass(frozen=True, slots=True)
class Progressed:
    """Progress of a long command: the share *done* (0..1), and *what* was done last."""

    id: int
    done: float
    what: str


@dataclass(frozen=True, slots=True)
class RenewalDue:
    """The connection expires soon unless a fresh token is sent: see `ClientSession.renew`."""


Event = (
    RenewalDue
    | Answered
    | Welcomed
    | MoveRequested
    | ConnectionLost
    | Notice
    | Progressed
    | Updated
    | SubscriptionEnded
)


@dataclass(slots=True, kw_only=True)
class _Pending:
    command: Command
    deadline: float
    submitted: float
    wire_bytes: int
    sent_at: float | None = None
    connection: ConnectionState | None = None
    not_before: float = 0.0
    losses: int = 0
    cancelled: bool = False
    was_held: bool = False
    has_default_deadline: bool = False
    is_long: bool = False


@dataclass(slots=True, kw_only=True, eq=False)
class ConnectionState:
    """What the robot knows of one WebSocket."""

    opened: float
    welcome: Welcome | None = None
    leaving: bool = False
    lost: bool = False
    last_heard: float = 0.0
    last_checked: float = 0.0
    last_ping: float | None = None
    ping_sent: float | None = None
    clock_offset: ClockOffset = field(default_factory=ClockOffset)
    last_exchange: Exchange | None = None
    outgoing: list[bytes] = field(default_factory=list)
    rate_limiter: RateLimiter = field(default_factory=RateLimiter)
    renewal: RenewalTimer = field(default_factory=RenewalTimer)
    backlog: Backlog | None = None

    @property
    def server(self) -> str:
        """The server's name, empty before the Welcome."""
        return self.welcome.server if self.welcome else ""


class ClientSession:
    """All commands of one robot, and the connections that carry them.

    Attributes:
        held_back: How many commands were not sent at once although there was a connection, each counted by
            the first reason.
    """

    def __init__(self, *, codec: Codec, settings: SessionSettings, sdk: str, first_id: int = 1) -> None:
        self.codec = codec
        self.settings = settings
        self.current: ConnectionState | None = None
        self.resent = 0
        self.dropped_answers = 0
        self.held_back: Counter[Reason] = Counter()
        self._sdk = sdk
        self._next_id = first_id
        self._pending: dict[int, _Pending] = {}
        self._sequence: dict[str, int] = {}
        self._delivered: dict[str, int] = {}
        self._busy_streams: dict[str, tuple[float, Failure]] = {}
        """By stream, until when it is held back, and the busy answer; a new connection clears this."""
        self._retry_tokens = _RETRY_BURST
        self.subscriptions = ClientSubscriptions()

    @property
    def unanswered(self) -> int:
        """How many commands have no final answer yet."""
        return sum(not pending.cancelled for pending in self._pending.values())

    def submit(
        self,
        service: str,
        payload: Any,
        *,
        now: float,
        deadline_s: float | None = None,
        stream: str = "",
        keep: bool = False,
        trace: str = "",
        is_open_ended: bool = False,
    ) -> int:
        """Accept a command and return its id; it is sent when a connection has capacity for it.

        A command without *deadline_s* gets ``session.answer_timeout_s``, unless it *is_open_ended* or the
        server reports progress on it, which marks it as long.

        Raises:
            BadMessage: The payload does not travel in messages.
            LimitExceeded: The message would be larger than the limit.
        """
        default_s = math.inf if is_open_ended else self.settings.answer_timeout_s
        timeout_s = default_s if deadline_s is None else deadline_s
        command = Command(
            id=self._next_id,
            service=service,
            payload=payload,
            stream=stream,
            seq=self._sequence.get(stream, 0) + 1,
            keep=keep,
            trace=trace,
        )
        data = encode_command(self.codec, _with_deadline(command, timeout_s))
        self._check_size(data)
        pending = _Pending(
            command=command,
            deadline=now + timeout_s,
            submitted=now,
            wire_bytes=len(data),
            has_default_deadline=deadline_s is None,
        )
        self._next_id += 1
        self._sequence[stream] = command.seq
        self._pending[command.id] = pending
        self._retry_tokens = min(_RETRY_BURST, self._retry_tokens + RETRY_SHARE)
        if self.current is not None and self._may_send(
            pending, self.current, self._capacity(self.current, now), now
        ):
            self._write(pending, self.current, now, data)
        return command.id

    def subscribe(self, topic: str, now: float) -> int:
        """Ask for the updates of *topic*, on this connection and all later ones; return the id."""
        identity, self._next_id = self._next_id, self._next_id + 1
        self._say(self.subscriptions.add(identity, topic, now), now)
        return identity

    def unsubscribe(self, identity: int, now: float) -> None:
        """End a subscription; does nothing if it has ended."""
        self._say(self.subscriptions.remove(identity), now)

    def cancel(self, identity: int) -> None:
        """Forget a command that its caller gave up; its answer, if one comes, is dropped.

        The server is asked to cancel a long command.  If the connection ends first, the command is sent
        again on the next one, because only there can it be cancelled.
        """
        pending = self._pending.get(identity)
        if pending is None or pending.cancelled:
            return
        pending.cancelled = True
        if pending.is_long:
            self._cancel_on_server(pending)
        elif pending.connection is None:
            del self._pending[identity]

    def open_connection(self, now: float) -> ConnectionState:
        """Return the state of a WebSocket that was just opened, with a Hello to send."""
        connection = ConnectionState(opened=now, last_heard=now, last_checked=now)
        connection.outgoing.append(self.codec.encode(Hello(sdk=self._sdk, capabilities=_CAPABILITIES)))
        return connection

    def close_connection(self, connection: ConnectionState) -> None:
        """Record that the WebSocket of *connection* ended; its commands wait for the next connection."""
        connection.lost = True
        self.subscriptions.lose(connection)
        if self.current is connection:
            self.current = None
        for identity, pending in list(self._pending.items()):
            if pending.connection is connection:
                pending.connection = None
                if pending.cancelled and not pending.is_long:
                    del self._pending[identity]

    def unanswered_on(self, connection: ConnectionState) -> int:
        """Return how many commands sent on *connection* are unanswered and not cancelled."""
        return sum(
            pending.connection is connection and not pending.cancelled for pending in self._pending.values()
        )

    def adopt(self, connection: ConnectionState, now: float) -> list[Event]:
        """Make a welcomed *connection* the current one and send the waiting commands on it.

        Of a latest-wins stream only the newest frame is sent again.  After a long outage frames are sent in
        the order and at the rate that `rse_pf.wire.rate_limit` describes.
        """
        before, self.current = self.current, connection
        self._busy_streams.clear()
        if before is not None and before is not connection:
            before.leaving = True
            for pending in self._pending.values():
                if pending.connection is before and pending.is_long and not pending.cancelled:
                    pending.connection = None  # the job continues on any server; the old one can close now
        self._say(self.subscriptions.adopt(connection, now), now)
        frames = [frame for frame in self._pending.values() if _is_frame(frame) and frame.connection is None]
        if (
            before is None
            and len(frames) > 1
            and is_long_outage(frames[0].submitted, frames[0].deadline, now)
        ):
            connection.backlog = Backlog(newest=frames[-1].command.id)
        return self._flush(now)

    def receive(self, connection: ConnectionState, data: bytes, now: float) -> list[Event]:
        """Return the events of one WebSocket message; raises ProtocolError if it is invalid."""
        connection.last_heard = now
        message = self.codec.decode_from_server(data)
        match message:
            case Welcome():
                return self._welcome(connection, message, now)
            case Pong():
                return self._pong(connection, message, now)
            case Move():
                within_s = message.within_ms / 1e3
                return [MoveRequested(message.reason, within_s if math.isfinite(within_s) else 0.0)]
            case Renewed():
                connection.renewal.expires_in(message.token_s, now)
                return []
            case Failure(id=None):
                return [Notice(message)]
            case Failure() if message.id in self.subscriptions:
                return [*self.subscriptions.refuse(connection, message)]
            case Update():
                return [*self.subscriptions.update(connection, message)]
            case Progress():
                return self._progress(connection, message)
            case _:
                return self._answer(connection, message, now) + self._flush(now)

    def renew(self, connection: ConnectionState, token: str) -> None:
        """Send a fresh *token* on *connection*; the server then extends the connection."""
        connection.outgoing.append(self.codec.encode(Renew(token=token)))

    def due(self, now: float) -> list[Event]:
        """End the commands whose deadline has passed, and send those that may be sent (again) now."""
        again, ended = self.subscriptions.due(now)
        self._say(again, now)
        events: list[Event] = [*ended]
        for identity, pending in list(self._pending.items()):
            if now >= pending.deadline:
                waited = now - pending.submitted
                failure = _failure(pending.command, "expired", f"no answer within {waited:.3f} s")
                events += self._end(identity, failure)
                if pending.is_long:
                    self._pending[identity] = pending
                    self._cancel_on_server(pending)
        return events + self._flush(now)

    def abandon(self, code: str, message: str, hint: str = "") -> list[Event]:
        """End everything with a failure, because no further connection will be opened."""
        return [*self.subscriptions.abandon(code, message, hint), *self.end_commands(code, message, hint)]

    def end_commands(self, code: str, message: str, hint: str = "") -> list[Event]:
        """End every command with a failure; the subscriptions wait for the next connection."""
        events: list[Event] = []
        for identity, pending in list(self._pending.items()):
            events += self._end(identity, _failure(pending.command, code, message, hint))
        return events

    def check(self, connection: ConnectionState, now: float) -> list[Event]:
        """Send a ping when one is due, and return `ConnectionLost` when the server does not respond.

        A robot that did not run for a while cannot tell whether the server was silent in that time, so such
        a gap does not count towards a timeout.
        """
        s = self.settings
        if connection.lost:
            return []
        if now - connection.last_checked >= s.stall_timeout_s:
            connection.last_heard = now
            connection.ping_sent = None if connection.ping_sent is None else now
        connection.last_checked = now
        if connection.welcome is None:
            late = now - connection.opened >= s.hello_timeout_s
            return self._lose(connection, "no welcome") if late else []
        if connection.ping_sent is not None and now - connection.ping_sent >= s.ping_timeout_s:
            return self._lose(connection, "no pong")
        waiting = [
            pending.sent_at
            for pending in self._pending.values()
            if pending.connection is connection and pending.sent_at is not None and not pending.is_long
        ]
        if waiting and now - max(connection.last_heard, min(waiting)) >= s.stall_timeout_s:
            return self._lose(connection, "silence")
        pause = s.ping_interval_s
        if waiting:
            pause = min(pause, s.stall_timeout_s / _PINGS_PER_STALL_TIMEOUT)
        if connection.last_ping is None or now - connection.last_ping >= pause:
            connection.ping_sent = now if connection.ping_sent is None else connection.ping_sent
            connection.last_ping = now
            connection.outgoing.append(self.codec.encode(Ping(sent_s=now)))
            connection.rate_limiter.spend(now)
        return [RenewalDue()] if not connection.leaving and connection.renewal.is_due(now) else []

    def next_due(self, now: float) -> float:
        """Return the time at which `due` and `check` must be called again."""
        first = now + self.settings.stall_timeout_s / _PINGS_PER_STALL_TIMEOUT
        next_s = now if self.current is None else self.current.rate_limiter.next_s(now)
        for pending in self._pending.values():
            first = min(first, pending.deadline)
            if pending.connection is None:
                if self.current is not None and (
                    self._is_replaced(pending.command) or self._busy_for_too_long(pending, now)
                ):
                    return now
                may_be_sent = max(next_s, self._not_before(pending))
                first = min(first, may_be_sent if may_be_sent > now else first)
        return max(now, first)

    def _flush(self, now: float) -> list[Event]:
        """Send the waiting commands, oldest first, as far as the server's limits allow."""
        connection = self.current
        if connection is None:
            return []
        events: list[Event] = []
        capacity = self._capacity(connection, now)
        waiting = [item for item in self._pending.items() if item[1].connection is None]
        newest = 0 if connection.backlog is None else connection.backlog.newest
        if not any(identity <= newest and _is_frame(pending) for identity, pending in waiting):
            connection.backlog = None
        else:
            waiting.sort(key=lambda item: send_order(item[0], item[1].command.stream))
        for identity, pending in waiting:
            command = pending.command
            if self._is_replaced(command):
                events += self._end(identity, _failure(command, "stale", "a newer frame took its place"))
            elif (busy := self._busy_for_too_long(pending, now)) is not None:
                events += self._end(identity, busy)
            elif self._may_send(pending, connection, capacity, now):
                capacity -= 1
                self._write(pending, connection, now)
                if pending.cancelled:
                    self._cancel_on_server(pending)
        return events

    def _is_replaced(self, command: Command) -> bool:
        """Return whether a newer frame of its stream makes this one void."""
        return bool(command.stream) and not command.keep and command.seq < self._sequence[command.stream]

    def _not_before(self, pending: _Pending) -> float:
        """Return the time until which a busy answer holds back this command or its stream."""
        until_s, _ = self._busy_streams.get(pending.command.stream, (0.0, None))
        return max(pending.not_before, until_s)

    def _busy_for_too_long(self, pending: _Pending, now: float) -> Failure | None:
        """Return the answer by which a waiting frame ends whose stream is held back past its deadline."""
        until_s, busy = self._busy_streams.get(pending.command.stream, (0.0, None))
        if busy is None or until_s < pending.deadline or until_s <= now:
            return None
        command, left_ms = pending.command, 1e3 * (until_s - now)
        return msgspec.structs.replace(busy, id=command.id, trace=command.trace, retry_after_ms=left_ms)

    def _may_send(self, pending: _Pending, connection: ConnectionState, capacity: int, now: float) -> bool:
        """Return whether this command may be sent now; count it if it is held back."""
        reason = self._reason_to_wait(pending, connection, capacity, now)
        if reason is not None and not pending.was_held:
            pending.was_held = True
            self.held_back[reason] += 1
        return reason is None

    def _reason_to_wait(
        self, pending: _Pending, connection: ConnectionState, capacity: int, now: float
    ) -> Reason | None:
        if now < self._not_before(pending):
            return "busy"
        if capacity > 0 and pending.command.stream and connection.backlog is not None:
            sent = sum(
                _is_frame(other) and other.connection is connection for other in self._pending.values()
            )
            capacity = connection.backlog.max_in_flight - sent
        return None if capacity > 0 else "own-limit"

    def _capacity(self, connection: ConnectionState, now: float) -> int:
        """Return how many commands may be sent now without exceeding the server's limits."""
        limit = connection.welcome.limits.max_in_flight if connection.welcome else self.settings.max_in_flight
        free = max(1, limit) - sum(pending.connection is connection for pending in self._pending.values())
        return min(free, connection.rate_limiter.available(now))

    def _say(self, messages: list[Message], now: float) -> None:
        """Write *messages* on the current connection, whatever the rate limit says."""
        if self.current is not None:
            self.current.outgoing += [self.codec.encode(message) for message in messages]
            for _ in messages:
                self.current.rate_limiter.spend(now)

    def _check_size(self, data: bytes) -> None:
        max_bytes = self.settings.max_message_bytes
        if self.current is not None and self.current.welcome is not None:
            max_bytes = min(max_bytes, self.current.welcome.limits.max_message_bytes)
        if len(data) > max_bytes:
            raise LimitExceeded(
                f"a command of {len(data)} bytes is above {max_bytes}",
                hint="send fewer matches, or send large data to the data server",
            )

    def _write(
        self, pending: _Pending, connection: ConnectionState, now: float, data: bytes | None = None
    ) -> None:
        self.resent += pending.sent_at is not None
        pending.connection = connection
        pending.sent_at = now
        connection.rate_limiter.spend(now)
        connection.outgoing.append(
            encode_command(self.codec, _with_deadline(pending.command, pending.deadline - now))
            if data is None
            else data
        )

    def _answer(self, connection: ConnectionState, answer: Result | Failure, now: float) -> list[Event]:
        pending = self._pending.get(-1 if answer.id is None else answer.id)
        elsewhere = pending is not None and pending.connection is not connection
        if pending is None or (elsewhere and isinstance(answer, Failure)):
            self.dropped_answers += 1
            return []
        if connection.backlog is not None:
            connection.backlog.note_answer(answer.queue_ms if isinstance(answer, Result) else math.inf)
        if isinstance(answer, Failure):
            return [] if self._retry(pending, answer, now) else self._end(pending.command.id, answer)
        command = pending.command
        if now >= pending.deadline:
            late = _failure(command, "expired", f"its answer came after {now - pending.submitted:.3f} s")
            return self._end(command.id, late)
        last = self._delivered.get(command.stream, 0)
        if command.stream and not command.keep and command.seq < last:
            stale = _failure(command, "stale", "a newer answer came first")
            return self._end(command.id, stale)
        if not pending.cancelled:
            self._delivered[command.stream] = max(last, command.seq)
        up_s = None
        down_s = None
        if not elsewhere and pending.sent_at is not None:
            up_s, down_s = connection.clock_offset.split_s(
                pending.sent_at, answer.received_s, answer.sent_s, now
            )
        return self._end(command.id, answer, up_s, down_s)

    def _retry(self, pending: _Pending, failure: Failure, now: float) -> bool:
        """Schedule a retry if another server or a later time may help; return whether one is scheduled."""
        pause_s = max(0.0, failure.retry_after_ms or 0.0) / 1e3
        if failure.code == "busy" and pause_s > 0.0 and pending.command.stream:
            self._busy_streams[pending.command.stream] = now + min(MAX_PAUSE_S, pause_s), failure
        if pending.cancelled:
            return False
        if failure.code == "worker-lost" and pending.losses < _MAX_TRIES_AFTER_LOSS:
            pending.losses += 1
            pending.connection = None
            return True
        after = now + pause_s
        if failure.code != "busy" or not after < pending.deadline or self._retry_tokens < 1.0:
            return False
        self._retry_tokens -= 1.0
        pending.connection = None
        pending.not_before = after
        return True

    def _progress(self, connection: ConnectionState, progress: Progress) -> list[Event]:
        """Mark a command as long, so that the default deadline no longer applies to it."""
        pending = self._pending.get(progress.id)
        if pending is None or pending.connection is not connection:
            return []
        if pending.cancelled:
            if not pending.is_long:
                pending.is_long = True
                self._cancel_on_server(pending)
            return []
        pending.is_long = True
        if pending.has_default_deadline:
            pending.deadline = math.inf
        share = min(1.0, max(0.0, progress.done)) if math.isfinite(progress.done) else 0.0
        return [Progressed(progress.id, share, progress.what)]

    def _cancel_on_server(self, pending: _Pending) -> None:
        pending.cancelled = True
        pending.deadline = math.inf
        if pending.connection is not None:
            pending.connection.outgoing.append(self.codec.encode(Cancel(id=pending.command.id)))

    def _welcome(self, connection: ConnectionState, welcome: Welcome, now: float) -> list[Event]:
        if connection.welcome is not None:
            return []
        connection.welcome = welcome
        connection.rate_limiter = RateLimiter(welcome.limits)
        if welcome.token_s is not None:
            connection.renewal.expires_in(welcome.token_s, now)
        return [Welcomed(welcome)]

    def _pong(self, connection: ConnectionState, pong: Pong, now: float) -> list[Event]:
        connection.ping_sent = None
        exchange = Exchange(pong.sent_s, pong.received_s, pong.answered_s, now)
        if connection.opened <= pong.sent_s <= now and exchange.is_plausible:
            connection.last_exchange = exchange
            connection.clock_offset.add(exchange)
        return []

    def _lose(self, connection: ConnectionState, reason: str) -> list[Event]:
        self.close_connection(connection)
        return [ConnectionLost(reason)]

    def _end(
        self, identity: int, answer: Result | Failure, up_s: float | None = None, down_s: float | None = None
    ) -> list[Event]:
        pending = self._pending.pop(identity)
        if pending.cancelled:
            self.dropped_answers += isinstance(answer, Result)
            return []
        return [
            Answered(
                id=identity,
                answer=answer,
                sent_s=pending.submitted,
                wire_bytes=pending.wire_bytes,
                up_s=up_s,
                down_s=down_s,
            )
        ]


def _with_deadline(command: Command, remaining_s: float) -> Command:
    return msgspec.structs.replace(command, deadline_ms=min(_MAX_DEADLINE_MS, max(0.0, remaining_s * 1e3)))


def _is_frame(pending: _Pending) -> bool:
    """Return whether the command is a frame: part of a stream, with a deadline."""
    return bool(pending.command.stream) and math.isfinite(pending.deadline)


def _failure(command: Command, code: str, message: str, hint: str = "") -> Failure:
    return Failure(id=command.id, code=code, message=message, hint=hint, trace=command.trace)
