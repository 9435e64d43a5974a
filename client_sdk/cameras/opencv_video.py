"""Open cameras and videos with OpenCV: a device by its number, a video file, or a stream by its address.

The time stamps of a file are its presentation times, or follow from a rate if it has none; those of a device
or stream are times of arrival on a monotonic clock.  There is no depth.
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
from rse_pf.images import MAX_IMAGE_PIXELS, load_opencv
from rse_pf.storage.files import check_exists

__all__ = ["Video", "open_video"]

_PROBED_FRAMES = 3  # the presentation times of this many frames show whether a file has such times
_MAX_MISSES = 30  # a device or stream that gave no image in this many successive reads is an error
_MIN_RATE_HZ = 0.1
"""Smallest rate of a file that is used; a smaller one is a mistake of its container, and 30 Hz are
assumed."""
_MAX_RATE_HZ = 1000.0
"""Largest rate of a file that is used; a larger one is a mistake of its container, and 30 Hz are assumed."""
_ASSUMED_RATE_HZ = 30.0  # rate of a file that states none, or one outside of these limits
_TEXT_PROBE_BYTES = 64
"""Number of first bytes of a file that are checked.  A file of which all are printable, or which is empty, is
refused as a text, since OpenCV would open the files that a playlist names.  YUV4MPEG2 videos are accepted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """An open device, stream or file.

    Attributes:
        images: Its images, not undistorted, without depth.
        close: Releases the device or file.
        frame_count: Number of frames that a file states; 0 if it states none, and for a device or stream.
        period_s: Time between frames of a file, s, by its stated rate or 30 Hz; 0 for a device or stream.
        notes: Sentences for the user on what was assumed.
    """

    images: Iterator[RawFrame]
    close: Callable[[], None]
    frame_count: int = 0
    period_s: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Start and end of a file, s: 0, and its stated number of frames times the time between two frames.

        None for a device, a stream, or a file that states no number of frames.
        """
        return (0.0, self.frame_count * self.period_s) if self.frame_count else None


def open_video(source: str, clock: Callable[[], float] = time.monotonic) -> Video:
    """Open a device (``0``), a video file or a stream (``rtsp://...``).

    Args:
        source: Number, path or address.
        clock: Clock of the time stamps of a device or stream, s.

    Raises:
        UsageError: There is no such device or file, OpenCV cannot read it, or its images are too large.
        MissingExtra: OpenCV is not installed.
    """
    # 1. Refuse a path that is no video, because OpenCV would wait for a pipe, or open the files that a
    #    playlist names.
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
            f"{source} is a text file, not a video", hint="name the video itself, not a playlist of videos"
        )
    # 2. Open it.
    _silence_warnings(cv2)
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
    # 3. Make a device deliver its latest image; give a file presentation times, or times by its rate.
    if is_device:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    if not is_file:
        return Video(images=_device_images(capture, source, clock), close=capture.release)
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    period_s = 1.0 / (rate_hz if _MIN_RATE_HZ <= rate_hz <= _MAX_RATE_HZ else _ASSUMED_RATE_HZ)
    has_times = _has_times(cv2, source)
    assumed = f"{source} states no presentation times: {1.0 / period_s:g} frames a second are assumed"
    return Video(
        images=_file_images(cv2, capture, source, None if has_times else period_s),
        close=capture.release,
        frame_count=max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT))),
        period_s=period_s,
        notes=() if has_times else (assumed,),
    )


def _has_times(cv2: Any, source: str) -> bool:
    """Return whether the presentation times of the first three frames of a file increase.

    Some containers have no presentation times; time stamps then follow from the rate of the file.  The result
    is True for fewer than two frames.
    """
    capture = cv2.VideoCapture(source)
    try:
        times_ms = [
            float(capture.get(cv2.CAP_PROP_POS_MSEC)) for _ in range(_PROBED_FRAMES) if capture.grab()
        ]
    finally:
        capture.release()
    return len(times_ms) < 2 or all(earlier < later for earlier, later in itertools.pairwise(times_ms))


def _is_text(path: Path) -> bool:
    """Return whether the first 64 bytes of a file are printable text; True for an empty file, too.

    False for a YUV4MPEG2 video, although its head is printable.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_TEXT_PROBE_BYTES)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="name another video") from error
    return all(32 <= byte < 127 or byte in b"\t\r\n" for byte in start) and not start.startswith(b"YUV4MPEG2")


def _silence_warnings(cv2: Any) -> None:
    """Stop OpenCV from printing its warnings, in the whole process.

    OpenCV has the function in one of two modules, depending on its version.
    """
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    logging.setLogLevel(0)


def _file_images(cv2: Any, capture: Any, name: str, period_s: float | None) -> Iterator[RawFrame]:
    """Yield the images of a file with their presentation times, or with times that are *period_s* apart."""
    row = 0
    while True:
        is_read, image = capture.read()
        if not is_read:
            if row == 0:
                raise UsageError(f"{name} holds no image", hint="record it again")
            return
        stamp_s = float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3 if period_s is None else row * period_s
        yield stamp_s, colour_of(image, name), None
        row += 1


def _device_images(capture: Any, name: str, clock: Callable[[], float]) -> Iterator[RawFrame]:
    """Yield the images of a device or stream with their times of arrival.

    Raises:
        UsageError: The device has delivered no image in 30 successive reads.
    """
    misses = 0
    while misses < _MAX_MISSES:
        is_read, image = capture.read()
        misses = 0 if is_read else misses + 1
        if is_read:
            yield clock(), colour_of(image, name), None
    raise UsageError(f"camera {name} gives no more images", hint="check its cable")
