"""Align the point clouds of two maps tile by tile with ICP, and make a loop closure of each alignment.

A tile is a cube of the first map's world frame in which both maps have points.  Each tile is aligned on its
own, because the maps have drifted, so that no single rigid transform fits their whole clouds.  The result is
deterministic.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, inverse, transform
from rse_pf.slam.cloud_deform import find_observers
from rse_pf.slam.consistency import LoopClosure
from rse_pf.slam.icp import IcpOptions, align_clouds
from rse_pf.slam.loop_closures import Atlas
from rse_pf.slam.relative_pose import RelativePoseOptions

__all__ = ["TILE_M", "align_tiles"]

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Points = npt.NDArray[np.floating[Any]]

TILE_M = 3.0
"""Side of a tile, in metres."""
# Largest number of tiles of two maps that are aligned: those with the most points.
_MAX_TILES = 6
# Smallest number of points of each of the two clouds in a tile that is aligned.
_MIN_POINTS = 2000


def align_tiles(
    atlas: Atlas, clouds: tuple[Points, Points], T_one_other: Array
) -> tuple[list[LoopClosure], Counter[str]]:
    """Return a loop closure for each tile that was aligned, and counts of the other tiles by reason.

    A loop closure is between the keyframes of both maps that observed the tile best.

    Args:
        atlas: The keyframes of the two maps; loop closures refer to its rows.
        clouds: ``(n, 3)`` and ``(m, 3)``, metres, each in the world frame of its map.
        T_one_other: ``(4, 4)``, initial pose of the second map in the first one.
    """
    target, source = (np.asarray(cloud, dtype=np.float64) for cloud in clouds)
    links: list[LoopClosure] = []
    refused: Counter[str] = Counter()
    if len(target) < _MIN_POINTS or len(source) < _MIN_POINTS:
        return links, refused
    moved = transform(T_one_other, source)
    options = IcpOptions()
    information = np.linalg.inv(RelativePoseOptions().min_covariance()).astype(np.float64)
    rows = [np.flatnonzero(atlas.of_map == which) for which in (0, 1)]
    for low in _tiles(target, moved):
        near = _within(target, low - options.reach_m, TILE_M + 2.0 * options.reach_m)
        inside = _within(moved, low, TILE_M)
        try:
            found = align_clouds(target[near], source[inside], T_one_other, options)
        except BadRequest:  # too few points are left after thinning
            refused["few-points"] += 1
            continue
        if found.verdict != "ok":
            refused[found.reason] += 1
            continue
        centre = moved[inside].mean(axis=0)
        a = _observer(atlas, rows[0], centre)
        b = _observer(atlas, rows[1], transform(inverse(T_one_other), centre[None])[0])
        T_a_b = inverse(atlas.T_world_camera[a]) @ found.T_target_source @ atlas.T_world_camera[b]
        links.append(LoopClosure(a=a, b=b, T_a_b=T_a_b, information=information))
    return links, refused


def _tiles(target: Array, moved: Array) -> list[Array]:
    """Return the lower corners ``(3,)`` of at most `_MAX_TILES` tiles with enough points, sorted by position.

    Tiles are chosen by the smaller of the two clouds' numbers of points.
    """
    counts = []
    for cloud in (target, moved):
        numbers, count = np.unique(np.floor(cloud / TILE_M).astype(np.int64), axis=0, return_counts=True)
        counts.append({tuple(number): int(n) for number, n in zip(numbers.tolist(), count, strict=True)})
    both = {
        number: min(n, counts[1][number])
        for number, n in counts[0].items()
        if min(n, counts[1].get(number, 0)) >= _MIN_POINTS
    }
    most = sorted(both, key=lambda number: (-both[number], number))[:_MAX_TILES]
    return [np.array(number, dtype=np.float64) * TILE_M for number in sorted(most)]


def _within(cloud: Array, low: Array, size_m: float) -> Mask:
    inside = (cloud >= low) & (cloud < low + size_m)
    return inside[:, 0] & inside[:, 1] & inside[:, 2]


def _observer(atlas: Atlas, rows: Rows, point: Array) -> int:
    """Return the row, among the keyframes *rows*, of the keyframe that observed *point* ``(3,)`` best."""
    place = find_observers(point[None], [atlas.keyframes[row] for row in rows.tolist()])[0]
    return int(rows[place])
