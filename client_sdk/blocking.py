"""The SDK for programs without asyncio: a robot whose event loop runs in a thread of its own.

Every method calls its namesake of `client_sdk.robot.Robot`; any number of threads may call at the same time.
"""

from __future__ import annotations

import asyncio
import random as random_module
import threading
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from client_sdk.answers import Answer, PoseAnswer
from client_sdk.connection import OnChange, Token
from client_sdk.offload import CloudFirst
from client_sdk.robot import OnProgress, Robot, connect
from client_sdk.stats import Stats
from rse_pf.config import SessionSettings
from rse_pf.errors import Disconnected

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rse_pf.geometry import Camera
    from rse_pf.pnp import PnpOptions

__all__ = ["BlockingRobot", "connect_blocking"]

T = TypeVar("T")


def connect_blocking(
    url: str,
    *,
    token: Token = None,
    codec: str = "zlib",
    settings: SessionSettings | None = None,
    offload: CloudFirst | None = None,
    clock: Callable[[], float] = time.monotonic,
    random: random_module.Random | None = None,
    on_change: OnChange = None,
) -> BlockingRobot:
    """Return a robot for ``with connect_blocking(url, token=...) as robot``; see `connect`.

    *on_change* is called in the thread of the event loop.
    """
    return BlockingRobot(
        connect(
            url,
            token=token,
            codec=codec,
            settings=settings,
            offload=offload,
            clock=clock,
            random=random,
            on_change=on_change,
        )
    )


class BlockingRobot:
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
        if self._loop is not None:
            try:
                self._wait(self._robot.close())
            finally:
                self._end()

    def solve_pnp(
        self,
        points_world: npt.NDArray[np.float64],
        pixels: npt.NDArray[np.float64],
        camera: Camera,
        options: PnpOptions | None = None,
        *,
        deadline_s: float | None = None,
        stream: str = "pose",
        keep: bool = False,
    ) -> PoseAnswer:
        """Estimate the camera pose of one frame in the cloud; see `Robot.solve_pnp`."""
        return self._wait(
            self._robot.solve_pnp(
                points_world, pixels, camera, options, deadline_s=deadline_s, stream=stream, keep=keep
            )
        )

    def call(
        self,
        service: str,
        request: Any,
        reply_type: type[Any] | None = None,
        *,
        deadline_s: float | None = None,
        stream: str = "",
        keep: bool = False,
        on_progress: OnProgress | None = None,
    ) -> Answer:
        """Call a service; see `Robot.call`.  *on_progress* is called in the thread of the event loop."""
        return self._wait(
            self._robot.call(
                service,
                request,
                reply_type,
                deadline_s=deadline_s,
                stream=stream,
                keep=keep,
                on_progress=on_progress,
            )
        )

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
