"""Register the robots that are connected to one server; the newer connection of a robot replaces the older.

Connections are ordered by the acceptance of their sockets, however late a worker reads the Hello.  A robot
that was asked to move keeps its old connection until its time to move is over; the worker then reports
``stays``.
"""

from __future__ import annotations

from typing import Any

from rse_pf.identity import RobotId
from rse_pf.server.supervisor.orders import ReplaceOrder
from rse_pf.server.supervisor.worker_handle import WorkerProcess

__all__ = ["SessionRegistry"]


class SessionRegistry:
    """The socket numbers of every robot that is connected to one server, with the worker of each."""

    def __init__(self) -> None:
        self._sockets: dict[RobotId, dict[int, WorkerProcess]] = {}

    def __len__(self) -> int:
        """Return the number of robots that are connected."""
        return len(self._sockets)

    def robot_of(self, number: int) -> RobotId | None:
        """Return the robot of the connection *number*, None if it is not registered."""
        return next((robot for robot, sockets in self._sockets.items() if number in sockets), None)

    def forget(self, worker: WorkerProcess) -> None:
        """Forget the connections of *worker*, which has ended."""
        for robot, sockets in list(self._sockets.items()):
            left = {number: other for number, other in sockets.items() if other is not worker}
            if left:
                self._sockets[robot] = left
            else:
                del self._sockets[robot]

    def handle(self, worker: WorkerProcess, message: dict[str, Any]) -> None:
        """Handle the event of one socket that *worker* reports: ``arrived``, ``stays`` or ``left``."""
        robot, number, event = RobotId(*message["robot"]), message["number"], message["event"]
        sockets = self._sockets.setdefault(robot, {})
        if event == "arrived":
            sockets[number] = worker
        elif event == "left":
            sockets.pop(number, None)
        for older in sorted(sockets)[:-1]:
            if event == "arrived" or older == number:
                sockets[older].order(ReplaceOrder(older))
        if not sockets:
            del self._sockets[robot]
