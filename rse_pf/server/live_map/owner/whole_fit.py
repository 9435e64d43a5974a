"""Fit a whole graph in a process of its own, which ends with the answer.

gtsam keeps the interpreter while it works: in the owner, no keyframe would be applied meanwhile.  The same
graph has the same poses as in this process.
"""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Callable

import numpy as np

from rse_pf.child.start import ChildPlan, how_ended, start_child
from rse_pf.errors import Crashed
from rse_pf.geometry import Array
from rse_pf.ipc import encode_message, receive
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.pose_graph import PoseGraph

__all__ = ["WholeFit", "fit_apart", "fit_here", "run"]

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
        Crashed: The process failed; its error output tells why.
        TimeoutError: It took two minutes.
    """
    asked = io.BytesIO()
    np.savez(asked, cauchy=options.cauchy, **{name: getattr(graph, name) for name in _ARRAYS})
    child = start_child(ChildPlan(target=f"{__name__}:run", name="rse-pf fit", nice=_NICE))
    try:
        child.say(asked.getvalue())
        answer = receive(child.connection, time.monotonic() + _LONGEST_S)
    finally:
        code = child.kill()
    if answer is None:
        raise Crashed(f"the fit of a whole map ended: {how_ended(code)}", hint="the server's log has it")
    poses: Array = np.frombuffer(answer, dtype="<f8").reshape(graph.T_world_pose.shape)
    return poses


def run(owner: socket.socket) -> None:
    """Read a graph from the *owner* and answer with its poses."""
    with np.load(io.BytesIO(receive(owner)), allow_pickle=False) as asked:
        graph = PoseGraph(**{name: asked[name] for name in _ARRAYS})
        poses = fit_here(graph, OptimiseOptions(cauchy=float(asked["cauchy"])))
    owner.sendall(encode_message(np.ascontiguousarray(poses, dtype="<f8").tobytes()))
