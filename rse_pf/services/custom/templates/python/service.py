"""@NAME@: where a cloud of points lies, and how far it reaches."""

from __future__ import annotations

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.wire.arrays import Array, reshaped

__all__ = ["Reply", "Request", "serve"]


class Request(msgspec.Struct):
    """``points`` holds 3n metres, row after row."""

    points: Array


class Reply(msgspec.Struct):
    """``centroid`` holds 3 metres; ``radius`` is the largest distance from it."""

    centroid: Array
    radius: float


def serve(request: Request) -> Reply:
    """Return centroid and radius of the points; raises BadRequest without any."""
    points = reshaped("points", request.points, 3)
    if not len(points):
        raise BadRequest("there are no points", hint="send at least one")
    centroid = points.mean(axis=0)
    return Reply(centroid=centroid, radius=float(np.linalg.norm(points - centroid, axis=1).max()))
