"""Collect the keyframes of a drive with which its calibration is checked, and match their features.

The selection does not use the calibration that is checked: keyframes are selected by the motion of their
features in the image, and matches by a fundamental matrix, which needs no intrinsics.
"""

from __future__ import annotations

import ctypes
from collections import deque
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import DescribedKeypoints, Features, Frame, describe, load_opencv
from client_sdk.stereo.depth import stereo_points
from rse_pf.geometry import Array, Camera, inverse, log_se3
from rse_pf.maps.descriptors import ORB
from rse_pf.native import address_of, aligned, core_function
from rse_pf.pnp import DepthNoise
from rse_pf.slam.descriptors import match_all

__all__ = ["FLIPS", "Keyframe", "KeyframeStore", "Tracks", "tracks_of"]

Rows = npt.NDArray[np.int64]

FLIPS = ("as it is", "left and right swapped", "top and bottom swapped", "turned by half a turn")
"""Orientations of the depth image relative to the colour image that are tried, as messages name them."""
_EXTRACTED_FEATURES = 500  # number of ORB features that are extracted if the tracker has none
_MAX_FEATURES = 1200  # largest number of features of a keyframe, those of smallest scale: bounds the time
_CANDIDATE_INTERVAL_S = 0.19  # shortest time, seconds, between two frames that are considered as keyframes
_MIN_MOVED_SHARE = 0.025
"""Smallest median motion of the features since the last keyframe, as a share of the image width, of a new
keyframe.  It grows by a factor of 1.6 each time that half of the keyframes are removed."""
# Fewest features of a keyframe; a frame with fewer matches to the last keyframe always becomes a keyframe.
_MIN_FEATURES = 60
_MAX_KEYFRAMES = 56  # above this number every second keyframe is removed: bounds memory and time
_MAX_RATE_RAD_S = 3.0  # a faster rotation, in rad/s, is an error of tracking: the twist counts as 0
_DEPTH_WINDOW_S = 0.42  # depth images within this time, seconds, before and after a keyframe are sampled
_MAX_DEPTH_SPREAD = 0.05  # relative range of neighbouring depths above which a pixel lies on an edge
_MATCH_RATIO = 0.8  # largest ratio of the distances to the best and to the second best descriptor of a match
_EPIPOLAR_PX = 3.0  # largest distance of a match from its epipolar line, pixels
# Numbers of keyframes by which those keyframes precede a keyframe with which it is matched.
_MATCHED_OFFSETS = (1, 2, 3, 5, 8)
_MIN_MATCHES = 12  # fewest matches of two keyframes, before and after outlier rejection


@dataclass(slots=True, kw_only=True, eq=False)
class Keyframe:
    """A frame of a drive with its *n* features and the depths at them.

    Attributes:
        row: Index of the frame among all frames of the drive.
        timestamp_s: Time stamp of the colour image, seconds.
        camera: Stated intrinsics of the colour image.
        pixels: ``(n, 2)``, undistorted pixels of the features.
        sizes: ``(n,)``, scales of the features, 1 for the finest.
        descriptors: ORB descriptors of the features, one row each.
        depths_m: ``(4, n)``, depths at the features for each of `FLIPS`, metres; NaN without a valid depth
            or on an edge.  A stereo pair has depths in the first row only.
        noise: Noise model of ``depths_m``.
        twist_s: ``(6,)``, translation (m) and rotation (rad) per second of the twist that multiplies
            ``T_camera_world`` on the left; 0 where it is not known.
        T_world_camera: The tracked pose ``(4, 4)``; None if tracking was lost.
        around: Depths at other times: pairs of a time, seconds after this frame (negative: before), and the
            depths ``(n,)`` at the features of this frame in the depth image of that time, metres.
    """

    row: int
    timestamp_s: float
    camera: Camera
    pixels: Array
    sizes: Array
    descriptors: npt.NDArray[np.uint8]
    depths_m: Array
    noise: DepthNoise
    twist_s: Array
    T_world_camera: Array | None
    around: list[tuple[float, Array]] = field(default_factory=list)


class KeyframeStore:
    """Select up to 56 keyframes, spread over a drive, from its frames in the order of time."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.frames = 0
        self.has_depth = False
        self.has_stereo = False
        self._last: tuple[float, Array] | None = None
        self._twist_s: Array = np.zeros(6)
        self._depths: deque[tuple[float, npt.NDArray[np.float32]]] = deque()
        self._tried_s = -np.inf
        self._moved_share = _MIN_MOVED_SHARE

    def add(self, frame: Frame, T_world_camera: Array | None, found: Features | None = None) -> None:
        """Add the next frame, and make it a keyframe if its features moved far enough since the last one.

        Args:
            frame: The frame.
            T_world_camera: Its tracked pose; None if tracking was lost.
            found: The features of the tracker.  If they are None, not ORB, or without sizes or orientations,
                ORB features are extracted here.
        """
        self._update_twist(frame.timestamp_s, T_world_camera)
        self._sample_depths(frame)
        self.frames += 1
        if 0.0 <= frame.timestamp_s - self._tried_s < _CANDIDATE_INTERVAL_S:
            return
        self._tried_s = frame.timestamp_s
        described = _described(frame, found)
        if len(described.pixels) < _MIN_FEATURES or not self._is_new(described, frame.camera.width):
            return
        self.keyframes.append(self._make_keyframe(frame, described, T_world_camera))
        if len(self.keyframes) > _MAX_KEYFRAMES:
            del self.keyframes[1::2]
            self._moved_share *= 1.6

    def _update_twist(self, stamp_s: float, T_world_camera: Array | None) -> None:
        """Compute the twist of the camera from the last frame to this frame; 0 if one of them has no pose.

        If the last frame is a keyframe, its twist becomes the mean of the twists before and after it.
        """
        last, self._last = self._last, None if T_world_camera is None else (stamp_s, T_world_camera)
        before, self._twist_s = self._twist_s, np.zeros(6)
        if last is None or T_world_camera is None or not 0.0 < stamp_s - last[0] < _DEPTH_WINDOW_S:
            return
        twist = log_se3((inverse(T_world_camera) @ last[1])[None])[0] / (stamp_s - last[0])
        if np.linalg.norm(twist[3:]) < _MAX_RATE_RAD_S:
            self._twist_s = twist
        if self.keyframes and self.keyframes[-1].timestamp_s == last[0] and before.any():
            self.keyframes[-1].twist_s = 0.5 * (before + self._twist_s)

    def _sample_depths(self, frame: Frame) -> None:
        """Sample the new depth image at the features of recent keyframes, and keep it for later keyframes."""
        if frame.stereo is not None or not _has_depth(frame):
            return
        for keyframe in self.keyframes[-8:]:
            apart_s = frame.timestamp_s - keyframe.timestamp_s
            if 0.0 < apart_s <= _DEPTH_WINDOW_S:
                keyframe.around.append((apart_s, depths_at(frame.depth_m, keyframe.pixels)))
        self._depths.append((frame.timestamp_s, frame.depth_m))
        while frame.timestamp_s - self._depths[0][0] > _DEPTH_WINDOW_S:
            self._depths.popleft()

    def _is_new(self, described: DescribedKeypoints | Features, width: int) -> bool:
        if not self.keyframes:
            return True
        last = self.keyframes[-1]
        one, other = match_all(last.descriptors, described.descriptors, ratio=_MATCH_RATIO)
        if len(one) < _MIN_FEATURES:
            return True
        moved = np.linalg.norm(last.pixels[one] - described.pixels[other], axis=1)
        return float(np.median(moved)) > self._moved_share * width

    def _make_keyframe(
        self, frame: Frame, described: DescribedKeypoints | Features, T_world_camera: Array | None
    ) -> Keyframe:
        pixels = described.pixels
        keyframe = Keyframe(
            row=self.frames - 1, timestamp_s=frame.timestamp_s, camera=frame.camera, pixels=pixels,
            sizes=described.sizes, descriptors=np.asarray(described.descriptors, dtype=np.uint8),
            depths_m=np.full((len(FLIPS), len(pixels)), np.nan), T_world_camera=T_world_camera,
            noise=frame.depth_noise, twist_s=self._twist_s,
        )  # fmt: skip
        if frame.stereo is not None:
            self.has_stereo = True
            points = (
                described.points_camera
                if isinstance(described, Features) and np.isfinite(described.points_camera).any()
                else stereo_points(frame.rgb, frame.stereo, frame.camera, pixels)
            )
            keyframe.depths_m[0] = points[:, 2]
        elif _has_depth(frame):
            self.has_depth = True
            flipped = (
                frame.depth_m, frame.depth_m[:, ::-1], frame.depth_m[::-1], frame.depth_m[::-1, ::-1]
            )  # fmt: skip
            for row, depth_m in enumerate(flipped):
                keyframe.depths_m[row] = depths_at(depth_m, pixels)
            keyframe.around = [
                (stamp_s - frame.timestamp_s, depths_at(depth_m, pixels)) for stamp_s, depth_m in self._depths
            ]
        return keyframe


def _described(frame: Frame, found: Features | None) -> DescribedKeypoints | Features:
    """Return the ORB features *found* by the tracker, at most 1200, or up to 500 extracted from the image."""
    if found is None or found.kind != ORB or not (found.is_oriented and found.is_scaled):
        return describe(frame.rgb, _EXTRACTED_FEATURES)
    if len(found.pixels) <= _MAX_FEATURES:
        return found
    # Keep the features of the finest scales, since the next image keeps the same ones, and they match.
    rows = np.sort(np.argsort(found.sizes, kind="stable")[:_MAX_FEATURES])
    return replace(
        found, pixels=found.pixels[rows], descriptors=found.descriptors[rows],
        orientations=found.orientations[rows],
        sizes=found.sizes[rows], points_camera=found.points_camera[rows],
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Observations of landmarks by keyframes.

    Observation *i* is the feature ``features[i]`` of the keyframe ``keyframes[i]``, which shows the landmark
    ``landmarks[i]``; the three arrays ``(n,)`` are indices, sorted by keyframe.  ``count`` is the number of
    landmarks.
    """

    keyframes: Rows
    features: Rows
    landmarks: Rows
    count: int


def tracks_of(keyframes: list[Keyframe], most: int = 3000) -> Tracks:
    """Match each keyframe with up to five earlier keyframes; return the tracks that span most keyframes.

    Each track is one landmark, seen by two keyframes or more; at most *most* tracks are returned.
    """
    numbers: list[Rows] = []
    count = 0
    for row, keyframe in enumerate(keyframes):
        own = np.full(len(keyframe.pixels), -1)
        for back in _MATCHED_OFFSETS:
            if row - back < 0:
                continue
            before = keyframes[row - back]
            one, other = matched(before, keyframe)
            known = numbers[row - back][one]
            is_free = (own[other] < 0) & ~np.isin(known, own[own >= 0])
            own[other[is_free]] = known[is_free]
        fresh = np.flatnonzero(own < 0)
        own[fresh] = count + np.arange(len(fresh))
        count += len(fresh)
        numbers.append(own)
    rows = np.concatenate([np.full(len(own), row) for row, own in enumerate(numbers)])
    features = np.concatenate([np.arange(len(own)) for own in numbers])
    landmarks = np.concatenate(numbers)
    lengths = np.bincount(landmarks, minlength=count)
    kept = np.argsort(-lengths, kind="stable")[:most]
    kept = kept[lengths[kept] >= 2]
    renumbered = np.full(count, -1)
    renumbered[kept] = np.arange(len(kept))
    chosen = np.flatnonzero(renumbered[landmarks] >= 0)
    return Tracks(
        keyframes=rows[chosen], features=features[chosen], landmarks=renumbered[landmarks[chosen]],
        count=len(kept),
    )  # fmt: skip


def matched(one: Keyframe, other: Keyframe) -> tuple[Rows, Rows]:
    """Match the features of two keyframes, and reject outliers with a fundamental matrix (RANSAC).

    Returns the indices of the matched features ``(m,)`` in *one* and in *other*; both are empty with fewer
    than 12 matches.
    """
    a, b = match_all(one.descriptors, other.descriptors, ratio=_MATCH_RATIO)
    if len(a) < _MIN_MATCHES:
        return a[:0], b[:0]
    cv2 = load_opencv()
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(one.pixels[a], other.pixels[b], cv2.FM_RANSAC, _EPIPOLAR_PX, 0.99, 300)
    if mask is None or int(mask.sum()) < _MIN_MATCHES:
        return a[:0], b[:0]
    kept = np.flatnonzero(mask.ravel())
    return a[kept], b[kept]


def _has_depth(frame: Frame) -> bool:
    """Return whether the depth image of *frame* has a depth; a sample of its pixels is tried first."""
    return bool(frame.depth_m[::16, ::16].any() or frame.depth_m.any())


def depths_at(depth_m: npt.NDArray[np.float32], pixels: Array) -> Array:
    """Return the median depth ``(n,)``, metres, of each pixel and four pixels at a distance of 2 px.

    NaN if one of the five depths is missing, or if they differ by more than 5 % of their median, as on an
    edge.

    Args:
        depth_m: ``(h, w)``, depths in metres, 0 where there is none.
        pixels: ``(n, 2)``; pixels at the border are moved inwards.
    """
    pixels, depths_m = aligned(pixels, np.float64), np.full(len(pixels), np.nan)
    depth_m = np.asarray(depth_m, dtype=np.float32)
    strides = (stride // depth_m.itemsize for stride in depth_m.strides)
    _core_depths_at()(
        address_of(depth_m), *depth_m.shape, *strides, address_of(pixels), len(pixels), _MAX_DEPTH_SPREAD,
        address_of(depths_m),
    )  # fmt: skip
    return depths_m


@cache
def _core_depths_at() -> Any:
    pointer, size = ctypes.c_void_p, ctypes.c_int64
    arguments = (pointer, *[size] * 4, pointer, size, ctypes.c_double, pointer)
    return core_function("check", "rse_pf_depths_at", arguments, ctypes.c_int32)
