"""The sandboxes of a worker whose services may be replaced while robots are connected.

A replacement gets a zygote and sandboxes of its own.  It takes new commands once its zygote is ready and the
isolation is complete; until then, and if that fails, the former ones go on.  The commands of one robot keep
their order: one that arrives while an earlier one is with the former sandboxes waits for its answer.  State
that a snapshot holds moves with the robot.
"""

from __future__ import annotations

import functools
from asyncio import TimerHandle
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from rse_pf.identity import RobotId
from rse_pf.server.sandbox.circuit_breaker import Block
from rse_pf.server.sandbox.manager import SandboxHost, SandboxManager
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueBacklog, QueuedCommand, QueueReport
from rse_pf.service import failure_of, unknown_service
from rse_pf.services.custom.installed import InstalledService
from rse_pf.wire import Failure, Result

__all__ = ["Answer", "MakeSandboxes", "OnReady", "ReloadingSandboxes"]

Answer = Callable[[QueuedCommand, Result | Failure], None]
OnReady = Callable[[tuple[str, ...] | None], None]


MakeSandboxes = Callable[..., SandboxManager]
"""Makes the sandboxes of some services; blocks until they are ready unless *on_ready* is given."""


@dataclass(eq=False, slots=True)
class _Generation:
    """The services of one time, and how many commands of each robot have no answer yet."""

    names: tuple[str, ...]
    sandboxes: SandboxManager | None = None
    unanswered: Counter[RobotId] = field(default_factory=Counter)


class ReloadingSandboxes(CommandQueue):
    """The queue of installed services: what the dispatcher knows of the sandboxes of its worker."""

    def __init__(
        self,
        make: MakeSandboxes,
        *,
        accepts_weak_isolation: bool,
        start_timeout_s: float,
        host: SandboxHost,
        on_change: Callable[[tuple[str, ...]], None],
    ) -> None:
        """Run nothing yet.

        Args:
            make: Makes and starts the sandboxes.
            accepts_weak_isolation: ``services.accept_weak_isolation``.
            start_timeout_s: A replacement that is not ready after this is given up.
            host: The worker.
            on_change: Called with the names of the services that run from now on.
        """
        self._make = make
        self._accepts_weak_isolation = accepts_weak_isolation
        self._start_timeout_s = start_timeout_s
        self._server_id = host.server_id
        self._loop = host.loop
        self._log = host.log
        self._answer = host.answer
        self._on_change = on_change
        self._connections: Counter[RobotId] = Counter()
        self._waiting: dict[RobotId, deque[QueuedCommand]] = {}
        self._retiring: list[_Generation] = []
        self._next: _Generation | None = None
        self._give_up: TimerHandle | None = None
        self._past_s: defaultdict[str, float] = defaultdict(float)
        self._past: Counter[str] = Counter()
        """Counts of sandboxes that have ended."""
        self._current = _Generation(())

    def start(self, services: Sequence[InstalledService]) -> None:
        """Run *services*, and wait until they are ready; without any, start no process.

        Raises:
            ConfigurationError: A means of isolation is missing and weak isolation was not accepted.
        """
        first = _Generation(tuple(service.name for service in services))
        if services:
            first.sandboxes = self._make_manager(services, first, None)
        self._current = first

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the services that run."""
        return self._current.names

    # --- replacement ---------------------------------------------------------------------------------

    def replace(self, services: Sequence[InstalledService]) -> None:
        """Run *services* instead as soon as they are ready; a replacement that is not yet is dropped."""
        self._drop_next()
        fresh = _Generation(tuple(service.name for service in services))
        if not services:
            self._switch(fresh)
            return
        self._next = fresh
        self._give_up = self._loop.call_later(self._start_timeout_s, self._refuse, fresh, "it did not start")
        fresh.sandboxes = self._make_manager(services, fresh, functools.partial(self._on_ready, fresh))

    def _make_manager(
        self, services: Sequence[InstalledService], generation: _Generation, on_ready: OnReady | None
    ) -> SandboxManager:
        answer = functools.partial(self._on_answer, generation)
        return self._make(services, answer=answer, on_ready=on_ready)

    def _on_ready(self, fresh: _Generation, missing: tuple[str, ...] | None) -> None:
        if fresh is not self._next:
            return
        if missing is None:
            fresh.sandboxes = None  # its zygote has ended, so there is nothing to close
            self._refuse(fresh, "its zygote ended")
        elif missing and not self._accepts_weak_isolation:
            self._refuse(fresh, f"this machine lacks {', '.join(missing)}")
        else:
            self._end_wait()
            self._switch(fresh)

    def _refuse(self, fresh: _Generation, why: str) -> None:
        if fresh is self._next:
            self._drop_next()
            self._log.error("services-refused", services=", ".join(fresh.names), reason=why)

    def _drop_next(self) -> None:
        dropped = self._next
        self._end_wait()
        if dropped is not None and dropped.sandboxes is not None:
            dropped.sandboxes.retire()

    def _end_wait(self) -> None:
        self._next = None
        if self._give_up is not None:
            self._give_up.cancel()
            self._give_up = None

    def _switch(self, fresh: _Generation) -> None:
        former, self._current = self._current, fresh
        if fresh.sandboxes is not None:
            for robot, count in self._connections.items():
                for _ in range(count):
                    fresh.sandboxes.add_connection(robot)
        if former.sandboxes is not None:
            self._retiring.append(former)
            self._loop.call_soon(self._end_if_idle, former)
        self._log.info("services-loaded", services=", ".join(fresh.names))
        self._on_change(fresh.names)

    def _end_if_idle(self, former: _Generation) -> None:
        """End sandboxes that have answered everything; each command is answered at its deadline at last."""
        if former in self._retiring and not former.unanswered and former.sandboxes is not None:
            self._retiring.remove(former)
            self._past.update(former.sandboxes.report()["counts"])
            for tenant, worked_s in former.sandboxes.cpu_by_tenant().items():
                self._past_s[tenant] += worked_s
            former.sandboxes.retire()

    # --- commands ------------------------------------------------------------------------------------

    def offers(self, service: str) -> bool:
        """Return whether *service* is one of those that run."""
        return service in self._current.names

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Run *queued* in its robot's sandbox; the answer comes through the callback."""
        if self._is_held(queued.robot):
            self._waiting.setdefault(queued.robot, deque()).append(queued)
        else:
            self._run(queued)

    def _run(self, queued: QueuedCommand) -> None:
        sandboxes, service = self._current.sandboxes, queued.command.service
        if sandboxes is None or not self.offers(service):
            error = unknown_service(service, self._current.names)
            self._answer(queued, failure_of(error, queued.command, server=self._server_id))
            return
        self._current.unanswered[queued.robot] += 1
        sandboxes.submit(queued)

    def _on_answer(self, generation: _Generation, queued: QueuedCommand, message: Result | Failure) -> None:
        robot = queued.robot
        if generation.unanswered[robot] > 1:
            generation.unanswered[robot] -= 1
        else:
            del generation.unanswered[robot]
        self._answer(queued, message)
        if generation is not self._current:
            self._loop.call_soon(self._go_on, robot)
            self._loop.call_soon(self._end_if_idle, generation)

    def _is_held(self, robot: RobotId) -> bool:
        return robot in self._waiting or any(robot in generation.unanswered for generation in self._retiring)

    def _go_on(self, robot: RobotId) -> None:
        """Run what waited for the former sandboxes of *robot*."""
        if any(robot in generation.unanswered for generation in self._retiring):
            return
        for queued in self._waiting.pop(robot, ()):
            self._run(queued)

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Do nothing: the command is answered before its deadline."""

    # --- robots --------------------------------------------------------------------------------------

    def enter(self, owner: Any) -> None:
        """Note a connection, whose robot keeps its sandbox."""
        self._connections[owner.robot] += 1
        for sandboxes in self._all:
            sandboxes.add_connection(owner.robot)

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Note the end of a connection; nobody waits for the commands of a robot that has none."""
        robot = owner.robot
        self._connections[robot] -= 1
        is_gone = self._connections[robot] <= 0
        if is_gone:
            del self._connections[robot]
            self._waiting.pop(robot, None)
        for sandboxes in self._all:
            sandboxes.remove_connection(robot)
        if is_gone:
            for generation in (self._current, *self._retiring):
                del generation.unanswered[robot]
                self._loop.call_soon(self._end_if_idle, generation)
        return []

    def close(self) -> None:
        """End every sandbox and the zygotes."""
        self._drop_next()
        for sandboxes in self._all:
            sandboxes.close()

    @property
    def _all(self) -> list[SandboxManager]:
        managers = (generation.sandboxes for generation in (self._current, *self._retiring))
        return [manager for manager in managers if manager is not None]

    # --- what is shown -------------------------------------------------------------------------------

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return sum(manager.held for manager in self._all) + sum(map(len, self._waiting.values()))

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return how many commands of the robot wait."""
        robot = queued.robot
        here = len(self._waiting.get(robot, ()))
        return QueueBacklog(here + sum(manager.waiting_of(robot) for manager in self._all))

    def report(self) -> QueueReport:
        """Return the state and the counts of this worker's sandboxes for /readyz and /metrics."""
        reports = [manager.report() for manager in self._all]
        counts = Counter(self._past)
        for report in reports:
            counts.update(report["counts"])
        current = self._current.sandboxes
        newest = {} if current is None else current.report()
        count = sum(report["sandboxes"] for report in reports)
        isolation = {
            "sandboxes": count,
            "missing_isolation": newest.get("missing_isolation", []),
            "open_breakers": newest.get("open_breakers", []),
            "counts": dict(counts),
            "services": list(self.names),
        }
        worked = self._past_s.copy()
        for manager in self._all:
            for tenant, worked_s in manager.cpu_by_tenant().items():
                worked[tenant] += worked_s
        return QueueReport(
            gauges={"sandboxes": float(count)},
            cpu_s={"sandboxes": dict(worked)},
            sections={"isolation": isolation},
        )

    def blocks(self) -> list[Block]:
        """Return the services and requests that are refused now after crashes, with their robots."""
        current = self._current.sandboxes
        return [] if current is None else current.blocks()

    def unblock(self, service: str | None, tenant: str | None, robot: str | None) -> list[Block]:
        """Lift what is refused (None stands for all), and return what it was."""
        current = self._current.sandboxes
        return [] if current is None else current.unblock(service, tenant, robot)
