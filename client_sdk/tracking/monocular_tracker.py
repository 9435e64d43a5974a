"""Track a camera without depth against its map of landmarks, as a state machine without input or output.

`MonocularTracker` has the steps of `Tracker`: frames and answers go in, pose queries and tracked frames come
out.  The unit of length of each segment is arbitrary until `MonocularTracker.rescale` is called, or the
segment is joined to an older one, whose unit it takes.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import (
    Correspondences,
    Features,
    Frame,
    PoseQuery,
    TrackedFrame,
    describe,
    round_for_wire,
)
from client_sdk.monocular.bundle import adjust
from client_sdk.monocular.two_view import TwoViewStart, start_from_two_views
from client_sdk.slots import Slots
from client_sdk.tracking.keyframe_map import NO_LANDMARK
from client_sdk.tracking.landmark_map import MIN_SHARED, LandmarkLimits, LandmarkMap, ViewFeatures
from client_sdk.tracking.place import place_of
from client_sdk.tracking.queries import Answer, OneQuery, Steps
from client_sdk.tracking.tracker import Join
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, pose_difference, rigid, scaled, transform
from rse_pf.maps.descriptors import ORB, DescriptorKind
from rse_pf.slam.descriptors import match_all
from rse_pf.slam.tracking import (
    ImageFeatures,
    NearLimits,
    Observations,
    distinct_distances,
    fit_pose,
)

__all__ = ["MonocularOptions", "MonocularTracker", "SeenKeyframe"]

Rows = npt.NDArray[np.int64]

_FEATURES_OF_PX, _MAX_FEATURES = 640, 2000
_START_DEPTH = 2.0
"""Median depth of the first landmarks in the arbitrary unit: fine enough for points rounded to 0.0001."""
_MAX_WAITING, _MIN_START_MATCHES = 30, 100
_LATEST, _ALIKE, _QUERIES = 3, 5, 3
_MANY = 3
"""A guided match with so many times the fewest inliers is worth a query."""
_WIDER = 2.5
_CONFIRM_PX, _LAST_PX = 8.0, 5.0
_TRACKED_RATIO, _CLEAR_RATIO, _CLEAR_INLIERS = 0.25, 0.5, 40
"""Shares of the matches that must agree: where the camera was just now, and at any other place."""
_JOIN_EVERY, _LOOP_ALIKE = 3, 2
_LOOP_AGE = 15
"""Keyframes of the same segment that are so much older, and share few landmarks, may be an older place."""
_AGREE_DEPTH, _AGREE_DEG, _AGREE_SCALE = 0.07, 4.0, 1.1
"""Two measurements of one similarity agree: in shares of the depth, in degrees, and as a ratio."""
_MAX_DEPTH_SPREAD = 0.15
"""Median distance from the median of the depths' ratios that give a scale, as a share of it."""
_MERGE_ITERATIONS = 6
_NO_SPREAD = np.zeros((3, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class MonocularOptions:
    """How a camera without depth is tracked.

    Attributes:
        features: Features of a frame of 640 px, spread over its cells; wider ones have more, up to 2000.
        max_matches: An even sample of so many is sent: a command stays under 10 kB in every codec.
        inlier_px: Largest reprojection error of an inlier.
        max_iterations: Of RANSAC.
        min_inliers: A pose with fewer is not accepted.
        search_px: Radius around the predicted pixels in which matches are sought.
        keyframe_share: A frame that sees a smaller share of its keyframe's landmarks becomes a keyframe.
        keyframe_deg: A frame turned further from the last keyframe becomes one.
        keyframe_depth_percent: A frame that moved further, in percent of the median depth, becomes one.
        start_parallax_deg: Median angle between the two views of the start.
        segment_after: A new segment begins after so many frames that show enough and no place that is known.
        limits: Of the map.
    """

    features: int = 1000
    max_matches: int = 250
    inlier_px: float = 3.0
    max_iterations: int = 1000
    min_inliers: int = 20
    search_px: float = 40.0
    keyframe_share: float = 0.7
    keyframe_deg: float = 10.0
    keyframe_depth_percent: float = 10.0
    start_parallax_deg: float = 2.0
    segment_after: int = 5
    limits: LandmarkLimits = field(default_factory=LandmarkLimits)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenKeyframe:
    """A keyframe as it is adjusted now: time in seconds, ``(4, 4)`` pose in the world, features of a kind.

    ``depths`` ``(n,)`` are those of the features along the optical axis, in the unit of the segment, NaN
    where no landmark is known.
    """

    timestamp_s: float
    T_world_camera: Array
    image: ImageFeatures
    kind: DescriptorKind
    depths: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Placed:
    """A pose relative to a keyframe, so that later adjustments of the keyframe move it, too."""

    timestamp_s: float
    keyframe: int
    T_keyframe_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Posed:
    """An image with its pose, the landmark of each feature, and whether its pose may be trusted."""

    features: ViewFeatures
    T_camera_world: Array
    landmarks: Rows
    matches: int
    is_weak: bool

    @property
    def inliers(self) -> int:
        """The number of landmarks that agree with the pose."""
        return int((self.landmarks != NO_LANDMARK).sum())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Matched:
    """Landmarks of a segment, and the features of an image that match them."""

    landmarks: Rows
    features: Rows

    def __len__(self) -> int:
        return len(self.landmarks)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Similarity:
    """Where a map lies in *segment*, by *keyframe* there: its lengths times *scale*, then moved by *T*."""

    segment: int
    keyframe: int
    T: Array
    scale: float


@dataclass(slots=True, kw_only=True, eq=False)
class _Segment:
    """One map, the frames that were placed in it, and the keyframe around which frames are tracked.

    ``unit`` says by what the lengths around the newest frames were multiplied since the segment began.
    """

    map: LandmarkMap
    unit: float = 1.0
    placed: list[_Placed] = field(default_factory=list)
    reference: int = 0
    reference_seen: int = 0

    def refer_to(self, keyframe: int) -> None:
        """Track frames around a keyframe."""
        self.reference = keyframe
        self.reference_seen = len(self.map.landmarks_of(keyframe))

    def place(self, timestamp_s: float, T_camera_world: Array, keyframe: int) -> None:
        """Take a frame with its pose, which follows a keyframe."""
        relative = self.map.keyframes[keyframe].T_camera_world @ inverse(T_camera_world)
        self.placed.append(_Placed(timestamp_s=timestamp_s, keyframe=keyframe, T_keyframe_camera=relative))

    def move(self, T_new_old: Array, scale: float) -> None:
        """Express all in another frame, after lengths are multiplied."""
        self.map.move(T_new_old, scale)
        self.unit *= scale
        self.placed = [
            replace(placed, T_keyframe_camera=scaled(placed.T_keyframe_camera, scale))
            for placed in self.placed
        ]

    def trajectory(self) -> Trajectory:
        """Return the placed frames in the order of time."""
        stamps = np.array([placed.timestamp_s for placed in self.placed])
        poses = [
            inverse(self.map.keyframes[placed.keyframe].T_camera_world) @ placed.T_keyframe_camera
            for placed in self.placed
        ]
        order = np.argsort(stamps, kind="stable")
        return Trajectory(stamps[order], np.array(poses).reshape(-1, 4, 4)[order])


class MonocularTracker:
    """Visual odometry of one camera without depth, which knows where it has been.

    Use it as `Tracker`: ``prepare(frame)``, then ``accept(query, T_camera_world, inliers)`` until a
    `TrackedFrame` comes back.

    A segment begins with two views that have parallax; the frames between them get their poses then.  A frame
    is matched near the pixels at which a constant velocity predicts the landmarks around the last keyframe,
    then in a wider radius, then with the last frame, then with the latest keyframes and those of all segments
    that look most alike.  If nothing fits, the frame is lost, and waits for the start of a new segment.  A
    segment is joined to an older one, in whose unit it is then, when two images of it were seen there.  An
    older place of the same segment that is recognised twice corrects what drifted in between.

    ``frames`` counts the frames, ``lost_frames`` those without a pose after the first start,
    ``starting_frames`` those before it; ``unrecognised`` those since the last pose that show enough and no
    known place; ``joins`` are the joins so far, ``loop_scales`` those by which an older place corrected the
    lengths around the newest frames.
    """

    def __init__(
        self,
        options: MonocularOptions | None = None,
        T_world_start: Array | None = None,
        slots: Slots | None = None,
    ) -> None:
        self.options = options or MonocularOptions()
        self._slots = slots or Slots()
        self.frames = 0
        self.lost_frames = 0
        self.starting_frames = 0
        self.unrecognised = 0
        self.loop_scales: list[float] = []
        self.joins: list[Join] = []
        self._T_world_start = np.eye(4) if T_world_start is None else T_world_start
        self._segments: dict[int, _Segment] = {}
        self._segment = 0
        self._begun = 0
        self._waiting: list[tuple[float, ViewFeatures]] = []
        self._last: _Posed | None = None
        self._motion: Array = np.eye(4)
        self._last_s = 0.0
        self._similar: _Similarity | None = None
        self._loop_from = 0
        self._frame: Frame  # set by `prepare`
        self._raw: Features
        self._open = OneQuery()

    @property
    def keyframes(self) -> int:
        """The number of keyframes."""
        return sum(len(segment.map.keyframes) for segment in self._segments.values())

    @property
    def loops(self) -> int:
        """The number of older places that corrected the map."""
        return len(self.loop_scales)

    @property
    def segment(self) -> int:
        """The number of the segment of the newest pose."""
        return self._segment

    @property
    def unit(self) -> float:
        """By what the lengths around the newest frames of this segment were multiplied since it began."""
        return self._own.unit

    @property
    def segment_keyframes(self) -> int:
        """The number of keyframes of this segment."""
        return len(self._own.map.keyframes)

    def keyframe(self, number: int, segment: int | None = None) -> SeenKeyframe:
        """Return a keyframe of a segment; None for that of the newest pose."""
        own = self._own if segment is None else self._segments[segment]
        keyframe = own.map.keyframes[number]
        return SeenKeyframe(
            timestamp_s=next(placed.timestamp_s for placed in own.placed if placed.keyframe == number),
            T_world_camera=self._T_world_start @ inverse(keyframe.T_camera_world),
            image=keyframe.features.image,
            kind=ORB if self._slots.features is None else self._slots.features.kind,
            depths=own.map.depths(number),
        )

    def keyframe_pose(self, number: int) -> Array:
        """Return the ``(4, 4)`` pose of a keyframe of this segment in the world, as it is adjusted now."""
        pose: Array = self._T_world_start @ inverse(self._own.map.keyframes[number].T_camera_world)
        return pose

    def keyframes_of(self, segment: int) -> Iterator[SeenKeyframe]:
        """Yield the keyframes of a segment, oldest first."""
        for number in range(len(self._segments[segment].map.keyframes) if segment in self._segments else 0):
            yield self.keyframe(number, segment)

    @property
    def segments(self) -> tuple[int, ...]:
        """The numbers of the segments, but for those that were joined to others; the first is 0."""
        return tuple(sorted(self._segments))

    def prepare(self, frame: Frame) -> PoseQuery | TrackedFrame:
        """Take the next frame; return a query, or the result for the frame if none is needed.

        Raises:
            UsageError: The last query was not answered yet, or the camera is another one.
        """
        self._open.refuse_open()
        if self._segments and frame.camera != self._own.map.camera:
            raise UsageError("the camera of this frame is another one", hint="use one tracker per camera")
        self.frames += 1
        self._frame = frame
        wider = max(1.0, frame.camera.width / _FEATURES_OF_PX)
        self._raw = _found(frame, self._feature_count(wider), self._slots)
        return self._open.begin(self._track(_looked_up(frame, self._raw, self._slots)))

    def accept(
        self, query: PoseQuery, T_camera_world: Array | None, inliers: int = 0, *, is_weak: bool = False
    ) -> PoseQuery | TrackedFrame:
        """Take the answer to *query*; return another query, or the result for the frame.

        Args:
            query: The query that `prepare` or `accept` returned last.
            T_camera_world: ``(4, 4)`` as the PnP service returns it; ``None`` if there was no answer.
            inliers: How many correspondences agree with it.
            is_weak: Whether its evidence is weak: then the frame becomes no keyframe.

        Raises:
            UsageError: *query* is not the open one.
        """
        return self._open.answer(query, Answer(T_camera_world, inliers, is_weak))

    def trajectory(self, segment: int = 0) -> Trajectory:
        """Return all poses of a segment so far, in the order of time, as its keyframes are adjusted now."""
        if segment not in self._segments:
            return Trajectory(np.empty(0), np.empty((0, 4, 4)))
        found = self._segments[segment].trajectory()
        return Trajectory(found.timestamps_s, self._T_world_start @ found.T_world_camera)

    def points(self, segment: int = 0) -> tuple[Array, npt.NDArray[np.uint8]]:
        """Return the ``(n, 3)`` landmarks of a segment in the world and their ``(n, 3)`` uint8 colours."""
        if segment not in self._segments:
            return np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)
        own = self._segments[segment].map
        return transform(self._T_world_start, own.points[own.is_alive]), own.colours[own.is_alive]

    def adjust(self) -> None:
        """Adjust all keyframes and landmarks of each segment together, such as at the end of a drive.

        It takes seconds, and poses that were returned before are corrected.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        for segment in self._segments.values():
            segment.map.adjust_all(iterations=_MERGE_ITERATIONS)
        self._last = self._similar = None

    def rescale(self, scale: float, segment: int = 0) -> None:
        """Multiply all lengths of a segment by *scale*, such as metres per unit."""
        if segment not in self._segments:
            return
        self._segments[segment].move(np.eye(4), scale)
        self._similar = None
        if segment == self._segment:
            self._move_last(np.eye(4), scale)

    def turn(self, T_new_old: Array) -> None:
        """Turn the world, such as after gravity became known; poses that were returned before change."""
        self._T_world_start = T_new_old @ self._T_world_start

    def median_depth(self, segment: int = 0) -> float:
        """Return the median depth of the landmarks around the newest frames of a segment, in its unit."""
        known = self._segments.get(segment)
        return 1.0 if known is None else known.map.median_depth(known.reference)

    @property
    def _own(self) -> _Segment:
        return self._segments[self._segment]

    def _feature_count(self, wider: float) -> int:
        return int(min(max(self.options.features, _MAX_FEATURES), self.options.features * wider))

    # --- one frame ---

    def _track(self, features: ViewFeatures) -> Steps:
        """Return the result of a frame, and yield the queries that it needs."""
        posed = None
        reason = "a place that was not seen before"
        if self._last is not None:
            for how in ("near", "wide", "frame"):
                posed, reason = yield from self._follow(features, how)
                if posed is not None:
                    break
        if posed is None and self._segments:
            posed, reason = yield from self._recognise(features)
        if posed is None:
            return self._start_or_lose(features, reason)
        self._waiting = []
        keyframe = self._keep(posed)
        assert self._last is not None
        if len(self._segments) > 1 and self.frames % _JOIN_EVERY == 0:
            yield from self._seek_join(self._last)
        elif keyframe:
            yield from self._seek_loop(self._last)
        return self._result(posed, keyframe=keyframe)

    def _follow(
        self, features: ViewFeatures, how: str
    ) -> Generator[PoseQuery, Answer, tuple[_Posed | None, str]]:
        """Yield a query against the landmarks that the last pose predicts, or against the last frame."""
        assert self._last is not None
        least = self.options.min_inliers
        if how == "frame":
            matched = self._matched_with_last(features, self._last)
        else:
            radius = self.options.search_px * (_WIDER if how == "wide" else 1.0)
            T_expected = self._expected(self._last)
            matched = _matched_near(self._own, features, T_expected, NearLimits(radius_px=radius))
            least *= _MANY
        if len(matched) < least:
            return None, f"only {len(matched)} matches with the map"
        answer = yield self._make_query(self._own, features, matched, "frame" if how == "frame" else "map")
        return self._confirm(self._own, features, answer, len(matched))

    def _expected(self, last: _Posed) -> Array:
        """Return ``T_camera_world`` as a user's motion function expects it, else by a constant velocity.

        With an IMU the camera turns as the gyroscope measured it.
        """
        motion, inertial = self._slots.motion, self._slots.inertial
        T = None if motion is None else motion.expected(self._frame.timestamp_s)
        if T is not None:
            return inverse(T)
        T_last_now = inverse(self._motion)
        turned = None if inertial is None else inertial.camera_rotation(self._last_s, self._frame.timestamp_s)
        if turned is not None:
            T_last_now[:3, :3] = turned
        expected: Array = inverse(T_last_now) @ last.T_camera_world
        return expected

    def _matched_with_last(self, features: ViewFeatures, last: _Posed) -> _Matched:
        rows = np.flatnonzero(last.landmarks != NO_LANDMARK)
        rows = rows[self._own.map.is_alive[last.landmarks[rows]]]
        known, columns = match_all(last.features.image.descriptors[rows], features.image.descriptors)
        return _Matched(landmarks=last.landmarks[rows[known]], features=columns)

    def _recognise(self, features: ViewFeatures) -> Generator[PoseQuery, Answer, tuple[_Posed | None, str]]:
        """Yield queries against the latest and the most alike keyframes of all segments."""
        candidates = [
            (segment, number, self._matched_with(segment, number, features))
            for segment, number in self._candidates(features)
        ]
        candidates.sort(key=lambda candidate: -len(candidate[2]))
        reason = f"only {len(candidates[0][2])} matches with the map"
        for segment, number, matched in candidates[:_QUERIES]:
            if len(matched) < self.options.min_inliers:
                break
            known = self._segments[segment]
            answer = yield self._make_query(known, features, matched, "keyframe")
            reason = "the matches agree on no pose"
            is_near = segment == self._segment and number >= len(known.map.keyframes) - _LATEST
            if not (is_near or self._is_clear(answer, len(matched))):
                continue
            posed, reason = self._confirm(known, features, answer, len(matched), number)
            if posed is not None:
                self._segment, self._last, self._similar = segment, None, None
                known.refer_to(number)
                return posed, ""
        return None, reason

    def _candidates(self, features: ViewFeatures) -> Iterator[tuple[int, int]]:
        """Yield the keyframes that may show what a frame shows: (segment, number)."""
        for segment, known in self._segments.items():
            count = len(known.map.keyframes)
            numbers = known.map.most_alike(features.place, np.arange(count))[:_ALIKE]
            if segment == self._segment:
                numbers = [*range(count - 1, max(-1, count - 1 - _LATEST), -1), *numbers]
            yield from ((segment, number) for number in dict.fromkeys(numbers))

    def _is_clear(self, answer: Answer, matches: int) -> bool:
        asked = min(matches, self.options.max_matches)
        return not answer.is_weak and answer.inliers >= max(_CLEAR_INLIERS, _CLEAR_RATIO * asked)

    # --- the same place twice ---

    def _seek_join(self, posed: _Posed) -> Generator[PoseQuery, Answer, None]:
        """Yield a query for the place of a tracked frame in another segment; join the two when two agree."""
        everywhere = [
            (segment, number)
            for segment, known in self._segments.items()
            if segment != self._segment
            for number in known.map.most_alike(posed.features.place, np.arange(len(known.map.keyframes)))[
                :_ALIKE
            ]
        ]
        similar = yield from self._seek_place(posed, everywhere)
        if similar is None:
            return
        if similar.segment < self._segment:
            self._join(self._segment, similar)
        else:  # the camera is back in the older segment: its poses stay
            back = inverse(similar.T)
            self._join(
                similar.segment,
                _Similarity(
                    segment=self._segment, keyframe=self._own.reference,
                    T=scaled(back, 1.0 / similar.scale), scale=1.0 / similar.scale,
                ),
                similar.keyframe,
            )  # fmt: skip

    def _seek_loop(self, posed: _Posed) -> Generator[PoseQuery, Answer, None]:
        """Yield a query for the place of a new keyframe among older ones, and correct the map by it."""
        own = self._own.map
        newest = len(own.keyframes) - 1
        apart = np.flatnonzero(own.shared_with(newest)[: max(0, newest - _LOOP_AGE)] < MIN_SHARED)
        if not len(apart) or newest < self._loop_from:
            return
        alike = own.most_alike(posed.features.place, apart)[:_LOOP_ALIKE]
        similar = yield from self._seek_place(posed, [(self._segment, number) for number in alike])
        if similar is None:
            return
        self._motion = scaled(self._motion, similar.scale)
        if self._slots.motion is not None:
            self._slots.motion.clear()
        self._merge_places(similar.keyframe, newest, similar)
        self._own.unit *= similar.scale
        self.loop_scales.append(similar.scale)
        self._loop_from = newest + _LOOP_AGE

    def _seek_place(
        self, posed: _Posed, keyframes: list[tuple[int, int]]
    ) -> Generator[PoseQuery, Answer, _Similarity | None]:
        """Yield a query against the best matched of *keyframes*; return the place if two frames agree."""
        matched = [
            (segment, number, self._matched_with(segment, number, posed.features))
            for segment, number in keyframes
        ]
        segment, number, best = max(matched, key=lambda candidate: len(candidate[2]))
        if len(best) < _CLEAR_INLIERS:
            return None
        known = self._segments[segment]
        answer = yield self._make_query(known, posed.features, best, "segment")
        if not self._is_clear(answer, len(best)):
            return None
        there, _ = self._confirm(known, posed.features, answer, len(best), number)
        if there is None:
            return None
        scale = self._scale_between(posed, there, known)
        if scale is None:
            return None
        T = inverse(there.T_camera_world) @ scaled(posed.T_camera_world, scale)
        similar = _Similarity(segment=segment, keyframe=number, T=T, scale=scale)
        before, self._similar = self._similar, similar
        if before is None or before.segment != segment:
            return None
        centre = inverse(posed.T_camera_world)[:3, 3]
        return similar if _agree(before, similar, centre, known.map.median_depth(number)) else None

    def _scale_between(self, posed: _Posed, there: _Posed, known: _Segment) -> float | None:
        """Return by what the lengths of this segment are multiplied there; None if depths do not agree."""
        both = np.flatnonzero((posed.landmarks != NO_LANDMARK) & (there.landmarks != NO_LANDMARK))
        here = transform(posed.T_camera_world, self._own.map.points[posed.landmarks[both]])[:, 2]
        ratios = transform(there.T_camera_world, known.map.points[there.landmarks[both]])[:, 2] / here
        if len(both) < self.options.min_inliers:
            return None
        scale = float(np.median(ratios))
        return scale if np.median(np.abs(ratios - scale)) <= _MAX_DEPTH_SPREAD * scale else None

    def _join(self, segment: int, similar: _Similarity, of_segment: int | None = None) -> None:
        """Move all of *segment*, the newer one, into an older one, which keeps its frame and its unit.

        Args:
            segment: The newer one.
            similar: Where it lies in the older one.
            of_segment: Its keyframe that shows the keyframe of *similar*; None means its newest reference.
        """
        newer, into = self._segments.pop(segment), self._segments[similar.segment]
        newer.move(similar.T, similar.scale)
        keyframe, landmark = into.map.take(newer.map)
        into.placed += [replace(placed, keyframe=placed.keyframe + keyframe) for placed in newer.placed]
        start = self._T_world_start
        self.joins.append(
            Join(
                segment,
                similar.segment,
                start @ similar.T @ scaled(inverse(start), similar.scale),
                similar.scale,
            )
        )
        if segment == self._segment:
            self._segment = similar.segment
            into.refer_to(newer.reference + keyframe)
            self._move_last(similar.T, similar.scale, landmark)
        self._merge_places(
            similar.keyframe, keyframe + (newer.reference if of_segment is None else of_segment)
        )

    def _move_last(self, T_new_old: Array, scale: float, first_landmark: int = 0) -> None:
        self._motion = scaled(self._motion, scale)
        if self._slots.motion is not None:
            self._slots.motion.clear()
        if self._last is not None:
            moved = np.where(
                self._last.landmarks == NO_LANDMARK, NO_LANDMARK, self._last.landmarks + first_landmark
            )
            T_camera_world = scaled(self._last.T_camera_world, scale) @ inverse(T_new_old)
            self._last = replace(self._last, T_camera_world=T_camera_world, landmarks=moved)

    def _merge_places(self, older: int, newer: int, bent: _Similarity | None = None) -> None:
        """Make one landmark of those around two keyframes that are the same, and adjust the whole map.

        With *bent* the keyframes between the two are moved before, so that the newer one is in its place.
        """
        own, reference = self._own.map, self._own.reference
        relative = None
        if self._last is not None:
            relative = self._last.T_camera_world @ inverse(own.keyframes[reference].T_camera_world)
        if bent is not None:
            own.bend(older, newer, bent.T, bent.scale)
        for keyframe in own.local(newer):
            own.fuse(keyframe, own.around(older), _CONFIRM_PX)
        own.adjust_around(newer)
        own.adjust_all(iterations=_MERGE_ITERATIONS)
        self._similar = None
        if self._last is not None and relative is not None:
            T_camera_world = relative @ own.keyframes[reference].T_camera_world
            self._last = replace(self._last, T_camera_world=T_camera_world)

    # --- matches and poses ---

    def _matched_with(self, segment: int, number: int, features: ViewFeatures) -> _Matched:
        """Match the landmarks of a keyframe by appearance alone."""
        landmarks, descriptors = self._segments[segment].map.landmarks_in(number)
        rows, columns = match_all(descriptors, features.image.descriptors)
        return _Matched(landmarks=landmarks[rows], features=columns)

    def _make_query(
        self, segment: _Segment, features: ViewFeatures, matched: _Matched, against: str
    ) -> PoseQuery:
        landmarks, columns = matched.landmarks, matched.features
        if len(landmarks) > self.options.max_matches:
            even = np.linspace(0, len(landmarks) - 1, self.options.max_matches).astype(np.int64)
            landmarks, columns = landmarks[even], columns[even]
        leftmost = np.argsort(features.image.pixels[columns, 0], kind="stable")
        points, pixels = round_for_wire(
            segment.map.points[landmarks[leftmost]], features.image.pixels[columns[leftmost]]
        )
        return PoseQuery(
            timestamp_s=self._frame.timestamp_s,
            correspondences=Correspondences(
                points_world=points, pixels=pixels, depths_m=np.zeros(len(points))
            ),
            camera=self._frame.camera,
            inlier_px=self.options.inlier_px,
            max_iterations=self.options.max_iterations,
            against=against,  # type: ignore[arg-type]
        )

    def _confirm(
        self, segment: _Segment, features: ViewFeatures, answer: Answer, matches: int,
        around: int | None = None,
    ) -> tuple[_Posed | None, str]:  # fmt: skip
        """Return the pose that fits all landmarks near that of an answer, or why there is none."""
        asked = min(matches, self.options.max_matches)
        pose = None if answer.T_camera_world is None else rigid(answer.T_camera_world)
        if pose is None or answer.inliers < max(self.options.min_inliers, _TRACKED_RATIO * asked):
            return None, "the matches agree on no pose"
        fitted = self._fit(segment, features, pose, _CONFIRM_PX, around)
        if fitted is None:
            return None, "too few landmarks agree with the pose"
        return replace(fitted, matches=matches, is_weak=answer.is_weak), ""

    def _fit(
        self, segment: _Segment, features: ViewFeatures, T_camera_world: Array, radius_px: float,
        around: int | None = None,
    ) -> _Posed | None:  # fmt: skip
        """Match all landmarks that a pose should see, and fit the pose to them; None if too few agree."""
        limits, least = self.options.limits, self.options.min_inliers
        pose = T_camera_world
        for radius in (radius_px, _LAST_PX):
            near = NearLimits(radius_px=radius, ratio=0.9)
            matched = _matched_near(segment, features, pose, near, around)
            count = len(matched)
            if count < least:
                return None
            observed = Observations(
                points=segment.map.points[matched.landmarks],
                spreads=np.broadcast_to(_NO_SPREAD, (count, 3, 3)),
                pixels=features.image.pixels[matched.features],
                pixels_px=limits.pixel_sigma * features.image.sizes[matched.features],
                depths_m=np.zeros(count),
                depths_dev_m=np.ones(count),
            )
            fitted = fit_pose(observed, segment.map.camera, pose, gate2=limits.outlier_sigma**2)
            if fitted is None or fitted.is_inlier.sum() < least:
                return None
            rotated = rigid(fitted.T_camera_world)
            if rotated is None:
                return None
            pose, is_inlier = rotated, fitted.is_inlier
        landmarks = np.full(len(features.image), NO_LANDMARK)
        landmarks[matched.features[is_inlier]] = matched.landmarks[is_inlier]
        return _Posed(
            features=features, T_camera_world=pose, landmarks=landmarks, matches=count, is_weak=False
        )

    # --- the start of a segment ---

    def _start_or_lose(self, features: ViewFeatures, reason: str) -> TrackedFrame:
        """Wait for a second view with parallax; then begin a segment, if so many frames before were lost."""
        if len(features.image) >= _MIN_START_MATCHES:
            self.unrecognised += 1
            views, rows, columns, why = self._two_views(features)
            if views is not None and (not self._segments or self.unrecognised > self.options.segment_after):
                return self._begin(features, views, rows, columns)
            self._waiting.append((self._frame.timestamp_s, features))
            reason = reason if self._segments else why
        elif not self._segments:
            reason = f"only {len(features.image)} features"
        if self._segments:
            self.lost_frames += 1
            self._last = None
            return self._without_pose("lost", reason)
        self.starting_frames += 1
        return self._without_pose("starting", reason)

    def _two_views(self, features: ViewFeatures) -> tuple[TwoViewStart | None, Rows, Rows, str]:
        """Return the start by the oldest waiting view that still shows the same, or why there is none."""
        none = np.empty(0, dtype=np.int64)
        reason = "the first frame"
        while self._waiting:
            first = self._waiting[0][1]
            rows, columns = match_all(first.image.descriptors, features.image.descriptors)
            if len(rows) >= _MIN_START_MATCHES and len(self._waiting) < _MAX_WAITING:
                views = start_from_two_views(
                    first.image.pixels[rows], features.image.pixels[columns], self._frame.camera,
                    min_parallax_deg=self.options.start_parallax_deg,
                )  # fmt: skip
                return (None if views.reason else views), rows, columns, views.reason
            self._waiting.pop(0)
            reason = f"only {len(rows)} matches with the first view"
        return None, none, none, reason

    def _begin(self, features: ViewFeatures, views: TwoViewStart, rows: Rows, columns: Rows) -> TrackedFrame:
        """Begin a segment with two views; place the frames between them."""
        first_s, first = self._waiting[0]
        unit = _START_DEPTH / float(np.median(views.points[:, 2]))
        made = LandmarkMap(self._frame.camera, self.options.limits, self._slots.optimiser or adjust)
        made.add_keyframe(first, np.eye(4), np.full(len(first.image), NO_LANDMARK))
        pose = scaled(views.T_second_first, unit)
        made.add_keyframe(features, pose, np.full(len(features.image), NO_LANDMARK))
        made.add_landmarks(unit * views.points, (0, rows[views.rows]), (1, columns[views.rows]))
        made.adjust_all()
        is_first = not self._segments
        self._segment = self._begun
        self._begun += 1
        own = self._segments[self._segment] = _Segment(map=made)
        own.refer_to(1)
        own.place(first_s, np.eye(4), 0)
        second = made.keyframes[1]
        before = self._place_waiting(own, second.T_camera_world)
        if not is_first:
            self.lost_frames -= len(own.placed)
        posed = _Posed(
            features=features, T_camera_world=second.T_camera_world, landmarks=second.landmarks,
            matches=len(rows), is_weak=False,
        )  # fmt: skip
        self._motion = np.eye(4) if before is None else second.T_camera_world @ inverse(before)
        self._last, self._similar, self.unrecognised, self._loop_from = posed, None, 0, 0
        self._last_s = self._frame.timestamp_s
        return self._result(posed, keyframe=True)

    def _place_waiting(self, own: _Segment, T_second: Array) -> Array | None:
        """Give the frames between the two views their poses; return that of the last one, if it has one."""
        count = len(self._waiting)
        pose, last = np.eye(4), None
        for number, (timestamp_s, features) in enumerate(self._waiting[1:], start=1):
            guess = pose.copy()
            guess[:3, 3] += (T_second[:3, 3] - pose[:3, 3]) / (count - number + 1)
            posed = self._fit(own, features, guess, self.options.search_px)
            last = None
            if posed is not None:
                last = pose = posed.T_camera_world
                own.place(timestamp_s, pose, 0)
        self._waiting = []
        return last

    # --- results ---

    def _keep(self, posed: _Posed) -> bool:
        """Take a posed frame as the last one, and into the map; say whether it became a keyframe."""
        own, T = self._own, posed.T_camera_world
        self._motion = np.eye(4) if self._last is None else T @ inverse(self._last.T_camera_world)
        self.unrecognised = 0
        keyframe = not posed.is_weak and self._is_keyframe(posed)
        if keyframe:
            number = own.map.add_keyframe(posed.features, T, posed.landmarks)
            own.map.extend(number)
            own.map.adjust_around(number)
            own.map.cull()
            own.refer_to(number)
            made = own.map.keyframes[number]
            posed = replace(posed, T_camera_world=made.T_camera_world, landmarks=made.landmarks)
        if self._slots.motion is not None:
            if self._last is None or keyframe:  # lost before, or the map was adjusted
                self._slots.motion.clear()
            self._slots.motion.add(self._frame.timestamp_s, inverse(posed.T_camera_world))
        self._last, self._last_s = posed, self._frame.timestamp_s
        return keyframe

    def _is_keyframe(self, posed: _Posed) -> bool:
        options, own = self.options, self._own
        if len(own.map.keyframes) >= options.limits.max_keyframes:
            return False
        reference = own.map.keyframes[own.reference].T_camera_world
        moved, turned_deg = pose_difference(posed.T_camera_world, reference)
        depth = own.map.median_depth(own.reference)
        return (
            posed.inliers < options.keyframe_share * own.reference_seen
            or turned_deg > options.keyframe_deg
            or moved > options.keyframe_depth_percent / 100 * depth
        )

    def _result(self, posed: _Posed, *, keyframe: bool) -> TrackedFrame:
        assert self._last is not None
        T = self._last.T_camera_world
        self._own.place(self._frame.timestamp_s, T, self._own.reference)
        is_apart = self._segment != min(self._segments)
        return TrackedFrame(
            frame=self._frame, T_world_camera=self._T_world_start @ inverse(T), keyframe=keyframe,
            inliers=posed.inliers, matches=posed.matches, segment=self._segment, scale="up to scale",
            features=self._raw,
            reason="in a segment that is not joined to the first one yet" if is_apart else "",
        )  # fmt: skip

    def _without_pose(self, status: Literal["lost", "starting"], reason: str) -> TrackedFrame:
        return TrackedFrame(
            frame=self._frame, T_world_camera=None, keyframe=False, inliers=0, matches=0, status=status,
            reason=reason, segment=self._segment, scale="up to scale", features=self._raw,
        )  # fmt: skip


def _matched_near(
    segment: _Segment, features: ViewFeatures, T_camera_world: Array, limits: NearLimits,
    around: int | None = None,
) -> _Matched:  # fmt: skip
    """Match the landmarks around a keyframe, that of reference by default, near the pixels of a pose."""
    own = segment.map
    numbers = own.around(segment.reference if around is None else around)
    rows, columns = own.landmarks(numbers).seek(
        T_camera_world, own.camera, features.image, limits, limits.radius_px
    )
    return _Matched(landmarks=numbers[rows], features=columns)


def _agree(one: _Similarity, two: _Similarity, centre: Array, depth: float) -> bool:
    """Say whether two measurements move the camera's centre to one place, turned and scaled alike."""
    places = [transform(similar.T, similar.scale * centre[None])[0] for similar in (one, two)]
    _, apart_deg = pose_difference(one.T, two.T)
    ratio = max(one.scale / two.scale, two.scale / one.scale)
    apart = float(np.linalg.norm(places[0] - places[1]))
    return apart <= _AGREE_DEPTH * depth and apart_deg <= _AGREE_DEG and ratio <= _AGREE_SCALE


def _found(frame: Frame, count: int, slots: Slots) -> Features:
    """Return features that are spread over the image, without points."""
    described = describe(frame.rgb, count, slot=slots.features)
    return Features(
        pixels=described.pixels, descriptors=described.descriptors, turns=described.turns,
        sizes=described.sizes, points_camera=np.full((len(described.pixels), 3), np.nan), kind=described.kind,
        is_oriented=described.is_oriented, is_scaled=described.is_scaled,
    )  # fmt: skip


def _looked_up(frame: Frame, found: Features, slots: Slots) -> ViewFeatures:
    """Return features with their colours and the place that they show."""
    last = np.array([frame.camera.width - 1, frame.camera.height - 1])
    columns, rows = np.clip(np.rint(found.pixels).astype(np.int64), 0, last).T
    image = ImageFeatures(
        pixels=found.pixels, descriptors=found.descriptors, turns=found.turns, sizes=found.sizes,
        distinct=distinct_distances(found.descriptors, found.pixels),
        is_oriented=found.is_oriented, is_scaled=found.is_scaled,
    )  # fmt: skip
    place = place_of(found.descriptors, frame.rgb, slots.loops)
    return ViewFeatures(image=image, colours=frame.rgb[rows, columns], place=place)
