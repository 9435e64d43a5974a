"""The rendered world: furnished rooms in a row, as textured rectangles; three unless more are asked for.

Everything is axis-aligned; z is up, metres; three rooms fill ``x 0..15, y 0..4.6, z 0..2.6``.
The same seed gives the same world; `client_sdk.simulator.camera` draws it.
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

ROOM_M, DEPTH_M, HEIGHT_M = 5.0, 4.6, 2.6
ROOMS = 3
DOOR_Y_M = (1.55, 3.05)
_DOOR_HEIGHT_M = 2.1
_WALL_M = 0.12

_Image = npt.NDArray[np.float32]
_Colour = tuple[int, int, int]

_OAK, _WALNUT, _WHITE, _CREAM = (196, 150, 98), (104, 66, 40), (244, 242, 236), (250, 244, 226)
# Background and print of the wallpaper of each room; the fourth has that of the first.
_PAPERS: tuple[tuple[_Colour, _Colour], ...] = (
    ((232, 222, 202), (150, 120, 92)),
    ((196, 214, 200), (74, 112, 104)),
    ((214, 218, 232), (92, 104, 150)),
)
_POSTERS: tuple[tuple[_Colour, _Colour], ...] = (
    ((246, 232, 200), (176, 58, 40)),
    ((236, 240, 242), (28, 72, 110)),
    ((250, 222, 130), (40, 60, 58)),
    ((240, 228, 222), (92, 40, 82)),
    ((224, 238, 220), (30, 92, 60)),
)
_FABRICS: tuple[tuple[_Colour, _Colour], ...] = (
    ((84, 120, 140), (36, 56, 74)),
    ((188, 96, 74), (112, 44, 36)),
    ((214, 176, 96), (134, 96, 40)),
)


# Size of a point in the motif of each wallpaper; the motif ends at 1.
_MOTIFS: tuple[Callable[[_Image, _Image], _Image], ...] = (
    lambda a, b: np.hypot(a, 1.8 * b),
    lambda a, b: np.abs(a) + np.abs(b),
    lambda a, b: np.maximum(np.abs(a), 2.2 * np.abs(b)),
)


@dataclass(frozen=True, slots=True)
class Face:
    """A rectangle on the plane ``axis = offset``, seen from the side its *sign* points to.

    ``low`` and ``high`` bound it in the two other axes, in order x, y, z.  Texture values 0..1 blend
    from colour *a* to colour *b*; a texel is ``texel_m`` wide and the texture repeats.
    """

    axis: int
    offset: float
    sign: int
    low: tuple[float, float]
    high: tuple[float, float]
    texture: int
    texel_m: float
    a: _Colour
    b: _Colour
    room: int


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Faces, and square textures ``(n, n)`` of values 0..1 whose sides are powers of two."""

    faces: tuple[Face, ...]
    textures: tuple[_Image, ...]


@dataclass(slots=True)
class _Builder:
    rng: np.random.Generator
    rooms: int = ROOMS
    faces: list[Face] = field(default_factory=list)
    textures: list[_Image] = field(default_factory=list)

    def texture(self, image: _Image) -> int:
        self.textures.append(np.clip(image, 0.0, 1.0).astype(np.float32))
        return len(self.textures) - 1

    def box(
        self, low: tuple[float, float, float], high: tuple[float, float, float], room: int,
        skin: tuple[int, float], colours: tuple[_Colour, _Colour],
    ) -> None:  # fmt: skip
        """Add the six faces of a box, seen from outside; *skin* is texture and texel size."""
        for axis in range(3):
            others = [other for other in range(3) if other != axis]
            for sign, offset in ((-1, low[axis]), (1, high[axis])):
                self.faces.append(
                    Face(axis, offset, sign, (low[others[0]], low[others[1]]),
                         (high[others[0]], high[others[1]]), *skin, *colours, room)
                )  # fmt: skip


def make_world(seed: int, rooms: int = ROOMS) -> World:
    """Return the world of *seed*: the rooms are fixed, textures and pictures depend on the seed."""
    build = _Builder(np.random.default_rng([seed, 11]), rooms)
    floor = build.texture(_planks(build.rng))
    ceiling = build.texture(0.5 + 0.25 * _noise(build.rng, 1024, 4, 120, 0.6))
    wood = build.texture(_grain(build.rng))
    cloth = build.texture(_weave(build.rng))
    for room in range(rooms):
        papers = _PAPERS[room % len(_PAPERS)]
        paper = build.texture(_wallpaper(build.rng, room))
        x0, x1 = room * ROOM_M, (room + 1) * ROOM_M
        low, high = (x0, 0.0), (x1, DEPTH_M)
        build.faces.append(Face(2, 0.0, 1, low, high, floor, 0.004, _OAK, _WALNUT, room))
        build.faces.append(Face(2, HEIGHT_M, -1, low, high, ceiling, 0.005, _WHITE, (196, 194, 190), room))
        for sign, y in ((1, 0.0), (-1, DEPTH_M)):
            build.faces.append(Face(1, y, sign, (x0, 0.0), (x1, HEIGHT_M), paper, 0.004, *papers, room))
        for sign, x in ((1, x0), (-1, x1)):
            outer = x in (0.0, rooms * ROOM_M)
            at = x if outer else x + sign * _WALL_M / 2
            for y_low, y_high, z_low in _wall_pieces(outer):
                build.faces.append(
                    Face(0, at, sign, (y_low, z_low), (y_high, HEIGHT_M), paper, 0.004, *papers, room)
                )
        _furnish(build, room, wood, cloth)
        _hang_pictures(build, room)
    for door in range(1, rooms):
        _door_frame(build, door, wood)
    return World(tuple(build.faces), tuple(build.textures))


def _wall_pieces(outer: bool) -> list[tuple[float, float, float]]:
    if outer:
        return [(0.0, DEPTH_M, 0.0)]
    left, right = DOOR_Y_M
    return [(0.0, left, 0.0), (right, DEPTH_M, 0.0), (left, right, _DOOR_HEIGHT_M)]


def _door_frame(build: _Builder, door: int, wood: int) -> None:
    x, half = door * ROOM_M, _WALL_M / 2 + 0.02
    left, right = DOOR_Y_M
    skin, colours = (wood, 0.003), (_CREAM, (176, 150, 118))
    build.box((x - half, left - 0.06, 0), (x + half, left + 0.02, _DOOR_HEIGHT_M), door, skin, colours)
    build.box((x - half, right - 0.02, 0), (x + half, right + 0.06, _DOOR_HEIGHT_M), door, skin, colours)
    build.box(
        (x - half, left - 0.06, _DOOR_HEIGHT_M - 0.02), (x + half, right + 0.06, _DOOR_HEIGHT_M + 0.06),
        door, skin, colours,
    )  # fmt: skip


def _furnish(build: _Builder, room: int, wood: int, cloth: int) -> None:
    """Put a sofa, a sideboard, shelves and, in every other room, a table into a room."""
    x = room * ROOM_M
    oak, walnut = (wood, 0.003), (wood, 0.004)
    fabric = (cloth, 0.003)
    colours = _FABRICS[room % len(_FABRICS)]
    has_table = room % 2 == 0
    if not has_table:
        build.box((x + 1.5, 0.0, 0.0), (x + 3.4, 0.75, 0.42), room, fabric, colours)
        build.box((x + 1.5, 0.0, 0.42), (x + 3.4, 0.22, 0.86), room, fabric, colours)
        _shelf(build, room, (x + 0.5, DEPTH_M - 0.32), (x + 2.1, DEPTH_M), wood)
        build.box((x + 2.9, DEPTH_M - 0.45, 0), (x + 4.5, DEPTH_M, 0.8), room, oak, (_OAK, _WALNUT))
    else:
        _table(build, room, (x + 2.05, 1.9), (x + 2.95, 2.7), wood)
        build.box((x + 0.5, 0.0, 0.0), (x + 2.0, 0.42, 0.86), room, walnut, ((150, 104, 66), (70, 42, 26)))
        _shelf(build, room, (x + 3.0, 0.0), (x + 4.5, 0.3), wood)
        build.box((x + 1.4, DEPTH_M - 0.72, 0), (x + 3.2, DEPTH_M, 0.42), room, fabric, colours)
        build.box((x + 1.4, DEPTH_M - 0.2, 0.42), (x + 3.2, DEPTH_M, 0.84), room, fabric, colours)
    for number in range(3):  # small boxes on the sideboard
        side = float(build.rng.uniform(0.12, 0.24))
        left = x + (0.62, 1.05, 1.5)[number] + (0.0 if has_table else 2.5)
        y, z = (0.06, 0.86) if has_table else (DEPTH_M - 0.4, 0.8)
        things = _POSTERS[int(build.rng.integers(len(_POSTERS)))]
        skin = (build.texture(_poster(build.rng, 64)), side / 64)
        build.box((left, y, z), (left + side, y + side, z + 1.3 * side), room, skin, things)


def _table(
    build: _Builder, room: int, low: tuple[float, float], high: tuple[float, float], wood: int
) -> None:
    skin, colours = (wood, 0.003), ((214, 170, 116), (120, 78, 46))
    build.box((*low, 0.68), (*high, 0.74), room, skin, colours)
    for x in (low[0] + 0.04, high[0] - 0.12):
        for y in (low[1] + 0.04, high[1] - 0.12):
            build.box((x, y, 0.0), (x + 0.08, y + 0.08, 0.68), room, skin, colours)
    bowl = (build.texture(_poster(build.rng, 64)), 0.3 / 64)
    corner = (low[0] + 0.3, low[1] + 0.25)
    build.box(
        (*corner, 0.74), (corner[0] + 0.3, corner[1] + 0.3, 0.9), room, bowl, _POSTERS[room % len(_POSTERS)]
    )


def _shelf(
    build: _Builder, room: int, low: tuple[float, float], high: tuple[float, float], wood: int
) -> None:
    """Add a book shelf whose books are a texture on its long sides."""
    build.box((*low, 0.0), (*high, 1.9), room, (wood, 0.003), (_OAK, _WALNUT))
    books = build.texture(_books(build.rng))
    sign, y = (1, high[1] + 0.002) if low[1] == 0.0 else (-1, low[1] - 0.002)
    colours = ((246, 226, 190), (96, 40, 36))
    inner_low, inner_high = (low[0] + 0.05, 0.08), (high[0] - 0.05, 1.85)
    build.faces.append(Face(1, y, sign, inner_low, inner_high, books, 1.8 / 512, *colours, room))


def _hang_pictures(build: _Builder, room: int) -> None:
    x = room * ROOM_M
    spots = [(1, 0.0, 1, x + 0.7, 1.35, 0.75), (1, DEPTH_M, -1, x + 1.6, 1.2, 0.9)]
    spots += [(1, DEPTH_M, -1, x + 3.5, 1.25, 0.7), (1, 0.0, 1, x + 2.2, 1.2, 0.7)]
    for x_wall, sign in ((x, 1), (x + ROOM_M, -1)):
        at = x_wall if x_wall in (0.0, build.rooms * ROOM_M) else x_wall + sign * _WALL_M / 2
        spots += [(0, at, sign, 0.4, 1.1, 0.8), (0, at, sign, 3.4, 1.15, 0.8)]
        if at == x_wall:
            spots.append((0, at, sign, 1.75, 1.0, 1.1))
    for number, (axis, offset, sign, along, z, size) in enumerate(spots):
        skin = (build.texture(_poster(build.rng, 256)), size / 256)
        colours = _POSTERS[(number + 2 * room) % len(_POSTERS)]
        low, high = (along, z), (along + size, z + size)
        build.faces.append(Face(axis, offset + 0.01 * sign, sign, low, high, *skin, *colours, room))


# --- textures, all band-limited and tiling ---------------------------------------------------------


def _noise(rng: np.random.Generator, n: int, low: float, high: float, power: float) -> _Image:
    """Return ``(n, n)`` tiling noise, about -1..1, with *low* to *high* waves a side."""
    weight = _noise_weights(n, low, high, power)
    image = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((n, n))) * weight, s=(n, n))
    scaled: _Image = (image / (2.5 * image.std())).astype(np.float32)
    return scaled


@functools.cache
def _noise_weights(n: int, low: float, high: float, power: float) -> npt.NDArray[np.float64]:
    waves = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n))
    return np.where((waves >= low) & (waves <= high), np.maximum(waves, 1) ** -(1.0 + power), 0.0)


def _wallpaper(rng: np.random.Generator, room: int) -> _Image:
    """Return marbled paper printed with motifs that never repeat exactly."""
    n = 1024
    paper = 0.16 + 0.12 * _noise(rng, n, 3, 40, 0.5) + 0.10 * _noise(rng, n, 60, 220, 0.0)
    rows, columns = np.mgrid[-40:41, -40:41].astype(np.float32)
    for y in range(0, n, 64):
        for x in range(0, n, 64):
            angle, size = rng.uniform(0, np.pi), rng.uniform(12, 26)
            cosine, sine = float(np.cos(angle) / size), float(np.sin(angle) / size)
            a, b = cosine * columns + sine * rows, cosine * rows - sine * columns
            shape = _MOTIFS[room % len(_MOTIFS)](a, b)
            ink = np.clip((1.0 - shape) * size / 1.5, 0, 1) * rng.uniform(0.25, 0.75)
            at_y = (y + int(rng.integers(64)) + np.arange(-40, 41)) % n
            at_x = (x + int(rng.integers(64)) + np.arange(-40, 41)) % n
            cells = np.ix_(at_y, at_x)
            paper[cells] += ink * (0.9 - paper[cells])
    return paper


def _planks(rng: np.random.Generator) -> _Image:
    """Return floor boards: rows of staggered planks with their own tone, grain and seams."""
    n, width = 1024, 32
    grain = 0.35 * np.repeat(_noise(rng, n, 8, 160, 0.2)[:, ::8], 8, axis=1)
    floor = 0.35 + grain + 0.10 * _noise(rng, n, 30, 200, 0.0)
    for row in range(0, n, width):
        ends = np.sort(rng.choice(np.arange(0, n, 16), size=5, replace=False))
        for left, right in zip(ends, np.append(ends[1:], ends[0] + n), strict=True):
            columns = np.arange(left, right) % n
            floor[row : row + width, columns] += rng.uniform(-0.22, 0.22)
            floor[row : row + width, columns[:2]] = 1.0
        floor[row : row + 2] = 0.95
    return floor


def _grain(rng: np.random.Generator) -> _Image:
    rings = _noise(rng, 512, 2, 24, 0.8)
    fine = np.repeat(_noise(rng, 512, 4, 100, 0.2)[:, ::8], 8, axis=1)
    grain: _Image = (0.38 + 0.10 * np.sin(8.0 * rings) + 0.3 * fine).astype(np.float32)
    return grain


def _weave(rng: np.random.Generator) -> _Image:
    blots = 1.0 / (1.0 + np.exp(-9.0 * _noise(rng, 512, 6, 30, 0.0)))
    cloth: _Image = (0.2 + 0.4 * blots + 0.15 * _noise(rng, 512, 40, 150, 0.0)).astype(np.float32)
    return cloth


def _poster(rng: np.random.Generator, n: int) -> _Image:
    """Return a framed abstract print: overlapping discs and bars."""
    image = 0.12 + 0.08 * _noise(rng, n, 3, n / 6, 0.3)
    rows, columns = (np.mgrid[:n, :n] / n).astype(np.float32)
    for _ in range(26):
        y, x, size = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9), rng.uniform(0.03, 0.2)
        angle, is_disc = rng.uniform(0, np.pi), rng.random() < 0.5
        cosine, sine = float(np.cos(angle)), float(np.sin(angle))
        # Nothing is drawn beyond 1.06 sizes from the centre.
        low_y, high_y, low_x, high_x = (
            max(0, int(n * (centre + reach)))
            for centre in (y, x)
            for reach in (-1.06 * size, 1.06 * size + 2 / n)
        )
        part = (slice(low_y, high_y), slice(low_x, high_x))
        dx, dy = columns[part] - x, rows[part] - y
        a, b = cosine * dx + sine * dy, cosine * dy - sine * dx
        inside = size - (np.sqrt(a * a + b * b) if is_disc else np.maximum(np.abs(a), 3 * np.abs(b)))
        cover = np.clip(inside * n / 1.5, 0, 1)
        image[part] += cover * (rng.uniform(0.0, 1.0) - image[part])
    edge = np.minimum(np.minimum(rows, 1 - rows), np.minimum(columns, 1 - columns))
    image += np.clip((0.07 - edge) * n / 1.5, 0, 1) * (0.02 - image)
    image += np.clip((0.035 - edge) * n / 1.5, 0, 1) * (1.0 - image)
    return np.asarray(image, dtype=np.float32)


def _books(rng: np.random.Generator) -> _Image:
    """Return five boards of books of many widths, heights and tones."""
    n, boards = 512, 5
    image = np.full((n, n), 0.95, dtype=np.float32)
    pitch = n // boards
    for board in range(boards):
        x = 4
        while x < n - 22:
            width, height = int(rng.integers(8, 22)), int(rng.integers(60, pitch - 12))
            bottom, tone = board * pitch + 8, rng.uniform(0.05, 0.85)
            spine = image[bottom : bottom + height, x : x + width - 1]
            spine[:] = tone
            label = int(rng.integers(8, height - 18))
            spine[label : label + int(rng.integers(4, 14)), 1:-1] = 1.0 - tone
            x += width + int(rng.random() < 0.1) * 10
        image[board * pitch : board * pitch + 8] = 0.25
    return image
