"""Isolated environments (the paper's Fig. 4) as the worker sees them: one process per robot, if needed.

A robot's first command to an installed service makes its environment, the end of its connection releases
it.  Promises that a crash in one of them is a typed failure for that robot alone, that no call outlives a
few of its deadlines, and that nothing here blocks the event loop.
"""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from rse_pf.backend.sandbox.child import encoded
from rse_pf.backend.sandbox.circuit_breaker import CircuitBreaker
from rse_pf.backend.sandbox.ipc import FdWatcher, IpcChannel
from rse_pf.backend.sandbox.zygote_client import SandboxLog, ZygoteClient
from rse_pf.backend.scheduling.scheduler import QueuedCommand
from rse_pf.config import PlatformSettings
from rse_pf.errors import (
    Busy,
    Conflict,
    Expired,
    NotFound,
    Poison,
    RsePfError,
    StoreError,
    WorkerLost,
    error_from_code,
)
from rse_pf.object_store import ObjectStore
from rse_pf.service import failure_of
from rse_pf.services.custom.installed import InstalledService
from rse_pf.wire import Failure, Result

__all__ = ["SandboxManager"]

_MAX_TRIES = 2
_BUSY_RETRY_MS = 1000.0


class Timer(Protocol):
    """A call that can be taken back."""

    def cancel(self) -> None:
        """Do not call."""


class Loop(FdWatcher, Protocol):
    """What environments need of an event loop."""

    def call_later(self, delay: float, callback: Callable[..., object], *args: Any) -> Timer:
        """Call *callback* in *delay* seconds."""

    def run_in_executor(self, executor: None, function: Callable[..., Any], *args: Any) -> Any:
        """Run *function* in a thread and return its future."""


@dataclass(eq=False, slots=True)
class _Call:
    """A command on its way through an environment."""

    job: QueuedCommand
    digest: str
    data: bytes
    tries: int = 0
    answered: bool = False


@dataclass(eq=False, slots=True)
class _Sandbox:
    number: int
    robot: str
    conversation: IpcChannel | None = None
    state: Literal["starting", "idle", "restoring", "busy", "over"] = "starting"
    waiting: deque[_Call] = field(default_factory=deque)
    running: _Call | None = None
    restored: dict[str, bytes | None] = field(default_factory=dict)
    """Last snapshot of each stateful service, as it stands in the store."""
    timers: list[Timer] = field(default_factory=list)
    grace: Timer | None = None
    fault: str = ""


class SandboxManager:
    """The environments of one worker."""

    def __init__(
        self,
        services: Sequence[InstalledService],
        *,
        settings: PlatformSettings,
        most: int,
        server_id: str,
        store: ObjectStore | None,
        monotonic: Callable[[], float],
        loop: Loop,
        log: SandboxLog,
        answer: Callable[[QueuedCommand, Result | Failure], None],
    ) -> None:
        """Start the template process and wait until it is warm.

        Args:
            services: As installed and checked.
            settings: Limits and grace.
            most: SandboxManager of this worker at a time.
            server_id: Goes into answers.
            store: Where snapshots live; None keeps none.
            monotonic: Clock of deadlines.
            loop: Of the worker.
            log: Of the worker; gets what services print.
            answer: Called exactly once for each submitted job.

        Raises:
            ConfigurationError: A wall is missing and weak isolation was not accepted.
        """
        self.counts: Counter[str] = Counter()
        self._services = {service.name: service for service in services}
        self._settings = settings
        self._most = most
        self._server_id = server_id
        self._store = store
        self._monotonic = monotonic
        self._loop = loop
        self._log = log
        self._answer_job = answer
        self._quarantine = CircuitBreaker(settings.services)
        self._by_robot: dict[str, _Sandbox] = {}
        self._by_number: dict[int, _Sandbox] = {}
        self._connections: Counter[str] = Counter()
        self._next_number = 0
        self._template = ZygoteClient(
            services, settings, loop=loop, log=log, on_gone=self._on_gone, on_lost=self._on_lost
        )

    def offers(self, service: str) -> bool:
        """Return whether *service* is an installed one."""
        return service in self._services

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the walls that this machine lacks."""
        return self._template.missing

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return sum(len(each.waiting) + (each.running is not None) for each in self._by_number.values())

    def report(self) -> dict[str, Any]:
        """Return what /readyz and /metrics say of this worker's environments."""
        return {
            "environments": len(self._by_number),
            "missing_walls": list(self.missing),
            "quarantined": self._quarantine.resting(self._monotonic()),
            "counts": dict(self.counts),
        }

    def connected(self, robot: str) -> None:
        """Note a connection of *robot*: its environment, if it still has one, is kept."""
        self._connections[robot] += 1
        environment = self._by_robot.get(robot)
        if environment is not None and environment.grace is not None:
            environment.grace.cancel()
            environment.grace = None

    def disconnected(self, robot: str) -> None:
        """Note the end of a connection; after the last one and a grace the environment is released."""
        self._connections[robot] -= 1
        if self._connections[robot] > 0:
            return
        del self._connections[robot]
        environment = self._by_robot.get(robot)
        if environment is None:
            return
        environment.waiting.clear()
        grace_s = self._settings.services.grace_s
        environment.grace = self._loop.call_later(grace_s, self._release, environment)

    def submit(self, job: QueuedCommand) -> None:
        """Run *job* in its robot's environment; the answer comes through the callback."""
        now = self._monotonic()
        command = job.command
        body = encoded(["call", command.service, command.payload])
        digest = hashlib.sha256(body).hexdigest()
        call = _Call(job, digest, body)
        refusal = self._refusal(call, now)
        if refusal is None and job.deadline_s <= now:
            refusal = Expired("the deadline passed before the work began")
        if refusal is not None:
            self._answer(call, failure_of(refusal, command, server=self._server_id))
            return
        environment = self._by_robot.get(job.robot)
        if environment is None and not self._has_room():
            busy = Busy(
                f"all {self._most} environments of this server are taken", retry_after_ms=_BUSY_RETRY_MS
            )
            self._answer(call, failure_of(busy, command, server=self._server_id))
            return
        if environment is None:
            environment = self._create(job.robot)
        if len(environment.waiting) >= self._settings.serving.max_queue_per_robot:
            busy = Busy(
                "too many commands of this robot wait", hint="wait for answers", retry_after_ms=_BUSY_RETRY_MS
            )
            self._answer(call, failure_of(busy, command, server=self._server_id))
            return
        environment.waiting.append(call)
        self._go_on(environment)

    def close(self) -> None:
        """End every environment and the template."""
        for environment in list(self._by_number.values()):
            self._forget(environment)
        self._template.close()

    # --- one environment ---------------------------------------------------------------------------

    def _has_room(self) -> bool:
        if len(self._by_number) < self._most:
            return True
        idle = [e for e in self._by_number.values() if e.grace is not None and e.running is None]
        if idle:
            self._forget(idle[0])
        return bool(idle)

    def _create(self, robot: str) -> _Sandbox:
        self._next_number += 1
        environment = _Sandbox(self._next_number, robot)
        conversation = environment.conversation = IpcChannel(
            self._loop,
            max_bytes=self._settings.session.max_inflated_bytes,
            on_message=lambda message: self._hear(environment, message),
            on_fault=lambda why: self._kill(environment, why),
            on_line=lambda text: self._log.info("service-output", robot=robot, text=text),
        )
        self._by_number[environment.number] = self._by_robot[robot] = environment
        self.counts["created"] += 1
        timeout_s = self._settings.services.start_timeout_s
        environment.timers.append(
            self._loop.call_later(timeout_s, self._kill, environment, "it did not start in time")
        )
        self._template.create(environment.number, conversation.theirs, conversation.their_output)
        conversation.begin()
        return environment

    def _on_gone(self, number: int, how: str) -> None:
        environment = self._by_number.get(number)
        if environment is not None:
            self._died(environment, how)

    def _on_lost(self) -> None:
        for environment in list(self._by_number.values()):
            self._died(environment, "the template was lost")

    def _go_on(self, environment: _Sandbox) -> None:
        """Start the next call of an idle environment."""
        while environment.state == "idle" and environment.waiting:
            call = environment.waiting.popleft()
            now, job = self._monotonic(), call.job
            refusal = self._refusal(call, now)
            if refusal is None and job.deadline_s <= now:
                refusal = Expired("the deadline passed before the work began")
            if refusal is not None:
                self._answer(call, failure_of(refusal, job.command, server=self._server_id))
                continue
            environment.state = "busy"
            environment.running = call
            job.started_s = now
            allowed_s = job.deadline_s - job.received_s
            killed_s = job.received_s + allowed_s * self._settings.services.deadline_factor
            environment.timers += [
                self._loop.call_later(job.deadline_s - now, self._is_late, environment, call),
                self._loop.call_later(killed_s - now, self._kill, environment, "it took too long", call),
            ]
            if self._keeps_state(job.command.service) and job.command.service not in environment.restored:
                self._restore(environment, call)
            else:
                self._write(environment, call.data)

    def _keeps_state(self, service: str) -> bool:
        return self._store is not None and self._services[service].kind == "per_robot_state"

    def _refusal(self, call: _Call, now: float) -> RsePfError | None:
        service = call.job.command.service
        verdict = self._quarantine.verdict(service, call.digest, now)
        if verdict == "poison":
            self.counts["poison"] += 1
            return Poison(
                "this request killed the environments that it met and is not tried again",
                hint="send another one; the server's log has the crash",
            )
        if verdict == "quarantined":
            rests_s = self._quarantine.rests_s(service, now)
            return WorkerLost(
                f"service {service!r} crashed again and again and rests for {rests_s:.0f} s",
                hint="tell the operator; the server's log has the crashes", retry_after_ms=rests_s * 1e3,
            )  # fmt: skip
        return None

    def _is_late(self, environment: _Sandbox, call: _Call) -> None:
        """The robot does not wait any longer; the environment has until the factor of its deadline."""
        if environment.running is call:
            late = Expired("the service did not answer before the deadline")
            self._answer(call, failure_of(late, call.job.command, server=self._server_id))

    def _kill(self, environment: _Sandbox, why: str, call: _Call | None = None) -> None:
        """Let it be killed; `_died` follows when the template says so."""
        if environment.state == "over" or (call is not None and environment.running is not call):
            return
        environment.fault = environment.fault or why
        self._template.end(environment.number)

    def _release(self, environment: _Sandbox) -> None:
        if environment.state != "over" and not self._connections[environment.robot]:
            self.counts["released"] += 1
            self._forget(environment)

    def _forget(self, environment: _Sandbox) -> None:
        """End the process and close what belongs to it; calls that wait for it are for the caller."""
        if environment.state == "over":
            return
        environment.state = "over"
        self._template.end(environment.number)
        for timer in environment.timers:
            timer.cancel()
        if environment.grace is not None:
            environment.grace.cancel()
        if environment.conversation is not None:
            environment.conversation.close()
        del self._by_number[environment.number]
        if self._by_robot.get(environment.robot) is environment:
            del self._by_robot[environment.robot]

    def _died(self, environment: _Sandbox, how: str) -> None:
        """Tell the robot, or try once more, and let what waited go on in a new environment."""
        now, call, never_ran = self._monotonic(), environment.running, environment.state == "starting"
        why = environment.fault or how
        self._forget(environment)
        self.counts["died"] += 1
        service = "" if call is None else call.job.command.service
        self._log.error("environment-died", robot=environment.robot, service=service, reason=f"{why} ({how})")
        waiting = list(environment.waiting)
        if call is not None:
            self._quarantine.died(service, call.digest, now)
            call.tries += 1
            if not call.answered and self._may_try_again(call, environment, now):
                waiting.insert(0, call)
            else:
                self._answer_lost(call, self._refusal(call, now) or _lost(service, why))
        if never_ran:
            for each in waiting:
                self._answer_lost(each, _lost(each.job.command.service, why))
        elif waiting and self._connections[environment.robot] > 0:
            self._create(environment.robot).waiting.extend(waiting)

    def _answer_lost(self, call: _Call, error: RsePfError) -> None:
        self._answer(call, failure_of(error, call.job.command, server=self._server_id))

    def _may_try_again(self, call: _Call, environment: _Sandbox, now: float) -> bool:
        service = self._services[call.job.command.service]
        return (
            call.tries < _MAX_TRIES
            and call.job.deadline_s > now
            and (service.kind == "stateless" or environment.restored.get(service.name) is not None)
            and self._quarantine.verdict(service.name, call.digest, now) == "run"
        )

    # --- the conversation --------------------------------------------------------------------------

    def _write(self, environment: _Sandbox, data: bytes) -> None:
        assert environment.conversation is not None
        environment.conversation.send(data)

    def _hear(self, environment: _Sandbox, message: list[Any]) -> None:
        call = environment.running
        if environment.state == "starting":
            environment.timers[0].cancel()
            environment.timers.clear()
            environment.state = "idle"
            self._go_on(environment)
        elif call is None:
            raise ValueError("an answer without a call")
        elif environment.state == "restoring" and message[0] is True:
            environment.state = "busy"
            self._write(environment, call.data)
        elif message[0] is True and message[2] is not None and self._keeps_state(call.job.command.service):
            self._keep_snapshot(environment, call, message)
        else:
            self._done(environment, call, message)

    def _done(self, environment: _Sandbox, call: _Call, message: list[Any]) -> None:
        if message[0] is True:
            _, reply, _, compute_ms = message
            answer: Result | Failure = Result(
                id=call.job.command.id, reply=reply, server=self._server_id, compute_ms=float(compute_ms)
            )
        else:
            _, code, text, hint, _ = message
            error = error_from_code(str(code), str(text)[:500], hint=str(hint)[:500])
            answer = failure_of(error, call.job.command, server=self._server_id)
        for timer in environment.timers:
            timer.cancel()
        environment.timers.clear()
        environment.running = None
        environment.state = "idle"
        self._answer(call, answer)
        self._go_on(environment)

    def _answer(self, call: _Call, answer: Result | Failure) -> None:
        if not call.answered:
            call.answered = True
            self._answer_job(call.job, answer)

    # --- state that survives -----------------------------------------------------------------------

    def _restore(self, environment: _Sandbox, call: _Call) -> None:
        """Read the last snapshot and give it to the service; *call* runs after that."""
        service = call.job.command.service
        future = self._loop.run_in_executor(None, _read, self._store, _name(environment.robot, service))
        environment.state = "restoring"

        def found(done: Any) -> None:
            if environment.running is not call or environment.state == "over":
                return
            if done.exception() is not None:
                self._done(environment, call, _no_store(done.exception()))
                return
            snapshot = environment.restored[service] = done.result()
            if snapshot is None:
                environment.state = "busy"
                self._write(environment, call.data)
            else:
                self._write(environment, encoded(["restore", service, snapshot]))

        future.add_done_callback(found)

    def _keep_snapshot(self, environment: _Sandbox, call: _Call, message: list[Any]) -> None:
        """Answer only when the state that belongs to the answer is safe."""
        assert self._store is not None
        service, data = call.job.command.service, bytes(message[2])
        expected = environment.restored[service]
        if data == expected:
            self._done(environment, call, message)
            return
        name = _name(environment.robot, service)
        future = self._loop.run_in_executor(None, self._store.compare_and_swap, name, expected, data)

        def kept(done: Any) -> None:
            if environment.running is not call or environment.state == "over":
                return
            error = done.exception()
            if error is None:
                environment.restored[service] = data
                self._done(environment, call, message)
            elif isinstance(error, Conflict):  # this one is the older: the robot's state lives elsewhere
                environment.running = None
                self._answer_lost(call, _lost(service, "its state went on elsewhere"))
                waiting = list(environment.waiting)
                self._forget(environment)
                if waiting and self._connections[environment.robot] > 0:
                    self._create(environment.robot).waiting.extend(waiting)
            else:
                self._done(environment, call, _no_store(error))

        future.add_done_callback(kept)


def _name(robot: str, service: str) -> str:
    return f"snapshots/{robot}/{service}"


def _read(store: ObjectStore, name: str) -> bytes | None:
    try:
        return store.get(name)
    except NotFound:
        return None


def _lost(service: str, why: str) -> WorkerLost:
    return WorkerLost(
        f"service {service!r} ended while it worked on this command: {why}",
        hint="the server's log has what it said last",
    )


def _no_store(error: BaseException | None) -> list[Any]:
    return [False, StoreError.code, f"the service's state cannot be kept: {error}", "send it again", 0.0]
