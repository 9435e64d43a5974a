"""Compute a command of a limited service in a process that is killed at the deadline of the command.

A command that exceeds a limit fails, and its failure names the limit.  A robot whose commands ended two
processes is refused these services for a while (`CrashRecord`).
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

# A command that used this much CPU time and was not computed by its deadline counts as a crash.  Otherwise
# its robot could occupy the processes all the time.  A command with a shorter deadline does not count.
_LONG_WORK_S = 2.0


def limited_processes(services: str, settings: PlatformSettings) -> LimitedProcesses:
    """Return the processes of one worker, none of which is started; *services* is ``module:function``."""
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
    """The limited services of one worker."""

    def __init__(self, context: WorkerContext, processes: LimitedProcesses) -> None:
        self._context = context
        self._processes = processes
        self._crashes = CrashRecord()

    def refusal(self, queued: QueuedCommand, now: float) -> Busy | None:
        """Return why the robot of *queued* may not use these services now, None if it may."""
        return self._crashes.refusal(queued.robot, now)

    def compute(self, queued: QueuedCommand) -> Result | Failure:
        """Answer *queued*; blocks until its deadline at most, and may run in several threads."""
        try:
            return self._compute(queued)
        except RsePfError as error:
            failure = error
        except Exception as error:  # noqa: BLE001  a defect must not end the thread of the queue
            self._log_defect(queued.command, "".join(traceback.format_exception(error)))
            failure = InternalError(f"service {queued.command.service!r} failed", hint="see the server's log")
        return failure_of(failure, queued.command, server=self._context.server_id)

    def blocked_robots(self, now: float) -> int:
        """Return how many robots are refused at *now* (monotonic seconds)."""
        return len(self._crashes.blocked(now))

    def cpu_s(self) -> float:
        """Return the CPU seconds of all processes so far; less again after the fork server has restarted."""
        return sum(map(cpu_seconds, self._processes.pids()))

    def close(self) -> None:
        """End all processes; commands that are computed now are answered with WorkerLost."""
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
                f"its deadline passed after {(context.clocks.monotonic() - now) * 1e3:.0f} ms of work",
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
