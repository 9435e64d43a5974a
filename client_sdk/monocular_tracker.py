"""Track a camera without depth: two-view start, poses by the PnP service, keyframes, landmarks.

`MonocularTracker` is a state machine without input or output, with the same steps as `Tracker`: frames and
answers go in, pose queries and tracked frames come out.  Its unit of length is arbitrary until
`MonocularTracker.rescale` is called.  It keeps one map: a lost robot is found again only where it was.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Correspondences, Frame, PoseQuery, TrackedFrame, describe, round_for_wire
from client_sdk.mapping import Trajectory
from client_sdk.monocular.bundle import refine_pose, reprojection_errors
from client_sdk.monocular.descriptors import match_all, match_near
from client_sdk.monocular.landmark_map import NO_LANDMARK, LandmarkLimits, LandmarkMap, ViewFeatures
from client_sdk.monocular.two_view import start_from_two_views
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, pose_difference, transform

__all__ = ["MonocularOptions", "MonocularTracker"]

_START_DEPTH = 2.0
"""Median depth of the first landmarks in the arbitrary unit: fine enough for points rounded to 0.0001."""
_MAX_STARTING = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class MonocularOptions:
    """How a camera without depth is tracked.

    Attributes:
        features: Features of a frame, spread over its cells.
        max_matches: An even sample of so many is sent: a command stays under 10 kB in every codec.
        inlier_px: Largest reprojection error of an inlier.
        max_iterations: Of RANSAC.
        min_inliers: A pose with fewer is not accepted.
        search_px: Radius around the predicted pixels in which matches are sought.
        keyframe_share: A frame that sees a smaller share of its keyframe's landmarks becomes a keyframe.
        keyframe_deg: A frame turned further from the last keyframe becomes one.
        keyframe_depth_percent: A frame that moved further, in percent of the median depth, becomes one.
        start_parallax_deg: Median angle between the two views of the start.
        limits: Of the map.
    """

    features: int = 1000
    max_matches: int = 250
    inlier_px: float = 3.0
    max_iterations: int = 1000
    min_inliers: int = 20
    search_px: float = 40.0
    keyframe_share: float = 0.5
    keyframe_deg: float = 10.0
    keyframe_depth_percent: float = 10.0
    start_parallax_deg: float = 2.0
    limits: LandmarkLimits = field(default_factory=LandmarkLimits)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Posed:
    """A pose relative to a keyframe, so that later adjustments of the keyframe move it, too."""

    timestamp_s: float
    keyframe: int
    T_keyframe_camera: Array


class MonocularTracker:
    """Visual odometry of one camera without depth, as a state machine without I/O.

    Use it as `Tracker`: ``prepare(frame)``, then ``accept(query, T_camera_world, inliers)`` until a
    `TrackedFrame` comes back.  ``frames`` counts the frames, ``lost_frames`` those without a pose after the
    start, ``starting_frames`` those before it; the poses of these are in `trajectory` after the start.
    """

    def __init__(self, options: MonocularOptions | None = None, T_world_start: Array | None = None) -> None:
        self.options = options or MonocularOptions()
        self.frames = 0
        self.lost_frames = 0
        self.starting_frames = 0
        self.map: LandmarkMap | None = None
        self._T_world_start = np.eye(4) if T_world_start is None else T_world_start
        self._starting: list[tuple[float, ViewFeatures]] = []
        self._posed: list[_Posed] = []
        self._reference = 0
        self._reference_seen = 0
        self._last: Array = np.eye(4)
        self._motion: Array = np.eye(4)
        self._lost_in_a_row = 0
        self._query: PoseQuery | None = None
        self._to_try: list[str] = []
        self._frame: Frame
        self._features: ViewFeatures
        self._matched: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]

    @property
    def keyframes(self) -> int:
        """The number of keyframes."""
        return 0 if self.map is None else len(self.map.keyframes)

    def prepare(self, frame: Frame) -> PoseQuery | TrackedFrame:
        """Take the next frame; return a query, or the result for the frame if none is needed.

        Raises:
            UsageError: The last query was not answered yet, or the camera is another one.
        """
        if self._query is not None:
            raise UsageError("the last query is open", hint="call accept with its answer, or with None")
        if self.map is not None and frame.camera != self.map.camera:
            raise UsageError("the camera of this frame is another one", hint="use one tracker per camera")
        self.frames += 1
        self._frame, self._features = frame, _extract(frame, self.options.features)
        if self.map is None:
            return self._start(frame)
        self._to_try = ["all"] if self._lost_in_a_row else ["motion", "recent", "all"]
        return self._next_query("")

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
        if query is not self._query:
            raise UsageError("this query is not the open one", hint="answer each query once, in order")
        self._query = None
        if T_camera_world is None or inliers < self.options.min_inliers:
            return self._next_query("the matches agree on no pose")
        found = self._refined(T_camera_world)
        if found is None:
            return self._next_query("too few landmarks agree with the pose")
        return self._keep(*found, matches=len(query.correspondences), is_weak=is_weak)

    def trajectory(self) -> Trajectory:
        """Return all poses so far, in the order of time, as the keyframes are adjusted now."""
        if self.map is None:
            return Trajectory(np.empty(0), np.empty((0, 4, 4)))
        poses = [self._T_world_camera(each) for each in self._posed]
        stamps = np.array([each.timestamp_s for each in self._posed])
        order = np.argsort(stamps, kind="stable")
        return Trajectory(stamps[order], np.array(poses).reshape(-1, 4, 4)[order])

    def points(self) -> tuple[Array, npt.NDArray[np.uint8]]:
        """Return the ``(n, 3)`` landmarks in the world and their ``(n, 3)`` uint8 colours."""
        if self.map is None:
            return np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)
        alive = self.map.is_alive
        return transform(self._T_world_start, self.map.points[alive]), self.map.colours[alive]

    def rescale(self, scale: float) -> None:
        """Multiply all lengths by *scale*, such as metres per unit."""
        if self.map is not None:
            self.map.rescale(scale)
        for row, each in enumerate(self._posed):
            self._posed[row] = replace(each, T_keyframe_camera=_scaled(each.T_keyframe_camera, scale))
        self._last, self._motion = _scaled(self._last, scale), _scaled(self._motion, scale)

    # --- the start ---

    def _start(self, frame: Frame) -> TrackedFrame:
        """Wait for a second view with parallax; then make the first two keyframes and landmarks."""
        if not self._starting:
            self._starting = [(frame.timestamp_s, self._features)]
            return self._wait("the first frame")
        options = self.options
        first = self._starting[0][1]
        rows, columns = match_all(first.descriptors, self._features.descriptors)
        views = start_from_two_views(
            first.pixels[rows], self._features.pixels[columns], frame.camera,
            min_parallax_deg=options.start_parallax_deg,
        )  # fmt: skip
        if views.reason:
            if len(rows) < 100 or len(self._starting) >= _MAX_STARTING:
                self._starting = [(frame.timestamp_s, self._features)]
            else:
                self._starting.append((frame.timestamp_s, self._features))
            return self._wait(views.reason)
        unit = _START_DEPTH / float(np.median(views.points[:, 2]))
        made = LandmarkMap(frame.camera, options.limits)
        none = np.full(len(first.pixels), NO_LANDMARK)
        made.add_keyframe(first, np.eye(4), none)
        pose = _scaled(views.T_second_first, unit)
        made.add_keyframe(self._features, pose, np.full(len(self._features.pixels), NO_LANDMARK))
        made.add_landmarks(unit * views.points, (0, rows[views.rows]), (1, columns[views.rows]))
        made.adjust_all()
        self.map = made
        self._set_reference(1)
        self._posed.append(_Posed(timestamp_s=self._starting[0][0], keyframe=0, T_keyframe_camera=np.eye(4)))
        T_camera_world = made.keyframes[1].T_camera_world
        self._place_waiting(T_camera_world)
        self._motion = np.eye(4)
        self._last = T_camera_world
        return self._result(T_camera_world, keyframe=True, inliers=len(made), matches=len(rows))

    def _place_waiting(self, T_second_world: Array) -> None:
        """Give the frames between the two views their poses."""
        assert self.map is not None
        count = len(self._starting)
        pose = np.eye(4)
        for number, (timestamp_s, features) in enumerate(self._starting[1:], start=1):
            guess = pose.copy()
            guess[:3, 3] += (T_second_world[:3, 3] - pose[:3, 3]) / (count - number + 1)
            found = self._refined(guess, features, radius_px=self.options.search_px)
            if found is not None:
                pose = found[0]
                relative = self.map.keyframes[0].T_camera_world @ inverse(pose)
                self._posed.append(_Posed(timestamp_s=timestamp_s, keyframe=0, T_keyframe_camera=relative))
        self._starting = []

    def _wait(self, reason: str) -> TrackedFrame:
        self.starting_frames += 1
        return TrackedFrame(
            frame=self._frame, T_world_camera=None, keyframe=False, inliers=0, matches=0,
            reason=reason, status="starting", scale="up to scale",
        )  # fmt: skip

    # --- queries ---

    def _next_query(self, reason: str) -> PoseQuery | TrackedFrame:
        while self._to_try:
            how = self._to_try.pop(0)
            landmarks, features = self._matches(how)
            if len(landmarks) >= self.options.min_inliers:
                return self._ask(how, landmarks, features)
            reason = f"only {len(landmarks)} matches with the map"
        return self._lose(reason)

    def _matches(self, how: str) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return landmarks and features that match: near the predicted pixels, or by appearance alone."""
        assert self.map is not None
        features = self._features
        if how == "motion":
            landmarks, pixels = self.map.visible(self._motion @ self._last, margin_px=self.options.search_px)
            rows, columns = match_near(
                pixels, self.map.descriptors[landmarks], features.pixels, features.descriptors,
                radius_px=self.options.search_px, ratio=0.8,
            )  # fmt: skip
            if len(rows) < 3 * self.options.min_inliers:
                return landmarks[:0], columns[:0]
            return landmarks[rows], columns
        if how == "recent":
            latest = range(max(0, len(self.map.keyframes) - 5), len(self.map.keyframes))
            wanted = {self._reference, *latest}
            landmarks = np.unique(np.concatenate([self.map.landmarks_of(each) for each in wanted]))
        else:
            landmarks = np.flatnonzero(self.map.is_alive)
        rows, columns = match_all(self.map.descriptors[landmarks], features.descriptors, ratio=0.85)
        return landmarks[rows], columns

    def _ask(self, how: str, landmarks: npt.NDArray[np.int64], features: npt.NDArray[np.int64]) -> PoseQuery:
        assert self.map is not None
        if len(landmarks) > self.options.max_matches:
            chosen = np.linspace(0, len(landmarks) - 1, self.options.max_matches).astype(np.int64)
            landmarks, features = landmarks[chosen], features[chosen]
        order = np.argsort(self._features.pixels[features, 0], kind="stable")
        points, pixels = round_for_wire(
            self.map.points[landmarks[order]], self._features.pixels[features[order]]
        )
        self._query = PoseQuery(
            timestamp_s=self._frame.timestamp_s,
            correspondences=Correspondences(
                points_world=points, pixels=pixels, depths_m=np.zeros(len(points))
            ),
            camera=self._frame.camera,
            inlier_px=self.options.inlier_px,
            max_iterations=self.options.max_iterations,
            against="map" if how == "motion" else "keyframe",
        )
        return self._query

    def _refined(
        self, T_camera_world: Array, features: ViewFeatures | None = None, *, radius_px: float = 8.0
    ) -> tuple[Array, npt.NDArray[np.int64]] | None:
        """Match all landmarks that the pose should see, and refine it with those that agree.

        Returns the pose and the ``(n,)`` landmark of each feature, or None if too few agree.
        """
        assert self.map is not None
        features = features or self._features
        pose = T_camera_world
        for radius in (radius_px, 5.0):
            landmarks, pixels = self.map.visible(pose)
            rows, columns = match_near(
                pixels, self.map.descriptors[landmarks], features.pixels, features.descriptors,
                radius_px=radius,
            )  # fmt: skip
            if len(rows) < self.options.min_inliers:
                return None
            points, seen = self.map.points[landmarks[rows]], features.pixels[columns]
            sigma = features.sigma_px[columns] * self.options.limits.pixel_sigma
            kept = np.ones(len(rows), dtype=bool)
            for _ in range(2):
                pose = refine_pose(pose, points[kept], seen[kept], sigma[kept], self.map.camera)
                errors, _ = reprojection_errors(pose, points, seen, self.map.camera)
                kept = errors <= self.options.limits.outlier_sigma * sigma
                if kept.sum() < self.options.min_inliers:
                    return None
        of_features = np.full(len(features.pixels), NO_LANDMARK)
        of_features[columns[kept]] = landmarks[rows[kept]]
        return pose, of_features

    # --- results ---

    def _keep(
        self, T_camera_world: Array, of_features: npt.NDArray[np.int64], *, matches: int, is_weak: bool
    ) -> TrackedFrame:
        assert self.map is not None
        inliers = int((of_features != NO_LANDMARK).sum())
        if self._lost_in_a_row:
            self._motion = np.eye(4)
        else:
            self._motion = T_camera_world @ inverse(self._last)
        self._lost_in_a_row = 0
        self._last = T_camera_world
        keyframe = not is_weak and self._is_keyframe(T_camera_world, inliers)
        if keyframe:
            number = self.map.add_keyframe(self._features, T_camera_world, of_features)
            self.map.extend(number)
            self.map.adjust_around(number)
            self.map.cull()
            self._set_reference(number)
            self._last = self.map.keyframes[number].T_camera_world
        return self._result(self._last, keyframe=keyframe, inliers=inliers, matches=matches)

    def _result(self, T_camera_world: Array, *, keyframe: bool, inliers: int, matches: int) -> TrackedFrame:
        assert self.map is not None
        relative = self.map.keyframes[self._reference].T_camera_world @ inverse(T_camera_world)
        posed = _Posed(
            timestamp_s=self._frame.timestamp_s, keyframe=self._reference, T_keyframe_camera=relative
        )
        self._posed.append(posed)
        return TrackedFrame(
            frame=self._frame, T_world_camera=self._T_world_camera(posed), keyframe=keyframe,
            inliers=inliers, matches=matches, scale="up to scale",
        )  # fmt: skip

    def _is_keyframe(self, T_camera_world: Array, inliers: int) -> bool:
        assert self.map is not None
        options = self.options
        if len(self.map.keyframes) >= options.limits.max_keyframes:
            return False
        reference = self.map.keyframes[self._reference].T_camera_world
        moved, turned_deg = pose_difference(T_camera_world, reference)
        depth = self.map.median_depth(self._reference)
        return (
            inliers < options.keyframe_share * self._reference_seen
            or turned_deg > options.keyframe_deg
            or moved > options.keyframe_depth_percent / 100 * depth
        )

    def _set_reference(self, number: int) -> None:
        assert self.map is not None
        self._reference = number
        self._reference_seen = len(self.map.landmarks_of(number))

    def _lose(self, reason: str) -> TrackedFrame:
        self.lost_frames += 1
        self._lost_in_a_row += 1
        return TrackedFrame(
            frame=self._frame, T_world_camera=None, keyframe=False, inliers=0, matches=0,
            status="lost", reason=reason, scale="up to scale",
        )  # fmt: skip

    def _T_world_camera(self, posed: _Posed) -> Array:
        assert self.map is not None
        keyframe = self.map.keyframes[posed.keyframe]
        pose: Array = self._T_world_start @ inverse(keyframe.T_camera_world) @ posed.T_keyframe_camera
        return pose


def _scaled(pose: Array, scale: float) -> Array:
    moved: Array = pose.copy()
    moved[:3, 3] *= scale
    return moved


def _extract(frame: Frame, count: int) -> ViewFeatures:
    """Return ORB features that are spread over the image, with the noise of their levels."""
    described = describe(frame.rgb, count)
    columns, rows = np.rint(described.pixels).astype(np.int64).T
    return ViewFeatures(
        pixels=described.pixels, descriptors=described.descriptors, sigma_px=described.sizes,
        colours=frame.rgb[rows, columns],
    )  # fmt: skip
