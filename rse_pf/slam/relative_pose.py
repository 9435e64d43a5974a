"""Measure the relative pose of two images: match features, solve PnP, and refine the pose with depths.

The landmarks of one image are matched with the features of the other image.  `measure_pose` returns any pose;
`measure_relative_pose` accepts it as a constraint between two keyframes only if enough matches are inliers.
Which images are compared, and which constraints are outliers, is decided by `rse_pf.slam.loop_closures`,
`rse_pf.slam.localise` and `rse_pf.live_map`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.errors import PnpError
from rse_pf.geometry import Array, Camera, adjoint, inverse, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.maps.format import Keyframe
from rse_pf.pnp import DepthNoise, PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.slam.descriptors import best_matches

__all__ = [
    "Landmarks",
    "MeasuredPose",
    "RelativePose",
    "RelativePoseOptions",
    "ScaleRatio",
    "View",
    "landmarks_of_keyframe",
    "match_descriptors",
    "match_landmarks",
    "measure_inverse_relative_pose",
    "measure_pose",
    "measure_relative_pose",
    "measure_scale_ratio",
    "view_of_keyframe",
]

_KINECT_NOISE = DepthNoise()
_MAX_LANDMARK_M = 1e5
"""Largest coordinate in metres of a landmark in its camera's frame; PnP would reject all matches because of
one landmark beyond it."""
_MIN_DEPTH_M = 0.01  # smallest depth in metres that is used as the measurement of a depth camera
_MAX_DEPTH_M = 100.0  # largest depth in metres that is used as the measurement of a depth camera
_MIN_SCALE_RATIOS = 12
"""Smallest number of inliers with a depth in both images from which a ratio of metric scales is
estimated."""
_MAX_SCALE_SPREAD = 0.15
"""Largest standard deviation of the logarithms of depth ratios at which their median is a ratio of scales."""
_MIN_SCALE_DEVIATION = 0.01
"""Smallest standard deviation of the logarithm of a ratio of scales: the errors of the landmarks of one
keyframe are correlated, so that more landmarks do not make it more accurate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePoseOptions:
    """Limits of matches and inliers; the defaults were measured on the red-kitchen recording of 7-Scenes.

    Attributes:
        ratio: Limit of the quotient of the distances of the best and of the second best match (Lowe's ratio
            test).
        inlier_px: Largest reprojection error of an inlier.
        max_matches: Largest number of matches that are used, those with the most similar descriptors.
        min_matches: Fewer matches give no pose; None means half of ``min_inliers``.  PnP needs at least 4.
        min_inliers: Fewer inliers give no constraint.
        min_inlier_ratio: A smaller share of inliers among the matches gives no constraint.
        floor_m: Standard deviation, along each axis, of the errors of the translation that all matches have
            in common, such as those of depth and calibration; its square is added to the variance of PnP.
        floor_deg: Standard deviation, about each axis, of the errors of the rotation that all matches have in
            common; its square is added to the variance of PnP.
        weak_variance: If PnP calls a pose weak, its covariance is multiplied by this factor before it becomes
            a constraint; 0 means that a weak pose gives no constraint.
    """

    ratio: float = 0.75
    inlier_px: float = 3.0
    max_matches: int = 700
    min_matches: int | None = None
    min_inliers: int = 40
    min_inlier_ratio: float = 0.5
    floor_m: float = 0.02
    floor_deg: float = 0.7
    weak_variance: float = 0.0

    def min_covariance(self) -> Array:
        """Return the ``(6, 6)`` covariance (metres, radians) that is added to that of each measured pose."""
        return np.diag([self.floor_m**2] * 3 + [math.radians(self.floor_deg) ** 2] * 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The features of one camera image, in which the landmarks of other images are looked for.

    Attributes:
        camera: The pinhole camera.
        pixels: ``(n, 2)``, undistorted.
        descriptors: ``(n, d)``.
        depths_m: ``(n,)`` along the optical axis, 0 where the depth is unknown; None without depths.
        noise: Noise of the depths.
        is_metric: Whether the depths are in metres; else their unit of length is unknown.
    """

    camera: Camera
    pixels: Array
    descriptors: Descriptors
    depths_m: Array | None = None
    noise: DepthNoise = _KINECT_NOISE
    is_metric: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """3-D points of a keyframe with descriptors, which are looked for in other images.

    Attributes:
        points_camera: ``(n, 3)`` metres in the frame of the keyframe's camera, finite.
        descriptors: ``(n, d)``, one row for each point.
    """

    points_camera: Array
    descriptors: Descriptors


@dataclass(frozen=True, slots=True)
class ScaleRatio:
    """The natural logarithm of the ratio of two units of length, and the variance of this logarithm.

    ``exp(log_ratio)`` is the length of the first unit, measured in the second unit.  Which units these are is
    stated where a ratio is returned.
    """

    log_ratio: float
    variance: float

    @property
    def inverse(self) -> ScaleRatio:
        """The ratio with both units exchanged: the length of the second unit, measured in the first unit."""
        return ScaleRatio(-self.log_ratio, self.variance)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredPose:
    """The pose of a view relative to a keyframe, and the matches from which it was computed.

    Attributes:
        solution: The PnP solution; its ``T_camera_world`` maps the keyframe's frame to the view's frame.
        points_keyframe: ``(k, 3)``, the matched landmarks in the frame of the keyframe, metres.
        pixels: ``(k, 2)``, the matched pixels in the view.
        depths_view: ``(k,)``, the depths of the matched features in the view, 0 where unknown.
        depth_ratio: For a metric view with depths: the length of one metre of the view's depths, measured in
            metres of the keyframe's landmarks, see `measure_scale_ratio`.  It differs from 1 if the depths of
            one of both have a wrong scale, as those of a depth camera with a wrong calibration.  None for
            other views, and where `measure_scale_ratio` returns None.
    """

    solution: PnpSolution
    points_keyframe: Array
    pixels: Array
    depths_view: Array
    depth_ratio: ScaleRatio | None = None

    @property
    def matches(self) -> int:
        """The number of matches."""
        return len(self.pixels)

    @property
    def inliers(self) -> int:
        """The number of inliers among the matches."""
        return len(self.solution.inliers)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePose:
    """A constraint between two keyframes *a* and *b*.

    Attributes:
        T_a_b: ``(4, 4)``, maps the frame of the camera of *b* to that of *a*.
        information: ``(6, 6)`` inverse covariance of the twist (metres, radians) in
            ``log(inverse(T_a_b) @ true_T_a_b)``.
        inliers: The number of inliers.
        matches: The number of matches.
        scale: The length of the unit of length of *b*, measured in that of *a*.  It is given if the view that
            was matched has depths in an unknown unit, and None otherwise.  This view is the image of *b* for
            `measure_relative_pose`, and that of *a* for `measure_inverse_relative_pose`.
        depth_ratio: `MeasuredPose.depth_ratio` with *b* as the view: the length of one metre of *b*, measured
            in metres of *a*.  None if it was not measured.
    """

    T_a_b: Array
    information: Array
    inliers: int
    matches: int
    scale: ScaleRatio | None = None
    depth_ratio: ScaleRatio | None = None


_DEFAULT = RelativePoseOptions()


def landmarks_of_keyframe(keyframe: Keyframe) -> Landmarks:
    """Return the features of *keyframe* whose 3-D point is known and within 100 km of its camera."""
    # A comparison with NaN, which means an unknown depth, is false.
    rows = np.flatnonzero((np.abs(keyframe.points_camera) <= _MAX_LANDMARK_M).all(axis=1))
    return Landmarks(
        points_camera=keyframe.points_camera[rows].astype(np.float64),
        descriptors=keyframe.descriptors[rows],
    )


def view_of_keyframe(keyframe: Keyframe) -> View:
    """Return the image of *keyframe* as a view; depths outside 0.01..100 m are unknown."""
    depths_m = keyframe.points_camera[:, 2].astype(np.float64)
    is_usable = (depths_m >= _MIN_DEPTH_M) & (depths_m <= _MAX_DEPTH_M)
    return View(
        camera=keyframe.camera,
        pixels=keyframe.pixels.astype(np.float64),
        descriptors=keyframe.descriptors,
        depths_m=np.where(is_usable, depths_m, 0.0),
    )


def measure_relative_pose(
    landmarks: Landmarks, view: View, options: RelativePoseOptions = _DEFAULT
) -> RelativePose | str:
    """Return the pose of *view* (b) relative to the keyframe of *landmarks* (a); deterministic.

    Returns:
        The relative pose, or the reason why there is none: "no-matches"; "no-pose"; "few-inliers";
        "low-inlier-ratio"; "no-scale" where the view is not metric and depths do not give its scale; or the
        reason why PnP calls the pose weak, unless ``weak_variance`` accepts weak poses.

    Raises:
        BadRequest: The descriptors to be matched are of different kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    measured = measure_pose(landmarks, view, options)
    if isinstance(measured, str):
        return measured
    if measured.inliers < options.min_inliers:
        return "few-inliers"
    if measured.inliers < options.min_inlier_ratio * measured.matches:
        return "low-inlier-ratio"
    weakness = measured.solution.reason
    if weakness and not options.weak_variance:
        return weakness
    scale = None if view.is_metric else measure_scale_ratio(measured, options)
    if scale is None and not view.is_metric:
        return "no-scale"
    factor = options.weak_variance if weakness else 1.0
    # The error is on the left of T_b_a: true_T_b_a = exp(xi) T_b_a.  The inverse of this equation has
    # exp(-xi) on the right of T_a_b, so that the covariance of both is the same.
    information = np.linalg.inv(factor * measured.solution.covariance + options.min_covariance())
    return RelativePose(
        T_a_b=inverse(measured.solution.T_camera_world),
        information=0.5 * (information + information.T),
        inliers=measured.inliers,
        matches=measured.matches,
        scale=scale,
        depth_ratio=measured.depth_ratio,
    )


def measure_inverse_relative_pose(
    landmarks: Landmarks, view: View, options: RelativePoseOptions = _DEFAULT
) -> RelativePose | str:
    """Return the pose of the keyframe of *landmarks* (b) relative to *view* (a).

    The result is the inverse of that of `measure_relative_pose`, without ``depth_ratio``; the reasons why
    there is no pose are the same.
    """
    measured = measure_relative_pose(landmarks, view, options)
    if isinstance(measured, str):
        return measured
    # inverse(T exp(xi)) = inverse(T) exp(-Ad(T) xi).
    J = adjoint(inverse(measured.T_a_b))
    information = J.T @ measured.information @ J
    return RelativePose(
        T_a_b=inverse(measured.T_a_b),
        information=0.5 * (information + information.T),
        inliers=measured.inliers,
        matches=measured.matches,
        scale=None if measured.scale is None else measured.scale.inverse,
    )


def measure_scale_ratio(measured: MeasuredPose, options: RelativePoseOptions = _DEFAULT) -> ScaleRatio | None:
    """Return the length of the unit of the view's depths, measured in the unit of the keyframe's landmarks.

    For each inlier with a depth in the view, the ratio is the depth of the landmark in the view that follows
    from the pose, divided by the depth that the view measured.  The estimate is the median of the logarithms
    of these ratios.  Its variance is the sum of three variances: that of the median, that of the errors which
    all landmarks of a keyframe have in common, and that of the pose along the optical axis.

    Returns:
        None if fewer than 12 inliers have a depth in both images, or the standard deviation of the logarithms
        of their ratios is above 0.15.
    """
    rows = measured.solution.inliers[measured.depths_view[measured.solution.inliers] > 0.0]
    expected_depths = transform(measured.solution.T_camera_world, measured.points_keyframe[rows])[:, 2]
    view_depths = measured.depths_view[rows]
    is_in_front = expected_depths > 0.0
    if np.count_nonzero(is_in_front) < _MIN_SCALE_RATIOS:
        return None
    log_ratios = np.log(expected_depths[is_in_front] / view_depths[is_in_front])
    log_ratio = float(np.median(log_ratios))
    # 1.4826 times the median absolute deviation is the standard deviation of a normal distribution.
    spread = 1.4826 * float(np.median(np.abs(log_ratios - log_ratio)))
    if spread > _MAX_SCALE_SPREAD:
        return None
    axial_deviation_m = math.sqrt(float(measured.solution.covariance[2, 2])) + options.floor_m
    variance = (
        0.5 * math.pi * spread**2 / len(log_ratios)  # the variance of a median is pi / 2 that of a mean
        + _MIN_SCALE_DEVIATION**2
        + (axial_deviation_m / float(np.median(expected_depths[is_in_front]))) ** 2
    )
    return ScaleRatio(log_ratio, variance)


def measure_pose(
    landmarks: Landmarks, view: View, options: RelativePoseOptions = _DEFAULT
) -> MeasuredPose | str:
    """Return the pose of *view* relative to the keyframe of *landmarks*, however few matches are inliers.

    The pose is refined with the depths of *view* if the view is metric and has depths, and all matched
    landmarks lie in front of the keyframe's camera.

    Args:
        landmarks: The landmarks of the keyframe.
        view: The image in which they are looked for.  Its depth noise is assumed for the camera that measured
            the landmarks, too.
        options: Limits of the matches and of the reprojection error.

    Returns:
        The pose, or the reason why there is none: "no-matches" or "no-pose".

    Raises:
        BadRequest: The descriptors to be matched are of different kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    # 1. Match the landmarks with the features of the view.
    points, pixels, depths_m = match_landmarks(landmarks, view, options)
    min_matches = options.min_inliers // 2 if options.min_matches is None else options.min_matches
    if len(points) < max(4, min_matches):
        return "no-matches"
    # 2. Compute the pose by PnP from the matches.
    try:
        solution = solve_pnp(points, pixels, view.camera, PnpOptions(inlier_px=options.inlier_px))
    except PnpError:
        return "no-pose"
    measured = MeasuredPose(solution=solution, points_keyframe=points, pixels=pixels, depths_view=depths_m)
    # 3. Refine the pose with the depths of both images, if the view has metric ones.
    if view.depths_m is None or not view.is_metric or points[:, 2].min() < _MIN_DEPTH_M:
        return measured
    refined = refine_with_depth(solution, points, pixels, depths_m, view.camera, view.noise)
    # 4. Compare the metric scales by the unrefined pose, which the depths of the view did not affect.
    return replace(measured, solution=refined, depth_ratio=measure_scale_ratio(measured, options))


def match_landmarks(
    landmarks: Landmarks, view: View, options: RelativePoseOptions = _DEFAULT
) -> tuple[Array, Array, Array]:
    """Match landmarks with the features of a view.

    Returns:
        The matched landmarks ``(k, 3)`` in the keyframe's frame, and the pixels ``(k, 2)`` and depths
        ``(k,)`` of the matched features in *view* (0 where unknown), sorted by the column of the pixel and
        rounded to 0.1 mm, 0.01 px and 1 mm.  *k* is at most ``max_matches``, and may be 0.

    Raises:
        BadRequest: The descriptors to be matched are of different kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    landmark_rows, view_rows = best_matches(landmarks.descriptors, view.descriptors, options.ratio)
    landmark_rows, view_rows = landmark_rows[: options.max_matches], view_rows[: options.max_matches]
    order = np.argsort(view.pixels[view_rows, 0], kind="stable")
    landmark_rows, view_rows = landmark_rows[order], view_rows[order]
    depths_m = np.zeros(len(view_rows)) if view.depths_m is None else view.depths_m[view_rows]
    return (
        landmarks.points_camera[landmark_rows].round(4),
        view.pixels[view_rows].round(2),
        depths_m.round(3),
    )


def match_descriptors(
    first: Descriptors, second: Descriptors, options: RelativePoseOptions = _DEFAULT
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the rows of *first* and of *second* that match, the best ``max_matches`` of them.

    The matches are sorted by their row of *second*.

    Raises:
        BadRequest: The descriptors to be matched are of different kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    first_rows, second_rows = best_matches(first, second, options.ratio)
    order = np.argsort(second_rows[: options.max_matches])
    return first_rows[order], second_rows[order]
