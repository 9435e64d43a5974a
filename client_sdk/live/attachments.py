"""What a robot stores beside its keyframes: made with a keyframe, sent when the link is idle."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from client_sdk.frontend import Features, Frame
from client_sdk.live.keyframe_points import points_of
from client_sdk.live.object_sender import ObjectSender, StoreObject
from client_sdk.live.options import LiveOptions
from rse_pf.slam.keyframe_points import ObjectReference
from rse_pf.token_bucket import TokenBucket

__all__ = ["Attached", "Attachments"]

_BUDGET_S = 2.0
"""What a robot has not used of its share for so long, it may use for the next keyframe."""
_POINT_BYTES = 4.5
_LEAST_POINTS = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class Attached:
    """The bytes of a keyframe's points, None if it has none."""

    points: bytes | None = None

    @property
    def points_reference(self) -> ObjectReference | None:
        """What the keyframe says of its points."""
        return _reference(self.points)


class Attachments:
    """Makes and sends what belongs to the keyframes of one robot; without *store*, nothing."""

    def __init__(
        self,
        store: StoreObject | None,
        options: LiveOptions,
        clock: Callable[[], float],
        wait_quiet: Callable[[], Awaitable[None]],
    ) -> None:
        self._options, self._clock = options, clock
        rate = options.points_bytes_per_s
        self._budget = TokenBucket(rate, burst=_BUDGET_S * rate)
        self._points: ObjectSender | None = None
        if store is not None and options.points:
            self._points = ObjectSender(
                store, bytes_per_s=options.points_bytes_per_s, clock=clock, wait_quiet=wait_quiet
            )

    def make(self, frame: Frame, features: Features) -> Attached:
        """Return what belongs to a keyframe; in any thread."""
        if self._points is None:
            return Attached()
        self._budget.fill(self._clock())
        most = min(self._options.points, int(self._budget.tokens / _POINT_BYTES))
        points = points_of(frame, features, max(most, _LEAST_POINTS))
        if points is not None:
            self._budget.spend(len(points), self._clock())
        return Attached(points=points)

    def add(self, attached: Attached) -> None:
        """Send what belongs to a keyframe that was queued."""
        if self._points is not None and attached.points is not None:
            self._points.add(attached.points)

    async def run(self) -> None:
        """Send until cancelled."""
        await asyncio.gather(*(sender.run() for sender in self._senders()))

    async def wait_empty(self) -> None:
        """Wait until nothing waits."""
        for sender in self._senders():
            await sender.wait_empty()

    def report(self) -> dict[str, Any]:
        """Return what was sent, by kind."""
        return {} if self._points is None else {"points": self._points.report()}

    def _senders(self) -> list[ObjectSender]:
        return [] if self._points is None else [self._points]


def _reference(data: bytes | None) -> ObjectReference | None:
    return None if data is None else ObjectReference(hashlib.sha256(data).hexdigest(), len(data))
