"""The localisation service: from one view and a map to the pose of the camera in that map.

A pose with few inliers, or on which two keyframes disagree, is not ok.  Earlier views are not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from rse_pf.config import DataSettings
from rse_pf.errors import BadRequest, PnpError
from rse_pf.geometry import Array as Matrix
from rse_pf.geometry import Camera, inverse, pose_difference, transform
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp
from rse_pf.service import Registry
from rse_pf.services.mapping.place import MapIndex, Within, check_comparisons, open_map, view_of
from rse_pf.slam.descriptors import load_faiss
from rse_pf.slam.relative_pose import RelativePoseOptions, View, match_points, reference_of
from rse_pf.wire.arrays import Array

__all__ = ["LocaliseOptions", "LocaliseReply", "LocaliseRequest", "locate", "register"]

_MAX_M = 1e6
"""PnP refuses coordinates beyond it."""


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


class LocaliseReply(msgspec.Struct, frozen=True, kw_only=True):
    """A pose ``T_map_camera`` (16 numbers, row-major) with its evidence.

    ``inliers`` counts the matches of the best keyframe alone; *rmse_px* is over those of all.

    ``verdict``: ok; weak, with a *reason*; or lost, with a reason and without a pose.
    """

    verdict: str
    reason: str = ""
    T_map_camera: Array | None = None
    inliers: int = 0
    rmse_px: float = 0.0
    keyframes: list[int] = []
    """Ids of the keyframes that support the pose, best first."""


@dataclass(frozen=True, slots=True, eq=False)
class _CandidatePose:
    row: int
    points_map: Matrix
    pixels: Matrix
    solution: PnpSolution


def locate(
    index: MapIndex, view: View, options: LocaliseOptions | None = None, *, within: Within | None = None
) -> LocaliseReply:
    """Find the pose of *view* among the keyframes of *index*.

    Place recognition gives candidates, PnP a pose from each; the best one is solved again with the points
    of all candidates that agree with it.

    Returns:
        The reply of the service, with ``T_map_camera`` as ``(4, 4)``.

    Raises:
        MissingExtra: faiss or the solver is not installed.
    """
    options = options or LocaliseOptions()
    rows = index.nearest(view.descriptors, options.candidates, within)
    if not rows:
        return LocaliseReply(verdict="lost", reason="no-candidates")
    candidates = [
        candidate for row, _ in rows if (candidate := _candidate_pose(index, row, view, options)) is not None
    ]
    if not candidates:
        return LocaliseReply(verdict="lost", reason="no-pose")
    candidates.sort(key=lambda candidate: -len(candidate.solution.inliers))
    best = candidates[0]
    agreeing = [candidate for candidate in candidates if _agrees(candidate, best, options)]
    solution = _solve_jointly(agreeing, view, options) or best.solution
    count = len(best.solution.inliers)
    if count < options.min_inliers // 2:
        return LocaliseReply(verdict="lost", reason="few-inliers", inliers=count)
    reason = _weakness(candidates, agreeing, solution, options)
    return LocaliseReply(
        verdict="weak" if reason else "ok",
        reason=reason,
        T_map_camera=inverse(solution.T_camera_world),
        inliers=count,
        rmse_px=solution.rmse_px,
        keyframes=[index.keyframes[candidate.row].id for candidate in agreeing],
    )


def register(registry: Registry, data: DataSettings | None = None) -> None:
    """Add ``localise`` to *registry*; *data* has the limit of a keyframe's features."""
    limits = data or DataSettings()
    keyframe_features = limits.max_keyframe_features

    @registry.service("localise", limited=True, warm_up=load_faiss)
    def localise(request: LocaliseRequest) -> LocaliseReply:
        """Find the camera's pose in a map."""
        view = view_of(request.camera, request.pixels, request.descriptors)
        _, index = open_map(request.map, keyframe_features)
        check_comparisons(index, view, (request.options or LocaliseOptions()).candidates)
        found = locate(index, view, request.options, within=request.within)
        pose = None if found.T_map_camera is None else found.T_map_camera.ravel()
        return msgspec.structs.replace(found, T_map_camera=pose)


def _candidate_pose(index: MapIndex, row: int, view: View, options: LocaliseOptions) -> _CandidatePose | None:
    keyframe = index.keyframes[row]
    reference = reference_of(keyframe)
    points, pixels, _ = match_points(reference, view, RelativePoseOptions(inlier_px=options.inlier_px))
    if len(points) < options.min_inliers // 2:
        return None
    points_map = transform(keyframe.T_world_camera, points)
    if not (np.abs(points_map) <= _MAX_M).all():  # too far from the origin of its map to be solved
        return None
    solution = _solve(points_map, pixels, view, options)
    return None if solution is None else _CandidatePose(row, points_map, pixels, solution)


def _solve_jointly(
    candidates: list[_CandidatePose], view: View, options: LocaliseOptions
) -> PnpSolution | None:
    """Solve with the inliers of all *candidates* together."""
    points = np.concatenate([candidate.points_map[candidate.solution.inliers] for candidate in candidates])
    pixels = np.concatenate([candidate.pixels[candidate.solution.inliers] for candidate in candidates])
    return _solve(points, pixels, view, options)


def _solve(points: Matrix, pixels: Matrix, view: View, options: LocaliseOptions) -> PnpSolution | None:
    try:
        return solve_pnp(points, pixels, view.camera, PnpOptions(inlier_px=options.inlier_px))
    except PnpError:
        return None


def _agrees(candidate: _CandidatePose, best: _CandidatePose, options: LocaliseOptions) -> bool:
    metres, degrees = pose_difference(
        inverse(candidate.solution.T_camera_world), inverse(best.solution.T_camera_world)
    )
    return metres <= options.agree_m and degrees <= options.agree_deg


def _weakness(
    candidates: list[_CandidatePose],
    agreeing: list[_CandidatePose],
    solution: PnpSolution,
    options: LocaliseOptions,
) -> str:
    best = agreeing[0]
    if len(best.solution.inliers) < options.min_inliers:
        return "few-inliers"
    if len(best.solution.inliers) < options.min_inlier_ratio * len(best.pixels):
        return "low-inlier-ratio"
    if solution.verdict != "ok":
        return solution.reason
    rival = max(options.min_inliers, len(best.solution.inliers) // 2)
    if any(
        candidate not in agreeing and len(candidate.solution.inliers) >= rival for candidate in candidates
    ):
        return "keyframes-disagree"
    return ""
