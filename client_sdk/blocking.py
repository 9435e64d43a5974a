"""The SDK for programs without asyncio: a robot whose event loop runs in a thread of its own.

Every method calls its namesake of `client_sdk.robot.Robot`; any number of threads may call at the same time.
"""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from client_sdk.closing import Closing
from client_sdk.robot import Robot, connect
from client_sdk.stats import Stats
from client_sdk.updates import BlockingUpdates, Updates
from rse_pf.errors import Disconnected, RsePfError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from client_sdk.frontend import Frame
    from client_sdk.live.blocking import BlockingLiveMapper
    from client_sdk.live.mapper import LiveMapper
    from client_sdk.mapper import BlockingMapper, Mapper

__all__ = ["BlockingRobot", "connect_blocking"]

P = ParamSpec("P")
T = TypeVar("T")


def _blocking(
    method: Callable[Concatenate[Robot, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[BlockingRobot, P], T]:
    """Return *method* for a `BlockingRobot`, with the same arguments and documentation."""

    @functools.wraps(method)
    def call(self: BlockingRobot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._wait(method(self._robot, *args, **kwargs))

    return call


def _blocking_mapper(
    make: Callable[Concatenate[Robot, P], Mapper],
) -> Callable[Concatenate[BlockingRobot, P], BlockingMapper]:
    """Return `Robot.mapper` for a `BlockingRobot`, whose mapper runs in the robot's event loop."""

    @functools.wraps(make)
    def mapper(self: BlockingRobot, /, *args: P.args, **kwargs: P.kwargs) -> BlockingMapper:
        from client_sdk.mapper import BlockingMapper

        return BlockingMapper(make(self._robot, *args, **kwargs), self._wait)

    return mapper


def _blocking_live_map(
    make: Callable[Concatenate[Robot, P], LiveMapper],
) -> Callable[Concatenate[BlockingRobot, P], BlockingLiveMapper]:
    """Return `Robot.live_map` for a `BlockingRobot`, whose mapper runs in the robot's event loop."""

    @functools.wraps(make)
    def live_map(self: BlockingRobot, /, *args: P.args, **kwargs: P.kwargs) -> BlockingLiveMapper:
        from client_sdk.live.blocking import BlockingLiveMapper

        return BlockingLiveMapper(make(self._robot, *args, **kwargs), self._wait)

    return live_map


class BlockingRobot(Closing):
    """A `Robot` whose methods block until their answers arrive."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> BlockingRobot:
        """Connect; raises Unauthorized or ConnectError."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="rse-pf-robot", daemon=True)
        self._thread.start()
        try:
            self._wait(self._robot.__aenter__())
        except BaseException:
            self._end()
            raise
        return self

    def close(self) -> None:
        """Close the connection and end the thread."""
        if self._loop is not None:
            try:
                self._wait(self._robot.close())
            finally:
                self._end()

    solve_pnp = _blocking(Robot.solve_pnp)
    call = _blocking(Robot.call)
    mapper = _blocking_mapper(Robot.mapper)
    live_map = _blocking_live_map(Robot.live_map)
    store_object = _blocking(Robot.store_object)

    def subscribe(self, topic: str) -> BlockingUpdates:
        """Ask for the updates of *topic*; iterate over what is returned.  See `Robot.subscribe`."""

        async def begin() -> Updates:
            return self._robot.subscribe(topic)

        return BlockingUpdates(self._wait(begin()), self._wait)

    def record_frame(self, frame: Frame, T_odom_camera: npt.NDArray[np.float64] | None = None) -> None:
        """Record a thumbnail of *frame* and its pose by odometry, as `Robot.record_frame` does."""

        async def record() -> None:
            self._robot.record_frame(frame, T_odom_camera)

        self._wait(record())

    @property
    def connected(self) -> bool:
        """Whether there is a connection to a server now; without one, commands wait for the next."""
        return self._robot.connected

    @property
    def failure(self) -> RsePfError | None:
        """Why the robot has stopped reconnecting for good; None while it has not."""
        return self._robot.failure

    @property
    def stats(self) -> Stats:
        """A snapshot of the robot's traffic."""
        if self._loop is None:
            return self._robot.stats

        async def snapshot() -> Stats:
            return self._robot.stats

        return self._wait(snapshot())

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        if self._loop is None:
            work.close()
            raise Disconnected(
                "the robot is not connected", hint="use with client_sdk.connect_blocking(...) as robot"
            )
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def _end(self) -> None:
        loop, thread = self._loop, self._thread
        self._loop = self._thread = None
        if loop is not None and thread is not None:
            loop.call_soon_threadsafe(loop.stop)
            thread.join()
            loop.close()


def _blocking_connect(make: Callable[P, Robot]) -> Callable[P, BlockingRobot]:
    @functools.wraps(make, assigned=(), updated=())
    def connect_blocking(*args: P.args, **kwargs: P.kwargs) -> BlockingRobot:
        """Return a robot for ``with connect_blocking(url, token=...) as robot``; see `connect`."""
        return BlockingRobot(make(*args, **kwargs))

    return connect_blocking


connect_blocking = _blocking_connect(connect)
"""Takes the arguments of `connect`; *on_change* is called in the thread of the event loop."""
