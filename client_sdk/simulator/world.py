"""Make the simulated world: furnished rooms in a row, as textured axis-aligned rectangles.

Lengths are in metres and z points up.  Room i fills x from 5 i to 5 (i + 1), y from 0 to 4.6, and z from 0 to
2.6; doors in the middle of the walls lead from room to room.  The same seed gives the same world;
`client_sdk.simulator.renderer` draws it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

__all__ = [
    "DEPTH_M",
    "DOOR_Y_M",
    "HEIGHT_M",
    "ROOMS",
    "ROOM_M",
    "Face",
    "World",
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

_Image = npt.NDArray[np.float32]
_Colour = tuple[int, int, int]  # red, green, blue, 0..255
_Colours = tuple[_Colour, _Colour]  # colours of the texture values 0 and 1

_OAK: _Colour = (196, 150, 98)
_WALNUT: _Colour = (104, 66, 40)
_FLOOR_COLOURS: _Colours = (_OAK, _WALNUT)
_CEILING_COLOURS: _Colours = ((244, 242, 236), (196, 194, 190))
_DOOR_COLOURS: _Colours = ((250, 244, 226), (176, 150, 118))
_SIDEBOARD_COLOURS: _Colours = ((150, 104, 66), (70, 42, 26))
_TABLE_COLOURS: _Colours = ((214, 170, 116), (120, 78, 46))
_BOOK_COLOURS: _Colours = ((246, 226, 190), (96, 40, 36))
# Background and print of the wallpapers; room i has the entry with index i modulo 3.
_WALLPAPER_COLOURS: tuple[_Colours, ...] = (
    ((232, 222, 202), (150, 120, 92)),
    ((196, 214, 200), (74, 112, 104)),
    ((214, 218, 232), (92, 104, 150)),
)
_POSTER_COLOURS: tuple[_Colours, ...] = (
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

# Shapes of the printed motifs of the wallpapers: an ellipse, a diamond and a bar.  Each function maps
# coordinates along the motif's axes, in units of its size, to a distance from its centre that is 1 at its
# border.
_MOTIFS: tuple[Callable[[_Image, _Image], _Image], ...] = (
    lambda a, b: np.hypot(a, 1.8 * b),
    lambda a, b: np.abs(a) + np.abs(b),
    lambda a, b: np.maximum(np.abs(a), 2.2 * np.abs(b)),
)
_MOTIF_CELL_TEXELS = 64  # distance of the motifs of a wallpaper, before each is moved at random
_MOTIF_REACH_TEXELS = 40  # a motif changes texels up to this far from its centre; the largest has 26 texels
_POSTER_SHAPES = 26  # number of discs and bars that are drawn on a poster
_DRAWN_SIZES = 1.06
"""A disc or bar of a poster is drawn within a square whose half side is this many times the shape's size,
which is the radius of a disc or half the length of a bar.  The corners of a bar, which is a third as wide as
long, are sqrt(1 + 1/9) = 1.054 sizes from its centre."""


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
    textures: tuple[_Image, ...]


@dataclass(slots=True)
class _Builder:
    """Faces and textures of a world that is being made, and its random generator."""

    rng: np.random.Generator
    rooms: int = ROOMS
    faces: list[Face] = field(default_factory=list)
    textures: list[_Image] = field(default_factory=list)

    def add_texture(self, image: _Image) -> int:
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
    builder = _Builder(np.random.default_rng([seed, 11]), rooms)
    # 1. Make the textures that all rooms share.
    floor = builder.add_texture(_make_planks(builder.rng))
    ceiling = builder.add_texture(0.5 + 0.25 * _make_noise(builder.rng, 1024, 4, 120, 0.6))
    wood = builder.add_texture(_make_wood_grain(builder.rng))
    cloth = builder.add_texture(_make_cloth(builder.rng))
    for room in range(rooms):
        # 2. Add floor, ceiling and walls of a room.
        colours = _WALLPAPER_COLOURS[room % len(_WALLPAPER_COLOURS)]
        paper = builder.add_texture(_make_wallpaper(builder.rng, room))
        x0, x1 = room * ROOM_M, (room + 1) * ROOM_M
        low, high = (x0, 0.0), (x1, DEPTH_M)
        builder.faces.append(Face(2, 0.0, 1, low, high, floor, _FLOOR_TEXEL_M, *_FLOOR_COLOURS, room))
        builder.faces.append(
            Face(2, HEIGHT_M, -1, low, high, ceiling, _CEILING_TEXEL_M, *_CEILING_COLOURS, room)
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


def _add_door_frame(builder: _Builder, door: int, wood: int) -> None:
    """Add the frame of the door between rooms *door* - 1 and *door*: two sides and a top."""
    x, half = door * ROOM_M, _WALL_M / 2 + 0.02
    left, right = DOOR_Y_M
    top, skin, colours = _DOOR_HEIGHT_M, (wood, _FURNITURE_TEXEL_M), _DOOR_COLOURS
    builder.add_box((x - half, left - 0.06, 0), (x + half, left + 0.02, top), door, skin, colours)
    builder.add_box((x - half, right - 0.02, 0), (x + half, right + 0.06, top), door, skin, colours)
    low, high = (x - half, left - 0.06, top - 0.02), (x + half, right + 0.06, top + 0.06)
    builder.add_box(low, high, door, skin, colours)


def _add_furniture(builder: _Builder, room: int, wood: int, cloth: int) -> None:
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
        colours = _POSTER_COLOURS[int(builder.rng.integers(len(_POSTER_COLOURS)))]
        skin = (builder.add_texture(_make_poster(builder.rng, 64)), side / 64)
        builder.add_box((left, y, z), (left + side, y + side, z + 1.3 * side), room, skin, colours)


def _add_table(
    builder: _Builder, room: int, low: tuple[float, float], high: tuple[float, float], wood: int
) -> None:
    """Add a table between two opposite corners (x, y), metres: a top, four legs, and a bowl."""
    skin, colours = (wood, _FURNITURE_TEXEL_M), _TABLE_COLOURS
    builder.add_box((*low, 0.68), (*high, 0.74), room, skin, colours)
    for x in (low[0] + 0.04, high[0] - 0.12):
        for y in (low[1] + 0.04, high[1] - 0.12):
            builder.add_box((x, y, 0.0), (x + 0.08, y + 0.08, 0.68), room, skin, colours)
    bowl_skin = (builder.add_texture(_make_poster(builder.rng, 64)), 0.3 / 64)
    x, y = low[0] + 0.3, low[1] + 0.25
    bowl_colours = _POSTER_COLOURS[room % len(_POSTER_COLOURS)]
    builder.add_box((x, y, 0.74), (x + 0.3, y + 0.3, 0.9), room, bowl_skin, bowl_colours)


def _add_shelf(
    builder: _Builder, room: int, low: tuple[float, float], high: tuple[float, float], wood: int
) -> None:
    """Add a bookshelf between two opposite corners (x, y), metres.

    The books are a texture on the side of the shelf that faces the room.
    """
    builder.add_box((*low, 0.0), (*high, 1.9), room, (wood, _FURNITURE_TEXEL_M), (_OAK, _WALNUT))
    books = builder.add_texture(_make_books(builder.rng))
    sign, y = (1, high[1] + 0.002) if low[1] == 0.0 else (-1, low[1] - 0.002)
    face_low, face_high = (low[0] + 0.05, 0.08), (high[0] - 0.05, 1.85)
    builder.faces.append(Face(1, y, sign, face_low, face_high, books, 1.8 / 512, *_BOOK_COLOURS, room))


def _add_pictures(builder: _Builder, room: int) -> None:
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
        skin = (builder.add_texture(_make_poster(builder.rng, 256)), size / 256)
        colours = _POSTER_COLOURS[(number + 2 * room) % len(_POSTER_COLOURS)]
        low, high = (along, z), (along + size, z + size)
        builder.faces.append(Face(axis, offset + 0.01 * sign, sign, low, high, *skin, *colours, room))


# --- Textures of walls, furniture and pictures, with values of 0..1 ---


def _make_noise(
    rng: np.random.Generator, n: int, min_waves: float, max_waves: float, falloff: float
) -> _Image:
    """Return repeating noise ``(n, n)``, about -1..1, with a limited band of frequencies.

    Args:
        rng: Random generator.
        n: Number of texels of a side.
        min_waves: Lowest frequency, in waves per side.
        max_waves: Highest frequency, in waves per side.
        falloff: The amplitude is proportional to the frequency to the power of -(1 + falloff).
    """
    weight = _noise_spectrum(n, min_waves, max_waves, falloff)
    image = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((n, n))) * weight, s=(n, n))
    noise: _Image = (image / (2.5 * image.std())).astype(np.float32)
    return noise


@functools.cache
def _noise_spectrum(n: int, min_waves: float, max_waves: float, falloff: float) -> npt.NDArray[np.float64]:
    waves = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n))
    is_in_band = (waves >= min_waves) & (waves <= max_waves)
    return np.where(is_in_band, np.maximum(waves, 1) ** -(1.0 + falloff), 0.0)


def _make_wallpaper(rng: np.random.Generator, room: int) -> _Image:
    """Return marbled wallpaper with printed motifs, of which no two are equal."""
    n, reach = 1024, _MOTIF_REACH_TEXELS
    paper = 0.16 + 0.12 * _make_noise(rng, n, 3, 40, 0.5) + 0.10 * _make_noise(rng, n, 60, 220, 0.0)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float32)
    for y in range(0, n, _MOTIF_CELL_TEXELS):
        for x in range(0, n, _MOTIF_CELL_TEXELS):
            angle, size = rng.uniform(0, np.pi), rng.uniform(12, 26)
            cosine, sine = float(np.cos(angle) / size), float(np.sin(angle) / size)
            a, b = cosine * columns + sine * rows, cosine * rows - sine * columns
            distance = _MOTIFS[room % len(_MOTIFS)](a, b)
            ink = np.clip((1.0 - distance) * size / 1.5, 0, 1) * rng.uniform(0.25, 0.75)
            motif_rows = (y + int(rng.integers(_MOTIF_CELL_TEXELS)) + np.arange(-reach, reach + 1)) % n
            motif_columns = (x + int(rng.integers(_MOTIF_CELL_TEXELS)) + np.arange(-reach, reach + 1)) % n
            texels = np.ix_(motif_rows, motif_columns)
            paper[texels] += ink * (0.9 - paper[texels])
    return paper


def _make_planks(rng: np.random.Generator) -> _Image:
    """Return floor boards: rows of staggered planks, each with a tone of its own, grain and seams."""
    n, width = 1024, 32
    grain = 0.35 * np.repeat(_make_noise(rng, n, 8, 160, 0.2)[:, ::8], 8, axis=1)
    floor = 0.35 + grain + 0.10 * _make_noise(rng, n, 30, 200, 0.0)
    for row in range(0, n, width):
        ends = np.sort(rng.choice(np.arange(0, n, 16), size=5, replace=False))
        for left, right in zip(ends, np.append(ends[1:], ends[0] + n), strict=True):
            columns = np.arange(left, right) % n
            floor[row : row + width, columns] += rng.uniform(-0.22, 0.22)
            floor[row : row + width, columns[:2]] = 1.0
        floor[row : row + 2] = 0.95
    return floor


def _make_wood_grain(rng: np.random.Generator) -> _Image:
    """Return wood: annual rings and fine grain along the rows."""
    rings = _make_noise(rng, 512, 2, 24, 0.8)
    fine = np.repeat(_make_noise(rng, 512, 4, 100, 0.2)[:, ::8], 8, axis=1)
    grain: _Image = (0.38 + 0.10 * np.sin(8.0 * rings) + 0.3 * fine).astype(np.float32)
    return grain


def _make_cloth(rng: np.random.Generator) -> _Image:
    """Return the cloth of a sofa: large blots and a fine weave."""
    blots = 1.0 / (1.0 + np.exp(-9.0 * _make_noise(rng, 512, 6, 30, 0.0)))
    cloth: _Image = (0.2 + 0.4 * blots + 0.15 * _make_noise(rng, 512, 40, 150, 0.0)).astype(np.float32)
    return cloth


def _make_poster(rng: np.random.Generator, n: int) -> _Image:
    """Return a framed abstract print ``(n, n)`` of discs and bars that cover each other."""
    image = 0.12 + 0.08 * _make_noise(rng, n, 3, n / 6, 0.3)
    rows, columns = (np.mgrid[:n, :n] / n).astype(np.float32)
    # 1. Draw discs and bars; positions and sizes are fractions of the poster's side.
    for _ in range(_POSTER_SHAPES):
        y, x, size = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9), rng.uniform(0.03, 0.2)
        angle, is_disc = rng.uniform(0, np.pi), rng.random() < 0.5
        cosine, sine = float(np.cos(angle)), float(np.sin(angle))
        low_y, high_y, low_x, high_x = (
            max(0, int(n * (centre + offset)))
            for centre in (y, x)
            for offset in (-_DRAWN_SIZES * size, _DRAWN_SIZES * size + 2 / n)
        )
        part = (slice(low_y, high_y), slice(low_x, high_x))
        dx, dy = columns[part] - x, rows[part] - y
        a, b = cosine * dx + sine * dy, cosine * dy - sine * dx
        distance = np.sqrt(a * a + b * b) if is_disc else np.maximum(np.abs(a), 3 * np.abs(b))
        cover = np.clip((size - distance) * n / 1.5, 0, 1)
        image[part] += cover * (rng.uniform(0.0, 1.0) - image[part])
    # 2. Draw a dark margin, and a light frame around it.
    edge_distance = np.minimum(np.minimum(rows, 1 - rows), np.minimum(columns, 1 - columns))
    image += np.clip((0.07 - edge_distance) * n / 1.5, 0, 1) * (0.02 - image)
    image += np.clip((0.035 - edge_distance) * n / 1.5, 0, 1) * (1.0 - image)
    return np.asarray(image, dtype=np.float32)


def _make_books(rng: np.random.Generator) -> _Image:
    """Return five shelves of books of many widths, heights and tones, each with a label."""
    n, shelves = 512, 5
    image = np.full((n, n), 0.95, dtype=np.float32)
    pitch = n // shelves
    for shelf in range(shelves):
        x = 4
        while x < n - 22:
            width, height = int(rng.integers(8, 22)), int(rng.integers(60, pitch - 12))
            bottom, tone = shelf * pitch + 8, rng.uniform(0.05, 0.85)
            spine = image[bottom : bottom + height, x : x + width - 1]
            spine[:] = tone
            label = int(rng.integers(8, height - 18))
            spine[label : label + int(rng.integers(4, 14)), 1:-1] = 1.0 - tone
            x += width + int(rng.random() < 0.1) * 10
        image[shelf * pitch : shelf * pitch + 8] = 0.25
    return image
