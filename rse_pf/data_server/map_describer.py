"""Summarise a map that a robot commits, in a process with limits on memory and CPU time.

The process reads the object from the store itself, so that the data server holds no map in memory; only an
object of a store in the data server's memory is sent to it.
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

TARGET = f"{__name__}:make_handler"  # function that a new process calls to get its handler


class MapDescriber:
    """Summarises maps in *processes*, which must have been made with `TARGET`."""

    def __init__(self, processes: RobotProcesses) -> None:
        self._processes = processes

    def describe(self, robot: RobotId, name: str) -> MapSummary:
        """Return the summary of the map in the object *name* of *robot*; block until it is computed.

        Raises:
            BadRequest: The object is not a map.
            LimitExceeded: The map is larger than the limits allow.
            Crashed, Busy, Expired, WorkerLost: See `RobotProcesses.call`.
        """
        store = self._processes.private_store
        data = None if store is None else store.get(name)
        reply = self._processes.call(robot, msgspec.msgpack.encode([name, data]))
        return msgspec.msgpack.decode(reply, type=MapSummary)

    def close(self) -> None:
        """Kill the process; a running call of `describe` raises WorkerLost."""
        self._processes.close()


def make_handler(configuration: str) -> Handler:
    """Return the function that answers `MapDescriber.describe` in the process.

    *configuration* is the platform's settings as JSON.
    """
    settings = PlatformSettings.from_dict(json.loads(configuration))
    store = shared_store(settings)

    def describe(request: bytes) -> bytes:
        name, data = msgspec.msgpack.decode(request)
        if store is not None:
            data = store.get(name)
        return msgspec.msgpack.encode(describe_map(data, max_map_bytes(settings)))

    return describe
