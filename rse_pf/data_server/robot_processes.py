"""Processes with limits on memory and CPU time, which decode maps and photos of robots.

A robot whose data crashed two processes is refused for a minute (`CrashRecord`).
"""

from __future__ import annotations

import json
from collections.abc import Callable

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import Crashed
from rse_pf.identity import RobotId
from rse_pf.limits.crash_record import CrashRecord
from rse_pf.processes.limited import LimitedProcesses, ProcessLimits
from rse_pf.storage.object_store import ObjectStore

__all__ = ["RobotProcesses", "max_map_bytes", "shared_store"]

_PRIVATE_STORE = "memory:"
"""Value of ``data.store`` for a store in the memory of the data server, which other processes cannot read."""
_MAX_INFLATED = 4  # a map may have this many times ``data.max_object_bytes`` after decompression
_WALL_S_PER_CPU_S = 3.0  # timeout of a call per CPU second: processes of low priority wait on a busy machine


def max_map_bytes(settings: PlatformSettings) -> int:
    """Return the largest size of a map after decompression, in bytes."""
    return _MAX_INFLATED * settings.data.max_object_bytes


class RobotProcesses:
    """The processes of one data server for one kind of work; the first call starts them.

    Attributes:
        count: Number of calls that run at the same time.
        private_store: The store if it is in the data server's memory; None if the processes can read it.
    """

    def __init__(
        self,
        target: str,
        settings: PlatformSettings,
        store: ObjectStore,
        clock: Callable[[], float],
        *,
        count: int = 1,
        processes: LimitedProcesses | None = None,
    ) -> None:
        """Describe the processes; none is started yet.

        Args:
            target: ``module:function``; the function takes the settings as JSON and returns the handler.
            settings: Settings of the platform, which the processes get, too.
            store: Store of the data server; the processes read it themselves unless it is in memory.
            clock: Monotonic seconds.
            count: Number of calls that run at the same time.
            processes: The processes; None makes them, with the limits of the settings group ``serving``.
        """
        self.count = count
        self.private_store = store if settings.data.store == _PRIVATE_STORE else None
        self._clock = clock
        self._crashes = CrashRecord()
        self._timeout_s = _WALL_S_PER_CPU_S * settings.serving.max_compute_s
        self._processes = processes or LimitedProcesses(
            target,
            ProcessLimits(
                memory_bytes=settings.serving.max_compute_memory_bytes, cpu_s=settings.serving.max_compute_s
            ),
            configuration=json.dumps(settings.to_dict()),
            count=count,
        )

    def call(
        self, robot: RobotId, request: bytes, *, near: str = "", charge: Callable[[float], None] | None = None
    ) -> bytes:
        """Return the handler's reply to *request* of *robot*; block until it is there.

        *near* and *charge* are described at `LimitedProcesses.call`.

        Raises:
            Crashed: The request crashed its process or exceeded its limit on memory or CPU time.
            Busy: Earlier requests of this robot crashed processes, or no process was free in time.
            Expired: The work took longer than the timeout.
            WorkerLost: The processes cannot be started, or were closed; the request is not the cause.
            RsePfError: The error that the handler raised.
        """
        refusal = self._crashes.refusal(robot, self._clock())
        if refusal is not None:
            raise refusal
        try:
            return self._processes.call(request, self._timeout_s, near=near, charge=charge)
        except Crashed:
            self._crashes.note_crash(robot, self._clock())
            raise

    def close(self) -> None:
        """Kill the processes; a running call raises WorkerLost."""
        self._processes.close()


def shared_store(settings: PlatformSettings) -> ObjectStore | None:
    """Open the store in another process than the data server; None if it is in the data server's memory."""
    return None if settings.data.store == _PRIVATE_STORE else open_data_store(settings)
