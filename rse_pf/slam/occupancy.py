"""The floor plan of a map: a 2-D occupancy grid, and its files as the ROS map_server reads them.

A cell is occupied if the cloud has points between the floor and the height of the robot there, and free if
the cloud shows the floor, or a keyframe has looked through it, within these heights, at one of its features.
All other cells are unknown.

Source:
    ROS map_server and nav2_map_server: image, resolution, origin, negate, occupied_thresh, free_thresh.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, to_quaternion, transform
from rse_pf.maps.format import MapVersion
from rse_pf.slam.inertial import upright_turn
from rse_pf.slam.level_surfaces import UpSource, up_of_map

__all__ = ["FREE", "OCCUPIED", "UNKNOWN", "GridOptions", "OccupancyGrid", "occupancy_files", "occupancy_grid"]

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Values of cells, as grey levels of the image."""

_MAX_CELLS = 1 << 24
_AROUND_M = 30.0
"""Points farther from all poses than this are left out: no camera has seen them."""
_MAX_RAY_M = 10.0
_MAX_RAYS = 400_000
_RAYS_AT_ONCE = 20_000
_LEAST_POINTS = 2
_BIN_M, _AREA_M = 0.05, 0.1
_FLOOR_SHARE = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class GridOptions:
    """What counts as floor and as an obstacle.

    Attributes:
        resolution_m: Length of a cell's edge.
        robot_height_m: Points higher above the floor are no obstacle.
        step_m: Points lower above the floor are floor.
        floor_m: Height of the floor in the world whose z points up; None: the lowest large surface.
        up: ``(3,)`` in the world of the map; None: as the map says, else across its floor, else across its
            level surfaces, which are told from walls by how the cameras stand.
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
    """A floor plan.

    Attributes:
        cells: ``(h, w)`` uint8, `OCCUPIED`, `UNKNOWN` or `FREE`; row 0 is the lowest y.
        origin_m: x and y of the corner of ``cells[0, 0]``.
        resolution_m: Length of a cell's edge.
        floor_m: Height of the floor.
        T_grid_world: ``(4, 4)``, from the world of the map to that of the grid, whose z points up.
        up_by: Where up is known from.
        points_left_out: How many points lie too far from all poses.
    """

    cells: npt.NDArray[np.uint8]
    origin_m: tuple[float, float]
    resolution_m: float
    floor_m: float
    T_grid_world: Array
    up_by: UpSource
    points_left_out: int = 0


_DEFAULT = GridOptions()


def occupancy_grid(version: MapVersion, options: GridOptions = _DEFAULT) -> OccupancyGrid:
    """Return the floor plan of a map; deterministic.

    Raises:
        UsageError: The map has no points or keyframes, nothing tells where up is, or the grid is too large.
    """
    if not version.keyframes:
        raise UsageError("a map without keyframes has no floor plan", hint="export its cloud as ply")
    if not len(version.points):
        raise UsageError("this map has no points, so it has no floor plan", hint="export it as tum or g2o")
    up, up_by = _up_of(version, options)
    turn = upright_turn(-up)
    poses = np.array([turn @ keyframe.T_world_camera for keyframe in version.keyframes])
    low, high = poses[:, :3, 3].min(axis=0), poses[:, :3, 3].max(axis=0)
    _check_size(high - low, options)
    points = transform(turn, version.points.astype(np.float64))
    inside = ((points >= low - _AROUND_M) & (points <= high + _AROUND_M)).all(axis=1)
    left_out, points = len(points) - int(inside.sum()), points[inside]
    if not len(points):
        raise UsageError(f"no point of this map is within {_AROUND_M:g} m of a pose", hint="check its poses")
    floor_m = _floor(points, poses, options) if options.floor_m is None else options.floor_m
    height = points[:, 2] - floor_m
    obstacles = points[(height > options.step_m) & (height <= options.robot_height_m)]
    ground = points[np.abs(height) <= options.step_m]
    start, end = _rays(version, poses, floor_m, turn, options)
    board = _Board.around([obstacles, ground, start, end], options)
    board.mark_free(board.cells_of(ground))
    board.cast(start, end)
    board.mark_occupied(board.cells_of(obstacles))
    return OccupancyGrid(
        cells=board.cells, origin_m=(float(board.low[0]), float(board.low[1])),
        resolution_m=options.resolution_m, floor_m=floor_m, T_grid_world=turn, up_by=up_by,
        points_left_out=left_out,
    )  # fmt: skip


def occupancy_files(grid: OccupancyGrid) -> dict[str, bytes]:
    """Return ``map.pgm`` and ``map.yaml``, which names the image; comments say where the floor is."""
    height, width = grid.cells.shape
    image = f"P5\n{width} {height}\n255\n".encode("ascii") + grid.cells[::-1].tobytes()
    x, y = grid.origin_m
    rows = [", ".join(f"{number:.9g}" for number in row) for row in grid.T_grid_world]
    lines = [
        f"# The floor is at z = {grid.floor_m:.3f} m; up is by {grid.up_by}.",
        "# T_grid_world, from the world of the map to that of this grid:",
        *(f"#   [{row}]" for row in rows),
        "# The same for ROS 2, with the frame `map` of the bridge below the frame `plan` of this grid:",
        f"#   {_as_static_transform(grid.T_grid_world)}",
        "image: map.pgm",
        "mode: trinary",
        f"resolution: {grid.resolution_m:.6g}",
        f"origin: [{x:.6f}, {y:.6f}, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
    ]
    return {"map.pgm": image, "map.yaml": ("\n".join(lines) + "\n").encode("ascii")}


def _as_static_transform(T_grid_world: Array) -> str:
    x, y, z = T_grid_world[:3, 3]
    qx, qy, qz, qw = to_quaternion(T_grid_world[:3, :3])
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {x:.6f} --y {y:.6f} --z {z:.6f} "
        f"--qx {qx:.9f} --qy {qy:.9f} --qz {qz:.9f} --qw {qw:.9f} --frame-id plan --child-frame-id map"
    )


def _up_of(version: MapVersion, options: GridOptions) -> tuple[Array, UpSource]:
    if options.up is not None:
        up = np.array(options.up)
        return up / np.linalg.norm(up), "--up"
    found = up_of_map(version)
    if found is None:
        raise UsageError(
            "this map does not say where up is, and its cameras do not agree", hint="name it: --up 0,0,1"
        )
    return found


def _check_size(extent_m: Array, options: GridOptions) -> None:
    sides = np.ceil(extent_m[:2] / options.resolution_m) + 1.0
    cells = float(sides[0] * sides[1])
    if cells > _MAX_CELLS:
        least_m = options.resolution_m * math.sqrt(cells / _MAX_CELLS) * 1.1
        hint = f"raise --resolution to {least_m:.2g} m" if least_m < 10.0 else "check the poses of the map"
        raise UsageError(
            f"a grid over {extent_m[0]:.4g} x {extent_m[1]:.4g} m has {cells:.3g} cells, above {_MAX_CELLS}",
            hint=hint,
        )


def _floor(points: Array, poses: Array, options: GridOptions) -> float:
    """Return the height of the lowest of the large level surfaces below the cameras.

    The area of a surface is that of the squares of 10 cm with points in a layer of 5 cm; a large one has 30 %
    of the largest.  Without points below the cameras it is the height of the lowest point.
    """
    below = points[points[:, 2] < float(np.median(poses[:, 2, 3]))]
    if not len(below):
        return float(points[:, 2].min())
    base = float(below[:, 2].min())
    cells = np.column_stack([
        np.floor((below[:, 2] - base) / _BIN_M), np.floor(below[:, :2] / _AREA_M)
    ]).astype(np.int64)  # fmt: skip
    area = np.bincount(np.unique(cells, axis=0)[:, 0])
    layer = int(np.flatnonzero(area >= _FLOOR_SHARE * area.max())[0])
    middle = base + (layer + 0.5) * _BIN_M
    near = below[np.abs(below[:, 2] - middle) <= _BIN_M, 2]
    return float(np.median(near)) if len(near) else middle


def _rays(
    version: MapVersion, poses: Array, floor_m: float, turn: Array, options: GridOptions
) -> tuple[Array, Array]:
    """Return starts and ends ``(n, 3)`` of the looks at features, cut to the heights of the robot.

    Each ends a cell before the feature: the cell of that is not free.
    """
    starts, ends = [np.empty((0, 3))], [np.empty((0, 3))]
    most = max(1, _MAX_RAYS // len(poses))
    for keyframe, T in zip(version.keyframes, poses, strict=True):
        points = keyframe.points_camera.astype(np.float64)
        points = points[(np.abs(points) <= _MAX_RAY_M).all(axis=1) & (points[:, 2] > 0.0)]
        points = points[:: max(1, math.ceil(len(points) / most))]
        ends.append(transform(T, points))
        starts.append(np.broadcast_to(T[:3, 3], points.shape))
    start, end = np.concatenate(starts), np.concatenate(ends)
    way = end - start
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    low, high = floor_m - options.step_m, floor_m + options.robot_height_m
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (np.array([low, high]) - start[:, 2:]) / way[:, 2:]
    is_level = np.abs(way[:, 2]) < 1e-9
    within = (start[:, 2] >= low) & (start[:, 2] <= high)
    at[is_level] = np.where(within[is_level, None], [0.0, 1.0], [1.0, 0.0])
    at[~is_level] = np.sort(at[~is_level], axis=1)
    first = np.maximum(at[:, 0], 0.0)
    last = np.minimum(at[:, 1], 1.0 - options.resolution_m / length)
    seen = first < last
    way, origin = way[seen], start[seen]
    return origin + first[seen, None] * way, origin + last[seen, None] * way


@dataclass(slots=True, kw_only=True, eq=False)
class _Board:
    """The cells while they are made; ``low`` ``(2,)`` is the corner of the first one, in whole cells."""

    low: Array
    resolution_m: float
    cells: npt.NDArray[np.uint8] = field(repr=False)

    @staticmethod
    def around(parts: list[Array], options: GridOptions) -> _Board:
        every = np.concatenate([part[:, :2] for part in parts])
        if not len(every):
            raise UsageError(
                "this map shows nothing between the floor and the height of the robot",
                hint="name the height of the floor: --floor",
            )
        low, high = every.min(axis=0), every.max(axis=0)
        _check_size(high - low, options)
        low = (np.floor(low / options.resolution_m) - 1.0) * options.resolution_m
        width, height = (np.ceil((high - low) / options.resolution_m) + 1.0).astype(np.int64)
        cells = np.full((int(height), int(width)), UNKNOWN, dtype=np.uint8)
        return _Board(low=low, resolution_m=options.resolution_m, cells=cells)

    def cells_of(self, points: Array) -> npt.NDArray[np.int64]:
        """Return the number of the cell of each point."""
        column, row = np.floor((points[:, :2] - self.low) / self.resolution_m).astype(np.int64).T
        numbers: npt.NDArray[np.int64] = row * self.cells.shape[1] + column
        return numbers

    def mark_free(self, numbers: npt.NDArray[np.int64]) -> None:
        self.cells.reshape(-1)[numbers] = FREE

    def mark_occupied(self, numbers: npt.NDArray[np.int64]) -> None:
        """Mark cells that are named twice or more."""
        found, count = np.unique(numbers, return_counts=True)
        self.cells.reshape(-1)[found[count >= _LEAST_POINTS]] = OCCUPIED

    def cast(self, start: Array, end: Array) -> None:
        """Mark the cells that lie on lines."""
        for first in range(0, len(start), _RAYS_AT_ONCE):
            rows = slice(first, first + _RAYS_AT_ONCE)
            origin, way = start[rows, :2], end[rows, :2] - start[rows, :2]
            steps = np.ceil(2.0 * np.linalg.norm(way, axis=1) / self.resolution_m).astype(np.int64) + 1
            ray = np.repeat(np.arange(len(steps)), steps)
            step = np.arange(len(ray)) - np.repeat(np.cumsum(steps) - steps, steps)
            share = step / np.maximum(steps[ray] - 1, 1)
            self.mark_free(np.unique(self.cells_of(origin[ray] + share[:, None] * way[ray])))
