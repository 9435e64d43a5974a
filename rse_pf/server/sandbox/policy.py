"""Decide when the sandboxes of one worker start, receive commands, are killed and are released.

Each event is a method call with the time, and returns `Action` values, which `manager` executes in order.
A worker has ``max_sandboxes`` places for sandboxes.  The rules:

- Each robot has at most one sandbox, which works on one command at a time; other commands of the robot wait
  in order.
- A command whose sandbox crashed is retried once in a new sandbox, unless its deadline has passed, its
  service keeps state that is in no snapshot, or `CircuitBreaker` refuses the command.
- A command without a result at its deadline is answered by an error.  If the service still works on the
  command after `_DEADLINE_FACTOR` times the allowed time, its sandbox is killed; that does not count as a
  crash.
- A sandbox is kept for a grace period after the last connection of its robot, unless another robot needs its
  place.
- When all places are taken, a new robot gets the place of a sandbox in its grace period.  If there is none,
  it gets the place of the longest idle sandbox of the tenant with the most sandboxes, if that tenant has at
  least two more than the tenant of the new robot (`largest_holder`).  If all those sandboxes work on
  commands, the new robot is refused, but the first place that becomes free is kept for its tenant for
  `_KEPT_S`.  State that is in no snapshot is lost with a sandbox.
- Commands that wait for a sandbox which crashed move to its successor.
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

START_TIMEOUT_S = 5.0  # seconds after which a sandbox that has not reported its start is killed
_MAX_TRIES = 2  # sandboxes in which one command runs at most: a crash may have another cause than the command
_BUSY_RETRY_MS = 1000.0  # milliseconds after which a robot that got no sandbox is asked to send again
_KEPT_S = 3.0  # seconds for which a place is kept for a refused robot, which asks again after _BUSY_RETRY_MS
_DEADLINE_HINT = "set a longer deadline, or send fewer commands to this service"
_DEADLINE_FACTOR = 2.0  # a sandbox is killed after this many times the time that its command is allowed


@dataclass(eq=False, slots=True)
class SandboxCall:
    """A command that a sandbox is to execute.

    Attributes:
        queued: The command with its robot and deadline.
        digest: SHA-256 in hex of *data*, by which `CircuitBreaker` recognises the same request.
        data: The encoded message with which the sandbox is asked to execute the command.
        tries: How many sandboxes ended while they worked on the command.
        is_answered: Whether the robot has an answer; a later result is dropped.
    """

    queued: QueuedCommand
    digest: str
    data: bytes
    tries: int = 0
    is_answered: bool = False

    @property
    def service(self) -> str:
        """Name of the service that the command calls."""
        return self.queued.command.service


@dataclass(frozen=True, slots=True)
class SandboxReply:
    """The reply of a service to a request.

    Attributes:
        value: The decoded reply.
        compute_ms: Time in milliseconds that the sandbox needed for the request.
        snapshot: State of the service after the request; None if the service has no snapshots.
    """

    value: Any
    compute_ms: float
    snapshot: bytes | None = None


@dataclass(frozen=True, slots=True)
class CreateSandbox:
    """Start sandbox *number* for *robot*; call `SandboxPolicy.on_ready` when it is ready, or `on_exit`."""

    number: int
    robot: RobotId


@dataclass(frozen=True, slots=True)
class SendMessage:
    """Send the encoded message *data* to sandbox *number*; call `SandboxPolicy.on_reply` with its answer."""

    number: int
    data: bytes


@dataclass(frozen=True, slots=True)
class KillSandbox:
    """Kill the process of sandbox *number*; call `SandboxPolicy.on_exit` when it has exited."""

    number: int


@dataclass(frozen=True, slots=True)
class ReleaseSandbox:
    """Kill the process of sandbox *number*, if it runs, and close its channel; no event of it follows."""

    number: int


@dataclass(frozen=True, slots=True)
class LoadSnapshot:
    """Read the stored snapshot of the robot and service of *call* for `SandboxPolicy.on_store_reply`."""

    number: int
    call: SandboxCall


@dataclass(frozen=True, slots=True)
class SaveSnapshot:
    """Store the snapshot *data* for the robot and service of *call*, if *expected* is the stored snapshot.

    *expected* is None if no snapshot is stored.  The result is passed to `SandboxPolicy.on_store_reply`.
    """

    number: int
    call: SandboxCall
    expected: bytes | None
    data: bytes


@dataclass(frozen=True, slots=True)
class AnswerCall:
    """Answer *call* with a reply or an error; there is at most one such action for each call."""

    call: SandboxCall
    outcome: SandboxReply | RsePfError


@dataclass(frozen=True, slots=True)
class LogEnd:
    """Log that a sandbox of *robot* crashed, or was killed because a command took too long.

    Attributes:
        robot: The robot.
        service: Name of the service that the sandbox worked for; "" if it worked on no command.
        reason: Why and how the process ended, in words.
        is_crash: False if the sandbox was killed because its command took too long.
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
    """One sandbox; times are monotonic seconds.

    Attributes:
        number: Number of the sandbox, which is never used again.
        robot: The robot whose commands it executes.
        kill_s: When the sandbox is killed, because it has not started, or its command takes too long.
        state: ``starting`` until it is ready, ``idle`` without a command; for the running call ``loading``
            (the snapshot is read from the store), ``restoring`` (the sandbox sets the state of the service to
            the snapshot), ``running`` (the service is called), ``saving`` (the new snapshot is stored);
            ``dying`` after an idle sandbox was ordered to be killed.
        waiting: Commands that wait, in order.
        running: The command on which the sandbox works, None if there is none.
        late_s: Deadline of the running command, infinite after the robot was sent an error for it.
        release_s: End of the grace period; infinite while the robot is connected.
        asked_s: When the sandbox was sent the request on which it works; None while it works on no request.
        snapshots: The snapshot of each stateful service that is in the store (None: there is none).
        unsaved: The reply of the running command while its snapshot is being stored.
        idle_since_s: When the sandbox became idle.
        fault: Why the sandbox is being killed; "" if it is not being killed, or closed its channel itself.
        is_overrun: Whether the sandbox is killed because its command took too long.
    """

    number: int
    robot: RobotId
    kill_s: float
    state: Literal["starting", "idle", "loading", "restoring", "running", "saving", "dying"] = "starting"
    waiting: deque[SandboxCall] = field(default_factory=deque)
    running: SandboxCall | None = None
    late_s: float = math.inf
    release_s: float = math.inf
    asked_s: float | None = None
    snapshots: dict[str, bytes | None] = field(default_factory=dict)
    unsaved: SandboxReply | None = None
    idle_since_s: float = 0.0
    fault: str = ""
    is_overrun: bool = False


class SandboxPolicy:
    """The state of all sandboxes of one worker; an event method returns the actions that follow, in order.

    All times are monotonic seconds.

    Attributes:
        breaker: Decides which services and requests are refused after crashes.
        counts: How often sandboxes were ``created``, were ``released`` (after the grace period, or for
            another robot), ``crashed`` and ``overran``, and how often a ``poison`` request was refused.
        worked_s: For each tenant the elapsed seconds for which its sandboxes have worked on requests, with
            any result.
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
            kinds: Kind of each installed service by name: only those of kind ``per_robot_state`` have
                snapshots.
            settings: Grace period, and number of crashes that open a circuit breaker.
            max_sandboxes: Most sandboxes of this worker at a time.
            keeps_snapshots: Whether there is an object store for snapshots.
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
        self._next_tenant = ""  # the tenant for which the next free place is kept until _next_until_s
        self._next_until_s = -math.inf
        self._connections: Counter[RobotId] = Counter()
        self._last_number = 0
        self._actions: list[Action] = []

    @property
    def held(self) -> int:
        """Number of commands that wait for their sandbox or run in it."""
        return sum(
            len(sandbox.waiting) + (sandbox.running is not None) for sandbox in self._sandboxes.values()
        )

    @property
    def sandboxes(self) -> int:
        """Number of sandboxes that have not been released, including those that start or are being killed."""
        return len(self._sandboxes)

    @property
    def wake_s(self) -> float:
        """Monotonic time in seconds at which `tick` must be called next; infinite if no time limit runs."""
        times = (
            min(sandbox.kill_s, sandbox.late_s, sandbox.release_s) for sandbox in self._sandboxes.values()
        )
        return min(times, default=math.inf)

    def waiting_of(self, robot: RobotId) -> int:
        """Return how many commands of *robot* wait; the running one is not counted."""
        sandbox = self._by_robot.get(robot)
        return 0 if sandbox is None else len(sandbox.waiting)

    # --- events of robots: connections and commands -------------------------------------------------

    def add_connection(self, robot: RobotId) -> None:
        """Count one more connection of *robot*, and end the grace period of its sandbox, if it has one."""
        self._connections[robot] += 1
        if robot in self._by_robot:
            self._by_robot[robot].release_s = math.inf

    def remove_connection(self, robot: RobotId, now: float) -> None:
        """Count one connection of *robot* less.

        After the last connection, the waiting commands of the robot are dropped without an answer, and the
        grace period of its sandbox begins.
        """
        self._connections[robot] -= 1
        if self._connections[robot] > 0:
            return
        del self._connections[robot]
        sandbox = self._by_robot.get(robot)
        if sandbox is not None:
            sandbox.waiting.clear()
            sandbox.release_s = now + self._settings.grace_s

    def submit(self, call: SandboxCall, now: float) -> list[Action]:
        """Start the command *call*, let it wait for its robot's sandbox, or answer it with an error.

        The error is that of `CircuitBreaker.refusal`, or Busy if the robot gets no sandbox.
        """
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

    # --- events of processes, of the object store and of the timer -----------------------------------

    def on_ready(self, number: int, now: float) -> list[Action]:
        """Handle the message of sandbox *number* that it has started and takes requests."""
        sandbox = self._sandboxes.get(number)
        if sandbox is None or sandbox.fault:
            return []
        if sandbox.state != "starting":
            return self.on_violation(number, "it reported its start twice")
        sandbox.state, sandbox.kill_s, sandbox.idle_since_s = "idle", math.inf, now
        self._start_next(sandbox, now)
        return self._take_actions()

    def on_reply(self, number: int, outcome: SandboxReply | RsePfError, now: float) -> list[Action]:
        """Handle the answer of sandbox *number* to its last request.

        The answer to a call is passed to the robot; if the snapshot has changed, after the snapshot was
        stored.  After a successful ``restore``, the call itself is sent; after a failed one, the call is
        answered by the error.  An answer of a sandbox that is being killed is ignored.
        """
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
            del sandbox.snapshots[call.service]  # the service's state is unknown: load the snapshot again
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
        """Handle the result of `LoadSnapshot` or `SaveSnapshot`.

        Args:
            number: Number of the sandbox.
            call: The command for which the snapshot was loaded or stored; it is answered by StoreError if
                *outcome* is an exception.
            outcome: The loaded snapshot, or None if there is none; None after a snapshot was stored; or the
                exception.  A Conflict means that another server has stored a newer snapshot: the sandbox is
                released, and *call* is answered by WorkerLost.
            now: Monotonic seconds.
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
            reason = f"the state of service {call.service!r} cannot be loaded or stored: {outcome}"
            failure = StoreError(reason, hint=hint or "send the command again")
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
        """Kill sandbox *number*, because it sent an invalid message (*why*) or closed its channel ("")."""
        sandbox = self._sandboxes.get(number)
        if sandbox is not None and not sandbox.fault:
            self._kill(sandbox, why)
        return self._take_actions()

    def on_exit(self, number: int, how: str, now: float) -> list[Action]:
        """Handle the end of the process of sandbox *number*; *how* is the reason in words."""
        if number in self._sandboxes:
            self._release_ended(self._sandboxes[number], how, now)
        return self._take_actions()

    def on_all_exited(self, how: str, now: float) -> list[Action]:
        """Handle the end of the zygote, with which all sandboxes were killed.

        Commands are retried or answered as after a crash, but `CircuitBreaker` does not count the crashes.
        """
        for sandbox in list(self._sandboxes.values()):
            self._release_ended(sandbox, how, now, is_evidence=False)
        return self._take_actions()

    def tick(self, now: float) -> list[Action]:
        """Apply all time limits that have passed at *now*.

        Sandboxes whose grace period has ended are released, running commands whose deadline has passed are
        answered by Expired, and sandboxes that did not start or work too long are killed.
        """
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
                sandbox.is_overrun = call is not None and not sandbox.fault  # fault: it is killed already
                self._kill(sandbox, "it did not start in time" if call is None else "it took too long")
        return self._take_actions()

    def close(self) -> list[Action]:
        """Release every sandbox without an answer to its commands, because the worker exits."""
        for sandbox in list(self._sandboxes.values()):
            self._release(sandbox)
        return self._take_actions()

    # --- rules: refusal, capacity and retry ---------------------------------------------------------

    def _refusal(self, call: SandboxCall, now: float) -> RsePfError | None:
        """Return the error of the circuit breaker for *call*, None if it may run; count poison requests."""
        refusal = self.breaker.refusal(call.queued.robot, call.service, call.digest, now)
        if isinstance(refusal, Poison):
            self.counts["poison"] += 1
        return refusal

    def _gets_place(self, robot: RobotId, now: float) -> bool:
        """Return whether *robot* may have a sandbox now; release one for it if all places are taken.

        If no sandbox can be released now, but one of a larger tenant could be while idle, the next free place
        is kept for the tenant of *robot*.
        """
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
        """Return a robot whose sandbox is in its grace period and runs no command; None if there is none.

        Of several robots, the result belongs to the tenant with the most sandboxes.
        """
        in_grace = (
            sandbox.robot
            for sandbox in self._sandboxes.values()
            if sandbox.running is None and sandbox.release_s < math.inf
        )
        return max(in_grace, key=lambda robot: self._held_by_tenant[robot.tenant], default=None)

    def _may_create(self, tenant: str, now: float) -> bool:
        """Return whether *tenant* may use a free place for a sandbox now.

        While a place is kept for ``_next_tenant``, another tenant with more sandboxes than ``_next_tenant``
        may not use the last free place.  If *tenant* is ``_next_tenant`` and a place is free, the result is
        True, and no place is kept any longer; if none is free, a place stays kept until ``_next_until_s``.
        """
        free = self._max_sandboxes - len(self._sandboxes)
        if tenant == self._next_tenant and free:
            self._next_until_s = -math.inf
        return free > (now < self._next_until_s and self._holds_more(tenant, 1))

    def _holds_more(self, tenant: str, more: int) -> bool:
        """Return whether *tenant* has at least *more* sandboxes more than ``_next_tenant`` has."""
        return self._held_by_tenant[tenant] >= self._held_by_tenant[self._next_tenant] + more

    def _no_place_error(self) -> Busy:
        return Busy(
            f"all {self._max_sandboxes} sandboxes of this worker are in use",
            hint="send the command again after retry_after_ms",
            retry_after_ms=_BUSY_RETRY_MS,
        )

    def _may_retry(self, call: SandboxCall, sandbox: _Sandbox, now: float) -> bool:
        """Return whether *call*, during which *sandbox* ended, is repeated in a new sandbox."""
        is_stateless = self._kinds[call.service] == "stateless"
        return (
            not call.is_answered
            and call.tries < _MAX_TRIES
            and call.queued.deadline_s > now
            and (is_stateless or sandbox.snapshots.get(call.service) is not None)
            and self.breaker.refusal(call.queued.robot, call.service, call.digest, now) is None
        )

    def _release_ended(self, sandbox: _Sandbox, how: str, now: float, *, is_evidence: bool = True) -> None:
        """Release a sandbox whose process has ended; log the end, and retry or answer its running command.

        Waiting commands move to a new sandbox; if the sandbox ended before it was ready, they are answered by
        WorkerLost.  Without *is_evidence*, a crash is not counted by the circuit breaker.
        """
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
        """Move the commands that wait for the released *sandbox* to a new sandbox of the same robot.

        If no place is free, they are answered by Busy.  If the robot has no connection, nothing is done.
        """
        if not sandbox.waiting or self._connections[sandbox.robot] == 0:
            return
        if self._may_create(sandbox.robot.tenant, now):
            self._create(sandbox.robot, now).waiting.extend(sandbox.waiting)
        else:
            self._refuse_waiting(sandbox)

    def _refuse_waiting(self, sandbox: _Sandbox) -> None:
        while sandbox.waiting:
            self._answer(sandbox.waiting.popleft(), self._no_place_error())

    # --- transitions of one sandbox, which append the actions ----------------------------------------

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
            sandbox.state = (
                "dying"  # no longer idle, so a command that arrives now waits for the next sandbox
            )
        self._actions.append(KillSandbox(sandbox.number))

    def _start_next(self, sandbox: _Sandbox, now: float) -> None:
        """Start the next waiting command if *sandbox* is idle.

        Commands that the circuit breaker refuses, or whose deadline has passed, are answered by an error.
        """
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
        """Add the time from the last request of *sandbox* to *now* to ``worked_s``; its work ends now."""
        if sandbox.asked_s is not None:
            self.worked_s[sandbox.robot.tenant] += now - sandbox.asked_s
            sandbox.asked_s = None

    def _finish(
        self, sandbox: _Sandbox, call: SandboxCall, outcome: SandboxReply | RsePfError, now: float
    ) -> None:
        """Answer *call* with *outcome*, and start the next waiting command of its *sandbox*.

        If the place of the sandbox is needed for the tenant that waits for one, the sandbox is released
        instead, and its waiting commands are answered by Busy.
        """
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
        f"the sandbox of service {service!r} ended while it worked on this command: {why}",
        hint="read in the server's log what the service printed last",
    )
