"""Find the feature tracks of a map, and triangulate their 3-D points with the poses of the map fixed.

A track is the set of features in several keyframes that show the same point.  Features are matched in pairs
of keyframes, and a feature leaves its track if the point is projected far from it, so that wrong matches
leave no track.  Points that only one keyframe shows are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.pnp import DepthNoise
from rse_pf.slam.pose_graph import connected_components
from rse_pf.slam.relative_pose import RelativePoseOptions, match_descriptors

__all__ = ["Tracks", "find_tracks"]

Rows = npt.NDArray[np.int64]

_NEXT_KEYFRAMES = 3
"""Number of the following keyframes of the same robot with which each keyframe is matched."""
_OUTLIER_PX = 4.0
"""Largest reprojection error in pixels of an observation; COLMAP filters its own models by the same."""
_GAUSS_NEWTON_STEPS = 3  # steps in which the points are triangulated, after each removal of outliers
_OUTLIER_ROUNDS = 2  # number of times that points are triangulated and outliers are removed
_MAX_POINT_M = 1e5  # largest coordinate in metres of a feature's point in the frame of its camera
_MIN_DEPTH_M = 0.05  # smallest depth in metres at which a feature's point is used
_MAX_DEPTH_M = 200.0  # largest depth in metres at which a feature's point is used
_DEPTH_NOISE = DepthNoise()
_GREY = 128  # red, green and blue of a point without a coloured point of the cloud nearby
_COLOUR_VOXEL_M = 0.05  # edge in metres of the voxels in which a point takes the colour of the cloud


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """The triangulated points of a map, and their observations in at least two keyframes each.

    Attributes:
        points: ``(n, 3)`` metres, in the world of the map.
        colours: ``(n, 3)`` uint8, the colour of the map's cloud near the point; grey without cloud.
        point: ``(m,)``, the row in ``points`` of each observation, ascending.
        keyframe: ``(m,)``, the index in the map of the keyframe of each observation.
        feature: ``(m,)``, the row of the feature in its keyframe.
        error_px: ``(m,)``, the distance between the feature and the projected point.
    """

    points: Array
    colours: npt.NDArray[np.uint8]
    point: Rows
    keyframe: Rows
    feature: Rows
    error_px: Array


def find_tracks(version: MapVersion, report: Callable[[float], None] = lambda done: None) -> Tracks:
    """Return the tracks of a map; the same map always gives the same tracks.

    Args:
        version: The map; its poses are not changed.
        report: Called with the completed share of the matching, 0 to 1.

    Raises:
        MissingExtra: The native core, which matches features, is not installed.
    """
    features = _collect_features(version)
    # 1. Match pairs of keyframes in both directions, and join matched features to sets.
    first_features, second_features = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    pairs = list(_keyframe_pairs(version))
    for number, (a, b) in enumerate(pairs):
        for first, second in ((a, b), (b, a)):
            first_rows, second_rows = _match(version.keyframes[first], version.keyframes[second])
            first_features.append(features.starts[first] + first_rows)
            second_features.append(features.starts[second] + second_rows)
        report((number + 1) / len(pairs))
    roots = connected_components(
        len(features.keyframe), np.concatenate(first_features), np.concatenate(second_features)
    )
    # 2. Triangulate the point of each set, and remove observations far from its projection.
    row = np.argsort(roots, kind="stable")
    for _ in range(_OUTLIER_ROUNDS):
        row = _keep_observed_twice(features, row, roots)
        point = _number_runs(roots[row])
        points = _triangulate(version, features, row, point)
        error_px = _reprojection_errors(version, features, row, points[point])
        row = _remove_outliers(features, row, point, error_px)
    # 3. Triangulate the points that are left.
    row = _keep_observed_twice(features, row, roots)
    point = _number_runs(roots[row])
    points = _triangulate(version, features, row, point)
    return Tracks(
        points=points,
        colours=_colours(version, points),
        point=point,
        keyframe=features.keyframe[row],
        feature=row - features.starts[features.keyframe[row]],
        error_px=_reprojection_errors(version, features, row, points[point]),
    )


def _keyframe_pairs(version: MapVersion) -> Iterator[tuple[int, int]]:
    """Yield pairs of indices of keyframes: consecutive ones of a robot, and those that an edge connects."""
    pairs: dict[tuple[int, int], None] = {}
    by_robot: dict[str, list[int]] = {}
    for index, keyframe in enumerate(version.keyframes):
        by_robot.setdefault(keyframe.robot, []).append(index)
    for indices in by_robot.values():
        indices.sort(key=lambda index: (version.keyframes[index].timestamp_s, index))
        for distance in range(1, _NEXT_KEYFRAMES + 1):
            pairs.update(dict.fromkeys(zip(indices, indices[distance:], strict=False)))
    index_of_id = {keyframe.id: index for index, keyframe in enumerate(version.keyframes)}
    for edge in version.edges:
        pair = index_of_id[edge.a], index_of_id[edge.b]
        if pair[0] != pair[1] and pair[::-1] not in pairs:
            pairs[pair] = None
    yield from pairs


def _rows_with_point(keyframe: Keyframe) -> Rows:
    """Return the rows of features whose 3-D point is plausible and is projected near their pixel."""
    points = keyframe.points_camera.astype(np.float64)
    is_usable = (np.abs(points) <= _MAX_POINT_M).all(axis=1)
    is_usable &= (points[:, 2] >= _MIN_DEPTH_M) & (points[:, 2] <= _MAX_DEPTH_M)
    rows = np.flatnonzero(is_usable)
    error = keyframe.camera.project(points[rows]) - keyframe.pixels[rows]
    near_rows: Rows = rows[np.linalg.norm(error, axis=1) <= _OUTLIER_PX]
    return near_rows


def _match(reference: Keyframe, view: Keyframe) -> tuple[Rows, Rows]:
    """Return the rows of *reference* and of *view* that match and agree with the poses of the map.

    The point of the feature in *reference* must be projected near the pixel of the feature in *view*.
    """
    known = _rows_with_point(reference)
    options = RelativePoseOptions(max_matches=max(1, len(view.pixels)))
    matched, view_rows = match_descriptors(reference.descriptors[known], view.descriptors, options)
    reference_rows = known[matched]
    T_view_reference = inverse(view.T_world_camera) @ reference.T_world_camera
    points = transform(T_view_reference, reference.points_camera[reference_rows].astype(np.float64))
    is_ahead = points[:, 2] > _MIN_DEPTH_M
    reference_rows, view_rows, points = reference_rows[is_ahead], view_rows[is_ahead], points[is_ahead]
    error = view.camera.project(points) - view.pixels[view_rows]
    is_near = np.linalg.norm(error, axis=1) <= _OUTLIER_PX
    return reference_rows[is_near], view_rows[is_near]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Features:
    """All *n* features of a map in one table.

    Attributes:
        starts: ``(k + 1,)``, the first row of the features of each keyframe, and *n*.
        keyframe: ``(n,)``, the index of the keyframe of each feature.
        pixel: ``(n, 2)``, undistorted.
        measured_point: ``(n, 3)`` metres, the feature's own 3-D point in the world; 0 if unknown.
        weight: ``(n,)``, the information of this point in 1/m^2; 0 if unknown.
    """

    starts: Rows
    keyframe: Rows
    pixel: Array
    measured_point: Array
    weight: Array


def _collect_features(version: MapVersion) -> _Features:
    counts = [len(keyframe.pixels) for keyframe in version.keyframes]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    n = starts[-1]
    pixel, measured_point, weight = np.empty((n, 2)), np.zeros((n, 3)), np.zeros(n)
    for start, keyframe in zip(starts, version.keyframes, strict=False):
        pixel[start : start + len(keyframe.pixels)] = keyframe.pixels
        rows = _rows_with_point(keyframe)
        points = keyframe.points_camera[rows].astype(np.float64)
        measured_point[start + rows] = transform(keyframe.T_world_camera, points)
        weight[start + rows] = 1.0 / _DEPTH_NOISE.variance_m2(points[:, 2])
    return _Features(
        starts=starts,
        keyframe=np.repeat(np.arange(len(counts)), counts),
        pixel=pixel,
        measured_point=measured_point,
        weight=weight,
    )


def _keep_observed_twice(features: _Features, row: Rows, roots: Rows) -> Rows:
    """Return those of the features *row* whose set has at least two features there, one with a depth."""
    root = roots[row]
    is_observed_twice = np.bincount(root, minlength=len(roots))[root] > 1
    has_depth = np.bincount(root, features.weight[row], len(roots))[root] > 0.0
    return row[is_observed_twice & has_depth]


def _number_runs(sorted_roots: Rows) -> Rows:
    """Return 0 for the first run of equal numbers, 1 for the second run, and so on."""
    if not len(sorted_roots):
        return sorted_roots
    return np.concatenate([[0], np.cumsum(sorted_roots[1:] != sorted_roots[:-1])]).astype(np.int64)


def _triangulate(version: MapVersion, features: _Features, row: Rows, point: Rows) -> Array:
    """Return the points ``(n, 3)`` that fit the pixels, and the depths where they are known.

    Gauss-Newton with a Huber loss starts at the weighted mean of the measured points; a pixel has a standard
    deviation of one pixel.

    Args:
        version: The map.
        features: All features of the map.
        row: ``(m,)``, the observing features.
        point: ``(m,)``, the number of the point of each observation, ascending.
    """
    count = int(point[-1]) + 1 if len(point) else 0
    # 1. Average the measured points.
    weight = features.weight[row]
    total_weight = np.bincount(point, weight, count)
    measured = features.measured_point[row]
    sums = [np.bincount(point, weight * measured[:, axis], count) for axis in range(3)]
    points: Array = np.stack(sums, axis=1) / total_weight[:, None]
    for _ in range(_GAUSS_NEWTON_STEPS):
        # 2. Compute residuals and Jacobians of the pixels, with the square roots of the Huber weights.
        residual, jacobian = _residuals(version, features, row, points[point])
        relative_error = np.linalg.norm(residual, axis=1) / _OUTLIER_PX
        root_weight = 1.0 / np.sqrt(np.maximum(relative_error, 1.0))
        residual, jacobian = root_weight[:, None] * residual, root_weight[:, None, None] * jacobian
        # 3. Add the normal equations of pixels and measured points.
        H = np.einsum("mki,mkj->mij", jacobian, jacobian)
        H += weight[:, None, None] * np.eye(3)
        right = weight[:, None] * (measured - points[point])
        right += np.einsum("mki,mk->mi", jacobian, residual)
        # 4. Sum them up for each point, and take a step.
        starts = np.flatnonzero(np.diff(point, prepend=-1))
        if count:
            left = np.add.reduceat(H, starts)
            points = points + np.linalg.solve(left, np.add.reduceat(right, starts)[..., None])[..., 0]
    return points


def _residuals(version: MapVersion, features: _Features, row: Rows, points: Array) -> tuple[Array, Array]:
    """Return the pixels minus the projected points ``(m, 2)``, and the Jacobians of the projections.

    The Jacobians ``(m, 2, 3)`` are in pixels per metre.  Residual and Jacobian of a point behind its camera
    are 0.

    Args:
        version: The map.
        features: All features of the map.
        row: ``(m,)``, the observing features.
        points: ``(m, 3)``, the point of each observation in the world.
    """
    keyframes = version.keyframes
    T_camera_world = np.array([inverse(k.T_world_camera) for k in keyframes]).reshape(-1, 4, 4)
    intrinsics = np.array([(k.camera.fx, k.camera.fy, k.camera.cx, k.camera.cy) for k in keyframes])
    intrinsics = intrinsics.reshape(-1, 4)
    index = features.keyframe[row]
    rotation = T_camera_world[index, :3, :3]
    points_camera = np.einsum("mij,mj->mi", rotation, points) + T_camera_world[index, :3, 3]
    is_ahead = points_camera[:, 2] > _MIN_DEPTH_M
    z = np.where(is_ahead, points_camera[:, 2], 1.0)
    focal, centre = intrinsics[index, :2], intrinsics[index, 2:]
    residual = features.pixel[row] - (focal * points_camera[:, :2] / z[:, None] + centre)
    by_point_camera = np.zeros((len(row), 2, 3))
    by_point_camera[:, 0, 0], by_point_camera[:, 1, 1] = focal[:, 0] / z, focal[:, 1] / z
    by_point_camera[:, :, 2] = -focal * points_camera[:, :2] / (z * z)[:, None]
    jacobian = np.einsum("mki,mij->mkj", by_point_camera, rotation)
    residual[~is_ahead], jacobian[~is_ahead] = 0.0, 0.0
    return residual, jacobian


def _reprojection_errors(version: MapVersion, features: _Features, row: Rows, points: Array) -> Array:
    """Return the reprojection error of each observation in pixels, infinite behind the camera."""
    residual, jacobian = _residuals(version, features, row, points)
    errors: Array = np.linalg.norm(residual, axis=1)
    errors[~jacobian.any(axis=(1, 2))] = np.inf  # The Jacobian is 0 if the point is behind the camera.
    return errors


def _remove_outliers(features: _Features, row: Rows, point: Rows, error_px: Array) -> Rows:
    """Return the inliers among the observations, only the best one of a point in each keyframe.

    The order of the observations stays.
    """
    index = features.keyframe[row]
    order = np.lexsort((row, error_px, index, point))
    is_repeated = (np.diff(index[order], prepend=-1) == 0) & (np.diff(point[order], prepend=-1) == 0)
    inliers = order[~is_repeated & (error_px[order] <= _OUTLIER_PX)]
    inlier_rows: Rows = row[np.sort(inliers)]
    return inlier_rows


def _colours(version: MapVersion, points: Array) -> npt.NDArray[np.uint8]:
    """Return for each of *points* ``(n, 3)`` the colour of a point of the cloud in its voxel, else grey."""
    colours = np.full((len(points), 3), _GREY, dtype=np.uint8)
    if not len(points) or not len(version.points):
        return colours
    # 1. Number the voxels around the points, and sort the cloud by them.
    low = points.min(axis=0) - 1.5 * _COLOUR_VOXEL_M
    sides = np.ceil((points.max(axis=0) - low) / _COLOUR_VOXEL_M) + 2
    is_inside = ((version.points >= low) & (version.points < low + sides * _COLOUR_VOXEL_M)).all(axis=1)
    cloud_voxels = _voxel_numbers(version.points[is_inside], low, sides)
    if not len(cloud_voxels):
        return colours
    order = np.argsort(cloud_voxels, kind="stable")
    # 2. Look up the voxel of each point by binary search.
    voxels = _voxel_numbers(points, low, sides)
    position = np.minimum(np.searchsorted(cloud_voxels[order], voxels), len(cloud_voxels) - 1)
    has_colour = cloud_voxels[order[position]] == voxels
    colours[has_colour] = version.colours[is_inside][order[position[has_colour]]]
    return colours


def _voxel_numbers(points: Array | npt.NDArray[np.float32], low: Array, sides: Array) -> Array:
    """Return the number of the voxel of each point; float64 is exact for less than 2**53 voxels.

    Args:
        points: ``(n, 3)`` metres.
        low: ``(3,)``, the corner of the first voxel.
        sides: ``(3,)``, the number of voxels along x, y and z.
    """
    index = np.floor((points - low) / _COLOUR_VOXEL_M)
    numbers: Array = (index[:, 0] * sides[1] + index[:, 1]) * sides[2] + index[:, 2]
    return numbers
