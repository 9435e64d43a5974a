"""What a robot stores beside its keyframes: made with a keyframe, sent when the link is idle."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from client_sdk.frontend import Features, Frame, load_opencv
from client_sdk.live.keyframe_points import points_of
from client_sdk.live.object_sender import ObjectSender, StoreObject
from client_sdk.live.options import LiveOptions
from client_sdk.transfer.data_connection import MAX_SINGLE_PUT_BYTES
from rse_pf.slam.keyframe_points import ObjectReference
from rse_pf.token_bucket import TokenBucket

__all__ = ["Attached", "Attachments"]

_BUDGET_S = 2.0
"""What a robot has not used of its share for so long, it may use for the next keyframe."""
_POINT_BYTES = 4.5
_LEAST_POINTS = 400
_QUALITY = 85


@dataclass(frozen=True, slots=True, kw_only=True)
class Attached:
    """The bytes of a keyframe's points and of its image (JPEG), None where it has none."""

    points: bytes | None = None
    image: bytes | None = None

    @property
    def points_reference(self) -> ObjectReference | None:
        """What the keyframe says of its points."""
        return _reference(self.points)

    @property
    def image_reference(self) -> ObjectReference | None:
        """What the keyframe says of its image."""
        return _reference(self.image)


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
        self.may_have_images = False
        """Whether the platform allows images; it says so when the robot joins the map."""
        self._points, self._images = (
            ObjectSender(store, bytes_per_s=rate, clock=clock, wait_quiet=wait_quiet)
            if store is not None and is_wanted
            else None
            for rate, is_wanted in (
                (options.points_bytes_per_s, options.points > 0), (options.images_bytes_per_s, options.images)
            )
        )  # fmt: skip
        self._budget, self._image_budget = (
            TokenBucket(rate, burst=_BUDGET_S * rate)
            for rate in (options.points_bytes_per_s, options.images_bytes_per_s)
        )

    def make(self, frame: Frame, features: Features) -> Attached:
        """Return what belongs to a keyframe; in any thread."""
        points, image, now = None, None, self._clock()
        if self._points is not None:
            self._budget.fill(now)
            most = min(self._options.points, int(self._budget.tokens / _POINT_BYTES))
            points = points_of(frame, features, max(most, _LEAST_POINTS))
            self._budget.spend(len(points or b""), now)
        if self._images is not None and self.may_have_images:
            self._image_budget.fill(now)
            if self._image_budget.tokens > 0:
                image = _jpeg(frame)
                self._image_budget.spend(len(image or b""), now)
        return Attached(points=points, image=image)

    def add(self, attached: Attached) -> None:
        """Send what belongs to a keyframe that was queued."""
        for sender, data in ((self._points, attached.points), (self._images, attached.image)):
            if sender is not None and data is not None:
                sender.add(data)

    async def run(self) -> None:
        """Send until cancelled."""
        await asyncio.gather(*(sender.run() for sender in self._senders()))

    async def wait_empty(self) -> None:
        """Wait until nothing waits."""
        for sender in self._senders():
            await sender.wait_empty()

    def report(self) -> dict[str, Any]:
        """Return what was sent, by kind."""
        named = {"points": self._points, "images": self._images if self.may_have_images else None}
        return {name: sender.report() for name, sender in named.items() if sender is not None}

    def _senders(self) -> list[ObjectSender]:
        return [sender for sender in (self._points, self._images) if sender is not None]


def _jpeg(frame: Frame) -> bytes | None:
    """Return the image of a frame as JPEG; None if it is too large for one request."""
    cv2 = load_opencv()
    image = np.ascontiguousarray(frame.rgb[:, :, ::-1])
    is_encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes() if is_encoded and data.nbytes <= MAX_SINGLE_PUT_BYTES else None


def _reference(data: bytes | None) -> ObjectReference | None:
    return None if data is None else ObjectReference(hashlib.sha256(data).hexdigest(), len(data))
