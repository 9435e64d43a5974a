"""Processes with limits on memory and CPU time, which decode the data of robots.

A robot whose data ended two of them is refused for a while (`CrashRecord`).
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
"""The ``data.store`` that other processes cannot read."""
_MAX_INFLATED = 4  # an inflated map may have this many times ``data.max_object_bytes``
_WALL_S_PER_CPU_S = 3.0  # of the timeout: the processes have a low priority, and wait on a busy machine


def max_map_bytes(settings: PlatformSettings) -> int:
    """Return the largest size of an inflated map."""
    return _MAX_INFLATED * settings.data.max_object_bytes


class RobotProcesses:
    """The processes of one data server for one kind of work; the first call starts them.

    Attributes:
        count: Calls that are worked on at the same time.
        private_store: The store if only the data server can read it, else None.
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
        """Start nothing yet.

        Args:
            target: ``module:function``, which takes the settings in JSON and returns the handler.
            settings: Groups data, serving and services.
            store: Store of the data server; processes read it themselves unless it is in its memory.
            clock: Monotonic seconds.
            count: Calls that run at the same time.
            processes: The processes; None makes some with the limits of ``serving``.
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
        """Return the reply of the handler to *request* of *robot*; blocks.

        *near* and *charge* are those of `LimitedProcesses.call`.

        Raises:
            Crashed: The request ended the process that worked on it.
            Busy: Earlier requests of this robot ended processes, or none was free in time.
            Expired, WorkerLost: It was not answered, for another reason than its bytes.
            RsePfError: What the handler raised.
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
        """End the processes; a call that is under way raises WorkerLost."""
        self._processes.close()


def shared_store(settings: PlatformSettings) -> ObjectStore | None:
    """Return the store as a process of its own reads it, None if only the data server can."""
    return None if settings.data.store == _PRIVATE_STORE else open_data_store(settings)
