"""Replace a worker that crashed in native code, and refuse a robot that causes such crashes.

Spare processes were forked with the workers, before any event loop and thread, and one of them takes the
place of a crashed worker.  After several crashes it begins with an exponential delay (`restart_delay_s`).  No
further spares are forked: when they are used up, or if a worker ends in another way, the server exits.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from rse_pf.auth.trust_store import TrustStore
from rse_pf.identity import RobotId
from rse_pf.limits.crash_record import BLOCK_S, WINDOW_S, CrashRecord
from rse_pf.server.gateway.audit_recorder import ServerAudit
from rse_pf.server.supervisor.crash_report import CRASH_SIGNALS, CrashReport
from rse_pf.server.supervisor.orders import BanOrder, BeginOrder
from rse_pf.server.supervisor.session_registry import SessionRegistry
from rse_pf.server.supervisor.worker import WorkerPlan
from rse_pf.server.supervisor.worker_handle import WorkerProcess
from rse_pf.server.worker_context import Log

__all__ = ["CrashRecovery", "restart_delay_s", "spare_plans"]

_SPARES = 5  # crashes that a server survives: a spare process waits for each
_PROMPT_RESTARTS = 2  # crashes within `WINDOW_S` without a delay: a robot that causes as many is refused


def restart_delay_s(crashes: int) -> float:
    """Return how long the successor of a worker waits after the *crashes*-th crash within `WINDOW_S`."""
    return 0.0 if crashes <= _PROMPT_RESTARTS else 2.0 ** (crashes - _PROMPT_RESTARTS - 1)


def spare_plans(plans: Sequence[WorkerPlan]) -> list[WorkerPlan]:
    """Return the plans of the spare processes for the workers of *plans*."""
    spare = replace(plans[0], index=-1, is_spare=True)
    return [replace(spare, crash=CrashReport()) for _ in range(_SPARES)]


class CrashRecovery:
    """Replaces a server's crashed workers by spare processes; refuses robots whose commands crash workers."""

    def __init__(
        self,
        workers: list[WorkerProcess],
        spares: list[WorkerProcess],
        *,
        registry: SessionRegistry,
        trust: TrustStore | None,
        log: Log,
        records: ServerAudit,
    ) -> None:
        """Replace nothing yet.

        Args:
            workers: The workers of the server; a crashed one is replaced in this list.
            spares: Spare processes.
            registry: Knows the robots of connections; those of an ended worker are removed from it.
            trust: Has the keys for a new worker; None for the keys with which the server started.
            log: The log of the server.
            records: The audit log of the server.
        """
        self._workers, self._spares = workers, spares
        self._registry, self._trust, self._log, self._records = registry, trust, log, records
        self._crashes = CrashRecord()
        self._times: deque[float] = deque(maxlen=_SPARES)
        self.cpu_s = 0.0
        """CPU seconds of workers that were replaced."""
        self.count = 0
        """Crashes since the start."""

    def replace(self, worker: WorkerProcess, now: float) -> WorkerProcess | None:
        """Record the crash of *worker*, which ended at *now* (s), and return its successor.

        None if no spare is left, or if native code did not end the worker; the latter is not recorded.
        """
        code = worker.exit_code(0)
        if code is None or -code not in CRASH_SIGNALS:
            return None
        crash = worker.crash.read()
        robot = crash.robot or self._registry.robot_of(crash.number)
        self._registry.forget(worker)
        self.count += 1
        self.cpu_s += worker.cpu_s
        about = {} if robot is None else {"robot": str(robot)}
        self._log.error("worker-crashed", pid=worker.pid, signal=-code, at=crash.place, **about)
        self._records.note("server.worker-crashed", pid=worker.pid, signal=-code, **about)
        index = self._workers.index(worker)
        worker.kill()
        if robot is not None and self._crashes.note_crash(robot, now):
            self._refuse(robot)
        self._times.append(now)
        wait_s = restart_delay_s(sum(now - at_s <= WINDOW_S for at_s in self._times))
        snapshot = "" if self._trust is None else self._trust.snapshot
        order = BeginOrder(index, wait_s, snapshot, self._crashes.blocked(now + wait_s))
        while self._spares:
            spare = self._workers[index] = self._spares.pop()
            if spare.begin(order):
                return spare
        return None

    def _refuse(self, robot: RobotId) -> None:
        self._log.warning("cut-off", robot=robot, reason="crashes")
        self._records.note("server.robot-shut-out", robot=str(robot), seconds=BLOCK_S)
        for worker in self._workers:
            worker.order(BanOrder(robot, BLOCK_S))
