"""The SDK for programs without asyncio: the same robot, its event loop in a thread of its own.

Promises no rules of its own: every method hands over to `client_sdk.robot.Robot`.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from types import TracebackType
from typing import Any, TypeVar

from client_sdk.robot import Answer, PoseAnswer, Robot, connect
from client_sdk.stats import Stats

__all__ = ["BlockingRobot", "connect_blocking"]

T = TypeVar("T")


def connect_blocking(url: str, **options: Any) -> BlockingRobot:
    """Return a robot for ``with connect_blocking(url, token=...) as robot``; see `connect`."""
    return BlockingRobot(connect(url, **options))


class BlockingRobot:
    """`Robot` whose methods wait for their answers."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="rse-pf-robot", daemon=True)

    def __enter__(self) -> BlockingRobot:
        """Connect; raises Unauthorized or ConnectError."""
        self._thread.start()
        try:
            self._wait(self._robot.__aenter__())
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connection."""
        self.close()

    def close(self) -> None:
        """Close the connection and end the thread."""
        if self._thread.is_alive():
            self._wait(self._robot.close())
            self._end()

    def solve_pnp(self, *args: Any, **options: Any) -> PoseAnswer:
        """Estimate the camera pose of one frame in the cloud; see `Robot.solve_pnp`."""
        return self._wait(self._robot.solve_pnp(*args, **options))

    def call(self, *args: Any, **options: Any) -> Answer:
        """Ask a service; see `Robot.call`."""
        return self._wait(self._robot.call(*args, **options))

    @property
    def stats(self) -> Stats:
        """A snapshot of the robot's traffic."""

        async def snapshot() -> Stats:
            return self._robot.stats

        return self._wait(snapshot())

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
