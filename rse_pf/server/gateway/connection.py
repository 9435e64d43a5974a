"""One robot's connection inside a worker: frames come in, and what its session decides goes out.

Commands go to a `CommandHandler`, which the dispatcher is, and come back through `RobotConnection.answer`.
The connection knows no socket library, and takes nothing more once it is closing.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

from msgspec import Struct

from rse_pf.auth.roster import SYNTHETIC
from rse_pf.auth.tokens import Claims
from rse_pf.errors import ProtocolError, RsePfError
from rse_pf.server.gateway.decoder_thread import DecoderThread
from rse_pf.server.gateway.frames import CloseSocket, FrameAssembler, Received, SendPong
from rse_pf.server.gateway.handshake import Accepted
from rse_pf.server.gateway.rate_limits import RobotRates
from rse_pf.server.ports import Wire, WorkerContext
from rse_pf.server.scheduling.overload import MAX_EARLY_COMMANDS
from rse_pf.wire import Command, Failure, Progress
from rse_pf.wire.messages import FromRobot
from rse_pf.wire.server_session import (
    MAX_BAD_MESSAGES,
    BeginUpdates,
    Close,
    Decision,
    Renewal,
    Send,
    SendRefusal,
    ServerSession,
    Submit,
    Withdraw,
)

__all__ = ["CommandHandler", "RobotConnection"]

_BAD_MESSAGE_PAUSE_S = 0.1
"""After an undecodable message its socket is not read for this, times their number."""
_MAX_REFUSED = 5
"""So many of them count for the pause if their ids could be read: clients take 1 s of silence for a lost
connection."""


class CommandHandler(Protocol):
    """The part of the dispatcher, which imports this module, that a connection uses."""

    context: WorkerContext
    decoder: DecoderThread
    rates: RobotRates

    def refuse_unread(
        self, connection: RobotConnection, session: ServerSession, data: bytes, now: float
    ) -> bool:
        """Refuse the message *data* before it is decoded; False if it must be decoded."""

    def refuse_long(self, connection: RobotConnection, session: ServerSession, data: bytes) -> bool:
        """Refuse a message that is too long for the event loop; False if the decoder thread may take it."""

    def note_undecoded(self, connection: RobotConnection, failure: Failure, size_bytes: int) -> None:
        """Count and log a message of *size_bytes* that was answered with *failure* instead of decoded."""

    def submit(self, connection: RobotConnection, command: Command, size_bytes: int, now: float) -> None:
        """Admit one command, or refuse it."""

    def withdraw(self, connection: RobotConnection, command_id: int) -> None:
        """Cancel a long command."""

    def renew(self, connection: RobotConnection, token: str) -> None:
        """Judge a fresh token."""

    def subscribe(self, connection: RobotConnection, identity: int, topic: str) -> None:
        """Begin the updates of *topic* for the subscription *identity*, or refuse it."""

    def unsubscribe(self, connection: RobotConnection, identity: int) -> None:
        """End a subscription."""

    def greet(self, connection: RobotConnection, now: float) -> None:
        """Note that the robot said Hello."""

    def disconnect(self, connection: RobotConnection) -> None:
        """Forget a connection whose socket ended."""


class RobotConnection:
    """One robot's connection between its handshake and its end."""

    __slots__ = (
        "_assembler", "_awaited_id", "_context", "_deferred", "_early_commands", "_handler", "_wire",
        "allowed_s", "claims", "commands", "ignores_pauses", "is_connected", "last_heard_s", "last_result",
        "moving_until_s", "number", "opened_s", "paused_until_s", "recorded", "robot", "session", "tap",
    )  # fmt: skip

    def __init__(
        self,
        handler: CommandHandler,
        wire: Wire,
        session: ServerSession | None,
        accepted: Accepted,
        *,
        now: float,
        number: int = 0,
    ) -> None:
        """Know the robot; its session waits for a Hello.

        Args:
            handler: Takes the commands.
            wire: The socket.
            session: The rules of the protocol; None echoes messages, for the conformance test of WebSocket.
            accepted: The robot, its claims and its codec, as the handshake gave them.
            now: Monotonic time in seconds, as all times here.
            number: Which socket of the server this is, in the order of acceptance.
        """
        self.robot = accepted.robot
        self.claims: Claims | None = accepted.claims
        """The claims of the robot's token; None where no token is required."""
        self.session = session
        self.number = number
        self.opened_s = self.last_heard_s = now
        self.allowed_s = handler.context.settings.session.answer_timeout_s
        """Time that the last command had, from its arrival to its deadline."""
        self.paused_until_s = float("-inf")
        """Until when the robot has to pause, as long as commands wait."""
        self.ignores_pauses = False
        """Whether it sent on in a pause: while commands wait, it is not refused any more, but read one
        command at a time.  This holds until the robot connects again: it would ignore the next pause, too.
        """
        self._early_commands = 0
        self._awaited_id: int | None = None
        self.commands = 0
        """How many of its commands were answered; ``last_result`` is ``ok`` or the code of the last one."""
        self.last_result = ""
        self.moving_until_s = float("-inf")
        self.is_connected = True
        self._handler = handler
        self._context = handler.context
        self.tap = None if session is None else handler.context.tap
        """Takes the messages for a recording, as those of the connection ``recorded``."""
        self.recorded = 0
        if self.tap is not None and session is not None:
            self.recorded = self.tap.opened(session.codec.name, accepted.robot)
        self._wire = wire
        self._assembler = FrameAssembler(handler.context.settings.session)
        self._deferred: deque[tuple[bytes, bool]] | None = None
        """Messages that arrived while the decoder thread has one of this robot, or one awaits its answer."""

    @property
    def is_closing(self) -> bool:
        """Whether a close frame was sent or received, so that nothing more is read or written."""
        return self._assembler.closed

    @property
    def is_synthetic(self) -> bool:
        """Whether the robot belongs to the platform itself, such as the canary: it is no load."""
        return self.claims is not None and SYNTHETIC in self.claims.scopes

    @property
    def is_opening(self) -> bool:
        """Whether the robot has not said Hello yet."""
        return self.session is not None and self.session.state == "opening"

    @property
    def is_shown(self) -> bool:
        """Whether an operator sees the robot: it said Hello, and does not belong to the platform itself."""
        return self.session is not None and not self.is_opening and not self.is_synthetic

    @property
    def may_move(self) -> bool:
        """Whether the robot said Hello and can be asked to leave for another server."""
        return self.session is not None and self.session.state == "open" and not self._assembler.closed

    def receive_frame(self, opcode: int, fin: bool, rsv: bool, payload: bytes) -> None:
        """Receive one unmasked frame."""
        now = self._context.clocks.monotonic()
        if self._assembler.is_whole(opcode, fin, rsv, len(payload)):
            self._take(payload, False, now)
            return
        decision = self._assembler.receive(opcode, fin, rsv, payload, now)
        if isinstance(decision, Received):
            self._take(decision.data, decision.is_text, now)
        elif isinstance(decision, SendPong):
            self._wire.send_pong(decision.data)
        elif isinstance(decision, CloseSocket):
            self._context.metrics.closed[f"frames-{decision.code}"] += 1
            self._wire.close(decision.code, decision.reason)

    def answer(self, data: bytes, command_id: int) -> None:
        """Write the final answer to a command; does nothing if the socket is gone."""
        session = self.session
        if self.is_connected and session is not None:
            session.in_flight -= 1
            if command_id == self._awaited_id:
                self._awaited_id = None
                self._context.loop.call_soon(self._read_deferred)
            if not self._assembler.closed:
                self._context.metrics.bytes_out += len(data)
                self._wire.send(data, session.codec.is_text)
                if self.tap is not None:
                    self.tap.down(self.recorded, data)

    def write(self, data: bytes) -> None:
        """Write one message, unless the connection is closing."""
        if not self._assembler.closed:
            self._context.metrics.bytes_out += len(data)
            self._wire.send(data, self.session is not None and self.session.codec.is_text)
            if self.tap is not None:
                self.tap.down(self.recorded, data)

    def write_progress(self, progress: Progress) -> None:
        """Write how far a long command is, if the robot is still connected and understands it."""
        if self.is_connected and self.session is not None and self.session.hears_progress:
            self.write(self.session.codec.encode(progress))

    @property
    def unsent_bytes(self) -> int:
        """How much was written that the kernel has not taken, because the robot reads slowly."""
        return self._wire.unsent_bytes()

    def bound_unsent(self, max_bytes: int) -> None:
        """Limit the bytes that the kernel holds for the network to *max_bytes*."""
        self._wire.bound_unsent(max_bytes)

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        """Write that a subscription ends because of *error*."""
        if self.is_connected and self.session is not None:
            self.write(self.session.refuse_updates(identity, error).data)

    def move(self, reason: str, within_ms: float, now: float) -> None:
        """Ask the robot to leave for another server."""
        if self.session is not None:
            self.moving_until_s = now + within_ms / 1e3
            self._execute(self.session.move(reason, within_ms), now)

    def answer_renewal(self, token_s: float | None, now: float) -> None:
        """Tell the robot that its fresh token is valid for *token_s*, s, or with None that it was refused."""
        if self.session is not None:
            self._execute(self.session.answer_renewal(token_s), now)

    def pause(self, seconds: float, now: float) -> None:
        """Note that the robot was refused, and has to pause."""
        self.paused_until_s, self._early_commands = now + seconds, 0

    def note_early(self) -> None:
        """Count a command that the robot sent in its pause."""
        self._early_commands += 1
        self.ignores_pauses |= self._early_commands > MAX_EARLY_COMMANDS

    def hold_until_answered(self, command_id: int) -> None:
        """Read nothing more from the robot until a command is answered."""
        self._awaited_id = command_id
        if self._deferred is None:
            self._deferred = deque()
            self._wire.hold()

    def _read_deferred(self) -> None:
        if self._deferred is None:
            return
        deferred, self._deferred = self._deferred, None
        now = self._context.clocks.monotonic()
        for waiting, was_text in deferred:
            if not self._assembler.closed:
                self._take(waiting, was_text, now)
        self._wire.read_on()

    def close(self, code: int, reason: str) -> None:
        """Close the socket and take nothing more from it."""
        self._context.metrics.closed[reason] += 1
        self._assembler.closed = True
        self._wire.close(code, reason)

    def on_socket_end(self) -> None:
        """Note that the socket has ended, and leave the dispatcher."""
        self.is_connected = False
        if self.tap is not None:
            self.tap.closed(self.recorded)
        self._handler.disconnect(self)

    def _take(self, data: bytes, is_text: bool, now: float) -> None:
        """Take one whole message, or defer it."""
        self.last_heard_s = now
        if self._deferred is not None:
            self._deferred.append((data, is_text))
            return
        works_for = self._context.crash.of_loop
        works_for[0] = self.number
        try:
            self._process(data, is_text, now)
        finally:
            works_for[0] = 0

    def _process(self, data: bytes, is_text: bool, now: float) -> None:
        """Echo or refuse one whole message, decode it at once, or pass it to the decoder thread."""
        handler, session = self._handler, self.session
        metrics = self._context.metrics
        metrics.bytes_in += len(data)
        if self.tap is not None:
            self.tap.up(self.recorded, data)
        if session is None:
            metrics.bytes_out += len(data)
            self._wire.send(data, is_text)
            return
        if session.state == "open" and handler.refuse_unread(self, session, data, now):
            return
        state, suspicion = session.state, session.suspicion
        decoder, decisions = handler.decoder, None
        if len(data) <= decoder.short_bytes:
            decisions = session.receive_short(data, now, decoder.short_inflated_bytes)
        if decisions is not None and len(decisions) == 1 and type(decisions[0]) is Submit:
            command = decisions[0].command
            if self.tap is not None and isinstance(command.payload, Struct):
                # The codec decodes a payload to a request only if it knows all fields of the message.
                self.tap.is_plain(data, command.id, f"{command.stream} {command.trace}")
            handler.submit(self, command, len(data), now)
        elif decisions is not None:
            self._follow(session, decisions, len(data), now, state, suspicion)
        elif not handler.refuse_long(self, session, data):
            self._decode_in_thread(session, data, now)

    def _decode_in_thread(self, session: ServerSession, data: bytes, now: float) -> None:
        state, suspicion = session.state, session.suspicion

        def follow_decoded(message: FromRobot | ProtocolError) -> None:
            if self.is_connected and not self._assembler.closed:
                works_for = self._context.crash.of_loop
                works_for[0] = self.number
                try:
                    decisions = session.take(message, now, data)
                    self._follow(session, decisions, len(data), now, state, suspicion)
                finally:
                    works_for[0] = 0
            if self._awaited_id is None:
                self._read_deferred()

        self._deferred = deque()
        self._wire.hold()
        self._handler.decoder.begin(
            session.codec, data, number=self.number, suspicion=suspicion, done=follow_decoded
        )

    def _follow(
        self,
        session: ServerSession,
        decisions: list[Decision],
        size_bytes: int,
        now: float,
        state: str,
        suspicion: int,
    ) -> None:
        """Execute what the session decided about one message; it was in *state* before."""
        self._execute(decisions, now, size_bytes)
        if session.bad_messages > MAX_BAD_MESSAGES:
            self._context.log.warning("cut-off", robot=self.robot, reason="bad-messages")
            self._handler.rates.ban(self.robot, now)
        if self._assembler.closed:
            return
        if session.suspicion > suspicion:
            # Refusing a bad message costs as much as reading it, so the socket is read more and more rarely.
            self._context.metrics.shed["bad-message"] += 1
            counted = session.bad_messages + min(session.refused_commands, _MAX_REFUSED)
            self._wire.pause(counted * _BAD_MESSAGE_PAUSE_S)
        elif state == "opening" and session.state == "open":
            self._handler.greet(self, now)

    def _execute(self, decisions: list[Decision], now: float, size_bytes: int = 0) -> None:
        handler = self._handler
        for decision in decisions:
            if isinstance(decision, Submit):
                handler.submit(self, decision.command, size_bytes, now)
            elif isinstance(decision, Send):
                self.write(decision.data)
                if isinstance(decision, SendRefusal):
                    handler.note_undecoded(self, decision.failure, size_bytes)
            elif isinstance(decision, Renewal):
                handler.renew(self, decision.token)
            elif isinstance(decision, Withdraw):
                handler.withdraw(self, decision.id)
            elif isinstance(decision, Close):
                self.close(decision.code, decision.reason)
            elif isinstance(decision, BeginUpdates):
                handler.subscribe(self, decision.id, decision.topic)
            else:
                handler.unsubscribe(self, decision.id)
