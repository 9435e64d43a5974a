"""The service ``optimise``: find the poses of a pose graph that fit its edges best."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from rse_pf.errors import LimitExceeded
from rse_pf.service import Registry, Report
from rse_pf.slam.optimise import OptimiseOptions, ignore_progress, optimise_graph
from rse_pf.slam.pose_graph import read_g2o, write_g2o

__all__ = ["OptimiseReply", "OptimiseRequest", "register"]

MAX_EDGES = 100_000
"""Most edges of the pose graph of a request, which bounds the time and memory of the job; a larger graph is
refused with LimitExceeded."""


class OptimiseRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A pose graph as g2o text; edges between consecutive ids are odometry, all others loop closures."""

    g2o: str
    options: OptimiseOptions | None = None


class OptimiseReply(msgspec.Struct, frozen=True, kw_only=True):
    """The optimised pose graph.

    Attributes:
        g2o: The graph with the optimised poses as g2o text.
        chi2_before: Sum of the squared residuals of all edges before the optimisation, without a robust loss.
        chi2_after: The same sum after the optimisation.
        cost_before: Cost with the robust loss before the optimisation.
        cost_after: Cost with the robust loss after the optimisation.
        components: Number of connected components of the graph.
        doubted: Probable outliers: the loop closures, as pairs of ids of poses, whose residual (Mahalanobis
            norm) after the optimisation is above three times the scale of the robust loss, or above 9 if the
            scale is smaller than 3.  They stay in the graph.
    """

    g2o: str
    chi2_before: float
    chi2_after: float
    cost_before: float
    cost_after: float
    components: int
    doubted: list[tuple[int, int]]


def register(registry: Registry) -> None:
    """Add the service ``optimise``, a long job, to *registry*."""

    @registry.service("optimise", kind="long")
    def optimise(request: OptimiseRequest, *, report: Report = ignore_progress) -> OptimiseReply:
        """Fit the poses of a pose graph to its edges."""
        graph = read_g2o(request.g2o)
        if len(graph.a) > MAX_EDGES:
            raise LimitExceeded(
                f"{len(graph.a)} edges are above {MAX_EDGES}", hint="send a part of the graph"
            )
        options = request.options or OptimiseOptions()
        optimised = optimise_graph(graph, options, report=report)
        squares = graph.squared_residuals(optimised.T_world_pose)
        outliers = np.flatnonzero(graph.robust & (squares > 9.0 * max(options.cauchy, 3.0) ** 2))
        return OptimiseReply(
            g2o=write_g2o(replace(graph, T_world_pose=optimised.T_world_pose)),
            chi2_before=float(graph.squared_residuals(graph.T_world_pose).sum()),
            chi2_after=float(squares.sum()),
            cost_before=optimised.cost_before,
            cost_after=optimised.cost_after,
            components=optimised.components,
            doubted=[(int(graph.ids[graph.a[k]]), int(graph.ids[graph.b[k]])) for k in outliers],
        )
