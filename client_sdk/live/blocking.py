"""A live map for programs without asyncio: the mapper runs in the event loop of a blocking robot."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterator
from types import TracebackType
from typing import Any

from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.live.alignments import Correction
from client_sdk.live.mapper import LiveMapper

__all__ = ["BlockingLiveMapper"]


class BlockingLiveMapper:
    """A `LiveMapper` whose methods block; what it knows of the map is in `mapper`."""

    def __init__(self, mapper: LiveMapper, wait: Callable[[Coroutine[Any, Any, Any]], Any]) -> None:
        """Wrap *mapper*; *wait* runs a coroutine to its end in the event loop of its robot."""
        self.mapper = mapper
        self._wait = wait

    def __enter__(self) -> BlockingLiveMapper:
        """Join the map; see `LiveMapper.__aenter__`."""
        self._wait(self.mapper.__aenter__())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Send what waits, and leave the map."""
        self._wait(self.mapper.__aexit__(kind, error, trace))

    def track(self, frame: Frame) -> TrackedFrame:
        """Return the pose of the next frame; see `LiveMapper.track`."""
        tracked: TrackedFrame = self._wait(self.mapper.track(frame))
        return tracked

    def corrections(self) -> Iterator[Correction]:
        """Yield each change of an alignment, and wait for the next; see `LiveMapper.corrections`."""
        changes = self.mapper.corrections()

        async def following() -> Correction | None:
            return await anext(changes, None)

        while (correction := self._wait(following())) is not None:
            yield correction
