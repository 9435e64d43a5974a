"""Register the robots that are connected to one server, and close older connections of the same robot.

1. A worker reports ``arrived`` when a robot has sent its Hello, and ``left`` when the connection is closed.
2. On ``arrived``, all connections of the robot but the newest are closed.  The newest is the one whose socket
   was accepted last, however late its worker reads the Hello.
3. The worker keeps a connection that was asked to move until its time to move is over, and then reports
   ``stays``.  If it is still not the newest, it is closed then.
"""

from __future__ import annotations

from typing import Any

from rse_pf.identity import RobotId
from rse_pf.server.supervisor.orders import ReplaceOrder
from rse_pf.server.supervisor.worker_handle import WorkerProcess

__all__ = ["SessionRegistry"]


class SessionRegistry:
    """The socket numbers of each robot that is connected to one server, and the worker of each socket."""

    def __init__(self) -> None:
        self._sockets: dict[RobotId, dict[int, WorkerProcess]] = {}

    def __len__(self) -> int:
        """Return the number of robots that are connected."""
        return len(self._sockets)

    def robot_of(self, number: int) -> RobotId | None:
        """Return the robot of the connection *number*, None if the connection is not registered."""
        return next((robot for robot, sockets in self._sockets.items() if number in sockets), None)

    def forget(self, worker: WorkerProcess) -> None:
        """Forget all connections of *worker*, which has exited."""
        for robot, sockets in list(self._sockets.items()):
            left = {number: other for number, other in sockets.items() if other is not worker}
            if left:
                self._sockets[robot] = left
            else:
                del self._sockets[robot]

    def handle(self, worker: WorkerProcess, message: dict[str, Any]) -> None:
        """Handle the event ``arrived``, ``stays`` or ``left`` of one socket, which *worker* reports.

        Older connections are closed by a `ReplaceOrder` to their workers.
        """
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
