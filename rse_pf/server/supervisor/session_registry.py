"""The robots connected to one server; the newer connection of a robot replaces the older one.

The order is that in which sockets were accepted, however late a worker reads a Hello.  A robot that is
moving keeps its old connection until the move is over; its worker reports ``stays`` then.
"""

from __future__ import annotations

from typing import Any

from rse_pf.identity import RobotId
from rse_pf.server.supervisor.orders import ReplaceOrder
from rse_pf.server.supervisor.worker_handle import WorkerProcess

__all__ = ["SessionRegistry"]


class SessionRegistry:
    """The sockets of every robot that is connected to one server."""

    def __init__(self) -> None:
        self._sockets: dict[RobotId, dict[int, WorkerProcess]] = {}

    def __len__(self) -> int:
        """Return the number of robots that are connected."""
        return len(self._sockets)

    def robot_of(self, number: int) -> RobotId | None:
        """Return whose connection *number* is, None if that is not known."""
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
        """Handle what a worker reports of one socket: ``arrived``, ``stays`` or ``left``."""
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
