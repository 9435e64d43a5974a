"""The rules of a robot's side, over any number of connections, without any input or output.

A `ClientSession` lives as long as the robot; a `ConnectionState` as long as one socket.  Commands survive the
death of a link: they are sent again, by the same id, on the next one.  Promises that a command gets
exactly one final answer, that nothing stale is delivered as fresh, that no more commands are on
their way than the server accepts, and never to read a clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.config import SessionSettings
from rse_pf.errors import LimitExceeded
from rse_pf.wire.backlog import Backlog, is_long, turn
from rse_pf.wire.client_events import (
    Answered,
    Event,
    ConnectionLost,
    MoveRequested,
    Notice,
    Progressed,
    RenewalDue,
    Welcomed,
)
from rse_pf.wire.clock_offset import ClockOffset, Exchange
from rse_pf.wire.codec import Codec
from rse_pf.wire.messages import (
    Cancel,
    Command,
    Failure,
    Hello,
    Move,
    Ping,
    Pong,
    Progress,
    Renew,
    Renewed,
    Result,
    Welcome,
)
from rse_pf.wire.preencoded import encode_command
from rse_pf.wire.rate_limit import RateLimiter
from rse_pf.wire.server_session import PROGRESS
from rse_pf.wire.token_renewal import RenewalTimer

__all__ = [
    "Answered",
    "ConnectionState",
    "Event",
    "ConnectionLost",
    "MoveRequested",
    "Notice",
    "Progressed",
    "RenewalDue",
    "ClientSession",
    "Welcomed",
]  # fmt: skip

_MAX_TRIES_AFTER_LOSS = 2
_RETRY_BURST = 5.0
_PINGS_PER_SILENCE = 3.0
_MAX_MS = 3.6e6


@dataclass(slots=True, kw_only=True)
class _Pending:
    command: Command
    deadline: float
    submitted: float
    wire_bytes: int
    sent_at: float | None = None
    link: ConnectionState | None = None
    not_before: float = 0.0
    losses: int = 0
    cancelled: bool = False
    is_open_ended: bool = False
    is_long: bool = False


@dataclass(slots=True, kw_only=True, eq=False)
class ConnectionState:
    """What the robot knows of one socket."""

    opened: float
    welcome: Welcome | None = None
    leaving: bool = False
    lost: bool = False
    last_heard: float = 0.0
    last_tended: float = 0.0
    last_ping: float | None = None
    ping_sent: float | None = None
    clock_offset: ClockOffset = field(default_factory=ClockOffset)
    last_exchange: Exchange | None = None
    outgoing: list[bytes] = field(default_factory=list)
    pace: RateLimiter = field(default_factory=RateLimiter)
    lease: RenewalTimer = field(default_factory=RenewalTimer)
    comeback: Backlog | None = None

    @property
    def server(self) -> str:
        """The server's name, empty before the Welcome."""
        return self.welcome.server if self.welcome else ""


class ClientSession:
    """All commands of one robot, and the links that they travel on."""

    def __init__(self, *, codec: Codec, settings: SessionSettings, sdk: str, first_id: int = 1) -> None:
        self.codec = codec
        self.settings = settings
        self.current: ConnectionState | None = None
        self.resent = 0
        self.dropped_answers = 0
        self._sdk = sdk
        self._next_id = first_id
        self._pending: dict[int, _Pending] = {}
        self._sequence: dict[str, int] = {}
        self._delivered: dict[str, int] = {}
        self._retry_tokens = _RETRY_BURST

    @property
    def unanswered(self) -> int:
        """How many commands wait for their end."""
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
        patient: bool = False,
    ) -> int:
        """Take a command; it is written to the current link as soon as there is one with room.

        A command without *deadline_s* has the setting's, unless it is *patient* or turns out to be long: the
        server says so by reporting progress.

        Raises:
            BadMessage: The payload does not travel in messages.
            LimitExceeded: The message would be larger than the limit.
        """
        default_s = math.inf if patient else self.settings.answer_timeout_s
        wait = default_s if deadline_s is None else deadline_s
        command = Command(
            id=self._next_id, service=service, payload=payload, stream=stream,
            seq=self._sequence.get(stream, 0) + 1, keep=keep, trace=trace,
        )  # fmt: skip
        data = encode_command(self.codec, _with_deadline(command, wait))
        self._check_size(data)
        pending = _Pending(
            command=command, deadline=now + wait, submitted=now, wire_bytes=len(data),
            is_open_ended=deadline_s is None,
        )  # fmt: skip
        self._next_id += 1
        self._sequence[stream] = command.seq
        self._pending[command.id] = pending
        self._retry_tokens = min(_RETRY_BURST, self._retry_tokens + self.settings.retry_percent / 100)
        if self.current is not None and self._may_go(command, self.current, self._room(self.current, now)):
            self._write(pending, self.current, now, data)
        return command.id

    def cancel(self, identity: int) -> None:
        """Forget a command whose caller went away; its answer, if one comes, is dropped.

        A long one is asked for once more on the next link, to be taken back there, if this one does not last.
        """
        pending = self._pending.get(identity)
        if pending is None or pending.cancelled:
            return
        pending.cancelled = True
        if pending.is_long:
            self._take_back(pending)
        elif pending.link is None:
            del self._pending[identity]

    def open_link(self, now: float) -> ConnectionState:
        """Return a new link with a Hello to send; call when a socket is open."""
        link = ConnectionState(opened=now, last_heard=now, last_tended=now)
        link.outgoing.append(self.codec.encode(Hello(sdk=self._sdk, capabilities=("move", PROGRESS))))
        return link

    def close_link(self, link: ConnectionState) -> None:
        """Tell that the socket of *link* is gone; its commands wait for the next link."""
        link.lost = True
        if self.current is link:
            self.current = None
        for identity, pending in list(self._pending.items()):
            if pending.link is link:
                pending.link = None
                if pending.cancelled and not pending.is_long:
                    del self._pending[identity]

    def unanswered_on(self, link: ConnectionState) -> int:
        """How many commands sent on *link* still wait for an answer that somebody wants."""
        return sum(pending.link is link and not pending.cancelled for pending in self._pending.values())

    def adopt(self, link: ConnectionState, now: float) -> list[Event]:
        """Make a welcomed *link* the current one and send on it what has no link.

        Of a latest-wins stream only the newest frame is sent again: no catch-up burst.  Frames that waited
        long for want of a link go as `rse_pf.wire.backlog` says.
        """
        before, self.current = self.current, link
        if before is not None and before is not link:
            before.leaving = True
            for pending in self._pending.values():
                if pending.link is before and pending.is_long and not pending.cancelled:
                    pending.link = None  # it goes on elsewhere: ask there, and do not hold the old server up
        frames = [each for each in self._pending.values() if _is_frame(each) and each.link is None]
        if before is None and len(frames) > 1 and is_long(frames[0].submitted, frames[0].deadline, now):
            link.comeback = Backlog(newest=frames[-1].command.id)
        return self._flush(now)

    def receive(self, link: ConnectionState, data: bytes, now: float) -> list[Event]:
        """Return what one WebSocket message on *link* means; raises ProtocolError if it is garbage."""
        link.last_heard = now
        message = self.codec.decode_from_server(data)
        if isinstance(message, Welcome):
            if link.welcome is not None:
                return []
            link.welcome, link.pace = message, RateLimiter(message.limits)
            if message.token_s is not None:
                link.lease.lasts(message.token_s, now)
            return [Welcomed(message)]
        if isinstance(message, Pong):
            return self._pong(link, message, now)
        if isinstance(message, Move):
            within_s = message.within_ms / 1e3
            return [MoveRequested(message.reason, within_s if math.isfinite(within_s) else 0.0)]
        if isinstance(message, Renewed):
            link.lease.lasts(message.token_s, now)
            return []
        if isinstance(message, Failure) and message.id is None:
            return [Notice(message)]
        if isinstance(message, Progress):
            return self._progress(link, message)
        return self._answer(link, message, now)

    def renew(self, link: ConnectionState, token: str) -> None:
        """Show a fresh *token* on *link*, whose end the server then moves."""
        link.outgoing.append(self.codec.encode(Renew(token=token)))

    def due(self, now: float) -> list[Event]:
        """Return the commands whose deadline has passed, and send those that may go (again)."""
        events: list[Event] = []
        for identity, pending in list(self._pending.items()):
            if now >= pending.deadline:
                waited = now - pending.submitted
                failure = _failure(pending.command, "expired", f"no answer within {waited:.3f} s")
                events += self._end(identity, failure)
                if pending.is_long:
                    self._pending[identity] = pending
                    self._take_back(pending)
        return events + self._flush(now)

    def abandon(self, code: str, message: str, hint: str = "") -> list[Event]:
        """End every command with a failure: there will be no other link."""
        events: list[Event] = []
        for identity, pending in list(self._pending.items()):
            failure = Failure(id=identity, code=code, message=message, hint=hint, trace=pending.command.trace)
            events += self._end(identity, failure)
        return events

    def tend(self, link: ConnectionState, now: float) -> list[Event]:
        """Ping *link* when it is time; say when it is dead.

        A robot that did not look for a while cannot tell whether the server was silent meanwhile,
        so such a gap does not count.
        """
        s = self.settings
        if link.lost:
            return []
        if now - link.last_tended >= s.stall_timeout_s:
            link.last_heard = now
            link.ping_sent = None if link.ping_sent is None else now
        link.last_tended = now
        if link.welcome is None:
            late = now - link.opened >= s.hello_timeout_s
            return self._lose(link, "no welcome") if late else []
        if link.ping_sent is not None and now - link.ping_sent >= s.ping_timeout_s:
            return self._lose(link, "no pong")
        waiting = [
            pending.sent_at
            for pending in self._pending.values()
            if pending.link is link and pending.sent_at is not None and not pending.is_long
        ]
        if waiting and now - max(link.last_heard, min(waiting)) >= s.stall_timeout_s:
            return self._lose(link, "silence")
        pause = s.ping_interval_s
        if waiting:
            pause = min(pause, s.stall_timeout_s / _PINGS_PER_SILENCE)
        if link.last_ping is None or now - link.last_ping >= pause:
            link.ping_sent = now if link.ping_sent is None else link.ping_sent
            link.last_ping = now
            link.outgoing.append(self.codec.encode(Ping(sent_s=now)))
            link.pace.spend(now)
        return [RenewalDue()] if not link.leaving and link.lease.is_due(now) else []

    def next_due(self, now: float) -> float:
        """Return when `due` and `tend` should be called again, at the latest."""
        times = [now + self.settings.stall_timeout_s / _PINGS_PER_SILENCE]
        times += [pending.deadline for pending in self._pending.values()]
        times += [p.not_before for p in self._pending.values() if p.link is None and p.not_before > now]
        if self.current is not None and not self.current.pace.room(now):
            times.append(self.current.pace.next_s(now))
        return max(now, min(times))

    def _flush(self, now: float) -> list[Event]:
        """Send what has no link, oldest first, as far as the server has room."""
        link = self.current
        if link is None:
            return []
        events: list[Event] = []
        room = self._room(link, now)
        waiting = [each for each in self._pending.items() if each[1].link is None]
        newest = 0 if link.comeback is None else link.comeback.newest
        if not any(identity <= newest and _is_frame(pending) for identity, pending in waiting):
            link.comeback = None
        else:
            waiting.sort(key=lambda each: turn(each[0], each[1].command.stream))
        for identity, pending in waiting:
            if now < pending.not_before:
                continue
            command = pending.command
            if command.stream and not command.keep and command.seq < self._sequence[command.stream]:
                events += self._end(identity, _failure(command, "stale", "a newer frame took its place"))
            elif self._may_go(command, link, room):
                room -= 1
                self._write(pending, link, now)
                if pending.cancelled:
                    self._take_back(pending)
        return events

    def _may_go(self, command: Command, link: ConnectionState, room: int) -> bool:
        if room <= 0 or not command.stream or link.comeback is None:
            return room > 0
        under_way = sum(_is_frame(each) and each.link is link for each in self._pending.values())
        return under_way < link.comeback.room

    def _room(self, link: ConnectionState, now: float) -> int:
        most = link.welcome.limits.max_in_flight if link.welcome else self.settings.max_in_flight
        free = max(1, most) - sum(pending.link is link for pending in self._pending.values())
        return min(free, link.pace.room(now))

    def _check_size(self, data: bytes) -> None:
        most = self.settings.max_message_bytes
        if self.current is not None and self.current.welcome is not None:
            most = min(most, self.current.welcome.limits.max_message_bytes)
        if len(data) > most:
            raise LimitExceeded(
                f"a command of {len(data)} bytes is above {most}",
                hint="send fewer matches, or send large data to the data server",
            )

    def _write(self, pending: _Pending, link: ConnectionState, now: float, data: bytes | None = None) -> None:
        self.resent += pending.sent_at is not None
        pending.link, pending.sent_at = link, now
        link.pace.spend(now)
        link.outgoing.append(
            encode_command(self.codec, _with_deadline(pending.command, pending.deadline - now))
            if data is None
            else data
        )

    def _answer(self, link: ConnectionState, answer: Result | Failure, now: float) -> list[Event]:
        pending = self._pending.get(-1 if answer.id is None else answer.id)
        elsewhere = pending is not None and pending.link is not link
        if pending is None or (elsewhere and isinstance(answer, Failure)):
            self.dropped_answers += 1
            return []
        if link.comeback is not None:
            link.comeback.heard(answer.queue_ms if isinstance(answer, Result) else math.inf)
        if isinstance(answer, Failure):
            again = self._try_again(pending, answer, now)
            return self._flush(now) if again else self._end(pending.command.id, answer) + self._flush(now)
        command = pending.command
        if now >= pending.deadline:
            late = _failure(command, "expired", f"its answer came after {now - pending.submitted:.3f} s")
            return self._end(command.id, late) + self._flush(now)
        last = self._delivered.get(command.stream, 0)
        if command.stream and not command.keep and command.seq < last:
            stale = _failure(command, "stale", "a newer answer came first")
            return self._end(command.id, stale) + self._flush(now)
        if not pending.cancelled:
            self._delivered[command.stream] = max(last, command.seq)
        up_s, down_s = None, None
        if not elsewhere and pending.sent_at is not None:
            up_s, down_s = link.clock_offset.split_s(pending.sent_at, answer.received_s, answer.sent_s, now)
        return self._end(command.id, answer, up_s, down_s) + self._flush(now)

    def _try_again(self, pending: _Pending, failure: Failure, now: float) -> bool:
        """Retry what may succeed elsewhere or later, within the deadline and the budget."""
        if pending.cancelled:
            return False
        if failure.code == "worker-lost" and pending.losses < _MAX_TRIES_AFTER_LOSS:
            pending.losses += 1
            pending.link = None
            return True
        after = now + max(0.0, failure.retry_after_ms or 0.0) / 1e3
        if failure.code != "busy" or not after < pending.deadline or self._retry_tokens < 1.0:
            return False
        self._retry_tokens -= 1.0
        pending.link, pending.not_before = None, after
        return True

    def _progress(self, link: ConnectionState, progress: Progress) -> list[Event]:
        """Note that a command is a long one: the default deadline is not for it."""
        pending = self._pending.get(progress.id)
        if pending is None or pending.link is not link:
            return []
        if pending.cancelled:
            if not pending.is_long:
                pending.is_long = True
                self._take_back(pending)
            return []
        pending.is_long = True
        if pending.is_open_ended:
            pending.deadline = math.inf
        share = min(1.0, max(0.0, progress.done)) if math.isfinite(progress.done) else 0.0
        return [Progressed(progress.id, share, progress.what)]

    def _take_back(self, pending: _Pending) -> None:
        pending.cancelled, pending.deadline = True, math.inf
        if pending.link is not None:
            pending.link.outgoing.append(self.codec.encode(Cancel(id=pending.command.id)))

    def _pong(self, link: ConnectionState, pong: Pong, now: float) -> list[Event]:
        link.ping_sent = None
        exchange = Exchange(pong.sent_s, pong.received_s, pong.answered_s, now)
        if link.opened <= pong.sent_s <= now and exchange.is_plausible:
            link.last_exchange = exchange
            link.clock_offset.add(exchange)
        return []

    def _lose(self, link: ConnectionState, reason: str) -> list[Event]:
        self.close_link(link)
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
                id=identity, answer=answer, sent_s=pending.submitted,
                wire_bytes=pending.wire_bytes, up_s=up_s, down_s=down_s,
            )
        ]  # fmt: skip


def _with_deadline(command: Command, remaining_s: float) -> Command:
    return msgspec.structs.replace(command, deadline_ms=min(_MAX_MS, max(0.0, remaining_s * 1e3)))


def _is_frame(pending: _Pending) -> bool:
    """Whether it loses its worth with time: of a stream, and not without an end."""
    return bool(pending.command.stream) and math.isfinite(pending.deadline)


def _failure(command: Command, code: str, message: str) -> Failure:
    return Failure(id=command.id, code=code, message=message, trace=command.trace)
