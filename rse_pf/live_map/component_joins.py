"""Decide whether the loop closures between two components of a live map join them, and where.

The rule is pairwise consistency maximisation: a join needs a set of loop closures that agree pairwise and
have enough weight.  A set that cannot distinguish two places that look the same (perceptual aliases) joins
nothing.  The functions only read the graph, except that it remembers which pairs were tested.

Source:
    Mangelson et al., Pairwise consistent measurement set maximization for robust multi-robot map merging,
    ICRA 2018.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, median_pose, scaled
from rse_pf.live_map.edge_consistency import (
    MAX_TESTED_EDGES,
    MIN_SUPPORT,
    are_consistent_between_components,
    choose_metric_component,
    choose_testable_edges,
    edge_between_components,
    has_consistent_scale,
    has_enough_support,
    relative_pose_between_components,
    relative_scale,
    total_weight,
)
from rse_pf.live_map.graph import MapGraph
from rse_pf.slam.consistency import find_maximum_clique

__all__ = ["ALIAS_DISTANCE_M", "AmbiguousJoin", "Join", "decide_join", "is_at_alias"]

ALIAS_DISTANCE_M = 1.0
"""Metres from which on two poses count as two places: errors of true loop closures stay far below."""
RIVAL_WEIGHT = 0.5
"""Share of the weight of the best consistent set from which on a second set, which says another place, makes
the join ambiguous."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Join:
    """The component ``moving`` is moved into the frame of another one by ``T_stay_moving`` ``(4, 4)``.

    ``scale`` is the length of its unit in the unit of the other component.  ``edges`` are the numbers of the
    loop closures that agree on this and are accepted.
    """

    moving: int
    T_stay_moving: Array
    scale: float
    edges: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class AmbiguousJoin:
    """The loop closures ``edges`` agree, but may see one of several equal places; ``reason`` says why."""

    edges: list[int]
    reason: str


def decide_join(graph: MapGraph, first: int, second: int) -> Join | AmbiguousJoin | None:
    """Return how pending loop closures join two components, or why not; None if too few of them agree."""
    # 1. Find the largest consistent set of loop closures between both components.
    consistent = _find_consistent_edges(graph, first, second)
    if not has_enough_support(graph, consistent):
        return None
    # 2. Refuse a set that perceptual aliases may explain.
    reason = _find_ambiguity(graph, first, second, consistent)
    if reason:
        return AmbiguousJoin(edges=consistent, reason=reason)
    # 3. Choose the component that stays: that of the map, else the older one; but always the metric one.
    root = graph.root_component()
    is_second = second == root or (first != root and second < first)
    stay, moving = (second, first) if is_second else (first, second)
    if choose_metric_component(graph, stay, moving) != stay:
        stay, moving = moving, stay
    # 4. The median over the loop closures gives scale and pose.
    log_scale = _median_log_scale(graph, consistent, stay)
    T_stay_moving = _median_frame(graph, consistent, stay, log_scale)
    return Join(moving=moving, T_stay_moving=T_stay_moving, scale=math.exp(log_scale), edges=consistent)


def is_at_alias(graph: MapGraph, number: int) -> bool:
    """Return whether an end of a loop closure is at a place that looks like another place of the map."""
    edge = graph.edges[number]
    return edge.a in graph.aliased_keyframes or edge.b in graph.aliased_keyframes


def _find_consistent_edges(
    graph: MapGraph, first: int, second: int, excluded: frozenset[int] = frozenset()
) -> list[int]:
    """Return the largest set of pending loop closures between two components that agree pairwise.

    The set is empty if all of them together have too little weight.  *excluded* ones are left out.
    """
    # 1. Choose the loop closures between both components, with a scale that the graph does not contradict.
    pair = {first, second}
    numbers = [
        number
        for number in graph.pending
        if number not in excluded
        and {graph.component_of(graph.edges[number].a), graph.component_of(graph.edges[number].b)} == pair
    ]
    base = choose_metric_component(graph, first, second)
    numbers = [number for number in numbers if has_consistent_scale(graph, graph.edges[number])]
    # 2. Bound their number; where rooms look the same, those that are left must reach beyond one room.
    if graph.equal_rooms_m:
        numbers = _thin_out(graph, numbers, base, 3.0 * graph.equal_rooms_m / MAX_TESTED_EDGES)
    numbers = choose_testable_edges(graph, numbers)
    if total_weight(graph, numbers) < MIN_SUPPORT:
        return []
    # 3. Test the pairs that were not tested before.
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
    # 4. The largest consistent set is a maximum clique.
    return _find_heaviest_clique(graph, numbers, adjacency)


def _find_heaviest_clique(
    graph: MapGraph, numbers: Sequence[int], adjacency: npt.NDArray[np.bool_]
) -> list[int]:
    """Return a maximum clique of all loop closures, or of those with full weight if it weighs more."""
    full = np.flatnonzero([graph.edges[number].weight == 1.0 for number in numbers])
    of_all = [numbers[row] for row in find_maximum_clique(adjacency).tolist()]
    if len(full) == len(numbers):
        return of_all
    of_full = [numbers[full[row]] for row in find_maximum_clique(adjacency[np.ix_(full, full)]).tolist()]
    return max(of_all, of_full, key=lambda clique: total_weight(graph, clique))


def _thin_out(graph: MapGraph, numbers: list[int], component: int, min_distance_m: float) -> list[int]:
    """Return those of *numbers* whose end in *component* is away from that of the last one returned."""
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
    # 1. Loop closures at known perceptual aliases prove nothing.
    distinct = [number for number in consistent if not is_at_alias(graph, number)]
    if not has_enough_support(graph, distinct):
        return "ambiguous: what it sees is in the map at several places"
    # 2. Where rooms look the same, the loop closures must reach beyond one room on both sides.
    size_m = graph.equal_rooms_m
    metric = [side for side in (first, second) if not graph.has_scales or graph.is_metric(side)]
    if size_m and min((_extent_m(graph, distinct, side) for side in metric), default=0.0) <= size_m:
        return f"ambiguous: what it shares with others lies within {size_m:g} m, the size of equal rooms"
    # 3. A second consistent set of similar weight must say the same place.
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
    """Return the largest distance between the ends of loop closures in *component*, metres."""
    edges = [graph.edges[number] for number in numbers]
    ends = [edge.a if graph.component_of(edge.a) == component else edge.b for edge in edges]
    positions = graph.T_component_camera[ends, :3, 3]
    return float(np.sqrt(((positions[:, None] - positions[None]) ** 2).sum(axis=2).max()))


def _median_log_scale(graph: MapGraph, numbers: list[int], stay: int) -> float:
    """Return the logarithm of the length of the other component's unit in the unit of *stay*."""
    return float(np.median([relative_scale(graph, number, stay)[0] for number in numbers]))


def _median_frame(graph: MapGraph, numbers: list[int], stay: int, log_scale: float) -> Array:
    """Return ``T_stay_moving`` ``(4, 4)``: the median over the poses that single loop closures say.

    The lengths of the moving component are multiplied by the exponential of *log_scale* before.
    """
    poses = []
    for number in numbers:
        edge = relative_pose_between_components(graph, number, stay, log_scale)
        T_moving = graph.T_component_camera[edge.b]
        if log_scale != 0.0:
            T_moving = scaled(T_moving, math.exp(log_scale))
        poses.append(graph.T_component_camera[edge.a] @ edge.T_a_b @ inverse(T_moving))
    return median_pose(np.array(poses))
