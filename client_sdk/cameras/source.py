"""The interface of all sources of frames, and what they have in common: order, undistortion, rectification.

Devices and file formats are in the other modules of this package, and in `client_sdk.datasets`.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt

from client_sdk.auto_close import AutoClose
from client_sdk.datasets.thinning import Thinning
from client_sdk.frontend import Frame, load_opencv
from client_sdk.image_map import map_to_pinhole
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.stereo_pair_checks import (
    PairMeasurement,
    check_stereo_pairs,
    find_fault,
    measure_pair,
)
from client_sdk.source_facts import Doubt, DoubtLog, DoubtName
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

__all__ = [
    "FrameSource",
    "FrameStream",
    "RawFrame",
    "RawPair",
    "RawSource",
    "SourceInfo",
    "StereoSource",
    "make_empty_depth",
]

_CHECKED_AT_START = 8  # stereo frames whose images are compared before the first one is delivered
_CHECK_INTERVAL = 5  # stereo frames from one comparison of both images to the next, after the start
_CHECKS_TO_REFUSE = 2
"""Successive comparisons whose matches are taken together to find a fault: one comparison alone may be of a
blurred image."""
_Item = TypeVar("_Item", bound=tuple[Any, ...])

RawFrame = tuple[float, npt.NDArray[np.uint8], "npt.NDArray[np.float32] | None"]
"""A frame before undistortion: time stamp (s), RGB image ``(h, w, 3)``, and depth ``(h, w)`` (m) or None."""

RawPair = tuple[float, npt.NDArray[np.uint8], npt.NDArray[np.uint8]]
"""A stereo frame before rectification: time stamp (s), left and right RGB image ``(h, w, 3)``."""


@runtime_checkable
class FrameSource(Protocol):
    """An iterator of undistorted frames in the order of time; a device delivers frames until it is closed.

    Attributes:
        name: Path or device, for messages.
        camera: The pinhole camera of all frames.
        has_depth: Whether frames have depth.
        has_stereo: Whether frames have the right image of a stereo pair.
    """

    name: str
    camera: Camera
    has_depth: bool
    has_stereo: bool

    def __iter__(self) -> Iterator[Frame]:
        """Return the source itself."""

    def __next__(self) -> Frame:
        """Return the next frame; raises UsageError if it cannot be used, and StopIteration at the end."""

    def close(self) -> None:
        """Release the device or file; may be called again.  The iterator is then at its end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceInfo:
    """The description of a source that `FrameStream` publishes, see `FrameSource`.

    Attributes:
        name: Path or device, for messages.
        camera: The pinhole camera of all frames.
        has_depth: Whether frames have depth.
        has_stereo: Whether frames have the right image of a stereo pair.
        notes: Sentences for the user on what was assumed.
        log: The doubts about the source, to which reading may add some.
        span_s: First and last time stamp, s; None if they are known only while frames come.
    """

    name: str
    camera: Camera
    has_depth: bool = False
    has_stereo: bool = False
    notes: tuple[str, ...] = ()
    log: DoubtLog = field(default_factory=DoubtLog)
    span_s: tuple[float, float] | None = None


class FrameStream(AutoClose):
    """A `FrameSource` that makes a frame of each item of an iterator, in the order of time.

    An item is a tuple whose first element is the time stamp (s).  Items that exceed the wanted rate, and
    items that are not later than the frame delivered last, are dropped before a frame is made.  The first
    item that is not later adds a doubt to *log*.
    """

    def __init__(
        self,
        info: SourceInfo,
        items: Iterator[_Item],
        make_frame: Callable[[_Item], Frame],
        *,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Store the source; nothing is read before the first frame is asked for.

        Args:
            info: Description of the source.
            items: Items in the order of time.
            make_frame: Makes a frame of an item.
            rate_hz: Frames a second that are delivered on average, see `Thinning`; None for all.
            close: Releases the device or file; None if there is none.

        Raises:
            UsageError: The rate is not above 0.
        """
        self._thinning = None if rate_hz is None else Thinning(rate_hz)
        self.name = info.name
        self.camera = info.camera
        self.has_depth = info.has_depth
        self.has_stereo = info.has_stereo
        self.notes = info.notes
        self.log = info.log
        self.span_s = info.span_s
        self._items: Iterator[Any] = items
        self._make_frame: Callable[[Any], Frame] = make_frame
        self._last_s = -math.inf
        self._close = close

    def __iter__(self) -> FrameStream:
        return self

    def __aiter__(self) -> FrameStream:
        return self

    async def __anext__(self) -> Frame:
        """Return the next frame, read in a thread, so that the event loop can serve the connection."""
        frame = await asyncio.to_thread(next, self, None)
        if frame is None:
            raise StopAsyncIteration
        return frame

    def __next__(self) -> Frame:
        while True:
            item = next(self._items)
            timestamp_s = item[0]
            if timestamp_s <= self._last_s:
                self._report_disorder(timestamp_s)
            elif self._thinning is None or self._thinning.selects(timestamp_s):
                self._last_s = timestamp_s
                return self._make_frame(item)

    def _report_disorder(self, timestamp_s: float) -> None:
        """Add a doubt about an image that is not later than the frame delivered last.

        If the log has a doubt about the order of time already, nothing is added.
        """
        if any(doubt.name is DoubtName.TIME_ORDER for doubt in self.log.doubts):
            return
        sentence = (
            f"{self.name} gives an image of {timestamp_s:.6f} s after one of {self._last_s:.6f} s; images "
            "that are not later than the image before are left out"
        )
        hint = "let the driver stamp images with a clock that is never set back"
        self.log.add(Doubt(name=DoubtName.TIME_ORDER, sentence=sentence, hint=hint))

    def close(self) -> None:
        """Release the device or file; the iterator is then at its end."""
        self._items = iter(())
        if self._close is not None:
            self._close()
            self._close = None


class RawSource(FrameStream):
    """A `FrameSource` over the images of one camera: checks their size, and undistorts them."""

    def __init__(
        self,
        info: SourceInfo,
        raw: Iterator[RawFrame],
        intrinsics: Intrinsics,
        *,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Take images from *raw* and undistort them by *intrinsics*; other arguments as of `FrameStream`.

        The camera of *info* must be that of *intrinsics*.

        Raises:
            UsageError: The rate is not above 0.
        """
        super().__init__(info, raw, self._undistort, rate_hz=rate_hz, close=close)
        self._undistortion = map_to_pinhole(intrinsics)
        self._empty_depth = make_empty_depth(self.camera)

    def _undistort(self, raw: RawFrame) -> Frame:
        timestamp_s, rgb, depth_m = raw
        for image in (rgb, rgb if depth_m is None else depth_m):
            height, width = image.shape[:2]
            if (width, height) != (self.camera.width, self.camera.height):
                raise UsageError(
                    f"{self.name} gives images of {width}x{height} px, its intrinsics are for "
                    f"{self.camera.width}x{self.camera.height} px",
                    hint="calibrate at the size that you use: rse-pf camera calibrate",
                )
        return Frame(
            timestamp_s=timestamp_s,
            rgb=self._undistortion.colour(rgb),
            depth_m=self._empty_depth if depth_m is None else self._undistortion.depth(depth_m),
            camera=self.camera,
        )


class StereoSource(FrameStream):
    """A `FrameSource` over the images of a stereo pair: rectifies them, and checks that both fit."""

    def __init__(
        self,
        info: SourceInfo,
        raw: Iterator[RawPair],
        rig: Rig,
        *,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Take pairs from *raw* and rectify them by *rig*; other arguments as of `FrameStream`.

        The camera of the source is the rectified one, whatever *info* says.

        Raises:
            UsageError: The rate is not above 0, or the rig has no stereo pair.
        """
        if rig.right is None:
            raise UsageError(f"the rig of {info.name} has one camera", hint="calibrate both: --stereo")
        self._rectification = Rectification(rig.left, rig.right)
        info = replace(info, camera=self._rectification.camera)
        super().__init__(info, raw, self._rectify, rate_hz=rate_hz, close=close)
        self._empty_depth = make_empty_depth(self.camera)
        self._checked_frames: deque[Frame] | None = None  # not yet delivered; None before the first check
        self._delivered = 0
        self._previous: Frame | None = None
        self._measurements: deque[PairMeasurement] = deque(maxlen=_CHECKS_TO_REFUSE)

    def __next__(self) -> Frame:
        """Return the next frame; both images of the first frames and of every fifth later one are compared.

        The first call reads eight frames, which are delivered after their comparison, one in each call.

        Raises:
            UsageError: The cameras are swapped, not synchronised, or rectified wrongly.
        """
        if self._checked_frames is None:
            self._checked_frames = deque()
            for _ in range(_CHECKED_AT_START):
                try:
                    self._checked_frames.append(super().__next__())
                except StopIteration:
                    break
            check_stereo_pairs(itertools.pairwise(self._checked_frames), self.name)
        frame = self._checked_frames.popleft() if self._checked_frames else super().__next__()
        self._check_later_pair(frame)
        return frame

    def _check_later_pair(self, frame: Frame) -> None:
        """Refuse pairs that fitted at the start and no longer do.

        Each call counts a frame; every fifth frame is compared.  If a camera loses an image, all its later
        images belong to another moment than those of the other one.

        Raises:
            UsageError: The matches of the last two comparisons together show a fault.
        """
        if self._delivered % _CHECK_INTERVAL == 1 and self._previous is not None:
            self._measurements.append(measure_pair(self._previous, frame))
            fault = find_fault(self._measurements)
            if fault is not None and len(self._measurements) == _CHECKS_TO_REFUSE:
                raise UsageError(
                    f"{self.name}: the pairs of images fit at the start, and no longer before "
                    f"{frame.timestamp_s:.3f} s, as if a camera had lost an image: {fault.message}",
                    hint="record the time of each image (MP4, MKV or a bag), or take one: --camera left",
                )
        self._delivered += 1
        self._previous = frame

    def _rectify(self, raw: RawPair) -> Frame:
        timestamp_s, left, right = raw
        cv2 = load_opencv()
        return Frame(
            timestamp_s=timestamp_s,
            rgb=self._rectification.left(left),
            depth_m=self._empty_depth,
            camera=self.camera,
            stereo=self._rectification.right(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)),
            T_body_camera=self._rectification.T_body_camera,
        )


def make_empty_depth(camera: Camera) -> npt.NDArray[np.float32]:
    """Return a depth image ``(h, w)`` without readings (0 m), read-only, for cameras without depth."""
    depth_m = np.zeros((camera.height, camera.width), dtype=np.float32)
    depth_m.flags.writeable = False
    return depth_m
