"""Refine the pose of `solve_pnp` with the depths that both cameras measured, by the noise of both.

PnP takes its points as exact and looks at the pixels of one image.  Where a depth camera took both images,
each correspondence is two noisy measurements of one point.  Nothing is searched here, and no inlier is added
or lost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, exp_se3, transform
from rse_pf.pnp.native_depth import depth_core
from rse_pf.pnp.solver import PnpSolution

__all__ = ["DepthNoise", "refine_by_numpy", "refine_with_depth"]

# From the solver's pose, the third step is below 10 um as a rule.
_MAX_ITERATIONS = 6
_CONVERGED = 1e-5
# Mahalanobis distance at which a correspondence weighs half.
_CAUCHY = 2.5
_MIN_PIXEL_PX = 0.05
_MIN_SCALE = 0.01
_NEAR_M = 1e-3
_MAX_DEPTH_M = 1e3
# Growth of the pixel errors above which depths and pixels contradict each other.
_MAX_GROWTH, _LEAST_RMSE_PX = 1.5, 0.2


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
) -> PnpSolution:
    """Return *solution* with the pose that fits pixels and depths of both images best.

    A point is taken as seen in the reference camera with the noise of its depth and its pixel; the second
    camera's pixel and depth carry noise, too.  The pixel noise, equal in both images, is read off the errors
    that *solution* left.  Iterated least squares on these residuals with a Cauchy weight; deterministic.
    A solution of the engine ``native`` is refined in the native core, others are by `refine_by_numpy`.

    Args:
        solution: Of `solve_pnp` for the same rows.
        points_reference: ``(n, 3)``, metres, in the frame of the *reference camera*, whose depth camera
            measured them; all before it.
        pixels: ``(n, 2)``, undistorted pixels of the second image.
        depths_m: ``(n,)``, metres along the optical axis of the second camera at these pixels, 0 where there
            is none.
        camera: Intrinsics of both images.
        noise: Of both depth cameras.

    Returns:
        The refined pose with its covariance and ``rmse_px``; inliers and verdict are those of *solution*.
        Where depths and pixels contradict each other, *solution* itself.

    Raises:
        BadRequest: Shapes do not fit, a depth is absurd, or a point is not before the reference camera.

    Source:
        Errors in variables after Segal et al., Generalized-ICP (RSS 2009), here with pixels and depths;
        covariance after Huber, Robust Statistics (1981), Sect. 7.6.
    """
    core = depth_core() if solution.engine == "native" else None
    if core is not None:
        found = core.refine(
            solution, points_reference, pixels, depths_m, camera,
            (noise.base_m, noise.growth_per_m, noise.from_m),
        )  # fmt: skip
        if found == "kept":
            return solution
        if found != "refused":
            return msgspec.structs.replace(
                solution, T_camera_world=found.T_camera_reference, covariance=found.covariance,
                rmse_px=found.rmse_px,
            )  # fmt: skip
    return refine_by_numpy(solution, points_reference, pixels, depths_m, camera, noise)


def refine_by_numpy(
    solution: PnpSolution,
    points_reference: Array,
    pixels: Array,
    depths_m: Array,
    camera: Camera,
    noise: DepthNoise = _KINECT,
) -> PnpSolution:
    """Return what `refine_with_depth` does, without the native core, whose oracle this is.

    Raises:
        BadRequest: Shapes do not fit, a depth is absurd, or a point is not before the reference camera.
    """
    depths_m = _checked(points_reference, depths_m)
    rows = solution.inliers
    points, measured = points_reference[rows], np.column_stack([pixels[rows], depths_m[rows]])
    has_depth = measured[:, 2] > 0.0
    if not has_depth.any():
        return solution
    try:
        fit = _fitted(solution, _Matches(points, measured, has_depth), camera, noise)
        covariance = fit.covariance()
    except np.linalg.LinAlgError:
        return solution
    error = camera.project(fit.points_camera) - measured[:, :2]
    rmse_px = math.sqrt(float(np.vdot(error, error)) / len(rows))
    # Also false where a number is not finite.
    if not (covariance is not None and rmse_px <= _MAX_GROWTH * max(_LEAST_RMSE_PX, solution.rmse_px)):
        return solution
    return msgspec.structs.replace(
        solution, T_camera_world=fit.T_camera_reference, covariance=covariance, rmse_px=rmse_px
    )


class _Matches(NamedTuple):
    """The inliers of a pose: points in the reference frame and what the camera measured of them."""

    points: Array
    """``(k, 3)``, metres."""
    measured: Array
    """``(k, 3)``: u and v in pixels, the depth in metres, 0 without a reading."""
    has_depth: npt.NDArray[np.bool_]


def _fitted(solution: PnpSolution, matches: _Matches, camera: Camera, noise: DepthNoise) -> _Fit:
    """Return the fit at the best pose; raises LinAlgError where some motion is free."""
    pixel_px2 = max(_MIN_PIXEL_PX, 0.5 * solution.rmse_px) ** 2
    spread = _spread_of_reference(matches.points, camera, noise, pixel_px2)
    T = solution.T_camera_world
    for _ in range(_MAX_ITERATIONS):
        fit = _Fit(T, matches, spread, camera, noise, pixel_px2)
        xi = np.linalg.solve(fit.weighted_information, fit.gradient)
        if not np.isfinite(xi).all():
            raise np.linalg.LinAlgError
        T = exp_se3(xi) @ T
        if np.abs(xi).max() < _CONVERGED:
            break
    return _Fit(T, matches, spread, camera, noise, pixel_px2)


def _checked(points_reference: Array, depths_m: Array) -> Array:
    depths_m = np.asarray(depths_m, dtype=np.float64)
    if depths_m.shape != (len(points_reference),):
        raise BadRequest(
            f"depths_m has shape {depths_m.shape} for {len(points_reference)} correspondences",
            hint="send one depth for each pixel, 0 where there is none",
        )
    if not ((depths_m >= 0.0) & (depths_m <= _MAX_DEPTH_M)).all():
        raise BadRequest(
            f"depths_m holds a number that is not within 0..{_MAX_DEPTH_M:g} m",
            hint="send metres, 0 where there is no reading",
        )
    if not (points_reference[:, 2] >= _NEAR_M).all():
        raise BadRequest(
            "depths_m came with a point that is not before the reference camera",
            hint="send points in the frame of the camera that measured them, or leave depths_m out",
        )
    return depths_m


def _spread_of_reference(points: Array, camera: Camera, noise: DepthNoise, pixel_px2: float) -> Array:
    """Return the ``(k, 3, 3)`` covariance of the points from pixel and depth in the reference image."""
    z = points[:, 2]
    along = points / z[:, None]
    spread = (along[:, :, None] * along[:, None, :]) * noise.variance_m2(z)[:, None, None]
    spread[:, 0, 0] += pixel_px2 * (z / camera.fx) ** 2
    spread[:, 1, 1] += pixel_px2 * (z / camera.fy) ** 2
    return spread


class _Fit:
    """Residuals (pixels and metres) of all correspondences at one pose, their weights and normal equations.

    A row without depth takes part with its pixel only: its third residual is 0 and of no weight.
    """

    def __init__(
        self,
        T_camera_reference: Array,
        matches: _Matches,
        spread: Array,
        camera: Camera,
        noise: DepthNoise,
        pixel_px2: float,
    ) -> None:
        measured, has_depth = matches.measured, matches.has_depth
        self.T_camera_reference = T_camera_reference
        self.points_camera = transform(T_camera_reference, matches.points)
        self.points_camera[:, 2] = np.maximum(self.points_camera[:, 2], _NEAR_M)
        x, y, z = self.points_camera.T
        k = len(z)
        residual = measured.copy()
        residual[:, :2] -= camera.project(self.points_camera)
        residual[:, 2] -= z
        residual[~has_depth, 2] = 0.0
        # (u, v, z) by the point in the camera's frame, then by the twist left of the pose.
        by_point = np.zeros((k, 3, 3))
        by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
        by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
        by_point[:, 2, 2] = has_depth
        by_twist = np.zeros((k, 3, 6))
        by_twist[:, 0, 0] = by_twist[:, 1, 1] = by_twist[:, 2, 2] = 1.0
        by_twist[:, 0, 4], by_twist[:, 0, 5] = z, -y
        by_twist[:, 1, 3], by_twist[:, 1, 5] = -z, x
        by_twist[:, 2, 3], by_twist[:, 2, 4] = y, -x
        by_twist = by_point @ by_twist
        turned = by_point @ T_camera_reference[:3, :3]
        variance = turned @ spread @ turned.transpose(0, 2, 1)
        variance[:, 0, 0] += pixel_px2
        variance[:, 1, 1] += pixel_px2
        variance[:, 2, 2] += np.where(has_depth, noise.variance_m2(z), 1.0)
        inverse = np.linalg.inv(variance)
        weighed = np.einsum("kij,kj->ki", inverse, residual)
        self._distance2 = np.einsum("ki,ki->k", residual, weighed)
        self._weight = 1.0 / (1.0 + self._distance2 / _CAUCHY**2)
        self._numbers = 2.0 + has_depth
        by_variance = inverse @ by_twist
        self._information = np.einsum("kia,kib->kab", by_twist, by_variance)
        self.weighted_information: Array = np.einsum("k,kab->ab", self._weight, self._information)
        self.gradient: Array = np.einsum("k,kia,ki->a", self._weight, by_twist, weighed)

    def covariance(self) -> Array | None:
        """Return the ``(6, 6)`` covariance of the twist left of the pose, None if there is none.

        The spread of the residuals scales it, so wrong noise of the sensor changes it less.
        """
        weight, distance2, numbers = self._weight, self._distance2, self._numbers
        slope = weight - 2.0 * weight**2 * distance2 / (numbers * _CAUCHY**2)
        mean_slope = float((numbers * slope).sum() / numbers.sum())
        if mean_slope <= 0.0:
            return None
        square = float((weight**2 * distance2).sum() / max(1.0, numbers.sum() - 6.0))
        covariance = np.linalg.inv(self._information.sum(axis=0))
        covariance *= max(_MIN_SCALE, square / mean_slope**2)
        covariance = 0.5 * (covariance + covariance.T)
        return covariance if (np.diag(covariance) > 0.0).all() else None
