"""The service ``pnp``: compute the camera pose of one image from 3-D to 2-D correspondences.

The service is stateless in the sense of the RSE-PF paper (Sect. 3.3): a request holds all data of its
computation.
"""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.config import PnpSettings
from rse_pf.errors import BadRequest, LimitExceeded, TooFewCorrespondences
from rse_pf.geometry import Camera
from rse_pf.pnp import DepthNoise, PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.pnp.engines import native_options
from rse_pf.pnp.native_solver import native_solver
from rse_pf.pnp.options import MIN_CORRESPONDENCES, WeakLimits
from rse_pf.service import Registry
from rse_pf.wire.arrays import Array, reshaped

__all__ = ["PnpReply", "PnpRequest", "make_request", "register"]

_UPPER = np.triu_indices(6)
"""Row and column numbers of the upper triangle of a 6x6 covariance, by rows."""
_FLAT_UPPER = 6 * _UPPER[0] + _UPPER[1]
"""Indices of the upper triangle in a flattened 6x6 covariance."""
_POINT_DECIMALS = 4  # decimals of a coordinate in metres: 0.1 mm, below the noise of a depth camera
_PIXEL_DECIMALS = 2  # decimals of a pixel coordinate: 0.01 px, below the noise of features
_DEPTH_DECIMALS = 3  # decimals of a depth in metres: 1 mm, as depth cameras write
_WEAK_LIMITS = WeakLimits()  # limits beyond which a pose of the fast path is weak: those of `solve_pnp`
MAX_ITERATIONS = 1000  # most RANSAC iterations of a command, which is the default of a command, too
MAX_CORRESPONDENCES = 5000  # most correspondences of a command: more are refused, as they improve no pose


class PnpRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Correspondences of one image, the payload of a ``pnp`` command.

    Attributes:
        camera: Intrinsics of the image.
        points_world: ``3n`` coordinates of ``n`` points, metres, world frame, row by row.
        pixels: ``2n`` undistorted pixel coordinates in the same order.
        options: Options of RANSAC; None for the server's defaults.
        depths_m: Optional ``n`` depths that a depth camera measured at the pixels, metres; 0 where there is
            none. With depths, the points must be in the frame of the camera that measured them, which is the
            world frame of the reply, and the server refines the pose with the depths.
        depth_noise: Noise of the depth camera that measured *depths_m* and of that which measured the points;
            used with *depths_m* only.
    """

    camera: Camera
    points_world: Array
    pixels: Array
    options: PnpOptions | None = None
    depths_m: Array | msgspec.UnsetType | None = msgspec.UNSET
    depth_noise: DepthNoise | msgspec.UnsetType | None = msgspec.UNSET


class PnpReply(msgspec.Struct, frozen=True, kw_only=True):
    """An accepted camera pose, the payload of the result of a ``pnp`` command.

    Attributes:
        T_camera_world: 16 numbers, a row-major 4x4 matrix that maps world points (metres) to the camera
            frame.
        inliers: Ascending row numbers of the inliers.
        rmse_px: Root mean square reprojection error of the inliers.
        covariance: 21 numbers, the upper triangle by rows of the ``(6, 6)`` covariance of the twist (metres,
            radians) that multiplies the pose on the left.
        verdict: ``ok`` or ``weak``.
        reason: Why the pose is weak; empty for a pose that is ok.
        engine: Name of the engine that estimated the pose.
    """

    T_camera_world: Array
    inliers: Array
    rmse_px: float
    covariance: Array
    verdict: str
    reason: str = ""
    engine: str = ""

    @classmethod
    def of(cls, solution: PnpSolution) -> PnpReply:
        """Return the reply that carries *solution*; its covariance is rounded to float32."""
        return cls(
            T_camera_world=solution.T_camera_world.ravel(),
            inliers=solution.inliers.astype(np.uint32),
            rmse_px=solution.rmse_px,
            covariance=solution.covariance.take(_FLAT_UPPER).astype(np.float32),
            verdict=solution.verdict,
            reason=solution.reason,
            engine=solution.engine,
        )

    def solution(self) -> PnpSolution:
        """Return the pose of the reply as a `PnpSolution`, with ``(4, 4)`` pose and ``(6, 6)`` covariance.

        A verdict other than ``ok``, such as one that only a newer server knows, becomes ``weak``.
        """
        covariance = np.zeros((6, 6))
        covariance[_UPPER] = self.covariance
        covariance.T[_UPPER] = self.covariance
        return PnpSolution(
            T_camera_world=np.asarray(self.T_camera_world, dtype=np.float64).reshape(4, 4),
            inliers=np.asarray(self.inliers).astype(np.intp),
            rmse_px=self.rmse_px,
            covariance=covariance,
            verdict="ok" if self.verdict == "ok" else "weak",
            reason=self.reason,
            engine=self.engine,
        )


def make_request(
    points_world: npt.NDArray[np.float64],
    pixels: npt.NDArray[np.float64],
    camera: Camera,
    options: PnpOptions | None = None,
    *,
    depths_m: npt.NDArray[np.float64] | None = None,
    depth_noise: DepthNoise | None = None,
    binary: bool = False,
) -> PnpRequest:
    """Return a request whose numbers are rounded, so that its JSON text is short.

    Points are rounded to 0.1 mm and pixels to 0.01 px.  This reduces the JSON text to a third of its bytes,
    and changes the position of the estimated pose by about 0.02 mm.

    Args:
        points_world: ``(n, 3)``, metres, world frame; with *depths_m* the frame of the camera that measured
            the points.
        pixels: ``(n, 2)``, undistorted pixels.
        camera: Intrinsics of the image.
        options: Options of RANSAC; None for the server's defaults.
        depths_m: ``(n,)``, depths measured at the pixels, rounded to 1 mm; None for a request without depths.
        depth_noise: Noise of the depth cameras; None for that of a Kinect.
        binary: Whether arrays are float32, for the codec ``bin``, instead of float64.
    """
    dtype = np.float32 if binary else np.float64
    return PnpRequest(
        camera=camera,
        points_world=np.round(np.asarray(points_world, dtype=np.float64), _POINT_DECIMALS).astype(dtype),
        pixels=np.round(np.asarray(pixels, dtype=np.float64), _PIXEL_DECIMALS).astype(dtype),
        options=options,
        depths_m=(
            msgspec.UNSET
            if depths_m is None
            else np.round(np.asarray(depths_m, dtype=np.float64), _DEPTH_DECIMALS).astype(dtype)
        ),
        depth_noise=msgspec.UNSET if depth_noise is None else depth_noise,
    )


def register(registry: Registry, settings: PnpSettings, *, max_iterations: int = MAX_ITERATIONS) -> None:
    """Add the service ``pnp`` to *registry*.

    Args:
        registry: The services of a server.
        settings: With the engine of commands that name none.
        max_iterations: RANSAC iterations that a command may ask for.

    Raises:
        MissingExtra: The native core, which every engine needs, is not installed.
    """
    solver = native_solver()
    defaults = PnpOptions()

    @registry.service("pnp", cheap=True)
    def pnp(request: PnpRequest) -> PnpReply:
        """Estimate the camera pose of one frame."""
        points_world, pixels = request.points_world, request.pixels
        _check_sizes(points_world, pixels)
        options = request.options or defaults
        if options.max_iterations > max_iterations:
            raise LimitExceeded(
                f"{options.max_iterations} iterations are above {max_iterations}", hint="ask for fewer"
            )
        engine = options.engine or settings.engine
        depths_m = None if request.depths_m is msgspec.UNSET else request.depths_m
        if engine == "native" and depths_m is None:
            # The fast path of most commands: the same pose as `solve_pnp`, without conversions of arrays.
            pose = solver.solve(points_world, pixels, request.camera, native_options(options, _WEAK_LIMITS))
            return PnpReply(
                T_camera_world=pose.T_camera_world,
                inliers=pose.inliers,
                rmse_px=pose.rmse_px,
                covariance=pose.covariance,
                verdict="weak" if pose.reason else "ok",
                reason=pose.reason,
                engine=engine,
            )
        points_world, pixels = points_world.reshape(-1, 3), pixels.reshape(-1, 2)
        solution = solve_pnp(points_world, pixels, request.camera, options, default_engine=engine)
        if depths_m is not None:
            noise = request.depth_noise or DepthNoise()
            solution = refine_with_depth(solution, points_world, pixels, depths_m, request.camera, noise)
        return PnpReply.of(solution)


def _check_sizes(points_world: Array, pixels: Array) -> None:
    """Check that the arrays, flat or as rows, hold a pixel for each point, and neither too few nor too many.

    Raises:
        LimitExceeded: There are more than `MAX_CORRESPONDENCES` points.
        TooFewCorrespondences: There are fewer than `MIN_CORRESPONDENCES` points.
        BadRequest: The numbers of points and pixels differ, or the last point or pixel is incomplete.
    """
    n = pixels.size // 2
    if (
        MIN_CORRESPONDENCES <= n <= MAX_CORRESPONDENCES
        and points_world.size == 3 * n
        and pixels.size == 2 * n
    ):
        return
    points_world, pixels = reshaped("points_world", points_world, 3), reshaped("pixels", pixels, 2)
    n = len(points_world)
    if n > MAX_CORRESPONDENCES:
        raise LimitExceeded(
            f"{n} correspondences are above {MAX_CORRESPONDENCES}", hint="send the best matches only"
        )
    if n < MIN_CORRESPONDENCES:
        raise TooFewCorrespondences(
            f"got {n} correspondences, a pose needs at least {MIN_CORRESPONDENCES}",
            hint="loosen the matcher, or skip this frame",
        )
    raise BadRequest(
        f"points {points_world.shape} and pixels {pixels.shape} are not (n, 3) and (n, 2)",
        hint="send one pixel for each point",
    )
