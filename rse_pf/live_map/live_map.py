"""The live map: events in, outcomes out; the same events give the same map, byte for byte.

`apply` alone changes it.  `measure`, `optimise` and `relocalise` only look: what they find becomes an event.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, InvalidCamera
from rse_pf.geometry import Array, inverse, scaled
from rse_pf.live_map.beliefs import (
    Changes,
    disbelieve_contradicting,
    has_jumped,
    has_other_metres,
    judge_again,
    judge_links,
    smooth_changes,
)
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LoopClosuresMeasured,
    MapStarted,
    Optimised,
    RobotForgotten,
    RobotLeft,
    matrix_bytes,
    matrix_of,
)
from rse_pf.live_map.feature_parts import FeatureParts, SnapshotParts
from rse_pf.live_map.graph import Graph, LiveKeyframe, LiveLink, Segment, variances_of
from rse_pf.live_map.measure import (
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
    Corrected,
    Culled,
    Joined,
    OptimiseWanted,
    Outcome,
    Unaligned,
)
from rse_pf.live_map.smoothing import SmoothedWindows, odometry_step, smooth_all
from rse_pf.live_map.versions import (
    PointSource,
    image_references,
    paths_of,
    point_sources,
    version_of,
    whole_graph,
)
from rse_pf.maps.descriptors import DescriptorKind, check_same_kind
from rse_pf.maps.format import MapVersion
from rse_pf.slam.keyframe import SentKeyframe, check_odometry_range, decode_keyframe
from rse_pf.slam.localise import LocalisationOptions, Localised, localise, spread_candidates
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.place_recognition import PlaceIndex, place_vector
from rse_pf.slam.pose_graph import PoseGraph

__all__ = ["LiveMap"]

_MAX_SEGMENT = 2**31
UP_TO_SCALE = "up to scale: no robot with metres has seen what it sees"


class LiveMap:
    """One map that several robots make together.

    Ids of keyframes are their positions in order of arrival.  The map's frame is that of the first segment,
    or of the version that it starts from.
    """

    def __init__(self, options: LiveMapOptions | None = None) -> None:
        self.options = options or LiveMapOptions()
        self._graph = Graph()
        self._places = PlaceIndex()
        self._parts = FeatureParts()
        self._kind_of: tuple[int, DescriptorKind] | None = None

    @classmethod
    def restore(cls, snapshot: bytes, options: LiveMapOptions | None = None) -> LiveMap:
        """Return the map that `snapshot` was called on.

        Raises:
            BadRequest: The snapshot is damaged, or of another version.
        """
        restored = cls(options)
        restored._graph, extra = Graph.decode(snapshot)
        restored._places = PlaceIndex.from_bytes(extra["places"])
        return restored

    def snapshot(self) -> bytes:
        """Return all that the map knows."""
        return self._graph.encode({"places": self._places.to_bytes()})

    @classmethod
    def restore_parts(
        cls, head: bytes, part: Callable[[str], bytes], options: LiveMapOptions | None = None
    ) -> LiveMap:
        """Return the map that `snapshot_parts` was called on; *part* returns the bytes of a part by name.

        Raises:
            BadRequest: The head or a part is damaged, or of another version.
        """
        restored = cls(options)
        restored._graph, restored._places, restored._parts = FeatureParts.decode(head, part)
        return restored

    def snapshot_parts(self, known: Collection[str] = ()) -> SnapshotParts:
        """Return all that the map knows, what keyframes saw in parts; *known* ones are not made again."""
        return self._parts.encode(self._graph, self._places, known)

    def digest(self) -> str:
        """Return the SHA-256 of all that the map knows: equal for equal maps."""
        return hashlib.sha256(self._graph.encode({})).hexdigest()

    @property
    def keyframes(self) -> int:
        """The number of keyframes whose features are kept."""
        return int(self._graph.held.sum())

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots that are in the map and have not left."""
        return tuple(self._graph.newest)

    @property
    def contributors(self) -> tuple[str, ...]:
        """The robots whose keyframes are in the map, also of those that left."""
        segments = self._graph.segments
        return tuple(dict.fromkeys(each.robot for each in segments if each.keyframes and not each.version))

    @property
    def loop_closure_count(self) -> int:
        """The number of measured links that hold poses together."""
        return len(self._graph.links) - len(self._graph.open)

    @property
    def pending_loop_closure_count(self) -> int:
        """The number of measured links that are not believed, the newest of them."""
        return len(self._graph.open)

    def accepted_loop_closures(self) -> list[tuple[int, int, Array]]:
        """Return the believed links as keyframes a, b and the measured ``T_a_b``."""
        links = self._graph.links.values()
        return [(link.a, link.b, link.T_a_b) for link in links if link.state == "believed"]

    @property
    def events(self) -> int:
        """The number of events that were applied."""
        return self._graph.events

    @property
    def kind(self) -> DescriptorKind | None:
        """Of the features of all keyframes, None while none is kept."""
        if self._kind_of is None or not self._graph.held[self._kind_of[0]]:
            held = np.flatnonzero(self._graph.held)
            if not len(held):
                return None
            data = self._graph.keyframes[held[0]].data
            assert data is not None
            self._kind_of = int(held[0]), decode_keyframe(data).features.kind
        return self._kind_of[1]

    def next_number(self, robot: str) -> int:
        """Return the number that the robot's next keyframe must have."""
        return self._graph.next_numbers.get(robot, 0)

    def next_segment(self, robot: str) -> int:
        """Return a number that no segment of the robot has; 0 if it has none."""
        own = [each.segment for each in self._graph.segments if each.robot == robot and not each.version]
        return max(own, default=-1) + 1

    def pose(self, keyframe: int) -> Array:
        """Return the ``(4, 4)`` pose of a keyframe in the frame of its component."""
        pose: Array = self._graph.T[keyframe].copy()
        return pose

    def is_in_map(self, keyframe: int) -> bool:
        """Return whether a keyframe is connected with the map's frame."""
        row = int(self._graph.of_segment[keyframe])
        return row >= 0 and self._is_aligned(row)

    def check_keyframe(self, event: KeyframeAdded) -> Literal["new", "known", "ahead"]:
        """Say whether a keyframe is the robot's next one; the map does not change.

        Raises:
            BadRequest: It cannot be a keyframe: a pose, a camera, features, a time or a segment is absurd; or
                its features are of another kind than those of the map.
        """
        expected = self.next_number(event.robot)
        if event.number != expected:
            return "known" if 0 <= event.number < expected else "ahead"
        oldest = max(0, self.next_segment(event.robot) - 1)
        if not oldest <= event.segment < _MAX_SEGMENT:
            raise BadRequest(
                f"segment {event.segment} is not within {oldest}..{_MAX_SEGMENT - 1}",
                hint="count segments upwards, one for each time that tracking starts again",
            )
        known = self._graph.find_segment(event.robot, event.segment)
        if known is not None and known.is_metric != event.keyframe.features.is_metric:
            raise BadRequest(
                f"segment {event.segment} has keyframes with and without metres",
                hint="begin a new segment where depths begin or end",
            )
        features = event.keyframe.features
        scale = assumed_scale(features) if known is None else known.scale
        try:
            check_odometry_range(event.keyframe, 1.0 if features.is_metric else scale)
        except InvalidCamera as error:
            raise BadRequest(error.message, hint=error.hint) from error
        kind = self.kind
        if kind is not None:
            check_same_kind(kind, event.keyframe.features.kind, "the live map")
        return "new"

    def apply(self, event: Event) -> list[Outcome]:
        """Change the map by *event*; deterministic.

        Events about keyframes that are gone change nothing.
        """
        self._graph.events += 1
        match event:
            case KeyframeAdded():
                return self._add(event)
            case LoopClosuresMeasured():
                return self._take_links(event)
            case Optimised():
                return self._take_poses(event)
            case RobotForgotten():
                return self._forget(event.robot)
            case RobotLeft():
                self._graph.newest.pop(event.robot, None)
            case MapStarted():
                return self._start(event)
        return []

    def measure(self, keyframe: int) -> LoopClosuresMeasured:
        """Compare a keyframe with others that may show the same place; changes nothing."""
        return self.prepare_measurement(keyframe)[0]()

    def prepare_measurement(
        self, keyframe: int, pieces: int = 1, candidates: int | None = None
    ) -> list[Callable[[], LoopClosuresMeasured]]:
        """Return functions that together do the work of `measure`, in any thread, while the map changes.

        The results of the pieces, one for each share of the candidates, are joined by `merge_measurements`.
        Less *candidates* than those of the options are for an owner that is behind.
        """
        stored = self._stored(keyframe)
        if stored is None or self._is_ignored(keyframe):
            return [lambda: LoopClosuresMeasured(keyframe=keyframe)]
        found = [self._stored(i) for i in self._candidates(keyframe, candidates)]
        others = [each for each in found if each is not None]
        size = max(1, -(-len(others) // pieces))
        shares = [others[begin : begin + size] for begin in range(0, max(1, len(others)), size)]
        return [partial(measure_stored_keyframes, stored, share, self.options.measured) for share in shares]

    def optimise(self) -> Optimised:
        """Fit the whole graph to all links; changes nothing.

        Raises:
            MissingExtra: gtsam is not installed.
        """
        return self.prepare_optimisation()()

    def prepare_optimisation(
        self, solve: Callable[[PoseGraph, OptimiseOptions], Array] | None = None
    ) -> Callable[[], Optimised]:
        """Return a function that does the work of `optimise`, in any thread, while the map changes.

        *solve* returns the poses that `optimise_graph` does, in a process of its own for example.
        """
        graph, ids = whole_graph(self._graph, self.options)
        anchor, up_to = ids.index(self._graph.anchor(self._graph.root)), self._graph.events
        options = OptimiseOptions(cauchy=self.options.cauchy)

        def fit() -> Optimised:
            poses = solve(graph, options) if solve else optimise_graph(graph, options).T_world_pose
            poses = graph.T_world_pose[anchor] @ inverse(poses[anchor]) @ poses
            return Optimised(up_to=up_to, ids=tuple(ids), T_map_camera=matrix_bytes(poses))

        return fit

    def relocalise(self, view: SentKeyframe) -> Localised:
        """Find the place of a view in the map, whatever its pose; changes nothing."""
        return self.prepare_relocalisation(view)()

    def prepare_relocalisation(self, view: SentKeyframe) -> Callable[[], Localised]:
        """Return what does the work of `relocalise`; another thread may call it while the map changes.

        Raises:
            BadRequest: The features of *view* are of another kind than those of the map.
        """
        graph, kind = self._graph, self.kind
        if kind is not None:
            check_same_kind(kind, view.features.kind, "the live map")
        aligned = np.flatnonzero(graph.held & self._aligned_mask())
        most = self.options.candidates
        # More are looked at, so that a second place that looks alike is compared, too.
        found = self._places.nearest(place_vector(view.features.descriptors), 6 * most, aligned)
        chosen = [
            (self._stored(i), graph.T[i].copy(), graph.segment_of(i).scale)
            for i in spread_candidates(found, graph.T, most)
        ]
        views = [(stored, T, scale) for stored, T, scale in chosen if stored is not None]
        options = LocalisationOptions(has_equal_rooms=graph.equal_rooms_m > 0.0)
        image, sought = view_of_features(view.features, view.camera), assumed_scale(view.features)

        def find() -> Localised:
            placed = [placed_keyframe(stored, T, scale) for stored, T, scale in views]
            found = localise(placed, image, options)
            return found if found.scale is None else replace(found, scale=found.scale * sought)

        return find

    def alignments(self) -> list[Alignment]:
        """Return where the newest segment of each robot lies."""
        return [self._alignment(self._graph.segments[row]) for row in self._graph.newest.values()]

    def alignment_of(self, robot: str, segment: int) -> Alignment | None:
        """Return where a segment lies, None if nothing of it is in the map."""
        found = self._graph.find_segment(robot, segment)
        return None if found is None else self._alignment(found)

    def to_version(self) -> MapVersion:
        """Return the keyframes and links that are connected with the map's frame, as a version."""
        return version_of(self._graph, self.options)

    def point_sources(self, version: MapVersion) -> tuple[PointSource, ...]:
        """Return where the points of the keyframes of *version* are, which this map has just made."""
        return point_sources(self._graph, version)

    def image_references(self, version: MapVersion) -> dict[str, dict[str, dict[str, str]]]:
        """Return ``images`` of the provenance of *version*: digests by robot's folder and id of keyframe."""
        return image_references(self._graph, version)

    def paths(self, most: int) -> list[tuple[str, int, Array]]:
        """Return robot, segment and ``(n, 3)`` positions of the keyframes in the map, of *most* of them."""
        return paths_of(self._graph, most)

    def objects_of(self, keyframes: Collection[int]) -> list[tuple[str, str]]:
        """Return robot and digest of the objects that were stored beside *keyframes*."""
        rows = [self._graph.keyframes[i] for i in keyframes]
        return [(row.robot, digest) for row in rows for digest in row.objects]

    @property
    def deletable_objects(self) -> list[tuple[str, str]]:
        """Robot and digest of the newest objects whose robot was forgotten, which nobody may read again."""
        return list(self._graph.gone_objects)

    # --- events -------------------------------------------------------------------------------

    def _add(self, event: KeyframeAdded) -> list[Outcome]:
        graph, options = self._graph, self.options
        keyframe = event.keyframe
        T_odom = keyframe.T_odom_camera
        row = graph.segment_row(event.robot, event.segment)
        segment = graph.segments[row]
        T, way = T_odom, 0.0
        if not segment.keyframes:
            segment.is_metric = keyframe.features.is_metric
            if not segment.is_metric:
                # Lengths begin as if the median depth were that of a room, so that noise fits.
                segment.scale = assumed_scale(keyframe.features)
                segment.reason = UP_TO_SCALE
                T = scaled(T_odom, segment.scale)
        else:
            last = segment.keyframes[-1]
            step = inverse(graph.T_odom[last]) @ T_odom
            if not segment.is_metric:
                step = scaled(step, segment.scale)
            T = graph.T[last] @ step
            way = float(graph.way[last]) + odometry_step(step, options)
        i = graph.add(
            LiveKeyframe(
                robot=event.robot, segment=event.segment, number=event.number,
                timestamp_s=keyframe.timestamp_s, data=event.data, objects=_objects_of(keyframe),
            ),
            row, T_odom, T, way,
        )  # fmt: skip
        self._places.add(i, place_vector(keyframe.features.descriptors))
        graph.next_numbers[event.robot] = event.number + 1
        graph.newest[event.robot] = row
        if graph.root < 0 and segment.is_metric:
            graph.root = row
        # A keyframe goes on from the last one, so only the first of an aligned segment tells something.
        is_told = segment.told is not None or not self._is_aligned(row)
        return [Added(id=i), *(() if is_told else self._tell((event.robot, event.number)))]

    def _take_links(self, event: LoopClosuresMeasured) -> list[Outcome]:
        graph, k = self._graph, event.keyframe
        if not self._exists(k):
            return []
        kept = [
            link for link in event.links
            if link.other != k and not self._is_ignored(k) and not self._is_ignored(link.other)
        ]  # fmt: skip
        is_off_its_path = has_jumped(graph, k, kept, self.options)
        if is_off_its_path:
            kept = []
        information = np.array([matrix_of(link.information, 6, 6) for link in kept]).reshape(-1, 6, 6)
        numbers = [
            graph.add_link(
                LiveLink(
                    a=k, b=link.other, T_a_b=np.array(matrix_of(link.T_keyframe_other, 4, 4)),
                    information=each, inliers=link.inliers, matches=link.matches, variances=variances,
                    scale=link.scale,
                )
            )
            for link, each, variances in zip(kept, information, variances_of(information), strict=True)
        ]  # fmt: skip
        changes = judge_links(graph, k, numbers, self.options)
        if is_off_its_path:
            changes.verdicts.add("contrary")
        is_off = has_other_metres(graph, k, kept, self.options)
        is_gone = disbelieve_contradicting(graph, k, changes, has_other_metres=is_off)
        again = self._judge_again() if is_gone else []
        mine = graph.keyframes[k]
        window = self._smooth(changes, mine.robot)
        graph.drop_oldest_open(self.options.open_links)
        told = self._tell((mine.robot, mine.number), window)
        # What is off its path would be compared with others, and tell each that it is at two places.
        return [*changes.outcomes, *again, *told, *(self._drop((k,)) if is_off_its_path else self._cull(k))]

    def _take_poses(self, event: Optimised) -> list[Outcome]:
        graph = self._graph
        T_new = np.frombuffer(event.T_map_camera, dtype="<f8").reshape(-1, 4, 4)
        placed = {i: row for row, i in enumerate(event.ids) if self._exists(i) and self.is_in_map(i)}
        moves: dict[int, Array] = {}
        for row, segment in enumerate(graph.segments):
            if not segment.keyframes or not self._is_aligned(row):
                continue
            move: Array | None = None
            for i in segment.keyframes:
                if i in placed:
                    move = T_new[placed[i]] @ inverse(graph.T[i])
                    graph.T[i] = T_new[placed[i]]
                elif move is not None:
                    graph.T[i] = move @ graph.T[i]
            if move is not None:
                moves[row] = move
        changes = Changes(moved=self._follow(moves))
        window = self._smooth(changes)
        return [*changes.outcomes, *self._tell(None, window)]

    def _follow(self, moves: dict[int, Array]) -> list[int]:
        """Move segments that joined after the optimisation began with those they are linked to."""
        graph = self._graph
        seeds = []
        for (one, other), numbers in sorted(graph.bridges().items()):
            for new, old in ((one, other), (other, one)):
                ids = graph.segments[new].keyframes
                if new not in moves and old in moves and ids:
                    moves[new] = moves[old]
                    graph.T[ids] = moves[old] @ graph.T[ids]
                    seeds += [graph.links[numbers[0]].a, graph.links[numbers[0]].b]
        return seeds

    def _forget(self, robot: str) -> list[Outcome]:
        graph = self._graph
        was_root = graph.segments[graph.root].component if graph.root >= 0 else -1
        beside = [row for row, each in enumerate(graph.segments) if each.component == was_root]
        gone = graph.forget(robot)
        self._parts.forget(gone)
        for i in gone:
            self._places.remove(i)
        graph.newest.pop(robot, None)
        if graph.root < 0 or not graph.segments[graph.root].keyframes:
            alive = [row for row, each in enumerate(graph.segments) if each.keyframes and each.is_metric]
            graph.root = next((row for row in alive if row in beside), alive[0] if alive else -1)
        graph.connect()
        return [*self._judge_again(), *self._tell(None)]

    def _judge_again(self) -> list[Outcome]:
        """Judge what rested on links that are gone, and bring the poses to where the others have them."""
        graph = self._graph
        outcomes: list[Outcome] = []
        for changes in judge_again(graph, self.options):
            self._smooth(changes)
            outcomes += [each for each in changes.outcomes if isinstance(each, Ambiguous)]
        smooth_all(graph, self.options)
        if graph.links and graph.root >= 0:
            outcomes.append(OptimiseWanted(misfit=0.0))
        return outcomes

    def _start(self, event: MapStarted) -> list[Outcome]:
        graph = self._graph
        if len(graph):
            raise BadRequest("the map has keyframes already", hint="start a new map from the version")
        graph.source, graph.equal_rooms_m = event.source, event.equal_rooms_m
        if not event.keyframes:
            return []
        graph.segments.append(Segment(robot="", segment=-1, version=True))
        graph.root = 0
        outcomes: list[Outcome] = []
        for number, start in enumerate(event.keyframes):
            keyframe = decode_keyframe(start.data)
            T_map_camera = keyframe.T_odom_camera
            row = LiveKeyframe(
                robot=start.robot, segment=-1, number=number, timestamp_s=keyframe.timestamp_s,
                data=start.data,
            )  # fmt: skip
            i = graph.add(row, 0, T_map_camera, T_map_camera, 0.0)
            self._places.add(i, place_vector(keyframe.features.descriptors))
            outcomes.append(Added(id=i))
        information = np.array([matrix_of(link.information, 6, 6) for link in event.links]).reshape(-1, 6, 6)
        for link, each_link, variances in zip(
            event.links, information, variances_of(information), strict=True
        ):
            graph.add_link(
                LiveLink(
                    a=link.a, b=link.b, T_a_b=np.array(matrix_of(link.T_a_b, 4, 4)), information=each_link,
                    inliers=0, matches=0, fixed=True, state="believed", variances=variances,
                )
            )  # fmt: skip
        graph.connect()
        return outcomes

    # --- parts of events -------------------------------------------------------------------------------

    def _smooth(self, changes: Changes, robot: str | None = None) -> SmoothedWindows | None:
        """Smooth around what changed, by a keyframe of *robot*; ask for a whole optimisation if due."""
        graph = self._graph
        window = smooth_changes(graph, changes, self.options, robot)
        if window is None:
            return None
        due = len(graph) - graph.optimised_at >= self.options.optimise_every
        if window.strained and due and graph.root >= 0:
            graph.optimised_at = len(graph)
            changes.outcomes.append(OptimiseWanted(misfit=window.misfit))
        return window

    def _tell(self, cause: tuple[str, int] | None, window: SmoothedWindows | None = None) -> list[Outcome]:
        """Return the outcomes that tell robots how the alignments of their newest segments changed."""
        graph = self._graph
        outcomes: list[Outcome] = []
        for row, T_map_odom, is_new in self._find_new_alignments():
            segment = graph.segments[row]
            if not self._is_aligned(row):
                if segment.told is not None:
                    segment.told = None
                    if not segment.reason and not graph.is_metric(segment.component):
                        segment.reason = UP_TO_SCALE
                    if not segment.reason:
                        segment.reason = "the links that aligned it were removed"
                    outcomes.append(
                        Unaligned(robot=segment.robot, segment=segment.segment, reason=segment.reason)
                    )
                continue
            if segment.told is None:
                links = sum(len(each) for pair, each in graph.bridges().items() if row in pair)
                outcomes.append(Joined(robot=segment.robot, segment=segment.segment, links=links))
            elif not is_new:
                continue
            segment.told, segment.reason = T_map_odom, ""
            segment.told_scale = segment.scale
            covariance = window.covariance(graph, segment.keyframes[-1]) if window is not None else None
            if covariance is not None:
                segment.covariance = covariance
            outcomes.append(
                Corrected(
                    robot=segment.robot, segment=segment.segment, T_map_odom=T_map_odom,
                    covariance=segment.covariance, cause=cause, scale=_scale_of(segment),
                )
            )  # fmt: skip
        return outcomes

    def _find_new_alignments(self) -> list[tuple[int, Array, bool]]:
        """Return row and alignment of the newest segments, and whether it changed since it was told."""
        graph, options = self._graph, self.options
        rows = [row for row in graph.newest.values() if graph.segments[row].keyframes]
        newest = [graph.segments[row].keyframes[-1] for row in rows]
        T = graph.T[newest] @ inverse(graph.odometry(newest))
        told = T.copy()
        for place, row in enumerate(rows):
            T_told = graph.segments[row].told
            if T_told is not None:
                told[place] = T_told
        moved2_m2 = ((T[:, :3, 3] - told[:, :3, 3]) ** 2).sum(axis=1)
        traces = (T[:, :3, :3] * told[:, :3, :3]).sum(axis=(1, 2))
        least_trace = 1.0 + 2.0 * math.cos(math.radians(options.told_deg))
        changed = (moved2_m2 > options.told_m**2) | (traces < least_trace)
        if graph.has_scales:
            scales = [(graph.segments[row].scale, graph.segments[row].told_scale) for row in rows]
            changed |= np.array([abs(math.log(now / told)) > options.told_scale for now, told in scales])
        return list(zip(rows, T, changed.tolist(), strict=True))

    def _cull(self, k: int) -> list[Outcome]:
        """Drop the features of the oldest keyframe at a place that enough others have seen."""
        graph, options = self._graph, self.options
        if not self.is_in_map(k):
            return []
        held = graph.held
        near = np.flatnonzero(held & (np.abs(graph.T[:, 0, 3] - graph.T[k, 0, 3]) <= options.same_place_m))
        off_m = np.abs(graph.T[near, :3, 3] - graph.T[k, :3, 3]).max(axis=1)
        near = near[off_m <= options.same_place_m]
        turned = np.einsum("nij,ij->n", graph.T[near, :3, :3], graph.T[k, :3, :3])
        near = near[turned >= 1.0 + 2.0 * math.cos(math.radians(options.same_place_deg))]
        near = near[[self.is_in_map(int(i)) for i in near]] if len(near) else near
        surplus = len(near) - options.same_place_most
        return self._drop(tuple(int(i) for i in near[: max(0, surplus)] if i != k))

    def _drop(self, ids: tuple[int, ...]) -> list[Outcome]:
        """Drop the features of keyframes, which are compared with nothing more."""
        for i in ids:
            self._graph.drop_data(i)
            self._places.remove(i)
        return [Culled(ids=ids)] if ids else []

    def _candidates(self, k: int, most: int | None = None) -> list[int]:
        """Return the keyframes to compare with *k*: some of its own component, some of others.

        With *most*, those that its robot has seen just before are left out: they join nothing.
        """
        graph, options = self._graph, self.options
        vector = self._places.vector_of(k)
        component = np.array([segment.component for segment in graph.segments])[graph.of_segment]
        own = component == graph.component_of(k)
        disbelieved = np.array([segment.disbelieved for segment in graph.segments])[graph.of_segment]
        held = graph.held & ~disbelieved
        held[k] = False
        close = graph.of_segment == graph.of_segment[k]
        apart = options.apart_steps if most is None else max(options.apart_steps, options.vague_steps)
        close &= np.abs(graph.way - graph.way[k]) < apart
        here = np.flatnonzero(held & own & ~close)
        there = np.flatnonzero(held & ~own)
        most = options.candidates if most is None else most
        found_there = self._places.nearest(vector, most // 2, there)
        found_here = self._places.nearest(vector, most - len(found_there), here)
        return sorted(i for i, _ in found_here + found_there)

    def _stored(self, i: int) -> StoredView | None:
        """Return a keyframe as it is kept, None if its bytes are not."""
        data = self._graph.keyframes[i].data
        return None if data is None else (i, data)

    def _is_ignored(self, i: int) -> bool:
        """Return whether links of a keyframe are not taken: it is gone, or its segment is not believed."""
        graph = self._graph
        return not self._exists(i) or graph.segments[int(graph.of_segment[i])].disbelieved

    def _exists(self, i: int) -> bool:
        return 0 <= i < len(self._graph) and bool(self._graph.of_segment[i] >= 0)

    def _is_aligned(self, row: int) -> bool:
        graph = self._graph
        return graph.root >= 0 and graph.segments[row].component == graph.segments[graph.root].component

    def _aligned_mask(self) -> npt.NDArray[np.bool_]:
        graph = self._graph
        aligned = np.array([self._is_aligned(row) for row in range(len(graph.segments))] + [False])
        mask: npt.NDArray[np.bool_] = aligned[graph.of_segment]
        return mask

    def _alignment(self, segment: Segment) -> Alignment:
        aligned = segment.told is not None
        return Alignment(
            robot=segment.robot, segment=segment.segment, aligned=aligned, reason=segment.reason,
            T_map_odom=segment.told, covariance=segment.covariance if aligned else None,
            scale=_scale_of(segment, is_told=True) if aligned else None,
        )  # fmt: skip


def _objects_of(keyframe: SentKeyframe) -> tuple[str, ...]:
    return tuple(each.digest for each in (keyframe.points, keyframe.image) if each is not None)


def _scale_of(segment: Segment, is_told: bool = False) -> float | None:
    """Return how many metres the unit of an aligned segment is, None of one in metres."""
    if segment.is_metric:
        return None
    return segment.told_scale if is_told else segment.scale
