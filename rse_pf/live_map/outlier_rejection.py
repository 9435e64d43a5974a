"""Accept and reject the loop closures of a live map: classification, joins, and contradicting evidence.

A new loop closure is *pending*.  Within one component it is compared with the poses of the graph, between two
components with other loop closures (see `pairwise_consistency`).  Loop closures that contradict the graph,
but agree with each other, are evidence against loop closures that were accepted earlier.  A robot whose
odometry or metric scale keeps contradicting the other robots is excluded: its keyframes stay, but its loop
closures are ignored.

To add a rule that rejects loop closures, see CONTRIBUTING.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from typing import Literal

import numpy as np

from rse_pf.geometry import inverse
from rse_pf.live_map.events import MeasuredLoopClosure, matrix_of
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.outcomes import Ambiguous, LoopClosureAccepted, LoopClosureRejected, Outcome
from rse_pf.live_map.pairwise_consistency import (
    ALIAS_DISTANCE_M,
    MIN_SUPPORT,
    AmbiguousJoin,
    Contradiction,
    Fit,
    classify_by_graph,
    decide_join,
    find_contradiction,
    find_supporting_edges,
    total_weight,
)
from rse_pf.slam.consistency import evidence_weight

__all__ = [
    "GraphChanges",
    "decide_again",
    "exclude_if_contradicting",
    "find_weakest_connection",
    "has_odometry_jump",
    "has_wrong_scale",
    "process_new_edges",
    "reject_misfitting_edges",
]

MAX_SQUARED_MISFIT = 30.0
"""Squared Mahalanobis norm of a loop closure's residual (six degrees of freedom) above which it counts as a
misfit; one true loop closure in 25,000 is above."""
MAX_MISFITS = 8  # updates in a row in which a loop closure misfits the smoothed graph until it is rejected
MAX_EDGES_AFTER_JOIN = 48  # newest pending loop closures that are classified after a join, to bound CPU time
MAX_ALIAS_RADIUS_M = 5.0
"""Metres around a place that looks like another one within which all keyframes are taken for aliases, at
most."""
MIN_ALIAS_SUPPORT = 12
"""Summed weight of contrary loop closures between two segments, at least, that proves perceptual aliases
where no connection weighs less, so that none can be rejected."""
JUMP_NEIGHBOURS = 4
"""Keyframes before a new one that may prove a jump of its odometry: they saw the same place a moment before,
so they cannot be at another place that looks the same."""
MAX_JUMP_RATIO = 0.5  # error of odometry per length of motion above which the odometry has jumped
MAX_CONTRADICTIONS = 16
"""Contradictions among the last 32 records of a segment from which on it is excluded; honest robots stay far
below, also with 10 % of wheel slip."""
WRONG_SCALE_COUNT = 2
"""Records of a contradiction that a keyframe with a wrong metric scale counts as, because two other robots
measured the scale."""
FIXED_WEIGHT = 1e9  # weight of a connection that is never rejected, above any sum of loop closures' weights

_AT_SEVERAL_PLACES = "ambiguous: what it saw is in the map at several places"


@dataclass(slots=True)
class GraphChanges:
    """What an update of loop closures changed.

    ``outcomes`` are reported.  ``moved`` are the keyframes around which the graph must be smoothed.  ``fits``
    collects how the loop closures of full weight within one component fitted the graph; those at perceptual
    aliases, which say nothing about the robot, are "alias".
    """

    outcomes: list[Outcome] = field(default_factory=list)
    moved: list[int] = field(default_factory=list)
    fits: set[Fit | Literal["alias"]] = field(default_factory=set)

    def mark_moved(self, *keyframes: int) -> None:
        """Add keyframes around which the graph must be smoothed, each at most once."""
        self.moved += [i for i in keyframes if i not in self.moved]


def process_new_edges(graph: MapGraph, keyframe: int, numbers: list[int]) -> GraphChanges:
    """Accept, reject or leave pending the loop closures *numbers* of *keyframe*, and join components by them.

    The graph is changed.  Loop closures without enough support stay pending.  Other pending ones may be
    accepted together with *numbers*, and accepted ones that *numbers* outweigh are rejected.  The result
    holds the outcomes, and the keyframes around which the graph must be smoothed.
    """
    changes = GraphChanges()
    # 1. Decide about the loop closures within the component of the keyframe by the poses of the graph.
    component = int(graph.components[keyframe])
    edges = {number: graph.edges[number] for number in numbers}
    others = {number: edge.b if edge.a == keyframe else edge.a for number, edge in edges.items()}
    within = [number for number in numbers if graph.components[others[number]] == component]
    _decide_within(graph, _drop_redundant_weak(graph, within), changes)
    # 2. Try to join the component with those that its loop closures lead to.
    for other in sorted({int(graph.components[i]) for i in others.values()} - {component}):
        _join_if_consistent(graph, int(graph.components[keyframe]), other, changes)
    return changes


def decide_again(graph: MapGraph) -> Iterator[GraphChanges]:
    """Decide again about all loop closures that are not accepted, as if they arrived now, oldest first.

    Rejected loop closures become pending, and proofs of perceptual aliases are dropped before, since they may
    rest on loop closures that were taken out.  This is a generator: the graph changes while the caller
    iterates, and the caller smooths it around each yielded change before the next one is computed.
    """
    graph.reopen_rejected()
    for keyframe, group in groupby(list(graph.pending), lambda number: graph.edges[number].a):
        pending = [number for number in group if _is_pending(graph, number)]
        if pending:
            changes = process_new_edges(graph, keyframe, pending)
            if changes.outcomes or changes.moved:
                yield changes


def reject_misfitting_edges(
    graph: MapGraph, squared_misfits: Mapping[int, float], changes: GraphChanges
) -> bool:
    """Count the misfits of accepted loop closures, and reject those with eight in a row.

    Args:
        graph: The graph after smoothing; the counts and the loop closures change.
        squared_misfits: Squared Mahalanobis norm of the residual of each smoothed loop closure, by number.
        changes: Receives the outcomes, and the ends of rejected loop closures as moved.

    Returns:
        Whether there was such a loop closure.
    """
    outliers = []
    for number, square in squared_misfits.items():
        is_misfit = square > MAX_SQUARED_MISFIT and not graph.edges[number].is_fixed
        if graph.note_misfit(number, is_misfit=is_misfit) >= MAX_MISFITS:
            outliers.append(number)
    _reject(graph, outliers, "contrary to the graph", changes)
    return bool(outliers)


# --- Loop closures within one component ---


def _decide_within(graph: MapGraph, numbers: list[int], changes: GraphChanges) -> None:
    """Accept loop closures within one component that agree with the graph; use the others as evidence.

    Others without enough support, and weak ones that repeat an accepted one of full weight, stay pending.
    """
    # 1. Compare the loop closures with the poses of the graph.
    fits = classify_by_graph(graph, numbers)
    changes.fits |= {
        "alias" if _is_at_alias(graph, number) else fit
        for number, fit in fits.items()
        if graph.edges[number].weight == 1.0
    }
    # 2. Accept loop closures that agree with the graph: those of full weight first, weak ones only where no
    #    accepted one of full weight connects the same keyframe and segment.
    agreeing = [number for number, fit in fits.items() if fit == "agrees"]
    _accept(graph, [number for number in agreeing if graph.edges[number].weight == 1.0], changes)
    for number in agreeing:
        if _is_pending(graph, number) and not _has_full_weight_parallel(graph, number):
            _accept(graph, [number], changes)
    # 3. Compare the other loop closures with pending ones: with enough support vague ones are accepted, and
    #    contrary ones reject accepted ones.
    for number, fit in fits.items():
        if fit == "agrees" or not _is_pending(graph, number):
            continue
        edge = graph.edges[number]
        # A rejection for an earlier loop closure of this loop may have separated the components of both ends.
        if graph.components[edge.a] != graph.components[edge.b]:
            continue
        supporting = find_supporting_edges(graph, number)
        contradiction = find_contradiction(graph, number) if supporting and fit == "contrary" else None
        if fit == "vague":
            _accept(graph, supporting, changes)
        elif contradiction is not None:
            _reject_contradicted(graph, number, supporting, contradiction, changes)


def _drop_redundant_weak(graph: MapGraph, numbers: list[int]) -> list[int]:
    """Return the loop closures of one keyframe without weak ones to a segment that a full one leads to.

    A weak loop closure adds nothing there, and costs the CPU time of a decision; it stays pending.
    """
    full = [number for number in numbers if graph.edges[number].weight == 1.0]
    connected = {int(graph.segment_rows[graph.edges[number].b]) for number in full}
    return [
        number
        for number in numbers
        if number in full or int(graph.segment_rows[graph.edges[number].b]) not in connected
    ]


def _has_full_weight_parallel(graph: MapGraph, number: int) -> bool:
    """Return whether an accepted loop closure of full weight connects the same keyframe and segment.

    It leads from one end of loop closure *number* to any keyframe in the segment of the other end.
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
    graph: MapGraph,
    number: int,
    consistent: list[int],
    contradiction: Contradiction,
    changes: GraphChanges,
) -> None:
    """Reject accepted loop closures that *consistent* ones, among them the contrary *number*, outweigh.

    Where accepted and contrary loop closures both have much weight, both are right: the robots saw two places
    that look the same (perceptual aliases).
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
            _mark_aliases(graph, consistent, distance_m, changes)
        elif contradicted and total_weight(graph, contradicted) < weight:
            _reject(graph, contradicted, reason, changes)
            _accept(graph, consistent, changes)
        return
    # 2. Between two segments, reject the weakest connection, as long as it weighs less than the contrary
    #    loop closures, until both segments are in two components.
    has_rejected = False
    while graph.segments[row_a].component == graph.segments[row_b].component:
        weakest = find_weakest_connection(graph, row_a, row_b)
        if not weakest or total_weight(graph, weakest) >= weight:
            break
        _reject(graph, weakest, reason, changes)
        has_rejected = True
    component_a, component_b = graph.segments[row_a].component, graph.segments[row_b].component
    # 3. If no connection was rejected, and the contrary loop closures weigh at least 12, an error of the
    #    graph that drift cannot explain proves perceptual aliases.
    if not has_rejected and weight >= MIN_ALIAS_SUPPORT and distance_m is not None:
        _mark_aliases(graph, consistent, distance_m, changes)
    # 4. Join the two components again where the contrary loop closures say.
    if has_rejected and component_a != component_b:
        _join_if_consistent(graph, component_a, component_b, changes)


def find_weakest_connection(graph: MapGraph, row_a: int, row_b: int) -> list[int]:
    """Return the loop closures of the weakest connection on the strongest path between two segments.

    A *connection* is all accepted loop closures between two segments.  The strongest path is the one whose
    weakest connection has the largest summed weight of loop closures.  Connections with an edge of a stored
    version are never returned; nor are those between two metric segments if segment *row_a* or *row_b* is
    not metric, because a segment of unknown scale proves nothing against known scales.  Return an empty list
    if there is no other connection on the path.
    """
    # 1. Sum the weights of the loop closures of each connection between two segments.
    connections = {
        pair: numbers for pair, numbers in graph.accepted_edges_by_segments().items() if pair[0] != pair[1]
    }
    is_metric = _are_metric(graph, (row_a, row_b))
    weights = {
        pair: FIXED_WEIGHT
        if any(graph.edges[number].is_fixed for number in numbers)
        or (_are_metric(graph, pair) and not is_metric)
        else total_weight(graph, numbers)
        for pair, numbers in connections.items()
    }
    # 2. Find the strongest path: the first one that exists when connections are added from the heaviest to
    #    the lightest.
    for min_weight in sorted(set(weights.values()), reverse=True):
        path = _find_path(row_a, row_b, [pair for pair in weights if weights[pair] >= min_weight])
        if path:
            # 3. Return the weakest connection on the path, unless nothing may reject it.
            weakest = min(path, key=lambda pair: (weights[pair], pair))
            return [] if weights[weakest] == FIXED_WEIGHT else connections[weakest]
    return []


def _are_metric(graph: MapGraph, rows: Iterable[int]) -> bool:
    return all(graph.segments[row].is_metric for row in rows)


def _find_path(start: int, goal: int, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the connections on a shortest path from *goal* back to *start*; empty if there is none.

    Connections are *pairs* of rows of segments.  The search is breadth-first.
    """
    came_from: dict[int, tuple[int, tuple[int, int]]] = {start: (start, (start, start))}
    frontier = [start]
    while frontier and goal not in came_from:
        next_frontier = []
        for row in frontier:
            for pair in sorted(pairs):
                if row in pair:
                    neighbour = pair[1] if pair[0] == row else pair[0]
                    if neighbour not in came_from:
                        came_from[neighbour] = (row, pair)
                        next_frontier.append(neighbour)
        frontier = next_frontier
    path = []
    row = goal
    while row in came_from and row != start:
        row, pair = came_from[row]
        path.append(pair)
    return path


# --- Joins and perceptual aliases ---


def _join_if_consistent(graph: MapGraph, first: int, second: int, changes: GraphChanges) -> None:
    """Join two components if enough pending loop closures between them agree, and decide about the rest.

    If too few agree, nothing changes.  If they agree but are ambiguous, only the reasons of segments change.
    """
    decision = decide_join(graph, first, second)
    if decision is None:
        return
    if isinstance(decision, AmbiguousJoin):
        for row in decision.segment_rows:
            graph.set_reason(row, decision.reason)
            robot, segment = graph.segments[row].robot, graph.segments[row].number
            changes.outcomes.append(Ambiguous(robot=robot, segment=segment, reason=decision.reason))
        return
    # 1. Move one component into the frame of the other one.
    accepted = graph.join_components(decision.moving, decision.T_stay_moving, decision.scale, decision.edges)
    for edge in accepted:
        changes.outcomes.append(LoopClosureAccepted(a=edge.a, b=edge.b))
        changes.mark_moved(edge.a, edge.b)
    # 2. Decide about the newest pending loop closures that are now within the joined component.
    components, joined = graph.components, graph.components[accepted[0].a]
    pending = [(number, graph.edges[number]) for number in graph.pending]
    within = [number for number, edge in pending if components[edge.a] == components[edge.b] == joined]
    _decide_within(graph, within[-MAX_EDGES_AFTER_JOIN:], changes)


def _mark_aliases(graph: MapGraph, numbers: list[int], distance_m: float, changes: GraphChanges) -> None:
    """Mark the ends of loop closures as two places that look the same, and undo the joins that rest on them.

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
        graph.mark_aliased(near.tolist())
    # 2. Reject connections between segments that have too little weight without the marked keyframes.
    for pair, connection in sorted(graph.accepted_edges_by_segments().items()):
        is_fixed = any(graph.edges[number].is_fixed for number in connection)
        distinct = [number for number in connection if not _is_at_alias(graph, number)]
        if pair[0] != pair[1] and not is_fixed and total_weight(graph, distinct) < MIN_SUPPORT:
            _reject(graph, connection, "ambiguous: both ends look like another place", changes)
            for row in pair:
                graph.set_reason(row, _AT_SEVERAL_PLACES)


def _is_at_alias(graph: MapGraph, number: int) -> bool:
    """Return whether an end of a loop closure is at a place that looks like another place of the map."""
    edge = graph.edges[number]
    return edge.a in graph.aliased_keyframes or edge.b in graph.aliased_keyframes


# --- Applying decisions ---


def _is_pending(graph: MapGraph, number: int) -> bool:
    return number in graph.edges and graph.edges[number].state == "pending"


def _accept(graph: MapGraph, numbers: list[int], changes: GraphChanges) -> None:
    for edge in graph.accept_edges(numbers):
        changes.outcomes.append(LoopClosureAccepted(a=edge.a, b=edge.b))
        changes.mark_moved(edge.a, edge.b)


def _reject(graph: MapGraph, numbers: list[int], reason: str, changes: GraphChanges) -> None:
    for edge in graph.reject_edges(numbers):
        changes.outcomes.append(LoopClosureRejected(a=edge.a, b=edge.b, reason=reason))
        changes.mark_moved(edge.a, edge.b)


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


def exclude_if_contradicting(
    graph: MapGraph, keyframe: int, changes: GraphChanges, *, is_scale_wrong: bool
) -> bool:
    """Record whether *keyframe* contradicts the map, and exclude its segment at 16 of 32 contradictions.

    A keyframe contradicts the map if all its loop closures of full weight within its component do and none
    was accepted, or if its metric scale is wrong, which counts twice.  Loop closures at perceptual aliases
    are no contradiction.  Without such loop closures and with a right scale, nothing is recorded.

    Args:
        graph: The graph; the exclusion takes the loop closures of the segment out of it.
        keyframe: The keyframe whose loop closures were just processed.
        changes: How its loop closures fitted the graph; receives the outcome of an exclusion.
        is_scale_wrong: Whether its metric scale differs from that of other robots.

    Returns:
        Whether the segment was excluded now.
    """
    row, segment = int(graph.segment_rows[keyframe]), graph.segment_of(keyframe)
    if not (changes.fits or is_scale_wrong) or segment.is_excluded or segment.is_from_version:
        return False
    has_accepted = any(isinstance(outcome, LoopClosureAccepted) for outcome in changes.outcomes)
    is_contrary = is_scale_wrong or (changes.fits == {"contrary"} and not has_accepted)
    contradictions = graph.note_contradiction(
        row, is_contradiction=is_contrary, count=WRONG_SCALE_COUNT if is_scale_wrong else 1
    )
    if contradictions < MAX_CONTRADICTIONS or not is_contrary:
        return False
    reason = f"contradicting: {contradictions} of the last 32 keyframes contradict their own odometry"
    if is_scale_wrong:
        reason = "contradicting: its metres are not those of two other robots"
    graph.exclude_segment(row, reason)
    changes.outcomes.append(Ambiguous(robot=segment.robot, segment=segment.number, reason=reason))
    return True
