"""The service ``localise``: find the pose of a camera in a map from one view.

Each request is independent of earlier views.  A pose with few inliers, or one that another part of the map
would explain as well, is not ok.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Camera, transform
from rse_pf.service import Registry
from rse_pf.services.mapping.place import (
    FeatureKind,
    MapIndex,
    Within,
    check_comparisons,
    open_map,
    view_of,
)
from rse_pf.slam.guided_search import MapLandmarks
from rse_pf.slam.localise import (
    LocalisationCandidate,
    LocalisationOptions,
    is_in_region,
    localise,
    spread_candidates,
)
from rse_pf.slam.relative_pose import RelativePoseOptions, View, landmarks_of_keyframe
from rse_pf.wire.arrays import Array

__all__ = ["LocaliseOptions", "LocaliseReply", "LocaliseRequest", "locate", "register"]

_RETRIEVAL_FACTOR = 6
"""Quotient of the number of keyframes that place recognition retrieves and the number of candidates that are
chosen from them, so that the candidates include other parts of the map that look alike (perceptual
aliases)."""
_MATCH_RATIO = 0.85
"""Limit of Lowe's ratio test between a view and a keyframe: photos are taken from other positions than
keyframes, so that right matches are less distinct than between neighbouring frames."""
_SEARCHED_KEYFRAMES = 12
"""Number of keyframes around a first pose whose landmarks the guided search matches: those that agree with
the pose, and the nearest others."""


class LocaliseOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of a localisation.

    Attributes:
        candidates: Number of keyframes to which the view is matched, 1..100.
        min_inliers: Fewest inliers of a pose that is ok, at least 12.
        min_inlier_ratio: Smallest share of the matches that are inliers of a pose that is ok.
        agree_m: A keyframe supports the best pose if its own pose of the view differs by at most this
            distance, metres.
        agree_deg: A keyframe supports the best pose if its own pose of the view differs by at most this
            angle, degrees.
        inlier_px: Largest reprojection error of an inlier, pixels.

    Raises:
        BadRequest: A number is out of its range.
    """

    candidates: int = 16
    min_inliers: int = 15
    min_inlier_ratio: float = 0.3
    agree_m: float = 0.15
    agree_deg: float = 5.0
    inlier_px: float = 6.0

    def __post_init__(self) -> None:
        if not (1 <= self.candidates <= 100 and self.min_inliers >= 12 and 0 < self.inlier_px <= 100):
            raise BadRequest(
                f"candidates = {self.candidates} is not within 1..100, min_inliers = {self.min_inliers} "
                f"below 12, or inlier_px = {self.inlier_px:g} not within 0..100",
                hint="leave them out to get the defaults",
            )
        if not (0 <= self.min_inlier_ratio <= 1 and self.agree_m > 0 and self.agree_deg > 0):
            raise BadRequest(
                f"min_inlier_ratio = {self.min_inlier_ratio:g} is not within 0..1, or agree_m = "
                f"{self.agree_m:g} or agree_deg = {self.agree_deg:g} not above 0",
                hint="leave them out to get the defaults",
            )


class LocaliseRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A view and the map in which it is localised.

    Attributes:
        map: Encoded map version.
        camera: Intrinsics of the view.
        pixels: ``2n`` undistorted pixel coordinates of the features.
        descriptors: Raw bytes of the ``n`` descriptors; 32 bytes each for ORB.
        within: Prior of the camera's position, such as that of the service ``wifi``; None to search the whole
            map.
        options: Options; None for the defaults.
        features: Kind of the descriptors; None for ORB.
    """

    map: bytes
    camera: Camera
    pixels: Array
    descriptors: bytes
    within: Within | None = None
    options: LocaliseOptions | None = None
    features: FeatureKind | None = None


class LocaliseReply(msgspec.Struct, frozen=True, kw_only=True):
    """The pose of the camera in the map with its evidence.

    Attributes:
        verdict: ``ok``; ``weak`` for a pose that may be wrong; ``lost`` without a pose, for which
            `rse_pf.slam.localise` says ``none``.
        reason: Why the pose is weak or missing; empty for a pose that is ok.
        T_map_camera: 16 numbers, row-major, maps camera points (metres) to the map frame; None without a
            pose.
        inliers: Number of inliers of the best keyframe, which is the candidate with most inliers, also where
            the pose was computed from several keyframes.
        rmse_px: Root mean square reprojection error of these inliers.
        keyframes: Ids of the keyframes that support the pose, best first.
        covariance: 36 numbers, row-major, the covariance of the twist (metres, radians) that multiplies the
            pose on the left; None without a pose.
    """

    verdict: str
    reason: str = ""
    T_map_camera: Array | None = None
    inliers: int = 0
    rmse_px: float = 0.0
    keyframes: list[int] = []
    covariance: Array | None = None


def locate(
    index: MapIndex, view: View, options: LocaliseOptions | None = None, *, within: Within | None = None
) -> LocaliseReply:
    """Find the pose of *view* in the map of *index*.

    Args:
        index: Index of the map.
        view: Features of the camera's image.
        options: Options; None for the defaults.
        within: Prior of the camera's position; None to search the whole map.

    Returns:
        The reply of the service, with ``T_map_camera`` as ``(4, 4)`` and ``covariance`` as ``(6, 6)``; both
        are None, and the verdict is ``lost``, if no candidate gives a pose.

    Raises:
        MissingExtra: The native core is not installed.
    """
    # 1. Retrieve similar keyframes by place recognition.
    options = options or LocaliseOptions()
    similar = index.nearest(view.descriptors, _RETRIEVAL_FACTOR * options.candidates, within)
    # 2. Choose the candidates among them.  At most three quarters of the candidates come from one region of
    # the map, so that the view is also matched to another region that looks alike.
    limits = LocalisationOptions(
        relative_pose=RelativePoseOptions(
            ratio=_MATCH_RATIO,
            min_inliers=options.min_inliers,
            min_inlier_ratio=options.min_inlier_ratio,
            inlier_px=options.inlier_px,
        ),
        min_candidate_inliers=options.min_inliers // 2,
        agree_m=options.agree_m,
        agree_deg=options.agree_deg,
        max_per_region=max(1, 3 * options.candidates // 4),
        fits_camera=True,
    )
    rows = spread_candidates(similar, index.T_map_keyframe, options.candidates, limits)
    candidates = [
        LocalisationCandidate(
            id=row,
            landmarks=landmarks_of_keyframe(index.keyframes[row]),
            T_map_keyframe=index.keyframes[row].T_world_camera,
        )
        for row in rows
    ]
    # 3. Estimate the pose of the view with each candidate, decide by their agreement whether it is ok, and
    # estimate it again with the landmarks of all keyframes around it.
    located = localise(
        candidates, view, limits, landmarks_around=functools.partial(_landmarks_around, index, limits)
    )
    return LocaliseReply(
        verdict="lost" if located.verdict == "none" else located.verdict,
        reason=located.reason,
        T_map_camera=located.T_map_camera,
        inliers=located.inliers,
        rmse_px=located.rmse_px,
        keyframes=[index.keyframes[row].id for row in located.keyframes],
        covariance=located.covariance,
    )


def _landmarks_around(
    index: MapIndex, limits: LocalisationOptions, T_map_camera: Array, agreeing: Sequence[int]
) -> MapLandmarks:
    """Return the landmarks of the *agreeing* keyframes, given as rows of *index*, and of those around a pose.

    Around a pose are the nearest keyframes of its region.
    """
    poses = index.T_map_keyframe
    region = np.flatnonzero(is_in_region(poses, T_map_camera, limits))
    distances_m = np.linalg.norm(poses[region, :3, 3] - T_map_camera[:3, 3], axis=1)
    nearest = region[np.argsort(distances_m, kind="stable")]
    chosen = list(dict.fromkeys([*agreeing, *nearest.tolist()]))[:_SEARCHED_KEYFRAMES]
    landmarks = [landmarks_of_keyframe(index.keyframes[row]) for row in chosen]
    return MapLandmarks(
        points_map=np.concatenate(
            [transform(poses[row], found.points_camera) for row, found in zip(chosen, landmarks, strict=True)]
        ),
        descriptors=np.concatenate([found.descriptors for found in landmarks]),
    )


def register(registry: Registry) -> None:
    """Add the service ``localise`` to *registry*."""

    @registry.service("localise", limited=True)
    def answer(request: LocaliseRequest) -> LocaliseReply:
        """Find the camera's pose in a map."""
        _, index = open_map(request.map)
        view = view_of(request.camera, request.pixels, request.descriptors, request.features, index)
        check_comparisons(index, view, (request.options or LocaliseOptions()).candidates)
        reply = locate(index, view, request.options, within=request.within)
        if reply.T_map_camera is None or reply.covariance is None:
            return reply
        return msgspec.structs.replace(
            reply, T_map_camera=reply.T_map_camera.ravel(), covariance=reply.covariance.ravel()
        )
