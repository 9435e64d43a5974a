"""A segment of a camera without depth: its map, its frames, and where it lies in another segment."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from client_sdk.tracking.landmark_map import OUTLIER_SIGMAS, LandmarkMap, MonocularView
from client_sdk.tracking.landmark_matching import (
    MAX_JOIN_DIFFERENCE_DEG,
    NO_LANDMARK,
    PIXEL_SIGMA_PX,
    VERIFY_LOWE_RATIO,
    Matches,
)
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, inverse, pose_difference, rigid, scaled, transform
from rse_pf.slam.descriptors import match_all
from rse_pf.slam.tracking import Features, GuidedMatchLimits, Observations, fit_pose

__all__ = ["AdjustedKeyframe", "MonocularSegment", "PosedView", "Similarity", "measure_scale"]

Rows = npt.NDArray[np.int64]

_REFINE_RADIUS_PX = 5.0
"""Radius, in pixels, around landmarks projected by a fitted pose in which they are matched again, for a
second fit."""
_AGREEMENT_DEPTH_SHARE = 0.07
"""Two measurements of where one segment lies in another confirm each other only if the two points to which
they move the centre of the camera are at most this share of the median depth apart."""
_AGREEMENT_SCALE_RATIO = 1.1
"""Two measurements of where one segment lies in another confirm each other only if the ratio of their scales,
the larger over the smaller, is at most this."""
_MAX_SCALE_SPREAD = 0.15
"""Largest median deviation of the ratios of depths from their median, as a share of this median: where it is
larger, no scale between two segments is known, and they are not joined."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdjustedKeyframe:
    """A keyframe as the bundle adjustment has it now.

    Attributes:
        timestamp_s: Time of the frame, in seconds.
        T_world_camera: ``(4, 4)``, in the unit of the segment.
        features: Features of the image, ``n`` of them.
        depths: ``(n,)``, depth of each feature along the optical axis in the unit of the segment, NaN for
            features without a landmark.
    """

    timestamp_s: float
    T_world_camera: Array
    features: Features
    depths: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _RelativePose:
    """Pose of a frame relative to a keyframe, which it follows when the keyframe is adjusted."""

    timestamp_s: float
    keyframe: int
    T_keyframe_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedView:
    """An image with its verified pose.

    Attributes:
        view: The image.
        T_camera_world: ``(4, 4)``, in the frame and unit of its segment.
        landmarks: ``(n,)``, landmark of each feature, or NO_LANDMARK.
        matches: Number of matches by which the pose was found.
        is_weak: Whether the solver calls the pose weak; the image never becomes a keyframe then.
    """

    view: MonocularView
    T_camera_world: Array
    landmarks: Rows
    matches: int
    is_weak: bool

    @property
    def inliers(self) -> int:
        """The number of landmarks that agree with the pose."""
        return int((self.landmarks != NO_LANDMARK).sum())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Similarity:
    """A similarity transformation: where a segment lies in another one, for a join.

    For a loop closure, both are the same segment, and the transformation is that of its newer part, which has
    drifted, to its older part.  A point ``x`` of the segment lies at ``T (scale x)`` in the other one.

    Attributes:
        segment: Number of the other segment; that of the same segment for a loop closure.
        keyframe: Keyframe of the other segment that shows the same place.
        T: ``(4, 4)``, rigid motion into the other segment, after all lengths are multiplied by *scale*.
        scale: Factor of all lengths.
    """

    segment: int
    keyframe: int
    T: Array
    scale: float

    def moved(self, position: Array) -> Array:
        """Return where a ``(3,)`` position of the segment lies in the other one."""
        place: Array = transform(self.T, self.scale * position[None])[0]
        return place

    def inverted(self, segment: int, keyframe: int) -> Similarity:
        """Return the inverse similarity: where the other segment lies in this one.

        *segment* is the number of this segment, *keyframe* its keyframe that shows the same place.
        """
        return Similarity(
            segment=segment,
            keyframe=keyframe,
            T=scaled(inverse(self.T), 1.0 / self.scale),
            scale=1.0 / self.scale,
        )

    def agrees_with(self, other: Similarity, centre: Array, depth: float) -> bool:
        """Return whether two measurements of one similarity confirm each other.

        Args:
            other: The other measurement.
            centre: ``(3,)``, centre of the camera in this segment; both measurements move it to nearly the
                same point of the other segment.
            depth: Median depth of the place in the unit of the other segment; distances are compared with it.
        """
        first, second = self.moved(centre), other.moved(centre)
        _, apart_deg = pose_difference(self.T, other.T)
        scale_ratio = max(self.scale / other.scale, other.scale / self.scale)
        return (
            float(np.linalg.norm(first - second)) <= _AGREEMENT_DEPTH_SHARE * depth
            and apart_deg <= MAX_JOIN_DIFFERENCE_DEG
            and scale_ratio <= _AGREEMENT_SCALE_RATIO
        )


def measure_scale(
    here: PosedView, map_here: LandmarkMap, there: PosedView, map_there: LandmarkMap, min_landmarks: int
) -> float | None:
    """Return the factor that turns lengths of one map into lengths of another one.

    The factor is the median ratio of the depths of features that have a landmark in both maps.

    Args:
        here: An image with its pose in the first map.
        map_here: The first map.
        there: The same image with its pose in the other map.
        map_there: The other map.
        min_landmarks: Fewest such features; None is returned with fewer, and if their ratios differ too much.
    """
    both = np.flatnonzero((here.landmarks != NO_LANDMARK) & (there.landmarks != NO_LANDMARK))
    depths_here = transform(here.T_camera_world, map_here.points[here.landmarks[both]])[:, 2]
    depths_there = transform(there.T_camera_world, map_there.points[there.landmarks[both]])[:, 2]
    ratios = depths_there / depths_here
    if len(both) < min_landmarks:
        return None
    scale = float(np.median(ratios))
    return scale if np.median(np.abs(ratios - scale)) <= _MAX_SCALE_SPREAD * scale else None


@dataclass(slots=True, kw_only=True, eq=False)
class MonocularSegment:
    """One segment of a drive.

    Attributes:
        map: Keyframes and landmarks.
        length_factor: Factor by which the lengths around the newest frames were multiplied since the segment
            began: by changes of the unit, which concern all lengths, and by loop closures, which multiply
                older
            lengths by less.
        frames: Poses of all frames of the segment.
        reference: The reference keyframe, around which frames are tracked.
        reference_landmarks: Number of landmarks that it saw when it became the reference.
        is_metric: Whether the unit is a metre.
        origin: ``(3,)``, the position that a change of the unit leaves in its place.
    """

    map: LandmarkMap
    length_factor: float = 1.0
    frames: list[_RelativePose] = field(default_factory=list)
    reference: int = 0
    reference_landmarks: int = 0
    is_metric: bool = False
    origin: Array = field(default_factory=lambda: np.zeros(3))

    def set_reference(self, keyframe: int) -> None:
        """Match further frames with the landmarks of a keyframe and its neighbours."""
        self.reference = keyframe
        self.reference_landmarks = len(self.map.landmarks_of(keyframe))

    def add_frame(self, timestamp_s: float, T_camera_world: Array, keyframe: int) -> None:
        """Add a frame with its pose, which follows a keyframe."""
        relative = self.map.keyframes[keyframe].T_camera_world @ inverse(T_camera_world)
        self.frames.append(
            _RelativePose(timestamp_s=timestamp_s, keyframe=keyframe, T_keyframe_camera=relative)
        )

    def move(self, T_new_old: Array, scale: float) -> None:
        """Express map and frames in another world: multiply all lengths by *scale*, then apply
        *T_new_old*."""
        self.map.move(T_new_old, scale)
        self.length_factor *= scale
        self.frames = [
            replace(frame, T_keyframe_camera=scaled(frame.T_keyframe_camera, scale)) for frame in self.frames
        ]

    def append(self, newer: MonocularSegment) -> tuple[int, int]:
        """Add all of a segment that was moved into this one's frame and unit.

        Returned are the numbers that its first keyframe and its first landmark have here.
        """
        keyframe, landmark = self.map.append(newer.map)
        self.frames += [replace(frame, keyframe=frame.keyframe + keyframe) for frame in newer.frames]
        return keyframe, landmark

    def match(
        self, view: MonocularView, T_camera_world: Array, limits: GuidedMatchLimits, around: int | None = None
    ) -> Matches:
        """Match the landmarks around a keyframe with an image near the pixels at which a pose predicts them.

        Args:
            view: The image.
            T_camera_world: ``(4, 4)``, its predicted pose.
            limits: Conditions of a match.
            around: The keyframe; None for the reference keyframe.
        """
        numbers = self.map.local_landmarks(self.reference if around is None else around)
        return self.map.landmarks(numbers).match(
            T_camera_world, self.map.camera, view.features, limits, limits.radius_px
        )

    def match_last_frame(self, view: MonocularView, last: PosedView) -> Matches:
        """Match the landmarks of the last frame that still exist with an image by their descriptors alone."""
        rows = np.flatnonzero(last.landmarks != NO_LANDMARK)
        rows = rows[self.map.is_alive[last.landmarks[rows]]]
        seen_again, features = match_all(last.view.features.descriptors[rows], view.features.descriptors)
        return self.map.matched(last.landmarks[rows[seen_again]], features)

    def fit(
        self,
        view: MonocularView,
        T_camera_world: Array,
        radius_px: float,
        min_inliers: int,
        around: int | None = None,
    ) -> PosedView | None:
        """Match landmarks near the pixels of a pose, and fit the pose to them; None if too few agree.

        Both are done twice, first within *radius_px*, then within 5 px.

        Args:
            view: The image.
            T_camera_world: ``(4, 4)``, its initial pose.
            radius_px: Radius around projected landmarks of the first match.
            min_inliers: Fewest matches, and fewest of them that agree with the fitted pose.
            around: Keyframe around which landmarks are matched; None for the reference keyframe.
        """
        for radius in (radius_px, _REFINE_RADIUS_PX):
            near = GuidedMatchLimits(radius_px=radius, lowe_ratio=VERIFY_LOWE_RATIO)
            matches = self.match(view, T_camera_world, near, around)
            count = len(matches)
            if count < min_inliers:
                return None
            observed = Observations(
                points=matches.points,
                covariances=matches.covariances,
                pixels=view.features.pixels[matches.features],
                pixel_sigmas_px=PIXEL_SIGMA_PX * view.features.sizes[matches.features],
                depths_m=np.zeros(count),
                depth_sigmas_m=np.ones(count),
            )
            fitted = fit_pose(observed, self.map.camera, T_camera_world, gate2=OUTLIER_SIGMAS**2)
            if fitted is None or fitted.is_inlier.sum() < min_inliers:
                return None
            pose = rigid(fitted.T_camera_world)
            if pose is None:
                return None
            T_camera_world, is_inlier = pose, fitted.is_inlier
        inliers = np.flatnonzero(is_inlier)
        landmarks = np.full(len(view.features), NO_LANDMARK)
        landmarks[matches.features[inliers]] = matches.numbers[inliers]
        return PosedView(
            view=view, T_camera_world=T_camera_world, landmarks=landmarks, matches=count, is_weak=False
        )

    @property
    def last_pose(self) -> tuple[float, Array]:
        """Time in seconds and ``T_camera_world`` ``(4, 4)`` of the newest frame, in the segment's unit."""
        newest = max(self.frames, key=lambda frame: frame.timestamp_s)
        keyframe = self.map.keyframes[newest.keyframe]
        return newest.timestamp_s, inverse(newest.T_keyframe_camera) @ keyframe.T_camera_world

    def trajectory(self) -> Trajectory:
        """Return ``T_world_camera`` of all frames in the order of time, in the segment's frame and unit."""
        stamps_s = np.array([frame.timestamp_s for frame in self.frames])
        poses = [
            inverse(self.map.keyframes[frame.keyframe].T_camera_world) @ frame.T_keyframe_camera
            for frame in self.frames
        ]
        order = np.argsort(stamps_s, kind="stable")
        return Trajectory(stamps_s[order], np.array(poses).reshape(-1, 4, 4)[order])
