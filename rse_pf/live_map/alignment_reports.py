"""Report how the alignments of robots' segments with a live map changed.

An alignment ``T_map_odom`` maps from the odometry frame of a segment to the frame of the map.  Poses in the
odometry frame never jump, so a robot can use them in control loops; corrections of the map change the
alignment only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from rse_pf.geometry import Array, inverse
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.graph_rows import UP_TO_SCALE, Segment
from rse_pf.live_map.outcomes import Alignment, Corrected, Joined, Unaligned

__all__ = ["alignment_of", "report_alignments"]

MIN_REPORTED_SHIFT_M = 0.001
"""Metres: a larger change of the translation of ``T_map_odom`` is reported; a smaller one is noise."""
MIN_REPORTED_ROTATION_DEG = 0.05
"""Degrees: a larger change of the rotation of ``T_map_odom`` is reported; it moves a point at 1 m by 1 mm."""
MIN_REPORTED_LOG_SCALE = 0.002
"""A larger change of the natural logarithm of a segment's scale is reported; 0.002 are 0.2 %."""


def report_alignments(
    graph: MapGraph, cause: tuple[str, int] | None, covariances: Mapping[int, Array] = MappingProxyType({})
) -> Iterator[Joined | Corrected | Unaligned]:
    """Yield how the alignments of the robots' newest segments changed since they were last reported.

    An alignment has changed if its translation, its rotation or its scale changed by more than the limit of
    this module since the robot was last sent it.  Only the newest segment of a robot is reported, and only if
    it has keyframes and the robot has not left.

    Args:
        graph: The graph, whose `MapGraph.apply` notes the results as reported.
        cause: The keyframe (robot, number) that caused the changes, None if an optimisation or the removal of
            a robot caused them.
        covariances: By keyframe, the ``(6, 6)`` covariance of a pose that was smoothed.  Without that of the
            newest keyframe of a segment, the covariance that was reported before is reported again.
    """
    for row, T_map_odom, has_changed in _find_alignments(graph):
        segment = graph.segments[row]
        is_reported = segment.reported_T_map_odom is not None
        # 1. Of a segment that is not connected with the map, report only that its alignment was lost.
        if not graph.is_aligned(row):
            if is_reported:
                is_metric = segment.component in graph.metric_components
                default = "the links that aligned it were removed" if is_metric else UP_TO_SCALE
                reason = segment.reason or default
                yield Unaligned(robot=segment.robot, segment=segment.number, reason=reason)
            continue
        # 2. Report that a segment without a reported alignment has one now, or again; leave out a segment
        #    whose reported alignment has not changed.
        if not is_reported:
            connections = graph.accepted_edges_by_segments().items()
            count = sum(len(numbers) for pair, numbers in connections if row in pair)
            yield Joined(robot=segment.robot, segment=segment.number, links=count)
        elif not has_changed:
            continue
        # 3. Report the new alignment.
        yield Corrected(
            robot=segment.robot,
            segment=segment.number,
            T_map_odom=T_map_odom,
            covariance=covariances.get(segment.keyframes[-1], segment.covariance),
            cause=cause,
            scale=None if segment.is_metric else segment.scale,
        )


def alignment_of(segment: Segment) -> Alignment:
    """Return the alignment that the robot was last sent for *segment*, or the reason why there is none."""
    is_aligned = segment.reported_T_map_odom is not None
    return Alignment(
        robot=segment.robot,
        segment=segment.number,
        aligned=is_aligned,
        reason=segment.reason,
        T_map_odom=segment.reported_T_map_odom,
        covariance=segment.covariance if is_aligned else None,
        scale=segment.reported_scale if is_aligned and not segment.is_metric else None,
    )


def _find_alignments(graph: MapGraph) -> list[tuple[int, Array, bool]]:
    """Return (row, ``T_component_odom``, whether it changed since the last report) of each newest segment.

    Segments without keyframes are left out.  ``T_component_odom`` ``(4, 4)`` maps from the odometry frame to
    the frame of the segment's component; it is ``T_map_odom`` if the component is that of the map.  The third
    value has no meaning if the robot was never sent an alignment of the segment.
    """
    rows = [row for row in graph.newest_segments.values() if graph.segments[row].keyframes]
    # 1. The pose of the newest keyframe in the map and in its odometry frame give the alignment.
    newest = [graph.segments[row].keyframes[-1] for row in rows]
    T = graph.T_component_camera[newest] @ inverse(graph.odometry_poses(newest))
    reported = T.copy()
    for index, row in enumerate(rows):
        T_reported = graph.segments[row].reported_T_map_odom
        if T_reported is not None:
            reported[index] = T_reported
    # 2. Compare the alignments with those that the robots were last sent.
    moved2_m2 = ((T[:, :3, 3] - reported[:, :3, 3]) ** 2).sum(axis=1)
    traces = (T[:, :3, :3] * reported[:, :3, :3]).sum(axis=(1, 2))
    min_trace = 1.0 + 2.0 * math.cos(math.radians(MIN_REPORTED_ROTATION_DEG))
    has_changed = (moved2_m2 > MIN_REPORTED_SHIFT_M**2) | (traces < min_trace)
    if graph.has_scales:
        scales = [(graph.segments[row].scale, graph.segments[row].reported_scale) for row in rows]
        changes = [abs(math.log(scale / before)) > MIN_REPORTED_LOG_SCALE for scale, before in scales]
        has_changed |= np.array(changes, dtype=np.bool_)
    return list(zip(rows, T, has_changed.tolist(), strict=True))
