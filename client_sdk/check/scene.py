"""Find static patterns, moving objects and depth along the ray, which spoil a drive whose images are good.

While the tracked camera moves, the whole image must change.  Blocks of the image that are unchanged a second
later belong to the pattern of a projector or to an overlay; or the camera is stationary, and its tracked pose
follows something large that moves in the view.
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

_MIN_SAMPLE_INTERVAL_S = 0.38
"""Shortest time, seconds, between two samples of a drive.  A sample is two frames in succession, since a
projector may be on in every second frame only."""
_MIN_COMPARED_INTERVAL_S = 1.0  # shortest time, seconds, between two images that are compared
_COMPARED_ROWS = 60  # number of image rows whose pixels are compared between two images
_BLOCK_ROWS = 6  # number of blocks into which an image is divided from top to bottom
_BLOCK_COLUMNS = 8  # number of blocks into which an image is divided from left to right
_MAX_BORDER_LEVEL = 8  # pixels up to this grey level of 255 count as the black border of an undistorted image
# Smallest mean square of the second differences of a block with texture; the noise of a sensor has less.
_MIN_TEXTURE = 150.0
_MIN_TEXTURED_BLOCKS = 6  # fewest blocks with texture with which two images are compared
# Smallest motion of the image, pixels, that the poses of two compared images predict.
_MIN_MOVED_PX = 10.0
# Smallest correlation of a block of two images that counts as unchanged; blocks that moved have less than
# 0.1.
_MIN_CORRELATION = 0.6
_MIN_IMAGES = 3  # fewest images with a static pattern or with moving objects that are reported
_MIN_WHOLE_SHARE = 0.7  # smallest share of unchanged blocks at which a static pattern covers the whole image
# Smallest share of unchanged blocks at which a part of the image is static; good drives have up to 0.03.
_MIN_PART_SHARE = 0.1
# Smallest share of the images that a static pattern covers wholly from which the pattern is reported.
_MIN_PATTERN_IMAGE_SHARE = 0.2
# Smallest share of the images with a static part from which moving objects are reported.
_MIN_STATIC_IMAGE_SHARE = 0.5
_MIN_OVERLAY_IMAGE_SHARE = 0.8  # share of the images in which a block of an overlay must be unchanged
# Largest natural logarithm of the ratio of two depths of one point; a larger ratio shows another surface.
_MAX_LOG_DEPTH_RATIO = 0.2
# Smallest slope of log depth over log ray length at which depth is measured along the ray: such depth has the
# slope 1, depth along the optical axis at most 0.15.
_MIN_RAY_SLOPE = 0.4
_MAX_RAY_SLOPE_DEVIATION = 0.1  # largest standard deviation of that slope with which a drive is classified


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """A sampled image of a drive, divided into 48 blocks.

    ``edges`` ``(48, n)`` are the second differences of grey levels along image rows in each block,
    ``texture`` ``(48,)`` their mean squares, and ``T_world_camera`` ``(4, 4)`` is the tracked pose, metres.
    """

    stamp_s: float
    edges: npt.NDArray[np.float32]
    texture: npt.NDArray[np.float32]
    T_world_camera: Array


class SceneWatch:
    """Find blocks of the image that are unchanged while the camera moves, from the frames in order."""

    def __init__(self) -> None:
        self._views: deque[_View] = deque()
        self._T_world_camera: Array | None = None
        self._began_s = -np.inf
        self._is_second = False
        self._textured: list[npt.NDArray[np.bool_]] = []
        self._still: list[npt.NDArray[np.bool_]] = []

    def add(self, frame: Frame, tracked: TrackedFrame) -> None:
        """Add the next frame; a frame without a pose counts as taken from the last known pose."""
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
        while len(self._views) > 2 and view.stamp_s - self._views[2].stamp_s >= _MIN_COMPARED_INTERVAL_S:
            self._views.popleft()
        before = [each for each in self._views if view.stamp_s - each.stamp_s >= _MIN_COMPARED_INTERVAL_S]
        depth_m = _median_depth(tracked) if before else math.inf
        moved = [each for each in before if _moved_px(each, view, frame.camera, depth_m) >= _MIN_MOVED_PX]
        if moved:
            self._compare(moved, view)
        self._views.append(view)

    def _is_due(self, stamp_s: float) -> bool:
        is_first = stamp_s - self._began_s >= _MIN_SAMPLE_INTERVAL_S
        is_due, self._is_second = is_first or self._is_second, is_first
        if is_first:
            self._began_s = stamp_s
        return is_due

    def _compare(self, before: Sequence[_View], view: _View) -> None:
        textured, still = [], []
        for each in before:
            has_texture = np.minimum(each.texture, view.texture) > _MIN_TEXTURE
            likeness = (each.edges * view.edges).mean(axis=1)
            textured.append(has_texture)
            still.append(has_texture & (likeness > _MIN_CORRELATION * np.sqrt(each.texture * view.texture)))
        row = int(np.argmax([each.sum() for each in still]))
        if textured[row].sum() >= _MIN_TEXTURED_BLOCKS:
            self._textured.append(textured[row])
            self._still.append(still[row])

    def doubts(self) -> tuple[Doubt, ...]:
        """Return a doubt about a static pattern or about moving objects; empty if there is neither."""
        if len(self._still) < _MIN_IMAGES:
            return ()
        textured, still = np.array(self._textured), np.array(self._still)
        shares = still.sum(axis=1) / textured.sum(axis=1)
        is_whole, is_part = shares >= _MIN_WHOLE_SHARE, shares >= _MIN_PART_SHARE
        always = still.sum(axis=0) > _MIN_OVERLAY_IMAGE_SHARE * np.maximum(_MIN_IMAGES, textured.sum(axis=0))
        percent = f"{100 * np.median(shares[is_part]) if is_part.any() else 0:.0f} % of the image"
        seen = f"in {np.count_nonzero(is_part)} of {len(shares)} images"
        if (
            is_whole.sum() >= max(_MIN_IMAGES, _MIN_PATTERN_IMAGE_SHARE * len(shares))
            or always.mean() >= _MIN_PART_SHARE
        ):
            sentence = (
                f"{percent} is unchanged a second later {seen}, though the pose moves: a pattern lies over it"
            )
            hint = "switch the projector off, or keep overlays and parts of the robot out of the image"
            return (Doubt(name=DoubtName.STATIC_PATTERN, sentence=sentence, hint=hint),)
        if is_part.sum() >= max(_MIN_IMAGES, _MIN_STATIC_IMAGE_SHARE * len(shares)):
            sentence = (
                f"{percent} is stationary {seen}, though the pose moves: something large moves in the view"
            )
            hint = "keep people and things that move out of most of the view"
            return (Doubt(name=DoubtName.MOVING_OBJECTS, sentence=sentence, hint=hint),)
        return ()


def _edges(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32] | None:
    """Return second differences ``(48, n)`` along 60 rows of an image, for each of its 48 blocks.

    None if the image has fewer than 60 rows or 64 columns.  Differences at dark pixels are 0.
    """
    height, width = rgb.shape[:2]
    if height < _COMPARED_ROWS or width < 8 * _BLOCK_COLUMNS:
        return None
    lines = rgb[:: height // _COMPARED_ROWS, :, 1][:_COMPARED_ROWS].astype(np.int16)
    lines = lines[:, : (width - 4) // _BLOCK_COLUMNS * _BLOCK_COLUMNS + 4]
    left, middle, right = lines[:, :-4], lines[:, 2:-2], lines[:, 4:]
    is_seen = np.minimum(np.minimum(left, middle), right) > _MAX_BORDER_LEVEL
    edges = np.where(is_seen, 2 * middle - left - right, 0).astype(np.float32)
    blocks = edges.reshape(_BLOCK_ROWS, _COMPARED_ROWS // _BLOCK_ROWS, _BLOCK_COLUMNS, -1).transpose(
        0, 2, 1, 3
    )
    return np.ascontiguousarray(blocks).reshape(_BLOCK_ROWS * _BLOCK_COLUMNS, -1)


def _median_depth(tracked: TrackedFrame) -> float:
    """Return the median depth of a frame's features, metres; infinity if no feature has a depth."""
    points = None if tracked.features is None else tracked.features.points_camera[:, 2]
    depths_m = np.empty(0) if points is None else points[points > 0.0]
    return float(np.median(depths_m)) if len(depths_m) else math.inf


def _moved_px(before: _View, view: _View, camera: Camera, depth_m: float) -> float:
    """Return about how far a point at *depth_m* moves in the image between the poses of two views, px."""
    moved_m, turned_deg = pose_difference(before.T_world_camera, view.T_world_camera)
    return camera.fx * (moved_m / depth_m + float(np.radians(turned_deg)))


def doubts_of_depth(keyframes: Sequence[Keyframe]) -> tuple[Doubt, ...]:
    """Return a doubt if the depth of a drive is measured along the ray, as some simulators write it.

    Such a depth is too large by the length of the vector ``(x, y, 1)`` to its pixel.  Depths of one point
    from two keyframes then differ by the ratio of these lengths: in logarithms, the depths have the slope 1
    over the lengths; correct depths have the slope 0.  Flipped depth images may have any slope, so there is
    no doubt if another flip agrees better.
    """
    ratios = _all_ratios(keyframes, 0)
    if ratios is None:
        return ()
    rays, depths = ratios
    slope, weights = 0.0, np.ones(len(rays))
    for _ in range(8):  # iterations of least squares, reweighted by a Cauchy loss
        slope = float((weights * rays * depths).sum() / max(1e-9, (weights * rays * rays).sum()))
        errors = depths - slope * rays
        spread = 1.4826 * float(np.median(np.abs(errors))) + 1e-6
        weights = 1.0 / (1.0 + np.square(errors / (2.0 * spread)))
    deviation = spread / max(1e-9, float(np.sqrt((weights * rays * rays).sum())))
    if deviation > _MAX_RAY_SLOPE_DEVIATION or slope < _MIN_RAY_SLOPE:
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
    """Return the `_ratios` of all successive keyframes together, with depth images flipped as `FLIPS[flip]`.

    None if no two successive keyframes have enough depths in common.
    """
    pairs = [_ratios(one, other, flip) for one, other in itertools.pairwise(keyframes)]
    known = [pair for pair in pairs if pair is not None]
    if not known:
        return None
    rays, depths = (np.concatenate(each) for each in zip(*known, strict=True))
    return rays, depths


def _ratios(before: Keyframe, keyframe: Keyframe, flip: int) -> tuple[Array, Array] | None:
    """Return ratios of ray lengths and of depths for points seen by two keyframes, as natural logarithms.

    Both results have the shape ``(n,)``.  The ratio of ray lengths is the length of the ray to the point in
    *keyframe* over that in *before*.  The ratio of depths is the depth in *keyframe* over the depth expected
    from *before*; the median of its logarithm is subtracted.  None without two poses or with
    fewer than 12 points.
    """
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
    is_same = np.abs(depths) < _MAX_LOG_DEPTH_RATIO
    if np.count_nonzero(is_same) < 12:
        return None
    return rays[is_same], depths[is_same] - float(np.median(depths[is_same]))


def _log_rays(keyframe: Keyframe, rows: npt.NDArray[np.int64]) -> Array:
    """Return the logarithms ``(n,)`` of the lengths of the rays ``(x, y, 1)`` to the features *rows*."""
    rays = keyframe.camera.back_project(keyframe.pixels[rows], np.ones(len(rows)))
    lengths: Array = np.log(np.linalg.norm(rays, axis=1))
    return lengths
