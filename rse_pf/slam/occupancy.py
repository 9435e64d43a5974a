"""Make the floor plan of a map: a 2-D occupancy grid.

A cell is occupied if at least two points of the cloud in it are more than one step above the floor, and not
above the height of the robot.  A cell is free if it is not occupied, and if a point of the cloud in it is
within one step of the floor, or a line of sight from a keyframe to one of its features passes over it at a
height from one step below the floor to the height of the robot.  All other cells are unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, planar_pose, transform
from rse_pf.maps.format import MapVersion
from rse_pf.slam.inertial import upright_rotation
from rse_pf.slam.level_surfaces import UpSource, estimate_up

__all__ = [
    "FREE",
    "MAX_CELLS",
    "MAX_LINES_OF_SIGHT",
    "OCCUPIED",
    "UNKNOWN",
    "GridOptions",
    "OccupancyGrid",
    "grid_of_points",
    "level_map",
    "make_occupancy_grid",
]

OCCUPIED = 0  # grey level of a cell with an obstacle: black
UNKNOWN = 205  # grey level of a cell that no camera has observed, as map_saver of ROS writes it
FREE = 254  # grey level of a cell without an obstacle: white, as map_saver of ROS writes it

MAX_CELLS = 1 << 24  # largest number of cells of an occupancy grid: 16 MiB of memory
_MAX_DISTANCE_M = 30.0
"""Largest distance in metres of a point from the box around all camera positions, along each axis of the
grid; points beyond are left out of the floor plan, because no camera can have seen them."""
_MAX_RAY_M = 10.0
"""Largest absolute coordinate in metres, in the camera's frame, of a feature whose line of sight marks cells
as free: the depth of a farther one is inaccurate."""
MAX_LINES_OF_SIGHT = 400_000
"""Largest number of lines of sight of a map that mark cells as free, divided equally among its keyframes;
bounds the time of an export."""
_RAYS_AT_ONCE = 20_000
"""Number of lines of sight that are rasterised in one array operation; bounds its memory."""
_MIN_POINTS = 2
"""Smallest number of points of the cloud that make a cell occupied: a single point may be an outlier."""
_LAYER_M = 0.05
"""Height in metres of the horizontal layers whose areas are compared to find the floor; the height of the
floor is then a median of points, which is finer."""
_AREA_CELL_M = 0.1  # edge in metres of the squares whose number measures the area of a horizontal layer
_FLOOR_SHARE = 0.3
"""The floor is the lowest layer whose area is at least this share of the area of the largest layer."""
_LEVEL_SQUARE_M = 0.25
"""Edge of the squares of which all points move with the same keyframe where a map is levelled: much smaller
than the distance over which a drift of the height matters."""
_SQUARES_AT_ONCE = 4096  # squares that are compared with all keyframes in one array operation; bounds memory


@dataclass(frozen=True, slots=True, kw_only=True)
class GridOptions:
    """The size of the cells of a floor plan, and which points of the map are floor and which are obstacles.

    Points that are neither, since they are above the robot or more than one step below the floor, mark no
    cell.

    Attributes:
        resolution_m: Length of a cell's edge, 0.01..10 m.
        robot_height_m: Obstacles are the points above ``step_m`` up to this height above the floor,
            0.05..100 m.
        step_m: Points up to this distance above or below the floor are part of the floor, 0.005..10 m.
        floor_m: Height of the floor in the frame of the grid, which is the world of the map rotated so that
            its z axis points up; None means the lowest large horizontal surface.
        up: ``(3,)`` direction against gravity in the world of the map, of a length within 0.001..1000; None
            means the direction that `rse_pf.slam.level_surfaces.estimate_up` returns.

    Raises:
        UsageError: A number or the length of *up* is out of its range, or the step is not below the height of
            the robot.
    """

    resolution_m: float = 0.05
    robot_height_m: float = 1.5
    step_m: float = 0.1
    floor_m: float | None = None
    up: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("--resolution", self.resolution_m, 0.01, 10.0),
            ("--robot-height", self.robot_height_m, 0.05, 100.0),
            ("--step", self.step_m, 0.005, 10.0),
            ("--floor", self.floor_m or 0.0, -1e5, 1e5),
        ):
            if not low <= value <= high:
                raise UsageError(
                    f"{name} = {value:g} is not within {low:g}..{high:g} m",
                    hint="leave it out for the default",
                )
        if self.step_m >= self.robot_height_m:
            raise UsageError(
                f"--step = {self.step_m:g} m is not below --robot-height = {self.robot_height_m:g} m",
                hint="an obstacle is higher than the step, and lower than the robot",
            )
        length = math.hypot(*(self.up or (1.0, 0.0, 0.0)))
        if not 1e-3 <= length <= 1e3:
            raise UsageError("--up is no direction", hint="name it in the world of the map, such as 0,0,1")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OccupancyGrid:
    """The floor plan of a map.

    Attributes:
        cells: ``(h, w)`` uint8, `OCCUPIED`, `UNKNOWN` or `FREE`; row 0 has the lowest y, column 0 the
            lowest x.
        origin_m: x and y of the corner of ``cells[0, 0]`` with the lowest x and y, in the frame of the grid.
        resolution_m: Length of a cell's edge.
        floor_m: Height of the floor in the frame of the grid.
        T_grid_world: ``(4, 4)``, maps the world of the map to the frame of the grid, whose z axis points up;
            a rotation without translation.
        up_source: How the direction against gravity was found.
        points_left_out: The number of points of the map that were not used, because they are more than 30 m
            outside the box around all camera positions.
    """

    cells: npt.NDArray[np.uint8]
    origin_m: tuple[float, float]
    resolution_m: float
    floor_m: float
    T_grid_world: Array
    up_source: UpSource
    points_left_out: int = 0


_DEFAULT = GridOptions()


def make_occupancy_grid(
    version: MapVersion, options: GridOptions = _DEFAULT, *, max_lines: int = MAX_LINES_OF_SIGHT
) -> OccupancyGrid:
    """Return the floor plan of a map; the same map and options always give the same grid.

    Args:
        version: The map, with keyframes and points.
        options: Size of the cells, and heights of floor and robot.
        max_lines: Largest number of lines of sight that mark cells as free; fewer take less time.

    Raises:
        UsageError: The map has no points or no keyframes, the direction against gravity is unknown, no point
            is near the cameras, nothing is seen between the floor and the height of the robot, or the grid
            would have more than 2**24 cells.
    """
    if not version.keyframes:
        raise UsageError("a map without keyframes has no floor plan", hint="export its cloud as ply")
    if not len(version.points):
        raise UsageError("this map has no points, so it has no floor plan", hint="export it as tum or g2o")
    up, up_source = _find_up(version, options)
    return grid_of_points(
        version.points,
        np.array([keyframe.T_world_camera for keyframe in version.keyframes]),
        [keyframe.points_camera for keyframe in version.keyframes],
        up,
        options,
        up_source=up_source,
        max_lines=max_lines,
    )


def grid_of_points(
    points_world: npt.NDArray[np.float32],
    T_world_camera: Array,
    sights_camera: Sequence[npt.NDArray[np.float32]],
    up: Array,
    options: GridOptions,
    *,
    up_source: UpSource,
    max_lines: int,
) -> OccupancyGrid:
    """Return the floor plan of a cloud and of the cameras that have seen it.

    Args:
        points_world: ``(m, 3)`` metres, m >= 1.
        T_world_camera: ``(k, 4, 4)``, k >= 1.
        sights_camera: For each camera ``(n, 3)`` points that it has seen, in its own frame, metres or NaN.
        up: ``(3,)``, unit vector against gravity in the world.
        options: Size of the cells, and heights of floor and robot; its ``up`` is not used.
        up_source: Where *up* comes from.
        max_lines: Largest number of lines of sight that mark cells as free.

    Raises:
        UsageError: No point is near the cameras, nothing is seen between the floor and the height of the
            robot, or the grid would have more than 2**24 cells.
    """
    # 1. Rotate the map so that its z axis points up.
    T_grid_world = upright_rotation(-up)
    T_grid_camera = T_grid_world @ T_world_camera
    # 2. Leave out points that no camera can have seen: those far outside the box around the cameras.  Refuse
    # a grid that would be too large for the cameras alone before the points are transformed.
    low = T_grid_camera[:, :3, 3].min(axis=0)
    high = T_grid_camera[:, :3, 3].max(axis=0)
    _check_cell_count(high - low, options)
    points = transform(T_grid_world, points_world.astype(np.float64))
    is_near = ((points >= low - _MAX_DISTANCE_M) & (points <= high + _MAX_DISTANCE_M)).all(axis=1)
    points_left_out = len(points) - int(is_near.sum())
    points = points[is_near]
    if not len(points):
        raise UsageError(
            f"no point of this map is within {_MAX_DISTANCE_M:g} m of a pose", hint="check its poses"
        )
    # 3. Find the height of the floor, and choose floor points and obstacles by their height above it.
    floor_m = _find_floor(points, T_grid_camera, options) if options.floor_m is None else options.floor_m
    height_m = points[:, 2] - floor_m
    obstacles = points[(height_m > options.step_m) & (height_m <= options.robot_height_m)]
    floor_points = points[np.abs(height_m) <= options.step_m]
    # 4. Mark the cells of floor points and lines of sight as free, then those of obstacles as occupied, which
    # replaces free.
    start, end = _lines_of_sight(sights_camera, T_grid_camera, floor_m, options, max_lines)
    raster = _Raster.covering([obstacles, floor_points, start, end], options)
    raster.mark_free(raster.cell_numbers(floor_points))
    raster.mark_lines_free(start, end)
    raster.mark_occupied(raster.cell_numbers(obstacles))
    return OccupancyGrid(
        cells=raster.cells,
        origin_m=(float(raster.low[0]), float(raster.low[1])),
        resolution_m=options.resolution_m,
        floor_m=floor_m,
        T_grid_world=T_grid_world,
        up_source=up_source,
        points_left_out=points_left_out,
    )


def level_map(version: MapVersion, T_base_camera: Array) -> MapVersion:
    """Return a map in which the base of the robot stands level, at one height, at each keyframe.

    A robot on wheels stands on the floor: where its base is estimated above it or tilted, because the pose
    has drifted or on a ramp, the floor around it is, too.  Each point gets the height that it has above the
    base at the nearest keyframe; x and y of points and bases stay.

    Args:
        version: The map, whose z axis points up, with keyframes.
        T_base_camera: ``(4, 4)``, metres: mount of the camera on the base.
    """
    # 1. Level the base at each keyframe, at the height of the first one.
    T_world_camera = np.array([keyframe.T_world_camera for keyframe in version.keyframes])
    T_world_base = T_world_camera @ inverse(T_base_camera)
    T_world_level = np.array(
        [planar_pose(pose[0, 3], pose[1, 3], math.atan2(pose[1, 0], pose[0, 0])) for pose in T_world_base]
    )
    T_world_level[:, 2, 3] = T_world_base[0, 2, 3]
    keyframes = tuple(
        replace(keyframe, T_world_camera=pose)
        for keyframe, pose in zip(version.keyframes, T_world_level @ T_base_camera, strict=True)
    )
    # 2. Find the nearest keyframe of each square that has points.
    points = version.points.astype(np.float64)
    low = points[:, :2].min(axis=0, initial=0.0)
    columns, rows = np.floor((points[:, :2] - low) / _LEVEL_SQUARE_M).astype(np.int64).T
    width = int(columns.max(initial=0)) + 1
    numbers, square = np.unique(rows * width + columns, return_inverse=True)
    squares = np.column_stack([numbers % width, numbers // width])
    nearest = np.zeros(len(squares), dtype=np.int64)
    for first in range(0, len(squares), _SQUARES_AT_ONCE):
        part = slice(first, first + _SQUARES_AT_ONCE)
        middles = low + (squares[part] + 0.5) * _LEVEL_SQUARE_M
        nearest[part] = np.linalg.norm(middles[:, None] - T_world_base[:, :2, 3], axis=2).argmin(axis=1)
    # 3. Give each point its height above the base there.
    heights = (T_world_level @ inverse(T_world_base))[:, 2][nearest[square]]
    points[:, 2] = (heights[:, :3] * points).sum(axis=1) + heights[:, 3]
    return replace(version, keyframes=keyframes, points=points.astype(np.float32))


def _find_up(version: MapVersion, options: GridOptions) -> tuple[Array, UpSource]:
    if options.up is not None:
        up = np.array(options.up)
        return up / np.linalg.norm(up), "--up"
    estimate = estimate_up(version)
    if estimate is None:
        raise UsageError(
            "this map does not say where up is, and its cameras do not agree", hint="name it: --up 0,0,1"
        )
    return estimate


def _check_cell_count(extent_m: Array, options: GridOptions) -> None:
    """Raise UsageError if a grid over *extent_m* (x and y in metres; a third number is ignored) is too large.

    The limit is 2**24 cells.
    """
    sides = np.ceil(extent_m[:2] / options.resolution_m) + 1.0
    cells = float(sides[0] * sides[1])
    if cells > MAX_CELLS:
        min_resolution_m = options.resolution_m * math.sqrt(cells / MAX_CELLS) * 1.1
        hint = (
            f"raise --resolution to {min_resolution_m:.2g} m"
            if min_resolution_m < 10.0
            else "check the poses of the map"
        )
        raise UsageError(
            f"a grid over {extent_m[0]:.4g} x {extent_m[1]:.4g} m has {cells:.3g} cells, above {MAX_CELLS}",
            hint=hint,
        )


def _find_floor(points: Array, T_grid_camera: Array, options: GridOptions) -> float:
    """Return the height of the lowest large horizontal surface below the cameras, metres in the grid's frame.

    Points below the median camera height are divided into horizontal layers of 5 cm.  The area of a layer is
    the number of its 10 cm squares with a point; a layer is large if it has at least 30 % of the area of the
    largest layer.  The result is the median height of the points within 5 cm of the middle of the lowest
    large layer; without points below the median camera height, the height of the lowest point.

    Args:
        points: ``(n, 3)`` metres in the frame of the grid, at least one.
        T_grid_camera: ``(k, 4, 4)``, the poses of the cameras.
        options: Not used.
    """
    below = points[points[:, 2] < float(np.median(T_grid_camera[:, 2, 3]))]
    if not len(below):
        return float(points[:, 2].min())
    lowest_m = float(below[:, 2].min())
    layers = np.floor((below[:, 2] - lowest_m) / _LAYER_M).astype(np.int64)
    squares = np.floor((below[:, :2] - below[:, :2].min(axis=0)) / _AREA_CELL_M).astype(np.int64)
    columns, rows = squares.max(axis=0) + 1
    distinct = np.unique((layers * columns + squares[:, 0]) * rows + squares[:, 1])
    area = np.bincount(distinct // (columns * rows))
    layer = int(np.flatnonzero(area >= _FLOOR_SHARE * area.max())[0])
    middle_m = lowest_m + (layer + 0.5) * _LAYER_M
    near = below[np.abs(below[:, 2] - middle_m) <= _LAYER_M, 2]
    return float(np.median(near)) if len(near) else middle_m


def _lines_of_sight(
    sights_camera: Sequence[npt.NDArray[np.float32]],
    T_grid_camera: Array,
    floor_m: float,
    options: GridOptions,
    max_lines: int,
) -> tuple[Array, Array]:
    """Return starts and ends ``(n, 3)`` in metres of the lines from cameras to features, in the grid's frame.

    Lines are cut to the heights from one step below the floor to the height of the robot above it, and end
    the length of a cell before the feature, because the cell of the feature itself is not free.  Lines of
    which nothing is left are dropped, so that *n* may be 0.
    """
    max_per_keyframe = max(1, max_lines // len(T_grid_camera))
    # 1. Take the lines from each keyframe to those of its features that lie in front of the camera, not
    # farther than `_MAX_RAY_M` along any axis; thin them evenly to the share of a keyframe.
    points = np.concatenate(sights_camera).astype(np.float64)
    keyframe = np.repeat(np.arange(len(sights_camera)), [len(seen) for seen in sights_camera])
    is_usable = (np.abs(points) <= _MAX_RAY_M).all(axis=1) & (points[:, 2] > 0.0)
    points, keyframe = points[is_usable], keyframe[is_usable]
    count = np.bincount(keyframe, minlength=len(sights_camera))
    place = np.arange(len(points)) - (np.cumsum(count) - count)[keyframe]
    is_chosen = place % np.maximum(1, -(-count // max_per_keyframe))[keyframe] == 0
    T = T_grid_camera[keyframe[is_chosen]]
    start = T[:, :3, 3]
    end = np.einsum("nij,nj->ni", T[:, :3, :3], points[is_chosen]) + start
    direction = end - start
    length_m = np.maximum(np.linalg.norm(direction, axis=1), 1e-9)
    # 2. Find where each line crosses the lowest and the highest permitted height, as shares of its length: 0
    # is the camera, 1 the feature.  A level line gets 0 and 1 at a permitted height, else 1 and 0: nothing is
    # left.
    low = floor_m - options.step_m
    high = floor_m + options.robot_height_m
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = (np.array([low, high]) - start[:, 2:]) / direction[:, 2:]
    is_level = np.abs(direction[:, 2]) < 1e-9
    is_within = (start[:, 2] >= low) & (start[:, 2] <= high)
    crossing[is_level] = np.where(is_within[is_level, None], [0.0, 1.0], [1.0, 0.0])
    crossing[~is_level] = np.sort(crossing[~is_level], axis=1)
    # 3. Cut each line at these shares, and the length of a cell before its feature; drop lines of which
    # nothing is left.
    first = np.maximum(crossing[:, 0], 0.0)
    last = np.minimum(crossing[:, 1], 1.0 - options.resolution_m / length_m)
    is_left = first < last
    direction, origin = direction[is_left], start[is_left]
    return origin + first[is_left, None] * direction, origin + last[is_left, None] * direction


@dataclass(slots=True, kw_only=True, eq=False)
class _Raster:
    """The cells of a grid, which the methods mark in place.

    Attributes:
        low: ``(2,)``, x and y in metres of the corner of cell (0, 0) with the lowest coordinates.
        resolution_m: Length of a cell's edge.
        cells: ``(h, w)`` as in `OccupancyGrid`; the row is along y, the column along x.
    """

    low: Array
    resolution_m: float
    cells: npt.NDArray[np.uint8] = field(repr=False)

    @staticmethod
    def covering(point_sets: list[Array], options: GridOptions) -> _Raster:
        """Return a raster of unknown cells around all points ``(n, 3)``, with a margin of one cell.

        Raises:
            UsageError: The sets hold no point, or the raster would have more than 2**24 cells.
        """
        xy = np.concatenate([points[:, :2] for points in point_sets])
        if not len(xy):
            raise UsageError(
                "this map shows nothing between the floor and the height of the robot",
                hint="name the height of the floor: --floor",
            )
        low, high = xy.min(axis=0), xy.max(axis=0)
        _check_cell_count(high - low, options)
        low = (np.floor(low / options.resolution_m) - 1.0) * options.resolution_m
        width, height = (np.ceil((high - low) / options.resolution_m) + 1.0).astype(np.int64)
        cells = np.full((int(height), int(width)), UNKNOWN, dtype=np.uint8)
        return _Raster(low=low, resolution_m=options.resolution_m, cells=cells)

    def cell_numbers(self, points: Array) -> npt.NDArray[np.int64]:
        """Return ``(n,)``, the index of the cell that holds each point in ``cells`` flattened row by row."""
        column, row = np.floor((points[:, :2] - self.low) / self.resolution_m).astype(np.int64).T
        numbers: npt.NDArray[np.int64] = row * self.cells.shape[1] + column
        return numbers

    def mark_free(self, cell_numbers: npt.NDArray[np.int64]) -> None:
        self.cells.reshape(-1)[cell_numbers] = FREE

    def mark_occupied(self, cell_numbers: npt.NDArray[np.int64]) -> None:
        """Mark the cells that hold at least two points; *cell_numbers* has the cell of each point."""
        distinct, count = np.unique(cell_numbers, return_counts=True)
        self.cells.reshape(-1)[distinct[count >= _MIN_POINTS]] = OCCUPIED

    def mark_lines_free(self, start: Array, end: Array) -> None:
        """Mark the cells under lines from *start* to *end* ``(n, 3)``, metres, as free.

        A line marks the cells of samples at most half a cell's edge apart, so that it may miss a cell of
        which it only cuts a corner.
        """
        for first in range(0, len(start), _RAYS_AT_ONCE):
            rows = slice(first, first + _RAYS_AT_ONCE)
            origin, direction = start[rows, :2], end[rows, :2] - start[rows, :2]
            samples = (
                np.ceil(2.0 * np.linalg.norm(direction, axis=1) / self.resolution_m).astype(np.int64) + 1
            )
            line = np.repeat(np.arange(len(samples)), samples)
            sample = np.arange(len(line)) - np.repeat(np.cumsum(samples) - samples, samples)
            share = sample / np.maximum(samples[line] - 1, 1)
            self.mark_free(self.cell_numbers(origin[line] + share[:, None] * direction[line]))
