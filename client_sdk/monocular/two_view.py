"""Two views of one camera without depth: their relative pose, and whether they suffice for a start.

The length of the translation is unknown to two views; it is 1 here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, inverse
from rse_pf.images import load_opencv
from rse_pf.slam.triangulation import parallax_deg, triangulate

__all__ = ["TwoViewStart", "start_from_two_views"]

_CONFIDENCE = 0.9999
_MIN_SHARE = 0.5
"""Of the matches that must agree with the relative pose, lie before both cameras and have parallax."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViewStart:
    """The pose of the second view and the points that both see, in the frame of the first camera.

    ``rows`` are the rows of the matches whose points are good; ``points`` ``(len(rows), 3)``.  *reason* is
    empty if the views suffice for a start.
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
    """Estimate the relative pose of two views and the points that both see.

    Args:
        first: ``(n, 2)`` undistorted pixels of the first view.
        second: ``(n, 2)``, row *i* shows the same point.
        camera: Intrinsics of both.
        inlier_px: Largest distance from the epipolar line, and largest reprojection error over 2.
        min_points: Fewer good points are no start.
        min_parallax_deg: Median angle between the rays; below it depth is noise.

    Returns:
        The views; ``reason`` says why they are no start.

    Raises:
        MissingExtra: OpenCV is not installed.

    Source:
        Nister, PAMI 2004 (five points); MAGSAC++, Barath et al., CVPR 2020, as OpenCV implements them.
    """
    cv2 = load_opencv()
    nothing = np.empty(0, dtype=np.int64)
    none = TwoViewStart(
        T_second_first=np.eye(4), rows=nothing, points=np.empty((0, 3)), parallax_deg=0.0,
        reason=f"only {len(first)} matches with the first view",
    )  # fmt: skip
    if len(first) < min_points:
        return none
    cv2.setRNGSeed(1)
    essential, mask = cv2.findEssentialMat(
        first, second, camera.matrix, cv2.USAC_MAGSAC, _CONFIDENCE, inlier_px
    )
    if essential is None or essential.shape != (3, 3):
        return none
    rows = np.flatnonzero(mask.ravel())
    if len(rows) < min_points:
        return none
    _, rotation, translation, _ = cv2.recoverPose(essential, first[rows], second[rows], camera.matrix)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    points, good = triangulate(np.eye(4), pose, first[rows], second[rows], camera, max_error_px=2 * inlier_px)
    angles = parallax_deg(points, np.zeros(3), inverse(pose)[:3, 3])
    median = float(np.median(angles[good])) if good.any() else 0.0
    kept = good & (angles > 0.3 * min_parallax_deg)
    reason = ""
    if median < min_parallax_deg:
        reason = f"the camera has moved too little sideways: {median:.1f} of {min_parallax_deg:g} deg"
    elif kept.sum() < max(min_points, _MIN_SHARE * len(rows)):
        reason = f"only {int(kept.sum())} of {len(rows)} points lie before both views"
    return TwoViewStart(
        T_second_first=pose, rows=rows[kept], points=points[kept], parallax_deg=median, reason=reason
    )
