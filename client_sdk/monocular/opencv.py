"""Load OpenCV, and read images with it that may come from a stranger.

Nothing here looks at what an image shows.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy.typing as npt

from rse_pf.errors import MissingExtra

__all__ = ["MAX_IMAGE_PIXELS", "load_opencv", "read_image"]

MAX_IMAGE_PIXELS = 1 << 25
"""Of one image: a frame of 8K video has fewer, and decoding it takes some 200 MB."""
_LIMIT = "OPENCV_IO_MAX_IMAGE_PIXELS"
"""OpenCV reads it when it is loaded, and compares it with the size in an image's header."""


def load_opencv() -> Any:
    """Return the module ``cv2``, which decodes no image above `MAX_IMAGE_PIXELS`; raises MissingExtra.

    The limit does not hold in a program that imported ``cv2`` by itself before, nor where the environment
    sets another one.
    """
    os.environ.setdefault(_LIMIT, str(MAX_IMAGE_PIXELS))
    try:
        import cv2
    except ImportError as error:
        raise MissingExtra("opencv-python-headless", "vision") from error
    return cv2


def read_image(path: Path, flags: int) -> npt.NDArray[Any] | None:
    """Return the image of a file as OpenCV decodes it with *flags*; None if it is no image, or too large.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    if not path.is_file():  # OpenCV would print a warning, or wait for what a pipe brings
        return None
    try:
        image: npt.NDArray[Any] | None = cv2.imread(str(path), flags)
    except cv2.error:
        return None
    return image
