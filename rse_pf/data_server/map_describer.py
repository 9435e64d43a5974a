"""Count what a committed map holds, in a process that has limits and may be killed.

The process reads the object itself, so that the data server never holds a map.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.data_server.robot_processes import RobotProcesses, max_map_bytes, private_store, shared_store
from rse_pf.identity import RobotId
from rse_pf.limited_process import Handler, LimitedProcesses
from rse_pf.maps.describe import MapSummary, describe_map
from rse_pf.object_store import ObjectStore

__all__ = ["MapDescriber", "make_handler"]

_TARGET = f"{__name__}:make_handler"


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
        self._store = private_store(settings, store)
        self._processes = RobotProcesses(_TARGET, settings, clock, processes=processes)

    def describe(self, robot: RobotId, name: str) -> MapSummary:
        """Return what the map in the object *name*, which *robot* sent, holds; blocks.

        Raises:
            BadRequest, LimitExceeded: It is no map, or larger than maps may be.
            Crashed, Busy, Expired, WorkerLost: As `RobotProcesses.call` says.
        """
        data = None if self._store is None else self._store.get(name)
        reply = self._processes.call(robot, msgspec.msgpack.encode([name, data]))
        return msgspec.msgpack.decode(reply, type=MapSummary)

    def close(self) -> None:
        """End the process; a call that is under way raises WorkerLost."""
        self._processes.close()


def make_handler(configuration: str) -> Handler:
    """Return what answers in the process; *configuration* has the settings in JSON."""
    settings = PlatformSettings.from_dict(json.loads(configuration))
    store = shared_store(settings)

    def describe(request: bytes) -> bytes:
        name, data = msgspec.msgpack.decode(request)
        if store is not None:
            data = store.get(name)
        return msgspec.msgpack.encode(describe_map(data, max_map_bytes(settings)))

    return describe
