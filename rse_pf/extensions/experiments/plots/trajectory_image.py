"""The image of estimated trajectories and the true one, with a panel for each recording.

A panel shows the plane of the two longest axes of the true path.  The image is drawn with Pillow, like the
image of a map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array
from rse_pf.maps.map_image import (
    COLOURS,
    INK,
    draw_legend,
    draw_scale,
    fitting,
    pillow,
)
from rse_pf.terminal import printable

__all__ = ["DrawnPath", "Panel", "draw_trajectories", "pieces"]

_PANEL_WIDTH_PX = 800  # width of a panel, in pixels
_PANEL_HEIGHT_PX = 640  # height of a panel, in pixels
_TITLE_HEIGHT_PX = 48  # height of a panel's title, in pixels
_LEGEND_HEIGHT_PX = 92  # height of a panel's legend, in pixels
_MARGIN_PX = 28  # pixels between the border of a panel and its content
_PANELS_PER_ROW = 2  # number of panels in a row of the image
_BACKGROUND_COLOUR = (255, 255, 255)  # colour (RGB) of the background
_TRUTH_COLOUR = (150, 156, 166)  # colour (RGB) of the true path
_BORDER_COLOUR = (228, 231, 236)  # colour (RGB) of the border of a panel
# A path is not drawn across a gap of more than this many times the median interval between poses.
_MAX_GAP_RATIO = 2.5
# Largest number of panels in an image.
_MAX_PANELS = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPath:
    """An estimated path, in the frame and unit of its panel, with its name in the legend."""

    name: str
    path: Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """The estimated paths of one recording and the true path, or None, all in the same coordinate frame.

    ``unit`` is the unit of the positions, which the scale bar names.
    """

    title: str
    truth: Trajectory | None
    paths: tuple[DrawnPath, ...]
    unit: str = "m"


def draw_trajectories(path: Path, panels: Sequence[Panel]) -> None:
    """Write a PNG with a panel for each of the first 24 recordings; the others are left out.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    image_module, draw_module, font_module = pillow()
    panels = panels[:_MAX_PANELS]
    across = min(_PANELS_PER_ROW, max(1, len(panels)))
    down = max(1, math.ceil(len(panels) / across))
    image = image_module.new("RGB", (across * _PANEL_WIDTH_PX, down * _PANEL_HEIGHT_PX), _BACKGROUND_COLOUR)
    draw = draw_module.Draw(image)
    fonts = font_module.load_default(size=22), font_module.load_default(size=16)
    for number, panel in enumerate(panels):
        _draw_panel(
            draw, panel, (number % across * _PANEL_WIDTH_PX, number // across * _PANEL_HEIGHT_PX), fonts
        )
    image.save(path, format="PNG")


def pieces(trajectory: Trajectory) -> list[Array]:
    """Return the positions ``(n, 3)`` of each part of a path within which no frames were lost.

    A part ends where the next pose is more than 2.5 times the median interval away in time.
    """
    if not len(trajectory):
        return []
    apart_s = np.diff(trajectory.timestamps_s)
    usual_s = float(np.median(apart_s)) if len(apart_s) else 0.0
    return np.split(trajectory.positions, np.flatnonzero(apart_s > _MAX_GAP_RATIO * usual_s) + 1)


def _draw_panel(draw: Any, panel: Panel, corner: tuple[int, int], fonts: tuple[Any, Any]) -> None:
    left, top = corner
    big, small = fonts
    draw.rectangle(
        [left, top, left + _PANEL_WIDTH_PX - 1, top + _PANEL_HEIGHT_PX - 1], outline=_BORDER_COLOUR, width=2
    )
    title = fitting(draw, printable(panel.title), big, _PANEL_WIDTH_PX - 2 * _MARGIN_PX)
    draw.text((left + _MARGIN_PX, top + 12), title, fill=INK, font=big)
    shown = [
        each.positions for each in (panel.truth, *(drawn.path for drawn in panel.paths)) if each is not None
    ]
    points = np.concatenate([*shown, np.empty((0, 3))])
    if not len(points):
        draw.text((left + _MARGIN_PX, top + _TITLE_HEIGHT_PX + 20), "no poses", fill=INK, font=small)
        return
    basis = _basis(points if panel.truth is None else panel.truth.positions)
    flat = points @ basis
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = np.array(
        [
            _PANEL_WIDTH_PX - 2 * _MARGIN_PX,
            _PANEL_HEIGHT_PX - _TITLE_HEIGHT_PX - _LEGEND_HEIGHT_PX - _MARGIN_PX,
        ]
    )
    scale = float((room / np.maximum(high - low, 1e-6)).min())
    middle = np.array([left + _PANEL_WIDTH_PX / 2, top + _TITLE_HEIGHT_PX + (room[1] + _MARGIN_PX) / 2])

    def line(trajectory: Trajectory, colour: tuple[int, int, int], width: int) -> None:
        for piece in pieces(trajectory):
            pixels = (piece @ basis - (low + high) / 2) * scale + middle
            places = [(float(x), float(y)) for x, y in pixels]
            if len(places) == 1:
                (x, y), half = places[0], width
                draw.ellipse([x - half, y - half, x + half, y + half], fill=colour)
            else:
                draw.line(places, fill=colour, width=width, joint="curve")

    legend = [] if panel.truth is None else [("truth", _TRUTH_COLOUR)]
    if panel.truth is not None:
        line(panel.truth, _TRUTH_COLOUR, 7)
    for number, drawn in enumerate(panel.paths):
        line(drawn.path, COLOURS[number % len(COLOURS)], 3)
        legend.append((printable(drawn.name), COLOURS[number % len(COLOURS)]))
    right = left + _PANEL_WIDTH_PX - _MARGIN_PX
    draw_scale(draw, scale, (right, top + _PANEL_HEIGHT_PX - _LEGEND_HEIGHT_PX - 6), panel.unit, small)
    draw_legend(
        draw,
        legend,
        (left + _MARGIN_PX, top + _PANEL_HEIGHT_PX - _LEGEND_HEIGHT_PX + 14),
        right,
        small,
        lines=3,
    )


def _basis(positions: Array) -> Array:
    """Return the unit vectors of the two longest axes of *positions* ``(n, 3)`` as columns of ``(3, 2)``."""
    centred = positions - positions.mean(axis=0)
    _, _, axes = np.linalg.svd(centred.T @ centred)
    basis: Array = axes[:2].T
    return basis
