"""Track a camera and share its keyframes with other robots in one live map.

`LiveMapper` tracks as `client_sdk.mapper.Mapper` does, sends keyframes in the background, and knows the pose
of its odometry frame in the map.  `client_sdk.live` lists the way of a keyframe step by step.

**Two poses.**  ``tracked.T_world_camera`` is the pose in the robot's odometry frame, to which the map never
applies a correction; control loops use this one.  ``tracked.T_map_camera`` is the pose in the map, None until
the segment is aligned.

**Corrections.**  Each change of an alignment is a `Correction`.  It is in `LiveMapper.corrections` before a
pose uses it, and the first tracked frame after a correction of its segment has ``corrected`` set.

**Segments.**  A segment is one odometry frame.  After `LiveOptions.segment_after` lost frames with enough
features a new segment begins: its first pose is the last known one, and it has an alignment of its own.  With
wheel odometry it begins earlier, at the carried pose, and keeps the last alignment until it has its own.

**A camera without depth** is tracked up to scale.  Its keyframes are sent in the unit of their segment, each
when two newer ones exist.  The map finds the metric scale (`LiveMapper.metres_per_unit`), so that
``T_map_camera`` is in metres, while ``T_world_camera`` stays in the unit of the segment.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Features, Frame, FrontEndOptions, PoseQuery, TrackedFrame
from client_sdk.live.alignments import Alignments, Correction, CorrectionStream, OtherRobot
from client_sdk.live.attachments import Attachments, EncodedAttachments, StoreObject
from client_sdk.live.floor_plans import FloorPlans
from client_sdk.live.keyframe_encoding import encode_depth_keyframe, encode_monocular_keyframe
from client_sdk.live.keyframe_queue import KeyframeQueue, NumberOffset, QueuedKeyframe
from client_sdk.live.keyframe_sender import REFUSALS, KeyframeSender, KeyframeSent, LiveRobot, MapShown
from client_sdk.live.monocular_odometry import MonocularOdometry
from client_sdk.live.options import LiveOptions
from client_sdk.live.relocaliser import Relocaliser
from client_sdk.mapper import Mapper
from client_sdk.plugins import FeaturesFunction, LoopsFunction, MotionFunction
from client_sdk.point_map import MapOptions, PointMap
from client_sdk.pose_answers import AskPose
from client_sdk.tracking.monocular_segment import AdjustedKeyframe
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.segment_join import carried_segment_after
from client_sdk.tracking.segments import add_to_cloud
from client_sdk.trajectory import Trajectory
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.errors import BadMessage, BadRequest, RsePfError, UnsupportedProtocol, UsageError
from rse_pf.geometry import Array, Camera, pose_difference
from rse_pf.slam.localise import PosePrior
from rse_pf.slam.occupancy import GridOptions, OccupancyGrid
from rse_pf.wire.live_map import live_topic

__all__ = ["LiveMapper"]

_JOIN_REFUSALS = (*REFUSALS, BadRequest, UnsupportedProtocol)
"""Errors with which the platform refuses a robot that joins a map, and would refuse it again: joining raises
them; after any other error the call is repeated in the background."""
_RESUBSCRIBE_PAUSE_S = 1.0  # pause before the robot subscribes to the map's updates again after a failure
_LEAVE_DEADLINE_S = 1.0  # deadline of the call that leaves the map, so that a lost connection delays no exit
_NEVER = 1_000_000_000
"""``segment_after`` of the tracker: more lost frames than any drive has, so that the tracker never begins a
segment by itself; in a live map `LiveMapper` begins each segment, and numbers it."""
_MAX_SENT_RECORDS = 100_000  # newest acknowledged keyframes whose times are stored: about 13 MB of memory


class LiveMapper:
    """Track a camera and share its keyframes in a live map; made by `Robot.live_map`.

    ::

        async with robot.live_map("warehouse", camera=camera) as mapper:
            async for frame in frames:
                tracked = await mapper.track(frame)
                show(tracked.T_map_camera, mapper.others)
    """

    def __init__(
        self,
        robot: LiveRobot,
        name: str,
        *,
        ask: AskPose,
        camera: Camera | None = None,
        depth: bool | None = None,
        spool: Path | None = None,
        options: FrontEndOptions | None = None,
        live: LiveOptions | None = None,
        map_options: MapOptions | None = None,
        T_world_start: Array | None = None,
        T_base_camera: Array | None = None,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        store: StoreObject | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Store the arguments; ``async with`` joins the map.

        Args:
            robot: The robot that calls the services; it need not be connected yet.
            name: Name of the map: small letters, digits and hyphens.
            ask: Function that computes the pose of a frame from matches of image and cloud, such as that of
                `client_sdk.pose_answers.ask_robot`.
            camera: Intrinsics; frames of another camera are refused.  None takes those of the first frame.
            depth: Whether to use depth.  None: if the first frame has some, or is a stereo pair.  With True a
                first frame without depth is refused.
            spool: Folder of this robot alone for keyframes that the map has not acknowledged, in a subfolder
                for each map; they survive a restart of this program.  None keeps them in memory.
            options: Options of the tracker, of which ``segment_after`` is not used (that of *live* is); None
                means `FrontEndOptions.live`.
            live: Options of keyframes and of their sending; None means `LiveOptions` with its defaults.
            map_options: Density of the robot's own cloud, to which its keyframes are added; None means the
                defaults.
            T_world_start: ``(4, 4)`` pose of the camera at the first frame in the odometry frame (which the
                tracker calls world).  None means the identity; with an IMU it means a pose in an odometry
                frame whose z axis points up, in which a level camera looks along x; else, with
                *T_base_camera*, that.
            T_base_camera: ``(4, 4)`` mount of the camera on the robot's base, metres, see `Mapper`; with it
                `track` takes wheel odometry.
            features: Function that finds the features of an image; None means ORB.  All robots of a map must
                use the same.
            motion: Function that predicts the pose of the next frame; None means constant velocity.
            loops: Function that describes an image for the robot's own place recognition; the map server
                recognises places by the features of keyframes instead.  None means the built-in description.
            store: Stores an object of this robot in the object store; None means that the map gets no points
                and no images of this robot.
            clock: Monotonic time in seconds.

        Raises:
            UsageError: An argument that must be a function is not one, or *features* has no name.
        """
        self.name = name
        self.options = live or LiveOptions()
        self.sent_keyframes: deque[KeyframeSent] = deque(maxlen=_MAX_SENT_RECORDS)
        """Times of the newest 100,000 keyframes that the map has acknowledged in this run."""
        self._robot, self._ask = robot, ask
        self._queue = KeyframeQueue(None if spool is None else spool / name)
        self._sender = KeyframeSender(
            robot,
            name,
            self._queue,
            deadline_s=self.options.deadline_s,
            bytes_per_s=self.options.bytes_per_s,
            clock=clock,
            current_segment=lambda: self._segment,
            on_introduced=self._apply_introduction,
            on_acknowledged=self.sent_keyframes.append,
        )
        self._attachments = Attachments(store, self.options, clock, self._wait_quiet)
        self._relocaliser = Relocaliser(
            robot,
            name,
            self.options,
            clock,
            on_reply=lambda *reply: self._publish(self._alignments.apply_relocalisation(*reply)),
        )
        self._floor_plans = FloorPlans(robot, name, deadline_s=self.options.deadline_s, clock=clock)
        self._mapper = Mapper(
            ask=self._ask_with_priority,
            camera=camera,
            depth=depth,
            options=replace(options or FrontEndOptions.live(), segment_after=_NEVER),
            map_options=map_options,
            T_world_start=T_world_start,
            T_base_camera=T_base_camera,
            adds_frames=False,
            holds_world=True,
            features=features,
            motion=motion,
            loops=loops,
        )
        self._has_depth = depth
        self._monocular_odometry: MonocularOdometry | None = None
        self._alignments = Alignments()
        self._correction_stream = CorrectionStream()
        self._continued: dict[int, int] = {}
        """The segment whose world a segment continues, because the wheels have carried the pose."""
        self._is_corrected = False  # whether the present segment was corrected since the last frame
        self._segment = self._first_segment = 0
        self._last_keyframe: Array | None = None
        self._last_keyframe_s: float | None = None
        self._poses: list[
            tuple[float, int, Array]
        ] = []  # time stamp, segment and T_odom_camera of each frame
        self._made_keyframes = self._dropped_keyframes = 0
        self._tasks: list[asyncio.Task[None]] = []
        self._cloud_update: asyncio.Future[Any] | None = None
        self._update_trouble = ""
        self._frame_lock = asyncio.Lock()
        self._is_introduced = False
        self._is_joined = False

    async def __aenter__(self) -> LiveMapper:
        """Join the map: open the spool folder, and ask the map for this robot's name and numbers.

        A robot without a connection asks as soon as it is connected.  If asking fails with another error than
        those below, it is repeated in the background, and `trouble` says why.

        Raises:
            Forbidden: The token has no scope for this map.
            Unauthorized: The platform does not accept the token.
            UnknownService, UnsupportedProtocol: The platform has no live maps.
            BadRequest: The name of the map is invalid.
            UsageError: The spool folder cannot be used, or another program uses it.
        """
        self._segment = self._first_segment = await asyncio.to_thread(self._queue.open)
        try:
            await self._join()
        except BaseException:
            self._queue.close()
            raise
        return self

    async def _join(self) -> None:
        if self._robot.connected:
            try:
                await self._sender.introduce()
            except _JOIN_REFUSALS:
                raise
            except RsePfError as error:
                self._update_trouble = f"{error.code}: {error.message}"
        if len(self._queue):
            self._sender.notify_added()
        self._is_joined = True
        works = self._sender.run(), self._follow_updates(), self._attachments.run()
        self._tasks = [asyncio.create_task(work) for work in works]

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Send the queued keyframes and attachments, for `LiveOptions.leave_s` at most, and leave the map.

        Nothing is sent without a connection, or if the block was cancelled.  After another exception in the
        block everything is sent as usual, and the exception goes on.  Keyframes that are not acknowledged by
        then stay in the spool folder, or are lost if there is none; `keyframes_waiting` is their number.
        """
        self._is_joined = False
        try:
            await self._wait_for_cloud()
            if self._robot.connected and not isinstance(error, asyncio.CancelledError):
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._wait_sent(), self.options.leave_s)
                with contextlib.suppress(RsePfError):
                    await self._robot.call(
                        "live-leave", {"map": self.name}, deadline_s=_LEAVE_DEADLINE_S, keep=True
                    )
        finally:
            relocalisation = self._relocaliser.task
            tasks = [*self._tasks, *([relocalisation] if relocalisation else [])]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._queue.close()
            self._correction_stream.close()

    async def track(self, frame: Frame, *, odometry: Sequence[OdometryReading] = ()) -> TrackedFrame:
        """Return the pose of the next frame in the odometry frame and in the map, or why there is none.

        Args:
            frame: Next frame of the same camera, in the order of time.
            odometry: Readings of the wheels since the last call, see `Mapper.track`.

        Raises:
            UsageError: The map is not joined, the frame is of another camera, the first frame has no depth
                although *depth* is True, *odometry* is refused as by `Mapper.track`, or a keyframe cannot be
                written to the spool folder.
        """
        if not self._is_joined:
            raise UsageError(
                f"the live map {self.name} is not joined", hint="use async with robot.live_map(...)"
            )
        async with self._frame_lock:
            # 1. Refuse a first frame without depth if *depth* is True.
            has_depth = frame.stereo is not None or frame.depth_m.any()
            if self.frames == 0 and self._has_depth and not has_depth:
                raise UsageError(
                    "the first frame has no depth, which depth=True requires",
                    hint="wait until the camera delivers depth; leave depth=True out if it never does",
                )
            # 2. Begin another segment at the last known pose, if tracking was lost for too long.
            if self._poses and self._mapper.unrecognised:
                carried = self._mapper.carry(frame.timestamp_s, odometry)
                odometry = ()
                after = self.options.segment_after
                if self._mapper.unrecognised >= (after if carried is None else carried_segment_after(after)):
                    self._restart(carried, frame.timestamp_s)
            # 3. Track the frame.
            tracked = await self._mapper.track(frame, odometry=odometry)
            # 4. Without depth, queue the settled keyframes of the tracker.
            tracker = self._mapper.monocular_tracker
            if tracker is not None and tracked.T_world_camera is not None:  # also if it is carried
                tracked = await self._follow_monocular(tracker, tracked, tracked.T_world_camera)
            # 5. With depth, make a keyframe of the frame if it moved far enough from the last keyframe.
            pose = tracked.T_world_camera
            if pose is not None and tracked.pose_source == "visual":
                self._poses.append((frame.timestamp_s, self._segment, pose))
                features = self._mapper.features
                if features is not None and self._is_keyframe(pose):
                    await self._make_keyframe(tracked, pose, features)
            # 6. Compute the pose in the map with the present alignment.
            tracked = replace(
                tracked,
                segment=self._segment,
                T_map_camera=None if pose is None else self._pose_in_map(pose),
                corrected=self._is_corrected,
            )
            self._is_corrected = False
            return tracked

    @property
    def aligned(self) -> bool:
        """Whether the pose of the present odometry frame in the map is known; `reason` says why not."""
        return self.T_map_odom is not None

    @property
    def reason(self) -> str:
        """Why the present segment is not aligned; empty if it is."""
        return self._alignments.get(self._segment).reason

    @property
    def T_map_odom(self) -> Array | None:
        """Pose ``(4, 4)`` of the present odometry frame in the map, metres; None while it is not aligned.

        It maps positions in metres: those in the unit of the odometry frame times `metres_per_unit`.
        """
        return self._alignments.get(self._segment).T_map_odom

    @property
    def metres_per_unit(self) -> float | None:
        """Metric scale of the present odometry frame: 1 with depth; without depth, None until aligned."""
        if self._mapper.monocular_tracker is None:
            return 1.0
        return self._alignments.get(self._segment).metres_per_unit if self.aligned else None

    @property
    def covariance(self) -> Array | None:
        """Covariance ``(6, 6)`` of the error of `T_map_odom`, None if unknown.

        The error is a twist: the true alignment is ``exp(twist) @ T_map_odom``, where the twist is three
        numbers of the translation in metres, then three of the rotation in radians.
        """
        return self._alignments.get(self._segment).covariance

    @property
    def aligned_by(self) -> str:
        """Source of the present segment's alignment: see `client_sdk.live.alignments.AlignedBy`."""
        return self._alignments.get(self._segment).by

    @property
    def segment(self) -> int:
        """Number of the present segment, which is one odometry frame, in the robot's own count.

        The first segment of a run is 0, or one more than that of the newest keyframe in the spool folder.
        With depth, a new segment begins after `LiveOptions.segment_after` lost frames.  Without depth, it
        begins when the tracker begins, changes or joins segments, or when a loop closure corrects lengths by
        more than 3 %.
        """
        return self._segment

    @property
    def others(self) -> dict[str, OtherRobot]:
        """The other robots of the map by their names."""
        return dict(self._alignments.others)

    @property
    def version(self) -> int:
        """Newest position in the log of the map that an update or a reply to a relocalisation has stated."""
        return self._alignments.version

    @property
    def map_keyframes(self) -> int:
        """Number of keyframes of all robots in the map, as far as this robot was notified."""
        return self._alignments.map_keyframes

    @property
    def map_server(self) -> str:
        """Id of the backend server on which the map server (the one process that changes the map) runs.

        Empty until it is known, and while the map moves to another server.
        """
        return self._alignments.map_server

    @property
    def state(self) -> str:
        """State of the map as this robot knows it; the first of these that is true.

        ``refused: ...`` if the platform refuses all keyframes of this robot, ``offline`` without a
        connection, ``joining`` before the first update of the map.  Then the state that the platform reports:
        ``live``, ``moving`` (to another server) or ``waiting for the store`` (the platform cannot use its
        object store, so keyframes are not accepted).
        """
        if self._sender.is_refused:
            return f"refused: {self._sender.trouble}"
        if not self._robot.connected:
            return "offline"
        return self._alignments.map_state or "joining"

    @property
    def trouble(self) -> str:
        """Why something does not work now, as ``code: sentence``; empty if everything works.

        It is the first of these failures that lasts: to send keyframes, to join the map or receive its
        updates, and, while the segment is not aligned, to relocalise.
        """
        relocalisation_trouble = "" if self.aligned else self._relocaliser.trouble
        return self._sender.trouble or self._update_trouble or relocalisation_trouble

    @property
    def odometry_trouble(self) -> str:
        """Why the wheel odometry is not used, see `Mapper.odometry_trouble`."""
        return self._mapper.odometry_trouble

    @property
    def keyframes_waiting(self) -> int:
        """Number of queued keyframes, which the map has neither acknowledged nor refused."""
        return len(self._queue)

    @property
    def features(self) -> Features | None:
        """Features of the last frame, if it has a pose and depth; see `Mapper.features`."""
        return self._mapper.features

    def relocalise(self, prior: PosePrior | None = None) -> None:
        """Relocalise with the next keyframe of an unaligned segment, without the usual pause; return at once.

        Nothing is asked without a connection, and while the map has no other keyframes than those that this
        robot has sent in this run.

        Args:
            prior: Where the camera is now in the map.  The robot sends it, moved with its odometry, until it
                is localised; a segment that was aligned by a relocalisation is relocalised once more.  A
                place within 3 standard deviations then needs less evidence, and is preferred to others that
                look alike; a place elsewhere is accepted as without a prior.
        """
        self._relocaliser.skip_pause()
        if prior is not None:
            has_metres = self._poses and self._mapper.monocular_tracker is None
            self._relocaliser.expect(prior, self._poses[-1][2] if has_metres else None)

    async def floor_plan(
        self, options: GridOptions | None = None, *, max_age_s: float = 0.0
    ) -> OccupancyGrid:
        """Return the floor plan of the whole map: what the keyframes of all its robots have seen.

        The map server makes it, about 0.4 s for 1,200 keyframes.  The robot receives only the cells that have
        changed since its last call, less than 20 kB/s: a call waits until this rate allows it.  If the plan
        has not changed, the same object is returned.

        Args:
            options: Size of the cells, heights of robot and floor, and the direction up.  None for *up*: the
                z axis of the map, which is right if its first robot had a base or an IMU.
            max_age_s: How old a plan may be to which only keyframes were added since; after a correction of
                half a cell a new one is made in any case.

        Raises:
            NotFound: The map shows no floor yet, or its z axis does not point up.
            BadRequest, LimitExceeded: An option is out of its range, or the plan is too large for a message.
            RsePfError: The platform does not answer, or has no floor plans.
        """
        return await self._floor_plans.newest(options or GridOptions(), max_age_s)

    @property
    def map(self) -> PointMap:
        """The robot's own cloud of its keyframes, each at its pose in its odometry frame, metres.

        Alignments are not applied, so the parts of several segments may not fit each other.  The newest
        keyframe may be missing.  For a camera without depth these are the landmarks of `Mapper.map`, in
        metres only if the mapper knows the scale.
        """
        return self._mapper.map

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames, each in the odometry frame of its segment; alignments are not applied.

        Without depth these are the poses of `Mapper.trajectory`: those of the tracker's segment 0, in its
        unit and with its later adjustments.
        """
        return self._mapper.trajectory

    @property
    def map_trajectory(self) -> Trajectory:
        """Poses of all frames of aligned segments in the map, by the newest alignment of each segment."""
        poses_in_map = [
            (timestamp_s, T_map_camera)
            for timestamp_s, segment, T_odom_camera in self._poses
            if (T_map_camera := self._alignments.get(segment).pose_in_map(T_odom_camera)) is not None
        ]
        return Trajectory(
            np.array([timestamp_s for timestamp_s, _ in poses_in_map]),
            np.array([T_map_camera for _, T_map_camera in poses_in_map]).reshape(-1, 4, 4),
        )

    @property
    def frames(self) -> int:
        """Number of frames given to `track` so far, with or without a pose."""
        return self._mapper.frames

    def restart_clock(self) -> None:
        """Accept an earlier time stamp in the next frame, for example because a bag was started again."""
        self._mapper.restart_clock()

    @property
    def lost_frames(self) -> int:
        """Number of frames without a pose; see `Mapper.lost_frames`."""
        return self._mapper.lost_frames

    @property
    def frames_before_start(self) -> int:
        """Number of frames before a camera without depth had moved enough for a first pose."""
        return self._mapper.frames_before_start

    @property
    def start_reason(self) -> str:
        """Why a camera without depth has no first pose yet; empty once it has."""
        return self._mapper.start_reason

    @property
    def keyframes(self) -> int:
        """Number of keyframes that were put into the queue for the map in this run."""
        return self._made_keyframes

    @property
    def scale(self) -> str:
        """Source of the metric scale, as in `Mapper.scale`.

        Without depth: ``metric, by the live map`` once the segment is aligned, else ``up to scale``.
        """
        if self._mapper.monocular_tracker is None:
            return self._mapper.scale
        return "metric, by the live map" if self.aligned else "up to scale"

    @property
    def T_body_camera(self) -> Array | None:
        """Pose ``(4, 4)`` of the camera in the body frame of its rig, metres; None without a rig."""
        return self._mapper.T_body_camera

    def report(self) -> dict[str, Any]:
        """Return the figures of the drive: those of `Mapper.report`, and under ``live`` those of the map.

        All of them are figures of this run of the program: ``segments`` does not count the segments of
        keyframes that an earlier run left in the spool folder.
        """
        return {
            **self._mapper.report(),
            "live": {
                "map": self.name,
                "state": self.state,
                "segments": self._segment - self._first_segment + 1,
                "aligned": self.aligned,
                "aligned_by": self.aligned_by,
                "reason": self.reason,
                "scale": self.scale,
                "metres_per_unit": self.metres_per_unit,
                "keyframes": self._made_keyframes,
                "keyframes_kept": len(self.sent_keyframes),
                "keyframes_waiting": len(self._queue),
                "keyframes_dropped": self._dropped_keyframes,
                "keyframes_refused": self._sender.refused_keyframes,
                "relocalisations": dict(self._relocaliser.verdicts),
                "others": sorted(self._alignments.others),
                **self._attachments.report(),
            },
        }

    def save(self, folder: Path) -> dict[str, Any]:
        """Write `map` and `trajectory` as `Mapper.save` does, and return the report of `Mapper`."""
        return self._mapper.save(folder)

    def corrections(self) -> AsyncIterator[Correction]:
        """Return an iterator over the changes of alignments: the last 1,000 so far, then each new one.

        It ends when the map is left.  A reader with more than 1,000 unread corrections loses the oldest.
        """
        return self._correction_stream.read()

    # --- Segments, and the making of keyframes ---

    def _restart(self, carried: Array | None, timestamp_s: float) -> None:
        """Begin another segment at the pose that the wheels have carried to a time, else at the last one.

        With a carried pose it continues the world of the segment before, and its alignment until it has one.
        """
        if carried is None:
            self._mapper.restart(self._poses[-1][2])
        else:
            self._mapper.restart(carried, timestamp_s)
            self._continued[self._segment + 1] = self._segment
        self._begin_segment()

    def _pose_in_map(self, T_odom_camera: Array) -> Array | None:
        """Return ``T_map_camera`` ``(4, 4)`` of a pose in the present odometry frame; None if not aligned.

        While the segment is not aligned, the alignment of the segments that it continues holds.
        """
        segment = self._segment
        while (T_map_camera := self._alignments.get(segment).pose_in_map(T_odom_camera)) is None:
            if segment not in self._continued:
                return None
            segment = self._continued[segment]
        return T_map_camera

    def _begin_segment(self) -> None:
        """Begin another segment; its first keyframe is relocalised without a pause."""
        self._segment += 1
        self._last_keyframe = self._last_keyframe_s = None
        self.relocalise()

    def _is_keyframe(self, T_odom_camera: Array) -> bool:
        if self._last_keyframe is None:
            return True
        moved_m, turned_deg = pose_difference(T_odom_camera, self._last_keyframe)
        return moved_m > self.options.keyframe_m or turned_deg > self.options.keyframe_deg

    async def _make_keyframe(self, tracked: TrackedFrame, T_odom_camera: Array, features: Features) -> None:
        """Queue a frame with depth as a keyframe, and add it to the robot's own cloud in a thread.

        The thread may still run when this returns (`_wait_for_cloud`).  A keyframe for which the queue has no
        space is added to the cloud only.
        """
        data, attachments = await asyncio.to_thread(
            self._encode_keyframe, tracked.frame, T_odom_camera, features
        )
        self._last_keyframe, self._last_keyframe_s = T_odom_camera, tracked.frame.timestamp_s
        await self._wait_for_cloud()
        self._cloud_update = asyncio.ensure_future(
            asyncio.to_thread(add_to_cloud, self.map, tracked.frame, T_odom_camera, features, True)
        )
        if await self._queue_keyframe(data, T_odom_camera):
            self._attachments.add(attachments)

    async def _follow_monocular(
        self, tracker: MonocularTracker, tracked: TrackedFrame, T_world_camera: Array
    ) -> TrackedFrame:
        """Queue the settled keyframes of a camera without depth, in a new segment if the odometry needs one.

        Return *tracked* with its pose in the odometry frame, in the unit of that frame.  *T_world_camera* is
        the pose of the frame by the tracker.
        """
        if self._monocular_odometry is None:
            self._monocular_odometry = MonocularOdometry(tracker)
        odometry = self._monocular_odometry
        if odometry.start_if_broken():
            self._begin_segment()
        for keyframe, T_odom_camera in odometry.take_settled():
            data = await asyncio.to_thread(self._encode_monocular_keyframe, keyframe, T_odom_camera)
            self._last_keyframe_s = keyframe.timestamp_s
            await self._queue_keyframe(data, T_odom_camera)
        pose = odometry.pose_in_odometry(T_world_camera)
        return replace(
            tracked, T_world_camera=pose, scale="up to scale", T_world_base=None, pose_covariance=None
        )

    async def _queue_keyframe(self, data: bytes, T_odom_camera: Array) -> bool:
        """Queue an encoded keyframe, and relocalise it if that is due; return False if the queue is full."""
        keyframe = QueuedKeyframe(self._queue.next_index, self._segment, data)
        if not await asyncio.to_thread(self._queue.add, keyframe):
            self._dropped_keyframes += 1
            return False
        self._made_keyframes += 1
        self._sender.notify_added()
        has_foreign_keyframes = self._alignments.map_keyframes > len(self.sent_keyframes)
        is_sure = self.aligned and not (self._relocaliser.has_prior and self.aligned_by == "relocalisation")
        if not is_sure and self._robot.connected and has_foreign_keyframes:
            self._relocaliser.start_if_due(keyframe, T_odom_camera)
        return True

    def _encode_keyframe(
        self, frame: Frame, T_odom_camera: Array, features: Features
    ) -> tuple[bytes, EncodedAttachments]:
        """Encode a frame with depth as a keyframe, and its attachments."""
        attachments = self._attachments.make(frame, features)
        data = encode_depth_keyframe(
            frame,
            T_odom_camera,
            features,
            max_orb_features=self.options.features,
            depth_noise=self._mapper.depth_noise,
            imu=self._mapper.keyframe_imu(T_odom_camera, self._last_keyframe_s, frame.timestamp_s),
            attachments=attachments,
        )
        return data, attachments

    def _encode_monocular_keyframe(self, adjusted: AdjustedKeyframe, T_odom_camera: Array) -> bytes:
        assert self._mapper.camera is not None
        return encode_monocular_keyframe(
            adjusted,
            T_odom_camera,
            self._mapper.camera,
            max_orb_features=self.options.features,
            imu=self._mapper.keyframe_imu(
                adjusted.T_world_camera, self._last_keyframe_s, adjusted.timestamp_s
            ),
        )

    # --- Priorities: pose queries before keyframes, keyframes before attachments ---

    async def _ask_with_priority(self, query: PoseQuery) -> PoseAnswer:
        """Ask for a pose, and delay keyframes and attachments until the answer."""
        self._sender.has_no_pose_query.clear()
        try:
            return await self._ask(query)
        finally:
            self._sender.has_no_pose_query.set()

    async def _wait_quiet(self) -> None:
        """Wait until no keyframe is queued, then until no pose query is open."""
        await self._sender.is_empty.wait()
        await self._sender.has_no_pose_query.wait()

    async def _wait_sent(self) -> None:
        """Wait until no keyframe is queued, and every attachment was uploaded or dropped."""
        await self._sender.is_empty.wait()
        await self._attachments.wait_empty()

    async def _wait_for_cloud(self) -> None:
        """Wait until the last keyframe is in the robot's own cloud."""
        if self._cloud_update is not None:
            await self._cloud_update

    # --- Updates that the map publishes, and relocalisations ---

    async def _follow_updates(self) -> None:
        """Apply the updates of the map's topic until cancelled; after a failure, subscribe again."""
        while True:
            try:
                if not self._is_introduced:
                    await self._sender.introduce()
                async for key, payload in self._robot.subscribe(live_topic(self.name)):
                    self._update_trouble = ""
                    try:
                        self._publish(self._alignments.apply_update(key, payload))
                    except BadMessage as error:
                        self._update_trouble = f"{error.code}: {error.message}"
            except RsePfError as error:
                self._update_trouble = f"{error.code}: {error.message}"
            await asyncio.sleep(_RESUBSCRIBE_PAUSE_S)

    def _apply_introduction(self, shown: MapShown, offset: NumberOffset) -> None:
        """Apply the map's reply about this robot: name, segment numbers, permission for images."""
        self._is_introduced = True
        self._attachments.may_store_images = shown.images
        if shown.you.robot:
            for correction in self._alignments.identify_robot(shown.you.robot, offset.segment):
                self._publish(correction)
        self._alignments.map_keyframes = max(self._alignments.map_keyframes, shown.keyframes)

    def _publish(self, correction: Correction | None) -> None:
        """Publish a correction, if any; one of the present segment sets ``corrected`` of the next frame."""
        if correction is not None:
            self._is_corrected |= correction.segment == self._segment
            self._correction_stream.publish(correction)
