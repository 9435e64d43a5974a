"""`solve_pnp`: estimate one camera pose with its covariance and verdict, or raise a typed error."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, TooFewCorrespondences
from rse_pf.geometry import Array, Camera
from rse_pf.pnp.engines import engine_for
from rse_pf.pnp.options import MIN_CORRESPONDENCES, PnpOptions, WeakLimits

__all__ = ["PnpSolution", "solve_pnp"]


class PnpSolution(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """An accepted camera pose.

    Attributes:
        T_camera_world: ``(4, 4)``, maps world points (metres) to the camera frame.
        inliers: Ascending row numbers of the inliers among the correspondences.
        rmse_px: Root mean square reprojection error of the inliers, pixels.
        covariance: ``(6, 6)`` of the twist xi = (rho metres, phi radians) in
            ``T_true = exp_se3(xi) @ T_camera_world``.
        verdict: ``ok``, or ``weak`` for a pose that may be wrong or imprecise.
        reason: Why the pose is weak: few-inliers, low-inlier-ratio, clustered, nearly-collinear, ambiguous or
            poorly-constrained; empty for a pose that is ok.
        engine: Name of the engine that estimated the pose, such as ``native``.
    """

    T_camera_world: Array
    inliers: npt.NDArray[np.intp]
    rmse_px: float
    covariance: Array
    verdict: Literal["ok", "weak"]
    reason: str
    engine: str


_DEFAULT_OPTIONS = PnpOptions()
_DEFAULT_LIMITS = WeakLimits()


def solve_pnp(
    points_world: Array,
    pixels: Array,
    camera: Camera,
    options: PnpOptions | None = None,
    *,
    default_engine: str = "native",
    weak: WeakLimits = _DEFAULT_LIMITS,
) -> PnpSolution:
    """Estimate the camera pose from 3-D to 2-D correspondences, some of which are wrong.

    Find ``T_camera_world`` such that ``camera.project(T_camera_world @ points_world[i])`` lies within
    ``options.inlier_px`` of ``pixels[i]`` for every inlier *i*.  Equal requests give equal poses on every
    server.

    Args:
        points_world: ``(n, 3)``, metres, world frame; ``n >= 4``, not all on one line.
        pixels: ``(n, 2)``, undistorted pixels; row *i* observes row *i* of *points_world*.
        camera: Intrinsics of the image the pixels come from.
        options: Options of RANSAC; None for the defaults.
        default_engine: Name of the engine if *options* names none: ``native`` or ``opencv``.
        weak: Limits beyond which a pose is weak instead of ok.

    Raises:
        TooFewCorrespondences: ``n < 4``.
        BadRequest: Shapes do not fit, a number is not finite or beyond 1e6, or there is no such engine.
        DegenerateGeometry: The inliers do not determine one pose, such as points on a line.
        NoConsensus: No pose has more inliers than a random pose would have.
        MissingExtra: The engine is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.

    Source:
        RSE-PF paper, Sect. 6.1 and Fig. 6; minimal solver after Gao et al. 2003, its ref. [13].
    """
    options = options or _DEFAULT_OPTIONS
    points_world, pixels = _validate(points_world, pixels)
    engine = options.engine or default_engine
    evidence = engine_for(engine)(points_world, pixels, camera, options, weak)
    if evidence.refusal is not None:
        raise evidence.refusal
    return PnpSolution(
        T_camera_world=evidence.T_camera_world,
        inliers=evidence.inliers,
        rmse_px=evidence.rmse_px,
        covariance=evidence.covariance,
        verdict="weak" if evidence.reason else "ok",
        reason=evidence.reason,
        engine=engine,
    )


def _validate(points_world: Array, pixels: Array) -> tuple[Array, Array]:
    try:
        points = np.ascontiguousarray(points_world, dtype=np.float64)
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest("points and pixels must be numbers", hint="send (n, 3) and (n, 2)") from error
    if points.ndim != 2 or pixels.ndim != 2 or points.shape[1] != 3 or pixels.shape != (len(points), 2):
        raise BadRequest(
            f"points {points.shape} and pixels {pixels.shape} are not (n, 3) and (n, 2)",
            hint="send one pixel for each point",
        )
    if len(points) < MIN_CORRESPONDENCES:
        raise TooFewCorrespondences(
            f"got {len(points)} correspondences, a pose needs at least {MIN_CORRESPONDENCES}",
            hint="loosen the matcher, or skip this frame",
        )
    return points, pixels
