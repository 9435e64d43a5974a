"""The inside of one worker: connections, scheduler and solver threads, without any socket library.

Frames come in through `connection.RobotConnection.frame`, bytes leave through a `Wire`; `dispatch` is the
only way to a service.  Promises that every submitted command gets exactly one answer while its socket
lives, that nothing but `dispatch` and the encoding of its answer runs outside of the event loop, and that
neither payloads nor tokens reach the log.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.gateway.handshake import Accepted
from rse_pf.backend.gateway.idle_timeouts import IdleTimeouts
from rse_pf.backend.gateway.rate_limits import CutOff, RobotRates, TooFast
from rse_pf.backend.log import JsonLog
from rse_pf.backend.metrics import LongestRecently, Metrics
from rse_pf.backend.object_refs import ObjectRefs
from rse_pf.backend.ports import Clocks, Handle, Loop, Wire
from rse_pf.backend.sandbox.manager import SandboxManager
from rse_pf.backend.scheduling.cpu_throttle import CpuThrottle
from rse_pf.backend.scheduling.scheduler import BEHIND, BEHIND_HINT, QueuedCommand, RefusedCommand, Scheduler
from rse_pf.backend.scheduling.thread_pool import Executor, SolverThreads
from rse_pf.config import PlatformSettings
from rse_pf.errors import Busy, Forbidden, InternalError, LimitExceeded, RsePfError, UnknownService
from rse_pf.service import Kind, Registry, Service, dispatch, failure_of
from rse_pf.wire import CODECS, Codec, Command, Failure, Progress, Result, make_codec
from rse_pf.wire.envelope import encode_refusal, peek
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_RATE, ServerSession

if TYPE_CHECKING:
    from rse_pf.backend.gateway.decoder_thread import DecoderThread
    from rse_pf.backend.gateway.token_watch import TokenWatch
    from rse_pf.backend.jobs.manager import JobManager

__all__ = ["Dispatcher"]

_UNKNOWN = "unknown"
_BATCH_S = 0.01
_USUAL = ("ok", Busy.code, "stale")
"""What happens hundreds of times a second: counted, and logged for developers only."""
"""Behind and out of budget, a small server refuses in batches: alone, a refusal costs three times as much."""
_TOO_FAST = "this robot sends more than its rate"
_TOO_FAST_HINT = "send fewer, or have the operator raise session.max_commands_per_s"


@dataclass(frozen=True, slots=True)
class _Outcome:
    job: QueuedCommand
    answer: Result | Failure
    data: bytes


class Dispatcher:
    """All connections of one worker and the work they asked for."""

    def __init__(
        self,
        *,
        settings: PlatformSettings,
        registry: Registry,
        server_id: str,
        clocks: Clocks,
        loop: Loop,
        log: JsonLog,
        new_session_id: Callable[[], str],
        rest: Callable[[float], None],
    ) -> None:
        self.settings = settings
        self._rest = rest
        self.clocks = clocks
        self.metrics = Metrics()
        self.connections: set[RobotConnection] = set()
        self.rates = RobotRates(settings.session)
        self._registry = registry
        self.server_id = server_id
        self._loop = loop
        self._log = log
        self._new_session_id = new_session_id
        self._codecs: dict[str, Codec] = {name: make_codec(name, settings.session) for name in CODECS}
        self._scheduler = Scheduler(settings.serving)
        self._waits = LongestRecently()
        self._gate = CpuThrottle(
            settings.serving.emulated_cores,
            settings.serving.size_burst_ms / 1e3,
            now=clocks.monotonic(),
            cpu_s=clocks.cpu(),
        )
        self._threads = SolverThreads(settings.serving.solver_threads, self._compute, self._from_thread)
        self._executors: dict[Kind, Executor] = {"stateless": self._threads}
        self.environments: SandboxManager | None = None
        """Of installed services; set by whoever can make processes."""
        self.jobs: JobManager | None = None
        """For long services; set by whoever can make processes."""
        self.standing: TokenWatch | None = None
        """What the connections' tokens are worth; set by whoever can hear of it."""
        self.objects = ObjectRefs(None, settings.serving)
        """What payloads may name; set by whoever opens the store."""
        self.reading: DecoderThread | None = None
        """Of long messages; set by whoever has a loop that threads can call."""
        self._gate_timer: Handle | None = None
        self._ran_inline = False
        self._sweep_timer: Handle | None = None
        self._move: tuple[str, float] | None = None
        self._patience = IdleTimeouts(settings.session, clocks.monotonic())
        self._lag_s = 0.0
        loop.call_later(self._patience.left_s(clocks.monotonic()), self._tick)

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        isolated = 0 if self.environments is None else self.environments.held
        return self._scheduler.waiting + self._scheduler.running + isolated

    def connect(self, wire: Wire, admitted: Accepted, number: int = 0) -> RobotConnection:
        """Return the connection of a robot whose handshake is done; *number* says which socket it is."""
        now = self.clocks.monotonic()
        session = None
        if admitted.codec:
            session = ServerSession(
                codec=self._codecs[admitted.codec],
                robot=admitted.robot,
                server=self.server_id,
                session=self._new_session_id(),
                limits=self.settings.session,
            )
        expires_s = None
        if admitted.expires_s is not None:
            expires_s = now + admitted.expires_s - self.clocks.wall()
        connection = RobotConnection(self, wire, session, admitted.robot, now, expires_s)
        connection.tenant, connection.claims, connection.number = admitted.tenant, admitted.claims, number
        if session is not None:
            session.ends_s = expires_s
        self.connections.add(connection)
        if self.standing is not None:
            self.standing.connected(connection)
        if self.environments is not None:
            self.environments.connected(connection.robot)
        return connection

    def disconnect(self, connection: RobotConnection) -> None:
        """Forget a connection whose socket ended, and what it still waited for."""
        if connection in self.connections and self.environments is not None:
            self.environments.disconnected(connection.robot)
        self.connections.discard(connection)
        if self.standing is not None:
            self.standing.left(connection)
        if self.jobs is not None:
            self.jobs.left(connection)
        for job in self._scheduler.leave(connection):
            self.metrics.requests[self._label(job.command.service), "disconnected"] += 1
        self._log.debug("disconnected", robot=connection.robot)

    def welcomed(self, connection: RobotConnection, now: float) -> None:
        """Note that a robot said Hello; while the server leaves, ask the robot to move at once."""
        self._log.debug("connected", robot=connection.robot)
        if self.standing is not None:
            self.standing.arrived(connection)
        if self._move is not None:
            connection.move(*self._move, now)

    def move_all(self, reason: str, within_ms: float) -> None:
        """Ask every robot, now and from now on, to leave for another server."""
        self._move = (reason, within_ms)
        if self.jobs is not None:
            self.jobs.give_up()
        now = self.clocks.monotonic()
        for connection in list(self.connections):
            connection.move(reason, within_ms, now)

    def close_all(self) -> None:
        """Close every socket; what is held is lost, so wait for `held` to be 0 first."""
        for connection in list(self.connections):
            connection.close(CLOSE_GOING_AWAY, "leaving")
        for executor in self._executors.values():
            executor.close()
        if self.jobs is not None:
            self.jobs.close()
        if self.environments is not None:
            self.environments.close()

    def submit(self, connection: RobotConnection, command: Command, size_bytes: int, now: float) -> None:
        """Queue one command, and start what may start."""
        deadline_ms = command.deadline_ms
        allowed_s = self.settings.session.answer_timeout_s if deadline_ms is None else deadline_ms / 1e3
        connection.allowed_s = allowed_s
        job = QueuedCommand(connection, connection.robot, command, size_bytes, now, now + allowed_s)
        if not connection.may_use(command.service):
            forbidden = Forbidden(
                f"this token does not hold the scope services:{command.service}", hint="issue one that does"
            )
            self._refuse([RefusedCommand(job, forbidden, "scope")], now)
            return
        if self.environments is not None and self.environments.offers(command.service):
            self.environments.submit(job)
            return
        service = self._service(command.service)
        if service is None:
            self._answer(self._compute(job), now)
            return
        if service.kind == "long" and self.jobs is not None:
            self.jobs.submit(job)
            return
        if service.kind not in self._executors:
            error = UnknownService(
                f"this server does not run {service.kind} services", hint="choose a stateless service"
            )
            self._refuse([RefusedCommand(job, error, "kind")], now)
            return
        self._refuse(self._scheduler.submit(job, now), now)
        self._start()

    def renew(self, connection: RobotConnection, token: str) -> None:
        """Judge a fresh token of a live connection."""
        if self.standing is not None:
            self.standing.renew(connection, token)
        elif connection.session is not None:
            connection.apply(connection.session.renewed(None), self.clocks.monotonic())

    def withdraw(self, connection: RobotConnection, identity: int) -> None:
        """Take back a long command; any other is answered soon in any case."""
        if self.jobs is not None:
            self.jobs.withdraw(connection, identity)

    def progress(self, connection: RobotConnection, progress: Progress) -> None:
        """Tell a robot that understands it how far its long command is."""
        session = connection.session
        if connection in self.connections and session is not None and session.hears_progress:
            connection.write(session.codec.encode(progress))

    def refuses_unread(self, connection: RobotConnection, codec: Codec, data: bytes, now: float) -> bool:
        """Refuse the command in *data* for a fraction of what reading it costs; False if it must be read."""
        verdict = self.rates.judge((connection.tenant, connection.robot), now)
        if verdict is not None:
            self._too_fast(connection, codec, data, verdict)
            return True
        if connection.allowed_s is None:
            return False
        retry_after_ms = self._scheduler.refuse_unread(connection.robot, connection.allowed_s, now)
        envelope = None if retry_after_ms is None else peek(codec, data)
        if envelope is None or not self._is_stateless(envelope.service):
            return False
        failure = Failure(
            id=envelope.id, code=Busy.code, message=BEHIND, hint=BEHIND_HINT,
            retry_after_ms=retry_after_ms, server=self.server_id,
        )  # fmt: skip
        refusal = encode_refusal(codec, failure)
        self.metrics.shed["unread"] += 1
        self.metrics.answered(envelope.service, Busy.code, 0.0)
        connection.write(refusal)
        if self._log.writes("debug"):
            self._log.debug(
                "command", robot=connection.robot, service=envelope.service, id=envelope.id, trace="",
                code=Busy.code, queue_ms=0.0, compute_ms=0.0, bytes_in=len(data), bytes_out=len(refusal),
            )  # fmt: skip
        return True

    def _too_fast(
        self, connection: RobotConnection, codec: Codec, data: bytes, verdict: TooFast | CutOff
    ) -> None:
        """Tell a robot to slow down, or cut it off; without a line in the log for each refusal."""
        self.metrics.shed["rate"] += 1
        if isinstance(verdict, CutOff):
            self._log.warning("cut-off", robot=connection.robot, reason="rate")
            connection.close(CLOSE_RATE, "rate")
            return
        envelope = peek(codec, data)
        failure = Failure(
            id=None if envelope is None else envelope.id, code=Busy.code, message=_TOO_FAST,
            hint=_TOO_FAST_HINT, retry_after_ms=verdict.retry_after_ms, server=self.server_id,
        )  # fmt: skip
        connection.write(encode_refusal(codec, failure))
        if envelope is not None:
            self.metrics.answered(self._label(envelope.service), Busy.code, 0.0)

    def snapshot(self) -> dict[str, Any]:
        """Return the numbers of this worker for /metrics and /status."""
        now = self.clocks.monotonic()
        self.metrics.gauges = {
            "robots": float(len(self.connections)),
            "queue": float(self._scheduler.waiting),
            "queue_oldest_s": self._scheduler.oldest_wait_s(now),
            "queue_ms": max(self._waits.longest_s(now), self._scheduler.oldest_wait_s(now)) * 1e3,
            "in_flight": float(self._scheduler.running),
            "loop_lag_s": self._lag_s,
            "cpu_s": self.clocks.cpu(),
            "log_lines_dropped": float(self._log.dropped),
        }
        self._lag_s = 0.0
        if self.environments is None:
            return self.metrics.snapshot()
        isolation = self.environments.report()
        self.metrics.gauges["environments"] = float(isolation["environments"])
        return {**self.metrics.snapshot(), "isolation": isolation}

    def answer_isolated(self, job: QueuedCommand, answer: Result | Failure) -> None:
        """Send what an environment came to; it may answer a robot that is gone."""
        now = self.clocks.monotonic()
        if isinstance(answer, Result):
            queue_ms = (job.started_s - job.received_s) * 1e3
            answer = msgspec.structs.replace(answer, queue_ms=queue_ms, received_s=job.received_s, sent_s=now)
        self._answer(self._encoded(job, answer), now)

    # --- from the queue to an answer -----------------------------------------------------------

    def _start(self) -> None:
        while (
            not self._ran_inline
            and self._scheduler.waiting
            and self._scheduler.running < self.settings.serving.solver_threads
        ):
            now = self.clocks.monotonic()
            wait_s = self._gate.wait_s(now, self.clocks.cpu()) if self._gate.is_on else 0.0
            if wait_s > 0:
                if self._gate_timer is None:
                    rest_s = _BATCH_S if self._scheduler.is_behind else 0.0
                    if rest_s > 0:
                        self._rest(rest_s)
                    self._gate_timer = self._loop.call_later(max(0.0, wait_s - rest_s), self._gate_opens)
                break
            job, refusals = self._scheduler.start(now)
            self._refuse(refusals, now)
            if job is not None:
                self._waits.note(now - job.received_s, now)
                self._run(job)
        if self._scheduler.waiting and self._sweep_timer is None:
            pause_s = self.settings.serving.queue_target_ms / 2e3
            self._sweep_timer = self._loop.call_later(pause_s, self._sweep)

    def _run(self, job: QueuedCommand) -> None:
        """Begin *job*; in the event loop only one in each of its rounds.

        Otherwise a slow round would hide the queue in the kernel, where nobody sees how long it is.
        """
        service = self._registry.get(job.command.service)
        inline_bytes = self.settings.serving.inline_bytes
        may_run_here = service.kind == "stateless" and not self.objects.named_by(job.command, service)
        if may_run_here and self._scheduler.runs_inline(
            cheap=service.cheap, size_bytes=job.size_bytes, inline_bytes=inline_bytes
        ):
            self._ran_inline = True
            self._loop.call_later(0.0, self._next_round)
            self._finish(self._compute(job))
        else:
            self._executors[service.kind].run(job)

    def _compute(self, job: QueuedCommand) -> _Outcome:
        """Solve and encode; runs in the loop or in a thread, so it touches nothing shared."""
        monotonic, command = self.clocks.monotonic, job.command
        started = monotonic()
        try:
            command = self.objects.put_in(command, self._registry, job.owner)
        except RsePfError as error:
            return self._encoded(job, failure_of(error, command, server=self.server_id))
        answer = dispatch(
            self._registry, command, monotonic, server=self.server_id, on_defect=self._log_defect
        )
        if isinstance(answer, Result):
            answer = msgspec.structs.replace(
                answer,
                queue_ms=(started - job.received_s) * 1e3,
                received_s=job.received_s,
                sent_s=monotonic(),
            )
        outcome = self._encoded(job, answer)
        kept = self.objects.kept(answer, outcome.answer, job.owner)
        return outcome if kept is outcome.answer else self._encoded(job, kept)

    def _encoded(self, job: QueuedCommand, answer: Result | Failure) -> _Outcome:
        codec, command = job.owner.session.codec, job.command
        try:
            data = codec.encode(answer)
        except Exception as error:  # noqa: BLE001  a service's reply is foreign data: anything may come out
            self._log_defect(command, error)
            answer = failure_of(
                InternalError(f"the reply of {command.service!r} cannot be encoded"),
                command,
                server=self.server_id,
            )
            return _Outcome(job, answer, codec.encode(answer))
        most = self.settings.session.max_message_bytes
        if len(data) > most and isinstance(answer, Result) and answer.object and answer.reply is not None:
            return self._encoded(job, msgspec.structs.replace(answer, reply=None))
        if len(data) > most:
            too_large = LimitExceeded(f"the reply has {len(data)} bytes, above {most}", hint="ask for less")
            answer = failure_of(too_large, command, server=self.server_id)
            data = codec.encode(answer)
        return _Outcome(job, answer, data)

    def _from_thread(self, outcome: _Outcome) -> None:
        self._loop.call_soon_threadsafe(self._finish_and_go_on, outcome)

    def _finish_and_go_on(self, outcome: _Outcome) -> None:
        self._finish(outcome)
        self._start()

    def _finish(self, outcome: _Outcome) -> None:
        now = self.clocks.monotonic()
        self._scheduler.done(outcome.job, now)
        self._answer(outcome, now)

    def _refuse(self, refusals: list[RefusedCommand], now: float) -> None:
        for refusal in refusals:
            self.metrics.shed[refusal.reason] += 1
            job = refusal.job
            failure = failure_of(refusal.error, job.command, server=self.server_id)
            self._answer(_Outcome(job, failure, job.owner.session.codec.encode(failure)), now)

    def _answer(self, outcome: _Outcome, now: float) -> None:
        job, answer = outcome.job, outcome.answer
        connection: RobotConnection = job.owner
        code = "ok" if isinstance(answer, Result) else answer.code
        service = self._label(job.command.service)
        self.metrics.answered(service, code, now - job.received_s)
        if connection in self.connections and connection.session is not None:
            connection.session.in_flight -= 1
            connection.write(outcome.data)
        level, tell = ("debug", self._log.debug) if code in _USUAL else ("info", self._log.info)
        if self._log.writes(level):
            compute_ms = answer.compute_ms if isinstance(answer, Result) else 0.0
            tell(
                "command", robot=job.robot, service=service, id=job.command.id, trace=job.command.trace,
                code=code, queue_ms=round((job.started_s or now) * 1e3 - job.received_s * 1e3, 3),
                compute_ms=round(compute_ms, 3),
                bytes_in=job.size_bytes, bytes_out=len(outcome.data),
            )  # fmt: skip

    def _log_defect(self, command: Command, error: BaseException) -> None:
        text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
        self._log.error("defect", service=command.service, id=command.id, trace=command.trace, traceback=text)

    def _service(self, name: str) -> Service | None:
        try:
            return self._registry.get(name)
        except UnknownService:
            return None

    def _is_stateless(self, name: str) -> bool:
        if self.environments is not None and self.environments.offers(name):
            return False
        service = self._service(name)
        return service is not None and service.kind in self._executors

    def _label(self, service: str) -> str:
        installed = self.environments is not None and self.environments.offers(service)
        return service if installed or self._service(service) is not None else _UNKNOWN

    # --- timers --------------------------------------------------------------------------------

    def _next_round(self) -> None:
        self._ran_inline = False
        self._start()

    def _gate_opens(self) -> None:
        self._gate_timer = None
        self._start()

    def _sweep(self) -> None:
        self._sweep_timer = None
        now = self.clocks.monotonic()
        self._refuse(self._scheduler.sweep(now), now)
        self._start()

    def _tick(self) -> None:
        now = self.clocks.monotonic()
        self._lag_s = max(self._lag_s, -self._patience.left_s(now))
        self._patience.look(self.connections, now)
        self._loop.call_later(self._patience.left_s(now), self._tick)
