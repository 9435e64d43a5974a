"""Track a camera without depth against its map of landmarks.

`MonocularTracker` is a state machine without input or output, with the steps of `Tracker`: extract features,
predict the pose, match landmarks, solve the pose (elsewhere, by a query), verify it, decide what becomes of
the frame, and keep it in the map.  Each segment has an arbitrary unit of length.  `MonocularTracker.rescale`
changes it, which `Mapper` calls once the metric scale is known; a segment that is joined to an older one
takes the unit of the older one at that time.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import (
    Features,
    Frame,
    MonocularOptions,
    PoseQuery,
    TrackedFrame,
    describe,
    make_features,
)
from client_sdk.monocular.bundle import adjust
from client_sdk.plugins import Plugins
from client_sdk.tracking.landmark_map import (
    MAX_KEYFRAMES,
    MIN_SHARED_LANDMARKS,
    LandmarkMap,
    MonocularView,
)
from client_sdk.tracking.landmark_matching import (
    GUIDED_MATCHES_FACTOR,
    JOIN_INTERVAL_FRAMES,
    LATEST_KEYFRAMES,
    NO_LANDMARK,
    VERIFY_RADIUS_PX,
    Candidate,
    Matches,
    make_place_vector,
    match_candidates,
    match_known_places,
    match_other_segments,
    shift_landmarks,
)
from client_sdk.tracking.monocular_segment import (
    AdjustedKeyframe,
    MonocularSegment,
    PosedView,
    Similarity,
    measure_scale,
)
from client_sdk.tracking.pose_queries import CLEAR_INLIERS, FrameSteps, OpenQuery, QueryAnswer, make_query
from client_sdk.tracking.reachability import (
    DRIFT_DEPTH_SHARE,
    MAX_DRIFT,
    REACH_DEPTH_SHARE,
    Reach,
    reach_after,
    reach_at_begin,
)
from client_sdk.tracking.segment_join import (
    NOT_JOINED,
    REPEATED,
    Join,
    carried_segment_after,
    root_of,
    without_segment,
)
from client_sdk.tracking.waiting_frames import MIN_START_MATCHES, Start, WaitingFrames
from client_sdk.trajectory import Trajectory
from client_sdk.wheel_odometry import WheelMotion
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, pose_difference, scaled, transform
from rse_pf.slam.tracking import GuidedMatchLimits

__all__ = ["MonocularTracker"]

Rows = npt.NDArray[np.int64]

_FEATURES_WIDTH_PX = 640
"""Image width for which `MonocularOptions.features` is meant; wider images have proportionally more
features."""
_MAX_FEATURES = 2000
"""Largest number of features of a wide image, unless `MonocularOptions.features` itself is larger: bounds the
time of a frame."""
_START_DEPTH = 2.0
"""Median depth of a segment's first landmarks in its arbitrary unit: large enough that the rounding of points
to 0.0001 units in a pose query does not matter."""
_WIDE_SEARCH_FACTOR = 2.5
"""Radius of the second guided search as a multiple of ``search_px``, for a camera that moved unexpectedly."""
_MIN_BASELINE_M = 0.05
"""Shortest motion of the camera by wheels between the two views that begin a segment, in metres, that gives
the scale of the segment until a source of scale does: in a shorter one the slip of single steps is large."""
_TRACKED_RATIO = 0.25
"""Smallest share of inliers among the matches that a query sent, for its pose to be accepted."""
_LOOP_CANDIDATES = 2
"""Number of similar older keyframes with which a new keyframe is matched to find a loop closure: bounds the
time of a keyframe."""
_LOOP_AGE_KEYFRAMES = 15
"""Smallest difference of the numbers of the two keyframes of a loop closure: nearer keyframes are connected
by common landmarks anyway.  After a loop closure, the next one is looked for this many keyframes later."""
_MERGE_ITERATIONS = 6
"""Iterations of the bundle adjustment of all keyframes after a join, after a loop closure, and in
`MonocularTracker.adjust`: bounds its time to seconds.  The two keyframes of a new segment are adjusted with
the default of `LandmarkMap.adjust_all`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _TrackState:
    """What a tracker knows of the camera between two frames.

    Attributes:
        segment: Number of the present segment.
        last: The last frame with its pose; None after a loss and after `MonocularTracker.adjust`.
        timestamp_s: Time of the last pose, in seconds.
        T_next_last: ``(4, 4)``, maps the frame of the last camera to that of the next one: the motion between
            the last two frames, which is assumed to repeat; the identity after a loss.
        unrecognised: Number of frames since the last accepted pose that show at least 100 features and no
            known place.
        candidate: Where the segment may lie in another one, or its newest part in an older one, measured once
            and not confirmed by a second measurement; None without one.
        first_position: ``(3,)``, of the camera in the present segment at the first of the measurements in a
            row that agree with the candidate.
        next_loop_keyframe: Number of the first keyframe for which a loop closure is looked for, after the
            last loop closure.
    """

    segment: int = 0
    last: PosedView | None = None
    timestamp_s: float = 0.0
    T_next_last: Array = field(default_factory=lambda: np.eye(4))
    unrecognised: int = 0
    candidate: Similarity | None = None
    first_position: Array = field(default_factory=lambda: np.zeros(3))
    next_loop_keyframe: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Attempt:
    """Matches of a frame by which its pose is to be solved.

    Attributes:
        matches: The matches.
        segment: Number of the segment whose landmarks are matched.
        against: The source of the landmarks, see `PoseQuery`.
        min_matches: Fewest matches for which the pose is queried.
        keyframe: Keyframe by which the place is recognised; None around the last pose.
    """

    matches: Matches
    segment: int
    against: Literal["map", "frame", "keyframe"]
    min_matches: int
    keyframe: int | None = None


class MonocularTracker:
    """Visual odometry of one camera without depth, with relocalisation and loop closure.

    Use it as `Tracker`: ``prepare(frame)``, then ``accept(query, T_camera_world, inliers)`` until a
    `TrackedFrame` comes back.

    A segment begins with two views that have parallax; when the second view comes, the frames that waited
    before it also get poses.  A frame is matched near the pixels at which a constant velocity predicts the
    landmarks around the reference keyframe, then in a wider radius, then with the last frame, then with the
    newest keyframes and with the most similar keyframes of all segments; such a place is accepted only if the
    camera can have moved there.  If no pose fits, the frame is lost, and waits for the start of a new
    segment.  Two segments are joined when two measurements in a row agree where one lies in the other, under
    the same condition; the newer segment is moved into the older one, whose unit it takes.  An older place of
    the same segment that is recognised twice closes a loop and corrects what drifted in between, if the
    camera can have drifted that far.

    Attributes:
        options: Options of tracking.
        frames: Number of frames so far.
        lost_frames: Number of frames without a pose after the first start.  Frames that get their poses when
            a later segment begins are subtracted again.
        starting_frames: Number of frames without a pose before the first start, also those that get their
            poses then.
        joins: All joins of segments so far, in their order.
        loop_scales: For each loop closure so far, the factor by which it multiplied the lengths around the
            newest frames, in their order.
    """

    def __init__(
        self,
        options: MonocularOptions | None = None,
        T_world_start: Array | None = None,
        plugins: Plugins | None = None,
    ) -> None:
        self.options = options or MonocularOptions()
        self.frames = 0
        self.lost_frames = 0
        self.starting_frames = 0
        self.loop_scales: list[float] = []
        self.joins: list[Join] = []
        self._plugins = plugins or Plugins()
        self._T_world_start = np.eye(4) if T_world_start is None else T_world_start
        self._state = _TrackState()
        self._segments: dict[int, MonocularSegment] = {}
        self._next_segment = 0
        self._anchors: dict[int, int] = {}
        """The segment in whose world a segment began, because the wheels had carried the pose."""
        self._has_missing_answer = False
        self._waiting = WaitingFrames(self.options.start_parallax_deg)
        self._frame: Frame  # the frame that is tracked, set by `prepare`
        self._raw: Features  # its features
        self._open = OpenQuery()

    @property
    def keyframes(self) -> int:
        """The number of keyframes of all segments."""
        return sum(segment.map.keyframe_count for segment in self._segments.values())

    @property
    def loops(self) -> int:
        """The number of loop closures."""
        return len(self.loop_scales)

    @property
    def segment(self) -> int:
        """The number of the segment of the newest pose; 0 before the first pose."""
        return self._state.segment

    @property
    def last_pose(self) -> tuple[float, Array] | None:
        """Time in seconds and ``T_world_camera`` ``(4, 4)`` of the last pose; None before the first.

        The pose is in the present segment, with its corrections and in its unit.
        """
        if not self._segments:
            return None
        timestamp_s, T_camera_world = self._present.last_pose
        return timestamp_s, self._T_world_start @ inverse(T_camera_world)

    @property
    def connected(self) -> frozenset[int]:
        """Numbers of the segments, without the first one, that wheels have connected with its world."""
        return frozenset(
            number for number in self._anchors if root_of(self._anchors, number) == min(self._segments)
        )

    @property
    def segments(self) -> tuple[int, ...]:
        """The numbers of all segments that were not joined to others, ascending; the first is 0."""
        return tuple(sorted(self._segments))

    @property
    def length_factor(self) -> float:
        """Factor by which `rescale` and loop closures multiplied the lengths around the newest frames so far.

        The factor is 1 when the present segment begins.  Before the first segment it must not be read.
        """
        return self._present.length_factor

    @property
    def segment_keyframes(self) -> int:
        """The number of keyframes of the present segment; not to be read before the first segment."""
        return self._present.map.keyframe_count

    def keyframe(self, number: int, segment: int | None = None) -> AdjustedKeyframe:
        """Return a keyframe of a segment as it is adjusted now; of the present segment for None."""
        own = self._present if segment is None else self._segments[segment]
        keyframe = own.map.keyframes[number]
        return AdjustedKeyframe(
            timestamp_s=next(frame.timestamp_s for frame in own.frames if frame.keyframe == number),
            T_world_camera=self._T_world_start @ inverse(keyframe.T_camera_world),
            features=keyframe.view.features,
            depths=own.map.depths(number),
        )

    def keyframe_pose(self, number: int) -> Array:
        """Return ``T_world_camera`` ``(4, 4)`` of a keyframe of the present segment as it is adjusted now."""
        pose: Array = self._T_world_start @ inverse(self._present.map.keyframes[number].T_camera_world)
        return pose

    def keyframes_of(self, segment: int) -> Iterator[AdjustedKeyframe]:
        """Yield the keyframes of a segment as they are adjusted now, oldest first.

        A segment that does not exist has none.
        """
        for number in range(self._segments[segment].map.keyframe_count if segment in self._segments else 0):
            yield self.keyframe(number, segment)

    def prepare(self, frame: Frame) -> PoseQuery | TrackedFrame:
        """Take the next frame; return a query for its pose, or its result if no query is needed.

        Raises:
            UsageError: The last query was not answered yet, the frame has another camera than those before,
                or a user's feature extractor failed.
        """
        self._open.refuse_open()
        if self._segments and frame.camera != self._present.map.camera:
            raise UsageError(
                "the camera of this frame is another one: its intrinsics or its size differ",
                hint="use one tracker per camera",
            )
        self.frames += 1
        self._has_missing_answer = False
        self._frame, view = frame, self._extract(frame)
        self._raw = view.features
        return self._open.begin(self._track(view))

    def skip(self, frame: Frame) -> TrackedFrame:
        """Lose the next frame without looking at its image, which repeats while the wheels turn.

        Raises:
            UsageError: The last query was not answered yet.
        """
        self._open.refuse_open()
        self.frames += 1
        self.lost_frames += bool(self._segments)
        self.starting_frames += not self._segments
        return TrackedFrame(
            frame=frame,
            T_world_camera=None,
            keyframe=False,
            inliers=0,
            matches=0,
            status="lost" if self._segments else "starting",
            reason=REPEATED,
            segment=self.segment,
            scale="up to scale",
        )

    def accept(
        self,
        query: PoseQuery,
        T_camera_world: Array | None,
        inliers: int = 0,
        *,
        is_weak: bool = False,
        is_missing: bool = False,
    ) -> PoseQuery | TrackedFrame:
        """Take the answer to *query*; return another query, or the result of the frame.

        Args:
            query: The query that `prepare` or `accept` returned last.
            T_camera_world: ``(4, 4)`` as the PnP service returns it, where world is the frame of the query's
                points and the unit is theirs; None if there was no answer.
            inliers: Number of correspondences that agree with the pose.
            is_weak: Whether the service calls the evidence for the pose weak; the frame becomes no keyframe
                then.
            is_missing: Whether there was no answer.  With wheel odometry such a frame does not count as
                unrecognised.

        Raises:
            UsageError: *query* is not the open one.
        """
        return self._open.answer(query, QueryAnswer(T_camera_world, inliers, is_weak, is_missing))

    def trajectory(self, segment: int = 0) -> Trajectory:
        """Return all poses of a segment in the order of time, as its keyframes are adjusted now.

        A segment that does not exist has none.
        """
        if segment not in self._segments:
            return Trajectory(np.empty(0), np.empty((0, 4, 4)))
        path = self._segments[segment].trajectory()
        return Trajectory(path.timestamps_s, self._T_world_start @ path.T_world_camera)

    def world_trajectory(self) -> Trajectory:
        """Return the poses of segment 0, and of all segments that wheels have connected with its world."""
        paths = [self.trajectory(segment) for segment in (0, *sorted(self.connected))]
        stamps_s = np.concatenate([path.timestamps_s for path in paths])
        order = np.argsort(stamps_s, kind="stable")
        return Trajectory(stamps_s[order], np.concatenate([path.T_world_camera for path in paths])[order])

    def points(self, segment: int = 0) -> tuple[Array, npt.NDArray[np.uint8]]:
        """Return the ``(n, 3)`` landmarks of a segment in the world and their ``(n, 3)`` uint8 colours.

        A segment that does not exist has none.
        """
        if segment not in self._segments:
            return np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)
        own = self._segments[segment].map
        return transform(self._T_world_start, own.points[own.is_alive]), own.colours[own.is_alive]

    def median_depth(self, segment: int = 0) -> float:
        """Return the median depth of a segment's reference keyframe, in the segment's unit.

        The depth is 1 for a segment that does not exist, and without landmarks.
        """
        own = self._segments.get(segment)
        return 1.0 if own is None else own.map.median_depth(own.reference)

    def adjust(self) -> None:
        """Adjust all keyframes and landmarks of each segment together, such as at the end of a drive.

        This takes seconds, and corrects poses that were returned before.  A segment of more than 200
        keyframes stays as it is.  The next frame is relocalised.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        for segment in self._segments.values():
            segment.map.adjust_all(iterations=_MERGE_ITERATIONS)
        self._state = replace(self._state, last=None, candidate=None)

    def rescale(self, scale: float, segment: int = 0) -> None:
        """Multiply all lengths of a segment by *scale*, such as by the metres per unit.

        The lengths are multiplied about the position of *T_world_start*, where segment 0 begins; those of a
        segment that wheels have connected about its first position.  The poses and points of the segment that
        were returned before change, but for a pose at that position.  A segment that does not exist is
        ignored.
        """
        if segment not in self._segments:
            return
        own, T_new_old = self._segments[segment], np.eye(4)
        T_new_old[:3, 3] = (1.0 - scale) * own.origin
        own.move(T_new_old, scale)
        own.is_metric = True
        self._state = replace(self._state, candidate=None)
        if segment == self._state.segment:
            self._move_state(T_new_old, scale)

    def turn(self, T_new_old: Array) -> None:
        """Express all poses in a rotated world, such as after gravity became known.

        Poses that were returned before are ``T_new_old @ T_world_camera`` in the new world.
        """
        self._T_world_start = T_new_old @ self._T_world_start

    # --- The steps of one frame ---

    def _track(self, view: MonocularView) -> FrameSteps:
        """Yield the queries of the present frame, and return its result."""
        # 1. Predict, match, solve and verify: around the last pose, then at all known places.
        posed, reason = yield from self._pose(view)
        # 2. Decide: without a pose, the frame is lost or begins a segment.
        if posed is None:
            return self._start_or_lose(view, reason)
        # 3. Keep the frame in the map, and look for its place in other segments or earlier in this one.
        self._waiting.clear()
        is_keyframe = self._keep(posed)
        if len(self._segments) > 1 and self.frames % JOIN_INTERVAL_FRAMES == 0:
            yield from self._find_join()
        elif is_keyframe:
            yield from self._find_loop()
        return self._make_result(posed, is_keyframe=is_keyframe)

    # --- Extract ---

    def _extract(self, frame: Frame) -> MonocularView:
        """Return the image of a frame, with features that are spread over it and have no 3-D points."""
        wider = max(1.0, frame.camera.width / _FEATURES_WIDTH_PX)
        count = int(min(max(self.options.features, _MAX_FEATURES), self.options.features * wider))
        described = describe(frame.rgb, count, plugin=self._plugins.features)
        no_points = np.broadcast_to(np.nan, (len(described.pixels), 3))  # takes no memory
        features = make_features(described, no_points)
        last_pixel = np.array([frame.camera.width - 1, frame.camera.height - 1])
        columns, lines = np.clip(np.rint(features.pixels).astype(np.int64), 0, last_pixel).T
        return MonocularView(
            features=features,
            colours=frame.rgb[lines, columns],
            place_vector=make_place_vector(features.descriptors, frame.rgb, self._plugins.loops),
        )

    # --- Predict and match ---

    def _predict_pose(self, last: PosedView) -> Array:
        """Predict ``T_camera_world`` ``(4, 4)`` of the frame by a user's motion model, if it returns a pose.

        Otherwise the motion between the last two frames is repeated, whatever time has passed; that of the
        wheels takes its place in a metric segment.  The rotation is replaced by that of the gyroscope, where
        there is one.
        """
        state, now_s = self._state, self._frame.timestamp_s
        T_world_camera = self._plugins.predict_pose(now_s)
        if T_world_camera is not None:
            return inverse(T_world_camera)
        T_last_next = self._plugins.predict_motion(
            inverse(state.T_next_last), state.timestamp_s, now_s, is_metric=self._present.is_metric
        )
        predicted: Array = inverse(T_last_next) @ last.T_camera_world
        return predicted

    def _carry(self, timestamp_s: float) -> tuple[Array, WheelMotion] | None:
        """Return ``T_camera_world`` ``(4, 4)``, carried by the wheels to a time, and their motion since.

        None without a metric pose, and if the wheels do not tell the motion.
        """
        if not self._segments or not self._present.is_metric:
            return None
        last_s, T_camera_world = self._present.last_pose
        motion = self._plugins.wheel_motion(last_s, timestamp_s)
        if motion is None:
            return None
        return inverse(motion.T_camera_begin_end) @ T_camera_world, motion

    def _match_around_last_pose(self, view: MonocularView) -> Iterator[_Attempt]:
        """Match a frame near the predicted pixels, then in a wider radius, then with the last frame.

        After a loss, frames are matched only near the pixels that a pose carried by the wheels predicts.
        """
        last, number, min_inliers = self._state.last, self._state.segment, self.options.min_inliers
        carried = self._carry(self._frame.timestamp_s) if last is None else None
        if last is not None:
            T_predicted = self._predict_pose(last)
        elif carried is not None:
            T_predicted = carried[0]
        else:
            return
        min_guided_matches = GUIDED_MATCHES_FACTOR * min_inliers
        for factor in (1.0, _WIDE_SEARCH_FACTOR):
            limits = GuidedMatchLimits(radius_px=factor * self.options.search_px)
            matches = self._present.match(view, T_predicted, limits)
            yield _Attempt(matches=matches, segment=number, against="map", min_matches=min_guided_matches)
        if last is None:
            return
        matches = self._present.match_last_frame(view, last)
        yield _Attempt(matches=matches, segment=number, against="frame", min_matches=min_inliers)

    def _match_known_places(self, view: MonocularView) -> Iterator[_Attempt]:
        """Match a frame with the three keyframes of all segments that have the most matches.

        Of these, only the best one may have too few matches for a query.
        """
        min_inliers, present = self.options.min_inliers, self._state.segment
        candidates = match_known_places(self._maps, view.place_vector, view.features, present)
        for rank, candidate in enumerate(candidates):
            if rank == 0 or len(candidate.matches) >= min_inliers:
                yield _Attempt(
                    matches=candidate.matches,
                    segment=candidate.segment,
                    against="keyframe",
                    min_matches=min_inliers,
                    keyframe=candidate.keyframe,
                )

    # --- Solve ---

    def _pose(self, view: MonocularView) -> Generator[PoseQuery, QueryAnswer, tuple[PosedView | None, str]]:
        """Ask for the pose of a frame by one attempt after the other, until one gives a verified pose.

        If the pose is found by a keyframe, the segment of the keyframe becomes the present one, and the
        keyframe its reference keyframe.  Returned are the image with its verified pose and an empty text, or
        None and why the last attempt failed.
        """
        reason = "a place that was not seen before"
        for attempt in chain(self._match_around_last_pose(view), self._match_known_places(view)):
            count, segment = len(attempt.matches), self._segments[attempt.segment]
            if count < attempt.min_matches:
                reason = f"only {count} matches with the map"
                continue
            # 1. Solve the pose by a query.
            answer = yield self._make_query(view, attempt.matches, attempt.against)
            self._has_missing_answer |= answer.is_missing
            reason = "the matches agree on no pose"
            # 2. Far from the newest keyframes, only a clear answer is accepted: perceptual aliases, places
            #    that look alike, exist.
            keyframe = attempt.keyframe
            if keyframe is not None:
                is_new = keyframe >= segment.map.keyframe_count - LATEST_KEYFRAMES
                is_near = is_new and attempt.segment == self._state.segment
                if not (is_near or self._is_clear(answer, count)):
                    continue
            # 3. Verify the pose by the landmarks around the keyframe, or around the reference keyframe.
            posed, reason = self._verify(segment, view, answer, count, keyframe)
            if posed is None:
                continue
            # 4. Accept a known place only if the camera can have moved there: another one may look the same.
            is_sought = keyframe is not None or self._state.last is None
            if is_sought and not self._is_reachable(posed, attempt):
                reason = "a place to which the camera cannot have moved"
                continue
            if keyframe is not None:
                self._state = replace(self._state, segment=attempt.segment, last=None, candidate=None)
                segment.set_reference(keyframe)
            return posed, ""
        return None, reason

    @property
    def _present(self) -> MonocularSegment:
        return self._segments[self._state.segment]

    @property
    def _maps(self) -> dict[int, LandmarkMap]:
        """The map of each segment by its number."""
        return {number: segment.map for number, segment in self._segments.items()}

    # --- Query and verify ---

    def _make_query(
        self, view: MonocularView, matches: Matches, against: Literal["map", "frame", "keyframe", "segment"]
    ) -> PoseQuery:
        return make_query(
            self._frame,
            matches,
            view.features,
            inlier_px=self.options.inlier_px,
            max_iterations=self.options.max_iterations,
            max_matches=self.options.max_matches,
            against=against,
        )

    def _is_clear(self, answer: QueryAnswer, match_count: int) -> bool:
        """Return whether an answer alone proves a place.

        *match_count* is the number of all matches, of which the query may have sent only a part.
        """
        return answer.is_clear(min(match_count, self.options.max_matches))

    def _verify(
        self,
        segment: MonocularSegment,
        view: MonocularView,
        answer: QueryAnswer,
        match_count: int,
        around: int | None = None,
    ) -> tuple[PosedView | None, str]:
        """Fit the pose of an answer to all landmarks around a keyframe.

        Returned are the image with the fitted pose and an empty text, or None and why there is no pose.

        Args:
            segment: The segment in which the pose was solved.
            view: The image.
            answer: The answer to its query.
            match_count: Number of matches of the query.
            around: Keyframe around which landmarks are matched; None for the reference keyframe.
        """
        sent = min(match_count, self.options.max_matches)
        pose = answer.accepted_pose(max(self.options.min_inliers, _TRACKED_RATIO * sent))
        if pose is None:
            return None, "the matches agree on no pose"
        fitted = segment.fit(view, pose, VERIFY_RADIUS_PX, self.options.min_inliers, around)
        if fitted is None:
            return None, "too few landmarks agree with the pose"
        return replace(fitted, matches=match_count, is_weak=answer.is_weak), ""

    def _is_reachable(self, posed: PosedView, attempt: _Attempt) -> bool:
        """Return whether the camera can have moved to a recognised place since its last pose.

        A frame after a tracked one may be anywhere near its pose: the motion between two images can change.
        After a loss, wheels tell where it can have moved.
        """
        position, last = inverse(posed.T_camera_world)[:3, 3], self._state.last
        distance = float(np.median(np.linalg.norm(attempt.matches.points - position, axis=1)))
        carried = None if last is not None else self._carry(self._frame.timestamp_s)
        own_root = root_of(self._anchors, self._state.segment)
        if carried is not None and root_of(self._anchors, attempt.segment) == own_root:
            by_wheels = Reach(inverse(carried[0])[:3, 3], carried[1].reach_m)
            return by_wheels.excess(position) <= REACH_DEPTH_SHARE * distance
        moved = math.inf
        if last is not None and attempt.segment == self._state.segment:
            moved = float(np.linalg.norm(position - inverse(last.T_camera_world)[:3, 3]))
        reach = reach_after(self._segments[attempt.segment].trajectory(), self._frame.timestamp_s)
        return moved <= distance or reach.excess(position) <= REACH_DEPTH_SHARE * distance

    # --- The start of a segment ---

    def _start_or_lose(self, view: MonocularView, reason: str) -> TrackedFrame:
        """Let a frame without a pose wait for a second view; or begin a segment with it as the second view.

        A frame with fewer than 100 features is lost without waiting.  A segment after the first begins only
        if more than ``segment_after`` frames with 100 features or more came since the last pose; earlier
        where wheels carry the pose, and then not by frames whose queries nobody has answered.
        """
        carried = self._carry(self._frame.timestamp_s)
        if carried is not None and self._has_missing_answer:
            reason = "no answer"
        elif len(view.features) >= MIN_START_MATCHES:
            self._state = replace(self._state, unrecognised=self._state.unrecognised + 1)
            start, start_reason = self._waiting.find_start(view, self._frame.camera)
            after = self.options.segment_after
            after = after if carried is None else carried_segment_after(after)
            may_begin = not self._segments or self._state.unrecognised > after
            if start is not None and may_begin:
                return self._begin_segment(view, start)
            self._waiting.add(self._frame.timestamp_s, view)
            reason = reason if self._segments else start_reason
        elif not self._segments:
            reason = f"only {len(view.features)} features"
        if self._segments:
            self.lost_frames += 1
            self._state = replace(self._state, last=None)
            return self._make_result_without_pose("lost", reason)
        self.starting_frames += 1
        return self._make_result_without_pose("starting", reason)

    def _begin_segment(self, view: MonocularView, start: Start) -> TrackedFrame:
        """Begin a segment with a waiting view and the present one."""
        # 1. Make a map of two keyframes in a unit in which the median depth is 2, and adjust it.
        views = start.views
        first_s, first = self._waiting.frame(start.first)
        unit = _START_DEPTH / float(np.median(views.points[:, 2]))
        adjuster = self._plugins.optimiser or adjust
        new_map = LandmarkMap(self._frame.camera, adjuster)
        for new_view, pose in ((first, np.eye(4)), (view, scaled(views.T_second_first, unit))):
            new_map.add_keyframe(new_view, pose, np.full(len(new_view.features), NO_LANDMARK))
        new_map.add_landmarks(
            unit * views.points, (0, start.rows[views.rows]), (1, start.columns[views.rows])
        )
        new_map.adjust_all()
        # 2. Give the frames before the second view their poses.
        is_first = not self._segments
        number = self._next_segment
        self._next_segment += 1
        segment = self._segments[number] = MonocularSegment(map=new_map)
        segment.set_reference(1)
        segment.add_frame(first_s, np.eye(4), 0)
        second = new_map.keyframes[1]
        T_before = self._waiting.fit_poses(
            segment,
            start.first,
            second.T_camera_world,
            search_px=self.options.search_px,
            min_inliers=self.options.min_inliers,
        )
        if not is_first:
            self.lost_frames -= len(segment.frames)
            if self._connect(segment, first_s):
                self._anchors[number] = self._state.segment
                second = new_map.keyframes[1]
                T_before = None
        # 3. Keep the present frame as the last one, from which the next frame is tracked.
        posed = PosedView(
            view=view,
            T_camera_world=second.T_camera_world,
            landmarks=second.landmarks,
            matches=len(start.rows),
            is_weak=False,
        )
        self._state = _TrackState(
            segment=number,
            last=posed,
            timestamp_s=self._frame.timestamp_s,
            T_next_last=np.eye(4) if T_before is None else second.T_camera_world @ inverse(T_before),
        )
        return self._make_result(posed, is_keyframe=True)

    def _connect(self, segment: MonocularSegment, first_s: float) -> bool:
        """Move a new segment to where the wheels have carried the last pose; return whether they tell it.

        *first_s* is the time of its first view; lengths become metres by the motion of the wheels between the
        first two views.
        """
        carried = self._carry(first_s)
        baseline = self._plugins.wheel_motion(first_s, self._frame.timestamp_s)
        if carried is None or baseline is None:
            return False
        length_m = float(np.linalg.norm(baseline.T_camera_begin_end[:3, 3]))
        if length_m < _MIN_BASELINE_M:
            return False
        length = float(np.linalg.norm(segment.map.keyframes[1].T_camera_world[:3, 3]))
        T_world_first = inverse(carried[0])
        segment.move(T_world_first, length_m / length)
        segment.length_factor, segment.is_metric, segment.origin = 1.0, True, T_world_first[:3, 3]
        return True

    # --- Keep ---

    def _keep(self, posed: PosedView) -> bool:
        """Take a frame with a verified pose as the last one, and into the map; return if it is a keyframe."""
        segment, last = self._present, self._state.last
        # 1. Update the motion model; after a loss the motion is not known.
        T_next_last = np.eye(4) if last is None else posed.T_camera_world @ inverse(last.T_camera_world)
        # 2. With a keyframe, extend the map, adjust it, and remove doubtful landmarks.
        is_keyframe = not posed.is_weak and self._is_keyframe(posed)
        if is_keyframe:
            number = segment.map.add_keyframe(posed.view, posed.T_camera_world, posed.landmarks)
            segment.map.extend(number)
            segment.map.adjust_around(number)
            segment.map.cull()
            segment.set_reference(number)
            keyframe = segment.map.keyframes[number]
            posed = replace(posed, T_camera_world=keyframe.T_camera_world, landmarks=keyframe.landmarks)
        # 3. Let the user's motion model forget earlier poses that no longer fit the pose of this frame: the
        # camera was lost before, or the map was adjusted.
        if last is None or is_keyframe:
            self._plugins.forget_poses()
        self._plugins.add_pose(self._frame.timestamp_s, inverse(posed.T_camera_world))
        # 4. Store the frame as the last one, from which the next frame is tracked.
        self._state = replace(
            self._state,
            last=posed,
            timestamp_s=self._frame.timestamp_s,
            T_next_last=T_next_last,
            unrecognised=0,
        )
        return is_keyframe

    def _is_keyframe(self, posed: PosedView) -> bool:
        """Return whether a frame differs much from the reference keyframe, and the map may grow."""
        options, segment = self.options, self._present
        if segment.map.keyframe_count >= MAX_KEYFRAMES:
            return False
        reference = segment.map.keyframes[segment.reference].T_camera_world
        moved, rotated_deg = pose_difference(posed.T_camera_world, reference)
        depth = segment.map.median_depth(segment.reference)
        return (
            posed.inliers < options.keyframe_share * segment.reference_landmarks
            or rotated_deg > options.keyframe_deg
            or moved > options.keyframe_depth_percent / 100 * depth
        )

    def _make_result(self, posed: PosedView, *, is_keyframe: bool) -> TrackedFrame:
        """Add the last pose to its segment, and return it as the result of the frame."""
        last = self._state.last
        assert last is not None
        segment = self._present
        segment.add_frame(self._frame.timestamp_s, last.T_camera_world, segment.reference)
        is_joined = root_of(self._anchors, self._state.segment) == min(self._segments)
        return TrackedFrame(
            frame=self._frame,
            T_world_camera=self._T_world_start @ inverse(last.T_camera_world),
            keyframe=is_keyframe,
            inliers=posed.inliers,
            matches=posed.matches,
            segment=self._state.segment,
            scale="up to scale",
            features=self._raw,
            reason="" if is_joined else NOT_JOINED,
        )

    def _make_result_without_pose(self, status: Literal["lost", "starting"], reason: str) -> TrackedFrame:
        return TrackedFrame(
            frame=self._frame,
            T_world_camera=None,
            keyframe=False,
            inliers=0,
            matches=0,
            status=status,
            reason=reason,
            segment=self._state.segment,
            scale="up to scale",
            features=self._raw,
        )

    # --- Join segments, and close loops ---

    def _find_join(self) -> Generator[PoseQuery, QueryAnswer, None]:
        """Ask for the place of the last frame in other segments; join two once two measurements agree.

        Two measurements are compared if they are of the same other segment and no measurement lies between
        them.
        """
        last, present = self._state.last, self._state.segment
        assert last is not None
        # 1. Measure where the present segment lies by the keyframe of another one with the most matches.
        best = match_other_segments(self._maps, last.view.place_vector, last.view.features, present)
        similarity = yield from self._measure_similarity(last, best)
        if similarity is None:
            return
        # 2. Leave out a place that the camera cannot have reached: it may be another one that looks the same.
        if not self._is_reachable_join(last, similarity):
            return
        # 3. Move the newer of the two segments into the older one, whose poses and unit stay as they are.
        if similarity.segment < present:
            self._join(present, similarity, self._present.reference)
        else:
            back = similarity.inverted(present, self._present.reference)
            self._join(similarity.segment, back, similarity.keyframe)

    def _is_reachable_join(self, last: PosedView, similarity: Similarity) -> bool:
        """Return whether the camera can have moved from the older of two segments to the newer one.

        *similarity* tells where the present segment, which has the frame *last*, lies in another one.
        """
        # 1. Compute how far outside of the camera's reach the newer segment begins, in the other's unit.
        present, other = self._state.segment, similarity.segment
        paths = {number: self._segments[number].trajectory() for number in (present, other)}
        reach = reach_at_begin(paths[min(present, other)], paths[max(present, other)])
        begin, unit = paths[max(present, other)].positions[0], 1.0
        if present < other:
            back = similarity.inverted(present, self._present.reference)
            begin, unit = back.moved(begin), similarity.scale
        else:
            begin = similarity.moved(begin)
        depth = self._segments[other].map.median_depth(similarity.keyframe)
        if unit * reach.excess(begin) <= REACH_DEPTH_SHARE * depth:
            return True
        # 2. Two places that look the same do not overlap: wait until the camera has moved farther than they
        #    can be apart.
        centre = inverse(last.T_camera_world)[:3, 3]
        moved = similarity.scale * float(np.linalg.norm(centre - self._state.first_position))
        return moved >= unit * reach.farthest(begin)

    def _find_loop(self) -> Generator[PoseQuery, QueryAnswer, None]:
        """Ask for the place of a new keyframe among older ones; close a loop once two measurements agree."""
        # 1. Choose older keyframes that share few landmarks with the new one.
        state, own = self._state, self._present.map
        assert state.last is not None
        newest = own.keyframe_count - 1
        shared = own.count_shared_landmarks(newest)[: max(0, newest - _LOOP_AGE_KEYFRAMES)]
        apart = np.flatnonzero(shared < MIN_SHARED_LANDMARKS)
        if not len(apart) or newest < state.next_loop_keyframe:
            return
        view = state.last.view
        similar = own.rank_by_similarity(view.place_vector, _LOOP_CANDIDATES, apart)
        keyframes = [(state.segment, keyframe) for keyframe in similar]
        # 2. Measure where the new keyframe lies by that of the older ones with the most matches.
        best = match_candidates(self._maps, keyframes, view.features)[0]
        similarity = yield from self._measure_similarity(state.last, best)
        if similarity is None:
            return
        # 3. Leave out a place that is farther away than the camera can have drifted: it looks the same.
        positions = own.positions
        length = float(np.linalg.norm(np.diff(positions[best.keyframe :], axis=0), axis=1).sum())
        drift = float(np.linalg.norm(similarity.moved(positions[-1]) - positions[-1]))
        if drift > MAX_DRIFT * length + DRIFT_DEPTH_SHARE * own.median_depth(best.keyframe):
            return
        # 4. Bend the map between the two keyframes, fuse the landmarks of both places, and adjust all.
        self._state = replace(
            self._state,
            T_next_last=scaled(self._state.T_next_last, similarity.scale),
            next_loop_keyframe=newest + _LOOP_AGE_KEYFRAMES,
        )
        self._plugins.forget_poses()
        self._merge_places(similarity.keyframe, newest, similarity)
        self._present.length_factor *= similarity.scale
        self.loop_scales.append(similarity.scale)

    def _measure_similarity(
        self, posed: PosedView, best: Candidate
    ) -> Generator[PoseQuery, QueryAnswer, Similarity | None]:
        """Measure where the present segment lies by the place of a frame at an older or another keyframe.

        Args:
            posed: The frame with its pose in the present segment.
            best: The keyframe, and the matches of its landmarks with the frame.

        Returns:
            The similarity, if the measurement before this one is of the same segment and agrees with it.
            Otherwise None; a new measurement is kept in the state for the comparison with the next one.
        """
        # 1. Solve and verify the pose by the keyframe.
        count, segment = len(best.matches), self._segments[best.segment]
        if count < CLEAR_INLIERS:
            return None
        answer = yield self._make_query(posed.view, best.matches, "segment")
        if not self._is_clear(answer, count):
            return None
        there, _ = self._verify(segment, posed.view, answer, count, best.keyframe)
        if there is None:
            return None
        # 2. Measure the scale by the depths of landmarks in both maps.
        scale = measure_scale(posed, self._present.map, there, segment.map, self.options.min_inliers)
        if scale is None:
            return None
        # 3. Keep the measurement as the candidate, and compare it with the candidate before it.
        measured = Similarity(
            segment=best.segment,
            keyframe=best.keyframe,
            T=inverse(there.T_camera_world) @ scaled(posed.T_camera_world, scale),
            scale=scale,
        )
        previous = self._state.candidate
        centre, depth = inverse(posed.T_camera_world)[:3, 3], segment.map.median_depth(best.keyframe)
        if (
            previous is None
            or previous.segment != best.segment
            or not previous.agrees_with(measured, centre, depth)
        ):
            self._state = replace(self._state, candidate=measured, first_position=centre)
            return None
        self._state = replace(self._state, candidate=measured)
        return measured

    def _join(self, segment: int, similarity: Similarity, keyframe: int) -> None:
        """Move all of *segment*, the newer one, into an older segment, which keeps its frame and its unit.

        Then the landmarks around the place that both segments show are fused, and the joined map is adjusted,
        so that poses of the older segment change as well.

        Args:
            segment: Number of the newer segment.
            similarity: Where the newer segment lies in the older one.
            keyframe: Keyframe of the newer segment that shows the same place as ``similarity.keyframe``, a
                keyframe of the older one; the landmarks around these two keyframes are fused.
        """
        newer, into = self._segments.pop(segment), self._segments[similarity.segment]
        newer.move(similarity.T, similarity.scale)
        first_keyframe, first_landmark = into.append(newer)
        start = self._T_world_start
        T_into_segment = start @ similarity.T @ scaled(inverse(start), similarity.scale)
        self.joins.append(Join(segment, similarity.segment, T_into_segment, similarity.scale))
        self._anchors = without_segment(self._anchors, segment)
        if segment == self._state.segment:
            self._state = replace(self._state, segment=similarity.segment)
            into.set_reference(newer.reference + first_keyframe)
            self._move_state(similarity.T, similarity.scale, first_landmark)
        self._merge_places(similarity.keyframe, first_keyframe + keyframe)

    def _move_state(self, T_new_old: Array, scale: float, first_landmark: int = 0) -> None:
        """Express the last pose in another frame and unit after its segment was moved or appended.

        Args:
            T_new_old: ``(4, 4)``, applied after the lengths are multiplied.
            scale: Factor of all lengths.
            first_landmark: Number of the segment's first landmark in the map that it was appended to.
        """
        state = self._state
        last = state.last
        if last is not None:
            last = replace(
                last,
                T_camera_world=scaled(last.T_camera_world, scale) @ inverse(T_new_old),
                landmarks=shift_landmarks(last.landmarks, first_landmark),
            )
        self._state = replace(state, T_next_last=scaled(state.T_next_last, scale), last=last)
        self._plugins.forget_poses()

    def _merge_places(self, older: int, newer: int, bend_by: Similarity | None = None) -> None:
        """Fuse the landmarks around two keyframes of one place, and adjust the whole present map.

        With *bend_by*, where the newer keyframe lies by the older one, the map between the two is bent
        before, so that the newer keyframe is in its place.  The last pose moves with the reference keyframe.
        """
        own, reference, last = self._present.map, self._present.reference, self._state.last
        T_camera_reference = None
        if last is not None:
            T_camera_reference = last.T_camera_world @ inverse(own.keyframes[reference].T_camera_world)
        if bend_by is not None:
            own.bend(older, newer, bend_by.T, bend_by.scale)
        for keyframe in own.local_keyframes(newer):
            own.fuse(keyframe, own.local_landmarks(older), VERIFY_RADIUS_PX)
        own.adjust_around(newer)
        own.adjust_all(iterations=_MERGE_ITERATIONS)
        if last is not None and T_camera_reference is not None:
            T_camera_world = T_camera_reference @ own.keyframes[reference].T_camera_world
            last = replace(last, T_camera_world=T_camera_world)
        self._state = replace(self._state, last=last, candidate=None)
