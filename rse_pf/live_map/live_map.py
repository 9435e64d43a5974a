"""The live map: one pose graph that several robots build together, as a deterministic state machine.

Events go in, outcomes come out.  `LiveMap.apply` alone changes the map; the same events give the same map to
the byte.  Expensive work (matching images, optimising the whole graph) only reads the map and returns an
event, so that it can run in other threads while the map changes.

Source:
    Outlier rejection is the pairwise consistency maximisation of Mangelson et al. (ICRA 2018), as in
    Kimera-Multi (Tian et al., T-RO 2022); unlike there, one process holds the graph of all robots.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import Literal

import numpy as np

from rse_pf.errors import BadRequest, InvalidCamera
from rse_pf.geometry import Array, inverse
from rse_pf.live_map.alignment_reports import alignment_of, report_alignments
from rse_pf.live_map.candidates import choose_candidates, find_redundant_keyframes
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LoopClosuresMeasured,
    MapStarted,
    Optimised,
    RobotForgotten,
    RobotLeft,
    matrix_bytes,
)
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.measure import (
    LOOP_CLOSURE_EVIDENCE,
    StoredView,
    assumed_scale,
    measure_stored_keyframes,
    placed_keyframe,
    view_of_features,
)
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.outcomes import (
    Added,
    Alignment,
    Ambiguous,
    Culled,
    OptimiseWanted,
    Outcome,
)
from rse_pf.live_map.outlier_rejection import decide_edges, decide_measured, has_odometry_jump
from rse_pf.live_map.smoothing import (
    CAUCHY_WIDTH,
    moved_keyframes,
    smooth_changes,
    smooth_everything,
)
from rse_pf.live_map.snapshots import (
    SnapshotParts,
    SnapshotWriter,
    decode_graph,
    decode_parts,
    decode_places,
    encode_graph,
)
from rse_pf.live_map.versions import (
    PlacedKeyframes,
    PointSource,
    image_references,
    paths_of,
    placed_keyframes,
    point_sources,
    version_of,
    whole_graph,
)
from rse_pf.maps.descriptors import DescriptorKind, check_same_kind
from rse_pf.maps.format import MapVersion
from rse_pf.slam.keyframe import SentKeyframe, check_odometry_range, decode_keyframe
from rse_pf.slam.localise import LocalisationOptions, Localised, PosePrior, localise, spread_candidates
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.place_recognition import PlaceIndex, place_vector
from rse_pf.slam.pose_graph import PoseGraph

__all__ = ["LiveMap"]

MAX_SEGMENTS = 2**31
"""Limit of a robot's segment numbers, which fit into 32 bits: this number and larger ones are refused."""
RELOCALISATION_POOL = 6
"""Ratio of the keyframes that place recognition proposes to those that a relocalisation compares.  Those
compared are chosen spread over the map: if two places look the same, both are compared, and the pose is
refused as ambiguous."""


class LiveMap:
    """One map that several robots build together.

    The id of a keyframe is its position in order of arrival, from 0; ids are never used again.  The frame of
    the map is that of the first metric segment, or of the stored version that the map started from.  If the
    robot of that segment is forgotten or excluded, another metric segment defines the frame.
    """

    def __init__(self, options: LiveMapOptions | None = None) -> None:
        self.options = options or LiveMapOptions()
        self._graph = MapGraph()
        self._places = PlaceIndex()
        self._snapshot_writer = SnapshotWriter()
        self._cached_kind: tuple[int, DescriptorKind] | None = None

    # --- Snapshots ---

    @classmethod
    def restore(cls, snapshot: bytes, options: LiveMapOptions | None = None) -> LiveMap:
        """Return the map that `LiveMap.snapshot` encoded as *snapshot*.

        Replays are equal only if *options* are those of the encoded map.

        Raises:
            BadRequest: The snapshot is damaged, or has another format version.
        """
        restored = cls(options)
        restored._graph, extra = decode_graph(snapshot)
        restored._places = decode_places(extra)
        return restored

    def snapshot(self) -> bytes:
        """Return the whole state of the map as bytes."""
        return encode_graph(self._graph, {"places": self._places.to_bytes()})

    @classmethod
    def restore_parts(
        cls, head: bytes, part: Callable[[str], bytes], options: LiveMapOptions | None = None
    ) -> LiveMap:
        """Return the map that `LiveMap.snapshot_parts` encoded.

        Args:
            head: The head of the snapshot.
            part: Returns the bytes of a part by name.
            options: Limits of the work for one keyframe; replays are equal only if they are those of the
                encoded map.

        Raises:
            BadRequest: The head or a part is damaged, or has another format version.
        """
        restored = cls(options)
        restored._graph, restored._places, restored._snapshot_writer = decode_parts(head, part)
        return restored

    def snapshot_parts(self, known: Collection[str] = ()) -> SnapshotParts:
        """Return the whole state of the map, with the features of keyframes in parts.

        Parts whose names are in *known* are stored already; they are not encoded again.
        """
        return self._snapshot_writer.encode(self._graph, self._places, known)

    def digest(self) -> str:
        """Return the SHA-256 of the pose graph and the features, in hexadecimal, without the place index."""
        return hashlib.sha256(encode_graph(self._graph, {})).hexdigest()

    # --- What the map holds ---

    @property
    def keyframes(self) -> int:
        """The number of keyframes whose features are kept."""
        return int(self._graph.has_features.sum())

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots that have added a keyframe and have not left."""
        return tuple(self._graph.newest_segments)

    @property
    def contributors(self) -> tuple[str, ...]:
        """The robots with keyframes in the map, also those that left."""
        segments = self._graph.segments
        return tuple(
            dict.fromkeys(each.robot for each in segments if each.keyframes and not each.is_from_version)
        )

    @property
    def loop_closure_count(self) -> int:
        """The number of accepted loop closures, plus all edges of the version that the map started from."""
        return len(self._graph.edges) - len(self._graph.pending)

    @property
    def pending_loop_closure_count(self) -> int:
        """The number of loop closures that are neither accepted nor rejected."""
        return len(self._graph.pending)

    def accepted_loop_closures(self) -> list[tuple[int, int, Array]]:
        """Return the accepted loop closures as (keyframe a, keyframe b, measured ``T_a_b`` ``(4, 4)``).

        Edges of the version that the map started from are among them.  Lengths are metres if *a* or *b* is in
        a metric segment, else in the unit of the segment of *a*.
        """
        edges = self._graph.edges.values()
        return [(edge.a, edge.b, edge.T_a_b) for edge in edges if edge.state == "accepted"]

    @property
    def events(self) -> int:
        """The number of events that were applied."""
        return self._graph.events

    @property
    def kind(self) -> DescriptorKind | None:
        """The kind of descriptors of all keyframes, None while no features are kept."""
        if self._cached_kind is None or not self._graph.has_features[self._cached_kind[0]]:
            with_features = np.flatnonzero(self._graph.has_features)
            if not len(with_features):
                return None
            data = self._graph.keyframes[with_features[0]].data
            assert data is not None
            self._cached_kind = int(with_features[0]), decode_keyframe(data).features.kind
        return self._cached_kind[1]

    def next_number(self, robot: str) -> int:
        """Return the number that the robot's next keyframe must have."""
        return self._graph.next_numbers.get(robot, 0)

    def next_segment(self, robot: str) -> int:
        """Return the smallest segment number above all segments of the robot, 0 if it has none."""
        own = (each for each in self._graph.segments if each.robot == robot and not each.is_from_version)
        return max((each.number for each in own), default=-1) + 1

    def pose(self, keyframe: int) -> Array:
        """Return the ``(4, 4)`` pose of a keyframe in the frame and unit of its component."""
        pose: Array = self._graph.T_component_camera[keyframe].copy()
        return pose

    def is_in_map(self, keyframe: int) -> bool:
        """Return whether a keyframe is connected with the frame of the map."""
        graph = self._graph
        return graph.root >= 0 and bool(graph.components[keyframe] == graph.root_component())

    def alignments(self) -> list[Alignment]:
        """Return the reported alignment of the newest segment of each robot that has not left."""
        return [alignment_of(self._graph.segments[row]) for row in self._graph.newest_segments.values()]

    def alignment_of(self, robot: str, segment: int) -> Alignment | None:
        """Return the reported alignment of a segment, None if the segment has no keyframe in the map."""
        found = self._graph.find_segment(robot, segment)
        return None if found is None else alignment_of(found)

    def to_version(self) -> MapVersion:
        """Return the keyframes with features that are connected with the map, and their edges, as a version.

        Raises:
            InternalError: The map holds something that does not fit into a version.
        """
        return version_of(self._graph)

    def point_sources(self, version: MapVersion) -> tuple[PointSource, ...]:
        """Return where the metric point clouds of *version*, which `to_version` just returned, are stored."""
        return point_sources(self._graph, version)

    def placed_keyframes(self) -> PlacedKeyframes:
        """Return the metric keyframes with features in the map, with their present poses."""
        return placed_keyframes(self._graph)

    def image_references(self, version: MapVersion) -> dict[str, dict[str, dict[str, str]]]:
        """Return the field ``images`` of the provenance of *version*: digests by robot and id of keyframe."""
        return image_references(self._graph, version)

    def paths(self, most: int) -> list[tuple[str, int, Array]]:
        """Return (robot, segment, positions ``(n, 3)`` in metres) of the segments in the map.

        About *most* keyframes are chosen evenly; the ends of each segment are among them, also beyond *most*.
        """
        return paths_of(self._graph, most)

    def objects_of(self, keyframes: Collection[int]) -> list[tuple[str, str]]:
        """Return (robot, digest) of the objects, points and images, that were stored with *keyframes*."""
        stored = [self._graph.keyframes[i] for i in keyframes]
        return [(keyframe.robot, digest) for keyframe in stored for digest in keyframe.objects]

    @property
    def deletable_objects(self) -> list[tuple[str, str]]:
        """(robot, digest) of the last 10,000 objects of forgotten robots; the map server deletes them."""
        return list(self._graph.orphaned_objects)

    # --- Work that only reads the map and returns an event ---

    def check_keyframe(self, event: KeyframeAdded) -> Literal["new", "known", "ahead"]:
        """Return whether a keyframe is the robot's next one, was added before, or comes too early.

        Only its number decides: "known" does not say that the keyframe is equal to the one that was added.
        The map does not change.

        Raises:
            BadRequest: The keyframe is the next one, and its data are damaged, its segment is older than the
                newest one of the robot or has keyframes of the other kind (with or without metric scale), its
                odometry is out of range, or its descriptors are of another kind than those of the map.
            InvalidCamera: The keyframe is the next one, and its camera model cannot be right.
        """
        expected = self.next_number(event.robot)
        if event.number != expected:
            return "known" if 0 <= event.number < expected else "ahead"
        oldest = max(0, self.next_segment(event.robot) - 1)
        if not oldest <= event.segment < MAX_SEGMENTS:
            raise BadRequest(
                f"segment {event.segment} is not within {oldest}..{MAX_SEGMENTS - 1}",
                hint="count segments upwards: use the newest one, or the next one after tracking was lost",
            )
        features = event.keyframe.features
        segment = self._graph.find_segment(event.robot, event.segment)
        if segment is not None and segment.is_metric != features.is_metric:
            raise BadRequest(
                f"segment {event.segment} has keyframes with and without metres",
                hint="begin a new segment where the camera changes between one with and one without depth",
            )
        scale = assumed_scale(features) if segment is None else segment.scale
        try:
            check_odometry_range(event.keyframe, 1.0 if features.is_metric else scale)
        except InvalidCamera as error:
            raise BadRequest(error.message, hint=error.hint) from error
        if self.kind is not None:
            check_same_kind(self.kind, features.kind, "the live map")
        return "new"

    def measure(self, keyframe: int) -> LoopClosuresMeasured:
        """Compare a keyframe with others that may show the same place; the map does not change."""
        return self.prepare_measurement(keyframe)[0]()

    def prepare_measurement(
        self, keyframe: int, pieces: int = 1, candidates: int | None = None
    ) -> list[Callable[[], LoopClosuresMeasured]]:
        """Return functions that together do the work of `measure`, each in any thread while the map changes.

        Args:
            keyframe: The keyframe that is compared with others.
            pieces: Largest number of functions, among which the candidates are divided; at least one is
                returned, and `merge_measurements` merges their results.
            candidates: None for the number of the options.  An overloaded map server states the largest
                number of keyframes to compare with; a stated number also leaves out keyframes of the same
                segment within 12 steps of odometry (3 m of straight motion).
        """
        stored = self._stored(keyframe)
        if stored is None or self._is_ignored(keyframe):
            return [lambda: LoopClosuresMeasured(keyframe=keyframe)]
        is_overloaded = candidates is not None
        limit = self.options.candidates if candidates is None else candidates
        chosen = choose_candidates(self._graph, self._places, keyframe, limit, is_overloaded=is_overloaded)
        stored_candidates = [self._stored(i) for i in chosen]
        others = [each for each in stored_candidates if each is not None]
        size = max(1, -(-len(others) // pieces))
        groups = [others[begin : begin + size] for begin in range(0, max(1, len(others)), size)]
        return [partial(measure_stored_keyframes, stored, group, LOOP_CLOSURE_EVIDENCE) for group in groups]

    def optimise(self) -> Optimised:
        """Optimise the whole graph and return its new poses as an event; the map does not change.

        It may be called only after `OptimiseWanted`: without a frame of the map, the result is undefined.

        Raises:
            MissingExtra: gtsam is not installed.
        """
        return self.prepare_optimisation()()

    def prepare_optimisation(
        self, solve: Callable[[PoseGraph, OptimiseOptions], Array] | None = None
    ) -> Callable[[], Optimised]:
        """Return a function that does the work of `optimise`, in any thread while the map changes.

        It may be called only after `OptimiseWanted`.  *solve* takes the place of `optimise_graph` and returns
        the optimised poses ``(n, 4, 4)``, for example from a process of its own.
        """
        pose_graph, ids = whole_graph(self._graph)
        anchor, up_to = ids.index(self._graph.anchor(self._graph.root)), self._graph.events
        options = OptimiseOptions(cauchy=CAUCHY_WIDTH)

        def run() -> Optimised:
            poses = solve(pose_graph, options) if solve else optimise_graph(pose_graph, options).T_world_pose
            # The keyframe that defines the frame of the map keeps its pose.
            poses = pose_graph.T_world_pose[anchor] @ inverse(poses[anchor]) @ poses
            return Optimised(up_to=up_to, ids=tuple(ids), T_map_camera=matrix_bytes(poses))

        return run

    def relocalise(self, view: SentKeyframe) -> Localised:
        """Find the pose of a view in the map without any prior pose; the map does not change.

        Raises:
            BadRequest: The descriptors of *view* are of another kind than those of the map.
        """
        return self.prepare_relocalisation(view)()

    def prepare_relocalisation(
        self, view: SentKeyframe, prior: PosePrior | None = None
    ) -> Callable[[], Localised]:
        """Return a function that does the work of `relocalise`, in any thread while the map changes.

        With a *prior*, half of the keyframes that are compared lie near it; fewer if the map has fewer there.

        Raises:
            BadRequest: The descriptors of *view* are of another kind than those of the map.
        """
        graph = self._graph
        if self.kind is not None:
            check_same_kind(self.kind, view.features.kind, "the live map")
        # 1. Choose keyframes by place recognition that are spread over the map.
        allowed = np.flatnonzero(graph.has_features & (graph.components == graph.root_component()))
        limit = self.options.candidates
        vector = place_vector(view.features.descriptors)
        nearest = self._places.nearest(vector, RELOCALISATION_POOL * limit, allowed)
        T, options = graph.T_component_camera, LocalisationOptions()
        if prior is not None and len(allowed):
            is_near = prior.contains(T[allowed], options.region_m, options.region_deg)
            expected = self._places.nearest(vector, limit // 2, allowed[is_near])
            nearest = list(dict([*expected, *nearest]).items())  # each keyframe once, the expected ones first
        # 2. Copy the poses of these keyframes, since the map may change before the returned function runs.
        chosen = [
            (self._stored(i), T[i].copy(), graph.segment_of(i).scale)
            for i in spread_candidates(nearest, T, limit)
        ]
        candidates = [(stored, pose, scale) for stored, pose, scale in chosen if stored is not None]
        options = replace(options, has_equal_rooms=graph.equal_rooms_m > 0.0)
        image, scale_of_view = view_of_features(view.features, view.camera), assumed_scale(view.features)

        def run() -> Localised:
            placed = [placed_keyframe(stored, pose, scale) for stored, pose, scale in candidates]
            found = localise(placed, image, options, prior=prior)
            return found if found.scale is None else replace(found, scale=found.scale * scale_of_view)

        return run

    # --- Events ---

    def apply(self, event: Event) -> list[Outcome]:
        """Change the map by *event* and return what changed; deterministic.

        Events about keyframes of forgotten robots, and a change of the map server, only increment the number
        of events.

        Raises:
            BadRequest: The event starts a map that has keyframes already, or its data are damaged.
            InvalidCamera: The camera model of an added keyframe cannot be right.
        """
        self._graph.count_event()
        match event:
            case MapStarted():
                return self._start(event)
            case KeyframeAdded():
                return self._add_keyframe(event)
            case LoopClosuresMeasured():
                return self._add_loop_closures(event)
            case Optimised():
                return self._take_optimised_poses(event)
            case RobotForgotten():
                return self._forget_robot(event.robot)
            case RobotLeft():
                self._graph.remove_robot(event.robot)
        return []

    def _add_keyframe(self, event: KeyframeAdded) -> list[Outcome]:
        """Add a keyframe to the graph and to the index of place recognition.

        Its pose is that of the newest keyframe of its segment, moved by the odometry since then; the first
        keyframe of a segment keeps its pose in the odometry frame, without depth by the assumed scale.
        """
        graph = self._graph
        # 1. Add the keyframe to the graph and to the index of place recognition.
        i = graph.add_keyframe(event)
        self._places.add(i, place_vector(event.keyframe.features.descriptors))
        # 2. Report an alignment only if the segment is in the map and the robot was sent no alignment of it;
        #    an alignment that was sent does not change by a keyframe that odometry adds.
        if graph.segment_of(i).reported_T_map_odom is not None or not self.is_in_map(i):
            return [Added(id=i)]
        return [Added(id=i), *graph.apply(report_alignments(graph, (event.robot, event.number)))]

    def _add_loop_closures(self, event: LoopClosuresMeasured) -> list[Outcome]:
        """Add the loop closures that were measured for a keyframe, and decide which of them are right."""
        graph = self._graph
        keyframe = event.keyframe
        if not graph.exists(keyframe):
            return []
        # 1. Leave out loop closures of forgotten or excluded robots, and all if odometry jumped.
        was_excluded = graph.segment_of(keyframe).is_excluded
        measured = [
            closure
            for closure in event.links
            if closure.other != keyframe and not was_excluded and not self._is_ignored(closure.other)
        ]
        has_jumped = has_odometry_jump(graph, keyframe, measured)
        if has_jumped:
            measured = []
        # 2. Accept or reject loop closures, join components, and exclude the segment of the robot if it keeps
        #    contradicting the map.  Only after an exclusion, decide again about all that are not accepted.
        outcomes = graph.apply(decide_measured(graph, keyframe, measured, has_jumped=has_jumped))
        is_excluded = graph.segment_of(keyframe).is_excluded and not was_excluded
        decided_again = self._decide_again() if is_excluded else []
        # 3. Smooth the poses around the changed loop closures, and reject the oldest of too many pending
        #    ones.
        robot, number = graph.keyframes[keyframe].robot, graph.keyframes[keyframe].number
        windows = smooth_changes(graph, moved_keyframes(outcomes), self.options, robot)
        graph.drop_oldest_pending()
        # 4. Report the alignments that changed.
        reports = graph.apply(report_alignments(graph, (robot, number), windows.covariances))
        # 5. Drop redundant features, and those of a keyframe whose odometry jumped, since later loop closures
        #    with it would contradict the graph.
        surplus = (keyframe,) if has_jumped else find_redundant_keyframes(graph, keyframe)
        for i in surplus:
            graph.drop_features(i)
            self._places.remove(i)
        culled = [Culled(ids=surplus)] if surplus else []
        return [*outcomes, *windows.outcomes, *decided_again, *reports, *culled]

    def _take_optimised_poses(self, event: Optimised) -> list[Outcome]:
        """Set the poses of the keyframes in the map to those of an optimisation.

        A keyframe that arrived after the optimisation began moves by the same rigid motion as the optimised
        one before it in its segment.  Poses of keyframes that have left the map meanwhile are ignored.
        """
        graph = self._graph
        T_optimised = np.frombuffer(event.T_map_camera, dtype="<f8").reshape(-1, 4, 4)
        index_of = {i: index for index, i in enumerate(event.ids) if graph.exists(i) and self.is_in_map(i)}
        # 1. Set the optimised poses; move each later keyframe as the optimised one before it.
        motions: dict[int, Array] = {}
        for row, segment in enumerate(graph.segments):
            if not segment.keyframes or not graph.is_aligned(row):
                continue
            T = graph.T_component_camera[segment.keyframes]
            motion: Array | None = None
            for position, i in enumerate(segment.keyframes):
                if i in index_of:
                    motion = T_optimised[index_of[i]] @ inverse(T[position])
                    T[position] = T_optimised[index_of[i]]
                elif motion is not None:
                    T[position] = motion @ T[position]
            if motion is not None:
                graph.set_poses(segment.keyframes, T)
                motions[row] = motion
        # 2. Move segments that joined the map later, and smooth the poses where they are connected.
        windows = smooth_changes(graph, self._move_joined_segments(motions), self.options)
        # 3. Report the alignments that changed.
        return [*windows.outcomes, *graph.apply(report_alignments(graph, None, windows.covariances))]

    def _move_joined_segments(self, motions: dict[int, Array]) -> list[int]:
        """Move segments that joined the map during an optimisation with the segments they are connected to.

        Args:
            motions: By row of an optimised segment, the motion ``(4, 4)`` of its newest optimised keyframe in
                the frame of the map; the motions of the moved segments are added to it.

        Returns:
            Keyframes to smooth around: for each moved segment, both ends of one loop closure that connects it
            with the segment whose motion it took.
        """
        graph = self._graph
        ends: list[int] = []
        for pair, numbers in sorted(graph.accepted_edges_by_segments().items()):
            for row, moved in (pair, pair[::-1]):
                ids = graph.segments[row].keyframes
                if row not in motions and moved in motions and ids:
                    motions[row] = motions[moved]
                    graph.set_poses(ids, motions[moved] @ graph.T_component_camera[ids])
                    ends += [graph.edges[numbers[0]].a, graph.edges[numbers[0]].b]
        return ends

    def _forget_robot(self, robot: str) -> list[Outcome]:
        """Take out all that a robot contributed, and decide again about the loop closures of other robots."""
        graph = self._graph
        forgotten = graph.forget_robot(robot)
        self._snapshot_writer.forget(forgotten)
        for i in forgotten:
            self._places.remove(i)
        return [*self._decide_again(), *graph.apply(report_alignments(graph, None))]

    def _start(self, event: MapStarted) -> list[Outcome]:
        """Begin with the keyframes and edges of a stored version, or with none.

        Raises:
            BadRequest: The map has keyframes already, or a keyframe of the version is damaged.
        """
        graph = self._graph
        if len(graph):
            raise BadRequest("the map has keyframes already", hint="start a new map from the version")
        graph.start_from_version(event)
        for i, start in enumerate(event.keyframes):
            self._places.add(i, place_vector(start.keyframe.features.descriptors))
        return [Added(id=i) for i in range(len(graph))]

    # --- Steps that several events share ---

    def _decide_again(self) -> list[Outcome]:
        """Decide again about all loop closures that are not accepted, and smooth the whole graph.

        Rejected loop closures become pending, and proofs of perceptual aliases are dropped before, since they
        may rest on loop closures that were taken out.  Pending ones are decided as if they arrived now,
        oldest first.

        Return what became ambiguous, and a request to optimise.  Accepted and rejected loop closures are left
        out, because all of them were decided; the caller reports the alignments.
        """
        graph = self._graph
        ambiguous: list[Outcome] = []
        graph.reopen_rejected()
        for keyframe, numbers in groupby(list(graph.pending), lambda number: graph.edges[number].a):
            outcomes = graph.apply(decide_edges(graph, keyframe, list(filter(graph.is_pending, numbers))))
            smooth_changes(graph, moved_keyframes(outcomes), self.options)
            ambiguous += [outcome for outcome in outcomes if isinstance(outcome, Ambiguous)]
        smooth_everything(graph, self.options)
        wanted = [OptimiseWanted()] if graph.edges and graph.root >= 0 else []
        return [*ambiguous, *wanted]

    def _stored(self, i: int) -> StoredView | None:
        """Return the id and the encoded keyframe *i*, None if its features were dropped."""
        data = self._graph.keyframes[i].data
        return None if data is None else (i, data)

    def _is_ignored(self, i: int) -> bool:
        """Return whether loop closures of *i* are ignored: it was forgotten, or its segment excluded."""
        return not self._graph.exists(i) or self._graph.segment_of(i).is_excluded
