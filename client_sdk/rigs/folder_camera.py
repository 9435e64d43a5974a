"""Find the intrinsics of a folder of images: ``intrinsics.json``, or a file of Open3D, ETH3D, SUN3D or
ScanNet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from client_sdk.rigs.benchmark_files import read_numbers, read_text
from client_sdk.rigs.intrinsics import INTRINSICS_HINT, Intrinsics, name_file_in_errors
from client_sdk.rigs.rig_file import read_intrinsics
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

__all__ = ["OWN_FILE", "find_folder_camera"]

OWN_FILE = (
    "intrinsics.json"  # file of the intrinsics of a folder in the format of `client_sdk.rigs.intrinsics`
)
_JSON_FILES = (OWN_FILE, "camera_intrinsic.json", "intrinsic.json")  # the others are those of Open3D
_TEXT_FILES = ("calibration.txt", "intrinsics.txt", "intrinsic/intrinsic_color.txt")
"""Files of ETH3D, SUN3D and ScanNet, in this order: numbers without names."""


def find_folder_camera(
    folder: Path, size_px: Callable[[], tuple[int, int]]
) -> tuple[Path, Intrinsics] | None:
    """Return the file that states the camera of *folder*, and its intrinsics; None if there is no such file.

    One file is read: the first that exists of `_JSON_FILES` and then `_TEXT_FILES`, in their order.  A text
    file holds ``fx fy cx cy``, or the camera matrix as 3x3 or 4x4 numbers row by row.  It does not state the
    size of the images, so *size_px* is called for their width and height, px.

    Raises:
        UsageError: The file cannot be read, or its numbers cannot be intrinsics.
    """
    for name in _JSON_FILES:
        if (folder / name).is_file():
            return folder / name, read_intrinsics(folder / name)
    for name in _TEXT_FILES:
        file = folder / name
        if file.is_file():
            values = read_numbers(file, read_text(file).split())
            if len(values) not in (4, 9, 16):
                raise UsageError(
                    f"{file} holds {len(values)} numbers, neither fx fy cx cy nor a matrix of 9 or 16",
                    hint=INTRINSICS_HINT,
                )
            side = round(len(values) ** 0.5)
            K = np.array(values).reshape(side, side)
            fx, fy, cx, cy = values if side == 2 else (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            width, height = size_px()
            with name_file_in_errors(file, INTRINSICS_HINT):
                camera = Camera(
                    fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), width=width, height=height
                )
            return file, Intrinsics(camera=camera)
    return None
