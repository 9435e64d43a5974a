"""Accept and reject the loop closures of a live map: classification, joins, and contradicting evidence.

A new loop closure is *pending*.  Within one component it is compared with the poses of the graph, between two
components with other loop closures (see `pairwise_consistency`).  Loop closures that contradict the graph,
but agree with each other, are evidence against loop closures that were accepted earlier.  A robot whose
odometry or metric scale keeps contradicting the other robots is excluded: its keyframes stay, but its loop
closures are ignored.

To add a rule, see CONTRIBUTING.md, "How to add a rule that rejects loop closures".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal

import numpy as np

from rse_pf.geometry import inverse
from rse_pf.live_map.decisions import (
    AcceptEdges,
    AddEdges,
    CompareEdges,
    Decision,
    ExcludeSegment,
    Fit,
    JoinComponents,
    MarkAliases,
    RecordContradictions,
    RecordMisfits,
    RejectEdges,
    StateReason,
)
from rse_pf.live_map.events import MeasuredLoopClosure, matrix_of
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.pairwise_consistency import (
    ALIAS_DISTANCE_M,
    MIN_SUPPORT,
    Contradiction,
    classify_by_graph,
    decide_join,
    find_contradiction,
    find_supporting_edges,
    total_weight,
)
from rse_pf.slam.consistency import evidence_weight

__all__ = [
    "decide_edges",
    "decide_exclusion",
    "decide_measured",
    "decide_misfits",
    "find_weakest_connection",
    "has_odometry_jump",
    "has_wrong_scale",
]

MAX_SQUARED_MISFIT = 30.0
"""Squared Mahalanobis norm of a loop closure's residual above which it counts as a misfit.  By the chi-square
distribution with six degrees of freedom, one true loop closure in 25,000 is above."""
MAX_MISFITS = 8  # smoothings in a row that an accepted loop closure misfits before it is rejected
MAX_EDGES_AFTER_JOIN = 48
"""Newest pending loop closures within a joined component that are decided after the join; older ones stay
pending without a decision, which bounds CPU time."""
MAX_ALIAS_RADIUS_M = 5.0
"""Largest radius, in metres, around a place that looks like another one, within which all keyframes are taken
for perceptual aliases."""
MIN_ALIAS_SUPPORT = 12
"""Summed weight of contrary loop closures between two segments, at least, that proves perceptual aliases.
They prove it only if they outweigh no connection (all accepted loop closures between two segments) on the
strongest path between both segments; else that connection is rejected."""
JUMP_NEIGHBOURS = 4
"""Keyframes before a new one that may prove a jump of its odometry: they saw the same place a moment before,
so they cannot be at another place that looks the same."""
MAX_JUMP_RATIO = 0.5
"""Error of odometry per length of motion above which the odometry has jumped, if the error is also above
`ALIAS_DISTANCE_M`."""
CONTRADICTION_HISTORY = 0xFFFFFFFF  # bit mask: the newest 32 records of contradictions decide about a robot
MAX_CONTRADICTIONS = 16
"""Contradictions among the last 32 records of a segment from which on it is excluded; honest robots stay far
below, also with 10 % of wheel slip."""
WRONG_SCALE_COUNT = 2
"""Contradictions that a keyframe with a wrong metric scale counts as: one for each of the two other robots,
at least, that contradict the scale."""
FIXED_WEIGHT = 1e9  # weight of a connection that is never rejected, above any other connection's weight

_AT_SEVERAL_PLACES = "ambiguous: what it saw is in the map at several places"


def decide_measured(
    graph: MapGraph, keyframe: int, measured: Sequence[MeasuredLoopClosure], *, has_jumped: bool
) -> Iterator[Decision]:
    """Decide about the loop closures that were measured for *keyframe*, and about its segment.

    The loop closures are added as pending ones, and decided by `decide_edges`.  The keyframe contradicts the
    map if all its loop closures of full weight within one component do and none was accepted, if its odometry
    has jumped (*has_jumped*), or if its metric scale is wrong.  The segment is excluded at 16 contradictions
    among its last 32 records.  A keyframe with a right scale and without loop closures of full weight within
    one component is not recorded.
    """
    numbers = range(graph.next_edge, graph.next_edge + len(measured))
    yield AddEdges(keyframe=keyframe, measured=measured)
    # 1. Decide about the loop closures, and collect how they fit the graph.
    fits: set[Fit | Literal["alias"]] = {"contrary"} if has_jumped else set()
    has_accepted = False
    for decision in decide_edges(graph, keyframe, numbers):
        yield decision
        if isinstance(decision, CompareEdges):
            fits |= decision.fits
        has_accepted |= isinstance(decision, AcceptEdges | JoinComponents)
    # 2. Record whether the keyframe contradicts the map, and exclude its segment if it keeps doing so.
    is_scale_wrong = has_wrong_scale(graph, keyframe, measured)
    is_contrary = is_scale_wrong or (fits == {"contrary"} and not has_accepted)
    if fits or is_scale_wrong:
        yield from decide_exclusion(graph, keyframe, is_contrary=is_contrary, is_scale_wrong=is_scale_wrong)


def decide_edges(graph: MapGraph, keyframe: int, numbers: Sequence[int]) -> Iterator[Decision]:
    """Accept or leave pending the loop closures *numbers* of *keyframe*, and join components by them.

    Loop closures without enough support stay pending.  Other pending ones may be accepted together with
    *numbers*; accepted ones that *numbers* outweigh, or that are at perceptual aliases, may be rejected.
    """
    # 1. Decide about the loop closures within the component of the keyframe by the poses of the graph.
    component = int(graph.components[keyframe])
    edges = {number: graph.edges[number] for number in numbers}
    others = {number: edge.b if edge.a == keyframe else edge.a for number, edge in edges.items()}
    within = [number for number in numbers if graph.components[others[number]] == component]
    yield from _decide_within(graph, _drop_redundant_weak(graph, within))
    # 2. Try to join the component with those that its loop closures lead to.
    for other in sorted({int(graph.components[i]) for i in others.values()} - {component}):
        yield from _decide_join(graph, int(graph.components[keyframe]), other)


def decide_misfits(graph: MapGraph, squared_misfits: Mapping[int, float]) -> Iterator[Decision]:
    """Count in how many smoothings in a row each loop closure misfitted, and reject it at the eighth.

    *squared_misfits* has the squared Mahalanobis norm of the residual of each accepted loop closure of the
    smoothing that ended now, by number.  A norm above `MAX_SQUARED_MISFIT` is a misfit; an edge of a stored
    version never counts as one.
    """
    misfits = {}
    for number, square in squared_misfits.items():
        edge = graph.edges[number]
        is_misfit = square > MAX_SQUARED_MISFIT and not edge.is_fixed
        misfits[number] = edge.misfits + 1 if is_misfit else 0
    yield RecordMisfits(misfits=misfits)
    outliers = [number for number, count in misfits.items() if count >= MAX_MISFITS]
    yield RejectEdges(numbers=outliers, reason="contrary to the graph")


# --- Loop closures within one component ---


def _decide_within(graph: MapGraph, numbers: list[int]) -> Iterator[Decision]:
    """Accept, or leave pending, the loop closures *numbers* within one component, by the poses of the graph.

    1. Those that agree with the graph are accepted, except weak ones (below full weight) that repeat an
       accepted one of full weight.
    2. A vague one is accepted if enough pending loop closures support it, together with these.
    3. A contrary one with enough support rejects accepted loop closures that it and its support outweigh.

    All others stay pending.
    """
    # 1. Compare the loop closures with the poses of the graph.
    fits = classify_by_graph(graph, numbers)
    full = [number for number in numbers if graph.edges[number].weight == 1.0]
    yield CompareEdges(fits={"alias" if _is_at_alias(graph, number) else fits[number] for number in full})
    # 2. Accept loop closures that agree with the graph: those of full weight first, weak ones only where no
    #    accepted one of full weight connects the same keyframe and segment.
    agreeing = [number for number, fit in fits.items() if fit == "agrees"]
    accepted = [number for number in agreeing if number in full]
    if accepted:
        yield AcceptEdges(numbers=accepted)
    for number in agreeing:
        if number not in full and not _has_full_weight_parallel(graph, number):
            yield AcceptEdges(numbers=[number])
    # 3. Compare the vague and the contrary loop closures with pending ones.  With enough support, vague ones
    #    are accepted, and contrary ones reject accepted loop closures that they outweigh.
    for number, fit in fits.items():
        if fit == "agrees" or not graph.is_pending(number):
            continue
        edge = graph.edges[number]
        # Skip a loop closure whose ends are in two components now, because a decision about an earlier one of
        # *numbers* has rejected what connected them; it stays pending.
        if graph.components[edge.a] != graph.components[edge.b]:
            continue
        supporting = find_supporting_edges(graph, number)
        contradiction = find_contradiction(graph, number) if supporting and fit == "contrary" else None
        if fit == "vague":
            if supporting:
                yield AcceptEdges(numbers=supporting)
        elif contradiction is not None:
            yield from _reject_contradicted(graph, number, supporting, contradiction)


def _drop_redundant_weak(graph: MapGraph, numbers: list[int]) -> list[int]:
    """Return the loop closures *numbers* of one keyframe without redundant weak ones, which stay pending.

    A weak loop closure is redundant if another one of *numbers*, of full weight, connects the keyframe with
    the same segment: it would add little, and costs the CPU time of a decision.
    """
    full = [number for number in numbers if graph.edges[number].weight == 1.0]
    connected = {int(graph.segment_rows[graph.edges[number].b]) for number in full}
    return [
        number
        for number in numbers
        if number in full or int(graph.segment_rows[graph.edges[number].b]) not in connected
    ]


def _has_full_weight_parallel(graph: MapGraph, number: int) -> bool:
    """Return whether an accepted loop closure of full weight makes the weak loop closure *number* redundant.

    Such a loop closure connects one end of *number* with any keyframe in the segment of the other end.
    """
    edge = graph.edges[number]
    for near, far in ((edge.a, edge.b), (edge.b, edge.a)):
        for parallel in (graph.edges[each] for each in graph.accepted_edges_of(near)):
            end = parallel.b if parallel.a == near else parallel.a
            if graph.segment_rows[end] == graph.segment_rows[far] and parallel.weight == 1.0:
                return True
    return False


# --- Evidence against accepted loop closures ---


def _reject_contradicted(
    graph: MapGraph, number: int, consistent: list[int], contradiction: Contradiction
) -> Iterator[Decision]:
    """Reject accepted loop closures that *consistent* ones, among them the contrary *number*, outweigh.

    Where the accepted and the contrary loop closures both have much weight, nobody knows which are wrong: two
    places look the same, and the keyframes there are marked as perceptual aliases.
    """
    reason = f"{len(consistent)} later links agree with each other and contradict it"
    edge = graph.edges[number]
    row_a, row_b = int(graph.segment_rows[edge.a]), int(graph.segment_rows[edge.b])
    contradicted, distance_m = contradiction.edges, contradiction.alias_distance_m
    weight = total_weight(graph, consistent)
    # 1. Within one segment, reject the loops that the contrary loop closures outweigh, and accept these.
    #    Where odometry cannot be so wrong, the contrary ones prove perceptual aliases instead.
    if row_a == row_b:
        if distance_m is not None:
            yield from _mark_aliases(graph, consistent, distance_m)
        elif contradicted and total_weight(graph, contradicted) < weight:
            yield RejectEdges(numbers=contradicted, reason=reason)
            yield AcceptEdges(numbers=consistent)
        return
    # 2. Between two segments, reject the weakest connection, as long as it weighs less than the contrary
    #    loop closures, until both segments are in two components.
    has_rejected = False
    while graph.segments[row_a].component == graph.segments[row_b].component:
        weakest = find_weakest_connection(graph, row_a, row_b)
        if not weakest or total_weight(graph, weakest) >= weight:
            break
        yield RejectEdges(numbers=weakest, reason=reason)
        has_rejected = True
    component_a, component_b = graph.segments[row_a].component, graph.segments[row_b].component
    # 3. If no connection was rejected, and the contrary loop closures weigh at least 12, an error of the
    #    graph that drift cannot explain proves perceptual aliases.
    if not has_rejected and weight >= MIN_ALIAS_SUPPORT and distance_m is not None:
        yield from _mark_aliases(graph, consistent, distance_m)
    # 4. Join the two components again where the contrary loop closures say.
    if has_rejected and component_a != component_b:
        yield from _decide_join(graph, component_a, component_b)


def find_weakest_connection(graph: MapGraph, row_a: int, row_b: int) -> list[int]:
    """Return the loop closures of the weakest connection on the strongest path between two segments.

    A *connection* is all accepted loop closures between two segments.  The strongest path is the one whose
    weakest connection has the largest summed weight of loop closures.  Return an empty list if there is no
    path, or if its weakest connection may not be rejected.  That is so for a connection with an edge of a
    stored version; and for one between two metric segments if segment *row_a* or *row_b* is not metric,
    because a segment of unknown scale proves nothing against known scales.
    """
    # 1. Sum the weights of the loop closures of each connection between two segments.
    connections = {
        pair: numbers for pair, numbers in graph.accepted_edges_by_segments().items() if pair[0] != pair[1]
    }
    metric = {row for row, segment in enumerate(graph.segments) if segment.is_metric}
    weights = {
        pair: FIXED_WEIGHT
        if any(graph.edges[number].is_fixed for number in numbers)
        or (metric.issuperset(pair) and not metric.issuperset((row_a, row_b)))
        else total_weight(graph, numbers)
        for pair, numbers in connections.items()
    }
    # 2. Find the strongest path: the first one that exists when connections are added from the heaviest to
    #    the lightest.
    for min_weight in sorted(set(weights.values()), reverse=True):
        path = _find_path(row_a, row_b, [pair for pair in weights if weights[pair] >= min_weight])
        if path:
            # 3. Return the weakest connection on the path, unless it may not be rejected.
            weakest = min(path, key=lambda pair: (weights[pair], pair))
            return [] if weights[weakest] == FIXED_WEIGHT else connections[weakest]
    return []


def _find_path(start: int, goal: int, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the connections on a shortest path from *start* to *goal*; empty if there is none.

    Connections are *pairs* of rows of segments.  The search is breadth-first.
    """
    paths: dict[int, list[tuple[int, int]]] = {start: []}
    queue = [start]
    for row in queue:
        for pair in sorted(pairs):
            if row in pair:
                neighbour = pair[1] if pair[0] == row else pair[0]
                if neighbour not in paths:
                    paths[neighbour] = [*paths[row], pair]
                    queue.append(neighbour)
    return paths.get(goal, [])


# --- Joins and perceptual aliases ---


def _decide_join(graph: MapGraph, first: int, second: int) -> Iterator[Decision]:
    """Join the components *first* and *second* if enough pending loop closures between them agree.

    After a join, the newest 48 pending loop closures within the joined component are decided.  If too few
    agree, nothing changes.  If loop closures agree on several different joins, only the reason why segments
    have no alignment changes.
    """
    decision = decide_join(graph, first, second)
    if decision is not None:
        yield decision
    if isinstance(decision, JoinComponents):
        # Decide about the newest pending loop closures that are now within the joined component.
        components, joined = graph.components, graph.components[graph.edges[decision.numbers[0]].a]
        pending = [(number, graph.edges[number]) for number in graph.pending]
        within = [number for number, edge in pending if components[edge.a] == components[edge.b] == joined]
        yield from _decide_within(graph, within[-MAX_EDGES_AFTER_JOIN:])


def _mark_aliases(graph: MapGraph, numbers: list[int], distance_m: float) -> Iterator[Decision]:
    """Mark the ends of loop closures as places that look the same, and reject connections that rest on them.

    The places are *distance_m* metres apart.  All keyframes of the same component within half of this
    distance, at most 5 m, of an end are marked, since they may look like the other place as well.
    """
    # 1. Mark the keyframes around both ends of the loop closures.
    radius_m = min(0.5 * distance_m, MAX_ALIAS_RADIUS_M)
    ends = {end for number in numbers for end in (graph.edges[number].a, graph.edges[number].b)}
    components, positions = graph.components, graph.T_component_camera[:, :3, 3]
    for i in sorted(ends):
        distances_m = np.sqrt(((positions - positions[i]) ** 2).sum(axis=1))
        near = np.flatnonzero((distances_m < radius_m) & (components == components[i]))
        yield MarkAliases(keyframes=near.tolist())
    # 2. Reject each connection (all accepted loop closures between two segments) that weighs less than 3
    #    without its loop closures at aliases.
    for pair, connection in sorted(graph.accepted_edges_by_segments().items()):
        is_fixed = any(graph.edges[number].is_fixed for number in connection)
        distinct = [number for number in connection if not _is_at_alias(graph, number)]
        if pair[0] != pair[1] and not is_fixed and total_weight(graph, distinct) < MIN_SUPPORT:
            yield RejectEdges(numbers=connection, reason="ambiguous: both ends look like another place")
            yield StateReason(rows=pair, reason=_AT_SEVERAL_PLACES, is_reported=False)


def _is_at_alias(graph: MapGraph, number: int) -> bool:
    """Return whether an end of a loop closure is at a place that looks like another place of the map."""
    edge = graph.edges[number]
    return edge.a in graph.aliased_keyframes or edge.b in graph.aliased_keyframes


# --- Checks of a robot: its odometry, its metric scale, and how often it contradicts the map ---


def has_wrong_scale(graph: MapGraph, keyframe: int, measured: Iterable[MeasuredLoopClosure]) -> bool:
    """Return whether the metric scale of *keyframe* differs from that of all robots it was compared with.

    Only loop closures of full weight with metric segments of other robots count.  They must be with at least
    two robots, or with one and the stored version: where only two robots differ, nobody knows which one is
    wrong.  All of them must find the scale of *keyframe* too large, or all of them too small.
    """
    own = graph.keyframes[keyframe].robot
    signs: dict[tuple[str, bool], set[float]] = {}
    for closure in measured:
        segment, robot = graph.segment_of(closure.other), graph.keyframes[closure.other].robot
        is_full = evidence_weight(closure.inliers, closure.matches) == 1.0
        if segment.is_metric and robot != own and is_full:
            sign = math.copysign(1.0, closure.off_scale) if closure.off_scale else 0.0
            signs.setdefault((robot, segment.is_from_version), set()).add(sign)
    return len(signs) > 1 and len(set().union(*signs.values())) == 1 and {0.0} not in signs.values()


def has_odometry_jump(graph: MapGraph, keyframe: int, measured: Iterable[MeasuredLoopClosure]) -> bool:
    """Return whether the odometry of *keyframe* contradicts all loop closures with the keyframes before it.

    A jump is an error above 1 m and above half of the motion that odometry states.  Only loop closures of
    full weight with the last four keyframes of the same metric segment count; without them the result is
    false.
    """
    segment = graph.segment_of(keyframe)
    if segment.is_from_version or not segment.is_metric:
        return False
    position = int(graph.positions[keyframe])
    neighbours = set(segment.keyframes[max(0, position - JUMP_NEIGHBOURS) : position])
    jumps = []
    for closure in measured:
        if closure.other in neighbours and evidence_weight(closure.inliers, closure.matches) == 1.0:
            motion = inverse(graph.T_odom_camera[keyframe]) @ graph.T_odom_camera[closure.other]
            error = inverse(np.array(matrix_of(closure.T_keyframe_other, 4, 4))) @ motion
            motion_m, error_m = (math.sqrt(float(T[:3, 3] @ T[:3, 3])) for T in (motion, error))
            jumps.append(error_m > max(ALIAS_DISTANCE_M, MAX_JUMP_RATIO * motion_m))
    return bool(jumps) and all(jumps)


def decide_exclusion(
    graph: MapGraph, keyframe: int, *, is_contrary: bool, is_scale_wrong: bool
) -> Iterator[Decision]:
    """Record whether *keyframe* contradicts the map, and exclude its segment at 16 of 32 contradictions.

    *is_contrary* says that the keyframe contradicts the map; a wrong metric scale counts as two
    contradictions.  Nothing is recorded of a segment that is excluded already, or that holds the keyframes of
    a stored version.
    """
    row, segment = int(graph.segment_rows[keyframe]), graph.segment_of(keyframe)
    if segment.is_excluded or segment.is_from_version:
        return
    count = WRONG_SCALE_COUNT if is_scale_wrong else 1
    newest = (1 << count) - 1 if is_contrary else 0
    history = ((segment.contradictions << count) | newest) & CONTRADICTION_HISTORY
    yield RecordContradictions(row=row, contradictions=history)
    contradictions = history.bit_count()
    if contradictions < MAX_CONTRADICTIONS or not is_contrary:
        return
    reason = f"contradicting: {contradictions} of the last 32 keyframes contradict their own odometry"
    if is_scale_wrong:
        reason = "contradicting: its metres are not those of two other robots"
    yield ExcludeSegment(row=row, reason=reason)
