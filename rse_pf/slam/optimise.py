"""Fit the poses of a whole pose graph to its edges.

The same graph gives the same poses, which never fit worse than the given ones.
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
from rse_pf.slam.pose_graph import PoseGraph, components

__all__ = [
    "OptimiseOptions",
    "OptimisedGraph",
    "ignore_progress",
    "optimise_graph",
    "robust_cost",
]  # fmt: skip

Rows = npt.NDArray[np.int64]

_ANCHOR_SIGMA = 1e-6
_RELATIVE_CHANGE = 1e-7


def ignore_progress(done: float, what: str) -> None:
    """Do nothing with the progress."""


class OptimiseOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to optimise; it travels with a command.

    ``cauchy`` is the width of the Cauchy kernel on loop and merge edges, in standard deviations of an
    edge's residual; 0 means least squares.

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
    """Poses ``(n, 4, 4)`` with the robust cost before and after."""

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
    """Return the poses of *graph* that fit its edges best.

    Minimises ``sum of squares of odometry + sum of cauchy**2 log(1 + squares / cauchy**2)`` of the
    other edges by Levenberg-Marquardt, once from the given poses and once from poses whose rotations
    the chordal relaxation found, and keeps the better.  The pose with the smallest row number of each
    connected component stays fixed.  With *chordal* False only the given poses are a start.

    Raises:
        MissingExtra: gtsam is not installed.
        Cancelled: *report* raised it.

    Source:
        Dellaert and Kaess, Factor Graphs for Robot Perception (2017); chordal start after Carlone et
        al., ICRA 2015.
    """
    options = options or OptimiseOptions()
    gtsam = _gtsam()
    part = components(len(graph.T_world_pose), graph.a, graph.b)
    anchors = np.unique(part)
    cost_before = robust_cost(graph, graph.T_world_pose, options.cauchy)
    best, best_cost = graph.T_world_pose, cost_before
    if not len(graph.a):
        return OptimisedGraph(
            T_world_pose=best, cost_before=0.0, cost_after=0.0, components=len(anchors)
        )  # fmt: skip
    report(0.0, "from the given poses")
    for share, start in ((0.1, None), (0.5, "chordal"))[: 2 if chordal else 1]:
        report(share, "from the given poses" if start is None else "from the chordal start")
        poses = graph.T_world_pose if start is None else _chordal(gtsam, graph, anchors)
        found = None if poses is None else _minimise(gtsam, graph, poses, anchors, options)
        if found is None:
            continue
        cost = robust_cost(graph, found, options.cauchy)
        if np.isfinite(found).all() and cost < best_cost:
            best, best_cost = found, cost
    report(1.0, "optimised")
    return OptimisedGraph(
        T_world_pose=best, cost_before=cost_before, cost_after=best_cost, components=len(anchors)
    )  # fmt: skip


def robust_cost(graph: PoseGraph, T_world_pose: Array, cauchy: float) -> float:
    """Return what `optimise_graph` minimises, at *T_world_pose*."""
    squares = graph.squared_residuals(T_world_pose)
    if cauchy > 0:
        squares = np.where(graph.robust, cauchy**2 * np.log1p(squares / cauchy**2), squares)
    return float(squares.sum())


def _factors(gtsam: Any, graph: PoseGraph, anchors: Rows, cauchy: float) -> Any:
    """Return the graph for gtsam, whose twists are (phi, rho)."""
    swap = [3, 4, 5, 0, 1, 2]
    factors = gtsam.NonlinearFactorGraph()
    tight = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR_SIGMA)
    for row in anchors.tolist():
        factors.add(gtsam.PriorFactorPose3(row, gtsam.Pose3(graph.T_world_pose[row]), tight))
    kernel = gtsam.noiseModel.mEstimator.Cauchy(cauchy) if cauchy > 0 else None
    for k, (a, b) in enumerate(zip(graph.a.tolist(), graph.b.tolist(), strict=True)):
        noise = gtsam.noiseModel.Gaussian.Information(graph.information[k][np.ix_(swap, swap)])
        if kernel is not None and graph.robust[k]:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(graph.T_a_b[k]), noise))
    return factors


def _minimise(
    gtsam: Any, graph: PoseGraph, T_world_pose: Array, anchors: Rows, options: OptimiseOptions
) -> Array | None:
    """Return the best poses from *T_world_pose* on, None where the linear systems have no solution."""
    values = gtsam.Values()
    for row, T in enumerate(T_world_pose):
        values.insert(row, gtsam.Pose3(T))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(options.max_iterations)
    parameters.setRelativeErrorTol(_RELATIVE_CHANGE)
    try:
        factors = _factors(gtsam, graph, anchors, options.cauchy)
        found = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    except RuntimeError:  # raised for an indeterminate system
        return None
    return np.array([found.atPose3(row).matrix() for row in range(len(T_world_pose))])


def _chordal(gtsam: Any, graph: PoseGraph, anchors: Rows) -> Array | None:
    """Return poses from the chordal relaxation of the rotations, None if there is none."""
    if len(anchors) > 1:
        return None
    try:
        values = gtsam.InitializePose3.initialize(_factors(gtsam, graph, anchors, 0.0))
    except RuntimeError:  # raised for a graph without loops
        return None
    poses = np.array([values.atPose3(row).matrix() for row in range(len(graph.T_world_pose))])
    return poses if np.isfinite(poses).all() else None


def _gtsam() -> Any:
    try:
        import gtsam
    except ImportError as error:
        raise MissingExtra("gtsam", "maps") from error
    return gtsam
