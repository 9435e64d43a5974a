"""The pose graph of a live map: keyframes, segments of odometry, and loop closures between them.

Vertices are the poses of keyframes.  Edges are the odometry between consecutive keyframes of a segment, and
accepted loop closures.  A *segment* holds the keyframes that one robot made in one odometry frame.  Segments
that accepted loop closures connect form a *component*, which has one frame and one unit of length.  The
*map* that robots are aligned with, and that is published, is one of the components; the others may join it.

`MapGraph` owns all tables and keeps them consistent; other modules of this package read them, and change them
through its methods only.  Nothing here decides which loop closures are right: `outlier_rejection` does.
All numbers depend on the order of the events only, so that a replay gives equal bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, rotation_angle_deg, scaled
from rse_pf.live_map.decisions import (
    AcceptEdges,
    AddEdges,
    Decision,
    ExcludeSegment,
    JoinComponents,
    MarkAliases,
    RecordContradictions,
    RecordMisfits,
    RejectEdges,
    StateReason,
)
from rse_pf.live_map.events import KeyframeAdded, MapStarted, MeasuredLoopClosure, matrix_of
from rse_pf.live_map.graph_rows import NO_LOOP_CLOSURE_YET, UP_TO_SCALE, LiveKeyframe, LoopEdge, Segment
from rse_pf.live_map.measure import assumed_scale
from rse_pf.live_map.outcomes import (
    Ambiguous,
    Corrected,
    Joined,
    LoopClosureAccepted,
    LoopClosureRejected,
    Outcome,
    Unaligned,
)

__all__ = ["STEP_LENGTH_M", "MapGraph"]

STEP_LENGTH_M = 0.25  # metres of motion that are one step of odometry; `OdometryNoise` is the drift of a step
STEP_ROTATION_DEG = 15.0  # degrees of rotation that are one step of odometry, as 0.25 m are
MIN_STEP = 0.05  # steps of odometry that a motion counts as, at least: a stationary robot has some variance
MAX_PENDING_EDGES = 400
"""Most pending loop closures of a map, to bound CPU time.  `MapGraph.drop_oldest_pending` rejects the oldest
ones beyond this number; like all rejected ones, they are decided again after a robot was forgotten or
excluded."""
MAX_REJECTED_EDGES = 2000
"""Most rejected loop closures of a map; those that were rejected first are deleted beyond this number.  A map
decides about them again after a robot was forgotten or excluded; the limit bounds memory and the time of
these decisions."""
MAX_ORPHANED_OBJECTS = 10_000
"""Most objects of forgotten robots in the list of objects to delete; the oldest entries beyond this number
are dropped from the list, and their objects stay in the store unless they were deleted before."""
INHERITED_CONTRADICTIONS = 0xFFFF
"""Bit mask of `Segment.contradictions`: a new segment of a robot inherits the newest 16 bits of its last one,
so that a hostile robot does not start without a record by opening a segment."""


class MapGraph:
    """The pose graph of a live map, and the only writer of its tables.

    Attributes:
        keyframes: All keyframes by id.  The id of a keyframe is its position in order of arrival.
        segments: All segments by row; a segment is never removed, but may have no keyframes any more.
        edges: Pending and accepted loop closures by number; numbers count in the order of measurement.
        pending: Numbers of the pending loop closures, oldest first.
        rejected: The newest rejected loop closures by number, which `reopen_rejected` makes pending again
            after a robot was forgotten or excluded, since its evidence may have rejected them.
        pair_consistency: By the numbers of two pending loop closures, the lower first: whether both agree
            with each other.  Pairs that were not tested are missing.
        next_edge: Number that the next added loop closure gets.
        root: Row of the segment whose first keyframe defines the frame of the map, -1 while there is none.
        events: Number of events that were applied.
        next_numbers: Number that the next keyframe of each robot must have.
        newest_segments: Row of the newest segment of each robot that has not left.
        optimised_at: Number of keyframes when an optimisation of the whole graph was last requested.
        smoothing_debt: By robot, the keyframes that were smoothed because of its events beyond
            `LiveMapOptions.smoothing_allowance`; an event for which fewer are smoothed lowers the number.
        aliased_keyframes: Keyframes at places that look like another place of the map (perceptual aliases).
        source: Name of the version that the map started from, empty if it started from none.
        equal_rooms_m: Metres: size of rooms that look the same, 0 if every place looks unique.
        orphaned_objects: (robot, digest) of the objects of forgotten robots, the last 10,000 of them.
    """

    def __init__(self, capacity: int = 64) -> None:
        self.keyframes: list[LiveKeyframe] = []
        self.segments: list[Segment] = []
        self.edges: dict[int, LoopEdge] = {}
        self.pending: list[int] = []
        self.rejected: dict[int, LoopEdge] = {}
        self.pair_consistency: dict[tuple[int, int], bool] = {}
        self.next_edge = 0
        self.root = -1
        self.events = 0
        self.next_numbers: dict[str, int] = {}
        self.newest_segments: dict[str, int] = {}
        self.optimised_at = 0
        self.smoothing_debt: dict[str, int] = {}
        self.aliased_keyframes: set[int] = set()
        self.source = ""
        self.equal_rooms_m = 0.0
        self.orphaned_objects: list[tuple[str, str]] = []
        self._accepted_of: dict[int, list[int]] = {}
        self._size = 0
        self._tables: dict[str, npt.NDArray[Any]] = {
            "T_component_camera": np.empty((capacity, 4, 4)),
            "T_odom_camera": np.empty((capacity, 4, 4)),
            "odometry_steps": np.empty(capacity),
            "segment_rows": np.empty(capacity, dtype=np.int64),
            "positions": np.empty(capacity, dtype=np.int64),
            "components": np.empty(capacity, dtype=np.int64),
            "has_features": np.empty(capacity, dtype=np.bool_),
        }

    def __len__(self) -> int:
        return self._size

    # --- Tables with a row for each keyframe: views, which change with the graph ---

    @property
    def T_component_camera(self) -> Array:
        """``(n, 4, 4)``: pose of each keyframe in the frame and unit of its component."""
        return self._tables["T_component_camera"][: self._size]

    @property
    def T_odom_camera(self) -> Array:
        """``(n, 4, 4)``: pose of each keyframe in its odometry frame, in the unit of its segment."""
        return self._tables["T_odom_camera"][: self._size]

    @property
    def odometry_steps(self) -> Array:
        """``(n,)``: steps of odometry from the first keyframe of the segment to each keyframe."""
        return self._tables["odometry_steps"][: self._size]

    @property
    def segment_rows(self) -> npt.NDArray[np.int64]:
        """``(n,)``: row of the segment of each keyframe, -1 after its robot was forgotten."""
        return self._tables["segment_rows"][: self._size]

    @property
    def components(self) -> npt.NDArray[np.int64]:
        """``(n,)``: component of each keyframe: the lowest row of its segments; -1 for forgotten robots."""
        return self._tables["components"][: self._size]

    @property
    def positions(self) -> npt.NDArray[np.int64]:
        """``(n,)``: position of each keyframe within its segment, from 0."""
        return self._tables["positions"][: self._size]

    @property
    def has_features(self) -> npt.NDArray[np.bool_]:
        """``(n,)``: whether the encoded features of each keyframe are kept, so that others can match them."""
        return self._tables["has_features"][: self._size]

    # --- Queries; the most frequent one, `segment_of`, reads its table without a view, which is faster ---

    def exists(self, i: int) -> bool:
        """Return whether *i* is the id of a keyframe whose robot was not forgotten."""
        return 0 <= i < self._size and bool(self.segment_rows[i] >= 0)

    def is_pending(self, number: int) -> bool:
        """Return whether loop closure *number* is pending, so neither accepted, rejected nor deleted."""
        return number in self.edges and self.edges[number].state == "pending"

    def segment_of(self, i: int) -> Segment:
        """Return the segment of keyframe *i*, whose robot was not forgotten."""
        return self.segments[int(self._tables["segment_rows"][i])]

    def find_segment(self, robot: str, number: int) -> Segment | None:
        """Return segment *number* of a robot, None if there is none or it has no keyframes left."""
        for segment in self.segments:
            is_same = (segment.robot, segment.number) == (robot, number)
            if is_same and not segment.is_from_version and segment.keyframes:
                return segment
        return None

    def segment_pair_of(self, edge: LoopEdge) -> tuple[int, int]:
        """Return the rows of the segments of both ends of a loop closure, the lower row first."""
        rows = self.segment_rows
        row_a, row_b = int(rows[edge.a]), int(rows[edge.b])
        return min(row_a, row_b), max(row_a, row_b)

    def root_component(self) -> int:
        """Return the component that the map consists of, -1 while no segment defines its frame."""
        return self.segments[self.root].component if self.root >= 0 else -1

    def is_aligned(self, row: int) -> bool:
        """Return whether segment *row* is in the component that the map consists of, if there is one."""
        return self.root >= 0 and self.segments[row].component == self.segments[self.root].component

    @property
    def metric_components(self) -> set[int]:
        """The components whose unit is a metre: at least one metric segment of theirs has keyframes."""
        return {each.component for each in self.segments if each.is_metric and each.keyframes}

    @property
    def has_scales(self) -> bool:
        """Whether scales must be estimated, because at least one segment is not metric."""
        return not all(segment.is_metric for segment in self.segments)

    def odometry_poses(self, ids: Sequence[int]) -> Array:
        """Return ``(n, 4, 4)`` poses of keyframes in their odometry frames, in the unit of the component."""
        T = self.T_odom_camera[np.asarray(ids, dtype=np.int64)]
        return scaled(T, np.array([self.segment_of(i).scale for i in ids])) if self.has_scales else T

    def anchor(self, row: int) -> int:
        """Return the keyframe that defines the frame of the component of segment *row*.

        Return -1 if the robot of this keyframe was forgotten.
        """
        component = self.segments[row].component
        ids = self.segments[self.root if component == self.root_component() else component].keyframes
        return ids[0] if ids else -1

    def anchors(self) -> set[int]:
        """Return the keyframes that define the frames of all components, and which smoothing holds.

        The set also has -1 if the robot of such a keyframe was forgotten.
        """
        return {self.anchor(row) for row in range(len(self.segments))}

    def accepted_edges_of(self, i: int) -> list[int]:
        """Return the numbers of the accepted loop closures of keyframe *i*; do not change this list."""
        return self._accepted_of.get(i, [])

    def accepted_edges_by_segments(self) -> dict[tuple[int, int], list[int]]:
        """Return the numbers of accepted loop closures by the rows of the two segments that they connect.

        The lower row is first; both rows are equal for loop closures within one segment.
        """
        by_segments: dict[tuple[int, int], list[int]] = {}
        for number, edge in self.edges.items():
            if edge.state == "accepted":
                by_segments.setdefault(self.segment_pair_of(edge), []).append(number)
        return by_segments

    def odometry_edges_of(self, i: int) -> list[tuple[int, int]]:
        """Return the pairs (before, *i*) and (*i*, after) of consecutive keyframes of the segment of *i*.

        A pair is missing at an end of the segment.  In the segment of a stored version, whose keyframes are
        not consecutive, there is no pair at all.
        """
        segment = self.segment_of(i)
        if segment.is_from_version:
            return []
        position, ids = int(self.positions[i]), segment.keyframes
        return [
            (ids[first], ids[first + 1]) for first in (position - 1, position) if 0 <= first < len(ids) - 1
        ]

    # --- Changes of keyframes and segments ---

    def count_event(self) -> None:
        """Increment the number of applied events."""
        self.events += 1

    def start_from_version(self, event: MapStarted) -> None:
        """Begin an empty map with the keyframes and edges of a stored version, or with none.

        The keyframes are in one segment (row 0), which defines the frame of the map.
        """
        self.source, self.equal_rooms_m = event.source, event.equal_rooms_m
        if event.keyframes:
            self.segments.append(Segment(robot="", number=-1, is_from_version=True))
            self.root = 0
        for number, start in enumerate(event.keyframes):
            sent = start.keyframe
            keyframe = LiveKeyframe(
                robot=start.robot, segment=-1, number=number, timestamp_s=sent.timestamp_s, data=start.data
            )
            self._append(keyframe, 0, sent.T_odom_camera, sent.T_odom_camera, 0.0)
        for edge in event.links:
            self._add_edge(
                LoopEdge(
                    a=edge.a,
                    b=edge.b,
                    T_a_b=np.array(matrix_of(edge.T_a_b, 4, 4)),
                    information=matrix_of(edge.information, 6, 6),
                    inliers=0,
                    matches=0,
                    is_fixed=True,
                    state="accepted",
                )
            )
        self._update_components()

    def _find_or_add_segment(self, robot: str, number: int) -> int:
        """Return the row of segment *number* of a robot; add the segment if there is none.

        If the robot has not left, *number* is that of its newest segment or of a new one, since the numbers
        of segments never decrease; else all segments are searched.  A new segment inherits the newest 16
        records of contradictions of the robot's last segment.
        """
        newest = self.newest_segments.get(robot)
        for row in range(len(self.segments)) if newest is None else (newest,):
            segment = self.segments[row]
            if (segment.robot, segment.number) == (robot, number) and not segment.is_from_version:
                return row
        row = len(self.segments)
        segment = Segment(robot=robot, number=number, component=row)
        earlier = [each for each in self.segments if each.robot == robot and not each.is_from_version]
        if earlier:
            segment.contradictions = earlier[-1].contradictions & INHERITED_CONTRADICTIONS
        self.segments.append(segment)
        return row

    def add_keyframe(self, event: KeyframeAdded) -> int:
        """Add a keyframe at the pose that odometry gives it; return the id of the keyframe.

        Its segment is added if there is none, and becomes the robot's newest one.  If no segment defines the
        frame of the map yet, this segment does, provided that it is metric.
        """
        sent = event.keyframe
        T_odom = sent.T_odom_camera
        row = self._find_or_add_segment(event.robot, event.segment)
        segment = self.segments[row]
        # 1. State the unit of a new segment; its first keyframe defines the frame of its component.
        if not segment.keyframes:
            segment.is_metric = sent.features.is_metric
            if not segment.is_metric:
                segment.scale, segment.reason = assumed_scale(sent.features), UP_TO_SCALE
            T_component, steps = T_odom if segment.is_metric else scaled(T_odom, segment.scale), 0.0
        # 2. Compute the pose of a later keyframe by odometry from the newest keyframe of the segment.
        else:
            newest = segment.keyframes[-1]
            motion = inverse(self.T_odom_camera[newest]) @ T_odom
            motion = motion if segment.is_metric else scaled(motion, segment.scale)
            T_component = self.T_component_camera[newest] @ motion
            steps = float(self.odometry_steps[newest]) + _count_odometry_steps(motion)
        keyframe = LiveKeyframe(
            robot=event.robot,
            segment=event.segment,
            number=event.number,
            timestamp_s=sent.timestamp_s,
            data=event.data,
            objects=tuple(each.digest for each in (sent.points, sent.image) if each is not None),
        )
        i = self._append(keyframe, row, T_odom, T_component, steps)
        self.next_numbers[event.robot] = event.number + 1
        self.newest_segments[event.robot] = row
        if self.root < 0 and segment.is_metric:
            self.root = row
        return i

    def _append(
        self, keyframe: LiveKeyframe, row: int, T_odom: Array, T_component: Array, odometry_steps: float
    ) -> int:
        """Append a keyframe to the tables and to segment *row*; return the id of the keyframe."""
        self._grow()
        i = self._size
        self._size += 1
        segment = self.segments[row]
        self.keyframes.append(keyframe)
        self.T_component_camera[i], self.T_odom_camera[i] = T_component, T_odom
        self.odometry_steps[i], self.segment_rows[i] = odometry_steps, row
        self.components[i] = segment.component
        self.positions[i], self.has_features[i] = len(segment.keyframes), True
        segment.keyframes.append(i)
        return i

    def _grow(self) -> None:
        """Double the capacity of the tables of keyframes when they are full."""
        if self._size == len(self._tables["positions"]):
            for name, old in self._tables.items():
                self._tables[name] = np.concatenate([old, np.empty_like(old)])

    def drop_features(self, i: int) -> None:
        """Drop the encoded features of keyframe *i*; its pose and its loop closures stay."""
        self.keyframes[i].data = None
        self.has_features[i] = False

    def restore_features(self, i: int, data: bytes) -> None:
        """Give keyframe *i*, which came from a snapshot, its encoded features."""
        self.keyframes[i].data = data
        self.has_features[i] = True

    def set_poses(self, ids: Sequence[int], T_component_camera: Array) -> None:
        """Set the ``(n, 4, 4)`` poses of keyframes in the frame of their component."""
        self.T_component_camera[ids] = T_component_camera

    def scale_segment(self, row: int, factor: float) -> None:
        """Multiply the estimated scale of segment *row* by *factor*; its poses and steps do not change."""
        self.segments[row].scale *= factor

    def remove_robot(self, robot: str) -> None:
        """Note that a robot left; its keyframes and loop closures stay."""
        self.newest_segments.pop(robot, None)

    def forget_robot(self, robot: str) -> list[int]:
        """Take out all keyframes of *robot* with their loop closures; return the ids of these keyframes.

        If the frame of the map was defined by the robot, another metric segment defines it afterwards, one of
        the same component if there is one.  If no metric segment has keyframes, the map has no frame then.
        """
        root_component = self.root_component()
        rows_of_root = [row for row, each in enumerate(self.segments) if each.component == root_component]
        own = [each for each in self.segments if each.robot == robot and not each.is_from_version]
        forgotten = [i for segment in own for i in segment.keyframes]
        members = set(forgotten)
        # 1. Take out the accepted, pending and rejected loop closures of the robot.
        for number in [n for n, edge in self.edges.items() if edge.a in members or edge.b in members]:
            self._reject(number)
        self.rejected = {
            number: edge
            for number, edge in self.rejected.items()
            if edge.a not in members and edge.b not in members
        }
        # 2. Empty the segments of the robot; their rows stay, so that other rows keep their numbers.
        for segment in own:
            segment.keyframes, segment.reported_T_map_odom = [], None
            segment.contradictions, segment.is_excluded = 0, False
        self.smoothing_debt.pop(robot, None)
        # 3. Drop the features of the keyframes, and list their objects in the object store for deletion.
        for i in forgotten:
            self.drop_features(i)
            self.orphaned_objects += [(robot, digest) for digest in self.keyframes[i].objects]
            self.keyframes[i].objects = ()
            self.segment_rows[i] = self.components[i] = -1
        self.orphaned_objects = self.orphaned_objects[-MAX_ORPHANED_OBJECTS:]
        # 4. Choose another segment to define the frame of the map if necessary, and update the components.
        self.newest_segments.pop(robot, None)
        if self.root < 0 or not self.segments[self.root].keyframes:
            metric = [row for row, each in enumerate(self.segments) if each.keyframes and each.is_metric]
            self.root = next((row for row in metric if row in rows_of_root), metric[0] if metric else -1)
        self._update_components()
        return forgotten

    def note_optimisation(self) -> None:
        """Note that an optimisation of the whole graph is requested now."""
        self.optimised_at = self._size

    def set_smoothing_debt(self, robot: str, keyframes: int) -> None:
        """Set how many keyframes were smoothed because of *robot* beyond its allowance."""
        self.smoothing_debt[robot] = keyframes

    # --- Changes of loop closures ---

    def apply(self, decisions: Iterable[Decision]) -> list[Outcome]:
        """Carry out each decision before the next one is made, and return the outcomes of all decisions.

        Decisions concern loop closures, components, segments and reports, and no keyframe is added by one.
        A generator of *decisions* sees the graph as its earlier decisions have changed it.
        """
        return [outcome for decision in decisions for outcome in self._apply(decision)]

    def _apply(self, decision: Decision) -> list[Outcome]:
        match decision:
            case AddEdges():
                for closure in decision.measured:
                    self._add_edge(_pending_edge(decision.keyframe, closure))
            case AcceptEdges():
                return self._accept(decision.numbers)
            case RejectEdges():
                edges = [self._reject(number) for number in decision.numbers]
                rows = self.segment_rows
                if any(rows[edge.a] != rows[edge.b] for edge in edges):
                    self._update_components()
                    self._drop_pair_consistency()
                return [LoopClosureRejected(a=edge.a, b=edge.b, reason=decision.reason) for edge in edges]
            case JoinComponents():
                return self._join_components(decision)
            case MarkAliases():
                self.aliased_keyframes.update(decision.keyframes)
            case StateReason():
                for row in decision.rows:
                    self.segments[row].reason = decision.reason
                if decision.is_reported:
                    return [self._ambiguous(row) for row in decision.rows]
            case RecordMisfits():
                for number, misfits in decision.misfits.items():
                    self.edges[number].misfits = misfits
            case RecordContradictions():
                self.segments[decision.row].contradictions = decision.contradictions
            case ExcludeSegment():
                self._exclude_segment(decision.row, decision.reason)
                return [self._ambiguous(decision.row)]
            case Corrected():
                segment = self.segments[self.newest_segments[decision.robot]]
                segment.reported_T_map_odom, segment.reason = decision.T_map_odom, ""
                segment.reported_scale, segment.covariance = segment.scale, decision.covariance
                return [decision]
            case Unaligned():
                segment = self.segments[self.newest_segments[decision.robot]]
                segment.reported_T_map_odom, segment.reason = None, decision.reason
                return [decision]
            case Joined():
                return [decision]
        return []

    def _ambiguous(self, row: int) -> Ambiguous:
        segment = self.segments[row]
        return Ambiguous(robot=segment.robot, segment=segment.number, reason=segment.reason)

    def _add_edge(self, edge: LoopEdge) -> None:
        """Add a pending or accepted loop closure; the caller updates the components."""
        self.edges[self.next_edge] = edge
        if edge.state == "accepted":
            self._connect(self.next_edge, edge)
        else:
            self.pending.append(self.next_edge)
        self.next_edge += 1

    def _accept(self, numbers: Sequence[int]) -> list[Outcome]:
        """Accept pending loop closures; the caller updates the components if they connect two components."""
        for number in numbers:
            edge = self.edges[number]
            edge.state, edge.misfits = "accepted", 0
            self.pending.remove(number)
            self._connect(number, edge)
        edges = [self.edges[number] for number in numbers]
        return [LoopClosureAccepted(a=edge.a, b=edge.b) for edge in edges]

    def _join_components(self, join: JoinComponents) -> list[Outcome]:
        """Move a component into the frame of another one, and accept the loop closures between both."""
        for segment in self.segments:
            if segment.component == join.moving and segment.keyframes:
                self._move_segment(segment, join.T_stay_moving, join.scale)
        outcomes = self._accept(join.numbers)
        self._update_components()
        self._drop_pair_consistency()
        return outcomes

    def _exclude_segment(self, row: int, reason: str) -> None:
        """Take out the loop closures of segment *row* for good, and mark it, so that later ones are ignored.

        Its keyframes stay.  If it defined the frame of the map, another metric segment of its component
        defines it afterwards, if there is one.
        """
        excluded = self.segments[row]
        excluded.is_excluded, excluded.reason = True, reason
        for number in [number for number, edge in self.edges.items() if row in self.segment_pair_of(edge)]:
            self._reject(number)
        self.rejected = {
            number: edge for number, edge in self.rejected.items() if row not in self.segment_pair_of(edge)
        }
        if self.root == row:
            candidates = (
                other
                for other, each in enumerate(self.segments)
                if other != row and each.component == excluded.component and each.keyframes and each.is_metric
            )
            self.root = next(candidates, row)
        self._update_components()

    def note_pair_consistency(self, earlier: int, later: int, *, is_consistent: bool) -> None:
        """Store whether two pending loop closures agree with each other, so that no pair is tested twice."""
        self.pair_consistency[earlier, later] = is_consistent

    def drop_oldest_pending(self) -> None:
        """Reject the oldest pending loop closures, so that the newest 400 stay pending."""
        surplus = len(self.pending) - MAX_PENDING_EDGES
        if surplus > 0:
            for number in self.pending[:surplus]:
                self._reject(number)
            self._drop_pair_consistency()

    def reopen_rejected(self) -> None:
        """Make all rejected loop closures pending again, and drop what was concluded from loop closures.

        No keyframe is a perceptual alias any more, and the consistency of all pairs is unknown.  The reason
        of segments without an alignment is `NO_LOOP_CLOSURE_YET` again, except that of excluded ones.
        """
        for number, edge in self.rejected.items():
            edge.state, edge.misfits = "pending", 0
            self.edges[number] = edge
        self.pending = sorted([*self.pending, *self.rejected])
        self.rejected, self.aliased_keyframes, self.pair_consistency = {}, set(), {}
        for segment in self.segments:
            if segment.reported_T_map_odom is None and not segment.is_excluded:
                segment.reason = NO_LOOP_CLOSURE_YET

    def _connect(self, number: int, edge: LoopEdge) -> None:
        self._accepted_of.setdefault(edge.a, []).append(number)
        self._accepted_of.setdefault(edge.b, []).append(number)

    def _reject(self, number: int) -> LoopEdge:
        """Take a loop closure out and keep it for `reopen_rejected`; the caller updates the components."""
        edge = self.edges.pop(number)
        if edge.state == "accepted":
            self._accepted_of[edge.a].remove(number)
            self._accepted_of[edge.b].remove(number)
        else:
            self.pending.remove(number)
        edge.state = "rejected"
        self.rejected[number] = edge
        if len(self.rejected) > MAX_REJECTED_EDGES:
            del self.rejected[next(iter(self.rejected))]
        return edge

    def _move_segment(self, segment: Segment, T_stay_moving: Array, scale: float) -> None:
        """Move the poses of a segment by *T_stay_moving*, after their lengths were multiplied by *scale*.

        The scale of the segment is multiplied by *scale*, and its steps of odometry are counted anew.
        """
        ids = segment.keyframes
        if scale == 1.0:
            self.set_poses(ids, T_stay_moving @ self.T_component_camera[ids])
            return
        self.set_poses(ids, T_stay_moving @ scaled(self.T_component_camera[ids], scale))
        segment.scale *= scale
        # The length of a step is stated in metres, so the number of steps depends on the scale.
        for before, here in pairwise(ids):
            T_before_here = inverse(self.T_odom_camera[before]) @ self.T_odom_camera[here]
            step = _count_odometry_steps(scaled(T_before_here, segment.scale))
            self.odometry_steps[here] = self.odometry_steps[before] + step

    def _update_components(self) -> None:
        """Compute the components of segments anew, by union-find over accepted loop closures."""
        parent = list(range(len(self.segments)))

        def find_root(row: int) -> int:
            while parent[row] != row:
                parent[row] = parent[parent[row]]
                row = parent[row]
            return row

        for edge in self.edges.values():
            if edge.state == "accepted":
                row_a, row_b = (find_root(row) for row in self.segment_pair_of(edge))
                parent[max(row_a, row_b)] = min(row_a, row_b)
        for row, segment in enumerate(self.segments):
            segment.component = find_root(row)
            self.components[segment.keyframes] = segment.component

    def _drop_pair_consistency(self) -> None:
        """Delete the entries of `pair_consistency` whose loop closures are not both pending any more."""
        pending = set(self.pending)
        self.pair_consistency = {
            pair: is_consistent
            for pair, is_consistent in self.pair_consistency.items()
            if pair[0] in pending and pair[1] in pending
        }

    # --- Snapshots ---

    def accepted_edges_by_keyframe(self) -> dict[int, list[int]]:
        """Return the numbers of accepted loop closures by keyframe, without empty lists, for a snapshot."""
        return {i: numbers for i, numbers in sorted(self._accepted_of.items()) if numbers}

    @classmethod
    def restore(
        cls,
        *,
        keyframes: list[LiveKeyframe],
        arrays: Mapping[str, npt.NDArray[Any]],
        accepted_by_keyframe: dict[int, list[int]],
        tables: Mapping[str, object],
    ) -> MapGraph:
        """Return the graph of a snapshot.

        Args:
            keyframes: All keyframes by id; without data if their features are restored later.
            arrays: The tables with a row for each keyframe, by the name of their property, without
                ``components`` and ``has_features``, which follow from the other arguments.
            accepted_by_keyframe: Numbers of accepted loop closures by keyframe.
            tables: Values of the other public attributes of `MapGraph`, by name.
        """
        graph = cls(capacity=max(64, len(keyframes)))
        graph._size = len(keyframes)
        for name, values in arrays.items():
            graph._tables[name][: graph._size] = values
        graph.components[:] = -1
        graph.has_features[:] = [keyframe.data is not None for keyframe in keyframes]
        graph.keyframes, graph._accepted_of = keyframes, accepted_by_keyframe
        for name, value in tables.items():
            setattr(graph, name, value)
        for segment in graph.segments:
            graph.components[segment.keyframes] = segment.component
        return graph


def _count_odometry_steps(T_from_to: Array) -> float:
    """Return a motion in steps of odometry: 0.25 m or 15 degrees are one step, the larger count decides.

    A motion counts as 0.05 steps at least.  The standard deviation of a relative pose by odometry grows with
    the square root of its steps.  *T_from_to* is ``(4, 4)``, in metres.
    """
    by_length = float(np.sqrt((T_from_to[:3, 3] ** 2).sum())) / STEP_LENGTH_M
    by_rotation = rotation_angle_deg(T_from_to[:3, :3]) / STEP_ROTATION_DEG
    return max(by_length, by_rotation, MIN_STEP)


def _pending_edge(keyframe: int, measured: MeasuredLoopClosure) -> LoopEdge:
    return LoopEdge(
        a=keyframe,
        b=measured.other,
        T_a_b=np.array(matrix_of(measured.T_keyframe_other, 4, 4)),
        information=matrix_of(measured.information, 6, 6),
        inliers=measured.inliers,
        matches=measured.matches,
        scale=measured.scale,
    )
