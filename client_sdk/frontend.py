"""The robot's visual front end: features, matches, and the queries for poses that are sent to the cloud.

`Tracker` is a state machine without input or output: frames and answers go in, pose queries and tracked
frames come out.  There is one query at a time.  Its numbers are rounded exactly as they are sent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from operator import attrgetter
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.opencv import load_opencv
from client_sdk.native_match import FrontEndCore, front_end_core
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, inverse, pose_difference

__all__ = [
    "Correspondences",
    "Features",
    "Frame",
    "FrontEndOptions",
    "PoseQuery",
    "TrackedFrame",
    "Tracker",
    "extract",
    "load_opencv",
    "match",
    "points_at",
    "round_for_wire",
]

# So many matches fit into a command of 10 kB.  Each takes 14 to 15 bytes with zlib in recordings, and 18 if
# all digits are random; 24 with MessagePack; 40 with plain JSON, 43 at most.
_MATCHES_OF_CODEC = {"zlib": 530, "bin": 400, "json": 220}

# ORB's pyramid.
_SCALE, _LEVELS = 1.2, 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One undistorted colour image with registered depth.

    ``rgb`` is ``(h, w, 3)`` uint8, red first; ``depth_m`` is ``(h, w)`` float32, metres along
    the optical axis, 0 where there is no reading.
    """

    timestamp_s: float
    rgb: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]
    camera: Camera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.rgb.shape != (*size, 3) or self.depth_m.shape != size:
            raise UsageError(
                f"colour {self.rgb.shape} and depth {self.depth_m.shape} do not fit a camera of "
                f"{size[1]}x{size[0]} px",
                hint="give colour, registered depth and intrinsics of one size",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndOptions:
    """How a robot finds and matches features, and which poses it accepts.

    Defaults: measured on the red-kitchen recording at 5 and 10 Hz (ATE 4 to 5 cm).

    Attributes:
        features: How many ORB features are sought in a frame.
        ratio: Lowe's ratio test: the best match must be this much closer than the second best.
        max_matches: The best by descriptor distance are sent, so that a command stays under 10 kB with zlib;
            other codecs need more bytes a match, see `sent_with`.
        min_depth_m: Nearer depth readings are not used.
        max_depth_m: Farther depth readings are not used.
        depth_spread_percent: A 3x3 patch whose depths differ by more of their median lies on an edge and is
            not used.
        inlier_px: Largest reprojection error of an inlier.
        max_iterations: Of RANSAC.
        min_inliers: A pose with fewer is not accepted.
        max_jump_m: The largest plausible motion from one frame to the next.
        keyframe_m: A frame farther from the last keyframe becomes one.
        keyframe_deg: A frame turned further from the last keyframe becomes one.
        keyframe_inliers: A frame with fewer inliers becomes a keyframe even if the robot hardly moved.
        chain: Match against the last good frame, or against the last keyframe; the other one is the retry.
    """

    features: int = 1000
    ratio: float = 0.75
    max_matches: int = 530
    min_depth_m: float = 0.3
    max_depth_m: float = 6.0
    depth_spread_percent: float = 5.0
    inlier_px: float = 3.0
    max_iterations: int = 1000
    min_inliers: int = 12
    max_jump_m: float = 0.5
    keyframe_m: float = 0.2
    keyframe_deg: float = 12.0
    keyframe_inliers: int = 120
    chain: Literal["frame", "keyframe"] = "frame"

    def __post_init__(self) -> None:
        if self.min_inliers < 4 or self.max_matches < self.min_inliers or self.features < self.min_inliers:
            raise UsageError(
                f"features = {self.features} and max_matches = {self.max_matches} must not be below "
                f"min_inliers = {self.min_inliers}, and that not below 4",
                hint="leave them out to get the defaults",
            )
        if not (0 < self.ratio <= 1 and 0 <= self.min_depth_m < self.max_depth_m and self.inlier_px > 0):
            raise UsageError(
                f"ratio = {self.ratio:g}, depth {self.min_depth_m:g}..{self.max_depth_m:g} m or "
                f"inlier_px = {self.inlier_px:g} cannot be used",
                hint="leave them out to get the defaults",
            )

    def sent_with(self, codec: str) -> FrontEndOptions:
        """Return these options with as many matches as fit into a command of 10 kB.

        Args:
            codec: ``zlib``, ``json`` or ``bin``, as the robot's connection has it.

        Raises:
            UsageError: There is no such codec.
        """
        if codec not in _MATCHES_OF_CODEC:
            raise UsageError(
                f"no codec named {codec!r}", hint=f"choose one of {', '.join(_MATCHES_OF_CODEC)}"
            )
        return replace(self, max_matches=min(self.max_matches, _MATCHES_OF_CODEC[codec]))

    @classmethod
    def wide_baseline(cls) -> FrontEndOptions:
        """Return options for views that lie 0.4 to 0.8 m apart, such as the NYU dining room's.

        Four times the features and a looser ratio test find the few matches that survive such a
        change of view: 24, 32, 30 and 530 inliers on those four pairs, where 3000 features leave
        the first pair 11 to 13.  The jump limit is above the baseline.
        """
        return cls(features=4000, ratio=0.8, inlier_px=4.0, max_iterations=1000, max_jump_m=1.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """ORB features of one frame.

    ``pixels`` ``(n, 2)``; ``descriptors`` ``(n, 32)`` uint8; ``points_camera`` ``(n, 3)`` metres,
    NaN where the depth cannot be trusted.
    """

    pixels: Array
    descriptors: npt.NDArray[np.uint8]
    points_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correspondences:
    """Points of a reference view, seen in another one; rounded as they are sent.

    ``points_world`` ``(n, 3)``: metres, in the frame of the *reference camera*, which is the
    world of this one query.  ``pixels`` ``(n, 2)``: row *i* observes point *i*, and ``depths_m``
    ``(n,)`` is the depth measured there, 0 where it cannot be trusted.
    """

    points_world: Array
    pixels: Array
    depths_m: Array

    def __len__(self) -> int:
        return len(self.pixels)


def extract(frame: Frame, options: FrontEndOptions) -> Features:
    """Find ORB features and their points; deterministic.

    Raises:
        MissingExtra: OpenCV is not installed.

    Source:
        Rublee et al., ICCV 2011; scale 1.2, 8 levels, FAST threshold 10.
    """
    cv2 = load_opencv()
    orb = cv2.ORB_create(nfeatures=options.features, scaleFactor=_SCALE, nlevels=_LEVELS, fastThreshold=10)
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    core = front_end_core()
    found = _described(cv2, orb, gray, core) if core is not None and _describes_alike(core) else None
    pixels, descriptors = found or _described_by_opencv(cv2, orb, gray)
    points_camera = points_at(frame, pixels, options)
    return Features(pixels=pixels, descriptors=descriptors, points_camera=points_camera)


_Described = tuple[Array, npt.NDArray[np.uint8]]


def _described_by_opencv(cv2: Any, orb: Any, gray: npt.NDArray[np.uint8]) -> _Described:
    """Return the pixels and the descriptors of an image's keypoints."""
    keypoints, descriptors = orb.detectAndCompute(gray, None)
    if not keypoints:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    return cv2.KeyPoint_convert(keypoints).astype(np.float64), descriptors


def _described(cv2: Any, orb: Any, gray: npt.NDArray[np.uint8], core: FrontEndCore) -> _Described | None:
    """Return the same, described by the native core; None where there is nothing that it can describe."""
    keypoints = orb.detect(gray, None)
    if not keypoints:
        return None
    n = len(keypoints)
    pixels = cv2.KeyPoint_convert(keypoints)
    angles_deg = np.fromiter(map(attrgetter("angle"), keypoints), np.float32, n)
    octaves = np.fromiter(map(attrgetter("octave"), keypoints), np.int32, n)
    descriptors = core.describe(gray, pixels, angles_deg, octaves, scale=_SCALE, levels=_LEVELS)
    return None if descriptors is None else (pixels.astype(np.float64), descriptors)


@cache
def _describes_alike(core: FrontEndCore) -> bool:
    """Say whether the core describes a picture as the installed OpenCV does, which may be another version."""
    cv2 = load_opencv()
    orb = cv2.ORB_create(nfeatures=500, scaleFactor=_SCALE, nlevels=_LEVELS, fastThreshold=10)
    blocks = np.random.default_rng(1).integers(0, 256, (60, 80))
    gray = np.kron(blocks, np.ones((5, 5))).astype(np.uint8)
    ours = _described(cv2, orb, gray, core)
    return ours is not None and bool(np.array_equal(ours[1], _described_by_opencv(cv2, orb, gray)[1]))


def match(reference: Features, frame: Features, options: FrontEndOptions) -> Correspondences:
    """Match the reference's points to the frame's pixels; deterministic.

    Brute-force Hamming distance, ratio test, at most one match for each pixel of the frame.  Rows
    go from left to right: neighbours share digits, which makes the message 8 % smaller.

    The native core gives the same rows in a tenth of the time where its library is built.

    Raises:
        MissingExtra: Neither the native core nor OpenCV is installed.
    """
    core = front_end_core()
    if core is not None and len(frame.pixels) >= 2:
        found = core.matches(
            reference.descriptors, reference.points_camera, frame.descriptors, frame.pixels,
            frame.points_camera, ratio=options.ratio, max_matches=options.max_matches,
        )  # fmt: skip
        if found is not None:
            return Correspondences(points_world=found[0], pixels=found[1], depths_m=found[2])
    known = np.flatnonzero(np.isfinite(reference.points_camera[:, 2]))
    if not len(known) or len(frame.pixels) < 2:
        return Correspondences(points_world=np.empty((0, 3)), pixels=np.empty((0, 2)), depths_m=np.empty(0))
    cv2 = load_opencv()
    distances, neighbours = cv2.batchDistance(
        reference.descriptors[known], frame.descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )
    clear = np.flatnonzero(distances[:, 0] < options.ratio * distances[:, 1])
    best_first = clear[np.argsort(distances[clear, 0], kind="stable")]
    _, firsts = np.unique(neighbours[best_first, 0], return_index=True)
    chosen = best_first[np.sort(firsts)][: options.max_matches]
    chosen = chosen[np.argsort(frame.pixels[neighbours[chosen, 0], 0], kind="stable")]
    seen = neighbours[chosen, 0]
    points_world, pixels = round_for_wire(reference.points_camera[known[chosen]], frame.pixels[seen])
    depths_m: Array = np.nan_to_num(frame.points_camera[seen, 2], posinf=0.0, neginf=0.0)
    return Correspondences(points_world=points_world, pixels=pixels, depths_m=np.round(depths_m, 3))


def round_for_wire(points_world: Array, pixels: Array) -> tuple[Array, Array]:
    """Round points to 0.1 mm and pixels to 0.01 px, so that cloud and robot solve the same numbers.

    The pose moves by about 0.02 mm, the message shrinks to a third.
    """
    return np.round(points_world, 4), np.round(pixels, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseQuery:
    """One query for the PnP service: the pose of this camera in the reference camera's frame.

    Solve with ``correspondences`` (their depths, too), ``camera``, ``inlier_px`` and ``max_iterations``,
    then pass the answer to `Tracker.accept`.
    """

    timestamp_s: float
    correspondences: Correspondences
    camera: Camera
    inlier_px: float
    max_iterations: int
    against: Literal["frame", "keyframe"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedFrame:
    """The result for one frame; a lost one has no pose and must not be drawn.

    ``T_world_camera`` ``(4, 4)`` is in metres, unless ``scale`` says ``up to scale``.  ``status`` is
    ``starting`` before a camera without depth has moved enough; ``reason`` says why there is no pose, or why
    it is weak.  `Mapper.track` fills the rest: ``covariance`` ``(6, 6)`` of the twist (metres, radians) on
    the left of the pose of the last query, who solved it, and how long that took.  ``corrected`` says that
    poses that were returned before have changed: read the trajectory again.

    In a live map, ``T_map_camera`` is the pose in the map, None until ``segment``, the present odometry
    frame, is aligned; ``corrected`` says that its alignment has changed since the last frame.
    """

    frame: Frame
    T_world_camera: Array | None
    keyframe: bool
    inliers: int
    matches: int
    status: Literal["first", "tracked", "lost", "starting"] = "tracked"
    reason: str = ""
    scale: Literal["metric", "up to scale"] = "metric"
    covariance: Array | None = None
    source: Literal["cloud", "burst", "robot", "none"] = "none"
    round_trip_ms: float | None = None
    corrected: bool = False
    T_map_camera: Array | None = None
    segment: int = 0

    @property
    def lost(self) -> bool:
        """Whether no pose was accepted."""
        return self.T_world_camera is None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """A frame that other frames are matched against."""

    features: Features
    T_world_camera: Array


class Tracker:
    """Visual odometry as a state machine without I/O; one frame and one query at a time.

    ::

        step = tracker.prepare(frame)
        while isinstance(step, PoseQuery):
            T_camera_world, inliers = ...   # the PnP service's answer, or None, 0 on any failure
            step = tracker.accept(step, T_camera_world, inliers)
        # step is now the TrackedFrame

    A frame is matched against the last good frame.  If the pose has too few inliers or jumps, it is
    queried once more against the last keyframe.  If that fails, too, the frame is lost: it is
    counted, and later frames are not matched against it.

    ``frames`` counts the frames prepared so far, ``lost_frames`` those of them without an accepted pose.
    """

    def __init__(self, options: FrontEndOptions | None = None, T_world_start: Array | None = None) -> None:
        self.options = options or FrontEndOptions()
        self.frames = 0
        self.lost_frames = 0
        self.keyframes = 0
        self._T_world_start = np.eye(4) if T_world_start is None else T_world_start
        self._last: _View | None = None
        self._keyframe: _View | None = None
        self._lost_in_a_row = 0
        self._frame: Frame  # set by `prepare`
        self._features: Features
        self._query: PoseQuery | None = None
        self._to_try: list[Literal["frame", "keyframe"]] = []

    @property
    def keyframe_features(self) -> Features | None:
        """The features of the last keyframe, None before the first."""
        return None if self._keyframe is None else self._keyframe.features

    @property
    def last_features(self) -> Features | None:
        """The features of the last frame that has a pose, None before the first."""
        return None if self._last is None else self._last.features

    def restart(self, T_world_start: Array) -> None:
        """Forget what frames are matched against: the next frame with enough features is at *T_world_start*.

        Raises:
            UsageError: A query is open.
        """
        self._refuse_open_query()
        self._T_world_start = T_world_start
        self._last = self._keyframe = None
        self._lost_in_a_row = 0

    def prepare(self, frame: Frame) -> PoseQuery | TrackedFrame:
        """Take the next frame; return a query, or the result for the frame if none is needed.

        The first frame with enough features is the start and needs no query; a frame without enough
        matches is lost without one.

        Raises:
            UsageError: The last query was not answered yet.
        """
        self._refuse_open_query()
        self.frames += 1
        self._frame, self._features = frame, extract(frame, self.options)
        if self._last is None:
            usable = int(np.isfinite(self._features.points_camera[:, 2]).sum())
            if usable < self.options.min_inliers:
                return self._lose(0)
            return self._keep(self._T_world_start, inliers=0, matches=0, keyframe=True)
        self._to_try = ["frame", "keyframe"] if self.options.chain == "frame" else ["keyframe", "frame"]
        if self._last is self._keyframe:
            self._to_try = ["keyframe"]
        return self._next_query(0)

    def accept(
        self, query: PoseQuery, T_camera_world: Array | None, inliers: int = 0
    ) -> PoseQuery | TrackedFrame:
        """Take the answer to *query*; return another query, or the result for the frame.

        Args:
            query: The query that `prepare` or `accept` returned last.
            T_camera_world: ``(4, 4)`` as the PnP service returns it, where world is the world of
                the query (its reference camera); ``None`` if there was no answer.
            inliers: How many correspondences agree with it.

        Raises:
            UsageError: *query* is not the open one.
        """
        if query is not self._query:
            raise UsageError("this query is not the open one", hint="answer each query once, in order")
        self._query = None
        matches = len(query.correspondences)
        if T_camera_world is not None and inliers >= self.options.min_inliers:
            T_world_camera = self._view(query.against).T_world_camera @ inverse(T_camera_world)
            if self._is_plausible(T_world_camera):
                keyframe = self._is_keyframe(T_world_camera, inliers)
                return self._keep(T_world_camera, inliers=inliers, matches=matches, keyframe=keyframe)
        return self._next_query(matches)

    def _refuse_open_query(self) -> None:
        if self._query is not None:
            raise UsageError(
                f"the query of frame {self._query.timestamp_s:.3f} s is open",
                hint="call accept with its answer, or with None",
            )

    def _next_query(self, matches: int) -> PoseQuery | TrackedFrame:
        while self._to_try:
            against = self._to_try.pop(0)
            found = match(self._view(against).features, self._features, self.options)
            if len(found) >= self.options.min_inliers:
                self._query = PoseQuery(
                    timestamp_s=self._frame.timestamp_s,
                    correspondences=found,
                    camera=self._frame.camera,
                    inlier_px=self.options.inlier_px,
                    max_iterations=self.options.max_iterations,
                    against=against,
                )
                return self._query
        return self._lose(matches)

    def _is_plausible(self, T_world_camera: Array) -> bool:
        last = self._view("frame").T_world_camera
        limit_m = self.options.max_jump_m * (1 + self._lost_in_a_row)
        moved_m = float(np.linalg.norm(T_world_camera[:3, 3] - last[:3, 3]))
        return bool(np.isfinite(T_world_camera).all()) and moved_m <= limit_m

    def _is_keyframe(self, T_world_camera: Array, inliers: int) -> bool:
        moved_m, turned_deg = pose_difference(T_world_camera, self._view("keyframe").T_world_camera)
        options = self.options
        is_far = moved_m > options.keyframe_m or turned_deg > options.keyframe_deg
        return is_far or inliers < options.keyframe_inliers

    def _keep(self, T_world_camera: Array, *, inliers: int, matches: int, keyframe: bool) -> TrackedFrame:
        self._last = _View(features=self._features, T_world_camera=T_world_camera)
        self._lost_in_a_row = 0
        if keyframe:
            self._keyframe = self._last
            self.keyframes += 1
        return TrackedFrame(
            frame=self._frame,
            T_world_camera=T_world_camera,
            keyframe=keyframe,
            inliers=inliers,
            matches=matches,
        )

    def _lose(self, matches: int) -> TrackedFrame:
        self.lost_frames += 1
        self._lost_in_a_row += 1
        return TrackedFrame(
            frame=self._frame, T_world_camera=None, keyframe=False, inliers=0, matches=matches
        )

    def _view(self, which: Literal["frame", "keyframe"]) -> _View:
        view = self._last if which == "frame" else self._keyframe
        assert view is not None
        return view


def points_at(frame: Frame, pixels: Array, options: FrontEndOptions) -> Array:
    """Return the ``(n, 3)`` points of the camera frame that *frame* shows at ``(n, 2)`` pixels.

    The depth of a pixel is the median of its 3x3 patch, NaN where that is sparse, spread, near or far.
    """
    core = front_end_core()
    if core is not None:
        found = core.points_at(
            frame.depth_m, pixels, frame.camera,
            min_depth_m=options.min_depth_m, max_depth_m=options.max_depth_m,
            spread=options.depth_spread_percent / 100.0,
        )  # fmt: skip
        if found is not None:
            return found
    return frame.camera.back_project(pixels, _depth_at(frame.depth_m, pixels, options))


def _depth_at(depth_m: npt.NDArray[np.float32], pixels: Array, options: FrontEndOptions) -> Array:
    """Return the median of each pixel's 3x3 patch, NaN where it is sparse, spread, near or far."""
    columns, rows = np.rint(pixels).astype(np.int64).T
    inside = (columns >= 1) & (rows >= 1) & (columns < depth_m.shape[1] - 1) & (rows < depth_m.shape[0] - 1)
    found = np.full(len(pixels), np.nan)
    step = np.array([-1, 0, 1])
    patches = depth_m[
        rows[inside][:, None, None] + step[:, None], columns[inside][:, None, None] + step
    ].reshape(-1, 9)
    valid = (patches > 0) & np.isfinite(patches)
    count = valid.sum(axis=1)
    ascending = np.sort(np.where(valid, patches, np.inf), axis=1)
    each = np.arange(len(patches))
    median = ascending[each, np.maximum(count - 1, 0) // 2].astype(np.float64)
    largest = ascending[each, np.maximum(count - 1, 0)].astype(np.float64)
    with np.errstate(invalid="ignore"):  # inf - inf where a patch holds no reading
        spread = largest - ascending[:, 0]
        trusted = (
            (count >= 5)
            & (spread < median * (options.depth_spread_percent / 100.0))
            & (median >= options.min_depth_m)
            & (median <= options.max_depth_m)
        )
    found[inside] = np.where(trusted, median, np.nan)
    return found
