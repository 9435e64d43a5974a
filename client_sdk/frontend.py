"""The robot's visual front end: frames, features with their points, and the queries for poses.

What a frame is matched with is decided in `client_sdk.tracking`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from client_sdk.imu.samples import ImuSamples
from client_sdk.slots import FeaturesSlot
from client_sdk.stereo.depth import noise_of, stereo_points
from client_sdk.stereo.view import StereoView
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, body_poses
from rse_pf.images import load_opencv
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors
from rse_pf.native import address_of, aligned, core_function
from rse_pf.pnp import DepthNoise
from rse_pf.slam.orb import DescribedPixels, describe_orb, spread_rows

__all__ = [
    "Correspondences",
    "DescribedPixels",
    "Features",
    "Frame",
    "FrontEndOptions",
    "PoseQuery",
    "TrackedFrame",
    "describe",
    "extract",
    "load_opencv",
    "points_at",
    "round_for_wire",
]

_MAX_STAMP_S = 1e10  # seconds since 1970 of the year 2286; milliseconds and nanoseconds are beyond it

# So many matches fit into a command of 10 kB.  Each takes 14 to 15 bytes with zlib in recordings, and 18 if
# all digits are random; 24 with MessagePack; 40 with plain JSON, 43 at most.
_MATCHES_OF_CODEC = {"zlib": 530, "bin": 400, "json": 220}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One undistorted colour image with registered depth, or with the right image of a stereo pair.

    ``rgb`` is ``(h, w, 3)`` uint8, red first; ``depth_m`` is ``(h, w)`` float32, metres along
    the optical axis, 0 where there is no reading.  With *stereo*, ``rgb`` and ``camera`` are those of the
    rectified left camera, and ``depth_m`` is all 0.  *imu* has the samples since the last frame.
    *T_body_camera* ``(4, 4)``, metres, is the pose of the camera in the body of its rig, None without a rig.

    Raises:
        UsageError: Arrays have another type or size, or the time stamp is not one of seconds.
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
                f"timestamp_s = {self.timestamp_s:g} is not within {_MAX_STAMP_S:g} s",
                hint="give seconds; divide nanoseconds by 1e9 and milliseconds by 1e3",
            )
        if self.stereo is not None and self.stereo.gray.shape != size:
            raise UsageError(
                f"a right image of {self.stereo.gray.shape} does not fit a left one of {size}",
                hint="rectify both images of a pair to one size",
            )

    @property
    def depth_noise(self) -> DepthNoise:
        """The noise of the depths that the frame's features get, where the picture is clear."""
        return DepthNoise() if self.stereo is None else noise_of(self.stereo, self.camera)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndOptions:
    """How a robot finds and matches features, and which poses it accepts.

    Defaults: measured on the red-kitchen recording at 5 and 10 Hz (ATE 4 to 5 cm).

    Attributes:
        features: How many ORB features a frame has.
        is_spread: Whether they are spread over the image, or the strongest wherever they are.
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
        keyframe_m: A frame farther from every keyframe becomes one.
        keyframe_deg: A frame turned further from every keyframe becomes one.
        keyframe_share: A frame that sees a smaller share of what the last keyframe saw becomes one.
        search_px: Radius around a predicted pixel in which a landmark is sought.
        segment_after: A new segment begins after so many frames that show enough and no place that is known.
        max_keyframes: So many are matched against at most; then older ones are thinned out.
    """

    features: int = 1000
    is_spread: bool = True
    ratio: float = 0.75
    max_matches: int = 530
    min_depth_m: float = 0.3
    max_depth_m: float = 6.0
    depth_spread_percent: float = 5.0
    inlier_px: float = 3.0
    max_iterations: int = 1000
    min_inliers: int = 20
    max_jump_m: float = 0.5
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
    def live(cls) -> FrontEndOptions:
        """Return options for live maps: the strongest features wherever they are, which link best.

        With spread features the last of three robots joins the kitchen's map at its frame 67, and 63 % of the
        poses are aligned when they are given out; with these at 17, and 90 %.
        """
        return cls(is_spread=False)

    @classmethod
    def wide_baseline(cls) -> FrontEndOptions:
        """Return options for views that lie 0.4 to 0.8 m apart, such as the NYU dining room's.

        Four times the features and a looser ratio test find the few matches that survive such a
        change of view: 24, 32, 30 and 530 inliers on those four pairs, where 3000 features leave
        the first pair 11 to 13.  The jump limit is above the baseline.
        """
        return cls(features=4000, is_spread=False, ratio=0.8, inlier_px=4.0, min_inliers=12, max_jump_m=1.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Features of one frame, ORB or those of a user.

    ``pixels`` ``(n, 2)``; ``descriptors`` ``(n, d)`` of one ``kind``; ``points_camera`` ``(n, 3)`` metres,
    NaN where the depth cannot be trusted; ``turns`` ``(n, 2)``, cosine and sine of the orientation; ``sizes``
    ``(n,)``, the scale of the pyramid's level, 1 for the finest.  Turns and sizes tell nothing unless the
    features are *is_oriented* and *is_scaled*.
    """

    pixels: Array
    descriptors: Descriptors
    points_camera: Array
    turns: Array
    sizes: Array
    kind: DescriptorKind = ORB
    is_oriented: bool = True
    is_scaled: bool = True


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


def extract(frame: Frame, options: FrontEndOptions, slot: FeaturesSlot | None = None) -> Features:
    """Find ORB features, or those of *slot*, spread over the image, and their points; deterministic.

    Raises:
        MissingExtra: OpenCV is not installed.
        UsageError: The features function failed, or returned no features.
    """
    described = describe(frame.rgb, options.features, is_spread=options.is_spread, slot=slot)
    return Features(
        pixels=described.pixels, descriptors=described.descriptors, turns=described.turns,
        sizes=described.sizes, points_camera=points_at(frame, described.pixels, options),
        kind=described.kind, is_oriented=described.is_oriented, is_scaled=described.is_scaled,
    )  # fmt: skip


def describe(
    rgb: npt.NDArray[np.uint8], count: int, *, is_spread: bool = True, slot: FeaturesSlot | None = None
) -> DescribedPixels:
    """Return *count* ORB features of an ``(h, w, 3)`` image, or those of *slot*; deterministic.

    Args:
        rgb: ``(h, w, 3)``.
        count: The most features.
        is_spread: Take the strongest of each cell of 40 px, with weak ones where there are no others; else
            the strongest of the image.
        slot: A user's features; None for ORB.

    Raises:
        MissingExtra: OpenCV is not installed.
        UsageError: The features function failed, or returned no features.
    """
    if slot is not None:
        return _described_by(slot, rgb, count, is_spread=is_spread)
    return describe_orb(rgb, count, is_spread=is_spread)


def _described_by(
    slot: FeaturesSlot, rgb: npt.NDArray[np.uint8], count: int, *, is_spread: bool
) -> DescribedPixels:
    """Return a user's features, the best first, of which a keyframe takes as many as fit."""
    found = slot(rgb)
    n = len(found.pixels)
    rows = np.arange(min(count, n))
    if is_spread and n > count:
        rows = np.array(spread_rows(found.pixels, found.scores, (rgb.shape[0], rgb.shape[1]), count))
    return DescribedPixels(
        pixels=found.pixels[rows], descriptors=found.descriptors[rows], turns=found.turns[rows],
        sizes=found.sizes[rows], kind=slot.kind, is_oriented=slot.is_oriented, is_scaled=slot.is_scaled,
    )  # fmt: skip


def round_for_wire(points_world: Array, pixels: Array) -> tuple[Array, Array]:
    """Round points to 0.1 mm and pixels to 0.01 px, so that cloud and robot solve the same numbers.

    The pose moves by about 0.02 mm, the message shrinks to a third.
    """
    return np.round(points_world, 4), np.round(pixels, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseQuery:
    """One query for the PnP service: the pose of this camera in the reference camera's frame.

    Solve with ``correspondences`` (their depths, too), ``camera``, ``inlier_px``, ``max_iterations`` and
    ``depth_noise`` (None: a Kinect's), then pass the answer to `Tracker.accept`.
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
    """The result for one frame; a lost one has no pose and must not be drawn.

    ``T_world_camera`` ``(4, 4)`` is in metres, unless ``scale`` says ``up to scale``.  ``status`` is
    ``starting`` before a camera without depth has moved enough; ``reason`` says why there is no pose, or why
    it is weak.  `Mapper.track` fills the rest: ``covariance`` ``(6, 6)`` of the twist (metres, radians) on
    the left of the pose of the last query, who solved it, and how long that took.  ``corrected`` says that
    poses that were returned before have changed: read the trajectory again.  Where the world itself was
    turned since the last frame, such as upright, ``T_new_old`` ``(4, 4)`` is its motion: what was returned
    before is ``T_new_old @ T_world_camera`` now.
    ``features`` are those of the image as they were found, None where nobody found any; their points are NaN
    where depth is not used.

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
    T_new_old: Array | None = None
    T_map_camera: Array | None = None
    segment: int = 0
    features: Features | None = None

    @property
    def T_world_body(self) -> Array | None:
        """The pose ``(4, 4)`` of the body of the rig; None without a pose, a rig, or metres."""
        pose, mount = self.T_world_camera, self.frame.T_body_camera
        return None if pose is None or mount is None or self.scale != "metric" else body_poses(pose, mount)

    @property
    def lost(self) -> bool:
        """Whether no pose was accepted."""
        return self.T_world_camera is None


def points_at(frame: Frame, pixels: Array, options: FrontEndOptions) -> Array:
    """Return the ``(n, 3)`` points of the camera frame that *frame* shows at ``(n, 2)`` pixels.

    The depth of a pixel is the median of its 3x3 patch, NaN where that is sparse, spread, near or far.  A
    stereo pair is matched, see `client_sdk.stereo.depth`.

    Raises:
        MissingExtra: The native core is not installed.
    """
    if frame.stereo is not None:
        return stereo_points(frame.rgb, frame.stereo, frame.camera, pixels)
    depth_m, pixels = aligned(frame.depth_m, np.float32), aligned(pixels, np.float64)
    height, width = depth_m.shape
    camera, points_camera = frame.camera, np.full((len(pixels), 3), np.nan)
    _core_points_at()(
        address_of(depth_m), width, height, address_of(pixels), len(pixels),
        camera.fx, camera.fy, camera.cx, camera.cy, options.min_depth_m, options.max_depth_m,
        options.depth_spread_percent / 100.0, address_of(points_camera),
    )  # fmt: skip
    return points_camera


@cache
def _core_points_at() -> Any:
    pointer, size, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    arguments = (pointer, size, size, pointer, size, *[number] * 7, pointer)
    return core_function("match", "rse_pf_points_at", arguments, ctypes.c_int32)
