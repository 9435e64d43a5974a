"""`solve_pnp`: one camera pose with its evidence, or a typed error if there is no reliable pose."""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, DegenerateGeometry
from rse_pf.geometry import Array, Camera
from rse_pf.pnp import evidence
from rse_pf.pnp.engines import Engine, engine_for, native_evidence
from rse_pf.pnp.options import PnpOptions, WeakLimits
from rse_pf.pnp.rules import PoseJudgement, too_few_matches

__all__ = ["PnpSolution", "solve_pnp"]

_MAX_ABS = 1e6
# Enough where half of the matches agree: a whole world that is mirrored, not a part of it.
_MIRROR_ITERATIONS = 50


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


_LAST_ROW = np.diag([0.0, 0.0, 0.0, 1.0])
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
    if engine == "native":
        return _solved_natively(points_world, pixels, camera, options, weak)  # which checks the numbers
    _check_numbers(points_world, pixels)
    propose = engine_for(engine)
    T_camera_world = _proposed(propose, points_world, pixels, camera, options)
    judgement = PoseJudgement(
        T_camera_world, points_world, pixels, camera, inlier_px=options.inlier_px, weak=weak
    )
    reason = _judge(judgement)
    assert T_camera_world is not None
    count = len(judgement.inliers)
    if count < weak.inlier_ratio * len(pixels):
        _refuse_mirrored(propose, points_world, pixels, camera, options, count)
    return PnpSolution(
        T_camera_world=T_camera_world,
        inliers=judgement.inliers,
        rmse_px=math.sqrt(judgement.squares_px2 / count),
        covariance=judgement.covariance,
        verdict="weak" if reason else "ok",
        reason=reason,
        engine=engine,
    )


def _judge(judgement: PoseJudgement) -> str:
    """Return why the pose is weak, "" if it is not; raises PnpError at the first rule that refuses it.

    The reason is the first weak rule that is broken, or ``ambiguous``, which outweighs the others.
    """
    reason = ""
    for rule, refusal in judgement.ask():
        if rule.is_kept:
            continue
        if refusal is not None:
            raise refusal()
        if not reason or rule.name == "ambiguous":
            reason = rule.name
    return reason


def _solved_natively(
    points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, weak: WeakLimits
) -> PnpSolution:
    """Return the pose and the evidence that the native core finds in one call."""
    found = native_evidence(points_world, pixels, camera, options, weak)
    return PnpSolution(
        T_camera_world=found.T_camera_world,
        inliers=found.inliers,
        rmse_px=found.rmse_px,
        covariance=found.covariance,
        verdict="weak" if found.reason else "ok",
        reason=found.reason,
        engine="native",
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
    if len(points) < 4:
        raise too_few_matches(len(points))
    return points, pixels


def _check_numbers(points: Array, pixels: Array) -> None:
    # vdot of a row of numbers with itself is their sum of squares; it overflows without a warning.
    if not (np.vdot(points, points) < _MAX_ABS**2 and np.vdot(pixels, pixels) < _MAX_ABS**2):
        for name, rows in (("points_world", points), ("pixels", pixels)):
            if not (np.abs(rows) <= _MAX_ABS).all():
                raise BadRequest(
                    f"{name} holds a number that is not finite or is beyond {_MAX_ABS:g}",
                    hint="leave such rows out",
                )


def _proposed(
    propose: Engine, points_world: Array, pixels: Array, camera: Camera, options: PnpOptions
) -> Array | None:
    """Return the engine's pose; a pose that is not finite agrees with no point and is refused later."""
    pose = propose(points_world, pixels, camera, options)
    if pose is None:
        return None
    T_camera_world: Array = _LAST_ROW.copy()
    T_camera_world[:3] = pose
    return T_camera_world


def _refuse_mirrored(
    propose: Engine, points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, count: int
) -> None:
    """Where most rows disagree, test whether the world is mirrored.

    The point reflection of a world projects alike, so points behind the camera and left-handed worlds are
    recognised by a far better pose of the reflected points.
    """
    reflected = -points_world
    few = msgspec.structs.replace(options, max_iterations=min(options.max_iterations, _MIRROR_ITERATIONS))
    T_camera_world = _proposed(propose, reflected, pixels, camera, few)
    if T_camera_world is None:
        return
    error2 = evidence.view_of(T_camera_world, reflected, pixels, camera)[evidence.ERROR2]
    better = int(np.count_nonzero(error2 <= options.inlier_px**2))
    if better >= 2 * count:
        raise DegenerateGeometry(
            f"{better} points agree behind the camera or mirrored, and only {count} as they are",
            hint="check the handedness of the world frame and the sign of the depth",
        )
