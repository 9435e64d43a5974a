"""What every source of frames promises, and the part that all sources share.

It knows no device and no file format.
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
    "FrameSource", "FrameStream", "RawFrame", "RawPair", "RawSource", "SourceInfo", "StereoSource",
    "no_depth",
]  # fmt: skip

_LOOKED_AT = 8
"""Frames of a pair of cameras whose images are compared at the start."""
_LOOK_EVERY = 5  # frames of a pair of cameras between two that are looked at in the drive
_LOOKS = 2  # in succession that say the same: one of them may be of a blurred image
_Item = TypeVar("_Item", bound=tuple[Any, ...])

RawFrame = tuple[float, npt.NDArray[np.uint8], "npt.NDArray[np.float32] | None"]
"""Time stamp in seconds, ``(h, w, 3)`` colours, red first, and ``(h, w)`` metres or None; still distorted."""

RawPair = tuple[float, npt.NDArray[np.uint8], npt.NDArray[np.uint8]]
"""Time stamp in seconds, and ``(h, w, 3)`` colours of the left and the right camera, not rectified."""


@runtime_checkable
class FrameSource(Protocol):
    """An iterator of frames of one camera, in the order of time; the end of a device never comes.

    ``camera`` is that of all frames; ``has_depth`` and ``has_stereo`` say whether they have depth, or the
    right image of a pair; ``name`` is for people.
    After `close`, which may be called again, the iterator is at its end.
    """

    name: str
    camera: Camera
    has_depth: bool
    has_stereo: bool

    def __iter__(self) -> Iterator[Frame]:
        """Return the source itself."""

    def __next__(self) -> Frame:
        """Return the next frame; raises UsageError where it cannot be used."""

    def close(self) -> None:
        """Release the device or file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceInfo:
    """What `FrameSource` says of a source.

    ``notes`` say what was assumed, ``log`` what is unlikely; ``span_s`` are the first and the last time
    stamp, None where only the drive tells them.
    """

    name: str
    camera: Camera
    has_depth: bool = False
    has_stereo: bool = False
    notes: tuple[str, ...] = ()
    log: DoubtLog = field(default_factory=DoubtLog)
    span_s: tuple[float, float] | None = None


class FrameStream(AutoClose):
    """A `FrameSource` over items ``(seconds, ...)``, each of which a function makes a frame of.

    Items that are thinned out are dropped before a frame is made; so are those that do not ascend in time,
    which is a doubt about the source.
    """

    def __init__(
        self,
        about: SourceInfo,
        items: Iterator[_Item],
        make: Callable[[_Item], Frame],
        *,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Take items at *rate_hz* as `Thinning` does; *close* releases what they are read from.

        Raises:
            UsageError: The rate is not above 0.
        """
        self._thinning = None if rate_hz is None else Thinning(rate_hz)
        self.name = about.name
        self.camera = about.camera
        self.has_depth = about.has_depth
        self.has_stereo = about.has_stereo
        self.notes = about.notes
        self.log = about.log
        self.span_s = about.span_s
        self._items: Iterator[Any] = items
        self._make: Callable[[Any], Frame] = make
        self._last_s = -math.inf
        self._close = close

    def __iter__(self) -> FrameStream:
        return self

    def __aiter__(self) -> FrameStream:
        return self

    async def __anext__(self) -> Frame:
        """Return the next frame; the camera is read in a thread, so that the connection is served."""
        frame = await asyncio.to_thread(next, self, None)
        if frame is None:
            raise StopAsyncIteration
        return frame

    def __next__(self) -> Frame:
        while True:
            item = next(self._items)
            timestamp_s = item[0]
            if timestamp_s <= self._last_s:
                self._report_order(timestamp_s)
            elif self._thinning is None or self._thinning.plays(timestamp_s):
                self._last_s = timestamp_s
                return self._make(item)

    def _report_order(self, timestamp_s: float) -> None:
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
    """A `FrameSource` over raw images: checks their size, and undistorts them."""

    def __init__(
        self,
        about: SourceInfo,
        raw: Iterator[RawFrame],
        intrinsics: Intrinsics,
        *,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Take images from *raw*; the other arguments are those of `FrameStream`.

        Raises:
            UsageError: The rate is not above 0.
        """
        super().__init__(about, raw, self._frame, rate_hz=rate_hz, close=close)
        self._undistortion = map_to_pinhole(intrinsics)
        self._no_depth = no_depth(self.camera)

    def _frame(self, raw: RawFrame) -> Frame:
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
            depth_m=self._no_depth if depth_m is None else self._undistortion.depth(depth_m),
            camera=self.camera,
        )


class StereoSource(FrameStream):
    """A `FrameSource` over raw pairs of images, which it rectifies."""

    def __init__(
        self,
        about: SourceInfo,
        raw: Iterator[RawPair],
        rig: Rig,
        *,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Take pairs from *raw*, rectified to a camera of their own; other arguments as of `FrameStream`.

        Raises:
            UsageError: The rate is not above 0, or the rig has no stereo pair.
        """
        if rig.right is None:
            raise UsageError(f"the rig of {about.name} has one camera", hint="calibrate both: --stereo")
        self._rectification = Rectification(rig.left, rig.right)
        about = replace(about, camera=self._rectification.camera)
        super().__init__(about, raw, self._frame, rate_hz=rate_hz, close=close)
        self._no_depth = no_depth(self.camera)
        self._ahead: deque[Frame] | None = None
        self._given = 0
        self._last: Frame | None = None
        self._looks: deque[PairMeasurement] = deque(maxlen=_LOOKS)

    def __next__(self) -> Frame:
        """Return the next frame; the first ones are compared before one is given out, and some later ones."""
        if self._ahead is None:
            self._ahead = deque()
            for _ in range(_LOOKED_AT):
                try:
                    self._ahead.append(super().__next__())
                except StopIteration:
                    break
            check_stereo_pairs(itertools.pairwise(self._ahead), self.name)
        frame = self._ahead.popleft() if self._ahead else super().__next__()
        self._look_at(frame)
        return frame

    def _look_at(self, frame: Frame) -> None:
        """Refuse pairs that have come apart: a camera that lost an image shows another moment from then on.

        Raises:
            UsageError: The rows of two images in succession do not fit any more.
        """
        if self._given % _LOOK_EVERY == 1 and self._last is not None:
            self._looks.append(measure_pair(self._last, frame))
            fault = find_fault(self._looks)
            if fault is not None and len(self._looks) == _LOOKS:
                raise UsageError(
                    f"{self.name}: the pairs of images fit at the start, and no longer before "
                    f"{frame.timestamp_s:.3f} s, as if a camera had lost an image: {fault.message}",
                    hint="record the time of each image (MP4, MKV or a bag), or take one: --camera left",
                )
        self._given += 1
        self._last = frame

    def _frame(self, raw: RawPair) -> Frame:
        timestamp_s, left, right = raw
        cv2 = load_opencv()
        return Frame(
            timestamp_s=timestamp_s,
            rgb=self._rectification.left(left),
            depth_m=self._no_depth,
            camera=self.camera,
            stereo=self._rectification.right(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)),
            T_body_camera=self._rectification.T_body_camera,
        )


def no_depth(camera: Camera) -> npt.NDArray[np.float32]:
    """Return a depth image without a reading, which cannot be written to."""
    depth_m = np.zeros((camera.height, camera.width), dtype=np.float32)
    depth_m.flags.writeable = False
    return depth_m
