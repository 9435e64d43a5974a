"""One robot's socket inside a worker: frames in, what its session decided out, everything else to the core.

Promises to know no socket library and no clock but the core's, and that a socket which closes takes nothing
more.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from rse_pf.auth.roster import holds
from rse_pf.backend.gateway.decoder_thread import DecoderThread, refusal_unread
from rse_pf.backend.gateway.frames import CloseSocket, FrameAssembler, Received, SendPong
from rse_pf.backend.ports import Wire
from rse_pf.wire.server_session import Decision, Renewal, Send, ServerSession, Submit, Withdraw

if TYPE_CHECKING:
    from rse_pf.auth.tokens import Claims
    from rse_pf.backend.gateway.dispatcher import Dispatcher
    from rse_pf.errors import ProtocolError
    from rse_pf.wire.messages import FromRobot

__all__ = ["RobotConnection"]


class RobotConnection:
    """One robot's socket between its handshake and its end."""

    __slots__ = (
        "_behind", "_core", "_wire", "allowed_s", "assembler", "claims", "expires_s", "last_heard_s",
        "moving_until_s", "number", "opened_s", "robot", "session", "tenant",
    )  # fmt: skip

    def __init__(
        self,
        core: Dispatcher,
        wire: Wire,
        session: ServerSession | None,
        robot: str,
        now: float,
        expires_s: float | None,
    ) -> None:
        self.robot = robot
        self.tenant = "default"
        self.session = session
        self.assembler = FrameAssembler(core.settings.session)
        self.opened_s = self.last_heard_s = now
        self.expires_s = expires_s
        self.allowed_s: float | None = None
        """What the last command allowed, from its arrival to its deadline."""
        self.claims: Claims | None = None
        """What the robot's token says; None where no token is asked for."""
        self.number = 0
        """Which socket of the server this is, in the order of acceptance."""
        self.moving_until_s = float("-inf")
        self._core = core
        self._wire = wire
        self._behind: deque[tuple[Received, float]] | None = None
        """What arrived while a long message is read elsewhere; None: nothing is."""

    def frame(self, opcode: int, fin: bool, rsv: bool, payload: bytes) -> None:
        """Take one unmasked frame."""
        now = self._core.clocks.monotonic()
        decision = self.assembler.receive(opcode, fin, rsv, payload, now)
        if isinstance(decision, Received):
            self._message(decision, now)
        elif isinstance(decision, SendPong):
            self._wire.send_pong(decision.data)
        elif isinstance(decision, CloseSocket):
            self._core.metrics.closed[f"frames-{decision.code}"] += 1
            self._wire.close(decision.code, decision.reason)

    def ended(self) -> None:
        """Note that the socket is gone."""
        self._core.disconnect(self)

    @property
    def may_move(self) -> bool:
        """Whether the robot said Hello and can be asked to leave for another server."""
        return self.session is not None and self.session.state == "open" and not self.assembler.closed

    def may_use(self, service: str) -> bool:
        """Whether the scopes of the robot's token allow *service*."""
        return self.claims is None or holds(self.claims.scopes, f"services:{service}")

    def move(self, reason: str, within_ms: float, now: float) -> None:
        """Ask the robot to leave for another server."""
        if self.session is not None:
            self.moving_until_s = now + within_ms / 1e3
            self.apply(self.session.move(reason, within_ms), now)

    def apply(self, decisions: list[Decision], now: float, size_bytes: int = 0) -> None:
        """Do what the session decided."""
        for decision in decisions:
            if isinstance(decision, Submit):
                self._core.submit(self, decision.command, size_bytes, now)
            elif isinstance(decision, Renewal):
                self._core.renew(self, decision.token)
            elif isinstance(decision, Send):
                self.write(decision.data)
            elif isinstance(decision, Withdraw):
                self._core.withdraw(self, decision.id)
            else:
                self.close(decision.code, decision.reason)

    def write(self, data: bytes) -> None:
        """Write one message, unless the socket is closing."""
        if self.assembler.closed:
            return
        self._core.metrics.bytes_out += len(data)
        self._wire.send(data, self.session is not None and self.session.codec.is_text)

    def close(self, code: int, reason: str) -> None:
        """Close the socket and take nothing more from it."""
        self._core.metrics.closed[reason] += 1
        self.assembler.closed = True
        self._wire.close(code, reason)

    def _message(self, received: Received, now: float) -> None:
        self.last_heard_s = now
        if self._behind is not None:
            self._behind.append((received, now))
            return
        self._core.metrics.bytes_in += len(received.data)
        session = self.session
        if session is None:
            self._core.metrics.bytes_out += len(received.data)
            self._wire.send(received.data, received.is_text)
            return
        if session.state == "open" and self._core.refuses_unread(self, session.codec, received.data, now):
            return
        reading, was, bad = self._core.reading, session.state, session.bad_messages
        if reading is None:
            self._received(session.receive(received.data, now), len(received.data), now, was, bad)
            return
        if len(received.data) <= reading.short_bytes:
            decisions = session.receive_short(received.data, now, reading.short_inflated_bytes)
            if decisions is not None:
                self._received(decisions, len(received.data), now, was, bad)
                return
        self._read_elsewhere(reading, session, received.data, now)

    def _read_elsewhere(
        self, reading: DecoderThread, session: ServerSession, data: bytes, now: float
    ) -> None:
        was, bad = session.state, session.bad_messages

        def done(read: FromRobot | ProtocolError) -> None:
            behind, self._behind = self._behind, None
            if not self.assembler.closed and self in self._core.connections:
                self._received(session.take(read, now, len(data)), len(data), now, was, bad)
            for each, arrived in behind or ():
                if not self.assembler.closed:
                    self._message(each, arrived)
            self._wire.read_on()

        if not reading.begin(session.codec, data, suspicion=bad, done=done):
            self._core.metrics.shed["unread"] += 1
            self.write(refusal_unread(session.codec, data, self._core.server_id))
            return
        self._behind = deque()
        self._wire.hold()

    def _received(self, decisions: list[Decision], size_bytes: int, now: float, was: str, bad: int) -> None:
        session = self.session
        self.apply(decisions, now, size_bytes)
        if session is None:
            return
        if session.bad_messages > self._core.settings.session.max_bad_messages:
            self._core.rates.rest((self.tenant, self.robot), now)
        if self.assembler.closed:
            return
        if session.bad_messages > bad:
            # To refuse costs as much as to read: who sends garbage is read more and more rarely.
            self._core.metrics.shed["bad-message"] += 1
            self._wire.pause(session.bad_messages * self._core.settings.session.bad_message_pause_s)
        if was == "opening" and session.state == "open":
            self._core.welcomed(self, now)
