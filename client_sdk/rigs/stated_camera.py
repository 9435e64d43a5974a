"""The camera that a folder states in a file of another program, where it has no ``intrinsics.json``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from client_sdk.rigs.benchmark_files import read_numbers, read_text
from client_sdk.rigs.intrinsics import INTRINSICS_HINT, Intrinsics, name_file_in_errors, read_intrinsics
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

__all__ = ["stated_camera"]

_OBJECTS = ("camera_intrinsic.json", "intrinsic.json")  # of Open3D and its recorders
_NUMBERS = ("calibration.txt", "intrinsics.txt", "intrinsic/intrinsic_color.txt")  # ETH3D, SUN3D, ScanNet


def stated_camera(folder: Path, size_px: Callable[[], tuple[int, int]]) -> tuple[Path, Intrinsics] | None:
    """Return the file that states the camera of a folder, and what it states; None if there is none.

    A text holds ``fx fy cx cy``, or a matrix of 3x3 or 4x4 numbers, and no size of the images: that is what
    *size_px* returns, width and height.

    Raises:
        UsageError: The file has other numbers.
    """
    for name in _OBJECTS:
        if (folder / name).is_file():
            return folder / name, read_intrinsics(folder / name)
    for name in _NUMBERS:
        file = folder / name
        if file.is_file():
            values = read_numbers(file, read_text(file).split())
            if len(values) not in (4, 9, 16):
                raise UsageError(
                    f"{file} holds {len(values)} numbers, neither fx fy cx cy nor a matrix",
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
