"""Track a camera frame by frame, and keep its trajectory and its map.

`Mapper` is what a robot with one camera needs.  It opens neither a connection nor a camera: it gets frames,
and a function that answers pose queries, such as `client_sdk.pose_answers.ask_robot` makes of a connected
robot.

**Choice of the tracker.**  The first frame decides.  A frame with depth or with a right image is tracked by
`client_sdk.tracking.tracker.Tracker`, in metres.  A frame without a right image and without depth (all depths
zero, or ``depth=False``) is tracked by `client_sdk.tracking.monocular_tracker.MonocularTracker`, up to scale
until odometry, a marker or an IMU gives the metric scale.

**Segment.**  A part of the drive whose poses are in one world.  After tracking was lost for too long the
tracker begins another segment, with a world of its own.  Segment 0, the first one, goes on after a loss when
one of its places is recognised; it is the trajectory and the map that users see.

**Join.**  When the camera, in a newer segment, recognises a place of an older segment, the newer segment is
moved into the world of the older one: poses, cloud and keyframes.

**Correction.**  A change of poses that were returned before: after a join, after the world was turned so that
z points up, or after a monocular tracker adjusted its keyframes.  The result of the frame that caused it has
``corrected`` set, and `Mapper.trajectory` has the poses as they are now.
"""

from __future__ import annotations

import asyncio
import functools
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Features, Frame, FrontEndOptions, MonocularOptions, PoseQuery, TrackedFrame
from client_sdk.imu.estimator import ImuEstimator, ImuScale, level_start_pose
from client_sdk.imu.samples import ImuSamples
from client_sdk.monocular.scale import MarkerScale, OdometryScale
from client_sdk.plugins import FeaturesFunction, LoopsFunction, MotionFunction, OptimiserFunction, Plugins
from client_sdk.point_map import MapOptions, PointMap, write_ply
from client_sdk.pose_answers import AskPose
from client_sdk.recording import RobotRecorder
from client_sdk.source_facts import DepthFacts, SourceFacts, check_source, median_depth_m
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.segment_join import CONTRADICTED
from client_sdk.tracking.segments import (
    DriveRecords,
    SegmentRecord,
    landmark_keyframes,
    make_keyframe,
    read_segment,
)
from client_sdk.tracking.stereo_adjustment import StereoAdjustment
from client_sdk.tracking.tracker import Tracker
from client_sdk.trajectory import Trajectory, write_trajectory
from client_sdk.wheel_odometry import BaseCovariance, OdometryReading, WheelOdometry
from rse_pf.errors import ConfigurationError, PnpError, RsePfError, UsageError
from rse_pf.geometry import Array, Camera, orthonormalise
from rse_pf.maps.format import UP, UP_FIELD, Keyframe, MapVersion, encode_map
from rse_pf.pnp import DepthNoise
from rse_pf.slam.inertial import KeyframeImu, upright_rotation
from rse_pf.slam.occupancy import GridOptions, OccupancyGrid, level_map, make_occupancy_grid

__all__ = ["Mapper"]

_MIN_READINGS = 2  # readings that a voxel of a dense map needs to be saved: single ones are mostly noise
_UP_TO_SCALE: Final = "up to scale"
_MAX_PLAN_LINES = 40_000
"""Largest number of lines of sight that mark free cells of a floor plan while the robot drives: a tenth of
those of an exported plan, since the floor itself marks most free cells."""
_DEFAULT_DEPTH_M = 2.0
"""Median depth in metres that is assumed when the last frame of a tracker with depth has no feature with
depth, to compute the noise of positions for the IMU."""


class Mapper:
    """Track a camera frame by frame, and keep its trajectory and its map.

    ::

        async with connect(url, token=token) as robot:
            mapper = robot.mapper()
            async for frame in open_camera("0", intrinsics=Path("intrinsics.json")):
                tracked = await mapper.track(frame)
            mapper.save(Path("out"))

    Frames with depth give a dense map in metres, stereo pairs a map of the points of their features, in
    metres too.  Frames without depth give a map of landmarks, up to scale unless there is a source of scale.
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
        T_base_camera: Array | None = None,
        planar: bool = False,
        keyframes_of: str = "",
        adds_frames: bool = True,
        recorder: RobotRecorder | None = None,
        holds_world: bool = False,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        optimiser: OptimiserFunction | None = None,
    ) -> None:
        """Make a mapper without frames; it chooses its tracker with the first frame.

        Args:
            ask: Answers pose queries.
            camera: Intrinsics; frames of another camera are refused.  None takes those of the first frame.
            options: Options of the tracker for depth and stereo pairs.
            monocular: Options of the tracker for frames without depth.
            depth: Whether to use the depth images of frames.  None: if the first frame has a depth reading.
                Stereo pairs are used in each case.
            scale: Source of the metric scale of frames without depth.  None: the IMU, if frames carry its
                samples, else the map stays up to scale.
            map_options: Density of the map of frames with depth.
            T_world_start: ``(4, 4)`` pose of the first frame in the world; with it the world is not turned
                when gravity becomes known.  None: the identity; with an IMU a pose whose world has z up, in
                which a level camera looks along x; else, with *T_base_camera*, that.
            T_base_camera: ``(4, 4)`` mount of the camera on the robot's base, metres; x of the base is ahead,
                z up.  With it the world is the frame of the base at the first image, unless *T_world_start*
                or an IMU gives another one, and `track` takes wheel odometry.
            planar: Whether the base stays in the plane z = 0 of the world, without roll and pitch: on one
                floor without ramps.  Poses of a camera with depth then keep to it.  Needs *T_base_camera*;
                a world by *T_world_start* or an IMU has no such plane.
            keyframes_of: Name of the robot whose keyframes are kept for `encoded_map`, about 50 kB each.
                Empty: none is kept.
            adds_frames: Whether each frame with depth is added to the map.  With False the caller adds
                what it wants to `map`.
            recorder: Receives each frame before it is tracked, and the points of each map that is saved.
            holds_world: Whether poses that were returned must stay: the world is not turned when gravity
                becomes known, and keyframes of stereo pairs are not adjusted at the end.
            features: Function that finds the features of an image; None: ORB.
            motion: Function that predicts the pose of the next frame; None: constant velocity.
            loops: Function that describes an image for place recognition; None: the features describe it.
            optimiser: Function for the bundle adjustment of a camera without depth; None: the built-in one.

        Raises:
            UsageError: An argument that must be a function is none, *features* has no name,
                *T_base_camera* is no pose, or *planar* has no *T_base_camera*.
        """
        self.camera = camera
        """Intrinsics of all frames: the argument *camera*, else those of the first frame, and None before."""
        self.T_body_camera: Array | None = None
        """Pose ``(4, 4)`` of the camera in the body frame of its rig, metres; None without a rig."""
        self._ask = ask
        self._options = options
        self._monocular_options = monocular
        self._uses_depth = depth
        self._scale: OdometryScale | MarkerScale | ImuScale | None = scale
        self._imu: ImuEstimator | None = None
        self._odometry_start_s = self._last_stamp_s = float("-inf")
        self._is_depth_unit_checked = False
        self._holds_poses = holds_world
        self._holds_world = holds_world or T_world_start is not None
        self._is_upright = False
        self._disparity_deviation_px = float("nan")
        self._map_options = map_options or MapOptions()
        self._T_world_start = T_world_start
        self._tracker: Tracker | MonocularTracker | None = None
        self._records = DriveRecords(self._map_options)
        self._keyframes_of = keyframes_of
        self._adds_frames = adds_frames
        self._recorder = recorder
        if planar and T_base_camera is None:
            raise UsageError(
                "planar says how the base moves, and the mount of the camera is not known",
                hint="give T_base_camera, too",
            )
        self._wheels = None if T_base_camera is None else WheelOdometry(T_base_camera)
        self._is_planar = planar
        self._base_covariance = BaseCovariance()
        self._newest_segment, self._last_visual_s = 0, float("-inf")
        self._image, self._image_s = b"", float("-inf")  # the newest image, and when it came first
        plugins = Plugins.wrap(features=features, motion=motion, loops=loops, optimiser=optimiser)
        self._plugins = replace(plugins, wheels=self._wheels)
        self._processed_joins = 0  # joins that were applied; with a monocular tracker, plus its loop closures
        self._depth_source: Literal["depth", "stereo"] = "depth"
        self._metric_segments: set[int] = set()  # segments of a monocular tracker whose scale is known
        self._frame_lock = asyncio.Lock()
        self._round_trips_ms: list[float] = []
        self._answer_sources: Counter[str] = Counter()
        self._lost_reasons: Counter[str] = Counter()
        self._start_reason = ""

    async def track(
        self, frame: Frame, *, position_m: Array | None = None, odometry: Sequence[OdometryReading] = ()
    ) -> TrackedFrame:
        """Return the pose of the next frame, or the reason why it has none.

        Images are processed in a thread.  A call waits until the call for the frame before has returned.

        Args:
            frame: Next frame of the same camera, in the order of time.
            position_m: ``(3,)`` position of the camera by the robot's odometry, metres, for `OdometryScale`.
            odometry: Readings of the wheels since the last call, in the order of time, in any fixed frame.
                The motion to the time of the frame is interpolated, and extrapolated by at most 0.1 s.

        Raises:
            UsageError: The frame is of another camera, not later than the one before, or the median of its
                depths is impossible in metres; or there is *odometry* without *T_base_camera*, or that goes
                back in time: such a call changes nothing.  Or a function of the user, such as *features*,
                failed.
            ConfigurationError: The function that answers pose queries cannot work, such as without a package.
        """
        async with self._frame_lock:
            # 1. Refuse a frame of another camera, of an earlier time, or with impossible depths.
            self._check_odometry(odometry)
            self._check(frame)
            if self._wheels is not None:
                self._wheels.add(odometry)
            if self._recorder is not None:
                self._recorder.record_frame(frame.timestamp_s, frame.rgb)
            # 2. Choose the tracker with the first frame, and add the frame's IMU samples.
            tracker = self._tracker_for(frame)
            if self._imu is not None and frame.imu is not None:
                self._imu.add(frame.imu)
            # 3. Match the frame, and solve the pose queries that the tracker yields one after the other.
            prepare = tracker.skip if self._is_repeated(frame) else tracker.prepare
            step = await _run_in_thread(tracker, functools.partial(prepare, frame))
            answer: PoseAnswer | None = None
            failure, is_missing = "", False
            while isinstance(step, PoseQuery):
                try:
                    answer, failure, is_missing = await self._ask(step), "", False
                except ConfigurationError:
                    _close_query(tracker, step)
                    raise
                except RsePfError as error:
                    answer, failure = None, f"{error.code}: {error.message}"
                    is_missing = not isinstance(error, PnpError)
                except BaseException:
                    _close_query(tracker, step)
                    raise
                solution = None if answer is None else answer.solution
                accept = functools.partial(
                    tracker.accept,
                    step,
                    None if solution is None else solution.T_camera_world,
                    0 if solution is None else len(solution.inliers),
                    is_weak=solution is not None and solution.verdict == "weak",
                    is_missing=is_missing,
                )
                step = await _run_in_thread(tracker, accept)
            # 4. Add the result to trajectory and map; apply joins, gravity and scale.
            return await asyncio.to_thread(self._finish, step, answer, failure, position_m)

    @property
    def odometry_trouble(self) -> str:
        """Why the wheel odometry is not used, as one sentence; empty if it is used, or there is none."""
        return "" if self._wheels is None else self._wheels.trouble

    @property
    def map(self) -> PointMap:
        """Points so far of segment 0 and of all segments that were joined to it, or connected by wheels.

        They are depth readings, features of stereo pairs, or landmarks of a camera without depth.
        With depth this is the map itself: later frames are added to it.  A turn of the world or an adjustment
        makes another map, and one that was returned before gets no more frames; once wheels have connected a
        segment, it is made anew at each access.  Of a camera without depth it
        is made anew from the landmarks at each access, and later frames do not change it.
        """
        tracker = self._tracker
        if not isinstance(tracker, MonocularTracker):
            return self._records.cloud
        return self._read_segments(tracker).cloud

    @property
    def trajectory(self) -> Trajectory:
        """Poses of segment 0 and of all segments that were joined to it, with all corrections.

        Segments that wheels have connected with it belong to it; poses that wheels have carried do not.
        """
        if isinstance(self._tracker, MonocularTracker):
            return self._tracker.world_trajectory()
        return self._records.trajectory()

    @property
    def frames(self) -> int:
        """Number of frames given to `track` so far, with or without a pose."""
        return 0 if self._tracker is None else self._tracker.frames

    def restart_clock(self) -> None:
        """Accept a next frame with an earlier time stamp, such as after a bag was started again."""
        self._last_stamp_s = float("-inf")
        if self._wheels is not None:
            self._wheels.clear()

    @property
    def lost_frames(self) -> int:
        """Number of frames without a pose by the camera, also those whose pose the wheels have carried.

        Frames before the start of a camera without depth do not count.
        """
        return 0 if self._tracker is None else self._tracker.lost_frames

    @property
    def frames_before_start(self) -> int:
        """Number of frames of a camera without depth before it had moved enough to begin."""
        return self._tracker.starting_frames if isinstance(self._tracker, MonocularTracker) else 0

    @property
    def start_reason(self) -> str:
        """Why a camera without depth has no first pose yet, such as that it only turns; empty once it has."""
        return self._start_reason

    @property
    def keyframes(self) -> int:
        """Number of keyframes in all segments; with depth also those that the tracker has thinned out."""
        return 0 if self._tracker is None else self._tracker.keyframes

    @property
    def scale(self) -> str:
        """Source of the metric scale of segment 0.

        ``metric, by depth``, ``metric, by stereo``, ``metric, by `` and the name of the source of scale,
        ``up to scale``, or ``unknown: no frame yet``.
        """
        if self._tracker is None:
            return "unknown: no frame yet"
        if isinstance(self._tracker, Tracker):
            return f"metric, by {self._depth_source}"
        return (
            f"metric, by {self._scale.name}" if 0 in self._metric_segments and self._scale else _UP_TO_SCALE
        )

    @property
    def imu(self) -> str:
        """State of the IMU: ``none``, ``used``, ``not used yet``, or ``not used: `` with the reason.

        ``none``: the first frame had no samples.  ``not used yet``: no alignment with the poses of the camera
        was tried, or the newest one did not succeed.  ``not used``: the samples are faulty or contradict the
        camera.
        """
        if self._imu is None:
            return "none"
        if self._imu.trouble:
            return f"not used: {self._imu.trouble}"
        return "not used yet" if self._imu.alignment is None else "used"

    @property
    def gravity(self) -> Array | None:
        """Gravity ``(3,)`` in the world, m/s^2; None while its direction is uncertain (1 sigma > 0.5 deg)."""
        return None if self._imu is None else self._imu.gravity_m_s2

    def keyframe_imu(
        self, T_world_camera: Array, previous_s: float | None, timestamp_s: float
    ) -> KeyframeImu | None:
        """Return gravity and preintegrated motion for a keyframe; None without an IMU or known gravity.

        The arguments are those of `ImuEstimator.keyframe_imu`.
        """
        return None if self._imu is None else self._imu.keyframe_imu(T_world_camera, previous_s, timestamp_s)

    @property
    def unrecognised(self) -> int:
        """Number of frames without a pose since the last pose; only of a camera with depth, else 0.

        Frames with too few features, such as those of a covered lens, do not count.
        """
        return self._tracker.unrecognised if isinstance(self._tracker, Tracker) else 0

    @property
    def monocular_tracker(self) -> MonocularTracker | None:
        """The tracker of a camera without depth; None with depth, and before the first frame."""
        return self._tracker if isinstance(self._tracker, MonocularTracker) else None

    @property
    def features(self) -> Features | None:
        """Features of the last frame, if it has a pose; None otherwise, and without depth."""
        return self._tracker.last_features if isinstance(self._tracker, Tracker) else None

    @property
    def depth_noise(self) -> DepthNoise:
        """Noise of depths as measured during the drive; of a Kinect if the camera has no depth."""
        return self._tracker.noise.noise if isinstance(self._tracker, Tracker) else DepthNoise()

    @property
    def _contradicts_wheels(self) -> bool:
        return isinstance(self._tracker, Tracker) and self._tracker.contradicts_wheels

    def carry(self, timestamp_s: float, odometry: Sequence[OdometryReading]) -> Array | None:
        """Add readings of the wheels, and return ``T_world_camera`` ``(4, 4)`` as they carry it to a time.

        *timestamp_s* is that of the next frame, in seconds, which is then tracked without these readings.
        None if there is no pose, or the wheels do not tell the motion since, or images contradict them.

        Raises:
            UsageError: As by `track`.
        """
        self._check_odometry(odometry)
        if self._wheels is not None:
            self._wheels.add(odometry)
        if self._wheels is None or self._tracker is None or self._tracker.last_pose is None:
            return None
        if self._contradicts_wheels:
            return None
        last_s, T_world_camera = self._tracker.last_pose
        motion = self._wheels.motion(last_s, timestamp_s)
        return None if motion is None else orthonormalise(T_world_camera @ motion.T_camera_begin_end)

    def restart(self, T_world_start: Array, timestamp_s: float | None = None) -> None:
        """Begin another world: the next frame with enough features gets the ``(4, 4)`` pose *T_world_start*.

        With *timestamp_s* this is the pose at that time, and wheels carry it to that frame.  The tracker
        forgets its keyframes, and gravity is estimated anew from the poses that follow.  Poses and points so
        far stay in `trajectory` and `map`, and those that follow are added to them as they are.

        Raises:
            UsageError: The camera has no depth, or no frame was tracked, or a frame is being tracked.
        """
        if not isinstance(self._tracker, Tracker):
            raise UsageError(
                "only a mapper that has tracked frames with depth can restart at a given pose",
                hint="make another mapper with T_world_start",
            )
        self._tracker.restart(T_world_start, timestamp_s)
        if self._imu is not None:
            stamps_s = self._records.first.stamps_s
            self._odometry_start_s = max(stamps_s, default=self._odometry_start_s)
            self._imu.forget_gravity()

    def report(self) -> dict[str, Any]:
        """Return the figures of the drive, which `save` writes to ``report.json``.

        ``map_points`` is the number of all voxels of the map, but in ``report.json`` of the saved ones only.
        Because `save` adjusts the keyframes first, other figures may differ from those before it as well.
        """
        trips = np.array(self._round_trips_ms)
        trajectory, separate = self.trajectory, self._separate_segments()
        offset: dict[str, float] = {}
        if isinstance(self._tracker, Tracker) and np.isfinite(self._disparity_deviation_px):
            offset["disparity_offset_px"] = round(self._tracker.disparity_offset_px, 3)
            offset["disparity_offset_deviation_px"] = round(self._disparity_deviation_px, 3)
        return {
            "frames": self.frames,
            "lost_frames": self.lost_frames,
            "frames_before_start": self.frames_before_start,
            "not_started_because": self.start_reason,
            "keyframes": self.keyframes,
            "segments_apart": len(separate),
            "frames_apart": sum(len(record.poses) for record, _ in separate),
            "scale": self.scale,
            **offset,
            **({} if self._imu is None else {"imu": self.imu}),
            **({} if self.T_body_camera is None else {"T_body_camera": self.T_body_camera.tolist()}),
            "unit": "unit of the map" if self.scale == _UP_TO_SCALE else "m",
            "path": round(trajectory.length_m, 3) if len(trajectory) > 1 else 0.0,
            "map_points": len(self.map),
            "answered_by": dict(self._answer_sources),
            "round_trip_ms": {
                f"p{q}": round(float(np.percentile(trips, q)), 2) if len(trips) else None
                for q in (50, 95, 99)
            },
            "lost_because": dict(self._lost_reasons.most_common(5)),
        }

    def encoded_map(self) -> bytes:
        """Return cloud and keyframes of segment 0 as one encoded map.

        `DataClient.update_map` stores it for the tenant, `merge_maps` merges several, and the service
        ``localise`` finds cameras in it.

        Raises:
            UsageError: There is no keyframe in metres: the scale is not known, or *keyframes_of* is empty.
        """
        return encode_map(self._map_version())

    def floor_plan(self, options: GridOptions | None = None) -> OccupancyGrid:
        """Return the floor plan of segment 0 so far: which cells are occupied, free or unknown.

        It takes about a second for a drive of 100 m; call it in a thread.  With *T_base_camera* the floor is
        where the wheels stand: heights are measured from the base at the nearest keyframe.

        Args:
            options: Size of the cells, heights of robot and floor, and the direction up.  None: cells of
                5 cm; up by the IMU, else across the floor; the lowest large horizontal surface is the floor.

        Raises:
            UsageError: There is no keyframe in metres (see `encoded_map`), or the map shows no floor.
        """
        version = self._map_version()
        if self._wheels is not None and self._is_upright:
            version = level_map(version, self._wheels.T_base_camera)
        return make_occupancy_grid(version, options or GridOptions(), max_lines=_MAX_PLAN_LINES)

    def save(self, folder: Path) -> dict[str, Any]:
        """Write ``map.ply``, ``trajectory.txt`` and ``report.json`` to a folder; return the report.

        Keyframes of stereo pairs and of a camera without depth are adjusted before, which takes seconds;
        those of stereo pairs change only if `adjust_pairs` finds a clear offset of the disparities.  With an
        IMU, the world is turned so that z points up if gravity is known, unless *holds_world* or
        *T_world_start* forbids it.

        A map with depth has the voxels with at least two depth readings, and the report counts only these.
        Segments that were not joined to segment 0 have files of their own: ``map-2.ply``,
        ``trajectory-2.txt`` and so on.  With a rig and in metres, ``trajectory-body.txt`` has the poses of
        the rig's body.

        Raises:
            UsageError: The folder cannot be written, or a frame is being tracked.
        """
        # 1. Adjust the keyframes, and bring segments to metric scale and z up.
        if isinstance(self._tracker, MonocularTracker):
            self._tracker.adjust()
            for segment in self._metric_segments:
                self._apply_scale(self._tracker, segment)
        elif self._tracker is not None:
            self.adjust_pairs()
            if self._imu is not None:
                self._align_imu(self._tracker)
                self._turn_upright(self._tracker)
        # 2. Collect the report, and the points of the voxels that were read often enough.
        report = self.report()
        points, colours = self.map.points(min_readings=self._min_readings)
        report["map_points"] = len(points)
        if self._recorder is not None:
            self._recorder.record_map(points)
        # 3. Write the files of segment 0, then those of the separate segments.
        is_metric = self.scale != _UP_TO_SCALE
        body = self.T_body_camera
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_ply(folder / "map.ply", points, colours, is_metric=is_metric)
            path = folder / "trajectory.txt"
            write_trajectory(path, self.trajectory, is_metric=is_metric, T_body_camera=body)
            for number, (record, is_metric) in enumerate(self._separate_segments(), start=2):
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
        """Adjust the keyframes of stereo pairs together with an offset of their disparities, as `save` does.

        Each segment has one offset.  Where it is clear, poses, keyframes and cloud of the segment are
        corrected.

        Returns:
            The adjustment of each segment by its number, also those that are not clear enough to move poses.
            Empty for other cameras, and for a mapper with *holds_world*.
        """
        tracker = self._tracker
        if not isinstance(tracker, Tracker) or self._depth_source != "stereo" or self._holds_poses:
            return {}
        adjusted = tracker.adjust_pairs()
        self._records.correct(adjusted)
        if tracker.segment in adjusted:
            self._disparity_deviation_px = adjusted[tracker.segment].deviation_px
        return tracker.pair_offsets

    # --- Contents of the map ---

    def _map_version(self) -> MapVersion:
        """Return cloud and keyframes of segment 0; raises UsageError as `encoded_map`."""
        keyframes = self._metric_keyframes()
        if not keyframes:
            raise UsageError(
                "no keyframe was kept in metres, so there is no map to share",
                hint="make the mapper with keyframes_of=ROBOT, and give it frames with depth, or a scale",
            )
        points, colours = self.map.points(min_readings=self._min_readings)
        provenance: dict[str, Any] = {"made_by": "mapper", "robot": self._keyframes_of}
        if self._is_upright:
            provenance[UP_FIELD] = list(UP)
        numbered = tuple(replace(keyframe, id=number) for number, keyframe in enumerate(keyframes))
        return MapVersion(keyframes=numbered, points=points, colours=colours, provenance=provenance)

    def _metric_keyframes(self) -> list[Keyframe]:
        """Return the keyframes of segment 0 if they are in metres, else none; only these may be shared."""
        tracker = self._tracker
        if not isinstance(tracker, MonocularTracker):
            return self._records.keyframes
        if not self._keyframes_of or self.camera is None or self.scale == _UP_TO_SCALE:
            return []
        return landmark_keyframes(tracker, self.camera, self._keyframes_of)

    @property
    def _min_readings(self) -> int:
        """Least readings of a voxel in a saved map: 2, and 1 for maps of features (stereo and landmarks)."""
        is_sparse = isinstance(self._tracker, MonocularTracker) or self._depth_source == "stereo"
        return 1 if is_sparse else _MIN_READINGS

    def _read_segments(self, tracker: MonocularTracker) -> SegmentRecord:
        """Return segment 0 of a tracker without depth, and all that wheels have connected with its world."""
        record = read_segment(tracker, 0, self._map_options)
        for number in sorted(tracker.connected):
            record.append(read_segment(tracker, number, self._map_options), np.eye(4))
        return record

    def _separate_segments(self) -> list[tuple[SegmentRecord, bool]]:
        """Return the segments that were not joined to segment 0, and whether they are in metres."""
        tracker = self._tracker
        if not isinstance(tracker, MonocularTracker):
            return [(record, True) for record in self._records.apart]
        return [
            (read_segment(tracker, number, self._map_options), number in self._metric_segments)
            for number in tracker.segments[1:]
            if number not in tracker.connected
        ]

    # --- Check of each frame, and choice of the tracker by the first one ---

    def _check_odometry(self, readings: Sequence[OdometryReading]) -> None:
        """Refuse readings without a mount, and readings that go back in time; raises UsageError."""
        if self._wheels is not None:
            self._wheels.check(readings)
        elif len(readings):
            raise UsageError(
                "odometry of the wheels does not tell how the camera moves without its mount",
                hint="make the mapper with T_base_camera, the (4, 4) pose of the camera on the base",
            )

    def _check(self, frame: Frame) -> None:
        """Note camera and time of a frame that can be tracked.

        Raises:
            UsageError: The frame is of another camera than the mapper or the frames before, not later than
                the frame before, or, without a stereo pair, the median of its depths is impossible in metres;
                such a frame changes nothing.
        """
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
        if not self._is_depth_unit_checked and frame.stereo is None:
            median_m = median_depth_m([frame.depth_m])
            depth = DepthFacts(median_m=median_m, units_per_m=1.0, is_unit_stated=True)
            check_source(SourceFacts(name="a frame", depth=depth))
            self._is_depth_unit_checked = median_m is not None
        self.camera, self._last_stamp_s = camera, frame.timestamp_s

    def _tracker_for(self, frame: Frame) -> Tracker | MonocularTracker:
        """Return the tracker, which the first frame chooses: with depth, with a stereo pair, or monocular.

        The IMU is started if the first frame has samples of it.
        """
        if self.T_body_camera is None:
            self.T_body_camera = frame.T_body_camera
        if self._tracker is None:
            if frame.imu is not None:
                self._start_imu(frame.imu, frame.camera)
            elif self._T_world_start is None and self._wheels is not None:
                self._T_world_start, self._is_upright = self._wheels.T_base_camera, True
                self._wheels.is_planar = self._is_planar
            has_depth = bool(frame.depth_m.any()) if self._uses_depth is None else self._uses_depth
            if frame.stereo is not None or has_depth:
                self._depth_source = "depth" if frame.stereo is None else "stereo"
                self._tracker = Tracker(self._options, self._T_world_start, self._plugins)
            else:
                self._base_covariance.expect_one_lens()
                if self._scale is None and self._wheels is not None:
                    self._scale = OdometryScale()
                self._tracker = MonocularTracker(self._monocular_options, self._T_world_start, self._plugins)
        return self._tracker

    def _start_imu(self, samples: ImuSamples, camera: Camera) -> None:
        """Start the IMU estimator; gravity levels the first camera, unless its pose was given."""
        self._imu = ImuEstimator(samples.model, camera)
        self._imu.add(samples)
        self._plugins = replace(self._plugins, inertial=self._imu)
        self._scale = self._scale or ImuScale(self._imu)
        if self._T_world_start is None:
            self._T_world_start = level_start_pose(self._imu.stationary_gravity())

    def _is_repeated(self, frame: Frame) -> bool:
        """Return whether an image repeats although the wheels have moved since it came first."""
        if self._wheels is None:
            return False
        image = frame.rgb.tobytes()
        if image != self._image:
            self._image, self._image_s = image, frame.timestamp_s
            return False
        motion = self._wheels.motion(self._image_s, frame.timestamp_s)
        return motion is not None and motion.is_clear

    # --- Result of a frame ---

    def _finish(
        self, tracked: TrackedFrame, answer: PoseAnswer | None, failure: str, position_m: Array | None
    ) -> TrackedFrame:
        """Complete the result of a frame, and add the frame to trajectory and map.

        A pose that the wheels carry is added afterwards: neither trajectory nor map contain it.
        """
        tracked = self._finish_visual(tracked, answer, failure, position_m)
        if self._wheels is None or tracked.status == "starting" or tracked.scale != "metric":
            return tracked
        return self._add_base(self._wheels, tracked)

    def _add_base(self, wheels: WheelOdometry, tracked: TrackedFrame) -> TrackedFrame:
        """Return the result of a frame with the pose of the base, carried by the wheels if it has none.

        The wheels do not carry it if images show another place than they tell.
        """
        tracker, pose, now_s = self._tracker, tracked.T_world_camera, tracked.frame.timestamp_s
        last = None if tracker is None else tracker.last_pose
        uncertainty = self._base_covariance
        if pose is not None:
            T_world_base = wheels.base_pose(pose)
            if tracked.segment > self._newest_segment:
                uncertainty.begin(T_world_base, wheels.motion(self._last_visual_s, now_s))
                self._newest_segment = tracked.segment
            self._last_visual_s = now_s
            world = tracked.segment, self._processed_joins, self._is_upright
            wheels.compare(now_s, T_world_base, world)
            covariance = uncertainty.add_visual(T_world_base, pose, tracked.covariance)
            return replace(tracked, T_world_base=T_world_base, pose_covariance=covariance)
        motion = None if last is None else wheels.motion(last[0], now_s)
        if last is None or motion is None:
            return tracked
        if self._contradicts_wheels:
            return replace(tracked, reason=CONTRADICTED)
        pose = orthonormalise(last[1] @ motion.T_camera_begin_end)
        T_world_base = wheels.base_pose(pose)
        return replace(
            tracked,
            T_world_camera=pose,
            status="odometry",
            T_world_base=T_world_base,
            pose_covariance=uncertainty.carried(T_world_base, motion),
        )

    def _finish_visual(
        self, tracked: TrackedFrame, answer: PoseAnswer | None, failure: str, position_m: Array | None
    ) -> TrackedFrame:
        """Complete the result of a frame by its image, and add the frame to trajectory and map.

        *failure* is why the last pose query was not answered, empty if it was.
        """
        tracker, pose = self._tracker, tracked.T_world_camera
        assert tracker is not None
        # 1. Say why there is no pose, or why the pose is weak.
        reason = tracked.reason or (failure if pose is None else "")
        if pose is None and not reason:
            reason = f"only {tracked.matches} matches, or their pose is not plausible"
            if not tracked.matches:
                reason = "no matches: it shows nothing that was seen just before"
        if pose is not None and answer is not None and answer.solution.verdict == "weak":
            reason = answer.solution.reason
        # 2. Set the status: lost without a pose, first for the first pose of a camera with depth.
        status = tracked.status
        if pose is None and status == "tracked":
            status = "lost"
        if status == "lost":
            self._lost_reasons[reason] += 1
        self._start_reason = reason if status == "starting" else ""
        if isinstance(tracker, Tracker) and pose is not None and not self._records.first.poses:
            status = "first"
        # 3. Count round trip and source of the last answer, and add them to the result with its covariance.
        if answer is not None:
            self._round_trips_ms.append(answer.round_trip_ms)
            self._answer_sources[answer.source] += 1
        tracked = replace(
            tracked,
            status=status,
            reason=reason,
            covariance=None if answer is None or pose is None else answer.solution.covariance,
            source="none" if answer is None else answer.source,
            round_trip_ms=None if answer is None else answer.round_trip_ms,
        )
        # 4. Without depth, the tracker holds trajectory and map itself: only the scale is left to apply.
        if isinstance(tracker, MonocularTracker):
            return self._finish_monocular(tracker, tracked, position_m)
        # 5. With depth, add the frame to the record of its segment, then apply joins and gravity.
        self._records.connected = tracker.connected
        if pose is not None:
            record = self._records.add(tracked, pose)
            if self._adds_frames:
                self._records.add_to_cloud(tracked, pose, tracker.last_features)
            if tracked.keyframe and self._keyframes_of and tracker.last_features is not None:
                record.keyframes.append(
                    make_keyframe(tracked, pose, tracker.last_features, self._keyframes_of)
                )
        return self._apply_gravity(tracker, self._apply_joins(tracker, tracked))

    def _apply_joins(self, tracker: Tracker, tracked: TrackedFrame) -> TrackedFrame:
        """Move each segment that was joined since the last frame into the world of the older segment.

        Return *tracked*, marked as corrected if there were any: poses that were returned before have moved.
        """
        joins = tracker.joins[self._processed_joins :]
        for join in joins:
            self._records.join(join)
        if joins:
            self._base_covariance.correct()
        self._processed_joins = len(tracker.joins)
        return replace(tracked, corrected=bool(joins))

    def _apply_gravity(self, tracker: Tracker, tracked: TrackedFrame) -> TrackedFrame:
        """Align the IMU when it is due; turn the world once, which corrects all poses returned before."""
        imu, pose = self._imu, tracked.T_world_camera
        if imu is None or pose is None or not imu.is_due(tracked.frame.timestamp_s):
            return tracked
        self._align_imu(tracker)
        T_new_old = None if self._is_upright else self._turn_upright(tracker)
        if T_new_old is None:
            return tracked
        return replace(tracked, T_world_camera=T_new_old @ pose, corrected=True, T_new_old=T_new_old)

    def _align_imu(self, tracker: Tracker) -> None:
        """Estimate gravity and biases from the poses of segment 0 since the last `restart`, in metres."""
        assert self._imu is not None
        path = self._records.trajectory()
        first = int(np.searchsorted(path.timestamps_s, self._odometry_start_s, side="right"))
        depths_m = np.empty(0) if tracker.last_features is None else tracker.last_features.points_camera[:, 2]
        depths_m = depths_m[np.isfinite(depths_m)]
        depth_m = float(np.median(depths_m)) if len(depths_m) else _DEFAULT_DEPTH_M
        self._imu.align(path.timestamps_s[first:], path.T_world_camera[first:], depth_m, is_metric=True)

    def _turn_upright(self, tracker: Tracker | MonocularTracker) -> Array | None:
        """Turn the world so that z points up, if gravity is known and the world may be turned.

        Return ``T_new_old`` ``(4, 4)``, or None if the world was not turned.
        """
        gravity = self.gravity
        if gravity is None or self._holds_world:
            return None
        T_new_old = upright_rotation(gravity)
        tracker.turn(T_new_old)
        if isinstance(tracker, Tracker):
            self._records.turn(T_new_old)
        self._is_upright = True
        return T_new_old

    def _finish_monocular(
        self, tracker: MonocularTracker, tracked: TrackedFrame, position_m: Array | None
    ) -> TrackedFrame:
        """Return the result in metres, if the scale of its segment is known.

        A keyframe, and a scale that becomes known or better, correct poses that were returned before.
        """
        frame, segment, scale = tracked.frame, tracked.segment, self._scale
        is_corrected = tracked.keyframe
        joins_and_loops = tracker.loops + len(tracker.joins)
        if joins_and_loops != self._processed_joins:
            self._base_covariance.correct()
        self._metric_segments.intersection_update(tracker.segments)
        if scale is not None:
            is_known = segment in self._metric_segments
            is_due = scale.is_due(frame.timestamp_s, is_known=is_known)
            if is_due or joins_and_loops != self._processed_joins:
                if position_m is None and self._wheels is not None:
                    position_m = self._wheels.camera_position(frame.timestamp_s)
                if not is_known:
                    scale.observe(frame.timestamp_s, frame.rgb, position_m)
                if tracked.T_world_camera is not None and self._apply_scale(tracker, segment):
                    is_corrected = True
                    newest_pose = tracker.trajectory(segment).T_world_camera[-1]
                    tracked = replace(tracked, T_world_camera=newest_pose)
        self._processed_joins = joins_and_loops
        is_metric = segment in self._metric_segments or segment in tracker.connected
        return replace(tracked, corrected=is_corrected, scale="metric" if is_metric else _UP_TO_SCALE)

    def _apply_scale(self, tracker: MonocularTracker, segment: int) -> bool:
        """Scale a segment of *tracker* to metres by the newest estimate; return False if there is none.

        With segment 0 the world is turned so that z points up, if gravity is known and the world may be
        turned.
        """
        if self._scale is None or self.camera is None:
            return False
        path = tracker.trajectory(segment)
        depth = tracker.median_depth(segment)
        scale = self._scale.metres_per_unit(path.timestamps_s, path.T_world_camera, self.camera, depth)
        if scale is None:
            return False
        tracker.rescale(scale, segment)
        self._metric_segments.add(segment)
        if segment == min(tracker.segments):
            self._turn_upright(tracker)
        return True


async def _run_in_thread(
    tracker: Tracker | MonocularTracker, work: Callable[[], PoseQuery | TrackedFrame]
) -> PoseQuery | TrackedFrame:
    """Run a step of a tracker in a thread and return its result.

    A cancellation waits for the step, which cannot be stopped, and closes the query that the step returned.
    """
    task = asyncio.ensure_future(asyncio.to_thread(work))
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        step = await task
        if isinstance(step, PoseQuery):
            _close_query(tracker, step)
        raise


def _close_query(tracker: Tracker | MonocularTracker, query: PoseQuery) -> None:
    """Answer a query and all that follow it with no pose, so that the tracker can take the next frame."""
    step: PoseQuery | TrackedFrame = query
    while isinstance(step, PoseQuery):
        step = tracker.accept(step, None)
