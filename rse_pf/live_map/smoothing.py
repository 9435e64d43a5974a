"""Smooth the pose graph of a live map around what changed, in windows of keyframes.

A window holds the keyframes nearest to the change along the graph; all other poses are held.  A window whose
border would move more than `LiveMapOptions` allows is replaced by a larger one, so the cost depends on the
window and not on the map.  The scales of segments that are not metric are estimated together with the poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, adjoint, inverse, scaled
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.graph_rows import LoopEdge
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.outcomes import LoopClosureAccepted, LoopClosureRejected, OptimiseWanted, Outcome
from rse_pf.live_map.outlier_rejection import decide_misfits
from rse_pf.live_map.pairwise_consistency import find_neighbours, relative_pose_of, unit_segment_of
from rse_pf.slam.consistency import OdometryNoise
from rse_pf.slam.smoother import ScaleTerms, SmoothedPoses, smooth

__all__ = [
    "CAUCHY_WIDTH",
    "GraphEdges",
    "SmoothedWindows",
    "information_of",
    "moved_keyframes",
    "odometry_information",
    "select_edges",
    "smooth_around",
    "smooth_changes",
    "smooth_everything",
]

Rows = npt.NDArray[np.int64]

DRIFT = OdometryNoise(step_m=0.007, step_deg=0.35)
"""Drift of odometry in one step that the smoother assumes; the tests of loop closures assume two to three
times as much, so that no true loop closure fails."""
CAUCHY_WIDTH = 3.0
"""Width of the Cauchy kernel on loop closures, standard deviations; larger residuals have less effect."""
MIN_KEYFRAMES_BETWEEN_OPTIMISATIONS = 20
"""Keyframes that arrive, at least, between two outcomes `OptimiseWanted` that smoothing causes, because an
optimisation of all poses is expensive.  After a robot was forgotten or excluded there is no such limit."""
MAX_SCALE_KEYFRAMES = 600
"""Keyframes of a segment, from 300 before the window on, whose edges determine the scale of the segment.  The
limit bounds the CPU time of a window."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphEdges:
    """*m* edges between the keyframes ``a`` and ``b`` ``(m,)``, odometry first, then loop closures.

    ``T_a_b`` is ``(m, 4, 4)`` in the unit of the component, ``information`` ``(m, 6, 6)``.  ``numbers``
    ``(m,)`` are those of loop closures, -1 for odometry.  ``unit_segments`` ``(m,)`` are the rows of the
    segments in whose unit the edges were measured, -1 for metres.
    """

    a: Rows
    b: Rows
    T_a_b: Array
    information: Array
    numbers: Rows
    unit_segments: Rows


@dataclass(slots=True, kw_only=True, eq=False)
class SmoothedWindows:
    """The result of `smooth_around`.

    ``is_strained`` says that the border of a window of the largest size moved too far, so that the whole
    graph should be optimised.  ``squared_misfits`` holds the squared Mahalanobis norm of the residual of each
    smoothed loop closure by number.  ``keyframe_count`` sums the keyframes of all windows that were tried,
    also of those that were replaced by a larger one.  ``covariances`` has the ``(6, 6)`` covariance of the
    newest pose of each robot that has not left, by keyframe, if this pose was smoothed.  It is that of a left
    twist (metres, radians) in the frame of the component, given the held poses, so it leaves out their
    uncertainty.  ``outcomes`` are what `smooth_changes` reports.
    """

    is_strained: bool = False
    squared_misfits: dict[int, float] = field(default_factory=dict)
    keyframe_count: int = 0
    covariances: dict[int, Array] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)


def smooth_changes(
    graph: MapGraph, moved: list[int], options: LiveMapOptions, robot: str | None = None
) -> SmoothedWindows:
    """Smooth around changed loop closures, and reject those that misfit eight smoothings in a row.

    The outcomes of the result have a request to optimise the whole graph if the border of the largest window
    moved too far, and at least 20 keyframes arrived since the last such request.

    Args:
        graph: The graph; its poses and loop closures change.
        moved: The keyframes to smooth around.
        options: Sizes of windows, and the allowance of a robot.
        robot: Robot whose keyframe is the cause.  If its smoothing debt is too large, the smallest window is
            taken, and an optimisation of the whole graph does the rest.
    """
    # 1. Limit the window of a robot that caused too much work before.
    debt = graph.smoothing_debt.get(robot, 0) if robot is not None else 0
    if debt >= options.max_smoothing_debt:
        options = replace(options, window_sizes=options.window_sizes[:1])
    # 2. Smooth, and reject loop closures that misfit eight smoothings in a row; if there are any, smooth
    #    again.
    windows = smooth_around(graph, moved, graph.anchors(), options) if moved else SmoothedWindows()
    keyframe_count = windows.keyframe_count
    rejected = graph.apply(decide_misfits(graph, windows.squared_misfits))
    if rejected:
        windows = smooth_around(graph, moved_keyframes(rejected, moved), graph.anchors(), options)
        windows.outcomes = rejected
        keyframe_count += windows.keyframe_count
    # 3. Add what exceeds the allowance of one keyframe to the debt of the robot, or pay back debt.
    allowance = options.smoothing_allowance
    if robot is not None and (debt or keyframe_count > allowance):
        graph.set_smoothing_debt(robot, max(0, debt + keyframe_count - allowance))
    # 4. Request an optimisation of the whole graph if no window was large enough, unless the last request was
    #    made less than 20 keyframes ago.
    is_due = len(graph) - graph.optimised_at >= MIN_KEYFRAMES_BETWEEN_OPTIMISATIONS
    if windows.is_strained and is_due and graph.root >= 0:
        graph.note_optimisation()
        windows.outcomes.append(OptimiseWanted())
    return windows


def moved_keyframes(outcomes: Iterable[Outcome], before: Iterable[int] = ()) -> list[int]:
    """Return the keyframes *before*, followed by the other ends of the loop closures in *outcomes*."""
    moved = list(before)
    for outcome in outcomes:
        if isinstance(outcome, LoopClosureAccepted | LoopClosureRejected):
            moved += [i for i in (outcome.a, outcome.b) if i not in moved]
    return moved


def smooth_around(
    graph: MapGraph, moved: Sequence[int], anchors: Iterable[int], options: LiveMapOptions
) -> SmoothedWindows:
    """Smooth the poses around the keyframes *moved*, in each component that they belong to.

    Args:
        graph: The graph; its poses and the scales of its segments change.
        moved: Keyframes around which edges changed.
        anchors: Keyframes that define the frame of a component, and are held.
        options: Sizes of windows, and how far their border may move.
    """
    result = SmoothedWindows()
    held = set(anchors)
    # 1. Group the moved keyframes by component.
    seeds_of: dict[int, list[int]] = {}
    for i in moved:
        if graph.exists(i):
            seeds_of.setdefault(int(graph.components[i]), []).append(i)
    newest_segments = [graph.segments[row] for row in graph.newest_segments.values()]
    newest = [segment.keyframes[-1] for segment in newest_segments if segment.keyframes]
    for _, seeds in sorted(seeds_of.items()):
        for size in options.window_sizes:
            # 2. Choose the keyframes of the window, and the edges that touch them.
            ids, is_whole = _choose_window(graph, seeds, size, held)
            if not ids:
                break
            free_scales = _find_free_scales(graph, ids)
            edges = _select_edges_with_scales(graph, ids, free_scales)
            if not len(edges.a):
                break
            # 3. Smooth a copy of the poses of the window.
            inside = set(ids)
            wanted = [i for i in newest if i in inside]
            result.keyframe_count += len(ids)
            smoothed, border, row_of = _smooth_window(graph, ids, wanted, edges, free_scales)
            # 4. Take the result if the border hardly moved, or there is no larger window; else try that one.
            is_strained = not is_whole and _has_moved(graph, border, smoothed, row_of, options)
            if is_strained and size != options.window_sizes[-1]:
                continue
            result.is_strained |= is_strained
            graph.set_poses(ids, smoothed.T[: len(ids)])
            for row, log_factor in zip(free_scales, smoothed.log_scales.tolist(), strict=True):
                graph.scale_segment(row, math.exp(log_factor))
            result.squared_misfits |= {
                int(number): float(square)
                for number, square in zip(edges.numbers, smoothed.squares, strict=True)
                if number >= 0
            }
            for i, right in zip(wanted, smoothed.covariances, strict=True):
                Ad = adjoint(graph.T_component_camera[i])
                result.covariances[i] = Ad @ (0.5 * (right + right.T)) @ Ad.T
            break
    return result


def smooth_everything(graph: MapGraph, options: LiveMapOptions) -> None:
    """Smooth all keyframes of all segments once, in windows of the largest size; the poses change."""
    largest, anchors = max(options.window_sizes), graph.anchors()
    options = replace(options, window_sizes=(largest,))
    for segment in graph.segments:
        for begin in range(0, len(segment.keyframes), largest):
            smooth_around(graph, segment.keyframes[begin : begin + largest], anchors, options)


# --- Edges of the graph as arrays ---


def select_edges(graph: MapGraph, ids: Iterable[int]) -> GraphEdges:
    """Return odometry and accepted loop closures with at least one end among the keyframes *ids*.

    Relative poses are in the unit of the component.  The information of odometry is that of a random walk.
    The information of a loop closure is multiplied by the square of its weight: a weight of 0.5 doubles its
    standard deviation.
    """
    # 1. Find the edges that touch the keyframes.
    loop_numbers: set[int] = set()
    steps: set[tuple[int, int]] = set()
    for i in ids:
        loop_numbers.update(graph.accepted_edges_of(i))
        steps.update(graph.odometry_edges_of(i))
    numbers = sorted(loop_numbers)
    loops = [graph.edges[number] for number in numbers]
    pairs = np.array(sorted(steps), dtype=np.int64).reshape(-1, 2)
    a, b = pairs[:, 0], pairs[:, 1]
    # 2. Compute the relative poses of odometry, and their information: that of one step, divided by the
    #    number of steps between both keyframes.
    T_odometry: Array = inverse(graph.T_odom_camera[a]) @ graph.T_odom_camera[b]
    if graph.has_scales:
        T_odometry = scaled(
            T_odometry, np.array([each.scale for each in graph.segments])[graph.segment_rows[a]]
        )
    odometry = np.zeros((len(a), 6, 6))
    odometry[:, range(6), range(6)] = (
        odometry_information() / (graph.odometry_steps[b] - graph.odometry_steps[a])[:, None]
    )
    # 3. Take the relative poses of loop closures, and their information reduced by their weight.
    T_loops, information = np.empty((0, 4, 4)), np.empty((0, 6, 6))
    if loops:
        T_loops = np.array([relative_pose_of(graph, edge) for edge in loops])
        weights = np.array([edge.weight for edge in loops])
        information = weights[:, None, None] ** 2 * np.array([information_of(graph, edge) for edge in loops])
    # 4. Note the segment in whose unit each edge was measured, since its scale may be estimated.
    unit_segments = np.full(len(a) + len(loops), -1, dtype=np.int64)
    if graph.has_scales:
        rows = graph.segment_rows[a]
        is_metric = np.array([segment.is_metric for segment in graph.segments])
        loop_units = np.array([unit_segment_of(graph, edge) for edge in loops], dtype=np.int64)
        unit_segments = np.concatenate([np.where(is_metric[rows], -1, rows), loop_units])
    return GraphEdges(
        a=np.concatenate([a, np.array([edge.a for edge in loops], dtype=np.int64)]),
        b=np.concatenate([b, np.array([edge.b for edge in loops], dtype=np.int64)]),
        T_a_b=np.concatenate([T_odometry, T_loops]),
        information=np.concatenate([odometry, information]),
        numbers=np.concatenate([np.full(len(a), -1), np.array(numbers, dtype=np.int64)]),
        unit_segments=unit_segments,
    )


def odometry_information() -> Array:
    """Return ``(6,)``: the diagonal of the information of one step of odometry, 1/m² and 1/rad²."""
    information: Array = np.array([DRIFT.step_m] * 3 + [math.radians(DRIFT.step_deg)] * 3) ** -2.0
    return information


def information_of(graph: MapGraph, edge: LoopEdge) -> Array:
    """Return the ``(6, 6)`` information of a loop closure in the unit of its component, without weight."""
    row = unit_segment_of(graph, edge)
    if row < 0:
        return edge.information
    per_length = np.array([1.0 / graph.segments[row].scale] * 3 + [1.0] * 3)
    information: Array = per_length[:, None] * edge.information * per_length
    return information


# --- One window ---


def _choose_window(
    graph: MapGraph, seeds: Sequence[int], size: int, held: set[int]
) -> tuple[list[int], bool]:
    """Return up to *size* keyframes around *seeds*, and whether they are all that the search can reach.

    The search is breadth-first along the graph, and neither takes nor passes *held* keyframes.  Of more than
    *size* seeds the last ones of the sequence are taken.
    """
    frontier = [i for i in seeds if i not in held][-size:]
    seen = set(frontier)
    ids = list(frontier)
    while frontier:
        next_frontier: list[int] = []
        for i in frontier:
            for neighbour, _ in find_neighbours(graph, i):
                if neighbour not in seen and neighbour not in held:
                    if len(ids) == size:
                        return ids, False
                    seen.add(neighbour)
                    ids.append(neighbour)
                    next_frontier.append(neighbour)
        frontier = next_frontier
    return ids, len(seeds) <= size


def _smooth_window(
    graph: MapGraph, ids: list[int], wanted: list[int], edges: GraphEdges, free_scales: list[int]
) -> tuple[SmoothedPoses, Rows, dict[int, int]]:
    """Return the smoothed poses, the keyframes at the border of the window, and the row of each of *ids*.

    The poses are those of *ids*, followed by all other ends of *edges*, which are held.  The border are the
    keyframes of *ids* that an edge connects with one outside.  Covariances are computed for the keyframes
    *wanted*.  The graph does not change.
    """
    row_of = np.full(len(graph), -1, dtype=np.int64)
    row_of[ids] = np.arange(len(ids))
    a_inside, b_inside = row_of[edges.a] >= 0, row_of[edges.b] >= 0
    border = np.concatenate([edges.a[a_inside & ~b_inside], edges.b[b_inside & ~a_inside]])
    outside = np.unique(np.concatenate([edges.b[~b_inside], edges.a[~a_inside]]))
    row_of[outside] = len(ids) + np.arange(len(outside))
    smoothed = smooth(
        graph.T_component_camera[np.concatenate([ids, outside])],
        len(ids),
        row_of[edges.a],
        row_of[edges.b],
        edges.T_a_b,
        edges.information,
        edges.numbers >= 0,
        cauchy=CAUCHY_WIDTH,
        wanted=row_of[wanted],
        scales=_scale_terms(graph, edges, free_scales),
    )
    return smoothed, np.unique(border), {i: row for row, i in enumerate(ids)}


def _has_moved(
    graph: MapGraph, border: Rows, smoothed: SmoothedPoses, row_of: dict[int, int], options: LiveMapOptions
) -> bool:
    """Return whether a keyframe at the border of a window moved or turned farther than the options allow."""
    if not len(border):
        return False
    before = graph.T_component_camera[border]
    after = smoothed.T[[row_of[i] for i in border.tolist()]]
    moved2_m2 = ((after[:, :3, 3] - before[:, :3, 3]) ** 2).sum(axis=1).max()
    traces = (before[:, :3, :3] * after[:, :3, :3]).sum(axis=(1, 2))
    min_trace = 1.0 + 2.0 * math.cos(math.radians(options.max_border_rotation_deg))
    return bool(moved2_m2 > options.max_border_shift_m**2 or traces.min() < min_trace)


# --- Scales of segments that are not metric ---


def _find_free_scales(graph: MapGraph, ids: Sequence[int]) -> list[int]:
    """Return the rows of the segments of keyframes *ids*, of one component, whose scale is estimated.

    These are the segments that are not metric.  In a component without a metric segment, the segment that
    defines the frame also defines the unit, so its scale is held.
    """
    if not graph.has_scales or not ids:
        return []
    used_rows = {int(row) for row in graph.segment_rows[list(ids)]}
    rows = sorted(row for row in used_rows if not graph.segments[row].is_metric)
    if rows and int(graph.components[ids[0]]) not in graph.metric_components:
        held = int(graph.segment_rows[graph.anchor(rows[0])])
        rows = [row for row in rows if row != held]
    return rows


def _select_edges_with_scales(graph: MapGraph, ids: list[int], free_scales: list[int]) -> GraphEdges:
    """Return the edges of keyframes *ids*, and those that determine the scales of segments *free_scales*."""
    touched = dict.fromkeys(ids)
    inside = set(ids)
    for row in free_scales:
        own = graph.segments[row].keyframes
        first = min(position for position, i in enumerate(own) if i in inside)
        begin = max(0, first - MAX_SCALE_KEYFRAMES // 2)
        touched.update(dict.fromkeys(own[begin : begin + MAX_SCALE_KEYFRAMES]))
    return select_edges(graph, touched)


def _scale_terms(graph: MapGraph, edges: GraphEdges, free_scales: list[int]) -> ScaleTerms | None:
    """Return the scales of the segments *free_scales*, which are estimated, and what edges measure of them.

    Return None if *free_scales* is empty.

    All scales that the loop closures of one segment measure count as one measurement, because an error of the
    depths of the segment is in all of them.  So the relative poses of loop closures, in the metres of other
    robots, determine the scale, and no robot moves others by false depths.
    """
    if not free_scales:
        return None
    # 1. Number the estimated scales by the row of their segment; -1 for other rows, and for the row -1.
    index_of_row = np.full(len(graph.segments) + 1, -1, dtype=np.int64)
    index_of_row[free_scales] = np.arange(len(free_scales))
    # 2. Compute the logarithm of the ratio of scales that each loop closure measures, and its information.
    m = len(edges.a)
    difference, information = np.zeros(m), np.zeros(m)
    for position in np.flatnonzero(edges.numbers >= 0).tolist():
        edge = graph.edges[int(edges.numbers[position])]
        if edge.scale is not None:
            scale_a, scale_b = graph.segment_of(edge.a).scale, graph.segment_of(edge.b).scale
            difference[position] = edge.scale[0] + math.log(scale_a / scale_b)
            information[position] = edge.weight**2 / edge.scale[1]
    # 3. Divide the information of each measurement by the number of measurements of its segment (the larger
    #    number of both segments), so that all of a segment count as one.
    measures = information > 0.0
    plus, minus = (
        np.where(measures, index_of_row[graph.segment_rows[ends]], -1) for ends in (edges.b, edges.a)
    )
    counts = [np.bincount(scales[scales >= 0], minlength=len(free_scales)) for scales in (plus, minus)]
    measurements = np.append(counts[0] + counts[1], 1)
    information /= np.maximum(measurements[plus], measurements[minus])
    return ScaleTerms(
        count=len(free_scales),
        of_edge=index_of_row[edges.unit_segments],
        plus=plus,
        minus=minus,
        difference=difference,
        information=information,
    )
