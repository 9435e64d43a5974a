"""Compute a command of a limited service in a process that is killed at the deadline of the command.

A command that exceeds a limit of memory, CPU time or time gets a failure that names the limit.  A robot whose
commands crashed two processes within five minutes may not use limited services for a minute (`CrashRecord`).
"""

from __future__ import annotations

import traceback

from rse_pf.config import PlatformSettings
from rse_pf.errors import Busy, Crashed, Expired, InternalError, RsePfError
from rse_pf.limits.crash_record import CrashRecord
from rse_pf.processes.limited import LimitedProcesses, Overran, ProcessLimits
from rse_pf.processes.linux import cpu_seconds
from rse_pf.server.compute.process import TARGET, configuration_of, decode_reply, encode_request
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.server.worker_context import WorkerContext
from rse_pf.service import failure_of
from rse_pf.wire import Command, Failure, Result

__all__ = ["LimitedServices", "limited_processes"]

# CPU seconds: a command that has used this much when it is killed at its deadline counts as a crash of its
# robot, which could otherwise occupy the process all the time.  One with a shorter deadline cannot reach it.
_LONG_WORK_S = 2.0


def limited_processes(services: str, settings: PlatformSettings) -> LimitedProcesses:
    """Return the limited processes of one worker, with the limits of *settings*; none is started yet.

    *services* is the ``module:function`` that returns the registry of services.
    """
    serving = settings.serving
    return LimitedProcesses(
        TARGET,
        ProcessLimits(
            memory_bytes=serving.max_compute_memory_bytes,
            cpu_s=serving.max_compute_s,
            max_reply_bytes=settings.session.max_inflated_bytes,
        ),
        configuration=configuration_of(services, settings),
    )


class LimitedServices:
    """Computes commands of limited services for one worker, and refuses robots after crashes."""

    def __init__(self, context: WorkerContext, processes: LimitedProcesses) -> None:
        self._context = context
        self._processes = processes
        self._crashes = CrashRecord()

    def refusal(self, queued: QueuedCommand, now: float) -> Busy | None:
        """Return the error for *queued* if crashes block its robot at *now* (monotonic s), None otherwise."""
        return self._crashes.refusal(queued.robot, now)

    def compute(self, queued: QueuedCommand) -> Result | Failure:
        """Return the answer to *queued*; any error becomes a Failure.

        Blocks until the deadline of *queued* at most; several threads may call this method.
        """
        try:
            return self._compute(queued)
        except RsePfError as error:
            failure = error
        except Exception as error:  # noqa: BLE001  a defect must not end the thread of the queue
            self._log_defect(queued.command, "".join(traceback.format_exception(error)))
            failure = InternalError(f"service {queued.command.service!r} failed", hint="see the server's log")
        return failure_of(failure, queued.command, server=self._context.server_id)

    def blocked_robots(self, now: float) -> int:
        """Return how many robots are blocked at *now* (monotonic seconds) after crashes."""
        return len(self._crashes.blocked(now))

    def cpu_s(self) -> float:
        """Return the CPU seconds of the limited processes so far.

        The number starts again from 0 when the process that forks them was restarted.
        """
        return sum(map(cpu_seconds, self._processes.pids()))

    def close(self) -> None:
        """Kill all limited processes; commands that run in them get the failure WorkerLost."""
        self._processes.close()

    def _compute(self, queued: QueuedCommand) -> Result | Failure:
        context, command = self._context, queued.command
        now = context.clocks.monotonic()
        refusal = self.refusal(queued, now)
        if refusal is not None:
            raise refusal
        try:
            reply = self._processes.call(encode_request(command, queued.robot), queued.deadline_s - now)
        except Overran as overrun:
            if overrun.cpu_s >= _LONG_WORK_S:
                self._note_crash(queued, overrun.message)
            raise Expired(
                f"the deadline passed after {(context.clocks.monotonic() - now) * 1e3:.0f} ms of work",
                hint="set a longer deadline, or send a smaller map",
            ) from None
        except Crashed as crash:
            self._note_crash(queued, crash.message)
            raise
        answer, defect = decode_reply(reply, command, server=context.server_id)
        if defect:
            self._log_defect(command, defect)
        return answer

    def _note_crash(self, queued: QueuedCommand, reason: str) -> None:
        context, command = self._context, queued.command
        is_blocked = self._crashes.note_crash(queued.robot, context.clocks.monotonic())
        context.log.warning(
            "compute-crashed", robot=queued.robot, service=command.service, id=command.id,
            trace=command.trace, reason=reason, blocked=is_blocked,
        )  # fmt: skip

    def _log_defect(self, command: Command, text: str) -> None:
        self._context.log.error(
            "defect", service=command.service, id=command.id, trace=command.trace, traceback=text
        )
