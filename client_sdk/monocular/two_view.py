"""Two views of one camera without depth: their relative pose, and whether they suffice to begin a map.

Two views do not determine the length of the translation; here it is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, inverse
from rse_pf.images import load_opencv
from rse_pf.slam.triangulation import parallax_deg, triangulate

__all__ = ["TwoViewStart", "start_from_two_views"]

_RANSAC_CONFIDENCE = 0.9999
"""Probability with which RANSAC finds an essential matrix without outliers."""
_MIN_GOOD_SHARE = 0.5
"""Smallest share of the inlier matches whose points lie before both cameras and have parallax: where the
relative pose is wrong, as it may be if both views show one plane, the share is smaller."""
_MIN_POINT_PARALLAX_SHARE = 0.3
"""Smallest parallax of a point that is kept, as a share of the argument *min_parallax_deg* of a start."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViewStart:
    """Relative pose of two views, and the points that both see.

    Attributes:
        T_second_first: ``(4, 4)``, pose of the second view, with a translation of length 1.
        rows: ``(k,)``, rows of the matches whose points are good: before both cameras, with small
            reprojection errors and enough parallax.
        points: ``(k, 3)``, in the frame of the first camera; the unit is the distance of the cameras.
        parallax_deg: Median parallax, in degrees, of the points before both cameras with small errors.
        reason: Why the two views do not suffice for a start; empty if they do.
    """

    T_second_first: Array
    rows: npt.NDArray[np.int64]
    points: Array
    parallax_deg: float
    reason: str = ""


def start_from_two_views(
    first: Array,
    second: Array,
    camera: Camera,
    *,
    inlier_px: float = 1.0,
    min_points: int = 80,
    min_parallax_deg: float = 1.5,
) -> TwoViewStart:
    """Estimate the relative pose of two views and triangulate the points that both see.

    Args:
        first: ``(n, 2)`` undistorted pixels in the first view.
        second: ``(n, 2)`` pixels of the same points in the second view.
        camera: Intrinsics of both views.
        inlier_px: Largest distance of a pixel from its epipolar line; the largest reprojection error of a
            good point is twice this.
        min_points: Fewest good points of a start.
        min_parallax_deg: Smallest median angle, in degrees, between the two rays of a point; below it depths
            are noise.

    Returns:
        The start; its ``reason`` says whether the two views suffice.  If they have too few matches or
        inliers, its pose is the identity, and it has no points.

    Raises:
        MissingExtra: OpenCV is not installed.

    Source:
        Nister, PAMI 2004 (five-point algorithm); MAGSAC++, Barath et al., CVPR 2020, as OpenCV implements
        them.
    """
    # 1. Estimate the essential matrix of the matches, and its inliers.
    cv2 = load_opencv()
    no_start = TwoViewStart(
        T_second_first=np.eye(4),
        rows=np.empty(0, dtype=np.int64),
        points=np.empty((0, 3)),
        parallax_deg=0.0,
        reason=f"only {len(first)} matches with the first view",
    )
    if len(first) < min_points:
        return no_start
    cv2.setRNGSeed(1)
    essential, mask = cv2.findEssentialMat(
        first, second, camera.matrix, cv2.USAC_MAGSAC, _RANSAC_CONFIDENCE, inlier_px
    )
    if essential is None or essential.shape != (3, 3):
        return no_start
    rows = np.flatnonzero(mask.ravel())
    if len(rows) < min_points:
        return no_start
    # 2. Choose that of the four poses of the essential matrix with the most points before both cameras.
    _, rotation, translation, _ = cv2.recoverPose(essential, first[rows], second[rows], camera.matrix)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    # 3. Triangulate the inliers, and compute their parallax.
    points, is_good = triangulate(
        np.eye(4), pose, first[rows], second[rows], camera, max_error_px=2 * inlier_px
    )
    angles_deg = parallax_deg(points, np.zeros(3), inverse(pose)[:3, 3])
    median_deg = float(np.median(angles_deg[is_good])) if is_good.any() else 0.0
    is_kept = is_good & (angles_deg > _MIN_POINT_PARALLAX_SHARE * min_parallax_deg)
    # 4. Decide whether the points suffice for a start.
    kept_count, reason = int(is_kept.sum()), ""
    if median_deg < min_parallax_deg:
        reason = f"the camera has moved too little sideways: {median_deg:.1f} of {min_parallax_deg:g} deg"
    elif kept_count < max(min_points, _MIN_GOOD_SHARE * len(rows)):
        reason = f"only {kept_count} of {len(rows)} points lie before both views"
    return TwoViewStart(
        T_second_first=pose,
        rows=rows[is_kept],
        points=points[is_kept],
        parallax_deg=median_deg,
        reason=reason,
    )
