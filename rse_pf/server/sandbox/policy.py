"""Decide what happens to the sandboxes of one worker: start, retry, deadline, kill, grace, capacity.

Events come in as method calls with the time, `Action` values come out, and `manager` executes them in
order.  The rules:

- Each robot has at most one sandbox, which works on one command at a time; the others wait in order.
- A command whose sandbox crashed is retried once in a new sandbox, unless its deadline has passed, its
  service keeps state that no snapshot holds, or `CircuitBreaker` refuses it.
- A command is answered at its deadline; its sandbox is killed at a multiple of the deadline, which is no
  crash.
- A sandbox outlives the last connection of its robot by a grace period, unless its place is needed.
- When all places are taken, a robot gets the place of a sandbox in its grace period, or else, by
  `largest_holder`, that of the sandbox which has been idle longest of the tenant that holds most.  If all of
  them work, the place of the first that ends its command is kept for the robot's tenant for `_KEPT_S`.
  State that no snapshot holds is lost.
- Commands that wait for a sandbox which crashed move to the new one.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from rse_pf.config import ServiceSettings
from rse_pf.errors import Busy, Conflict, Expired, Poison, RsePfError, StoreError, WorkerLost
from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import largest_holder
from rse_pf.processes.ipc import encode_message
from rse_pf.server.sandbox.circuit_breaker import CircuitBreaker
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.service import Kind

__all__ = [
    "Action",
    "AnswerCall",
    "CreateSandbox",
    "KillSandbox",
    "LoadSnapshot",
    "LogEnd",
    "ReleaseSandbox",
    "SandboxCall",
    "SandboxPolicy",
    "SandboxReply",
    "SaveSnapshot",
    "SendMessage",
]

START_TIMEOUT_S = 5.0  # a sandbox that is not ready within this time is killed
_MAX_TRIES = 2  # of a command whose sandbox crashed: the crash may have had another cause
_BUSY_RETRY_MS = 1000.0  # pause of a robot that gets no sandbox
_KEPT_S = 3.0  # a free place is kept for a tenant: its refused robot has sent again within this time
_DEADLINE_HINT = "set a longer deadline, or send fewer commands to this service"
_DEADLINE_FACTOR = 2.0  # a sandbox is killed when its command has taken this many times its deadline


@dataclass(eq=False, slots=True)
class SandboxCall:
    """A command on its way through a sandbox; ``data`` is the message that asks for it."""

    queued: QueuedCommand
    digest: str
    data: bytes
    tries: int = 0
    is_answered: bool = False

    @property
    def service(self) -> str:
        """Name of the service."""
        return self.queued.command.service


@dataclass(frozen=True, slots=True)
class SandboxReply:
    """What a service returned, and the state that belongs to it (None: it keeps none)."""

    value: Any
    compute_ms: float
    snapshot: bytes | None = None


@dataclass(frozen=True, slots=True)
class CreateSandbox:
    """Start a process for *robot* and report `on_ready` or `on_exit`."""

    number: int
    robot: RobotId


@dataclass(frozen=True, slots=True)
class SendMessage:
    """Send *data* to the sandbox and report what it `on_reply`."""

    number: int
    data: bytes


@dataclass(frozen=True, slots=True)
class KillSandbox:
    """Kill the process; `on_exit` follows."""

    number: int


@dataclass(frozen=True, slots=True)
class ReleaseSandbox:
    """Kill the process, if it runs, and free what belongs to it; nothing more is reported of it."""

    number: int


@dataclass(frozen=True, slots=True)
class LoadSnapshot:
    """Read the last snapshot of the service and report `on_store_reply`."""

    number: int
    call: SandboxCall


@dataclass(frozen=True, slots=True)
class SaveSnapshot:
    """Replace the snapshot *expected* by *data* and report `on_store_reply`."""

    number: int
    call: SandboxCall
    expected: bytes | None
    data: bytes


@dataclass(frozen=True, slots=True)
class AnswerCall:
    """Answer the robot; at most once for each call."""

    call: SandboxCall
    outcome: SandboxReply | RsePfError


@dataclass(frozen=True, slots=True)
class LogEnd:
    """Log that a sandbox crashed, or was killed because the deadline of its robot had passed.

    ``service`` is "" if it ran none.
    """

    robot: RobotId
    service: str
    reason: str
    is_crash: bool


Action = (
    CreateSandbox
    | SendMessage
    | KillSandbox
    | ReleaseSandbox
    | LoadSnapshot
    | SaveSnapshot
    | AnswerCall
    | LogEnd
)


@dataclass(eq=False, slots=True)
class _Sandbox:
    number: int
    robot: RobotId
    kill_s: float
    """When it is killed: it did not start, or works too long."""
    state: Literal["starting", "idle", "loading", "restoring", "running", "saving", "dying"] = "starting"
    waiting: deque[SandboxCall] = field(default_factory=deque)
    running: SandboxCall | None = None
    late_s: float = math.inf
    """Deadline of the running call."""
    release_s: float = math.inf
    """End of the grace period; infinite while the robot is connected."""
    asked_s: float | None = None
    """When it was sent what it works at; None while it does nothing."""
    snapshots: dict[str, bytes | None] = field(default_factory=dict)
    """Last snapshot of each stateful service, as it stands in the store."""
    unsaved: SandboxReply | None = None
    """The reply whose snapshot is being saved."""
    idle_since_s: float = 0.0
    fault: str = ""
    is_overrun: bool = False
    """It was killed because the deadline of the running call had passed."""


class SandboxPolicy:
    """All sandboxes of one worker; every event returns the actions that follow from it.

    ``breaker`` knows what is refused after crashes, ``counts`` what happened how often, and ``worked_s`` for
    how long the sandboxes of each tenant have worked at requests, whatever they answered.
    """

    def __init__(
        self,
        kinds: Mapping[str, Kind],
        settings: ServiceSettings,
        *,
        max_sandboxes: int,
        keeps_snapshots: bool,
    ) -> None:
        """Begin without any sandbox.

        Args:
            kinds: Kind of each installed service.
            settings: Limits, grace and the rules of the circuit breaker.
            max_sandboxes: Sandboxes of this worker at a time.
            keeps_snapshots: Whether there is a store for the state of services.
        """
        self.counts: Counter[str] = Counter()
        self.worked_s: defaultdict[str, float] = defaultdict(float)
        self._kinds = kinds
        self._settings = settings
        self._max_sandboxes = max_sandboxes
        self._keeps_snapshots = keeps_snapshots
        self.breaker = CircuitBreaker(settings)
        self._sandboxes: dict[int, _Sandbox] = {}
        self._by_robot: dict[RobotId, _Sandbox] = {}
        self._held_by_tenant: Counter[str] = Counter()
        self._next_tenant = ""  # gets the next place of a tenant that holds two more
        self._next_until_s = -math.inf
        self._connections: Counter[RobotId] = Counter()
        self._last_number = 0
        self._actions: list[Action] = []

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return sum(
            len(sandbox.waiting) + (sandbox.running is not None) for sandbox in self._sandboxes.values()
        )

    @property
    def sandboxes(self) -> int:
        """Sandboxes that exist."""
        return len(self._sandboxes)

    @property
    def wake_s(self) -> float:
        """The time at which `tick` is due next; infinite if nothing is waited for."""
        times = (
            min(sandbox.kill_s, sandbox.late_s, sandbox.release_s) for sandbox in self._sandboxes.values()
        )
        return min(times, default=math.inf)

    def waiting_of(self, robot: RobotId) -> int:
        """Return how many commands of *robot* wait."""
        sandbox = self._by_robot.get(robot)
        return 0 if sandbox is None else len(sandbox.waiting)

    # --- events from the gateway -------------------------------------------------------------------

    def add_connection(self, robot: RobotId) -> None:
        """Count one more connection of *robot*: its sandbox, if it still has one, is not released."""
        self._connections[robot] += 1
        if robot in self._by_robot:
            self._by_robot[robot].release_s = math.inf

    def remove_connection(self, robot: RobotId, now: float) -> None:
        """Count one connection of *robot* less; after the last one the grace period of its sandbox begins."""
        self._connections[robot] -= 1
        if self._connections[robot] > 0:
            return
        del self._connections[robot]
        sandbox = self._by_robot.get(robot)
        if sandbox is not None:
            sandbox.waiting.clear()
            sandbox.release_s = now + self._settings.grace_s

    def submit(self, call: SandboxCall, now: float) -> list[Action]:
        """Begin or queue the command of a robot."""
        refusal = self._refusal(call, now)
        sandbox = self._by_robot.get(call.queued.robot)
        if refusal is None and sandbox is None and not self._gets_place(call.queued.robot, now):
            refusal = self._no_place_error()
        if refusal is not None:
            self._answer(call, refusal)
            return self._take_actions()
        sandbox = sandbox or self._create(call.queued.robot, now)
        sandbox.waiting.append(call)
        self._start_next(sandbox, now)
        return self._take_actions()

    # --- events from processes and the store -------------------------------------------------------

    def on_ready(self, number: int, now: float) -> list[Action]:
        """Follow the report that a sandbox has started and takes requests."""
        sandbox = self._sandboxes.get(number)
        if sandbox is None or sandbox.fault:
            return []
        if sandbox.state != "starting":
            return self.on_violation(number, "it reported its start twice")
        sandbox.state, sandbox.kill_s, sandbox.idle_since_s = "idle", math.inf, now
        self._start_next(sandbox, now)
        return self._take_actions()

    def on_reply(self, number: int, outcome: SandboxReply | RsePfError, now: float) -> list[Action]:
        """Follow the answer of a sandbox to its last message; one that is being killed answers too late."""
        sandbox = self._sandboxes.get(number)
        if sandbox is None or sandbox.fault:
            return []
        call = sandbox.running
        if call is None or sandbox.state not in ("restoring", "running"):
            return self.on_violation(number, "it replied without a request")
        self._count_work(sandbox, now)
        if sandbox.state == "restoring" and isinstance(outcome, SandboxReply):
            self._send(sandbox, call, now)
        elif sandbox.state == "restoring":
            del sandbox.snapshots[call.service]  # its state is unknown: the next command restores again
            self._finish(sandbox, call, outcome, now)
        elif (
            isinstance(outcome, RsePfError)
            or outcome.snapshot is None
            or not self._keeps_state(call)
            or outcome.snapshot == sandbox.snapshots[call.service]
        ):
            self._finish(sandbox, call, outcome, now)
        else:
            sandbox.state, sandbox.unsaved = "saving", outcome
            expected = sandbox.snapshots[call.service]
            self._actions.append(SaveSnapshot(number, call, expected, outcome.snapshot))
        return self._take_actions()

    def on_store_reply(
        self, number: int, call: SandboxCall, outcome: bytes | BaseException | None, now: float
    ) -> list[Action]:
        """Follow a reply of the store: a snapshot (None if there is none), a saved one (None), or an error.

        A Conflict means that it holds a newer snapshot: the robot's state was changed on another server.
        """
        sandbox = self._sandboxes.get(number)
        if sandbox is None or sandbox.running is not call or sandbox.state not in ("loading", "saving"):
            return []
        if isinstance(outcome, Conflict):
            self._release(sandbox)
            self._answer(call, _worker_lost(call.service, "its state was changed on another server"))
            self._move_waiting(sandbox, now)
        elif isinstance(outcome, BaseException):
            hint = outcome.hint if isinstance(outcome, RsePfError) else ""
            reason = f"the state of the service cannot be kept: {outcome}"
            failure = StoreError(reason, hint=hint or "send it again")
            self._finish(sandbox, call, failure, now)
        elif sandbox.unsaved is not None:
            sandbox.snapshots[call.service] = sandbox.unsaved.snapshot
            self._finish(sandbox, call, sandbox.unsaved, now)
        else:
            sandbox.snapshots[call.service] = outcome
            if outcome is None:
                self._send(sandbox, call, now)
            else:
                sandbox.state, sandbox.asked_s = "restoring", now
                message = encode_message(["restore", call.service, outcome])
                self._actions.append(SendMessage(number, message))
        return self._take_actions()

    def on_violation(self, number: int, why: str) -> list[Action]:
        """Kill a sandbox that violated the protocol, or closed its channel (*why* is "")."""
        sandbox = self._sandboxes.get(number)
        if sandbox is not None and not sandbox.fault:
            self._kill(sandbox, why)
        return self._take_actions()

    def on_exit(self, number: int, how: str, now: float) -> list[Action]:
        """Follow the end of the process of a sandbox."""
        if number in self._sandboxes:
            self._release_ended(self._sandboxes[number], how, now)
        return self._take_actions()

    def on_all_exited(self, how: str, now: float) -> list[Action]:
        """Follow the end of all sandboxes with their zygote: it is evidence against no service or request."""
        for sandbox in list(self._sandboxes.values()):
            self._release_ended(sandbox, how, now, is_evidence=False)
        return self._take_actions()

    def tick(self, now: float) -> list[Action]:
        """Answer the calls whose deadline has passed, and kill and release the sandboxes that are due."""
        for sandbox in list(self._sandboxes.values()):
            call = sandbox.running
            if sandbox.release_s <= now:
                self.counts["released"] += 1
                self._count_work(sandbox, now)
                self._release(sandbox)
                continue
            if call is not None and sandbox.late_s <= now:
                sandbox.late_s = math.inf
                self._answer(call, Expired("the service did not answer in time", hint=_DEADLINE_HINT))
            if sandbox.kill_s <= now:
                sandbox.is_overrun = call is not None and not sandbox.fault  # else it is being killed
                self._kill(sandbox, "it did not start in time" if call is None else "it took too long")
        return self._take_actions()

    def close(self) -> list[Action]:
        """Release every sandbox and answer no command, because the worker ends."""
        for sandbox in list(self._sandboxes.values()):
            self._release(sandbox)
        return self._take_actions()

    # --- rules -------------------------------------------------------------------------------------

    def _refusal(self, call: SandboxCall, now: float) -> RsePfError | None:
        refusal = self.breaker.refusal(call.queued.robot, call.service, call.digest, now)
        if isinstance(refusal, Poison):
            self.counts["poison"] += 1
        return refusal

    def _gets_place(self, robot: RobotId, now: float) -> bool:
        """Return whether *robot* gets a sandbox; if all places are taken, one may be released for it."""
        if self._may_create(robot.tenant, now):
            return True
        by_idle = sorted(self._sandboxes.values(), key=lambda sandbox: sandbox.idle_since_s)
        held = {sandbox.robot: 1 for sandbox in by_idle}
        donor = self._in_grace() or largest_holder(
            held, robot, lambda other: self._by_robot[other].state == "idle"
        )
        if donor is not None:
            self.counts["released"] += 1
            self._release(self._by_robot[donor])
            return True
        if largest_holder(held, robot, lambda other: True) is not None:
            self._next_tenant, self._next_until_s = robot.tenant, now + _KEPT_S
        return False

    def _in_grace(self) -> RobotId | None:
        """Return the robot without a connection of the tenant that holds most; None if there is none."""
        in_grace = (
            sandbox.robot
            for sandbox in self._sandboxes.values()
            if sandbox.running is None and sandbox.release_s < math.inf
        )
        return max(in_grace, key=lambda robot: self._held_by_tenant[robot.tenant], default=None)

    def _may_create(self, tenant: str, now: float) -> bool:
        """Return whether a place is free for *tenant*: the last one is kept for the next tenant, if any."""
        free = self._max_sandboxes - len(self._sandboxes)
        if tenant == self._next_tenant and free:
            self._next_until_s = -math.inf
        return free > (now < self._next_until_s and self._holds_more(tenant, 1))

    def _holds_more(self, tenant: str, more: int) -> bool:
        return self._held_by_tenant[tenant] >= self._held_by_tenant[self._next_tenant] + more

    def _no_place_error(self) -> Busy:
        return Busy(
            f"all {self._max_sandboxes} sandboxes of this server are in use",
            hint="send the command again after retry_after_ms",
            retry_after_ms=_BUSY_RETRY_MS,
        )

    def _may_retry(self, call: SandboxCall, sandbox: _Sandbox, now: float) -> bool:
        is_stateless = self._kinds[call.service] == "stateless"
        return (
            not call.is_answered
            and call.tries < _MAX_TRIES
            and call.queued.deadline_s > now
            and (is_stateless or sandbox.snapshots.get(call.service) is not None)
            and self.breaker.refusal(call.queued.robot, call.service, call.digest, now) is None
        )

    def _release_ended(self, sandbox: _Sandbox, how: str, now: float, *, is_evidence: bool = True) -> None:
        """Release a sandbox whose process ended by itself or was killed; retry or answer its command."""
        call, why = sandbox.running, sandbox.fault or how
        self._count_work(sandbox, now)
        self._release(sandbox)
        service, reason = "" if call is None else call.service, f"{why} ({how})"
        self.counts["overran" if sandbox.is_overrun else "crashed"] += 1
        self._actions.append(LogEnd(sandbox.robot, service, reason, is_crash=not sandbox.is_overrun))
        if call is not None:
            if sandbox.is_overrun:
                self.breaker.note_overrun(sandbox.robot, service, now)
            elif is_evidence:
                self.breaker.note_crash(sandbox.robot, service, call.digest, now)
            call.tries += 1
            if self._may_retry(call, sandbox, now):
                sandbox.waiting.appendleft(call)
            else:
                self._answer(call, self._refusal(call, now) or _worker_lost(service, why))
        if sandbox.state == "starting":
            while sandbox.waiting:
                waiting = sandbox.waiting.popleft()
                self._answer(waiting, _worker_lost(waiting.service, why))
        self._move_waiting(sandbox, now)

    def _move_waiting(self, sandbox: _Sandbox, now: float) -> None:
        """Move the commands that waited for a released sandbox to a new one."""
        if not sandbox.waiting or self._connections[sandbox.robot] == 0:
            return
        if self._may_create(sandbox.robot.tenant, now):
            self._create(sandbox.robot, now).waiting.extend(sandbox.waiting)
        else:
            self._refuse_waiting(sandbox)

    def _refuse_waiting(self, sandbox: _Sandbox) -> None:
        while sandbox.waiting:
            self._answer(sandbox.waiting.popleft(), self._no_place_error())

    # --- steps -------------------------------------------------------------------------------------

    def _create(self, robot: RobotId, now: float) -> _Sandbox:
        self._last_number += 1
        sandbox = _Sandbox(self._last_number, robot, kill_s=now + START_TIMEOUT_S)
        self._sandboxes[sandbox.number] = self._by_robot[robot] = sandbox
        self._held_by_tenant[robot.tenant] += 1
        self.counts["created"] += 1
        self._actions.append(CreateSandbox(sandbox.number, robot))
        return sandbox

    def _release(self, sandbox: _Sandbox) -> None:
        del self._sandboxes[sandbox.number], self._by_robot[sandbox.robot]
        self._held_by_tenant -= Counter([sandbox.robot.tenant])
        self._actions.append(ReleaseSandbox(sandbox.number))

    def _kill(self, sandbox: _Sandbox, why: str) -> None:
        sandbox.fault = sandbox.fault or why
        sandbox.kill_s = math.inf
        if sandbox.state == "idle":
            sandbox.state = "dying"  # a command that comes now waits for the next sandbox
        self._actions.append(KillSandbox(sandbox.number))

    def _start_next(self, sandbox: _Sandbox, now: float) -> None:
        """Start the next call of an idle sandbox; refuse those that are no longer worth it."""
        while sandbox.state == "idle" and not sandbox.fault and sandbox.waiting:
            call = sandbox.waiting.popleft()
            queued, refusal = call.queued, self._refusal(call, now)
            if refusal is None and queued.deadline_s <= now:
                refusal = Expired("the deadline passed before the service was called", hint=_DEADLINE_HINT)
            if refusal is not None:
                self._answer(call, refusal)
                continue
            sandbox.running, queued.started_s = call, now
            sandbox.late_s = queued.deadline_s
            allowed_s = queued.deadline_s - queued.received_s
            sandbox.kill_s = queued.received_s + allowed_s * _DEADLINE_FACTOR
            if self._keeps_state(call) and call.service not in sandbox.snapshots:
                sandbox.state = "loading"
                self._actions.append(LoadSnapshot(sandbox.number, call))
            else:
                self._send(sandbox, call, now)

    def _send(self, sandbox: _Sandbox, call: SandboxCall, now: float) -> None:
        sandbox.state, sandbox.asked_s = "running", now
        if not sandbox.fault:
            self._actions.append(SendMessage(sandbox.number, call.data))

    def _count_work(self, sandbox: _Sandbox, now: float) -> None:
        if sandbox.asked_s is not None:
            self.worked_s[sandbox.robot.tenant] += now - sandbox.asked_s
            sandbox.asked_s = None

    def _finish(
        self, sandbox: _Sandbox, call: SandboxCall, outcome: SandboxReply | RsePfError, now: float
    ) -> None:
        sandbox.state, sandbox.running, sandbox.unsaved = "idle", None, None
        sandbox.late_s = sandbox.kill_s = math.inf
        sandbox.idle_since_s = now
        self._answer(call, outcome)
        is_full = len(self._sandboxes) == self._max_sandboxes
        if is_full and now < self._next_until_s and self._holds_more(sandbox.robot.tenant, 2):
            self.counts["released"] += 1
            self._refuse_waiting(sandbox)
            self._release(sandbox)
        else:
            self._start_next(sandbox, now)

    def _answer(self, call: SandboxCall, outcome: SandboxReply | RsePfError) -> None:
        if not call.is_answered:
            call.is_answered = True
            self._actions.append(AnswerCall(call, outcome))

    def _keeps_state(self, call: SandboxCall) -> bool:
        return self._keeps_snapshots and self._kinds[call.service] == "per_robot_state"

    def _take_actions(self) -> list[Action]:
        actions, self._actions = self._actions, []
        return actions


def _worker_lost(service: str, why: str) -> WorkerLost:
    return WorkerLost(
        f"service {service!r} ended while it worked on this command: {why}",
        hint="the server's log has what it printed last",
    )
