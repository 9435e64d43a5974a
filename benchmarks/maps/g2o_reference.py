"""Optimise one pose graph with g2o, for the comparison in `pose_graphs.py`.

Needs a separate interpreter with g2o-python and numpy below 2 (with numpy 2 the wheel crashes):

    VENV/bin/python g2o_reference.py < ORDER.json > ANSWER.json

The order has ``g2o`` (text), ``robust`` (for each edge), ``cauchy`` (width of the kernel on robust edges, 0
for none) and ``rounds``; the answer ``poses`` (4 x 4, one for each vertex, in their order), ``chi2`` of them
(no kernel), and ``seconds`` of the optimiser alone.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import g2o
import numpy as np


def matrix(words: list[str]) -> Any:
    """Return the symmetric 6 x 6 matrix whose upper triangle *words* give."""
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = [float(word) for word in words]
    return upper + np.triu(upper, 1).T


def optimizer_of(order: dict[str, Any]) -> tuple[Any, list[Any]]:
    """Return an optimiser that holds the graph, and its vertices; the first is fixed."""
    optimizer = g2o.SparseOptimizer()
    optimizer.set_algorithm(
        g2o.OptimizationAlgorithmLevenberg(g2o.BlockSolverSE3(g2o.LinearSolverEigenSE3()))
    )
    vertices: list[Any] = []
    edges = 0
    for words in (line.split() for line in order["g2o"].splitlines()):
        if words[0] == "VERTEX_SE3:QUAT":
            vertex = g2o.VertexSE3()
            vertex.set_id(int(words[1]))
            vertex.set_estimate_data(np.array([float(word) for word in words[2:9]]))
            vertex.set_fixed(not vertices)
            optimizer.add_vertex(vertex)
            vertices.append(vertex)
            continue
        x, y, z, qx, qy, qz, qw = (float(word) for word in words[3:10])
        edge = g2o.EdgeSE3()
        for end, name in enumerate(words[1:3]):
            edge.set_vertex(end, optimizer.vertex(int(name)))
        edge.set_measurement(g2o.Isometry3d(g2o.Quaternion(qw, qx, qy, qz), np.array([x, y, z])))
        edge.set_information(matrix(words[10:]))
        if order["robust"][edges] and order["cauchy"] > 0:
            edge.set_robust_kernel(g2o.RobustKernelCauchy(order["cauchy"]))
        optimizer.add_edge(edge)
        edges += 1
    return optimizer, vertices


def fit() -> None:
    """Read the order, fit, write the answer."""
    order = json.load(sys.stdin)
    optimizer, vertices = optimizer_of(order)
    optimizer.initialize_optimization()
    began = time.perf_counter()
    optimizer.optimize(order["rounds"])
    seconds = time.perf_counter() - began
    optimizer.compute_active_errors()
    json.dump(
        {
            "poses": [vertex.estimate().matrix().tolist() for vertex in vertices],
            "chi2": float(optimizer.active_chi2()), "seconds": seconds,
        },
        sys.stdout,
    )  # fmt: skip


if __name__ == "__main__":
    fit()
