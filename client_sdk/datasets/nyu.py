"""Read the formats of NYU Depth V2: raw dumps of a Kinect, and the labelled ``.mat`` file (needs h5py).

`client_sdk.datasets.recordings` makes frames with these functions: it reads a depth image (`read_raw_depth`),
undistorts it, and registers it to the undistorted colour image (`register_depth`).

Source:
    Silberman et al., ECCV 2012; the calibration is the one shipped with the data set's toolbox.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from client_sdk.datasets.images import read_stored_pixels
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.geometry import Array, Camera, Lens, transform

__all__ = [
    "COLOUR_CAMERA",
    "COLOUR_LENS",
    "DEPTH_CAMERA",
    "DEPTH_LENS",
    "LabelledFile",
    "RawFile",
    "raw_files",
    "read_raw_depth",
    "register_depth",
]

# Pinhole camera of the undistorted colour images of the data set, from its toolbox.
COLOUR_CAMERA = Camera(
    fx=518.85790117450188,
    fy=519.46961112127485,
    cx=325.58244941119034,
    cy=253.73616633400465,
    width=640,
    height=480,
)
# Distortion k1 k2 p1 p2 k3 of the colour camera, from the toolbox of the data set.
_COLOUR_DISTORTION = (
    0.20796615318809061,
    -0.58613825163911781,
    7.2231363135888329e-04,
    1.0479627195765181e-03,
    0.49856986684705107,
)
# Pinhole camera of the undistorted depth images of the data set, from its toolbox.
DEPTH_CAMERA = Camera(
    fx=582.62448167737955,
    fy=582.69103270988637,
    cx=313.04475870804731,
    cy=238.44389626620386,
    width=640,
    height=480,
)
# Distortion k1 k2 p1 p2 k3 of the depth camera, from the toolbox of the data set.
_DEPTH_DISTORTION = (
    -0.099897236553084481,
    0.39065324602765344,
    1.9290592870229277e-03,
    -1.9422022475975055e-03,
    -0.51031725053400578,
)
COLOUR_LENS = Lens(camera=COLOUR_CAMERA, distortion=_COLOUR_DISTORTION)
DEPTH_LENS = Lens(camera=DEPTH_CAMERA, distortion=_DEPTH_DISTORTION)
_MAX_DEPTH_M = 10.0  # largest depth that is used; a pixel with a larger one counts as without a reading
_SIZE_PX = (COLOUR_CAMERA.width, COLOUR_CAMERA.height)  # width and height of all images of the data set
_MAX_IMAGES = 10_000
"""Most images, and most names of scenes, in a labelled file; a file with more is refused.  The published file
has 1,449."""
_MAX_NAME_LENGTH = 256
"""Most characters in the name of a scene of a labelled file; a file with a longer name is refused as
damaged."""
_MAX_CHUNK_VALUES = 1 << 26
"""Most values in a chunk of an array of a labelled file; a file with a larger chunk is refused, because HDF5
inflates whole chunks in memory."""
_MAT_HINT = "name nyu_depth_v2_labeled.mat as it was published"
_H5PY_ERRORS = (OSError, RuntimeError, KeyError, TypeError, ValueError, OverflowError, MemoryError)
"""Errors that h5py raises for a damaged file; each becomes a UsageError."""
_SHAPES = {"images": (3, *_SIZE_PX), "depths": _SIZE_PX, "rawDepths": _SIZE_PX}
"""Shape of one image in each array of the labelled file: (channels,) columns, rows."""
# Name of an image of a raw dump, with its time stamp in seconds.
_RAW_FILE_NAME = re.compile(r"[dr]-(\d+(?:\.\d+)?)-\d+\.(?:pgm|ppm)$")


class RawFile(NamedTuple):
    """An image file of a raw dump, with the time stamp (s) that its name states."""

    timestamp_s: float
    path: Path


def T_colour_depth() -> Array:
    """Return the pose ``(4, 4)`` of the depth camera in the frame of the colour camera, m.

    The toolbox stores the matrices -R and -t, with which points get a negative z; x / z and y / z are the
    same as with R and t, which this function returns.
    """
    T = np.eye(4)
    T[:3, :3] = [
        [0.99997798940829263, -0.0050359919480810989, -0.0043196624923060242],
        [0.0050518419386157446, 0.99998051861143999, 0.0036662365748484798],
        [0.0043011152014118693, -0.0036879781309514218, 0.99998394948385538],
    ]
    T[:3, 3] = [-0.025031875059141302, 2.9342312935846411e-04, -6.6238747008330102e-04]
    return T


def read_raw_depth(path: Path) -> npt.NDArray[np.float32]:
    """Return the depth image ``(h, w)``, m, of a PGM file of a raw dump.

    The values of the file are the disparities of a Kinect, in little endian, while the PGM format demands big
    endian.  The depth of a value is ``351.3 / (1092.5 - value)``, as in the toolbox.  Pixels without a
    reading, and readings beyond 10 m, are 0.

    Raises:
        UnreadableImage: The file is missing, damaged or cut off; some files of the published dumps are.
    """
    raw = read_stored_pixels(path).byteswap()
    difference = 1092.5 - raw.astype(np.float32)
    is_reading = (raw > 0) & (difference >= 351.3 / _MAX_DEPTH_M)
    return np.where(is_reading, 351.3 / np.where(is_reading, difference, 1.0), 0.0).astype(np.float32)


def register_depth(depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the view of the colour camera ``(h, w)``, m, of an undistorted image of the depth camera.

    Each reading is projected to the nearest pixel of the colour camera; if several meet in a pixel, the
    nearest to the camera stays.  Pixels without a reading are 0.
    """
    rows, columns = np.nonzero(depth_m > 0)
    pixels = np.column_stack((columns, rows)).astype(np.float64)
    points_depth = DEPTH_CAMERA.back_project(pixels, depth_m[rows, columns].astype(np.float64))
    points_colour = transform(T_colour_depth(), points_depth)
    columns, rows = np.rint(COLOUR_CAMERA.project(points_colour)).astype(np.int64).T
    height, width = COLOUR_CAMERA.height, COLOUR_CAMERA.width
    is_inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    far_first = np.flatnonzero(is_inside)[np.argsort(-points_colour[is_inside, 2], kind="stable")]
    registered = np.zeros((height, width), dtype=np.float32)
    registered[rows[far_first], columns[far_first]] = points_colour[far_first, 2]
    return registered


def raw_files(folder: Path, prefix: str) -> list[RawFile]:
    """Return the images of a raw dump in the order of time.

    *prefix* is ``d`` for depth, or ``r`` for colour; a file is named ``PREFIX-SECONDS-TICKS.pgm`` or
    ``.ppm``.
    """
    stamped = [(_RAW_FILE_NAME.match(path.name), path) for path in folder.glob(f"{prefix}-*.p[gp]m")]
    return sorted(RawFile(float(stamp[1]), path) for stamp, path in stamped if stamp)


class LabelledFile:
    """The labelled ``.mat`` file (HDF5), which is opened for each image that is read.

    MATLAB stores columns first, so that HDF5 shows ``images`` as ``(n, 3, w, h)``, and depths as ``(n, w,
    h)``.  ``rawDepths`` (0 without a reading) are read rather than ``depths``, whose holes are filled by
    interpolation.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def rows(self, scene: str | None) -> list[int]:
        """Return the rows of the images of one scene, or of all images for None.

        Raises:
            UsageError: The file is not the labelled file, or holds no such scene.
            MissingExtra: h5py is not installed.
        """
        with self._open() as file:
            count = len(file["images"])
            if scene is None:
                return list(range(count))
            try:
                names = _read_strings(file, "scenes")
            except _H5PY_ERRORS as error:
                raise self._damage_error() from error
        rows = [row for row, name in enumerate(names) if name == scene]
        if not rows:
            first_names = ", ".join(sorted(set(names))[:5]) or "none"
            raise UsageError(
                f"no scene {scene} in {self.path}", hint=f"name one of its scenes: {first_names}, ..."
            )
        return rows

    def read(self, row: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Return the RGB image ``(h, w, 3)`` and the registered depth image ``(h, w)``, m, of one row.

        Depth is 0 without a reading, and beyond 10 m.

        Raises:
            UsageError: The file is damaged, or not the labelled file.
            MissingExtra: h5py is not installed.
        """
        with self._open() as file:
            depths = file["rawDepths"] if "rawDepths" in file else file["depths"]
            try:
                rgb = np.ascontiguousarray(np.transpose(file["images"][row], (2, 1, 0)), dtype=np.uint8)
                depth_m = np.ascontiguousarray(np.transpose(depths[row]), dtype=np.float32)
            except _H5PY_ERRORS as error:
                raise self._damage_error() from error
        depth_m[~np.isfinite(depth_m) | (depth_m >= _MAX_DEPTH_M)] = 0.0
        return rgb, depth_m

    def _open(self) -> Any:
        try:
            import h5py
        except ImportError as error:
            raise MissingExtra("h5py", "vision") from error
        try:
            file = h5py.File(self.path, "r")
        except OSError as error:
            raise UsageError(f"{self.path} is not an HDF5 .mat file", hint=_MAT_HINT) from error
        try:
            has_arrays = "images" in file and ("rawDepths" in file or "depths" in file)
            is_valid = has_arrays and _has_valid_arrays(h5py, file)
        except _H5PY_ERRORS as error:
            file.close()
            raise self._damage_error() from error
        if not is_valid:
            file.close()
            size = f" of {_SIZE_PX[0]}x{_SIZE_PX[1]} px" if has_arrays else ""
            raise UsageError(f"{self.path} holds no images and depths{size}", hint=_MAT_HINT)
        return file

    def _damage_error(self) -> UsageError:
        return UsageError(f"{self.path} is damaged", hint=_MAT_HINT)


def _has_valid_arrays(h5py: Any, file: Any) -> bool:
    """Return whether the arrays of images of *file* are safe to read.

    They must hold numbers in the shape of the data set, all the same number of images up to `_MAX_IMAGES`, in
    chunks of at most `_MAX_CHUNK_VALUES`, stored in *file* itself: a virtual array takes no space in the
    file, but memory here, and a linked one may show any file of this machine.
    """
    counts = set()
    for name in _SHAPES.keys() & file.keys():
        dataset = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
        if not isinstance(dataset, h5py.Dataset) or dataset.shape[1:] != _SHAPES[name]:
            return False
        if dataset.external or dataset.is_virtual or dataset.dtype.kind not in "uif":
            return False
        chunk = dataset.chunks or (1,)
        if np.prod(chunk, dtype=float) > _MAX_CHUNK_VALUES:
            return False
        counts.add(len(dataset))
    return len(counts) == 1 and counts.pop() <= _MAX_IMAGES


def _read_strings(file: Any, name: str) -> list[str]:
    """Return the strings of the MATLAB cell array *name*; empty if the file has none.

    Raises:
        ValueError: The array has more than 10,000 strings, or one of more than 256 characters.
    """
    if name not in file:
        return []
    if file[name].size > _MAX_IMAGES:
        raise ValueError(f"{name} names more than {_MAX_IMAGES} images")
    texts = []
    for cell in np.asarray(file[name]).ravel():
        if file[cell].size > _MAX_NAME_LENGTH:
            raise ValueError(f"{name} holds a text of more than {_MAX_NAME_LENGTH} characters")
        texts.append("".join(chr(code) for code in np.asarray(file[cell]).ravel()))
    return texts
