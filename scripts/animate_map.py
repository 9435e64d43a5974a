"""Draw the maps of the demo's robots as they grow: python scripts/animate_map.py out docs/images/demo.gif

It reads ``robot-*/map.ply`` and ``robot-*/trajectory.txt`` of ``rse-pf demo``.  A map file holds its points
in the order in which they were first measured, frame by frame, so a part of the file is the map of a part of
the drive.  Equal files give equal animations.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from client_sdk.mapping import read_ply

__all__ = ["Drive", "animate", "frames", "main", "read_drives"]

Points = npt.NDArray[np.float64]

WIDTH, HEIGHT, SCALE = 720, 330, 2
FRAMES, FRAME_MS, LAST_MS = 40, 110, 2500
MAX_BYTES = 1_500_000
COLOURS_OF_PATHS = ((0, 114, 178), (213, 94, 0), (204, 121, 167))
PAPER = (250, 250, 248)
_TILT_RAD = np.radians(50.0)
_CEILING_M = 2.2
_FALL_M = 0.1
_PALETTE = 96
_MARGIN = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """What one robot of the demo wrote, in order.

    ``points`` and ``colours`` are (n, 3), ``frames`` (n,) counts the frames measured before
    a point, ``path`` (m, 3) holds the positions of the camera.
    """

    points: Points
    colours: npt.NDArray[np.uint8]
    frames: npt.NDArray[np.int64]
    path: Points


def read_drives(folder: Path) -> list[Drive]:
    """Return the drives of all robots of a demo, without the ceiling; the world's z axis points up."""
    drives = []
    for robot in sorted(folder.glob("robot-*")):
        points, colours = read_ply(robot / "map.ply")
        # The new points of a frame are sorted by their first coordinate: a fall begins the next frame.
        number = np.concatenate(([0], np.cumsum(np.diff(points[:, 0]) < -_FALL_M)))
        below = points[:, 2] < _CEILING_M
        path = np.loadtxt(robot / "trajectory.txt", usecols=(1, 2, 3), ndmin=2)
        drives.append(
            Drive(
                points=points[below].astype(np.float64), colours=colours[below],
                frames=number[below], path=path
            )
        )  # fmt: skip
    if not drives:
        raise SystemExit(f"{folder} holds no robot-1/map.ply: run make demo first")
    return drives


def frames(drives: Sequence[Drive], count: int = FRAMES) -> Iterator[Image.Image]:
    """Yield the pictures: after each, every robot has driven one part of *count* of its way further."""
    everything = np.concatenate([drive.points for drive in drives])
    low, high = np.percentile(_flat(everything), (0.2, 99.8), axis=0)
    zoom = float(((np.array([WIDTH, HEIGHT]) - 2 * _MARGIN) / (high - low)).min()) * SCALE
    shift = np.array([WIDTH, HEIGHT]) * SCALE / 2 - zoom * (low + high) / 2
    depth = np.full((HEIGHT * SCALE, WIDTH * SCALE), -np.inf)
    canvas = np.empty((*depth.shape, 3), dtype=np.uint8)
    canvas[:] = PAPER
    for number in range(count):
        for drive in drives:
            total = int(drive.frames[-1]) + 1
            begin, end = np.searchsorted(
                drive.frames, [total * part // count for part in (number, number + 1)]
            )
            _splat(canvas, depth, drive.points[begin:end], drive.colours[begin:end], zoom, shift)
        picture = Image.fromarray(canvas)
        draw = ImageDraw.Draw(picture)
        for drive, colour in zip(drives, COLOURS_OF_PATHS, strict=False):
            driven = drive.path[: max(2, len(drive.path) * (number + 1) // count)]
            line = [(float(x), float(y)) for x, y in _flat(driven) * zoom + shift]
            draw.line(line, fill=(255, 255, 255), width=5 * SCALE, joint="curve")
            draw.line(line, fill=colour, width=3 * SCALE, joint="curve")
            x, y = line[-1]
            draw.ellipse(
                [x - 6 * SCALE, y - 6 * SCALE, x + 6 * SCALE, y + 6 * SCALE], fill=colour, outline=(255,) * 3
            )
        yield picture.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def _flat(points: Points) -> Points:
    """Return (n, 2), metres to the right and down, as seen obliquely from above along the y axis."""
    down = -points[:, 1] * np.sin(_TILT_RAD) - points[:, 2] * np.cos(_TILT_RAD)
    return np.column_stack((points[:, 0], down))


def _splat(
    canvas: npt.NDArray[np.uint8], depth: Points, points: Points, colours: npt.NDArray[np.uint8], zoom: float,
    shift: Points,
) -> None:  # fmt: skip
    """Draw points into the picture, each as a small square, where none stands before them."""
    near = -points[:, 1] * np.cos(_TILT_RAD) + points[:, 2] * np.sin(_TILT_RAD)
    order = np.argsort(near)
    pixels = np.round(_flat(points) * zoom + shift).astype(np.int64)[order]
    near, tints = near[order], colours[order]
    for dy in range(2):
        for dx in range(2):
            x, y = pixels[:, 0] + dx, pixels[:, 1] + dy
            inside = (x >= 0) & (x < depth.shape[1]) & (y >= 0) & (y < depth.shape[0])
            shown = np.flatnonzero(inside)
            shown = shown[near[shown] >= depth[y[shown], x[shown]] - 0.02]
            canvas[y[shown], x[shown]] = tints[shown]
            depth[y[shown], x[shown]] = near[shown]


def animate(pictures: Sequence[Image.Image], file: Path) -> int:
    """Write the pictures as an animation that repeats; return its size in bytes."""
    sample = pictures[-1].copy()
    for number, colour in enumerate(COLOURS_OF_PATHS):  # so that the few pixels of paths keep their colours
        sample.paste(colour, (0, 40 * number, WIDTH, 40 * number + 40))
    palette = sample.quantize(_PALETTE, dither=Image.Dither.NONE)
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    waits = [FRAME_MS] * (len(flat) - 1) + [LAST_MS]
    flat[0].save(file, save_all=True, append_images=flat[1:], duration=waits, loop=0, optimize=True)
    return file.stat().st_size


def main(words: list[str]) -> int:
    """Write the animation; return 1 if it is too large for a page."""
    if len(words) != 2:
        print("usage: python scripts/animate_map.py FOLDER_OF_THE_DEMO FILE.gif")
        return 2
    size = animate(list(frames(read_drives(Path(words[0])))), Path(words[1]))
    print(f"{words[1]}: {size:,} bytes, {FRAMES} pictures of {WIDTH}x{HEIGHT}")
    return 1 if size > MAX_BYTES else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
