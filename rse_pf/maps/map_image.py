"""The image of a map (the paper's Fig. 7): a coloured point cloud with the paths of its cameras.

The image is drawn with Pillow alone, because Matplotlib and its fonts would be a fifth of what the demo
installs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import MissingExtra
from rse_pf.geometry import Array
from rse_pf.terminal import printable

__all__ = ["COLOURS", "INK", "RobotPath", "draw_legend", "draw_map", "draw_scale", "fitting", "pillow"]

_WIDTH = 1600  # of the image, in pixels
_HEIGHT = 900  # of the image, in pixels
_CAPTION = 64  # height in pixels of the strips at the top and the bottom in which no point is drawn
_MARGIN = 40  # pixels between the border of the image and its content
# Background of the image, as RGB: not white, so that white surfaces differ from regions without points.
_BACKGROUND = (228, 231, 236)
INK = (30, 34, 42)
_WHITE = (255, 255, 255)
COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233))
"""Colours of the paths of robots (RGB), distinct for colour-blind readers as well; Okabe and Ito 2008."""
# Focal length of the camera of the image, relative: the result is scaled to fill the image afterwards.
_FOCAL = 1.35
# Distance along a path, in metres, after which the next camera is drawn on it.
_CAMERA_EVERY_M = 0.5
# Lengths of a scale bar in metres, or in the unit of the map; the first of a suitable length is used.
_SCALES = (1.0, 0.5, 2.0, 0.2, 5.0, 0.1, 10.0, 20.0, 50.0, 100.0, 0.05, 0.02, 0.01)
# Shortest and longest scale bar, in pixels.
_SCALE_PX = (60.0, 300.0)
# Height of a line of the legend, in pixels.
_LEGEND_LINE = 24
# Distance from the beginning of a line's colour to its name in the legend, in pixels.
_LEGEND_TEXT = 38
# A scene whose horizontal extent is longer than wide by more than this ratio is drawn from its long side.
_LONG_SCENE = 1.25
# Points more than this far above the highest camera, in metres, are a ceiling and are not drawn.
_CEILING_M = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotPath:
    """The path of a robot: ``T_world_camera`` ``(n, 4, 4)``, the poses of its camera in order."""

    name: str
    T_world_camera: Array


def draw_map(
    path: Path,
    points_world: npt.NDArray[np.floating[Any]],
    colours: npt.NDArray[np.uint8],
    robots: list[RobotPath],
    caption: str,
    *,
    unit: str = "m",
) -> None:
    """Write a PNG that shows a coloured point cloud obliquely from above, with the paths of the robots.

    Args:
        path: Path of the PNG.
        points_world: Points ``(n, 3)`` in the world frame.
        colours: RGB of each point, ``(n, 3)``.
        robots: The path of each robot in the same frame.
        caption: The line above the image; a text that is too long is cut.
        unit: Unit of the points, which the scale bar names.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    image_module, draw_module, font_module = pillow()
    robots = [replace(robot, name=printable(robot.name)) for robot in robots]
    up = _up(robots)
    shown = _below_ceiling(points_world, robots, up)
    points, tints = points_world[shown].astype(np.float64), colours[shown]
    view = _Observer(points, robots, up)
    image = image_module.fromarray(_splat(view, points, tints))
    draw = draw_module.Draw(image)
    big, small = font_module.load_default(size=26), font_module.load_default(size=20)
    for number, robot in enumerate(robots):
        _draw_path(draw, view, robot, COLOURS[number % len(COLOURS)])
    for number, robot in enumerate(robots):
        _draw_ends(draw, view, robot, COLOURS[number % len(COLOURS)])
    ends = view.project(np.stack([view.centre, view.centre + view.axis_x]))
    one_px = max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
    bottom = _HEIGHT - 34
    scale_left = draw_scale(draw, one_px, (_WIDTH - _MARGIN, bottom), unit, small)
    text = fitting(draw, printable(caption), big, _WIDTH - 2 * _MARGIN)
    draw.text((_MARGIN, 18), text, fill=INK, font=big)
    names = [robot.name for robot in robots]
    names[:1] = [f"{name} (dot: start, ring: end)" for name in names[:1]]
    entries = [(name, COLOURS[number % len(COLOURS)]) for number, name in enumerate(names)]
    draw_legend(draw, entries, (_MARGIN, bottom), scale_left - _MARGIN, small)
    image.save(path, format="PNG")


class _Observer:
    """The virtual pinhole camera of the image: 40 degrees downward, with all paths and most points in view.

    Seen from above, it views along the mean viewing direction of the robots' cameras, or across a long scene.
    """

    def __init__(self, points: Array, robots: list[RobotPath], up: Array) -> None:
        places = np.concatenate([np.zeros((0, 3)), *(robot.T_world_camera[:, :3, 3] for robot in robots)])
        low, high = _bounds(points, places, (2, 98))
        self.centre = (low + high) / 2
        forward = self._side(points, robots, up)
        slope = math.radians(40)
        self.axis_z = math.cos(slope) * forward - math.sin(slope) * up
        self.axis_x = np.cross(self.axis_z, up)
        self.axis_x /= np.linalg.norm(self.axis_x)
        self.axis_y = np.cross(self.axis_z, self.axis_x)
        self.axis_y *= -1 if self.axis_y @ up > 0 else 1
        self.distance = max(1.0, float(np.linalg.norm(high - low)))
        self.scale, self.shift = 1.0, np.zeros(2)
        if len(points) + len(places):
            some = points[:: max(1, len(points) // 20_000)]
            low_px, high_px = _bounds(self._flat(some), self._flat(places), (0.5, 99.5))
            available = np.array([_WIDTH - 2 * _MARGIN, _HEIGHT - 2 * _CAPTION - _MARGIN])
            self.scale = float((available / np.maximum(high_px - low_px, 1e-9)).min())
            self.shift = np.array([_WIDTH / 2, _HEIGHT / 2]) - self.scale * (high_px + low_px) / 2

    @staticmethod
    def _side(points: Array, robots: list[RobotPath], up: Array) -> Array:
        """Return the horizontal unit vector along which the scene is viewed.

        This is the mean viewing direction of the robots' cameras, or the short horizontal axis of a long
        scene.
        """
        directions = np.concatenate([robot.T_world_camera[:, :3, 2] for robot in robots])
        mean = directions.mean(axis=0) if len(directions) else np.zeros(3)
        level = np.eye(3) - np.outer(up, up)
        mean = level @ mean
        if len(points):
            flat = (points - points.mean(axis=0)) @ level
            spread, axes = np.linalg.eigh(flat.T @ flat)
            if spread[2] > _LONG_SCENE**2 * spread[1]:
                across = level @ axes[:, 1]
                mean = across if across @ mean >= 0 else -across
        if np.linalg.norm(mean) < 0.05:
            mean = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        side: Array = mean / np.linalg.norm(mean)
        return side

    def depth(self, points: Array) -> Array:
        """Return the distances ``(n,)`` of points from the virtual camera along its optical axis (m)."""
        depth: Array = (points - self.centre) @ self.axis_z + 1.6 * self.distance
        return depth

    def project(self, points: Array) -> Array:
        """Return the pixels ``(n, 2)`` of the image at which *points* ``(n, 3)`` appear."""
        return self._flat(points) + self.shift

    def _flat(self, points: Array) -> Array:
        moved = points - self.centre
        flat = np.column_stack([moved @ self.axis_x, moved @ self.axis_y])
        flat *= (_FOCAL * self.scale / np.maximum(self.depth(points), 0.1))[:, None]
        return flat


def _bounds(points: Array, places: Array, percentiles: tuple[float, float]) -> tuple[Array, Array]:
    """Return the lower and the upper bound of each axis over all *places* and most *points*.

    Of *points* only the two *percentiles* count, so that outliers do not extend the bounds.
    """
    if len(points):
        places = np.concatenate([places, np.percentile(points, percentiles, axis=0)])
    if not len(places):
        places = np.zeros((1, points.shape[1]))
    return places.min(axis=0), places.max(axis=0)


def _splat(view: _Observer, points: Array, colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the image ``(height, width, 3)`` of the points: each a small square, near ones over far ones."""
    picture = np.empty((_HEIGHT, _WIDTH, 3), dtype=np.uint8)
    picture[:] = _BACKGROUND
    if not len(points):
        return picture
    pixels = np.round(view.project(points)).astype(np.int64)
    order = np.argsort(-view.depth(points))
    size = _splat_size(pixels)
    top, bottom = _CAPTION, _HEIGHT - _CAPTION
    for dy in range(size):
        for dx in range(size):
            x, y = pixels[order, 0] + dx, pixels[order, 1] + dy
            inside = (x >= 0) & (x < _WIDTH) & (y >= top) & (y < bottom)
            picture[y[inside], x[inside]] = colours[order[inside]]
    return picture


def _splat_size(pixels: npt.NDArray[np.int64]) -> int:
    """Return the side, 1 to 4 pixels, of squares that close the gaps between neighbouring points."""
    spread = np.percentile(pixels, 98, axis=0) - np.percentile(pixels, 2, axis=0)
    area_per_pixel = float(spread[0] * spread[1]) / max(1, len(pixels))
    return int(np.clip(round(math.sqrt(2.5 * area_per_pixel)), 1, 4))


def _draw_path(draw: Any, view: _Observer, robot: RobotPath, colour: tuple[int, int, int]) -> None:
    if not len(robot.T_world_camera):
        return
    line = [(float(x), float(y)) for x, y in view.project(robot.T_world_camera[:, :3, 3])]
    draw.line(line, fill=(255, 255, 255), width=9, joint="curve")
    draw.line(line, fill=colour, width=5, joint="curve")
    for pose in _thin_out(robot.T_world_camera):
        _draw_camera(draw, view, pose, colour)


def _draw_ends(draw: Any, view: _Observer, robot: RobotPath, colour: tuple[int, int, int]) -> None:
    """Draw a dot at the start and a ring at the end of the path of *robot*.

    The ring is wider than the dot, so that both show where one robot ends at the start of another.
    """
    if not len(robot.T_world_camera):
        return
    (x0, y0), (x1, y1) = view.project(robot.T_world_camera[[0, -1], :3, 3])
    draw.ellipse([x1 - 16, y1 - 16, x1 + 16, y1 + 16], outline=_WHITE, width=9)
    draw.ellipse([x1 - 14, y1 - 14, x1 + 14, y1 + 14], outline=colour, width=5)
    draw.ellipse([x0 - 9, y0 - 9, x0 + 9, y0 + 9], fill=colour, outline=_WHITE, width=3)


def draw_legend(
    draw: Any,
    entries: Sequence[tuple[str, tuple[int, int, int]]],
    corner: tuple[float, float],
    right: float,
    font: Any,
    *,
    lines: int = 1,
) -> None:
    """Draw names with their colours, between *corner* and *right* in pixels, in at most *lines* lines.

    For the names that do not fit, "and N more" is written.
    """
    left, y = corner
    x, last = left, y + (lines - 1) * _LEGEND_LINE
    for number, (name, colour) in enumerate(entries):
        text = fitting(draw, name, font, right - left - _LEGEND_TEXT)
        length = draw.textlength(text, font=font)
        has_next_line = y + _LEGEND_LINE <= last
        more = f"and {len(entries) - number} more"
        reserved = 0 if has_next_line or number == len(entries) - 1 else draw.textlength(more, font=font) + 24
        if x > left and x + _LEGEND_TEXT + length + reserved > right:
            if not has_next_line:
                draw.text((x, y), more, fill=INK, font=font, anchor="lm")
                return
            x, y = left, y + _LEGEND_LINE
        draw.line([(x, y), (x + 30, y)], fill=colour, width=5)
        draw.text((x + _LEGEND_TEXT, y), text, fill=INK, font=font, anchor="lm")
        x += _LEGEND_TEXT + length + 24


def fitting(draw: Any, text: str, font: Any, max_px: float) -> str:
    """Return *text*, cut and with " ..." at its end if it is wider than *max_px* pixels in *font*."""
    if draw.textlength(text, font=font) <= max_px:
        return text
    while text and draw.textlength(f"{text} ...", font=font) > max_px:
        text = text[:-1]
    return f"{text} ..."


def _thin_out(poses: Array) -> list[Array]:
    """Return the first pose, and each pose at least `_CAMERA_EVERY_M` away from the last returned pose."""
    chosen = [poses[0]]
    for pose in poses[1:]:
        if np.linalg.norm(pose[:3, 3] - chosen[-1][:3, 3]) >= _CAMERA_EVERY_M:
            chosen.append(pose)
    return chosen


def _draw_camera(draw: Any, view: _Observer, T_world_camera: Array, colour: tuple[int, int, int]) -> None:
    corners = np.array([[-0.09, -0.07, 0.14], [0.09, -0.07, 0.14], [0.09, 0.07, 0.14], [-0.09, 0.07, 0.14]])
    world = np.vstack([np.zeros(3), corners]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    flat = [(float(x), float(y)) for x, y in view.project(world)]
    for corner in flat[1:]:
        draw.line([flat[0], corner], fill=colour, width=2)
    draw.line([*flat[1:], flat[1]], fill=colour, width=2)


def draw_scale(draw: Any, one_px: float, end: tuple[float, float], unit: str, font: Any) -> float:
    """Draw a scale bar that ends at *end*; return the x at which its label begins, in pixels.

    The bar has a round length in *unit*, of which *one_px* is the length in pixels.
    """
    length = next((m for m in _SCALES if _SCALE_PX[0] <= m * one_px <= _SCALE_PX[1]), 1.0)
    label, (right, y) = f"{length:g} {unit}", end
    left = right - min(length * one_px, _SCALE_PX[1])
    draw.line([(left, y), (right, y)], fill=INK, width=3)
    for x in (left, right):
        draw.line([(x, y - 7), (x, y + 7)], fill=INK, width=3)
    draw.text((left - 16, y), label, fill=INK, font=font, anchor="rm")
    return left - 16 - float(draw.textlength(label, font=font))


def _up(robots: list[RobotPath]) -> Array:
    """Return the unit vector of the mean upward direction of all cameras, which is their -y axis."""
    if not sum(len(robot.T_world_camera) for robot in robots):
        return np.array([0.0, -1.0, 0.0])
    mean = -np.concatenate([robot.T_world_camera[:, :3, 1] for robot in robots]).mean(axis=0)
    up: Array = mean / np.linalg.norm(mean)
    return up


def _below_ceiling(
    points: npt.NDArray[np.floating[Any]], robots: list[RobotPath], up: Array
) -> npt.NDArray[np.bool_]:
    heights = points @ up
    cameras = np.concatenate([robot.T_world_camera[:, :3, 3] for robot in robots]) @ up
    highest = float(cameras.max()) if len(cameras) else math.inf
    return np.asarray(heights < highest + _CEILING_M)


def pillow() -> tuple[Any, Any, Any]:
    """Return Pillow's modules Image, ImageDraw and ImageFont.

    Raises MissingExtra if Pillow is not installed.
    """
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise MissingExtra("pillow", "local") from error
    return Image, ImageDraw, ImageFont
