"""Where up is in a cloud whose gravity nobody measured: across the floors, tables and ceilings in it."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.maps.format import MapVersion

__all__ = ["UpSource", "up_of_floor", "up_of_map", "up_of_surfaces"]

UpSource = Literal["the map", "--up", "the floor", "the level surfaces", "the cameras"]
_LEAST_UP = 0.5
"""Length of the mean of the cameras' unit vectors, below which they do not agree on where up is."""

_VOXEL_M = 0.15
_MAX_POINTS = 500_000
_LEAST_POINTS, _LEAST_VOXELS = 12, 20
_FLAT = 0.02
"""A voxel is flat if its points spread at most this share of their variance along its surface across it."""
_LEVEL_DEG, _ALIKE_DEG = 30.0, 5.0
_MOST_TRIED = 500
_CELL_M, _LEAST_OF_CELL, _LEAST_CELLS = 0.25, 10, 40
_FLOOR_M = (0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05, 0.05)
"""Heights beside the plane from which a cell does not count, from one fit to the next."""
_LEAST_SHARE, _LEAST_WIDTH_M, _MOST_OFF_DEG = 0.5, 1.0, 5.0


def up_of_map(version: MapVersion) -> tuple[Array, UpSource] | None:
    """Return the unit vector of where up is in a map that has keyframes, and what tells it.

    It is what the map says, else the normal of its floor, else that of its level surfaces, else the mean of
    what is up in its cameras; None if these do not agree.
    """
    told = version.up
    if told is not None:
        return told, "the map"
    # y of a camera points down in its image.
    mean = -np.mean([keyframe.T_world_camera[:3, 1] for keyframe in version.keyframes], axis=0)
    length = float(np.linalg.norm(mean))
    if length < _LEAST_UP:
        return None
    level = up_of_surfaces(version.points, mean / length)
    rough: tuple[Array, UpSource] = (mean / length, "the cameras")
    if level is not None:
        rough = level, "the level surfaces"
    places = np.array([keyframe.T_world_camera[:3, 3] for keyframe in version.keyframes])
    floor = up_of_floor(version.points, rough[0], places)
    return rough if floor is None else (floor, "the floor")


def up_of_surfaces(points: npt.NDArray[np.float32], up: Array) -> Array | None:
    """Return the unit vector across the level surfaces of a cloud; None if it shows too few.

    Args:
        points: ``(n, 3)`` metres.
        up: ``(3,)``, about where up is: the direction within 30 degrees of it that most surfaces share is it.
    """
    chosen = points[:: max(1, len(points) // _MAX_POINTS)].astype(np.float64)
    _, voxel, count = np.unique(
        np.floor(chosen / _VOXEL_M).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    voxel = voxel.reshape(-1)
    total = len(count)
    mean = (
        np.stack([np.bincount(voxel, chosen[:, axis], total) for axis in range(3)], axis=1) / count[:, None]
    )
    apart = chosen - mean[voxel]
    spread = np.empty((total, 3, 3))
    for i in range(3):
        for j in range(3):
            spread[:, i, j] = np.bincount(voxel, apart[:, i] * apart[:, j], total) / count
    lengths, axes = np.linalg.eigh(spread[count >= _LEAST_POINTS])
    normals = axes[lengths[:, 0] <= _FLAT * lengths[:, 1], :, 0]
    normals = normals * np.sign(normals @ up)[:, None]
    normals = normals[normals @ up >= math.cos(math.radians(_LEVEL_DEG))]
    if not len(normals):
        return None
    least = math.cos(math.radians(_ALIKE_DEG))
    tried = normals[:: max(1, len(normals) // _MOST_TRIED)]
    found: Array = tried[int(np.argmax(np.count_nonzero(tried @ normals.T >= least, axis=1)))]
    for _ in range(2):
        alike = normals[normals @ found >= least]
        if len(alike) < _LEAST_VOXELS:
            return None
        found = alike.mean(axis=0)
        found = found / np.linalg.norm(found)
    return found


def up_of_floor(points: npt.NDArray[np.float32], up: Array, places: Array) -> Array | None:
    """Return the normal of the floor: over many metres it is known better than the normals of its parts.

    The lowest points of each cell below the cameras are fitted by a plane with Tukey's weights.  None where
    fewer than half of the cells lie on it, where they are too few or in a line, or where it is tilted by more
    than 5 degrees: stairs, ramps and several storeys.

    Args:
        points: ``(n, 3)`` metres.
        up: ``(3,)``, within some degrees of where up is.
        places: ``(k, 3)`` of the cameras.
    """
    across = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(up, across), up])
    below = points.astype(np.float64) @ axes.T
    below = below[below[:, 2] < np.median(places @ up)]
    if not len(below):
        return None
    _, cell = np.unique(np.floor(below[:, :2] / _CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    order = np.lexsort((below[:, 2], cell))
    count = np.bincount(cell)
    first = np.cumsum(count) - count
    low = below[order][(first + count // 20)[count >= _LEAST_OF_CELL]]
    if len(low) < _LEAST_CELLS:
        return None
    plane = np.array([0.0, 0.0, float(np.percentile(low[:, 2], 20))])
    rows = np.column_stack([low[:, :2], np.ones(len(low))])
    for limit_m in _FLOOR_M:
        weights = np.clip(1.0 - ((low[:, 2] - rows @ plane) / limit_m) ** 2, 0.0, None)
        plane = np.linalg.lstsq(rows * weights[:, None], low[:, 2] * weights, rcond=None)[0]
    on_it = low[np.abs(low[:, 2] - rows @ plane) < _FLOOR_M[-1]]
    if len(on_it) < max(_LEAST_CELLS, _LEAST_SHARE * len(low)):
        return None
    width_m = math.sqrt(12.0 * float(np.linalg.eigvalsh(np.cov(on_it[:, :2].T))[0]))
    normal = np.array([-plane[0], -plane[1], 1.0]) / math.hypot(plane[0], plane[1], 1.0)
    if width_m < _LEAST_WIDTH_M or normal[2] < math.cos(math.radians(_MOST_OFF_DEG)):
        return None
    found: Array = normal @ axes
    return found
