"""Localise a camera among keyframes of a map: return its pose with a verdict and a reason.

The candidates are keyframes that place recognition proposes.  For each candidate, the pose of the view is
estimated by PnP from matches of the candidate's landmarks, and refined with the depths of the view if it has
metric ones.  Estimates that agree confirm each other.  An estimate elsewhere with many inliers makes the
result ambiguous, because two parts of the world then look alike (perceptual aliasing).  A view without depths
may be localised a second time with all landmarks around its first pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, PnpError
from rse_pf.geometry import Array, adjoint, exp_se3, inverse, log_se3, pose_difference, rigid, transform
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp
from rse_pf.slam.camera_fit import CameraFit, fit_camera
from rse_pf.slam.guided_search import MapLandmarks, search_around
from rse_pf.slam.relative_pose import (
    Landmarks,
    MeasuredPose,
    RelativePoseOptions,
    View,
    measure_pose,
    measure_scale_ratio,
)

__all__ = [
    "LocalisationCandidate",
    "LocalisationOptions",
    "Localised",
    "PosePrior",
    "is_in_region",
    "localise",
    "spread_candidates",
]

_MAX_LOG_FOCAL = 0.07
"""Largest absolute natural logarithm of the quotient of fitted and stated focal length at which the stated
camera is accepted; for photos with a right camera it is below 0.06."""
_MAX_CAMERA_STEP_M = 0.12
"""Largest distance between the poses of the fitted and of the stated camera at which the stated camera is
accepted; photos with a right camera stay below 0.1 m."""
_MAX_CAMERA_ROTATION_DEG = 6.0
"""Largest rotation between the poses of the fitted and of the stated camera at which the stated camera is
accepted; photos with a right camera and a rolling shutter stay below 5.1 degrees."""
_MAX_MAP_COORDINATE_M = 1e6
"""Largest coordinate in metres of a candidate keyframe in the map.  A keyframe beyond it has a false pose,
since no robot drives 1,000 km; it is ignored, so that it does not make the pose of the view ambiguous."""
_MIN_CAMERA_WEIGHT = 0.4
"""Smallest factor of the covariance that unknown intrinsics add to that of a pose.  It is below 1 because
most stated intrinsics are right: with 1, nearly all errors of photos with a right camera are within one
standard deviation.  It is above 0.25 because the fitted focal length may err by as much as the stated one, so
that both agree."""
_DOUBTED_FOCAL_DEVIATIONS = 3.0
"""Difference of fitted and stated focal length, in standard deviations, from which on that factor is 1."""
_GUIDED_FLOOR_M = 0.002
"""Standard deviation along each axis, in metres, of the error that all landmarks around a pose have in
common; its square is added to the variance of a guided search."""
_GUIDED_FLOOR_DEG = 0.3
"""Standard deviation about each axis, in degrees, of the error that all landmarks around a pose have in
common; its square is added to the variance of a guided search."""
_MAX_PRIOR_SIGMAS = 3.0
"""Largest distance of an expected pose from its prior, in standard deviations."""
_PRIOR_MARGIN_M = 0.2
"""Standard deviation along each axis, in metres, that is added to a prior: a planar one states none of the
height."""
_PRIOR_MARGIN_DEG = 5.0  # standard deviation about each axis, in degrees, that is added to a prior
_MAX_PRIOR_VARIANCE = 1e12  # largest element of the covariance of a prior, m^2: larger than any map
_MAX_PRIOR_ROUNDING = 1e-6  # largest negative eigenvalue of a covariance that counts as rounding
_MIN_EXPECTED_SHARE = 0.5
"""An estimate near the prior is preferred if it has at least this share of the inliers of the best one: equal
places give nearly equal numbers, a wrong prior a small one."""
_FEW_MATCHES = ("few-inliers", "low-inlier-ratio", "one-keyframe")
"""Reasons that concern the matches of single keyframes; they do not hold for the pose of a guided search that
is sure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalisationOptions:
    """Conditions under which the pose of a view is accepted.

    Attributes:
        relative_pose: Limits for matches of a candidate.  The verdict is ok only if the best estimate has at
            least its ``min_inliers`` and its ``min_inlier_ratio``.
        min_candidate_inliers: The estimate of a candidate with fewer inliers is dropped.
        agree_m: Largest distance between two estimates that agree.
        agree_deg: Largest rotation between two estimates that agree.
        min_single_inliers: Fewest inliers of the best estimate with which the verdict may be ok although no
            other estimate agrees with it.
        rival_ratio: The pose is ambiguous if an estimate disagrees with the best one, is not weak by the
            rules of PnP, and has at least this share of the inliers of the best one.  In recordings of
            environments without repetition there was never such an estimate.
        region_m: Largest distance between two keyframes that count as of one region.
        region_deg: Largest rotation between two keyframes that count as of one region.
        max_per_region: Largest number of candidates of one region that are compared.
        has_equal_rooms: Whether the map may have rooms that look alike.  The verdict is then never ok, and
            the reason is "ambiguous": a view shows less than a room, and so cannot tell the rooms apart.
        fits_camera: Whether to fit a camera to the matches of a view without depths, because its stated
            intrinsics may be wrong, as those of a photo.  The verdict is then ok only if the fitted camera
            has nearly the stated focal length and nearly the same pose, and the covariance includes a share
            of the squared difference of both poses.
    """

    relative_pose: RelativePoseOptions = field(default_factory=lambda: RelativePoseOptions(min_inliers=30))
    min_candidate_inliers: int = 15
    agree_m: float = 0.2
    agree_deg: float = 6.0
    min_single_inliers: int = 80
    rival_ratio: float = 0.1
    region_m: float = 1.5
    region_deg: float = 45.0
    max_per_region: int = 4
    has_equal_rooms: bool = False
    fits_camera: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePrior:
    """Where a camera is expected to be, such as an operator says.

    Attributes:
        T_map_camera: ``(4, 4)``, metres.
        covariance: ``(6, 6)`` of position (metres) and rotation (radians) about the axes of the map.

    Raises:
        BadRequest: The pose is no rigid motion, or the covariance is not positive semidefinite.
    """

    T_map_camera: Array
    covariance: Array

    def __post_init__(self) -> None:
        T, covariance = rigid(self.T_map_camera), self.covariance
        is_bounded = bool((np.abs(covariance) <= _MAX_PRIOR_VARIANCE).all())
        if T is None or not is_bounded or np.linalg.eigvalsh(covariance)[0] < -_MAX_PRIOR_ROUNDING:
            raise BadRequest(
                "the prior is no rigid motion with a positive semidefinite covariance",
                hint="send a pose in the map, and the covariance of its position and rotation",
            )
        object.__setattr__(self, "T_map_camera", T)  # a frozen dataclass allows no other way

    def contains(
        self, T_map_cameras: Array, reach_m: float = 0.0, reach_deg: float = 0.0
    ) -> npt.NDArray[np.bool_]:
        """Return ``(n,)``, whether each pose ``(n, 4, 4)`` is within 3 standard deviations of this one.

        The reaches enlarge these distances, in quadrature: a camera there may see what is expected here.
        """
        turns = log_se3(T_map_cameras @ inverse(self.T_map_camera))[:, 3:]
        apart = np.hstack((T_map_cameras[:, :3, 3] - self.T_map_camera[:3, 3], turns))
        variance_m2 = _PRIOR_MARGIN_M**2 + (reach_m / _MAX_PRIOR_SIGMAS) ** 2
        variance_deg2 = _PRIOR_MARGIN_DEG**2 + (reach_deg / _MAX_PRIOR_SIGMAS) ** 2
        covariance = self.covariance + np.diag(
            [variance_m2] * 3 + [math.radians(1.0) ** 2 * variance_deg2] * 3
        )
        sigmas2 = np.einsum("ni,ni->n", apart, np.linalg.solve(covariance, apart.T).T)
        is_within: npt.NDArray[np.bool_] = sigmas2 <= _MAX_PRIOR_SIGMAS**2
        return is_within


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Localised:
    """The pose of a camera in a map, with its quality.

    Attributes:
        verdict: ``ok``; ``weak``, a pose that must not be trusted; or ``none``, no pose.
        reason: Why the verdict is not ``ok``.  For ``weak``: "ambiguous", "few-inliers", "low-inlier-ratio",
            "one-keyframe", "wrong-intrinsics", "no-scale", or a reason of PnP.  For ``none``: "no-candidates"
            or "no-pose".
        T_map_camera: ``(4, 4)``, metres; None if the verdict is ``none``.
        covariance: ``(6, 6)`` of the twist (metres, radians) on the left of ``T_map_camera``; None if the
            verdict is ``none``.
        inliers: Number of inliers of the best keyframe, which is the candidate with most inliers, also if the
            pose was computed from several keyframes, or by a guided search.
        matches: Number of matches of the best keyframe.
        rmse_px: Root mean square reprojection error of the inliers of the best keyframe, at its own estimate.
        keyframes: Ids of the keyframes whose estimates agree, the one with most inliers first.
        scale: Length in metres of the unit of the view's depths; None if the depths are metric, or if the
            scale is unknown (verdict ``weak``, reason "no-scale").
    """

    verdict: Literal["ok", "weak", "none"]
    reason: str = ""
    T_map_camera: Array | None = None
    covariance: Array | None = None
    inliers: int = 0
    matches: int = 0
    rmse_px: float = 0.0
    keyframes: tuple[int, ...] = ()
    scale: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalisationCandidate:
    """The landmarks of a keyframe that may show the same place as the view, with its id and pose in the map.

    Attributes:
        id: Id of the keyframe in the map.
        landmarks: The landmarks of the keyframe, in the frame of its camera.
        T_map_keyframe: ``(4, 4)``, metres.
    """

    id: int
    landmarks: Landmarks
    T_map_keyframe: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Estimate:
    """The pose of the view that one keyframe estimates.

    The covariance ``(6, 6)`` is of the twist (metres, radians) on the right of ``T_map_camera``.
    """

    keyframe: int
    T_map_keyframe: Array
    T_map_camera: Array
    covariance: Array
    measured: MeasuredPose


_DEFAULT = LocalisationOptions()


def localise(
    candidates: Sequence[LocalisationCandidate],
    view: View,
    options: LocalisationOptions = _DEFAULT,
    *,
    landmarks_around: Callable[[Array, Sequence[int]], MapLandmarks] | None = None,
    prior: PosePrior | None = None,
) -> Localised:
    """Return the pose of *view* in the map of *candidates*; deterministic.

    Args:
        candidates: Keyframes that place recognition proposes.  They should show all regions that look like
            the view, see `spread_candidates`: candidates of one region cannot reveal another one that looks
            alike.
        view: The image whose pose is estimated.
        options: Conditions under which the pose is ok.
        landmarks_around: Returns the landmarks of the map around a pose ``(4, 4)``, also those of the given
            ids of candidates.  With it, the pose of a view without depths is that of a guided search if this
            finds one, see `search_around`; None for no such search.
        prior: Where the camera is expected.  A pose there needs half of the inliers, or agreeing keyframes or
            30 of them, and other places that look alike do not make it ambiguous unless they have twice as
            many.  A pose elsewhere is accepted as without a prior.

    Raises:
        BadRequest: The descriptors of a candidate and of the view are of different kinds.
        MissingExtra: The native core is not installed.
    """
    if not candidates:
        return Localised(verdict="none", reason="no-candidates")
    # 1. Estimate the pose of the view with each candidate.
    estimates = _estimate_poses(candidates, view, options)
    if not estimates:
        return Localised(verdict="none", reason="no-pose")
    if prior is not None:
        estimates, options = _prefer_expected(estimates, prior, options)
    # 2. Divide the estimates into those that agree with the best one, which has most inliers, and the others.
    best = estimates[0]
    agreeing = [estimate for estimate in estimates if _do_agree(estimate, best, options)]
    contradicting = [estimate for estimate in estimates if not _do_agree(estimate, best, options)]
    # 3. Take the mean of the agreeing poses, and the covariance of the best one.  For a view without metric
    # depths, replace the mean, but not the covariance, by the pose that PnP computes from the inliers of all
    # agreeing estimates together.
    solution = best.measured.solution
    T_map_camera, covariance = _fuse_estimates(agreeing)
    if (view.depths_m is None or not view.is_metric) and len(agreeing) > 1:
        solution = _solve_jointly(agreeing, view, options)
        T_map_camera = best.T_map_keyframe @ inverse(solution.T_camera_world)
    # 4. Find the first reason not to trust the pose.
    reason = _weakness(agreeing, contradicting, solution, options)
    # 5. Search again around the pose.  If the landmarks around it confirm it together, it does not matter
    # that single keyframes have few matches.
    guided = None
    if landmarks_around is not None and view.depths_m is None:
        guided = search_around(
            T_map_camera,
            landmarks_around(T_map_camera, [estimate.keyframe for estimate in agreeing]),
            view,
            min_inliers=max(options.min_candidate_inliers, best.measured.inliers // 2),
            inlier_px=options.relative_pose.inlier_px,
        )
    if guided is not None:
        T_map_camera = guided.T_map_camera
        covariance = guided.covariance + _guided_floor(T_map_camera)
        if reason in _FEW_MATCHES and guided.is_sure:
            reason = ""
    # 6. Enlarge the covariance if the camera may be wrong.  The camera is fitted to the matches of the first
    # pose, since a guided search finds only those that suit the stated camera.
    if options.fits_camera and view.depths_m is None:
        fit = fit_camera(*_collect_matches(agreeing), T_map_camera, view.camera)
        covariance = covariance + _camera_covariance(fit, T_map_camera)
        reason = reason or _camera_weakness(fit, T_map_camera)
    scale = None if view.is_metric else _estimate_scale(agreeing, options)
    if scale is None and not view.is_metric:
        reason = reason or "no-scale"
    return Localised(
        verdict="weak" if reason else "ok",
        reason=reason,
        T_map_camera=T_map_camera,
        covariance=covariance,
        inliers=best.measured.inliers,
        matches=best.measured.matches,
        rmse_px=best.measured.solution.rmse_px,
        keyframes=tuple(estimate.keyframe for estimate in agreeing),
        scale=scale,
    )


def spread_candidates(
    similar: Sequence[tuple[int, float]],
    T_map_camera: Array,
    count: int,
    options: LocalisationOptions = _DEFAULT,
) -> list[int]:
    """Return the ids of up to *count* similar keyframes, with a limited number from each region of the map.

    A second region that looks like the first one is then compared as well, though the first region may have
    more keyframes.

    Args:
        similar: Ids and similarities of keyframes from place recognition, the most similar first; about six
            times *count* of them leave a choice.
        T_map_camera: ``(n, 4, 4)``, the poses of all keyframes, indexed by their ids.
        count: The largest number of candidates.
        options: The size of a region, and the number of candidates from each.
    """
    candidates: list[int] = []
    for number, _ in similar:
        is_near = is_in_region(T_map_camera[candidates], T_map_camera[number], options)
        if np.count_nonzero(is_near) < options.max_per_region:
            candidates.append(number)
        if len(candidates) == count:
            break
    return candidates


def is_in_region(
    T_map_keyframes: Array, T_map_camera: Array, options: LocalisationOptions
) -> npt.NDArray[np.bool_]:
    """Return ``(n,)``, whether each of the poses ``(n, 4, 4)`` is of one region with a pose ``(4, 4)``."""
    # The trace of a rotation matrix is 1 + 2 cos(angle).
    min_trace = 1.0 + 2.0 * math.cos(math.radians(options.region_deg))
    distances_m = np.linalg.norm(T_map_keyframes[:, :3, 3] - T_map_camera[:3, 3], axis=1)
    traces = np.einsum("kij,ij->k", T_map_keyframes[:, :3, :3], T_map_camera[:3, :3])
    is_in: npt.NDArray[np.bool_] = (distances_m <= options.region_m) & (traces >= min_trace)
    return is_in


def _estimate_poses(
    candidates: Sequence[LocalisationCandidate], view: View, options: LocalisationOptions
) -> list[_Estimate]:
    """Return the estimates of all candidates with enough inliers, the one with most inliers first."""
    estimates = []
    for candidate in candidates:
        if not (np.abs(candidate.T_map_keyframe[:3, 3]) <= _MAX_MAP_COORDINATE_M).all():
            continue
        measured = measure_pose(candidate.landmarks, view, options.relative_pose)
        if isinstance(measured, str) or measured.inliers < options.min_candidate_inliers:
            continue
        estimates.append(
            _Estimate(
                keyframe=candidate.id,
                T_map_keyframe=candidate.T_map_keyframe,
                T_map_camera=candidate.T_map_keyframe @ inverse(measured.solution.T_camera_world),
                covariance=measured.solution.covariance + options.relative_pose.min_covariance(),
                measured=measured,
            )
        )
    return sorted(estimates, key=lambda estimate: (-estimate.measured.inliers, estimate.keyframe))


def _prefer_expected(
    estimates: list[_Estimate], prior: PosePrior, options: LocalisationOptions
) -> tuple[list[_Estimate], LocalisationOptions]:
    """Return the estimates near the prior, and options that ask for less evidence.

    Return the arguments if no estimate is near the prior, or if it has too few inliers beside the best one.
    """
    is_expected = prior.contains(np.array([estimate.T_map_camera for estimate in estimates]))
    expected = [estimate for estimate, is_near in zip(estimates, is_expected, strict=True) if is_near]
    if not expected or (expected[0].measured.inliers < _MIN_EXPECTED_SHARE * estimates[0].measured.inliers):
        return estimates, options
    min_inliers = options.relative_pose.min_inliers
    return expected, replace(
        options,
        relative_pose=replace(options.relative_pose, min_inliers=min_inliers // 2),
        min_single_inliers=min_inliers,
    )


def _estimate_scale(estimates: Sequence[_Estimate], options: LocalisationOptions) -> float | None:
    """Return the length, in metres, of the unit of the view's depths; None if no estimate gives it.

    The logarithms of the estimates' scales are averaged, weighted by their inverse variances.
    """
    ratios = [measure_scale_ratio(estimate.measured, options.relative_pose) for estimate in estimates]
    known = [ratio for ratio in ratios if ratio is not None]
    if not known:
        return None
    weights = np.array([1.0 / ratio.variance for ratio in known])
    return math.exp(float(weights @ [ratio.log_ratio for ratio in known] / weights.sum()))


def _collect_matches(estimates: Sequence[_Estimate]) -> tuple[Array, Array, Array]:
    """Return all *k* matches of *estimates*, inliers and outliers.

    Returns:
        Landmarks ``(k, 3)`` in the map, the positions ``(k, 3)`` of the cameras of their keyframes in the
        map, and pixels ``(k, 2)`` in the view.
    """
    points = [transform(e.T_map_keyframe, e.measured.points_keyframe) for e in estimates]
    origins = [np.tile(e.T_map_keyframe[:3, 3], (e.measured.matches, 1)) for e in estimates]
    pixels = [e.measured.pixels for e in estimates]
    return np.concatenate(points), np.concatenate(origins), np.concatenate(pixels)


def _guided_floor(T_map_camera: Array) -> Array:
    """Return the ``(6, 6)`` covariance (metres, radians) that is added to that of a guided search.

    It is of the twist on the left of *T_map_camera*.
    """
    floor = np.diag([_GUIDED_FLOOR_M**2] * 3 + [math.radians(_GUIDED_FLOOR_DEG) ** 2] * 3)
    to_map = adjoint(T_map_camera)
    floor_map: Array = to_map @ floor @ to_map.T
    return floor_map


def _camera_covariance(fit: CameraFit, T_map_camera: Array) -> Array:
    """Return the ``(6, 6)`` covariance that an unknown error of the intrinsics adds to that of a pose.

    It is of the twist on the left of *T_map_camera*: the outer product of the difference between the fitted
    and the given pose, plus the covariance of the fitted one, both times a weight.  The weight grows with the
    difference between fitted and stated focal length.
    """
    doubt = abs(fit.log_focal) / (_DOUBTED_FOCAL_DEVIATIONS * fit.log_focal_deviation)
    weight = min(1.0, max(_MIN_CAMERA_WEIGHT, doubt**2))
    difference = log_se3((fit.T_map_camera @ inverse(T_map_camera))[None])[0]
    return weight * (np.outer(difference, difference) + fit.covariance)


def _camera_weakness(fit: CameraFit, T_map_camera: Array) -> str:
    """Return "wrong-intrinsics" if the matches contradict the intrinsics of the view, else "".

    They contradict if focal length, position or rotation of the fitted camera differ from the stated ones by
    more than a limit plus one standard deviation.  A quantity that the matches do not determine, such as the
    focal length in front of a flat wall, has a large standard deviation, and so is not contradicted.
    """
    moved_m, rotated_deg = pose_difference(fit.T_map_camera, T_map_camera)
    is_contradicted = (
        abs(fit.log_focal) > _MAX_LOG_FOCAL + fit.log_focal_deviation
        or moved_m > _MAX_CAMERA_STEP_M + fit.position_deviation_m
        or rotated_deg > _MAX_CAMERA_ROTATION_DEG + fit.turn_deviation_deg
    )
    return "wrong-intrinsics" if is_contradicted else ""


def _do_agree(a: _Estimate, b: _Estimate, options: LocalisationOptions) -> bool:
    metres, degrees = pose_difference(a.T_map_camera, b.T_map_camera)
    return metres <= options.agree_m and degrees <= options.agree_deg


def _weakness(
    agreeing: Sequence[_Estimate],
    contradicting: Sequence[_Estimate],
    solution: PnpSolution,
    options: LocalisationOptions,
) -> str:
    """Return the reason why a pose must not be trusted, "" if it can be.

    Args:
        agreeing: The best estimate and those that agree with it, the best first.
        contradicting: The other estimates.
        solution: The PnP solution of the pose.
        options: Conditions under which the pose is ok.
    """
    best = agreeing[0].measured
    if options.has_equal_rooms:
        return "ambiguous"
    rivals = [e.measured.inliers for e in contradicting if not e.measured.solution.reason]
    if rivals and max(rivals) >= options.rival_ratio * best.inliers:
        return "ambiguous"
    if best.inliers < options.relative_pose.min_inliers:
        return "few-inliers"
    if best.inliers < options.relative_pose.min_inlier_ratio * best.matches:
        return "low-inlier-ratio"
    if solution.reason:
        return solution.reason
    if len(agreeing) < 2 and best.inliers < options.min_single_inliers:
        return "one-keyframe"
    return ""


def _solve_jointly(estimates: Sequence[_Estimate], view: View, options: LocalisationOptions) -> PnpSolution:
    """Solve PnP with the inliers of all *estimates*, in the frame of the keyframe of the first one.

    Without depths this is more accurate than the pose of one keyframe, since each has inliers of its own.

    Returns:
        The solution of the first estimate if the joint problem has none.
    """
    best = estimates[0]
    T_best_map = inverse(best.T_map_keyframe)
    points, pixels = [], []
    for estimate in estimates:
        inliers = estimate.measured.solution.inliers
        T_best_keyframe = T_best_map @ estimate.T_map_keyframe
        points.append(transform(T_best_keyframe, estimate.measured.points_keyframe[inliers]))
        pixels.append(estimate.measured.pixels[inliers])
    try:
        return solve_pnp(
            np.concatenate(points),
            np.concatenate(pixels),
            view.camera,
            PnpOptions(inlier_px=options.relative_pose.inlier_px),
        )
    except PnpError:
        return best.measured.solution


def _fuse_estimates(estimates: Sequence[_Estimate]) -> tuple[Array, Array]:
    """Return the mean pose of agreeing estimates, weighted by their information, and its covariance.

    The covariance is that of the best estimate, not a smaller one: neighbouring keyframes have the errors of
    the map in common.  It is of the twist on the left of the pose.
    """
    best = estimates[0]
    # 1. Average the twists from the best pose to all poses, and move the best pose by the mean twist.
    T_camera_map = inverse(best.T_map_camera)
    twists = log_se3(np.array([T_camera_map @ estimate.T_map_camera for estimate in estimates]))
    information = np.array([np.linalg.inv(estimate.covariance) for estimate in estimates])
    twist = np.linalg.solve(information.sum(axis=0), np.einsum("kij,kj->i", information, twists))
    T_map_camera: Array = best.T_map_camera @ exp_se3(twist)
    # 2. Convert the covariance of the twist on the right of the pose to that of the twist on its left.
    to_left = adjoint(T_map_camera)
    covariance: Array = to_left @ best.covariance @ to_left.T
    return T_map_camera, 0.5 * (covariance + covariance.T)
