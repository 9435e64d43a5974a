"""A tracker's inner loops in the native core: matches near predicted pixels, and poses that fit landmarks.

The library is the one that `rse_pf.native` finds.  `rse_pf.slam.tracking` has the same in numpy.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera
from rse_pf.native import address_of, aligned, load_core, load_part
from rse_pf.native_matcher import Workspace

__all__ = ["TrackCore", "open_tracker", "track_core"]

_ABI = 2
_CELL_WORDS = 16_400
_NONE = 256
_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class _NearRequest(ctypes.Structure):
    """``rse_pf_near_request`` of ``rse_pf_track.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("sought_rows", _I), ("rows", _I),
        ("predicted", _P), ("sought_turns", _P), ("sought_sizes", _P), ("sought", _P), ("pixels", _P),
        ("turns", _P), ("sizes", _P), ("descriptors", _P), ("distinct", _P), ("radius_px", _D), ("ratio", _D),
        ("distinct_ratio", _D), ("min_cosine", _D), ("max_size_ratio", _D), ("max_distance", _I),
    )  # fmt: skip


class _SeekRequest(ctypes.Structure):
    """``rse_pf_seek_request`` of ``rse_pf_track.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("rows", _I), ("landmarks", _I),
        ("numbers", _P), ("points", _P), ("rays", _P), ("turns", _P), ("sizes", _P), ("descriptors", _P),
        ("fx", _D), ("fy", _D), ("cx", _D), ("cy", _D), ("width", _D), ("height", _D), ("margin_px", _D),
        ("nearest_m", _D), ("min_cosine", _D), ("max_nearer", _D), ("max_farther", _D),
        ("T_camera_world", _D * 16),
    )  # fmt: skip


class _FitRequest(ctypes.Structure):
    """``rse_pf_fit_request`` of ``rse_pf_track.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("rows", _I), ("points", _P), ("spreads", _P),
        ("pixels", _P), ("pixels_px", _P), ("depths_m", _P), ("depths_dev", _P), ("fx", _D), ("fy", _D),
        ("cx", _D), ("cy", _D), ("cauchy2", _D), ("gate2", _D), ("T_camera_world", _D * 16),
    )  # fmt: skip


class _FitResult(ctypes.Structure):
    """``rse_pf_fit_result`` of ``rse_pf_track.h``."""

    _fields_ = (("inliers", _I), ("T_camera_world", _D * 16), ("information", _D * 36))


class TrackCore:
    """The tracker's part of one loaded library; every thread may call it.

    Arguments are those of the functions of `rse_pf.slam.tracking`, which checked their shapes.
    """

    def __init__(
        self, distinct: Callable[..., int], near: Callable[..., int], seek: Callable[..., int],
        fit: Callable[..., int], sway: Callable[..., int],
    ) -> None:  # fmt: skip
        self._distinct, self._near, self._seek, self._fit, self._sway = distinct, near, seek, fit, sway
        self._workspace = Workspace()

    def distinct(
        self, descriptors: npt.NDArray[np.uint8], pixels: Array, apart_px: float
    ) -> npt.NDArray[np.int32]:
        """Return the distance of each feature to the most similar other one."""
        descriptors, pixels = aligned(descriptors, np.uint8), aligned(pixels, np.float64)
        distances = np.full(len(pixels), _NONE, dtype=np.int32)
        self._distinct(
            address_of(descriptors), address_of(pixels), len(pixels), float(apart_px), address_of(distances)
        )
        return distances

    def match_near(
        self,
        sought: tuple[Array, Array, Array, npt.NDArray[np.uint8]],
        image: tuple[Array, Array, Array, npt.NDArray[np.uint8], npt.NDArray[np.int32]],
        limits: tuple[float, float, float, float, float, int],
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the rows of the sought features and of the image's features that match."""
        of_sought = [*(aligned(array, np.float64) for array in sought[:3]), aligned(sought[3], np.uint8)]
        of_image = _of_image(image)
        m, n = len(sought[0]), len(image[0])
        request = _NearRequest(
            _ABI, 0, m, n, *map(address_of, of_sought), *map(address_of, of_image), *_limits(limits)
        )
        rows, columns = np.empty(min(m, n), dtype=np.int64), np.empty(min(m, n), dtype=np.int64)
        workspace = self._workspace.words(m + 12 * n + _CELL_WORDS)
        count = self._near(
            ctypes.byref(request), address_of(workspace), address_of(rows), address_of(columns)
        )
        return rows[: max(0, count)], columns[: max(0, count)]

    def seek(
        self,
        landmarks: tuple[Array, Array, Array, Array, npt.NDArray[np.uint8]],
        numbers: npt.NDArray[np.int64],
        view: tuple[Array, Camera, float],
        expectation: tuple[float, float, float, float],
        image: tuple[Array, Array, Array, npt.NDArray[np.uint8], npt.NDArray[np.int32]],
        limits: tuple[float, float, float, float, float, int],
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the rows of *numbers*, and of the image's features, that match where a pose expects them.

        Args:
            landmarks: Points, rays, turns, sizes and descriptors.
            numbers: Rows of *landmarks* that are sought.
            view: ``T_camera_world``, the camera, and the margin around its image in pixels.
            expectation: Least depth, least cosine of the rays, and the largest ratios of the distances.
            image: As in `match_near`.
            limits: As in `match_near`.
        """
        T_camera_world, camera, margin_px = view
        arrays = [*(aligned(array, np.float64) for array in landmarks[:4]), aligned(landmarks[4], np.uint8)]
        chosen = aligned(numbers, np.int64)
        of_image = _of_image(image)
        m, n = len(chosen), len(image[0])
        request = _SeekRequest(
            _ABI, 0, m, len(arrays[0]), address_of(chosen), *map(address_of, arrays),
            camera.fx, camera.fy, camera.cx, camera.cy, camera.width,
            camera.height, margin_px, *expectation, (_D * 16)(*T_camera_world.ravel().tolist()),
        )  # fmt: skip
        near = _NearRequest(
            _ABI, 0, 0, n, None, None, None, None, *map(address_of, of_image), *_limits(limits)
        )
        rows, columns = np.empty(min(m, n), dtype=np.int64), np.empty(min(m, n), dtype=np.int64)
        workspace = self._workspace.words(11 * m + 12 * n + _CELL_WORDS)
        count = self._seek(
            ctypes.byref(request), ctypes.byref(near), address_of(workspace), address_of(rows),
            address_of(columns),
        )  # fmt: skip
        return rows[: max(0, count)], columns[: max(0, count)]

    def fit_pose(
        self,
        points: tuple[Array, Array],
        measured: tuple[Array, Array, Array, Array],
        camera: Camera,
        limits: tuple[float, float],
        T_camera_world: Array,
    ) -> tuple[Array, Array, npt.NDArray[np.bool_]] | None:
        """Return the pose, its information and who agrees; None where some motion is free."""
        arrays = [aligned(array, np.float64) for array in (*points, *measured)]
        is_inlier = np.zeros(len(points[0]), dtype=np.uint8)
        result = _FitResult()
        request = _fit_request(arrays, camera, limits, T_camera_world)
        if self._fit(ctypes.byref(request), address_of(is_inlier), ctypes.byref(result)):
            return None
        pose = np.array(result.T_camera_world).reshape(4, 4)
        return pose, np.array(result.information).reshape(6, 6), is_inlier.view(bool)

    def fit_sway(
        self,
        points: tuple[Array, Array],
        measured: tuple[Array, Array, Array, Array],
        sways: Array,
        camera: Camera,
        cauchy2: float,
        T_camera_world: Array,
    ) -> tuple[float, float]:
        """Return by how much motions of the points explain what is left, and its information."""
        arrays = [aligned(array, np.float64) for array in (*points, *measured, sways)]
        request = _fit_request(arrays[:-1], camera, (cauchy2, 0.0), T_camera_world)
        found = np.zeros(2)
        at = address_of(found)
        self._sway(ctypes.byref(request), address_of(arrays[-1]), at, at + found.itemsize)
        return float(found[0]), float(found[1])


def _of_image(
    image: tuple[Array, Array, Array, npt.NDArray[np.uint8], npt.NDArray[np.int32]],
) -> list[npt.NDArray[Any]]:
    """Return the arrays of an image's features as the library reads them."""
    arrays = [*(aligned(array, np.float64) for array in image[:3]), aligned(image[3], np.uint8)]
    return [*arrays, aligned(image[4], np.int32)]


def _limits(limits: tuple[float, float, float, float, float, int]) -> tuple[float | int, ...]:
    return *map(float, limits[:-1]), int(min(max(limits[-1], -1), _NONE))


def _fit_request(
    arrays: Sequence[Array], camera: Camera, limits: tuple[float, float], T_camera_world: Array
) -> _FitRequest:
    """Return a request that points to *arrays*, which must live as long."""
    return _FitRequest(
        _ABI, 0, len(arrays[0]), *map(address_of, arrays),
        camera.fx, camera.fy, camera.cx, camera.cy, *map(float, limits),
        (_D * 16)(*T_camera_world.ravel().tolist()),
    )  # fmt: skip


def open_tracker(path: Path) -> TrackCore:
    """Load the library at *path*.

    Raises:
        ConfigurationError: As `load_part` says.
    """
    distinct, near, seek, fit, sway = load_part(
        path, "track", _ABI, "rse_pf_distinct", "rse_pf_match_near", "rse_pf_seek", "rse_pf_fit_pose",
        "rse_pf_fit_sway",
    )  # fmt: skip
    distinct.argtypes, distinct.restype = (_P, _P, _I, _D, _P), ctypes.c_int32
    near.argtypes, near.restype = (_P, _P, _P, _P), _I
    seek.argtypes, seek.restype = (_P, _P, _P, _P, _P), _I
    fit.argtypes, fit.restype = (_P, _P, _P), ctypes.c_int32
    sway.argtypes, sway.restype = (_P, _P, _P, _P), ctypes.c_int32
    return TrackCore(distinct, near, seek, fit, sway)


@cache
def track_core() -> TrackCore:
    """Return the tracker of the native core, which is required."""
    return load_core(open_tracker)
