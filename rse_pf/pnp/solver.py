"""`solve_pnp`: one camera pose with its evidence, or a typed error; never a pose that is a guess.

Promises determinism, no threads, and no state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, DegenerateGeometry, NoConsensus, TooFewCorrespondences
from rse_pf.geometry import Array, Camera
from rse_pf.pnp import evidence
from rse_pf.pnp.engines import engine_for

__all__ = ["PnpOptions", "PnpSolution", "WeakLimits", "solve_pnp"]

_LARGEST = 1e6
_CHANCE = -3.0
"""log10 of the false alarms at which chance is ruled out."""
_COLLINEAR, _NEARLY_COLLINEAR = 0.02, 0.1
_SAME_POSE, _SIMILAR_POSE = 1.1, 2.0
_FLAT_DEPTH = 0.2
_NOISE_FLOOR_PX2 = 0.01


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise BadRequest(
            f"{name} = {value:g} is not within {low:g}..{high:g}", hint="leave it out for the default"
        )


class PnpOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to solve; it travels with a command.

    Raises:
        BadRequest: A number is out of its range.
    """

    engine: Literal["poselib", "opencv"] | None = None
    inlier_px: float = 8.0
    max_iterations: int = 1000
    min_iterations: int = 10
    confidence: float = 0.999

    def __post_init__(self) -> None:
        _within("inlier_px", self.inlier_px, 1e-3, 100.0)
        _within("max_iterations", self.max_iterations, 1, 100_000)
        _within("min_iterations", self.min_iterations, 1, self.max_iterations)
        _within("confidence", self.confidence, 1e-6, 1.0 - 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakLimits:
    """Below these a pose is called weak."""

    inliers: int = 12
    inlier_ratio: float = 0.25
    translation_m: float = 0.1
    rotation_rad: float = math.radians(2.0)
    image_share: float = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PnpSolution:
    """A pose and what speaks for it.

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
    default_engine: str = "poselib",
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
    pose = engine_for(engine)(points_world, pixels, camera, options)
    if pose is None or not math.isfinite(float(np.sum(pose))):
        _blame(points_world, pixels)
        raise _no_consensus(0, len(pixels), options)
    view, error2 = evidence.view_of(pose, points_world, pixels, camera)
    inliers = np.flatnonzero(error2 <= options.inlier_px**2)
    count = len(inliers)
    error2 = error2[inliers]
    if count < 4 or _is_chance(len(pixels), count, float(error2.max()), camera):
        _blame(points_world, pixels)
        raise _no_consensus(count, len(pixels), options)
    view = view[:, inliers]
    spread = evidence.Spread(view)
    if spread.thinness < _COLLINEAR:
        raise _collinear(spread.thinness)
    if spread.image_radius * camera.fx < 2.0 * options.inlier_px:
        raise DegenerateGeometry(
            f"the pixels that agree lie within {spread.image_radius * camera.fx:.1f} px of each other",
            hint="match points all over the image, or skip this frame",
        )
    squares = float(error2.sum())
    covariance = _covariance(view, camera, squares)
    rmse_px = math.sqrt(squares / count)
    reason = _weakness(count, len(pixels), spread, covariance, camera, weak)
    if _is_flat(view):
        twin = _twin(pose, points_world[inliers], pixels[inliers], camera, rmse_px)
        reason = reason or twin
    T_camera_world = np.eye(4)
    T_camera_world[:3] = pose
    return PnpSolution(
        T_camera_world=T_camera_world,
        inliers=inliers,
        rmse_px=rmse_px,
        covariance=covariance,
        verdict="weak" if reason else "ok",
        reason=reason,
        engine=engine,
    )


def _checked(points_world: Array, pixels: Array) -> tuple[Array, Array]:
    try:
        points = np.ascontiguousarray(points_world, dtype=np.float64)
        seen = np.ascontiguousarray(pixels, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest("points and pixels must be numbers", hint="send (n, 3) and (n, 2)") from error
    if points.ndim != 2 or seen.ndim != 2 or points.shape[1] != 3 or seen.shape != (len(points), 2):
        raise BadRequest(
            f"points {points.shape} and pixels {seen.shape} are not (n, 3) and (n, 2)",
            hint="send one pixel for each point",
        )
    if len(points) < 4:
        raise TooFewCorrespondences(
            f"got {len(points)} correspondences, a pose needs at least 4",
            hint="loosen the matcher, or skip this frame",
        )
    for name, rows in (("points_world", points), ("pixels", seen)):
        flat = rows.ravel()
        total = float(flat.dot(flat))
        if not total < _LARGEST**2 and not (np.abs(flat) <= _LARGEST).all():
            raise BadRequest(
                f"{name} holds a number that is not finite or is beyond {_LARGEST:g}",
                hint="leave such rows out",
            )
    return points, seen


def _is_chance(n: int, count: int, largest_error2_px2: float, camera: Camera) -> bool:
    return evidence.log10_false_alarms(n, count, largest_error2_px2, camera) > _CHANCE


def _blame(points_world: Array, pixels: Array) -> None:
    """Say so if the input as a whole is degenerate: it is a better reason than "no consensus"."""
    for rows in (points_world, pixels):
        thinness = evidence.slenderness(rows)
        if thinness < _COLLINEAR:
            raise _collinear(thinness)


def _collinear(thinness: float) -> DegenerateGeometry:
    return DegenerateGeometry(
        f"the points that agree lie on one line or coincide (width/length {thinness:.3f} is below "
        f"{_COLLINEAR})",
        hint="match points all over the image, or skip this frame",
    )


def _covariance(view: Array, camera: Camera, squares_px2: float) -> Array:
    variance = max(squares_px2 / max(1, 2 * view.shape[1] - 6), _NOISE_FLOOR_PX2)
    try:
        covariance = np.linalg.inv(evidence.information(view, camera)).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        covariance = np.full((6, 6), -1.0)
    covariance *= variance
    if not min(covariance.diagonal().tolist()) > 0:
        raise DegenerateGeometry(
            "the correspondences leave a motion of the camera free", hint="match more of the scene"
        )
    return covariance


def _weakness(
    count: int, n: int, spread: evidence.Spread, covariance: Array, camera: Camera, weak: WeakLimits
) -> str:
    if count < weak.inliers:
        return "few-inliers"
    if count < weak.inlier_ratio * n:
        return "low-inlier-ratio"
    if spread.thinness < _NEARLY_COLLINEAR:
        return "nearly-collinear"
    if 2.0 * spread.image_radius * camera.fx < weak.image_share * camera.width:
        return "clustered"
    variances = covariance.diagonal().tolist()
    if max(variances[:3]) > weak.translation_m**2 or max(variances[3:]) > weak.rotation_rad**2:
        return "poorly-constrained"
    return ""


def _is_flat(view: Array) -> bool:
    """Whether perspective is weak: only then may a plane have two poses."""
    z = view[evidence.Z]
    nearest, farthest = float(z.min()), float(z.max())
    return farthest - nearest < _FLAT_DEPTH * farthest


def _twin(pose: Array, points: Array, pixels: Array, camera: Camera, rmse_px: float) -> str:
    """Look for the second pose of a plane."""
    other = evidence.flipped_rmse_px(pose, points, pixels, camera)
    if other is None:
        return ""
    ratio = other / max(rmse_px, math.sqrt(_NOISE_FLOOR_PX2))
    if ratio < _SAME_POSE:
        raise DegenerateGeometry(
            f"two poses fit alike ({rmse_px:.2f} and {other:.2f} px)",
            hint="match points that do not lie in one far plane",
        )
    return "ambiguous" if ratio < _SIMILAR_POSE else ""


def _no_consensus(count: int, n: int, options: PnpOptions) -> NoConsensus:
    return NoConsensus(
        f"the best pose agrees with {count} of {n} correspondences within {options.inlier_px:g} px, "
        "no more than chance would give",
        hint="tighten the matcher, or skip this frame",
    )
