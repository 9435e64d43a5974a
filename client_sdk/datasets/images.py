"""Read image files for all sources: as stored, without rotation by metadata; grey or colour, 8 or 16 bits.

Formats of single benchmarks are read by the other modules of this package.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from client_sdk.source_facts import DoubtLog
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera
from rse_pf.images import MAX_IMAGE_PIXELS, load_opencv, read_image

__all__ = [
    "UnreadableImage",
    "check_size",
    "colour_of",
    "image_files",
    "is_image",
    "numbers_in_name",
    "probe",
    "probe_size_px",
    "read_colour",
    "read_depth",
    "read_stored_pixels",
    "readable",
]

_Row = TypeVar("_Row")
_Result = TypeVar("_Result")
_IMAGE_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"}
_WHOLE_NUMBER = re.compile(r"\d+")  # in the name of a file
_NO_READING = 65535
"""Value with which some recorders mark a pixel without a reading in a 16-bit depth image; it is read as 0."""
_WHITE_PERCENTILE = 99.9
"""The values of a 16-bit image are scaled so that this percentile of them becomes 255; the brighter pixels,
also 255 then, are mostly defects of the sensor.  Each image is scaled by itself."""
_BRIGHTNESS_STRIDE = 4
"""Step in rows and columns between the pixels from which the brightness of a 16-bit image is measured."""


class UnreadableImage(UsageError):
    """An image file is missing, damaged, cut off, empty or too large; sources leave its frame out."""

    def __init__(self, path: Path) -> None:
        super().__init__(
            f"cannot read the image {path}",
            hint=f"check that it is a whole image of at most {MAX_IMAGE_PIXELS} pixels",
        )
        self.name = path.name


def read_stored_pixels(path: Path) -> npt.NDArray[Any]:
    """Return the pixels of an image file as they are stored: grey ``(h, w)``, BGR or BGRA ``(h, w, c)``.

    Raises:
        UnreadableImage: The file is missing, damaged, cut off, empty or too large.
        MissingExtra: OpenCV is not installed.
    """
    image = read_image(path, load_opencv().IMREAD_UNCHANGED)
    if image is None:
        raise UnreadableImage(path)
    return image


def is_image(path: Path) -> bool:
    """Return whether a path is a file with the ending of an image, and not a file ``._NAME`` of macOS."""
    return path.suffix.lower() in _IMAGE_ENDINGS and not path.name.startswith("._") and path.is_file()


def image_files(folder: Path) -> list[Path]:
    """Return the image files directly in a folder, sorted by the numbers in their names, then by name."""
    paths = [path for path in folder.iterdir() if is_image(path)]
    return sorted(paths, key=lambda path: (numbers_in_name(path), path.name))


def numbers_in_name(path: Path) -> tuple[int, ...]:
    """Return the whole numbers in the name of a file without its ending, from left to right."""
    return tuple(int(digits) for digits in _WHOLE_NUMBER.findall(path.stem))


def readable(rows: Iterable[_Row], read: Callable[[_Row], _Result], log: DoubtLog) -> Iterator[_Result]:
    """Yield ``read(row)`` for each row, and leave out rows whose image cannot be read.

    *log* counts the rows that are left out.

    Raises:
        UnreadableImage: There is a row, but no row whose image can be read; raised after the last row.
    """
    failed: UnreadableImage | None = None
    is_empty = True
    for row in rows:
        try:
            result = read(row)
        except UnreadableImage as error:
            log.leave_out(error.name)
            failed = error
        else:
            is_empty = False
            yield result
    if is_empty and failed is not None:
        raise failed


def probe(rows: Sequence[_Row], read: Callable[[_Row], _Result]) -> list[_Result]:
    """Return ``read(row)`` for the first, the middle and the last row, without those that cannot be read.

    The list is empty if there is no row.

    Raises:
        UnreadableImage: None of the three can be read.
    """
    results: list[_Result] = []
    failed: UnreadableImage | None = None
    for row in sorted({0, len(rows) // 2, len(rows) - 1}) if rows else ():
        try:
            results.append(read(rows[row]))
        except UnreadableImage as error:
            failed = error
    if failed is not None and not results:
        raise failed
    return results


def probe_size_px(paths: Sequence[Path]) -> tuple[int, int]:
    """Return width and height of colour images, px, from the first image that `probe` can read.

    Raises:
        UnreadableImage: `probe` cannot read any.
    """
    height, width = probe(paths, read_colour)[0].shape[:2]
    return width, height


def read_colour(path: Path) -> npt.NDArray[np.uint8]:
    """Return the RGB image ``(h, w, 3)`` of a file.

    Raises:
        UnreadableImage: The file is missing, or no whole image.
        UsageError: The image has other channels or bits than `colour_of` takes.
        MissingExtra: OpenCV is not installed.
    """
    return colour_of(read_stored_pixels(path), str(path))


def read_depth(path: Path, depth_scale: float) -> npt.NDArray[np.float32]:
    """Return the depth image ``(h, w)`` of a file, m, with 0 for pixels without a reading.

    A value of the file divided by *depth_scale* is metres; the values 0 and 65535 are no readings.

    Raises:
        UnreadableImage: The file is missing, or no whole image.
        UsageError: The image does not have one channel of 16 bits.
        MissingExtra: OpenCV is not installed.
    """
    image = read_stored_pixels(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise UsageError(
            f"{path} is not a 16-bit depth image",
            hint="depth is one 16-bit channel, value / depth_scale in m",
        )
    depth_m: npt.NDArray[np.float32] = np.where(image == _NO_READING, 0, image).astype(np.float32)
    depth_m /= np.float32(depth_scale)
    return depth_m


def colour_of(image: npt.NDArray[Any], name: str) -> npt.NDArray[np.uint8]:
    """Return the RGB image ``(h, w, 3)`` of an image as OpenCV reads it: grey, BGR or BGRA, 8 or 16 bits.

    Values of 16 bits are scaled so that the brightest pixels of this image become 255, because cameras use
    10, 12, 14 or all 16 bits, and the file does not state how many.  *name* is the file, for the message.

    Raises:
        UsageError: The image has another number of channels, or neither 8 nor 16 bits.
    """
    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4):
        raise UsageError(
            f"{name} has {channels} channels of {image.dtype}",
            hint="use grey or colour images of 8 or 16 bits",
        )
    if image.dtype == np.uint16:
        white = max(
            1.0, float(np.percentile(image[::_BRIGHTNESS_STRIDE, ::_BRIGHTNESS_STRIDE], _WHITE_PERCENTILE))
        )
        image = np.minimum(image.astype(np.float32) * np.float32(255.0 / white), 255.0).astype(np.uint8)
    if channels == 1:
        return np.ascontiguousarray(np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2))
    return np.ascontiguousarray(image[:, :, 2::-1])


def check_size(image: npt.NDArray[Any], camera: Camera, path: Path) -> None:
    """Refuse an image of another size than its camera; *path* is the file, for the message.

    Raises:
        UsageError: The sizes differ, so that the intrinsics do not fit.
    """
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise UsageError(
            f"{path} is {width}x{height} px, the camera of the recording {camera.width}x{camera.height} px",
            hint="give colour and depth the size in intrinsics.json, and scale fx, fy, cx, cy with it",
        )
