"""The scheduler behind the admission step, as the dispatcher uses them."""

from __future__ import annotations

from rse_pf.config import SessionSettings
from rse_pf.identity import RobotId
from rse_pf.server.gateway.admission import MAX_QUEUE_PER_ROBOT, Admission
from rse_pf.server.scheduling.command_queue import QueuedCommand, RefusedCommand
from rse_pf.server.scheduling.scheduler import Scheduler
from rse_pf.wire import Command


def queued(
    robot: str, identity: int = 0, *, at: float = 0.0, within: float = 10.0, tenant: str = "default",
    **command: object,
) -> QueuedCommand:  # fmt: skip
    """Return a command of *robot* that arrives at *at* and has *within* seconds."""
    work = Command(id=identity, service="work", **command)
    return QueuedCommand(robot, RobotId(tenant, robot), work, 100, at, at + within)


class AdmittedScheduler(Scheduler):
    """Queues what is admitted."""

    def __init__(self, *, max_queue: int = MAX_QUEUE_PER_ROBOT) -> None:
        super().__init__()
        self._admission = Admission(SessionSettings(), max_queue=max_queue)

    def submit(self, command: QueuedCommand, now: float = 0.0) -> list[RefusedCommand]:
        refusal = self._admission.refusal(command, None, self.backlog(command))
        if refusal is None:
            return super().submit(command)
        return [refusal]


def measure_turns(scheduler: Scheduler, turn_s: float, until_s: float) -> None:
    """Start a command every *turn_s* until the mean has converged; the last at *until_s*."""
    for step in range(400):
        now = until_s - (399 - step) * turn_s
        Scheduler.submit(scheduler, queued("turns", at=now - turn_s))
        started, _ = scheduler.start(now)
        assert started is not None
        scheduler.done(started, now)
