"""Offer robots and mappers to programs without asyncio: methods wait for answers.

The event loop of a robot runs in a thread.  Every method calls the method of `client_sdk.robot.Robot` or of
`client_sdk.mapper.Mapper` with the same name.  Any number of threads may call methods of a robot at the same
time.  Functions that the program gave to the SDK run in one further thread, and may call methods, too.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from client_sdk.auto_close import AutoClose
from client_sdk.commands.subscriptions import BlockingUpdates, Updates
from client_sdk.commands.traffic_stats import Stats
from client_sdk.concurrency.event_loop_thread import EventLoopThread
from client_sdk.robot import MAX_DEADLINE_S, Robot, connect
from rse_pf.errors import Disconnected, RsePfError, UsageError
from rse_pf.wire import Welcome

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt

    from client_sdk.frontend import Frame, TrackedFrame
    from client_sdk.live.blocking import BlockingLiveMapper
    from client_sdk.live.live_mapper import LiveMapper
    from client_sdk.mapper import Mapper
    from client_sdk.point_map import PointMap
    from client_sdk.trajectory import Trajectory
    from client_sdk.wheel_odometry import OdometryReading
    from rse_pf.geometry import Array

__all__ = ["BlockingMapper", "BlockingRobot", "connect_blocking"]

GRACE_S = 0.5
"""A call with *deadline_s* ends at its deadline, unless the event loop hangs; then it raises Expired this
many seconds after the deadline."""

P = ParamSpec("P")
T = TypeVar("T")


def _blocking(
    method: Callable[Concatenate[Robot, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[BlockingRobot, P], T]:
    """Return *method* of `Robot` as one of `BlockingRobot`, with the same arguments and documentation."""

    @functools.wraps(method)
    def call(self: BlockingRobot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        deadline_s, limit_s = kwargs.get("deadline_s"), None
        if isinstance(deadline_s, int | float):
            limit_s = min(max(0.0, deadline_s), MAX_DEADLINE_S) + GRACE_S
        return self._wait(method(self._robot, *args, **kwargs), limit_s)

    return call


def _blocking_mapper(
    make: Callable[Concatenate[Robot, P], Mapper],
) -> Callable[Concatenate[BlockingRobot, P], BlockingMapper]:
    """Return `Robot.mapper` as a method of `BlockingRobot`; the mapper runs in the robot's event loop."""

    @functools.wraps(make)
    def mapper(self: BlockingRobot, /, *args: P.args, **kwargs: P.kwargs) -> BlockingMapper:
        return BlockingMapper(make(self._robot, *args, **kwargs), self._wait)

    return mapper


def _blocking_live_map(
    make: Callable[Concatenate[Robot, P], LiveMapper],
) -> Callable[Concatenate[BlockingRobot, P], BlockingLiveMapper]:
    """Return `Robot.live_map` as a method of `BlockingRobot`; the mapper runs in the robot's event loop."""

    @functools.wraps(make)
    def live_map(self: BlockingRobot, /, *args: P.args, **kwargs: P.kwargs) -> BlockingLiveMapper:
        from client_sdk.live.blocking import BlockingLiveMapper

        return BlockingLiveMapper(make(self._robot, *args, **kwargs), self._wait)

    return live_map


class BlockingRobot(AutoClose):
    """One robot whose methods block until the answer has arrived; make one with `connect_blocking`."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._thread = EventLoopThread(robot.close)

    def __enter__(self) -> BlockingRobot:
        """Connect and return this robot; raise the errors of `Robot.__aenter__`, such as ConnectError."""
        self._thread = EventLoopThread(self._robot.close)
        self._robot.callbacks.start_thread()
        self._thread.start()
        try:
            self._wait(self._robot.__aenter__())
        except BaseException:
            self.close()
            raise
        return self

    def close(self) -> None:
        """Close the connections and end the threads; calls that wait end with Disconnected.

        Any thread may call this, also a function that the program gave to the SDK, and more than once.
        """
        self._thread.close()
        self._robot.callbacks.end_thread()

    solve_pnp = _blocking(Robot.solve_pnp)
    call = _blocking(Robot.call)
    mapper = _blocking_mapper(Robot.mapper)
    live_map = _blocking_live_map(Robot.live_map)
    store_object = _blocking(Robot.store_object)

    def subscribe(self, topic: str) -> BlockingUpdates:
        """Subscribe to *topic*, as `Robot.subscribe` does; iterate over the returned updates."""

        async def begin() -> Updates:
            return self._robot.subscribe(topic)

        return BlockingUpdates(self._wait(begin()), self._wait)

    def record_frame(self, frame: Frame, T_odom_camera: npt.NDArray[np.float64] | None = None) -> None:
        """Add a thumbnail of *frame* and its pose by odometry to the recording, like `Robot.record_frame`."""

        async def record() -> None:
            self._robot.record_frame(frame, T_odom_camera)

        self._wait(record())

    @property
    def connected(self) -> bool:
        """Whether a server is connected now; while none is, commands wait for the next connection."""
        return self._robot.connected

    @property
    def welcome(self) -> Welcome | None:
        """The Welcome of the connected server: name, tenant, scopes and limits of the robot; or None."""
        return self._robot.welcome

    @property
    def failure(self) -> RsePfError | None:
        """Why all servers refuse this robot now, None while they do not; the robot goes on reconnecting."""
        return self._robot.failure

    @property
    def stats(self) -> Stats:
        """A snapshot of the counters and times of this robot's commands and connections."""

        async def snapshot() -> Stats:
            return self._robot.stats

        try:
            return self._wait(snapshot())
        except (Disconnected, UsageError):
            # The loop has ended, or this is its thread: the counters can be read without it.
            return self._robot.stats

    def _wait(self, work: Coroutine[Any, Any, T], limit_s: float | None = None) -> T:
        return self._thread.wait(work, limit_s)


class BlockingMapper:
    """Wrap a `Mapper` for programs without asyncio; its attribute ``mapper`` has all other properties."""

    def __init__(self, mapper: Mapper, wait: Callable[[Coroutine[Any, Any, Any]], Any] = asyncio.run) -> None:
        """Wrap a mapper.

        Args:
            mapper: The mapper to use; it stays available as ``mapper``.
            wait: Runs a coroutine and returns its result, such as in the event loop of a blocking robot.
        """
        self.mapper = mapper
        self._wait = wait

    def track(
        self, frame: Frame, *, position_m: Array | None = None, odometry: Sequence[OdometryReading] = ()
    ) -> TrackedFrame:
        """Return the pose of the next frame; see `Mapper.track`."""
        tracked: TrackedFrame = self._wait(self.mapper.track(frame, position_m=position_m, odometry=odometry))
        return tracked

    @property
    def map(self) -> PointMap:
        """The map so far of segment 0, the first one, and of all segments joined to it; see `Mapper.map`."""
        return self.mapper.map

    @property
    def trajectory(self) -> Trajectory:
        """Poses so far of segment 0, the first one, and of all segments joined to it; see `Mapper`."""
        return self.mapper.trajectory

    @property
    def scale(self) -> str:
        """Source of the metric scale; see `Mapper.scale`."""
        return self.mapper.scale

    def encoded_map(self) -> bytes:
        """Return cloud and keyframes as one encoded map; see `Mapper.encoded_map`."""
        return self.mapper.encoded_map()

    def save(self, folder: Path) -> dict[str, Any]:
        """Write map, trajectory and report to a folder; see `Mapper.save`."""
        return self.mapper.save(folder)


def _blocking_connect(make: Callable[P, Robot]) -> Callable[P, BlockingRobot]:
    @functools.wraps(make, assigned=(), updated=())
    def connect_blocking(*args: P.args, **kwargs: P.kwargs) -> BlockingRobot:
        """Make a robot for ``with connect_blocking(url, token=...) as robot``; see `connect`."""
        return BlockingRobot(make(*args, **kwargs))

    return connect_blocking


connect_blocking = _blocking_connect(connect)
"""Make a `BlockingRobot`; the arguments are those of `connect`."""
