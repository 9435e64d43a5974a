"""Read the images of a source, and say in one line which of them is damaged.

Every reader of files uses these functions, so that orientation, grey, 16 bits and damage are treated in one
way.
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
    "UnreadableImage", "check_size", "colour_of", "image_files", "is_image", "numbers_in_name", "probe",
    "read_colour", "read_depth", "readable",
]  # fmt: skip

_Row = TypeVar("_Row")
_Made = TypeVar("_Made")
_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"}
_NUMBER = re.compile(r"\d+")
_NO_READING = 65535  # some recorders write "no reading" so
_WHITE_PERCENTILE = 99.9  # of an image of 16 bits: brighter pixels are defects of the sensor
_SAMPLE = 4  # every fourth row and column tells how bright an image is


class UnreadableImage(UsageError):
    """An image is damaged, cut off, empty or too large; a drive leaves it out."""

    def __init__(self, path: Path) -> None:
        super().__init__(
            f"cannot read the image {path}",
            hint=f"check that it is a whole image of at most {MAX_IMAGE_PIXELS} pixels",
        )
        self.name = path.name


def _read_raw(path: Path) -> npt.NDArray[Any]:
    """Return an image as OpenCV reads it, unchanged, its pixels as they are stored.

    Raises:
        UnreadableImage: The file is missing, or no whole image.
        MissingExtra: OpenCV is not installed.
    """
    image = read_image(path, load_opencv().IMREAD_UNCHANGED)
    if image is None:
        raise UnreadableImage(path)
    return image


def is_image(path: Path) -> bool:
    """Say whether a file is an image by its name; files ``._NAME`` hold what macOS adds to a file."""
    return path.suffix.lower() in _ENDINGS and not path.name.startswith("._") and path.is_file()


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of the numbers in their names."""
    paths = [path for path in folder.iterdir() if is_image(path)]
    return sorted(paths, key=lambda path: (numbers_in_name(path), path.name))


def numbers_in_name(path: Path) -> tuple[int, ...]:
    """Return the whole numbers in the name of a file, in their order."""
    return tuple(int(digits) for digits in _NUMBER.findall(path.stem))


def readable(rows: Iterable[_Row], read: Callable[[_Row], _Made], log: DoubtLog) -> Iterator[_Made]:
    """Yield what *read* makes of rows; those with an image that cannot be read are left out, and counted.

    Raises:
        UnreadableImage: No row has a readable image.
    """
    failed: UnreadableImage | None = None
    is_empty = True
    for row in rows:
        try:
            made = read(row)
        except UnreadableImage as error:
            log.leave_out(error.name)
            failed = error
        else:
            is_empty = False
            yield made
    if is_empty and failed is not None:
        raise failed


def probe(rows: Sequence[_Row], read: Callable[[_Row], _Made]) -> list[_Made]:
    """Return what *read* makes of the first, the middle and the last row that have readable images.

    Raises:
        UnreadableImage: None of them has.
    """
    made: list[_Made] = []
    failed: UnreadableImage | None = None
    for row in sorted({0, len(rows) // 2, len(rows) - 1}) if rows else ():
        try:
            made.append(read(rows[row]))
        except UnreadableImage as error:
            failed = error
    if failed is not None and not made:
        raise failed
    return made


def read_colour(path: Path) -> npt.NDArray[np.uint8]:
    """Return the ``(h, w, 3)`` colours of a file, red first; raises UnreadableImage, and as `colour_of`."""
    return colour_of(_read_raw(path), str(path))


def read_depth(path: Path, depth_scale: float) -> npt.NDArray[np.float32]:
    """Return the ``(h, w)`` depth of a file in metres, 0 without a reading; *depth_scale* units are a metre.

    Raises:
        UnreadableImage: The file is missing, or no whole image.
        UsageError: The image has not 16 bits of one channel.
    """
    image = _read_raw(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise UsageError(
            f"{path} is not a 16-bit depth image",
            hint="depth is one 16-bit channel, value / depth_scale in m",
        )
    depth_m: npt.NDArray[np.float32] = np.where(image == _NO_READING, 0, image).astype(np.float32)
    depth_m /= np.float32(depth_scale)
    return depth_m


def colour_of(image: npt.NDArray[Any], name: str) -> npt.NDArray[np.uint8]:
    """Return ``(h, w, 3)``, red first, of an image as OpenCV reads it: grey, BGR or BGRA.

    Values of 16 bits are scaled so that the brightest pixels of the image are white: cameras use 10, 12, 14
    or 16 of them.

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
        white = max(1.0, float(np.percentile(image[::_SAMPLE, ::_SAMPLE], _WHITE_PERCENTILE)))
        image = np.minimum(image.astype(np.float32) * np.float32(255.0 / white), 255.0).astype(np.uint8)
    if channels == 1:
        return np.ascontiguousarray(np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2))
    return np.ascontiguousarray(image[:, :, 2::-1])


def check_size(image: npt.NDArray[Any], camera: Camera, path: Path) -> None:
    """Refuse an image of another size than the camera's: the intrinsics would be those of another camera."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise UsageError(
            f"{path} is {width}x{height} px, the camera of the recording {camera.width}x{camera.height} px",
            hint="give colour and depth the size in intrinsics.json, and scale fx, fy, cx, cy with it",
        )
