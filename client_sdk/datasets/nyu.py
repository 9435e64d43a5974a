"""The formats of NYU Depth V2: raw depth, registration, and the labelled .mat file, which needs h5py.

Images are not undistorted here; `client_sdk.datasets.recordings` does that before registration.

Source:
    Silberman et al., ECCV 2012; the calibration is the one shipped with the data set's toolbox.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.errors import MissingExtra, UsageError
from rse_pf.files import read_regular_file
from rse_pf.geometry import Array, Camera, Lens, transform

__all__ = [
    "COLOUR_CAMERA",
    "COLOUR_LENS",
    "DEPTH_CAMERA",
    "DEPTH_LENS",
    "LabelledFile",
    "RawFile",
    "depth_from_raw",
    "raw_files",
    "read_pnm",
    "register_depth",
    "truncated_files",
]

COLOUR_CAMERA = Camera(
    fx=518.85790117450188,
    fy=519.46961112127485,
    cx=325.58244941119034,
    cy=253.73616633400465,
    width=640,
    height=480,
)
_COLOUR_DISTORTION = (
    0.20796615318809061,
    -0.58613825163911781,
    7.2231363135888329e-04,
    1.0479627195765181e-03,
    0.49856986684705107,
)
DEPTH_CAMERA = Camera(
    fx=582.62448167737955,
    fy=582.69103270988637,
    cx=313.04475870804731,
    cy=238.44389626620386,
    width=640,
    height=480,
)
_DEPTH_DISTORTION = (
    -0.099897236553084481,
    0.39065324602765344,
    1.9290592870229277e-03,
    -1.9422022475975055e-03,
    -0.51031725053400578,
)
COLOUR_LENS = Lens(camera=COLOUR_CAMERA, distortion=_COLOUR_DISTORTION)
DEPTH_LENS = Lens(camera=DEPTH_CAMERA, distortion=_DEPTH_DISTORTION)
_MAX_DEPTH_M = 10.0
_MAX_PNM_BYTES = 16 << 20
_PNM_HEAD = re.compile(rb"(P[56])\s+(?:#[^\n]*\n\s*)*(\d{1,5})\s+(\d{1,5})\s+(\d{1,5})\s")
"""A comment ends with its line, so that there is one way to read a head."""
_PIXELS = (COLOUR_CAMERA.width, COLOUR_CAMERA.height)
_MAX_IMAGES, _MAX_LETTERS = 10_000, 256
_MAX_CHUNK_VALUES = 1 << 26
_MAT_HINT = "name nyu_depth_v2_labeled.mat as it was published"
_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, OverflowError, MemoryError)
"""What h5py raises where the bytes of a file make no sense."""
_SHAPES = {"images": (3, *_PIXELS), "depths": _PIXELS, "rawDepths": _PIXELS}
"""Of one image in the labelled file."""

_STAMPED = re.compile(r"[dr]-(\d+(?:\.\d+)?)-\d+\.(?:pgm|ppm)$")


class RawFile(NamedTuple):
    """One image of a raw dump and the time in its name."""

    timestamp_s: float
    path: Path


def T_colour_depth() -> Array:
    """Return the pose of the depth camera in the colour camera's frame, metres.

    The toolbox stores minus the rotation and the opposite translation, which cancels when it divides
    by a negative z.  This is the same map with points in front of the camera.
    """
    T = np.eye(4)
    T[:3, :3] = [
        [0.99997798940829263, -0.0050359919480810989, -0.0043196624923060242],
        [0.0050518419386157446, 0.99998051861143999, 0.0036662365748484798],
        [0.0043011152014118693, -0.0036879781309514218, 0.99998394948385538],
    ]
    T[:3, 3] = [-0.025031875059141302, 2.9342312935846411e-04, -6.6238747008330102e-04]
    return T


def depth_from_raw(raw: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
    """Return metres, 0 without a reading or beyond 10 m: ``351.3 / (1092.5 - raw)``."""
    difference = 1092.5 - raw.astype(np.float32)
    is_reading = (raw > 0) & (difference >= 351.3 / _MAX_DEPTH_M)
    return np.where(is_reading, 351.3 / np.where(is_reading, difference, 1.0), 0.0).astype(np.float32)


def register_depth(depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return an undistorted depth image as the colour camera sees it, nearest surface first."""
    rows, columns = np.nonzero(depth_m > 0)
    pixels = np.column_stack((columns, rows)).astype(np.float64)
    points_depth = DEPTH_CAMERA.back_project(pixels, depth_m[rows, columns].astype(np.float64))
    points_colour = transform(T_colour_depth(), points_depth)
    columns, rows = np.rint(COLOUR_CAMERA.project(points_colour)).astype(np.int64).T
    size = (COLOUR_CAMERA.height, COLOUR_CAMERA.width)
    seen = (columns >= 0) & (rows >= 0) & (columns < size[1]) & (rows < size[0])
    far_first = np.flatnonzero(seen)[np.argsort(-points_colour[seen, 2], kind="stable")]
    registered = np.zeros(size, dtype=np.float32)
    registered[rows[far_first], columns[far_first]] = points_colour[far_first, 2]
    return registered


def raw_files(folder: Path, prefix: str) -> list[RawFile]:
    """Return the images ``prefix-SECONDS-TICKS.p?m`` of a raw dump by time, without `truncated_files`."""
    return [file for file in _stamped_files(folder, prefix) if not _is_truncated(file)]


def truncated_files(folder: Path) -> list[str]:
    """Return the names of images that are too small; the published dump holds some."""
    files = [*_stamped_files(folder, "d"), *_stamped_files(folder, "r")]
    return [file.path.name for file in files if _is_truncated(file)]


def _stamped_files(folder: Path, prefix: str) -> list[RawFile]:
    stamped = [(_STAMPED.match(path.name), path) for path in folder.glob(f"{prefix}-*.p[gp]m")]
    return sorted(RawFile(float(stamp[1]), path) for stamp, path in stamped if stamp)


def _is_truncated(file: RawFile) -> bool:
    return file.path.stat().st_size <= COLOUR_CAMERA.width * COLOUR_CAMERA.height


def read_pnm(path: Path) -> npt.NDArray[Any]:
    """Return the pixels of a binary PPM ``(h, w, 3)`` uint8 or a 16-bit PGM ``(h, w)`` uint16.

    The 16-bit files of the raw dump are *little* endian, contrary to the format.

    Raises:
        UsageError: The file cannot be read or is of another kind.
    """
    try:
        content = read_regular_file(path, _MAX_PNM_BYTES)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="unpack the dump again") from error
    head = _PNM_HEAD.match(content)
    if head:
        width, height = int(head[2]), int(head[3])
        colours = 3 if head[1] == b"P6" else 1
        kind = np.dtype("<u2") if int(head[4]) > 255 else np.dtype(np.uint8)
        body = content[head.end() :]
        if len(body) >= width * height * colours * kind.itemsize:
            pixels = np.frombuffer(body, dtype=kind, count=width * height * colours)
            return pixels.reshape((height, width, 3) if colours == 3 else (height, width))
    raise UsageError(f"{path} is not a complete PPM or PGM image", hint="unpack the dump again")


class LabelledFile:
    """The labelled ``.mat`` file (HDF5), one image at a time.

    MATLAB stores columns first, so HDF5 shows ``images`` as ``(n, 3, w, h)`` and depths as
    ``(n, w, h)``.  ``rawDepths`` (0 = no reading) are preferred, as ``depths`` have their holes filled.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def rows(self, scene: str | None) -> list[int]:
        """Return the rows of one scene, of all without a *scene*.

        Raises:
            UsageError: The file is not the labelled file, or holds no such scene.
            MissingExtra: h5py is not installed.
        """
        with self._open() as file:
            count = len(file["images"])
            if scene is None:
                return list(range(count))
            try:
                names = _strings(file, "scenes")
            except _DAMAGE as error:
                raise self._damage_error() from error
        rows = [row for row, name in enumerate(names) if name == scene]
        if not rows:
            some = ", ".join(sorted(set(names))[:5]) or "none"
            raise UsageError(f"no scene {scene} in {self.path}", hint=f"scenes begin with {some}")
        return rows

    def read(self, row: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """Return colour ``(h, w, 3)`` and registered depth ``(h, w)`` in metres of one row."""
        with self._open() as file:
            depths = file["rawDepths"] if "rawDepths" in file else file["depths"]
            try:
                rgb = np.ascontiguousarray(np.transpose(file["images"][row], (2, 1, 0)), dtype=np.uint8)
                depth_m = np.ascontiguousarray(np.transpose(depths[row]), dtype=np.float32)
            except _DAMAGE as error:
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
            is_complete = "images" in file and ("rawDepths" in file or "depths" in file)
            fits = is_complete and _holds_images(h5py, file)
        except _DAMAGE as error:
            file.close()
            raise self._damage_error() from error
        if not fits:
            file.close()
            problem = (
                f"images and depths of {_PIXELS[0]}x{_PIXELS[1]} px" if is_complete else "images and depths"
            )
            raise UsageError(f"{self.path} holds no {problem}", hint=_MAT_HINT)
        return file

    def _damage_error(self) -> UsageError:
        return UsageError(f"{self.path} is damaged", hint=_MAT_HINT)


def _holds_images(h5py: Any, file: Any) -> bool:
    """Say whether all images have the size of the data set, and lie in the file itself.

    What lies in no file costs nothing there and memory here; what lies in another file may be any file of
    this machine.
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


def _strings(file: Any, name: str) -> list[str]:
    """Return a MATLAB cell array of strings; an absent one is empty."""
    if name not in file:
        return []
    if file[name].size > _MAX_IMAGES:
        raise ValueError(f"{name} names more than {_MAX_IMAGES} images")
    texts = []
    for cell in np.asarray(file[name]).ravel():
        if file[cell].size > _MAX_LETTERS:
            raise ValueError(f"{name} holds no short texts")
        texts.append("".join(chr(code) for code in np.asarray(file[cell]).ravel()))
    return texts
