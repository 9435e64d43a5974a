"""Refine the pose of `solve_pnp` with the depths that both cameras measured, by the noise of both.

PnP takes its points as exact and looks at the pixels of one image.  Where a depth camera took both images,
each correspondence is two noisy measurements of one point.  Nothing is searched here, and no inlier is added
or lost.  The native core computes it.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera
from rse_pf.native import PART_ABIS, Workspace, address_of, aligned, core_function
from rse_pf.pnp.solver import PnpSolution

__all__ = ["DepthNoise", "refine_with_depth"]

_PORTABLE = 1
_REFINED = 0  # status of the core: the depths changed the pose
_KEPT = 1  # status of the core: the pose without depths stays
_COLUMNS = 11  # numbers of the workspace for each match
_SPARE_ROWS = 4  # rows of the workspace beyond one for each match
_MAX_DEPTH_M = 1e3


class DepthNoise(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Noise of a depth camera: the standard deviation of depth z is base + growth * max(0, z - from)^2.

    ``base_m`` and ``from_m`` are metres, ``growth_per_m`` is metres per square metre; the defaults are a
    Kinect's.

    Raises:
        BadRequest: A number is out of its range.

    Source:
        Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 5.
    """

    base_m: float = 0.0012
    growth_per_m: float = 0.0019
    from_m: float = 0.4

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("base_m", self.base_m, 1e-5, 1.0),
            ("growth_per_m", self.growth_per_m, 0.0, 1.0),
            ("from_m", self.from_m, 0.0, 100.0),
        ):
            if not low <= value <= high:
                raise BadRequest(
                    f"{name} = {value:g} is not within {low:g}..{high:g}", hint="leave it out for the default"
                )

    def variance_m2(self, depth_m: Array) -> Array:
        """Return the variance (square metres) of each depth (metres)."""
        beyond = np.maximum(0.0, depth_m - self.from_m)
        variance: Array = (self.base_m + self.growth_per_m * beyond * beyond) ** 2
        return variance


_KINECT = DepthNoise()


def refine_with_depth(
    solution: PnpSolution,
    points_reference: Array,
    pixels: Array,
    depths_m: Array,
    camera: Camera,
    noise: DepthNoise = _KINECT,
    *,
    portable: bool = False,
) -> PnpSolution:
    """Return *solution* with the pose that fits pixels and depths of both images best.

    A point is taken as seen in the reference camera with the noise of its depth and its pixel; the second
    camera's pixel and depth carry noise, too.  The pixel noise, equal in both images, is read off the errors
    that *solution* left.  Iterated least squares on these residuals with a Cauchy weight; deterministic.

    Args:
        solution: Of `solve_pnp` for the same rows.
        points_reference: ``(n, 3)``, metres, in the frame of the *reference camera*, whose depth camera
            measured them; all before it.
        pixels: ``(n, 2)``, undistorted pixels of the second image.
        depths_m: ``(n,)``, metres along the optical axis of the second camera at these pixels, 0 where there
            is none.
        camera: Intrinsics of both images.
        noise: Of both depth cameras.
        portable: Forbid AVX2, which changes no byte of the result.

    Returns:
        The refined pose with its covariance and ``rmse_px``; inliers and verdict are those of *solution*.
        Where depths and pixels contradict each other, *solution* itself.

    Raises:
        BadRequest: Shapes do not fit, a number is absurd, or a point is not before the reference camera.
        MissingExtra: The native core is not installed.

    Source:
        Errors in variables after Segal et al., Generalized-ICP (RSS 2009), here with pixels and depths;
        covariance after Huber, Robust Statistics (1981), Sect. 7.6.
    """
    points, pixels = aligned(points_reference, np.float64), aligned(pixels, np.float64)
    depths_m, rows = aligned(depths_m, np.float64), aligned(solution.inliers, np.int64)
    n = len(points)
    if (points.shape, pixels.shape, depths_m.shape) != ((n, 3), (n, 2), (n,)):
        raise BadRequest(
            f"depths_m has shape {depths_m.shape} for {n} points and {len(pixels)} pixels",
            hint="send one depth for each pixel, 0 where there is none",
        )
    request = _Request(
        PART_ABIS["depth"], _PORTABLE if portable else 0, n, len(rows),
        *map(address_of, (points, pixels, depths_m, rows)), camera.fx, camera.fy, camera.cx, camera.cy,
        noise.base_m, noise.growth_per_m, noise.from_m, solution.rmse_px,
        (ctypes.c_double * 16)(*solution.T_camera_world.ravel().tolist()),
    )  # fmt: skip
    result = _Result()
    workspace = _WORKSPACE.words(_COLUMNS * (len(rows) + _SPARE_ROWS))
    _function()(ctypes.byref(request), address_of(workspace), ctypes.byref(result))
    if result.status == _KEPT:
        return solution
    if result.status != _REFINED:
        raise _refusal(result.status)
    return msgspec.structs.replace(
        solution, T_camera_world=np.array(result.T_camera_reference).reshape(4, 4),
        covariance=np.array(result.covariance).reshape(6, 6), rmse_px=result.rmse_px,
    )  # fmt: skip


def _refusal(status: int) -> BadRequest:
    """Return the error of a status of ``rse_pf_depth.h``."""
    match status:
        case 3:
            return BadRequest(
                f"depths_m holds a number that is not within 0..{_MAX_DEPTH_M:g} m",
                hint="send metres, 0 where there is no reading",
            )
        case 4:
            return BadRequest(
                "depths_m came with a point that is not before the reference camera",
                hint="send points in the frame of the camera that measured them, or leave depths_m out",
            )
        case 5:
            return BadRequest(
                "depths_m came with a pixel that is not finite or is beyond 1e+06", hint="leave such rows out"
            )
    return BadRequest(
        "depths_m came with a pose, a camera or row numbers that do not fit",
        hint="pass the solution of solve_pnp for the same rows",
    )


class _Request(ctypes.Structure):
    """``rse_pf_depth_request`` of ``rse_pf_depth.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("rows", ctypes.c_int64),
        ("inlier_rows", ctypes.c_int64), ("points_reference", ctypes.c_void_p), ("pixels", ctypes.c_void_p),
        ("depths_m", ctypes.c_void_p), ("inliers", ctypes.c_void_p), ("fx", ctypes.c_double),
        ("fy", ctypes.c_double), ("cx", ctypes.c_double), ("cy", ctypes.c_double),
        ("base_m", ctypes.c_double), ("growth_per_m", ctypes.c_double), ("from_m", ctypes.c_double),
        ("rmse_px", ctypes.c_double), ("T_camera_reference", ctypes.c_double * 16),
    )  # fmt: skip


class _Result(ctypes.Structure):
    """``rse_pf_depth_result`` of ``rse_pf_depth.h``."""

    _fields_ = (
        ("status", ctypes.c_int64), ("rmse_px", ctypes.c_double),
        ("T_camera_reference", ctypes.c_double * 16), ("covariance", ctypes.c_double * 36),
    )  # fmt: skip


_WORKSPACE = Workspace()


@cache
def _function() -> Any:
    return core_function("depth", "rse_pf_depth_refine", (ctypes.c_void_p,) * 3, None)
