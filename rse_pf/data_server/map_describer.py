"""Count what a committed map holds, in a process that has limits and may be killed.

The process reads the object itself, so that the data server never holds a map.
"""

from __future__ import annotations

import json

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.data_server.robot_processes import RobotProcesses, max_map_bytes, shared_store
from rse_pf.identity import RobotId
from rse_pf.maps.describe import MapSummary, describe_map
from rse_pf.processes.limited import Handler

__all__ = ["TARGET", "MapDescriber", "make_handler"]

TARGET = f"{__name__}:make_handler"


class MapDescriber:
    """Reads maps in *processes*, which have the target `TARGET`."""

    def __init__(self, processes: RobotProcesses) -> None:
        self._processes = processes

    def describe(self, robot: RobotId, name: str) -> MapSummary:
        """Return what the map in the object *name*, which *robot* sent, holds; blocks.

        Raises:
            BadRequest, LimitExceeded: It is no map, or larger than maps may be.
            Crashed, Busy, Expired, WorkerLost: As `RobotProcesses.call` says.
        """
        store = self._processes.private_store
        data = None if store is None else store.get(name)
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
