"""Cameras and videos that OpenCV opens: a device number, a video file, or the address of a stream.

The time stamps of a file are its presentation times, those of a device are the clock's.  There is no depth.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client_sdk.cameras.source import RawFrame
from client_sdk.datasets.images import colour_of
from rse_pf.errors import UsageError
from rse_pf.files import check_exists
from rse_pf.images import MAX_IMAGE_PIXELS, load_opencv

__all__ = ["Video", "open_video"]

_LOOKED_AT = 3  # frames that are read to see whether a file has presentation times
_MAX_MISSES = 30
"""A device that gives no image so many times in a row has gone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """Images of a device or of a file, and how to close it.

    ``frames`` is how many a file states, 0 if it states none; ``period_s`` is the time between them, of a
    device 0.  ``notes`` say what was assumed.
    """

    images: Iterator[RawFrame]
    close: Callable[[], None]
    frames: int = 0
    period_s: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def span_s(self) -> tuple[float, float] | None:
        """First and last time of a file, by the frames that it states; None of a device."""
        return (0.0, self.frames * self.period_s) if self.frames else None


def open_video(source: str, clock: Callable[[], float] = time.monotonic) -> Video:
    """Open a device (``0``), a video file or a stream.

    Raises:
        UsageError: There is no such device or file, or OpenCV cannot read it.
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    is_device, is_file = source.isdigit(), not source.isdigit() and "://" not in source
    if is_file:
        check_exists(source, "name a device by its number, or a video")
    if is_file and not Path(source).is_file():
        raise UsageError(
            f"there is no video {source}: it is no regular file",
            hint="name a video, or a device by its number, such as 0",
        )
    if is_file and _is_text(Path(source)):
        raise UsageError(
            f"{source} is a text, not a video", hint="a playlist names other files: name the video itself"
        )
    _silence(cv2)
    capture = cv2.VideoCapture(int(source) if is_device else source)
    if not capture.isOpened():
        capture.release()
        if is_device:
            device = Path(f"/dev/video{int(source)}")
            if device.parent.is_dir() and not device.exists():
                raise UsageError(
                    f"camera {source} cannot be opened: {device} does not exist",
                    hint="connect the camera; ls /dev/video* lists those that are there",
                )
            raise UsageError(
                f"camera {source} cannot be opened",
                hint="close other programs that use it, and add yourself to the group video",
            )
        raise UsageError(f"{source} is not a video that OpenCV can read", hint="convert it, such as to mp4")
    width, height = (
        int(capture.get(property_id)) for property_id in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    )
    if width * height > MAX_IMAGE_PIXELS:
        capture.release()
        raise UsageError(
            f"{source} has images of {width}x{height} px, above {MAX_IMAGE_PIXELS} pixels",
            hint="make them smaller",
        )
    if is_device:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    if not is_file:
        return Video(images=_device_images(capture, source, clock), close=capture.release)
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    period_s = 1.0 / rate_hz if 0.1 <= rate_hz <= 1000 else 1.0 / 30.0
    has_times = _has_times(cv2, source)
    assumed = f"{source} states no presentation times: {1.0 / period_s:g} frames a second are assumed"
    return Video(
        images=_file_images(cv2, capture, source, None if has_times else period_s),
        close=capture.release,
        frames=max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT))),
        period_s=period_s,
        notes=() if has_times else (assumed,),
    )


def _has_times(cv2: Any, source: str) -> bool:
    """Return whether the first frames of a file have presentation times: some containers report none."""
    capture = cv2.VideoCapture(source)
    try:
        times_ms = [float(capture.get(cv2.CAP_PROP_POS_MSEC)) for _ in range(_LOOKED_AT) if capture.grab()]
    finally:
        capture.release()
    return len(times_ms) < 2 or all(earlier < later for earlier, later in itertools.pairwise(times_ms))


def _is_text(path: Path) -> bool:
    """Say whether a file begins as a text; of the formats of videos only YUV4MPEG2 does."""
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="name another video") from error
    return all(32 <= byte < 127 or byte in b"\t\r\n" for byte in start) and not start.startswith(b"YUV4MPEG2")


def _silence(cv2: Any) -> None:
    """Keep OpenCV from printing warnings of its own beside ours; 4.14 has the function in another module."""
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    logging.setLogLevel(0)


def _file_images(cv2: Any, capture: Any, name: str, period_s: float | None) -> Iterator[RawFrame]:
    """Yield the images of a file with their presentation times, or *period_s* apart."""
    row = 0
    while True:
        good, image = capture.read()
        if not good:
            if row == 0:
                raise UsageError(f"{name} holds no image", hint="record it again")
            return
        stamp_s = float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3 if period_s is None else row * period_s
        yield stamp_s, colour_of(image, name), None
        row += 1


def _device_images(capture: Any, name: str, clock: Callable[[], float]) -> Iterator[RawFrame]:
    misses = 0
    while misses < _MAX_MISSES:
        good, image = capture.read()
        misses = 0 if good else misses + 1
        if good:
            yield clock(), colour_of(image, name), None
    raise UsageError(f"camera {name} gives no more images", hint="check its cable")
