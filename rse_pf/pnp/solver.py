"""`solve_pnp`: one camera pose with its evidence, or a typed error if there is no reliable pose."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, TooFewCorrespondences
from rse_pf.geometry import Array, Camera
from rse_pf.pnp.engines import engine_for
from rse_pf.pnp.options import PnpOptions, WeakLimits
from rse_pf.pnp.rules import MATCHES_OF_A_POSE

__all__ = ["PnpSolution", "solve_pnp"]


class PnpSolution(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A pose and its evidence.

    Attributes:
        T_camera_world: ``(4, 4)``, maps world points (metres) into the camera's frame.
        inliers: Sorted row numbers of the correspondences that agree.
        rmse_px: Root mean square reprojection error over the inliers.
        covariance: ``(6, 6)`` of the twist xi = (rho metres, phi radians) in
            ``T_true = exp_se3(xi) @ T_camera_world``.
        verdict: ``ok``, or ``weak`` with a *reason*: few-inliers, low-inlier-ratio, clustered,
            nearly-collinear, ambiguous, poorly-constrained.
        engine: Which engine proposed it.
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
    """Estimate the camera pose from 3-D to 2-D matches, some of which are wrong.

    Finds ``T_camera_world`` such that every inlier *i* satisfies
    ``pixels[i] ~ camera.project(T_camera_world @ points_world[i])`` within
    ``options.inlier_px``.  The same request gives the same pose on every server.

    Args:
        points_world: ``(n, 3)``, metres, world frame; ``n >= 4``, not all on one line.
        pixels: ``(n, 2)``, undistorted pixels; row *i* observes row *i* of *points_world*.
        camera: Intrinsics of the image the pixels come from.
        options: RANSAC settings; ``None`` means the defaults.
        default_engine: The engine when *options* names none.
        weak: Where a pose stops being ``ok``.

    Raises:
        TooFewCorrespondences: ``n < 4``.
        BadRequest: Shapes do not fit, or a number is not finite or absurd.
        DegenerateGeometry: The points lie on one line or coincide, or two poses fit alike.
        NoConsensus: No pose agrees with more correspondences than chance would give.
        MissingExtra: The engine is not installed.

    Source:
        RSE-PF paper, Sect. 6.1 and Fig. 6; minimal solver after Gao et al. 2003, its ref. [13].
    """
    options = options or _DEFAULT_OPTIONS
    points_world, pixels = _checked(points_world, pixels)
    engine = options.engine or default_engine
    found = engine_for(engine)(points_world, pixels, camera, options, weak)
    if found.refusal is not None:
        raise found.refusal
    return PnpSolution(
        T_camera_world=found.T_camera_world,
        inliers=found.inliers,
        rmse_px=found.rmse_px,
        covariance=found.covariance,
        verdict="weak" if found.reason else "ok",
        reason=found.reason,
        engine=engine,
    )


def _checked(points_world: Array, pixels: Array) -> tuple[Array, Array]:
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
    if len(points) < MATCHES_OF_A_POSE:
        raise TooFewCorrespondences(
            f"got {len(points)} correspondences, a pose needs at least {MATCHES_OF_A_POSE}",
            hint="loosen the matcher, or skip this frame",
        )
    return points, pixels
