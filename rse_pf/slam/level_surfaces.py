"""Where up is in a cloud whose gravity nobody measured: across the floors, tables and ceilings in it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array

__all__ = ["up_of_surfaces"]

_VOXEL_M = 0.15
_MAX_POINTS = 500_000
_LEAST_POINTS, _LEAST_VOXELS = 12, 20
_FLAT = 0.02
"""A voxel is flat if its points spread at most this share of their variance along its surface across it."""
_LEVEL_DEG, _ALIKE_DEG = 30.0, 5.0
_MOST_TRIED = 500


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
