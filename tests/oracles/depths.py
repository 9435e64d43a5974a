"""Depths at pixels, sharpness of edges, and voxels, pixel after pixel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def points_at(
    depth_m: npt.NDArray[np.float32], pixels: Array, camera: Any, low_m: float, high_m: float, spread: float
) -> Array:
    """Return the points at pixels whose 3x3 patch has five readings that are alike, NaN elsewhere."""
    height, width = depth_m.shape
    z = np.full(len(pixels), np.nan)
    for row, (u, v) in enumerate(np.rint(pixels)):
        if not (1 <= u < width - 1 and 1 <= v < height - 1):
            continue
        patch = depth_m[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2]
        readings = np.sort(patch[(patch > 0.0) & np.isfinite(patch)]).astype(np.float64)
        if len(readings) >= 5:
            median = readings[(len(readings) - 1) // 2]
            if readings[-1] - readings[0] < median * spread and low_m <= median <= high_m:
                z[row] = median
    with np.errstate(over="ignore", invalid="ignore"):
        x, y = (pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z
    return np.column_stack((x, y, z))


def depths_at(depth_m: npt.NDArray[np.float32], pixels: Array, spread: float) -> Array:
    """Return medians of five readings around pixels, NaN where one is missing or they differ."""
    height, width = depth_m.shape
    found = np.full(len(pixels), np.nan)
    for row, (u, v) in enumerate(np.rint(pixels).astype(int)):
        u, v = min(max(u, 2), width - 3), min(max(v, 2), height - 3)
        five = np.sort(depth_m[[v, v - 2, v + 2, v, v], [u, u, u, u - 2, u + 2]])
        if five[0] > 0.0 and five[-1] - five[0] <= spread * five[2] and np.isfinite(five[2]):
            found[row] = five[2]
    return found


def sharpness(lines: npt.NDArray[np.uint8]) -> float:
    """Return how steep the strongest 4 % of steps over 16 pixels of each line are, beside the whole step."""
    values = lines.astype(int)
    if values.shape[1] < 48:
        return math.nan
    whole = np.abs(values[:, 16:] - values[:, :-16])
    limit = max(16, np.sort(whole, axis=None)[-max(1, int(0.04 * whole.size))])
    row, column = np.nonzero(whole >= limit)
    if len(row) < 40:
        return math.nan
    fine = np.abs(values[:, 2:] - values[:, :-2])
    chosen = np.column_stack([row, column])[:: -(-len(row) // 600)]
    return float(np.median([fine[r, c : c + 15].max() / whole[r, c] for r, c in chosen]))


def frame_readings(frame: Any, options: Any) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return camera-frame points and colours of the pixels that a map takes of a frame."""
    depth, step, share = frame.depth_m, options.every_px, np.float32(options.edge_percent / 100.0)
    points, colours = [], []
    for v in range(0, depth.shape[0], step):
        for u in range(0, depth.shape[1], step):
            z = depth[v, u]
            pairs = [(depth[v, u - 1], z)] * (u > 0) + [(depth[v - 1, u], z)] * (v > 0)
            pairs += [(z, after) for after in (*depth[v, u + 1 : u + 2], *depth[v + 1 : v + 2, u])]
            is_surface = all(abs(after - before) <= after * share for before, after in pairs)
            if options.min_depth_m <= z <= options.max_depth_m and is_surface:
                points.append(frame.camera.back_project(np.array([[u, v]], float), np.array([z], float))[0])
                colours.append(frame.rgb[v, u])
    return np.array(points), np.array(colours)


def voxel_means(points: Array, colours: npt.NDArray[Any], voxel_m: float) -> dict[tuple[int, ...], Array]:
    """Return the mean position and colour of the readings in each voxel."""
    voxels: dict[tuple[int, ...], list[Array]] = {}
    for point, colour in zip(points, colours, strict=True):
        voxels.setdefault(tuple(np.floor(point / voxel_m).astype(int)), []).append(np.append(point, colour))
    return {key: np.mean(readings, axis=0) for key, readings in voxels.items()}
