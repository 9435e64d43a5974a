"""Sources of frames, and what they have in common: order of time, frame rate, undistortion, rectification.

Devices and file formats are read by the other modules of this package, and by `client_sdk.datasets`.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from client_sdk.auto_close import AutoClose
from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.thinning import Thinning
from client_sdk.frontend import Frame, load_opencv
from client_sdk.image_map import map_to_pinhole
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rectification import Rectification
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
    "RawFrame",
    "RawPair",
    "checked_pairs",
    "make_empty_depth",
    "rectified",
    "select_in_time",
    "undistorted",
]

_CHECKED_AT_START = 8  # first stereo frames that are read and checked before the first one is delivered
_CHECK_INTERVAL = 5  # later, the left and the right image of one stereo frame in this many are compared
_CHECKS_TO_REFUSE = 2
"""The rig is refused by the matches of this many successive comparisons together: one comparison may be of a
blurred image.  A comparison matches features of the left image with those of the right image of one frame."""
_Item = TypeVar("_Item", bound=tuple[Any, ...])

RawFrame = tuple[float, npt.NDArray[np.uint8], "npt.NDArray[np.float32] | None"]
"""A frame before undistortion: time stamp (s), RGB image ``(h, w, 3)``, and depth ``(h, w)`` (m) or None."""

RawPair = tuple[float, npt.NDArray[np.uint8], npt.NDArray[np.uint8]]
"""A stereo frame before rectification: time stamp (s), left and right RGB image ``(h, w, 3)``."""


@dataclass(slots=True, kw_only=True, eq=False)
class FrameSource(AutoClose):
    """An iterator of undistorted frames in the order of time; a device delivers frames until it is closed.

    ``async for`` reads each frame in a thread, so that the event loop can serve the robot's connection.

    Attributes:
        name: Path or name of the device, for messages.
        camera: The pinhole camera of all frames.
        frames: The frames.
        has_depth: Whether frames have depth.
        has_stereo: Whether frames have the right image of a stereo pair.
        notes: Sentences for the user on what was assumed because the source does not state it.
        log: The doubts about the source; reading may add some.
        span_s: First and last time stamp, s; None if they are not known before the frames are read.
        release: Releases the device or file; None if there is none.
        recording: The recording of the frames; None for a device, a video or a folder of images.
    """

    name: str
    camera: Camera
    frames: Iterator[Frame]
    has_depth: bool = False
    has_stereo: bool = False
    notes: tuple[str, ...] = ()
    log: DoubtLog = field(default_factory=DoubtLog)
    span_s: tuple[float, float] | None = None
    release: Callable[[], None] | None = None
    recording: Dataset | None = None

    def __iter__(self) -> FrameSource:
        """Return the source itself."""
        return self

    def __aiter__(self) -> FrameSource:
        """Return the source itself."""
        return self

    async def __anext__(self) -> Frame:
        """Return the next frame, read in a thread; raises as `__next__` does."""
        frame = await asyncio.to_thread(next, self, None)
        if frame is None:
            raise StopAsyncIteration
        return frame

    def __next__(self) -> Frame:
        """Return the next frame; raises UsageError if it cannot be used, and StopIteration at the end.

        The first call on a stereo pair reads eight frames (`checked_pairs`), so that the first eight frames
        of two devices are delivered late.
        """
        return next(self.frames)

    def close(self) -> None:
        """Release the device or file, so that the iterator is at its end; may be called again."""
        self.frames = iter(())
        if self.release is not None:
            self.release()
            self.release = None


def select_in_time(
    items: Iterable[_Item], name: str, log: DoubtLog, thinning: Thinning | None = None
) -> Iterator[_Item]:
    """Yield the items that are later than the last yielded item, and that *thinning* selects.

    The first element of an item is its time stamp, s.  An item that is not later than the last yielded one is
    left out; the first such item adds a doubt to *log*, unless the log has a doubt about the order of time
    already.  *name* is the source, for the doubt.  If *thinning* is None, all later items are yielded.
    """
    last_s = -math.inf
    for item in items:
        timestamp_s = item[0]
        if timestamp_s > last_s:
            if thinning is None or thinning.selects(timestamp_s):
                last_s = timestamp_s
                yield item
        elif all(doubt.name is not DoubtName.TIME_ORDER for doubt in log.doubts):
            sentence = (
                f"{name} gives an image of {timestamp_s:.6f} s after one of {last_s:.6f} s; images "
                "that are not later than the image before are left out"
            )
            hint = "let the driver stamp images with a clock that is never set back"
            log.add(Doubt(name=DoubtName.TIME_ORDER, sentence=sentence, hint=hint))


def undistorted(raw: Iterable[RawFrame], lens: Intrinsics, name: str) -> Iterator[Frame]:
    """Yield the frames of one camera without the distortion of *lens*; *name* is the source, for errors.

    Raises:
        UsageError: An image does not have the size that *lens* states.
    """
    camera, undistortion = lens.camera, map_to_pinhole(lens)
    empty_depth = make_empty_depth(camera)
    for timestamp_s, rgb, depth_m in raw:
        for image in (rgb, rgb if depth_m is None else depth_m):
            height, width = image.shape[:2]
            if (width, height) != (camera.width, camera.height):
                raise UsageError(
                    f"{name} gives images of {width}x{height} px, its intrinsics are for "
                    f"{camera.width}x{camera.height} px",
                    hint="calibrate at the size that you use: rse-pf camera calibrate",
                )
        yield Frame(
            timestamp_s=timestamp_s,
            rgb=undistortion.colour(rgb),
            depth_m=empty_depth if depth_m is None else undistortion.depth(depth_m),
            camera=camera,
        )


def rectified(raw: Iterable[RawPair], rectification: Rectification) -> Iterator[Frame]:
    """Yield the rectified frames of a stereo pair; raises UsageError if an image has another size."""
    empty_depth = make_empty_depth(rectification.camera)
    cv2 = load_opencv()
    for timestamp_s, left, right in raw:
        yield Frame(
            timestamp_s=timestamp_s,
            rgb=rectification.left(left),
            depth_m=empty_depth,
            camera=rectification.camera,
            stereo=rectification.right(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)),
            T_body_camera=rectification.T_body_camera,
        )


def checked_pairs(frames: Iterator[Frame], name: str) -> Iterator[Frame]:
    """Yield rectified stereo frames, and refuse a rig if their images show a fault.

    The left and right images of the first eight frames are compared before the first frame is yielded.  Later
    those of every fifth frame are compared, because two devices whose images are paired by their order get
    out of step when one of them loses an image.

    Raises:
        UsageError: The first frames together, or the last two comparisons together, show that the cameras are
            swapped, not synchronised, or rectified wrongly; *name* is the source in its message.
    """
    first_frames = list(itertools.islice(frames, _CHECKED_AT_START))
    check_stereo_pairs(itertools.pairwise(first_frames), name)
    measurements: deque[PairMeasurement] = deque(maxlen=_CHECKS_TO_REFUSE)
    previous: Frame | None = None
    for number, frame in enumerate(itertools.chain(first_frames, frames)):
        if number % _CHECK_INTERVAL == 1 and previous is not None:
            measurements.append(measure_pair(previous, frame))
            fault = find_fault(measurements)
            if fault is not None and len(measurements) == _CHECKS_TO_REFUSE:
                raise UsageError(
                    f"{name}: the left and right images fit each other at the start, but no longer at "
                    f"{frame.timestamp_s:.3f} s, as if a camera had lost an image: {fault.message}",
                    hint="record the time of each image (MP4, MKV or a bag), or take one: --camera left",
                )
        previous = frame
        yield frame


def make_empty_depth(camera: Camera) -> npt.NDArray[np.float32]:
    """Return a read-only depth image ``(h, w)`` of zeros, which mean that there are no readings."""
    depth_m = np.zeros((camera.height, camera.width), dtype=np.float32)
    depth_m.flags.writeable = False
    return depth_m
