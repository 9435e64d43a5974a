"""Deform the clouds of maps whose keyframes were moved: each point follows the keyframe that observed it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.ply import Colours, Points

__all__ = ["deform_cloud", "deform_clouds", "joined_cloud", "observers_of", "voxels_of"]

_VOXEL_M = 0.01
_MIN_DEPTH_M, _MAX_DEPTH_M = 0.2, 6.0


def deform_clouds(
    versions: Sequence[MapVersion],
    of_map: npt.NDArray[np.int64],
    keyframes: Sequence[Keyframe],
    T_world_camera: Array,
    rows: npt.NDArray[np.int64],
) -> tuple[Points, Colours]:
    """Return the clouds of the maps of *rows* with each point moved like its keyframe, one point per voxel.

    Args:
        versions: The maps, with clouds in their own worlds.
        of_map: ``(n,)``, the map of each keyframe.
        keyframes: All *n*, with their old poses.
        T_world_camera: ``(n, 4, 4)``, their new poses.
        rows: Keyframes that are in the result.
    """
    clouds: list[Array] = []
    colours: list[Colours] = []
    for which in np.unique(of_map[rows]).tolist():
        version = versions[which]
        own = [int(row) for row in rows if of_map[row] == which]
        if len(version.points):
            moved = T_world_camera[own]
            clouds.append(deform_cloud(version.points, [keyframes[row] for row in own], moved))
            colours.append(version.colours)
    return joined_cloud(clouds, colours)


def deform_cloud(points: Points, keyframes: Sequence[Keyframe], T_world_camera: Array) -> Array:
    """Return ``(m, 3)`` *points* of one map, each moved like the keyframe that observed it.

    Args:
        points: ``(m, 3)``, metres, in the old world of the map.
        keyframes: All *n* of the map, with their old poses.
        T_world_camera: ``(n, 4, 4)``, their new poses.
    """
    observer = observers_of(np.asarray(points, dtype=np.float64), keyframes)
    moved = np.empty((len(points), 3))
    for place, keyframe in enumerate(keyframes):
        mine = observer == place
        correction = T_world_camera[place] @ inverse(keyframe.T_world_camera)
        moved[mine] = transform(correction, points[mine].astype(np.float64))
    return moved


def joined_cloud(clouds: Sequence[Array], colours: Sequence[Colours]) -> tuple[Points, Colours]:
    """Return moved clouds as one, with one point for each voxel."""
    if not clouds:
        return np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8)
    return _thin(np.concatenate(clouds), np.concatenate(colours))


def observers_of(points: Array, keyframes: Sequence[Keyframe]) -> npt.NDArray[np.int64]:
    """Return for each point the keyframe that observed it at the smallest depth, else the nearest one."""
    best = np.full(len(points), np.inf)
    observer = np.zeros(len(points), dtype=np.int64)
    for place, keyframe in enumerate(keyframes):
        seen = transform(inverse(keyframe.T_world_camera), points)
        depth = seen[:, 2]
        ahead = np.where(depth > _MIN_DEPTH_M, depth, 1.0)
        camera = keyframe.camera
        u = camera.fx * seen[:, 0] / ahead + camera.cx
        v = camera.fy * seen[:, 1] / ahead + camera.cy
        inside = (
            (depth > _MIN_DEPTH_M) & (depth < _MAX_DEPTH_M)
            & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        )  # fmt: skip
        # A point outside of every image follows the nearest keyframe.
        cost = np.where(inside, depth, 1e3 + np.linalg.norm(seen, axis=1))
        nearer = cost < best
        best[nearer], observer[nearer] = cost[nearer], place
    return observer


def voxels_of(points: Array, voxel_m: float) -> npt.NDArray[np.int64]:
    """Return the voxel of each of ``(n, 3)`` points as one number, ``(n,)``, in the order of its three.

    Points that are farther apart than 2**21 voxels get these three numbers, ``(n, 3)``.
    """
    voxels = np.floor(points / voxel_m).astype(np.int64)
    voxels -= voxels.min(axis=0, initial=0)
    if voxels.max(initial=0) < 1 << 21:
        keys: npt.NDArray[np.int64] = (voxels[:, 0] << 42) | (voxels[:, 1] << 21) | voxels[:, 2]
        return keys
    return voxels


def _thin(points: Array, colours: Colours) -> tuple[Points, Colours]:
    """Return the mean of the points of each voxel, with the colour of the first."""
    _, first, group = np.unique(voxels_of(points, _VOXEL_M), axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    means = np.stack([np.bincount(group, weights=points[:, axis]) / count for axis in range(3)], axis=1)
    return means.astype(np.float32), colours[first]
