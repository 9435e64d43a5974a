"""Which measured links are believed: those that agree with others, and with the graph.

Links between two connected components are compared pairwise, links within one with what the graph says.
Links that contradict the graph, but not each other, are evidence against those that were believed before.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, scaled
from rse_pf.live_map.graph import Graph, LiveLink
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.slam.consistency import (
    LinkEnds,
    fits_prediction,
    largest_clique,
    round_trips_close,
    scale_fits,
)

__all__ = [
    "agreeing_between",
    "agreeing_by_odometry",
    "has_enough_ends",
    "is_strong",
    "judge_within",
    "scale_into",
    "step_into",
    "weight_of",
    "with_metres",
]

_CONTRARY_LINKS = 24
_KNOWN_SCALE = 0.03
"""Deviation of the logarithm of a scale that a graph knows: the first links leave 1 to 3 %."""


def agreeing_between(
    graph: Graph, one: int, other: int, options: LiveMapOptions, leave_out: frozenset[int] = frozenset()
) -> list[int]:
    """Return the numbers of the largest set of open links between two components that agree pairwise.

    Two links agree if the round trip over both is the identity, as `round_trips_close` says; the
    poses within a component are those of the graph.  Links whose agreement is known are not compared again.

    Where one of the components has no metres, two links agree if their scales do, too.

    Source:
        Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018.
    """
    pair = {one, other}
    numbers = [
        number for number in graph.open
        if number not in leave_out
        and {graph.component_of(graph.links[number].a), graph.component_of(graph.links[number].b)} == pair
    ]  # fmt: skip
    one = with_metres(graph, one, other)
    numbers = _of_fitting_scale(graph, numbers, options)
    if graph.equal_rooms_m:
        # So that the links that are tested reach farther than a room.
        numbers = _spread(graph, numbers, one, 3.0 * graph.equal_rooms_m / options.tested_links)
    numbers = _tested(graph, numbers, options)
    if weight_of(graph, numbers, options) < options.min_links:
        return []
    for place, number in enumerate(numbers):
        unknown = [each for each in numbers[:place] if (each, number) not in graph.agreements]
        if unknown:
            for each, agrees in zip(unknown, _compare(graph, number, unknown, one, options), strict=True):
                graph.agreements[each, number] = agrees
    agree = np.zeros((len(numbers), len(numbers)), dtype=np.bool_)
    for j, later in enumerate(numbers):
        for i, earlier in enumerate(numbers[:j]):
            agree[i, j] = agree[j, i] = graph.agreements[earlier, later]
    return _heaviest(graph, numbers, agree, options)


def has_enough_ends(graph: Graph, numbers: Sequence[int], options: LiveMapOptions) -> bool:
    """Return whether links weigh enough, and are from different keyframes on both sides.

    The sides are components; or segments, within one component; or the keyframes that were measured and those
    they were compared with, within one segment.
    """
    if weight_of(graph, numbers, options) < options.min_links:
        return False
    first = graph.links[numbers[0]]
    is_within = graph.component_of(first.a) == graph.component_of(first.b)
    row, component = int(graph.of_segment[first.a]), graph.component_of(first.a)
    measured: set[int] = set()
    others: set[int] = set()
    for number in numbers:
        a, b = graph.links[number].a, graph.links[number].b
        on_side = graph.of_segment[a] == row if is_within else graph.component_of(a) == component
        measured.add(a if on_side else b)
        others.add(b if on_side else a)
    return min(len(measured), len(others)) >= options.min_ends


def weight_of(graph: Graph, numbers: Iterable[int], options: LiveMapOptions) -> float:
    """Return how much links count together: 1 for each that is strong, less for others."""
    return sum(graph.links[number].weight(options.strong) for number in numbers)


def is_strong(graph: Graph, number: int, options: LiveMapOptions) -> bool:
    """Return whether a link counts whole."""
    return graph.links[number].weight(options.strong) == 1.0


def judge_within(
    graph: Graph, numbers: Sequence[int], walked: Sequence[float], options: LiveMapOptions
) -> list[str]:
    """Compare links within one component with the graph: "agrees", "contrary", or "vague" for each.

    The graph is vague where the way between both ends, *walked* steps, is long.
    """
    links = [graph.links[number] for number in numbers]
    predicted = inverse(graph.T[[link.a for link in links]]) @ graph.T[[link.b for link in links]]
    fitting = set(_of_fitting_scale(graph, numbers, options, walked))
    steps = np.maximum(np.array(walked), 1.0)
    # On a round way of a given length no point is farther than its diameter.
    apart_m = np.sqrt((predicted[:, :3, 3] ** 2).sum(axis=1))
    lever_m = np.maximum(apart_m, options.spacing_m * steps / math.pi)
    measured = _ends_of([_oriented(graph, link, True) for link in links])
    agrees = fits_prediction(predicted, measured, steps, lever_m, options.judged)
    agrees &= np.array([number in fitting for number in numbers], dtype=np.bool_)
    return [
        "contrary" if not ok else "vague" if far else "agrees"
        for ok, far in zip(agrees.tolist(), (steps > options.vague_steps).tolist(), strict=True)
    ]


def with_metres(graph: Graph, one: int, other: int) -> int:
    """Return which of two components the other one is expressed in: the first, or the one with metres."""
    return other if graph.has_scales and graph.is_metric(other) and not graph.is_metric(one) else one


def scale_into(graph: Graph, number: int, stay: int) -> tuple[float, float]:
    """Return the logarithm of how long the unit of a link's other component is in that of *stay*.

    And its variance; both are 0 where both components are metric, so that nothing is to be measured.
    """
    link = graph.links[number]
    a, b = graph.segment_of(link.a), graph.segment_of(link.b)
    if link.scale is None or (graph.is_metric(a.component) and graph.is_metric(b.component)):
        return 0.0, 0.0
    log_ratio = link.scale[0] + math.log(a.scale / b.scale)
    return (log_ratio if a.component == stay else -log_ratio), link.scale[1]


def step_into(graph: Graph, number: int, stay: int, log_scale: float) -> _Ends:
    """Return a link from component *stay* to another one, lengths in the unit of *stay*.

    *log_scale* is how long the unit of the other one is in that.
    """
    link = graph.links[number]
    row, forward = graph.unit_of(link), graph.component_of(link.a) == stay
    length = 1.0 if row < 0 else graph.segments[row].scale * (1.0 if forward else math.exp(log_scale))
    return _directed(link, forward, length)


def agreeing_by_odometry(
    graph: Graph, number: int, numbers: Sequence[int], options: LiveMapOptions
) -> list[int]:
    """Return the largest set of links between two segments that agree pairwise by odometry alone.

    The set holds *number*, or is empty; *numbers* are other links between the same two segments.
    """
    others = _tested(graph, sorted({*numbers} - {number}), options)[-_CONTRARY_LINKS:]
    if not others:
        return [number]
    row, beyond = (int(graph.of_segment[i]) for i in (graph.links[number].a, graph.links[number].b))
    if graph.segments[beyond].is_metric and not graph.segments[row].is_metric:
        row = beyond
    ends = [_ends(graph, each, row) for each in others]
    last = _ends(graph, number, row)
    near = np.flatnonzero(_trips_close(graph, graph.T_odom, ends, last, None, options))
    agree = np.zeros((len(near), len(near)), dtype=np.bool_)
    for j in range(1, len(near)):
        before = [ends[each] for each in near[:j]]
        agree[j, :j] = _trips_close(graph, graph.T_odom, before, ends[near[j]], None, options)
    clique = largest_clique(agree | agree.T) if len(near) else near
    return sorted([number, *(others[near[each]] for each in clique.tolist())])


def _heaviest(
    graph: Graph, numbers: Sequence[int], agree: npt.NDArray[np.bool_], options: LiveMapOptions
) -> list[int]:
    """Return the largest set of *numbers* that agree, or that of the strong ones if it weighs more."""
    strong = np.flatnonzero([is_strong(graph, number, options) for number in numbers])
    every = [numbers[row] for row in largest_clique(agree).tolist()]
    if len(strong) == len(numbers):
        return every
    of_strong = [numbers[strong[row]] for row in largest_clique(agree[np.ix_(strong, strong)]).tolist()]
    return max(every, of_strong, key=lambda each: weight_of(graph, each, options))


class _Ends(NamedTuple):
    """Both ends of a link, the step from one to the other with its variances, and its scale if it has one."""

    a: int
    b: int
    T_a_b: Array
    variances: Array
    scale: tuple[float, float] | None = None


def _of_fitting_scale(
    graph: Graph, numbers: Sequence[int], options: LiveMapOptions, walked: Sequence[float] | None = None
) -> list[int]:
    """Return the links whose scale is that of the graph, where it is known, after *walked* steps."""
    fitting = []
    for place, number in enumerate(numbers):
        link = graph.links[number]
        if link.scale is None:
            fitting.append(number)
            continue
        a, b = graph.segment_of(link.a), graph.segment_of(link.b)
        if a.component != b.component and not all(graph.is_metric(each.component) for each in (a, b)):
            fitting.append(number)
            continue
        steps = 0.0 if walked is None else walked[place]
        variance = link.scale[1] + _KNOWN_SCALE**2 + steps * options.judged.step_scale**2
        off = link.scale[0] + math.log(a.scale / b.scale)
        if scale_fits(np.array(off**2), np.array(variance)):
            fitting.append(number)
    return fitting


def _tested(graph: Graph, numbers: list[int], options: LiveMapOptions) -> list[int]:
    """Return the newest of *numbers*, at most a few for each keyframe, those with most inliers."""
    count: Counter[int] = Counter()
    kept = []
    for number in sorted(numbers, key=lambda each: (-graph.links[each].inliers, each)):
        link = graph.links[number]
        if max(count[link.a], count[link.b]) < options.links_of_keyframe:
            count[link.a] += 1
            count[link.b] += 1
            kept.append(number)
    return sorted(kept)[-options.tested_links :]


def _spread(graph: Graph, numbers: list[int], one: int, least_m: float) -> list[int]:
    """Return those of *numbers* whose end in component *one* is not close to that of the last one taken."""
    taken: list[int] = []
    last = np.full(3, np.inf)
    for number in numbers:
        here = graph.T[_ends_between(graph, number, one)[0], :3, 3]
        if np.abs(here - last).max() >= least_m:
            taken.append(number)
            last = here
    return taken


def _compare(graph: Graph, number: int, others: list[int], one: int, options: LiveMapOptions) -> list[bool]:
    """Return whether each of *others* agrees with link *number*; all connect component *one* with another."""
    last = _ends_between(graph, number, one)
    ends = [_ends_between(graph, each, one) for each in others]
    along_a = graph.walks(last.a, [end.a for end in ends])
    along_b = graph.walks(last.b, [end.b for end in ends])
    return [
        bool(is_close) for is_close in _trips_close(graph, graph.T, ends, last, (along_a, along_b), options)
    ]


def _trips_close(
    graph: Graph, T: Array, ends: Sequence[_Ends], last: _Ends,
    along: tuple[dict[int, float], dict[int, float]] | None, options: LiveMapOptions,
) -> npt.NDArray[np.bool_]:  # fmt: skip
    """Return whether the round trips over link *last* and each of *ends* are close to the identity.

    *along* are the metres from each end of *last* to the keyframes of *ends*; None takes those of the
    odometry.
    """
    links = _ends_of(ends)
    if along is None:
        way_a, way_b = graph.way[links.a] - graph.way[last.a], graph.way[links.b] - graph.way[last.b]
        walked = np.abs(way_a) + np.abs(way_b)
    else:
        walked = np.array([along[0][end.a] + along[1][end.b] for end in ends])
    return round_trips_close(T, links, _ends_of([last]), walked, options.judged)


def _ends_of(ends: Sequence[_Ends]) -> LinkEnds:
    scales = [end.scale for end in ends if end.scale is not None]
    return LinkEnds(
        a=np.array([end.a for end in ends], dtype=np.int64),
        b=np.array([end.b for end in ends], dtype=np.int64),
        T_a_b=np.array([end.T_a_b for end in ends]),
        variances=np.array([end.variances for end in ends]),
        scales=np.array(scales) if scales else None,
    )


def _ends_between(graph: Graph, number: int, one: int) -> _Ends:
    """Return a link from component *one* to another, in the unit of *one*."""
    log_scale, variance = scale_into(graph, number, one)
    ends = step_into(graph, number, one, log_scale)
    return ends._replace(scale=(log_scale, variance)) if variance else ends


def _ends(graph: Graph, number: int, row: int) -> _Ends:
    """Return a link from segment *row*, in the unit of its odometry; that of the other end is apart."""
    link = graph.links[number]
    forward = int(graph.of_segment[link.a]) == row
    if link.scale is None or graph.of_segment[link.a] == graph.of_segment[link.b]:
        return _directed(link, forward, 1.0)
    log_ratio, variance = link.scale
    log_scale = log_ratio if forward else -log_ratio
    is_in_other = graph.unit_of(link) >= 0 and not forward
    ends = _directed(link, forward, math.exp(log_scale) if is_in_other else 1.0)
    return ends._replace(scale=(log_scale, variance))


def _oriented(graph: Graph, link: LiveLink, forward: bool) -> _Ends:
    """Return a link within one component, in the unit of that."""
    row = -1 if link.scale is None else graph.unit_of(link)
    return _directed(link, forward, 1.0 if row < 0 else graph.segments[row].scale)


def _directed(link: LiveLink, forward: bool, length: float) -> _Ends:
    """Return both ends of a link, its step from the first to the second times *length*, and its variances."""
    T_a_b, variances = link.T_a_b, link.variances
    if length != 1.0:
        T_a_b, variances = scaled(T_a_b, length), variances * np.array([length**2] * 3 + [1.0] * 3)
    if forward:
        return _Ends(link.a, link.b, T_a_b, variances)
    return _Ends(link.b, link.a, inverse(T_a_b), variances)
