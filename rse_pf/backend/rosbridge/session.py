"""The rules of a rosbridge client's connection, without input or output.

It is a `ServerSession` in other words: what a robot sent and the time come in, decisions come out.  There is
no Hello: a connection whose token is not known yet hears ``auth`` only, every other one is open at once.
"""

from __future__ import annotations

import msgspec

from rse_pf.backend.rosbridge.codec import (
    RosbridgeCodec,
    RosbridgeMessage,
    RosbridgeOp,
    ServiceCall,
    status_of,
)
from rse_pf.config import SessionSettings
from rse_pf.errors import ProtocolError, RsePfError, Unauthorized, UnsupportedProtocol
from rse_pf.wire import Command
from rse_pf.wire.server_session import (
    CLOSE_PROTOCOL,
    AskTopics,
    Authenticate,
    Decision,
    Send,
    ServerSession,
    Submit,
)

__all__ = ["RosbridgeSession"]

_MAX_AUTH_BYTES = 8192
"""The longest message of a client that has not shown a token."""
_LEVELS = {"none": 0, "error": 1, "warning": 2, "info": 3}
_TOPIC_OPS = frozenset(("advertise", "unadvertise", "publish", "subscribe", "unsubscribe"))
_ROSAPI = "rosapi/"


class RosbridgeSession(ServerSession):
    """One rosbridge client's connection, as its server sees it."""

    is_pinged = True

    def __init__(
        self,
        *,
        codec: RosbridgeCodec,
        server: str,
        limits: SessionSettings,
        is_open: bool,
    ) -> None:
        super().__init__(codec=codec, robot="", server=server, session="", limits=limits)
        if is_open:
            self.state = "open"
        self._rosbridge = codec
        self._level = _LEVELS["error"]

    def receive_short(self, data: bytes, now: float, max_bytes: int) -> list[Decision] | None:
        """Return the decisions about one message at *now* (s), or None if it is longer than *max_bytes*."""
        if self.state == "opening" and len(data) > _MAX_AUTH_BYTES:
            return self._close(CLOSE_PROTOCOL, "authenticate first")
        message = self._rosbridge.decode_short_from_robot(data, max_bytes)
        return None if message is None else self.take(message, now, data)

    def take(self, message: object, now: float, data: bytes = b"") -> list[Decision]:
        """Return the decisions about *data*, decoded as a `RosbridgeMessage`."""
        if self.state == "closed" or not isinstance(message, RosbridgeMessage):
            return []
        op = message.op
        if self.state == "opening":
            return self._before_token(op, message.error, len(data))
        if message.error is not None or op is None:
            return self._refuse(op, message.error, len(data))
        if op.op == "call_service":
            return self._call(op, message.command)
        if op.op in _TOPIC_OPS:
            return [AskTopics(op)]
        if op.op == "auth":
            return self._renew(op.mac, now)
        if op.op == "set_level" and isinstance(op.level, str):
            self._level = _LEVELS.get(op.level, self._level)
        return []  # a status of the client is for a log that nobody reads

    def open(self) -> None:
        """Open the session, because the client's token was accepted."""
        self.state = "open"

    def token_refusal(self) -> list[Send]:
        """Return the messages that tell a client that its token was refused; the connection ends then."""
        error = Unauthorized(
            "the token is missing or not valid", hint="issue one with rse-pf token issue ROBOT"
        )
        return [Send(status_of(self._failure(error)))]

    def forget_command(self, command_id: int) -> None:
        """Forget the client's id of a call that has its final answer."""
        self._rosbridge.calls.pop(command_id, None)

    def move(self, reason: str, within_ms: float) -> list[Decision]:
        """Warn the client, which cannot move: it connects again when this connection is closed."""
        self.ends_when_idle = True
        return self._status("warning", f"this server leaves ({reason}): connect again")

    def answer_renewal(self, token_s: float | None) -> list[Decision]:
        """Answer an ``auth`` of an open connection."""
        if token_s is not None:
            return self._status("info", f"the fresh token lasts {token_s:.0f} s")
        return super().answer_renewal(token_s)

    def refuse(self, op: RosbridgeOp, error: RsePfError) -> list[Send]:
        """Return the refusal of *op*, as the answer to a call or else as a status."""
        failure = self._failure(error)
        if op.op == "call_service":
            number = self._rosbridge.new_call(op.id, op.service, is_unread=True)
            return [Send(self._rosbridge.encode(msgspec.structs.replace(failure, id=number)))]
        return [Send(status_of(failure, op.id))] if self._level else []

    def respond(self, op: RosbridgeOp, values: object) -> bytes:
        """Return the answer *values* to a call that the endpoint itself answers."""
        return self._rosbridge.respond(ServiceCall(op.id, op.service), values)

    def _call(self, op: RosbridgeOp, command: Command | None) -> list[Decision]:
        if command is None:
            return []
        if command.service.startswith(_ROSAPI):
            return [AskTopics(op)]
        number = self._rosbridge.new_call(op.id, op.service)
        decisions = self._command(msgspec.structs.replace(command, id=number))
        if not isinstance(decisions[0], Submit):
            self._rosbridge.calls.pop(number)
        return decisions

    def _before_token(
        self, op: RosbridgeOp | None, error: ProtocolError | None, size_bytes: int
    ) -> list[Decision]:
        """Accept ``auth`` only; any other operation counts as a bad message."""
        if op is not None and op.op == "auth" and error is None:
            return [Authenticate(op.mac)]
        if error is None:
            first = Unauthorized("no token was shown yet", hint="send auth with the token as mac first")
            return self._count([*self.refuse(op, first)] if op else [], size_bytes)
        return self._refuse(op, error, size_bytes)

    def _refuse(self, op: RosbridgeOp | None, error: ProtocolError | None, size_bytes: int) -> list[Decision]:
        if error is None:
            return []
        if op is None:
            return self._count([self._send(self._failure(error))], size_bytes)
        sent: list[Decision] = [*self.refuse(op, error)]
        is_harmless = isinstance(error, UnsupportedProtocol) and self.state == "open"
        return sent if is_harmless else self._count(sent, size_bytes)

    def _status(self, level: str, text: str) -> list[Decision]:
        return [Send(self._rosbridge.status(level, text))] if _LEVELS[level] <= self._level else []
