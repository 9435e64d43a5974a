"""Smooth a live map around what changed: windows of keyframes that grow while their border moves.

The scales of segments without metres are fitted with the poses of a window, by all that is known of them:
also by the keyframes of such a segment beyond the window, which stay where they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, adjoint, inverse, rotation_angle_deg, scaled
from rse_pf.live_map.graph import Graph, LiveLink
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.slam.consistency import OdometryNoise
from rse_pf.slam.smoother import ScaleTerms, SmoothedPoses, smooth

__all__ = [
    "Edges",
    "SmoothedWindows",
    "edges_of",
    "link_information",
    "odometry_of",
    "odometry_step",
    "smooth_all",
    "smooth_around",
]

Rows = npt.NDArray[np.int64]

_LEAST_STEP = 0.05
_OF_SCALE = 600
"""Keyframes of a segment, nearest to a window, by which its scale is fitted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """Edges between keyframes ``a`` and ``b`` (ids); ``numbers`` are those of links, -1 for odometry.

    Lengths are in the unit of the component; ``units`` are the rows of the segments that they come from, -1
    where they are metres.
    """

    a: Rows
    b: Rows
    T_a_b: Array
    information: Array
    numbers: Rows
    units: Rows


@dataclass(slots=True, kw_only=True, eq=False)
class SmoothedWindows:
    """What `smooth_around` did.

    ``strained`` says that even the largest window was too small; ``misfit`` is the mean squared misfit of the
    links; ``squares`` that of each believed link that was smoothed; ``keyframes`` counts those of all windows
    that were tried.
    """

    strained: bool = False
    misfit: float = 0.0
    squares: dict[int, float] = field(default_factory=dict)
    keyframes: int = 0
    _covariances: dict[int, Array] = field(default_factory=dict)

    def covariance(self, graph: Graph, keyframe: int) -> Array | None:
        """Return the ``(6, 6)`` covariance of the newest pose of a segment, if it moved, given those held.

        It is of the twist (metres, radians) on the left of the pose, in the frame of the map.
        """
        right = self._covariances.get(keyframe)
        if right is None:
            return None
        to_left = adjoint(graph.T[keyframe])
        left: Array = to_left @ (0.5 * (right + right.T)) @ to_left.T
        return left


def smooth_around(
    graph: Graph, moved: Sequence[int], anchors: Iterable[int], options: LiveMapOptions
) -> SmoothedWindows:
    """Smooth *graph* around the keyframes *moved*, one component after the other; the graph changes.

    The window grows while its border moves.  *anchors* are keyframes that define the frame of a component.
    """
    done = SmoothedWindows()
    held = set(anchors)
    groups: dict[int, list[int]] = {}
    for i in moved:
        if graph.of_segment[i] >= 0:
            groups.setdefault(graph.component_of(i), []).append(i)
    total = 0.0
    newest = [
        graph.segments[row].keyframes[-1] for row in graph.newest.values() if graph.segments[row].keyframes
    ]
    for _, seeds in sorted(groups.items()):
        for size in options.windows:
            ids, is_whole = _window(graph, seeds, size, held)
            if not ids:
                break
            free = _free_scales(graph, ids)
            edges = _all_edges(graph, ids, free, options) if free else edges_of(graph, ids, options)
            if not len(edges.a):
                break
            inside = set(ids)
            told = [i for i in newest if i in inside]
            done.keyframes += len(ids)
            found, border, rows = _fit(graph, ids, told, edges, free, options)
            is_strained = not is_whole and _is_moved(graph, border, found, rows, options)
            if not is_strained or size == options.windows[-1]:
                done.strained |= is_strained
                graph.T[ids] = found.T[: len(ids)]
                for row, grown in zip(free, found.log_scales.tolist(), strict=True):
                    graph.segments[row].scale *= math.exp(grown)
                squares = {
                    int(number): float(square)
                    for number, square in zip(edges.numbers, found.squares, strict=True) if number >= 0
                }  # fmt: skip
                done.squares |= squares
                total += sum(squares.values())
                done._covariances |= dict(zip(told, found.covariances, strict=True))
                break
    done.misfit = total / max(1, len(done.squares))
    return done


def smooth_all(graph: Graph, options: LiveMapOptions) -> None:
    """Smooth each segment of *graph* once, by the largest window; the graph changes."""
    largest, anchors = max(options.windows), graph.anchors()
    options = replace(options, windows=(largest,))
    for segment in graph.segments:
        for begin in range(0, len(segment.keyframes), largest):
            smooth_around(graph, segment.keyframes[begin : begin + largest], anchors, options)


def edges_of(graph: Graph, ids: Iterable[int], options: LiveMapOptions) -> Edges:
    """Return odometry and believed links that touch one of the keyframes *ids*."""
    links: set[int] = set()
    steps: set[tuple[int, int]] = set()
    for i in ids:
        links.update(graph.links_at(i))
        steps.update(graph.steps_at(i))
    numbers = sorted(links)
    pairs = np.array(sorted(steps), dtype=np.int64).reshape(-1, 2)
    a, b = pairs[:, 0], pairs[:, 1]
    walked = graph.way[b] - graph.way[a]
    drift: OdometryNoise = options.drift
    spread = np.array([drift.step_m] * 3 + [math.radians(drift.step_deg)] * 3) ** -2.0
    chain = np.zeros((len(a), 6, 6))
    chain[:, range(6), range(6)] = spread / walked[:, None]
    measured = [graph.links[number] for number in numbers]
    if not measured:
        T_a_b, information = np.empty((0, 4, 4)), np.empty((0, 6, 6))
    else:
        T_a_b = np.array([graph.step_of(link) for link in measured])
        # What has half of the evidence is taken for half as exact.
        weights = np.array([link.weight(options.strong) for link in measured])
        information = weights[:, None, None] ** 2 * np.array(
            [link_information(graph, link) for link in measured]
        )
    units = np.full(len(a) + len(measured), -1, dtype=np.int64)
    if graph.has_scales:
        rows = graph.of_segment[a]
        of_links = np.array([graph.unit_of(link) for link in measured], dtype=np.int64)
        units = np.concatenate([np.where(_metric(graph)[rows], -1, rows), of_links])
    return Edges(
        a=np.concatenate([a, np.array([link.a for link in measured], dtype=np.int64)]),
        b=np.concatenate([b, np.array([link.b for link in measured], dtype=np.int64)]),
        T_a_b=np.concatenate([odometry_of(graph, a, b), T_a_b]),
        information=np.concatenate([chain, information]),
        numbers=np.concatenate([np.full(len(a), -1), np.array(numbers, dtype=np.int64)]),
        units=units,
    )


def odometry_of(graph: Graph, a: Rows, b: Rows) -> Array:
    """Return ``T_a_b`` of keyframes of one segment each by odometry, in the unit of the component."""
    T_a_b: Array = inverse(graph.T_odom[a]) @ graph.T_odom[b]
    if graph.has_scales:
        T_a_b = scaled(T_a_b, np.array([each.scale for each in graph.segments])[graph.of_segment[a]])
    return T_a_b


def _free_scales(graph: Graph, ids: Sequence[int]) -> list[int]:
    """Return the segments without metres that keyframes of one component belong to, whose scale is free.

    Where no segment has metres, the scale of the one that defines the frame is held.
    """
    if not graph.has_scales or not ids:
        return []
    rows = sorted({int(row) for row in graph.of_segment[list(ids)] if not graph.segments[row].is_metric})
    if rows and not graph.is_metric(graph.component_of(ids[0])):
        held = int(graph.of_segment[graph.anchor(rows[0])])
        rows = [row for row in rows if row != held]
    return rows


def _metric(graph: Graph) -> npt.NDArray[np.bool_]:
    return np.array([each.is_metric for each in graph.segments])


def link_information(graph: Graph, link: LiveLink) -> Array:
    """Return the ``(6, 6)`` information of a link in the unit of its component."""
    row = graph.unit_of(link)
    if row < 0:
        return link.information
    per_length = np.array([1.0 / graph.segments[row].scale] * 3 + [1.0] * 3)
    information: Array = per_length[:, None] * link.information * per_length
    return information


def _all_edges(graph: Graph, ids: list[int], rows: list[int], options: LiveMapOptions) -> Edges:
    """Return what `edges_of` does, with all edges of the segments *rows*, whose scales are free."""
    touched = dict.fromkeys(ids)
    inside = set(ids)
    for row in rows:
        own = graph.segments[row].keyframes
        places = [place for place, i in enumerate(own) if i in inside]
        begin = max(0, min(places) - _OF_SCALE // 2)
        touched.update(dict.fromkeys(own[begin : begin + _OF_SCALE]))
    return edges_of(graph, touched, options)


def _scale_terms(graph: Graph, edges: Edges, rows: list[int], options: LiveMapOptions) -> ScaleTerms | None:
    """Return the free scales of segments, and what edges measure of them; None if there are none.

    All ratios of depths that a robot causes count as one: what is wrong with its depths is wrong in all of
    them, on purpose or not.  So lengths of ways, in the metres of others, decide, and no robot moves others
    by its depths.
    """
    if not rows:
        return None
    of_row = np.full(len(graph.segments) + 1, -1, dtype=np.int64)
    of_row[rows] = np.arange(len(rows))
    m = len(edges.a)
    difference, information = np.zeros(m), np.zeros(m)
    for place in np.flatnonzero(edges.numbers >= 0).tolist():
        link = graph.links[int(edges.numbers[place])]
        if link.scale is not None:
            here, there = graph.segment_of(link.a).scale, graph.segment_of(link.b).scale
            difference[place] = link.scale[0] + math.log(here / there)
            information[place] = link.weight(options.strong) ** 2 / link.scale[1]
    measures = information > 0.0
    ends = [np.where(measures, of_row[graph.of_segment[each]], -1) for each in (edges.b, edges.a)]
    counts = [np.bincount(each[each >= 0], minlength=len(rows)) for each in ends]
    shared = np.append(counts[0] + counts[1], 1)
    information /= np.maximum(shared[ends[0]], shared[ends[1]])
    return ScaleTerms(
        count=len(rows), of_edge=of_row[edges.units],
        plus=ends[0], minus=ends[1],
        difference=difference, information=information,
    )  # fmt: skip


def odometry_step(T_from_to: Array, options: LiveMapOptions) -> float:
    """Return how many steps of the odometry's noise a motion is."""
    moved = float(np.sqrt((T_from_to[:3, 3] ** 2).sum())) / options.spacing_m
    turned = rotation_angle_deg(T_from_to[:3, :3]) / options.spacing_deg
    return max(moved, turned, _LEAST_STEP)


def _window(graph: Graph, seeds: Sequence[int], size: int, held: set[int]) -> tuple[list[int], bool]:
    """Return up to *size* keyframes around *seeds*, nearest first, and whether they are the whole component.

    Where there are more seeds, the newest are taken.
    """
    front = [i for i in seeds if i not in held][-size:]
    seen = set(front)
    ids = list(front)
    while front:
        following: list[int] = []
        for i in front:
            for other, _ in graph.neighbours(i):
                if other not in seen and other not in held:
                    if len(ids) == size:
                        return ids, False
                    seen.add(other)
                    ids.append(other)
                    following.append(other)
        front = following
    return ids, len(front) == 0 and len(seeds) <= size


def _fit(
    graph: Graph, ids: list[int], told: list[int], edges: Edges, free: list[int], options: LiveMapOptions
) -> tuple[SmoothedPoses, Rows, dict[int, int]]:
    """Return the smoothed poses, the keyframes of the window that touch its border, and rows by id."""
    row_of = np.full(len(graph), -1, dtype=np.int64)
    row_of[ids] = np.arange(len(ids))
    a_inside, b_inside = row_of[edges.a] >= 0, row_of[edges.b] >= 0
    border = np.concatenate([edges.a[a_inside & ~b_inside], edges.b[b_inside & ~a_inside]])
    beyond = np.unique(np.concatenate([edges.b[~b_inside], edges.a[~a_inside]]))
    row_of[beyond] = len(ids) + np.arange(len(beyond))
    found = smooth(
        graph.T[np.concatenate([ids, beyond])], len(ids), row_of[edges.a], row_of[edges.b], edges.T_a_b,
        edges.information, edges.numbers >= 0, cauchy=options.cauchy, wanted=row_of[told],
        scales=_scale_terms(graph, edges, free, options),
    )  # fmt: skip
    return found, np.unique(border), {i: row for row, i in enumerate(ids)}


def _is_moved(
    graph: Graph, border: Rows, found: SmoothedPoses, rows: dict[int, int], options: LiveMapOptions
) -> bool:
    """Return whether a keyframe at the border of the window moved by more than it may."""
    if not len(border):
        return False
    old, new = graph.T[border], found.T[[rows[i] for i in border.tolist()]]
    moved2_m2 = ((new[:, :3, 3] - old[:, :3, 3]) ** 2).sum(axis=1).max()
    traces = (old[:, :3, :3] * new[:, :3, :3]).sum(axis=(1, 2))
    least_trace = 1.0 + 2.0 * math.cos(math.radians(options.border_deg))
    return bool(moved2_m2 > options.border_m**2 or traces.min() < least_trace)
