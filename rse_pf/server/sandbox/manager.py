"""Execute what `policy` decides about the sandboxes of one worker: processes, messages, timers and the store.

The paper's Fig. 4 gives each robot an isolated environment of its own.  Nothing here blocks the event loop
once the zygote has started.
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
    """The worker that sandboxes run for."""

    server_id: str
    """Goes into answers."""
    loop: AbstractEventLoop
    monotonic: Callable[[], float]
    """Clock of deadlines, s."""
    log: Log
    """Gets what services print."""
    answer: Callable[[QueuedCommand, Result | Failure], None]
    """Called exactly once for each submitted command whose robot stays connected."""


class SandboxManager:
    """The sandboxes of one worker."""

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
        """Start the zygote and wait until it is ready.

        Args:
            services: As installed and checked.
            settings: Limits and grace.
            max_sandboxes: Sandboxes of this worker at a time.
            store: Where snapshots are kept; None keeps none.
            host: The worker.
            on_ready: As for `ZygoteClient`: if given, nothing blocks, and nothing may be submitted before it
                was called.

        Raises:
            ConfigurationError: A means of isolation is missing and weak isolation was not accepted.
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
        """Sandboxes that were sent a request and have not replied; all others are paused."""
        self._actions: deque[Action] = deque()
        self._is_executing = False
        self._timer: TimerHandle | None = None
        self._timer_s = math.inf
        self._zygote = ZygoteClient(
            services, settings, loop=host.loop, log=host.log, on_gone=self.on_gone, on_lost=self.on_lost,
            on_ready=on_ready,
        )  # fmt: skip

    def start(self) -> SandboxManager:
        """Start the zygote; return this object.  Raises ConfigurationError, see `ZygoteClient.start`."""
        self._zygote.start()
        return self

    @property
    def missing(self) -> tuple[str, ...]:
        """The means of isolation that this machine lacks."""
        return self._zygote.missing

    def offers(self, service: str) -> bool:
        """Return whether *service* is an installed one."""
        return service in self._names

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return self._policy.held

    def waiting_of(self, robot: RobotId) -> int:
        """Return how many commands of *robot* wait."""
        return self._policy.waiting_of(robot)

    def report(self) -> dict[str, Any]:
        """Return the state and the counts of this worker's sandboxes for /readyz and /metrics."""
        return {
            "sandboxes": self._policy.sandboxes,
            "missing_isolation": list(self.missing),
            "open_breakers": self._policy.breaker.open_services(self._monotonic()),
            "counts": dict(self._policy.counts),
        }

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return for how long the sandboxes of each tenant have worked at requests, in seconds."""
        return dict(self._policy.worked_s)

    def blocks(self) -> list[Block]:
        """Return the services and requests that are refused now after crashes, with their robots."""
        return self._policy.breaker.blocks(self._monotonic())

    def unblock(self, service: str | None, tenant: str | None, robot: str | None) -> list[Block]:
        """Lift the matching blocks (None matches everything), and return them."""
        return self._policy.breaker.unblock(self._monotonic(), service=service, tenant=tenant, robot=robot)

    def add_connection(self, robot: RobotId) -> None:
        """Note a connection of *robot*."""
        self._policy.add_connection(robot)

    def remove_connection(self, robot: RobotId) -> None:
        """Note the end of a connection; after the last one and a grace period the sandbox is released."""
        self._policy.remove_connection(robot, self._monotonic())
        self._execute([])

    def submit(self, queued: QueuedCommand) -> None:
        """Run *queued* in its robot's sandbox; the answer comes through the callback."""
        data = encode_message(["call", queued.command.service, queued.command.payload])
        call = SandboxCall(queued, hashlib.sha256(data).hexdigest(), data)
        self._execute(self._policy.submit(call, self._monotonic()))

    def close(self) -> None:
        """End every sandbox and the zygote."""
        self._execute(self._policy.close())
        self._zygote.close()

    def retire(self) -> None:
        """End every sandbox, and the zygote without waiting for it."""
        self._execute(self._policy.close())
        if self._timer is not None:
            self._timer.cancel()
        self._zygote.retire()

    # --- events ------------------------------------------------------------------------------------

    def on_gone(self, number: int, how: str) -> None:
        """Sandbox *number* ended; *how* says by what."""
        self._execute(self._policy.on_exit(number, how, self._monotonic()))

    def on_lost(self) -> None:
        """The zygote ended, and every sandbox with it."""
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

    # --- actions -----------------------------------------------------------------------------------

    def _execute(self, actions: list[Action]) -> None:
        """Execute *actions*; those that follow from them come after them, in order."""
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
        """Wake up when the policy needs it; a timer that is early costs less than one more cancelled."""
        wake_s = self._policy.wake_s
        if wake_s >= self._timer_s:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer_s = wake_s
        self._timer = self._loop.call_later(max(0.0, wake_s - self._monotonic()), self._on_timer)

    # --- snapshots ---------------------------------------------------------------------------------

    def _ask_store(self, number: int, call: SandboxCall, function: Callable[..., Any], *args: Any) -> None:
        """Run a function of the store in a thread, and pass its result or error to the policy."""

        def done(future: Any) -> None:
            outcome = future.exception() or future.result()
            self._execute(self._policy.on_store_reply(number, call, outcome, self._monotonic()))

        work = functools.partial(function, self._store, call.queued.robot, call.service, *args)
        self._loop.run_in_executor(None, work).add_done_callback(done)


def _load(store: ObjectStore, robot: RobotId, service: str) -> bytes | None:
    """Return the snapshot, None if there is none; raises StoreError."""
    try:
        return store.get(state_name(robot, service))
    except NotFound:
        return None


def _save(store: ObjectStore, robot: RobotId, service: str, expected: bytes | None, data: bytes) -> None:
    store.compare_and_swap(state_name(robot, service), expected, data)
