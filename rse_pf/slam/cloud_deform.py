"""Deform the point cloud of a map after its keyframes moved: a point follows the keyframe that saw it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.loop_closures import Atlas
from rse_pf.slam.ply import Colours, Points

__all__ = ["deform_cloud", "deform_clouds", "find_observers", "merge_clouds", "voxel_keys"]

_VOXEL_M = 0.01  # edge in metres of the voxels to which a merged cloud is thinned
_MIN_DEPTH_M = 0.2
"""Smallest depth in metres at which a keyframe counts as an observer of a point of the cloud: that of a depth
camera."""
_MAX_DEPTH_M = 6.0
"""Largest depth in metres at which a keyframe counts as an observer of a point of the cloud: that of a depth
camera."""
_UNOBSERVED_COST = 1e3
"""Metres that are added to the distance of a point from a keyframe that does not see it, so that every
keyframe that sees the point is preferred."""


def deform_clouds(
    versions: Sequence[MapVersion],
    atlas: Atlas,
    T_world_camera: Array,
    rows: npt.NDArray[np.int64],
) -> tuple[Points, Colours]:
    """Return the deformed clouds of several maps as one cloud with at most one point in each voxel of 1 cm.

    Args:
        versions: The maps, whose clouds are in their own worlds.
        atlas: All *n* keyframes, with their old poses, and the index in *versions* of the map of each.
        T_world_camera: ``(n, 4, 4)``, the new poses of the keyframes.
        rows: Indices of the keyframes of the result; maps without such a keyframe are left out.
    """
    clouds: list[Array] = []
    colours: list[Colours] = []
    for map_index in np.unique(atlas.of_map[rows]).tolist():
        version = versions[map_index]
        map_rows = [int(row) for row in rows if atlas.of_map[row] == map_index]
        if len(version.points):
            map_keyframes = [atlas.keyframes[row] for row in map_rows]
            clouds.append(deform_cloud(version.points, map_keyframes, T_world_camera[map_rows]))
            colours.append(version.colours)
    return merge_clouds(clouds, colours)


def deform_cloud(points: Points, keyframes: Sequence[Keyframe], T_world_camera: Array) -> Array:
    """Return the points ``(m, 3)`` of one map, m, after each moved like the keyframe that observed it.

    That keyframe is the one that `find_observers` chooses.

    Args:
        points: ``(m, 3)`` metres, in the old world of the map.
        keyframes: The *n* keyframes of the map, at least one, with their old poses.
        T_world_camera: ``(n, 4, 4)``, the new poses of the keyframes.
    """
    observers = find_observers(np.asarray(points, dtype=np.float64), keyframes)
    moved = np.empty((len(points), 3))
    for row, keyframe in enumerate(keyframes):
        is_observed = observers == row
        correction = T_world_camera[row] @ inverse(keyframe.T_world_camera)
        moved[is_observed] = transform(correction, points[is_observed].astype(np.float64))
    return moved


def merge_clouds(clouds: Sequence[Array], colours: Sequence[Colours]) -> tuple[Points, Colours]:
    """Concatenate clouds that are in the same world, and thin them to one point in each voxel of 1 cm.

    The point of a voxel is the mean of its points, with the colour of the first of them.  Without clouds both
    arrays are empty.
    """
    if not clouds:
        return np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8)
    return _thin(np.concatenate(clouds), np.concatenate(colours))


def find_observers(points: Array, keyframes: Sequence[Keyframe]) -> npt.NDArray[np.int64]:
    """Return for each point the index of the keyframe that saw it at the smallest depth, ``(m,)``.

    A keyframe sees a point that is projected into its image at a depth of 0.2 to 6 m.  A point that no
    keyframe sees is assigned to the keyframe with the nearest camera.

    Args:
        points: ``(m, 3)`` metres, in the world of the keyframes.
        keyframes: The keyframes; at least one.
    """
    best_cost = np.full(len(points), np.inf)
    observers = np.zeros(len(points), dtype=np.int64)
    for row, keyframe in enumerate(keyframes):
        camera = keyframe.camera
        points_camera = transform(inverse(keyframe.T_world_camera), points)
        depth = points_camera[:, 2]
        safe_depth = np.where(depth > _MIN_DEPTH_M, depth, 1.0)
        u = camera.fx * points_camera[:, 0] / safe_depth + camera.cx
        v = camera.fy * points_camera[:, 1] / safe_depth + camera.cy
        is_in_image = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        is_seen = (depth > _MIN_DEPTH_M) & (depth < _MAX_DEPTH_M) & is_in_image
        cost = np.where(is_seen, depth, _UNOBSERVED_COST + np.linalg.norm(points_camera, axis=1))
        is_better = cost < best_cost
        best_cost[is_better], observers[is_better] = cost[is_better], row
    return observers


def voxel_keys(points: Array, voxel_m: float) -> npt.NDArray[np.int64]:
    """Return a key of the voxel of each point: one number, or three if one cannot hold it.

    Two points lie in the same voxel if and only if their keys are equal.  Along each axis, voxels are counted
    from that of the smallest coordinate of these points, or from that of 0 if all coordinates are positive.
    Therefore the keys of two calls cannot be compared.

    Args:
        points: ``(n, 3)`` metres.
        voxel_m: Edge of a voxel.

    Returns:
        ``(n,)`` numbers whose order is that of the voxel indices along x, then y, then z.  If an index is
        2**21 or more: ``(n, 3)``, the voxel indices along x, y and z.
    """
    voxels = np.floor(points / voxel_m).astype(np.int64)
    voxels -= voxels.min(axis=0, initial=0)
    if voxels.max(initial=0) < 1 << 21:
        return (voxels[:, 0] << 42) | (voxels[:, 1] << 21) | voxels[:, 2]
    return voxels


def _thin(points: Array, colours: Colours) -> tuple[Points, Colours]:
    """Return for each voxel the mean of its points, with the colour of the first of them."""
    _, first, group = np.unique(voxel_keys(points, _VOXEL_M), axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    means = np.stack([np.bincount(group, weights=points[:, axis]) / count for axis in range(3)], axis=1)
    return means.astype(np.float32), colours[first]
