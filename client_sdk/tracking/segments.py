"""What a mapper keeps of each segment of a drive: poses, cloud and keyframes, until segments are joined.

A tracker without depth keeps its segments itself, since each keyframe corrects them; here is their record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Features, Frame, TrackedFrame
from client_sdk.point_map import MapOptions, PointMap
from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.stereo_adjustment import MOST_KEYFRAMES, StereoAdjustment
from client_sdk.tracking.tracker import Join
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, Camera, inverse, rigid, transform
from rse_pf.maps.format import Keyframe

__all__ = [
    "DriveRecords",
    "SeenPoints",
    "SegmentRecord",
    "add_to_cloud",
    "certain_rows",
    "keyframe_of",
    "landmark_keyframes",
    "tracker_record",
]

_CLOUD_SHARE = 0.05
"""Largest deviation of a stereo pair's depth in the cloud, as a share of the depth."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """What a stereo keyframe adds to a cloud: its pose, ``(n, 3)`` points and colours."""

    timestamp_s: float
    T_world_camera: Array
    points_camera: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]


@dataclass(slots=True, kw_only=True, eq=False)
class SegmentRecord:
    """One segment: stamps in seconds, ``(4, 4)`` poses in its own frame, its cloud and its keyframes.

    ``seen`` are the points that stereo keyframes added to the cloud, so that it follows these; None once they
    are too many to be adjusted.
    """

    cloud: PointMap
    stamps_s: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    seen: list[SeenPoints] | None = field(default_factory=list)

    def take(self, other: SegmentRecord, T_own_other: Array) -> None:
        """Add all of another segment."""
        self.stamps_s += other.stamps_s
        self.poses += [_moved(T_own_other, pose) for pose in other.poses]
        self.cloud.add_map(other.cloud, T_own_other)
        self.keyframes += [
            replace(keyframe, T_world_camera=_moved(T_own_other, keyframe.T_world_camera))
            for keyframe in other.keyframes
        ]
        self.note(
            None if other.seen is None else
            [replace(seen, T_world_camera=_moved(T_own_other, seen.T_world_camera)) for seen in other.seen]
        )  # fmt: skip

    def note(self, seen: list[SeenPoints] | None) -> None:
        """Remember what stereo keyframes added to the cloud, None for too many."""
        kept = None if self.seen is None or seen is None else self.seen + seen
        self.seen = None if kept is None or len(kept) > MOST_KEYFRAMES else kept

    def corrected(self, found: StereoAdjustment) -> SegmentRecord:
        """Return the segment as an adjustment of its keyframes has it; a cloud that others made stays."""

        def moved(stamp_s: float, pose: Array) -> Array:
            T = found.moved(np.array([stamp_s]), pose[None])[0]
            return _moved(T @ inverse(pose), pose)

        def shown(points_camera: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
            points = with_offset(points_camera.astype(np.float64), found.f_baseline, found.offset_px)
            return points.astype(np.float32)

        corrected = SegmentRecord(
            cloud=PointMap(self.cloud.options) if self.seen else self.cloud, stamps_s=self.stamps_s,
            poses=[moved(*each) for each in zip(self.stamps_s, self.poses, strict=True)],
            keyframes=[
                replace(
                    each, T_world_camera=moved(each.timestamp_s, each.T_world_camera),
                    points_camera=shown(each.points_camera),
                )
                for each in self.keyframes
            ],
            seen=None if self.seen is None else [
                replace(
                    each, T_world_camera=moved(each.timestamp_s, each.T_world_camera),
                    points_camera=shown(each.points_camera),
                )
                for each in self.seen
            ],
        )  # fmt: skip
        for each in corrected.seen or ():
            is_known = np.isfinite(each.points_camera[:, 2])
            points = transform(each.T_world_camera, each.points_camera[is_known].astype(np.float64))
            corrected.cloud.add_points(points, each.colours[is_known])
        return corrected

    def trajectory(self) -> Trajectory:
        """Return the poses in the order of time."""
        order = np.argsort(self.stamps_s, kind="stable")
        return Trajectory(np.array(self.stamps_s)[order], np.array(self.poses).reshape(-1, 4, 4)[order])


class DriveRecords:
    """The segments of one drive; the first one, 0, is what its user sees."""

    def __init__(self, options: MapOptions) -> None:
        self._options = options
        self._segments: dict[int, SegmentRecord] = {0: SegmentRecord(cloud=PointMap(options))}

    @property
    def first(self) -> SegmentRecord:
        """The first segment, with all that was joined to it."""
        return self._segments[0]

    @property
    def apart(self) -> list[SegmentRecord]:
        """The segments that were not joined to the first one, in their order."""
        return [record for number, record in sorted(self._segments.items()) if number and record.poses]

    def add(self, tracked: TrackedFrame, pose: Array) -> SegmentRecord:
        """Add a frame with its pose to its segment."""
        record = self._segments.setdefault(tracked.segment, SegmentRecord(cloud=PointMap(self._options)))
        record.stamps_s.append(tracked.frame.timestamp_s)
        record.poses.append(pose)
        return record

    def add_to_cloud(self, tracked: TrackedFrame, pose: Array, features: Features | None) -> None:
        """Add what a frame shows to the cloud of its segment, see the function."""
        record = self._segments[tracked.segment]
        add_to_cloud(record.cloud, tracked.frame, pose, features, tracked.keyframe)
        if tracked.frame.stereo is not None and features is not None and tracked.keyframe:
            points, colours = _pair_points(tracked.frame, features)
            stamp_s = tracked.frame.timestamp_s
            record.note([SeenPoints(stamp_s, pose, points.astype(np.float32), colours)])

    def correct(self, adjusted: Mapping[int, StereoAdjustment]) -> None:
        """Move segments as an adjustment of their keyframes has them."""
        for number, found in adjusted.items():
            if number in self._segments:
                self._segments[number] = self._segments[number].corrected(found)

    def join(self, join: Join) -> None:
        """Move all of a segment into the one that it lies in."""
        record = self._segments.pop(join.segment, None)
        if record is None:
            return
        into = self._segments.setdefault(join.into, SegmentRecord(cloud=PointMap(self._options)))
        into.take(record, join.T_into_segment)

    def turn(self, T_new_old: Array) -> None:
        """Turn the world of all segments."""
        for number, record in self._segments.items():
            self._segments[number] = SegmentRecord(cloud=PointMap(self._options))
            self._segments[number].take(record, T_new_old)


def tracker_record(tracker: MonocularTracker, segment: int, options: MapOptions) -> SegmentRecord:
    """Return a segment of a tracker without depth, as it is corrected now; its cloud are the landmarks."""
    cloud = PointMap(options)
    cloud.add_points(*tracker.points(segment))
    path = tracker.trajectory(segment)
    return SegmentRecord(cloud=cloud, stamps_s=path.timestamps_s.tolist(), poses=list(path.T_world_camera))


def add_to_cloud(
    cloud: PointMap, frame: Frame, pose: Array, features: Features | None, is_keyframe: bool
) -> None:
    """Add what a frame shows at a pose to a cloud.

    Of a stereo pair these are the points of a keyframe's features whose depth is known to 5 %: they are what
    it has measured, and a dense match of both images would take longer than all else.
    """
    if frame.stereo is None:
        cloud.add(frame, pose)
    elif features is not None and is_keyframe:
        points, colours = _pair_points(frame, features)
        cloud.add_points(transform(pose, points), colours)


def _pair_points(frame: Frame, features: Features) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return the ``(n, 3)`` points of a pair whose depth is known to 5 %, and their colours."""
    rows = certain_rows(frame, features)
    columns, lines = np.rint(features.pixels[rows]).astype(np.int64).T
    size = np.array([frame.camera.width, frame.camera.height]) - 1
    colours = frame.rgb[np.clip(lines, 0, size[1]), np.clip(columns, 0, size[0])]
    return features.points_camera[rows], colours


def certain_rows(frame: Frame, features: Features) -> npt.NDArray[np.int64]:
    """Return the rows of the features of a stereo pair whose depth is known to 5 %."""
    depths_m = features.points_camera[:, 2]
    with np.errstate(invalid="ignore"):
        deviation_m = 2.0 * np.sqrt(frame.depth_noise.variance_m2(depths_m))
        return np.flatnonzero(deviation_m <= _CLOUD_SHARE * depths_m)


def keyframe_of(tracked: TrackedFrame, pose: Array, features: Features, robot: str) -> Keyframe:
    """Return a tracked frame as a keyframe of a map, without its number."""
    return Keyframe(
        id=0, robot=robot, timestamp_s=tracked.frame.timestamp_s, T_world_camera=pose,
        camera=tracked.frame.camera, pixels=features.pixels.astype(np.float32),
        descriptors=features.descriptors, points_camera=features.points_camera.astype(np.float32),
        kind=features.kind,
    )  # fmt: skip


def landmark_keyframes(tracker: MonocularTracker, camera: Camera, robot: str) -> list[Keyframe]:
    """Return the keyframes of the first segment of a camera without depth, as they are corrected now.

    Features without a landmark have no point.
    """
    return [
        Keyframe(
            id=0, robot=robot, timestamp_s=seen.timestamp_s, T_world_camera=seen.T_world_camera,
            camera=camera, pixels=seen.image.pixels.astype(np.float32), descriptors=seen.image.descriptors,
            points_camera=camera.back_project(seen.image.pixels, seen.depths).astype(np.float32),
            kind=seen.kind,
        )
        for seen in tracker.keyframes_of(min(tracker.segments, default=0))
    ]  # fmt: skip


def _moved(T_into_segment: Array, pose: Array) -> Array:
    moved = rigid(T_into_segment @ pose)
    return T_into_segment @ pose if moved is None else moved
