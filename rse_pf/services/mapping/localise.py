"""The localisation service: from one view and a map to the pose of the camera in that map.

A pose with few inliers, or that another place contradicts, is not ok.  Earlier views are not used.
"""

from __future__ import annotations

import msgspec

from rse_pf.errors import BadRequest
from rse_pf.geometry import Camera
from rse_pf.service import Registry
from rse_pf.services.mapping.place import (
    FeatureKind,
    MapIndex,
    Within,
    check_comparisons,
    open_map,
    view_of,
)
from rse_pf.slam.localise import LocalisationCandidate, LocalisationOptions, localise, spread_candidates
from rse_pf.slam.relative_pose import RelativePoseOptions, View, landmarks_of_keyframe
from rse_pf.wire.arrays import Array

__all__ = ["LocaliseOptions", "LocaliseReply", "LocaliseRequest", "locate", "register"]

_SEARCHED = 6
"""So many times the candidates are looked at, so that a second place that looks alike is compared, too."""


class LocaliseOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to localise.

    A pose is ok from *min_inliers*; *candidates* keyframes are looked at; keyframes whose own pose of
    the view differs by more than *agree_m* or *agree_deg* from the best one do not count for it.

    Raises:
        BadRequest: A number is out of its range.
    """

    candidates: int = 8
    min_inliers: int = 30
    min_inlier_ratio: float = 0.3
    agree_m: float = 0.15
    agree_deg: float = 5.0
    inlier_px: float = 3.0

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
    """A view and an encoded map version; *within* is a prior, such as what ``wifi`` answers."""

    map: bytes
    camera: Camera
    pixels: Array
    descriptors: bytes
    within: Within | None = None
    options: LocaliseOptions | None = None
    features: FeatureKind | None = None
    """None for ORB."""


class LocaliseReply(msgspec.Struct, frozen=True, kw_only=True):
    """A pose ``T_map_camera`` (16 numbers, row-major) with its evidence.

    ``covariance`` (36 numbers, row-major) is of the twist (metres, radians) on the left of the pose.
    ``inliers`` counts the matches of the best keyframe, and *rmse_px* is over them.

    ``verdict``: ok; weak, with a *reason*; or lost, with a reason and without a pose.
    """

    verdict: str
    reason: str = ""
    T_map_camera: Array | None = None
    inliers: int = 0
    rmse_px: float = 0.0
    keyframes: list[int] = []
    """Ids of the keyframes that support the pose, best first."""
    covariance: Array | None = None


def locate(
    index: MapIndex, view: View, options: LocaliseOptions | None = None, *, within: Within | None = None
) -> LocaliseReply:
    """Find the pose of *view* among the keyframes of *index*.

    Place recognition gives candidates of each place that looks alike, and `rse_pf.slam.localise` decides.

    Returns:
        The reply of the service, with ``T_map_camera`` as ``(4, 4)`` and ``covariance`` as ``(6, 6)``.

    Raises:
        MissingExtra: The native core is not installed.
    """
    options = options or LocaliseOptions()
    similar = index.nearest(view.descriptors, _SEARCHED * options.candidates, within)
    limits = LocalisationOptions(
        measured=RelativePoseOptions(
            min_inliers=options.min_inliers, min_inlier_ratio=options.min_inlier_ratio,
            inlier_px=options.inlier_px,
        ),
        min_candidate_inliers=options.min_inliers // 2,
        agree_m=options.agree_m,
        agree_deg=options.agree_deg,
        max_per_region=max(1, 3 * options.candidates // 4),
        fits_camera=True,
    )  # fmt: skip
    rows = spread_candidates(similar, index.T_map_keyframe, options.candidates, limits)
    keyframes = [index.keyframes[row] for row in rows]
    candidates = [
        LocalisationCandidate(id=k.id, landmarks=landmarks_of_keyframe(k), T_map_keyframe=k.T_world_camera)
        for k in keyframes
    ]
    located = localise(candidates, view, limits)
    return LocaliseReply(
        verdict="lost" if located.verdict == "none" else located.verdict,
        reason=located.reason,
        T_map_camera=located.T_map_camera,
        inliers=located.inliers,
        rmse_px=located.rmse_px,
        keyframes=list(located.keyframes),
        covariance=located.covariance,
    )


def register(registry: Registry) -> None:
    """Add ``localise`` to *registry*."""

    @registry.service("localise", limited=True)
    def answer(request: LocaliseRequest) -> LocaliseReply:
        """Find the camera's pose in a map."""
        _, index = open_map(request.map)
        view = view_of(request.camera, request.pixels, request.descriptors, request.features, index)
        check_comparisons(index, view, (request.options or LocaliseOptions()).candidates)
        found = locate(index, view, request.options, within=request.within)
        if found.T_map_camera is None or found.covariance is None:
            return found
        return msgspec.structs.replace(
            found, T_map_camera=found.T_map_camera.ravel(), covariance=found.covariance.ravel()
        )
