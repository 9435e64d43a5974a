"""Track a camera with depth, or a stereo pair, against the map of its keyframes.

`Tracker` is a state machine without input or output: frames and answers go in, pose queries and tracked
frames come out.  A frame takes these steps: extract features, predict the pose, match landmarks, solve the
pose (elsewhere, by a query), verify it, decide what becomes of the frame, and keep it in the map.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Features, Frame, FrontEndOptions, PoseQuery, TrackedFrame, extract
from client_sdk.plugins import Plugins
from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.appearance_check import has_predicted_appearance
from client_sdk.tracking.depth_noise import NoiseEstimate
from client_sdk.tracking.keyframe_map import KeyframeMap, PosedView, View, observe_landmarks
from client_sdk.tracking.landmark_matching import (
    GUIDED_MATCHES_FACTOR,
    JOIN_INTERVAL_FRAMES,
    NO_LANDMARK,
    VERIFY_LOWE_RATIO,
    VERIFY_RADIUS_PX,
    Candidate,
    Matches,
    make_place_vector,
    match_known_places,
    match_other_segments,
    shift_landmarks,
)
from client_sdk.tracking.pose_queries import CLEAR_INLIERS, FrameSteps, OpenQuery, QueryAnswer, make_query
from client_sdk.tracking.reachability import (
    REACH_DEPTH_SHARE,
    Reach,
    reach_after,
    reach_at_begin,
    reach_between,
)
from client_sdk.tracking.rolling_shutter import (
    ReadoutEstimate,
    correct_view,
    measure_readout_change,
    rotation_rate,
)
from client_sdk.tracking.segment_join import (
    NOT_JOINED,
    REPEATED,
    Join,
    JoinCandidate,
    WheelConnection,
    carried_segment_after,
    connections_between,
    is_join_expected,
    root_of,
    without_segment,
)
from client_sdk.tracking.stereo_adjustment import StereoAdjustment, adjust_stereo
from client_sdk.wheel_odometry import WheelMotion
from rse_pf.geometry import Array, inverse, orthonormalise, pose_difference, rigid, transform
from rse_pf.slam.tracking import GuidedMatchLimits, fit_pose

__all__ = ["Tracker"]

Rows = npt.NDArray[np.int64]

_BEGIN_DEPTHS_FACTOR = 3
"""Fewest features with depth of the frame that begins a later segment, as a multiple of ``min_inliers``: a
frame with fewer is most likely of a covered lens."""
_GUIDED_RATIO = 0.35
"""Smallest share of inliers among the matches that a query sent, for a pose that was solved by matches near
predicted pixels: with fewer the pose is dropped without verification."""
_LAST_FRAME_RATIO = 0.4
"""Smallest share of inliers among the matches that a query sent, for a pose that was solved by matches with
the last frame: with fewer the pose is dropped without verification.  No prediction supports these matches."""
_NEARBY_RATIO = 0.25
"""Smallest share of inliers among all matches with a keyframe, also those that the query did not send, with
which an untracked frame is relocalised near the camera's last pose: low, because the place itself is
plausible."""
_VERIFIED_RATIO = 0.3
"""Smallest share of the landmarks matched around a solved pose that must agree with the fitted pose."""
_WIDE_RADIUS_PX = 160.0
"""Radius of the last search of a stereo pair around its last pose: 10 degrees of unexpected rotation of a
car's camera."""
_ENOUGH_MAP_MATCHES = 120
"""With this many matched landmarks of the map, a pose is verified without points of the last frame: a chain
of frames drifts, the map does not."""
_MIN_INTERVAL_S = 1e-3
"""Smallest time between two frames, in seconds, by which a rotation is divided: time stamps may repeat."""
_MAX_RATE_RAD_S = 3.0
"""Largest rotation rate, in rad/s, at which the rolling shutter is undone: with a readout of 20 ms the image
is sheared by 3.4 degrees.  A faster rotation between two frames is most likely a cut in a video; such a frame
is tracked, but its image is used as it is."""
_MAX_STEREO_MATCHES = 250
"""Largest number of matches that a query of a stereo pair sends: after the answer, the robot itself fits the
pose to all matched landmarks."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _TrackState:
    """What a tracker knows of the camera between two frames.

    Attributes:
        T_world_camera: ``(4, 4)``, the last accepted pose, also after a loss.
        timestamp_s: Time of that pose, in seconds.
        T_last_next: ``(4, 4)``, pose of the next camera in the frame of the last one, assumed to be that
            between the last two frames; the identity if these do not tell it.
        rotation_rate: ``(3,)`` rad/s in the camera's frame, mean rate between the last two frames; zeros if
            it is not known.
        last: The last frame with its pose; None after a loss and after `Tracker.adjust_pairs`.
        first: A segment's first image (with rolling shutter), until the second frame tells at which rate the
            camera rotated; None afterwards.
        keyframe_inliers: Number of landmarks that agreed with the pose of the newest keyframe; for the first
            keyframe of a segment, half the number of its features with depth.
        lost_in_a_row: Number of frames without a pose since the last accepted one.
        unrecognised: Number of frames since the last accepted pose that show enough features and no known
            place.
        contradictions: The number of these at which the wheels had hardly moved since that pose.
        segment: Number of the present segment, -1 before the first.
        join_candidate: Where the present segment may lie in another one; None without a measurement.
    """

    T_world_camera: Array
    timestamp_s: float = 0.0
    T_last_next: Array = field(default_factory=lambda: np.eye(4))
    rotation_rate: Array = field(default_factory=lambda: np.zeros(3))
    last: PosedView | None = None
    first: View | None = None
    keyframe_inliers: int = 0
    lost_in_a_row: int = 0
    unrecognised: int = 0
    contradictions: int = 0
    segment: int = -1
    join_candidate: JoinCandidate | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Attempt:
    """Matches of a frame by which its pose is to be solved.

    Attributes:
        matches: The matches.
        segment: Number of the segment whose landmarks are matched.
        T_world_reference: ``(4, 4)``, pose of the query's reference camera in the world of that segment.
        against: The source of the landmarks, see `PoseQuery`.
        min_matches: Fewest matches for which the pose is queried.
        min_ratio: Smallest share of inliers among the sent matches; ``min_inliers`` are needed, too.
    """

    matches: Matches
    segment: int
    T_world_reference: Array
    against: Literal["map", "frame", "keyframe", "segment"]
    min_matches: int
    min_ratio: float

    @property
    def is_recognised(self) -> bool:
        """Whether the matches show a known place, and are not those around the last pose."""
        return self.against in ("keyframe", "segment")

    def distance_to(self, position: Array) -> float:
        """Return the median distance of the matched landmarks from a ``(3,)`` position, in metres."""
        return float(np.median(np.linalg.norm(self.matches.points - position, axis=1)))


class Tracker:
    """Visual odometry with relocalisation; takes one frame and one query at a time.

    ::

        step = tracker.prepare(frame)
        while isinstance(step, PoseQuery):
            T_camera_world, inliers = ...   # the PnP service's answer, or None, 0 on any failure
            is_weak = ...                   # whether the verdict of the answer is "weak"
            step = tracker.accept(step, T_camera_world, inliers, is_weak=is_weak)
        # step is now the TrackedFrame

    A frame is matched near the pixels at which a constant velocity predicts the landmarks of the nearest
    keyframes and of the last frame.  If no pose fits, it is matched with the last frame by appearance; a
    stereo pair is then matched in a wide radius around its last pose.  If no pose fits again, it is matched
    with the newest keyframes and with the most similar keyframes of all segments; such a place is accepted
    only if the camera can have moved there.  Otherwise the frame is lost, and the next one is tried in the
    same order.  After `FrontEndOptions.segment_after` unrecognised frames a new segment begins at the last
    accepted pose, or at that to which the wheels have carried it.  Two segments are joined when two
    measurements in a row agree where one lies in the other, under the same condition; the newer segment is
    moved into the older one.  A frame with a weak pose never becomes a keyframe.

    Attributes:
        options: Options of the front end.
        frames: Number of frames so far.
        lost_frames: Number of frames without a pose so far.
        keyframes: Number of keyframes so far, also of those that were thinned out.
        joins: All joins of segments so far, in their order.
        noise: Estimate of the noise of the camera's depths.
        readout: Estimate of the readout time of the camera's rolling shutter.
        disparity_offset_px: Pixels that are added to the disparities of every further frame of a stereo pair:
            the sum of the clear offsets that `adjust_pairs` found for the present segment.
        pair_offsets: Result of the last `adjust_pairs` by segment, also where it was not clear and nothing
            was changed.
    """

    def __init__(
        self,
        options: FrontEndOptions | None = None,
        T_world_start: Array | None = None,
        plugins: Plugins | None = None,
    ) -> None:
        self.options = options or FrontEndOptions()
        self.frames = 0
        self.lost_frames = 0
        self.keyframes = 0
        self.joins: list[Join] = []
        self.noise = NoiseEstimate()
        self.readout = ReadoutEstimate()
        self.disparity_offset_px = 0.0
        self.pair_offsets: dict[int, StereoAdjustment] = {}
        self._plugins = plugins or Plugins()
        self._T_world_start = np.eye(4) if T_world_start is None else T_world_start
        self._state = _TrackState(T_world_camera=self._T_world_start)
        self._segments: dict[int, KeyframeMap] = {}
        self._next_segment = 0
        self._anchors: dict[int, int] = {}
        """The segment in whose world a segment began, because the wheels had carried the pose."""
        self._connections: dict[int, tuple[WheelConnection, ...]] = {}
        """Motions by wheels between the world of a segment and that of its anchor: several once a segment
        between them was joined."""
        self._elsewhere: set[int] = set()
        """Segments that may begin anywhere: the robot was carried to them, as the images tell."""
        self._has_pose = False
        self._has_missing_answer = False
        self._adjusted_frames = 0
        self._pending_readout_s = 0.0
        self._frame: Frame  # the frame that is tracked, set by `prepare`
        self._raw: View  # its image with rolling shutter
        self._interval_s: float  # seconds since the last accepted pose
        self._open = OpenQuery()

    @property
    def last_features(self) -> Features | None:
        """Features of the last frame without its rolling shutter.

        None if that frame has no pose, and after `adjust_pairs`.
        """
        return None if self._state.last is None else self._state.last.view.features

    @property
    def segment(self) -> int:
        """The number of the present segment; 0 for the first one, and before there is one."""
        return max(0, self._state.segment)

    @property
    def last_pose(self) -> tuple[float, Array] | None:
        """Time in seconds and ``T_world_camera`` ``(4, 4)`` of the last accepted pose; None before the first.

        The pose is in the present segment, with its corrections; after `restart` it is the given one.
        """
        return (self._state.timestamp_s, self._state.T_world_camera) if self._has_pose else None

    @property
    def connected(self) -> frozenset[int]:
        """Numbers of the segments, without the first one, that wheels have connected with its world."""
        return frozenset(
            number for number in self._anchors if root_of(self._anchors, number) == min(self._segments)
        )

    @property
    def unrecognised(self) -> int:
        """Number of frames since the last pose that show enough features with depth and no known place.

        Enough are three times ``min_inliers``.  An image with fewer, such as that of a covered lens, does not
        count.
        """
        return self._state.unrecognised

    @property
    def contradicts_wheels(self) -> bool:
        """Whether images show another place than the wheels tell: they do not carry the pose there."""
        return self._state.contradictions >= carried_segment_after(self.options.segment_after)

    def restart(self, T_world_start: Array, timestamp_s: float | None = None) -> None:
        """Forget all segments: the next frame with enough features begins segment 0 at *T_world_start*.

        *T_world_start* is the ``(4, 4)`` pose ``T_world_camera`` of that frame; with *timestamp_s* it is that
        at this time, from which the wheels carry it to that frame.  The counts of frames and keyframes, the
        joins and all estimates (depth noise, readout time, disparity offset) are kept.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        self._T_world_start = T_world_start
        self._segments.clear()
        self._anchors.clear()
        self._connections.clear()
        self._elsewhere.clear()
        self._next_segment = 0
        self._has_pose = timestamp_s is not None
        self._state = _TrackState(
            T_world_camera=T_world_start,
            timestamp_s=self._state.timestamp_s if timestamp_s is None else timestamp_s,
        )

    def turn(self, T_new_old: Array) -> None:
        """Express all poses in a rotated world, such as after gravity became known.

        Poses that were returned before are ``T_new_old @ T_world_camera`` in the new world.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        self._T_world_start = orthonormalise(T_new_old @ self._T_world_start)
        for segment_map in self._segments.values():
            segment_map.move(T_new_old)
        for number, connections in self._connections.items():
            self._connections[number] = tuple(each.moved(T_new_old) for each in connections)
        self._move_state(T_new_old)

    def adjust_pairs(self) -> dict[int, StereoAdjustment]:
        """Adjust all keyframes of each segment of a stereo drive together, such as at its end.

        This takes seconds.  A segment is changed only if its disparity offset is clear: its keyframes and
        landmarks move, and if it is the present segment, the offset is added to the disparities of all
        further frames.  The next frame is relocalised in any case.

        Returns:
            The adjustment of each segment that was changed, by the number of the segment; it tells how poses
            that were returned before change.  Empty without stereo pairs, and if no frame came since the last
            call.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        stereo = self._frame.stereo if self._segments else None
        if stereo is None or self._adjusted_frames == self.frames:
            return {}
        self._adjusted_frames, self.pair_offsets = self.frames, {}
        for segment, segment_map in self._segments.items():
            adjustment = adjust_stereo(segment_map, self._frame.camera.fx * stereo.baseline_m)
            if adjustment is not None:
                self.pair_offsets[segment] = adjustment
        clear = {segment: found for segment, found in self.pair_offsets.items() if found.is_clear}
        state = replace(self._state, last=None, join_candidate=None, first=None)
        own = clear.get(state.segment)
        if own is not None:
            self.disparity_offset_px += own.offset_px
            moved = own.moved(np.array([state.timestamp_s]), state.T_world_camera[None])[0]
            state = replace(state, T_world_camera=orthonormalise(moved))
            self._map.set_last(state.T_world_camera, state.timestamp_s)
        self._state = state
        self._plugins.forget_poses()
        return clear

    def prepare(self, frame: Frame) -> PoseQuery | TrackedFrame:
        """Take the next frame; return a query for its pose, or its result if no query is needed.

        A frame needs no query if its matches are too few, or if there is no map yet.  Such a frame is lost,
        or begins a segment: the first segment if ``min_inliers`` of its features have depth, a further
        segment after more than ``segment_after`` unrecognised frames.

        Raises:
            UsageError: The last query was not answered yet, or a user's feature extractor failed.
        """
        self._open.refuse_open()
        self.frames += 1
        self._interval_s = max(_MIN_INTERVAL_S, frame.timestamp_s - self._state.timestamp_s)
        self._frame = frame
        self._has_missing_answer = False
        self._raw = self._extract(frame)
        self.noise.model = frame.depth_noise
        # The rolling shutter is undone at the last rotation rate, until the pose of this frame is known.
        view = correct_view(self._raw, self.readout.readout_s, self._state.rotation_rate)
        return self._open.begin(self._track(view))

    def skip(self, frame: Frame) -> TrackedFrame:
        """Lose the next frame without looking at its image, which repeats while the wheels turn.

        Raises:
            UsageError: The last query was not answered yet.
        """
        self._open.refuse_open()
        self.frames += 1
        self.lost_frames += 1
        return TrackedFrame(
            frame=frame,
            T_world_camera=None,
            keyframe=False,
            inliers=0,
            matches=0,
            status="lost",
            reason=REPEATED,
            segment=self.segment,
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
            T_camera_world: ``(4, 4)`` as the PnP service returns it: maps the world of the query, which is
                the frame of its reference camera and not the world of the segment, to the frame of the
                camera.  None if there was no answer.
            inliers: Number of correspondences that agree with the pose.
            is_weak: Whether the service calls the evidence for the pose weak; the frame then changes no
                landmark and becomes no keyframe.
            is_missing: Whether there was no answer.  With wheel odometry such a frame does not count as
                unrecognised.

        Raises:
            UsageError: *query* is not the open one.
        """
        return self._open.answer(query, QueryAnswer(T_camera_world, inliers, is_weak, is_missing))

    # --- The steps of one frame ---

    def _track(self, view: View) -> FrameSteps:
        """Yield the queries of the present frame, whose image is *view*, and return its result."""
        if not self._segments:
            return self._begin_or_lose(view, match_count=0)
        # 1. Predict, match, solve and verify: around the last pose, then at all known places.
        posed, match_count = yield from self._pose(view)
        # 2. Decide: without a pose, the frame is lost or begins a segment.
        if posed is None:
            return self._begin_or_lose(view, match_count)
        # 3. Keep the frame in the map, and look for its place in other segments.
        is_keyframe = self._keep(posed)
        if len(self._segments) > 1 and self.frames % JOIN_INTERVAL_FRAMES == 0:
            yield from self._find_join(posed)
        return self._make_result(posed, is_keyframe=is_keyframe)

    # --- Extract ---

    def _extract(self, frame: Frame) -> View:
        """Return the image of a frame with its rolling shutter."""
        features = extract(frame, self.options, self._plugins.features)
        if self.disparity_offset_px and frame.stereo is not None:
            f_baseline = frame.camera.fx * frame.stereo.baseline_m
            points_camera = with_offset(features.points_camera, f_baseline, self.disparity_offset_px)
            features = replace(features, points_camera=points_camera)
        return View(
            features=features,
            shutter_displacements=np.zeros_like(features.points_camera),
            camera=frame.camera,
            place_vector=make_place_vector(features.descriptors, frame.rgb, self._plugins.loops),
            is_stereo=frame.stereo is not None,
            timestamp_s=frame.timestamp_s,
        )

    # --- Predict and match ---

    def _predict_pose(self) -> Array:
        """Predict ``T_world_camera`` ``(4, 4)`` of the frame by a user's motion model, if it returns a pose.

        Otherwise the motion between the last two frames is repeated, whatever time has passed.  Its rotation
        is replaced by that of the gyroscope, where there is one.
        """
        state, now_s = self._state, self._frame.timestamp_s
        T_world_camera = self._plugins.predict_pose(now_s)
        if T_world_camera is not None:
            return T_world_camera
        T_last_next = self._plugins.predict_motion(state.T_last_next.copy(), state.timestamp_s, now_s)
        return orthonormalise(state.T_world_camera @ T_last_next)

    def _carry(self) -> tuple[Array, WheelMotion | None]:
        """Return the last pose ``(4, 4)`` carried by the wheels to this frame, and their motion.

        Without a motion by the wheels it is the last pose itself.
        """
        state = self._state
        motion = self._plugins.wheel_motion(state.timestamp_s, self._frame.timestamp_s)
        if motion is None or not self._has_pose:
            return state.T_world_camera, None
        return orthonormalise(state.T_world_camera @ motion.T_camera_begin_end), motion

    def _match_around_last_pose(self, view: View) -> Iterator[_Attempt]:
        """Match a frame near the pixels that the motion predicts, with the last frame, and widely.

        The wide search around the last pose is for stereo pairs only.  After a loss, the only attempt is
        near the pixels that a pose carried by the wheels predicts.
        """
        state, noise, min_inliers = self._state, self.noise.noise, self.options.min_inliers
        guided = GuidedMatchLimits(radius_px=self.options.search_px)
        if state.last is None:
            T_carried, motion = self._carry()
            if motion is not None:
                yield _Attempt(
                    matches=self._map.match(view, T_carried, guided, None, noise),
                    segment=state.segment,
                    T_world_reference=T_carried,
                    against="map",
                    min_matches=GUIDED_MATCHES_FACTOR * min_inliers,
                    min_ratio=_GUIDED_RATIO,
                )
            return
        T_predicted, T_last = self._predict_pose(), state.T_world_camera
        yield _Attempt(
            matches=self._map.match(view, T_predicted, guided, self._state.last, noise),
            segment=state.segment,
            T_world_reference=T_predicted,
            against="map",
            min_matches=GUIDED_MATCHES_FACTOR * min_inliers,
            min_ratio=_GUIDED_RATIO,
        )
        # Verifying the attempt before may have replaced the last frame, see `_replace_first_keyframe`.
        assert self._state.last is not None
        yield _Attempt(
            matches=self._map.match_last_frame(view, self._state.last, noise),
            segment=state.segment,
            T_world_reference=T_last,
            against="frame",
            min_matches=min_inliers,
            min_ratio=_LAST_FRAME_RATIO,
        )
        if view.is_stereo:
            wide = GuidedMatchLimits(radius_px=_WIDE_RADIUS_PX)
            yield _Attempt(
                matches=self._map.match(view, T_last, wide, self._state.last, noise),
                segment=state.segment,
                T_world_reference=T_last,
                against="map",
                min_matches=min_inliers,
                min_ratio=_GUIDED_RATIO,
            )

    def _match_known_places(self, view: View) -> Iterator[_Attempt]:
        """Match a frame with the three keyframes of all segments that have the most matches."""
        present = self._state.segment
        for candidate in match_known_places(self._segments, view.place_vector, view.features, present):
            yield self._attempt_at(candidate, "keyframe")

    def _attempt_at(self, place: Candidate, against: Literal["keyframe", "segment"]) -> _Attempt:
        """Return the attempt at a known place, whose keyframe is the reference camera."""
        return _Attempt(
            matches=place.matches,
            segment=place.segment,
            T_world_reference=self._segments[place.segment].poses[place.keyframe],
            against=against,
            min_matches=self.options.min_inliers,
            min_ratio=0.0,
        )

    # --- Solve ---

    def _pose(self, view: View) -> Generator[PoseQuery, QueryAnswer, tuple[PosedView | None, int]]:
        """Ask for the pose of a frame by one attempt after the other, until one gives a verified pose.

        If the pose is found in another segment, that one becomes the present segment.  Returned are the image
        with its verified pose, None if no attempt gives one, and the largest number of matches of an attempt.
        """
        max_count = 0
        for attempt in chain(self._match_around_last_pose(view), self._match_known_places(view)):
            count = len(attempt.matches)
            max_count = max(max_count, count)
            if count < attempt.min_matches:
                continue
            # 1. Solve the pose by a query.
            T_world_camera, answer = yield from self._solve(view, attempt)
            if T_world_camera is None:
                continue
            # 2. Far from the last pose, only a clear answer by a known place is accepted: perceptual aliases,
            #    places that look alike, exist.
            is_near = self._is_near(T_world_camera, attempt)
            has_support = not attempt.is_recognised or answer.inliers >= _NEARBY_RATIO * count
            is_clear = attempt.is_recognised and answer.is_clear(count)
            if not ((is_near and has_support) or is_clear):
                continue
            # 3. Verify the pose by the landmarks around it, and at a known place by the appearance.
            is_continuous = is_near and self._is_continuous(T_world_camera)
            image = view if is_continuous else self._raw
            posed = self._verify(image, T_world_camera, attempt, answer, is_continuous=is_continuous)
            if posed is None:
                continue
            # 4. Accept a known place only if the camera can have moved there: another one may look the same.
            if (attempt.is_recognised or self._state.last is None) and not self._is_reachable(posed, attempt):
                continue
            if attempt.segment != self._state.segment:
                self._state = replace(self._state, segment=attempt.segment, last=None, join_candidate=None)
            return posed, max_count
        return None, max_count

    def _solve(
        self, view: View, attempt: _Attempt
    ) -> Generator[PoseQuery, QueryAnswer, tuple[Array | None, QueryAnswer]]:
        """Ask for the pose of an image by the matches of an attempt, of which the query may send only a part.

        Returned are ``T_world_camera`` ``(4, 4)`` in the world of the attempt's segment, None without a rigid
        pose and enough inliers, and the answer.
        """
        answer = yield make_query(
            self._frame,
            attempt.matches,
            view.features,
            inlier_px=self.options.inlier_px,
            max_iterations=self.options.max_iterations,
            max_matches=self._max_matches,
            against=attempt.against,
            T_world_reference=attempt.T_world_reference,
            depth_noise=None if self._frame.stereo is None else self.noise.noise,
        )
        self._has_missing_answer |= answer.is_missing
        sent = min(len(attempt.matches), self._max_matches)
        T_camera_reference = answer.accepted_pose(max(self.options.min_inliers, attempt.min_ratio * sent))
        if T_camera_reference is None:
            return None, answer
        return attempt.T_world_reference @ inverse(T_camera_reference), answer

    @property
    def _map(self) -> KeyframeMap:
        """The map of the present segment."""
        return self._segments[self._state.segment]

    @property
    def _max_matches(self) -> int:
        """Largest number of matches that a query sends; fewer for a stereo pair."""
        most = self.options.max_matches
        return most if self._frame.stereo is None else min(most, _MAX_STEREO_MATCHES)

    # --- Verify ---

    def _is_near(self, T_world_camera: Array, attempt: _Attempt) -> bool:
        """Return whether a pose lies near the last one in the same segment.

        It does if the camera moved by at most the median distance of the matched landmarks, whatever time
        passed: a view from farther away shows another scene.  Rotations are not limited.  After a loss the
        pose that the wheels have carried takes the place of the last one.
        """
        position = T_world_camera[:3, 3]
        last = self._state.T_world_camera if self._state.last is not None else self._carry()[0]
        moved_m = np.linalg.norm(position - last[:3, 3])
        return attempt.segment == self._state.segment and bool(moved_m <= attempt.distance_to(position))

    def _is_reachable(self, posed: PosedView, attempt: _Attempt) -> bool:
        """Return whether the camera can have moved to a recognised place since its last pose.

        A frame after a tracked one may be anywhere near its pose: the motion between two images can change.
        After a loss, wheels tell where it can have moved.
        """
        T_carried, motion = (None, None) if self._state.last is not None else self._carry()
        if motion is not None and T_carried is not None:
            own_root = root_of(self._anchors, self._state.segment)
            if root_of(self._anchors, attempt.segment) == own_root:
                reach = Reach(T_carried[:3, 3], motion.reach_m)
                position = posed.T_world_camera[:3, 3]
                return reach.excess(position) <= REACH_DEPTH_SHARE * attempt.distance_to(position)
        if attempt.segment != self._state.segment and self._may_be_anywhere(attempt.segment):
            return True
        position, own = posed.T_world_camera[:3, 3], self._map.trajectory()
        if not self._state.lost_in_a_row and self._is_near(posed.T_world_camera, attempt):
            return True
        if attempt.segment == self._state.segment:
            reach = reach_after(own, self._frame.timestamp_s)
        else:
            path = self._segments[attempt.segment].trajectory()
            reach = reach_between(path, own, self._frame.timestamp_s)
        return reach.excess(position) <= REACH_DEPTH_SHARE * attempt.distance_to(position)

    def _may_be_anywhere(self, other: int) -> bool:
        """Return whether the robot was carried by hand between another segment and the present one."""
        roots = {root_of(self._anchors, number) for number in (other, self._state.segment)}
        return bool(self._elsewhere & roots)

    def _looks_right(self, T_world_camera: Array, segment: int) -> bool:
        """Return whether the image looks as a pose in a segment predicts; True for a user's features."""
        if self._plugins.features is not None:
            return True
        return has_predicted_appearance(
            self._frame, self._segments[segment], T_world_camera, self.options.min_inliers
        )

    def _is_continuous(self, T_world_camera: Array) -> bool:
        """Return whether the camera moved from the pose of the frame before to this near one.

        After a loss, or a cut in a video (a rotation that is too fast), it did not, and its rotation rate is
        unknown.
        """
        state = self._state
        _, rotated_deg = pose_difference(state.T_world_camera, T_world_camera)
        return state.last is not None and math.radians(rotated_deg) <= _MAX_RATE_RAD_S * self._interval_s

    def _verify(
        self,
        view: View,
        T_world_camera: Array,
        attempt: _Attempt,
        answer: QueryAnswer,
        *,
        is_continuous: bool = False,
    ) -> PosedView | None:
        """Fit a solved pose to all landmarks of the map around it; None if too few agree.

        An accepted pose updates the estimate of the depth noise.  With *is_continuous* the image of a depth
        camera (not of a stereo pair) also updates the estimate of the readout time, and the second frame of a
        segment gives the rotation rate by which the rolling shutter of the first frame is undone.  At a
        recognised place the image must also look as the landmarks predict.  A user's features cannot be
        computed at given pixels: they are not compared.

        Args:
            view: The image.
            T_world_camera: ``(4, 4)``, the solved pose, in the world of the attempt's segment.
            attempt: The matches by which the pose was solved.
            answer: The answer to their query.
            is_continuous: Whether the camera moved there from its last pose; then its rolling shutter is
                undone by that motion.
        """
        state, min_inliers, noise = self._state, self.options.min_inliers, self.noise.noise
        segment_map = self._segments[attempt.segment]
        # 1. Match the landmarks around the pose; the last frame is left out in the map of another segment.
        limits = GuidedMatchLimits(radius_px=VERIFY_RADIUS_PX, lowe_ratio=VERIFY_LOWE_RATIO)
        last = state.last if attempt.segment == state.segment else None
        matches = segment_map.match(view, T_world_camera, limits, last, noise, _ENOUGH_MAP_MATCHES)
        if len(matches) < min_inliers:
            return None
        # 2. Fit the pose to the matched landmarks.
        observed = observe_landmarks(view, matches, T_world_camera, noise)
        fitted = fit_pose(observed, view.camera, inverse(T_world_camera))
        # 3. Undo the rolling shutter at the rotation rate of the fitted pose, first in the segment's first
        #    image, which has no rate of its own; then fit again.
        rate = np.zeros(3)
        if fitted is not None and is_continuous:
            T_world_camera = inverse(fitted.T_camera_world)
            rate = rotation_rate(state.T_world_camera, T_world_camera, self._interval_s, state.rotation_rate)
            first = state.first if int(fitted.is_inlier.sum()) >= CLEAR_INLIERS else None
            corrected = correct_view(first or self._raw, self.readout.readout_s, rate)
            if first is not None:
                self._replace_first_keyframe(corrected)
                return self._verify(view, T_world_camera, attempt, answer, is_continuous=True)
            view = corrected
            observed = observe_landmarks(view, matches, T_world_camera, noise)
            fitted = fit_pose(observed, view.camera, fitted.T_camera_world)
        accepted = None if fitted is None else rigid(fitted.T_camera_world)
        if fitted is None or accepted is None:
            return None
        # 4. Measure the mean rotation rate and, of a depth camera, the readout time.  Not of a stereo pair:
        #    its shutters are global, and an unsynchronised pair looks like a readout.
        T_world_camera, mean_rate = inverse(accepted), np.zeros(3)
        if is_continuous:
            mean_rate = rotation_rate(state.T_world_camera, T_world_camera, self._interval_s, mean_rate)
        if is_continuous and not view.is_stereo:
            change = measure_readout_change(view, matches, observed, fitted)
            self._pending_readout_s += self.readout.update(*change, rate)
        # 5. Accept the pose if enough landmarks agree.
        inliers = np.flatnonzero(fitted.is_inlier)
        if len(inliers) < max(min_inliers, _VERIFIED_RATIO * len(matches)):
            return None
        # 6. Update the noise estimate, compare the appearance, and note which features show which landmarks.
        self.noise.add(observed, inliers, accepted)
        if attempt.is_recognised and not self._looks_right(T_world_camera, attempt.segment):
            return None
        landmarks = np.full(len(view.features), NO_LANDMARK)
        landmarks[matches.features[inliers]] = matches.numbers[inliers]
        return PosedView(
            view=view,
            T_world_camera=self._plugins.on_plane(T_world_camera),
            landmarks=landmarks,
            inliers=len(inliers),
            matches=max(len(attempt.matches), len(matches)),
            is_weak=answer.is_weak,
            rotation_rate=mean_rate,
        )

    def _replace_first_keyframe(self, view: View) -> None:
        """Replace the map of the present segment by one with its first keyframe without rolling shutter.

        *view* is the first image, corrected with the rotation rate that is known only after the second frame.
        """
        state = self._state
        assert state.last is not None
        self._segments[state.segment] = KeyframeMap(self.options.max_keyframes)
        landmarks = self._add_first_keyframe(view, state.T_world_camera)
        self._state = replace(state, last=replace(state.last, view=view, landmarks=landmarks), first=None)

    # --- Decide and keep ---

    def _keep(self, posed: PosedView) -> bool:
        """Take a frame with a verified pose as the last one, and into the map; return if it is a keyframe."""
        state, T_world_camera, timestamp_s = self._state, posed.T_world_camera, self._frame.timestamp_s
        # 1. Update the motion model; after a loss the motion is not known.
        T_last_next, rate = np.eye(4), state.rotation_rate
        if state.lost_in_a_row or state.last is None:
            self._plugins.forget_poses()
        else:
            T_last_next = orthonormalise(inverse(state.T_world_camera) @ T_world_camera)
            rate = posed.rotation_rate
        self._plugins.add_pose(timestamp_s, T_world_camera)
        # 2. Fuse the measurements into the landmarks, and add a keyframe; a weak pose does neither.
        is_keyframe, keyframe_inliers = self._is_keyframe(posed), state.keyframe_inliers
        landmarks = posed.landmarks
        if not posed.is_weak:
            self._map.fuse(posed.view, T_world_camera, landmarks, self.noise.noise)
        if is_keyframe:
            landmarks = self._map.add_keyframe(posed.view, T_world_camera, landmarks, self.noise.noise)
            self.keyframes += 1
            keyframe_inliers = posed.inliers
        self._map.set_last(T_world_camera, timestamp_s)
        # 3. Move all landmarks by the change of the readout time; this image was fused with the old time.
        for segment_map in self._segments.values():
            segment_map.change_readout(self._pending_readout_s)
        self._pending_readout_s = 0.0
        # 4. Keep the frame as the last one, from which the next frame is tracked.
        self._state = replace(
            state,
            T_world_camera=T_world_camera,
            timestamp_s=timestamp_s,
            T_last_next=T_last_next,
            rotation_rate=rate,
            last=replace(posed, landmarks=landmarks),
            first=None,
            keyframe_inliers=keyframe_inliers,
            lost_in_a_row=0,
            unrecognised=0,
            contradictions=0,
        )
        return is_keyframe

    def _is_keyframe(self, posed: PosedView) -> bool:
        """Return whether a frame is far from all keyframes, or sees much fewer landmarks than the newest.

        The limits are the options ``keyframe_m``, ``keyframe_deg`` and ``keyframe_share``.  A frame with a
        weak pose, or with fewer inliers than twice ``min_inliers``, is never a keyframe.
        """
        options = self.options
        if posed.is_weak or posed.inliers < 2 * options.min_inliers:
            return False
        metres, degrees = self._map.distances(posed.T_world_camera)
        is_far = bool(((metres > options.keyframe_m) | (degrees > options.keyframe_deg)).all())
        landmark_count = int((posed.landmarks != NO_LANDMARK).sum())
        return is_far or landmark_count < options.keyframe_share * self._state.keyframe_inliers

    def _begin_or_lose(self, view: View, match_count: int) -> TrackedFrame:
        """Lose a frame without a pose; or begin a segment with it, if enough frames before it were lost.

        The first segment begins at the start pose, with a frame of at least ``min_inliers`` features with
        depth.  A later one begins at the last accepted pose, with a frame of at least three times as many
        features with depth, once more than ``segment_after`` such frames without a pose came since then.
        Where wheels have carried the pose, it begins there, and earlier; frames whose queries nobody has
        answered do not count.  If images show another place while the wheels stand still, the robot was
        carried away, or something hides the view: the wheels do not tell then where the segment begins.
        """
        feature_count = int(np.isfinite(view.features.points_camera[:, 2]).sum())
        factor = _BEGIN_DEPTHS_FACTOR if self._segments else 1
        if feature_count < factor * self.options.min_inliers:
            return self._lose(match_count)
        (T_carried, motion), is_elsewhere = self._carry(), False
        if self._segments:
            if motion is not None and self._has_missing_answer:
                return self._lose(match_count)
            is_still = motion is not None and motion.is_still
            self._state = replace(
                self._state,
                unrecognised=self._state.unrecognised + 1,
                contradictions=self._state.contradictions + is_still,
            )
            after = self.options.segment_after
            is_elsewhere = self.contradicts_wheels
            if is_elsewhere:
                motion = None
            if self._state.unrecognised <= (after if motion is None else carried_segment_after(after)):
                return self._lose(match_count)
        is_continued = bool(self._segments) or motion is not None
        start = T_carried if is_continued else self._T_world_start
        if is_elsewhere:
            self._elsewhere.add(self._next_segment)
        return self._begin_segment(view, start, feature_count, motion)

    def _begin_segment(
        self, view: View, T_world_camera: Array, feature_count: int, motion: WheelMotion | None
    ) -> TrackedFrame:
        """Begin a segment with a frame at a pose; it is the present segment from now on.

        *feature_count* is the number of features with depth, *motion* that by which the wheels have carried
        the pose from the segment before, if they have.  Returned is the result of the frame.
        """
        segment, timestamp_s = self._next_segment, self._frame.timestamp_s
        self._next_segment += 1
        if motion is not None and self._segments:
            self._anchors[segment] = self._state.segment
            connection = WheelConnection(position=T_world_camera[:3, 3], motion=motion)
            self._connections[segment] = (connection,)
        self._has_pose = True
        self._segments[segment] = KeyframeMap(self.options.max_keyframes)
        self._state = _TrackState(T_world_camera=T_world_camera, timestamp_s=timestamp_s, segment=segment)
        posed = PosedView(
            view=view,
            T_world_camera=T_world_camera,
            landmarks=self._add_first_keyframe(view, T_world_camera),
            inliers=0,
            matches=0,
            is_weak=False,
        )
        self.keyframes += 1
        self._state = replace(
            self._state,
            last=posed,
            first=self._raw,
            keyframe_inliers=feature_count // 2,
        )
        self._plugins.forget_poses()
        self._plugins.add_pose(timestamp_s, T_world_camera)
        return self._make_result(posed, is_keyframe=True)

    def _add_first_keyframe(self, view: View, T_world_camera: Array) -> Rows:
        """Add the first keyframe of the present segment; return the landmark of each feature."""
        none = np.full(len(view.features), NO_LANDMARK)
        self._map.set_last(T_world_camera, view.timestamp_s)
        return self._map.add_keyframe(view, T_world_camera, none, self.noise.noise)

    def _lose(self, match_count: int) -> TrackedFrame:
        self.lost_frames += 1
        self._state = replace(
            self._state,
            last=None,
            rotation_rate=np.zeros(3),
            lost_in_a_row=self._state.lost_in_a_row + 1,
        )
        return TrackedFrame(
            frame=self._frame,
            T_world_camera=None,
            keyframe=False,
            inliers=0,
            matches=match_count,
            segment=self.segment,
            features=self._raw.features,
        )

    def _make_result(self, posed: PosedView, *, is_keyframe: bool) -> TrackedFrame:
        is_joined = root_of(self._anchors, self._state.segment) == min(self._segments)
        return TrackedFrame(
            frame=self._frame,
            T_world_camera=self._state.T_world_camera,
            keyframe=is_keyframe,
            inliers=posed.inliers,
            matches=posed.matches,
            segment=self.segment,
            features=self._raw.features,
            reason="" if is_joined else NOT_JOINED,
        )

    # --- Join segments ---

    def _find_join(self, posed: PosedView) -> Generator[PoseQuery, QueryAnswer, None]:
        """Ask for the place of a tracked frame in other segments; join two once two measurements agree.

        Two measurements are compared if they are of the same other segment and no measurement lies between
        them.  An answer need not be clear if wheels connect both segments and allow the measurement.
        """
        # 1. Solve and verify the pose against the keyframe of another segment with the most matches.
        view, present = posed.view, self._state.segment
        best = match_other_segments(self._segments, view.place_vector, view.features, present)
        count = len(best.matches)
        if count < CLEAR_INLIERS:
            return
        attempt = self._attempt_at(best, "segment")
        T_other_camera, answer = yield from self._solve(view, attempt)
        if T_other_camera is None:
            return
        here = posed.T_world_camera[:3, 3]
        is_clear = answer.is_clear(min(count, self._max_matches))
        T_other_present = T_other_camera @ inverse(posed.T_world_camera)
        is_expected = self._is_join_expected(best.segment, T_other_present, here)
        there = self._verify(view, T_other_camera, attempt, answer) if is_clear or is_expected else None
        if there is None or not (is_clear or there.inliers >= CLEAR_INLIERS):
            return
        # 2. Keep the measurement as the candidate; go on only if the candidate before it agrees.
        T_other_present = orthonormalise(there.T_world_camera @ inverse(posed.T_world_camera))
        previous = self._state.join_candidate
        is_confirmed = previous is not None and previous.agrees_with(best.segment, T_other_present)
        first_position = previous.first_position if previous is not None and is_confirmed else here
        candidate = JoinCandidate(
            segment=best.segment, T_other_present=T_other_present, first_position=first_position
        )
        self._state = replace(self._state, join_candidate=candidate)
        if not is_confirmed:
            return
        # 3. If the camera cannot have moved there, the place may be another one that looks the same.  Two
        #    such places do not overlap: wait until the camera has moved farther than they can be apart.
        reach, begin = self._reach_of_join(best.segment, T_other_present)
        distance_m = attempt.distance_to(there.T_world_camera[:3, 3])
        is_reached = is_expected or reach.excess(begin) <= REACH_DEPTH_SHARE * distance_m
        if not is_reached and np.linalg.norm(here - first_position) < reach.farthest(begin):
            return
        # 4. Move the newer of the two segments into the older one, whose poses stay as they are.
        if best.segment < present:
            self._join(present, best.segment, T_other_present)
        else:
            self._join(best.segment, present, inverse(T_other_present))

    def _is_join_expected(self, other: int, T_other_present: Array, here: Array) -> bool:
        """Return whether wheels connect two segments, and allow a measurement of one in the other.

        The arguments are those of `is_join_expected`; *other* is the number of the other segment.
        """
        present = self._state.segment
        if root_of(self._anchors, other) != root_of(self._anchors, present):
            return False
        on_way = connections_between(self._anchors, other, present)
        connections = chain.from_iterable(self._connections[number] for number in on_way)
        return is_join_expected(connections, T_other_present, here)

    def _reach_of_join(self, other: int, T_other_present: Array) -> tuple[Reach, Array]:
        """Return where the newer of two segments can begin in the older one, and where it would by a join.

        *T_other_present* is ``(4, 4)``, the position ``(3,)``.
        """
        present = self._state.segment
        if self._may_be_anywhere(other):
            return Reach(np.zeros(3), math.inf), np.zeros(3)
        older, newer = (self._segments[number].trajectory() for number in sorted((other, present)))
        T_older_newer = T_other_present if other < present else inverse(T_other_present)
        return reach_at_begin(older, newer), transform(T_older_newer, newer.positions[:1])[0]

    def _join(self, segment: int, into: int, T_into_segment: Array) -> None:
        """Move all of *segment*, the newer one, into the map of *into*, which keeps its world.

        *T_into_segment* ``(4, 4)`` is the pose of the newer segment's world in that of the older one.
        """
        segment_map = self._segments.pop(segment)
        self._elsewhere.discard(segment)
        segment_map.move(T_into_segment)
        first_landmark = self._segments[into].append(segment_map)
        self.joins.append(Join(segment, into, T_into_segment))
        own = self._connections.pop(segment, ())
        for number, anchor in self._anchors.items():
            if anchor == segment:
                self._connections[number] += own
        self._anchors = without_segment(self._anchors, segment)
        if segment == self._state.segment and self._state.last is not None:
            self._state = replace(self._state, segment=into)
            self._move_state(T_into_segment, first_landmark)
        else:
            self._state = replace(self._state, join_candidate=None)

    def _move_state(self, T_new_old: Array, first_landmark: int = 0) -> None:
        """Express the last pose in another frame after its segment was moved or appended.

        Args:
            T_new_old: ``(4, 4)``.
            first_landmark: Number of the segment's first landmark in the map that it was appended to.
        """
        T_world_camera = orthonormalise(T_new_old @ self._state.T_world_camera)
        last = self._state.last
        if last is not None:
            landmarks = shift_landmarks(last.landmarks, first_landmark)
            last = replace(last, T_world_camera=T_world_camera, landmarks=landmarks)
        self._state = replace(self._state, T_world_camera=T_world_camera, last=last, join_candidate=None)
        self._plugins.forget_poses()
