"""The pose-graph service: from a pose graph to the poses that fit its edges best."""

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
"""Limit of one pose graph."""


class OptimiseRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A pose graph as g2o text; edges between consecutive ids are taken for odometry."""

    g2o: str
    options: OptimiseOptions | None = None


class OptimiseReply(msgspec.Struct, frozen=True, kw_only=True):
    """The graph with its new poses as g2o text, and how well it fits (chi2, no kernel)."""

    g2o: str
    chi2_before: float
    chi2_after: float
    cost_before: float
    cost_after: float
    components: int
    doubted: list[tuple[int, int]]
    """Loop edges, as pairs of ids, whose residual is more than three times the width of the kernel."""


def register(registry: Registry) -> None:
    """Add ``optimise`` to *registry*."""

    @registry.service("optimise", kind="long")
    def optimise(request: OptimiseRequest, *, report: Report = ignore_progress) -> OptimiseReply:
        """Fit the poses of a pose graph to its edges."""
        graph = read_g2o(request.g2o)
        if len(graph.a) > MAX_EDGES:
            raise LimitExceeded(
                f"{len(graph.a)} edges are above {MAX_EDGES}", hint="send a part of the graph"
            )
        options = request.options or OptimiseOptions()
        found = optimise_graph(graph, options, report=report)
        squares = graph.squared_residuals(found.T_world_pose)
        wrong = np.flatnonzero(graph.robust & (squares > 9.0 * max(options.cauchy, 3.0) ** 2))
        return OptimiseReply(
            g2o=write_g2o(replace(graph, T_world_pose=found.T_world_pose)),
            chi2_before=graph.chi2(),
            chi2_after=float(squares.sum()),
            cost_before=found.cost_before,
            cost_after=found.cost_after,
            components=found.components,
            doubted=[(int(graph.ids[graph.a[k]]), int(graph.ids[graph.b[k]])) for k in wrong],
        )
