"""The relative pose of two views: matches, PnP, depth, and whether the result is a link.

Which views to compare, and which links to believe, is decided elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rse_pf.errors import PnpError
from rse_pf.geometry import Array, Camera, adjoint, inverse, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.maps.format import Keyframe
from rse_pf.pnp import DepthNoise, PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.slam.descriptors import best_matches

__all__ = [
    "MeasuredPose",
    "MeasuredScale",
    "Reference",
    "RelativePose",
    "RelativePoseOptions",
    "View",
    "match_points",
    "match_rows",
    "measure_inverse_link",
    "measure_link",
    "measure_pose",
    "reference_of",
    "scale_between",
    "view_of_keyframe",
]

_KINECT = DepthNoise()
_MAX_POINT_M = 1e5
"""No point of a keyframe is further away; PnP refuses all matches for one that is."""
_NEAREST_M, _FARTHEST_M = 0.01, 100.0
"""Depths that a depth camera may measure; the depth of anything else is left out."""
_MIN_RATIOS = 12
"""Points with a depth in both keyframes from which on they tell a scale."""
_MAX_RATIO_SPREAD = 0.15
"""Deviation of the logarithms of the depths' ratios beyond which they tell none."""
_SCALE_FLOOR = 0.01
"""Smallest deviation of the logarithm of a scale: errors of landmarks of one keyframe are correlated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePoseOptions:
    """Limits of matches and inliers; the defaults were measured on the red-kitchen recording."""

    ratio: float = 0.75
    inlier_px: float = 3.0
    max_matches: int = 700
    min_matches: int | None = None
    """Fewer matches are not solved; None: half of ``min_inliers``."""
    min_inliers: int = 40
    min_inlier_ratio: float = 0.5
    floor_m: float = 0.02
    floor_deg: float = 0.7
    """Smallest standard deviations for each axis: errors of depth and calibration are correlated."""
    weak_variance: float = 0.0
    """A pose that its evidence calls weak is a link with so many times its covariance; 0: it is none."""

    def floor(self) -> Array:
        """Return the ``(6, 6)`` covariance that every measured pose has at least."""
        return np.diag([self.floor_m**2] * 3 + [math.radians(self.floor_deg) ** 2] * 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A camera image: ``(n, 2)`` undistorted pixels with their ``(n, d)`` descriptors of any kind.

    ``depths_m``, if there are any, are the ``(n,)`` depths at the pixels with their ``noise``, 0 where there
    is none.  They are in another unit than those of other views unless the view ``is_metric``.
    """

    camera: Camera
    pixels: Array
    descriptors: Descriptors
    depths_m: Array | None = None
    noise: DepthNoise = _KINECT
    is_metric: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """Points of a keyframe that are sought in other images: ``(n, 3)`` metres, camera frame, finite.

    ``descriptors`` ``(n, d)`` has one row for each point.
    """

    points_camera: Array
    descriptors: Descriptors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredPose:
    """``T_view_reference`` by PnP and depth, and the matches it was found among.

    ``points_reference`` ``(k, 3)`` are metres, in the frame of the reference; ``pixels`` ``(k, 2)`` and
    ``depths_view`` ``(k,)``, 0 where there is none, are those of the view.  ``depth_ratio`` is how long a
    metre of the view is in those of the reference, by the pose that pixels alone give.
    """

    solution: PnpSolution
    points_reference: Array
    pixels: Array
    depths_view: Array
    depth_ratio: MeasuredScale | None = None

    @property
    def matches(self) -> int:
        """The number of matches."""
        return len(self.pixels)

    @property
    def inliers(self) -> int:
        """The number of matches that agree."""
        return len(self.solution.inliers)


@dataclass(frozen=True, slots=True)
class MeasuredScale:
    """The logarithm of how long the unit of one keyframe is in that of another, and its variance."""

    log_ratio: float
    variance: float

    @property
    def inverse(self) -> MeasuredScale:
        """How long the unit of the other keyframe is in that of the one."""
        return MeasuredScale(-self.log_ratio, self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePose:
    """``T_a_b`` between two keyframes, its ``(6, 6)`` information, and the number of inliers and matches.

    The information is the inverse covariance of the twist (metres, radians) in
    ``log(inverse(T_a_b) @ T_a_b_true)``.  ``scale``, where the keyframes have different units, is that of the
    unit of *b* in the unit of *a*; ``depth_ratio`` how long a metre of one is in those of the other, where
    both claim metres.
    """

    T_a_b: Array
    information: Array
    inliers: int
    matches: int
    scale: MeasuredScale | None = None
    depth_ratio: MeasuredScale | None = None


_DEFAULT = RelativePoseOptions()


def reference_of(keyframe: Keyframe) -> Reference:
    """Return the features of *keyframe* that have a usable point: one absurd row must not cost the others."""
    # Not a number is "no depth".
    usable = np.flatnonzero((np.abs(keyframe.points_camera) <= _MAX_POINT_M).all(axis=1))
    return Reference(
        points_camera=keyframe.points_camera[usable].astype(np.float64),
        descriptors=keyframe.descriptors[usable],
    )


def view_of_keyframe(keyframe: Keyframe) -> View:
    """Return the image of *keyframe*, with the depths that a depth camera could have measured."""
    depths_m = keyframe.points_camera[:, 2].astype(np.float64)
    usable = (depths_m >= _NEAREST_M) & (depths_m <= _FARTHEST_M)
    return View(
        camera=keyframe.camera,
        pixels=keyframe.pixels.astype(np.float64),
        descriptors=keyframe.descriptors,
        depths_m=np.where(usable, depths_m, 0.0),
    )


def measure_link(
    reference: Reference, view: View, options: RelativePoseOptions = _DEFAULT
) -> RelativePose | str:
    """Return the pose of *view* (b) relative to *reference* (a) as a link; deterministic.

    Returns:
        The relative pose, or the reason why there is none: "no-matches", "no-pose", "few-inliers",
        "low-inlier-ratio", "no-scale" where the view is not metric and the depths of both do not tell a
        ratio, or the reason why the pose is weak, unless weak poses are links.
    """
    measured = measure_pose(reference, view, options)
    if isinstance(measured, str):
        return measured
    if measured.inliers < options.min_inliers:
        return "few-inliers"
    if measured.inliers < options.min_inlier_ratio * measured.matches:
        return "low-inlier-ratio"
    weak = measured.solution.reason
    if weak and not options.weak_variance:
        return weak
    scale = None if view.is_metric else scale_between(measured, options)
    if scale is None and not view.is_metric:
        return "no-scale"
    variance = options.weak_variance if weak else 1.0
    # T_b_a true = exp(xi) T_b_a, and its inverse has exp(-xi) on its right: the same covariance.
    information = np.linalg.inv(variance * measured.solution.covariance + options.floor())
    return RelativePose(
        T_a_b=inverse(measured.solution.T_camera_world),
        information=0.5 * (information + information.T),
        inliers=measured.inliers,
        matches=measured.matches,
        scale=scale,
        depth_ratio=measured.depth_ratio,
    )


def measure_inverse_link(
    reference: Reference, view: View, options: RelativePoseOptions = _DEFAULT
) -> RelativePose | str:
    """Return the pose of *reference* (b) relative to *view* (a), as `measure_link` does of the view."""
    found = measure_link(reference, view, options)
    if isinstance(found, str):
        return found
    # inverse(T exp(xi)) = inverse(T) exp(-Ad(T) xi).
    back = adjoint(inverse(found.T_a_b))
    information = back.T @ found.information @ back
    return RelativePose(
        T_a_b=inverse(found.T_a_b), information=0.5 * (information + information.T), inliers=found.inliers,
        matches=found.matches, scale=None if found.scale is None else found.scale.inverse,
    )  # fmt: skip


def scale_between(measured: MeasuredPose, options: RelativePoseOptions = _DEFAULT) -> MeasuredScale | None:
    """Return how long the unit of the view's depths is in that of the reference's points.

    It is the median of the ratios of depths among the inliers; None if too few of them have a depth, or they
    do not agree.  What the pose may be wrong by along the axis of the view counts, too.
    """
    rows = measured.solution.inliers[measured.depths_view[measured.solution.inliers] > 0.0]
    expected = transform(measured.solution.T_camera_world, measured.points_reference[rows])[:, 2]
    known = measured.depths_view[rows]
    is_before = expected > 0.0
    if np.count_nonzero(is_before) < _MIN_RATIOS:
        return None
    ratios = np.log(expected[is_before] / known[is_before])
    log_ratio = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - log_ratio)))
    if spread > _MAX_RATIO_SPREAD:
        return None
    along = math.sqrt(float(measured.solution.covariance[2, 2])) + options.floor_m
    variance = (
        0.5 * math.pi * spread**2 / len(ratios)
        + _SCALE_FLOOR**2
        + (along / float(np.median(expected[is_before]))) ** 2
    )
    return MeasuredScale(log_ratio, variance)


def measure_pose(
    reference: Reference, view: View, options: RelativePoseOptions = _DEFAULT
) -> MeasuredPose | str:
    """Return ``T_view_reference``, or the reason why there is none: "no-matches" or "no-pose".

    The pose is refined with the depths of *view*, if it has any, is metric, and all matched points lie before
    the camera.

    Args:
        reference: Whose points are sought.
        view: The image in which they are sought; the depth noise is taken for that of both cameras.
        options: Of matches and inliers; the number of inliers is not judged here.
    """
    points, pixels, depths_m = match_points(reference, view, options)
    least = options.min_inliers // 2 if options.min_matches is None else options.min_matches
    if len(points) < max(4, least):
        return "no-matches"
    try:
        solution = solve_pnp(points, pixels, view.camera, _pnp_options(options.inlier_px))
    except PnpError:
        return "no-pose"
    measured = MeasuredPose(solution=solution, points_reference=points, pixels=pixels, depths_view=depths_m)
    if view.depths_m is None or not view.is_metric or points[:, 2].min() < _NEAREST_M:
        return measured
    refined = refine_with_depth(solution, points, pixels, depths_m, view.camera, view.noise)
    return replace(measured, solution=refined, depth_ratio=scale_between(measured, options))


def match_points(
    reference: Reference, view: View, options: RelativePoseOptions = _DEFAULT
) -> tuple[Array, Array, Array]:
    """Return the points of *reference* that *view* shows, ``(k, 3)``, with its pixels and depths there.

    They are sorted from left to right, and rounded to 0.1 mm, 0.01 px and 1 mm.

    Raises:
        BadRequest: The descriptors are of two kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    rows, columns = best_matches(reference.descriptors, view.descriptors, options.ratio)
    rows, columns = rows[: options.max_matches], columns[: options.max_matches]
    leftmost = np.argsort(view.pixels[columns, 0], kind="stable")
    rows, columns = rows[leftmost], columns[leftmost]
    depths_m = np.zeros(len(columns)) if view.depths_m is None else view.depths_m[columns]
    return reference.points_camera[rows].round(4), view.pixels[columns].round(2), depths_m.round(3)


def match_rows(
    reference: Descriptors, view: Descriptors, options: RelativePoseOptions = _DEFAULT
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return rows of *reference* and of *view* that match, the best ``max_matches``, by rows of *view*.

    Raises:
        As `match_points`.
    """
    rows, columns = best_matches(reference, view, options.ratio)
    order = np.argsort(columns[: options.max_matches])
    return rows[order], columns[order]


@lru_cache(maxsize=16)
def _pnp_options(inlier_px: float) -> PnpOptions:
    return PnpOptions(inlier_px=inlier_px)
