"""Test which loop closures of a live map agree, and decide whether they join two components.

1. A loop closure *within one component* is compared with the poses of the graph (`classify_by_graph`), and
   with other loop closures by odometry alone (`find_consistent_by_odometry`).  `find_contradiction` returns
   what a loop closure that is contrary to the graph proves.
2. Loop closures *between two components* are compared pairwise; the largest set that agrees joins both
   components (`decide_join`), unless perceptual aliases may explain it.

All functions only read the graph, except that `decide_join` stores in it whether each tested pair of loop
closures agrees (`MapGraph.note_pair_consistency`).  For the tests of `rse_pf.slam.consistency`, loop closures
are converted to one direction and one unit of length (`DirectedEdge`).

Source:
    Mangelson et al., Pairwise consistent measurement set maximization for robust multi-robot map merging,
    ICRA 2018.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, median_pose, scaled
from rse_pf.live_map.decisions import Fit, JoinComponents, StateReason
from rse_pf.live_map.graph import STEP_LENGTH_M, MapGraph
from rse_pf.live_map.graph_rows import LoopEdge
from rse_pf.slam.consistency import (
    CHI2_99_PERCENT_1,
    EdgeArrays,
    OdometryNoise,
    are_pairwise_consistent,
    find_maximum_clique,
    fits_prediction,
)

__all__ = [
    "ALIAS_DISTANCE_M",
    "MIN_SUPPORT",
    "Contradiction",
    "classify_by_graph",
    "decide_join",
    "find_consistent_by_odometry",
    "find_contradiction",
    "find_neighbours",
    "find_supporting_edges",
    "relative_pose_between_components",
    "relative_pose_of",
    "relative_scale",
    "total_weight",
    "unit_segment_of",
]

MIN_SUPPORT = 3.0
"""Summed weight of loop closures that agree pairwise, at least, before they join components or reject others;
with less, they stay pending.  With this value, 0 of 2,000 random wrong loop closures were accepted
(``benchmarks live.one_process``)."""
MIN_SUPPORTING_KEYFRAMES = 2
"""Different keyframes on each side, at least, that loop closures must connect before they join components or
reject others, because loop closures of one keyframe share its errors."""
MAX_TESTED_EDGES = 48
"""Newest pending loop closures between two components that are tested pairwise before a join; older ones stay
pending untested, which bounds CPU time."""
MAX_EDGES_OF_KEYFRAME = 4
"""Most loop closures that share a keyframe among those that are tested; those with fewer inliers are not
tested, since they repeat the evidence of the keyframe."""
MAX_CONTRARY_EDGES = 24
"""Newest other loop closures between the same two segments that are tested by odometry against one loop
closure; older ones do not support it, which bounds CPU time."""
MAX_CONFIRMED_STEPS = 12.0
"""Steps of odometry between both ends of a loop closure beyond which drift makes the graph too vague to
confirm a single loop closure."""
MAX_PATH_STEPS = 200.0
"""Steps of odometry of a path along which drift leaves no information on the relative pose.  A path that the
search does not find counts as this number of steps at most if both ends lie in one segment, where odometry
connects them, and as this number of steps at least otherwise."""
MAX_VISITED_KEYFRAMES = 250
"""Most keyframes that one search for shortest paths visits, to bound CPU time; the length of a path that is
not found within them is estimated."""
MAX_DRIFT_RATIO = 0.15
"""Error of odometry, in metres per metre of path, that is possible; a larger disagreement with loop closures
means that two places look the same."""
KNOWN_SCALE_DEVIATION = 0.03
"""Standard deviation of the natural logarithm of a segment's scale in the graph: after the first loop
closures of the segment, the error of the estimated scale is 1 to 3 %."""

TEST_NOISE = OdometryNoise()
"""Drift of odometry that the tests of loop closures assume: two to three times that of the smoother, so that
no true loop closure fails."""
ALIAS_DISTANCE_M = 1.0
"""Metres between two estimates of one pose above which they are taken for poses at two places that look the
same, and not for one place with an error."""
RIVAL_WEIGHT = 0.5
"""Share of the weight of the best consistent set from which on a second set makes the join ambiguous, if its
loop closures give a relative pose of both components that differs by more than `ALIAS_DISTANCE_M`."""


class DirectedEdge(NamedTuple):
    """A loop closure in a stated direction and unit of length.

    ``T_a_b`` ``(4, 4)`` maps points of the camera of keyframe ``b`` to that of ``a``; ``variances`` ``(6,)``
    are those of its twist (squares of the unit, square radians).  ``scale`` is the logarithm of the length of
    the unit of *b* in the unit of *a* with its variance, None if both units are the same.
    """

    a: int
    b: int
    T_a_b: Array
    variances: Array
    scale: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction:
    """What a loop closure proves that is contrary to the graph: a perceptual alias, or wrong loop closures.

    ``alias_distance_m`` is the distance of two places that look the same, None if drift explains the error.
    ``edges`` are the numbers of the accepted loop closures of the same segment that contradict the contrary
    one; there are none between two segments, or with an alias.
    """

    alias_distance_m: float | None = None
    edges: list[int] = field(default_factory=list)


# --- Evidence of a set of loop closures ---


def total_weight(graph: MapGraph, numbers: Iterable[int]) -> float:
    """Return the summed weight of loop closures: 1 for each with full weight, less for weak ones."""
    return sum(graph.edges[number].weight for number in numbers)


def has_enough_support(graph: MapGraph, numbers: Sequence[int]) -> bool:
    """Return whether loop closures together weigh at least 3 and touch at least two keyframes on each side.

    The sides are the two components; within one component they are the two segments; and within one segment
    the ends ``a`` and the ends ``b`` of the loop closures.
    """
    if total_weight(graph, numbers) < MIN_SUPPORT:
        return False
    first = graph.edges[numbers[0]]
    # 1. Distinguish the sides by the segments of the ends within one component, else by their components.
    is_within_component = graph.components[first.a] == graph.components[first.b]
    side_of = graph.segment_rows if is_within_component else graph.components
    # 2. Collect the different keyframes of each side.
    near_side: set[int] = set()
    far_side: set[int] = set()
    for number in numbers:
        a, b = graph.edges[number].a, graph.edges[number].b
        is_near = side_of[a] == side_of[first.a]
        near_side.add(a if is_near else b)
        far_side.add(b if is_near else a)
    return min(len(near_side), len(far_side)) >= MIN_SUPPORTING_KEYFRAMES


def choose_testable_edges(graph: MapGraph, numbers: Sequence[int]) -> list[int]:
    """Return the loop closures of *numbers* that are tested: at most four of any keyframe, and 48 in all.

    Loop closures are taken from the most inliers to the fewest; one is left out if four of those taken
    already end at one of its keyframes.  The newest 48 of those taken are returned, sorted by number.
    """
    edges_of_keyframe: Counter[int] = Counter()
    chosen = []
    for number in sorted(numbers, key=lambda each: (-graph.edges[each].inliers, each)):
        edge = graph.edges[number]
        if max(edges_of_keyframe[edge.a], edges_of_keyframe[edge.b]) < MAX_EDGES_OF_KEYFRAME:
            edges_of_keyframe[edge.a] += 1
            edges_of_keyframe[edge.b] += 1
            chosen.append(number)
    return sorted(chosen)[-MAX_TESTED_EDGES:]


# --- Loop closures within one component ---


def classify_by_graph(graph: MapGraph, numbers: Sequence[int]) -> dict[int, Fit]:
    """Return by number how each of some loop closures within one component fits the poses of the graph."""
    if not numbers:
        return {}
    # 1. Predict the relative poses of the loop closures by the poses of the graph.
    edges = [graph.edges[number] for number in numbers]
    T = graph.T_component_camera
    predicted = inverse(T[[edge.a for edge in edges]]) @ T[[edge.b for edge in edges]]
    # 2. Count the steps of odometry between both ends along the graph; drift grows with them.
    targets: dict[int, list[int]] = {}
    for edge in edges:
        targets.setdefault(edge.a, []).append(edge.b)
    paths = {a: shortest_paths(graph, a, ends) for a, ends in targets.items()}
    steps = [paths[edge.a][edge.b] for edge in edges]
    # 3. Compute the lever arm by which rotation noise moves the far end: the distance of both ends, or, after
    #    a round trip, the diameter of a circle whose circumference is the path.
    steps_between = np.maximum(np.array(steps), 1.0)
    distance_m = np.sqrt((predicted[:, :3, 3] ** 2).sum(axis=1))
    lever_m = np.maximum(distance_m, STEP_LENGTH_M * steps_between / math.pi)
    # 4. Test whether noise explains the errors of scale and pose.
    has_scale = [has_consistent_scale(graph, edge, along) for edge, along in zip(edges, steps, strict=True)]
    measured = _stack_edges([_edge_within_component(graph, edge) for edge in edges])
    agrees = fits_prediction(predicted, measured, steps_between, lever_m, TEST_NOISE)
    agrees &= np.array(has_scale, dtype=np.bool_)
    return {
        number: "contrary" if not is_consistent else "vague" if is_far else "agrees"
        for number, is_consistent, is_far in zip(
            numbers, agrees, steps_between > MAX_CONFIRMED_STEPS, strict=True
        )
    }


def find_supporting_edges(graph: MapGraph, number: int) -> list[int]:
    """Return the pending loop closures that agree with *number* by odometry, if they have enough support.

    They are between the same two segments as *number*, which is among them.  The list is empty if their
    weight or the number of their keyframes is too small, see `has_enough_support`.
    """
    rows, edge = graph.segment_rows, graph.edges[number]
    pair = {rows[edge.a], rows[edge.b]}
    others = [(other, graph.edges[other]) for other in graph.pending if other != number]
    parallels = [other for other, each in others if {rows[each.a], rows[each.b]} == pair]
    consistent = find_consistent_by_odometry(graph, number, parallels)
    return consistent if has_enough_support(graph, consistent) else []


def has_consistent_scale(graph: MapGraph, edge: LoopEdge, steps: float = 0.0) -> bool:
    """Return whether the measured scale of a loop closure fits that of the graph.

    The result is true if no scale was measured, because both segments are metric, or if the graph does not
    know the ratio of both scales yet.  *steps* of odometry lie between both ends; the scale of a single
    camera drifts along them.
    """
    if edge.scale is None:
        return True
    a, b = graph.segment_of(edge.a), graph.segment_of(edge.b)
    if a.component != b.component and not {a.component, b.component} <= graph.metric_components:
        return True
    variance = edge.scale[1] + KNOWN_SCALE_DEVIATION**2 + steps * TEST_NOISE.step_scale**2
    difference = edge.scale[0] + math.log(a.scale / b.scale)
    return difference**2 <= CHI2_99_PERCENT_1 * variance


def find_consistent_by_odometry(graph: MapGraph, number: int, others: Iterable[int]) -> list[int]:
    """Return the largest set of loop closures that agree with *number* and pairwise, by odometry alone.

    *others* are loop closures between the same two segments as *number*; up to 24 of them are tested, see
    `choose_testable_edges`.  The result is sorted and holds *number*, alone if no other one agrees.  The
    poses of the graph are not used, since they may rest on wrong loop closures.
    """
    candidates = choose_testable_edges(graph, sorted({*others} - {number}))[-MAX_CONTRARY_EDGES:]
    if not candidates:
        return [number]
    # 1. Express the loop closures in the direction and unit of one segment, the metric one if there is one.
    edge = graph.edges[number]
    base, opposite = int(graph.segment_rows[edge.a]), int(graph.segment_rows[edge.b])
    if graph.segments[opposite].is_metric and not graph.segments[base].is_metric:
        base = opposite
    directed = [_edge_between_segments(graph, graph.edges[each], base) for each in candidates]
    reference = _edge_between_segments(graph, edge, base)
    # 2. Keep the other loop closures that agree with loop closure *number*.
    near = np.flatnonzero(_agree_by_odometry(graph, directed, reference))
    # 3. Test these pairwise; the largest set that agrees is a maximum clique.
    agree = np.zeros((len(near), len(near)), dtype=np.bool_)
    for j in range(1, len(near)):
        before = [directed[position] for position in near[:j]]
        agree[j, :j] = _agree_by_odometry(graph, before, directed[near[j]])
    clique = find_maximum_clique(agree | agree.T) if len(near) else near
    return sorted([number, *(candidates[near[position]] for position in clique.tolist())])


def _agree_by_odometry(
    graph: MapGraph, edges: Sequence[DirectedEdge], reference: DirectedEdge
) -> npt.NDArray[np.bool_]:
    """Return ``(m,)``: whether each of *m* loop closures agrees with *reference* by odometry alone.

    All lead from one segment to one other, or within one segment, in the unit of the first one.
    """
    arrays = _stack_edges(edges)
    steps = graph.odometry_steps
    steps_a, steps_b = steps[arrays.a] - steps[reference.a], steps[arrays.b] - steps[reference.b]
    return are_pairwise_consistent(
        graph.T_odom_camera, arrays, _stack_edges([reference]), np.abs(steps_a) + np.abs(steps_b), TEST_NOISE
    )


def find_contradiction(graph: MapGraph, number: int) -> Contradiction | None:
    """Return what loop closure *number*, which is contrary to the graph, proves; None if it proves nothing.

    The error of the relative pose of both ends is computed by odometry within one segment, and by the poses
    of the graph between two segments of one component.  An error above 1 m and above 15 % of the path along
    odometry proves perceptual aliases.  A smaller one within a segment contradicts accepted loop closures
    that do not agree with *number* by odometry.  A loop closure between two segments proves nothing if an end
    is a known perceptual alias.
    """
    # 1. Compute the error of the relative pose, and the steps of odometry between both ends.
    rows, edge = graph.segment_rows, graph.edges[number]
    ends, row = [edge.a, edge.b], int(rows[edge.a])
    if row != rows[edge.b] and not graph.aliased_keyframes.isdisjoint(ends):
        return None
    if row == rows[edge.b]:
        T_a, T_b = scaled(graph.T_odom_camera[ends], graph.segments[row].scale)
        steps = abs(float(graph.odometry_steps[edge.a] - graph.odometry_steps[edge.b]))
    else:
        T_a, T_b = graph.T_component_camera[ends]
        steps = shortest_paths(graph, edge.a, [edge.b])[edge.b]
    error = inverse(relative_pose_of(graph, edge)) @ inverse(T_a) @ T_b
    error_m = float(np.sqrt((error[:3, 3] ** 2).sum()))
    # 2. An error that drift cannot explain is the distance of two places that look the same.
    if error_m > max(ALIAS_DISTANCE_M, steps * STEP_LENGTH_M * MAX_DRIFT_RATIO):
        return Contradiction(alias_distance_m=error_m)
    # 3. Else find the accepted loop closures within the segment that do not agree by odometry.
    loops = [
        other
        for other, accepted in graph.edges.items()
        if accepted.state == "accepted"
        and not accepted.is_fixed
        and rows[accepted.a] == rows[accepted.b] == row == rows[edge.b]
    ]
    return Contradiction(
        edges=[loop for loop in loops if loop not in find_consistent_by_odometry(graph, number, [loop])]
    )


def shortest_paths(graph: MapGraph, start: int, targets: Iterable[int]) -> dict[int, float]:
    """Return the steps of odometry from keyframe *start* to each target along the shortest path.

    A loop closure counts as one step.  The search (Dijkstra) visits 250 keyframes at most.  For a target that
    the search does not reach, the result is an estimate.  In the segment of *start* it is the number of steps
    along the segment, but at most 200; elsewhere it is the number of steps to the farthest visited keyframe,
    but at least 200.
    """
    wanted = set(targets)
    steps: dict[int, float] = {}
    visited: set[int] = set()
    heap = [(0.0, start)]
    farthest = 0.0
    while heap and len(steps) < len(wanted) and len(visited) < MAX_VISITED_KEYFRAMES:
        farthest, i = heapq.heappop(heap)
        if i in visited:
            continue
        visited.add(i)
        if i in wanted:
            steps[i] = farthest
        for neighbour, length in find_neighbours(graph, i):
            if neighbour not in visited:
                heapq.heappush(heap, (farthest + length, neighbour))
    for i in wanted - steps.keys():
        along_segment = abs(float(graph.odometry_steps[i] - graph.odometry_steps[start]))
        is_same_segment = graph.segment_rows[i] == graph.segment_rows[start]
        steps[i] = min(along_segment, MAX_PATH_STEPS) if is_same_segment else max(farthest, MAX_PATH_STEPS)
    return steps


def find_neighbours(graph: MapGraph, i: int) -> Iterator[tuple[int, float]]:
    """Yield (keyframe, steps) of each keyframe that odometry or an accepted edge connects with *i*.

    A loop closure counts as one step.  Keyframes of a stored version have no odometry.
    """
    segment, position = graph.segments[graph.segment_rows[i]], int(graph.positions[i])
    if not segment.is_from_version:
        for near in (position - 1, position + 1):
            if 0 <= near < len(segment.keyframes):
                other = segment.keyframes[near]
                yield other, abs(float(graph.odometry_steps[other] - graph.odometry_steps[i]))
    for number in graph.accepted_edges_of(i):
        edge = graph.edges[number]
        yield (edge.b if edge.a == i else edge.a), 1.0


# --- Loop closures between two components ---


def choose_metric_component(graph: MapGraph, first: int, second: int) -> int:
    """Return in whose unit two components are compared: the first one's, unless only the second is metric."""
    metric = graph.metric_components
    return second if second in metric and first not in metric else first


def relative_scale(graph: MapGraph, number: int, base: int) -> tuple[float, float]:
    """Return the scale that a loop closure between component *base* and another one measures.

    The first value is the logarithm of the length of the other component's unit in the unit of *base*, the
    second one its variance.  Both are 0 if both components are metric, because no scale is unknown then.
    """
    edge = graph.edges[number]
    a, b = graph.segment_of(edge.a), graph.segment_of(edge.b)
    if edge.scale is None or {a.component, b.component} <= graph.metric_components:
        return 0.0, 0.0
    log_ratio = edge.scale[0] + math.log(a.scale / b.scale)
    return (log_ratio if a.component == base else -log_ratio), edge.scale[1]


def relative_pose_between_components(
    graph: MapGraph, number: int, base: int, log_scale: float
) -> DirectedEdge:
    """Return a loop closure from component *base* to another one, with lengths in the unit of *base*.

    *log_scale* is the logarithm of the length of the other component's unit in the unit of *base*.
    """
    edge = graph.edges[number]
    row, is_forward = unit_segment_of(graph, edge), bool(graph.components[edge.a] == base)
    unit = 1.0 if row < 0 else graph.segments[row].scale * (1.0 if is_forward else math.exp(log_scale))
    return _directed(edge, is_forward, unit)


def edge_between_components(graph: MapGraph, number: int, base: int) -> DirectedEdge:
    """Return a loop closure from component *base* to another one, with the scale that it measures."""
    log_scale, variance = relative_scale(graph, number, base)
    directed = relative_pose_between_components(graph, number, base, log_scale)
    return directed._replace(scale=(log_scale, variance)) if variance else directed


def are_consistent_between_components(
    graph: MapGraph, number: int, others: Sequence[int], base: int
) -> npt.NDArray[np.bool_]:
    """Return ``(m,)``: whether each of *m* other loop closures agrees with loop closure *number*.

    All connect component *base* with the same other component.  Within a component the poses of the graph
    and the shortest paths along the graph take the place of odometry.

    Source:
        Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018.
    """
    reference = edge_between_components(graph, number, base)
    directed = [edge_between_components(graph, other, base) for other in others]
    steps_a = shortest_paths(graph, reference.a, [edge.a for edge in directed])
    steps_b = shortest_paths(graph, reference.b, [edge.b for edge in directed])
    steps = np.array([steps_a[edge.a] + steps_b[edge.b] for edge in directed])
    return are_pairwise_consistent(
        graph.T_component_camera, _stack_edges(directed), _stack_edges([reference]), steps, TEST_NOISE
    )


# --- Joins of two components ---


def decide_join(graph: MapGraph, first: int, second: int) -> JoinComponents | StateReason | None:
    """Return the join of two components that pending loop closures prove, or why it is ambiguous.

    Return None if too few loop closures agree.
    """
    # 1. Find the largest consistent set of loop closures between both components.
    consistent = _find_consistent_edges(graph, first, second)
    if not has_enough_support(graph, consistent):
        return None
    # 2. If perceptual aliases may explain the set, return this reason instead of a join.
    root = graph.root_component()
    reason = _find_ambiguity(graph, first, second, consistent)
    if reason:
        edges = [graph.edges[number] for number in consistent]
        ends = sorted({end for edge in edges for end in (edge.a, edge.b)}, reverse=True)
        rows = dict.fromkeys(int(graph.segment_rows[i]) for i in ends if graph.components[i] != root)
        changed = [row for row in rows if graph.segments[row].reason != reason]
        return StateReason(rows=changed, reason=reason, is_reported=True)
    # 3. Choose the component that stays: that of the map, else the older one; but if only one is metric, that
    #    one.
    is_second = second == root or (first != root and second < first)
    stay, moving = (second, first) if is_second else (first, second)
    if choose_metric_component(graph, stay, moving) != stay:
        stay, moving = moving, stay
    # 4. Compute the scale and the pose of the moving component as medians over the loop closures.
    log_scale = _median_log_scale(graph, consistent, stay)
    T_stay_moving = _median_frame(graph, consistent, stay, log_scale)
    return JoinComponents(
        moving=moving, T_stay_moving=T_stay_moving, scale=math.exp(log_scale), numbers=consistent
    )


def _find_consistent_edges(
    graph: MapGraph, first: int, second: int, excluded: frozenset[int] = frozenset()
) -> list[int]:
    """Return the largest set of pending loop closures between two components that agree pairwise.

    The set is empty if the tested ones together have too little weight.  *excluded* ones are left out.
    """
    # 1. Choose the pending loop closures between both components whose scale the graph does not contradict.
    components, pair = graph.components, {first, second}
    edges = [(number, graph.edges[number]) for number in graph.pending if number not in excluded]
    between = [(number, each) for number, each in edges if {components[each.a], components[each.b]} == pair]
    numbers = [number for number, each in between if has_consistent_scale(graph, each)]
    base = choose_metric_component(graph, first, second)
    # 2. Limit the number of loop closures. Where rooms look the same, take them at a distance from each
    #    other, so that the limited number extends over more than one room.
    if graph.equal_rooms_m:
        numbers = _thin_out(graph, numbers, base, 3.0 * graph.equal_rooms_m / MAX_TESTED_EDGES)
    numbers = choose_testable_edges(graph, numbers)
    if total_weight(graph, numbers) < MIN_SUPPORT:
        return []
    # 3. Test the pairs of loop closures that were not tested before.
    for position, later in enumerate(numbers):
        untested = [each for each in numbers[:position] if (each, later) not in graph.pair_consistency]
        if untested:
            agrees = are_consistent_between_components(graph, later, untested, base)
            for earlier, is_consistent in zip(untested, agrees.tolist(), strict=True):
                graph.note_pair_consistency(earlier, later, is_consistent=is_consistent)
    adjacency = np.zeros((len(numbers), len(numbers)), dtype=np.bool_)
    for j, later in enumerate(numbers):
        for i, earlier in enumerate(numbers[:j]):
            adjacency[i, j] = adjacency[j, i] = graph.pair_consistency[earlier, later]
    # 4. The largest consistent set is a maximum clique of the graph of consistent pairs.
    return _find_heaviest_clique(graph, numbers, adjacency)


def _find_heaviest_clique(
    graph: MapGraph, numbers: Sequence[int], adjacency: npt.NDArray[np.bool_]
) -> list[int]:
    """Return the heavier one of two maximum cliques: of all loop closures, and of those with full weight.

    A maximum clique has the largest number of loop closures; its weight is their summed weight.

    Row and column *i* of *adjacency* are those of the loop closure ``numbers[i]``.
    """
    full = np.flatnonzero([graph.edges[number].weight == 1.0 for number in numbers])
    of_all = [numbers[row] for row in find_maximum_clique(adjacency).tolist()]
    if len(full) == len(numbers):
        return of_all
    of_full = [numbers[full[row]] for row in find_maximum_clique(adjacency[np.ix_(full, full)]).tolist()]
    return max(of_all, of_full, key=lambda clique: total_weight(graph, clique))


def _thin_out(graph: MapGraph, numbers: list[int], component: int, min_distance_m: float) -> list[int]:
    """Return loop closures whose ends in *component* are at a distance from each other, sorted as *numbers*.

    A loop closure is left out if its end is within *min_distance_m* metres, along each axis, of the end of
    the loop closure that was taken before it; ends of loop closures taken earlier may be nearer.
    """
    chosen: list[int] = []
    last = np.full(3, np.inf)
    for number in numbers:
        end = edge_between_components(graph, number, component).a
        position = graph.T_component_camera[end, :3, 3]
        if np.abs(position - last).max() >= min_distance_m:
            chosen.append(number)
            last = position
    return chosen


def _find_ambiguity(graph: MapGraph, first: int, second: int, consistent: list[int]) -> str:
    """Return why a consistent set may see one of several equal places, empty if there is no sign of that."""
    # 1. The set is ambiguous if it has too little support without loop closures at known perceptual aliases.
    ends = {number: {graph.edges[number].a, graph.edges[number].b} for number in consistent}
    distinct = [number for number in consistent if ends[number].isdisjoint(graph.aliased_keyframes)]
    if not has_enough_support(graph, distinct):
        return "ambiguous: what it sees is in the map at several places"
    # 2. Where rooms look the same, the loop closures must extend over more than one room in each metric
    #    component; without a metric component no extent is known, and the set is ambiguous.
    size_m = graph.equal_rooms_m
    metric = {first, second} & graph.metric_components
    if size_m and min((_extent_m(graph, distinct, side) for side in metric), default=0.0) <= size_m:
        return f"ambiguous: what it shares with others lies within {size_m:g} m, the size of equal rooms"
    # 3. The set is ambiguous if a second consistent set, without its loop closures, has enough support and at
    #    least half of its weight, but gives a relative pose of both components that differs by more than 1 m.
    rivals = _find_consistent_edges(graph, first, second, frozenset(consistent))
    is_heavy = total_weight(graph, rivals) / RIVAL_WEIGHT >= total_weight(graph, consistent)
    if is_heavy and has_enough_support(graph, rivals):
        stay = choose_metric_component(graph, first, second)
        T_consistent, T_rivals = (
            _median_frame(graph, numbers, stay, _median_log_scale(graph, numbers, stay))
            for numbers in (consistent, rivals)
        )
        if float(np.sqrt(((T_consistent - T_rivals)[:3, 3] ** 2).sum())) > ALIAS_DISTANCE_M:
            return f"ambiguous: {len(consistent)} links say one place, {len(rivals)} another"
    return ""


def _extent_m(graph: MapGraph, numbers: list[int], component: int) -> float:
    """Return the largest distance between the ends of loop closures in *component*, in its unit."""
    edges = [graph.edges[number] for number in numbers]
    ends = [edge.a if graph.components[edge.a] == component else edge.b for edge in edges]
    positions = graph.T_component_camera[ends, :3, 3]
    return float(np.sqrt(((positions[:, None] - positions[None]) ** 2).sum(axis=2).max()))


def _median_log_scale(graph: MapGraph, numbers: list[int], stay: int) -> float:
    """Return the median logarithm of the length of the other component's unit in the unit of *stay*."""
    return float(np.median([relative_scale(graph, number, stay)[0] for number in numbers]))


def _median_frame(graph: MapGraph, numbers: list[int], stay: int, log_scale: float) -> Array:
    """Return ``T_stay_moving`` ``(4, 4)``: the pose of the frame of the moving component in that of *stay*.

    It is the medoid of the poses that single loop closures give, after the lengths of the moving component
    were multiplied by the exponential of *log_scale*.
    """
    poses = []
    for number in numbers:
        edge = relative_pose_between_components(graph, number, stay, log_scale)
        T_moving = graph.T_component_camera[edge.b]
        if log_scale != 0.0:
            T_moving = scaled(T_moving, math.exp(log_scale))
        poses.append(graph.T_component_camera[edge.a] @ edge.T_a_b @ inverse(T_moving))
    return median_pose(np.array(poses))


# --- Loop closures as values ---


def unit_segment_of(graph: MapGraph, edge: LoopEdge) -> int:
    """Return the row of the segment in whose unit a loop closure is, -1 if it is in metres."""
    is_metric = graph.segment_of(edge.a).is_metric or graph.segment_of(edge.b).is_metric
    return -1 if is_metric else int(graph.segment_rows[edge.a])


def relative_pose_of(graph: MapGraph, edge: LoopEdge) -> Array:
    """Return ``T_a_b`` of a loop closure within one component, in the unit of the component."""
    row = unit_segment_of(graph, edge)
    return edge.T_a_b if row < 0 else scaled(edge.T_a_b, graph.segments[row].scale)


def _stack_edges(edges: Sequence[DirectedEdge]) -> EdgeArrays:
    """Return loop closures as arrays; either all of them have a scale, or none has."""
    scales = [edge.scale for edge in edges if edge.scale is not None]
    return EdgeArrays(
        a=np.array([edge.a for edge in edges], dtype=np.int64),
        b=np.array([edge.b for edge in edges], dtype=np.int64),
        T_a_b=np.array([edge.T_a_b for edge in edges]),
        variances=np.array([edge.variances for edge in edges]),
        scales=np.array(scales) if scales else None,
    )


def _edge_between_segments(graph: MapGraph, edge: LoopEdge, base: int) -> DirectedEdge:
    """Return a loop closure from segment *base* to another one, in the unit of the odometry of *base*."""
    is_forward = int(graph.segment_rows[edge.a]) == base
    if edge.scale is None or graph.segment_rows[edge.a] == graph.segment_rows[edge.b]:
        return _directed(edge, is_forward, 1.0)
    log_ratio, variance = edge.scale
    log_scale = log_ratio if is_forward else -log_ratio
    is_in_other_unit = unit_segment_of(graph, edge) >= 0 and not is_forward
    directed = _directed(edge, is_forward, math.exp(log_scale) if is_in_other_unit else 1.0)
    return directed._replace(scale=(log_scale, variance))


def _edge_within_component(graph: MapGraph, edge: LoopEdge) -> DirectedEdge:
    """Return a loop closure within one component, in the unit of the component."""
    row = -1 if edge.scale is None else unit_segment_of(graph, edge)
    return _directed(edge, True, 1.0 if row < 0 else graph.segments[row].scale)


def _directed(edge: LoopEdge, is_forward: bool, unit: float) -> DirectedEdge:
    """Return a loop closure from *a* to *b*, or from *b* to *a* if not *is_forward*; lengths times *unit*."""
    T_a_b, variances = edge.T_a_b, edge.variances
    if unit != 1.0:
        T_a_b, variances = scaled(T_a_b, unit), variances * np.array([unit**2] * 3 + [1.0] * 3)
    if is_forward:
        return DirectedEdge(edge.a, edge.b, T_a_b, variances)
    return DirectedEdge(edge.b, edge.a, inverse(T_a_b), variances)
