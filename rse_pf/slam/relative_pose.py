"""The relative pose of two keyframes: matches, PnP and the covariance; none with too few inliers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import PnpError
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.maps.format import Keyframe
from rse_pf.pnp import PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.slam.descriptors import Descriptors, hamming_matches

Rows = npt.NDArray[np.int64]

__all__ = [
    "RelativePose",
    "RelativePoseOptions",
    "View",
    "matched_points",
    "measure_relative_pose",
    "pose_of_view",
]

# Depths that a depth camera may measure; the depth of anything else is left out.
_MAX_POINT_M = 1e5
"""No point of a keyframe is further away; PnP refuses all matches for one that is."""
_NEAREST_M, _FARTHEST_M = 0.01, 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePoseOptions:
    """Limits of matches and inliers; the defaults were measured on the red-kitchen recording."""

    ratio: float = 0.75
    inlier_px: float = 3.0
    max_matches: int = 700
    min_inliers: int = 40
    min_inlier_ratio: float = 0.5
    floor_m: float = 0.02
    floor_deg: float = 0.7
    """Smallest standard deviations for each axis: errors of depth and calibration are correlated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A camera image: ``(n, 2)`` undistorted pixels with their ``(n, 32)`` descriptors.

    ``depths_m``, if there are any, are the ``(n,)`` depths at the pixels, 0 where there is none.
    """

    camera: Camera
    pixels: Array
    descriptors: Descriptors
    depths_m: Array | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePose:
    """``T_a_b`` between two keyframes, its ``(6, 6)`` information, and the number of inliers and matches."""

    T_a_b: Array
    information: Array
    inliers: int
    matches: int


def measure_relative_pose(a: Keyframe, b: Keyframe, options: RelativePoseOptions) -> RelativePose | str:
    """Return the pose of keyframe *b* relative to *a*, from points of *a* in the image of *b*.

    Returns:
        The relative pose, or the reason why there is none: "no-matches", "no-pose", "few-inliers",
        "low-inlier-ratio".
    """
    view = View(
        camera=b.camera,
        pixels=np.asarray(b.pixels, dtype=np.float64),
        descriptors=b.descriptors,
        depths_m=_depths_m(b),
    )
    found = pose_of_view(a, view, options)
    if isinstance(found, str):
        return found
    solution, matches = found
    count = len(solution.inliers)
    if count < options.min_inliers:
        return "few-inliers"
    if count < options.min_inlier_ratio * matches:
        return "low-inlier-ratio"
    T_b_a = solution.T_camera_world
    # T_b_a true = exp(xi) T_b_a, so inverse(T_a_b) T_a_b true = exp(-xi): the same covariance.
    floor = np.diag([options.floor_m**2] * 3 + [math.radians(options.floor_deg) ** 2] * 3)
    covariance = solution.covariance + floor
    information = np.linalg.inv(covariance).astype(np.float64)
    return RelativePose(T_a_b=inverse(T_b_a), information=information, inliers=count, matches=matches)


def pose_of_view(
    reference: Keyframe, view: View, options: RelativePoseOptions
) -> tuple[PnpSolution, int] | str:
    """Return ``T_view_reference`` by PnP with the number of matches, or the reason why there is none.

    The pose is refined with the depths of *view*, if it has any.
    """
    points, rows, columns = matched_points(reference, view, options)
    if len(rows) < max(4, options.min_inliers // 2):
        return "no-matches"
    try:
        solution = solve_pnp(
            points, view.pixels[columns], view.camera, PnpOptions(inlier_px=options.inlier_px)
        )
    except PnpError:
        return "no-pose"
    if view.depths_m is not None and points[:, 2].min() >= _NEAREST_M:
        solution = refine_with_depth(
            solution, points, view.pixels[columns], view.depths_m[columns], view.camera
        )
    return solution, len(rows)


def matched_points(reference: Keyframe, view: View, options: RelativePoseOptions) -> tuple[Array, Rows, Rows]:
    """Return the reference's ``(k, 3)`` matched points (its camera frame), and both row numbers."""
    # Not a number is "no depth"; the rest is another's, and one row must not cost the whole request.
    known = np.flatnonzero((np.abs(reference.points_camera) <= _MAX_POINT_M).all(axis=1))
    rows, columns = hamming_matches(reference.descriptors[known], view.descriptors, options.ratio)
    rows, columns = known[rows[: options.max_matches]], columns[: options.max_matches]
    return np.asarray(reference.points_camera[rows], dtype=np.float64), rows, columns


def _depths_m(keyframe: Keyframe) -> Array:
    """Return the depth of each feature, 0 where there is none that a depth camera could have measured."""
    depths_m = np.asarray(keyframe.points_camera[:, 2], dtype=np.float64)
    usable = (depths_m >= _NEAREST_M) & (depths_m <= _FARTHEST_M)
    return np.where(usable, depths_m, 0.0)
