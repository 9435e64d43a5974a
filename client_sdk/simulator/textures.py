"""Make the textures of the simulated worlds: square images ``(n, n)`` of values 0..1, n a power of two.

`client_sdk.simulator.world` repeats them over its faces and gives them colours.  The same generator gives the
same texture.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

__all__ = [
    "Texture",
    "make_books",
    "make_cloth",
    "make_noise",
    "make_planks",
    "make_poster",
    "make_wallpaper",
    "make_wood_grain",
]

Texture = npt.NDArray[np.float32]
"""Values 0..1; some texels of a texture that is not clipped yet are slightly outside."""

# Shapes of the printed motifs of the wallpapers: an ellipse, a diamond and a bar.  Each function maps
# coordinates along the motif's axes, in units of its size, to a distance from its centre that is 1 at its
# border.
_MOTIFS: tuple[Callable[[Texture, Texture], Texture], ...] = (
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


def make_noise(
    rng: np.random.Generator, n: int, min_waves: float, max_waves: float, falloff: float
) -> Texture:
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
    noise: Texture = (image / (2.5 * image.std())).astype(np.float32)
    return noise


@functools.cache
def _noise_spectrum(n: int, min_waves: float, max_waves: float, falloff: float) -> npt.NDArray[np.float64]:
    waves = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n))
    is_in_band = (waves >= min_waves) & (waves <= max_waves)
    return np.where(is_in_band, np.maximum(waves, 1) ** -(1.0 + falloff), 0.0)


def make_wallpaper(rng: np.random.Generator, room: int) -> Texture:
    """Return marbled wallpaper with printed motifs, of which no two are equal."""
    n, reach = 1024, _MOTIF_REACH_TEXELS
    paper = 0.16 + 0.12 * make_noise(rng, n, 3, 40, 0.5) + 0.10 * make_noise(rng, n, 60, 220, 0.0)
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


def make_planks(rng: np.random.Generator) -> Texture:
    """Return floor boards: rows of staggered planks, each with a tone of its own, grain and seams."""
    n, width = 1024, 32
    grain = 0.35 * np.repeat(make_noise(rng, n, 8, 160, 0.2)[:, ::8], 8, axis=1)
    floor = 0.35 + grain + 0.10 * make_noise(rng, n, 30, 200, 0.0)
    for row in range(0, n, width):
        ends = np.sort(rng.choice(np.arange(0, n, 16), size=5, replace=False))
        for left, right in zip(ends, np.append(ends[1:], ends[0] + n), strict=True):
            columns = np.arange(left, right) % n
            floor[row : row + width, columns] += rng.uniform(-0.22, 0.22)
            floor[row : row + width, columns[:2]] = 1.0
        floor[row : row + 2] = 0.95
    return floor


def make_wood_grain(rng: np.random.Generator) -> Texture:
    """Return wood: annual rings and fine grain along the rows."""
    rings = make_noise(rng, 512, 2, 24, 0.8)
    fine = np.repeat(make_noise(rng, 512, 4, 100, 0.2)[:, ::8], 8, axis=1)
    grain: Texture = (0.38 + 0.10 * np.sin(8.0 * rings) + 0.3 * fine).astype(np.float32)
    return grain


def make_cloth(rng: np.random.Generator) -> Texture:
    """Return the cloth of a sofa: large blots and a fine weave."""
    blots = 1.0 / (1.0 + np.exp(-9.0 * make_noise(rng, 512, 6, 30, 0.0)))
    cloth: Texture = (0.2 + 0.4 * blots + 0.15 * make_noise(rng, 512, 40, 150, 0.0)).astype(np.float32)
    return cloth


def make_poster(rng: np.random.Generator, n: int) -> Texture:
    """Return a framed abstract print ``(n, n)`` of discs and bars that cover each other."""
    image = 0.12 + 0.08 * make_noise(rng, n, 3, n / 6, 0.3)
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


def make_books(rng: np.random.Generator) -> Texture:
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
