"""A folder of images as a camera: colours, with or without depth.

Colours lie in ``rgb/`` or in the folder itself, depth (16-bit) in ``depth/`` under the same names.  Names
with a decimal point are time stamps in seconds; other images are 0.1 s apart.  Recordings that list their
images are read by `client_sdk.datasets`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.cameras.source import RawFrame, colour_of
from rse_pf.errors import UsageError
from rse_pf.images import MAX_IMAGE_PIXELS, load_opencv, read_image

__all__ = ["image_files", "is_image", "open_folder", "read_raw_image"]

_ENDINGS = {".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"}
_PERIOD_S = 0.1


def is_image(path: Path) -> bool:
    """Say whether a file is an image by its name."""
    return path.suffix.lower() in _ENDINGS and path.is_file()


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of their names, numbers by value."""
    return sorted((path for path in folder.iterdir() if is_image(path)), key=_order)


def open_folder(folder: Path, depth_scale: float) -> tuple[Iterator[RawFrame], bool]:
    """Return the images of a folder, and whether they have depth; *depth_scale* units are a metre.

    Raises:
        UsageError: There is no image, or depth lacks an image.
    """
    colours = image_files(folder / "rgb" if (folder / "rgb").is_dir() else folder)
    if not colours:
        raise UsageError(f"{folder} holds no image", hint="put images into it, or into its folder rgb/")
    depths: dict[str, Path] = {}
    if (folder / "depth").is_dir():
        depths = {path.stem: path for path in image_files(folder / "depth")}
    missing = [path.name for path in colours if path.stem not in depths]
    if depths and missing:
        raise UsageError(
            f"{missing[0]} has no depth image of the same name in {folder / 'depth'}",
            hint="name depth images as colour images, or remove the folder depth/",
        )
    return _images(colours, depths, depth_scale), bool(depths)


def read_raw_image(path: Path) -> npt.NDArray[Any]:
    """Return an image as OpenCV reads it, unchanged; raises UsageError and MissingExtra."""
    cv2 = load_opencv()
    image = read_image(path, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UsageError(
            f"cannot read the image {path}",
            hint=f"check that it is a whole image of at most {MAX_IMAGE_PIXELS} pixels",
        )
    return image


def _images(colours: list[Path], depths: dict[str, Path], depth_scale: float) -> Iterator[RawFrame]:
    stamps = _stamps(colours)
    for stamp, path in zip(stamps, colours, strict=True):
        rgb = colour_of(read_raw_image(path), str(path))
        depth_m = None
        if depths:
            depth = read_raw_image(depths[path.stem])
            if depth.dtype != np.uint16 or depth.ndim != 2:
                raise UsageError(
                    f"{depths[path.stem]} is not a 16-bit depth image",
                    hint="depth is one 16-bit channel, value / depth_scale in m",
                )
            depth_m = np.where(depth == np.iinfo(np.uint16).max, 0, depth).astype(np.float32)
            depth_m /= np.float32(depth_scale)
        yield stamp, rgb, depth_m


def _stamps(paths: list[Path]) -> list[float]:
    """Return the names as seconds if they are decimal numbers, else multiples of the period."""
    try:
        values = [float(path.stem) for path in paths]
    except ValueError:
        values = []
    is_time = any("." in path.stem for path in paths) and len(set(values)) == len(paths)
    is_time = is_time and all(map(math.isfinite, values))
    return values if is_time else [row * _PERIOD_S for row in range(len(paths))]


def _order(path: Path) -> tuple[float, str]:
    stem = path.stem
    digits = stem if stem.replace(".", "", 1).isdecimal() else "".join(filter(str.isdecimal, stem))
    return (float(digits) if digits else 0.0, path.name)
