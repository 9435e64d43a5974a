"""Measure the relative poses of a keyframe and others that may show the same place.

PnP from the new keyframe's points in the other images, refined with the depths of both.  Which keyframes to
try, and which links to believe, is decided elsewhere.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rse_pf.errors import PnpError
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.live_map.events import LinksMeasured, MeasuredLink, matrix_bytes
from rse_pf.live_map.keyframe_code import KeyframeFeatures, decode_features
from rse_pf.native_matcher import match_core
from rse_pf.pnp import PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.slam.descriptors import hamming_matches

__all__ = [
    "MeasureOptions",
    "MeasuredPose",
    "StoredView",
    "decoded_view",
    "joined_links",
    "matched",
    "measure_links",
    "measure_pose",
    "measure_stored",
]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureOptions:
    """Limits of matches and inliers of a link; those of `RelativePoseOptions`, which the recordings gave."""

    ratio: float = 0.75
    inlier_px: float = 3.0
    max_matches: int = 700
    min_inliers: int = 40
    min_inlier_ratio: float = 0.5
    floor_m: float = 0.02
    floor_deg: float = 0.7
    """Smallest standard deviations for each axis: errors of depth and calibration are correlated."""

    def floor(self) -> Array:
        """Return the ``(6, 6)`` covariance that every measured pose has at least."""
        return np.diag([self.floor_m**2] * 3 + [math.radians(self.floor_deg) ** 2] * 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredPose:
    """``T_view_reference`` by PnP and depth, and the number of matches it was found among."""

    solution: PnpSolution
    matches: int

    @property
    def inliers(self) -> int:
        """The number of matches that agree."""
        return len(self.solution.inliers)


_DEFAULT = MeasureOptions()
StoredView = tuple[int, bytes, Camera]
"""Id, encoded features and camera of a keyframe."""


def measure_links(
    keyframe: tuple[int, KeyframeFeatures, Camera],
    others: Sequence[tuple[int, KeyframeFeatures, Camera]],
    options: MeasureOptions = _DEFAULT,
) -> LinksMeasured:
    """Measure the pose of each of *others* relative to *keyframe*; deterministic.

    Args:
        keyframe: Its id, features and camera.
        others: Likewise.
        options: What a link needs.

    Returns:
        The links in the order of *others*, and the number of failures by reason: "no-matches", "no-pose",
        "few-inliers", "low-inlier-ratio", or the reason why the pose is weak.  The information of a link is
        the inverse covariance of the twist (metres, radians) in
        ``log(inverse(T_keyframe_other) @ T_keyframe_other_true)``, as an `Edge` of a map has it.
    """
    number, features, camera = keyframe
    points = features.points_camera(camera)
    links: list[MeasuredLink] = []
    failed: Counter[str] = Counter()
    for other, other_features, other_camera in others:
        found = measure_pose(points, features, other_features, other_camera, options)
        reason = found if isinstance(found, str) else _shortcoming(found, options)
        if isinstance(found, str) or reason:
            failed[reason] += 1
            continue
        # T_other_keyframe true = exp(xi) T_other_keyframe, and its inverse has exp(-xi) on its right.
        information = np.linalg.inv(found.solution.covariance + options.floor())
        links.append(
            MeasuredLink(
                other=other, T_keyframe_other=matrix_bytes(inverse(found.solution.T_camera_world)),
                information=matrix_bytes(0.5 * (information + information.T)),
                inliers=found.inliers, matches=found.matches,
            )
        )  # fmt: skip
    return LinksMeasured(keyframe=number, links=tuple(links), failed=dict(sorted(failed.items())))


def measure_stored(
    keyframe: StoredView, others: Sequence[StoredView], options: MeasureOptions = _DEFAULT
) -> LinksMeasured:
    """Return what `measure_links` does of keyframes as they are kept; raises BadRequest."""
    return measure_links(decoded_view(keyframe), [decoded_view(each) for each in others], options)


def decoded_view(stored: StoredView) -> tuple[int, KeyframeFeatures, Camera]:
    """Return id, features and camera of a keyframe as it is kept; raises BadRequest."""
    number, features, camera = stored
    return number, decode_features(features, camera), camera


def joined_links(keyframe: int, measured: Iterable[LinksMeasured]) -> LinksMeasured:
    """Return what several calls of `measure_links` found for one keyframe, in their order."""
    links: list[MeasuredLink] = []
    failed: Counter[str] = Counter()
    for each in measured:
        links += each.links
        failed.update(each.failed)
    return LinksMeasured(keyframe=keyframe, links=tuple(links), failed=dict(sorted(failed.items())))


def measure_pose(
    points_reference: Array,
    reference: KeyframeFeatures,
    view: KeyframeFeatures,
    camera: Camera,
    options: MeasureOptions = _DEFAULT,
) -> MeasuredPose | str:
    """Return ``T_view_reference``, or the reason why there is none: "no-matches" or "no-pose".

    Args:
        points_reference: ``(n, 3)``, metres, of *reference* in its camera's frame.
        reference: Whose points are sought.
        view: The image in which they are sought.
        camera: Of the view; the depth noise is taken for that of both cameras.
        options: Of matches and inliers; the number of inliers is not judged here.
    """
    points, pixels, depths_m = matched(points_reference, reference, view, options)
    if len(points) < max(4, options.min_inliers // 2):
        return "no-matches"
    try:
        solution = solve_pnp(points, pixels, camera, _pnp_options(options.inlier_px))
    except PnpError:
        return "no-pose"
    solution = refine_with_depth(solution, points, pixels, depths_m, camera)
    return MeasuredPose(solution=solution, matches=len(points))


def matched(
    points_reference: Array, reference: KeyframeFeatures, view: KeyframeFeatures, options: MeasureOptions
) -> tuple[Array, Array, Array]:
    """Return the points of *reference* that *view* shows, ``(k, 3)``, with its pixels and depths there.

    By the native core where its library is built, else in ten times the time.

    Raises:
        MissingExtra: There is neither the native core nor faiss.
    """
    core = match_core()
    if core is not None and len(view) >= 2:
        pixels = view.pixels.astype(np.float64)
        found = core.matches(
            reference.descriptors, points_reference, view.descriptors, pixels, _with_depths(view),
            ratio=options.ratio, max_matches=options.max_matches,
        )  # fmt: skip
        if found is not None:
            return found
    rows, columns = hamming_matches(reference.descriptors, view.descriptors, options.ratio)
    rows, columns = rows[: options.max_matches], columns[: options.max_matches]
    leftmost = np.argsort(view.pixels[columns, 0], kind="stable")
    rows, columns = rows[leftmost], columns[leftmost]
    pixels, depths_m = view.pixels[columns].astype(np.float64), view.depths_m[columns].astype(np.float64)
    return points_reference[rows].round(4), pixels.round(2), depths_m.round(3)


def _with_depths(view: KeyframeFeatures) -> Array:
    """Return ``(n, 3)`` rows whose third number is the depth, which is all that the native core reads."""
    rows = np.zeros((len(view), 3))
    rows[:, 2] = view.depths_m
    return rows


def _shortcoming(found: MeasuredPose, options: MeasureOptions) -> str:
    """Return why a pose is no link, "" if it is one."""
    if found.inliers < options.min_inliers:
        return "few-inliers"
    if found.inliers < options.min_inlier_ratio * found.matches:
        return "low-inlier-ratio"
    return found.solution.reason


@lru_cache(maxsize=16)
def _pnp_options(inlier_px: float) -> PnpOptions:
    return PnpOptions(inlier_px=inlier_px)
