"""Optimise a pose graph in two levels: first each map on its own, then all maps as rigid bodies.

The resulting poses are the initial values for the optimisation of the whole graph, which needs fewer
iterations then.  These functions build the graphs of both levels; the optimisation itself is
`rse_pf.slam.optimise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, adjoint, inverse
from rse_pf.slam.pose_graph import PoseGraph, connected_components

__all__ = ["graph_between", "graphs_within", "poses_of_levels", "stacked"]

Rows = npt.NDArray[np.int64]


def graphs_within(graph: PoseGraph, of_map: Rows) -> list[tuple[Rows, PoseGraph]]:
    """Return for each map the rows of its poses in *graph*, and the graph of these poses and their edges.

    Args:
        graph: The whole pose graph, of ``n`` poses.
        of_map: ``(n,)``, the number of the map of each pose.
    """
    found = []
    for which in np.unique(of_map).tolist():
        rows = np.flatnonzero(of_map == which)
        place = np.full(len(of_map), -1)
        place[rows] = np.arange(len(rows))
        own = (of_map[graph.a] == which) & (of_map[graph.b] == which)
        inner = replace(
            graph, T_world_pose=graph.T_world_pose[rows], a=place[graph.a[own]], b=place[graph.b[own]],
            T_a_b=graph.T_a_b[own], information=graph.information[own], robust=graph.robust[own],
            ids=np.arange(len(rows)),
        )  # fmt: skip
        found.append((rows, inner))
    return found


def graph_between(graph: PoseGraph, of_map: Rows, T_world_pose: Array) -> tuple[Rows, PoseGraph]:
    """Return the number of each pose's rigid body, and the pose graph of the bodies.

    A body is a set of poses that are connected by edges within one map.  The pose of a body is the common
    motion of its poses relative to *T_world_pose*; it is the identity at the start.

    Args:
        graph: The whole pose graph, of ``n`` poses.
        of_map: ``(n,)``, the number of the map of each pose.
        T_world_pose: ``(n, 4, 4)``, the poses after each map was optimised on its own.
    """
    inner = of_map[graph.a] == of_map[graph.b]
    root = connected_components(len(of_map), graph.a[inner], graph.b[inner])
    _, body = np.unique(root, return_inverse=True)
    body = body.ravel().astype(np.int64)
    outer = body[graph.a] != body[graph.b]
    a, b = graph.a[outer], graph.b[outer]
    T_pose_b = T_world_pose[b]
    # log(inverse(M) inverse(A) B) = Ad(T_world_b) log(inverse(T_a_b) ...) with M = T_world_a T_a_b T_b_world.
    to_pose = adjoint(inverse(T_pose_b))
    information = np.swapaxes(to_pose, 1, 2) @ graph.information[outer] @ to_pose
    count = int(body.max()) + 1
    condensed = PoseGraph(
        T_world_pose=np.tile(np.eye(4), (count, 1, 1)),
        a=body[a],
        b=body[b],
        T_a_b=T_world_pose[a] @ graph.T_a_b[outer] @ inverse(T_pose_b),
        information=0.5 * (information + np.swapaxes(information, 1, 2)),
        robust=graph.robust[outer],
        ids=np.arange(count),
    )
    return body, condensed


def poses_of_levels(body: Rows, T_bodies: Array, T_world_pose: Array) -> Array:
    """Return the poses ``(n, 4, 4)``, each moved by the pose of its *body* in *T_bodies*."""
    moved: Array = T_bodies[body] @ T_world_pose
    return moved


def stacked(parts: Sequence[tuple[Rows, Array]], count: int) -> Array:
    """Return ``(count, 4, 4)`` poses, into which the poses of each of *parts* are written at their rows."""
    poses = np.zeros((count, 4, 4))
    for rows, each in parts:
        poses[rows] = each
    return poses
