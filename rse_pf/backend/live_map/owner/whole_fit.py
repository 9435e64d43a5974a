"""Fit a whole graph in a process of its own, which ends with the answer.

gtsam keeps the interpreter while it works: in the owner, no keyframe would be applied meanwhile.  The same
graph has the same poses as in this process.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np

from rse_pf.geometry import Array
from rse_pf.linux import die_with_parent
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.pose_graph import PoseGraph

__all__ = ["WholeFit", "fit_apart", "fit_here", "main"]

WholeFit = Callable[[PoseGraph, OptimiseOptions], Array]
"""Returns the ``(n, 4, 4)`` poses that fit the edges of a graph best."""
_NICE = 10
_LONGEST_S = 120.0
_ARRAYS = ("T_world_pose", "a", "b", "T_a_b", "information", "robust", "ids")


def fit_here(graph: PoseGraph, options: OptimiseOptions) -> Array:
    """Return the poses that `optimise_graph` finds, computed in this process; raises MissingExtra."""
    return optimise_graph(graph, options).T_world_pose


def fit_apart(graph: PoseGraph, options: OptimiseOptions) -> Array:
    """Return the poses of `fit_here` from a process of low priority that ends with the calling thread.

    Raises:
        CalledProcessError: The process failed; its error output tells why.
        TimeoutExpired: It took two minutes.
    """
    asked = io.BytesIO()
    np.savez(asked, cauchy=options.cauchy, **{name: getattr(graph, name) for name in _ARRAYS})
    done = subprocess.run(
        [sys.executable, "-m", __name__, str(os.getpid())],
        input=asked.getvalue(), stdout=subprocess.PIPE, timeout=_LONGEST_S, check=True,
    )  # fmt: skip
    poses: Array = np.frombuffer(done.stdout, dtype="<f8").reshape(graph.T_world_pose.shape)
    return poses


def main(arguments: list[str]) -> None:
    """Read a graph from the standard input and write its poses to the standard output.

    Args:
        arguments: The process whose end is this one's, too.
    """
    if not die_with_parent(int(arguments[0])):
        return
    os.nice(_NICE)
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as asked:
        graph = PoseGraph(**{name: asked[name] for name in _ARRAYS})
        poses = fit_here(graph, OptimiseOptions(cauchy=float(asked["cauchy"])))
    with os.fdopen(os.dup(1), "wb") as answer:
        answer.write(np.ascontiguousarray(poses, dtype="<f8").tobytes())


if __name__ == "__main__":
    main(sys.argv[1:])
