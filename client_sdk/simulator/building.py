"""Make buildings for robots on wheels: an office with a ring of corridors, nine rooms, and a hall of shelves.

Lengths are in metres; x points right in a plan, y up, z up, and z = 0 is the floor.  A plan has one character
for each square metre: ``#`` is wall, ``S`` a shelf of 1.9 m, ``B`` a box of 0.8 m, and a small letter the
floor of a room.  All squares of one letter have the wallpaper and the floor of one room.  The seed chooses
the textures; `client_sdk.simulator.renderer` draws the building.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.simulator.textures import (
    make_books,
    make_noise,
    make_planks,
    make_poster,
    make_wallpaper,
)
from client_sdk.simulator.world import (
    BOOK_COLOURS,
    CEILING_COLOURS,
    FLOOR_COLOURS,
    HEIGHT_M,
    POSTER_COLOURS,
    ROOM_M,
    WALLPAPER_COLOURS,
    Face,
    World,
    WorldBuilder,
)
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["BUILDINGS", "Building", "make_building"]

_PLANS = {
    "office": """
        ########################
        #aaaaaa#bbbbbb#ccccccSS#
        #aaBaaa#bbbbbb#cccBcccc#
        #aaaaaa#bbSbbb#cccccccc#
        ####a######b######c#####
        #ddddddjjjjjkkkkkklllll#
        #ddddddjjjjjkkkkkklllll#
        #ee##################ff#
        #ee#gggggSg#hhhhBhh##ff#
        #ee#ggggggg#hhhhhhh##ff#
        #eeggggggBg#hhhhhhhhhff#
        #ee#ggggggg#hhhShhh##ff#
        #ee##################ff#
        #iiiiiimmmmmnnnnnnooooo#
        #iiiiiimmmmmnnnnnnooooo#
        ########################""",
    "rooms": """
        ###################
        #aaaaa#bbbbb#ccccc#
        #aBaaa#bbbbb#ccSSc#
        #aaaaaabbbbbbccccc#
        #aaaaa#bbBbb#ccccc#
        #SSaaa#bbbbb#ccccc#
        ###a######b####c###
        #ddddd#eeeee#fffff#
        #ddddd#eBeee#fffff#
        #ddddddeeeee#ffBff#
        #dSddd#eeeeeeffff##
        #ddddd#eeeee#fffff#
        ###d####e######f###
        #ggggg#hhhhh#iiiii#
        #gBggg#hhhhh#iiiSi#
        #ggggg#hhBhhhiiiSi#
        #gggggghhhhh#iiiii#
        #ggggS#hhhhh#iBiii#
        ###################""",
    "hall": """
        ######################
        #aaaaabbbbbcccccddddd#
        #aaaaabbbbbcccccddddd#
        #aaSSSSSSbbccSSSSSSdd#
        #aaaaabbbbbcccccddddd#
        #aaaaabbbbbcccccddddd#
        #eeSSSBffffggSSSSSShh#
        #eeeeefffffggggghhhhh#
        #eeeeefffffggggghhhhh#
        #eeSSSSSSffgggBSSSShh#
        #eeeeefffffggggghhhhh#
        #iiiiijjjjjkkkkklllll#
        #iiSSSSSSjjkkSSSSSSll#
        #iiiiijjjjjkkkkklllll#
        #iiiiijjjjjkkkkklllll#
        ######################""",
}
BUILDINGS = tuple(_PLANS)
"""Names of the buildings."""

_WALL = "#"
_SHELF = "S"
_SHELF_HEIGHT_M = 1.9  # height of a shelf, metres: above the camera
_BOX = "B"
_BOX_HEIGHT_M = 0.8  # height of a box, metres: the camera sees over it
_FLOOR_TEXEL_M = 0.0055
"""Width of a texel of floors, whose textures repeat after 5.6 m; most rooms are at most that long, because a
floor that repeats in view gives false places."""
_WALL_TEXEL_M = 0.004  # width of a texel of wallpapers: fine enough for a camera at 0.5 m from a wall
_CEILING_TEXEL_M = 0.005  # width of a texel of ceilings
_BOOKS_TEXELS = 512  # side of the texture of a shelf, which is as high as the shelf
_POSTER_TEXELS = 256  # side of the texture of a poster
_POSTER_M = 0.8  # side of a poster on a wall
_POSTER_LOW_M = (0.3, 1.2)  # lowest and highest lower edge of a poster: a camera near the floor sees it
_POSTER_EVERY_M = 2.0  # length of wall for each poster, so that two stretches of one wallpaper differ
_POSTER_OFFSET_M = 0.01  # distance of a poster from its wall
_PATH_STEP_M = 0.01  # distance between two points of a route
_ROUNDING_POINTS = 30
"""To round the corners of a route, each point (1 cm apart) is replaced by the mean of itself and this many
points on either side; this is done twice.  It cuts a corner by at most 0.3 m, and no wall is nearer than
0.5 m to the corner."""
_MIN_LEG_SQUARES = 5  # fewest squares from one goal of a route to the next


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Building:
    """A building: what it looks like, and where a robot can drive.

    Attributes:
        world: Faces and textures, for the renderer.
        is_free: ``(h, w)`` of bool, one square metre each: row r and column c are the floor with y from r to
            r + 1 and x from c to c + 1.
    """

    world: World
    is_free: npt.NDArray[np.bool_]

    def distance_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a point from the nearest wall, shelf or box; 0 inside of one."""
        row, column = int(np.floor(y_m)), int(np.floor(x_m))
        height, width = self.is_free.shape
        if not (0 <= row < height and 0 <= column < width):
            return 0.0
        rows, columns = np.nonzero(~self.is_free)
        gap_x = np.maximum(np.maximum(columns - x_m, x_m - columns - 1), 0.0)
        gap_y = np.maximum(np.maximum(rows - y_m, y_m - rows - 1), 0.0)
        return float(np.hypot(gap_x, gap_y).min())

    def route(self, seed: int, length_m: float) -> Array:
        """Return ``(n, 2)`` points x, y, 1 cm apart, of a drive to random goals, at least *length_m* long.

        The route leads along the middle of squares, with rounded corners; it turns back where a goal lies
        behind it.
        """
        rng = np.random.default_rng([seed, 23])
        squares = [tuple(each) for each in np.argwhere(self.is_free).tolist()]
        visited = [squares[int(rng.integers(len(squares)))]]
        while len(visited) - 1 < length_m:
            leg = self._shortest_path(visited[-1], squares[int(rng.integers(len(squares)))])
            if len(leg) > _MIN_LEG_SQUARES:
                visited += leg[1:]
        corners = np.array(visited, dtype=float)[:, ::-1] + 0.5
        path = _resample(corners)
        for _ in range(2):
            path = _resample(_round_corners(path))
        return path

    def _shortest_path(self, start: tuple[int, ...], goal: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Return the squares from *start* to *goal*, both included, by breadth-first search."""
        parents: dict[tuple[int, ...], tuple[int, ...]] = {start: start}
        queue = deque([start])
        while queue and goal not in parents:
            row, column = square = queue.popleft()
            for near in ((row, column + 1), (row, column - 1), (row + 1, column), (row - 1, column)):
                if near not in parents and self.is_free[near]:
                    parents[near] = square
                    queue.append(near)
        path = [goal]
        while path[-1] != start:
            path.append(parents[path[-1]])
        return path[::-1]


def make_building(name: str, seed: int) -> Building:
    """Return a building of `BUILDINGS`, whose textures, posters and shelves are chosen by *seed*.

    Raises:
        UsageError: There is no building of this name.
    """
    if name not in _PLANS:
        raise UsageError(f"there is no building {name!r}", hint=f"choose one of {', '.join(BUILDINGS)}")
    plan = np.array([list(row.strip()) for row in _PLANS[name].split()][::-1])
    builder = WorldBuilder(np.random.default_rng([seed, 29, BUILDINGS.index(name)]))
    # 1. Add floor, ceiling and walls of each room, and posters on its walls.
    ceiling = builder.add_texture(0.5 + 0.25 * make_noise(builder.rng, 1024, 4, 120, 0.6))
    is_room = np.char.islower(plan)
    for number, letter in enumerate(np.unique(plan[is_room])):
        _add_room(builder, plan, str(letter), number, ceiling)
    # 2. Add shelves and boxes.
    for kind, height_m in ((_SHELF, _SHELF_HEIGHT_M), (_BOX, _BOX_HEIGHT_M)):
        for row, first, last in _runs(plan == kind):
            _add_block(builder, (first, row, 0.0), (last, row + 1.0, height_m), is_shelf=kind == _SHELF)
    return Building(world=World(tuple(builder.faces), tuple(builder.textures)), is_free=is_room)


def _add_room(
    builder: WorldBuilder, plan: npt.NDArray[np.str_], letter: str, number: int, ceiling: int
) -> None:
    """Add the floor and the ceiling of the rectangle around all squares of a letter, and their walls."""
    rows, columns = np.nonzero(plan == letter)
    low, high = (float(columns.min()), float(rows.min())), (columns.max() + 1.0, rows.max() + 1.0)
    lamp = int((low[0] + high[0]) / 2 / ROOM_M)
    floor = builder.add_texture(make_planks(builder.rng))
    builder.faces.append(Face(2, 0.0, 1, low, high, floor, _FLOOR_TEXEL_M, *FLOOR_COLOURS, lamp))
    builder.faces.append(Face(2, HEIGHT_M, -1, low, high, ceiling, _CEILING_TEXEL_M, *CEILING_COLOURS, lamp))
    paper = builder.add_texture(make_wallpaper(builder.rng, number))
    colours = WALLPAPER_COLOURS[number % len(WALLPAPER_COLOURS)]
    is_wall, is_own = plan == _WALL, (plan == letter) | np.isin(plan, (_SHELF, _BOX))
    for axis, sign in itertools.product((0, 1), (1, -1)):
        # A wall that is seen from larger x lies on the left of a square of the room.
        is_wall_near = np.roll(is_wall, sign, axis=1 - axis) & is_own
        for line, first, last in _runs(is_wall_near.T if axis == 0 else is_wall_near):
            if not _has_letter(plan, letter, axis, line, first, last):
                continue
            offset = line + (0.0 if sign > 0 else 1.0)
            face_low, face_high = (float(first), 0.0), (float(last), HEIGHT_M)
            builder.faces.append(
                Face(axis, offset, sign, face_low, face_high, paper, _WALL_TEXEL_M, *colours, lamp)
            )
            _add_posters(builder, (axis, offset, sign), (float(first), float(last)), lamp)


def _has_letter(plan: npt.NDArray[np.str_], letter: str, axis: int, line: int, first: int, last: int) -> bool:
    """Return whether a run of squares holds a letter, and not only furniture."""
    squares = plan[first:last, line] if axis == 0 else plan[line, first:last]
    return bool((squares == letter).any())


def _add_posters(
    builder: WorldBuilder, wall: tuple[int, float, int], extent: tuple[float, float], lamp: int
) -> None:
    """Add posters at random places of a wall (axis, offset, sign as in `Face`), one for each 2 m."""
    axis, offset, sign = wall
    count = int((extent[1] - extent[0]) / _POSTER_EVERY_M)
    for part in np.linspace(*extent, count, endpoint=False):
        along = float(part + builder.rng.uniform(0.1, _POSTER_EVERY_M - _POSTER_M - 0.1))
        z = float(builder.rng.uniform(*_POSTER_LOW_M))
        poster = builder.add_texture(make_poster(builder.rng, _POSTER_TEXELS))
        colours = POSTER_COLOURS[int(builder.rng.integers(len(POSTER_COLOURS)))]
        low, high = (along, z), (along + _POSTER_M, z + _POSTER_M)
        skin = (poster, _POSTER_M / _POSTER_TEXELS)
        builder.faces.append(
            Face(axis, offset + sign * _POSTER_OFFSET_M, sign, low, high, *skin, *colours, lamp)
        )


def _add_block(
    builder: WorldBuilder,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    *,
    is_shelf: bool,
) -> None:
    """Add a shelf of books or a box that carries a poster on each side, between two opposite corners."""
    if is_shelf:
        skin = (builder.add_texture(make_books(builder.rng)), _SHELF_HEIGHT_M / _BOOKS_TEXELS)
        colours = BOOK_COLOURS
    else:
        skin = (builder.add_texture(make_poster(builder.rng, _POSTER_TEXELS)), 1.0 / _POSTER_TEXELS)
        colours = POSTER_COLOURS[int(builder.rng.integers(len(POSTER_COLOURS)))]
    builder.add_box(low, high, int((low[0] + high[0]) / 2 / ROOM_M), skin, colours)


def _runs(is_part: npt.NDArray[np.bool_]) -> Iterator[tuple[int, int, int]]:
    """Yield row, first column and the column after the last one of each run of True in a row."""
    for row, values in enumerate(is_part):
        edges = np.flatnonzero(np.diff(np.concatenate(([0], values.astype(np.int8), [0]))))
        for first, last in edges.reshape(-1, 2).tolist():
            yield row, first, last


def _resample(points: Array) -> Array:
    """Return points about 1 cm apart on the path through *points* ``(n, 2)``."""
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    distances = np.linspace(0.0, along[-1], round(along[-1] / _PATH_STEP_M) + 1)
    return np.column_stack([np.interp(distances, along, points[:, axis]) for axis in range(2)])


def _round_corners(path: Array) -> Array:
    """Return the moving average of a path ``(n, 2)`` whose ends count as if they continued at rest."""
    half = _ROUNDING_POINTS
    window = np.ones(2 * half + 1) / (2 * half + 1)
    extended = np.pad(path, ((half, half), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(extended[:, axis], window, mode="valid") for axis in range(2)])
