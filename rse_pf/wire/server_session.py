"""The rules of the server's side of the protocol for one connection, without input or output.

A `ServerSession` takes received messages and the time, and returns decisions (`Send`, `Submit`, `Close` ...)
that the caller executes.  The robot's side is in `rse_pf.wire.client_session`.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from rse_pf.config import BurstSettings, SessionSettings
from rse_pf.errors import (
    BadRequest,
    Busy,
    ProtocolError,
    QuotaExceeded,
    RsePfError,
    Unauthorized,
    UnsupportedProtocol,
)
from rse_pf.wire.codec import Codec
from rse_pf.wire.envelope import undecodable_id
from rse_pf.wire.messages import (
    PROTOCOL_VERSION,
    Cancel,
    Command,
    Failure,
    FromRobot,
    FromServer,
    Hello,
    Limits,
    Move,
    Ping,
    Pong,
    Renewed,
    Subscribe,
    Unsubscribe,
    Welcome,
)
from rse_pf.wire.rate_limit import command_burst

__all__ = [
    "CLOSE_GOING_AWAY",
    "CLOSE_PROTOCOL",
    "CLOSE_RATE",
    "CLOSE_REPLACED",
    "CLOSE_REVOKED",
    "CLOSE_TOKEN_OVER",
    "CLOSE_UNSUPPORTED",
    "MAX_SUBSCRIPTIONS",
    "PROGRESS",
    "RENEWAL_PAUSE_S",
    "UPDATES",
    "BeginUpdates",
    "Close",
    "Decision",
    "EndUpdates",
    "Renewal",
    "Send",
    "SendRefusal",
    "ServerSession",
    "Submit",
    "Withdraw",
]

PROGRESS = "progress"
"""Capability in the Hello of a robot that accepts progress messages and may cancel commands."""

UPDATES = "updates"
"""Capability in the Hello of a robot that may subscribe to topics."""

MAX_SUBSCRIPTIONS = 8
"""Most subscriptions of one connection; a robot needs one for each live map in which it drives."""

RENEWAL_PAUSE_S = 1.0
"""Shortest pause in seconds between two renewals of a token on one connection, because each renewal costs the
server a signature check."""

# Close codes of WebSockets that a server sends.
CLOSE_GOING_AWAY = 1001  # the server stops, or the robot was silent for too long
CLOSE_PROTOCOL = 4400  # the robot broke the protocol
CLOSE_TOKEN_OVER = 4401  # the robot's token has expired
CLOSE_REVOKED = 4403  # the robot or its token was revoked
CLOSE_UNSUPPORTED = 4406  # the server does not know the robot's version of the protocol
CLOSE_REPLACED = 4409  # the robot has a newer connection
CLOSE_RATE = 4429  # the robot continued to exceed its rate limit, or its commands crashed processes
MAX_BAD_MESSAGES = 10
"""Most undecodable messages without a readable id on one connection; after one more, the side that received
them, robot or server, closes the socket."""
_BAD_MESSAGE_BYTES = 65_536
"""An undecodable message counts once, and once more for each time that its size reaches this many bytes:
decoding a long message takes more time."""


class Send(msgspec.Struct, frozen=True, gc=False):
    """Decision: send *data* as a WebSocket message."""

    data: bytes


class SendRefusal(Send, frozen=True, gc=False):
    """Decision: send *data*, which is *failure* encoded and refuses a message that cannot be decoded."""

    failure: Failure


class Submit(msgspec.Struct, frozen=True, gc=False):
    """Decision: pass *command* to the scheduler."""

    command: Command


class Close(msgspec.Struct, frozen=True, gc=False):
    """Decision: close the socket with the WebSocket close code *code* and *reason*."""

    code: int
    reason: str


class Withdraw(msgspec.Struct, frozen=True, gc=False):
    """Decision: cancel the command *id*, because the robot asks for it."""

    id: int


class Renewal(msgspec.Struct, frozen=True, gc=False):
    """Decision: verify the fresh *token*, and send the answer that `ServerSession.answer_renewal` returns."""

    token: str


class BeginUpdates(msgspec.Struct, frozen=True, gc=False):
    """Decision: send updates of *topic* as subscription *id*, or refuse by `ServerSession.refuse_updates`."""

    id: int
    topic: str


class EndUpdates(msgspec.Struct, frozen=True, gc=False):
    """Decision: send no more updates of the subscription *id*."""

    id: int


# What the caller of a `ServerSession` has to do.
Decision = Send | Submit | Withdraw | Renewal | Close | BeginUpdates | EndUpdates


class ServerSession:
    """One robot's connection, as its server sees it.

    Attributes:
        robot: Name of the robot.
        state: ``opening`` until the Hello, then ``open``, ``closed`` after a `Close`.
        in_flight: Number of commands that were submitted and are not answered; the caller counts it down.
        ends_s: Time of the server's clock at which the robot's token expires, which the caller sets after
            authentication; None if it never does.
        hears_progress: Whether the robot announced the capability `PROGRESS`.
        hears_updates: Whether the robot announced the capability `UPDATES`.
        topics: By id of a subscription that has not ended: its topic.
        bad_messages: Number of undecodable messages whose id could not be read; a long one counts several
            times.
        refused_commands: Number of undecodable messages whose id could be read, counted in the same way, less
            one for each valid command since then.
        suspicion: The sum of ``bad_messages`` and ``refused_commands``; messages of a robot with a smaller
            sum are decoded first.
        tenant: Tenant of the robot, which the Welcome states.
        scopes: Scopes of the robot's token, which the Welcome states.
    """

    def __init__(
        self,
        *,
        codec: Codec,
        robot: str,
        server: str,
        session: str,
        limits: SessionSettings,
        burst: BurstSettings | None = None,
    ) -> None:
        self.robot = robot
        self.state: Literal["opening", "open", "closed"] = "opening"
        self.in_flight = 0
        self.ends_s: float | None = None
        self.tenant: str | None = None
        self.scopes: tuple[str, ...] = ()
        self.hears_progress = self.hears_updates = False
        self.topics: dict[int, str] = {}
        self.codec = codec
        self._server = server
        self._session = session
        self._limits = limits
        self._burst = burst or BurstSettings()
        self.bad_messages = self.refused_commands = self.suspicion = 0
        self._next_renewal_s = float("-inf")

    def receive_short(self, data: bytes, now: float, max_bytes: int) -> list[Decision] | None:
        """Decode one WebSocket message that arrived at *now* (server's clock, s), and return the decisions.

        None if the message has more than *max_bytes* inflated: the caller then decodes it in another thread
        and calls `take`.
        """
        if self.state == "closed":
            return []
        try:
            message = self.codec.decode_short_from_robot(data, max_bytes)
        except ProtocolError as error:
            return self.take(error, now, data)
        if type(message) is Command and self.state == "open":
            return self._command(message)
        return None if message is None else self.take(message, now)

    def take(self, message: FromRobot | ProtocolError, now: float, data: bytes = b"") -> list[Decision]:
        """Return the decisions about one decoded message, or about the error that decoding *data* raised.

        *now* is the time of the server's clock, s.
        """
        if self.state == "closed":
            return []
        match message:
            case ProtocolError():
                return self._refuse_undecoded(message, data)
            case Hello():
                return self._hello(message, now)
            case _ if self.state == "opening":
                return self._close(CLOSE_PROTOCOL, "say hello first")
            case Command():
                return self._command(message)
            case Ping():
                return [self._send(Pong(sent_s=message.sent_s, received_s=now, answered_s=now))]
            case Cancel():
                return [Withdraw(message.id)]
            case Subscribe():
                return self._subscribe(message)
            case Unsubscribe():
                return [] if self.topics.pop(message.id, None) is None else [EndUpdates(message.id)]
            case _:
                return self._renew(message.token, now)

    def move(self, reason: str, within_ms: float) -> list[Send]:
        """Return the message that asks the robot to move to another server within *within_ms* milliseconds.

        The list is empty if the session is not open.
        """
        return [self._send(Move(reason=reason, within_ms=within_ms))] if self.state == "open" else []

    def answer_renewal(self, token_s: float | None) -> Send:
        """Return the answer to a `Renewal`.

        *token_s* is the number of seconds until the fresh token expires, and the connection with it.  None
        means that the token was refused: the answer does not say why, and the connection keeps its previous
        expiry.
        """
        if token_s is not None:
            return self._send(Renewed(token_s=token_s))
        error = Unauthorized(
            "the fresh token is not valid for this robot", hint="the connection keeps its previous expiry"
        )
        return self._send(self._failure(error))

    def refuse_updates(self, identity: int, error: RsePfError) -> Send:
        """End the subscription *identity* because of *error*, and return the message that reports it."""
        self.topics.pop(identity, None)
        return self._send(self._failure(error, identity=identity))

    def _subscribe(self, message: Subscribe) -> list[Decision]:
        """Begin the subscription of *message*, or refuse it; an earlier one with the same id ends."""
        if not self.hears_updates:
            unannounced = BadRequest(
                f"this connection did not announce the capability {UPDATES}",
                hint="name it in the hello message",
            )
            return [self._send(self._failure(unannounced, identity=message.id))]
        ended: list[Decision] = []
        if self.topics.pop(message.id, None) is not None:
            ended.append(EndUpdates(message.id))
        if len(self.topics) >= MAX_SUBSCRIPTIONS:
            full = QuotaExceeded(
                f"this connection has {len(self.topics)} subscriptions already", hint="end one of them first"
            )
            return [*ended, self._send(self._failure(full, identity=message.id))]
        self.topics[message.id] = message.topic
        return [*ended, BeginUpdates(message.id, message.topic)]

    def _renew(self, token: str, now: float) -> list[Decision]:
        if now < self._next_renewal_s:
            error = Busy(
                f"a fresh token was sent less than {RENEWAL_PAUSE_S:g} s ago",
                hint="renew each token once, before it expires",
                retry_after_ms=1e3 * (self._next_renewal_s - now),
            )
            return [self._send(self._failure(error))]
        self._next_renewal_s = now + RENEWAL_PAUSE_S
        return [Renewal(token)]

    def _failure(self, error: RsePfError, *, identity: int | None = None, trace: str = "") -> Failure:
        return Failure(
            id=identity,
            code=error.code,
            message=error.message,
            hint=error.hint,
            retry_after_ms=error.retry_after_ms,
            server=self._server,
            trace=trace,
        )

    def _hello(self, hello: Hello, now: float) -> list[Decision]:
        if self.state == "open":
            return self._close(CLOSE_PROTOCOL, "hello came twice")
        if hello.protocol != PROTOCOL_VERSION:
            error = UnsupportedProtocol(
                f"the robot has protocol version {hello.protocol}, this server {PROTOCOL_VERSION}",
                hint="install a matching rse-pf on the robot",
            )
            return [self._send(self._failure(error)), *self._close(CLOSE_UNSUPPORTED, "unsupported protocol")]
        self.state = "open"
        self.hears_progress = PROGRESS in hello.capabilities
        self.hears_updates = UPDATES in hello.capabilities
        burst = self._burst
        has_burst = burst.url != "" and burst.robot_commands_per_day > 0
        welcome = Welcome(
            server=self._server,
            session=self._session,
            robot=self.robot,
            protocol=PROTOCOL_VERSION,
            limits=Limits(
                max_message_bytes=self._limits.max_message_bytes,
                max_in_flight=self._limits.max_in_flight,
                max_commands_per_s=self._limits.max_commands_per_s,
                command_burst=command_burst(self._limits.max_commands_per_s),
                burst_commands_per_day=burst.robot_commands_per_day if has_burst else 0,
            ),
            clock_s=now,
            token_s=None if self.ends_s is None else max(0.0, self.ends_s - now),
            burst_url=burst.url if has_burst else "",
            tenant=self.tenant,
            scopes=self.scopes,
        )
        return [self._send(welcome)]

    def _command(self, command: Command) -> list[Decision]:
        if self.refused_commands:
            self.refused_commands -= 1
            self.suspicion -= 1
        if self.in_flight >= self._limits.max_in_flight:
            busy = Busy(
                f"{self.in_flight} commands of this robot are unanswered",
                hint="wait for answers before sending more",
                retry_after_ms=self._limits.ping_interval_s * 100,
            )
            return [self._send(self._failure(busy, identity=command.id, trace=command.trace))]
        self.in_flight += 1
        return [Submit(command)]

    def _refuse_undecoded(self, error: ProtocolError, data: bytes) -> list[Decision]:
        """Refuse the message *data*, whose decoding raised *error*.

        If its id can be read, the refusal is the answer to this command, because the program of the robot
        made a mistake.  Without an id the client itself is faulty, so the connection is closed after
        `MAX_BAD_MESSAGES`.
        """
        identity = undecodable_id(self.codec, data) if self.state == "open" else None
        failure = self._failure(error, identity=identity)
        sent: list[Decision] = [SendRefusal(self.codec.encode(failure), failure)]
        if identity is None:
            return self._count(sent, len(data))
        self.refused_commands += _weight(len(data))
        self.suspicion += _weight(len(data))
        return sent

    def _count(self, sent: list[Decision], size_bytes: int) -> list[Decision]:
        """Count an undecodable message without a readable id, which the decisions *sent* answer.

        Returns *sent*, followed by a Close if there were too many such messages.
        """
        self.bad_messages += _weight(size_bytes)
        self.suspicion += _weight(size_bytes)
        if self.bad_messages > MAX_BAD_MESSAGES:
            return [*sent, *self._close(CLOSE_PROTOCOL, "too many bad messages")]
        return sent

    def _close(self, code: int, reason: str) -> list[Decision]:
        self.state = "closed"
        return [Close(code, reason)]

    def _send(self, message: FromServer) -> Send:
        return Send(self.codec.encode(message))


def _weight(size_bytes: int) -> int:
    """Return the number of times that an undecodable message of *size_bytes* counts."""
    return 1 + size_bytes // _BAD_MESSAGE_BYTES
