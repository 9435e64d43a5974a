"""``intrinsics.json``: a camera with its lens, as calibration writes it and every source reads it.

::

    {"fx": 525.1, "fy": 525.3, "cx": 319.8, "cy": 240.1, "width": 640, "height": 480,
     "model": "radial-tangential", "distortion": [k1, k2, p1, p2, k3],
     "depth_scale": 1000, "rms_px": 0.31, "views": 24}

Lengths are pixels.  ``distortion`` (OpenCV's order), ``depth_scale`` (units of a 16-bit depth image in a
metre), ``rate_hz`` (of images that state no time), ``rms_px`` and ``views`` (of the calibration) may be left
out, and ``model`` for all lenses but ``fisheye`` (Kannala and Brandt), whose ``distortion`` is
``[k1, k2, k3, k4]``.  The names that other programs give to these fields are read as well; an unknown field
is refused, since it may state what would be missed.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from client_sdk.frontend import load_opencv
from client_sdk.image_map import ImageMap
from rse_pf.config.validation import did_you_mean
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.files import read_document
from rse_pf.geometry import Array, Camera
from rse_pf.images import MAX_IMAGE_PIXELS

__all__ = [
    "INTRINSICS_HINT", "TYPICAL_HINT", "Intrinsics", "LensModel", "Undistortion", "intrinsics_of",
    "lens_maps", "lens_model", "read_intrinsics", "read_json", "told_with", "values_of", "write_intrinsics",
    "write_json",
]  # fmt: skip

LensModel = Literal["radial-tangential", "fisheye"]

_T = TypeVar("_T")
_MAX_FILE_BYTES = 1 << 20
_MAX_DISTORTION = 1e3
_MIN_DEPTH_SCALE, _MAX_DEPTH_SCALE = 1e-2, 1e7
_MIN_RATE_HZ, _MAX_RATE_HZ = 1e-3, 1e4
_DEFAULT_DEPTH_SCALE = 1000.0  # millimetres, as most depth cameras write them
_LENS_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(
        (
            "radial-tangential", "radtan", "plumb_bob", "brown_conrady", "pinhole", "opencv", "none",
            "simple_pinhole", "perspective", "",
        ),
        "radial-tangential",
    ),
    **dict.fromkeys(
        ("fisheye", "equidistant", "kannala_brandt4", "kannalabrandt8", "opencv_fisheye"), "fisheye"
    ),
}  # fmt: skip
"""Names of lens models, in lower case, in files of EuRoC, Kalibr, ROS, COLMAP, ORB-SLAM3 and nerfstudio."""
_OTHER_NAMES = {
    **dict.fromkeys(("w", "image_width"), "width"),
    **dict.fromkeys(("h", "image_height"), "height"),
    **dict.fromkeys(("fl_x", "f_x", "fu"), "fx"),
    **dict.fromkeys(("fl_y", "f_y", "fv"), "fy"),
    **dict.fromkeys(("c_x", "cu", "ppx"), "cx"),
    **dict.fromkeys(("c_y", "cv", "ppy"), "cy"),
    **dict.fromkeys(
        ("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "dist_coeff", "coeffs", "dist", "D"),
        "distortion",
    ),
    **dict.fromkeys(("distortion_model", "camera_model", "lens_model"), "model"),
    **dict.fromkeys(("camera_matrix", "intrinsic_matrix", "matrix", "K"), "matrix"),
    **dict.fromkeys(("depth_map_factor", "png_depth_scale", "depth_factor"), "depth_scale"),
    **dict.fromkeys(("fps", "frame_rate", "Camera.fps"), "rate_hz"),
}  # fmt: skip
"""Fields as OpenCV, ROS, COLMAP, Open3D, librealsense and nerfstudio call them, and as this file does."""
_NUMBERED = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
"""Coefficients that have fields of their own, of a radial-tangential lens and of a fisheye."""
_FIELDS = {
    "fx", "fy", "cx", "cy", "width", "height", "matrix", "distortion", "model", "depth_scale", "rate_hz",
    "depth_registered_to_color", "rms_px", "views", *_NUMBERED[0], *_NUMBERED[1],
}  # fmt: skip
_REMARKS = {"name", "comment", "description", "source", "serial", "camera_name", "depth_unit"}
"""Fields for people."""
INTRINSICS_HINT = (
    "write fx fy cx cy width height, and distortion [k1 k2 p1 p2 k3] and depth_scale if they are known, as "
    "JSON into intrinsics.json; files of OpenCV, ROS, ORB-SLAM and COLMAP hold them (docs/cameras.md)"
)
TYPICAL_HINT = (
    "calibrate: rse-pf camera calibrate SOURCE --board 9x6 --square-mm 25 (docs/cameras.md); a typical fx "
    "and fy in that file is a guess that bends the map: Kinect 525 and RealSense D435 615 px at 640x480; "
    "phones 0.8 and webcams 0.9 of the width"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A camera, the distortion of its lens (0, 4 or 5 numbers) and the unit of its 16-bit depth images.

    ``model`` says what the numbers of ``distortion`` are: k1 k2 p1 p2 k3 of a ``radial-tangential`` lens, or
    k1 k2 k3 k4 of a ``fisheye`` (Kannala and Brandt, PAMI 2006, as OpenCV's fisheye module has it).
    ``depth_scale`` is None if nobody stated it.  ``rate_hz`` is that of images without a time.
    ``is_depth_registered`` False says that depth images show another camera's view.  ``rms_px`` and ``views``
    tell how the camera was calibrated.  All of these are None if unknown.

    Raises:
        UsageError: A number is impossible.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    depth_scale: float | None = None
    rms_px: float | None = None
    views: int | None = None
    model: LensModel = "radial-tangential"
    rate_hz: float | None = None
    is_depth_registered: bool | None = None

    @property
    def depth_units_per_m(self) -> float:
        """The ``depth_scale``, or the one that is assumed."""
        return _DEFAULT_DEPTH_SCALE if self.depth_scale is None else self.depth_scale

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
                hint=INTRINSICS_HINT,
            )
        if not _MIN_DEPTH_SCALE <= self.depth_units_per_m <= _MAX_DEPTH_SCALE:
            raise UsageError(
                f"depth_scale {self.depth_scale:g} is not within {_MIN_DEPTH_SCALE:g}..{_MAX_DEPTH_SCALE:g}",
                hint="1000 for mm, 5000 for TUM",
            )
        if self.rate_hz is not None and not _MIN_RATE_HZ <= self.rate_hz <= _MAX_RATE_HZ:
            raise UsageError(
                f"rate_hz {self.rate_hz:g} is not within {_MIN_RATE_HZ:g}..{_MAX_RATE_HZ:g}",
                hint="give the images in a second, or leave it out",
            )
        pixels = self.camera.width * self.camera.height
        if pixels > MAX_IMAGE_PIXELS:
            raise UsageError(
                f"images of {self.camera.width}x{self.camera.height} px are above {MAX_IMAGE_PIXELS} pixels",
                hint="make the images smaller, and scale fx fy cx cy with them",
            )


def read_intrinsics(path: Path | str) -> Intrinsics:
    """Return the intrinsics of a file.

    Raises:
        UsageError: The file is missing, lacks a number, has an unknown field, or a number is impossible.
    """
    path = Path(path)
    values = read_json(path, INTRINSICS_HINT)
    with told_with(path, INTRINSICS_HINT):
        return intrinsics_of(values)


def read_json(path: Path, hint: str) -> Any:
    """Return what a small file of JSON holds; raises UsageError."""
    if not path.exists():
        raise UsageError(f"there is no {path}, and the intrinsics are not known", hint=TYPICAL_HINT)
    return read_document(path, "a file of intrinsics", hint=hint, max_bytes=_MAX_FILE_BYTES)


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
    values = _with_our_names(values)
    model = lens_model(values.get("model"))
    if "matrix" in values:
        K = np.array(values["matrix"], dtype=np.float64).reshape(3, 3)
        K = K.T if K[2, 0] or K[2, 1] else K  # Open3D writes column after column
        values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **values}
    camera = Camera(
        **{name: float(values[name]) for name in ("fx", "fy", "cx", "cy")},
        width=int(values["width"]),
        height=int(values["height"]),
    )
    return Intrinsics(
        camera=camera,
        distortion=_distortion(values, model),
        depth_scale=_optional(values.get("depth_scale"), float),
        rms_px=_optional(values.get("rms_px"), float),
        views=_optional(values.get("views"), int),
        model=model,
        rate_hz=_optional(values.get("rate_hz"), float),
        is_depth_registered=_optional(values.get("depth_registered_to_color"), bool),
    )


def lens_model(name: Any) -> LensModel:
    """Return the model of a lens by one of its names, None for none; raises UsageError."""
    model = _LENS_MODELS.get("radtan" if name is None else str(name).lower())
    if model is None:
        raise UsageError(
            f"the lens model {name!r} is not known",
            hint=f"calibrate with one of {', '.join(get_args(LensModel))}, or name the model of the numbers",
        )
    return model


def _with_our_names(values: Any) -> dict[str, Any]:
    """Return the fields of a file by the names of this module; raises UsageError for one that is unknown."""
    ours: dict[str, Any] = {}
    for name, value in values.items():
        field = _OTHER_NAMES.get(name, name)
        if field not in _FIELDS and name not in _REMARKS:
            raise UsageError(
                f"the field {name!r} is not known", hint=did_you_mean(name, sorted(_FIELDS), INTRINSICS_HINT)
            )
        if field in ours and ours[field] != value and field != "model":
            raise UsageError(f"{field} is {ours[field]} and, as {name}, {value}", hint="give the field once")
        if field != "model" or str(value).lower() not in ("pinhole", "perspective", ""):
            ours[field] = value  # "pinhole" names the projection, not the distortion
    return ours


def _distortion(values: dict[str, Any], model: LensModel) -> tuple[float, ...]:
    """Return the coefficients, from one field or from fields of their own; raises UsageError."""
    names = _NUMBERED[model == "fisheye"]
    own = [name for name in {*_NUMBERED[0], *_NUMBERED[1]} if float(values.get(name, 0.0))]
    if "distortion" not in values:
        if not set(own) <= set(names):
            raise UsageError(
                f"a lens of model {model} has no {min(set(own) - set(names))}", hint=INTRINSICS_HINT
            )
        return tuple(float(values.get(name, 0.0)) for name in names) if own else ()
    if own:
        raise UsageError("distortion is given twice, as a list and by names", hint="give the list")
    return tuple(float(value) for value in np.ravel(values["distortion"]))


def _optional(value: Any, kind: Callable[[Any], _T]) -> _T | None:
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
        "distortion": list(intrinsics.distortion),
    }  # fmt: skip
    if intrinsics.depth_scale is not None:
        values["depth_scale"] = intrinsics.depth_scale
    if intrinsics.rate_hz is not None:
        values["rate_hz"] = intrinsics.rate_hz
    if intrinsics.is_depth_registered is not None:
        values["depth_registered_to_color"] = intrinsics.is_depth_registered
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
