"""The newer connection of a robot wins: the supervisor knows every worker's robots, and decides.

Connections count in the order in which they were accepted, whatever worker was slow to hear their Hello.
Promises no socket and no clock, and that a robot which is moving keeps its old connection until the move is
over: its worker asks again then.
"""

from __future__ import annotations

from typing import Protocol

__all__ = ["SessionRegistry", "WorkerHandle"]

Robot = tuple[str, str]
"""Tenant and name."""


class WorkerHandle(Protocol):
    """A worker that takes orders."""

    def order(self, **what: object) -> None:
        """Send an order."""


class SessionRegistry:
    """Who is connected to one server, and by which sockets."""

    def __init__(self) -> None:
        self._sockets: dict[Robot, dict[int, WorkerHandle]] = {}

    def hear(self, worker: WorkerHandle, message: dict[str, object]) -> None:
        """Take what a worker says of one socket: ``arrived``, ``stays`` or ``left``."""
        robot = (str(message["tenant"]), str(message["robot"]))
        number = int(str(message["number"]))
        if message["event"] == "left":
            self._left(robot, number)
            return
        if message["event"] == "arrived":
            self._sockets.setdefault(robot, {})[number] = worker
        sockets = self._sockets.get(robot, {})
        for older in sorted(sockets)[:-1]:
            if message["event"] == "arrived" or older == number:
                sockets[older].order(do="replace", number=older)

    def _left(self, robot: Robot, number: int) -> None:
        sockets = self._sockets.get(robot, {})
        sockets.pop(number, None)
        if not sockets:
            self._sockets.pop(robot, None)
