"""Deform the clouds of maps whose keyframes were moved: each point follows the keyframe that observed it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion

__all__ = ["deform_clouds"]

Points = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

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
    clouds, colours = [], []
    for which in np.unique(of_map[rows]).tolist():
        version = versions[which]
        if not len(version.points):
            continue
        own = [int(row) for row in rows if of_map[row] == which]
        observer = _observer_of(np.asarray(version.points, dtype=np.float64), [keyframes[row] for row in own])
        moved = np.empty((len(version.points), 3))
        for place, row in enumerate(own):
            mine = observer == place
            correction = T_world_camera[row] @ inverse(keyframes[row].T_world_camera)
            moved[mine] = transform(correction, version.points[mine].astype(np.float64))
        clouds.append(moved)
        colours.append(version.colours)
    if not clouds:
        return np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8)
    return _thin(np.concatenate(clouds), np.concatenate(colours))


def _observer_of(points: Array, keyframes: Sequence[Keyframe]) -> npt.NDArray[np.int64]:
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


def _thin(points: Array, colours: Colours) -> tuple[Points, Colours]:
    """Return the mean of the points of each voxel, with the colour of the first."""
    _, first, group = np.unique(
        np.floor(points / _VOXEL_M).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    group = group.ravel()
    count = np.bincount(group)
    means = np.stack([np.bincount(group, weights=points[:, axis]) / count for axis in range(3)], axis=1)
    return means.astype(np.float32), colours[first]
