"""Track a camera with depth against the map of its keyframes, as a state machine without input or output.

Frames and answers go in, pose queries and tracked frames come out; there is one query at a time.  Its numbers
are rounded exactly as they are sent.  Poses are solved elsewhere, and drawn elsewhere.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import (
    Correspondences,
    Features,
    Frame,
    FrontEndOptions,
    PoseQuery,
    TrackedFrame,
    extract,
    round_for_wire,
)
from client_sdk.slots import Slots
from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.keyframe_map import NO_LANDMARK, KeyframeMap, Landmarks, View, between
from client_sdk.tracking.looks import share_alike
from client_sdk.tracking.noise import NoiseEstimate
from client_sdk.tracking.place import place_of
from client_sdk.tracking.queries import Answer, OneQuery, Steps
from client_sdk.tracking.shutter import ReadoutEstimate, sways, turn_rate, without_shutter
from client_sdk.tracking.stereo_adjustment import StereoAdjustment, adjust_stereo
from rse_pf.geometry import Array, inverse, pose_difference, rigid, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.pnp import DepthNoise
from rse_pf.slam.descriptors import match_all
from rse_pf.slam.tracking import (
    FittedPose,
    ImageFeatures,
    NearLimits,
    Observations,
    distinct_distances,
    fit_pose,
    fit_sway,
)

__all__ = ["Join", "Tracker"]

Rows = npt.NDArray[np.int64]

_PIXEL_PX = 1.0
"""Deviation of a feature's pixel on the finest level; it grows with the size of the feature."""
_LOCAL = 6  # keyframes next to a predicted pose whose landmarks are matched
_LATEST = 3  # newest keyframes that a camera which was lost just now is compared with first
_ALIKE = 5  # keyframes that place recognition proposes
_MANY = 3
"""A guided match with so many times the fewest inliers is worth a query."""
_GUIDED_RATIO = 0.35  # share of the matches that must be inliers of a query guided by a predicted pose
_FOLLOWED_RATIO = 0.4  # of a query against the last frame
_NEAR_RATIO = 0.25  # of a query against a keyframe of the place where the camera was just now
_CONFIRMED_RATIO = 0.3  # of the landmarks around a recognised pose
_CLEAR_RATIO = 0.5  # of a query against a keyframe of any other place, which may be an alias
_CLEAR_INLIERS = 40
_ALIKE_SHARE = 0.25
"""Of the landmarks that the pose of a recognised place expects, so many look as expected at their pixels."""
_CONFIRM_PX = 8.0
_NEAR_LOWE_RATIO = 0.8  # largest ratio of the best and the second distance around a predicted pixel
_CONFIRM_LOWE_RATIO = 0.9  # the same around a pose to confirm, where the radius is small
_FAR_PX = 160.0
"""Radius of the last search around the last pose: a camera that turned otherwise is 10 degrees off."""
_ALL_RATIO = 0.8  # largest ratio of the best and the second distance where all features are compared
_ALL_DISTANCE = 64  # largest distance of a match there, in bits of 256
_ENOUGH = 120
"""With so many landmarks of the map a pose needs no points of the last frame: a chain of frames drifts."""
_MOST_JUMPS = 4
"""A camera that was lost for long may have moved by so many limits, or its place must be clear."""
_LEAST_ROWS = 30  # an image with fewer landmarks with depth does not determine the rate of its shutter
_LEAST_INTERVAL_S = 1e-3  # between two frames, so that stamps which repeat give no infinite rate
_MOST_RATE = 3.0
"""Radians a second.  A rate that a cut only seems to have would turn an image of 20 ms by 3.4 degrees."""
_QUERIES = 3
"""So many keyframes are asked for the place of one frame, those with the most matches first."""
_STEREO_MATCHES = 250
"""Of one query: a stereo pair has depths at many features, and the robot fits all of them itself."""
_JUMP_SHARE = 0.15
"""Of the median depth."""
_JOIN_EVERY = 3
_JOIN_M = 0.15  # two measurements of the pose of a segment agree within this translation
_JOIN_DEG = 4.0  # and within this rotation


@dataclass(frozen=True, slots=True)
class Join:
    """A segment lies in another one: poses of *segment* are ``T_into_segment @ pose`` in *into*.

    Without depth the lengths of *segment* are multiplied by *scale* before.
    """

    segment: int
    into: int
    T_into_segment: Array
    scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """Landmarks that an image shows, and the rows of its features that show them; rows as in `Landmarks`."""

    points: Array
    spreads: Array
    sways: Array
    numbers: Rows
    features: Rows

    def __len__(self) -> int:
        return len(self.features)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Posed:
    """An image with its pose, the landmark of each feature, and whether its pose may be trusted.

    ``is_next`` says that the camera moved there from its last pose, so that its motion is known.
    """

    view: View
    T_world_camera: Array
    landmarks: Rows
    inliers: int
    matches: int
    is_weak: bool
    is_next: bool = False


class Tracker:
    """Visual odometry that knows where it has been; one frame and one query at a time.

    ::

        step = tracker.prepare(frame)
        while isinstance(step, PoseQuery):
            T_camera_world, inliers = ...   # the PnP service's answer, or None, 0 on any failure
            step = tracker.accept(step, T_camera_world, inliers)
        # step is now the TrackedFrame

    A frame is matched near the pixels at which a constant velocity predicts the landmarks of the nearest
    keyframes and of the last frame.  If no pose fits, it is matched with the last frame, then with the latest
    keyframes and those that look most alike, wherever they are.  If nothing fits, the frame is lost, and the
    next one is tried in the same order.  After `FrontEndOptions.segment_after` unrecognised frames a new
    segment begins; it is joined to an older one when two images of it were found there.  A weak pose never
    becomes a keyframe.

    ``frames`` counts the frames prepared so far, ``lost_frames`` those of them without an accepted pose, and
    ``unrecognised`` those since the last pose that show enough and no known place; a covered lens is none.
    ``joins`` are the joins so far, in their order; ``noise`` and ``readout`` are estimates of the camera's,
    and ``disparity_offset_px`` what the disparities of a stereo pair lack, which `adjust_pairs` finds;
    ``pair_offsets`` is what it found last, by segment.
    """

    def __init__(
        self,
        options: FrontEndOptions | None = None,
        T_world_start: Array | None = None,
        slots: Slots | None = None,
    ) -> None:
        self.options = options or FrontEndOptions()
        self._slots = slots or Slots()
        self.frames = 0
        self.lost_frames = 0
        self.keyframes = 0
        self.unrecognised = 0
        self.joins: list[Join] = []
        self.noise = NoiseEstimate()
        self.disparity_offset_px = 0.0
        self.pair_offsets: dict[int, StereoAdjustment] = {}
        self.readout = ReadoutEstimate()
        self._T_world_start = np.eye(4) if T_world_start is None else T_world_start
        self._segments: dict[int, KeyframeMap] = {}
        self._segment = -1
        self._begun = self._adjusted = 0
        self._last: _Posed | None = None
        self._T_last: Array = self._T_world_start
        self._last_s, self._more_s = 0.0, 0.0
        self._motion: Array = np.eye(4)
        self._rate: Array = np.zeros(3)
        self._first: tuple[Features, View] | None = None
        self._reference_seen = 0
        self._lost_in_a_row = 0
        self._place: tuple[int, Array] | None = None
        self._frame: Frame  # set by `prepare`
        self._raw: Features
        self._features: Features
        self._open = OneQuery()

    @property
    def last_features(self) -> Features | None:
        """The features of the last frame, without its rolling shutter, if that has a pose."""
        return self._features if self._last is not None else None

    @property
    def segment(self) -> int:
        """The number of the present segment, from 0."""
        return max(0, self._segment)

    def restart(self, T_world_start: Array) -> None:
        """Forget what frames are matched against: the next frame with enough features is at *T_world_start*.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        self._T_world_start = self._T_last = T_world_start
        self._segments.clear()
        self._segment, self._last, self._place = -1, None, None
        self._motion, self._lost_in_a_row, self._begun, self.unrecognised = np.eye(4), 0, 0, 0
        self._rate, self._first = np.zeros(3), None

    def turn(self, T_new_old: Array) -> None:
        """Turn the world, such as after gravity became known; poses that were returned before change.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        self._T_world_start = _rotation_made(T_new_old @ self._T_world_start)
        self._T_last = _rotation_made(T_new_old @ self._T_last)
        for known in self._segments.values():
            known.move(T_new_old)
        self._place = None
        if self._last is not None:
            self._last = replace(self._last, T_world_camera=self._T_last)
        if self._slots.motion is not None:
            self._slots.motion.clear()

    def adjust_pairs(self) -> dict[int, StereoAdjustment]:
        """Adjust all keyframes of each segment of a stereo drive together, such as at its end.

        It takes seconds.  Returned is by segment how poses change that were returned before, nothing if no
        frame came since the last time; ``pair_offsets`` has also what was not clear enough to change them.
        The next frame is recognised.

        Raises:
            UsageError: A query is open.
        """
        self._open.refuse_open()
        stereo = self._frame.stereo if self._segments else None
        if stereo is None or self._adjusted == self.frames:
            return {}
        self._adjusted, self.pair_offsets = self.frames, {}
        adjusted = {}
        for number, known in self._segments.items():
            found = adjust_stereo(known, self._frame.camera.fx * stereo.baseline_m)
            if found is not None:
                self.pair_offsets[number] = found
                if found.is_clear:
                    adjusted[number] = found
        own = adjusted.get(self._segment)
        if own is not None:
            self.disparity_offset_px += own.offset_px
            self._T_last = _rotation_made(own.moved(np.array([self._last_s]), self._T_last[None])[0])
        self._last, self._place, self._first = None, None, None
        if self._slots.motion is not None:
            self._slots.motion.clear()
        return adjusted

    def prepare(self, frame: Frame) -> PoseQuery | TrackedFrame:
        """Take the next frame; return a query, or the result for the frame if none is needed.

        The first frame with enough features is the start and needs no query; a frame without enough
        matches is lost without one.

        Raises:
            UsageError: The last query was not answered yet.
        """
        self._open.refuse_open()
        self.frames += 1
        self._frame, self._raw = frame, extract(frame, self.options, self._slots.features)
        if self.disparity_offset_px and frame.stereo is not None:
            f_baseline = frame.camera.fx * frame.stereo.baseline_m
            points_camera = with_offset(self._raw.points_camera, f_baseline, self.disparity_offset_px)
            self._raw = replace(self._raw, points_camera=points_camera)
        self._features = self._raw
        self.noise.model = frame.depth_noise
        return self._open.begin(self._track(self._turned(self._view(), self._raw, self._rate)))

    def accept(
        self, query: PoseQuery, T_camera_world: Array | None, inliers: int = 0, *, is_weak: bool = False
    ) -> PoseQuery | TrackedFrame:
        """Take the answer to *query*; return another query, or the result for the frame.

        Args:
            query: The query that `prepare` or `accept` returned last.
            T_camera_world: ``(4, 4)`` as the PnP service returns it, where world is the world of
                the query (its reference camera); ``None`` if there was no answer.
            inliers: How many correspondences agree with it.
            is_weak: Whether its evidence is weak.

        Raises:
            UsageError: *query* is not the open one.
        """
        return self._open.answer(query, Answer(T_camera_world, inliers, is_weak))

    # --- one frame ---

    def _track(self, view: View) -> Steps:
        """Return the result of a frame, and yield the queries that it needs."""
        if not self._segments:
            return self._begin_or_lose(view, matches=0)
        posed, matches = None, 0
        if self._last is not None:
            for how in ("map", "frame", "far") if self._frame.stereo is not None else ("map", "frame"):
                posed, tried = yield from self._follow(view, how)
                matches = max(matches, tried)
                if posed is not None:
                    break
        if posed is None:
            posed, tried = yield from self._recognise(view)
            matches = max(matches, tried)
        if posed is None:
            return self._begin_or_lose(view, matches)
        keyframe = self._keep(posed)
        if len(self._segments) > 1 and self.frames % _JOIN_EVERY == 0:
            yield from self._seek_join(posed)
        return self._result(posed, keyframe=keyframe)

    def _follow(self, view: View, how: str) -> Generator[PoseQuery, Answer, tuple[_Posed | None, int]]:
        """Yield a query against what the last pose predicts, or against the last frame alone."""
        assert self._last is not None
        least = self.options.min_inliers
        T_reference = self._expected() if how == "map" else self._T_last
        if how != "frame":
            radius_px = self.options.search_px if how == "map" else _FAR_PX
            seen = self._seen(view, T_reference, radius_px, _NEAR_LOWE_RATIO)
            if len(seen) < (_MANY if how == "map" else 1) * least:
                return None, len(seen)
        else:
            seen = _seen_anywhere(self._of_last(), self._last_descriptors(), view)
            if len(seen) < least:
                return None, len(seen)
        answer = yield self._make_query(view, seen, T_reference, "frame" if how == "frame" else "map")
        ratio = _FOLLOWED_RATIO if how == "frame" else _GUIDED_RATIO
        T = self._placed(answer, T_reference, len(seen), ratio)
        if T is None or not self._is_plausible(T):
            return None, len(seen)
        image, is_next = self._image_at(view, T, is_near=True)
        return self._confirm(image, T, answer, len(seen), self._map(), is_next=is_next), len(seen)

    def _expected(self) -> Array:
        """Return ``T_world_camera`` as a user's motion function expects it, else by a constant velocity.

        With an IMU the camera turns as the gyroscope measured it.
        """
        motion, inertial = self._slots.motion, self._slots.inertial
        T = None if motion is None else motion.expected(self._frame.timestamp_s)
        if T is not None:
            return T
        T_last_now = self._motion.copy()
        turned = None if inertial is None else inertial.camera_rotation(self._last_s, self._frame.timestamp_s)
        if turned is not None:
            T_last_now[:3, :3] = turned
        return _rotation_made(self._T_last @ T_last_now)

    def _recognise(self, view: View) -> Generator[PoseQuery, Answer, tuple[_Posed | None, int]]:
        """Yield queries against the latest and the most alike keyframes of all segments."""
        candidates = []
        for segment, number in self._candidates(view):
            landmarks, descriptors = self._segments[segment].landmarks_in(number)
            candidates.append((segment, number, _seen_anywhere(landmarks, descriptors, view)))
        candidates.sort(key=lambda candidate: -len(candidate[2]))
        most = len(candidates[0][2]) if candidates else 0
        for segment, number, seen in candidates[:_QUERIES]:
            if len(seen) < self.options.min_inliers:
                break
            known = self._segments[segment]
            T_reference = known.pose(number)
            answer = yield self._make_query(view, seen, T_reference, "keyframe")
            T = self._placed(answer, T_reference, len(seen), 0.0)
            if T is None:
                continue
            is_clear = answer.inliers >= max(_CLEAR_INLIERS, _CLEAR_RATIO * len(seen)) and not answer.is_weak
            is_near = segment == self._segment and self._is_plausible(T)
            if not (is_clear or (is_near and answer.inliers >= _NEAR_RATIO * len(seen))):
                continue
            image, is_next = self._image_at(view, T, is_near=is_near)
            posed = self._confirm(image, T, answer, len(seen), known, is_next=is_next)
            if posed is not None and self._looks_right(posed.T_world_camera, known):
                if segment != self._segment:
                    self._segment, self._last, self._place = segment, None, None
                return posed, most
        return None, most

    def _candidates(self, view: View) -> Iterator[tuple[int, int]]:
        """Yield the keyframes that may show what a frame shows: (segment, number)."""
        for segment, known in self._segments.items():
            numbers = known.most_alike(view.place, _ALIKE)
            if segment == self._segment:
                numbers = [*range(len(known) - 1, max(-1, len(known) - 1 - _LATEST), -1), *numbers]
            yield from ((segment, number) for number in dict.fromkeys(numbers))

    def _seek_join(self, posed: _Posed) -> Generator[PoseQuery, Answer, None]:
        """Yield a query for the place of a tracked frame in another segment; join the two when two agree."""
        options = []
        for segment, known in self._segments.items():
            if segment == self._segment:
                continue
            for number in known.most_alike(posed.view.place, _ALIKE):
                landmarks, descriptors = known.landmarks_in(number)
                options.append((segment, number, _seen_anywhere(landmarks, descriptors, posed.view)))
        segment, number, seen = max(options, key=lambda option: len(option[2]))
        if len(seen) < _CLEAR_INLIERS:
            return
        T_reference = self._segments[segment].pose(number)
        answer = yield self._make_query(posed.view, seen, T_reference, "segment")
        T = self._placed(answer, T_reference, len(seen), _CLEAR_RATIO)
        if T is None or answer.inliers < _CLEAR_INLIERS or answer.is_weak:
            return
        other = self._confirm(posed.view, T, answer, len(seen), self._segments[segment])
        if other is None or not self._looks_right(other.T_world_camera, self._segments[segment]):
            return
        T_into_segment = _rotation_made(other.T_world_camera @ inverse(posed.T_world_camera))
        before, self._place = self._place, (segment, T_into_segment)
        if before is None or before[0] != segment:
            return
        apart_m, apart_deg = pose_difference(before[1], T_into_segment)
        if apart_m <= _JOIN_M and apart_deg <= _JOIN_DEG:
            if segment < self._segment:
                self._join(self._segment, segment, T_into_segment)
            else:  # the camera is back in the older segment: its poses stay
                self._join(segment, self._segment, inverse(T_into_segment))

    def _join(self, segment: int, into: int, T_into_segment: Array) -> None:
        """Move all of *segment*, the newer one, into *into*, which keeps its frame."""
        own = self._segments.pop(segment)
        own.move(T_into_segment)
        first = self._segments[into].take(own)
        self.joins.append(Join(segment, into, T_into_segment))
        self._place = None
        if segment != self._segment or self._last is None:
            return
        self._segment = into
        if self._slots.motion is not None:
            self._slots.motion.clear()
        self._T_last = _rotation_made(T_into_segment @ self._T_last)
        last = self._last
        moved = np.where(last.landmarks == NO_LANDMARK, NO_LANDMARK, last.landmarks + first)
        self._last = replace(last, T_world_camera=self._T_last, landmarks=moved)

    # --- matches and poses ---

    def _map(self) -> KeyframeMap:
        return self._segments[self._segment]

    def _of_last(self) -> Landmarks:
        assert self._last is not None
        return self._map().landmarks_of_view(
            self._last.view, self._T_last, self._last.landmarks, self.noise.noise, _PIXEL_PX
        )

    def _last_descriptors(self) -> Descriptors:
        return self._of_last().descriptors

    def _seen(
        self, view: View, T_world_camera: Array, radius_px: float, ratio: float,
        known: KeyframeMap | None = None, enough: int = 1_000_000,
    ) -> _Seen:  # fmt: skip
        """Match landmarks of the nearest keyframes and of the last frame near the pixels that a pose expects.

        A feature that both show is taken as the last frame shows it.
        """
        T_camera_world = inverse(T_world_camera)
        limits = NearLimits(radius_px=radius_px, ratio=ratio)
        own = known is None or known is self._map()
        if known is None:
            known = self._map()
        nearest = known.nearest(T_world_camera, _LOCAL)
        numbers, features = known.seek(nearest, T_camera_world, view, limits, radius_px)
        if self._last is None or not own or self._lost_in_a_row or len(features) >= enough:
            return _seen_rows(known.landmarks(numbers), np.arange(len(numbers)), features)
        recent = self._of_last()
        rows, recent_features = recent.seek(T_camera_world, view.camera, view.features, limits, radius_px)
        is_new, is_new_landmark = np.ones(len(view.features), bool), np.ones(known.landmark_count + 1, bool)
        is_new[recent_features] = is_new_landmark[recent.numbers[rows]] = False  # NO_LANDMARK is the last row
        stays = is_new[features] & is_new_landmark[numbers]
        numbers, features = numbers[stays], features[stays]
        first = _seen_rows(known.landmarks(numbers), np.arange(len(numbers)), features)
        second = _seen_rows(recent, rows, recent_features)
        return _Seen(
            points=np.concatenate([first.points, second.points]),
            spreads=np.concatenate([first.spreads, second.spreads]),
            sways=np.concatenate([first.sways, second.sways]),
            numbers=np.concatenate([first.numbers, second.numbers]),
            features=np.concatenate([first.features, second.features]),
        )

    def _make_query(self, view: View, seen: _Seen, T_reference: Array, against: str) -> PoseQuery:
        rows, most = np.arange(len(seen)), self._most_matches()
        if len(rows) > most:
            rows = np.linspace(0, len(rows) - 1, most).astype(np.int64)
        rows = rows[np.argsort(view.features.pixels[seen.features[rows], 0], kind="stable")]
        features = seen.features[rows]
        points, pixels = round_for_wire(
            transform(inverse(T_reference), seen.points[rows]), view.features.pixels[features]
        )
        depths_m = np.nan_to_num(view.points_camera[features, 2], posinf=0.0, neginf=0.0).round(3)
        if len(points) and points[:, 2].min() <= 0.01:
            depths_m = np.zeros(len(points))  # a depth is compared with that of the reference camera
        return PoseQuery(
            timestamp_s=self._frame.timestamp_s,
            correspondences=Correspondences(points_world=points, pixels=pixels, depths_m=depths_m),
            camera=view.camera,
            inlier_px=self.options.inlier_px,
            max_iterations=self.options.max_iterations,
            against=against,  # type: ignore[arg-type]
            depth_noise=None if self._frame.stereo is None else self.noise.noise,
        )

    def _most_matches(self) -> int:
        most = self.options.max_matches
        return most if self._frame.stereo is None else min(most, _STEREO_MATCHES)

    def _placed(self, answer: Answer, T_reference: Array, matches: int, ratio: float) -> Array | None:
        """Return ``T_world_camera`` of an answer, None if too few agree or it is no pose."""
        asked = min(matches, self._most_matches())
        if answer.T_camera_world is None or answer.inliers < max(self.options.min_inliers, ratio * asked):
            return None
        T_camera_reference = rigid(answer.T_camera_world)
        return None if T_camera_reference is None else T_reference @ inverse(T_camera_reference)

    def _is_plausible(self, T_world_camera: Array) -> bool:
        jump_m = max(self.options.max_jump_m, self._scene_jump_m())
        limit_m = jump_m * min(1 + self._lost_in_a_row, _MOST_JUMPS)
        moved_m = float(np.linalg.norm(T_world_camera[:3, 3] - self._T_last[:3, 3]))
        return moved_m <= limit_m

    def _scene_jump_m(self) -> float:
        """Return how far a stereo pair may move at once among what it sees: that of a car sees far."""
        z = self._raw.points_camera[:, 2]
        if self._frame.stereo is None or not np.isfinite(z).any():
            return 0.0
        return _JUMP_SHARE * float(np.median(z[np.isfinite(z)]))

    def _image_at(self, view: View, T_world_camera: Array, *, is_near: bool) -> tuple[View, bool]:
        """Return a frame's image at a pose, and whether the camera moved there from its last pose.

        After a cut in a video it did not, and nothing is known of how fast it turns: its shutter stays.
        """
        rate = turn_rate(self._T_last, T_world_camera, self._interval_s(), np.zeros(3))
        if is_near and self._last is not None and float(np.linalg.norm(rate)) <= _MOST_RATE:
            return view, True
        return self._turned(view, self._raw, np.zeros(3)), False

    def _confirm(
        self, view: View, T_world_camera: Array, answer: Answer, matches: int, known: KeyframeMap,
        *, is_next: bool = False,
    ) -> _Posed | None:  # fmt: skip
        """Match the local map near the pose, and fit the pose to all that agrees; None if little does.

        *is_next* says that the camera moved here from its last pose.
        """
        seen = self._seen(view, T_world_camera, _CONFIRM_PX, _CONFIRM_LOWE_RATIO, known, _ENOUGH)
        least = self.options.min_inliers
        if len(seen) < least:
            return None
        observed = self._observe(view, seen, T_world_camera)
        fitted = fit_pose(observed, view.camera, inverse(T_world_camera))
        if fitted is not None and is_next:
            T_fitted = inverse(fitted.T_camera_world)
            rate = turn_rate(self._T_last, T_fitted, self._interval_s(), self._rate)
            if self._first is not None and int(fitted.is_inlier.sum()) >= _CLEAR_INLIERS:
                self._turn_first(*self._first, rate)
                return self._confirm(view, T_fitted, answer, matches, self._map(), is_next=True)
            view = self._turned(view, self._raw, rate)
            observed = self._observe(view, seen, T_fitted)
            fitted = fit_pose(observed, view.camera, fitted.T_camera_world)
            if fitted is not None and self._frame.stereo is None:
                self._learn_readout(view, seen, observed, fitted, rate)
        agreeing = 0 if fitted is None else int(fitted.is_inlier.sum())
        if fitted is None or agreeing < max(least, _CONFIRMED_RATIO * len(seen)):
            return None
        T_camera_world = rigid(fitted.T_camera_world)
        if T_camera_world is None:
            return None
        inliers = np.flatnonzero(fitted.is_inlier)
        self.noise.add(observed, inliers, T_camera_world)
        landmarks = np.full(len(view.features), NO_LANDMARK)
        landmarks[seen.features[inliers]] = seen.numbers[inliers]
        return _Posed(
            view=view, T_world_camera=inverse(T_camera_world), landmarks=landmarks, inliers=agreeing,
            matches=max(matches, len(seen)), is_weak=answer.is_weak, is_next=is_next,
        )  # fmt: skip

    def _looks_right(self, T_world_camera: Array, known: KeyframeMap) -> bool:
        """Return whether a frame shows what a pose expects: matches alone never speak against one.

        A user's features cannot be described where they were not found: they are believed.
        """
        if self._slots.features is not None:
            return True
        landmarks = known.landmarks_of(known.nearest(T_world_camera, _LOCAL))
        share, count = share_alike(self._frame, landmarks, T_world_camera)
        return count >= self.options.min_inliers and share >= _ALIKE_SHARE

    def _observe(self, view: View, seen: _Seen, T_world_camera: Array) -> Observations:
        z = np.nan_to_num(view.points_camera[seen.features, 2], posinf=0.0, neginf=0.0)
        noise: DepthNoise = self.noise.noise
        at_m = z
        if view.is_stereo:
            at_m = between(z, transform(inverse(T_world_camera), seen.points)[:, 2])
        return Observations(
            points=seen.points,
            spreads=seen.spreads,
            pixels=view.features.pixels[seen.features],
            pixels_px=_PIXEL_PX * view.features.sizes[seen.features],
            depths_m=z,
            depths_dev_m=np.sqrt(noise.variance_m2(at_m)),
        )

    # --- the shutter ---

    def _view(self) -> View:
        """Return the image of the present frame, with its rolling shutter."""
        features = self._raw
        image = ImageFeatures(
            pixels=features.pixels, descriptors=features.descriptors, turns=features.turns,
            sizes=features.sizes, distinct=distinct_distances(features.descriptors, features.pixels),
            is_oriented=features.is_oriented, is_scaled=features.is_scaled,
        )  # fmt: skip
        return View(
            features=image, points_camera=features.points_camera, sways=np.zeros_like(features.points_camera),
            camera=self._frame.camera,
            place=place_of(features.descriptors, self._frame.rgb, self._slots.loops),
            is_stereo=self._frame.stereo is not None, timestamp_s=self._frame.timestamp_s,
        )  # fmt: skip

    def _interval_s(self) -> float:
        return max(_LEAST_INTERVAL_S, self._frame.timestamp_s - self._last_s)

    def _turned(self, view: View, raw: Features, rate: Array) -> View:
        """Return an image without its rolling shutter, of a camera that turns at *rate*."""
        features = without_shutter(raw, view.camera, self.readout.readout_s * rate)
        return replace(
            view,
            features=replace(view.features, pixels=features.pixels),
            points_camera=features.points_camera,
            sways=sways(raw, features.points_camera, view.camera, rate),
        )

    def _turn_first(self, raw: Features, view: View, rate: Array) -> None:
        """Make the first keyframe of a segment again, now that a second image tells how the camera turned."""
        assert self._last is not None
        first = self._turned(view, raw, rate)
        known = self._segments[self._segment] = KeyframeMap(self.options.max_keyframes)
        none = np.full(len(first.features), NO_LANDMARK)
        landmarks = known.add_keyframe(first, self._T_last, none, self.noise.noise, _PIXEL_PX)
        self._last, self._first = replace(self._last, view=first, landmarks=landmarks), None

    def _learn_readout(
        self, view: View, seen: _Seen, observed: Observations, fitted: FittedPose, rate: Array
    ) -> None:
        """Correct the estimate of the readout by what an image with its pose tells.

        Stereo cameras have global shutters, and a pair that is not simultaneous would look like a readout.
        """
        rows = np.flatnonzero(fitted.is_inlier & (observed.depths_m > 0.0))
        if len(rows) < _LEAST_ROWS:
            return
        known = seen.sways[rows] @ fitted.T_camera_world[:3, :3].T
        more_s, information = fit_sway(
            observed.only(rows), known - view.sways[seen.features[rows]], view.camera, fitted.T_camera_world
        )
        self._more_s += self.readout.add(more_s, information, rate)

    # --- results ---

    def _keep(self, posed: _Posed) -> bool:
        """Take a posed frame as the last one, and into the map; say whether it became a keyframe."""
        known, T = self._map(), posed.T_world_camera
        if self._lost_in_a_row or self._last is None:
            self._motion = np.eye(4)
        else:
            self._motion = _rotation_made(inverse(self._T_last) @ T)
            if not posed.is_next:
                self._rate = np.zeros(3)
            else:
                self._rate = turn_rate(self._T_last, T, self._interval_s(), np.zeros(3))
        self._last_s, self._first = self._frame.timestamp_s, None
        if self._slots.motion is not None:
            if self._lost_in_a_row or self._last is None:
                self._slots.motion.clear()
            self._slots.motion.add(self._frame.timestamp_s, T)
        self._features = replace(
            self._raw, pixels=posed.view.features.pixels, points_camera=posed.view.points_camera
        )
        self._lost_in_a_row, self.unrecognised, self._T_last = 0, 0, T
        keyframe = self._is_keyframe(posed)
        if not posed.is_weak:
            known.fuse(posed.view, T, posed.landmarks, self.noise.noise, _PIXEL_PX)
        landmarks = posed.landmarks
        if keyframe:
            landmarks = known.add_keyframe(posed.view, T, landmarks, self.noise.noise, _PIXEL_PX)
            self.keyframes += 1
            self._reference_seen = posed.inliers
        self._last = _Posed(
            view=posed.view, T_world_camera=T, landmarks=landmarks, inliers=posed.inliers,
            matches=posed.matches, is_weak=posed.is_weak,
        )  # fmt: skip
        # After the image, which was measured with the readout of before, has become part of the map.
        for segment in self._segments.values():
            segment.lengthen_readout(self._more_s)
        self._more_s = 0.0
        return keyframe

    def _is_keyframe(self, posed: _Posed) -> bool:
        options = self.options
        if posed.is_weak or posed.inliers < 2 * options.min_inliers:
            return False
        metres, degrees = self._map().distances(posed.T_world_camera)
        is_new = bool(((metres > options.keyframe_m) | (degrees > options.keyframe_deg)).all())
        landmarks = int((posed.landmarks != NO_LANDMARK).sum())
        return is_new or landmarks < options.keyframe_share * self._reference_seen

    def _begin_or_lose(self, view: View, matches: int) -> TrackedFrame:
        """Begin a segment with a frame that has enough features with depth, if so many before were lost."""
        usable = int(np.isfinite(view.points_camera[:, 2]).sum())
        if usable < (_MANY if self._segments else 1) * self.options.min_inliers:
            return self._lose(matches)
        if self._segments:
            self.unrecognised += 1
            if self.unrecognised <= self.options.segment_after:
                return self._lose(matches)
        start = self._T_world_start if not self._segments else self._T_last
        self._segment = self._begun
        self._begun += 1
        self._segments[self._segment] = KeyframeMap(self.options.max_keyframes)
        none = np.full(len(view.features), NO_LANDMARK)
        landmarks = self._map().add_keyframe(view, start, none, self.noise.noise, _PIXEL_PX)
        self.keyframes += 1
        self._last = _Posed(
            view=view, T_world_camera=start, landmarks=landmarks, inliers=0, matches=0, is_weak=False
        )
        self._first, self._last_s, self._rate = (self._raw, view), self._frame.timestamp_s, np.zeros(3)
        if self._slots.motion is not None:
            self._slots.motion.clear()
            self._slots.motion.add(self._frame.timestamp_s, start)
        self._T_last, self._motion, self._place = start, np.eye(4), None
        self._lost_in_a_row, self.unrecognised, self._reference_seen = 0, 0, usable // 2
        return self._result(self._last, keyframe=True)

    def _result(self, posed: _Posed, *, keyframe: bool) -> TrackedFrame:
        is_apart = self._segment != min(self._segments)
        return TrackedFrame(
            frame=self._frame, T_world_camera=self._T_last, keyframe=keyframe, inliers=posed.inliers,
            matches=posed.matches, segment=self.segment, features=self._raw,
            reason="in a segment that is not joined to the first one yet" if is_apart else "",
        )  # fmt: skip

    def _lose(self, matches: int) -> TrackedFrame:
        self.lost_frames += 1
        self._lost_in_a_row += 1
        self._last, self._rate = None, np.zeros(3)
        return TrackedFrame(
            frame=self._frame, T_world_camera=None, keyframe=False, inliers=0, matches=matches,
            segment=self.segment, features=self._raw,
        )  # fmt: skip


def _seen_anywhere(landmarks: Landmarks, descriptors: Descriptors, view: View) -> _Seen:
    """Match landmarks with the features of an image by appearance alone."""
    rows, features = match_all(
        descriptors, view.features.descriptors, ratio=_ALL_RATIO, max_distance=_ALL_DISTANCE
    )
    return _seen_rows(landmarks, rows, features)


def _seen_rows(landmarks: Landmarks, rows: Rows, features: Rows) -> _Seen:
    """Return some rows of landmarks as an image shows them."""
    return _Seen(
        points=landmarks.points[rows], spreads=landmarks.spreads[rows], sways=landmarks.sways[rows],
        numbers=landmarks.numbers[rows], features=features,
    )  # fmt: skip


def _rotation_made(T: Array) -> Array:
    """Return a pose with a true rotation: products drift from it, and `inverse` doubles the error."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    made: Array = T.copy()
    made[:3, :3] = U @ Vt
    return made
