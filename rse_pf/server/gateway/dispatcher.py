"""Bring the commands of all connections of one worker to their queues.

Frames come in through `RobotConnection.receive_frame`, and bytes leave through a `Wire`: no socket library
is known here.  Each queue (`CommandQueue`) answers what it took.
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from typing import Any

from rse_pf.errors import Busy, NotFound, UnknownService
from rse_pf.server.gateway.admission import DECODER_FULL, TOO_FAST, TOO_LATE, Admission
from rse_pf.server.gateway.answers import Answers
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.decoder_thread import DecoderThread
from rse_pf.server.gateway.handshake import Accepted
from rse_pf.server.gateway.idle_timeouts import IdleTimeouts
from rse_pf.server.gateway.rate_limits import CUT_OFF
from rse_pf.server.gateway.stateless_queue import StatelessQueue
from rse_pf.server.gateway.token_watch import TokenWatch
from rse_pf.server.live_map.router import LiveMapRouter
from rse_pf.server.ports import Wire, WorkerContext
from rse_pf.server.scheduling.command_queue import CommandQueue
from rse_pf.server.scheduling.scheduler import QueueBacklog, QueuedCommand, RefusedCommand
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import CODECS, Codec, Command, Failure
from rse_pf.wire.envelope import peek
from rse_pf.wire.server_codec import make_server_codec
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_RATE, ServerSession

__all__ = ["Dispatcher"]

_DECODER_RETRY_MS = 500.0
_NO_JOBS = {"jobs": 0.0, "jobs_pending": 0.0}
"""Alarms read these gauges of every server."""


class Dispatcher:
    """All connections of one worker and the commands that they sent."""

    def __init__(
        self,
        context: WorkerContext,
        *,
        answers: Answers,
        token_watch: TokenWatch,
        queues: Sequence[CommandQueue] = (),
        updates: LiveMapRouter | None = None,
    ) -> None:
        """Take no connection yet; `start` begins to look for idle ones.

        Args:
            context: The settings, clocks, event loop and log of the worker.
            answers: Computes and sends answers; its registry names the services of this process.
            token_watch: Ends connections whose token is no longer valid; the connections are shared with it.
            queues: Where commands wait, beside that of stateless services; the first that offers a service
                takes its commands.
            updates: Takes subscriptions to live maps; one of *queues*, or None where they are off.
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
        """Begin to look for idle connections."""
        now = self.context.clocks.monotonic()
        self.context.loop.call_later(self._idle_timeouts.until_tick_s(now), self._tick)

    @property
    def held(self) -> int:
        """Commands that must be answered before the worker ends."""
        return sum(queue.held for queue in self._queues)

    def connect(self, wire: Wire, accepted: Accepted, number: int = 0) -> RobotConnection:
        """Return a new connection for a robot whose handshake is done; *number* says which socket it is."""
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
        connection = RobotConnection(self, wire, session, accepted, now=now, number=number)
        self.connections.add(connection)
        self._token_watch.watch(connection, expires_s)
        for queue in self._queues:
            queue.enter(connection)
        return connection

    def _log_defect(self, error: Exception) -> None:
        text = "".join(traceback.format_exception(error))
        self.context.log.error("defect", traceback=text)

    def disconnect(self, connection: RobotConnection) -> None:
        """Forget a connection whose socket ended, and what it still waited for."""
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

    def greet(self, connection: RobotConnection, now: float) -> None:
        """Note that a robot said Hello; while the server leaves, ask the robot to move at once."""
        if connection.is_shown:
            self.context.log.info("robot-online", robot=connection.robot)
        self._token_watch.report_hello(connection)
        if self._move is not None:
            connection.move(*self._move, now)

    def move_all(self, reason: str, within_ms: float) -> None:
        """Ask every robot, now and from now on, to leave for another server."""
        self._move = (reason, within_ms)
        for queue in self._queues:
            queue.give_up()
        now = self.context.clocks.monotonic()
        for connection in list(self.connections):
            connection.move(reason, within_ms, now)

    def close_all(self) -> None:
        """Close every socket; what is held is lost, so wait for `held` to be 0 first."""
        for connection in list(self.connections):
            connection.close(CLOSE_GOING_AWAY, "leaving")
        self.decoder.close()
        for queue in self._queues:
            queue.close()

    def refuse_unread(
        self, connection: RobotConnection, session: ServerSession, data: bytes, now: float
    ) -> bool:
        """Refuse the message *data* for a fraction of what decoding it costs; False if it must be decoded."""
        answers = self._answers
        codec = session.codec
        retry_ms = self.rates.retry_after_ms(connection.robot, now)
        if retry_ms == CUT_OFF:
            self.context.metrics.shed["rate"] += 1
            self.context.log.warning("cut-off", robot=connection.robot, reason="rate")
            connection.close(CLOSE_RATE, "rate")
            return True
        if retry_ms:
            answers.refuse_unread(connection, peek(codec, data), len(data), TOO_FAST, retry_ms)
            return True
        scheduler = self.stateless.scheduler
        if connection.ignores_pauses or not scheduler.waiting:
            return False
        early_s = max(0.0, connection.paused_until_s - now)
        pause_s = early_s or scheduler.unread_pause_s(connection.robot, connection.allowed_s)
        envelope = peek(codec, data) if pause_s else None
        if envelope is None or self._queue_of(envelope.service) is not self.stateless:
            return False
        if early_s:
            connection.note_early()
        else:
            connection.pause(pause_s, now)
        answers.refuse_unread(connection, envelope, len(data), TOO_LATE, 1e3 * pause_s)
        return True

    def refuse_long(self, connection: RobotConnection, session: ServerSession, data: bytes) -> bool:
        """Refuse a message that is too long for the event loop; False if the decoder thread may take it."""
        may_wait = self.admission.may_wait(len(data), self.decoder.unread_bytes, session.suspicion)
        if not may_wait:
            envelope = peek(session.codec, data)
            self._answers.refuse_unread(connection, envelope, len(data), DECODER_FULL, _DECODER_RETRY_MS)
        return not may_wait

    def note_undecoded(self, connection: RobotConnection, failure: Failure, size_bytes: int) -> None:
        """Count and log a message of *size_bytes* that was answered with *failure* instead of decoded."""
        self._answers.note_undecoded(connection, failure, size_bytes)

    def submit(self, connection: RobotConnection, command: Command, size_bytes: int, now: float) -> None:
        """Admit one command to the queue of its service, or refuse it."""
        deadline_ms = command.deadline_ms
        allowed_s = self._answer_timeout_s if deadline_ms is None else deadline_ms / 1e3
        connection.allowed_s = allowed_s
        queued = QueuedCommand(connection, connection.robot, command, size_bytes, now, now + allowed_s)
        if self.stateless.runs_at_once(queued):
            return
        queue = self._queue_of(command.service)
        judges_itself = queue is not None and queue.judges_scope
        claims = None if judges_itself else connection.claims
        is_held = connection.ignores_pauses and queue is self.stateless
        backlog = QueueBacklog() if queue is None or is_held else queue.backlog(queued)
        refusal = self.admission.judge(queued, claims, backlog)
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

    def withdraw(self, connection: RobotConnection, command_id: int) -> None:
        """Cancel a command in the queue that has it."""
        for queue in self._queues:
            queue.withdraw(connection, command_id)

    def subscribe(self, connection: RobotConnection, identity: int, topic: str) -> None:
        """Begin the updates of *topic* for the subscription *identity*, or refuse it."""
        if self._updates is not None:
            self._updates.subscribe(connection, identity, topic)
        else:
            error = NotFound("this server offers no updates", hint="the operator has switched live maps off")
            connection.refuse_updates(identity, error)

    def unsubscribe(self, connection: RobotConnection, identity: int) -> None:
        """End a subscription."""
        if self._updates is not None:
            self._updates.unsubscribe(connection, identity)

    def renew(self, connection: RobotConnection, token: str) -> None:
        """Judge a fresh token of a live connection."""
        self._token_watch.renew(connection, token)

    def snapshot(self) -> dict[str, Any]:
        """Return the numbers of this worker for /metrics and /status."""
        reports = [queue.report() for queue in self._queues]
        metrics, tap = self.context.metrics, self.context.tap
        gauges = {
            "robots": float(sum(not connection.is_synthetic for connection in self.connections)),
            "loop_lag_s": self._lag_s,
            "cpu_s": self.context.clocks.cpu(),
            "log_lines_dropped": float(self.context.log.dropped),
            **_NO_JOBS,
            **({} if tap is None else {"recording_dropped": float(tap.dropped)}),
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
        """Return the queue of *service*, None if this server does not offer the service."""
        for queue in self._queues:
            if queue.offers(service):
                return queue
        return None

    def _tick(self) -> None:
        now = self.context.clocks.monotonic()
        self._lag_s = max(self._lag_s, -self._idle_timeouts.until_tick_s(now))
        self._idle_timeouts.close_idle(self.connections, now)
        self.context.loop.call_later(self._idle_timeouts.until_tick_s(now), self._tick)
