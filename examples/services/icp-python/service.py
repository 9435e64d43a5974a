"""icp-python: align one cloud of points to another (iterative closest point, point to point)."""

from __future__ import annotations

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array as Matrix
from rse_pf.wire.arrays import Array, reshaped

__all__ = ["Reply", "Request", "serve"]

_MAX_POINTS = 2000
_MIN_POINTS = 3


class Request(msgspec.Struct):
    """``source`` and ``target`` hold 3n and 3m metres, row after row; matched so many times."""

    source: Array
    target: Array
    iterations: int = 30


class Reply(msgspec.Struct):
    """``T_target_source`` holds 16 numbers, row-major: it takes source points to the target's frame."""

    T_target_source: Array
    rmse_m: float


def serve(request: Request) -> Reply:
    """Return the rigid motion that takes the source onto the target, and what is left of the distance.

    Raises:
        BadRequest: Fewer than three points, or more than 2,000.
    """
    source, target = reshaped("source", request.source, 3), reshaped("target", request.target, 3)
    for name, points in (("source", source), ("target", target)):
        if not _MIN_POINTS <= len(points) <= _MAX_POINTS:
            raise BadRequest(f"{name} has {len(points)} points, not 3 to {_MAX_POINTS}")
    T = np.eye(4)
    for _ in range(min(max(request.iterations, 1), 100)):
        moved = source @ T[:3, :3].T + T[:3, 3]
        T = _motion(moved, target[_closest(moved, target)]) @ T
    moved = source @ T[:3, :3].T + T[:3, 3]
    residuals = moved - target[_closest(moved, target)]
    return Reply(T_target_source=T.ravel(), rmse_m=float(np.sqrt((residuals**2).sum(axis=1).mean())))


def _closest(points: Matrix, among: Matrix) -> Matrix:
    """Return for each of *points* ``(n, 3)`` the row of the closest of *among* ``(m, 3)``."""
    return ((points[:, None] - among[None]) ** 2).sum(axis=2).argmin(axis=1)


def _motion(source: Matrix, target: Matrix) -> Matrix:
    """Return the motion ``(4, 4)`` that takes *source* to *target* with least squares (Horn 1987)."""
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    S = (source - centre_source).T @ (target - centre_target)
    trace, skew = np.trace(S), S - S.T
    N = np.empty((4, 4))
    N[0, 0] = trace
    N[0, 1:] = N[1:, 0] = skew[1, 2], skew[2, 0], skew[0, 1]
    N[1:, 1:] = S + S.T - trace * np.eye(3)
    w, x, y, z = np.linalg.eigh(N)[1][:, -1]
    T = np.eye(4)
    T[:3, :3] = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    T[:3, 3] = centre_target - T[:3, :3] @ centre_source
    return T
