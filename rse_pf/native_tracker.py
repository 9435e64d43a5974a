"""A tracker's inner loops in the native core: matches near predicted pixels, and poses that fit landmarks.

The library is the one that `rse_pf.native` finds.  `rse_pf.slam.tracking` has the same in numpy.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera
from rse_pf.native import address_of, aligned, load_part, open_found
from rse_pf.native_matcher import Workspace

__all__ = ["TrackCore", "open_tracker", "track_core"]

_ABI = 1
_CELL_WORDS = 4200
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
        self, distinct: Callable[..., int], near: Callable[..., int], fit: Callable[..., int]
    ) -> None:
        self._distinct, self._near, self._fit = distinct, near, fit
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
        of_image = [*(aligned(array, np.float64) for array in image[:3]), aligned(image[3], np.uint8)]
        of_image.append(aligned(image[4], np.int32))
        m, n = len(sought[0]), len(image[0])
        rows, columns = np.empty(min(m, n), dtype=np.int64), np.empty(min(m, n), dtype=np.int64)
        workspace = self._workspace.words(m + 2 * n + _CELL_WORDS)
        request = _NearRequest(
            _ABI, 0, m, n, *map(address_of, of_sought), *map(address_of, of_image),
            *map(float, limits[:-1]), int(min(max(limits[-1], -1), _NONE)),
        )  # fmt: skip
        count = self._near(
            ctypes.byref(request), address_of(workspace), address_of(rows), address_of(columns)
        )
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
        request = _FitRequest(
            _ABI, 0, len(points[0]), *map(address_of, arrays),
            camera.fx, camera.fy, camera.cx, camera.cy, *map(float, limits),
            (_D * 16)(*T_camera_world.ravel().tolist()),
        )  # fmt: skip
        if self._fit(ctypes.byref(request), address_of(is_inlier), ctypes.byref(result)):
            return None
        pose = np.array(result.T_camera_world).reshape(4, 4)
        return pose, np.array(result.information).reshape(6, 6), is_inlier.view(bool)


def open_tracker(path: Path) -> TrackCore:
    """Load the library at *path*.

    Raises:
        ConfigurationError: As `load_part` says.
    """
    distinct, near, fit = load_part(
        path, "track", _ABI, "rse_pf_distinct", "rse_pf_match_near", "rse_pf_fit_pose"
    )
    distinct.argtypes, distinct.restype = (_P, _P, _I, _D, _P), ctypes.c_int32
    near.argtypes, near.restype = (_P, _P, _P, _P), _I
    fit.argtypes, fit.restype = (_P, _P, _P), ctypes.c_int32
    return TrackCore(distinct, near, fit)


@cache
def track_core() -> TrackCore | None:
    """Return the tracker's part of the library that `rse_pf.native` finds; None without one that fits."""
    return open_found(open_tracker)
