"""Read and write ``intrinsics.json``: the pinhole camera, the distortion, and the unit of depth images.

::

    {"fx": 525.1, "fy": 525.3, "cx": 319.8, "cy": 240.1, "width": 640, "height": 480,
     "model": "radial-tangential", "distortion": [k1, k2, p1, p2, k3],
     "depth_scale": 1000, "rms_px": 0.31, "views": 24}

Focal lengths, principal point and size are in pixels.  These fields may be left out: ``distortion``
(coefficients in OpenCV's order), ``model`` (``radial-tangential`` by default, or ``fisheye`` with ``[k1, k2,
k3, k4]``), ``depth_scale`` (a pixel of a 16-bit depth image divided by this is metres),
``depth_registered_to_color`` (whether depth images show the view of the colour camera), ``rate_hz`` (rate of
images that have no time stamps), ``rms_px`` (root mean square reprojection error of the calibration) and
``views`` (number of images of the calibration).  The names that other programs give to these fields are read,
too.  An unknown field is refused, because it may state something that changes the projection.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rse_pf.config.validation import did_you_mean
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.geometry import LENS_MODELS, Camera, Lens, find_lens_model
from rse_pf.images import MAX_IMAGE_PIXELS
from rse_pf.storage.files import read_document

__all__ = [
    "INTRINSICS_HINT",
    "Intrinsics",
    "calibration_hint",
    "intrinsics_to_json",
    "name_file_in_errors",
    "parse_intrinsics",
    "parse_lens_model",
    "read_json",
    "write_intrinsics",
    "write_json",
]

_T = TypeVar("_T")
_MAX_FILE_BYTES = 1 << 20
"""Largest intrinsics.json or rig.json that is read, 1 MiB; a larger file is refused, and a real one has some
hundred bytes."""
_MIN_DEPTH_SCALE = 1e-2
"""Smallest accepted depth_scale: with 0.01 one unit of a depth image is 100 m, too coarse to map."""
# Largest accepted depth_scale: with 1e7 the largest value of 16 bits is 7 mm, too near to map.
_MAX_DEPTH_SCALE = 1e7
_MIN_RATE_HZ = 1e-3  # smallest accepted rate_hz: between slower images no motion could be tracked
_MAX_RATE_HZ = 1e4  # largest accepted rate_hz: no camera is faster
_DEFAULT_DEPTH_SCALE = 1000.0  # depth_scale if nobody stated it: most depth cameras write millimetres
_PERSPECTIVE_NAMES = {"pinhole", "perspective", "simple_pinhole", "none", ""}
"""Names in lower case, in a field that states a lens model, of a perspective projection without its
distortion model; coefficients are then radial-tangential, as in files of COLMAP, Kalibr and EuRoC."""
_UNSPECIFIC_NAMES = {"pinhole", "perspective", "none", ""}
"""Names in lower case with which a field does not choose a lens model, because the file may do so in another
field: a file may state ``camera_model: pinhole`` and ``distortion_model: equidistant``."""
_FIELD_ALIASES = {
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
}
"""For each field name of OpenCV, ROS, COLMAP, Open3D, librealsense and nerfstudio, the name of the same field
in ``intrinsics.json``."""
_COEFFICIENT_NAMES = {name for model in LENS_MODELS.values() for name in model.coefficient_names}
"""Names of the distortion coefficients of all lens models; a file may state each in a field, such as
``k1``."""
_FIELDS = {
    "fx",
    "fy",
    "cx",
    "cy",
    "width",
    "height",
    "matrix",
    "distortion",
    "model",
    "depth_scale",
    "rate_hz",
    "depth_registered_to_color",
    "rms_px",
    "views",
    *_COEFFICIENT_NAMES,
}
"""Names of the fields that are read, after `_FIELD_ALIASES` has replaced the names of other programs."""
_REMARKS = {
    "name",
    "comment",
    "description",
    "source",
    "serial",
    "camera_name",
    "depth_unit",
    "standard_deviations",
}
"""Fields of ``intrinsics.json`` for people: they may have any value, which is not used."""
INTRINSICS_HINT = (
    "write fx fy cx cy width height, and distortion [k1 k2 p1 p2 k3] and depth_scale if they are known, as "
    "JSON into intrinsics.json; files of OpenCV, ROS, ORB-SLAM and COLMAP hold them (docs/cameras.md)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics(Lens):
    """A calibrated lens, the unit of its 16-bit depth images, and the error of the calibration.

    Attributes:
        depth_scale: Units of a depth image per metre: metres are the value of a pixel divided by this.  None
            if nobody stated it.
        rms_px: Root mean square reprojection error of the calibration; None if unknown.
        views: Number of images of the calibration board that were used; None if unknown.
        rate_hz: Images per second, for images that have no time stamps; None if unknown.
        is_depth_registered: The field ``depth_registered_to_color``: whether depth images show the view of
            the colour camera; None if unknown.

    Raises:
        UsageError: The lens model is not known, the coefficients do not fit the model, or a number is not in
            its range.
    """

    depth_scale: float | None = None
    rms_px: float | None = None
    views: int | None = None
    rate_hz: float | None = None
    is_depth_registered: bool | None = None

    def __post_init__(self) -> None:
        try:
            Lens.__post_init__(self)
            LENS_MODELS[self.model].check_stated_coefficients(self.distortion)
        except InvalidCamera as error:
            raise UsageError(error.message, hint=error.hint) from error
        if not _MIN_DEPTH_SCALE <= self.depth_units_per_m <= _MAX_DEPTH_SCALE:
            raise UsageError(
                f"depth_scale {self.depth_scale:g} is not within {_MIN_DEPTH_SCALE:g}..{_MAX_DEPTH_SCALE:g} "
                "units a metre",
                hint="write 1000 for depth images in mm, or 5000 for those of TUM",
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

    @property
    def depth_units_per_m(self) -> float:
        """Units of a depth image per metre: ``depth_scale``, or 1000 (millimetres) if nobody stated it."""
        return _DEFAULT_DEPTH_SCALE if self.depth_scale is None else self.depth_scale


def calibration_hint(source: str, file: Path | str) -> str:
    """Return the hint for a *source* of one camera whose intrinsics are not known; *file* is to hold them."""
    return (
        f"calibrate by the motion that it shows: rse-pf camera calibrate {source} --out {file}, then use "
        f"--intrinsics {file}; with a board, or by numbers that you know: docs/cameras.md"
    )


def read_json(path: Path, hint: str) -> Any:
    """Return the content of a JSON file of intrinsics or of a rig, of at most 1 MiB.

    Raises:
        UsageError: The file is missing (its hint says how to calibrate); or the file cannot be read, is too
            large, or is not JSON (its hint is *hint*).
    """
    if not path.exists():
        raise UsageError(
            f"there is no {path}, and the intrinsics are not known", hint=calibration_hint("SOURCE", path)
        )
    return read_document(path, "a file of intrinsics", hint=hint, max_bytes=_MAX_FILE_BYTES)


@contextlib.contextmanager
def name_file_in_errors(path: Path, hint: str) -> Iterator[None]:
    """Turn errors of the block that parses the file *path* into a UsageError that names the file.

    Raises:
        UsageError: The block raised InvalidCamera or UsageError, whose hint stays; or a built-in exception
            such as KeyError or TypeError, because a field is missing or has another type, which gets *hint*.
    """
    try:
        yield
    except (InvalidCamera, UsageError) as error:
        raise UsageError(f"{path}: {error.message}", hint=error.hint) from error
    except KeyError as error:
        raise UsageError(f"{path} has no {error.args[0]}", hint=hint) from error
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise UsageError(f"{path} is not a file of intrinsics", hint=hint) from error


def parse_intrinsics(values: Any) -> Intrinsics:
    """Return the intrinsics that a decoded JSON object states; call it within `name_file_in_errors`.

    Raises:
        UsageError: A field is unknown, two names of one field state different values, or a number is
            impossible.
        InvalidCamera: The numbers of the pinhole camera are impossible.
        KeyError, ValueError, TypeError, AttributeError: A field is missing, or has another type.
    """
    # 1. Give all fields the names of intrinsics.json.
    values = _replace_field_aliases(values)
    model = parse_lens_model(values.get("model"))
    # 2. If there is a camera matrix, take from it those of fx fy cx cy that have no field of their own.
    if "matrix" in values:
        K = np.array(values["matrix"], dtype=np.float64).reshape(3, 3)
        K = K.T if K[2, 0] or K[2, 1] else K  # Open3D writes column after column
        values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **values}
    camera = Camera(
        **{name: float(values[name]) for name in ("fx", "fy", "cx", "cy")},
        width=int(values["width"]),
        height=int(values["height"]),
    )
    # 3. Read the fields that may be left out.
    return Intrinsics(
        camera=camera,
        distortion=_parse_distortion(values, model),
        depth_scale=_convert_optional(values.get("depth_scale"), float),
        rms_px=_convert_optional(values.get("rms_px"), float),
        views=_convert_optional(values.get("views"), int),
        model=model,
        rate_hz=_convert_optional(values.get("rate_hz"), float),
        is_depth_registered=_convert_optional(values.get("depth_registered_to_color"), bool),
    )


def parse_lens_model(stated: Any) -> str:
    """Return the name in `LENS_MODELS` of the lens model that a file states.

    It is ``radial-tangential`` for None and for the names in `_PERSPECTIVE_NAMES`.

    Raises:
        UsageError: No lens model has this name.
    """
    name = "pinhole" if stated is None else str(stated)
    if name.lower() in _PERSPECTIVE_NAMES:
        return "radial-tangential"
    model = find_lens_model(name)
    if model is None:
        raise UsageError(
            f"the lens model {name!r} is not known",
            hint=f"calibrate with one of {', '.join(LENS_MODELS)}, or name the model of the numbers",
        )
    return model.name


def _replace_field_aliases(values: Any) -> dict[str, Any]:
    """Return the fields of a file by the names of ``intrinsics.json``.

    A field of the lens model with one of `_UNSPECIFIC_NAMES` is left out.

    Raises:
        UsageError: A field is not known, or two names of one field state different values.
    """
    fields: dict[str, Any] = {}
    for alias, value in values.items():
        name = _FIELD_ALIASES.get(alias, alias)
        if name not in _FIELDS and alias not in _REMARKS:
            raise UsageError(
                f"the field {alias!r} is not known",
                hint=did_you_mean(alias, sorted(_FIELDS), INTRINSICS_HINT),
            )
        if name == "model":
            if str(value).lower() in _UNSPECIFIC_NAMES:
                continue
            value = parse_lens_model(value)
        if name in fields and fields[name] != value:
            raise UsageError(
                f"{name} is {fields[name]} and, as {alias}, {value}", hint=f"give {name} once, as {name}"
            )
        fields[name] = value
    return fields


def _parse_distortion(values: dict[str, Any], model: str) -> tuple[float, ...]:
    """Return the distortion coefficients that a file states as ``distortion``, or as ``k1``, ``k2``, ...

    Without the list, the result is empty if all of ``k1``, ``k2``, ... are 0 or missing.

    Raises:
        UsageError: The file states the list and a coefficient other than 0 by its name; or, without the list,
            it states a coefficient other than 0 by a name that *model* does not have.
    """
    names = LENS_MODELS[model].coefficient_names
    nonzero = {name for name in _COEFFICIENT_NAMES if float(values.get(name, 0.0))}
    if "distortion" not in values:
        if not nonzero <= set(names):
            raise UsageError(
                f"a lens of model {model} has no {min(nonzero - set(names))}", hint=INTRINSICS_HINT
            )
        return tuple(float(values.get(name, 0.0)) for name in names) if nonzero else ()
    if nonzero:
        raise UsageError(
            "distortion is given twice, as a list and by names",
            hint="remove k1, k2, ... or the list distortion",
        )
    return tuple(float(value) for value in np.ravel(values["distortion"]))


def _convert_optional(value: Any, convert: Callable[[Any], _T]) -> _T | None:
    return None if value is None else convert(value)


def write_intrinsics(path: Path | str, intrinsics: Intrinsics) -> None:
    """Write the file that `client_sdk.rigs.rig_file.read_intrinsics` reads; raises UsageError if it cannot be
    written."""
    write_json(path, intrinsics_to_json(intrinsics))


def write_json(path: Path | str, values: Any) -> None:
    """Write *values* as indented JSON; raises UsageError if the file cannot be written."""
    try:
        Path(path).write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another file") from error


def intrinsics_to_json(intrinsics: Intrinsics) -> dict[str, Any]:
    """Return the JSON object that `parse_intrinsics` reads; leave out what is None or the default."""
    camera = intrinsics.camera
    values: dict[str, Any] = {
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "width": camera.width,
        "height": camera.height,
        "distortion": list(intrinsics.distortion),
    }
    optional = {
        "depth_scale": intrinsics.depth_scale,
        "rate_hz": intrinsics.rate_hz,
        "depth_registered_to_color": intrinsics.is_depth_registered,
        "model": None if intrinsics.model == "radial-tangential" else intrinsics.model,
        "rms_px": None if intrinsics.rms_px is None else round(intrinsics.rms_px, 4),
        "views": intrinsics.views,
    }
    return values | {name: value for name, value in optional.items() if value is not None}
