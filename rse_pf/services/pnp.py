"""The perspective-n-point service: from the matches of one frame to one camera pose with its evidence.

It is stateless in the sense of the paper (Sect. 3.3): the request holds all that is needed.
"""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.config import PnpSettings
from rse_pf.errors import BadRequest, LimitExceeded, TooFewCorrespondences
from rse_pf.geometry import Camera
from rse_pf.native import native_solver
from rse_pf.pnp import DepthNoise, PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.pnp.engines import native_options
from rse_pf.pnp.options import WeakLimits
from rse_pf.service import Registry
from rse_pf.wire.arrays import Array, reshaped

__all__ = ["PnpReply", "PnpRequest", "make_request", "register"]

_UPPER = np.triu_indices(6)
_FLAT_UPPER = 6 * _UPPER[0] + _UPPER[1]
_POINT_DECIMALS = 4
_PIXEL_DECIMALS = 2
_DEPTH_DECIMALS = 3
_WEAK_LIMITS = WeakLimits()
# Matches of one command; more cost time, and do not make the pose better.
MAX_CORRESPONDENCES = 5000


class PnpRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Correspondences of one image.

    ``points_world`` holds ``3n`` metres, world frame, row after row; ``pixels`` holds ``2n``
    undistorted pixels in the same order.

    ``depths_m``, which may be left out, holds the ``n`` depths that a depth camera measured at the pixels,
    0 where there is none; the pose is then refined by the noise of both images.  The world frame of such a
    request is the camera that measured the points.  ``depth_noise`` is that of both depth cameras.
    """

    camera: Camera
    points_world: Array
    pixels: Array
    options: PnpOptions | None = None
    depths_m: Array | msgspec.UnsetType | None = msgspec.UNSET
    depth_noise: DepthNoise | msgspec.UnsetType | None = msgspec.UNSET


class PnpReply(msgspec.Struct, frozen=True, kw_only=True):
    """A pose and what speaks for it.

    ``T_camera_world`` holds 16 numbers, row-major; ``inliers`` sorted row numbers;
    ``covariance`` the 21 numbers of the upper triangle, row after row, of the ``(6, 6)``
    covariance of the twist (metres, then radians) on the left of the pose.
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
        """Return *solution* as a reply."""
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
        """Return the reply as the solver's type."""
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
    """Return the request of ``(n, 3)`` points and ``(n, 2)`` pixels, rounded for the wire.

    Rounds to 0.1 mm and 0.01 px, which is a third of the bytes and moves a pose by about
    0.02 mm, and the ``(n,)`` *depths_m*, if there are any, to 1 mm; *binary* makes the arrays float32.
    """
    kind = np.float32 if binary else np.float64
    return PnpRequest(
        camera=camera,
        points_world=np.round(np.asarray(points_world, dtype=np.float64), _POINT_DECIMALS).astype(kind),
        pixels=np.round(np.asarray(pixels, dtype=np.float64), _PIXEL_DECIMALS).astype(kind),
        options=options,
        depths_m=(
            msgspec.UNSET
            if depths_m is None
            else np.round(np.asarray(depths_m, dtype=np.float64), _DEPTH_DECIMALS).astype(kind)
        ),
        depth_noise=msgspec.UNSET if depth_noise is None else depth_noise,
    )


def register(registry: Registry, settings: PnpSettings) -> None:
    """Add ``pnp`` to *registry*, with the limits and the engine of *settings*.

    Raises:
        MissingExtra: The native core is not installed.
    """
    solver = native_solver()  # which every engine needs: a missing core is reported before the first command
    defaults = PnpOptions(max_iterations=settings.max_iterations)
    own_iterations = PnpOptions().max_iterations

    @registry.service("pnp", cheap=True)
    def pnp(request: PnpRequest) -> PnpReply:
        """Estimate the camera pose of one frame."""
        points_world, pixels = request.points_world, request.pixels
        _check_sizes(points_world, pixels)
        options = request.options or defaults
        if options is not defaults and options.max_iterations == own_iterations:
            # The robot left it out, so the limit of the server holds.
            options = msgspec.structs.replace(options, max_iterations=defaults.max_iterations)
        if options.max_iterations > settings.max_iterations:
            raise LimitExceeded(
                f"{options.max_iterations} iterations are above {settings.max_iterations}",
                hint="ask for fewer",
            )
        engine = options.engine or settings.engine
        depths_m = None if request.depths_m is msgspec.UNSET else request.depths_m
        if engine == "native" and depths_m is None:
            # As `solve_pnp`, in the arrays of the reply: most commands are answered here.
            found = solver.solve(points_world, pixels, request.camera, native_options(options, _WEAK_LIMITS))
            return PnpReply(
                T_camera_world=found.T_camera_world, inliers=found.inliers, rmse_px=found.rmse_px,
                covariance=found.covariance, verdict="weak" if found.reason else "ok", reason=found.reason,
                engine=engine,
            )  # fmt: skip
        points_world, pixels = points_world.reshape(-1, 3), pixels.reshape(-1, 2)
        solution = solve_pnp(points_world, pixels, request.camera, options, default_engine=engine)
        if depths_m is not None:
            noise = request.depth_noise or DepthNoise()
            solution = refine_with_depth(solution, points_world, pixels, depths_m, request.camera, noise)
        return PnpReply.of(solution)


def _check_sizes(points_world: Array, pixels: Array) -> None:
    """Raise an error unless the arrays hold 4 to `MAX_CORRESPONDENCES` points and pixels."""
    n = pixels.size // 2
    if 4 <= n <= MAX_CORRESPONDENCES and points_world.size == 3 * n and pixels.size == 2 * n:
        return
    points_world, pixels = reshaped("points_world", points_world, 3), reshaped("pixels", pixels, 2)
    n = len(points_world)
    if n > MAX_CORRESPONDENCES:
        raise LimitExceeded(
            f"{n} correspondences are above {MAX_CORRESPONDENCES}", hint="send the best matches only"
        )
    if n < 4:
        raise TooFewCorrespondences(
            f"got {n} correspondences, a pose needs at least 4",
            hint="loosen the matcher, or skip this frame",
        )
    raise BadRequest(
        f"points {points_world.shape} and pixels {pixels.shape} are not (n, 3) and (n, 2)",
        hint="send one pixel for each point",
    )
