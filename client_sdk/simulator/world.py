"""Make the simulated world: furnished rooms in a row, as textured axis-aligned rectangles.

Lengths are in metres and z points up.  Room i fills x from 5 i to 5 (i + 1), y from 0 to 4.6, and z from 0 to
2.6; doors in the middle of the walls lead from room to room.  The same seed gives the same world;
`client_sdk.simulator.renderer` draws it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from client_sdk.simulator.textures import (
    Texture,
    make_books,
    make_cloth,
    make_noise,
    make_planks,
    make_poster,
    make_wallpaper,
    make_wood_grain,
)

__all__ = [
    "BOOK_COLOURS",
    "CEILING_COLOURS",
    "DEPTH_M",
    "DOOR_Y_M",
    "FLOOR_COLOURS",
    "HEIGHT_M",
    "POSTER_COLOURS",
    "ROOMS",
    "ROOM_M",
    "WALLPAPER_COLOURS",
    "Face",
    "World",
    "WorldBuilder",
    "make_world",
]

ROOM_M = 5.0  # extent of each simulated room along x, metres
DEPTH_M = 4.6  # extent of each simulated room along y, metres
HEIGHT_M = 2.6  # height of the ceiling of the simulated rooms, metres
ROOMS = 3  # default number of rooms of the simulated world
DOOR_Y_M = (1.55, 3.05)  # y in metres of the two sides of each door
_DOOR_HEIGHT_M = 2.1  # height of the doors between the simulated rooms, metres
_WALL_M = 0.12  # thickness of the walls between rooms

# Width of a texel in metres, for the textures of walls and furniture
_FLOOR_TEXEL_M = 0.004
_CEILING_TEXEL_M = 0.005
_WALL_TEXEL_M = 0.004
_FURNITURE_TEXEL_M = 0.003

_Colour = tuple[int, int, int]  # red, green, blue, 0..255
_Colours = tuple[_Colour, _Colour]  # colours of the texture values 0 and 1

_OAK: _Colour = (196, 150, 98)
_WALNUT: _Colour = (104, 66, 40)
FLOOR_COLOURS: _Colours = (_OAK, _WALNUT)
CEILING_COLOURS: _Colours = ((244, 242, 236), (196, 194, 190))
_DOOR_COLOURS: _Colours = ((250, 244, 226), (176, 150, 118))
_SIDEBOARD_COLOURS: _Colours = ((150, 104, 66), (70, 42, 26))
_TABLE_COLOURS: _Colours = ((214, 170, 116), (120, 78, 46))
BOOK_COLOURS: _Colours = ((246, 226, 190), (96, 40, 36))
# Background and print of the wallpapers; room i has the entry with index i modulo 3.
WALLPAPER_COLOURS: tuple[_Colours, ...] = (
    ((232, 222, 202), (150, 120, 92)),
    ((196, 214, 200), (74, 112, 104)),
    ((214, 218, 232), (92, 104, 150)),
)
POSTER_COLOURS: tuple[_Colours, ...] = (
    ((246, 232, 200), (176, 58, 40)),
    ((236, 240, 242), (28, 72, 110)),
    ((250, 222, 130), (40, 60, 58)),
    ((240, 228, 222), (92, 40, 82)),
    ((224, 238, 220), (30, 92, 60)),
)
_FABRIC_COLOURS: tuple[_Colours, ...] = (
    ((84, 120, 140), (36, 56, 74)),
    ((188, 96, 74), (112, 44, 36)),
    ((214, 176, 96), (134, 96, 40)),
)


@dataclass(frozen=True, slots=True)
class Face:
    """A textured rectangle on an axis-aligned plane, visible from one side.

    Attributes:
        axis: Axis that is perpendicular to the plane: 0 for x, 1 for y, 2 for z.
        offset: Coordinate of the plane on that axis, metres.
        sign: 1 if the face is visible from larger coordinates, -1 if from smaller ones.
        low: Smallest coordinates of the face on the two other axes, in the order x, y, z, metres.
        high: Largest coordinates of the face on these axes, metres.
        texture: Index of the texture in `World.textures`; the texture begins at *low*, and repeats.
        texel_m: Width of a texel, metres.
        colour_0: Colour of the texture value 0; the colour of a value between 0 and 1 is a linear mixture.
        colour_1: Colour of the texture value 1.
        room: Index of the room whose lamp lights the face.
    """

    axis: int
    offset: float
    sign: int
    low: tuple[float, float]
    high: tuple[float, float]
    texture: int
    texel_m: float
    colour_0: _Colour
    colour_1: _Colour
    room: int


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Faces of a world, and its square textures ``(n, n)`` of values 0..1, n a power of two."""

    faces: tuple[Face, ...]
    textures: tuple[Texture, ...]


@dataclass(slots=True)
class WorldBuilder:
    """Faces and textures of a world that is being made, and its random generator."""

    rng: np.random.Generator
    rooms: int = ROOMS
    faces: list[Face] = field(default_factory=list)
    textures: list[Texture] = field(default_factory=list)

    def add_texture(self, image: Texture) -> int:
        """Add a texture, clipped to 0..1; return its index."""
        self.textures.append(np.clip(image, 0.0, 1.0).astype(np.float32))
        return len(self.textures) - 1

    def add_box(
        self,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        room: int,
        skin: tuple[int, float],
        colours: _Colours,
    ) -> None:
        """Add the six faces of a box, visible from outside.

        *low* and *high* are opposite corners (x, y, z), metres; *skin* is the index of the texture and the
        width of a texel, metres; *colours* are those of the texture values 0 and 1; the lamp of *room* lights
        the box.
        """
        for axis in range(3):
            u_axis, v_axis = (other for other in range(3) if other != axis)
            face_low, face_high = (low[u_axis], low[v_axis]), (high[u_axis], high[v_axis])
            for sign, offset in ((-1, low[axis]), (1, high[axis])):
                self.faces.append(Face(axis, offset, sign, face_low, face_high, *skin, *colours, room))


def make_world(seed: int, rooms: int = ROOMS) -> World:
    """Return the world of a seed, with a number of rooms in a row.

    The seed chooses textures, pictures, and the sizes of the small boxes on the sideboards.  Rooms and other
    furniture are the same for all seeds.
    """
    builder = WorldBuilder(np.random.default_rng([seed, 11]), rooms)
    # 1. Make the textures that all rooms share.
    floor = builder.add_texture(make_planks(builder.rng))
    ceiling = builder.add_texture(0.5 + 0.25 * make_noise(builder.rng, 1024, 4, 120, 0.6))
    wood = builder.add_texture(make_wood_grain(builder.rng))
    cloth = builder.add_texture(make_cloth(builder.rng))
    for room in range(rooms):
        # 2. Add floor, ceiling and walls of a room.
        colours = WALLPAPER_COLOURS[room % len(WALLPAPER_COLOURS)]
        paper = builder.add_texture(make_wallpaper(builder.rng, room))
        x0, x1 = room * ROOM_M, (room + 1) * ROOM_M
        low, high = (x0, 0.0), (x1, DEPTH_M)
        builder.faces.append(Face(2, 0.0, 1, low, high, floor, _FLOOR_TEXEL_M, *FLOOR_COLOURS, room))
        builder.faces.append(
            Face(2, HEIGHT_M, -1, low, high, ceiling, _CEILING_TEXEL_M, *CEILING_COLOURS, room)
        )
        for sign, y in ((1, 0.0), (-1, DEPTH_M)):
            builder.faces.append(
                Face(1, y, sign, (x0, 0.0), (x1, HEIGHT_M), paper, _WALL_TEXEL_M, *colours, room)
            )
        for sign, x in ((1, x0), (-1, x1)):
            has_door = x not in (0.0, rooms * ROOM_M)
            wall_x = x + sign * _WALL_M / 2 if has_door else x
            for y_low, y_high, z_low in _wall_pieces(has_door):
                low, high = (y_low, z_low), (y_high, HEIGHT_M)
                builder.faces.append(Face(0, wall_x, sign, low, high, paper, _WALL_TEXEL_M, *colours, room))
        # 3. Add furniture and pictures.
        _add_furniture(builder, room, wood, cloth)
        _add_pictures(builder, room)
    # 4. Add the door frames.
    for door in range(1, rooms):
        _add_door_frame(builder, door, wood)
    return World(tuple(builder.faces), tuple(builder.textures))


def _wall_pieces(has_door: bool) -> list[tuple[float, float, float]]:
    """Return the rectangles of the wall at an end of a room: smallest y, largest y and smallest z, metres.

    The largest z of each rectangle is that of the ceiling.  A wall with a door has three rectangles: one on
    each side of the door, and one above it.
    """
    if not has_door:
        return [(0.0, DEPTH_M, 0.0)]
    left, right = DOOR_Y_M
    return [(0.0, left, 0.0), (right, DEPTH_M, 0.0), (left, right, _DOOR_HEIGHT_M)]


def _add_door_frame(builder: WorldBuilder, door: int, wood: int) -> None:
    """Add the frame of the door between rooms *door* - 1 and *door*: two sides and a top."""
    x, half = door * ROOM_M, _WALL_M / 2 + 0.02
    left, right = DOOR_Y_M
    top, skin, colours = _DOOR_HEIGHT_M, (wood, _FURNITURE_TEXEL_M), _DOOR_COLOURS
    builder.add_box((x - half, left - 0.06, 0), (x + half, left + 0.02, top), door, skin, colours)
    builder.add_box((x - half, right - 0.02, 0), (x + half, right + 0.06, top), door, skin, colours)
    low, high = (x - half, left - 0.06, top - 0.02), (x + half, right + 0.06, top + 0.06)
    builder.add_box(low, high, door, skin, colours)


def _add_furniture(builder: WorldBuilder, room: int, wood: int, cloth: int) -> None:
    """Add a sofa, a sideboard with three small boxes, shelves and, in rooms 0, 2, ..., a table."""
    x = room * ROOM_M
    fine_wood, coarse_wood, fabric = (wood, 0.003), (wood, 0.004), (cloth, 0.003)
    sofa = _FABRIC_COLOURS[room % len(_FABRIC_COLOURS)]
    has_table = room % 2 == 0
    if has_table:
        _add_table(builder, room, (x + 2.05, 1.9), (x + 2.95, 2.7), wood)
        builder.add_box((x + 0.5, 0.0, 0.0), (x + 2.0, 0.42, 0.86), room, coarse_wood, _SIDEBOARD_COLOURS)
        _add_shelf(builder, room, (x + 3.0, 0.0), (x + 4.5, 0.3), wood)
        builder.add_box((x + 1.4, DEPTH_M - 0.72, 0), (x + 3.2, DEPTH_M, 0.42), room, fabric, sofa)
        builder.add_box((x + 1.4, DEPTH_M - 0.2, 0.42), (x + 3.2, DEPTH_M, 0.84), room, fabric, sofa)
    else:
        builder.add_box((x + 1.5, 0.0, 0.0), (x + 3.4, 0.75, 0.42), room, fabric, sofa)
        builder.add_box((x + 1.5, 0.0, 0.42), (x + 3.4, 0.22, 0.86), room, fabric, sofa)
        _add_shelf(builder, room, (x + 0.5, DEPTH_M - 0.32), (x + 2.1, DEPTH_M), wood)
        low, high = (x + 2.9, DEPTH_M - 0.45, 0), (x + 4.5, DEPTH_M, 0.8)
        builder.add_box(low, high, room, fine_wood, (_OAK, _WALNUT))
    for number in range(3):
        side = float(builder.rng.uniform(0.12, 0.24))
        left = x + (0.62, 1.05, 1.5)[number] + (0.0 if has_table else 2.5)
        y, z = (0.06, 0.86) if has_table else (DEPTH_M - 0.4, 0.8)
        colours = POSTER_COLOURS[int(builder.rng.integers(len(POSTER_COLOURS)))]
        skin = (builder.add_texture(make_poster(builder.rng, 64)), side / 64)
        builder.add_box((left, y, z), (left + side, y + side, z + 1.3 * side), room, skin, colours)


def _add_table(
    builder: WorldBuilder, room: int, low: tuple[float, float], high: tuple[float, float], wood: int
) -> None:
    """Add a table between two opposite corners (x, y), metres: a top, four legs, and a bowl."""
    skin, colours = (wood, _FURNITURE_TEXEL_M), _TABLE_COLOURS
    builder.add_box((*low, 0.68), (*high, 0.74), room, skin, colours)
    for x in (low[0] + 0.04, high[0] - 0.12):
        for y in (low[1] + 0.04, high[1] - 0.12):
            builder.add_box((x, y, 0.0), (x + 0.08, y + 0.08, 0.68), room, skin, colours)
    bowl_skin = (builder.add_texture(make_poster(builder.rng, 64)), 0.3 / 64)
    x, y = low[0] + 0.3, low[1] + 0.25
    bowl_colours = POSTER_COLOURS[room % len(POSTER_COLOURS)]
    builder.add_box((x, y, 0.74), (x + 0.3, y + 0.3, 0.9), room, bowl_skin, bowl_colours)


def _add_shelf(
    builder: WorldBuilder, room: int, low: tuple[float, float], high: tuple[float, float], wood: int
) -> None:
    """Add a bookshelf between two opposite corners (x, y), metres.

    The books are a texture on the side of the shelf that faces the room.
    """
    builder.add_box((*low, 0.0), (*high, 1.9), room, (wood, _FURNITURE_TEXEL_M), (_OAK, _WALNUT))
    books = builder.add_texture(make_books(builder.rng))
    sign, y = (1, high[1] + 0.002) if low[1] == 0.0 else (-1, low[1] - 0.002)
    face_low, face_high = (low[0] + 0.05, 0.08), (high[0] - 0.05, 1.85)
    builder.faces.append(Face(1, y, sign, face_low, face_high, books, 1.8 / 512, *BOOK_COLOURS, room))


def _add_pictures(builder: WorldBuilder, room: int) -> None:
    """Add square pictures to the four walls of a room, 1 cm in front of them."""
    x = room * ROOM_M
    # For each picture: axis, offset and sign of its wall as in `Face`; then the position along the wall and
    # the height of its lower corner, and the length of its side, metres.
    pictures = [
        (1, 0.0, 1, x + 0.7, 1.35, 0.75),
        (1, DEPTH_M, -1, x + 1.6, 1.2, 0.9),
        (1, DEPTH_M, -1, x + 3.5, 1.25, 0.7),
        (1, 0.0, 1, x + 2.2, 1.2, 0.7),
    ]
    for wall_x, sign in ((x, 1), (x + ROOM_M, -1)):
        has_door = wall_x not in (0.0, builder.rooms * ROOM_M)
        surface_x = wall_x + sign * _WALL_M / 2 if has_door else wall_x
        pictures += [(0, surface_x, sign, 0.4, 1.1, 0.8), (0, surface_x, sign, 3.4, 1.15, 0.8)]
        if not has_door:
            pictures.append((0, surface_x, sign, 1.75, 1.0, 1.1))
    for number, (axis, offset, sign, along, z, size) in enumerate(pictures):
        skin = (builder.add_texture(make_poster(builder.rng, 256)), size / 256)
        colours = POSTER_COLOURS[(number + 2 * room) % len(POSTER_COLOURS)]
        low, high = (along, z), (along + size, z + size)
        builder.faces.append(Face(axis, offset + 0.01 * sign, sign, low, high, *skin, *colours, room))
