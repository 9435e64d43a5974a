"""Align two overlapping point clouds by generalised ICP, starting from an initial pose.

The refined pose is rejected if it fits worse than the initial pose, if the clouds overlap too little, or if
their surfaces do not constrain it.  The result is then the initial pose, with the reason.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra
from rse_pf.geometry import Array, pose_difference, transform

__all__ = ["CloudAlignment", "IcpOptions", "align_clouds", "load_small_gicp"]

_MIN_POINTS = 100
"""Smallest number of points of a thinned cloud, and of correspondences between two clouds.  Fewer points are
an error; with fewer correspondences a refined pose is rejected."""
_NEIGHBOURS = 20  # number of nearest points from which the normal and covariance of a point are estimated
_MIN_GAIN = 0.02
"""Tolerance of the comparison of the mean distances between the clouds at the refined and at the initial
pose, as a share of the latter.  If the poses differ, the refined one is accepted if its distance is smaller
by more than this share.  If they count as equal, it is accepted unless its distance is larger by more than
this share."""
_UNCHANGED_M = 0.002
"""Translation in metres up to which a pose refined by ICP counts as equal to the initial pose."""
_UNCHANGED_DEG = 0.1
"""Rotation in degrees up to which a pose refined by ICP counts as equal to the initial pose."""
_CONVERGED_M = 1e-4  # translation in metres of an ICP step below which the solver has converged
_CONVERGED_RAD = 1e-4  # rotation in radians of an ICP step below which the solver has converged
_MAX_MISFIT_SHARE = 0.2
"""Mean distance between the clouds at the refined pose, as a share of `IcpOptions.reach_m`, above which the
pose is rejected because the surfaces do not fit."""
_MIN_CONSTRAINT = 0.004
"""Limit for the smallest eigenvalue of the constraint matrix (`_Surfaces.measure_constraint`).  If that
eigenvalue is below the limit, the surfaces do not determine all six degrees of freedom of the pose.  It is 0
for a plane, and about 0.1 for the corner of a room."""


class IcpOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of an alignment, which a command contains.

    Attributes:
        voxel_m: Edge of the voxels to which both clouds are thinned, 1e-3..10 m.
        reach_m: Largest distance between corresponding points, voxel_m..100 m.
        max_iterations: Most iterations of the solver in each of its two stages, 1..1000.  The first stage
            uses *reach_m*, the second one a third of it, but at least two voxels.
        min_overlap: Smallest share of the thinned source points with a correspondence at an accepted pose,
            0.05..1.
        max_motion_m: Largest translation from the initial pose to an accepted one, metres, above 0.
        max_motion_deg: Largest rotation from the initial pose to an accepted one, degrees, above 0 and up to
            180.

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
        is_within = (
            1e-3 <= self.voxel_m <= 10.0
            and self.voxel_m <= self.reach_m <= 100.0
            and 1 <= self.max_iterations <= 1000
            and 0.05 <= self.min_overlap <= 1.0
            and self.max_motion_m > 0
            and 0 < self.max_motion_deg <= 180
        )
        if not is_within:
            raise BadRequest(
                "an option of icp is out of its range: voxel_m 0.001..10, reach_m voxel_m..100, "
                "max_iterations 1..1000, min_overlap 0.05..1, max_motion_m above 0, max_motion_deg above 0 "
                "and up to 180",
                hint="leave the option out for its default",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudAlignment:
    """The pose between two clouds, and how well it fits.

    Attributes:
        T_target_source: ``(4, 4)``, metres; the initial pose if the verdict is ``refused``.
        verdict: ``ok`` or ``refused``.
        reason: Why the refined pose was rejected, "" if it was accepted.  "worse": it fits worse than the
            initial pose; "poor-fit": the surfaces do not fit; "little-overlap"; "sliding": the surfaces do
            not constrain the pose; "jumped": it is too far from the initial pose; "not-converged".
        overlap: Share of the thinned source points with a target point within ``reach_m``, at the refined
            pose, also if it was rejected.
        misfit_before_m: Mean distance of source points to the target's surface at the initial pose; a point
            without a correspondence counts as ``reach_m``.
        misfit_after_m: Mean distance of source points to the target's surface at the refined pose, also if it
            was rejected.
        iterations: Iterations of the solver in both stages together.
    """

    T_target_source: Array
    verdict: str
    reason: str
    overlap: float
    misfit_before_m: float
    misfit_after_m: float
    iterations: int


def align_clouds(
    target: Array, source: Array, T_target_source: Array, options: IcpOptions | None = None
) -> CloudAlignment:
    """Refine the pose of *source* in the frame of *target* by generalised ICP; deterministic, in one thread.

    The fit of a pose is not measured by the cost of the solver.  It is the mean distance of the thinned
    source points to the tangent planes of their nearest target points, where a point without correspondence
    counts as ``reach_m``, so that losing correspondences makes the fit worse.

    Args:
        target: ``(n, 3)`` metres.
        source: ``(m, 3)`` metres.
        T_target_source: ``(4, 4)``, the initial pose.
        options: None means the defaults.

    Raises:
        BadRequest: Fewer than 100 points are left of a cloud after thinning.
        MissingExtra: small_gicp is not installed.

    Source:
        Segal, Haehnel and Thrun, "Generalized-ICP", RSS 2009; implementation small_gicp (Koide 2024).
    """
    options = options or IcpOptions()
    gicp = load_small_gicp()
    # 1. Thin both clouds and estimate the normals and covariances of their points.
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
    surfaces = _Surfaces(target_cloud, target_tree, source_cloud, options.reach_m)
    before = surfaces.measure_fit(T_target_source)
    # 2. Refine the pose with the correspondence distance reach_m, then with a third of it (but at least two
    # voxels).
    pose, iterations, has_converged = T_target_source, 0, False
    for reach_m in (options.reach_m, max(options.reach_m / 3.0, 2.0 * options.voxel_m)):
        result = gicp.align(
            target_cloud,
            source_cloud,
            target_tree,
            init_T_target_source=pose,
            registration_type="GICP",
            max_correspondence_distance=reach_m,
            num_threads=1,
            max_iterations=options.max_iterations,
            rotation_epsilon=_CONVERGED_RAD,
            translation_epsilon=_CONVERGED_M,
        )
        pose, has_converged = np.asarray(result.T_target_source), bool(result.converged)
        iterations += int(result.iterations)
    # 3. Measure the fit at the refined pose, and reject the pose or accept it.
    after = surfaces.measure_fit(pose) if np.isfinite(pose).all() else _Fit(0.0, math.inf)
    reason = "" if has_converged else "not-converged"
    reason = reason or _rejection(
        T_target_source, pose, before, after, surfaces.measure_constraint(pose), options
    )
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


class _Surfaces:
    """Two thinned clouds, between which distances to tangent planes are measured at any pose."""

    def __init__(self, target: Any, tree: Any, source: Any, reach_m: float) -> None:
        self._points = np.asarray(target.points())[:, :3]
        self._normals = np.asarray(target.normals())[:, :3]
        self._source = np.asarray(source.points())[:, :3]
        self._tree, self._reach_m = tree, reach_m

    def measure_fit(self, T_target_source: Array) -> _Fit:
        """Return the share of source points with a correspondence, and the mean point-to-plane distance.

        A point without a correspondence counts as ``reach_m`` in the mean.
        """
        has_match, distance, _, _ = self._correspondences(T_target_source)
        distance = np.where(has_match, distance, self._reach_m)
        return _Fit(float(has_match.mean()), float(distance.mean()))

    def measure_constraint(self, T_target_source: Array) -> float:
        """Return how well the surfaces constrain a pose in its weakest direction.

        The number is 0 if they can slide along each other, or have fewer than 100 correspondences.

        The measure is the smallest eigenvalue of the mean outer product of ``(normal, lever x normal)``,
        where levers are divided by their mean length.

        Source:
            Gelfand et al., "Geometrically stable sampling for the ICP algorithm", 3DIM 2003.
        """
        has_match, _, points, normals = self._correspondences(T_target_source)
        if has_match.sum() < _MIN_POINTS:
            return 0.0
        lever = points[has_match] - points[has_match].mean(axis=0)
        lever /= np.linalg.norm(lever, axis=1).mean()
        rows = np.hstack([normals[has_match], np.cross(lever, normals[has_match])])
        return float(np.linalg.eigvalsh(rows.T @ rows / len(rows))[0])

    def _correspondences(self, T_target_source: Array) -> tuple[npt.NDArray[np.bool_], Array, Array, Array]:
        """Return for each source point whether it has a correspondence, and its point-to-plane distance.

        A point has a correspondence if a target point is within ``reach_m`` of it.
        The last two arrays are the source points in the target's frame, and the normal of the nearest target
        point of each.  A point without correspondence has numbers, too, which mean nothing.
        """
        points = transform(T_target_source, self._source)
        indices, squared_distances = self._tree.batch_nearest_neighbor_search(points, num_threads=1)
        nearest = np.asarray(indices, dtype=np.int64)
        has_match = (nearest >= 0) & (np.asarray(squared_distances) <= self._reach_m**2)
        nearest = np.where(nearest >= 0, nearest, 0)
        normals = self._normals[nearest]
        distance = np.abs(np.einsum("ij,ij->i", points - self._points[nearest], normals))
        return has_match, distance, points, normals


def _rejection(
    initial: Array, pose: Array, before: _Fit, after: _Fit, constraint: float, options: IcpOptions
) -> str:
    """Return the reason to reject a refined *pose* (`CloudAlignment.reason`), "" if it is accepted.

    *before* and *after* are the fits at the *initial* and at the refined pose, and *constraint* is what
    `_Surfaces.measure_constraint` returns for the refined pose.
    """
    if after.overlap < options.min_overlap:
        return "little-overlap"
    if after.misfit_m > _MAX_MISFIT_SHARE * options.reach_m:
        return "poor-fit"
    if constraint < _MIN_CONSTRAINT:
        return "sliding"
    moved_m, rotated_deg = pose_difference(pose, initial)
    if moved_m > options.max_motion_m or rotated_deg > options.max_motion_deg:
        return "jumped"
    if moved_m <= _UNCHANGED_M and rotated_deg <= _UNCHANGED_DEG:
        return "" if after.misfit_m <= before.misfit_m * (1.0 + _MIN_GAIN) else "worse"
    return "" if after.misfit_m < before.misfit_m * (1.0 - _MIN_GAIN) else "worse"


def load_small_gicp() -> Any:
    """Import and return the module small_gicp; raises MissingExtra if it is not installed."""
    try:
        import small_gicp
    except ImportError as error:
        raise MissingExtra("small_gicp", "maps") from error
    return small_gicp
