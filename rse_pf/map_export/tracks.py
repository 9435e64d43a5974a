"""The points that several keyframes of a map see: tracks of matched features, and where each point is.

Poses stay as the map has them.  A feature counts for a track while its point is projected near it, so that
wrong matches leave no track behind; points that one keyframe alone sees are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.pnp import DepthNoise
from rse_pf.slam.relative_pose import RelativePoseOptions, match_descriptors

__all__ = ["Tracks", "find_tracks"]

Rows = npt.NDArray[np.int64]

_NEIGHBOURS = 3
"""A keyframe is compared with so many that its robot made next, and with those that an edge names."""
_OUTLIER_PX = 4.0
"""An observation farther from the projected point is none; COLMAP filters its own models by as much."""
_STEPS, _ROUNDS = 3, 2
_MAX_POINT_M = 1e5
_NEAREST_M, _FARTHEST_M = 0.05, 200.0
_NOISE = DepthNoise()
_GREY = 128
_COLOUR_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Points and the features that see them; each point is seen by two keyframes or more.

    Attributes:
        points: ``(n, 3)`` metres, world.
        colours: ``(n, 3)`` uint8: of the cloud near the point, grey where there is none.
        point: ``(m,)``, of each observation; in the order of points.
        keyframe: ``(m,)``, the place of the keyframe in the map.
        feature: ``(m,)``, the row in the keyframe.
        error_px: ``(m,)``, between the feature and the projected point.
    """

    points: Array
    colours: npt.NDArray[np.uint8]
    point: Rows
    keyframe: Rows
    feature: Rows
    error_px: Array


def find_tracks(version: MapVersion, report: Callable[[float], None] = lambda done: None) -> Tracks:
    """Return the tracks of a map; deterministic.

    Args:
        version: The map.
        report: Gets how much is done, 0 to 1.

    Raises:
        MissingExtra: There is no matcher.
    """
    features = _features_of(version)
    joined = _Sets(len(features.keyframe))
    pairs = list(_pairs(version))
    for number, (a, b) in enumerate(pairs):
        for one, other in ((a, b), (b, a)):
            rows, columns = _agreeing(version.keyframes[one], version.keyframes[other])
            joined.join(features.starts[one] + rows, features.starts[other] + columns)
        report((number + 1) / len(pairs))
    roots = joined.roots()
    row = np.argsort(roots, kind="stable")
    for _ in range(_ROUNDS):
        row = _with_others(features, row, roots)
        point = _numbered(roots[row])
        points = _solved(version, features, row, point)
        error_px = _errors(version, features, row, points[point])
        row = _cleaned(features, row, point, error_px)
    row = _with_others(features, row, roots)
    point = _numbered(roots[row])
    points = _solved(version, features, row, point)
    return Tracks(
        points=points, colours=_colours(version, points), point=point, keyframe=features.keyframe[row],
        feature=row - features.starts[features.keyframe[row]],
        error_px=_errors(version, features, row, points[point]),
    )  # fmt: skip


def _pairs(version: MapVersion) -> Iterator[tuple[int, int]]:
    """Yield pairs of places of keyframes: of one robot and near in time, or linked by an edge."""
    found: dict[tuple[int, int], None] = {}
    by_robot: dict[str, list[int]] = {}
    for place, keyframe in enumerate(version.keyframes):
        by_robot.setdefault(keyframe.robot, []).append(place)
    for places in by_robot.values():
        places.sort(key=lambda place: (version.keyframes[place].timestamp_s, place))
        for apart in range(1, _NEIGHBOURS + 1):
            found.update(dict.fromkeys(zip(places, places[apart:], strict=False)))
    place_of = {keyframe.id: place for place, keyframe in enumerate(version.keyframes)}
    for edge in version.edges:
        pair = place_of[edge.a], place_of[edge.b]
        if pair[0] != pair[1] and pair[::-1] not in found:
            found[pair] = None
    yield from found


def _has_point(keyframe: Keyframe) -> Rows:
    """Return the rows whose depth a camera may have measured at their pixel."""
    points = keyframe.points_camera.astype(np.float64)
    usable = (np.abs(points) <= _MAX_POINT_M).all(axis=1)
    rows = np.flatnonzero(usable & (points[:, 2] >= _NEAREST_M) & (points[:, 2] <= _FARTHEST_M))
    apart = keyframe.camera.project(points[rows]) - keyframe.pixels[rows]
    known: Rows = rows[np.linalg.norm(apart, axis=1) <= _OUTLIER_PX]
    return known


def _agreeing(reference: Keyframe, view: Keyframe) -> tuple[Rows, Rows]:
    """Return the rows of two keyframes that match, where the point of one is at the pixel of the other."""
    known = _has_point(reference)
    options = RelativePoseOptions(max_matches=max(1, len(view.pixels)))
    rows, columns = match_descriptors(reference.descriptors[known], view.descriptors, options)
    rows = known[rows]
    T_view_reference = inverse(view.T_world_camera) @ reference.T_world_camera
    points = transform(T_view_reference, reference.points_camera[rows].astype(np.float64))
    ahead = points[:, 2] > _NEAREST_M
    rows, columns, points = rows[ahead], columns[ahead], points[ahead]
    near = np.linalg.norm(view.camera.project(points) - view.pixels[columns], axis=1) <= _OUTLIER_PX
    return rows[near], columns[near]


class _Sets:
    """Disjoint sets of ``0..n-1``, each known by its least number."""

    def __init__(self, count: int) -> None:
        self._parent = list(range(count))

    def join(self, one: Rows, other: Rows) -> None:
        for a, b in zip(one.tolist(), other.tolist(), strict=True):
            first, second = self._root(a), self._root(b)
            if first != second:
                self._parent[max(first, second)] = min(first, second)

    def roots(self) -> Rows:
        return np.array([self._root(each) for each in range(len(self._parent))], dtype=np.int64)

    def _root(self, each: int) -> int:
        parent = self._parent
        while parent[each] != each:
            parent[each] = parent[parent[each]]
            each = parent[each]
        return each


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Features:
    """All features of a map; those of keyframe *i* begin at row ``starts[i]``.

    ``known`` is a feature's own point in the world, ``weight`` its information in 1/m^2, 0 without depth.
    """

    starts: Rows
    keyframe: Rows
    pixel: Array
    known: Array
    weight: Array


def _features_of(version: MapVersion) -> _Features:
    counts = [len(each.pixels) for each in version.keyframes]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    pixel, known, weight = np.empty((starts[-1], 2)), np.zeros((starts[-1], 3)), np.zeros(starts[-1])
    for start, keyframe in zip(starts, version.keyframes, strict=False):
        pixel[start : start + len(keyframe.pixels)] = keyframe.pixels
        rows = _has_point(keyframe)
        points = keyframe.points_camera[rows].astype(np.float64)
        known[start + rows] = transform(keyframe.T_world_camera, points)
        weight[start + rows] = 1.0 / _NOISE.variance_m2(points[:, 2])
    return _Features(
        starts=starts, keyframe=np.repeat(np.arange(len(counts)), counts), pixel=pixel, known=known,
        weight=weight,
    )  # fmt: skip


def _with_others(features: _Features, row: Rows, roots: Rows) -> Rows:
    """Return the rows whose point is seen by another one, too, and has a depth in one of them."""
    of_root = roots[row]
    seen = np.bincount(of_root, minlength=len(roots))[of_root] > 1
    return row[seen & (np.bincount(of_root, features.weight[row], len(roots))[of_root] > 0.0)]


def _numbered(sorted_roots: Rows) -> Rows:
    """Return 0, 1, ... for each run of equal numbers."""
    if not len(sorted_roots):
        return sorted_roots
    return np.concatenate([[0], np.cumsum(sorted_roots[1:] != sorted_roots[:-1])]).astype(np.int64)


def _solved(version: MapVersion, features: _Features, row: Rows, point: Rows) -> Array:
    """Return the ``(n, 3)`` points that fit the pixels, and the depths where there are some.

    Gauss-Newton from the mean of the measured points; a pixel counts with a deviation of one.
    """
    count = int(point[-1]) + 1 if len(point) else 0
    weight = features.weight[row]
    total = np.bincount(point, weight, count)
    known = features.known[row]
    sums = [np.bincount(point, weight * known[:, axis], count) for axis in range(3)]
    points: Array = np.stack(sums, axis=1) / total[:, None]
    for _ in range(_STEPS):
        residual, jacobian = _residuals(version, features, row, points[point])
        far = np.linalg.norm(residual, axis=1) / _OUTLIER_PX
        trust = 1.0 / np.sqrt(np.maximum(far, 1.0))  # Huber
        residual, jacobian = trust[:, None] * residual, trust[:, None, None] * jacobian
        normal = np.einsum("mki,mkj->mij", jacobian, jacobian)
        normal += weight[:, None, None] * np.eye(3)
        right = weight[:, None] * (known - points[point])
        right += np.einsum("mki,mk->mi", jacobian, residual)
        starts = np.flatnonzero(np.diff(point, prepend=-1))
        if count:
            left = np.add.reduceat(normal, starts)
            points = points + np.linalg.solve(left, np.add.reduceat(right, starts)[..., None])[..., 0]
    return points


def _residuals(version: MapVersion, features: _Features, row: Rows, points: Array) -> tuple[Array, Array]:
    """Return the ``(m, 2)`` pixels minus projections, 0 behind the camera, and their ``(m, 2, 3)`` slopes."""
    T_camera_world = np.array([inverse(each.T_world_camera) for each in version.keyframes]).reshape(-1, 4, 4)
    lens = np.array([(each.camera.fx, each.camera.fy, each.camera.cx, each.camera.cy)
                     for each in version.keyframes]).reshape(-1, 4)  # fmt: skip
    place = features.keyframe[row]
    rotation = T_camera_world[place, :3, :3]
    seen = np.einsum("mij,mj->mi", rotation, points) + T_camera_world[place, :3, 3]
    is_ahead = seen[:, 2] > _NEAREST_M
    z = np.where(is_ahead, seen[:, 2], 1.0)
    focal, centre = lens[place, :2], lens[place, 2:]
    residual = features.pixel[row] - (focal * seen[:, :2] / z[:, None] + centre)
    slope = np.zeros((len(row), 2, 3))
    slope[:, 0, 0], slope[:, 1, 1] = focal[:, 0] / z, focal[:, 1] / z
    slope[:, :, 2] = -focal * seen[:, :2] / (z * z)[:, None]
    jacobian = np.einsum("mki,mij->mkj", slope, rotation)
    residual[~is_ahead], jacobian[~is_ahead] = 0.0, 0.0
    return residual, jacobian


def _errors(version: MapVersion, features: _Features, row: Rows, points: Array) -> Array:
    residual, jacobian = _residuals(version, features, row, points)
    errors: Array = np.linalg.norm(residual, axis=1)
    errors[~jacobian.any(axis=(1, 2))] = np.inf  # behind the camera
    return errors


def _cleaned(features: _Features, row: Rows, point: Rows, error_px: Array) -> Rows:
    """Return the rows that fit, of each keyframe the best one of a point; in the same order."""
    place = features.keyframe[row]
    order = np.lexsort((row, error_px, place, point))
    same = (np.diff(place[order], prepend=-1) == 0) & (np.diff(point[order], prepend=-1) == 0)
    kept = order[~same & (error_px[order] <= _OUTLIER_PX)]
    cleaned: Rows = row[np.sort(kept)]
    return cleaned


def _colours(version: MapVersion, points: Array) -> npt.NDArray[np.uint8]:
    """Return the colour of the cloud in the voxel of each point, grey where it has none."""
    colours = np.full((len(points), 3), _GREY, dtype=np.uint8)
    if not len(points) or not len(version.points):
        return colours
    low = points.min(axis=0) - 1.5 * _COLOUR_M
    sides = np.ceil((points.max(axis=0) - low) / _COLOUR_M) + 2
    inside = ((version.points >= low) & (version.points < low + sides * _COLOUR_M)).all(axis=1)
    keys = _voxels(version.points[inside], low, sides)
    if not len(keys):
        return colours
    order = np.argsort(keys, kind="stable")
    wanted = _voxels(points, low, sides)
    at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    found = keys[order[at]] == wanted
    colours[found] = version.colours[inside][order[at[found]]]
    return colours


def _voxels(points: Array | npt.NDArray[np.float32], low: Array, sides: Array) -> Array:
    """Return a number for the voxel of each point, exact in float64 while there are fewer than 2**53."""
    index = np.floor((points - low) / _COLOUR_M)
    numbers: Array = (index[:, 0] * sides[1] + index[:, 1]) * sides[2] + index[:, 2]
    return numbers
