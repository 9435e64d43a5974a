"""Encode a keyframe as a robot sends it: where one image was taken, its camera, and its features with depths.

The robot encodes a keyframe once: the same bytes wait on the robot's disk, are sent, and are stored in the
log and in the snapshots of a live map.  A fixed head is followed by typed blocks, so that later releases can
add blocks without a new version of the format.  A reader keeps unknown optional blocks byte for byte, and
rejects a keyframe with an unknown required block.  Sizes are checked before an array is made.

All numbers are little-endian::

    head      108 bytes: "KF", version 2 (uint8), number of blocks (uint8), timestamp_s (float64),
              the first three rows of T_odom_camera (12 float64)
    block     head of each block, 8 bytes: kind (uint16), flags (uint16; 1: required), size of the content
              (uint32); the content follows
    camera    kind 1: model (uint8; 1: pinhole), number in the rig (uint8; 0), width, height (uint16),
              fx, fy, cx, cy (float64)
    features  kind 2: detector (uint8; 1: ORB, 2: named), distance (uint8; 1: Hamming distance of bits,
              2: squared Euclidean distance of int8), bytes of a descriptor (uint16), number of features n
              (uint16), f (uint8): pixels are stored in units of 2**-f px, length of the name (uint8; 0 for
              ORB); n columns and n rows (uint16), n descriptors, the name of the feature kind (ASCII)
    geometry  kind 3: type of the depths (uint8), 0 (uint8), n (uint16), and for type
              1, depths: n depths in mm (uint16);
              2, disparities of a stereo pair: focal length in px times baseline in m (float64), n
              disparities in 1/64 px (uint16), which also hold depths beyond 65 m;
              3, depths of an odometry segment without metric scale: a unit (float64), and n numbers
              (uint16; 0: unknown depth); number times unit is a depth in the unit of length of the
              segment, which is also that of T_odom_camera and unknown in metres
    noise     kind 5, optional: base_m, growth_per_m and from_m (3 float64) of `rse_pf.pnp.DepthNoise`;
              without this block its default values, those of a Kinect
    IMU       kind 6, optional: gravity, and the motion since the previous keyframe: `rse_pf.slam.inertial`
    points    kind 7, optional: reference to the coloured points of the keyframe:
              `rse_pf.slam.keyframe_points`
    image     kind 8, optional: reference to the image of the keyframe, a JPEG file

Blocks are in ascending order of their kinds.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, rigid
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors
from rse_pf.maps.format import Keyframe
from rse_pf.pnp import DepthNoise
from rse_pf.slam.inertial import KeyframeImu, decode_imu, encode_imu
from rse_pf.slam.keyframe_points import ObjectReference, decode_reference, encode_reference

__all__ = [
    "MAX_BLOCKS",
    "MAX_FEATURES",
    "MAX_KEYFRAME_BYTES",
    "KeyframeFeatures",
    "SentKeyframe",
    "UnknownBlock",
    "check_odometry_range",
    "decode_keyframe",
    "encode_keyframe",
    "make_features",
    "make_scaleless_features",
    "max_features",
]

MAX_KEYFRAME_BYTES = 36_000
"""Largest size in bytes of one encoded keyframe: the 894 ORB features that a robot sends by default need
33.3 kB.  A larger keyframe is refused."""
MAX_FEATURES = 894
"""Largest number of features of one keyframe with ORB descriptors; for other kinds of descriptors,
`max_features` returns the number.  Of more features a robot sends the first ones that can be encoded; a
keyframe that holds more is refused."""
MAX_BLOCKS = 16
"""Largest number of blocks in one encoded keyframe, a keyframe with more is refused: this release knows seven
kinds of blocks."""

_MAGIC = b"KF"  # the first two bytes of an encoded keyframe
_VERSION = 2  # version of the encoding of keyframes, the only one that is read and written

_HEAD_STRUCT = struct.Struct("<2sBB13d")
_BLOCK_STRUCT = struct.Struct("<HHI")
_CAMERA_STRUCT = struct.Struct("<BBHH4d")
_FEATURES_STRUCT = struct.Struct("<BBHHBB")
_GEOMETRY_STRUCT = struct.Struct("<BBH")
_SCALE_STRUCT = struct.Struct("<d")
"""Encoding of focal length times baseline before disparities, or of the unit before depths without
scale."""
_NOISE_STRUCT = struct.Struct("<3d")

_REQUIRED = 1  # flag of a block: a reader that does not know its kind must reject the keyframe
_CAMERA_BLOCK = 1
_FEATURES_BLOCK = 2
_GEOMETRY_BLOCK = 3
_NOISE_BLOCK = 5
_IMU_BLOCK = 6
_POINTS_BLOCK = 7
_IMAGE_BLOCK = 8
_REQUIRED_BLOCKS = {_CAMERA_BLOCK: "camera", _FEATURES_BLOCK: "features", _GEOMETRY_BLOCK: "geometry"}
"""Names for error messages of the blocks that each keyframe has, by the number of their kind."""
_OPTIONAL_BLOCKS = {_NOISE_BLOCK: "noise", _IMU_BLOCK: "IMU", _POINTS_BLOCK: "points", _IMAGE_BLOCK: "image"}
"""Names for error messages of the blocks that a keyframe may lack, by the number of their kind."""

_PINHOLE = 1  # number by which the camera block names the pinhole model
_ORB_DETECTOR = 1  # number by which the features block names the detector ORB
_NAMED_DETECTOR = 2  # number by which the features block announces the name of another kind of features
_DISTANCES = {"uint8": 1, "int8": 2}
"""Number by which the features block names the distance of descriptors, by their dtype: 1 is the Hamming
distance, 2 the squared Euclidean distance."""
_DEPTHS = 1  # number by which the geometry block announces depths in millimetres
_DISPARITIES = 2  # number by which the geometry block announces disparities of a stereo pair
_SCALELESS_DEPTHS = 3  # number by which the geometry block announces depths without metric scale

_FEATURE_BYTES = 6
"""Encoded size in bytes of a feature without its descriptor: column, row and depth, 2 bytes each."""
_MAX_FEATURES_BYTES = MAX_FEATURES * (_FEATURE_BYTES + ORB.size)
"""Largest encoded size in bytes of all features of one keyframe, whatever their kind: that of 894 ORB
features.  `max_features` divides it by the size of one feature."""
_FINEST_PIXEL_FRACTION = 4
"""Exponent of the finest unit of encoded pixels: 2**-4 px, where no coordinate is above 4,095 px."""
_COARSEST_PIXEL_FRACTION = 2
"""Exponent of the coarsest unit of encoded pixels: 2**-2 px, where no coordinate is above 16,383 px."""
_BORDER_PX = 64
"""Largest distance in pixels of an undistorted feature beyond the right or the lower edge of the image; a
keyframe with a farther one is refused.  Beyond the left or the upper edge a coordinate would be negative,
which the encoding does not hold."""
_DISPARITY_STEPS_PER_PX = 64  # disparities are encoded in units of 1/64 px
_MAX_STEPS = 65_535  # largest number that encodes a depth or a disparity: a uint16
# Smallest depth of a depth camera in millimetres: a feature with a smaller one is not encoded, and a keyframe
# that holds one is refused.
_MIN_DEPTH_MM = 10
# Smallest depth of a stereo pair in metres: a feature with a smaller one is not encoded, and a keyframe that
# holds one is refused.
_MIN_DEPTH_M = 0.01
_MAX_DEPTH_M = 1000.0
"""Largest depth of a stereo pair in metres: a feature with a larger one is not encoded, and a keyframe that
holds one is refused, since poses are refined with depths up to 1 km."""
# Smallest focal length times baseline of a stereo pair in px m, such as 50 px and 1 mm; a keyframe with a
# smaller one is refused.
_MIN_F_BASELINE = 0.05
# Largest focal length times baseline of a stereo pair in px m, such as 10,000 px and 10 m; a keyframe with a
# larger one is refused.
_MAX_F_BASELINE = 1e5
_MAX_MEDIAN_DEPTHS = 16.0
"""A depth without metric scale is encoded as unknown if it is more than this multiple of the median depth of
its keyframe: the position of such a far landmark is inaccurate."""
_MIN_UNIT = 1e-9
"""Smallest accepted quantisation step of depths without metric scale, in the unit of length of their
segment."""
_MAX_UNIT = 1e3
"""Largest accepted quantisation step of depths without metric scale, in the unit of length of their
segment."""
_MAX_TIME_S = 1e12
"""Largest time of a keyframe in seconds after or before 1970, far beyond any clock: a keyframe with another
time is refused."""
_MAX_ODOMETRY_M = 1e6
"""Largest coordinate in metres of a camera in the odometry of its robot: no robot drives 1,000 km in one run.
`check_odometry_range` refuses a keyframe beyond it."""
_KINECT_NOISE = DepthNoise()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeFeatures:
    """Features of one image with depths, rounded to the numbers that the encoding can hold.

    Attributes:
        pixels: ``(n, 2)`` float32, undistorted.
        depths_m: ``(n,)`` float32 along the optical axis.  In metres and above 0 if `unit` is None; otherwise
            in the unit of length of the robot's segment, which is unknown in metres, and 0 where the depth is
            unknown.
        descriptors: ``(n, d)``.
        noise: The noise model of the camera that measured metric depths; not used for depths without metric
            scale.
        kind: The kind of the descriptors.
        f_baseline: Focal length in px times baseline in m of the stereo pair whose disparities are encoded;
            0 for a depth camera.
        unit: None for metric depths; else the quantisation step of which all depths are whole multiples, in
            the unit of length of the robot's segment.
    """

    pixels: npt.NDArray[np.float32]
    depths_m: npt.NDArray[np.float32]
    descriptors: Descriptors
    noise: DepthNoise = _KINECT_NOISE
    kind: DescriptorKind = ORB
    f_baseline: float = 0.0
    unit: float | None = None

    def __len__(self) -> int:
        return len(self.depths_m)

    @property
    def is_metric(self) -> bool:
        """Whether the depths, and the pose of the keyframe, are in metres."""
        return self.unit is None

    def points_camera(self, camera: Camera) -> Array:
        """Return the 3-D points ``(n, 3)`` in the frame of *camera*, in the unit of the depths.

        Features whose depth is unknown get the origin, the centre of the camera.
        """
        return camera.back_project(self.pixels.astype(np.float64), self.depths_m.astype(np.float64))


@dataclass(frozen=True, slots=True)
class UnknownBlock:
    """An optional block whose kind this release does not know (4, or above 8), kept byte for byte."""

    kind: int
    content: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SentKeyframe:
    """A keyframe as a robot sends it and as the log of a live map stores it.

    It holds neither an id nor the name of its robot: a live map numbers keyframes in the order of their
    arrival, and knows the robot from the token of the request.  The keyframe of a map version is
    `rse_pf.maps.format.Keyframe`; `in_map` and `from_map` convert between both.

    Attributes:
        timestamp_s: When the image was taken, Unix seconds.
        T_odom_camera: ``(4, 4)``; maps points from the camera's frame to the odometry frame of the robot's
            segment, in metres or in the unit of length of the features' depths.
        camera: The pinhole camera that took the image.
        features: The features of the image.
        unknown_blocks: Blocks that this release does not know.
        imu: What an IMU measured, if the robot has one.
        points: The object of the robot that holds the coloured points of the keyframe, if there is one.
        image: The object of the robot that holds the image as JPEG, if there is one.
    """

    timestamp_s: float
    T_odom_camera: Array
    camera: Camera
    features: KeyframeFeatures
    unknown_blocks: tuple[UnknownBlock, ...] = ()
    imu: KeyframeImu | None = None
    points: ObjectReference | None = None
    image: ObjectReference | None = None

    def in_map(self, *, id: int, robot: str, T_world_camera: Array, metres_per_unit: float = 1.0) -> Keyframe:
        """Return this keyframe as a keyframe of a map, which has 3-D points instead of depths.

        The point of a feature with an unknown depth is NaN.  The depth noise, IMU data, references to objects
        and unknown blocks are left out.

        Args:
            id: The id in the map.
            robot: Name of the robot.
            T_world_camera: ``(4, 4)``, the pose in the world of the map, metres.
            metres_per_unit: Metric scale of the segment, by which depths without scale are multiplied; not
                used if the depths are metric.
        """
        points = self.features.points_camera(self.camera)
        if not self.features.is_metric:
            points = np.where(self.features.depths_m[:, None] > 0.0, metres_per_unit * points, np.nan)
        return Keyframe(
            id=id,
            robot=robot,
            timestamp_s=self.timestamp_s,
            T_world_camera=T_world_camera,
            camera=self.camera,
            pixels=self.features.pixels,
            descriptors=self.features.descriptors,
            points_camera=points.astype(np.float32),
            kind=self.features.kind,
        )

    @staticmethod
    def from_map(keyframe: Keyframe) -> SentKeyframe:
        """Return a keyframe of a map as if a robot had sent it, with its pose in the map as odometry.

        Its depths count as those of a Kinect, rounded to 1 mm.  Features whose depth is unknown or not within
        0.01..65 m are left out, as `make_features` does.
        """
        features = make_features(
            keyframe.pixels, keyframe.points_camera[:, 2], keyframe.descriptors, kind=keyframe.kind
        )
        return SentKeyframe(
            timestamp_s=keyframe.timestamp_s,
            T_odom_camera=keyframe.T_world_camera,
            camera=keyframe.camera,
            features=features,
        )


# --- Selection and rounding of features, so that they can be encoded ---


def max_features(kind: DescriptorKind) -> int:
    """Return how many features of a kind one keyframe can have: 894 ORB features, 485 with 64 bytes each."""
    return min(MAX_FEATURES, _MAX_FEATURES_BYTES // (_FEATURE_BYTES + kind.size))


def make_features(
    pixels: npt.NDArray[np.floating],
    depths_m: npt.NDArray[np.floating],
    descriptors: Descriptors,
    noise: DepthNoise = _KINECT_NOISE,
    kind: DescriptorKind = ORB,
    f_baseline: float = 0.0,
) -> KeyframeFeatures:
    """Return the features of a keyframe, rounded as they are encoded, without those that cannot be encoded.

    Pixels are rounded to 1/16 px (to 1/8 or 1/4 px if a coordinate of one of them is above 4,095 px), depths
    to 1 mm, or their disparities to 1/64 px.  Of more than `max_features` features the first ones are used.
    ORB returns the features of the finest pyramid level first, and features of that level give the most loop
    closures.

    Args:
        pixels: ``(n, 2)``, undistorted; features outside 0..16383 px are left out.
        depths_m: ``(n,)`` metres along the optical axis; features are left out whose depth is not finite or
            not within 0.01..65 m (for a stereo pair 0.01..1000 m).
        descriptors: ``(n, d)``.
        noise: Noise of the depths.
        kind: The kind of the descriptors.
        f_baseline: Focal length in px times baseline in m of the stereo pair that measured the depths; 0 for
            a depth camera.

    Raises:
        BadRequest: The shapes do not fit.
    """
    _check_shapes(pixels, depths_m, descriptors, kind)
    with np.errstate(invalid="ignore", over="ignore"):
        rounded_m = _round_depths(np.asarray(depths_m, dtype=np.float64), f_baseline)
        is_usable = np.isfinite(rounded_m) & _is_encodable_pixel(pixels)
    rows = np.flatnonzero(is_usable)[: max_features(kind)]
    return KeyframeFeatures(
        pixels=_round_pixels(pixels[rows]),
        depths_m=rounded_m[rows].astype(np.float32),
        descriptors=np.ascontiguousarray(descriptors[rows]),
        noise=noise,
        kind=kind,
        f_baseline=f_baseline,
    )


def _round_depths(depths_m: Array, f_baseline: float) -> Array:
    """Return depths in metres, rounded as they are encoded; NaN where they cannot be encoded.

    Depths are rounded to 1 mm if *f_baseline* (px m) is 0, else their disparities are rounded to 1/64 px.
    """
    if f_baseline == 0.0:
        depths_mm = np.rint(depths_m * 1000.0)
        is_encodable = (depths_mm >= _MIN_DEPTH_MM) & (depths_mm <= _MAX_STEPS)
        return np.where(is_encodable, depths_mm / 1000.0, np.nan)
    steps = np.rint(_DISPARITY_STEPS_PER_PX * f_baseline / np.where(depths_m > 0.0, depths_m, np.nan))
    rounded_m = (
        f_baseline * _DISPARITY_STEPS_PER_PX / np.where((steps >= 1) & (steps <= _MAX_STEPS), steps, np.nan)
    )
    return np.where((rounded_m >= _MIN_DEPTH_M) & (rounded_m <= _MAX_DEPTH_M), rounded_m, np.nan)


def make_scaleless_features(
    pixels: npt.NDArray[np.floating],
    depths: npt.NDArray[np.floating],
    descriptors: Descriptors,
    kind: DescriptorKind = ORB,
) -> KeyframeFeatures:
    """Return the features of a keyframe whose segment has no metric scale, those with a depth first.

    A depth above 16 times the median depth becomes unknown, because such a far landmark is inaccurate.  Of
    more than `max_features` features the first ones are used.  Pixels are rounded as by `make_features`.

    Args:
        pixels: ``(n, 2)``, undistorted; features outside 0..16383 px are left out.
        depths: ``(n,)`` along the optical axis, in the segment's unit of length; a depth that is not finite
            or not above 0 is unknown.
        descriptors: ``(n, d)``.
        kind: The kind of the descriptors.

    Raises:
        BadRequest: The shapes do not fit, or the largest depth (at most 16 times the median depth) is not
            within 6.6e-5..6.6e7, so that its quantisation step is not within 1e-9..1e3.
    """
    _check_shapes(pixels, depths, descriptors, kind)
    # 1. Find the features with a pixel that can be encoded, and those of them with a depth.
    with np.errstate(invalid="ignore"):
        is_usable = _is_encodable_pixel(pixels)
        known_depths = np.where(np.isfinite(depths) & (depths > 0.0), depths, 0.0)
    has_depth = is_usable & (known_depths > 0.0)
    # 2. Choose the unit so that the largest number of the encoding stands for the farthest depth that is
    #    encoded: the largest depth, but at most 16 times the median depth.
    max_depth = _MAX_MEDIAN_DEPTHS * float(np.median(known_depths[has_depth])) if has_depth.any() else 1.0
    unit = min(max_depth, float(known_depths[has_depth].max(initial=0.0)) or 1.0) / _MAX_STEPS
    if not _MIN_UNIT <= unit <= _MAX_UNIT:
        raise BadRequest(
            f"depths up to {unit * _MAX_STEPS:g} are not within {_MIN_UNIT * _MAX_STEPS:g}.."
            f"{_MAX_UNIT * _MAX_STEPS:g} units of length of the segment",
            hint="choose a unit of the segment in which depths are around 1",
        )
    # 3. Round the depths; those beyond 16 times the median depth become unknown.
    steps = np.rint(np.where(has_depth & (known_depths <= max_depth), known_depths, 0.0) / unit)
    steps = np.where(steps <= _MAX_STEPS, steps, 0.0)
    # 4. Take the features with a depth, then those without, up to the number that a keyframe can have.
    order = np.concatenate(
        [np.flatnonzero(is_usable & (steps > 0)), np.flatnonzero(is_usable & (steps == 0))]
    )
    rows = order[: max_features(kind)]
    return KeyframeFeatures(
        pixels=_round_pixels(pixels[rows]),
        depths_m=(steps[rows] * unit).astype(np.float32),
        descriptors=np.ascontiguousarray(descriptors[rows]),
        kind=kind,
        unit=unit,
    )


def _check_shapes(
    pixels: npt.NDArray[np.floating],
    depths: npt.NDArray[np.floating],
    descriptors: Descriptors,
    kind: DescriptorKind,
) -> None:
    n = len(depths)
    has_right_lengths = pixels.shape == (n, 2) and depths.shape == (n,) and len(descriptors) == n
    if not (has_right_lengths and kind.is_kind_of(descriptors)):
        raise BadRequest(
            f"pixels {pixels.shape}, depths_m {depths.shape}, descriptors {descriptors.shape} of "
            f"{descriptors.dtype} do not fit features of {kind}",
            hint="give one row for each feature",
        )


def _is_encodable_pixel(pixels: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Return for each pixel ``(n, 2)`` whether both coordinates are within 0..16383 px."""
    is_positive = pixels.min(axis=1, initial=np.inf) >= 0.0
    is_encodable: npt.NDArray[np.bool_] = is_positive & (
        pixels.max(axis=1, initial=-1.0) <= _max_pixel(_COARSEST_PIXEL_FRACTION)
    )
    return is_encodable


def _round_pixels(pixels: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    scale = 2.0 ** _pixel_fraction(float(pixels.max(initial=0.0)))
    return (np.rint(pixels.astype(np.float64) * scale) / scale).astype(np.float32)


def _pixel_fraction(largest_px: float) -> int:
    """Return the largest f of 2..4 for which uint16 holds *largest_px* in units of ``2**-f`` px."""
    fractions = range(_FINEST_PIXEL_FRACTION, _COARSEST_PIXEL_FRACTION - 1, -1)
    return next(fraction for fraction in fractions if largest_px <= _max_pixel(fraction))


def _max_pixel(fraction: int) -> float:
    """Return the largest coordinate in px that uint16 holds in units of ``2**-fraction`` px."""
    return 65_535 / 2.0**fraction


# --- Encoding of a keyframe as bytes ---


def encode_keyframe(keyframe: SentKeyframe) -> bytes:
    """Return *keyframe* as bytes, its features rounded as `make_features` rounds them.

    Sizes and ranges are not checked, unlike in `decode_keyframe`: the features must come from
    `make_features`, `make_scaleless_features` or `decode_keyframe`, which return only what can be encoded.
    """
    camera, features = keyframe.camera, keyframe.features
    n = len(features)
    fraction = _pixel_fraction(float(features.pixels.max(initial=0.0)))
    name = b"" if features.kind == ORB else features.kind.name.encode()
    pixel_steps = np.rint(features.pixels.T.astype(np.float64) * 2.0**fraction).astype("<u2")
    optional_blocks = _encode_optional_blocks(keyframe)
    block_count = len(_REQUIRED_BLOCKS) + len(optional_blocks)
    pose_rows = keyframe.T_odom_camera[:3].ravel().tolist()
    parts = [_HEAD_STRUCT.pack(_MAGIC, _VERSION, block_count, keyframe.timestamp_s, *pose_rows)]
    camera_numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    feature_head = _FEATURES_STRUCT.pack(*_kind_numbers(features.kind), n, fraction, len(name))
    for kind, *contents in (
        (_CAMERA_BLOCK, _CAMERA_STRUCT.pack(_PINHOLE, 0, *camera_numbers)),
        (_FEATURES_BLOCK, feature_head, pixel_steps.tobytes(), features.descriptors.tobytes(), name),
        (_GEOMETRY_BLOCK, *_encode_geometry(features)),
    ):
        parts += [_BLOCK_STRUCT.pack(kind, _REQUIRED, sum(map(len, contents))), *contents]
    for kind, content in optional_blocks:
        parts += [_BLOCK_STRUCT.pack(kind, 0, len(content)), content]
    return b"".join(parts)


def _encode_optional_blocks(keyframe: SentKeyframe) -> list[tuple[int, bytes]]:
    """Return kind and content of the optional blocks of *keyframe*, in ascending order of their kinds."""
    blocks = [(block.kind, block.content) for block in keyframe.unknown_blocks]
    noise = keyframe.features.noise
    if noise != _KINECT_NOISE:
        blocks.append((_NOISE_BLOCK, _NOISE_STRUCT.pack(noise.base_m, noise.growth_per_m, noise.from_m)))
    if keyframe.imu is not None:
        blocks.append((_IMU_BLOCK, encode_imu(keyframe.imu)))
    for kind, reference in ((_POINTS_BLOCK, keyframe.points), (_IMAGE_BLOCK, keyframe.image)):
        if reference is not None:
            blocks.append((kind, encode_reference(reference)))
    return sorted(blocks, key=lambda block: block[0])


def _encode_geometry(features: KeyframeFeatures) -> tuple[bytes, bytes]:
    """Return the bytes of the geometry block in two parts: those before the depths, and the depths."""
    depths, n = features.depths_m.astype(np.float64), len(features)
    if features.unit is not None:
        head = _GEOMETRY_STRUCT.pack(_SCALELESS_DEPTHS, 0, n) + _SCALE_STRUCT.pack(features.unit)
        return head, np.rint(depths / features.unit).astype("<u2").tobytes()
    if features.f_baseline == 0.0:
        return _GEOMETRY_STRUCT.pack(_DEPTHS, 0, n), np.rint(depths * 1000.0).astype("<u2").tobytes()
    head = _GEOMETRY_STRUCT.pack(_DISPARITIES, 0, n) + _SCALE_STRUCT.pack(features.f_baseline)
    steps = np.rint(_DISPARITY_STEPS_PER_PX * features.f_baseline / depths)
    return head, steps.astype("<u2").tobytes()


# --- Decoding and checking of the bytes of a keyframe ---


def decode_keyframe(data: bytes) -> SentKeyframe:
    """Return the keyframe that `encode_keyframe` encoded; its descriptors are a read-only view of *data*.

    Raises:
        BadRequest: *data* is too long or malformed, a required block is unknown or missing, a number is not
            finite or out of its range, or a feature lies more than 64 px outside the image.
        InvalidCamera: The intrinsics are not those of a camera.
    """
    # 1. Check the size of the bytes, and decode the head.
    if not _HEAD_STRUCT.size <= len(data) <= MAX_KEYFRAME_BYTES:
        raise _bad_keyframe(
            f"its size of {len(data)} bytes is not within {_HEAD_STRUCT.size}..{MAX_KEYFRAME_BYTES}"
        )
    magic, version, block_count, timestamp_s, *pose_rows = _HEAD_STRUCT.unpack_from(data)
    if magic != _MAGIC or version != _VERSION:
        raise _bad_keyframe("it does not begin as a keyframe of version 2")
    if not abs(timestamp_s) <= _MAX_TIME_S:
        raise _bad_keyframe(
            f"its time {timestamp_s:g} s is not within +-{_MAX_TIME_S:g} s", "send seconds since 1970"
        )
    T_odom_camera = rigid(np.array([*pose_rows, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4))
    if T_odom_camera is None:
        raise _bad_keyframe(
            "T_odom_camera is no rigid motion", "send three rows of a rotation and a translation in metres"
        )
    # 2. Find where the content of each block begins and ends; copy unknown optional blocks byte for byte.
    spans: dict[int, tuple[int, int]] = {}
    unknown_blocks = []
    for kind, begin, end in _find_blocks(data, block_count):
        if kind in _REQUIRED_BLOCKS or kind in _OPTIONAL_BLOCKS:
            spans[kind] = begin, end
        else:
            unknown_blocks.append(UnknownBlock(kind, bytes(data[begin:end])))
    for kind, name in _REQUIRED_BLOCKS.items():
        if kind not in spans:
            raise _bad_keyframe(f"it has no block of the {name}")
    # 3. Decode the required blocks.
    camera = _decode_camera(data, *spans[_CAMERA_BLOCK])
    features = _decode_features(data, spans[_FEATURES_BLOCK], spans[_GEOMETRY_BLOCK], camera)
    # 4. Decode those optional blocks that the keyframe has.
    if _NOISE_BLOCK in spans:
        if not features.is_metric:
            raise _bad_keyframe("it has a noise in metres, and depths without scale", "leave the noise out")
        features = replace(features, noise=_decode_noise(data, *spans[_NOISE_BLOCK]))
    imu = decode_imu(bytes(data[slice(*spans[_IMU_BLOCK])])) if _IMU_BLOCK in spans else None
    points, image = (
        decode_reference(bytes(data[slice(*spans[kind])])) if kind in spans else None
        for kind in (_POINTS_BLOCK, _IMAGE_BLOCK)
    )
    return SentKeyframe(
        timestamp_s=timestamp_s,
        T_odom_camera=T_odom_camera,
        camera=camera,
        features=features,
        unknown_blocks=tuple(unknown_blocks),
        imu=imu,
        points=points,
        image=image,
    )


def check_odometry_range(keyframe: SentKeyframe, metres_per_unit: float = 1.0) -> None:
    """Check that the camera is within 1,000 km of the origin of the robot's odometry.

    A keyframe that comes from a map version is not checked: its world may have the origin of a national
    survey.

    Args:
        keyframe: As a robot sent it.
        metres_per_unit: Metric scale of the robot's segment, 1 if its poses are in metres.

    Raises:
        BadRequest: A coordinate of the camera is beyond 1,000 km.
    """
    if not (np.abs(metres_per_unit * keyframe.T_odom_camera[:3, 3]) <= _MAX_ODOMETRY_M).all():
        raise _bad_keyframe(
            f"a coordinate of T_odom_camera is more than {_MAX_ODOMETRY_M:.0f} m from the odometry's start",
            "send the odometry in metres",
        )


def _find_blocks(data: bytes, block_count: int) -> Iterator[tuple[int, int, int]]:
    """Yield the kind of each block, and where its content begins and ends in *data*.

    Raises:
        BadRequest: A block is malformed, repeated, out of order, or required and unknown.
    """
    if block_count > MAX_BLOCKS:
        raise _bad_keyframe(f"it has {block_count} blocks, more than {MAX_BLOCKS}")
    end, last_kind = _HEAD_STRUCT.size, 0
    for _ in range(block_count):
        begin = end + _BLOCK_STRUCT.size
        if begin > len(data):
            raise _bad_keyframe("it ends within the head of a block")
        kind, flags, size = _BLOCK_STRUCT.unpack_from(data, end)
        end = begin + size
        if end > len(data):
            raise _bad_keyframe(f"block {kind} of {size} bytes goes on beyond the end of the keyframe")
        is_known = kind in _REQUIRED_BLOCKS or kind in _OPTIONAL_BLOCKS
        if kind < max(1, last_kind) or (kind == last_kind and is_known) or flags > _REQUIRED:
            raise _bad_keyframe(f"block {kind} is repeated, out of order, or has unknown flags {flags}")
        if kind in _OPTIONAL_BLOCKS and flags & _REQUIRED:
            raise _bad_keyframe(f"the optional block of the {_OPTIONAL_BLOCKS[kind]} is flagged as required")
        if kind not in _REQUIRED_BLOCKS and flags & _REQUIRED:
            raise _bad_keyframe(
                f"it needs block {kind}, which this release does not know",
                "update the server, or send the keyframe without this block",
            )
        if kind in _REQUIRED_BLOCKS and not flags & _REQUIRED:
            raise _bad_keyframe(f"the block of the {_REQUIRED_BLOCKS[kind]} is not flagged as required")
        last_kind = kind
        yield kind, begin, end
    if end != len(data):
        raise _bad_keyframe(f"{len(data) - end} bytes follow the last block")


def _decode_camera(data: bytes, begin: int, end: int) -> Camera:
    if end - begin != _CAMERA_STRUCT.size:
        raise _bad_keyframe(f"the block of the camera has {end - begin} bytes, not {_CAMERA_STRUCT.size}")
    model, number, width, height, fx, fy, cx, cy = _CAMERA_STRUCT.unpack_from(data, begin)
    if (model, number) != (_PINHOLE, 0):
        raise _bad_keyframe(
            f"camera {number} of model {model} is not known", "send undistorted pixels of one pinhole camera"
        )
    return Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def _decode_noise(data: bytes, begin: int, end: int) -> DepthNoise:
    if end - begin != _NOISE_STRUCT.size:
        raise _bad_keyframe(f"the block of the depth noise has {end - begin} bytes, not {_NOISE_STRUCT.size}")
    base_m, growth_per_m, from_m = _NOISE_STRUCT.unpack_from(data, begin)
    return DepthNoise(base_m=base_m, growth_per_m=growth_per_m, from_m=from_m)


def _decode_features(
    data: bytes, features_span: tuple[int, int], geometry_span: tuple[int, int], camera: Camera
) -> KeyframeFeatures:
    """Return the features of the features block and the geometry block; raises BadRequest.

    Args:
        data: The bytes of the keyframe.
        features_span: Where the content of the features block begins and ends in *data*.
        geometry_span: Where the content of the geometry block begins and ends in *data*.
        camera: The camera, whose image must contain the pixels up to a border of 64 px.
    """
    (begin, end), (geometry_begin, geometry_end) = features_span, geometry_span
    # 1. Check that both blocks have the sizes that the head of the features block states.
    if end - begin < _FEATURES_STRUCT.size or geometry_end - geometry_begin < _GEOMETRY_STRUCT.size:
        raise _bad_keyframe("the block of the features or of the geometry is too short")
    detector, distance, descriptor_bytes, n, fraction, name_bytes = _FEATURES_STRUCT.unpack_from(data, begin)
    if not _COARSEST_PIXEL_FRACTION <= fraction <= _FINEST_PIXEL_FRACTION:
        raise _bad_keyframe(f"pixels in units of 2**-{fraction} px are not known")
    if end - begin != _FEATURES_STRUCT.size + n * (4 + descriptor_bytes) + name_bytes:
        raise _bad_keyframe(
            f"{end - begin} bytes are not {n} features with descriptors of {descriptor_bytes}"
        )
    kind = _decode_kind(detector, distance, descriptor_bytes, bytes(data[end - name_bytes : end]))
    if n > max_features(kind):
        raise _bad_keyframe(f"{n} features of {kind} are above {max_features(kind)}")
    # 2. Decode the depths.
    depths, f_baseline, unit = _decode_depths(data, geometry_begin, geometry_end, n)
    # 3. Decode the pixels.
    steps = np.frombuffer(data, dtype="<u2", count=2 * n, offset=begin + _FEATURES_STRUCT.size).reshape(2, n)
    pixels = (steps.T * np.float32(2.0**-fraction)).astype(np.float32, copy=False)
    max_column = (camera.width + _BORDER_PX) << fraction
    max_row = (camera.height + _BORDER_PX) << fraction
    if n and (steps[0].max() > max_column or steps[1].max() > max_row):
        raise _bad_keyframe(
            f"a pixel lies more than {_BORDER_PX} px outside the image of {camera.width}x{camera.height} px"
        )
    # 4. Decode the descriptors.
    descriptors = np.frombuffer(
        data, dtype=kind.dtype, count=n * kind.size, offset=begin + _FEATURES_STRUCT.size + 4 * n
    )
    return KeyframeFeatures(
        pixels=pixels,
        depths_m=depths,
        descriptors=descriptors.reshape(n, kind.size),
        kind=kind,
        f_baseline=f_baseline,
        unit=unit,
    )


def _decode_depths(
    data: bytes, begin: int, end: int, n: int
) -> tuple[npt.NDArray[np.float32], float, float | None]:
    """Return the depths of *n* features, and ``f_baseline`` and ``unit`` as `KeyframeFeatures` has them.

    Raises:
        BadRequest: The geometry block is malformed, or a number is out of its range.
    """
    depth_type, zero, count = _GEOMETRY_STRUCT.unpack_from(data, begin)
    if depth_type not in (_DEPTHS, _DISPARITIES, _SCALELESS_DEPTHS) or zero:
        raise _bad_keyframe(
            f"geometry of kind {depth_type} is not known",
            f"send kind {_DEPTHS}, {_DISPARITIES} or {_SCALELESS_DEPTHS}, and 0 in the byte that follows it",
        )
    scale_begin = begin + _GEOMETRY_STRUCT.size
    depths_begin = scale_begin + (0 if depth_type == _DEPTHS else _SCALE_STRUCT.size)
    if count != n or end - depths_begin != 2 * n:
        raise _bad_keyframe(f"{count} depths in {end - begin} bytes are not those of {n} features")
    steps = np.frombuffer(data, dtype="<u2", count=n, offset=depths_begin)
    if depth_type == _DEPTHS:
        if n and steps.min() < _MIN_DEPTH_MM:
            raise _bad_keyframe(f"a depth is below {_MIN_DEPTH_MM} mm")
        return (steps / 1000.0).astype(np.float32), 0.0, None
    if depth_type == _SCALELESS_DEPTHS:
        unit: float = _SCALE_STRUCT.unpack_from(data, scale_begin)[0]
        if not _MIN_UNIT <= unit <= _MAX_UNIT:
            raise _bad_keyframe(
                f"its unit of depth {unit:g} is not within {_MIN_UNIT:g}..{_MAX_UNIT:g}",
                "choose a unit of the segment in which depths are around 1",
            )
        return (steps * unit).astype(np.float32), 0.0, unit
    f_baseline: float = _SCALE_STRUCT.unpack_from(data, scale_begin)[0]
    if not _MIN_F_BASELINE <= f_baseline <= _MAX_F_BASELINE:
        raise _bad_keyframe(
            f"its focal length times baseline, {f_baseline:g} px m, is not within "
            f"{_MIN_F_BASELINE:g}..{_MAX_F_BASELINE:g} px m",
            "send pixels times metres",
        )
    min_step, max_step = int(steps.min(initial=_MAX_STEPS)), int(steps.max(initial=1))
    nearest_m = f_baseline * _DISPARITY_STEPS_PER_PX / max(max_step, 1)
    farthest_m = f_baseline * _DISPARITY_STEPS_PER_PX / max(min_step, 1)
    if n and (min_step < 1 or nearest_m < _MIN_DEPTH_M or farthest_m > _MAX_DEPTH_M):
        raise _bad_keyframe(
            f"depths of {nearest_m:g} to {farthest_m:g} m are not within "
            f"{_MIN_DEPTH_M:g}..{_MAX_DEPTH_M:g} m",
            "leave out features whose disparity is too small",
        )
    return (f_baseline * _DISPARITY_STEPS_PER_PX / steps).astype(np.float32), f_baseline, None


def _kind_numbers(kind: DescriptorKind) -> tuple[int, int, int]:
    """Return the numbers of detector and distance, and the bytes of a descriptor, for the features block."""
    return (_ORB_DETECTOR if kind == ORB else _NAMED_DETECTOR), _DISTANCES[kind.dtype], kind.size


def _decode_kind(detector: int, distance: int, size: int, name: bytes) -> DescriptorKind:
    """Return the kind of descriptors that a features block states; raises BadRequest if it is not known."""
    if (detector, distance, size, name) == (*_kind_numbers(ORB), b""):
        return ORB
    dtype = next((dtype for dtype, number in _DISTANCES.items() if number == distance), None)
    if detector != _NAMED_DETECTOR or dtype is None:
        raise _bad_keyframe(
            f"features of detector {detector}, distance {distance}, with {size} bytes are not known",
            "send ORB of 32 bytes, or named features of bytes or int8",
        )
    try:
        kind = DescriptorKind(name.decode("ascii", "replace"), dtype, size)
    except BadRequest as error:
        raise _bad_keyframe(error.message, error.hint) from error
    if kind == ORB:
        raise _bad_keyframe(
            f"its features of the kind ORB have detector {_NAMED_DETECTOR}, which is for all other kinds",
            f"send ORB features as detector {_ORB_DETECTOR}, without a name",
        )
    return kind


def _bad_keyframe(reason: str, hint: str = "send what encode_keyframe returned") -> BadRequest:
    return BadRequest(f"the keyframe is refused: {reason}", hint=hint)
