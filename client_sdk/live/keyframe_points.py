"""Choose the points of a keyframe that its robot sends for the cloud of a live map.

They are pixels on a grid, thinned to one for each voxel: a keyframe takes a bounded share of the link.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Features, Frame
from client_sdk.tracking.segments import certain_rows
from rse_pf.slam.cloud_deform import voxel_keys
from rse_pf.slam.keyframe_points import encode_points

__all__ = ["points_of"]

_NEAREST_M, _FARTHEST_M = 0.3, 3.5
"""As in a robot's own cloud: beyond, a depth camera is off by centimetres."""
_VOXEL_M = 0.01
_EDGE_SHARE = 0.05
_Pixels = npt.NDArray[np.int64]


def points_of(frame: Frame, features: Features, most: int) -> bytes | None:
    """Return at most *most* points of a keyframe as `encode_points` does; None if it has none.

    With depth these are pixels of a grid that do not lie between two surfaces; of a stereo pair the features
    whose depth is known to 5 %.
    """
    if frame.stereo is None:
        pixels = _grid(frame, most)
        depths_m = frame.depth_m[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    else:
        rows = certain_rows(frame, features)
        size = np.array([frame.camera.width, frame.camera.height]) - 1
        pixels = np.clip(np.rint(features.pixels[rows]).astype(np.int64), 0, size)
        depths_m = features.points_camera[rows, 2].astype(np.float64)
    kept = _one_per_voxel(frame.camera.back_project(pixels.astype(np.float64), depths_m))[:most]
    if not len(kept):
        return None
    pixels = pixels[kept]
    return encode_points(pixels, depths_m[kept], frame.rgb[pixels[:, 1], pixels[:, 0]], frame.camera)


def _grid(frame: Frame, most: int) -> _Pixels:
    """Return columns and rows ``(n, 2)`` of at most *most* pixels whose depth is that of their surface."""
    depth = frame.depth_m
    lines, columns = depth.shape
    step = max(2, math.ceil(math.sqrt(lines * columns / most)))
    rows, columns_of = np.mgrid[step // 2 : lines - 1 : step, step // 2 : columns - 1 : step]
    v, u = rows.ravel(), columns_of.ravel()
    z = depth[v, u]
    with np.errstate(invalid="ignore"):
        usable = (z >= _NEAREST_M) & (z <= _FARTHEST_M)
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            usable &= np.abs(depth[v + dv, u + du] - z) <= _EDGE_SHARE * z
    pixels: _Pixels = np.column_stack((u, v))[usable].astype(np.int64)
    return pixels


def _one_per_voxel(points: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return the rows of the first point of each voxel, in order."""
    _, first = np.unique(voxel_keys(points, _VOXEL_M), axis=0, return_index=True)
    rows: npt.NDArray[np.int64] = np.sort(first)
    return rows
