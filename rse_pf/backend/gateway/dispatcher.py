"""Bring the commands of all connections of one worker to a service, and their answers back.

Frames come in through `RobotConnection.receive_frame`, and bytes leave through a `Wire`: no socket library
is known here.  Nothing but the computation of an answer (`Answers.compute`) runs outside of the event
loop.
"""

from __future__ import annotations

import math
from asyncio import TimerHandle
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rse_pf.backend.compute.lane import ComputeLane
from rse_pf.backend.gateway.admission import DECODER_FULL, TOO_FAST, TOO_LATE, Admission, UnreadRefusal
from rse_pf.backend.gateway.answers import Answers, EncodedAnswer
from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.gateway.decoder_thread import DecoderThread
from rse_pf.backend.gateway.handshake import Accepted
from rse_pf.backend.gateway.idle_timeouts import IdleTimeouts
from rse_pf.backend.gateway.rate_limits import CUT_OFF
from rse_pf.backend.gateway.token_watch import TokenWatch
from rse_pf.backend.jobs.manager import JobManager
from rse_pf.backend.jobs.queue import has_jobs
from rse_pf.backend.live_map.router import LIVE_SERVICES, LiveMapRouter
from rse_pf.backend.metrics import LongestRecently
from rse_pf.backend.ports import Wire, WorkerContext
from rse_pf.backend.rosbridge.codec import CODEC as ROSBRIDGE
from rse_pf.backend.rosbridge.codec import RosbridgeCodec
from rse_pf.backend.rosbridge.session import RosbridgeSession
from rse_pf.backend.rosbridge.topics import RosbridgeTopics
from rse_pf.backend.sandbox.reloading import ReloadingSandboxes
from rse_pf.backend.scheduling.cpu_throttle import BATCH_S, CpuThrottle
from rse_pf.backend.scheduling.scheduler import (
    INLINE_BYTES,
    QUEUE_TARGET_S,
    QueueBacklog,
    QueuedCommand,
    RefusedCommand,
    Scheduler,
)
from rse_pf.backend.scheduling.thread_pool import SOLVER_THREADS, SolverThreads
from rse_pf.errors import NotFound, UnknownService
from rse_pf.identity import RobotId
from rse_pf.service import Registry
from rse_pf.services.pnp import wire_types
from rse_pf.silent_connections import SilentConnections
from rse_pf.wire import CODECS, Codec, Command, Failure, make_codec
from rse_pf.wire.envelope import Envelope, peek
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_RATE, CLOSE_TOKEN_OVER, ServerSession

__all__ = [
    "CommandQueues",
    "ComputeQueue",
    "Dispatcher",
    "JobQueue",
    "LiveMapQueue",
    "NoQueue",
    "SandboxQueue",
    "TopicQueue",
]

_DECODER_RETRY_MS = 500.0
_UNMEASURED_TURN_S = 0.125
"""Sandboxes and jobs do not measure their turns: a robot whose queue is full waits this long for each of
them."""
_TOKEN_S = 3.0
"""Time from the handshake to the token of a rosbridge client that showed none in it."""


class NoQueue:
    """Stands for the sandboxes of a server without installed services, and for queues that are switched
    off."""

    held = 0
    known = 0
    waiting = 0
    max_delay_s = math.inf

    def offers(self, service: str) -> bool:
        """Return False: no service is offered, so that nothing is ever submitted."""
        return False

    def waiting_of(self, robot: RobotId) -> int:
        """Return 0."""
        return 0

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return zeros."""
        return QueueBacklog()

    def leave(self, owner: object) -> list[QueuedCommand]:
        """Return nothing."""
        return []

    def report(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return nothing."""
        return {}

    def subscribe(self, connection: RobotConnection, identity: int, topic: str) -> None:
        """Refuse every topic."""
        error = NotFound("this server offers no updates", hint="the operator has switched live maps off")
        connection.refuse_updates(identity, error)

    def execute(self, connection: RobotConnection, session: RosbridgeSession, op: Any) -> None:
        """Do nothing: without rosbridge nobody asks."""

    def ignore(self, *_: Any) -> None:
        """Do nothing."""

    submit = withdraw = give_up = close = note_refused = unsubscribe = ignore
    add_connection = remove_connection = forget_connection = forget_client = left = ignore


ComputeQueue = ComputeLane[EncodedAnswer] | NoQueue
SandboxQueue = ReloadingSandboxes | NoQueue
JobQueue = JobManager | NoQueue
LiveMapQueue = LiveMapRouter | NoQueue
TopicQueue = RosbridgeTopics | NoQueue


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandQueues:
    """Where the commands of one worker wait, and who takes the operations on topics.

    Attributes:
        scheduler: The queue of stateless commands.
        compute: Runs limited services.
        sandboxes: Runs installed services.
        jobs: Runs long services.
        live_maps: Takes commands and subscriptions to live maps.
        topics: Takes the operations of rosbridge clients.
    """

    scheduler: Scheduler
    compute: ComputeQueue = field(default_factory=NoQueue)
    sandboxes: SandboxQueue = field(default_factory=NoQueue)
    jobs: JobQueue = field(default_factory=NoQueue)
    live_maps: LiveMapQueue = field(default_factory=NoQueue)
    topics: TopicQueue = field(default_factory=NoQueue)


class Dispatcher:
    """All connections of one worker and the commands that they sent."""

    def __init__(
        self,
        context: WorkerContext,
        *,
        registry: Registry,
        admission: Admission,
        queues: CommandQueues,
        answers: Answers,
        token_watch: TokenWatch,
    ) -> None:
        """Take no connection yet; start the solver threads and the timer of idle connections.

        Args:
            context: The settings, clocks, event loop and log of the worker.
            registry: The stateless and long services.
            admission: Decides which commands are taken.
            queues: Where the taken commands wait.
            answers: Computes and sends answers.
            token_watch: Ends connections whose token is no longer valid; the connections are shared with it.
        """
        settings = context.settings
        monotonic = context.clocks.monotonic
        self.context = context
        self.connections = token_watch.connections
        self.rates = admission.rates
        self.decoder = DecoderThread(context.loop.call_soon_threadsafe)
        self._registry = registry
        self._admission = admission
        self._scheduler = queues.scheduler
        self._throttle = CpuThrottle(settings.serving.emulated_cores, now=monotonic(), cpu=context.clocks.cpu)
        self._answers = answers
        self._compute = queues.compute
        self._sandboxes = queues.sandboxes
        self._jobs = queues.jobs
        self._live_maps = queues.live_maps
        self._topics = queues.topics
        self._token_watch = token_watch
        self._codecs: dict[str, Codec] = {
            name: make_codec(name, settings.session, pnp=wire_types(registry)) for name in CODECS
        }
        serving = settings.serving
        self._awaited: SilentConnections[RobotConnection] = SilentConnections(
            call_later=context.loop.call_later, seconds=_TOKEN_S,
            most=serving.max_unauthenticated, most_per_source=serving.max_unauthenticated_per_source,
        )  # fmt: skip
        self._threads = SolverThreads(
            SOLVER_THREADS,
            answers.compute,
            lambda answer: context.loop.call_soon_threadsafe(self._on_computed, answer),
        )
        of_kind = {
            "stateless": "scheduler",
            "long": "jobs" if has_jobs(settings) else "refused",
        }
        self._queues = {
            service.name: "compute"
            if queues.compute.offers(service.name)
            else of_kind.get(service.kind, "refused")
            for service in registry
        }
        self._queues |= {name: "live-maps" for name in LIVE_SERVICES if queues.live_maps.offers(name)}
        self._cheap = frozenset(
            service.name
            for service in registry
            if service.cheap
            and self._queue_of(service.name) == "scheduler"
            and service.name not in answers.with_objects
        )
        """Services that `_runs_at_once` may run: in the event loop, without asking a store before."""
        self._monotonic = monotonic
        self._answer_timeout_s = settings.session.answer_timeout_s
        self._waits = LongestRecently()
        self._ran_inline = False
        self._throttle_timer: TimerHandle | None = None
        self._sweep_timer: TimerHandle | None = None
        self._batched: list[tuple[RobotConnection, Codec, Envelope, UnreadRefusal, float, int]] = []
        self._move: tuple[str, float] | None = None
        self._idle_timeouts = IdleTimeouts(settings.session, monotonic())
        self._lag_s = 0.0
        context.loop.call_later(self._idle_timeouts.until_tick_s(monotonic()), self._tick)

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        held = self._scheduler.waiting + self._scheduler.running
        return held + self._compute.held + self._sandboxes.held + self._live_maps.held

    def connect(self, wire: Wire, accepted: Accepted, number: int = 0) -> RobotConnection:
        """Return a new connection for a robot whose handshake is done; *number* says which socket it is."""
        now = self.context.clocks.monotonic()
        expires_s = (
            None if accepted.expires_s is None else now + accepted.expires_s - self.context.clocks.wall()
        )
        session: ServerSession | None = None
        if accepted.codec == ROSBRIDGE:
            session = self._rosbridge_session(accepted)
        elif accepted.codec:
            session = ServerSession(
                codec=self._codecs[accepted.codec],
                robot=accepted.robot.name,
                server=self.context.server_id,
                session=self.context.new_session_id(),
                limits=self.context.settings.session,
                burst=self.context.settings.burst,
            )
            session.ends_s = expires_s
        connection = RobotConnection(self, wire, session, accepted, now=now, number=number)
        if accepted.awaits_token:
            self._awaited.enter(connection, partial(_close_without_token, connection), accepted.source)
        else:
            self._add_connection(connection, expires_s, now)
        return connection

    def _rosbridge_session(self, accepted: Accepted) -> RosbridgeSession:
        limits = self.context.settings.session
        return RosbridgeSession(
            codec=RosbridgeCodec(limits, self._codecs["json"]),
            server=self.context.server_id, limits=limits, is_open=not accepted.awaits_token,
        )  # fmt: skip

    def _add_connection(self, connection: RobotConnection, expires_s: float | None, now: float) -> None:
        """Add a connection whose robot is known; its token ends at *expires_s* (monotonic clock, s)."""
        self.connections.add(connection)
        self._token_watch.watch(connection, expires_s)
        self._sandboxes.add_connection(connection.robot)
        if connection.may_move:  # a rosbridge client says no Hello
            self.greet(connection, now)

    def authenticate(self, connection: RobotConnection, token: str) -> None:
        """Judge the token of a rosbridge client that showed none in its handshake."""
        source = self._awaited.leave(connection)
        session = connection.session
        clocks = self.context.clocks
        if source is None or not isinstance(session, RosbridgeSession):
            return
        now = clocks.monotonic()
        accepted = self._token_watch.judge(token, connection.robot, source)
        if accepted is None or self.rates.banned_s(accepted.robot, now) > 0:
            for send in session.token_refusal():
                connection.write(send.data)
            connection.close(CLOSE_TOKEN_OVER if accepted is None else CLOSE_RATE, "unauthenticated")
            return
        connection.robot, connection.claims = accepted.robot, accepted.claims
        session.open()
        ends_s = accepted.expires_s
        self._add_connection(connection, None if ends_s is None else now + ends_s - clocks.wall(), now)

    def ask_topics(self, connection: RobotConnection, op: Any) -> None:
        """Execute an operation of a rosbridge client on its topics."""
        if isinstance(connection.session, RosbridgeSession):
            self._topics.execute(connection, connection.session, op)

    def disconnect(self, connection: RobotConnection) -> None:
        """Forget a connection whose socket ended, and what it still waited for."""
        if connection in self.connections:
            self._sandboxes.remove_connection(connection.robot)
        self.connections.discard(connection)
        self._token_watch.forget(connection)
        self._jobs.forget_connection(connection)
        self._live_maps.left(connection)
        self._topics.forget_client(connection)
        self._awaited.leave(connection)
        for queued in self._scheduler.leave(connection) + self._compute.leave(connection):
            self.context.metrics.requests[self._answers.label(queued.command.service), "disconnected"] += 1
        self.context.log.debug("disconnected", robot=connection.robot)

    def greet(self, connection: RobotConnection, now: float) -> None:
        """Note that a robot said Hello; while the server leaves, ask the robot to move at once."""
        self.context.log.debug("connected", robot=connection.robot)
        self._token_watch.report_hello(connection)
        if self._move is not None:
            connection.move(*self._move, now)

    def move_all(self, reason: str, within_ms: float) -> None:
        """Ask every robot, now and from now on, to leave for another server."""
        self._move = (reason, within_ms)
        self._jobs.give_up()
        self._live_maps.give_up()
        now = self.context.clocks.monotonic()
        for connection in list(self.connections):
            connection.move(reason, within_ms, now)

    def close_all(self) -> None:
        """Close every socket; what is held is lost, so wait for `held` to be 0 first."""
        for connection in list(self.connections):
            connection.close(CLOSE_GOING_AWAY, "leaving")
        self._awaited.cut_all()
        self._threads.close()
        self.decoder.close()
        self._jobs.close()
        self._compute.close()
        self._sandboxes.close()

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
            answers.send_unread_refusal(connection, codec, peek(codec, data), TOO_FAST, retry_ms, len(data))
            return True
        if connection.allowed_s is None or not self._scheduler.is_behind:
            return False
        retry_ms = self._scheduler.retry_unread_ms(connection.robot, connection.allowed_s)
        envelope = peek(codec, data) if retry_ms else None
        if envelope is None or self._queue_of(envelope.service) != "scheduler":
            return False
        self._scheduler.note_refused(now)
        if self._throttle_timer is None:
            answers.send_unread_refusal(connection, codec, envelope, TOO_LATE, retry_ms, len(data))
        else:
            if not self._batched:
                self.context.loop.call_later(BATCH_S, self._send_batch)
            self._batched.append((connection, codec, envelope, TOO_LATE, retry_ms, len(data)))
        return True

    def refuse_long(self, connection: RobotConnection, session: ServerSession, data: bytes) -> bool:
        """Refuse a message that is too long for the event loop; False if the decoder thread may take it."""
        may_wait = self._admission.may_wait(len(data), self.decoder.unread_bytes, session.suspicion)
        if not may_wait:
            envelope = peek(session.codec, data)
            self._answers.send_unread_refusal(
                connection, session.codec, envelope, DECODER_FULL, _DECODER_RETRY_MS, len(data)
            )
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
        if self._runs_at_once(queued):
            return
        queue = self._queue_of(command.service)
        turns = self._compute if queue == "compute" else self._scheduler
        # A live map judges the scope by its name.
        claims = None if queue == "live-maps" else connection.claims
        refusal = self._admission.judge(queued, claims, self._backlog(queued, queue), turns.max_delay_s)
        if refusal is not None:
            if refusal.reason == "behind":
                turns.note_refused(now)
            self._answers.send_refusal(refusal, now)
        elif queue == "scheduler":
            self._refuse(self._scheduler.submit(queued), now)
            self._start()
        elif queue == "compute":
            self._compute.submit(queued, now)
        elif queue == "sandboxes":
            self._sandboxes.submit(queued)
        elif queue == "jobs":
            self._jobs.submit(queued)
        elif queue == "live-maps":
            self._live_maps.submit(queued)
        elif queue == "refused":
            error = UnknownService(
                f"this server cannot run {command.service!r}", hint="choose a stateless service"
            )
            self._answers.send_refusal(RefusedCommand(queued, error, "kind"), now)
        else:
            self._answers.send(self._answers.compute(queued), now)

    def withdraw(self, connection: RobotConnection, command_id: int) -> None:
        """Cancel a long command; any other is answered soon in any case."""
        self._jobs.withdraw(connection, command_id)

    def subscribe(self, connection: RobotConnection, identity: int, topic: str) -> None:
        """Begin the updates of *topic* for the subscription *identity*, or refuse it."""
        self._live_maps.subscribe(connection, identity, topic)

    def unsubscribe(self, connection: RobotConnection, identity: int) -> None:
        """End a subscription."""
        self._live_maps.unsubscribe(connection, identity)

    def renew(self, connection: RobotConnection, token: str) -> None:
        """Judge a fresh token of a live connection."""
        self._token_watch.renew(connection, token)

    def snapshot(self) -> dict[str, Any]:
        """Return the numbers of this worker for /metrics and /status."""
        now = self.context.clocks.monotonic()
        oldest_wait_s = self._scheduler.oldest_wait_s(now)
        isolation = self._sandboxes.report()
        self.context.metrics.gauges = {
            "robots": float(len(self.connections)),
            "queue": float(self._scheduler.waiting),
            "queue_oldest_s": oldest_wait_s,
            "queue_ms": max(self._waits.longest_s(now), oldest_wait_s) * 1e3,
            "in_flight": float(self._scheduler.running),
            "loop_lag_s": self._lag_s,
            "cpu_s": self.context.clocks.cpu(),
            "log_lines_dropped": float(self.context.log.dropped),
            "jobs": float(self._jobs.known),
            "jobs_pending": float(self._jobs.waiting),
            **self._compute.report(),
            **self._live_maps.report(),
            **self._topics.report(),
            **({} if self.context.tap is None else {"recording_dropped": float(self.context.tap.dropped)}),
            **({"sandboxes": float(isolation["sandboxes"])} if isolation else {}),
        }
        self._lag_s = 0.0
        for kind, queue in (
            ("sandboxes", self._sandboxes), ("jobs", self._jobs), ("live-maps", self._live_maps)
        ):  # fmt: skip
            self.context.metrics.set_cpu(kind, queue.cpu_by_tenant())
        return {**self.context.metrics.snapshot(), **({"isolation": isolation} if isolation else {})}

    # --- from the queue to an answer -----------------------------------------------------------

    def _runs_at_once(self, queued: QueuedCommand) -> bool:
        """Answer a cheap command of an idle server without a place in the queue; False if it has to be
        queued or refused.

        The shortest way of a command.  It decides, counts and answers as `submit` does for any other.
        """
        service = queued.command.service
        claims = queued.owner.claims
        if (
            self._ran_inline
            or service not in self._cheap
            or queued.size_bytes > INLINE_BYTES
            or self._throttle.is_on
            or (claims is not None and not self._admission.is_in_scope(service, claims))
        ):
            return False
        now = self._monotonic()
        if not self._scheduler.start_unqueued(queued, now):
            return False
        self._waits.note(now - queued.received_s, now)
        self._begin_inline()
        answer = self._answers.compute(queued)
        now = self._monotonic()
        self._scheduler.finish_unqueued(queued, now)
        self._answers.send(answer, now)
        return True

    def _begin_inline(self) -> None:
        """Keep every other command from running in this round of the event loop."""
        self._ran_inline = True
        self.context.loop.call_soon(self._next_round)

    def _start(self) -> None:
        """Start the commands whose turn it is, as many as threads and the throttle allow."""
        scheduler = self._scheduler
        while not self._ran_inline and scheduler.waiting and scheduler.running < SOLVER_THREADS:
            now = self._monotonic()
            wait_s = self._throttle.wait_s(now)
            if wait_s > 0:
                if self._throttle_timer is None:
                    self._throttle_timer = self.context.loop.call_later(wait_s, self._go_on)
                break
            queued, refusals = scheduler.start(now)
            if refusals:
                self._refuse(refusals, now)
            if queued is not None:
                self._waits.note(now - queued.received_s, now)
                self._run(queued)
        if scheduler.waiting and self._sweep_timer is None:
            self._sweep_timer = self.context.loop.call_later(QUEUE_TARGET_S / 2, self._sweep)

    def _run(self, queued: QueuedCommand) -> None:
        """Compute the answer to *queued*; in the event loop only one in each of its rounds.

        Otherwise a slow round would hide the queue in the kernel, where its length cannot be seen.
        """
        command = queued.command
        answers = self._answers
        service = self._registry.get(command.service)
        may_refer = command.service in answers.with_objects
        asks_store = may_refer and answers.objects.has_references(command, service)
        if not asks_store and self._scheduler.runs_inline(
            cheap=service.cheap,
            size_bytes=queued.size_bytes,
        ):
            self._begin_inline()
            self._finish(self._answers.compute(queued))
        else:
            self._threads.run(queued)

    def _on_computed(self, answer: EncodedAnswer) -> None:
        self._finish(answer)
        self._start()

    def _finish(self, answer: EncodedAnswer) -> None:
        now = self._monotonic()
        self._scheduler.done(answer.queued, now)
        self._answers.send(answer, now)

    def _refuse(self, refusals: list[RefusedCommand], now: float) -> None:
        for refusal in refusals:
            self._answers.send_refusal(refusal, now)

    # --- where a command waits -----------------------------------------------------------------

    def _queue_of(self, service: str) -> str:
        """Return the name of the queue of *service*, "" if this server does not offer the service."""
        return "sandboxes" if self._sandboxes.offers(service) else self._queues.get(service, "")

    def _backlog(self, queued: QueuedCommand, queue: str) -> QueueBacklog:
        """Return the commands that would delay *queued* in the queue that it would join."""
        if queue == "scheduler":
            return self._scheduler.backlog(queued)
        if queue == "compute":
            return self._compute.backlog(queued)
        waiting_of = {
            "sandboxes": self._sandboxes.waiting_of,
            "jobs": self._jobs.waiting_of,
            "live-maps": self._live_maps.waiting_of,
        }.get(queue)
        waiting = 0 if waiting_of is None else waiting_of(queued.robot)
        return QueueBacklog(waiting, turn_s=_UNMEASURED_TURN_S)

    # --- timers --------------------------------------------------------------------------------

    def _next_round(self) -> None:
        self._ran_inline = False
        if self._scheduler.waiting:
            self._start()

    def _go_on(self) -> None:
        self._throttle_timer = None
        self._start()

    def _send_batch(self) -> None:
        batched, self._batched = self._batched, []
        for refusal in batched:
            self._answers.send_unread_refusal(*refusal)

    def _sweep(self) -> None:
        self._sweep_timer = None
        now = self.context.clocks.monotonic()
        self._refuse(self._scheduler.sweep(now), now)
        self._start()

    def _tick(self) -> None:
        now = self.context.clocks.monotonic()
        self._lag_s = max(self._lag_s, -self._idle_timeouts.until_tick_s(now))
        self._idle_timeouts.close_idle(self.connections, now)
        self.context.loop.call_later(self._idle_timeouts.until_tick_s(now), self._tick)


def _close_without_token(connection: RobotConnection) -> None:
    if not connection.is_closing:
        connection.close(CLOSE_TOKEN_OVER, "unauthenticated")
