"""Cameras and videos that OpenCV opens: a device number, a video file, or the address of a stream.

The time stamps of a file are its own, those of a device are the clock's.  There is no depth.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from client_sdk.cameras.source import RawFrame, colour_of
from rse_pf.errors import UsageError
from rse_pf.images import MAX_IMAGE_PIXELS, load_opencv

__all__ = ["is_video_file", "open_video"]

_MAX_MISSES = 30
"""A device that gives no image so many times in a row has gone."""


def is_video_file(source: str) -> bool:
    """Say whether a source is a file, neither a device nor a stream.

    Raises:
        UsageError: There is no such file.
    """
    is_file = not source.isdigit() and "://" not in source
    if is_file and not Path(source).is_file():
        raise UsageError(f"there is no video {source}", hint="name a device number, a video or a folder")
    return is_file


def open_video(
    source: str, clock: Callable[[], float] = time.monotonic
) -> tuple[Iterator[RawFrame], Callable[[], None]]:
    """Open a device (``0``), a video file or a stream; return its images and how to close it.

    Raises:
        UsageError: There is no such device or file, or OpenCV cannot read it.
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    is_device, is_file = source.isdigit(), is_video_file(source)
    if is_file and _is_text(Path(source)):
        raise UsageError(
            f"{source} is a text, not a video", hint="a playlist names other files: name the video itself"
        )
    _silence(cv2)
    capture = cv2.VideoCapture(int(source) if is_device else source)
    if not capture.isOpened():
        capture.release()
        if is_device:
            raise UsageError(
                f"camera {source} cannot be opened",
                hint="see ls /dev/video*; close other programs that use it; add yourself to the group video",
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
    images = _file_images(cv2, capture, source) if is_file else _device_images(capture, source, clock)
    return images, capture.release


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


def _file_images(cv2: Any, capture: Any, name: str) -> Iterator[RawFrame]:
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    period_s = 1.0 / rate_hz if 0.1 <= rate_hz <= 1000 else 1.0 / 30.0
    row = 0
    while True:
        good, image = capture.read()
        if not good:
            if row == 0:
                raise UsageError(f"{name} holds no image", hint="record it again")
            return
        # By number: the position that containers report is 0 in some of them.
        yield row * period_s, colour_of(image, name), None
        row += 1


def _device_images(capture: Any, name: str, clock: Callable[[], float]) -> Iterator[RawFrame]:
    misses = 0
    while misses < _MAX_MISSES:
        good, image = capture.read()
        misses = 0 if good else misses + 1
        if good:
            yield clock(), colour_of(image, name), None
    raise UsageError(f"camera {name} gives no more images", hint="check its cable")
