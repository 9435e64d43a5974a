"""Find what makes a drive unusable though each image is good: patterns that stand still, and moving objects.

Where the tracked camera moves, the whole image must change.  Blocks of the image that look the same a second
later belong to a projector, to an overlay, or to a world that stands still while something large moves before
a camera at rest.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.check.keyframes import FLIPS, Keyframe, matched
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.source_facts import Doubt, DoubtName
from rse_pf.geometry import Array, Camera, inverse, pose_difference, transform

__all__ = ["SceneWatch", "doubts_of_depth"]

_EVERY_S = 0.38  # two frames in succession are looked at, since a projector may be on in each second one
_APART_S = 1.0  # between two images that are compared
_LINES = 60  # image rows that are compared
_ROWS = 6  # blocks of an image from top to bottom
_COLUMNS = 8  # blocks of an image from left to right
_DARK_LEVEL = 8  # darker pixels lie beyond the border of an undistorted image
_LEAST_TEXTURE = 150.0  # mean square of a block's second differences; the noise of a sensor has less
_FEWEST_BLOCKS = 6  # with texture
_MOVED_PX = 10.0  # the pose moves the image by as much
_SAME = 0.6  # correlation of a block that stands still; of one that moves it is below 0.1
_FEWEST_IMAGES = 3
_WHOLE = 0.7  # of the blocks stand still: a pattern lies over the whole image
_PART = 0.1  # of the blocks stand still: a part of the image; healthy drives have 0.03 at most
_OFTEN = 0.2  # share of the images that show a static pattern: more are a finding
_MOSTLY = 0.5  # share of the images in which a part is stationary: more are a finding
_ALWAYS = 0.8  # share of the images in which a block of an overlay is stationary
_MAX_RATIO = 0.2  # of depths, as a logarithm: readings that differ by more show another surface
_RAY_SLOPE = 0.4  # depth along the ray has 1, depth along the axis 0; healthy drives have 0.15 at most
_RAY_DEVIATION = 0.1  # a drive that tells the slope less exactly tells nothing


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """``edges`` ``(48, n)`` are second differences along rows of each block, ``texture`` mean squares."""

    stamp_s: float
    edges: npt.NDArray[np.float32]
    texture: npt.NDArray[np.float32]
    T_world_camera: Array


class SceneWatch:
    """Take all frames of a drive, and keep which blocks of the image stand still while the camera moves."""

    def __init__(self) -> None:
        self._views: deque[_View] = deque()
        self._T_world_camera: Array | None = None
        self._began_s = -np.inf
        self._is_second = False
        self._textured: list[npt.NDArray[np.bool_]] = []
        self._still: list[npt.NDArray[np.bool_]] = []

    def add(self, frame: Frame, tracked: TrackedFrame) -> None:
        """Look at the next frame; one without a pose is taken to be where the last one was."""
        if tracked.T_world_camera is not None:
            self._T_world_camera = tracked.T_world_camera
        if self._T_world_camera is None or not self._is_due(frame.timestamp_s):
            return
        edges = _edges(frame.rgb)
        if edges is None:
            return
        view = _View(
            stamp_s=frame.timestamp_s, edges=edges, texture=np.square(edges).mean(axis=1),
            T_world_camera=self._T_world_camera,
        )  # fmt: skip
        while len(self._views) > 2 and view.stamp_s - self._views[2].stamp_s >= _APART_S:
            self._views.popleft()
        before = [each for each in self._views if view.stamp_s - each.stamp_s >= _APART_S]
        depth_m = _median_depth(tracked) if before else math.inf
        moved = [each for each in before if _moved_px(each, view, frame.camera, depth_m) >= _MOVED_PX]
        if moved:
            self._compare(moved, view)
        self._views.append(view)

    def _is_due(self, stamp_s: float) -> bool:
        is_first = stamp_s - self._began_s >= _EVERY_S
        is_due, self._is_second = is_first or self._is_second, is_first
        if is_first:
            self._began_s = stamp_s
        return is_due

    def _compare(self, before: Sequence[_View], view: _View) -> None:
        textured, still = [], []
        for each in before:
            has_texture = np.minimum(each.texture, view.texture) > _LEAST_TEXTURE
            likeness = (each.edges * view.edges).mean(axis=1)
            textured.append(has_texture)
            still.append(has_texture & (likeness > _SAME * np.sqrt(each.texture * view.texture)))
        row = int(np.argmax([each.sum() for each in still]))
        if textured[row].sum() >= _FEWEST_BLOCKS:
            self._textured.append(textured[row])
            self._still.append(still[row])

    def doubts(self) -> tuple[Doubt, ...]:
        """Return what stands still in the image while the camera moves."""
        if len(self._still) < _FEWEST_IMAGES:
            return ()
        textured, still = np.array(self._textured), np.array(self._still)
        shares = still.sum(axis=1) / textured.sum(axis=1)
        is_whole, is_part = shares >= _WHOLE, shares >= _PART
        always = still.sum(axis=0) > _ALWAYS * np.maximum(_FEWEST_IMAGES, textured.sum(axis=0))
        percent = f"{100 * np.median(shares[is_part]) if is_part.any() else 0:.0f} % of the image"
        seen = f"in {np.count_nonzero(is_part)} of {len(shares)} images"
        if is_whole.sum() >= max(_FEWEST_IMAGES, _OFTEN * len(shares)) or always.mean() >= _PART:
            sentence = (
                f"{percent} looks the same a second later {seen}, though the pose moves: "
                "a pattern lies over it"
            )
            hint = "switch the projector off, or keep overlays and parts of the robot out of the image"
            return (Doubt(name=DoubtName.STATIC_PATTERN, sentence=sentence, hint=hint),)
        if is_part.sum() >= max(_FEWEST_IMAGES, _MOSTLY * len(shares)):
            sentence = (
                f"{percent} stands still {seen}, though the pose moves: something large moves in the view"
            )
            hint = "keep people and things that move out of most of the view"
            return (Doubt(name=DoubtName.MOVING_OBJECTS, sentence=sentence, hint=hint),)
        return ()


def _edges(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32] | None:
    """Return ``(48, n)`` second differences along some rows of an image; None if it is too small."""
    height, width = rgb.shape[:2]
    if height < _LINES or width < 8 * _COLUMNS:
        return None
    lines = rgb[:: height // _LINES, :, 1][:_LINES].astype(np.int16)
    lines = lines[:, : (width - 4) // _COLUMNS * _COLUMNS + 4]
    left, middle, right = lines[:, :-4], lines[:, 2:-2], lines[:, 4:]
    is_seen = np.minimum(np.minimum(left, middle), right) > _DARK_LEVEL
    edges = np.where(is_seen, 2 * middle - left - right, 0).astype(np.float32)
    blocks = edges.reshape(_ROWS, _LINES // _ROWS, _COLUMNS, -1).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(blocks).reshape(_ROWS * _COLUMNS, -1)


def _median_depth(tracked: TrackedFrame) -> float:
    """Return the median depth of a frame's features, infinity where none has a depth."""
    points = None if tracked.features is None else tracked.features.points_camera[:, 2]
    depths_m = np.empty(0) if points is None else points[points > 0.0]
    return float(np.median(depths_m)) if len(depths_m) else math.inf


def _moved_px(before: _View, view: _View, camera: Camera, depth_m: float) -> float:
    """Return by how much the pose moves the image between two views, at a depth."""
    moved_m, turned_deg = pose_difference(before.T_world_camera, view.T_world_camera)
    return camera.fx * (moved_m / depth_m + float(np.radians(turned_deg)))


def doubts_of_depth(keyframes: Sequence[Keyframe]) -> tuple[Doubt, ...]:
    """Return a doubt if the depth of a drive is measured along the ray, as some simulators write it.

    Such depth is too long by the length of the ray to a pixel, at depth 1.  Readings of one point from two
    keyframes then differ by the ratio of both lengths; the slope of one logarithm over the other is 1.  Depth
    that is mirrored may have any slope; it agrees better where it is turned back.
    """
    ratios = _all_ratios(keyframes, 0)
    if ratios is None:
        return ()
    rays, depths = ratios
    slope, weights = 0.0, np.ones(len(rays))
    for _ in range(8):  # of least squares with the weights of a Cauchy loss
        slope = float((weights * rays * depths).sum() / max(1e-9, (weights * rays * rays).sum()))
        errors = depths - slope * rays
        spread = 1.4826 * float(np.median(np.abs(errors))) + 1e-6
        weights = 1.0 / (1.0 + np.square(errors / (2.0 * spread)))
    deviation = spread / max(1e-9, float(np.sqrt((weights * rays * rays).sum())))
    if deviation > _RAY_DEVIATION or slope < _RAY_SLOPE:
        return ()
    mirrored = [_all_ratios(keyframes, flip) for flip in range(1, len(FLIPS))]
    if any(1.4826 * float(np.median(np.abs(each[1]))) < spread for each in mirrored if each is not None):
        return ()
    sentence = (
        f"depth grows towards the corners of the image as if it were measured along the ray "
        f"({100 * slope:.0f} +- {100 * deviation:.0f} % of it), not along the optical axis"
    )
    hint = "divide each depth by the length of (x, y, 1), the ray of its pixel"
    return (Doubt(name=DoubtName.DEPTH_ALONG_RAY, sentence=sentence, hint=hint),)


def _all_ratios(keyframes: Sequence[Keyframe], flip: int) -> tuple[Array, Array] | None:
    """Return `_ratios` of all neighbours, with the depth images turned as in row *flip* of `FLIPS`."""
    pairs = [_ratios(one, other, flip) for one, other in itertools.pairwise(keyframes)]
    known = [pair for pair in pairs if pair is not None]
    if not known:
        return None
    rays, depths = (np.concatenate(each) for each in zip(*known, strict=True))
    return rays, depths


def _ratios(before: Keyframe, keyframe: Keyframe, flip: int) -> tuple[Array, Array] | None:
    """Return logarithms ``(n,)``: of the ratio of a point's rays, and of its depth over the expected one."""
    if before.T_world_camera is None or keyframe.T_world_camera is None:
        return None
    one, other = matched(before, keyframe)
    old_m, new_m = before.depths_m[flip][one], keyframe.depths_m[flip][other]
    is_known = np.isfinite(old_m) & np.isfinite(new_m)
    one, other, old_m, new_m = one[is_known], other[is_known], old_m[is_known], new_m[is_known]
    points = before.camera.back_project(before.pixels[one], old_m)
    points = transform(inverse(keyframe.T_world_camera) @ before.T_world_camera, points)
    depths = np.log(new_m / np.maximum(points[:, 2], 1e-3))
    rays = _log_rays(keyframe, other) - _log_rays(before, one)
    is_same = np.abs(depths) < _MAX_RATIO
    if np.count_nonzero(is_same) < 12:
        return None
    return rays[is_same], depths[is_same] - float(np.median(depths[is_same]))


def _log_rays(keyframe: Keyframe, rows: npt.NDArray[np.int64]) -> Array:
    """Return the logarithm of the length of the rays of some features, at depth 1."""
    rays = keyframe.camera.back_project(keyframe.pixels[rows], np.ones(len(rows)))
    lengths: Array = np.log(np.linalg.norm(rays, axis=1))
    return lengths
