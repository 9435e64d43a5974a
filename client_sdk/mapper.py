"""From frames to a trajectory and a map: the one object that a robot with a camera needs.

`Mapper` sends each frame's matches to the PnP service and keeps what comes back.  It opens no connection and
no camera: it is given a function that answers pose queries, such as that of a connected robot.
"""

from __future__ import annotations

import asyncio
import functools
import json
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Features, Frame, FrontEndOptions, PoseQuery, TrackedFrame
from client_sdk.imu.inertial import ImuScale, Inertial, upright
from client_sdk.imu.samples import ImuSamples
from client_sdk.mapping import MapOptions, PointMap, Trajectory, write_ply, write_trajectory
from client_sdk.monocular.scale import MarkerScale, OdometryScale
from client_sdk.slots import FeaturesFunction, LoopsFunction, MotionFunction, OptimiserFunction, Slots
from client_sdk.source_facts import DepthFacts, SourceFacts, check_source, median_depth_m
from client_sdk.tracking.monocular_tracker import MonocularOptions, MonocularTracker
from client_sdk.tracking.segments import (
    DriveRecords,
    SegmentRecord,
    keyframe_of,
    landmark_keyframes,
    tracker_record,
)
from client_sdk.tracking.stereo_adjustment import StereoAdjustment
from client_sdk.tracking.tracker import Tracker
from rse_pf.errors import ConfigurationError, RsePfError, UsageError
from rse_pf.geometry import Array, Camera
from rse_pf.maps.format import UP, UP_FIELD, Keyframe, MapVersion, encode_map
from rse_pf.pnp import DepthNoise, PnpOptions
from rse_pf.slam.inertial import KeyframeImu, upright_rotation

if TYPE_CHECKING:  # only robots that record need what it imports
    from rse_pf.recording.robot_recorder import RobotRecorder

__all__ = ["AskPose", "BlockingMapper", "Mapper", "ask_robot"]


AskPose = Callable[[PoseQuery], Awaitable[PoseAnswer]]
"""Answers one pose query, or raises an RsePfError, with which the query counts as not answered."""

_MIN_READINGS = 2
_UP_TO_SCALE = "up to scale"
_LEVEL_GRAVITY: Array = np.array([0.0, 9.81, 0.0])
_USUAL_DEPTH_M = 2.0


def ask_robot(solve_pnp: Callable[..., Awaitable[PoseAnswer]], deadline_s: float | None = None) -> AskPose:
    """Return a function that answers pose queries by `Robot.solve_pnp`, within *deadline_s* each."""

    async def ask(query: PoseQuery) -> PoseAnswer:
        found = query.correspondences
        return await solve_pnp(
            found.points_world,
            found.pixels,
            query.camera,
            PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations),
            depths_m=found.depths_m if found.depths_m.any() else None,
            depth_noise=query.depth_noise,
            deadline_s=deadline_s,
            keep=True,
        )

    return ask


class Mapper:
    """Tracks a camera frame by frame, and keeps its trajectory and its map.

    ::

        async with connect(url, token=token) as robot:
            mapper = robot.mapper()
            async for frame in open_camera("0", intrinsics=Path("intrinsics.json")):
                tracked = await mapper.track(frame)
            mapper.save(Path("out"))

    Frames with depth give a dense map in metres, stereo pairs the points of their features.  Frames without
    depth (all zero) give landmarks, up to scale unless *scale* knows a length.
    """

    def __init__(
        self,
        *,
        ask: AskPose,
        camera: Camera | None = None,
        options: FrontEndOptions | None = None,
        monocular: MonocularOptions | None = None,
        depth: bool | None = None,
        scale: OdometryScale | MarkerScale | None = None,
        map_options: MapOptions | None = None,
        T_world_start: Array | None = None,
        keyframes_of: str = "",
        adds_frames: bool = True,
        recorder: RobotRecorder | None = None,
        holds_world: bool = False,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        optimiser: OptimiserFunction | None = None,
    ) -> None:
        """Start without frames.

        Args:
            ask: Answers pose queries.
            camera: Frames of another camera are refused; None takes that of the first frame.
            options: For frames with depth.
            monocular: For frames without depth.
            depth: Whether to use depth; None means: if the first frame has some.
            scale: For frames without depth: where metres come from; None means from the IMU, if frames have
                one, else "up to scale".
            map_options: Density of the map of frames with depth.
            T_world_start: ``(4, 4)``, pose of the first camera; None means the identity, or, with an IMU, a
                world whose z points up, in which a level camera looks along x.
            keyframes_of: Name of the robot under which keyframes are kept, about 50 kB each, for
                `encoded_map`; empty keeps none.
            adds_frames: Whether each frame with depth is added to the map; else the caller adds to `map`
                what it wants.
            recorder: Gets each frame before it is tracked, and the points of each map that is saved.
            holds_world: Whether poses that were returned are never turned, when gravity becomes known better,
                nor moved by an adjustment of stereo pairs.
            features: Finds the features of an image; None for ORB.
            motion: Expects the pose of the next frame; None for a constant velocity.
            loops: Describes an image, so that places are recognised; None takes its features.
            optimiser: Adjusts keyframes and landmarks of a camera without depth; None for the built-in one.

        Raises:
            UsageError: One of these is no function, or *features* has no name.
        """
        self.camera = camera
        self.T_body_camera: Array | None = None
        self._ask = ask
        self._options = options
        self._monocular = monocular
        self._depth = depth
        self._scale: OdometryScale | MarkerScale | ImuScale | None = scale
        self._inertial: Inertial | None = None
        self._began_s = self._last_stamp_s = float("-inf")
        self._is_depth_known = False
        self._holds_poses, self._disparity_deviation_px = holds_world, float("nan")
        self._is_upright, self._holds_world = False, holds_world or T_world_start is not None
        self._map_options = map_options or MapOptions()
        self._T_world_start = T_world_start
        self._tracker: Tracker | MonocularTracker | None = None
        self._records = DriveRecords(self._map_options)
        self._keyframes_of = keyframes_of
        self._adds_frames = adds_frames
        self._recorder = recorder
        self._slots = Slots.of(features=features, motion=motion, loops=loops, optimiser=optimiser)
        self._joined = 0
        self._depth_by: Literal["depth", "stereo"] = "depth"
        self._metric: set[int] = set()
        self._one_frame = asyncio.Lock()
        self._round_trips_ms: list[float] = []
        self._sources: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()

    async def track(self, frame: Frame, *, position_m: Array | None = None) -> TrackedFrame:
        """Return the pose of the next frame, or why there is none; the work is done in a thread.

        Args:
            frame: Of the same camera as all others, in the order of time.
            position_m: ``(3,)``, position of the camera by the robot's odometry, for `OdometryScale`.

        Raises:
            UsageError: The frame is of another camera, not later than the one before, or its depth is not in
                metres.
            ConfigurationError: The function that answers cannot work at all, such as without a package.
        """
        async with self._one_frame:
            self._check(frame)
            if self._recorder is not None:
                self._recorder.frame(frame.timestamp_s, frame.rgb)
            tracker = self._tracker_for(frame)
            if self._inertial is not None and frame.imu is not None:
                self._inertial.add(frame.imu)
            step = await _in_thread(tracker, functools.partial(tracker.prepare, frame))
            answer: PoseAnswer | None = None
            failure = ""
            while isinstance(step, PoseQuery):
                try:
                    answer, failure = await self._ask(step), ""
                except ConfigurationError:
                    _give_up(tracker, step)
                    raise
                except RsePfError as error:
                    answer, failure = None, f"{error.code}: {error.message}"
                except BaseException:
                    _give_up(tracker, step)
                    raise
                solution = None if answer is None else answer.solution
                accept = functools.partial(
                    tracker.accept,
                    step,
                    None if solution is None else solution.T_camera_world,
                    0 if solution is None else len(solution.inliers),
                    is_weak=solution is not None and solution.verdict == "weak",
                )
                step = await _in_thread(tracker, accept)
            return await asyncio.to_thread(self._finished, step, answer, failure, position_m)

    @property
    def map(self) -> PointMap:
        """The map so far: dense with depth, else its landmarks."""
        tracker = self._tracker
        if not isinstance(tracker, MonocularTracker):
            return self._records.first.cloud
        return tracker_record(tracker, 0, self._map_options).cloud

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far, with all corrections, of the first segment and all that was joined to it."""
        if isinstance(self._tracker, MonocularTracker):
            return self._tracker.trajectory()
        return self._records.first.trajectory()

    @property
    def frames(self) -> int:
        """The number of frames tracked so far."""
        return 0 if self._tracker is None else self._tracker.frames

    def restart_clock(self) -> None:
        """Accept frames of an earlier time: their source began anew, such as a bag that is played again."""
        self._last_stamp_s = float("-inf")

    @property
    def lost_frames(self) -> int:
        """The number of frames without a pose, but for those before the start of a camera without depth."""
        return 0 if self._tracker is None else self._tracker.lost_frames

    @property
    def frames_before_start(self) -> int:
        """The number of frames of a camera without depth before it had moved enough to begin."""
        return self._tracker.starting_frames if isinstance(self._tracker, MonocularTracker) else 0

    @property
    def keyframes(self) -> int:
        """The number of keyframes."""
        return 0 if self._tracker is None else self._tracker.keyframes

    @property
    def scale(self) -> str:
        """Where metres come from: ``metric, by depth``, ``metric, by ...``, or ``up to scale``."""
        if self._tracker is None or isinstance(self._tracker, Tracker):
            return f"metric, by {self._depth_by}" if self._tracker is not None else "unknown: no frame yet"
        return f"metric, by {self._scale.name}" if 0 in self._metric and self._scale else _UP_TO_SCALE

    @property
    def imu(self) -> str:
        """``none``, ``used``, ``not used yet``, or ``not used: `` and why, in one line."""
        if self._inertial is None:
            return "none"
        if self._inertial.trouble:
            return f"not used: {self._inertial.trouble}"
        return "not used yet" if self._inertial.alignment is None else "used"

    @property
    def gravity(self) -> Array | None:
        """``(3,)`` m/s^2 in the world; None while it is not known."""
        return None if self._inertial is None else self._inertial.gravity

    def keyframe_imu(
        self, T_world_camera: Array, since_s: float | None, timestamp_s: float
    ) -> KeyframeImu | None:
        """Return what a keyframe tells of the IMU, as `Inertial.keyframe` does; None while it is unknown."""
        return (
            None if self._inertial is None else self._inertial.keyframe(T_world_camera, since_s, timestamp_s)
        )

    @property
    def unrecognised(self) -> int:
        """The number of lost frames since the last pose that show enough; a covered lens does not count."""
        return self._tracker.unrecognised if isinstance(self._tracker, Tracker) else 0

    @property
    def landmark_tracker(self) -> MonocularTracker | None:
        """The tracker of a camera without depth; None with depth, and before the first frame."""
        return self._tracker if isinstance(self._tracker, MonocularTracker) else None

    @property
    def features(self) -> Features | None:
        """The features of the last frame that has a pose; None before it, and without depth."""
        return self._tracker.last_features if isinstance(self._tracker, Tracker) else None

    @property
    def depth_noise(self) -> DepthNoise:
        """The noise of the camera's depths, as it was measured on the way; a Kinect's without depth."""
        return self._tracker.noise.noise if isinstance(self._tracker, Tracker) else DepthNoise()

    def restart(self, T_world_start: Array) -> None:
        """Begin a new odometry frame: the next frame is at *T_world_start*, whatever was seen before.

        Raises:
            UsageError: The frames have no depth, or a frame is being tracked.
        """
        if not isinstance(self._tracker, Tracker):
            raise UsageError("only a camera with depth can start anew", hint="make another mapper")
        self._tracker.restart(T_world_start)
        if self._inertial is not None:
            stamps_s = self._records.first.stamps_s
            self._began_s = max(stamps_s, default=self._began_s)
            self._inertial.forget()

    def report(self) -> dict[str, Any]:
        """Return the figures of the drive, as for ``report.json``."""
        trips = np.array(self._round_trips_ms)
        trajectory, apart = self.trajectory, self._apart()
        offset: dict[str, float] = {}
        if isinstance(self._tracker, Tracker) and np.isfinite(self._disparity_deviation_px):
            offset["disparity_offset_px"] = round(self._tracker.disparity_offset_px, 3)
            offset["disparity_offset_deviation_px"] = round(self._disparity_deviation_px, 3)
        return {
            "frames": self.frames,
            "lost_frames": self.lost_frames,
            "frames_before_start": self.frames_before_start,
            "keyframes": self.keyframes,
            "segments_apart": len(apart),
            "frames_apart": sum(len(record.poses) for record, _ in apart),
            "scale": self.scale,
            **offset,
            **({} if self._inertial is None else {"imu": self.imu}),
            **({} if self.T_body_camera is None else {"T_body_camera": self.T_body_camera.tolist()}),
            "unit": "unit of the map" if self.scale == _UP_TO_SCALE else "m",
            "path": round(trajectory.length_m, 3) if len(trajectory) > 1 else 0.0,
            "map_points": len(self.map),
            "answered_by": dict(self._sources),
            "round_trip_ms": {
                f"p{q}": round(float(np.percentile(trips, q)), 2) if len(trips) else None
                for q in (50, 95, 99)
            },
            "lost_because": dict(self._reasons.most_common(5)),
        }

    def encoded_map(self) -> bytes:
        """Return cloud and keyframes as one map that others can merge with theirs, or be found in.

        `DataClient.update_map` shares it; `merge_maps` makes one map of several.

        Raises:
            UsageError: No keyframe was kept: the scale is not known, or *keyframes_of* is empty.
        """
        keyframes = self._kept_keyframes()
        if not keyframes:
            raise UsageError(
                "no keyframe was kept in metres, so there is no map to share",
                hint="make the mapper with keyframes_of=ROBOT, and give it frames with depth, or a scale",
            )
        points, colours = self.map.points(min_readings=self._least_readings)
        made_by: dict[str, Any] = {"made_by": "mapper", "robot": self._keyframes_of}
        if self._is_upright:
            made_by[UP_FIELD] = list(UP)
        numbered = tuple(replace(keyframe, id=number) for number, keyframe in enumerate(keyframes))
        version = MapVersion(keyframes=numbered, points=points, colours=colours, provenance=made_by)
        return encode_map(version)

    def save(self, folder: Path) -> dict[str, Any]:
        """Write ``map.ply``, ``trajectory.txt`` and ``report.json``; return the report.

        With a rig, ``trajectory-body.txt`` has the poses of its body, where they are in metres.

        Segments that were not joined to the first one have files of their own: ``map-2.ply``,
        ``trajectory-2.txt`` and so on.

        A map with depth has the points that were read at least twice; the report counts those.  Without depth
        and with stereo pairs all keyframes are adjusted together before, which takes seconds.  Pairs move
        only if their disparities are clearly too small or too large: by the report's ``disparity_offset_px``.

        Raises:
            UsageError: The folder cannot be written.
        """
        if isinstance(self._tracker, MonocularTracker):
            self._tracker.adjust()
            for segment in self._metric:
                self._make_metric(self._tracker, segment)
        elif self._tracker is not None:
            self.adjust_pairs()
            if self._inertial is not None:
                self._align(self._tracker)
                self._make_upright(self._tracker)
        report = self.report()
        points, colours = self.map.points(min_readings=self._least_readings)
        report["map_points"] = len(points)
        if self._recorder is not None:
            self._recorder.map(points)
        is_metric = self.scale != _UP_TO_SCALE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_ply(folder / "map.ply", points, colours, is_metric=is_metric)
            body = self.T_body_camera
            path = folder / "trajectory.txt"
            write_trajectory(path, self.trajectory, is_metric=is_metric, T_body_camera=body)
            for number, (record, is_metric) in enumerate(self._apart(), start=2):
                write_ply(folder / f"map-{number}.ply", *record.cloud.points(), is_metric=is_metric)
                path = folder / f"trajectory-{number}.txt"
                write_trajectory(path, record.trajectory(), is_metric=is_metric, T_body_camera=body)
            text = json.dumps(report, indent=2) + "\n"
            (folder / "report.json").write_text(text, encoding="utf-8")
        except OSError as error:
            raise UsageError(
                f"cannot write {folder}: {error.strerror}", hint="name another folder"
            ) from error
        return report

    def adjust_pairs(self) -> Mapping[int, StereoAdjustment]:
        """Adjust all keyframes of stereo pairs together, with what their disparities lack, as `save` does.

        Returned is by segment what was found, also where it is not clear and nothing moves; nothing of other
        cameras, and of a mapper that holds its poses.
        """
        tracker = self._tracker
        if not isinstance(tracker, Tracker) or self._depth_by != "stereo" or self._holds_poses:
            return {}
        adjusted = tracker.adjust_pairs()
        self._records.correct(adjusted)
        if tracker.segment in adjusted:
            self._disparity_deviation_px = adjusted[tracker.segment].deviation_px
        return tracker.pair_offsets

    def _kept_keyframes(self) -> list[Keyframe]:
        """Return the keyframes that others may use: those in metres."""
        tracker = self._tracker
        if not isinstance(tracker, MonocularTracker):
            return self._records.first.keyframes
        if not self._keyframes_of or self.camera is None or self.scale == _UP_TO_SCALE:
            return []
        return landmark_keyframes(tracker, self.camera, self._keyframes_of)

    @property
    def _least_readings(self) -> int:
        """How often a voxel of the map must have been read to be trusted: twice, if the map is dense."""
        is_sparse = isinstance(self._tracker, MonocularTracker) or self._depth_by == "stereo"
        return 1 if is_sparse else _MIN_READINGS

    def _apart(self) -> list[tuple[SegmentRecord, bool]]:
        """Return the segments that were not joined to the first one, and whether they are in metres."""
        tracker = self._tracker
        if not isinstance(tracker, MonocularTracker):
            return [(record, True) for record in self._records.apart]
        return [
            (tracker_record(tracker, number, self._map_options), number in self._metric)
            for number in tracker.segments[1:]
        ]

    def _check(self, frame: Frame) -> None:
        """Refuse a frame that cannot follow the one before; what is refused changes nothing."""
        own, camera = frame.camera, self.camera or frame.camera
        if own != camera:
            raise UsageError(
                f"a frame of {own.width}x{own.height} px, fx {own.fx:g} is of another camera "
                f"than those before, of {camera.width}x{camera.height} px, fx {camera.fx:g}",
                hint="use one mapper for each camera, and give it the intrinsics of the frames",
            )
        if frame.timestamp_s <= self._last_stamp_s:
            raise UsageError(
                f"a frame of {frame.timestamp_s:.6f} s is not later than the one before, "
                f"of {self._last_stamp_s:.6f} s",
                hint="give frames in the order of their exposure, each with its own time",
            )
        if not self._is_depth_known and frame.stereo is None:
            median_m = median_depth_m([frame.depth_m])
            depth = DepthFacts(median_m=median_m, units_per_m=1.0, is_unit_stated=True)
            check_source(SourceFacts(name="a frame", depth=depth))
            self._is_depth_known = median_m is not None
        self.camera, self._last_stamp_s = camera, frame.timestamp_s

    def _tracker_for(self, frame: Frame) -> Tracker | MonocularTracker:
        if self.T_body_camera is None:
            self.T_body_camera = frame.T_body_camera
        if self._tracker is None:
            if frame.imu is not None:
                self._begin_inertial(frame.imu, frame.camera)
            if frame.stereo is not None or (
                bool(frame.depth_m.any()) if self._depth is None else self._depth
            ):
                self._depth_by = "depth" if frame.stereo is None else "stereo"
                self._tracker = Tracker(self._options, self._T_world_start, self._slots)
            else:
                self._tracker = MonocularTracker(self._monocular, self._T_world_start, self._slots)
        return self._tracker

    def _begin_inertial(self, samples: ImuSamples, camera: Camera) -> None:
        """Take the IMU of the first frame, which says where down is, and metres if nothing else does."""
        self._inertial = Inertial(samples.model, camera)
        self._inertial.add(samples)
        self._slots = replace(self._slots, inertial=self._inertial)
        self._scale = self._scale or ImuScale(self._inertial)
        if self._T_world_start is None:
            gravity = self._inertial.first_gravity()
            self._T_world_start = upright(_LEVEL_GRAVITY if gravity is None else gravity)

    def _align(self, tracker: Tracker) -> None:
        """Find gravity and biases of a drive in metres."""
        assert self._inertial is not None
        path = self._records.first.trajectory()
        first = int(np.searchsorted(path.timestamps_s, self._began_s, side="right"))
        depths_m = np.empty(0) if tracker.last_features is None else tracker.last_features.points_camera[:, 2]
        depths_m = depths_m[np.isfinite(depths_m)]
        depth_m = float(np.median(depths_m)) if len(depths_m) else _USUAL_DEPTH_M
        self._inertial.align(path.timestamps_s[first:], path.T_world_camera[first:], depth_m, is_metric=True)

    def _make_upright(self, tracker: Tracker | MonocularTracker) -> bool:
        """Turn the world, if gravity is known, so that z points up; say whether it was turned."""
        gravity = None if self._inertial is None else self._inertial.gravity
        if gravity is None or self._holds_world:
            return False
        turned = upright_rotation(gravity)
        tracker.turn(turned)
        if isinstance(tracker, Tracker):
            self._records.turn(turned)
        self._is_upright = True
        return True

    def _finished(
        self, tracked: TrackedFrame, answer: PoseAnswer | None, failure: str, position_m: Array | None
    ) -> TrackedFrame:
        """Complete the result of a frame, and add it to trajectory and map."""
        tracker, pose = self._tracker, tracked.T_world_camera
        is_first = isinstance(tracker, Tracker) and pose is not None and not self._records.first.poses
        reason = tracked.reason or (failure if pose is None else "")
        if pose is None and not reason:
            reason = f"only {tracked.matches} matches, or their pose is not plausible"
            if not tracked.matches:
                reason = "no matches: it shows nothing that was seen just before"
        if pose is not None and answer is not None and answer.solution.verdict == "weak":
            reason = answer.solution.reason
        status = tracked.status
        if pose is None and status == "tracked":
            status = "lost"
        if answer is not None:
            self._round_trips_ms.append(answer.round_trip_ms)
            self._sources[answer.source] += 1
        if status == "lost":
            self._reasons[reason] += 1
        done = replace(
            tracked,
            status="first" if is_first else status,
            reason=reason,
            covariance=None if answer is None or pose is None else answer.solution.covariance,
            source="none" if answer is None else answer.source,
            round_trip_ms=None if answer is None else answer.round_trip_ms,
        )
        if isinstance(tracker, MonocularTracker):
            return self._with_scale(tracker, done, position_m)
        assert tracker is not None
        if pose is not None:
            record = self._records.add(done, pose)
            if self._adds_frames:
                self._records.add_to_cloud(done, pose, tracker.last_features)
            if done.keyframe and self._keyframes_of and tracker.last_features is not None:
                record.keyframes.append(keyframe_of(done, pose, tracker.last_features, self._keyframes_of))
        return self._with_gravity(tracker, self._with_joins(tracker, done))

    def _with_gravity(self, tracker: Tracker, done: TrackedFrame) -> TrackedFrame:
        """Turn the world once gravity is known; the poses that were returned before are corrected."""
        inertial, pose = self._inertial, done.T_world_camera
        if inertial is None or pose is None or not inertial.is_due(done.frame.timestamp_s):
            return done
        self._align(tracker)
        if self._is_upright or inertial.gravity is None:
            return done
        T = upright_rotation(inertial.gravity)
        if not self._make_upright(tracker):
            return done
        return replace(done, T_world_camera=T @ pose, corrected=True, T_new_old=T)

    def _with_joins(self, tracker: Tracker, done: TrackedFrame) -> TrackedFrame:
        """Move what was joined since the last frame; the poses that were returned before are corrected."""
        joins = tracker.joins[self._joined :]
        for join in joins:
            self._records.join(join)
        self._joined = len(tracker.joins)
        return replace(done, corrected=bool(joins))

    def _with_scale(
        self, tracker: MonocularTracker, done: TrackedFrame, position_m: Array | None
    ) -> TrackedFrame:
        """Return the result in metres where they are known; a keyframe corrects poses that were returned."""
        frame, segment = done.frame, done.segment
        corrected = done.keyframe
        merged = tracker.loops + len(tracker.joins)
        self._metric.intersection_update(tracker.segments)
        is_due = self._scale is not None and self._scale.is_due(
            frame.timestamp_s, is_known=segment in self._metric
        )
        if self._scale is not None and (is_due or merged != self._joined):
            if segment not in self._metric:
                self._scale.observe(frame.timestamp_s, frame.rgb, position_m)
            if done.T_world_camera is not None and self._make_metric(tracker, segment):
                corrected = True
                done = replace(done, T_world_camera=tracker.trajectory(segment).T_world_camera[-1])
        self._joined = merged
        is_metric = segment in self._metric
        return replace(done, corrected=corrected, scale="metric" if is_metric else "up to scale")

    def _make_metric(self, tracker: MonocularTracker, segment: int) -> bool:
        """Scale a segment to metres, also after an adjustment of all; say whether the scale is known."""
        if self._scale is None or self.camera is None:
            return False
        path = tracker.trajectory(segment)
        depth = tracker.median_depth(segment)
        scale = self._scale.metres_per_unit(path.timestamps_s, path.T_world_camera, self.camera, depth)
        if scale is None:
            return False
        tracker.rescale(scale, segment)
        self._metric.add(segment)
        if segment == min(tracker.segments):
            self._make_upright(tracker)
        return True


class BlockingMapper:
    """A `Mapper` whose `track` blocks; everything else is that of the mapper."""

    def __init__(self, mapper: Mapper, wait: Callable[[Coroutine[Any, Any, Any]], Any] = asyncio.run) -> None:
        """Wrap *mapper*; *wait* runs a coroutine to its end, such as in the event loop of a robot."""
        self.mapper = mapper
        self._wait = wait

    def track(self, frame: Frame, *, position_m: Array | None = None) -> TrackedFrame:
        """Return the pose of the next frame; see `Mapper.track`."""
        tracked: TrackedFrame = self._wait(self.mapper.track(frame, position_m=position_m))
        return tracked

    @property
    def map(self) -> PointMap:
        """The map so far; see `Mapper.map`."""
        return self.mapper.map

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far; see `Mapper.trajectory`."""
        return self.mapper.trajectory

    @property
    def scale(self) -> str:
        """Where metres come from; see `Mapper.scale`."""
        return self.mapper.scale

    def encoded_map(self) -> bytes:
        """Return a map that others can merge with theirs; see `Mapper.encoded_map`."""
        return self.mapper.encoded_map()

    def save(self, folder: Path) -> dict[str, Any]:
        """Write the map, the trajectory and the report; see `Mapper.save`."""
        return self.mapper.save(folder)


async def _in_thread(
    tracker: Tracker | MonocularTracker, act: Callable[[], PoseQuery | TrackedFrame]
) -> PoseQuery | TrackedFrame:
    """Return the next step of a frame.  A cancellation waits for it, since the thread goes on anyway."""
    work = asyncio.ensure_future(asyncio.to_thread(act))
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        step = await work
        if isinstance(step, PoseQuery):
            _give_up(tracker, step)
        raise


def _give_up(tracker: Tracker | MonocularTracker, query: PoseQuery) -> None:
    """Close the open query, so that the next frame can be tracked after a cancellation."""
    step: PoseQuery | TrackedFrame = query
    while isinstance(step, PoseQuery):
        step = tracker.accept(step, None)
