"""Optimise a whole pose graph with GTSAM, with a robust kernel on loop closures.

The same graph gives the same poses, and the result never has a higher cost than the given poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra
from rse_pf.geometry import Array
from rse_pf.service import Report
from rse_pf.slam.pose_graph import PoseGraph, connected_components

__all__ = ["OptimiseOptions", "OptimisedGraph", "ignore_progress", "optimise_graph", "robust_cost"]

Rows = npt.NDArray[np.int64]

_ANCHOR_SIGMA = 1e-6
"""Standard deviation in metres and radians of the prior that fixes the first pose of each component: small
enough to hold it, and large enough for a well conditioned linear system."""
_RELATIVE_COST_CHANGE = 1e-7
"""Relative decrease of the cost of a pose graph below which Levenberg-Marquardt has converged."""
_GTSAM_ORDER = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
"""Index that reorders a 6x6 matrix of twists (translation, rotation) to GTSAM's (rotation, translation)."""


def ignore_progress(done: float, what: str) -> None:
    """Do nothing: a function `rse_pf.service.Report` for callers who do not want to know the progress."""


class OptimiseOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of the optimisation, which a command contains.

    Attributes:
        cauchy: Width of the Cauchy kernel on loop and merge edges, in standard deviations of the residual of
            an edge, up to 1e6; 0 means least squares, without a robust kernel.
        max_iterations: Most iterations of Levenberg-Marquardt from each of its one or two starting points
            (see `optimise_graph`), 1..1000.

    Raises:
        BadRequest: A number is out of its range.
    """

    cauchy: float = 3.0
    max_iterations: int = 60

    def __post_init__(self) -> None:
        if not (0.0 <= self.cauchy <= 1e6 and 1 <= self.max_iterations <= 1000):
            raise BadRequest(
                f"cauchy = {self.cauchy:g} is not within 0..1e6, or max_iterations = "
                f"{self.max_iterations} not within 1..1000",
                hint="leave them out to get the defaults",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OptimisedGraph:
    """The optimised poses of a graph.

    Attributes:
        T_world_pose: ``(n, 4, 4)``, metres.
        cost_before: The robust cost at the given poses.
        cost_after: The robust cost at the optimised poses, at most ``cost_before``.
        components: The number of connected components of the graph.
    """

    T_world_pose: Array
    cost_before: float
    cost_after: float
    components: int


def optimise_graph(
    graph: PoseGraph,
    options: OptimiseOptions | None = None,
    *,
    report: Report = ignore_progress,
    chordal: bool = True,
) -> OptimisedGraph:
    """Return the poses of *graph* that minimise its robust cost, see `robust_cost`.

    Levenberg-Marquardt runs from the given poses, and again from poses whose rotations come from the chordal
    relaxation; the poses with the lowest cost, which may be the given ones, are returned.  The pose with the
    smallest row of each connected component stays fixed.

    Args:
        graph: The pose graph.
        options: None means the defaults.
        report: Called with the progress.
        chordal: Whether to start from the poses of the chordal relaxation, too.  They are skipped if the
            graph is not connected, or has no loops.

    Raises:
        MissingExtra: GTSAM is not installed.
        Cancelled: *report* raised it.

    Source:
        Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017; chordal relaxation: Carlone et al.,
        "Initialization Techniques for 3D SLAM", ICRA 2015.
    """
    options = options or OptimiseOptions()
    gtsam = _load_gtsam()
    # 1. Find the poses that stay fixed, and compute the cost of the given poses.
    anchors = np.unique(connected_components(len(graph.T_world_pose), graph.a, graph.b))
    cost_before = robust_cost(graph, graph.T_world_pose, options.cauchy)
    best_poses, best_cost = graph.T_world_pose, cost_before
    if not len(graph.a):
        return OptimisedGraph(
            T_world_pose=best_poses, cost_before=0.0, cost_after=0.0, components=len(anchors)
        )
    # 2. Minimise the cost from each start, and keep the best poses.
    report(0.0, "from the given poses")
    for share, is_chordal in ((0.1, False), (0.5, True))[: 2 if chordal else 1]:
        report(share, "from the chordal start" if is_chordal else "from the given poses")
        start = _chordal_poses(gtsam, graph, anchors) if is_chordal else graph.T_world_pose
        poses = None if start is None else _minimise(gtsam, graph, start, anchors, options)
        if poses is None:
            continue
        cost = robust_cost(graph, poses, options.cauchy)
        if np.isfinite(poses).all() and cost < best_cost:
            best_poses, best_cost = poses, cost
    report(1.0, "optimised")
    return OptimisedGraph(
        T_world_pose=best_poses, cost_before=cost_before, cost_after=best_cost, components=len(anchors)
    )


def robust_cost(graph: PoseGraph, T_world_pose: Array, cauchy: float) -> float:
    """Return the cost of the poses *T_world_pose* ``(n, 4, 4)`` of *graph*.

    With r the Mahalanobis norm of the residual of an edge, the cost is the sum of r^2 over odometry edges and
    of ``cauchy^2 log(1 + r^2 / cauchy^2)`` over the other edges.  If *cauchy* is 0, it is the sum of r^2 over
    all edges.
    """
    squares = graph.squared_residuals(T_world_pose)
    if cauchy > 0:
        squares = np.where(graph.robust, cauchy**2 * np.log1p(squares / cauchy**2), squares)
    return float(squares.sum())


def _make_factors(gtsam: Any, graph: PoseGraph, anchors: Rows, cauchy: float) -> Any:
    """Return GTSAM's factor graph: priors on the anchors, and a between factor for each edge.

    Edges that may be outliers have a Cauchy kernel of the width *cauchy*, unless this is 0.
    """
    factors = gtsam.NonlinearFactorGraph()
    anchor_noise = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR_SIGMA)
    for row in anchors.tolist():
        factors.add(gtsam.PriorFactorPose3(row, gtsam.Pose3(graph.T_world_pose[row]), anchor_noise))
    kernel = gtsam.noiseModel.mEstimator.Cauchy(cauchy) if cauchy > 0 else None
    for k, (a, b) in enumerate(zip(graph.a.tolist(), graph.b.tolist(), strict=True)):
        noise = gtsam.noiseModel.Gaussian.Information(graph.information[k][_GTSAM_ORDER])
        if kernel is not None and graph.robust[k]:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(graph.T_a_b[k]), noise))
    return factors


def _minimise(
    gtsam: Any, graph: PoseGraph, T_world_pose: Array, anchors: Rows, options: OptimiseOptions
) -> Array | None:
    """Return the poses that Levenberg-Marquardt reaches from *T_world_pose*; None if GTSAM raises an error.

    The poses in the rows *anchors* stay fixed.
    """
    values = gtsam.Values()
    for row, T in enumerate(T_world_pose):
        values.insert(row, gtsam.Pose3(T))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(options.max_iterations)
    parameters.setRelativeErrorTol(_RELATIVE_COST_CHANGE)
    try:
        factors = _make_factors(gtsam, graph, anchors, options.cauchy)
        optimised = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    except RuntimeError:  # GTSAM found an indeterminate linear system: there are no poses from this start.
        return None
    return np.array([optimised.atPose3(row).matrix() for row in range(len(T_world_pose))])


def _chordal_poses(gtsam: Any, graph: PoseGraph, anchors: Rows) -> Array | None:
    """Return poses ``(n, 4, 4)`` from the chordal relaxation of the rotations.

    Returns:
        None if the graph is not connected, or GTSAM finds no finite poses, as for a graph without loops.
    """
    if len(anchors) > 1:
        return None
    try:
        values = gtsam.InitializePose3.initialize(_make_factors(gtsam, graph, anchors, 0.0))
    except RuntimeError:  # The graph has no loops, for which GTSAM has no chordal relaxation.
        return None
    poses = np.array([values.atPose3(row).matrix() for row in range(len(graph.T_world_pose))])
    return poses if np.isfinite(poses).all() else None


def _load_gtsam() -> Any:
    try:
        import gtsam
    except ImportError as error:
        raise MissingExtra("gtsam", "maps") from error
    return gtsam
