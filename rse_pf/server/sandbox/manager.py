"""Execute the actions that `policy` decides for the sandboxes of one worker.

`SandboxManager` passes events to `SandboxPolicy` and executes the returned actions: it starts and kills
processes through the zygote, sends messages, sets timers, and reads and writes snapshots.  The event loop is
blocked only by `SandboxManager.start`, until the zygote is ready, and by `SandboxManager.close`.
Source: the paper's Fig. 4 gives each robot an isolated environment.
"""

from __future__ import annotations

import functools
import hashlib
import math
from asyncio import AbstractEventLoop, TimerHandle
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadMessage, NotFound, RsePfError
from rse_pf.identity import RobotId, state_name
from rse_pf.processes.ipc import encode_message
from rse_pf.server.sandbox.channel import IpcChannel, is_ready, outcome_of
from rse_pf.server.sandbox.circuit_breaker import Block
from rse_pf.server.sandbox.policy import (
    Action,
    AnswerCall,
    CreateSandbox,
    KillSandbox,
    LoadSnapshot,
    LogEnd,
    ReleaseSandbox,
    SandboxCall,
    SandboxPolicy,
    SandboxReply,
    SaveSnapshot,
    SendMessage,
)
from rse_pf.server.sandbox.zygote_client import ZygoteClient
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.server.worker_context import Log
from rse_pf.service import failure_of
from rse_pf.services.custom.installed import InstalledService
from rse_pf.storage.object_store import ObjectStore
from rse_pf.wire import Failure, Result

__all__ = ["SandboxHost", "SandboxManager"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SandboxHost:
    """What sandboxes need of the worker whose commands they execute.

    Attributes:
        server_id: Id of the backend server, a field of every answer.
        loop: Event loop of the worker.
        monotonic: Clock of the deadlines, in seconds.
        log: Receives the printed output of services, and crashes of sandboxes.
        answer: Called exactly once for each submitted command whose robot stays connected.
    """

    server_id: str
    loop: AbstractEventLoop
    monotonic: Callable[[], float]
    log: Log
    answer: Callable[[QueuedCommand, Result | Failure], None]


class SandboxManager:
    """The sandboxes of one worker for a fixed set of installed services, and their zygote.

    All methods are called in the event loop of the worker.
    """

    def __init__(
        self,
        services: Sequence[InstalledService],
        *,
        settings: PlatformSettings,
        max_sandboxes: int,
        store: ObjectStore | None,
        host: SandboxHost,
        on_ready: Callable[[tuple[str, ...] | None], None] | None = None,
    ) -> None:
        """Prepare; no process is started before `start`.

        Args:
            services: The installed services, whose hashes were verified.
            settings: Limits of sandboxes, and the grace period after the last connection of a robot.
            max_sandboxes: Most sandboxes of this worker at a time.
            store: Object store for snapshots of the state of services; None stores no snapshots.
            host: Event loop, clock, log and answers of the worker.
            on_ready: If given, `start` does not wait for the zygote; the function is called when the zygote
                is ready or has exited (see `ZygoteClient`), and no command may be submitted before.
        """
        self._policy = SandboxPolicy(
            {service.name: service.kind for service in services},
            settings.services,
            max_sandboxes=max_sandboxes,
            keeps_snapshots=store is not None,
        )
        self._names = {service.name for service in services}
        self._max_message_bytes = settings.session.max_inflated_bytes
        self._server_id = host.server_id
        self._store = store
        self._monotonic = host.monotonic
        self._loop = host.loop
        self._log = host.log
        self._answer = host.answer
        self._channels: dict[int, IpcChannel] = {}
        self._working: set[int] = set()
        """Numbers of the sandboxes that were sent a request and have not replied.

        A sandbox is paused by SIGSTOP after a message to the worker, until it is sent the next request.
        """
        self._actions: deque[Action] = deque()
        self._is_executing = False
        self._timer: TimerHandle | None = None
        self._timer_s = math.inf
        self._zygote = ZygoteClient(
            services, settings, loop=host.loop, log=host.log, on_gone=self.on_gone, on_lost=self.on_lost,
            on_ready=on_ready,
        )  # fmt: skip

    def start(self) -> SandboxManager:
        """Start the zygote and return this object; waits until the zygote is ready, unless *on_ready* is set.

        Raises:
            ConfigurationError: The zygote did not start, or a means of isolation is missing and weak
                isolation is not accepted (see `ZygoteClient.start`).
        """
        self._zygote.start()
        return self

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of `isolation.ISOLATION` that this machine lacks; empty before the zygote is ready."""
        return self._zygote.missing

    def offers(self, service: str) -> bool:
        """Return whether *service* is the name of one of the installed services."""
        return service in self._names

    @property
    def held(self) -> int:
        """Number of commands that wait for their sandbox or run in it."""
        return self._policy.held

    def waiting_of(self, robot: RobotId) -> int:
        """Return how many commands of *robot* wait for its sandbox; a running command is not counted."""
        return self._policy.waiting_of(robot)

    def report(self) -> dict[str, Any]:
        """Return state and counts of the sandboxes for ``/readyz`` and ``/metrics``.

        Returns:
            ``sandboxes``: number of sandboxes; ``missing_isolation``: means of isolation that this machine
            lacks; ``open_breakers``: services refused to all robots or to a whole tenant; ``counts``: how
            often sandboxes were created, released, crashed and overran, and poison requests were refused.
        """
        return {
            "sandboxes": self._policy.sandboxes,
            "missing_isolation": list(self.missing),
            "open_breakers": self._policy.breaker.open_services(self._monotonic()),
            "counts": dict(self._policy.counts),
        }

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return the elapsed seconds for which the sandboxes of each tenant have worked on requests.

        It is the time from each request to its reply; the CPU time of a sandbox is not measured.
        """
        return dict(self._policy.worked_s)

    def blocks(self) -> list[Block]:
        """Return all refusals of services and requests that are in force now after crashes or overruns."""
        return self._policy.breaker.blocks(self._monotonic())

    def unblock(self, service: str | None, tenant: str | None, robot: str | None) -> list[Block]:
        """Lift the refusals that match all arguments (None matches everything), and return them."""
        return self._policy.breaker.unblock(self._monotonic(), service=service, tenant=tenant, robot=robot)

    def add_connection(self, robot: RobotId) -> None:
        """Count one more connection of *robot*, which keeps its sandbox."""
        self._policy.add_connection(robot)

    def remove_connection(self, robot: RobotId) -> None:
        """Count one connection of *robot* less.

        After the last connection, the waiting commands of the robot are dropped without an answer, and its
        sandbox is released after the grace period ``services.grace_s``.
        """
        self._policy.remove_connection(robot, self._monotonic())
        self._execute([])

    def submit(self, queued: QueuedCommand) -> None:
        """Run the command *queued* in the sandbox of its robot; the answer is passed to `SandboxHost.answer`.

        The command waits for earlier commands of the robot.  It may be refused, for instance while all
        sandboxes are in use; then the error is the answer.
        """
        data = encode_message(["call", queued.command.service, queued.command.payload])
        call = SandboxCall(queued, hashlib.sha256(data).hexdigest(), data)
        self._execute(self._policy.submit(call, self._monotonic()))

    def close(self) -> None:
        """Kill every sandbox, and wait until the zygote has exited; the zygote is killed after 0.5 s."""
        self._execute(self._policy.close())
        self._zygote.close()

    def retire(self) -> None:
        """Kill every sandbox, and end the zygote without blocking the event loop."""
        self._execute(self._policy.close())
        if self._timer is not None:
            self._timer.cancel()
        self._zygote.retire()

    # --- events of processes, messages and timers, which are passed to the policy --------------------

    def on_gone(self, number: int, how: str) -> None:
        """Handle the end of the process of sandbox *number*; *how* is the reason in words."""
        self._execute(self._policy.on_exit(number, how, self._monotonic()))

    def on_lost(self) -> None:
        """Handle the end of the zygote, with which every sandbox was killed."""
        self._execute(self._policy.on_all_exited("the zygote ended", self._monotonic()))

    def _on_fault(self, number: int, why: str) -> None:
        self._execute(self._policy.on_violation(number, why))

    def _on_message(self, number: int, message: Any) -> None:
        self._working.discard(number)
        self._follow_message(number, message, self._monotonic())
        if number in self._channels and number not in self._working:
            self._zygote.pause(number)

    def _follow_message(self, number: int, message: Any, now: float) -> None:
        if is_ready(message):
            self._execute(self._policy.on_ready(number, now))
            return
        try:
            outcome = outcome_of(message)
        except BadMessage as error:
            self._on_fault(number, error.message)
        else:
            self._execute(self._policy.on_reply(number, outcome, now))

    def _on_timer(self) -> None:
        self._timer, self._timer_s = None, math.inf
        self._execute(self._policy.tick(self._monotonic()))

    # --- execution of the actions that the policy returned -------------------------------------------

    def _execute(self, actions: list[Action]) -> None:
        """Execute *actions* in order, then set the timer for `SandboxPolicy.wake_s`.

        An action may cause an event whose actions are executed after all actions of the first call.
        """
        self._actions.extend(actions)
        if self._is_executing:
            return
        self._is_executing = True
        try:
            while self._actions:
                self._act(self._actions.popleft())
        finally:
            self._is_executing = False
        self._set_timer()

    def _act(self, action: Action) -> None:
        match action:
            case SendMessage(number, data):
                if number in self._channels:
                    self._working.add(number)
                    self._channels[number].send(data)
                    self._zygote.resume(number)
            case AnswerCall(call, outcome):
                self._answer(call.queued, self._answer_of(call, outcome))
            case CreateSandbox(number, robot):
                self._create(number, robot)
            case KillSandbox(number):
                self._zygote.end(number)
                self._channels[number].stop_reading()
            case ReleaseSandbox(number):
                self._zygote.end(number)
                self._channels.pop(number).close()
                self._working.discard(number)
            case LoadSnapshot(number, call):
                self._ask_store(number, call, _load)
            case SaveSnapshot(number, call, expected, data):
                self._ask_store(number, call, _save, expected, data)
            case LogEnd(robot, service, reason, is_crash):
                event = "sandbox-crashed" if is_crash else "sandbox-overran"
                write = self._log.error if is_crash else self._log.warning
                write(event, robot=robot, service=service, reason=reason)

    def _create(self, number: int, robot: RobotId) -> None:
        channel = self._channels[number] = IpcChannel(
            self._loop,
            max_bytes=self._max_message_bytes,
            on_message=functools.partial(self._on_message, number),
            on_fault=functools.partial(self._on_fault, number),
            on_line=lambda text: self._log.info("service-output", robot=robot, text=text),
        )
        is_ordered = self._zygote.create(number, channel.theirs, channel.their_output)
        channel.start()
        if not is_ordered:
            self.on_gone(number, "the zygote is overloaded")

    def _answer_of(self, call: SandboxCall, outcome: SandboxReply | RsePfError) -> Result | Failure:
        command = call.queued.command
        if isinstance(outcome, RsePfError):
            return failure_of(outcome, command, server=self._server_id)
        return Result(
            id=command.id, reply=outcome.value, server=self._server_id, compute_ms=outcome.compute_ms
        )

    def _set_timer(self) -> None:
        """Set a timer for `SandboxPolicy.wake_s`; a timer that is set for an earlier time stays instead."""
        wake_s = self._policy.wake_s
        if wake_s >= self._timer_s:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer_s = wake_s
        self._timer = self._loop.call_later(max(0.0, wake_s - self._monotonic()), self._on_timer)

    # --- snapshots of the state of services in the object store ---------------------------------------

    def _ask_store(self, number: int, call: SandboxCall, function: Callable[..., Any], *args: Any) -> None:
        """Run `_load` or `_save` in a thread, and pass the result or the exception to the policy."""

        def done(future: Any) -> None:
            outcome = future.exception() or future.result()
            self._execute(self._policy.on_store_reply(number, call, outcome, self._monotonic()))

        work = functools.partial(function, self._store, call.queued.robot, call.service, *args)
        self._loop.run_in_executor(None, work).add_done_callback(done)


def _load(store: ObjectStore, robot: RobotId, service: str) -> bytes | None:
    """Return the stored snapshot of *service* for *robot*, None if there is none; raises StoreError."""
    try:
        return store.get(state_name(robot, service))
    except NotFound:
        return None


def _save(store: ObjectStore, robot: RobotId, service: str, expected: bytes | None, data: bytes) -> None:
    """Replace the stored snapshot *expected* (None: there is none) by *data*.

    Raises:
        Conflict: Another snapshot than *expected* is stored.
        StoreError: The store failed.
    """
    store.compare_and_swap(state_name(robot, service), expected, data)
