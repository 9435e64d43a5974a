"""Find the feature tracks of a map, and triangulate their 3-D points with the poses of the map fixed.

A track is the set of features in several keyframes that show the same point.  Features are matched in pairs
of keyframes.  A feature is removed from its track if the triangulated point is projected more than 4 px from
it, which removes wrong matches.  A point that fewer than two keyframes show is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.pnp import DepthNoise
from rse_pf.slam.pose_graph import connected_components
from rse_pf.slam.relative_pose import RelativePoseOptions, match_descriptors
from rse_pf.slam.triangulation import reprojection_errors, triangulate_rays

__all__ = ["Tracks", "distinct_cameras", "find_tracks"]

Rows = npt.NDArray[np.int64]

_MATCHED_FOLLOWERS = 3
"""Number of the following keyframes of the same robot with which each keyframe is matched."""
_OUTLIER_PX = 4.0
"""Largest reprojection error in pixels of a match and of an observation, and the width of the Huber loss of
the triangulation; COLMAP filters its own models by the same limit."""
# Iterations of each triangulation: one with measured points alone, then three with pixels as well.
_TRIANGULATION_ITERATIONS = 4
_OUTLIER_ROUNDS = 2
"""Number of rounds, each of which triangulates the points and then removes outliers; one more triangulation
follows the last round."""
_MAX_POINT_M = 1e5  # largest absolute coordinate in metres of a feature's point in the frame of its camera
_MIN_DEPTH_M = 0.05
"""Smallest depth in metres at which a feature's measured point is used; a point that is not deeper in the
frame of a camera counts as behind it."""
_MAX_DEPTH_M = 200.0  # largest depth in metres at which a feature's measured point is used
_DEPTH_NOISE = DepthNoise()  # noise by which measured depths are weighted: the default, that of a Kinect
_GREY = 128  # red, green and blue of a point without a point of the coloured cloud in its voxel
_COLOUR_VOXEL_M = 0.05  # edge in metres of the voxels in which a point takes the colour of the cloud


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """The triangulated points of a map, and their observations in at least two keyframes each.

    Attributes:
        points: ``(n, 3)`` metres, in the world of the map.
        colours: ``(n, 3)`` uint8, red, green and blue of a point of the map's cloud in the same 5 cm voxel;
            grey where the cloud has none.
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
        report: Called with the completed share of the matching, 0 to 1; not called for a map without pairs of
            keyframes.

    Returns:
        Empty tracks if no point is observed in two keyframes.

    Raises:
        MissingExtra: The native core, which matches ORB features, is not installed.
    """
    features = _collect_features(version)
    # 1. Match pairs of keyframes in both directions.  Features that matches connect, directly or through
    # other features, form a set; `roots` names the set of each feature.
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
    # 2. Triangulate the point of each set, and remove observations that are far from its projection, or that
    # are not the best one in their keyframe.
    row = np.argsort(roots, kind="stable")
    for _ in range(_OUTLIER_ROUNDS):
        row = _keep_observed_twice(features, row, roots)
        point = _number_runs(roots[row])
        points = _triangulate(features, row, point)
        error_px, _ = _reproject(features, row, points[point])
        row = _remove_outliers(features, row, point, error_px)
    # 3. Triangulate the points again from the observations that are left.
    row = _keep_observed_twice(features, row, roots)
    point = _number_runs(roots[row])
    points = _triangulate(features, row, point)
    return Tracks(
        points=points,
        colours=_colours(version, points),
        point=point,
        keyframe=features.keyframe[row],
        feature=row - features.starts[features.keyframe[row]],
        error_px=_reproject(features, row, points[point])[0],
    )


def distinct_cameras(version: MapVersion) -> list[Camera]:
    """Return the different cameras of a map's keyframes, in the order in which they first occur."""
    return list(dict.fromkeys(keyframe.camera for keyframe in version.keyframes))


def _keyframe_pairs(version: MapVersion) -> Iterator[tuple[int, int]]:
    """Yield pairs of indices of keyframes that are matched, each pair once.

    A keyframe is matched with the three keyframes of its robot that follow it in time, and with the keyframes
    to which an edge connects it.
    """
    pairs: dict[tuple[int, int], None] = {}
    by_robot: dict[str, list[int]] = {}
    for index, keyframe in enumerate(version.keyframes):
        by_robot.setdefault(keyframe.robot, []).append(index)
    for indices in by_robot.values():
        indices.sort(key=lambda index: (version.keyframes[index].timestamp_s, index))
        for distance in range(1, _MATCHED_FOLLOWERS + 1):
            pairs.update(dict.fromkeys(zip(indices, indices[distance:], strict=False)))
    index_of_id = {keyframe.id: index for index, keyframe in enumerate(version.keyframes)}
    for edge in version.edges:
        pair = index_of_id[edge.a], index_of_id[edge.b]
        if pair[0] != pair[1] and pair[::-1] not in pairs:
            pairs[pair] = None
    yield from pairs


def _rows_with_point(keyframe: Keyframe) -> Rows:
    """Return the rows of features with a known 3-D point within the limits of coordinates and depth.

    The point must also be projected at most 4 px from the feature's own pixel.
    """
    points = keyframe.points_camera.astype(np.float64)
    is_usable = (np.abs(points) <= _MAX_POINT_M).all(axis=1)
    is_usable &= (points[:, 2] >= _MIN_DEPTH_M) & (points[:, 2] <= _MAX_DEPTH_M)
    rows = np.flatnonzero(is_usable)
    error = keyframe.camera.project(points[rows]) - keyframe.pixels[rows]
    near_rows: Rows = rows[np.linalg.norm(error, axis=1) <= _OUTLIER_PX]
    return near_rows


def _match(reference: Keyframe, view: Keyframe) -> tuple[Rows, Rows]:
    """Return the rows ``(k,)`` of features in *reference* and in *view* that match and agree with the poses.

    With the poses of the map, the measured point of the feature in *reference* must be projected at most 4 px
    from the pixel of the feature in *view*; features without a measured point are not matched from
    *reference*.
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
        cameras: The different cameras of the keyframes.
        camera: ``(n,)``, the index of the camera of each feature.
        T_camera_world: ``(k, 4, 4)``, the poses of the keyframes.
        pixel: ``(n, 2)``, undistorted.
        ray: ``(n, 3)``, the point of the feature at a depth of 1 in the frame of its camera.
        focal_px: ``(n,)``, the geometric mean of the focal lengths along x and y.
        measured_point: ``(n, 3)`` metres, the point that the depth of the feature gives, in the world; 0 if
            unknown.
        weight: ``(n,)``, the information of this point along each axis in 1/m^2: the inverse variance of the
            depth; 0 if unknown.
    """

    starts: Rows
    keyframe: Rows
    cameras: list[Camera]
    camera: Rows
    T_camera_world: Array
    pixel: Array
    ray: Array
    focal_px: Array
    measured_point: Array
    weight: Array


def _collect_features(version: MapVersion) -> _Features:
    counts = [len(keyframe.pixels) for keyframe in version.keyframes]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    n = starts[-1]
    pixel, ray, measured_point, weight = np.empty((n, 2)), np.empty((n, 3)), np.zeros((n, 3)), np.zeros(n)
    for start, keyframe in zip(starts, version.keyframes, strict=False):
        own = slice(start, start + len(keyframe.pixels))
        pixel[own] = keyframe.pixels
        ray[own] = keyframe.camera.back_project(pixel[own], np.ones(len(keyframe.pixels)))
        rows = _rows_with_point(keyframe)
        points = keyframe.points_camera[rows].astype(np.float64)
        measured_point[start + rows] = transform(keyframe.T_world_camera, points)
        weight[start + rows] = 1.0 / _DEPTH_NOISE.variance_m2(points[:, 2])
    cameras = distinct_cameras(version)
    number_of = {camera: number for number, camera in enumerate(cameras)}
    keyframe_camera = np.array([number_of[each.camera] for each in version.keyframes], dtype=np.int64)
    camera = np.repeat(keyframe_camera, counts)
    return _Features(
        starts=starts,
        keyframe=np.repeat(np.arange(len(counts)), counts),
        cameras=cameras,
        camera=camera,
        T_camera_world=np.array([inverse(each.T_world_camera) for each in version.keyframes]),
        pixel=pixel,
        ray=ray,
        focal_px=np.array([np.sqrt(each.fx * each.fy) for each in cameras])[camera],
        measured_point=measured_point,
        weight=weight,
    )


def _keep_observed_twice(features: _Features, row: Rows, roots: Rows) -> Rows:
    """Return the part of *row* whose sets have at least two features in *row*, one or more of them measured.

    Args:
        features: All features of the map.
        row: ``(m,)``, rows of features.
        roots: ``(n,)``, the set of each feature of the map.
    """
    root = roots[row]
    is_observed_twice = np.bincount(root, minlength=len(roots))[root] > 1
    has_depth = np.bincount(root, features.weight[row], len(roots))[root] > 0.0
    return row[is_observed_twice & has_depth]


def _number_runs(sorted_roots: Rows) -> Rows:
    """Return for each number the index of its run of equal numbers: 0 in the first run, 1 in the second."""
    if not len(sorted_roots):
        return sorted_roots
    return np.concatenate([[0], np.cumsum(sorted_roots[1:] != sorted_roots[:-1])]).astype(np.int64)


def _triangulate(features: _Features, row: Rows, point: Rows) -> Array:
    """Return the points ``(n, 3)`` in the world, metres, that fit the pixels and the measured points best.

    Three rounds of reweighted least squares start at the weighted mean of the measured points.  Pixels have a
    standard deviation of 1 px and a Huber loss of 4 px; measured points have a quadratic loss.

    Args:
        features: All features of the map.
        row: ``(m,)``, the observing features.
        point: ``(m,)``, the number of the point of each observation, ascending from 0 without gaps; each
            point has an observation with a measured point.
    """
    count = int(point[-1]) + 1 if len(point) else 0
    keyframe = features.keyframe[row]
    centres = inverse(features.T_camera_world)[keyframe, :3, 3]
    rays = np.einsum("mji,mj->mi", features.T_camera_world[keyframe, :3, :3], features.ray[row])
    ray_weights = np.zeros(len(row))
    for _ in range(_TRIANGULATION_ITERATIONS):
        points = triangulate_rays(
            centres, rays, ray_weights, features.measured_point[row], features.weight[row], point, count
        )
        error_px, depth_m = _reproject(features, row, points[point])
        # A pixel is depth over focal length wide.  Behind a camera the error is infinite, and the weight 0.
        information = np.square(features.focal_px[row] / np.maximum(depth_m, _MIN_DEPTH_M))
        ray_weights = information / np.maximum(error_px / _OUTLIER_PX, 1.0)
    return points


def _reproject(features: _Features, row: Rows, points: Array) -> tuple[Array, Array]:
    """Return reprojection errors ``(m,)``, pixels, infinite behind the camera, and depths ``(m,)``, metres.

    Row *i* of *points* ``(m, 3)``, in the world, is the point of the observing feature ``row[i]``.
    """
    error_px, depth_m = np.empty(len(row)), np.empty(len(row))
    for number, camera in enumerate(features.cameras):
        own = np.flatnonzero(features.camera[row] == number)
        T_camera_world = features.T_camera_world[features.keyframe[row[own]]]
        error_px[own], depth_m[own] = reprojection_errors(
            T_camera_world, points[own], features.pixel[row[own]], camera
        )
    return error_px, depth_m


def _remove_outliers(features: _Features, row: Rows, point: Rows, error_px: Array) -> Rows:
    """Return the part of *row*, in its order, that are inliers: the reprojection error is at most 4 px.

    Of several observations of a point in one keyframe only the one with the smallest error can be an inlier.
    """
    index = features.keyframe[row]
    order = np.lexsort((row, error_px, index, point))
    is_repeated = (np.diff(index[order], prepend=-1) == 0) & (np.diff(point[order], prepend=-1) == 0)
    inliers = order[~is_repeated & (error_px[order] <= _OUTLIER_PX)]
    inlier_rows: Rows = row[np.sort(inliers)]
    return inlier_rows


def _colours(version: MapVersion, points: Array) -> npt.NDArray[np.uint8]:
    """Return for each of *points* ``(n, 3)`` the colour of the first cloud point in its voxel, else grey.

    The result is ``(n, 3)`` uint8; the voxels have an edge of 5 cm.
    """
    colours = np.full((len(points), 3), _GREY, dtype=np.uint8)
    if not len(points) or not len(version.points):
        return colours
    # 1. Number the voxels of the box around the points, and sort the cloud points inside of it by their
    # voxel.
    low = points.min(axis=0) - 1.5 * _COLOUR_VOXEL_M
    sides = np.ceil((points.max(axis=0) - low) / _COLOUR_VOXEL_M) + 2
    is_inside = ((version.points >= low) & (version.points < low + sides * _COLOUR_VOXEL_M)).all(axis=1)
    cloud_voxels = _voxel_numbers(version.points[is_inside], low, sides)
    if not len(cloud_voxels):
        return colours
    order = np.argsort(cloud_voxels, kind="stable")
    # 2. Look up the voxel of each point among those of the cloud by binary search.
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
