"""Records of the segments of a drive that a mapper keeps: poses, point cloud and keyframes.

At a join, the record of the newer segment is added to that of the older one, and is removed.

A tracker without depth keeps its segments itself, because every new keyframe corrects them; here are
functions that read them out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Features, Frame, TrackedFrame
from client_sdk.point_map import MapOptions, PointMap
from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.segment_join import Join
from client_sdk.tracking.stereo_adjustment import MAX_ADJUSTED_KEYFRAMES, StereoAdjustment
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, Camera, inverse, rigid, transform
from rse_pf.maps.format import Keyframe

__all__ = [
    "DriveRecords",
    "KeyframePoints",
    "SegmentRecord",
    "add_to_cloud",
    "landmark_keyframes",
    "make_keyframe",
    "read_segment",
    "select_certain_rows",
]

_MAX_DEPTH_DEVIATION = 0.05
"""Largest uncertainty of the depth of a stereo pair's point that is added to a cloud, as a share of the
depth."""
_DISPARITY_SIGMAS = 2.0
"""The standard deviation of a stereo pair's depth in a sharp image times this is compared with
`_MAX_DEPTH_DEVIATION`: other images are about twice as noisy."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframePoints:
    """Points that one stereo keyframe added to a cloud.

    Attributes:
        timestamp_s: Time of the keyframe, in seconds.
        T_world_camera: ``(4, 4)``, its pose in the frame of the segment.
        points_camera: ``(n, 3)`` metres in the camera's frame.
        colours: ``(n, 3)`` uint8, red first.
    """

    timestamp_s: float
    T_world_camera: Array
    points_camera: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]


_Kept = TypeVar("_Kept", Keyframe, KeyframePoints)


@dataclass(slots=True, kw_only=True, eq=False)
class SegmentRecord:
    """The record of one segment, in the frame of the segment.

    Attributes:
        cloud: Point cloud.
        stamps_s: Times of the frames with a pose, in seconds.
        poses: ``T_world_camera`` ``(4, 4)`` of these frames.
        keyframes: Keyframes for an encoded map, if the mapper keeps them (its *keyframes_of* is a name).
        keyframe_points: Points that each stereo keyframe added to the cloud, by which the cloud is made again
            after an adjustment; None once there were more than `MAX_ADJUSTED_KEYFRAMES` keyframes.
    """

    cloud: PointMap
    stamps_s: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    keyframe_points: list[KeyframePoints] | None = field(default_factory=list)

    def append(self, other: SegmentRecord, T_own_other: Array) -> None:
        """Add all of another segment, moved by ``T_own_other`` ``(4, 4)`` into the frame of this one."""

        def moved(kept: _Kept) -> _Kept:
            return replace(kept, T_world_camera=_move_pose(T_own_other, kept.T_world_camera))

        self.stamps_s += other.stamps_s
        self.poses += [_move_pose(T_own_other, pose) for pose in other.poses]
        self.cloud.add_map(other.cloud, T_own_other)
        self.keyframes += map(moved, other.keyframes)
        points = other.keyframe_points
        self.add_keyframe_points(None if points is None else [moved(kept) for kept in points])

    def add_keyframe_points(self, added: list[KeyframePoints] | None) -> None:
        """Keep the points of further stereo keyframes, or forget those of all keyframes for good.

        All are forgotten if *added* is None, and if there are more than `MAX_ADJUSTED_KEYFRAMES` then.
        """
        points = None if self.keyframe_points is None or added is None else self.keyframe_points + added
        is_adjustable = points is not None and len(points) <= MAX_ADJUSTED_KEYFRAMES
        self.keyframe_points = points if is_adjustable else None

    def corrected(self, adjustment: StereoAdjustment) -> SegmentRecord:
        """Return a new record of the segment after an adjustment of its stereo keyframes.

        The poses of all frames and keyframes, and the depths of the keyframes, are corrected.  The cloud is
        built anew from the points of the keyframes; without such points (there were too many keyframes, or
        the cloud was not made of keyframes) the cloud stays uncorrected, as the same object.
        """

        def moved(stamp_s: float, pose: Array) -> Array:
            T = adjustment.moved(np.array([stamp_s]), pose[None])[0]
            return _move_pose(T @ inverse(pose), pose)

        def corrected(kept: _Kept) -> _Kept:
            points = kept.points_camera.astype(np.float64)
            points = with_offset(points, adjustment.f_baseline, adjustment.offset_px)
            return replace(
                kept,
                T_world_camera=moved(kept.timestamp_s, kept.T_world_camera),
                points_camera=points.astype(np.float32),
            )

        keyframe_points = self.keyframe_points
        if keyframe_points is not None:
            keyframe_points = [corrected(kept) for kept in keyframe_points]
        cloud = PointMap(self.cloud.options) if keyframe_points else self.cloud
        for points in keyframe_points or ():
            has_depth = np.isfinite(points.points_camera[:, 2])
            local = points.points_camera[has_depth].astype(np.float64)
            cloud.add_points(transform(points.T_world_camera, local), points.colours[has_depth])
        return SegmentRecord(
            cloud=cloud,
            stamps_s=self.stamps_s,
            poses=[moved(stamp_s, pose) for stamp_s, pose in zip(self.stamps_s, self.poses, strict=True)],
            keyframes=[corrected(keyframe) for keyframe in self.keyframes],
            keyframe_points=keyframe_points,
        )

    def trajectory(self) -> Trajectory:
        """Return the poses in the order of time, in the frame of the segment."""
        order = np.argsort(self.stamps_s, kind="stable")
        return Trajectory(np.array(self.stamps_s)[order], np.array(self.poses).reshape(-1, 4, 4)[order])


class DriveRecords:
    """The records of all segments of one drive.

    The first segment, number 0, is that of `Mapper.trajectory` and `Mapper.map`.
    """

    def __init__(self, options: MapOptions) -> None:
        self._options = options
        self._segments: dict[int, SegmentRecord] = {0: SegmentRecord(cloud=PointMap(options))}
        self.connected: Collection[int] = ()
        """Numbers of the segments that wheels have connected with the world of the first one."""

    @property
    def first(self) -> SegmentRecord:
        """The first segment, with all segments that were joined to it."""
        return self._segments[0]

    @property
    def _world(self) -> list[SegmentRecord]:
        """The first segment, and all that wheels have connected with its world."""
        later = (self._segments[number] for number in sorted(self.connected) if number in self._segments)
        return [self.first, *later]

    @property
    def cloud(self) -> PointMap:
        """Points of the first segment and of the connected ones; a new map if there are such."""
        first, *later = self._world
        if not later:
            return first.cloud
        cloud = PointMap(self._options)
        for record in (first, *later):
            cloud.add_map(record.cloud, np.eye(4))
        return cloud

    @property
    def keyframes(self) -> list[Keyframe]:
        """Keyframes of the first segment and of the connected ones."""
        return [keyframe for record in self._world for keyframe in record.keyframes]

    def trajectory(self) -> Trajectory:
        """Return the poses of the first segment and of the connected ones in the order of time."""
        whole = SegmentRecord(
            cloud=self.first.cloud,
            stamps_s=[stamp_s for record in self._world for stamp_s in record.stamps_s],
            poses=[pose for record in self._world for pose in record.poses],
        )
        return whole.trajectory()

    @property
    def apart(self) -> list[SegmentRecord]:
        """The segments with poses that are not in the world of the first one, in the order of their
        numbers."""
        return [
            record
            for number, record in sorted(self._segments.items())
            if number and record.poses and number not in self.connected
        ]

    def add(self, tracked: TrackedFrame, pose: Array) -> SegmentRecord:
        """Add a frame with its pose ``(4, 4)`` to its segment, and return the record of the segment."""
        record = self._segments.setdefault(tracked.segment, SegmentRecord(cloud=PointMap(self._options)))
        record.stamps_s.append(tracked.frame.timestamp_s)
        record.poses.append(pose)
        return record

    def add_to_cloud(self, tracked: TrackedFrame, pose: Array, features: Features | None) -> None:
        """Add the points that a frame measured to the cloud of its segment, see `add_to_cloud`.

        Those of a stereo keyframe are kept for an adjustment, too.
        """
        record = self._segments[tracked.segment]
        add_to_cloud(record.cloud, tracked.frame, pose, features, tracked.keyframe)
        if tracked.frame.stereo is not None and features is not None and tracked.keyframe:
            points, colours = _points_of_pair(tracked.frame, features)
            stamp_s = tracked.frame.timestamp_s
            record.add_keyframe_points([KeyframePoints(stamp_s, pose, points.astype(np.float32), colours)])

    def correct(self, adjusted: Mapping[int, StereoAdjustment]) -> None:
        """Replace the records of segments by those after an adjustment of their stereo keyframes.

        *adjusted* is by the number of the segment; numbers without a record are ignored.
        """
        for number, adjustment in adjusted.items():
            if number in self._segments:
                self._segments[number] = self._segments[number].corrected(adjustment)

    def join(self, join: Join) -> None:
        """Move all of a segment into the record of the segment that it was joined to.

        A segment without a record is ignored.
        """
        record = self._segments.pop(join.segment, None)
        if record is None:
            return
        into = self._segments.setdefault(join.into, SegmentRecord(cloud=PointMap(self._options)))
        into.append(record, join.T_into_segment)

    def turn(self, T_new_old: Array) -> None:
        """Express all segments in a rotated world, by ``T_new_old`` ``(4, 4)``."""
        for number, record in self._segments.items():
            self._segments[number] = SegmentRecord(cloud=PointMap(self._options))
            self._segments[number].append(record, T_new_old)


def read_segment(tracker: MonocularTracker, segment: int, options: MapOptions) -> SegmentRecord:
    """Return a segment of a tracker without depth as it is adjusted now, without its keyframes.

    Its landmarks are the cloud.  A segment that does not exist gives an empty record.
    """
    cloud = PointMap(options)
    cloud.add_points(*tracker.points(segment))
    path = tracker.trajectory(segment)
    return SegmentRecord(cloud=cloud, stamps_s=path.timestamps_s.tolist(), poses=list(path.T_world_camera))


def add_to_cloud(
    cloud: PointMap, frame: Frame, pose: Array, features: Features | None, is_keyframe: bool
) -> None:
    """Add the points that a frame measured to a cloud.

    A frame with depth adds its depth image.  A stereo pair adds the features whose depth is known to 5 %, and
    only if it is a keyframe: a dense match of both images would take longer than all other steps.

    Args:
        cloud: The cloud, which is changed.
        frame: Image with depth, or a stereo pair.
        pose: ``T_world_camera`` ``(4, 4)``.
        features: Features of the frame; None adds nothing of a stereo pair.
        is_keyframe: Whether the frame is a keyframe.
    """
    if frame.stereo is None:
        cloud.add(frame, pose)
    elif features is not None and is_keyframe:
        points, colours = _points_of_pair(frame, features)
        cloud.add_points(transform(pose, points), colours)


def _points_of_pair(frame: Frame, features: Features) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return the points of a stereo pair's features whose depth is known to 5 %, and their colours.

    The shapes are ``(n, 3)``, metres in the left camera's frame, and ``(n, 3)`` uint8.
    """
    rows = select_certain_rows(frame, features)
    columns, lines = np.rint(features.pixels[rows]).astype(np.int64).T
    columns, lines = np.clip(columns, 0, frame.camera.width - 1), np.clip(lines, 0, frame.camera.height - 1)
    return features.points_camera[rows], frame.rgb[lines, columns]


def select_certain_rows(frame: Frame, features: Features) -> npt.NDArray[np.int64]:
    """Return the rows of the features of a stereo pair whose depth is certain.

    Two standard deviations of such a depth are at most 5 % of it.  Rows without a depth are left out.
    """
    depths_m = features.points_camera[:, 2]
    with np.errstate(invalid="ignore"):
        deviation_m = _DISPARITY_SIGMAS * np.sqrt(frame.depth_noise.variance_m2(depths_m))
        return np.flatnonzero(deviation_m <= _MAX_DEPTH_DEVIATION * depths_m)


def make_keyframe(tracked: TrackedFrame, pose: Array, features: Features, robot: str) -> Keyframe:
    """Return a tracked frame as a keyframe of a map; `Mapper.encoded_map` replaces its number 0.

    Args:
        tracked: The frame.
        pose: ``T_world_camera`` ``(4, 4)`` in the map.
        features: Features of the frame with their points.
        robot: Name of the robot.
    """
    return Keyframe(
        id=0,
        robot=robot,
        timestamp_s=tracked.frame.timestamp_s,
        T_world_camera=pose,
        camera=tracked.frame.camera,
        pixels=features.pixels.astype(np.float32),
        descriptors=features.descriptors,
        points_camera=features.points_camera.astype(np.float32),
        kind=features.kind,
    )


def landmark_keyframes(tracker: MonocularTracker, camera: Camera, robot: str) -> list[Keyframe]:
    """Return the keyframes of the first segment of a tracker without depth, as they are adjusted now.

    Those of segments that wheels have connected with its world follow.  All have the number 0, which
    `Mapper.encoded_map` replaces.  Features without a landmark have no point (NaN).

    Args:
        tracker: The tracker.
        camera: Intrinsics of its frames.
        robot: Name of the robot.
    """
    return [
        Keyframe(
            id=0,
            robot=robot,
            timestamp_s=adjusted.timestamp_s,
            T_world_camera=adjusted.T_world_camera,
            camera=camera,
            pixels=adjusted.features.pixels.astype(np.float32),
            descriptors=adjusted.features.descriptors,
            points_camera=camera.back_project(adjusted.features.pixels, adjusted.depths).astype(np.float32),
            kind=adjusted.features.kind,
        )
        for segment in (min(tracker.segments, default=0), *sorted(tracker.connected))
        for adjusted in tracker.keyframes_of(segment)
    ]


def _move_pose(T_into_segment: Array, pose: Array) -> Array:
    """Return ``T_into_segment @ pose`` with an orthonormal rotation.

    If the product is no rigid motion, it is returned as it is.
    """
    moved = T_into_segment @ pose
    rigid_pose = rigid(moved)
    return moved if rigid_pose is None else rigid_pose
