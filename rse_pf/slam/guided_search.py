"""Localise a view a second time, guided by a first pose: project landmarks of the map into the view by it.

Place recognition proposes few keyframes, and descriptors alone match few of their landmarks.  Around
a first pose, the landmarks of all keyframes are searched near their projections only, so that more of them
are matched, and they determine one pose together.  ORB-SLAM tracks its local map in this way (Mur-Artal,
Montiel and Tardos, IEEE T-RO 2015, Sect. V-D).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import PnpError
from rse_pf.geometry import Array, adjoint, inverse, pose_difference, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp
from rse_pf.slam.descriptors import distance_bound
from rse_pf.slam.relative_pose import View
from rse_pf.slam.tracking import Features, GuidedMatchLimits, PredictedFeatures, match_predictions

__all__ = ["GuidedPose", "MapLandmarks", "search_around"]

_SEARCH_RADII_PX = (25.0, 6.0)
"""Search radius of each round, pixels.  A first pose that is wrong by 10 cm moves the projections of points
at 2 m by 25 pixels; after the first round, they are off by few pixels."""
_LOWE_RATIO = 0.9
"""Limit of Lowe's ratio test within the radius; it is higher than among all features of an image, because
fewer features compete within the radius."""
_MAX_DISTANCE_BITS = 64  # largest Hamming distance of a match, of 256 bits: a quarter, half that of chance
_MIN_DEPTH_M = 0.1  # smallest depth in metres at which a landmark is projected
_MAX_STEP_M = 0.25
"""Largest distance between the first and the second pose, metres; right poses of photos moved by 0.14 m at
most, wrong ones by 0.35 m."""
_MAX_STEP_DEG = 10.0  # largest rotation between the two poses, degrees: that of 0.25 m for points at 1.5 m
_MIN_SURE_INLIERS = 60
"""Fewest inliers of a second pose that is sure; around first poses that were wrong by 0.3 to 1.5 m, wrong
second poses had 47 inliers at most."""
_MIN_SURE_RATIO = 0.5  # smallest share of inliers among the matches of a second pose that is sure


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapLandmarks:
    """Landmarks of several keyframes in the frame of the map.

    Attributes:
        points_map: ``(n, 3)`` metres, finite.
        descriptors: ``(n, d)``.
    """

    points_map: Array
    descriptors: Descriptors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GuidedPose:
    """The pose of a view that the landmarks around a first pose determine together.

    Attributes:
        T_map_camera: ``(4, 4)``, metres.
        covariance: ``(6, 6)`` of the twist (metres, radians) on the left of ``T_map_camera``, for independent
            errors of the matches.
        solution: The solution of PnP, in the frame of the first pose's camera.
        matches: The number of matches, inliers and outliers.
    """

    T_map_camera: Array
    covariance: Array
    solution: PnpSolution
    matches: int

    @property
    def is_sure(self) -> bool:
        """Whether the pose is ok whatever the number of inliers of single keyframes."""
        inliers = len(self.solution.inliers)
        is_supported = inliers >= max(_MIN_SURE_INLIERS, _MIN_SURE_RATIO * self.matches)
        return is_supported and not self.solution.reason


def search_around(
    T_map_camera: Array, landmarks: MapLandmarks, view: View, min_inliers: int, inlier_px: float
) -> GuidedPose | None:
    """Match landmarks near their projections by a first pose, and solve PnP with all of them; deterministic.

    Args:
        T_map_camera: ``(4, 4)``, metres, the first pose.
        landmarks: Landmarks of the keyframes around the pose.
        view: The image; its depths are not used.
        min_inliers: Fewest inliers of the second pose.
        inlier_px: Largest reprojection error of an inlier, pixels.

    Returns:
        The second pose; None if there is none, if it has fewer inliers, or if it is further from the first
        one than 0.25 m or 10 degrees.

    Raises:
        BadRequest: The descriptors of landmarks and view are of different kinds.
        MissingExtra: They are ORB descriptors, and the native core is not installed.
    """
    features = _features_of(view)
    points = transform(inverse(T_map_camera), landmarks.points_map)
    T_camera_first = np.eye(4)
    for radius_px in _SEARCH_RADII_PX:
        # 1. Project the landmarks by the last pose, and match each with a feature within the radius.
        rows, feature_rows = _match_near(
            transform(T_camera_first, points), landmarks.descriptors, features, view, radius_px
        )
        # 2. Solve PnP with all matches, in the frame of the first pose.
        try:
            solution = solve_pnp(
                points[rows], view.pixels[feature_rows], view.camera, PnpOptions(inlier_px=inlier_px)
            )
        except PnpError:
            return None
        T_camera_first = solution.T_camera_world
    moved_m, rotated_deg = pose_difference(T_camera_first, np.eye(4))
    if len(solution.inliers) < min_inliers or moved_m > _MAX_STEP_M or rotated_deg > _MAX_STEP_DEG:
        return None
    # 3. The error is on the left of the inverse pose; the inverse of exp(xi) T has -Ad(inverse(T)) xi there.
    T_map_second = T_map_camera @ inverse(T_camera_first)
    to_map = adjoint(T_map_second)
    return GuidedPose(
        T_map_camera=T_map_second,
        covariance=to_map @ solution.covariance @ to_map.T,
        solution=solution,
        matches=len(rows),
    )


def _features_of(view: View) -> Features:
    """Return the features of a view, without orientations, sizes and distinctiveness."""
    count = len(view.pixels)
    return Features(
        pixels=view.pixels,
        descriptors=view.descriptors,
        points_camera=np.full((count, 3), np.nan),
        orientations=np.zeros((count, 2)),
        sizes=np.ones(count),
        distinctiveness=np.full(count, distance_bound(view.descriptors), dtype=np.int32),
        is_oriented=False,
        is_scaled=False,
    )


def _match_near(
    points_camera: Array, descriptors: Descriptors, features: Features, view: View, radius_px: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the rows of the landmarks and of the features that match within a radius, one to one."""
    size = [view.camera.width, view.camera.height]
    in_front = np.flatnonzero(points_camera[:, 2] > _MIN_DEPTH_M)
    projected = view.camera.project(points_camera[in_front])
    is_inside = ((projected > -radius_px) & (projected < np.add(size, radius_px))).all(axis=1)
    rows = in_front[is_inside]
    predicted = PredictedFeatures(
        pixels=projected[is_inside],
        descriptors=descriptors[rows],
        orientations=np.zeros((len(rows), 2)),
        sizes=np.ones(len(rows)),
    )
    limits = GuidedMatchLimits(
        radius_px=radius_px,
        lowe_ratio=_LOWE_RATIO,
        distinctiveness_ratio=math.inf,
        max_distance=_MAX_DISTANCE_BITS,
    )
    matched, feature_rows = match_predictions(predicted, features, limits)
    return rows[matched].astype(np.int64), feature_rows
