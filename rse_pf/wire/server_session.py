"""The rules of a server's side of one connection, without any input or output.

Bytes and readings of the clock go in, decisions come out (`Send`, `Submit`, `Close`).  The
robot's side is in `rse_pf.wire.client_session`.  Promises never to read a clock or touch a socket.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rse_pf.config import SessionSettings
from rse_pf.errors import (
    BadMessage,
    Busy,
    InternalError,
    LimitExceeded,
    ProtocolError,
    RsePfError,
    Unauthorized,
)
from rse_pf.wire.codec import Codec
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
    Renew,
    Renewed,
    Result,
    Welcome,
)

__all__ = [
    "CLOSE_GOING_AWAY",
    "CLOSE_NORMAL",
    "CLOSE_PROTOCOL",
    "CLOSE_RATE",
    "CLOSE_REPLACED",
    "CLOSE_REVOKED",
    "CLOSE_TOKEN_OVER",
    "CLOSE_UNSUPPORTED",
    "PROGRESS",
    "RENEWAL_PAUSE_S",
    "Close",
    "Decision",
    "Renewal",
    "Send",
    "ServerSession",
    "Submit",
    "Withdraw",
]

PROGRESS = "progress"
"""Capability of a robot that takes progress and may take commands back."""

RENEWAL_PAUSE_S = 1.0
"""A robot that shows fresh tokens faster is told to wait: each costs a signature check."""

CLOSE_NORMAL = 1000
CLOSE_GOING_AWAY = 1001
CLOSE_PROTOCOL = 4400
CLOSE_TOKEN_OVER = 4401
CLOSE_REVOKED = 4403
CLOSE_UNSUPPORTED = 4406
CLOSE_REPLACED = 4409
CLOSE_RATE = 4429
CLOSE_RATE = 4429


@dataclass(frozen=True, slots=True)
class Send:
    """Write this WebSocket message."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Submit:
    """Hand this command to the scheduler."""

    command: Command


@dataclass(frozen=True, slots=True)
class Close:
    """Close the socket with this code."""

    code: int
    reason: str


@dataclass(frozen=True, slots=True)
class Withdraw:
    """The robot takes this command back."""

    id: int


@dataclass(frozen=True, slots=True)
class Renewal:
    """Judge this fresh token and answer with `ServerSession.renewed`."""

    token: str


Decision = Send | Submit | Withdraw | Renewal | Close


class ServerSession:
    """One robot's connection, as its server sees it."""

    def __init__(
        self, *, codec: Codec, robot: str, server: str, session: str, limits: SessionSettings
    ) -> None:
        self.robot = robot
        self.state: Literal["opening", "open", "closed"] = "opening"
        self.in_flight = 0
        self.ends_s: float | None = None
        """When the robot's token is over, on the server's clock; set by whoever knows."""
        self.hears_progress = False
        """Whether the robot knows of long commands."""
        self.codec = codec
        self._server = server
        self._session = session
        self._limits = limits
        self._bad_messages = 0
        self._next_renewal_s = float("-inf")

    @property
    def bad_messages(self) -> int:
        """How many messages could not be read; a long one counts for several."""
        return self._bad_messages

    def receive(self, data: bytes, now: float) -> list[Decision]:
        """Return what to do about one WebSocket message that arrived at *now* (server clock, s)."""
        if self.state == "closed":
            return []
        message: FromRobot | ProtocolError
        try:
            message = self.codec.decode_from_robot(data)
        except ProtocolError as error:
            message = error
        return self.take(message, now, len(data))

    def receive_short(self, data: bytes, now: float, most: int) -> list[Decision] | None:
        """Return the same as `receive`, but None if the message is longer than *most* bytes, inflated."""
        if self.state == "closed":
            return []
        try:
            message = self.codec.decode_short_from_robot(data, most)
        except ProtocolError as error:
            return self.take(error, now, len(data))
        return None if message is None else self.take(message, now)

    def take(self, message: FromRobot | ProtocolError, now: float, size_bytes: int = 0) -> list[Decision]:
        """Return what to do about one message of *size_bytes* that was read, or could not be."""
        if self.state == "closed":
            return []
        if isinstance(message, ProtocolError):
            return self._refuse(message, size_bytes)
        if isinstance(message, Hello):
            return self._hello(message, now)
        if self.state == "opening":
            return self._leave(CLOSE_PROTOCOL, "say hello first")
        if isinstance(message, Ping):
            pong = Pong(sent_s=message.sent_s, received_s=now, answered_s=now)
            return [self._send(pong)]
        if isinstance(message, Cancel):
            return [Withdraw(message.id)]
        if isinstance(message, Renew):
            return self._renew(message, now)
        return self._command(message)

    def answer(self, message: Result | Failure) -> Send:
        """Return the bytes of the final answer to a command that was submitted.

        A reply that cannot be encoded, or that is larger than a message may be, becomes a failure.
        """
        self.in_flight -= 1
        try:
            send = self._send(message)
            if len(send.data) <= self._limits.max_message_bytes:
                return send
            error: ProtocolError = LimitExceeded(
                f"the reply of {len(send.data)} bytes is above {self._limits.max_message_bytes}",
                hint="ask for less, or fetch it from the data server",
            )
        except BadMessage as unencodable:
            error = unencodable
        return self._send(
            Failure(
                id=message.id,
                code=error.code if isinstance(error, LimitExceeded) else InternalError.code,
                message=error.message if isinstance(error, LimitExceeded) else "the reply does not travel",
                hint=error.hint,
                server=self._server,
            )
        )

    def move(self, reason: str, within_ms: float) -> list[Decision]:
        """Ask the robot to leave for another server, make before break."""
        return [self._send(Move(reason=reason, within_ms=within_ms))] if self.state == "open" else []

    def renewed(self, token_s: float | None) -> list[Decision]:
        """Answer a `Renewal`: the socket lives *token_s* more, or (None) the token was no good.

        A refusal says as little as the door does, and the socket keeps the end that it had.
        """
        if token_s is not None:
            return [self._send(Renewed(token_s=token_s))]
        error = Unauthorized(
            "the fresh token is not valid for this robot", hint="the socket keeps the end that it had"
        )
        return [self._send(self._complaint(error))]

    def _renew(self, message: Renew, now: float) -> list[Decision]:
        if now < self._next_renewal_s:
            error = Busy(
                "a fresh token was shown a moment ago", hint="renew once in a token's life",
                retry_after_ms=1e3 * (self._next_renewal_s - now),
            )  # fmt: skip
            return [self._send(self._complaint(error))]
        self._next_renewal_s = now + RENEWAL_PAUSE_S
        return [Renewal(message.token)]

    def _complaint(self, error: RsePfError) -> Failure:
        return Failure(
            code=error.code, message=error.message, hint=error.hint, retry_after_ms=error.retry_after_ms,
            server=self._server,
        )  # fmt: skip

    def _hello(self, hello: Hello, now: float) -> list[Decision]:
        if self.state == "open":
            return self._leave(CLOSE_PROTOCOL, "hello came twice")
        if hello.protocol != PROTOCOL_VERSION:
            failure = Failure(
                code="unsupported",
                message=f"protocol {hello.protocol} is not {PROTOCOL_VERSION}",
                hint="install a matching rse-pf on the robot",
                server=self._server,
            )
            return [self._send(failure), *self._leave(CLOSE_UNSUPPORTED, "unsupported protocol")]
        self.state = "open"
        self.hears_progress = PROGRESS in hello.capabilities
        welcome = Welcome(
            server=self._server,
            session=self._session,
            robot=self.robot,
            protocol=PROTOCOL_VERSION,
            limits=Limits(
                max_message_bytes=self._limits.max_message_bytes,
                max_in_flight=self._limits.max_in_flight,
                max_commands_per_s=self._limits.max_commands_per_s,
                command_burst=self._limits.command_burst if self._limits.max_commands_per_s else 0,
            ),
            clock_s=now,
            token_s=None if self.ends_s is None else max(0.0, self.ends_s - now),
        )
        return [self._send(welcome)]

    def _command(self, command: Command) -> list[Decision]:
        if self.in_flight >= self._limits.max_in_flight:
            busy = Busy(f"{self.in_flight} commands of this robot are unanswered")
            return [
                self._send(
                    Failure(
                        id=command.id,
                        code=busy.code,
                        message=busy.message,
                        hint="wait for answers before sending more",
                        retry_after_ms=self._limits.ping_interval_s * 100,
                        server=self._server,
                        trace=command.trace,
                    )
                )
            ]
        self.in_flight += 1
        return [Submit(command)]

    def _refuse(self, error: ProtocolError, size_bytes: int) -> list[Decision]:
        self._bad_messages += 1 + size_bytes // self._limits.bad_message_bytes
        failure = Failure(code=error.code, message=error.message, hint=error.hint, server=self._server)
        if self._bad_messages > self._limits.max_bad_messages:
            return [self._send(failure), *self._leave(CLOSE_PROTOCOL, "too many bad messages")]
        return [self._send(failure)]

    def _leave(self, code: int, reason: str) -> list[Decision]:
        self.state = "closed"
        return [Close(code, reason)]

    def _send(self, message: FromServer) -> Send:
        return Send(self.codec.encode(message))
