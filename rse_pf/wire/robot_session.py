"""The rules of a robot's side, over any number of connections, without any input or output.

A `RobotSession` lives as long as the robot; a `Link` as long as one socket.  Commands survive the
death of a link: they are sent again, by the same id, on the next one.  Promises that a command gets
exactly one final answer, that nothing stale is delivered as fresh, and never to read a clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.settings import SessionSettings
from rse_pf.wire.clock_offset import ClockOffset, Exchange
from rse_pf.wire.codec import Codec
from rse_pf.wire.messages import Command, Failure, Hello, Move, Ping, Pong, Result, Welcome

__all__ = ["Answered", "Link", "LinkLost", "MoveAsked", "Notice", "RobotSession", "Welcomed"]

_MAX_TRIES_AFTER_LOSS = 2
_RETRY_BURST = 5.0
_PONGS_PER_SILENCE = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A command came to its end."""

    id: int
    answer: Result | Failure
    sent_s: float
    wire_bytes: int = 0
    up_s: float | None = None
    down_s: float | None = None


@dataclass(frozen=True, slots=True)
class Welcomed:
    """The link is open; the session sends on it from now on."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class MoveAsked:
    """The server wants the robot elsewhere."""

    reason: str
    within_s: float


@dataclass(frozen=True, slots=True)
class LinkLost:
    """The link is dead although its socket may look alive."""

    reason: str


@dataclass(frozen=True, slots=True)
class Notice:
    """The server complains about a message or the session, not about one command."""

    failure: Failure


Event = Answered | Welcomed | MoveAsked | LinkLost | Notice


@dataclass(slots=True, kw_only=True)
class _Pending:
    command: Command
    deadline: float
    first_sent: float
    sent_at: float = 0.0
    wire_bytes: int = 0
    link: Link | None = None
    not_before: float = 0.0
    losses: int = 0


@dataclass(slots=True, kw_only=True, eq=False)
class Link:
    """What the robot knows of one socket."""

    opened: float
    welcome: Welcome | None = None
    leaving: bool = False
    lost: bool = False
    last_heard: float = 0.0
    next_ping: float = 0.0
    ping_sent: float | None = None
    clock_offset: ClockOffset = field(default_factory=ClockOffset)
    last_exchange: Exchange | None = None
    outgoing: list[bytes] = field(default_factory=list)

    @property
    def server(self) -> str:
        """The server's name, empty before the Welcome."""
        return self.welcome.server if self.welcome else ""


class RobotSession:
    """All commands of one robot, and the links that they travel on."""

    def __init__(self, *, codec: Codec, settings: SessionSettings, sdk: str, first_id: int = 1) -> None:
        self.codec = codec
        self.settings = settings
        self.current: Link | None = None
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
        return len(self._pending)

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
    ) -> int:
        """Take a command; it is written to the current link as soon as there is one."""
        identity, self._next_id = self._next_id, self._next_id + 1
        sequence = self._sequence.get(stream, 0) + 1
        self._sequence[stream] = sequence
        wait = self.settings.answer_timeout_s if deadline_s is None else deadline_s
        command = Command(
            id=identity, service=service, payload=payload, stream=stream, seq=sequence, keep=keep,
            trace=trace,
        )  # fmt: skip
        pending = _Pending(command=command, deadline=now + wait, first_sent=now)
        self._pending[identity] = pending
        self._retry_tokens = min(_RETRY_BURST, self._retry_tokens + self.settings.retry_percent / 100)
        if self.current is not None:
            self._write(pending, self.current, now)
        return identity

    def cancel(self, identity: int) -> None:
        """Forget a command whose caller went away."""
        self._pending.pop(identity, None)

    def open_link(self, now: float) -> Link:
        """Return a new link with a Hello to send; call when a socket is open."""
        link = Link(opened=now, last_heard=now, next_ping=now)
        link.outgoing.append(self.codec.encode(Hello(sdk=self._sdk, capabilities=("move",))))
        return link

    def close_link(self, link: Link) -> None:
        """Tell that the socket of *link* is gone; its commands wait for the next link."""
        link.lost = True
        if self.current is link:
            self.current = None
        for pending in self._pending.values():
            if pending.link is link:
                pending.link = None

    def unanswered_on(self, link: Link) -> int:
        """How many commands sent on *link* still wait for an answer."""
        return sum(pending.link is link for pending in self._pending.values())

    def adopt(self, link: Link, now: float) -> list[Event]:
        """Make a welcomed *link* the current one and resend what has no link.

        Of a latest-wins stream only the newest frame is sent again: no catch-up burst.
        """
        before, self.current = self.current, link
        if before is not None and before is not link:
            before.leaving = True
        events: list[Event] = []
        newest: dict[str, int] = {}
        for pending in self._pending.values():
            newest[pending.command.stream] = max(newest.get(pending.command.stream, 0), pending.command.seq)
        for identity, pending in list(self._pending.items()):
            if pending.link is not None:
                continue
            command = pending.command
            if not command.keep and command.stream and command.seq < newest[command.stream]:
                events += self._end(identity, _failure(command, "stale", "a newer frame took its place"))
            else:
                self._write(pending, link, now)
        return events

    def receive(self, link: Link, data: bytes, now: float) -> list[Event]:
        """Return what one WebSocket message on *link* means; raises ProtocolError if it is garbage."""
        link.last_heard = now
        message = self.codec.decode_from_server(data)
        if isinstance(message, Welcome):
            link.welcome = message
            return [Welcomed(message)]
        if isinstance(message, Pong):
            return self._pong(link, message, now)
        if isinstance(message, Move):
            return [MoveAsked(message.reason, message.within_ms / 1e3)]
        if isinstance(message, Failure) and message.id is None:
            return [Notice(message)]
        return self._answer(link, message, now)

    def due(self, now: float) -> list[Event]:
        """Return the commands whose deadline has passed, and resend those whose pause is over."""
        events: list[Event] = []
        for identity, pending in list(self._pending.items()):
            if now >= pending.deadline:
                waited = now - pending.first_sent
                events += self._end(
                    identity, _failure(pending.command, "expired", f"no answer within {waited:.3f} s")
                )
            elif pending.link is None and self.current is not None and now >= pending.not_before:
                self._write(pending, self.current, now)
        return events

    def abandon(self, code: str, message: str, hint: str = "") -> list[Event]:
        """End every command with a failure: there will be no other link."""
        events: list[Event] = []
        for identity, pending in list(self._pending.items()):
            failure = Failure(id=identity, code=code, message=message, hint=hint, trace=pending.command.trace)
            events += self._end(identity, failure)
        return events

    def tend(self, link: Link, now: float) -> list[Event]:
        """Ping *link* when it is time; say when it is dead."""
        s = self.settings
        if link.lost:
            return []
        if link.welcome is None:
            late = now - link.opened >= s.hello_timeout_s
            return self._lose(link, "no welcome") if late else []
        if link.ping_sent is not None and now - link.ping_sent >= s.ping_patience_s:
            return self._lose(link, "no pong")
        waiting = [p.sent_at for p in self._pending.values() if p.link is link]
        if waiting and now - max(link.last_heard, min(waiting)) >= s.silence_s:
            return self._lose(link, "silence")
        if now >= link.next_ping:
            if link.ping_sent is None:
                link.ping_sent = now
            link.outgoing.append(self.codec.encode(Ping(sent_s=now)))
            pause = s.silence_s / _PONGS_PER_SILENCE if waiting else s.ping_interval_s
            link.next_ping = now + min(pause, s.ping_interval_s)
        return []

    def next_due(self, now: float) -> float:
        """Return when `due` or `tend` should be called again, at the latest."""
        times = [now + self.settings.silence_s / _PONGS_PER_SILENCE]
        times += [pending.deadline for pending in self._pending.values()]
        times += [p.not_before for p in self._pending.values() if p.link is None and p.not_before > now]
        return max(now, min(times))

    def _write(self, pending: _Pending, link: Link, now: float) -> None:
        self.resent += pending.sent_at > 0
        pending.link, pending.sent_at = link, now
        remaining_ms = max(0.0, (pending.deadline - now) * 1e3)
        command = msgspec.structs.replace(pending.command, deadline_ms=remaining_ms)
        data = self.codec.encode(command)
        pending.wire_bytes = len(data)
        link.outgoing.append(data)

    def _answer(self, link: Link, answer: Result | Failure, now: float) -> list[Event]:
        pending = self._pending.get(-1 if answer.id is None else answer.id)
        if pending is None:
            self.dropped_answers += 1
            return []
        command = pending.command
        if isinstance(answer, Failure) and self._try_again(pending, answer, now):
            return []
        up_s = down_s = None
        if isinstance(answer, Result):
            last = self._delivered.get(command.stream, 0)
            if command.stream and not command.keep and command.seq < last:
                return self._end(command.id, _failure(command, "stale", "a newer answer came first"))
            self._delivered[command.stream] = max(last, command.seq)
            offset = link.clock_offset.offset_s
            if offset is not None:
                up_s = answer.received_s - offset - pending.sent_at
                down_s = now - (answer.sent_s - offset)
        return self._end(command.id, answer, up_s, down_s)

    def _try_again(self, pending: _Pending, failure: Failure, now: float) -> bool:
        """Retry what may succeed elsewhere or later, within the deadline and the budget."""
        if failure.code == "worker-lost" and pending.losses < _MAX_TRIES_AFTER_LOSS:
            pending.losses += 1
            pending.link = None
            return True
        after = now + (failure.retry_after_ms or 0.0) / 1e3
        if failure.code != "busy" or after >= pending.deadline or self._retry_tokens < 1.0:
            return False
        self._retry_tokens -= 1.0
        pending.link, pending.not_before = None, after
        return True

    def _pong(self, link: Link, pong: Pong, now: float) -> list[Event]:
        link.ping_sent = None
        link.last_exchange = Exchange(pong.sent_s, pong.received_s, pong.answered_s, now)
        link.clock_offset.add(link.last_exchange)
        return []

    def _lose(self, link: Link, reason: str) -> list[Event]:
        self.close_link(link)
        return [LinkLost(reason)]

    def _end(
        self, identity: int, answer: Result | Failure, up_s: float | None = None, down_s: float | None = None
    ) -> list[Event]:
        pending = self._pending.pop(identity)
        return [
            Answered(
                id=identity,
                answer=answer,
                sent_s=pending.first_sent,
                wire_bytes=pending.wire_bytes,
                up_s=up_s,
                down_s=down_s,
            )
        ]


def _failure(command: Command, code: str, message: str) -> Failure:
    return Failure(id=command.id, code=code, message=message, trace=command.trace)
