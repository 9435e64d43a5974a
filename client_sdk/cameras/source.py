"""What every source of frames promises, and the part that all sources share.

It knows no device and no file format.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from client_sdk.closing import Closing
from client_sdk.datasets.thinning import Thinning
from client_sdk.frontend import Frame
from client_sdk.rigs.intrinsics import Intrinsics, Undistortion
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

__all__ = ["FrameSource", "RawFrame", "RawSource", "colour_of"]

RawFrame = tuple[float, npt.NDArray[np.uint8], "npt.NDArray[np.float32] | None"]
"""Time stamp in seconds, ``(h, w, 3)`` colours, red first, and ``(h, w)`` metres or None; still distorted."""


@runtime_checkable
class FrameSource(Protocol):
    """An iterator of frames of one camera, in the order of time; the end of a device never comes.

    ``camera`` is that of all frames; ``has_depth`` says whether they have depth; ``name`` is for people.
    After `close`, which may be called again, the iterator is at its end.
    """

    name: str
    camera: Camera
    has_depth: bool

    def __iter__(self) -> Iterator[Frame]:
        """Return the source itself."""

    def __next__(self) -> Frame:
        """Return the next frame; raises UsageError where it cannot be used."""

    def close(self) -> None:
        """Release the device or file."""


class RawSource(Closing):
    """A `FrameSource` over raw images: checks their size, undistorts them and thins them out."""

    def __init__(
        self,
        name: str,
        raw: Iterator[RawFrame],
        intrinsics: Intrinsics,
        *,
        has_depth: bool,
        rate_hz: float | None = None,
        close: Callable[[], None] | None = None,
    ) -> None:
        """Take images from *raw* at *rate_hz* as `Thinning` does; *close* releases what it reads from.

        Raises:
            UsageError: The rate is not above 0.
        """
        self._thinning = None if rate_hz is None else Thinning(rate_hz)
        self.name = name
        self.camera = intrinsics.camera
        self.has_depth = has_depth
        self._raw = raw
        self._undistortion = Undistortion(intrinsics)
        self._last_s = -math.inf
        self._close = close
        self._no_depth = np.zeros((self.camera.height, self.camera.width), dtype=np.float32)
        self._no_depth.flags.writeable = False

    def __iter__(self) -> RawSource:
        return self

    def __aiter__(self) -> RawSource:
        return self

    async def __anext__(self) -> Frame:
        """Return the next frame; the camera is read in a thread, so that the connection is served."""
        frame = await asyncio.to_thread(next, self, None)
        if frame is None:
            raise StopAsyncIteration
        return frame

    def __next__(self) -> Frame:
        if self._raw is None:
            raise StopIteration
        while True:
            timestamp_s, rgb, depth_m = next(self._raw)
            if timestamp_s <= self._last_s:
                continue
            if self._thinning is None or self._thinning.plays(timestamp_s):
                break
        self._last_s = timestamp_s
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

    def close(self) -> None:
        """Release the device or file; the iterator is then at its end."""
        self._raw = iter(())
        if self._close is not None:
            self._close()
            self._close = None


def colour_of(image: npt.NDArray[np.uint8], name: str) -> npt.NDArray[np.uint8]:
    """Return ``(h, w, 3)``, red first, of an image as OpenCV reads it: grey, BGR or BGRA.

    Raises:
        UsageError: The image has another number of channels, or not 8 bits.
    """
    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != np.uint8 or channels not in (1, 3, 4):
        raise UsageError(
            f"{name} has {channels} channels of {image.dtype}", hint="use grey or colour images of 8 bits"
        )
    if channels == 1:
        return np.ascontiguousarray(np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2))
    return np.ascontiguousarray(image[:, :, 2::-1])
