"""Refine the pose of `solve_pnp` with the depths that both cameras measured.

PnP takes the 3-D points as exact, and minimises the reprojection errors in the second image only.  If depth
cameras took both images, a correspondence is two noisy measurements of one point: pixel and depth in the
reference image, from which the 3-D point was computed, and pixel and depth in the second image.  The
refinement weights each residual by the noise of both measurements; the set of inliers stays that of PnP.  The
native core computes the refined pose (``native/src/depth.cpp``).
"""

from __future__ import annotations

import ctypes

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera
from rse_pf.native import PART_ABIS, Workspace, address_of, aligned, core_function
from rse_pf.pnp.options import require_within
from rse_pf.pnp.solver import PnpSolution

__all__ = ["DepthNoise", "refine_with_depth"]

_PORTABLE = 1  # flag RSE_PF_DEPTH_PORTABLE of a request: compute without AVX2
_REFINED = 0  # status RSE_PF_DEPTH_REFINED of a result: it holds the refined pose
_KEPT = 1  # status RSE_PF_DEPTH_KEPT of a result: the pose of PnP stays
_COLUMNS = 11  # columns of the core's workspace, each with one 8-byte number for each inlier
_SPARE_ROWS = 4  # rows of the core's workspace that pad the inliers to a multiple of four
_MAX_DEPTH_M = 1e3  # largest depth (metres) that the core accepts; here it only appears in an error message


class DepthNoise(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Noise model of a depth camera: the standard deviation of a measured depth, which grows with the depth.

    At depth z (metres) it is ``base_m + growth_per_m * max(0, z - from_m)**2`` metres.

    Attributes:
        base_m: Standard deviation up to the depth *from_m*, metres.
        growth_per_m: Growth of the standard deviation with the square of the depth beyond *from_m*, 1/metre.
        from_m: Depth from which on the standard deviation grows, metres.

    The default values, 1.2 mm + 1.9 mm/m^2 beyond 0.4 m, are those of a Kinect.

    Raises:
        BadRequest: A number is out of its range.

    Source:
        Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 5.
    """

    base_m: float = 0.0012
    growth_per_m: float = 0.0019
    from_m: float = 0.4

    def __post_init__(self) -> None:
        require_within("base_m", self.base_m, 1e-5, 1.0)
        require_within("growth_per_m", self.growth_per_m, 0.0, 1.0)
        require_within("from_m", self.from_m, 0.0, 100.0)

    def variance_m2(self, depth_m: Array) -> Array:
        """Return the variances (square metres) of *depth_m* (metres), a new array of the same shape."""
        beyond = np.maximum(0.0, depth_m - self.from_m)
        return (self.base_m + self.growth_per_m * beyond * beyond) ** 2


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
    """Refine the pose of *solution* with the depths that the cameras of both images measured.

    Minimise the residuals of pixel and depth of the inliers in the second image by Gauss-Newton with Cauchy
    weights; an inlier without a depth there has the residual of its pixel only.  The covariance of a residual
    sums the noise of pixel and depth in both images.  The standard deviation of a pixel coordinate is taken
    as half of ``solution.rmse_px`` in each image, at least 0.05 px: the square of a reprojection error sums
    the variances of four coordinates, two in each image.

    Args:
        solution: Result of `solve_pnp` for the same rows, where the world frame is that of the reference
            camera.
        points_reference: ``(n, 3)``, metres, in the frame of the reference camera, whose depth camera
            measured them; all in front of it, also the outliers.
        pixels: ``(n, 2)``, undistorted pixels of the second image.
        depths_m: ``(n,)``, metres along the optical axis of the second camera at these pixels, at most 1000;
            0 for a pixel without a depth.
        camera: Intrinsics of both images.
        noise: Noise of both depth cameras.
        portable: Compute without AVX2, which changes no byte of the result; for tests.

    Returns:
        A copy of *solution* with the refined pose, its covariance, and the root mean square reprojection
        error of all inliers at the refined pose as ``rmse_px``; inliers, verdict and reason stay those of
        PnP.  *solution* itself if no inlier has a depth in the second image, if the ``rmse_px`` of the
        refined pose would be above 1.5 times the larger one of ``solution.rmse_px`` and 0.2 px, if the
        iterations diverge, or if the normal equations are singular or leave a variance that is not positive
        and finite.

    Raises:
        BadRequest: Shapes do not fit, a number is not finite or too large, a depth is negative, or a point is
            not in front of the reference camera.
        MissingExtra: The native core is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.

    Source:
        Residual covariances as in Segal et al., Generalized-ICP, RSS 2009, here for pixels and depths;
        covariance of the pose by Huber, Robust Statistics (1981), Sect. 7.6.
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
        PART_ABIS["depth"],
        _PORTABLE if portable else 0,
        n,
        len(rows),
        *map(address_of, (points, pixels, depths_m, rows)),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        noise.base_m,
        noise.growth_per_m,
        noise.from_m,
        solution.rmse_px,
        (ctypes.c_double * 16)(*solution.T_camera_world.ravel().tolist()),
    )
    result = _Result()
    workspace = _WORKSPACE.words(_COLUMNS * (len(rows) + _SPARE_ROWS))
    refine = core_function("depth", "rse_pf_depth_refine", (ctypes.c_void_p,) * 3, None)
    refine(ctypes.byref(request), address_of(workspace), ctypes.byref(result))
    if result.status == _KEPT:
        return solution
    if result.status != _REFINED:
        message, hint = _REFUSALS.get(result.status, _BAD_REQUEST)
        raise BadRequest(message, hint=hint)
    return msgspec.structs.replace(
        solution,
        T_camera_world=np.array(result.T_camera_reference).reshape(4, 4),
        covariance=np.array(result.covariance).reshape(6, 6),
        rmse_px=result.rmse_px,
    )


_REFUSALS = {
    3: (
        f"depths_m holds a number that is not within 0..{_MAX_DEPTH_M:g} m",
        "send metres, 0 where there is no reading",
    ),
    4: (
        "depths_m came with a point that is not in front of the reference camera",
        "send points in the frame of the camera that measured them, or leave depths_m out",
    ),
    5: (
        "depths_m came with a pixel that is not finite or is beyond 1e+06",
        "leave such rows out",
    ),
}
"""Message and hint of the error for each status of ``rse_pf_depth.h`` that names a malformed array: 3 is
RSE_PF_DEPTH_BAD_DEPTHS, 4 RSE_PF_DEPTH_BAD_POINTS, and 5 RSE_PF_DEPTH_BAD_PIXELS."""
_BAD_REQUEST = (
    "depths_m came with a pose, a camera or row numbers that do not fit",
    "pass the solution of solve_pnp for the same rows",
)


class _Request(ctypes.Structure):
    """The C struct ``rse_pf_depth_request`` of ``native/include/rse_pf_depth.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("rows", ctypes.c_int64),
        ("inlier_rows", ctypes.c_int64),
        ("points_reference", ctypes.c_void_p),
        ("pixels", ctypes.c_void_p),
        ("depths_m", ctypes.c_void_p),
        ("inliers", ctypes.c_void_p),
        ("fx", ctypes.c_double),
        ("fy", ctypes.c_double),
        ("cx", ctypes.c_double),
        ("cy", ctypes.c_double),
        ("base_m", ctypes.c_double),
        ("growth_per_m", ctypes.c_double),
        ("from_m", ctypes.c_double),
        ("rmse_px", ctypes.c_double),
        ("T_camera_reference", ctypes.c_double * 16),
    )


class _Result(ctypes.Structure):
    """The C struct ``rse_pf_depth_result`` of ``native/include/rse_pf_depth.h``."""

    _fields_ = (
        ("status", ctypes.c_int64),
        ("rmse_px", ctypes.c_double),
        ("T_camera_reference", ctypes.c_double * 16),
        ("covariance", ctypes.c_double * 36),
    )


_WORKSPACE = Workspace()
"""Scratch memory for calls of the core, one array in each thread."""
