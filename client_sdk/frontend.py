"""The robot's visual front end: frames, features with their 3-D points, pose queries and tracked frames.

The trackers of `client_sdk.tracking` decide which features are matched, and which poses are accepted.  A
user's own feature extractor enters here, through the argument *plugin* of `describe` and `extract`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from client_sdk.imu.samples import ImuSamples
from client_sdk.plugins import FeaturesPlugin
from client_sdk.stereo.depth import noise_of, stereo_points
from client_sdk.stereo.view import StereoView
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, body_poses
from rse_pf.images import load_opencv
from rse_pf.native import core_function
from rse_pf.pnp import DepthNoise
from rse_pf.slam.descriptors import measure_distinctiveness
from rse_pf.slam.orb import DescribedKeypoints, describe_orb, select_spread_rows
from rse_pf.slam.tracking import Features

__all__ = [
    "Correspondences",
    "DescribedKeypoints",
    "Features",
    "Frame",
    "FrontEndOptions",
    "MonocularOptions",
    "PoseQuery",
    "TrackedFrame",
    "describe",
    "extract",
    "load_opencv",
    "make_features",
    "points_at",
]

_MAX_STAMP_S = 1e10
"""Largest absolute time stamp of a frame, in seconds, in the year 2286: a frame with a larger number, which
is most likely one of milliseconds or nanoseconds, is refused."""
_MAX_MATCHES_OF_CODEC = {"zlib": 530, "bin": 400, "json": 220}
"""Matches that fit into a command of 10 kB by codec: a match takes 14 to 18 bytes with JSON and zlib, 24 with
MessagePack (``bin``), and 40 to 43 with plain JSON."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One undistorted colour image, with registered depth or with the right image of a stereo pair.

    Attributes:
        timestamp_s: Time of the image, in seconds.
        rgb: ``(h, w, 3)`` uint8, red first; the rectified left image of a stereo pair.
        depth_m: ``(h, w)`` floats, metres along the optical axis, 0 where there is no reading; all 0 for
            stereo pairs and for cameras without depth.
        camera: Intrinsics of *rgb*.
        stereo: The right image of a stereo pair, or None.
        imu: Samples of the IMU since the last frame, or None.
        T_body_camera: ``(4, 4)``, metres: pose of the camera in the body of its rig; None without a rig.

    Raises:
        UsageError: An array has another type or size, or the time stamp cannot be one of seconds.
    """

    timestamp_s: float
    rgb: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]
    camera: Camera
    stereo: StereoView | None = None
    imu: ImuSamples | None = None
    T_body_camera: Array | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.rgb.shape != (*size, 3) or self.depth_m.shape != size:
            raise UsageError(
                f"colour {self.rgb.shape} and depth {self.depth_m.shape} do not fit a camera of "
                f"{size[1]}x{size[0]} px",
                hint="give colour, registered depth and intrinsics of one size",
            )
        if self.rgb.dtype != np.uint8 or not np.issubdtype(self.depth_m.dtype, np.floating):
            raise UsageError(
                f"rgb holds {self.rgb.dtype} and depth_m {self.depth_m.dtype}, not uint8 and float32",
                hint="convert colours to 0..255 with astype(numpy.uint8), and depth to metres of float32",
            )
        if not abs(self.timestamp_s) <= _MAX_STAMP_S:
            raise UsageError(
                f"timestamp_s = {self.timestamp_s:g} is not within -{_MAX_STAMP_S:g} to {_MAX_STAMP_S:g} s",
                hint="give seconds; divide nanoseconds by 1e9 and milliseconds by 1e3",
            )
        if self.stereo is not None and self.stereo.gray.shape != size:
            raise UsageError(
                f"a right image of {self.stereo.gray.shape} does not fit a left one of {size}",
                hint="rectify both images of a pair to one size",
            )

    @property
    def depth_noise(self) -> DepthNoise:
        """Noise model of this frame's depths in a sharp image: a Kinect's, or a stereo pair's."""
        return DepthNoise() if self.stereo is None else noise_of(self.stereo, self.camera)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndOptions:
    """Options of a robot's front end: how features are extracted and matched, and which poses are accepted.

    With the defaults, the absolute trajectory error of the red-kitchen recording is 3.0 cm at 10 Hz.

    Attributes:
        features: Number of features of a frame.
        is_spread: Whether features are spread over the image; otherwise the strongest of the image are taken.
        max_matches: Largest number of matches that a pose query sends, an even sample of all; 530 keep a
            command below 10 kB with the codec zlib, see `sent_with` for other codecs.
        min_depth_m: Smallest depth of a feature that is used; not for stereo pairs.
        max_depth_m: Largest depth of a feature that is used; not for stereo pairs.
        depth_spread_percent: A pixel has no depth if the largest and the smallest depth of its 3x3 patch
            differ by more than this percentage of their median: the patch lies on the edge of an object.  Not
            for stereo pairs.
        inlier_px: Largest reprojection error, in pixels, of an inlier of a pose query.
        max_iterations: Largest number of RANSAC iterations.
        min_inliers: Smallest number of inliers of an accepted pose; a keyframe needs twice as many.
        keyframe_m: A frame becomes a keyframe if no keyframe of its segment is both within this distance, in
            metres, and rotated against it by at most *keyframe_deg*.
        keyframe_deg: See *keyframe_m*.
        keyframe_share: A frame also becomes a keyframe if it sees less than this share, 0 to 1, of the number
            of landmarks that the newest keyframe saw.
        search_px: Radius, in pixels, around the predicted pixel of a landmark in which features are compared
            with the landmark.
        segment_after: Number of frames since the last pose, with enough features and no recognised place,
            after which a new segment begins.
        max_keyframes: Largest number of keyframes of a segment; beyond it older keyframes are thinned out.

    Raises:
        UsageError: An option is outside its range.
    """

    features: int = 1000
    is_spread: bool = True
    max_matches: int = 530
    min_depth_m: float = 0.3
    max_depth_m: float = 6.0
    depth_spread_percent: float = 5.0
    inlier_px: float = 3.0
    max_iterations: int = 1000
    min_inliers: int = 20
    keyframe_m: float = 0.15
    keyframe_deg: float = 10.0
    keyframe_share: float = 0.6
    search_px: float = 40.0
    segment_after: int = 10
    max_keyframes: int = 1000

    def __post_init__(self) -> None:
        if self.min_inliers < 4 or self.max_matches < self.min_inliers or self.features < self.min_inliers:
            raise UsageError(
                f"features = {self.features} and max_matches = {self.max_matches} must not be below "
                f"min_inliers = {self.min_inliers}, and min_inliers must not be below 4",
                hint="leave them out to get the defaults",
            )
        if not (0 <= self.min_depth_m < self.max_depth_m and self.inlier_px > 0):
            raise UsageError(
                f"min_depth_m = {self.min_depth_m:g} must be from 0 to below max_depth_m = "
                f"{self.max_depth_m:g}, and inlier_px = {self.inlier_px:g} above 0",
                hint="leave them out to get the defaults",
            )

    def sent_with(self, codec: str) -> FrontEndOptions:
        """Return these options with *max_matches* reduced to what fits into a command of 10 kB.

        Args:
            codec: Codec of the robot's connection: ``zlib``, ``json`` or ``bin``.

        Raises:
            UsageError: There is no such codec.
        """
        if codec not in _MAX_MATCHES_OF_CODEC:
            raise UsageError(
                f"no codec named {codec!r}", hint=f"choose one of {', '.join(_MAX_MATCHES_OF_CODEC)}"
            )
        return replace(self, max_matches=min(self.max_matches, _MAX_MATCHES_OF_CODEC[codec]))

    @classmethod
    def live(cls) -> FrontEndOptions:
        """Return options for live maps: the strongest features of the image, which close most loops.

        Three robots share the frames of the red-kitchen recording.  With spread features the last of them is
        aligned with the live map at its 67th frame, and 63 % of all poses are aligned when they are returned;
        with these options at its 17th frame, and 90 %.
        """
        return cls(is_spread=False)

    @classmethod
    def wide_baseline(cls) -> FrontEndOptions:
        """Return options for views that lie 0.4 to 0.8 m apart, such as those of the NYU dining room.

        5,000 features, five times the default, find the few matches that survive such a change of view: 25,
        43, 34 and 485 inliers for the four pairs of neighbouring views of that room, where 3,000 features
        find 12 for the first pair.
        """
        return cls(features=5000, is_spread=False, inlier_px=4.0, min_inliers=12)


@dataclass(frozen=True, slots=True, kw_only=True)
class MonocularOptions:
    """Options of tracking a camera without depth.

    Attributes:
        features: Number of features of a frame of 640 px; wider frames have more, up to 2000.
        max_matches: Largest number of matches that a pose query sends, an even sample of all; 250 keep the
            command of a query below 10 kB with the codecs zlib and MessagePack, and below 11 kB with JSON.
        inlier_px: Largest reprojection error, in pixels, of an inlier of a pose query.
        max_iterations: Largest number of RANSAC iterations.
        min_inliers: Smallest number of inliers of an accepted pose.
        search_px: Radius, in pixels, around the predicted pixel of a landmark in which features are compared
            with the landmark.
        keyframe_share: A frame that sees less than this share of its reference keyframe's landmarks becomes a
            keyframe.
        keyframe_deg: A frame rotated by more than this from its reference keyframe becomes a keyframe.
        keyframe_depth_percent: A frame that moved farther than this from its reference keyframe, in percent
            of the median depth, becomes a keyframe.
        start_parallax_deg: Smallest median parallax of the two views that begin a segment.
        segment_after: Number of frames since the last pose, with enough features and no recognised place,
            after which a new segment begins.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correspondences:
    """Correspondences between 3-D points and pixels of one view, as they are sent.

    Attributes:
        points_world: ``(n, 3)``, rounded to 0.0001, in the world of the query, see `PoseQuery`.
        pixels: ``(n, 2)``: pixel *i* shows point *i*; rounded to 0.01 px.
        depths_m: ``(n,)``, depth along the optical axis, measured at each pixel, 0 where it is missing or
            unreliable.
    """

    points_world: Array
    pixels: Array
    depths_m: Array

    def __len__(self) -> int:
        return len(self.pixels)


def extract(frame: Frame, options: FrontEndOptions, plugin: FeaturesPlugin | None = None) -> Features:
    """Extract the features of a frame with their 3-D points; the same frame gives the same features with ORB.

    Args:
        frame: Image with depth, or a stereo pair.
        options: Number of features, whether they are spread, and the range of depths.
        plugin: A user's feature extractor; None for ORB.

    Raises:
        MissingExtra: OpenCV or the native core is not installed.
        UsageError: The user's function failed, or returned values that cannot be features.
    """
    described = describe(frame.rgb, options.features, is_spread=options.is_spread, plugin=plugin)
    return make_features(described, points_at(frame, described.pixels, options))


def make_features(described: DescribedKeypoints, points_camera: Array) -> Features:
    """Return described keypoints as features with the ``(n, 3)`` points *points_camera*, metres or NaN."""
    return Features(
        pixels=described.pixels,
        descriptors=described.descriptors,
        points_camera=points_camera,
        orientations=described.orientations,
        sizes=described.sizes,
        distinctiveness=measure_distinctiveness(described.descriptors, described.pixels),
        kind=described.kind,
        is_oriented=described.is_oriented,
        is_scaled=described.is_scaled,
    )


def describe(
    rgb: npt.NDArray[np.uint8],
    count: int,
    *,
    is_spread: bool = True,
    plugin: FeaturesPlugin | None = None,
) -> DescribedKeypoints:
    """Detect and describe the keypoints of an image, by ORB or by a user's feature extractor.

    Args:
        rgb: ``(h, w, 3)`` uint8, red first.
        count: Largest number of keypoints.
        is_spread: Take the strongest keypoints of each cell of 40 px, also weak ones where a cell has no
            others; otherwise take the strongest of the image.
        plugin: A user's feature extractor; None for ORB.

    Raises:
        MissingExtra: OpenCV or the native core is not installed.
        UsageError: The user's function failed, or returned values that cannot be features.
    """
    if plugin is None:
        return describe_orb(rgb, count, is_spread=is_spread)
    checked = plugin(rgb)
    rows = np.arange(min(count, len(checked.pixels)))
    if is_spread and len(checked.pixels) > count:
        rows = np.array(
            select_spread_rows(checked.pixels, checked.scores, (rgb.shape[0], rgb.shape[1]), count)
        )
    return DescribedKeypoints(
        pixels=checked.pixels[rows],
        descriptors=checked.descriptors[rows],
        orientations=checked.orientations[rows],
        sizes=checked.sizes[rows],
        kind=plugin.kind,
        is_oriented=plugin.is_oriented,
        is_scaled=plugin.is_scaled,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseQuery:
    """A query for the PnP service: the pose of a camera in the world of the query.

    With depth, the world of the query is the frame of a reference camera, in metres: a camera whose pose in
    the segment the tracker knows, such as that of a keyframe.  Without depth, it is the frame of the
    segment's map, in the unit of that map.  The PnP service returns ``T_camera_world``, which maps the world
    of the query to the frame of the camera, and which is passed to the tracker's ``accept``.

    Attributes:
        timestamp_s: Time of the frame, in seconds.
        correspondences: Points, pixels and depths.
        camera: Intrinsics of the pixels.
        inlier_px: Largest reprojection error of an inlier, in pixels.
        max_iterations: Largest number of RANSAC iterations.
        against: The source of the points: the ``map`` around the predicted or last pose, the last ``frame``,
            a ``keyframe`` by which an untracked frame is relocalised, or, as ``segment``, a keyframe of
            another segment or of an older place, which is compared with a tracked frame for a join or a loop
            closure.
        depth_noise: Noise model of the depths; None for a Kinect's.
    """

    timestamp_s: float
    correspondences: Correspondences
    camera: Camera
    inlier_px: float
    max_iterations: int
    against: Literal["map", "frame", "keyframe", "segment"]
    depth_noise: DepthNoise | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedFrame:
    """The result of tracking one frame.

    Attributes:
        frame: The frame.
        T_world_camera: ``(4, 4)``, metres unless *scale* is ``up to scale``; None for a lost frame, which
            must not be drawn.
        keyframe: Whether the frame became a keyframe.
        inliers: Number of landmarks that agree with the pose; 0 for the first pose of a segment with depth.
        matches: Number of matches with landmarks; without a pose, the largest number of an attempt (0 without
            depth).
        status: ``lost`` without a pose, ``starting`` without a pose before a camera without depth has moved
            enough, ``first`` with the first pose, ``tracked`` with another one, ``odometry`` if the wheels
            have carried the last pose to this frame, which the camera did not give.  These are the values
            that `Mapper.track` returns; a `Tracker` itself reports ``tracked`` in place of ``lost`` and
            ``first``.
        reason: Why there is no pose, why the pose is weak, or that its segment is not joined to the first
            one; empty otherwise.
        scale: Whether lengths are metres, or of an arbitrary unit.
        covariance: ``(6, 6)`` covariance of the answer to the last query, not of *T_world_camera*: of the
            twist (metres, radians) on the left of ``T_camera_world``, which maps the world of the query to
            the camera; filled by `Mapper.track`.
        source: Who solved the last query: a server (``cloud``), the Lambda (``burst``), or the ``robot``;
            filled by `Mapper.track`.
        round_trip_ms: Time from the last query to its answer in milliseconds, whoever solved the query;
            filled by `Mapper.track`.
        corrected: Whether poses that were returned before have changed, so that the trajectory must be read
            again; in a live map, whether the alignment of the segment has changed since the last frame.
        T_new_old: ``(4, 4)``, by which the world was rotated since the last frame, such as to let z point up:
            a pose that was returned before is ``T_new_old @ T_world_camera`` now.  None if the world was not
            rotated.
        T_map_camera: ``(4, 4)``, the pose in the live map; None until the segment is aligned.
        segment: Number of the present segment, that is, of the odometry frame.
        features: Features where the image shows them, whose rolling shutter is not undone; None where none
            were extracted.  Their points are NaN where depth is not used.
        T_world_base: ``(4, 4)``, metres, pose of the robot's base; None without a pose, without a mount
            (*T_base_camera* of the mapper), and up to scale.
        pose_covariance: ``(6, 6)`` covariance of *T_world_base*: of its position (m) and its rotation (rad)
            about the axes of the world, with the drift since the start or the last join; None without
            *T_world_base*.
    """

    frame: Frame
    T_world_camera: Array | None
    keyframe: bool
    inliers: int
    matches: int
    status: Literal["first", "tracked", "lost", "starting", "odometry"] = "tracked"
    reason: str = ""
    scale: Literal["metric", "up to scale"] = "metric"
    covariance: Array | None = None
    source: Literal["cloud", "burst", "robot", "none"] = "none"
    round_trip_ms: float | None = None
    corrected: bool = False
    T_new_old: Array | None = None
    T_map_camera: Array | None = None
    segment: int = 0
    features: Features | None = None
    T_world_base: Array | None = None
    pose_covariance: Array | None = None

    @property
    def pose_source(self) -> Literal["visual", "odometry", "lost"]:
        """What the pose is from: the image, or the wheels since the last pose of an image; ``lost``: none."""
        if self.T_world_camera is None:
            return "lost"
        return "odometry" if self.status == "odometry" else "visual"

    @property
    def T_world_body(self) -> Array | None:
        """Pose ``(4, 4)`` of the rig's body in metres; None without a pose, a rig, or a metric scale."""
        pose, mount = self.T_world_camera, self.frame.T_body_camera
        return None if pose is None or mount is None or self.scale != "metric" else body_poses(pose, mount)

    @property
    def lost(self) -> bool:
        """Whether the frame has no pose."""
        return self.T_world_camera is None


def points_at(frame: Frame, pixels: Array, options: FrontEndOptions) -> Array:
    """Return the 3-D points that a frame shows at given pixels.

    The depth of a pixel is the median of the readings in its 3x3 patch.  The points of a stereo pair are
    those of the disparities at the pixels, see `client_sdk.stereo.depth`.

    Args:
        frame: Image with depth, or a stereo pair.
        pixels: ``(n, 2)``, column and row.
        options: Range of depths, and how much the readings of a patch may differ.

    Returns:
        ``(n, 3)`` metres in the camera's frame; NaN where a patch has fewer than five readings, or readings
        that differ too much, or where their median is out of range.

    Raises:
        MissingExtra: The native core is not installed.
    """
    if frame.stereo is not None:
        return stereo_points(frame.rgb, frame.stereo, frame.camera, pixels)
    height, width = frame.depth_m.shape
    camera, points_camera = frame.camera, np.full((len(pixels), 3), np.nan)
    _core_points_at()(
        frame.depth_m.astype(np.float32, copy=False),
        width,
        height,
        pixels.astype(np.float64, copy=False),
        len(pixels),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        options.min_depth_m,
        options.max_depth_m,
        options.depth_spread_percent / 100.0,
        points_camera,
    )
    return points_camera


@cache
def _core_points_at() -> Any:
    pointer, size, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    arguments = (pointer, size, size, pointer, size, *[number] * 7, pointer)
    return core_function("match", "rse_pf_points_at", arguments, ctypes.c_int32)
