"""One robot's connection inside a worker: it assembles frames to messages, and writes messages.

Whole messages are passed to the dispatcher, and answers return through `RobotConnection.answer`.  The
connection reads and writes through the interface `Wire` only, and does neither once it is closing.
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
    """One robot's connection, from its accepted handshake until its socket is closed."""

    __slots__ = (
        "_assembler", "_awaited_id", "_context", "_deferred", "_early_commands", "_receive", "_wire",
        "allowed_s", "claims", "commands", "ignores_pauses", "is_connected", "last_message_s", "last_result",
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
            session: The state machine of the protocol; None echoes all messages, for conformance tests of
                WebSocket.
            accepted: The robot, its claims and its codec, from the handshake.
            receive: Called with this connection, its session, each whole message, and the message's time of
                arrival.
            now: Present time; all times of this class are monotonic seconds.
            number: Number of the socket on this server, in the order of acceptance.
        """
        self.robot = accepted.robot
        self.claims: Claims | None = accepted.claims
        """The claims of the robot's token; None where no token is required."""
        self.session = session
        self.number = number
        self.opened_s = self.last_message_s = now
        self.allowed_s = context.settings.session.answer_timeout_s
        """Seconds from the arrival of the robot's last command to its deadline."""
        self.paused_until_s = float("-inf")
        """End of the robot's pause; until then its commands are refused while commands of robots wait."""
        self.ignores_pauses = False
        """Whether the robot sent more than `MAX_EARLY_COMMANDS` in one pause.  Until it connects again, its
        commands are then not refused for overload, and the next one is read when the last one is answered."""
        self._early_commands = 0
        self._awaited_id: int | None = None
        self.commands = 0
        """Number of commands of this connection that were answered."""
        self.last_result = ""
        """Result of the last answered command: ``ok`` or the code of a failure; "" before."""
        self.moving_until_s = float("-inf")
        """Time until which the robot has to move to another server; in the past if it was not asked to."""
        self.is_connected = True
        self._receive = receive
        self._context = context
        self.tap = NullMessageTap() if session is None else context.tap
        """Observes the messages for a recording; there the connection has the number ``tap_connection``."""
        self.tap_connection = (
            0 if session is None else self.tap.open_connection(session.codec.name, accepted.robot)
        )
        self._wire = wire
        self._assembler = FrameAssembler(context.settings.session)
        self._deferred: deque[tuple[bytes, bool]] | None = None
        """Messages, and whether each is text, that wait until an earlier message is decoded in a thread, or
        until a command is answered; None if messages are passed to the dispatcher at once."""

    @property
    def is_closing(self) -> bool:
        """Whether a close frame was sent or received, so that nothing more is read or written."""
        return self._assembler.closed

    @property
    def is_synthetic(self) -> bool:
        """Whether the robot is a part of the platform, such as the canary; metrics do not count it."""
        return self.claims is not None and SYNTHETIC in self.claims.scopes

    @property
    def is_opening(self) -> bool:
        """Whether the robot has not sent its Hello yet."""
        return self.session is not None and self.session.state == "opening"

    @property
    def is_shown(self) -> bool:
        """Whether operators see the robot: it sent its Hello, and is not synthetic."""
        return self.session is not None and not self.is_opening and not self.is_synthetic

    @property
    def may_move(self) -> bool:
        """Whether the robot sent its Hello, and can be asked to move to another server."""
        return self.session is not None and self.session.state == "open" and not self._assembler.closed

    def receive_frame(self, opcode: int, fin: bool, rsv: bool, payload: bytes) -> None:
        """Handle one WebSocket frame, given by its opcode, FIN bit, reserved bits and unmasked payload.

        The frame completes a message, which is passed on, is answered by a pong, closes the connection, or
        waits for the other fragments of its message.
        """
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
        """Write the encoded answer *data* to the command *command_id*; write nothing if the socket is closed.

        If reading was held until this answer (`hold_until_answered`), it continues.
        """
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
        """Write one encoded message, unless the connection is closing."""
        if not self._assembler.closed:
            self._context.metrics.bytes_out += len(data)
            self._wire.send(data, self.session is not None and self.session.codec.is_text)
            self.tap.observe_sent(self.tap_connection, data)

    def write_progress(self, progress: Progress) -> None:
        """Write the progress of a job, if the robot is connected and its Hello has that capability."""
        if self.is_connected and self.session is not None and self.session.hears_progress:
            self.write(self.session.codec.encode(progress))

    @property
    def unsent_bytes(self) -> int:
        """Bytes in this process's write buffer: written here, and not yet taken by the kernel."""
        return self._wire.unsent_bytes()

    def bound_unsent(self, max_bytes: int) -> None:
        """Let the kernel accept bytes of this connection only while fewer than *max_bytes* are unsent."""
        self._wire.bound_unsent(max_bytes)

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        """Write a failure that ends the subscription with the id *identity* because of *error*."""
        if self.is_connected and self.session is not None:
            self.write(self.session.refuse_updates(identity, error).data)

    def move(self, reason: str, within_ms: float, now: float) -> None:
        """Ask the robot to connect to another server within *within_ms*; *reason* is part of the message."""
        if self.session is not None:
            self.moving_until_s = now + within_ms / 1e3
            for message in self.session.move(reason, within_ms):
                self.write(message.data)

    def answer_renewal(self, token_s: float | None) -> None:
        """Write that the fresh token is valid for *token_s* seconds, or with None that it was refused."""
        if self.session is not None:
            self.write(self.session.answer_renewal(token_s).data)

    def pause(self, seconds: float, now: float) -> None:
        """Note that a command was refused at *now*, so that the robot has to pause for *seconds*."""
        self.paused_until_s, self._early_commands = now + seconds, 0

    def note_early(self) -> None:
        """Count a command that the robot sent in its pause; above the limit, set ``ignores_pauses``."""
        self._early_commands += 1
        self.ignores_pauses |= self._early_commands > MAX_EARLY_COMMANDS

    def read_rarely(self, seconds: float) -> None:
        """Read nothing from the socket for *seconds*, because its last message could not be decoded."""
        self._wire.pause(seconds)

    def hold_until_answered(self, command_id: int) -> None:
        """Read nothing more until the command *command_id* is answered, and defer messages read already."""
        self._awaited_id = command_id
        if self._deferred is None:
            self.defer()

    def defer(self) -> None:
        """Read nothing more from the socket until `resume`, and keep messages that were read already."""
        self._deferred = deque()
        self._wire.hold()

    def resume(self, follow: Callable[[], None]) -> None:
        """End `defer`: call *follow*, which handles the message that was decoded, then the deferred messages.

        *follow* is not called if the connection is closing or closed.  Deferred messages wait on if a command
        must be answered before (`hold_until_answered`).
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
        """Handle the deferred messages in their order, and read from the socket again."""
        if self._deferred is None:
            return
        deferred, self._deferred = self._deferred, None
        now = self._context.clocks.monotonic()
        for waiting, was_text in deferred:
            if not self._assembler.closed:
                self._take(waiting, was_text, now)
        self._wire.read_on()

    def close(self, code: int, reason: str) -> None:
        """Send a close frame with *code*, and count the connection as closed for *reason*.

        Nothing more is read or written.
        """
        self._context.metrics.closed[reason] += 1
        self._assembler.closed = True
        self._wire.close(code, reason)

    def end(self) -> None:
        """Note that the socket was closed, so that nothing more is written."""
        self.is_connected = False
        self.tap.close_connection(self.tap_connection)

    def _take(self, data: bytes, is_text: bool, now: float) -> None:
        """Pass one whole message to the dispatcher, or defer it; without a session, echo it."""
        self.last_message_s = now
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
