"""Replace a worker that crashed in native code, and refuse a robot that causes such crashes.

1. `_SPARES` spare processes are forked together with the workers, before any event loop and thread exists.
2. When a worker is killed by a signal of `CRASH_SIGNALS`, a spare process takes its place.  From the third
   crash within `WINDOW_S` on, it begins after an exponential delay (`restart_delay_s`).
3. A robot whose commands caused two such crashes within `WINDOW_S` is disconnected, and refused for
   `BLOCK_S`.
4. No further spare processes are forked.  When all are used, or if a worker exits in another way, the server
   exits.
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

_SPARES = 5  # spare processes, and so the number of crashes that a server survives
_PROMPT_RESTARTS = 2  # crashes within `WINDOW_S` that cause no delay: a robot that causes as many is refused


def restart_delay_s(crashes: int) -> float:
    """Return the seconds that a spare process waits after the *crashes*-th crash within `WINDOW_S`.

    It is 0 for the first two crashes, then 1, 2, 4 s and so on.
    """
    return 0.0 if crashes <= _PROMPT_RESTARTS else 2.0 ** (crashes - _PROMPT_RESTARTS - 1)


def spare_plans(plans: Sequence[WorkerPlan]) -> list[WorkerPlan]:
    """Return the plans of `_SPARES` spare processes for the workers that have *plans*."""
    spare = replace(plans[0], index=-1, is_spare=True)
    return [replace(spare, crash=CrashReport()) for _ in range(_SPARES)]


class CrashRecovery:
    """Replaces crashed workers of a server by spare processes, and refuses robots that crash workers."""

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
            workers: The workers of the server; `replace` changes this list.
            spares: The spare processes; `replace` removes those that it uses.
            registry: Has the robot of each connection; connections of a crashed worker are removed.
            trust: Has the keys and the roster for a new worker; None for those with which the server started.
            log: The log of the server.
            records: The audit log of the server.
        """
        self._workers, self._spares = workers, spares
        self._registry, self._trust, self._log, self._records = registry, trust, log, records
        self._crashes = CrashRecord()
        self._times: deque[float] = deque(maxlen=_SPARES)
        self.cpu_s = 0.0
        """CPU seconds of the workers that have crashed."""
        self.count = 0
        """Number of crashes since the start of the server."""

    def replace(self, worker: WorkerProcess, now: float) -> WorkerProcess | None:
        """Record the crash of *worker*, which exited at *now* (s), and return the process that replaces it.

        Return None if no spare process is left, or if *worker* was not killed by a crash signal; in the
        latter case nothing is recorded.
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
