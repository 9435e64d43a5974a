"""Keep of a drive what its calibration can be judged by: features of some frames, and depths around them.

Nothing is chosen by the calibration that is judged: frames by how far their features move in the image, and
matches by an epipolar line, for which no calibration is needed.
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
"""How the depth image may lie on the colour image."""
_FEATURES, _MOST_FEATURES = 500, 1200
_CANDIDATE_S = 0.19
_MOVED_SHARE = 0.025
"""Of the width of the image; a frame whose features moved less adds nothing."""
_FEW = 60
_MOST = 56
_MOST_RAD_S = 3.0
_AROUND_S = 0.42
_SPREAD = 0.05
_RATIO, _EPIPOLAR_PX = 0.8, 3.0
_BACK = (1, 2, 3, 5, 8)
_LEAST_MATCHES = 12


@dataclass(slots=True, kw_only=True, eq=False)
class Keyframe:
    """One frame of a drive.

    ``row`` counts frames; ``depths_m`` ``(4, n)`` at the features in each of `FLIPS`, NaN where there is none
    or an edge, and ``noise`` is that of depth.  ``T_world_camera`` is the pose that was tracked, None where
    it was lost, and ``twist_s`` ``(6,)`` how its inverse changes in a second, a twist on the left.
    ``around`` holds ``(seconds later, (n,) depths at the features)`` of frames near in time.
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
    """Take the frames of a drive in order, and keep up to 56 of them, spread over it."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.frames = 0
        self.has_depth = False
        self.has_stereo = False
        self._last: tuple[float, Array] | None = None
        self._twist_s: Array = np.zeros(6)
        self._depths: deque[tuple[float, npt.NDArray[np.float32]]] = deque()
        self._tried_s = -np.inf
        self._moved_share = _MOVED_SHARE

    def add(self, frame: Frame, T_world_camera: Array | None, found: Features | None = None) -> None:
        """Look at one frame, at the pose that was tracked for it, and at the features that were found.

        ORB features are found here where *found* is None or of another kind, such as vectors without sizes.
        """
        self._move(frame.timestamp_s, T_world_camera)
        self._surround(frame)
        self.frames += 1
        if 0.0 <= frame.timestamp_s - self._tried_s < _CANDIDATE_S:
            return
        self._tried_s = frame.timestamp_s
        described = _described(frame, found)
        if len(described.pixels) < _FEW or not self._is_new(described, frame.camera.width):
            return
        self.keyframes.append(self._made(frame, described, T_world_camera))
        if len(self.keyframes) > _MOST:
            del self.keyframes[1::2]
            self._moved_share *= 1.6

    def _move(self, stamp_s: float, T_world_camera: Array | None) -> None:
        """Take how fast the camera moves from its last pose to this one; the last keyframe gets the mean."""
        last, self._last = self._last, None if T_world_camera is None else (stamp_s, T_world_camera)
        before, self._twist_s = self._twist_s, np.zeros(6)
        if last is None or T_world_camera is None or not 0.0 < stamp_s - last[0] < _AROUND_S:
            return
        twist = log_se3((inverse(T_world_camera) @ last[1])[None])[0] / (stamp_s - last[0])
        if np.linalg.norm(twist[3:]) < _MOST_RAD_S:
            self._twist_s = twist
        if self.keyframes and self.keyframes[-1].timestamp_s == last[0] and before.any():
            self.keyframes[-1].twist_s = 0.5 * (before + self._twist_s)

    def _surround(self, frame: Frame) -> None:
        """Sample the new depth image at the features of the last keyframes, and keep it for those to come."""
        if frame.stereo is not None or not _has_depth(frame):
            return
        for keyframe in self.keyframes[-8:]:
            apart_s = frame.timestamp_s - keyframe.timestamp_s
            if 0.0 < apart_s <= _AROUND_S:
                keyframe.around.append((apart_s, depths_at(frame.depth_m, keyframe.pixels)))
        self._depths.append((frame.timestamp_s, frame.depth_m))
        while frame.timestamp_s - self._depths[0][0] > _AROUND_S:
            self._depths.popleft()

    def _is_new(self, described: DescribedKeypoints | Features, width: int) -> bool:
        if not self.keyframes:
            return True
        last = self.keyframes[-1]
        one, other = match_all(last.descriptors, described.descriptors, ratio=_RATIO)
        if len(one) < _FEW:
            return True
        moved = np.linalg.norm(last.pixels[one] - described.pixels[other], axis=1)
        return float(np.median(moved)) > self._moved_share * width

    def _made(
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
    """Return the ORB features of a frame: those that were found, the finest where they are many."""
    if found is None or found.kind != ORB or not (found.is_oriented and found.is_scaled):
        return describe(frame.rgb, _FEATURES)
    if len(found.pixels) <= _MOST_FEATURES:
        return found
    # The finest: they are the same ones in the next image, which each second one would not be.
    rows = np.sort(np.argsort(found.sizes, kind="stable")[:_MOST_FEATURES])
    return replace(
        found, pixels=found.pixels[rows], descriptors=found.descriptors[rows],
        orientations=found.orientations[rows],
        sizes=found.sizes[rows], points_camera=found.points_camera[rows],
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Which features of which keyframes show one landmark: ``(n,)`` each, and how many landmarks."""

    keyframes: Rows
    features: Rows
    landmarks: Rows
    count: int


def tracks_of(keyframes: list[Keyframe], most: int = 3000) -> Tracks:
    """Match keyframes with some before them, and return the longest tracks."""
    numbers: list[Rows] = []
    count = 0
    for row, keyframe in enumerate(keyframes):
        own = np.full(len(keyframe.pixels), -1)
        for back in _BACK:
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
    """Return rows of features of two keyframes that look alike and lie on one epipolar geometry."""
    a, b = match_all(one.descriptors, other.descriptors, ratio=_RATIO)
    if len(a) < _LEAST_MATCHES:
        return a[:0], b[:0]
    cv2 = load_opencv()
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(one.pixels[a], other.pixels[b], cv2.FM_RANSAC, _EPIPOLAR_PX, 0.99, 300)
    if mask is None or int(mask.sum()) < _LEAST_MATCHES:
        return a[:0], b[:0]
    kept = np.flatnonzero(mask.ravel())
    return a[kept], b[kept]


def _has_depth(frame: Frame) -> bool:
    """Return whether a depth image has readings; a few pixels of it say so nearly always."""
    return bool(frame.depth_m[::16, ::16].any() or frame.depth_m.any())


def depths_at(depth_m: npt.NDArray[np.float32], pixels: Array) -> Array:
    """Return ``(n,)`` medians of five depths around each pixel; NaN where one is missing, or on an edge."""
    pixels, depths_m = aligned(pixels, np.float64), np.full(len(pixels), np.nan)
    depth_m = np.asarray(depth_m, dtype=np.float32)
    strides = (stride // depth_m.itemsize for stride in depth_m.strides)
    _core_depths_at()(
        address_of(depth_m), *depth_m.shape, *strides, address_of(pixels), len(pixels), _SPREAD,
        address_of(depths_m),
    )  # fmt: skip
    return depths_m


@cache
def _core_depths_at() -> Any:
    pointer, size = ctypes.c_void_p, ctypes.c_int64
    arguments = (pointer, *[size] * 4, pointer, size, ctypes.c_double, pointer)
    return core_function("check", "rse_pf_depths_at", arguments, ctypes.c_int32)
