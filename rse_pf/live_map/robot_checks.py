"""Decide whether a robot's odometry or metric scale contradicts the other robots of a live map.

Such a robot is excluded: its keyframes stay, but its loop closures are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from rse_pf.geometry import inverse
from rse_pf.live_map.events import MeasuredLoopClosure, matrix_of
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.outcomes import Ambiguous, LoopClosureAccepted
from rse_pf.live_map.outlier_rejection import GraphChanges
from rse_pf.live_map.pairwise_consistency import ALIAS_DISTANCE_M
from rse_pf.slam.consistency import evidence_weight

__all__ = ["exclude_if_contradicting", "has_odometry_jump", "has_wrong_scale"]

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
