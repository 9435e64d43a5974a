"""Receive the messages of all connections of one worker, and pass their commands to queues.

1. `_refuse_unread` refuses a message before it is decoded if its robot exceeds its rate, or if the server is
   overloaded.
2. `_receive` decodes a short message in the event loop, and has a long one decoded in the decoder thread.
3. `_execute` carries out the decisions of the session (`rse_pf.wire.server_session`) about the message.
4. `submit` admits or refuses a command, and passes it to the first queue that offers its service.

Nothing here uses a socket: `RobotConnection` passes messages, and writes through a `Wire`.
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from typing import Any

from rse_pf.errors import Busy, NotFound, ProtocolError, UnknownService
from rse_pf.server.gateway.admission import DECODER_FULL, TOO_LATE, Admission
from rse_pf.server.gateway.answers import Answers
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.handshake import Accepted
from rse_pf.server.gateway.idle_timeouts import IdleTimeouts
from rse_pf.server.gateway.rate_limits import CUT_OFF
from rse_pf.server.gateway.service_queues import StatelessQueue
from rse_pf.server.gateway.token_watch import TokenWatch
from rse_pf.server.live_map.router import LiveMapRouter
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueBacklog, QueuedCommand, RefusedCommand
from rse_pf.server.scheduling.decoder_thread import DecoderThread
from rse_pf.server.worker_context import Wire, WorkerContext
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import CODECS, Codec, Command
from rse_pf.wire.envelope import peek
from rse_pf.wire.messages import FromRobot
from rse_pf.wire.server_codec import make_server_codec
from rse_pf.wire.server_session import (
    CLOSE_GOING_AWAY,
    CLOSE_RATE,
    MAX_BAD_MESSAGES,
    BeginUpdates,
    Close,
    Decision,
    EndUpdates,
    Renewal,
    Send,
    SendRefusal,
    ServerSession,
    Submit,
    Withdraw,
)

__all__ = ["Dispatcher"]

# Milliseconds after which a robot may send a long message again that was refused because the decoder thread
# has too much to decode: a message that inflates to the greatest size is decoded in this time.
_DECODER_RETRY_MS = 500.0
# After a message that could not be decoded, its socket is not read for this many seconds, multiplied by the
# number of such messages on the connection.
_BAD_MESSAGE_PAUSE_S = 0.1
# At most this many undecodable messages with a readable id count for that pause, so that they cause no more
# than 0.5 s: clients take 1 s without a message for a lost connection.
_MAX_REFUSED = 5
# Gauges of a server without jobs: alarms read them of every server.
_NO_JOBS = {"jobs": 0.0, "jobs_pending": 0.0}


class Dispatcher:
    """The connections of one worker: receives their messages, and submits their commands to queues."""

    def __init__(
        self,
        context: WorkerContext,
        *,
        answers: Answers,
        token_watch: TokenWatch,
        queues: Sequence[CommandQueue] = (),
        updates: LiveMapRouter | None = None,
    ) -> None:
        """Have no connection yet; `start` begins to close idle ones.

        Args:
            context: The settings, clocks, event loop and log of the worker.
            answers: Computes and sends answers; its registry has the services that this process runs.
            token_watch: Closes connections whose token is no longer valid; its set of connections is used
                here, too.
            queues: The queues before the queue of stateless services; the first queue that offers a service
                gets its commands.
            updates: Handles subscriptions to live maps; one of *queues*, or None if live maps are off.
        """
        settings = context.settings
        self.context = context
        self.connections = token_watch.connections
        self.admission = Admission(settings.session)
        self.rates = self.admission.rates
        self.decoder = DecoderThread(context.loop.call_soon_threadsafe, context.crash, self._log_defect)
        self.stateless = StatelessQueue(context, answers)
        self._queues: tuple[CommandQueue, ...] = (*queues, self.stateless)
        self._answers = answers
        self._updates = updates
        self._token_watch = token_watch
        self._names = frozenset(service.name for service in answers.registry)
        self._codecs: dict[str, Codec] = {
            name: make_server_codec(name, settings.session, read_first=pnp_reader(answers.registry, name))
            for name in CODECS
        }
        self._answer_timeout_s = settings.session.answer_timeout_s
        self._move: tuple[str, float] | None = None
        now = context.clocks.monotonic()
        self._idle_timeouts = IdleTimeouts(settings.session, now)
        self._lag_s = 0.0

    def start(self) -> None:
        """Begin to check periodically for idle connections, and to close them."""
        now = self.context.clocks.monotonic()
        self.context.loop.call_later(self._idle_timeouts.until_tick_s(now), self._tick)

    @property
    def held(self) -> int:
        """Number of commands, in all queues, that must be answered before the worker exits."""
        return sum(queue.held for queue in self._queues)

    def connect(self, wire: Wire, accepted: Accepted, number: int = 0) -> RobotConnection:
        """Return a new connection for an accepted handshake, after all queues were notified of it.

        *number* is the number of the socket on this server, in the order of acceptance.
        """
        now = self.context.clocks.monotonic()
        expires_s = (
            None if accepted.expires_s is None else now + accepted.expires_s - self.context.clocks.wall()
        )
        session: ServerSession | None = None
        if accepted.codec:
            session = ServerSession(
                codec=self._codecs[accepted.codec],
                robot=accepted.robot.name,
                server=self.context.server_id,
                session=self.context.new_session_id(),
                limits=self.context.settings.session,
                burst=self.context.settings.burst,
            )
            session.ends_s = expires_s
            session.tenant = accepted.robot.tenant
            session.scopes = () if accepted.claims is None else accepted.claims.scopes
        connection = RobotConnection(
            self.context, wire, session, accepted, receive=self._receive, now=now, number=number
        )
        self.connections.add(connection)
        self._token_watch.watch(connection, expires_s)
        for queue in self._queues:
            queue.enter(connection)
        return connection

    def _log_defect(self, error: Exception) -> None:
        text = "".join(traceback.format_exception(error))
        self.context.log.error("defect", traceback=text)

    def disconnect(self, connection: RobotConnection) -> None:
        """Forget a connection whose socket was closed, and drop those of its commands that wait."""
        connection.end()
        self._token_watch.forget(connection)
        if connection in self.connections:
            self.connections.discard(connection)
            for queue in self._queues:
                for queued in queue.leave(connection):
                    service = self._answers.label(queued.command.service)
                    if not connection.is_synthetic:
                        self.context.metrics.requests[service, "disconnected"] += 1
        if connection.is_shown:
            self.context.log.info("robot-offline", robot=connection.robot)

    def _greet(self, connection: RobotConnection, now: float) -> None:
        """Report that a robot sent its Hello; if this server drains, ask it to move to another server."""
        if connection.is_shown:
            self.context.log.info("robot-online", robot=connection.robot)
        self._token_watch.report_hello(connection)
        if self._move is not None:
            connection.move(*self._move, now)

    def move_all(self, reason: str, within_ms: float) -> None:
        """Ask every robot to move to another server within *within_ms*, because this server drains.

        Robots that connect later are asked at their Hello.
        """
        self._move = (reason, within_ms)
        for queue in self._queues:
            queue.give_up()
        now = self.context.clocks.monotonic()
        for connection in list(self.connections):
            connection.move(reason, within_ms, now)

    def close_all(self) -> None:
        """Close every socket, and all queues.

        Commands that wait or run get no answer, so the caller first waits until `held` is 0.
        """
        for connection in list(self.connections):
            connection.close(CLOSE_GOING_AWAY, "leaving")
        self.decoder.close()
        for queue in self._queues:
            queue.close()

    def _receive(self, connection: RobotConnection, session: ServerSession, data: bytes, now: float) -> None:
        """Decode one whole message, and do what it asks for, such as to submit its command.

        A short message is decoded at once, a long one in the decoder thread.  Two kinds of messages are
        refused undecoded: those that `_refuse_unread` refuses for the robot's rate or the server's overload,
        and long ones for which the decoder thread has too much to decode.
        """
        if session.state == "open" and self._refuse_unread(connection, session, data, now):
            return
        state, suspicion = session.state, session.suspicion
        decoder, decisions = self.decoder, None
        if len(data) <= decoder.short_bytes:
            decisions = session.receive_short(data, now, decoder.short_inflated_bytes)
        if decisions is not None and len(decisions) == 1 and type(decisions[0]) is Submit:
            command = decisions[0].command
            connection.tap.observe_command(data, command)
            self.submit(connection, command, len(data), now)
        elif decisions is not None:
            self._follow(connection, session, decisions, len(data), now, state, suspicion)
        elif self.admission.may_wait(len(data), decoder.unread_bytes, suspicion):
            self._decode_in_thread(connection, session, data, now)
        else:
            self._answers.refuse_unread(
                connection, peek(session.codec, data), len(data), DECODER_FULL, _DECODER_RETRY_MS
            )

    def _refuse_unread(
        self, connection: RobotConnection, session: ServerSession, data: bytes, now: float
    ) -> bool:
        """Refuse the message *data* without decoding it, and return True; return False if it may be decoded.

        The connection of a robot that ignored many refusals for its rate is closed.
        """
        answers = self._answers
        codec = session.codec
        # 1. The rate of the robot.
        retry_ms = self.rates.retry_after_ms(connection.robot, now)
        if retry_ms == CUT_OFF:
            self.context.metrics.shed["rate"] += 1
            self.context.log.warning("cut-off", robot=connection.robot, reason="rate")
            connection.close(CLOSE_RATE, "rate")
            return True
        if retry_ms:
            answers.refuse_unread(connection, peek(codec, data), len(data), self.admission.too_fast, retry_ms)
            return True
        # 2. The overload of the server, or the rest of a pause; a robot that ignores pauses is not refused.
        scheduler = self.stateless.scheduler
        if connection.ignores_pauses or not scheduler.waiting:
            return False
        early_s = max(0.0, connection.paused_until_s - now)
        pause_s = early_s or scheduler.unread_pause_s(connection.robot, connection.allowed_s)
        # 3. Only commands to stateless services are refused, because the overload is that of their queue.
        envelope = peek(codec, data) if pause_s else None
        if envelope is None or self._queue_of(envelope.service) is not self.stateless:
            return False
        if early_s:
            connection.note_early()
        else:
            connection.pause(pause_s, now)
        answers.refuse_unread(connection, envelope, len(data), TOO_LATE, 1e3 * pause_s)
        return True

    def _decode_in_thread(
        self, connection: RobotConnection, session: ServerSession, data: bytes, now: float
    ) -> None:
        """Have *data* decoded in the decoder thread, and defer the robot's further messages until then."""
        state, suspicion = session.state, session.suspicion

        def follow_decoded(message: FromRobot | ProtocolError) -> None:
            decisions = session.take(message, now, data)
            self._follow(connection, session, decisions, len(data), now, state, suspicion)

        connection.defer()
        self.decoder.begin(
            session.codec, data, number=connection.number, suspicion=suspicion,
            done=lambda message: connection.resume(lambda: follow_decoded(message)),
        )  # fmt: skip

    def _follow(
        self,
        connection: RobotConnection,
        session: ServerSession,
        decisions: list[Decision],
        size_bytes: int,
        now: float,
        state: str,
        suspicion: int,
    ) -> None:
        """Execute the *decisions* of the session about one message of *size_bytes*.

        Then pause reading if the message could not be decoded, or greet the robot if it was its Hello.
        *state* and *suspicion* are those of the session before the message.
        """
        for decision in decisions:
            self._execute(connection, decision, size_bytes, now)
        if session.bad_messages > MAX_BAD_MESSAGES:
            self.context.log.warning("cut-off", robot=connection.robot, reason="bad-messages")
            self.rates.ban(connection.robot, now)
        if connection.is_closing:
            return
        if session.suspicion > suspicion:
            # Refusing a bad message costs as much as decoding a good one, so the pauses grow with each.
            self.context.metrics.shed["bad-message"] += 1
            counted = session.bad_messages + min(session.refused_commands, _MAX_REFUSED)
            connection.read_rarely(counted * _BAD_MESSAGE_PAUSE_S)
        elif state == "opening" and session.state == "open":
            self._greet(connection, now)

    def _execute(self, connection: RobotConnection, decision: Decision, size_bytes: int, now: float) -> None:
        """Carry out one decision of the session: submit, write, renew, cancel, close or subscribe."""
        match decision:
            case Submit():
                self.submit(connection, decision.command, size_bytes, now)
            case Send():
                connection.write(decision.data)
                if isinstance(decision, SendRefusal):
                    self._answers.note_undecoded(connection, decision.failure, size_bytes)
            case Renewal():
                self._token_watch.renew(connection, decision.token)
            case Withdraw():
                for queue in self._queues:
                    queue.withdraw(connection, decision.id)
            case Close():
                connection.close(decision.code, decision.reason)
            case BeginUpdates():
                self._subscribe(connection, decision.id, decision.topic)
            case EndUpdates():
                if self._updates is not None:
                    self._updates.unsubscribe(connection, decision.id)

    def submit(self, connection: RobotConnection, command: Command, size_bytes: int, now: float) -> None:
        """Pass one command to the first queue that offers its service, or send a refusal.

        A cheap command on an idle server is answered at once.

        Args:
            connection: The connection of the robot.
            command: The decoded command.
            size_bytes: Length of the message on the wire.
            now: Time of arrival, monotonic seconds.
        """
        deadline_ms = command.deadline_ms
        allowed_s = self._answer_timeout_s if deadline_ms is None else deadline_ms / 1e3
        connection.allowed_s = allowed_s
        queued = QueuedCommand(connection, connection.robot, command, size_bytes, now, now + allowed_s)
        if self.stateless.runs_at_once(queued):
            return
        queue = self._queue_of(command.service)
        claims = None if queue is not None and queue.checks_scope else connection.claims
        is_held = connection.ignores_pauses and queue is self.stateless
        backlog = QueueBacklog() if queue is None or is_held else queue.backlog(queued)
        refusal = self.admission.refusal(queued, claims, backlog)
        if refusal is not None:
            if queue is self.stateless and isinstance(refusal.error, Busy):
                connection.pause(1e-3 * (refusal.error.retry_after_ms or 0.0), now)
            self._answers.send_refusal(refusal, now)
        elif queue is not None:
            if is_held:
                connection.hold_until_answered(command.id)
            queue.submit(queued, now)
        elif command.service in self._names:
            error = UnknownService(
                f"this server cannot run {command.service!r}", hint="choose a stateless service"
            )
            self._answers.send_refusal(RefusedCommand(queued, error, "kind"), now)
        else:
            self._answers.send(self._answers.compute(queued), now)

    def _subscribe(self, connection: RobotConnection, identity: int, topic: str) -> None:
        """Begin to send the updates of *topic* to the subscription *identity*, or refuse the subscription."""
        if self._updates is not None:
            self._updates.subscribe(connection, identity, topic)
        else:
            error = NotFound("this server has no live maps", hint="ask the operator to switch live maps on")
            connection.refuse_updates(identity, error)

    def snapshot(self) -> dict[str, Any]:
        """Return counters, gauges and sections of this worker's report; set the event loop's lag to 0."""
        reports = [queue.report() for queue in self._queues]
        metrics = self.context.metrics
        gauges = {
            "robots": float(sum(not connection.is_synthetic for connection in self.connections)),
            "loop_lag_s": self._lag_s,
            "cpu_s": self.context.clocks.cpu(),
            "log_lines_dropped": float(self.context.log.dropped),
            **_NO_JOBS,
            "recording_dropped": float(self.context.tap.dropped),
        }
        sections: dict[str, Any] = {}
        for report in reports:
            gauges |= report.gauges
            sections |= report.sections
            for kind, cpu_s in report.cpu_s.items():
                metrics.set_cpu(kind, cpu_s)
        metrics.gauges = gauges
        self._lag_s = 0.0
        return {**metrics.snapshot(), **sections}

    def _queue_of(self, service: str) -> CommandQueue | None:
        """Return the first queue that offers *service*, None if this server does not offer the service."""
        for queue in self._queues:
            if queue.offers(service):
                return queue
        return None

    def _tick(self) -> None:
        """Close idle connections, measure how late the event loop was, and plan the next tick."""
        now = self.context.clocks.monotonic()
        self._lag_s = max(self._lag_s, -self._idle_timeouts.until_tick_s(now))
        self._idle_timeouts.close_idle(self.connections, now)
        self.context.loop.call_later(self._idle_timeouts.until_tick_s(now), self._tick)
