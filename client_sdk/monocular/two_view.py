"""Two views of one camera without depth: their relative pose, and whether they suffice to begin a map.

Two views do not determine the length of the translation; here it is 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.rotation import fit_rotation
from rse_pf.geometry import Array, Camera, inverse, rotation_angle_deg
from rse_pf.images import load_opencv
from rse_pf.slam.triangulation import parallax_deg, triangulate

__all__ = ["TwoViewStart", "share_in_third_view", "start_from_two_views"]

_RANSAC_CONFIDENCE = 0.9999
"""Probability with which RANSAC finds an essential matrix without outliers."""
_MIN_GOOD_SHARE = 0.5
"""Smallest share of the inlier matches whose points lie before both cameras with small errors: where the
relative pose is wrong, as it may be if both views show one plane, the share is smaller."""
_MIN_POINT_PARALLAX_DEG = 0.3
"""Smallest parallax, in degrees, of a point that is kept: the depth of a point with less is noise."""
_WIDE_POINTS = 50
"""Number of points that must have a wide parallax where the median is small: a camera that drives forward
sees most points near its direction, with no parallax, and these at the sides."""
_WIDE_PARALLAX_DEG = 1.0
"""Smallest parallax, in degrees, of the points at the sides: noise of stationary cameras stays below 0.3."""
_EXPLAINED_PX = 3.0
"""Largest error, in pixels, of a match that a rotation or a homography explains: three times the noise of a
feature.  In small images it is less, see `_EXPLAINED_DEG`."""
_EXPLAINED_DEG = 0.38
"""The same error as an angle, in degrees, which is the smaller limit below a focal length of 452 px: in an
image of 320 px, 3 px explain a wall that the camera passes sideways as a rotation."""
_MAX_ROTATION_SHARE = 0.6
"""Largest share of all matches that one rotation may explain: 0.8 to 1.0 where the camera only turns, also
with focal lengths that are wrong by 7 %; 0.1 to 0.4 in drives forward over one or two frames, and up to 0.6
where a camera passes walls sideways."""
_MAX_ROTATION_SHARE_AT_SIDES = 0.5
"""The same for a start by the points at the sides: less parallax has to be clearer."""
_MIN_PLANE_SHARE = 0.9
"""Share of the inlier matches from which one homography explains the scene: 0.92 to 1.0 for planes, 0.4 to
0.9 for streets and rooms.  The relative pose of a plane has two solutions, and needs more parallax."""
_MIN_STILL_SHARE = 0.03
"""Share of the inlier matches that lie off a plane and did not move from which they are a background: 0.05 to
0.1 behind a thing of 30 % of the image with most of the texture, below 0.01 where the camera moves."""
_MIN_TWO_MOTIONS_SHARE = 0.93
"""Share of the inlier matches from which a rotation and a homography together explain all: 0.97 to 1.0 where
a flat thing moves before a stationary camera; 0.6 to 0.85 in streets, 0.7 to 0.92 in rooms."""
_MAX_PLANE_ROTATION_SHARE = 0.4
"""Largest share of all matches that one rotation may explain where the scene is a plane: an image that turns
before a lens with a wrong distortion looks like a plane, and has 0.45 or more."""
_MAX_TURN_DEG = 20.0
"""Largest rotation, in degrees, between the two views of a start: an unknown distortion of k1 = 0.2 has
parallax in a rotation by 25 degrees and more."""
_MIN_MOTION_MATCHES = 8
"""Fewest matches to which a homography or a rotation is fitted; either fits fewer by chance."""
_THIRD_VIEW_PARALLAX_DEG = 0.5
"""Smallest parallax, in degrees, of the points that a third view checks: with less, any pose fits."""
_THIRD_VIEW_PX = 2.0
"""Largest reprojection error, in pixels, of a point with which a third view agrees."""
_THIRD_VIEW_DRAWS = 200
"""Number of RANSAC iterations of the pose of a third view, which bounds its time to 2 ms."""
_MIN_THIRD_VIEW_POINTS = 20
"""Fewest points by which a third view can agree; with fewer a wrong pose fits by chance."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViewStart:
    """Relative pose of two views, and the points that both see.

    Attributes:
        T_second_first: ``(4, 4)``, pose of the second view, with a translation of length 1.
        rows: ``(k,)``, rows of the matches whose points are good: before both cameras, with small
            reprojection errors and enough parallax.
        points: ``(k, 3)``, in the frame of the first camera; the unit is the distance of the cameras.
        parallax_deg: ``(k,)``, angle in degrees between the two rays of each point.
        reason: Why the two views do not suffice for a start; empty if they do.
        is_still: Whether the reason is that the camera did not move, or only turned: then views between the
            two do not suffice either.
    """

    T_second_first: Array
    rows: npt.NDArray[np.int64]
    points: Array
    parallax_deg: Array
    reason: str = ""
    is_still: bool = False


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

    Two views suffice if the median parallax is large; or, as for a camera that drives forward, if 50 points
    have 1 degree and the scene is no plane.  They do not suffice if one rotation explains half of the
    matches, or if a rotation and the motion of a plane explain all: then the camera did not move.

    Args:
        first: ``(n, 2)`` undistorted pixels in the first view.
        second: ``(n, 2)`` pixels of the same points in the second view.
        camera: Intrinsics of both views.
        inlier_px: Largest distance of a pixel from its epipolar line; the largest reprojection error of a
            good point is twice this.
        min_points: Fewest good points of a start.
        min_parallax_deg: Median angle, in degrees, between the two rays of a point, that suffices alone.

    Returns:
        The start; its ``reason`` says whether the two views suffice.  If they have too few matches or
        inliers, or the camera did not move, its pose is the identity, and it has no points.

    Raises:
        MissingExtra: OpenCV is not installed.

    Source:
        Nister, PAMI 2004 (five-point algorithm); MAGSAC++, Barath et al., CVPR 2020, as OpenCV implements
        them.
    """
    # 1. Refuse a camera that did not move or only turned.
    cv2 = load_opencv()
    if len(first) < min_points:
        return _no_start(f"only {len(first)} matches with the first view")
    standstill = _describe_standstill(first, second, camera)
    if standstill:
        return _no_start(standstill, is_still=True)
    # 2. Estimate the essential matrix of the matches, and its inliers.
    cv2.setRNGSeed(1)
    essential, mask = cv2.findEssentialMat(
        first, second, camera.matrix, cv2.USAC_MAGSAC, _RANSAC_CONFIDENCE, inlier_px
    )
    rows = np.flatnonzero(mask.ravel()) if essential is not None else np.empty(0, dtype=np.int64)
    if len(rows) < min_points or essential.shape != (3, 3):
        return _no_start(f"only {len(rows)} of {len(first)} matches agree with one motion of the camera")
    # 3. Choose that of the four poses of the essential matrix with the most points before both cameras.
    _, rotation, translation, _ = cv2.recoverPose(essential, first[rows], second[rows], camera.matrix)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    # 4. Triangulate the inliers, and compute their parallax.
    points, is_good = triangulate(
        np.eye(4), pose, first[rows], second[rows], camera, max_error_px=2 * inlier_px
    )
    angles_deg = parallax_deg(points, np.zeros(3), inverse(pose)[:3, 3])
    is_kept = is_good & (angles_deg > _MIN_POINT_PARALLAX_DEG)
    # 5. Decide whether the points suffice for a start.
    good_deg, good_count, kept_count = np.sort(angles_deg[is_good]), int(is_good.sum()), int(is_kept.sum())
    median_deg = float(np.median(good_deg)) if good_count else 0.0
    wide_deg = float(good_deg[-_WIDE_POINTS]) if good_count >= _WIDE_POINTS else 0.0
    reason, is_still = "", False
    if median_deg < min_parallax_deg and wide_deg < _WIDE_PARALLAX_DEG:
        reason = (
            f"the camera has moved too little: {median_deg:.1f} of {min_parallax_deg:g} deg of parallax, "
            f"{wide_deg:.1f} of {_WIDE_PARALLAX_DEG:g} deg at the sides"
        )
    elif rotation_angle_deg(rotation) > _MAX_TURN_DEG:
        reason = (
            f"the camera has turned by {rotation_angle_deg(rotation):.0f} of at most {_MAX_TURN_DEG:g} deg"
        )
    else:
        is_plane, two_motions_share = _explain_by_motions(first[rows], second[rows], camera)
        is_narrow = median_deg < min_parallax_deg
        if is_plane:
            reason = _describe_standstill(first, second, camera, _MAX_PLANE_ROTATION_SHARE)
        elif is_narrow:
            reason = _describe_standstill(first, second, camera, _MAX_ROTATION_SHARE_AT_SIDES)
        if not is_plane and not reason and two_motions_share >= _MIN_TWO_MOTIONS_SHARE:
            reason = (
                "the camera does not move, a thing before it does: a rotation and a plane explain "
                f"{100 * two_motions_share:.0f} % of {len(rows)} matches"
            )
        is_still = bool(reason)
        if is_plane and is_narrow and not is_still:
            reason = (
                f"the camera sees a plane and has moved too little: {median_deg:.1f} of "
                f"{min_parallax_deg:g} deg of parallax"
            )
        elif not reason and good_count < _MIN_GOOD_SHARE * len(rows):
            reason = f"only {good_count} of {len(rows)} points lie before both views"
        elif not reason and kept_count < min_points:
            reason = f"only {kept_count} of {min_points} points have parallax"
    return TwoViewStart(
        T_second_first=pose,
        rows=rows[is_kept],
        points=points[is_kept],
        parallax_deg=angles_deg[is_kept],
        reason=reason,
        is_still=is_still,
    )


def share_in_third_view(
    start: TwoViewStart, rows: npt.NDArray[np.int64], third: Array, camera: Camera
) -> float:
    """Return the share of a start's points with which one pose of a third view agrees.

    Args:
        start: Pose and points of two other views.
        rows: ``(m,)``, rows of the matches of the two views whose first pixel the third view shows, too.
        third: ``(m, 2)`` undistorted pixels of these in the third view.
        camera: Intrinsics of all views.

    Returns:
        The share of the points with a parallax of at least 0.5 degrees; 0 if fewer than 20 are shown.
    """
    _, own, seen = np.intersect1d(start.rows, rows, assume_unique=True, return_indices=True)
    has_parallax = start.parallax_deg[own] >= _THIRD_VIEW_PARALLAX_DEG
    points, pixels = start.points[own[has_parallax]], third[seen[has_parallax]]
    if len(points) < _MIN_THIRD_VIEW_POINTS:
        return 0.0
    is_posed, _, _, inliers = load_opencv().solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        None,
        iterationsCount=_THIRD_VIEW_DRAWS,
        reprojectionError=_THIRD_VIEW_PX,
        confidence=_RANSAC_CONFIDENCE,
    )
    return len(inliers) / len(points) if is_posed else 0.0


def _no_start(reason: str, *, is_still: bool = False) -> TwoViewStart:
    return TwoViewStart(
        T_second_first=np.eye(4),
        rows=np.empty(0, dtype=np.int64),
        points=np.empty((0, 3)),
        parallax_deg=np.empty(0),
        reason=reason,
        is_still=is_still,
    )


def _explained_px(camera: Camera) -> float:
    """Return the largest error, in pixels, of a match that a motion explains."""
    return min(_EXPLAINED_PX, math.radians(_EXPLAINED_DEG) * min(camera.fx, camera.fy))


def _describe_standstill(
    first: Array, second: Array, camera: Camera, max_rotation_share: float = _MAX_ROTATION_SHARE
) -> str:
    """Say that the camera did not move, or only turned; return an empty text if it moved."""
    explained_px = _explained_px(camera)
    moved_px = np.linalg.norm(second - first, axis=1)
    unmoved_share = float((moved_px <= explained_px).mean())
    if unmoved_share > max_rotation_share:
        return (
            f"the camera does not move: {100 * unmoved_share:.0f} % of {len(first)} matches moved by less "
            f"than {explained_px:.2g} px"
        )
    fit = fit_rotation(first, second, camera, inlier_px=explained_px)
    turned_share = float((fit.errors_px <= explained_px).mean())
    if turned_share > max_rotation_share:
        return (
            f"the camera only turns: a rotation of {rotation_angle_deg(fit.R_second_first):.1f} deg explains "
            f"{100 * turned_share:.0f} % of {len(first)} matches"
        )
    return ""


def _explain_by_motions(first: Array, second: Array, camera: Camera) -> tuple[bool, float]:
    """Return whether the scene is one plane, and which share a plane and a rotation together explain.

    Where matches that are not on the plane did not move, the scene is no plane: they are the background of a
    thing that moves.  The plane of the second share is that of the most matches, or that of the most others:
    a thing that moves may have more or fewer matches than its background.
    """
    explained_px = _explained_px(camera)
    on_plane = _is_on_plane(first, second, explained_px)
    on_second_plane = np.zeros(len(first), dtype=np.bool_)
    on_second_plane[~on_plane] = _is_on_plane(first[~on_plane], second[~on_plane], explained_px)
    is_unmoved = np.linalg.norm(second - first, axis=1) <= explained_px
    is_plane = on_plane.mean() >= _MIN_PLANE_SHARE and (is_unmoved & ~on_plane).mean() < _MIN_STILL_SHARE
    shares = []
    for is_explained in (on_plane.copy(), on_second_plane):
        rest = ~is_explained
        if rest.sum() >= _MIN_MOTION_MATCHES:
            rotation = fit_rotation(first[rest], second[rest], camera, inlier_px=explained_px)
            is_explained[rest] = rotation.errors_px <= explained_px
        shares.append(float(is_explained.mean()))
    return bool(is_plane), max(shares)


def _is_on_plane(first: Array, second: Array, explained_px: float) -> npt.NDArray[np.bool_]:
    """Return which matches the homography explains that explains the most of them."""
    homography = None
    if len(first) >= _MIN_MOTION_MATCHES:
        homography, _ = load_opencv().findHomography(first, second, load_opencv().RANSAC, explained_px)
    if homography is None:
        return np.zeros(len(first), dtype=np.bool_)
    moved = np.column_stack([first, np.ones(len(first))]) @ homography.T
    errors_px = np.linalg.norm(moved[:, :2] / moved[:, 2:] - second, axis=1)
    is_on_plane: npt.NDArray[np.bool_] = errors_px <= explained_px
    return is_on_plane
