"""What new links change: which are believed, which components they join, and which old links they refute."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise

import numpy as np

from rse_pf.geometry import Array, inverse, median_pose, scaled
from rse_pf.live_map.agreement import (
    agreeing_between,
    agreeing_by_odometry,
    has_enough_ends,
    is_strong,
    judge_within,
    scale_into,
    step_into,
    weight_of,
    with_metres,
)
from rse_pf.live_map.events import MeasuredLoopClosure, matrix_of
from rse_pf.live_map.graph import Graph, Segment
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.outcomes import Ambiguous, LoopClosureAccepted, LoopClosureRejected, Outcome
from rse_pf.live_map.smoothing import SmoothedWindows, odometry_step, smooth_around

__all__ = [
    "Changes",
    "disbelieve_contradicting",
    "has_jumped",
    "has_other_metres",
    "judge_again",
    "judge_links",
    "smooth_changes",
]

_DOUBTFUL = 30.0
"""Squared misfit of a link, six degrees of freedom: one true link in 25,000 has more."""
_JUDGED_AFTER_JOIN = 48
_NEIGHBOURS = 4
_FIXED = 1e9
"""Weight of links that are never removed."""
_CONTRADICTIONS = 16
"""Of the last 32 keyframes of a robot, those with other metres twice; honest robots, also with 10 % of wheel
slip, stay far below."""


@dataclass(slots=True)
class Changes:
    """Changes of links: their outcomes, and the keyframes around which the graph must be smoothed."""

    outcomes: list[Outcome] = field(default_factory=list)
    moved: list[int] = field(default_factory=list)
    verdicts: set[str] = field(default_factory=set)
    """What links within one component were: "agrees", "vague", "contrary", or "lookalike"."""

    def touch(self, *keyframes: int) -> None:
        """Note keyframes to smooth around, each once."""
        self.moved += [i for i in keyframes if i not in self.moved]


def judge_links(graph: Graph, keyframe: int, numbers: list[int], options: LiveMapOptions) -> Changes:
    """Judge the new links *numbers* of *keyframe*: believe, join, or refute; the graph changes."""
    changes = Changes()
    here = graph.component_of(keyframe)
    others = {number: _other_end(graph, number, keyframe) for number in numbers}
    within = [number for number in numbers if graph.component_of(others[number]) == here]
    _judge_within(graph, _strongest(graph, within, options), options, changes)
    for component in sorted({graph.component_of(i) for i in others.values()} - {here}):
        _try_join(graph, graph.component_of(keyframe), component, options, changes)
    return changes


def _strongest(graph: Graph, numbers: list[int], options: LiveMapOptions) -> list[int]:
    """Return the links of one keyframe without those beside a strong one to the same segment.

    They would tell nothing new, at the cost of another judgement.
    """
    strong = [number for number in numbers if is_strong(graph, number, options)]
    tied = {int(graph.of_segment[graph.links[number].b]) for number in strong}
    return [n for n in numbers if n in strong or int(graph.of_segment[graph.links[n].b]) not in tied]


def judge_again(graph: Graph, options: LiveMapOptions) -> Iterator[Changes]:
    """Judge all links that are not believed as if they came now, oldest first; yield what changed, in parts.

    What was refuted, called ambiguous or taken for a lookalike is open again before, so what rests on links
    that are gone is not believed any more.  The caller smooths around each part.
    """
    graph.reopen()
    for segment in graph.segments:
        if segment.told is None and not segment.disbelieved:
            segment.reason = Segment(robot="", segment=0).reason
    for keyframe, numbers in groupby(list(graph.open), lambda number: graph.links[number].a):
        left = [number for number in numbers if number in graph.links and graph.links[number].state == "open"]
        if left:
            changes = judge_links(graph, keyframe, left, options)
            if changes.outcomes or changes.moved:
                yield changes


def has_other_metres(
    graph: Graph, keyframe: int, links: Iterable[MeasuredLoopClosure], options: LiveMapOptions
) -> bool:
    """Return whether the metres of *keyframe* are not those of all other robots that it is compared with.

    These must be two or more, and differ from it alike: of two robots nobody knows which one is wrong.
    """
    own, signs = graph.keyframes[keyframe].robot, dict[tuple[str, bool], set[float]]()
    for link in links:
        other = graph.segment_of(link.other)
        is_strong = options.strong.weight_of(link.inliers, link.matches) == 1.0
        if other.is_metric and graph.keyframes[link.other].robot != own and is_strong:
            seen = signs.setdefault((graph.keyframes[link.other].robot, other.version), set())
            seen.add(math.copysign(1.0, link.off_scale) if link.off_scale else 0.0)
    return len(signs) > 1 and len(set().union(*signs.values())) == 1 and {0.0} not in signs.values()


def has_jumped(
    graph: Graph, keyframe: int, links: Iterable[MeasuredLoopClosure], options: LiveMapOptions
) -> bool:
    """Return whether the odometry of *keyframe* is far from where all of its latest neighbours see it.

    They saw the same place just before, so these are no two places that look the same.
    """
    segment = graph.segment_of(keyframe)
    if segment.version or not segment.is_metric:
        return False
    place = bisect_left(segment.keyframes, keyframe)
    before = set(segment.keyframes[max(0, place - _NEIGHBOURS) : place])
    are_off = []
    for link in links:
        if link.other in before and options.strong.weight_of(link.inliers, link.matches) == 1.0:
            step = inverse(graph.T_odom[keyframe]) @ graph.T_odom[link.other]
            off = inverse(np.array(matrix_of(link.T_keyframe_other, 4, 4))) @ step
            step_m, off_m = (math.sqrt(float(each[:3, 3] @ each[:3, 3])) for each in (step, off))
            are_off.append(off_m > max(options.lookalike_m, 0.5 * step_m))
    return bool(are_off) and all(are_off)


def disbelieve_contradicting(
    graph: Graph, keyframe: int, changes: Changes, *, has_other_metres: bool = False
) -> bool:
    """Note whether all links of *keyframe* contradict the map; say if its segment is disbelieved from now on.

    Links of an honest robot contradict its odometry for a few keyframes, until they are believed, or prove
    that two places look alike; places that are known to do so count for nothing here.
    """
    segment = graph.segments[int(graph.of_segment[keyframe])]
    if not (changes.verdicts or has_other_metres) or segment.disbelieved or segment.version:
        return False
    is_contrary = has_other_metres or (
        changes.verdicts == {"contrary"}
        and not any(isinstance(each, LoopClosureAccepted) for each in changes.outcomes)
    )
    # What two robots measure tells more than what the map predicts.
    noted = 2 if has_other_metres else 1
    bits = (1 << noted) - 1 if is_contrary else 0
    segment.contradictions = ((segment.contradictions << noted) | bits) & 0xFFFFFFFF
    count = segment.contradictions.bit_count()
    if count < _CONTRADICTIONS or not is_contrary:
        return False
    graph.disbelieve(int(graph.of_segment[keyframe]))
    segment.reason = f"contradicting: {count} of the last 32 keyframes contradict their own odometry"
    if has_other_metres:
        segment.reason = "contradicting: its metres are not those of two other robots"
    changes.outcomes.append(Ambiguous(robot=segment.robot, segment=segment.segment, reason=segment.reason))
    return True


def smooth_changes(
    graph: Graph, changes: Changes, options: LiveMapOptions, robot: str | None = None
) -> SmoothedWindows | None:
    """Smooth around what changed, and remove links that contradict the graph for long; None if nothing moved.

    *robot* is whose keyframe is the cause.  Where it caused too much before, the window is the smallest one,
    and a whole optimisation does the rest.
    """
    used = graph.smoothing.get(robot, 0) if robot is not None else 0
    if used >= options.smoothing_most:
        options = replace(options, windows=options.windows[:1])
    window, smoothed = None, 0
    if changes.moved:
        window = smooth_around(graph, changes.moved, graph.anchors(), options)
        smoothed = window.keyframes
        if _remove_doubted(graph, window.squares, options, changes):
            window = smooth_around(graph, changes.moved, graph.anchors(), options)
            smoothed += window.keyframes
    if robot is not None and (used or smoothed > options.smoothing_each):
        graph.smoothing[robot] = max(0, used + smoothed - options.smoothing_each)
    return window


def _remove_doubted(
    graph: Graph, squares: dict[int, float], options: LiveMapOptions, changes: Changes
) -> bool:
    """Count the updates in which links contradicted the graph, remove those with too many; say if there were.

    *squares* has the squared misfit of each believed link that was smoothed.
    """
    gone = []
    for number, square in squares.items():
        link = graph.links[number]
        link.doubts = link.doubts + 1 if square > _DOUBTFUL and not link.fixed else 0
        if link.doubts >= options.doubts:
            gone.append(number)
    _remove(graph, gone, "contrary to the graph", changes)
    return bool(gone)


def _judge_within(graph: Graph, numbers: list[int], options: LiveMapOptions, changes: Changes) -> None:
    walks: dict[int, dict[int, float]] = {}
    for number in numbers:
        link = graph.links[number]
        if link.a not in walks:
            ends = [graph.links[each].b for each in numbers if graph.links[each].a == link.a]
            walks[link.a] = graph.walks(link.a, ends)
    if not numbers:
        return
    walked = [walks[graph.links[number].a][graph.links[number].b] for number in numbers]
    verdicts = judge_within(graph, numbers, walked, options)
    changes.verdicts |= {
        "lookalike" if _is_lookalike(graph, number) else verdict
        for number, verdict in zip(numbers, verdicts, strict=True)
        if is_strong(graph, number, options)
    }
    agreeing = [number for number, verdict in zip(numbers, verdicts, strict=True) if verdict == "agrees"]
    _believe(graph, [number for number in agreeing if is_strong(graph, number, options)], changes)
    for number in agreeing:
        if graph.links[number].state == "open" and not _has_strong_beside(graph, number, options):
            _believe(graph, [number], changes)
    for number, verdict in zip(numbers, verdicts, strict=True):
        if verdict == "agrees" or number not in graph.links or graph.links[number].state != "open":
            continue
        link = graph.links[number]
        if graph.component_of(link.a) != graph.component_of(link.b):
            continue
        if verdict == "vague":
            agreeing = agreeing_by_odometry(graph, number, _open_beside(graph, number), options)
            if has_enough_ends(graph, agreeing, options):
                _believe(graph, agreeing, changes)
        else:
            _refute(graph, number, options, changes)


def _has_strong_beside(graph: Graph, number: int, options: LiveMapOptions) -> bool:
    """Return whether a strong believed link ties a keyframe of a link to the segment of the other one."""
    link = graph.links[number]
    for one, other in ((link.a, link.b), (link.b, link.a)):
        for each in graph.links_at(one):
            beside = graph.links[each]
            end = beside.b if beside.a == one else beside.a
            if graph.of_segment[end] == graph.of_segment[other] and is_strong(graph, each, options):
                return True
    return False


def _refute(graph: Graph, number: int, options: LiveMapOptions, changes: Changes) -> None:
    """Remove believed links that fewer links support than those that agree with the contrary *number*.

    Where many support both, what two robots saw together is at two places that look the same.
    """
    agreeing = agreeing_by_odometry(graph, number, _open_beside(graph, number), options)
    if not has_enough_ends(graph, agreeing, options):
        return
    link = graph.links[number]
    one, other = int(graph.of_segment[link.a]), int(graph.of_segment[link.b])
    reason = f"{len(agreeing)} later links agree with each other and contradict it"
    if one == other:
        apart_m = _apart_m(graph, number)
        walked = abs(float(graph.way[link.a] - graph.way[link.b]))
        if apart_m > max(options.lookalike_m, walked * options.spacing_m * options.worst_drift):
            _note_lookalikes(graph, agreeing, apart_m, options, changes)
            return
        contrary = [
            each for each in _loops(graph, one)
            if each not in agreeing_by_odometry(graph, number, [each], options)
        ]  # fmt: skip
        if contrary and weight_of(graph, contrary, options) < weight_of(graph, agreeing, options):
            _remove(graph, contrary, reason, changes)
            _believe(graph, agreeing, changes)
        return
    if _is_lookalike(graph, number):
        return
    refuted = False
    while graph.segments[one].component == graph.segments[other].component:
        weakest = _weakest_bridge(graph, one, other, options)
        if not weakest or weight_of(graph, weakest, options) >= weight_of(graph, agreeing, options):
            break
        _remove(graph, weakest, reason, changes)
        refuted = True
    if refuted and graph.segments[one].component != graph.segments[other].component:
        _try_join(graph, graph.segments[one].component, graph.segments[other].component, options, changes)
    elif not refuted and weight_of(graph, agreeing, options) >= options.lookalike_links:
        apart_m, walked = _off_m(graph, number), graph.walks(link.a, [link.b])[link.b]
        if apart_m > max(options.lookalike_m, walked * options.spacing_m * options.worst_drift):
            _note_lookalikes(graph, agreeing, apart_m, options, changes)


def _loops(graph: Graph, row: int) -> list[int]:
    """Return the believed links within a segment."""
    return [
        number for number, link in graph.links.items()
        if link.state == "believed" and not link.fixed
        and graph.of_segment[link.a] == graph.of_segment[link.b] == row
    ]  # fmt: skip


def _apart_m(graph: Graph, number: int) -> float:
    """Return by how much odometry contradicts a link within a segment."""
    link = graph.links[number]
    from_a, to_b = graph.odometry([link.a, link.b])
    off = inverse(graph.step_of(link)) @ inverse(from_a) @ to_b
    return float(np.sqrt((off[:3, 3] ** 2).sum()))


def _off_m(graph: Graph, number: int) -> float:
    """Return by how much the graph contradicts a link."""
    link = graph.links[number]
    off = inverse(graph.step_of(link)) @ inverse(graph.T[link.a]) @ graph.T[link.b]
    return float(np.sqrt((off[:3, 3] ** 2).sum()))


def _weakest_bridge(graph: Graph, one: int, other: int, options: LiveMapOptions) -> list[int]:
    """Return the lightest links that connect two segments on the heaviest path between *one* and *other*.

    Links of the version that the map started from are never removed, nor those between two segments in metres
    if *one* or *other* is not: a segment whose scale is unknown says nothing against known ones.
    """
    bridges = {pair: numbers for pair, numbers in graph.bridges().items() if pair[0] != pair[1]}
    of_metres = _are_metric(graph, one, other)
    strength = {
        pair: _FIXED
        if any(graph.links[n].fixed for n in numbers) or (_are_metric(graph, *pair) and not of_metres)
        else weight_of(graph, numbers, options)
        for pair, numbers in bridges.items()
    }
    for least in sorted(set(strength.values()), reverse=True):
        path = _path(one, other, [pair for pair in strength if strength[pair] >= least])
        if path:
            pair = min(path, key=lambda each: (strength[each], each))
            return [] if strength[pair] == _FIXED else bridges[pair]
    return []


def _are_metric(graph: Graph, *rows: int) -> bool:
    return all(graph.segments[row].is_metric for row in rows)


def _path(one: int, other: int, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs on the shortest path, [] if there is none."""
    came: dict[int, tuple[int, tuple[int, int]]] = {one: (one, (one, one))}
    front = [one]
    while front and other not in came:
        following = []
        for row in front:
            for pair in sorted(pairs):
                if row in pair:
                    beyond = pair[1] if pair[0] == row else pair[0]
                    if beyond not in came:
                        came[beyond] = (row, pair)
                        following.append(beyond)
        front = following
    path = []
    while other in came and other != one:
        other, pair = came[other]
        path.append(pair)
    return path


def _try_join(graph: Graph, one: int, other: int, options: LiveMapOptions, changes: Changes) -> None:
    """Join two components if enough open links between them agree."""
    agreeing = agreeing_between(graph, one, other, options)
    if not has_enough_ends(graph, agreeing, options):
        return
    reason = _ambiguity(graph, one, other, agreeing, options)
    if reason:
        _call_ambiguous(graph, agreeing, reason, changes)
        return
    root = graph.segments[graph.root].component if graph.root >= 0 else -1
    stay, moving = (other, one) if other == root or (one != root and other < one) else (one, other)
    stay, moving = (stay, moving) if with_metres(graph, stay, moving) == stay else (moving, stay)
    log_scale = _scale_of_moving(graph, agreeing, stay)
    T_stay_moving = median_pose(np.array([_proposed(graph, number, stay, log_scale) for number in agreeing]))
    for segment in graph.segments:
        if segment.component == moving and segment.keyframes:
            _move(graph, segment, T_stay_moving, math.exp(log_scale), options)
    _believe(graph, agreeing, changes)
    graph.connect()
    graph.forget_agreements()
    joined = graph.segments[min(stay, moving)].component
    beside = [
        number for number in graph.open
        if graph.component_of(graph.links[number].a) == graph.component_of(graph.links[number].b) == joined
    ]  # fmt: skip
    _judge_within(graph, beside[-_JUDGED_AFTER_JOIN:], options, changes)


def _scale_of_moving(graph: Graph, numbers: list[int], stay: int) -> float:
    """Return the logarithm of how long the unit of the component that joins *stay* is in that, by links."""
    return float(np.median([scale_into(graph, number, stay)[0] for number in numbers]))


def _move(
    graph: Graph, segment: Segment, T_stay_moving: Array, scale: float, options: LiveMapOptions
) -> None:
    """Express a segment in another frame, its lengths multiplied by *scale*."""
    ids = segment.keyframes
    if scale == 1.0:
        graph.T[ids] = T_stay_moving @ graph.T[ids]
        return
    graph.T[ids] = T_stay_moving @ scaled(graph.T[ids], scale)
    segment.scale *= scale
    # Steps of the noise are metres, too.
    for last, here in pairwise(ids):
        step = scaled(inverse(graph.T_odom[last]) @ graph.T_odom[here], segment.scale)
        graph.way[here] = graph.way[last] + odometry_step(step, options)


def _ambiguity(graph: Graph, one: int, other: int, agreeing: list[int], options: LiveMapOptions) -> str:
    """Return why links that agree cannot tell which of several equal places is seen, "" if they can."""
    telling = [number for number in agreeing if not _is_lookalike(graph, number)]
    if not has_enough_ends(graph, telling, options):
        return "ambiguous: what it sees is in the map at several places"
    size_m = graph.equal_rooms_m
    sides = [side for side in (one, other) if not graph.has_scales or graph.is_metric(side)]
    if size_m and min((_spread_m(graph, telling, side) for side in sides), default=0.0) <= size_m:
        return f"ambiguous: what it shares with others lies within {size_m:g} m, the size of equal rooms"
    rivals = agreeing_between(graph, one, other, options, frozenset(agreeing))
    are_many = 2.0 * weight_of(graph, rivals, options) >= weight_of(graph, agreeing, options)
    if are_many and has_enough_ends(graph, rivals, options):
        stay = with_metres(graph, one, other)
        first, second = (
            median_pose(
                np.array([_proposed(graph, n, stay, _scale_of_moving(graph, each, stay)) for n in each])
            )
            for each in (agreeing, rivals)
        )
        if float(np.sqrt(((first - second)[:3, 3] ** 2).sum())) > options.lookalike_m:
            return f"ambiguous: {len(agreeing)} links say one place, {len(rivals)} another"
    return ""


def _spread_m(graph: Graph, numbers: list[int], side: int) -> float:
    """Return how far the keyframes of links in component *side* are apart at most."""
    ends = [(graph.links[number].a, graph.links[number].b) for number in numbers]
    at = graph.T[[a if graph.component_of(a) == side else b for a, b in ends], :3, 3]
    return float(np.sqrt(((at[:, None] - at[None]) ** 2).sum(axis=2).max()))


def _call_ambiguous(graph: Graph, numbers: list[int], reason: str, changes: Changes) -> None:
    """Tell the newest of the segments that links would have joined why it is not aligned."""
    root = graph.segments[graph.root].component if graph.root >= 0 else -1
    for i in sorted({end for n in numbers for end in (graph.links[n].a, graph.links[n].b)}, reverse=True):
        segment = graph.segments[int(graph.of_segment[i])]
        if segment.component != root and segment.reason != reason:
            segment.reason = reason
            changes.outcomes.append(Ambiguous(robot=segment.robot, segment=segment.segment, reason=reason))


def _note_lookalikes(
    graph: Graph, numbers: list[int], apart_m: float, options: LiveMapOptions, changes: Changes
) -> None:
    """Note two places that look the same but are *apart_m* apart; undo the joins that rest on them.

    All that is nearer to them than half of that may have a twin, too.
    """
    radius_m = min(0.5 * apart_m, options.lookalike_most_m)
    ends = [end for number in numbers for end in (graph.links[number].a, graph.links[number].b)]
    here = np.array([graph.component_of(i) if graph.of_segment[i] >= 0 else -1 for i in range(len(graph))])
    for i in sorted(set(ends)):
        off_m = np.sqrt(((graph.T[:, :3, 3] - graph.T[i, :3, 3]) ** 2).sum(axis=1))
        near = np.flatnonzero((off_m < radius_m) & (here == here[i]))
        graph.lookalikes.update(near.tolist())
    for pair, beside in sorted(graph.bridges().items()):
        fixed = any(graph.links[number].fixed for number in beside)
        telling = [number for number in beside if not _is_lookalike(graph, number)]
        if pair[0] != pair[1] and not fixed and weight_of(graph, telling, options) < options.min_links:
            _remove(graph, beside, "ambiguous: both ends look like another place", changes)
            for row in pair:
                graph.segments[row].reason = "ambiguous: what it saw is in the map at several places"


def _is_lookalike(graph: Graph, number: int) -> bool:
    return graph.links[number].a in graph.lookalikes or graph.links[number].b in graph.lookalikes


def _proposed(graph: Graph, number: int, stay: int, log_scale: float) -> Array:
    """Return the pose of the moving component's frame in that of the staying one, by one link.

    The lengths of the moving one are multiplied by the exponential of *log_scale* before.
    """
    ends = step_into(graph, number, stay, log_scale)
    T_moving = graph.T[ends.b] if log_scale == 0.0 else scaled(graph.T[ends.b], math.exp(log_scale))
    T_stay_moving: Array = graph.T[ends.a] @ ends.T_a_b @ inverse(T_moving)
    return T_stay_moving


def _believe(graph: Graph, numbers: list[int], changes: Changes) -> None:
    for number in numbers:
        link = graph.links[number]
        if link.state == "open":
            graph.believe(number)
            changes.outcomes.append(LoopClosureAccepted(a=link.a, b=link.b))
            changes.touch(link.a, link.b)


def _remove(graph: Graph, numbers: list[int], reason: str, changes: Changes) -> None:
    crossed = False
    for number in numbers:
        link = graph.links[number]
        graph.remove_link(number)
        changes.outcomes.append(LoopClosureRejected(a=link.a, b=link.b, reason=reason))
        changes.touch(link.a, link.b)
        crossed |= bool(graph.of_segment[link.a] != graph.of_segment[link.b])
    if crossed:
        graph.connect()
        graph.forget_agreements()


def _open_beside(graph: Graph, number: int) -> list[int]:
    """Return the open links between the same two segments as *number*."""
    link = graph.links[number]
    pair = {int(graph.of_segment[link.a]), int(graph.of_segment[link.b])}
    return [
        each for each in graph.open
        if each != number
        and {int(graph.of_segment[graph.links[each].a]), int(graph.of_segment[graph.links[each].b])} == pair
    ]  # fmt: skip


def _other_end(graph: Graph, number: int, keyframe: int) -> int:
    link = graph.links[number]
    return link.b if link.a == keyframe else link.a
