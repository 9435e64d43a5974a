"""One robot's connection inside a worker: it assembles frames into messages, and writes messages.

Whole messages go to the dispatcher, and answers return through `RobotConnection.answer`.  The connection
knows no socket library, and reads and writes nothing more once it is closing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rse_pf.auth.roster import SYNTHETIC
from rse_pf.auth.tokens import Claims
from rse_pf.errors import RsePfError
from rse_pf.server.gateway.frames import CloseSocket, FrameAssembler, Received, SendPong
from rse_pf.server.gateway.handshake import Accepted
from rse_pf.server.scheduling.overload import MAX_EARLY_COMMANDS
from rse_pf.server.worker_context import NullMessageTap, Wire, WorkerContext
from rse_pf.wire import Progress
from rse_pf.wire.server_session import ServerSession

__all__ = ["RobotConnection"]


class RobotConnection:
    """One robot's connection between its handshake and its end."""

    __slots__ = (
        "_assembler", "_awaited_id", "_context", "_deferred", "_early_commands", "_receive", "_wire",
        "allowed_s", "claims", "commands", "ignores_pauses", "is_connected", "last_heard_s", "last_result",
        "moving_until_s", "number", "opened_s", "paused_until_s", "robot", "session", "tap",
        "tap_connection",
    )  # fmt: skip

    def __init__(
        self,
        context: WorkerContext,
        wire: Wire,
        session: ServerSession | None,
        accepted: Accepted,
        *,
        receive: Callable[[RobotConnection, ServerSession, bytes, float], None],
        now: float,
        number: int = 0,
    ) -> None:
        """Wait for the Hello of the robot.

        Args:
            context: The settings, clocks, event loop and metrics of the worker.
            wire: The socket.
            session: The rules of the protocol; None echoes messages, for conformance tests of WebSocket.
            accepted: The robot, its claims and its codec, from the handshake.
            receive: Called with the connection, its session, each whole message, and the time of its arrival.
            now: Monotonic time in seconds, as all times here.
            number: Number of the socket on this server, in the order of acceptance.
        """
        self.robot = accepted.robot
        self.claims: Claims | None = accepted.claims
        """The claims of the robot's token; None where no token is required."""
        self.session = session
        self.number = number
        self.opened_s = self.last_heard_s = now
        self.allowed_s = context.settings.session.answer_timeout_s
        """Seconds that the last command had from its arrival to its deadline."""
        self.paused_until_s = float("-inf")
        """The robot has to pause until this time, as long as commands wait."""
        self.ignores_pauses = False
        """Whether the robot sent more than `MAX_EARLY_COMMANDS` in a pause.  While commands wait, it is then
        read one command at a time and no longer refused, until it connects again."""
        self._early_commands = 0
        self._awaited_id: int | None = None
        self.commands = 0
        """How many of its commands were answered."""
        self.last_result = ""
        """The result of the last of them: ``ok`` or the code of a failure."""
        self.moving_until_s = float("-inf")
        self.is_connected = True
        self._receive = receive
        self._context = context
        self.tap = NullMessageTap() if session is None else context.tap
        """Observes the messages of the connection, whose number for the tap is ``tap_connection``."""
        self.tap_connection = (
            0 if session is None else self.tap.open_connection(session.codec.name, accepted.robot)
        )
        self._wire = wire
        self._assembler = FrameAssembler(context.settings.session)
        self._deferred: deque[tuple[bytes, bool]] | None = None
        """Messages that arrived while one of this robot is decoded in a thread, or while a command must be
        answered first; None if messages are passed on at once."""

    @property
    def is_closing(self) -> bool:
        """Whether a close frame was sent or received, so that nothing more is read or written."""
        return self._assembler.closed

    @property
    def is_synthetic(self) -> bool:
        """Whether the robot belongs to the platform, such as the canary, and does not count as load."""
        return self.claims is not None and SYNTHETIC in self.claims.scopes

    @property
    def is_opening(self) -> bool:
        """Whether the robot has not said Hello yet."""
        return self.session is not None and self.session.state == "opening"

    @property
    def is_shown(self) -> bool:
        """Whether operators see the robot: it said Hello, and does not belong to the platform."""
        return self.session is not None and not self.is_opening and not self.is_synthetic

    @property
    def may_move(self) -> bool:
        """Whether the robot said Hello and can be asked to move to another server."""
        return self.session is not None and self.session.state == "open" and not self._assembler.closed

    def receive_frame(self, opcode: int, fin: bool, rsv: bool, payload: bytes) -> None:
        """Receive one unmasked frame."""
        now = self._context.clocks.monotonic()
        decision = self._assembler.receive(opcode, fin, rsv, payload, now)
        if isinstance(decision, Received):
            self._take(decision.data, decision.is_text, now)
        elif isinstance(decision, SendPong):
            self._wire.send_pong(decision.data)
        elif isinstance(decision, CloseSocket):
            self._context.metrics.closed[f"frames-{decision.code}"] += 1
            self._wire.close(decision.code, decision.reason)

    def answer(self, data: bytes, command_id: int) -> None:
        """Write the final answer to a command; does nothing if the socket is closed."""
        session = self.session
        if self.is_connected and session is not None:
            session.in_flight -= 1
            if command_id == self._awaited_id:
                self._awaited_id = None
                self._context.loop.call_soon(self._read_deferred)
            if not self._assembler.closed:
                self._context.metrics.bytes_out += len(data)
                self._wire.send(data, session.codec.is_text)
                self.tap.observe_sent(self.tap_connection, data)

    def write(self, data: bytes) -> None:
        """Write one message, unless the connection is closing."""
        if not self._assembler.closed:
            self._context.metrics.bytes_out += len(data)
            self._wire.send(data, self.session is not None and self.session.codec.is_text)
            self.tap.observe_sent(self.tap_connection, data)

    def write_progress(self, progress: Progress) -> None:
        """Write the progress of a long command, if the robot is connected and announced the capability."""
        if self.is_connected and self.session is not None and self.session.hears_progress:
            self.write(self.session.codec.encode(progress))

    @property
    def unsent_bytes(self) -> int:
        """Bytes that were written and that the kernel has not taken, because the robot reads slowly."""
        return self._wire.unsent_bytes()

    def bound_unsent(self, max_bytes: int) -> None:
        """Limit the bytes of this connection that the kernel holds and has not sent to *max_bytes*."""
        self._wire.bound_unsent(max_bytes)

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        """Write that a subscription ends because of *error*."""
        if self.is_connected and self.session is not None:
            self.write(self.session.refuse_updates(identity, error).data)

    def move(self, reason: str, within_ms: float, now: float) -> None:
        """Ask the robot to move to another server within *within_ms*."""
        if self.session is not None:
            self.moving_until_s = now + within_ms / 1e3
            for message in self.session.move(reason, within_ms):
                self.write(message.data)

    def answer_renewal(self, token_s: float | None) -> None:
        """Send that the fresh token is valid for *token_s* seconds, or with None that it was refused."""
        if self.session is not None:
            self.write(self.session.answer_renewal(token_s).data)

    def pause(self, seconds: float, now: float) -> None:
        """Note that the robot was refused, and has to pause."""
        self.paused_until_s, self._early_commands = now + seconds, 0

    def note_early(self) -> None:
        """Count a command that the robot sent in its pause."""
        self._early_commands += 1
        self.ignores_pauses |= self._early_commands > MAX_EARLY_COMMANDS

    def read_rarely(self, seconds: float) -> None:
        """Read nothing from the socket for *seconds*, because its last message was bad."""
        self._wire.pause(seconds)

    def hold_until_answered(self, command_id: int) -> None:
        """Read nothing more until the command *command_id* is answered; messages that were read wait, too."""
        self._awaited_id = command_id
        if self._deferred is None:
            self.defer()

    def defer(self) -> None:
        """Read nothing more from the socket, and keep the messages that were read already."""
        self._deferred = deque()
        self._wire.hold()

    def resume(self, follow: Callable[[], None]) -> None:
        """Call *follow* for the message that was decoded in a thread, then take the deferred messages.

        *follow* is not called if the connection is closing or gone.
        """
        if self.is_connected and not self._assembler.closed:
            works_for = self._context.crash.of_loop
            works_for[0] = self.number
            try:
                follow()
            finally:
                works_for[0] = 0
        if self._awaited_id is None:
            self._read_deferred()

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
        """Close the socket and read nothing more from it."""
        self._context.metrics.closed[reason] += 1
        self._assembler.closed = True
        self._wire.close(code, reason)

    def end(self) -> None:
        """Note that the socket has ended: nothing more is written."""
        self.is_connected = False
        self.tap.close_connection(self.tap_connection)

    def _take(self, data: bytes, is_text: bool, now: float) -> None:
        """Pass on or defer one whole message; without a session, echo it."""
        self.last_heard_s = now
        session = self.session
        if self._deferred is not None:
            self._deferred.append((data, is_text))
            return
        self._context.metrics.bytes_in += len(data)
        if session is None:
            self._context.metrics.bytes_out += len(data)
            self._wire.send(data, is_text)
            return
        self.tap.observe_received(self.tap_connection, data)
        works_for = self._context.crash.of_loop
        works_for[0] = self.number
        try:
            self._receive(self, session, data, now)
        finally:
            works_for[0] = 0
