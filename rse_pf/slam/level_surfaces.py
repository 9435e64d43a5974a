"""Estimate the direction against gravity ("up") of a map without IMU from its floors, tables and ceilings."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.maps.format import MapVersion

__all__ = ["UpSource", "estimate_up", "floor_normal", "level_surface_normal"]

UpSource = Literal["the map", "--up", "the floor", "the level surfaces", "the cameras"]
"""Source of a direction against gravity: stated by the map, given on the command line as the option ``--up``,
or estimated from the plane of the floor, from all level surfaces, or from the orientations of the cameras."""

_MIN_CAMERA_AGREEMENT = 0.5
"""Length of the mean of the cameras' upward unit vectors below which the cameras do not agree on where up is;
the length is 1 if all cameras are held alike, and about 0 if they are held in all directions."""

# --- Limits of `level_surface_normal`, which finds horizontal surfaces by the normals of small voxels ---
_VOXEL_M = 0.15  # edge in metres of the voxels in which surface normals are estimated
_MAX_POINTS = 500_000
"""Number of points from twice which on a cloud is thinned evenly before level surfaces are looked for, which
bounds the time; at least this number and fewer than twice as many points are left."""
_MIN_VOXEL_POINTS = 12  # a voxel with fewer points has no surface normal
_MIN_VOXELS = 20  # with fewer flat voxels of similar normals, a cloud has no level surfaces
_MAX_FLATNESS_RATIO = 0.02
"""A voxel is flat if the smallest variance of its points along a principal axis, that of the normal, is at
most this share of the second smallest one."""
_MAX_LEVEL_TILT_DEG = 30.0
"""Largest angle in degrees between the normal of a level surface and the rough direction up; walls are
beyond it."""
_MAX_NORMAL_DIFFERENCE_DEG = 5.0
"""Largest angle in degrees between two surface normals that support the same direction."""
# Number of normals from twice which on only an even selection of them is tried as the common direction, which
# bounds the time; the selection has at least this number and fewer than twice as many normals.
_MAX_HYPOTHESES = 500

# --- Limits of `floor_normal`, which fits a plane to the lowest points ---
_CELL_M = 0.25
"""Edge in metres of the horizontal cells in which the floor is looked for; one low point of each cell is
used."""
_MIN_CELL_POINTS = 10
"""Smallest number of points of a cell of the floor; a cell with fewer is left out, because its low point may
be an outlier."""
_MIN_CELLS = 40  # with fewer cells on the plane of the floor, a cloud has no floor
_TUKEY_LIMITS_M = (0.4, 0.4, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05, 0.05)
"""Distances in metres from the plane of the floor at which the weight of a cell becomes 0, for the successive
iterations of its robust fit."""
_MIN_INLIER_RATIO = 0.5
"""Smallest share of the cells (horizontal squares of 0.25 m with one low point each) whose low point must lie
within 5 cm of the plane of the floor; with stairs or several storeys in a map, the share is smaller, and the
map has no floor."""
_MIN_WIDTH_M = 1.0
"""Smallest width in metres of a floor, measured perpendicularly to its longest extent: the tilt of a narrower
strip is uncertain."""
_MAX_FLOOR_TILT_DEG = 5.0
"""Largest angle in degrees between the normal of the floor and the rough direction up; ramps are beyond
it."""


def estimate_up(version: MapVersion) -> tuple[Array, UpSource] | None:
    """Return the unit vector ``(3,)`` against gravity in the world of a map, and what it was taken from.

    A direction that the map states is returned as it is.  Otherwise the estimate begins with the mean of the
    cameras' upward directions.  It is refined by the normals of level surfaces within 30 degrees of it, and
    then by the normal of a floor within 5 degrees of the result.  A refinement is left out if the cloud has
    too few such surfaces; the source names the last one that was made.

    Args:
        version: A map with at least one keyframe.

    Returns:
        None if the map does not state the direction and the mean of the cameras' upward unit vectors is
        shorter than 0.5; then neither level surfaces nor a floor are looked for.
    """
    # 1. Use the direction that the map states.
    stated_up = version.up
    if stated_up is not None:
        return stated_up, "the map"
    # 2. Take the mean of the cameras' upward directions; the y axis of a camera points down in its image.
    mean = -np.mean([keyframe.T_world_camera[:3, 1] for keyframe in version.keyframes], axis=0)
    length = float(np.linalg.norm(mean))
    if length < _MIN_CAMERA_AGREEMENT:
        return None
    estimate: tuple[Array, UpSource] = (mean / length, "the cameras")
    # 3. Refine this direction by level surfaces of the cloud.
    level = level_surface_normal(version.points, mean / length)
    if level is not None:
        estimate = level, "the level surfaces"
    # 4. Refine the result by the plane of the floor.
    camera_positions = np.array([keyframe.T_world_camera[:3, 3] for keyframe in version.keyframes])
    floor = floor_normal(version.points, estimate[0], camera_positions)
    return estimate if floor is None else (floor, "the floor")


def level_surface_normal(points: npt.NDArray[np.float32], up: Array) -> Array | None:
    """Return the common unit normal ``(3,)`` of the level surfaces of a cloud; None if it has too few.

    Args:
        points: ``(n, 3)`` metres.
        up: ``(3,)`` rough direction against gravity; the result is the direction within 30 degrees of *up*
            that most surface normals share.
    """
    # 1. Divide the points into voxels, and compute the covariance of the points of each voxel.
    thinned = points[:: max(1, len(points) // _MAX_POINTS)].astype(np.float64)
    _, voxel, count = np.unique(
        np.floor(thinned / _VOXEL_M).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    voxel = voxel.reshape(-1)
    total = len(count)
    mean = (
        np.stack([np.bincount(voxel, thinned[:, axis], total) for axis in range(3)], axis=1) / count[:, None]
    )
    offset = thinned - mean[voxel]
    covariance = np.empty((total, 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(voxel, offset[:, i] * offset[:, j], total) / count
    # 2. Take the normals of flat voxels, oriented upwards, and leave out those of walls.
    variances, axes = np.linalg.eigh(covariance[count >= _MIN_VOXEL_POINTS])
    normals = axes[variances[:, 0] <= _MAX_FLATNESS_RATIO * variances[:, 1], :, 0]
    normals = normals * np.sign(normals @ up)[:, None]
    normals = normals[normals @ up >= math.cos(math.radians(_MAX_LEVEL_TILT_DEG))]
    if not len(normals):
        return None
    # 3. Choose the normal that most others are similar to.
    min_cosine = math.cos(math.radians(_MAX_NORMAL_DIFFERENCE_DEG))
    hypotheses = normals[:: max(1, len(normals) // _MAX_HYPOTHESES)]
    supporters = np.count_nonzero(hypotheses @ normals.T >= min_cosine, axis=1)
    direction: Array = hypotheses[int(np.argmax(supporters))]
    # 4. Replace it twice by the mean of the normals similar to it.
    for _ in range(2):
        similar = normals[normals @ direction >= min_cosine]
        if len(similar) < _MIN_VOXELS:
            return None
        direction = similar.mean(axis=0)
        direction = direction / np.linalg.norm(direction)
    return direction


def floor_normal(points: npt.NDArray[np.float32], up: Array, camera_positions: Array) -> Array | None:
    """Return the unit normal ``(3,)`` of the floor, fitted by iteratively reweighted least squares.

    The plane of a floor of many metres is known more accurately than the normals of small surfaces.  The
    squared residuals have the weights of Tukey's biweight.

    Args:
        points: ``(n, 3)`` metres.
        up: ``(3,)`` unit vector against gravity, accurate to some degrees.
        camera_positions: ``(k, 3)`` metres; only points below the median height of the cameras are used.

    Returns:
        None if fewer than half of the cells lie on one plane, as with stairs and several storeys, if they are
        fewer than 40 or a strip narrower than 1 m, or if the plane is tilted by more than 5 degrees.
    """
    # 1. Express the points in axes whose third one is *up*, and keep those below the median camera.
    level_axis = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    level_axis /= np.linalg.norm(level_axis)
    axes = np.stack([level_axis, np.cross(up, level_axis), up])
    below = points.astype(np.float64) @ axes.T
    below = below[below[:, 2] < np.median(camera_positions @ up)]
    if not len(below):
        return None
    # 2. Take of each horizontal cell the point at the 5th percentile of the heights.
    _, cell = np.unique(np.floor(below[:, :2] / _CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    order = np.lexsort((below[:, 2], cell))
    count = np.bincount(cell)
    first = np.cumsum(count) - count
    low = below[order][(first + count // 20)[count >= _MIN_CELL_POINTS]]
    if len(low) < _MIN_CELLS:
        return None
    # 3. Fit the plane z = a x + b y + c from a level start, with a decreasing limit of the weights.  Each row
    # is multiplied by the root of its weight, since least squares squares it.
    plane = np.array([0.0, 0.0, float(np.percentile(low[:, 2], 20))])
    rows = np.column_stack([low[:, :2], np.ones(len(low))])
    for limit_m in _TUKEY_LIMITS_M:
        weights = np.clip(1.0 - ((low[:, 2] - rows @ plane) / limit_m) ** 2, 0.0, None)
        plane = np.linalg.lstsq(rows * weights[:, None], low[:, 2] * weights, rcond=None)[0]
    # 4. Accept the plane if enough cells lie on it, in an area that is wide enough.
    inliers = low[np.abs(low[:, 2] - rows @ plane) < _TUKEY_LIMITS_M[-1]]
    if len(inliers) < max(_MIN_CELLS, _MIN_INLIER_RATIO * len(low)):
        return None
    width_m = math.sqrt(12.0 * float(np.linalg.eigvalsh(np.cov(inliers[:, :2].T))[0]))
    normal = np.array([-plane[0], -plane[1], 1.0]) / math.hypot(plane[0], plane[1], 1.0)
    if width_m < _MIN_WIDTH_M or normal[2] < math.cos(math.radians(_MAX_FLOOR_TILT_DEG)):
        return None
    normal_world: Array = normal @ axes
    return normal_world
