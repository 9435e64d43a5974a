"""The refinement of a pose with depth in the native core; `rse_pf.pnp.depth_refinement` is its reference.

The library is the one that `rse_pf.native` finds; without it, or with an older one, numpy does the same work.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from rse_pf.geometry import Array, Camera
from rse_pf.native import address_of, aligned, load_core, load_part
from rse_pf.pnp.solver import PnpSolution

__all__ = ["DepthCore", "RefinedPose", "depth_core", "open_depth"]

_ABI = 1
_PORTABLE = 1
# rse_pf_depth_request: abi, flags, rows, inliers, four arrays | camera, noise, rmse | pose.
_HEAD = struct.Struct("=IIqqQQQQdddddddd")
_POSE_AT = _HEAD.size
_REQUEST_BYTES = _POSE_AT + 16 * 8
# rse_pf_depth_result: status, rmse | pose | covariance.
_RESULT = struct.Struct("=qd")
_FOUND_AT, _COVARIANCE_AT = _RESULT.size, _RESULT.size + 16 * 8
_RESULT_BYTES = _COVARIANCE_AT + 36 * 8
_COLUMNS, _SPARE_ROWS = 11, 4
_FIRST_ROWS = 512
_REFINED, _KEPT = 0, 1


class RefinedPose(NamedTuple):
    """A pose that fits the depths, too: ``(4, 4)``, its ``(6, 6)`` covariance, and the pixels' error."""

    T_camera_reference: Array
    covariance: Array
    rmse_px: float


class _Buffers(threading.local):
    """The request, the result and the workspace of one thread."""

    def __init__(self) -> None:
        request, result = np.zeros(_REQUEST_BYTES, np.uint8), np.zeros(_RESULT_BYTES, np.uint8)
        self.request = memoryview(request)  # type: ignore[arg-type]
        self.result = memoryview(result)  # type: ignore[arg-type]
        self.request_at, self.result_at = address_of(request), address_of(result)
        self.start = request[_POSE_AT:].view(np.float64).reshape(4, 4)
        self.pose = result[_FOUND_AT:_COVARIANCE_AT].view(np.float64).reshape(4, 4)
        self.covariance = result[_COVARIANCE_AT:].view(np.float64).reshape(6, 6)
        self.lend(_FIRST_ROWS)

    def lend(self, rows: int) -> None:
        self.rows = rows
        self.workspace = np.empty(_COLUMNS * (rows + _SPARE_ROWS))
        self.workspace_at = address_of(self.workspace)


class DepthCore:
    """The refinement of one loaded library; every thread may call it.

    ``portable`` forbids AVX2, which changes no byte of the result.
    """

    def __init__(self, refine: Callable[[int, int, int], None], *, portable: bool = False) -> None:
        self._refine = refine
        self._flags = _PORTABLE if portable else 0
        self._buffers = _Buffers()

    def refine(
        self,
        solution: PnpSolution,
        points_reference: Array,
        pixels: Array,
        depths_m: Array,
        camera: Camera,
        noise: tuple[float, float, float],
    ) -> RefinedPose | Literal["kept", "refused"]:
        """Refine the pose that pixels gave.

        Args:
            solution: The pose of the camera in the frame of the reference camera, and its inliers.
            points_reference: ``(n, 3)``, metres, in the frame of the camera that measured them.
            pixels: ``(n, 2)`` in the second image.
            depths_m: ``(n,)`` at these pixels, 0 where there is none.
            camera: Intrinsics of both images.
            noise: ``base_m``, ``growth_per_m`` and ``from_m`` of both depth cameras.

        Returns:
            The refined pose; ``kept`` where the pose stays as it is; ``refused`` where the arrays have other
            shapes or hold numbers that the reference refuses, too.
        """
        T_camera_reference, inliers = solution.T_camera_world, solution.inliers
        n, k = len(depths_m), len(inliers)
        arrays = [aligned(each, np.float64) for each in (points_reference, pixels, depths_m)]
        shapes = [each.shape for each in arrays]
        if shapes != [(n, 3), (n, 2), (n,)] or T_camera_reference.shape != (4, 4) or inliers.shape != (k,):
            return "refused"
        rows = aligned(inliers, np.int64)
        buffers = self._buffers
        if k > buffers.rows:
            buffers.lend(2 * k)
        _HEAD.pack_into(
            buffers.request, 0, _ABI, self._flags, n, k, *map(address_of, arrays), address_of(rows),
            camera.fx, camera.fy, camera.cx, camera.cy, *noise, solution.rmse_px,
        )  # fmt: skip
        buffers.start[:] = T_camera_reference
        self._refine(buffers.request_at, buffers.workspace_at, buffers.result_at)
        status, found_rmse_px = _RESULT.unpack_from(buffers.result)
        if status == _REFINED:
            return RefinedPose(buffers.pose.copy(), buffers.covariance.copy(), found_rmse_px)
        return "kept" if status == _KEPT else "refused"


def open_depth(path: Path, *, portable: bool = False) -> DepthCore:
    """Load the library at *path*; *portable* forbids AVX2; raises ConfigurationError as `load_part` says."""
    (refine,) = load_part(path, "depth", _ABI, "rse_pf_depth_refine")
    refine.argtypes, refine.restype = (ctypes.c_void_p,) * 3, None
    return DepthCore(refine, portable=portable)


@cache
def depth_core() -> DepthCore:
    """Return the depth refinement of the native core, which is required."""
    return load_core(open_depth)
