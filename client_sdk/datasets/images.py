"""Read the images of a recording, and say in one line which one is broken."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import UsageError
from rse_pf.images import MAX_IMAGE_PIXELS, load_opencv, read_image

__all__ = ["read_colour", "read_image_file"]


def read_colour(path: Path) -> npt.NDArray[np.uint8]:
    """Return the colour image of a file, ``(h, w, 3)``, in the order red, green, blue.

    Raises:
        UsageError: The file is not an image.
        MissingExtra: OpenCV is not installed.
    """
    return read_image_file(path, is_depth=False)


def read_image_file(path: Path, *, is_depth: bool) -> npt.NDArray[Any]:
    """Return colours as `read_colour` does, or a ``(h, w)`` depth image of 16 bits; raises UsageError."""
    cv2 = load_opencv()
    image = read_image(path, cv2.IMREAD_UNCHANGED if is_depth else cv2.IMREAD_COLOR)
    if image is None:
        raise UsageError(
            f"cannot read the image {path}",
            hint=f"unpack the recording again; an image has at most {MAX_IMAGE_PIXELS} pixels",
        )
    if not is_depth:
        rgb: npt.NDArray[Any] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return rgb
    if image.dtype != np.uint16 or image.ndim != 2:
        raise UsageError(
            f"{path} is not a 16-bit depth image",
            hint="depth is one 16-bit channel, value / depth_scale in m",
        )
    return image
