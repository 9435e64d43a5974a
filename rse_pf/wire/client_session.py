"""The rules of the robot's side of the protocol, over any number of connections, without input or output.

A `ClientSession` exists as long as the robot's program, a `ConnectionState` as long as one WebSocket.  A
command survives the loss of its connection: it is sent again on the next connection, with the same id.  Each
command gets exactly one final answer, an answer that came after its deadline or after that of a newer frame
is reported as a failure, and the number of unanswered commands never exceeds the server's limit.  The caller
passes the time as ``now``: seconds of the robot's monotonic clock.
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
"""The capabilities that the robot announces in its Hello."""
_MAX_TRIES_AFTER_LOSS = 2
"""Times that a command is sent again after the answer ``worker-lost``: the command itself may have caused
the loss of the worker process."""
_RETRY_BURST = 5.0
"""Commands that a robot may send again after the answer ``busy`` before `RETRY_SHARE` limits them."""
_PINGS_PER_STALL_TIMEOUT = 3.0
"""Pings in each ``session.stall_timeout_s`` while a command is unanswered, so that the connection does not
count as lost because of one lost ping."""
_MAX_DEADLINE_MS = 3.6e6
"""Longest deadline that a command states, in milliseconds: the limit of the protocol, one hour."""
RETRY_SHARE = 0.1
"""Commands that may be sent again after the answer ``busy``, for each new command: at most a tenth, so that
retries add little load to servers that are overloaded.  Source: Google SRE book, ch. 21."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A command got its final answer, from the server or from the session itself (such as ``expired``).

    ``sent_s`` is the time of the robot's clock at which `ClientSession.submit` accepted the command.
    ``up_s`` and ``down_s`` are the one-way delays (s) of the command and of the answer, None if no clock
    offset is known.  ``wire_bytes`` is the size of the command's message.
    """

    id: int
    answer: Result | Failure
    sent_s: float
    wire_bytes: int = 0
    up_s: float | None = None
    down_s: float | None = None


@dataclass(frozen=True, slots=True)
class Welcomed:
    """The server accepted the connection; the caller may now pass it to `ClientSession.adopt`."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class MoveRequested:
    """The server asks the robot to connect to another server within ``within_s`` seconds."""

    reason: str
    within_s: float


@dataclass(frozen=True, slots=True)
class ConnectionLost:
    """The server did not respond in time, so the connection counts as lost; its socket may still be open."""

    reason: str


@dataclass(frozen=True, slots=True)
class Notice:
    """The server reports a failure that concerns a message or the session, not one command."""

    failure: Failure


@dataclass(frozen=True, slots=True)
class Progressed:
    """Progress of a long command: the part that is *done* (0..1), and *what* was done last."""

    id: int
    done: float
    what: str


@dataclass(frozen=True, slots=True)
class RenewalDue:
    """The connection expires soon, with the robot's token: send a fresh one by `ClientSession.renew`."""


# What a `ClientSession` reports to its caller.
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
    """A command without a final answer.

    Attributes:
        command: The command, without its deadline.
        deadline: Time of the robot's clock at which the command ends with ``expired``; infinite for none.
        submitted: Time at which the session accepted the command.
        wire_bytes: Size of its message.
        sent_at: Time at which it was sent last; None if it was not sent yet.
        connection: The connection on which it was sent; None while it waits to be sent (again).
        not_before: Time before which it is not sent again, after the answer ``busy``.
        losses: Number of answers ``worker-lost``.
        cancelled: Whether its caller has cancelled it.
        was_held: Whether it is counted in ``held_back``.
        has_default_deadline: Whether its caller gave no deadline.
        is_long: Whether the server has reported progress on it.
    """

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
    """What the robot knows of one WebSocket.

    Attributes:
        opened: Time of the robot's clock at which the WebSocket was opened.
        welcome: The Welcome of the server, None before it.
        leaving: Whether another connection has become the current one.
        lost: Whether this connection was lost or closed.
        last_received: Time of the last message of the server.
        last_checked: Time of the last call of `ClientSession.check`.
        last_ping: Time of the last ping, None before it.
        ping_sent: Time of the first ping since the last pong, None if there is none.
        clock_offset: Estimate of the offset between the clocks of robot and server.
        last_exchange: The timestamps of the last plausible ping and pong.
        outgoing: Encoded messages that the caller has to send on this connection.
        rate_limiter: Limits the messages of the robot.
        renewal: When the robot's token has to be renewed.
        backlog: Limits the frames in flight after a long outage; None otherwise.
    """

    opened: float
    welcome: Welcome | None = None
    leaving: bool = False
    lost: bool = False
    last_received: float = 0.0
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
        """The name of the server, "" before the Welcome."""
        return self.welcome.server if self.welcome else ""


class ClientSession:
    """All commands of one robot, and the connections that carry them.

    Attributes:
        current: The connection on which commands are sent; None without one.
        resent: Number of times that a command was sent again on a later connection.
        dropped_answers: Number of answers to commands that had their final answer already, or were cancelled.
        held_back: By reason, the number of commands that were not sent at once although there was a
            connection; a command is counted once, by its first reason.
        subscriptions: The robot's subscriptions.
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
        """By stream: the time until which its commands wait after a busy answer, and this answer.

        A new connection clears this."""
        self._retry_tokens = _RETRY_BURST
        self.subscriptions = ClientSubscriptions()

    @property
    def unanswered(self) -> int:
        """The number of commands without a final answer, without those that were cancelled."""
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
        """Accept a command and return its id; it is sent as soon as a connection has capacity for it.

        Args:
            service: Name of the service.
            payload: The request.
            now: Time of the robot's clock, s.
            deadline_s: Seconds until the command ends with ``expired``.  None means
                ``session.answer_timeout_s``, and no deadline once the server reports progress on the command.
            stream: Stream of frames to which the command belongs, "" for none; a newer frame replaces a
                waiting one.
            keep: Whether a newer frame of the stream does not replace this one.
            trace: Trace id of the command.
            is_open_ended: Whether a command without *deadline_s* has no deadline.

        Raises:
            BadMessage: The payload cannot be encoded.
            LimitExceeded: The message would be larger than the limit of the robot or of the server.
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
        """Subscribe to *topic* on the current connection and all later ones; return the subscription's id."""
        identity, self._next_id = self._next_id, self._next_id + 1
        self._send(self.subscriptions.add(identity, topic, now), now)
        return identity

    def unsubscribe(self, identity: int, now: float) -> None:
        """End the subscription *identity*; do nothing if it has ended already."""
        self._send(self.subscriptions.remove(identity), now)

    def cancel(self, identity: int) -> None:
        """Cancel the command *identity*; its answer is dropped, and no event reports its end.

        The server is asked to cancel a long command.  If the connection is lost before, the command is sent
        again on the next connection and cancelled there, because the job continues without a connection.
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
        """Return the state of a WebSocket that was just opened; its ``outgoing`` holds a Hello."""
        connection = ConnectionState(opened=now, last_received=now, last_checked=now)
        connection.outgoing.append(self.codec.encode(Hello(sdk=self._sdk, capabilities=_CAPABILITIES)))
        return connection

    def close_connection(self, connection: ConnectionState) -> None:
        """Record that *connection* was lost or closed; its unanswered commands are sent on the next one."""
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
        """Return the number of commands that were sent on *connection*, are unanswered and not cancelled."""
        return sum(
            pending.connection is connection and not pending.cancelled for pending in self._pending.values()
        )

    def adopt(self, connection: ConnectionState, now: float) -> list[Event]:
        """Make *connection*, which the server has welcomed, the current one; send the waiting commands on it.

        Of the waiting frames of a stream only the newest is sent, except those with ``keep``; the others end
        as ``stale``.  After a long outage frames are sent in the order and at the rate that
        `rse_pf.wire.rate_limit` describes.  Returns the events of commands that ended.
        """
        before, self.current = self.current, connection
        self._busy_streams.clear()
        if before is not None and before is not connection:
            before.leaving = True
            for pending in self._pending.values():
                if pending.connection is before and pending.is_long and not pending.cancelled:
                    pending.connection = None  # any server continues a job, so the old connection can close
        self._send(self.subscriptions.adopt(connection, now), now)
        frames = [frame for frame in self._pending.values() if _is_frame(frame) and frame.connection is None]
        if (
            before is None
            and len(frames) > 1
            and is_long_outage(frames[0].submitted, frames[0].deadline, now)
        ):
            connection.backlog = Backlog(newest=frames[-1].command.id)
        return self._flush(now)

    def receive(self, connection: ConnectionState, data: bytes, now: float) -> list[Event]:
        """Return the events of the WebSocket message *data*; raises ProtocolError if it is invalid."""
        connection.last_received = now
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
        """Send a fresh *token* on *connection*, which the server then keeps until this token expires."""
        connection.outgoing.append(self.codec.encode(Renew(token=token)))

    def due(self, now: float) -> list[Event]:
        """End the commands whose deadline has passed, and send the waiting commands that may be sent now.

        Returns the events of all commands and subscriptions that ended.
        """
        again, ended = self.subscriptions.due(now)
        self._send(again, now)
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
        """End all subscriptions and commands with a failure, because no further connection will be opened."""
        return [*self.subscriptions.abandon(code, message, hint), *self.end_commands(code, message, hint)]

    def end_commands(self, code: str, message: str, hint: str = "") -> list[Event]:
        """End every command with a failure; the subscriptions wait for the next connection."""
        events: list[Event] = []
        for identity, pending in list(self._pending.items()):
            events += self._end(identity, _failure(pending.command, code, message, hint))
        return events

    def check(self, connection: ConnectionState, now: float) -> list[Event]:
        """Send a ping when one is due; return `ConnectionLost` when the server has not responded in time.

        Returns `RenewalDue` when a fresh token is due.  If this method was not called for
        ``session.stall_timeout_s``, because the robot's program was paused, the time of the pause does not
        count as silence of the server.
        """
        s = self.settings
        if connection.lost:
            return []
        if now - connection.last_checked >= s.stall_timeout_s:
            connection.last_received = now
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
        if waiting and now - max(connection.last_received, min(waiting)) >= s.stall_timeout_s:
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
        """Return the time at which `due` and `check` must be called next, at the latest."""
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
        """Send the waiting commands as far as the server's limits allow, and end those that are void.

        They are sent oldest first, and after a long outage in the order of `send_order`.  Returns the events
        of the commands that ended: as ``stale``, or with the busy answer of their stream.
        """
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
                events += self._end(
                    identity, _failure(command, "stale", "a newer frame of the stream replaced this one")
                )
            elif (busy := self._busy_for_too_long(pending, now)) is not None:
                events += self._end(identity, busy)
            elif self._may_send(pending, connection, capacity, now):
                capacity -= 1
                self._write(pending, connection, now)
                if pending.cancelled:
                    self._cancel_on_server(pending)
        return events

    def _is_replaced(self, command: Command) -> bool:
        """Return whether *command* is a frame without ``keep``, and its stream has a newer frame."""
        return bool(command.stream) and not command.keep and command.seq < self._sequence[command.stream]

    def _not_before(self, pending: _Pending) -> float:
        """Return the time until which *pending* waits, because its stream or itself was answered ``busy``."""
        until_s, _ = self._busy_streams.get(pending.command.stream, (0.0, None))
        return max(pending.not_before, until_s)

    def _busy_for_too_long(self, pending: _Pending, now: float) -> Failure | None:
        """Return the busy answer with which a command ends if its stream must wait past its deadline.

        None if the command can still be sent before its deadline.
        """
        until_s, busy = self._busy_streams.get(pending.command.stream, (0.0, None))
        if busy is None or until_s < pending.deadline or until_s <= now:
            return None
        command, left_ms = pending.command, 1e3 * (until_s - now)
        return msgspec.structs.replace(busy, id=command.id, trace=command.trace, retry_after_ms=left_ms)

    def _may_send(self, pending: _Pending, connection: ConnectionState, capacity: int, now: float) -> bool:
        """Return whether *pending* may be sent now; if not, count it once in ``held_back``."""
        reason = self._reason_to_wait(pending, connection, capacity, now)
        if reason is not None and not pending.was_held:
            pending.was_held = True
            self.held_back[reason] += 1
        return reason is None

    def _reason_to_wait(
        self, pending: _Pending, connection: ConnectionState, capacity: int, now: float
    ) -> Reason | None:
        """Return why *pending* may not be sent now, None if it may.

        *capacity* is the number of commands that the server's limits allow on *connection*; the frames of a
        backlog are limited further.
        """
        if now < self._not_before(pending):
            return "busy"
        if capacity > 0 and pending.command.stream and connection.backlog is not None:
            sent = sum(
                _is_frame(other) and other.connection is connection for other in self._pending.values()
            )
            capacity = connection.backlog.max_in_flight - sent
        return None if capacity > 0 else "own-limit"

    def _capacity(self, connection: ConnectionState, now: float) -> int:
        """Return the number of commands that may be sent now within the server's limits."""
        limit = connection.welcome.limits.max_in_flight if connection.welcome else self.settings.max_in_flight
        free = max(1, limit) - sum(pending.connection is connection for pending in self._pending.values())
        return min(free, connection.rate_limiter.available(now))

    def _send(self, messages: list[Message], now: float) -> None:
        """Send *messages* on the current connection at once; they count for the rate limit but never wait.

        Without a connection they are dropped.
        """
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
            late = _failure(
                command, "expired", f"the answer came too late, after {now - pending.submitted:.3f} s"
            )
            return self._end(command.id, late)
        last = self._delivered.get(command.stream, 0)
        if command.stream and not command.keep and command.seq < last:
            stale = _failure(command, "stale", "the answer to a newer frame came first")
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
        """Schedule a retry of *pending* after *failure*, if its code and the limits allow one.

        A command is sent again at once after ``worker-lost``, and after the server's pause after ``busy``.
        Returns whether the command waits for its retry; if not, *failure* is its final answer.
        """
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
        """Mark the command of *progress* as long, so that the default deadline no longer applies to it.

        Returns the event; none if the command has ended or was cancelled, or was sent on another connection.
        """
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
        done = min(1.0, max(0.0, progress.done)) if math.isfinite(progress.done) else 0.0
        return [Progressed(progress.id, done, progress.what)]

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
    """Return whether *pending* is a frame: a command with a stream and a deadline."""
    return bool(pending.command.stream) and math.isfinite(pending.deadline)


def _failure(command: Command, code: str, message: str, hint: str = "") -> Failure:
    return Failure(id=command.id, code=code, message=message, hint=hint, trace=command.trace)
