"""Find the place of one view among placed keyframes: a pose with its verdict and reason.

Each candidate proposes a placement by PnP and depth; placements that agree support each other, and one that
contradicts them makes the place ambiguous.  Which keyframes are candidates is decided elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rse_pf.errors import PnpError
from rse_pf.geometry import Array, adjoint, exp_se3, inverse, log_se3, pose_difference, transform
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp
from rse_pf.slam.camera_fit import CameraFit, fit_camera
from rse_pf.slam.relative_pose import (
    MeasuredPose,
    Reference,
    RelativePoseOptions,
    View,
    measure_pose,
    scale_between,
)

__all__ = ["LocalisationOptions", "Localised", "PlacedKeyframe", "localise", "spread_candidates"]

_MAX_LOG_FOCAL = 0.07  # logarithm of an adjusted focal length over the given one; good photos: up to 0.06
_MAX_CAMERA_STEP_M = 0.12  # between the poses of the given and the adjusted camera; good photos: up to 0.1
_MAX_CAMERA_TURN_DEG = 6.0  # between both; good photos with a rolling shutter: up to 5.1
_MAX_M = 1e6
"""A keyframe farther from the origin of its map than any robot drives is no rival for a place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalisationOptions:
    """When a placement counts, and when it is ok.

    Attributes:
        measured: Of matches; a pose is ok from its ``min_inliers`` and ``min_inlier_ratio`` on.
        least_inliers: A candidate with fewer proposes nothing.
        agree_m: Placements closer than this,
        agree_deg: and turned less than this, support each other.
        alone_inliers: One keyframe alone is enough from so many inliers on.
        rival: A contradicting placement with this share of the inliers makes a place ambiguous: where a room
            is unique, none was ever found.
        place_m: Candidates closer than this,
        place_deg: and turned less than this, are of one place,
        of_place: of which so many are compared.
        has_equal_rooms: Whether rooms may look the same; then a view, which shows less than a room, is never
            enough.
        fits_camera: Whether the camera of a view without depths may be wrong, as that of a photo.  Its pose
            then counts only if it agrees with the one that the best fitting camera has, and what lies between
            both is part of the covariance.
    """

    measured: RelativePoseOptions = field(default_factory=lambda: RelativePoseOptions(min_inliers=30))
    least_inliers: int = 15
    agree_m: float = 0.2
    agree_deg: float = 6.0
    alone_inliers: int = 80
    rival: float = 0.1
    place_m: float = 1.5
    place_deg: float = 45.0
    of_place: int = 4
    has_equal_rooms: bool = False
    fits_camera: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Localised:
    """Where a camera is in the map.

    ``verdict`` is ``ok``; ``weak`` with a reason ("ambiguous", "few-inliers", "low-inlier-ratio",
    "one-keyframe", "wrong-intrinsics", or one of PnP); or ``none`` with a reason ("no-candidates", "no-pose")
    and without a pose.
    ``covariance`` ``(6, 6)`` is of the twist (metres, radians) on the left of ``T_map_camera``.  ``inliers``,
    ``matches`` and ``rmse_px`` are those of the best keyframe; ``keyframes`` are the ids of those that agree,
    best first.  ``scale`` is how many metres the unit of the view's depths is, None if that is a metre;
    without it such a view is ``weak`` with the reason "no-scale".
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
class PlacedKeyframe:
    """A keyframe of a map that may show the view: its id, its points, and its ``(4, 4)`` pose in the map."""

    id: int
    reference: Reference
    T_map_keyframe: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Placement:
    """The pose of the view that one keyframe proposes, with its covariance on the right."""

    keyframe: int
    T_map_keyframe: Array
    T_map_camera: Array
    covariance: Array
    found: MeasuredPose


_DEFAULT = LocalisationOptions()


def localise(
    candidates: Sequence[PlacedKeyframe], view: View, options: LocalisationOptions = _DEFAULT
) -> Localised:
    """Return the place of *view* among *candidates*; deterministic.

    Args:
        candidates: Keyframes that look alike.  Those of one place say nothing against another one: give some
            of each place that looks alike.
        view: The image whose place is sought.
        options: When a placement is ok.

    Raises:
        MissingExtra: There is no matcher or no solver.
    """
    if not candidates:
        return Localised(verdict="none", reason="no-candidates")
    placements = []
    for candidate in candidates:
        if not (np.abs(candidate.T_map_keyframe[:3, 3]) <= _MAX_M).all():
            continue
        measured = measure_pose(candidate.reference, view, options.measured)
        if isinstance(measured, str) or measured.inliers < options.least_inliers:
            continue
        placements.append(
            _Placement(
                keyframe=candidate.id,
                T_map_keyframe=candidate.T_map_keyframe,
                T_map_camera=candidate.T_map_keyframe @ inverse(measured.solution.T_camera_world),
                covariance=measured.solution.covariance + options.measured.floor(),
                found=measured,
            )
        )
    if not placements:
        return Localised(verdict="none", reason="no-pose")
    placements.sort(key=lambda each: (-each.found.inliers, each.keyframe))
    best = placements[0]
    agreeing = [each for each in placements if _agree(each, best, options)]
    others = [each for each in placements if not _agree(each, best, options)]
    solution = best.found.solution
    T_map_camera, covariance = _fused(agreeing)
    if (view.depths_m is None or not view.is_metric) and len(agreeing) > 1:
        solution = _solved_together(agreeing, view, options)
        T_map_camera = best.T_map_keyframe @ inverse(solution.T_camera_world)
    reason = _weakness(agreeing, others, solution, options)
    if options.fits_camera and view.depths_m is None:
        fit = fit_camera(*_matches_of(agreeing), T_map_camera, view.camera)
        covariance = covariance + _uncertainty_of_camera(fit, T_map_camera)
        reason = reason or _camera_weakness(fit, T_map_camera)
    scale = None if view.is_metric else _scale_of(agreeing, options)
    if scale is None and not view.is_metric:
        reason = reason or "no-scale"
    return Localised(
        verdict="weak" if reason else "ok", reason=reason, T_map_camera=T_map_camera, covariance=covariance,
        inliers=best.found.inliers, matches=best.found.matches, rmse_px=best.found.solution.rmse_px,
        keyframes=tuple(each.keyframe for each in agreeing), scale=scale,
    )  # fmt: skip


def spread_candidates(
    found: Sequence[tuple[int, float]],
    T_map_camera: Array,
    count: int,
    options: LocalisationOptions = _DEFAULT,
) -> list[int]:
    """Return up to *count* ids of *found* (best first), only a few of each place.

    So a second place that looks alike is compared, too, though the first one has more keyframes.

    Args:
        found: Ids and similarities, of about six times *count* keyframes.
        T_map_camera: ``(n, 4, 4)``, by id.
        count: How many to compare.
        options: What is one place.
    """
    chosen: list[int] = []
    least_trace = 1.0 + 2.0 * math.cos(math.radians(options.place_deg))
    for number, _ in found:
        here, others = T_map_camera[number], T_map_camera[chosen]
        near = np.linalg.norm(others[:, :3, 3] - here[:3, 3], axis=1) <= options.place_m
        near &= np.einsum("kij,ij->k", others[:, :3, :3], here[:3, :3]) >= least_trace
        if np.count_nonzero(near) < options.of_place:
            chosen.append(number)
        if len(chosen) == count:
            break
    return chosen


def _scale_of(placements: Sequence[_Placement], options: LocalisationOptions) -> float | None:
    """Return how long the unit of the view is in that of placements that agree, None if none tells."""
    measured = [scale_between(each.found, options.measured) for each in placements]
    known = [each for each in measured if each is not None]
    if not known:
        return None
    weights = np.array([1.0 / each.variance for each in known])
    return math.exp(float(weights @ [each.log_ratio for each in known] / weights.sum()))


def _matches_of(placements: Sequence[_Placement]) -> tuple[Array, Array, Array]:
    """Return all matches, agreeing or not: points of the map, the places of their keyframes, and pixels."""
    points = [transform(each.T_map_keyframe, each.found.points_reference) for each in placements]
    origins = [np.tile(each.T_map_keyframe[:3, 3], (each.found.matches, 1)) for each in placements]
    pixels = [each.found.pixels for each in placements]
    return np.concatenate(points), np.concatenate(origins), np.concatenate(pixels)


def _uncertainty_of_camera(fit: CameraFit, T_map_camera: Array) -> Array:
    """Return the ``(6, 6)`` covariance that an unknown error of the camera adds to the pose."""
    moved = log_se3((fit.T_map_camera @ inverse(T_map_camera))[None])[0]
    covariance: Array = np.outer(moved, moved) + fit.covariance
    return covariance


def _camera_weakness(fit: CameraFit, T_map_camera: Array) -> str:
    """Return "wrong-intrinsics" if the matches contradict the camera of the view, else "".

    What the matches leave undetermined, such as the focal length before a flat wall, contradicts nothing.
    """
    moved_m, turned_deg = pose_difference(fit.T_map_camera, T_map_camera)
    is_contradicted = (
        abs(fit.log_focal) > _MAX_LOG_FOCAL + fit.log_focal_deviation
        or moved_m > _MAX_CAMERA_STEP_M + fit.position_deviation_m
        or turned_deg > _MAX_CAMERA_TURN_DEG + fit.turn_deviation_deg
    )
    return "wrong-intrinsics" if is_contradicted else ""


def _agree(one: _Placement, other: _Placement, options: LocalisationOptions) -> bool:
    metres, degrees = pose_difference(one.T_map_camera, other.T_map_camera)
    return metres <= options.agree_m and degrees <= options.agree_deg


def _weakness(
    agreeing: Sequence[_Placement],
    others: Sequence[_Placement],
    solution: PnpSolution,
    options: LocalisationOptions,
) -> str:
    """Return why the placement of *agreeing* (best first), solved as *solution*, is not ok, "" if it is."""
    best = agreeing[0].found
    if options.has_equal_rooms:
        return "ambiguous"
    rival = max((each.found.inliers for each in others if not each.found.solution.reason), default=0)
    if rival and rival >= options.rival * best.inliers:
        return "ambiguous"
    if best.inliers < options.measured.min_inliers:
        return "few-inliers"
    if best.inliers < options.measured.min_inlier_ratio * best.matches:
        return "low-inlier-ratio"
    if solution.reason:
        return solution.reason
    if len(agreeing) < 2 and best.inliers < options.alone_inliers:
        return "one-keyframe"
    return ""


def _solved_together(
    placements: Sequence[_Placement], view: View, options: LocalisationOptions
) -> PnpSolution:
    """Return the solution that fits the inliers of all *placements*, or that of the first one.

    It is relative to the first keyframe.  Without depths a pose of one keyframe is no more exact than its few
    pixels; each has its own.
    """
    best = placements[0]
    T_best_map = inverse(best.T_map_keyframe)
    points, pixels = [], []
    for placement in placements:
        inliers = placement.found.solution.inliers
        T_best_keyframe = T_best_map @ placement.T_map_keyframe
        points.append(transform(T_best_keyframe, placement.found.points_reference[inliers]))
        pixels.append(placement.found.pixels[inliers])
    try:
        return solve_pnp(
            np.concatenate(points), np.concatenate(pixels), view.camera,
            PnpOptions(inlier_px=options.measured.inlier_px),
        )  # fmt: skip
    except PnpError:
        return best.found.solution


def _fused(placements: Sequence[_Placement]) -> tuple[Array, Array]:
    """Return the mean of placements that agree, weighted by their information, and its covariance.

    Keyframes that lie together share the errors of the map, so the covariance is that of the best one.
    """
    best = placements[0]
    back = inverse(best.T_map_camera)
    twists = log_se3(np.array([back @ each.T_map_camera for each in placements]))
    information = np.array([np.linalg.inv(each.covariance) for each in placements])
    twist = np.linalg.solve(information.sum(axis=0), np.einsum("kij,kj->i", information, twists))
    T_map_camera: Array = best.T_map_camera @ exp_se3(twist)
    to_map = adjoint(T_map_camera)
    covariance: Array = to_map @ best.covariance @ to_map.T
    return T_map_camera, 0.5 * (covariance + covariance.T)
