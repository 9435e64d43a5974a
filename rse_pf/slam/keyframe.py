"""A keyframe: where one image was taken, its camera, and its features with their depths.

It has one form as bytes, which the robot makes once: these bytes wait on its disk, go over the wire, and are
kept in the log and in the snapshots of a live map.  A fixed head is followed by typed blocks, so that later
releases add blocks and no versions.  A reader keeps optional blocks that it does not know byte for byte, and
refuses a keyframe with a required one.  Numbers and sizes are judged before an array is made.

All numbers are little-endian::

    head      108 bytes: "KF", version 2 (uint8), number of blocks (uint8), timestamp_s (float64),
              the first three rows of T_odom_camera (12 float64)
    block     8 bytes: kind (uint16), flags (uint16; 1: required), size of its content (uint32); the content
    camera    kind 1: model (uint8; 1: pinhole), number in the rig (uint8; 0), width, height (uint16),
              fx, fy, cx, cy (float64)
    features  kind 2: detector (uint8; 1: ORB, 2: named), metric (uint8; 1: Hamming of bits, 2: squared
              Euclidean distance of int8), bytes of a descriptor (uint16), number n (uint16), f (uint8):
              pixels count in units of 2**-f, length of the name (uint8; 0 for ORB);
              n columns and n rows (uint16), n descriptors, the name (ASCII)
    geometry  kind 3: what it holds (uint8), 0 (uint8), n (uint16), and for
              1, depths: n depths in mm (uint16);
              2, disparities of a stereo pair: focal length in px times baseline in m (float64), n
              disparities in 1/64 px (uint16): depths beyond 65 m are kept
              3, depths of a segment without scale: the unit (float64), in the unknown unit of length that
              T_odom_camera has, too; n depths in this unit (uint16; 0: none)
    noise     kind 5, optional: deviation of a depth z in metres is base + growth * max(0, z - from)^2
              (3 float64); a Kinect's where it is left out
    IMU       kind 6, optional: gravity, and the motion since the last keyframe: `rse_pf.slam.inertial`
    points    kind 7, optional: where its coloured points are: `rse_pf.slam.keyframe_points`
    image     kind 8, optional: where its image is, as JPEG

Blocks stand in the order of their kinds.
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
from rse_pf.pnp import DepthNoise
from rse_pf.slam.inertial import KeyframeImu, decode_imu, encode_imu
from rse_pf.slam.keyframe_points import ObjectReference, decode_reference, encode_reference

__all__ = [
    "MAX_BLOCKS",
    "MAX_FEATURES",
    "MAX_KEYFRAME_BYTES",
    "Keyframe",
    "KeyframeFeatures",
    "UnknownBlock",
    "check_sent",
    "decode_keyframe",
    "encode_keyframe",
    "make_features",
    "make_scaleless_features",
    "most_features",
]

MAX_KEYFRAME_BYTES = 36_000
"""Size of one keyframe; the features that a robot sends by default take 33.3 kB of it."""
MAX_FEATURES = 894
"""Number of features of one keyframe; fewer of larger descriptors than ORB's, see `most_features`."""
MAX_BLOCKS = 16

_MAGIC, _VERSION = b"KF", 2
_HEAD = struct.Struct("<2sBB13d")
_BLOCK = struct.Struct("<HHI")
_CAMERA = struct.Struct("<BBHH4d")
_FEATURES = struct.Struct("<BBHHBB")
_GEOMETRY = struct.Struct("<BBH")
_F_BASELINE = struct.Struct("<d")
_UNIT = struct.Struct("<d")
_CAMERA_KIND, _FEATURES_KIND, _GEOMETRY_KIND = 1, 2, 3
_NOISE_KIND, _IMU_KIND, _POINTS_KIND, _IMAGE_KIND = 5, 6, 7, 8
_OPTIONAL = {_NOISE_KIND: "noise", _IMU_KIND: "IMU", _POINTS_KIND: "points", _IMAGE_KIND: "image"}
_NAMES = {_CAMERA_KIND: "camera", _FEATURES_KIND: "features", _GEOMETRY_KIND: "geometry"}
_NOISE = struct.Struct("<3d")
_KINECT = DepthNoise()
_REQUIRED = 1
_PINHOLE, _ORB, _NAMED = 1, 1, 2
_DEPTH, _SCALELESS = 1, 3
_METRICS = {"uint8": 1, "int8": 2}
_FEATURE_BYTES = 6
"""Of a feature, but for its descriptor."""
_MAX_FEATURE_BYTES = MAX_FEATURES * (_FEATURE_BYTES + ORB.size)
_FINEST, _COARSEST = 4, 2
_DISPARITY, _PER_PX = 2, 64
_NEAREST_MM, _FARTHEST_MM = 10, 65_535
_NEAREST_M, _FARTHEST_M = 0.01, 1000.0
"""Of depths by disparities: poses are refined with depths up to 1 km."""
_LEAST_F_BASELINE, _MOST_F_BASELINE = 0.05, 1e5
"""Of 50 px and 1 mm, and of 10,000 px and 10 m."""
_FAR_MEDIANS = 16.0
"""A landmark so many times as far as the median one has no depth: its place is not known well."""
_MIN_UNIT, _MAX_UNIT = 1e-9, 1e3
_BORDER_PX = 64
"""Undistorted pixels may lie so far beyond the image."""
_MAX_TIME_S = 1e12
_MAX_ODOMETRY_M = 1e6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyframeFeatures:
    """Features of one image, all with depth, rounded as they are encoded.

    ``pixels`` ``(n, 2)`` float32, undistorted; ``depths_m`` ``(n,)`` float32, metres along the optical axis,
    above 0, with their ``noise`` as the robot measured it; ``descriptors`` ``(n, d)`` of one ``kind``.
    ``f_baseline`` is that of the stereo pair, pixels times metres, whose disparities are encoded; 0 for a
    depth camera.

    With a ``unit``, the depths are no metres but in the length of the robot's segment, whose scale nobody
    knows; they are multiples of ``unit``, 0 where there is none.
    """

    pixels: npt.NDArray[np.float32]
    depths_m: npt.NDArray[np.float32]
    descriptors: Descriptors
    noise: DepthNoise = _KINECT
    kind: DescriptorKind = ORB
    f_baseline: float = 0.0
    unit: float | None = None

    def __len__(self) -> int:
        return len(self.depths_m)

    @property
    def is_metric(self) -> bool:
        """Whether depths, and the pose of the keyframe, are in metres."""
        return self.unit is None

    def points_camera(self, camera: Camera) -> Array:
        """Return the ``(n, 3)`` points in the frame of *camera*, which took the image, as the depths are."""
        return camera.back_project(self.pixels.astype(np.float64), self.depths_m.astype(np.float64))


@dataclass(frozen=True, slots=True)
class UnknownBlock:
    """An optional block of a kind that this release does not know, 4 or above 8, kept as it came."""

    kind: int
    content: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """Where an image was taken and what it shows.

    ``timestamp_s`` is in seconds since 1970.  ``T_odom_camera`` ``(4, 4)``, metres (or the unit of its
    features' depths), maps the camera's frame to the odometry frame of the robot's segment; for a keyframe of
    a version it is the pose in that map.  ``imu`` tells where down is, if the robot has an IMU; ``points``
    and ``image`` are objects of the robot that tell more of what it shows; ``others`` are the blocks that
    this release does not know.
    """

    timestamp_s: float
    T_odom_camera: Array
    camera: Camera
    features: KeyframeFeatures
    others: tuple[UnknownBlock, ...] = ()
    imu: KeyframeImu | None = None
    points: ObjectReference | None = None
    image: ObjectReference | None = None


def most_features(kind: DescriptorKind) -> int:
    """Return how many features of a kind a keyframe may have: 894 of ORB, 485 with 64 bytes, 253 with 128."""
    return min(MAX_FEATURES, _MAX_FEATURE_BYTES // (_FEATURE_BYTES + kind.size))


def make_features(
    pixels: npt.NDArray[np.floating],
    depths_m: npt.NDArray[np.floating],
    descriptors: Descriptors,
    noise: DepthNoise = _KINECT,
    kind: DescriptorKind = ORB,
    f_baseline: float = 0.0,
) -> KeyframeFeatures:
    """Return the features of a keyframe; rows without a usable depth are left out.

    Pixels are rounded to 1/16 px (images wider than 4,095 px: 1/8, 1/4), depths to 1 mm, or their disparities
    to 1/64 px.  Where there are
    more than `most_features`, the first are kept: ORB gives those of the finest level first, which keep most
    links.

    Args:
        pixels: ``(n, 2)``, undistorted; rows outside 0..16383 px are left out.
        depths_m: ``(n,)`` metres along the optical axis; not finite or out of 0.01..65 m (of a stereo pair:
            0.01..1000 m): none.
        descriptors: ``(n, d)``.
        noise: Of the depths.
        kind: Of the descriptors.
        f_baseline: Focal length in pixels times baseline in metres of the stereo pair that measured the
            depths; 0 for a depth camera.

    Raises:
        BadRequest: The shapes do not fit.
    """
    _check_shapes(pixels, depths_m, descriptors, kind)
    with np.errstate(invalid="ignore", over="ignore"):
        rounded_m = _rounded_depths(np.asarray(depths_m, dtype=np.float64), f_baseline)
        usable = np.isfinite(rounded_m) & _has_pixel(pixels)
    rows = np.flatnonzero(usable)[: most_features(kind)]
    return KeyframeFeatures(
        pixels=_rounded(pixels[rows]),
        depths_m=rounded_m[rows].astype(np.float32),
        descriptors=np.ascontiguousarray(descriptors[rows]),
        noise=noise,
        kind=kind,
        f_baseline=f_baseline,
    )


def _rounded_depths(depths_m: Array, f_baseline: float) -> Array:
    """Return depths as they are encoded, NaN where they cannot be."""
    if f_baseline == 0.0:
        steps = np.rint(depths_m * 1000.0)
        return np.where((steps >= _NEAREST_MM) & (steps <= _FARTHEST_MM), steps / 1000.0, np.nan)
    steps = np.rint(_PER_PX * f_baseline / np.where(depths_m > 0.0, depths_m, np.nan))
    found = f_baseline * _PER_PX / np.where((steps >= 1) & (steps <= 65_535), steps, np.nan)
    return np.where((found >= _NEAREST_M) & (found <= _FARTHEST_M), found, np.nan)


def make_scaleless_features(
    pixels: npt.NDArray[np.floating],
    depths: npt.NDArray[np.floating],
    descriptors: Descriptors,
    kind: DescriptorKind = ORB,
) -> KeyframeFeatures:
    """Return the features of a keyframe whose segment has no scale, those with a depth first.

    Args:
        pixels: ``(n, 2)``, undistorted; rows outside 0..16383 px are left out.
        depths: ``(n,)`` along the optical axis, in the length of the segment; none: not finite, not above 0.
        descriptors: ``(n, d)``.
        kind: Of the descriptors.

    Raises:
        BadRequest: The shapes do not fit, or no float64 of sensible size is a unit of these depths.
    """
    _check_shapes(pixels, depths, descriptors, kind)
    with np.errstate(invalid="ignore"):
        usable, known = _has_pixel(pixels), np.where(np.isfinite(depths) & (depths > 0.0), depths, 0.0)
    has_depth = usable & (known > 0.0)
    farthest = _FAR_MEDIANS * float(np.median(known[has_depth])) if has_depth.any() else 1.0
    unit = min(farthest, float(known[has_depth].max(initial=0.0)) or 1.0) / _FARTHEST_MM
    if not _MIN_UNIT <= unit <= _MAX_UNIT:
        raise BadRequest(
            f"depths up to {unit * _FARTHEST_MM:g} have no unit within {_MIN_UNIT:g}..{_MAX_UNIT:g}",
            hint="choose a unit of the segment in which depths are around 1",
        )
    steps = np.rint(np.where(has_depth & (known <= farthest), known, 0.0) / unit)
    steps = np.where(steps <= _FARTHEST_MM, steps, 0.0)
    order = np.concatenate([np.flatnonzero(usable & (steps > 0)), np.flatnonzero(usable & (steps == 0))])
    rows = order[: most_features(kind)]
    return KeyframeFeatures(
        pixels=_rounded(pixels[rows]),
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
    fits = pixels.shape == (n, 2) and depths.shape == (n,) and len(descriptors) == n
    if not (fits and kind.is_kind_of(descriptors)):
        raise BadRequest(
            f"pixels {pixels.shape}, depths_m {depths.shape}, descriptors {descriptors.shape} of "
            f"{descriptors.dtype} do not fit features of {kind}",
            hint="give one row for each feature",
        )


def _has_pixel(pixels: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Return whether the form of the bytes holds each pixel."""
    is_positive = pixels.min(axis=1, initial=np.inf) >= 0.0
    held: npt.NDArray[np.bool_] = is_positive & (pixels.max(axis=1, initial=-1.0) <= _largest_px(_COARSEST))
    return held


def _rounded(pixels: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    scale = 2.0 ** _fraction_of(float(pixels.max(initial=0.0)))
    rounded: npt.NDArray[np.float32] = (np.rint(pixels.astype(np.float64) * scale) / scale).astype(np.float32)
    return rounded


def encode_keyframe(keyframe: Keyframe) -> bytes:
    """Return *keyframe* as bytes, its features rounded as `make_features` rounds them."""
    camera, features = keyframe.camera, keyframe.features
    n = len(features)
    fraction = _fraction_of(float(features.pixels.max(initial=0.0)))
    name = b"" if features.kind == ORB else features.kind.name.encode()
    units = np.rint(features.pixels.T.astype(np.float64) * 2.0**fraction).astype("<u2")
    optional = _optional_blocks(keyframe)
    blocks = len(_NAMES) + len(optional)
    parts = [_HEAD.pack(
        _MAGIC, _VERSION, blocks, keyframe.timestamp_s,
        *keyframe.T_odom_camera[:3].ravel().tolist(),
    )]  # fmt: skip
    camera_numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    for kind, *contents in (
        (_CAMERA_KIND, _CAMERA.pack(_PINHOLE, 0, *camera_numbers)),
        (
            _FEATURES_KIND, _FEATURES.pack(*_kind_numbers(features.kind), n, fraction, len(name)),
            units.tobytes(), features.descriptors.tobytes(), name,
        ),
        (_GEOMETRY_KIND, *_geometry_of(features)),
    ):  # fmt: skip
        parts += [_BLOCK.pack(kind, _REQUIRED, sum(map(len, contents))), *contents]
    for kind, content in optional:
        parts += [_BLOCK.pack(kind, 0, len(content)), content]
    return b"".join(parts)


def _optional_blocks(keyframe: Keyframe) -> list[tuple[int, bytes]]:
    """Return kind and content of the blocks that may be missing, in their order."""
    blocks = [(block.kind, block.content) for block in keyframe.others]
    noise = keyframe.features.noise
    if noise != _KINECT:
        blocks.append((_NOISE_KIND, _NOISE.pack(noise.base_m, noise.growth_per_m, noise.from_m)))
    if keyframe.imu is not None:
        blocks.append((_IMU_KIND, encode_imu(keyframe.imu)))
    for kind, reference in ((_POINTS_KIND, keyframe.points), (_IMAGE_KIND, keyframe.image)):
        if reference is not None:
            blocks.append((kind, encode_reference(reference)))
    return sorted(blocks, key=lambda block: block[0])


def _geometry_of(features: KeyframeFeatures) -> tuple[bytes, bytes]:
    """Return the head and the numbers of the block of the geometry."""
    depths, n = features.depths_m.astype(np.float64), len(features)
    if features.unit is not None:
        head = _GEOMETRY.pack(_SCALELESS, 0, n) + _UNIT.pack(features.unit)
        return head, np.rint(depths / features.unit).astype("<u2").tobytes()
    if features.f_baseline == 0.0:
        return _GEOMETRY.pack(_DEPTH, 0, n), np.rint(depths * 1000.0).astype("<u2").tobytes()
    head = _GEOMETRY.pack(_DISPARITY, 0, n) + _F_BASELINE.pack(features.f_baseline)
    return head, np.rint(_PER_PX * features.f_baseline / depths).astype("<u2").tobytes()


def decode_keyframe(data: bytes) -> Keyframe:
    """Return the keyframe that `encode_keyframe` encoded; its arrays are read-only views where they can be.

    Raises:
        BadRequest: The bytes are too many or malformed, a required block is not known, a number is not finite
            or absurd, or a feature lies outside the image.
        InvalidCamera: The intrinsics are no camera.
    """
    if not _HEAD.size <= len(data) <= MAX_KEYFRAME_BYTES:
        raise _refusal(f"{len(data)} bytes are not within {_HEAD.size}..{MAX_KEYFRAME_BYTES}")
    magic, version, count, timestamp_s, *numbers = _HEAD.unpack_from(data)
    if magic != _MAGIC or version != _VERSION:
        raise _refusal("it does not begin as a keyframe of version 2")
    if not abs(timestamp_s) <= _MAX_TIME_S:
        raise _refusal("its time is absurd", "send seconds since 1970")
    T_odom_camera = rigid(np.array([*numbers, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4))
    if T_odom_camera is None:
        raise _refusal(
            "T_odom_camera is no rigid motion", "send three rows of a rotation and a translation in metres"
        )
    known: dict[int, tuple[int, int]] = {}
    others = []
    for kind, begin, end in _blocks(data, count):
        if kind in _NAMES or kind in _OPTIONAL:
            known[kind] = begin, end
        else:
            others.append(UnknownBlock(kind, bytes(data[begin:end])))
    for kind, name in _NAMES.items():
        if kind not in known:
            raise _refusal(f"it has no block of the {name}")
    camera = _camera(data, *known[_CAMERA_KIND])
    features = _features(data, known[_FEATURES_KIND], known[_GEOMETRY_KIND], camera)
    if _NOISE_KIND in known and not features.is_metric:
        raise _refusal("it has a noise in metres, and depths without scale", "leave the noise out")
    if _NOISE_KIND in known:
        features = replace(features, noise=_noise(data, *known[_NOISE_KIND]))
    imu = None
    if _IMU_KIND in known:
        begin, end = known[_IMU_KIND]
        imu = decode_imu(bytes(data[begin:end]))
    points, image = (
        decode_reference(bytes(data[slice(*known[kind])])) if kind in known else None
        for kind in (_POINTS_KIND, _IMAGE_KIND)
    )
    return Keyframe(
        timestamp_s=timestamp_s, T_odom_camera=T_odom_camera, camera=camera, features=features,
        others=tuple(others), imu=imu, points=points, image=image,
    )  # fmt: skip


def check_sent(keyframe: Keyframe, metres_per_unit: float = 1.0) -> None:
    """Raise BadRequest if a robot cannot have made *keyframe*: it is over 1,000 km from its start.

    A keyframe of a version may be: its map can have the origin of a state's survey.
    """
    if not (np.abs(metres_per_unit * keyframe.T_odom_camera[:3, 3]) <= _MAX_ODOMETRY_M).all():
        raise _refusal(
            f"T_odom_camera is more than {_MAX_ODOMETRY_M:.0f} m from the start",
            "send metres of the odometry",
        )


def _blocks(data: bytes, count: int) -> Iterator[tuple[int, int, int]]:
    """Yield kind, begin and end of each block; raises BadRequest."""
    if count > MAX_BLOCKS:
        raise _refusal(f"{count} blocks are more than {MAX_BLOCKS}")
    end, last = _HEAD.size, 0
    for _ in range(count):
        begin = end + _BLOCK.size
        if begin > len(data):
            raise _refusal("it ends within the head of a block")
        kind, flags, size = _BLOCK.unpack_from(data, end)
        end = begin + size
        if end > len(data):
            raise _refusal(f"a block of {size} bytes goes on beyond its end")
        if (
            kind < max(1, last)
            or (kind == last and (kind in _NAMES or kind in _OPTIONAL))
            or flags > _REQUIRED
        ):
            raise _refusal(f"block {kind} stands twice, after a later one, or has unknown flags")
        if kind in _OPTIONAL and flags & _REQUIRED:
            raise _refusal(f"the block of the {_OPTIONAL[kind]} is optional")
        if kind not in _NAMES and flags & _REQUIRED:
            raise _refusal(
                f"it needs block {kind}, which this release does not know",
                "update the server, or send the keyframe without this block",
            )
        if kind in _NAMES and not flags & _REQUIRED:
            raise _refusal(f"the block of the {_NAMES[kind]} is not required")
        last = kind
        yield kind, begin, end
    if end != len(data):
        raise _refusal(f"{len(data) - end} bytes follow the last block")


def _camera(data: bytes, begin: int, end: int) -> Camera:
    if end - begin != _CAMERA.size:
        raise _refusal(f"a camera has {_CAMERA.size} bytes, not {end - begin}")
    model, number, width, height, fx, fy, cx, cy = _CAMERA.unpack_from(data, begin)
    if (model, number) != (_PINHOLE, 0):
        raise _refusal(
            f"camera {number} of model {model} is not known", "send undistorted pixels of one pinhole camera"
        )
    return Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def _noise(data: bytes, begin: int, end: int) -> DepthNoise:
    if end - begin != _NOISE.size:
        raise _refusal(f"a noise has {_NOISE.size} bytes, not {end - begin}")
    base_m, growth_per_m, from_m = _NOISE.unpack_from(data, begin)
    return DepthNoise(base_m=base_m, growth_per_m=growth_per_m, from_m=from_m)


def _features(
    data: bytes, features: tuple[int, int], geometry: tuple[int, int], camera: Camera
) -> KeyframeFeatures:
    """Return the features of the blocks that begin and end there; raises BadRequest."""
    (begin, end), (depths_begin, depths_end) = features, geometry
    if end - begin < _FEATURES.size or depths_end - depths_begin < _GEOMETRY.size:
        raise _refusal("the block of the features or of the geometry is too short")
    detector, metric, descriptor_bytes, n, fraction, name_bytes = _FEATURES.unpack_from(data, begin)
    if not _COARSEST <= fraction <= _FINEST:
        raise _refusal(f"pixels in 2**-{fraction} are not known")
    if end - begin != _FEATURES.size + n * (4 + descriptor_bytes) + name_bytes:
        raise _refusal(f"{end - begin} bytes are not {n} features with descriptors of {descriptor_bytes}")
    kind = _kind(detector, metric, descriptor_bytes, bytes(data[end - name_bytes : end]))
    if n > most_features(kind):
        raise _refusal(f"{n} features of {kind} are above {most_features(kind)}")
    depths, f_baseline, unit = _depths(data, depths_begin, depths_end, n)
    units = np.frombuffer(data, dtype="<u2", count=2 * n, offset=begin + _FEATURES.size).reshape(2, n)
    pixels = (units.T * np.float32(2.0**-fraction)).astype(np.float32, copy=False)
    widest, highest = (camera.width + _BORDER_PX) << fraction, (camera.height + _BORDER_PX) << fraction
    if n and (units[0].max() > widest or units[1].max() > highest):
        raise _refusal(f"a pixel lies outside the image of {camera.width}x{camera.height} px")
    descriptors = np.frombuffer(
        data, dtype=kind.dtype, count=n * kind.size, offset=begin + _FEATURES.size + 4 * n
    )
    return KeyframeFeatures(
        pixels=pixels,
        depths_m=depths,
        descriptors=descriptors.reshape(n, kind.size),
        kind=kind,
        f_baseline=f_baseline,
        unit=unit,
    )


def _depths(data: bytes, begin: int, end: int, n: int) -> tuple[npt.NDArray[np.float32], float, float | None]:
    """Return the depths of *n* features, the f b of their stereo pair or 0, and their unit or None.

    Raises:
        BadRequest: They are malformed or absurd.
    """
    what, zero, count = _GEOMETRY.unpack_from(data, begin)
    if what not in (_DEPTH, _DISPARITY, _SCALELESS) or zero:
        raise _refusal(f"geometry of kind {what} is not known", "send a depth for each feature")
    first = begin + _GEOMETRY.size + (0 if what == _DEPTH else _UNIT.size)
    if count != n or end - first != 2 * n:
        raise _refusal(f"{count} depths in {end - begin} bytes are not those of {n} features")
    steps = np.frombuffer(data, dtype="<u2", count=n, offset=first)
    if what == _DEPTH:
        if n and steps.min() < _NEAREST_MM:
            raise _refusal(f"a depth is below {_NEAREST_MM} mm")
        return (steps / 1000.0).astype(np.float32), 0.0, None
    if what == _SCALELESS:
        unit: float = _UNIT.unpack_from(data, begin + _GEOMETRY.size)[0]
        if not _MIN_UNIT <= unit <= _MAX_UNIT:
            raise _refusal(
                f"its unit of depth {unit:g} is not within {_MIN_UNIT:g}..{_MAX_UNIT:g}",
                "choose a unit of the segment in which depths are around 1",
            )
        return (steps * unit).astype(np.float32), 0.0, unit
    f_baseline: float = _F_BASELINE.unpack_from(data, begin + _GEOMETRY.size)[0]
    if not _LEAST_F_BASELINE <= f_baseline <= _MOST_F_BASELINE:
        raise _refusal(
            f"its focal length times baseline {f_baseline:g} is that of no stereo pair",
            "send pixels times metres",
        )
    least, most = int(steps.min(initial=65_535)), int(steps.max(initial=1))
    nearest, farthest = (f_baseline * _PER_PX / max(step, 1) for step in (most, least))
    if n and (least < 1 or nearest < _NEAREST_M or farthest > _FARTHEST_M):
        raise _refusal(
            f"depths of {nearest:g} to {farthest:g} m are not within {_NEAREST_M:g}..{_FARTHEST_M:g} m",
            "leave out features whose disparity is too small",
        )
    return (f_baseline * _PER_PX / steps).astype(np.float32), f_baseline, None


def _kind_numbers(kind: DescriptorKind) -> tuple[int, int, int]:
    """Return detector, metric and bytes of a descriptor."""
    return (_ORB if kind == ORB else _NAMED), _METRICS[kind.dtype], kind.size


def _kind(detector: int, metric: int, size: int, name: bytes) -> DescriptorKind:
    """Return the kind whose numbers and name stand in a block; raises BadRequest."""
    if (detector, metric, size, name) == (*_kind_numbers(ORB), b""):
        return ORB
    dtype = next((dtype for dtype, number in _METRICS.items() if number == metric), None)
    if detector != _NAMED or dtype is None:
        raise _refusal(
            f"features of detector {detector}, metric {metric}, with {size} bytes are not known",
            "send ORB of 32 bytes, or named features of bytes or int8",
        )
    try:
        kind = DescriptorKind(name.decode("ascii", "replace"), dtype, size)
    except BadRequest as error:
        raise _refusal(error.message, error.hint) from error
    if kind == ORB:
        raise _refusal("it has ORB as named features", "send them as detector 1 without a name")
    return kind


def _fraction_of(widest_px: float) -> int:
    """Return the finest *f* for which uint16 holds *widest_px* in units of ``2**-f``."""
    return next(f for f in range(_FINEST, _COARSEST - 1, -1) if widest_px <= _largest_px(f))


def _largest_px(fraction: int) -> float:
    """Return the largest pixel that uint16 holds in units of ``2**-fraction``."""
    return 65_535 / 2.0**fraction


def _refusal(why: str, hint: str = "send what encode_keyframe returned") -> BadRequest:
    return BadRequest(f"the keyframe is refused: {why}", hint=hint)
