"""Count what a committed map holds, in a process that has limits and may be killed.

The process reads the object itself, so that the data server never holds a map.  A robot whose maps ended two
processes is refused for a while.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import msgspec

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.crash_record import CrashRecord
from rse_pf.errors import Crashed
from rse_pf.identity import RobotId
from rse_pf.limited_process import Handler, LimitedProcesses, ProcessLimits
from rse_pf.maps.describe import MapSummary, describe_map
from rse_pf.object_store import ObjectStore

__all__ = ["MapDescriber", "make_handler", "max_map_bytes"]

_TARGET = f"{__name__}:make_handler"
_PRIVATE_STORE = "memory:"
_MAX_INFLATED = 4
"""Times ``data.max_object_bytes``."""
_WALL_S_PER_CPU_S = 3.0
"""The processes have a low priority: on a busy machine poses go first."""


def max_map_bytes(settings: PlatformSettings) -> int:
    """Return the largest size of an inflated map."""
    return _MAX_INFLATED * settings.data.max_object_bytes


class MapDescriber:
    """The process of one data server that reads maps; the first map starts it."""

    def __init__(
        self,
        settings: PlatformSettings,
        store: ObjectStore,
        clock: Callable[[], float],
        processes: LimitedProcesses | None = None,
    ) -> None:
        """Remember what is needed; nothing is started.

        Args:
            settings: Groups data, serving and services.
            store: Is read here only if ``data.store`` is in the memory of this process.
            clock: Monotonic seconds.
            processes: What reads maps; None means a process with the limits of ``serving``.
        """
        self._store = store if settings.data.store == _PRIVATE_STORE else None
        self._clock = clock
        self._crashes = CrashRecord()
        self._timeout_s = _WALL_S_PER_CPU_S * settings.serving.max_compute_s
        self._processes = processes or LimitedProcesses(
            _TARGET,
            ProcessLimits(
                memory_bytes=settings.serving.max_compute_memory_bytes, cpu_s=settings.serving.max_compute_s
            ),
            configuration=json.dumps(settings.to_dict()),
        )

    def describe(self, robot: RobotId, name: str) -> MapSummary:
        """Return what the map in the object *name*, which *robot* sent, holds; blocks.

        Raises:
            BadRequest, LimitExceeded: It is no map, or larger than maps may be.
            Crashed: It ended the process that read it.
            Busy: Earlier maps of this robot ended processes, or none was free in time.
            Expired, WorkerLost: It was not read, for another reason than its bytes.
        """
        refusal = self._crashes.refusal(robot, self._clock())
        if refusal is not None:
            raise refusal
        data = None if self._store is None else self._store.get(name)
        try:
            reply = self._processes.call(msgspec.msgpack.encode([name, data]), self._timeout_s)
        except Crashed:
            self._crashes.note_crash(robot, self._clock())
            raise
        return msgspec.msgpack.decode(reply, type=MapSummary)

    def close(self) -> None:
        """End the processes; a call that is under way raises WorkerLost."""
        self._processes.close()


def make_handler(configuration: str) -> Handler:
    """Return what answers in the process; *configuration* has the settings in JSON."""
    settings = PlatformSettings.from_dict(json.loads(configuration))
    store = None if settings.data.store == _PRIVATE_STORE else open_data_store(settings)

    def describe(request: bytes) -> bytes:
        name, data = msgspec.msgpack.decode(request)
        if store is not None:
            data = store.get(name)
        return msgspec.msgpack.encode(describe_map(data, max_map_bytes(settings)))

    return describe
