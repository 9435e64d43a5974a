"""Align two overlapping clouds, from an initial guess to the pose between them.

A pose that fits worse than the guess, overlaps too little, or is not constrained by the surfaces is refused;
the answer is then the guess, with the reason.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra
from rse_pf.geometry import Array as Matrix
from rse_pf.geometry import pose_difference, transform

__all__ = ["CloudAlignment", "IcpOptions", "align", "load_small_gicp"]

_MIN_POINTS = 100
_NEIGHBOURS = 20
_MIN_GAIN = 0.02
"""A pose must fit better than the guess by this share, unless it is almost equal to it."""
_UNMOVED_M, _UNMOVED_DEG = 0.002, 0.1
_STEP_M, _STEP_RAD = 1e-4, 1e-4
"""The solver ends when a step is smaller than both."""
_MAX_MISFIT = 0.2
"""Mean distance, as a share of the reach, above which surfaces do not fit."""


class IcpOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to align; it travels with a command.

    ``voxel_m`` thins both clouds; ``reach_m`` is the largest distance at which two points may be one;
    ``max_motion_m`` and ``max_motion_deg`` bound how far from the guess an answer is believed;
    ``min_overlap`` is the share of the source that must find the target.

    Raises:
        BadRequest: A number is out of its range.
    """

    voxel_m: float = 0.02
    reach_m: float = 0.15
    max_iterations: int = 60
    min_overlap: float = 0.5
    max_motion_m: float = 0.3
    max_motion_deg: float = 15.0

    def __post_init__(self) -> None:
        within = (
            1e-3 <= self.voxel_m <= 10.0 and self.voxel_m <= self.reach_m <= 100.0
            and 1 <= self.max_iterations <= 1000 and 0.05 <= self.min_overlap <= 1.0
            and self.max_motion_m > 0 and 0 < self.max_motion_deg <= 180
        )  # fmt: skip
        if not within:
            raise BadRequest("an option of icp is out of its range", hint="leave it out for the default")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudAlignment:
    """A pose between two clouds, and its evidence.

    ``verdict`` is ``ok``, or ``refused`` with a *reason* (worse, poor-fit, little-overlap, sliding,
    jumped, not-converged); ``T_target_source`` ``(4, 4)`` then is the guess.
    """

    T_target_source: Matrix
    verdict: str
    reason: str
    overlap: float
    misfit_before_m: float
    misfit_after_m: float
    iterations: int


def align(
    target: Matrix, source: Matrix, T_target_source: Matrix, options: IcpOptions | None = None
) -> CloudAlignment:
    """Refine the pose of *source* in the frame of *target*; deterministic, one thread.

    Generalised ICP with a decreasing reach.  The fit is not measured by the solver but by the mean
    distance of the thinned source points to the planes of their nearest target points, each limited to
    *reach_m*, so that points without correspondence make the fit worse.

    Args:
        target: ``(n, 3)`` metres.
        source: ``(m, 3)`` metres.
        T_target_source: ``(4, 4)``, the initial guess.
        options: ``None`` means the defaults.

    Returns:
        The refined pose, or the guess with the reason why no better one was found.

    Raises:
        BadRequest: Too few points are left after thinning.
        MissingExtra: small_gicp is not installed.

    Source:
        Segal, Haehnel and Thrun, RSS 2009, by small_gicp (Koide 2024).
    """
    options = options or IcpOptions()
    gicp = load_small_gicp()
    target_cloud, target_tree = gicp.preprocess_points(
        np.ascontiguousarray(target), options.voxel_m, num_neighbors=_NEIGHBOURS, num_threads=1
    )
    source_cloud, _ = gicp.preprocess_points(
        np.ascontiguousarray(source), options.voxel_m, num_neighbors=_NEIGHBOURS, num_threads=1
    )
    count = min(target_cloud.size(), source_cloud.size())
    if count < _MIN_POINTS:
        raise BadRequest(
            f"{count} points are left of a cloud thinned to {options.voxel_m:g} m, not {_MIN_POINTS}",
            hint="send more points, in metres, or a smaller voxel_m",
        )
    fit = _FitMeasure(target_cloud, target_tree, source_cloud, options.reach_m)
    before = fit(T_target_source)
    pose, iterations, converged = T_target_source, 0, False
    for reach_m in (options.reach_m, max(options.reach_m / 3.0, 2.0 * options.voxel_m)):
        found = gicp.align(
            target_cloud, source_cloud, target_tree, init_T_target_source=pose, registration_type="GICP",
            max_correspondence_distance=reach_m, num_threads=1, max_iterations=options.max_iterations,
            rotation_epsilon=_STEP_RAD, translation_epsilon=_STEP_M,
        )  # fmt: skip
        pose, converged = np.asarray(found.T_target_source), bool(found.converged)
        iterations += int(found.iterations)
    after = fit(pose) if np.isfinite(pose).all() else _Fit(0.0, math.inf)
    reason = "" if converged else "not-converged"
    reason = reason or _refusal(T_target_source, pose, before, after, fit.constraint(pose), options)
    return CloudAlignment(
        T_target_source=T_target_source if reason else pose,
        verdict="refused" if reason else "ok",
        reason=reason,
        overlap=after.overlap,
        misfit_before_m=before.misfit_m,
        misfit_after_m=after.misfit_m if math.isfinite(after.misfit_m) else options.reach_m,
        iterations=iterations,
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    overlap: float
    misfit_m: float


class _FitMeasure:
    """Measures how well a pose fits, by distances to planes, without the weights of the solver."""

    def __init__(self, target: Any, tree: Any, source: Any, reach_m: float) -> None:
        self._points = np.asarray(target.points())[:, :3]
        self._normals = np.asarray(target.normals())[:, :3]
        self._source = np.asarray(source.points())[:, :3]
        self._tree, self._reach_m = tree, reach_m

    def __call__(self, T_target_source: Matrix) -> _Fit:
        near, distance, _, _ = self._matched(T_target_source)
        misfit = np.where(near, distance, self._reach_m)
        return _Fit(float(near.mean()), float(misfit.mean()))

    def constraint(self, T_target_source: Matrix) -> float:
        """Return how well the surfaces constrain the direction of motion that they constrain least.

        The smallest eigenvalue of the mean outer product of ``(normal, lever x normal)``, with the
        lever in units of the cloud's own size: 0 where the clouds may slide or turn freely.

        Source:
            Gelfand et al., Geometrically stable sampling for the ICP algorithm, 3DIM 2003.
        """
        near, _, moved, normals = self._matched(T_target_source)
        if near.sum() < _MIN_POINTS:
            return 0.0
        lever = moved[near] - moved[near].mean(axis=0)
        lever /= np.linalg.norm(lever, axis=1).mean()
        rows = np.hstack([normals[near], np.cross(lever, normals[near])])
        return float(np.linalg.eigvalsh(rows.T @ rows / len(rows))[0])

    def _matched(self, T_target_source: Matrix) -> tuple[npt.NDArray[np.bool_], Matrix, Matrix, Matrix]:
        moved = transform(T_target_source, self._source)
        found, squared = self._tree.batch_nearest_neighbor_search(moved, num_threads=1)
        nearest = np.asarray(found, dtype=np.int64)
        near = (nearest >= 0) & (np.asarray(squared) <= self._reach_m**2)
        nearest = np.where(nearest >= 0, nearest, 0)
        normals = self._normals[nearest]
        distance = np.abs(np.einsum("ij,ij->i", moved - self._points[nearest], normals))
        return near, distance, moved, normals


_MIN_CONSTRAINT = 0.004
"""Smallest eigenvalue at which surfaces constrain a pose; a plane has 0, a corner about 0.1."""


def _refusal(
    guess: Matrix, pose: Matrix, before: _Fit, after: _Fit, constraint: float, options: IcpOptions
) -> str:
    if after.overlap < options.min_overlap:
        return "little-overlap"
    if after.misfit_m > _MAX_MISFIT * options.reach_m:
        return "poor-fit"
    if constraint < _MIN_CONSTRAINT:
        return "sliding"
    moved_m, turned_deg = pose_difference(pose, guess)
    if moved_m > options.max_motion_m or turned_deg > options.max_motion_deg:
        return "jumped"
    if moved_m <= _UNMOVED_M and turned_deg <= _UNMOVED_DEG:
        return "" if after.misfit_m <= before.misfit_m * (1.0 + _MIN_GAIN) else "worse"
    return "" if after.misfit_m < before.misfit_m * (1.0 - _MIN_GAIN) else "worse"


def load_small_gicp() -> Any:
    """Return small_gicp; raises MissingExtra."""
    try:
        import small_gicp
    except ImportError as error:
        raise MissingExtra("small_gicp", "maps") from error
    return small_gicp
