"""Use a live map in a program without asyncio: the mapper runs in the event loop of a `BlockingRobot`."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterator, Sequence
from types import TracebackType
from typing import Any

from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.live.alignments import Correction
from client_sdk.live.live_mapper import LiveMapper
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.slam.occupancy import GridOptions, OccupancyGrid

__all__ = ["BlockingLiveMapper"]


class BlockingLiveMapper:
    """Wrap the coroutines of a `LiveMapper` in methods that block; ``mapper`` has its properties."""

    def __init__(self, mapper: LiveMapper, wait: Callable[[Coroutine[Any, Any, Any]], Any]) -> None:
        """Store the arguments.

        Args:
            mapper: The live mapper, which becomes the attribute ``mapper``.
            wait: Runs a coroutine in the event loop of the mapper's robot, and returns its result.
        """
        self.mapper = mapper
        self._wait = wait

    def __enter__(self) -> BlockingLiveMapper:
        """Join the map; raises as `LiveMapper.__aenter__` does."""
        self._wait(self.mapper.__aenter__())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Send the queued keyframes and attachments, and leave the map; see `LiveMapper.__aexit__`."""
        self._wait(self.mapper.__aexit__(kind, error, trace))

    def track(self, frame: Frame, *, odometry: Sequence[OdometryReading] = ()) -> TrackedFrame:
        """Return the pose of the next frame; see `LiveMapper.track`."""
        tracked: TrackedFrame = self._wait(self.mapper.track(frame, odometry=odometry))
        return tracked

    def floor_plan(self, options: GridOptions | None = None, *, max_age_s: float = 0.0) -> OccupancyGrid:
        """Return the floor plan of the whole map; see `LiveMapper.floor_plan`."""
        plan: OccupancyGrid = self._wait(self.mapper.floor_plan(options, max_age_s=max_age_s))
        return plan

    def corrections(self) -> Iterator[Correction]:
        """Yield each change of an alignment, and block until the next; see `LiveMapper.corrections`."""
        corrections = self.mapper.corrections()

        async def next_correction() -> Correction | None:
            return await anext(corrections, None)

        while (correction := self._wait(next_correction())) is not None:
            yield correction
