"""The rules of a server's side of one connection, without input or output.

Messages and the time go in, decisions come out (`Send`, `Submit`, `Close` ...).  The robot's side is in
`rse_pf.wire.client_session`.
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
"""Capability of a robot that accepts progress messages and may cancel commands."""

UPDATES = "updates"
"""Capability of a robot that may subscribe to topics."""

MAX_SUBSCRIPTIONS = 8
"""Subscriptions of one connection; a robot needs one for each map that it drives in."""

RENEWAL_PAUSE_S = 1.0
"""Minimum pause between two renewals, because each one costs a signature check."""

CLOSE_GOING_AWAY = 1001
CLOSE_PROTOCOL = 4400
CLOSE_TOKEN_OVER = 4401
CLOSE_REVOKED = 4403
CLOSE_UNSUPPORTED = 4406
CLOSE_REPLACED = 4409
CLOSE_RATE = 4429
MAX_BAD_MESSAGES = 10
"""Undecodable messages without a readable id after which robot and server close the socket."""
_BAD_MESSAGE_BYTES = 65_536
"""An undecodable message counts once, and once more for each of these bytes: longer ones cost more."""


class Send(msgspec.Struct, frozen=True, gc=False):
    """Write this WebSocket message."""

    data: bytes


class SendRefusal(Send, frozen=True, gc=False):
    """Write this WebSocket message, which refuses a message that cannot be decoded."""

    failure: Failure


class Submit(msgspec.Struct, frozen=True, gc=False):
    """Hand this command to the scheduler."""

    command: Command


class Close(msgspec.Struct, frozen=True, gc=False):
    """Close the socket with this code."""

    code: int
    reason: str


class Withdraw(msgspec.Struct, frozen=True, gc=False):
    """The robot cancels this command."""

    id: int


class Renewal(msgspec.Struct, frozen=True, gc=False):
    """Verify this fresh token and answer with `ServerSession.answer_renewal`."""

    token: str


class BeginUpdates(msgspec.Struct, frozen=True, gc=False):
    """Send the updates of this topic, or refuse with `ServerSession.refuse_updates`."""

    id: int
    topic: str


class EndUpdates(msgspec.Struct, frozen=True, gc=False):
    """Send no more updates of this subscription."""

    id: int


Decision = Send | Submit | Withdraw | Renewal | Close | BeginUpdates | EndUpdates


class ServerSession:
    """One robot's connection, as its server sees it.

    Attributes:
        ends_s: When the robot's token expires, on the server's clock; set after authentication.
        hears_progress: Whether the robot announced the capability `PROGRESS`.
        hears_updates: Whether it announced the capability `UPDATES`.
        topics: The topic of each live subscription, by its id.
        bad_messages: How many invalid messages arrived whose id could not be read; a long one counts several
            times.
        refused_commands: How many invalid messages arrived whose id could be read, less one for each valid
            command since.
        suspicion: The sum of both; a robot with less is read first.
        tenant: Of the robot, and ``scopes`` of its token; both go into the Welcome.
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
        """Return the decisions about one WebSocket message that arrived at *now* (server clock, s).

        None means that the message has more than *max_bytes* inflated: decode it elsewhere, for `take`.
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
        """Return the decisions about one decoded message, or about the error of decoding *data*."""
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
        """Ask the robot to connect to another server before it closes this connection."""
        return [self._send(Move(reason=reason, within_ms=within_ms))] if self.state == "open" else []

    def answer_renewal(self, token_s: float | None) -> Send:
        """Answer a `Renewal`: the connection lasts *token_s* longer, or (None) the token was refused.

        A refusal has no cause, as in the handshake, and the connection keeps its previous expiry.
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
        """Begin a subscription; an earlier one with the same id ends."""
        if not self.hears_updates:
            unheard = BadRequest(
                f"this connection did not announce the capability {UPDATES}", hint="name it in hello"
            )
            return [self._send(self._failure(unheard, identity=message.id))]
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
                "a fresh token was sent a moment ago",
                hint="renew once per token",
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
                f"protocol {hello.protocol} is not {PROTOCOL_VERSION}",
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
        """Answer a message that cannot be decoded, as the answer to its command where its id can be read.

        With an id the program of the robot made a mistake, and gets the error.  Without an id the client
        itself is broken, so the connection is closed after `MAX_BAD_MESSAGES`.
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
        """Count a bad message that *sent* answers."""
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
    """Return how often an undecodable message of *size_bytes* counts."""
    return 1 + size_bytes // _BAD_MESSAGE_BYTES
