"""Replace the installed services of a worker by another set while robots are connected.

Each set of services is a generation, with a zygote and sandboxes of its own.  New commands go to the next
generation as soon as its zygote is ready, and no means of isolation is missing (unless the settings accept
that); until then, and if that fails,
the current generation continues.  The commands of one robot keep their order: a command that arrives while an
earlier one of its robot runs in a former generation waits for that one's answer.  State that is in a snapshot
is restored in the next generation.
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
"""Called with a command and its answer."""
OnReady = Callable[[tuple[str, ...] | None], None]
"""Called when a zygote is ready, with the missing means of isolation, or with None when it has exited."""


MakeSandboxes = Callable[..., SandboxManager]
"""Makes and starts a `SandboxManager` for its argument, a sequence of `InstalledService`.

The keywords are ``answer`` (`Answer`) and ``on_ready`` (`OnReady` or None); with None, the call blocks until
the zygote is ready.
"""


@dataclass(eq=False, slots=True)
class _Generation:
    """A set of services and their sandboxes.

    Attributes:
        names: Names of the services.
        sandboxes: The sandboxes; None without services, or after their zygote has exited.
        unanswered: Number of commands without an answer, by robot.
    """

    names: tuple[str, ...]
    sandboxes: SandboxManager | None = None
    unanswered: Counter[RobotId] = field(default_factory=Counter)


class ReloadingSandboxes(CommandQueue):
    """The command queue of a worker's installed services, which can be replaced while commands run."""

    def __init__(
        self,
        make: MakeSandboxes,
        *,
        accepts_weak_isolation: bool,
        start_timeout_s: float,
        host: SandboxHost,
        on_change: Callable[[tuple[str, ...]], None],
    ) -> None:
        """Begin without services.

        Args:
            make: Makes and starts the sandboxes of a generation.
            accepts_weak_isolation: Setting ``services.accept_weak_isolation``: whether services run if a
                means of isolation is missing.
            start_timeout_s: Seconds after which a replacement whose zygote is not ready is given up.
            host: Event loop, clock, log and answers of the worker.
            on_change: Called with the names of the new services after each replacement.
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
        self._waiting: dict[RobotId, deque[QueuedCommand]] = {}  # for answers of former generations
        self._retiring: list[
            _Generation
        ] = []  # former generations that still have commands without an answer
        self._next: _Generation | None = None  # the replacement whose zygote is not ready yet
        self._give_up: TimerHandle | None = None
        self._past_s: defaultdict[str, float] = defaultdict(float)
        """Working seconds by tenant in generations that have ended."""
        self._past: Counter[str] = Counter()
        """`SandboxPolicy.counts` of generations that have ended."""
        self._current = _Generation(())

    def start(self, services: Sequence[InstalledService]) -> None:
        """Run the first *services*, and block until their zygote is ready; with none, start no process.

        Raises:
            ConfigurationError: The zygote did not start, or a means of isolation is missing and weak
                isolation is not accepted.
        """
        first = _Generation(tuple(service.name for service in services))
        if services:
            first.sandboxes = self._make_manager(services, first, None)
        self._current = first

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the services of the current generation."""
        return self._current.names

    # --- replacement of a generation by the next one -------------------------------------------------

    def replace(self, services: Sequence[InstalledService]) -> None:
        """Replace the current services by *services* as soon as their zygote is ready; does not block.

        An earlier replacement that is not ready yet is dropped.  If the zygote does not start in time, or a
        means of isolation is missing and that is not accepted, the current services continue, and the error
        event ``services-refused`` is logged.
        """
        self._drop_next()
        fresh = _Generation(tuple(service.name for service in services))
        if not services:
            self._switch(fresh)
            return
        self._next = fresh
        self._give_up = self._loop.call_later(
            self._start_timeout_s, self._refuse, fresh, "its zygote did not start in time"
        )
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
        """End the sandboxes of a former generation if all its commands are answered, and add up its counts.

        This happens at the latest at the last deadline, at which every command is answered.
        """
        if former in self._retiring and not former.unanswered and former.sandboxes is not None:
            self._retiring.remove(former)
            self._past.update(former.sandboxes.report()["counts"])
            for tenant, worked_s in former.sandboxes.cpu_by_tenant().items():
                self._past_s[tenant] += worked_s
            former.sandboxes.retire()

    # --- commands of robots --------------------------------------------------------------------------

    def offers(self, service: str) -> bool:
        """Return whether *service* is the name of a service of the current generation."""
        return service in self._current.names

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Run *queued* in the sandbox of its robot; the answer is passed to `SandboxHost.answer`.

        The command waits first while a former generation works on an earlier command of the robot.
        """
        if self._must_wait(queued.robot):
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
            self._loop.call_soon(self._run_waiting, robot)
            self._loop.call_soon(self._end_if_idle, generation)

    def _must_wait(self, robot: RobotId) -> bool:
        """Return whether a new command of *robot* waits for answers of former generations."""
        return robot in self._waiting or any(robot in generation.unanswered for generation in self._retiring)

    def _run_waiting(self, robot: RobotId) -> None:
        """Run the waiting commands of *robot*, unless former generations have not answered all others."""
        if any(robot in generation.unanswered for generation in self._retiring):
            return
        for queued in self._waiting.pop(robot, ()):
            self._run(queued)

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Do nothing: a sandbox cannot cancel a command, which is answered at its deadline at the latest."""

    # --- connections of robots -----------------------------------------------------------------------

    def enter(self, owner: Any) -> None:
        """Count the connection *owner*; the sandbox of its robot is kept while the robot has connections."""
        self._connections[owner.robot] += 1
        for sandboxes in self._all:
            sandboxes.add_connection(owner.robot)

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Count the connection *owner* no more; after the last one of its robot, drop the robot's commands.

        Dropped commands are not answered.  The result is always empty: no command is left to the caller.
        """
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
        """Kill the sandboxes of all generations, and wait until their zygotes have exited."""
        self._drop_next()
        for sandboxes in self._all:
            sandboxes.close()

    @property
    def _all(self) -> list[SandboxManager]:
        managers = (generation.sandboxes for generation in (self._current, *self._retiring))
        return [manager for manager in managers if manager is not None]

    # --- state for robots, metrics and operators -----------------------------------------------------

    @property
    def held(self) -> int:
        """Number of commands that wait or run, in all generations."""
        return sum(manager.held for manager in self._all) + sum(map(len, self._waiting.values()))

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return how many commands of the robot of *queued* wait; the robot never has to pause."""
        robot = queued.robot
        here = len(self._waiting.get(robot, ()))
        return QueueBacklog(here + sum(manager.waiting_of(robot) for manager in self._all))

    def report(self) -> QueueReport:
        """Return state and counts of the sandboxes of all generations for ``/readyz`` and ``/metrics``.

        Missing isolation and open circuit breakers are those of the current generation.
        """
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
        """Return the refusals of the current generation that are in force after crashes or overruns."""
        current = self._current.sandboxes
        return [] if current is None else current.blocks()

    def unblock(self, service: str | None, tenant: str | None, robot: str | None) -> list[Block]:
        """Lift the refusals that match all arguments (None matches everything), and return them."""
        current = self._current.sandboxes
        return [] if current is None else current.unblock(service, tenant, robot)
