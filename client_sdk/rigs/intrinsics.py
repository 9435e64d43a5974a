"""``intrinsics.json``: a camera with its lens, as calibration writes it and every source reads it.

::

    {"fx": 525.1, "fy": 525.3, "cx": 319.8, "cy": 240.1, "width": 640, "height": 480,
     "model": "radial-tangential", "distortion": [k1, k2, p1, p2, k3],
     "depth_scale": 1000, "rms_px": 0.31, "views": 24}

Lengths are pixels.  ``distortion`` (OpenCV's order), ``depth_scale`` (units of a 16-bit depth image in a
metre), ``rms_px`` and ``views`` (of the calibration) may be left out, and ``model`` for all lenses but
``fisheye`` (Kannala and Brandt), whose ``distortion`` is ``[k1, k2, k3, k4]``.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from client_sdk.frontend import load_opencv
from client_sdk.image_map import ImageMap
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.files import read_regular_file
from rse_pf.geometry import Array, Camera
from rse_pf.images import MAX_IMAGE_PIXELS

__all__ = [
    "Intrinsics", "LensModel", "Undistortion", "intrinsics_of", "lens_maps", "read_intrinsics", "read_json",
    "told_with", "values_of", "write_intrinsics", "write_json",
]  # fmt: skip

LensModel = Literal["radial-tangential", "fisheye"]

_T = TypeVar("_T", int, float)
_MAX_FILE_BYTES = 1 << 20
_MAX_DISTORTION = 1e3
_MIN_DEPTH_SCALE, _MAX_DEPTH_SCALE = 1e-2, 1e7
_HINT = "it needs fx fy cx cy width height, and may have distortion [k1 k2 p1 p2 k3] and depth_scale"


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A camera, the distortion of its lens (0, 4 or 5 numbers) and the scale of its 16-bit depth images.

    ``model`` says what the numbers of ``distortion`` are: k1 k2 p1 p2 k3 of a ``radial-tangential`` lens, or
    k1 k2 k3 k4 of a ``fisheye`` (Kannala and Brandt, PAMI 2006, as OpenCV's fisheye module has it).
    ``rms_px`` and ``views`` tell how it was calibrated; None if unknown.

    Raises:
        UsageError: A number is impossible.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    depth_scale: float = 1000.0
    rms_px: float | None = None
    views: int | None = None
    model: LensModel = "radial-tangential"

    def __post_init__(self) -> None:
        if self.model not in get_args(LensModel):
            raise UsageError(
                f"no lens model {self.model!r}", hint=f"write one of {', '.join(get_args(LensModel))}"
            )
        if self.model == "fisheye" and len(self.distortion) not in (0, 4):
            raise UsageError(
                f"{len(self.distortion)} distortion numbers of a fisheye", hint="give k1 k2 k3 k4"
            )
        if len(self.distortion) not in (0, 4, 5) or not all(
            abs(coefficient) <= _MAX_DISTORTION for coefficient in self.distortion
        ):
            raise UsageError(
                f"{len(self.distortion)} distortion numbers, or one that is not within {_MAX_DISTORTION:g}",
                hint=_HINT,
            )
        if not _MIN_DEPTH_SCALE <= self.depth_scale <= _MAX_DEPTH_SCALE:
            raise UsageError(
                f"depth_scale {self.depth_scale:g} is not within {_MIN_DEPTH_SCALE:g}..{_MAX_DEPTH_SCALE:g}",
                hint="1000 for mm, 5000 for TUM",
            )
        pixels = self.camera.width * self.camera.height
        if pixels > MAX_IMAGE_PIXELS:
            raise UsageError(
                f"images of {self.camera.width}x{self.camera.height} px are above {MAX_IMAGE_PIXELS} pixels",
                hint="make the images smaller, and scale fx fy cx cy with them",
            )


def read_intrinsics(path: Path | str, *, with_depth_scale: bool = False) -> Intrinsics:
    """Return the intrinsics of a file.

    Args:
        path: The file.
        with_depth_scale: Refuse a file without ``depth_scale``, instead of taking 1000.

    Raises:
        UsageError: The file is missing, or lacks a number, or a number is impossible.
    """
    path = Path(path)
    values = read_json(path, _HINT)
    with told_with(path, _HINT):
        if with_depth_scale:
            values["depth_scale"]
        return intrinsics_of(values)


def read_json(path: Path, hint: str) -> Any:
    """Return what a small file of JSON holds; raises UsageError."""
    try:
        return json.loads(read_regular_file(path, _MAX_FILE_BYTES))
    except FileNotFoundError as error:
        raise UsageError(
            f"there is no {path}", hint="make one: rse-pf camera calibrate SOURCE --board 9x6 --square-mm 25"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{path} is not a file of intrinsics", hint=hint) from error


@contextlib.contextmanager
def told_with(path: Path, hint: str) -> Iterator[None]:
    """Turn what a wrong number raises into one line with the path."""
    try:
        yield
    except (InvalidCamera, UsageError) as error:
        raise UsageError(f"{path}: {error.message}", hint=error.hint) from error
    except KeyError as error:
        raise UsageError(f"{path} has no {error.args[0]}", hint=hint) from error
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise UsageError(f"{path} is not a file of intrinsics", hint=hint) from error


def intrinsics_of(values: Any) -> Intrinsics:
    """Return the intrinsics of a JSON object; what is wrong with it raises as it comes, see `told_with`."""
    camera = Camera(
        **{name: float(values[name]) for name in ("fx", "fy", "cx", "cy")},
        width=int(values["width"]),
        height=int(values["height"]),
    )
    return Intrinsics(
        camera=camera,
        distortion=tuple(float(value) for value in values.get("distortion", ())),
        depth_scale=float(values.get("depth_scale", 1000.0)),
        rms_px=_optional(values.get("rms_px"), float),
        views=_optional(values.get("views"), int),
        model=values.get("model", "radial-tangential"),
    )


def _optional(value: Any, kind: type[_T]) -> _T | None:
    return None if value is None else kind(value)


def write_intrinsics(path: Path | str, intrinsics: Intrinsics) -> None:
    """Write the file that `read_intrinsics` reads; raises UsageError where it cannot be written."""
    write_json(path, values_of(intrinsics))


def write_json(path: Path | str, values: Any) -> None:
    """Write a small file of JSON; raises UsageError where it cannot be written."""
    try:
        Path(path).write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another file") from error


def values_of(intrinsics: Intrinsics) -> dict[str, Any]:
    """Return the JSON object of `intrinsics_of`."""
    camera = intrinsics.camera
    values: dict[str, Any] = {
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "width": camera.width, "height": camera.height,
        "distortion": list(intrinsics.distortion), "depth_scale": intrinsics.depth_scale,
    }  # fmt: skip
    if intrinsics.model != "radial-tangential":
        values["model"] = intrinsics.model
    if intrinsics.rms_px is not None:
        values["rms_px"] = round(intrinsics.rms_px, 4)
    if intrinsics.views is not None:
        values["views"] = intrinsics.views
    return values


class Undistortion(ImageMap):
    """Map images of a distorted lens to the pinhole camera of the same intrinsics."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        distorts = intrinsics.model == "fisheye" or any(intrinsics.distortion)
        super().__init__(lens_maps(intrinsics, np.eye(3), intrinsics.camera) if distorts else None)


def lens_maps(lens: Intrinsics, rotation: Array, camera: Camera) -> tuple[Any, Any]:
    """Return where pixels of a pinhole *camera*, turned by ``(3, 3)`` *rotation*, lie in images of *lens*.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    make = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
    maps: tuple[Any, Any] = make(
        lens.camera.matrix, np.array(lens.distortion or (0.0,) * 4), rotation, camera.matrix,
        (camera.width, camera.height), cv2.CV_32FC1,
    )  # fmt: skip
    return maps
