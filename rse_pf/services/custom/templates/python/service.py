"""@NAME@: compute the centroid and the radius of a point cloud."""

from __future__ import annotations

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.wire.arrays import Array, reshaped

__all__ = ["Reply", "Request", "serve"]


class Request(msgspec.Struct):
    """``points`` holds the 3n coordinates of n points, metres, row by row."""

    points: Array


class Reply(msgspec.Struct):
    """``centroid`` holds 3 metres; ``radius`` is the largest distance of a point from it, metres."""

    centroid: Array
    radius: float


def serve(request: Request) -> Reply:
    """Return the centroid and the radius of the points; raises BadRequest if there are none."""
    points = reshaped("points", request.points, 3)
    if not len(points):
        raise BadRequest("there are no points", hint="send at least one")
    centroid = points.mean(axis=0)
    return Reply(centroid=centroid, radius=float(np.linalg.norm(points - centroid, axis=1).max()))
