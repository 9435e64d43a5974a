"""A mapper that shares one live map with other robots.

`LiveMapper` tracks as `client_sdk.mapper.Mapper` does, sends a keyframe each 0.1 m or 6 degrees in the
background, and knows where its odometry frame lies in the map.

**Poses never jump unannounced.**  ``tracked.T_world_camera`` stays in the robot's odometry frame: nothing
that the map finds moves it.  ``tracked.T_map_camera`` is the same pose in the map, None until the segment is
aligned.  It uses the alignment of the moment, and whatever changes that is a `Correction`: it is in
`LiveMapper.corrections` before a pose uses it, and the first such pose says ``corrected``.  A new ``segment``
begins when tracking was lost: it continues at the last known pose, and is aligned on its own.

**Frames without depth** are tracked up to scale.  A keyframe is sent when it has settled, in the unit of its
segment; the map finds how many metres that is (`metres_per_unit`), and ``tracked.T_map_camera`` is metres as
soon as the segment is aligned, while ``tracked.T_world_camera`` stays in the segment's unit.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Features, Frame, FrontEndOptions, PoseQuery, TrackedFrame
from client_sdk.live.alignments import Alignments, Correction, OtherRobot
from client_sdk.live.attachments import Attached, Attachments
from client_sdk.live.keyframe_chain import KeyframeChain
from client_sdk.live.object_sender import StoreObject
from client_sdk.live.options import LiveOptions
from client_sdk.live.sender import REFUSALS, KeyframeSender, LiveRobot, Myself
from client_sdk.live.waiting_keyframes import Base, WaitingKeyframe, WaitingKeyframes
from client_sdk.mapper import AskPose, Mapper
from client_sdk.mapping import MapOptions, PointMap, Trajectory
from client_sdk.slots import FeaturesFunction, LoopsFunction, MotionFunction
from client_sdk.tracking.monocular_tracker import MonocularTracker, SeenKeyframe
from client_sdk.tracking.segments import add_to_cloud
from rse_pf.errors import BadMessage, BadRequest, RsePfError, UnsupportedProtocol, UsageError
from rse_pf.geometry import Array, Camera, pose_difference
from rse_pf.maps.descriptors import DescriptorKind
from rse_pf.slam.keyframe import (
    MAX_FEATURES,
    SentKeyframe,
    encode_keyframe,
    make_features,
    make_scaleless_features,
    max_features,
)
from rse_pf.wire.live_map import LiveRelocalise, RelocaliseReply, live_topic

__all__ = ["KeyframeSent", "LiveMapper"]

_FINAL = (*REFUSALS, BadRequest, UnsupportedProtocol)
"""A live map that answers so will not be joined by trying again."""
_RETRY_S = 1.0
_MAX_CORRECTIONS = 1000
_NEVER = 1_000_000_000
"""The tracker begins no segment of its own: a live map has to know of each."""
_MAX_SENT = 100_000
_OFTEN_IN_VAIN, _RARELY = 6, 4.0
"""After so many answers without a place a robot asks so many times as rarely."""


@dataclass(frozen=True, slots=True)
class KeyframeSent:
    """A keyframe that the map keeps: its number in the map, and when it was sent and acknowledged."""

    number: int
    sent_s: float
    kept_s: float


class LiveMapper:
    """A `Mapper` whose map is shared with other robots; made by `Robot.live_map`.

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
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        store: StoreObject | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Describe the robot's part of a live map; ``async with`` joins it.

        Args:
            robot: Connected, or with an offload and not connected yet.
            name: Of the map: small letters, digits and hyphens.
            ask: Answers pose queries.
            camera: Frames of another camera are refused; None takes that of the first frame.
            depth: Whether to use depth; None means: if the first frame has some, or is a stereo pair.  With
                True a first frame without depth is refused.
            spool: Folder of keyframes that wait for the map, which survive a restart of this program, for
                this robot alone; None keeps them in memory.
            options: Of the tracker.
            live: Of keyframes and their sending.
            map_options: Density of the robot's own cloud, to which keyframes are added.
            T_world_start: ``(4, 4)``, pose of the first camera in the odometry frame; None: the identity.
            features: Finds the features of an image; None for ORB.  All robots of a map use the same.
            motion: Expects the pose of the next frame; None for a constant velocity.
            loops: Describes an image, so that this robot finds its own places again; other robots are found
                by the features.
            store: Stores an object of this robot, for the cloud of the map; None: it gets no points.
            clock: Seconds, monotonic.

        Raises:
            UsageError: One of these is no function, or *features* has no name.
        """
        self.name = name
        self.options = live or LiveOptions()
        self.sent_keyframes: deque[KeyframeSent] = deque(maxlen=_MAX_SENT)
        self._robot, self._clock = robot, clock
        self._waiting = WaitingKeyframes(None if spool is None else spool / name)
        self._sender: KeyframeSender
        self._attachments = Attachments(store, self.options, clock, self._wait_idle)
        self._ask = ask
        self._mapper = Mapper(
            ask=self._ask_first, camera=camera, depth=depth,
            options=replace(options or FrontEndOptions.live(), segment_after=_NEVER), map_options=map_options,
            T_world_start=T_world_start, adds_frames=False, holds_world=True, features=features,
            motion=motion, loops=loops,
        )  # fmt: skip
        self._alignments = Alignments()
        self._has_depth = depth
        self._chain: KeyframeChain | None = None
        self._segment = 0
        self._last_keyframe: Array | None = None
        self._last_keyframe_s: float | None = None
        self._is_corrected = False
        self._poses: list[tuple[float, int, Array]] = []
        self._made, self._dropped = 0, 0
        self._verdicts: Counter[str] = Counter()
        self._relocalised_at = float("-inf")
        self._asked_in_vain = 0
        self._relocalising: asyncio.Task[None] | None = None
        self._listeners: list[asyncio.Queue[Correction | None]] = []
        self._corrections: deque[Correction] = deque(maxlen=_MAX_CORRECTIONS)
        self._tasks: list[asyncio.Task[None]] = []
        self._adding: asyncio.Future[Any] | None = None
        self._trouble = ""
        self._place_trouble = ""
        self._one_frame = asyncio.Lock()
        self._is_known = False
        self._is_open = False
        self._is_over = False

    async def __aenter__(self) -> LiveMapper:
        """Join the map; without a connection, join it as soon as there is one.

        Raises:
            Forbidden: The token has no scope for this map.
            UnknownService: The platform has no live maps.
            BadRequest: The name cannot be used.
            UsageError: The spool cannot be used, or another program uses it.
        """
        self._segment = await asyncio.to_thread(self._waiting.open)
        try:
            await self._join()
        except BaseException:
            self._waiting.close()
            raise
        return self

    async def _join(self) -> None:
        self._sender = KeyframeSender(
            self._robot, self.name, self._waiting, deadline_s=self.options.deadline_s,
            bytes_per_s=self.options.bytes_per_s, clock=self._clock, on_known=self._note_introduction,
            on_sent=lambda *sent: self.sent_keyframes.append(KeyframeSent(*sent)),
        )  # fmt: skip
        self._sender.current_segment = self._segment
        if self._robot.connected:
            try:
                await self._sender.introduce()
            except _FINAL:
                raise
            except RsePfError as error:
                self._trouble = f"{error.code}: {error.message}"
        if len(self._waiting):
            self._sender.note_added()
        self._is_open = True
        works = self._sender.run(), self._follow(), self._attachments.run()
        self._tasks = [asyncio.create_task(work) for work in works]

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Send what waits, for `LiveOptions.leave_s` at most, and leave the map.

        What was not sent stays in the spool, or is lost if there is none: see `keyframes_waiting`.
        """
        self._is_open = False
        try:
            await self._wait_for_cloud()
            if self._robot.connected and not isinstance(error, asyncio.CancelledError):
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._wait_sent(), self.options.leave_s)
                with contextlib.suppress(RsePfError):
                    await self._robot.call("live-leave", {"map": self.name}, deadline_s=_RETRY_S, keep=True)
        finally:
            ending = [*self._tasks, *([self._relocalising] if self._relocalising else [])]
            for task in ending:
                task.cancel()
            await asyncio.gather(*ending, return_exceptions=True)
            self._waiting.close()
            self._is_over = True
            for listener in self._listeners:
                listener.put_nowait(None)

    async def track(self, frame: Frame) -> TrackedFrame:
        """Return the pose of the next frame in the odometry frame and in the map, or why there is none.

        Raises:
            UsageError: The frame is of another camera, or the first one lacks the depth of *depth*; or the
                spool's disk is full.
        """
        if not self._is_open:
            raise UsageError("this live map is not joined", hint="use async with robot.live_map(...)")
        async with self._one_frame:
            is_first, has_depth = self.frames == 0, frame.stereo is not None or frame.depth_m.any()
            if is_first and self._has_depth and not has_depth:
                raise UsageError(
                    "the first frame has no depth",
                    hint="wait for depth, or leave depth=True out for one lens",
                )
            if self._mapper.unrecognised >= self.options.segment_after and self._poses:
                self._mapper.restart(self._poses[-1][2])
                self._begin_segment()
            done = await self._mapper.track(frame)
            tracker = self._mapper.landmark_tracker
            if tracker is not None and done.T_world_camera is not None:
                done = await self._chained(tracker, done, done.T_world_camera)
            pose = done.T_world_camera
            if pose is not None:
                self._poses.append((frame.timestamp_s, self._segment, pose))
                features = self._mapper.features
                if features is not None and self._is_keyframe(pose):
                    await self._keep(done, pose, features)
            return self._place_in_map(done)

    @property
    def aligned(self) -> bool:
        """Whether it is known where the present segment lies in the map; `reason` says why not."""
        return self.T_map_odom is not None

    @property
    def reason(self) -> str:
        """Why the present segment is not aligned, empty if it is."""
        return self._alignments.of(self._segment).reason

    @property
    def T_map_odom(self) -> Array | None:
        """``(4, 4)``: where the present odometry frame lies in the map; None while that is unknown.

        Lengths of the odometry frame are multiplied by `metres_per_unit` before.
        """
        return self._alignments.of(self._segment).T_map_odom

    @property
    def metres_per_unit(self) -> float | None:
        """How many metres the unit of the present odometry frame is; None while that is unknown."""
        if self._mapper.landmark_tracker is None:
            return 1.0
        return self._alignments.of(self._segment).scale if self.aligned else None

    @property
    def covariance(self) -> Array | None:
        """``(6, 6)`` of the twist (metres, radians) on the left of `T_map_odom`, None if unknown."""
        return self._alignments.of(self._segment).covariance

    @property
    def aligned_by(self) -> str:
        """Who aligned the present segment: ``map``, ``relocalisation``, or ``nothing``."""
        return self._alignments.of(self._segment).by

    @property
    def segment(self) -> int:
        """The number of the present odometry frame, from 0; tracking that was lost begins a new one."""
        return self._segment

    @property
    def others(self) -> dict[str, OtherRobot]:
        """The other robots of the map by their names."""
        return dict(self._alignments.others)

    @property
    def version(self) -> int:
        """The position in the log of the map that this robot has heard of."""
        return self._alignments.version

    @property
    def map_keyframes(self) -> int:
        """The number of keyframes of the whole map, of all robots."""
        return self._alignments.map_keyframes

    @property
    def owner(self) -> str:
        """Who serves the map."""
        return self._alignments.owner

    @property
    def state(self) -> str:
        """The state of the map as this robot sees it.

        ``joining``, ``live``, ``waiting for the store`` or ``moving`` (to another server), as the map says;
        ``offline`` without a connection; ``refused: ...`` if the platform takes no keyframe of this robot.
        """
        if self._is_open and self._sender.is_refused:
            return f"refused: {self._sender.trouble}"
        if not self._robot.connected:
            return "offline"
        return self._alignments.map_state or "joining"

    @property
    def trouble(self) -> str:
        """Why keyframes are not kept, updates do not come, or no place is looked up; empty if all is well."""
        unaligned = "" if self.aligned else self._place_trouble
        return (self._sender.trouble if self._is_open else "") or self._trouble or unaligned

    @property
    def keyframes_waiting(self) -> int:
        """The number of keyframes that the map has not acknowledged."""
        return len(self._waiting)

    @property
    def features(self) -> Features | None:
        """The features of the last frame that has a pose, as those of `Mapper.features`."""
        return self._mapper.features

    def relocalise(self) -> None:
        """Ask for the place in the map with the next keyframe, without the usual pause."""
        self._relocalised_at, self._asked_in_vain = float("-inf"), 0

    @property
    def map(self) -> PointMap:
        """The robot's own cloud of its keyframes, in its odometry frame; the newest may be missing.

        Without depth: its landmarks, as those of `Mapper.map`.
        """
        return self._mapper.map

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far, in the odometry frame; without depth as the tracker has corrected them."""
        return self._mapper.trajectory

    @property
    def map_trajectory(self) -> Trajectory:
        """The poses of all segments that are aligned, in the map, by the newest alignment of each."""
        placed = [
            (stamp, T_map_camera)
            for stamp, segment, pose in self._poses
            if (T_map_camera := self._alignments.of(segment).in_map(pose)) is not None
        ]
        return Trajectory(
            np.array([stamp for stamp, _ in placed]), np.array([pose for _, pose in placed]).reshape(-1, 4, 4)
        )

    @property
    def frames(self) -> int:
        """The number of frames tracked so far."""
        return self._mapper.frames

    def restart_clock(self) -> None:
        """Accept frames of an earlier time: their source began anew, such as a bag that is played again."""
        self._mapper.restart_clock()

    @property
    def lost_frames(self) -> int:
        """The number of frames without a pose."""
        return self._mapper.lost_frames

    @property
    def frames_before_start(self) -> int:
        """The number of frames of a camera without depth before it had moved enough to begin."""
        return self._mapper.frames_before_start

    @property
    def keyframes(self) -> int:
        """The number of keyframes made for the map in this run."""
        return self._made

    @property
    def scale(self) -> str:
        """Where metres come from: as `Mapper.scale`, ``metric, by the live map``, or ``up to scale`` yet."""
        if self._mapper.landmark_tracker is None:
            return self._mapper.scale
        return "metric, by the live map" if self.aligned else "up to scale"

    def report(self) -> dict[str, Any]:
        """Return the figures of the drive: those of `Mapper.report`, and ``live``."""
        return {
            **self._mapper.report(),
            "live": {
                "map": self.name,
                "state": self.state,
                "segments": self._segment + 1,
                "aligned": self.aligned,
                "aligned_by": self.aligned_by,
                "reason": self.reason,
                "scale": self.scale,
                "metres_per_unit": self.metres_per_unit,
                "keyframes": self._made,
                "keyframes_kept": len(self.sent_keyframes),
                "keyframes_waiting": len(self._waiting),
                "keyframes_dropped": self._dropped,
                "keyframes_refused": self._sender.refused if self._is_open or self._is_over else 0,
                "relocalisations": dict(self._verdicts),
                "others": sorted(self._alignments.others),
                **self._attachments.report(),
            },
        }

    @property
    def T_body_camera(self) -> Array | None:
        """The ``(4, 4)`` pose of the camera in the body of its rig, metres; None without a rig."""
        return self._mapper.T_body_camera

    def save(self, folder: Path) -> dict[str, Any]:
        """Write the robot's own cloud and trajectory as `Mapper.save` does; return its report."""
        return self._mapper.save(folder)

    async def corrections(self) -> AsyncIterator[Correction]:
        """Yield each change of an alignment, those before the call first; ends with the ``async with``.

        A reader that is more than 1,000 behind misses the oldest.
        """
        queue: asyncio.Queue[Correction | None] = asyncio.Queue()
        for known in self._corrections:
            queue.put_nowait(known)
        if self._is_over:
            queue.put_nowait(None)
        self._listeners.append(queue)
        try:
            while (correction := await queue.get()) is not None:
                yield correction
        finally:
            self._listeners.remove(queue)

    async def _ask_first(self, query: PoseQuery) -> PoseAnswer:
        """Ask for a pose while keyframes wait."""
        self._sender.note_pose_asked()
        try:
            return await self._ask(query)
        finally:
            self._sender.note_pose_answered()

    def _begin_segment(self) -> None:
        """Take that an odometry frame of its own begins."""
        self._segment += 1
        self._sender.current_segment = self._segment
        self._last_keyframe = self._last_keyframe_s = None
        self.relocalise()

    def _is_keyframe(self, pose: Array) -> bool:
        if self._last_keyframe is None:
            return True
        moved_m, turned_deg = pose_difference(pose, self._last_keyframe)
        return moved_m > self.options.keyframe_m or turned_deg > self.options.keyframe_deg

    async def _keep(self, done: TrackedFrame, pose: Array, features: Features) -> None:
        """Make a keyframe of a tracked frame, and queue it for the map."""
        data, attached = await asyncio.to_thread(self._encode, done.frame, pose, features)
        self._last_keyframe, self._last_keyframe_s = pose, done.frame.timestamp_s
        await self._wait_for_cloud()
        self._adding = asyncio.ensure_future(
            asyncio.to_thread(add_to_cloud, self.map, done.frame, pose, features, True)
        )
        if await self._queue(data, pose):
            self._attachments.add(attached)

    async def _chained(self, tracker: MonocularTracker, done: TrackedFrame, pose: Array) -> TrackedFrame:
        """Return a frame of a camera without depth with its pose in the odometry; queue settled keyframes."""
        chain = self._chain = self._chain or KeyframeChain(tracker)
        if chain.follow():
            self._begin_segment()
        for seen, T_odom_camera in chain.settled():
            data = await asyncio.to_thread(self._encode_settled, seen, T_odom_camera)
            self._last_keyframe_s = seen.timestamp_s
            await self._queue(data, T_odom_camera)
        return replace(done, T_world_camera=chain.pose(pose), scale="up to scale")

    async def _queue(self, data: bytes, pose: Array) -> bool:
        """Queue a keyframe for the map; return whether there was space for it."""
        waiting = self._waiting
        keyframe = WaitingKeyframe(waiting.next_index, self._segment, data)
        if not await asyncio.to_thread(waiting.add, keyframe):
            self._dropped += 1
            return False
        self._made += 1
        self._sender.note_added()
        self._relocalise(keyframe, pose)
        return True

    async def _wait_idle(self) -> None:
        """Wait until neither a pose is asked for nor a keyframe waits."""
        await self._sender.wait_empty()
        await self._sender.wait_quiet()

    async def _wait_sent(self) -> None:
        """Wait until the map has every keyframe, and the store what belongs to them."""
        await self._sender.wait_empty()
        await self._attachments.wait_empty()

    async def _wait_for_cloud(self) -> None:
        """Wait until the last keyframe is in the robot's own cloud."""
        if self._adding is not None:
            await self._adding

    def _encode(self, frame: Frame, T_odom_camera: Array, features: Features) -> tuple[bytes, Attached]:
        """Return a keyframe of the first features with depth, of the finest levels; and what is its."""
        attached = self._attachments.make(frame, features)
        depths_m = features.points_camera[:, 2]
        rows = np.flatnonzero(np.isfinite(depths_m))[: self._most(features.kind)]
        keyframe = SentKeyframe(
            timestamp_s=frame.timestamp_s, T_odom_camera=T_odom_camera, camera=frame.camera,
            features=make_features(
                features.pixels[rows], depths_m[rows], features.descriptors[rows], self._mapper.depth_noise,
                features.kind, 0.0 if frame.stereo is None else frame.camera.fx * frame.stereo.baseline_m,
            ),
            imu=self._mapper.keyframe_imu(T_odom_camera, self._last_keyframe_s, frame.timestamp_s),
            points=attached.points_reference, image=attached.image_reference,
        )  # fmt: skip
        return encode_keyframe(keyframe), attached

    def _encode_settled(self, seen: SeenKeyframe, T_odom_camera: Array) -> bytes:
        """Return a keyframe without scale: its features with a landmark first, then those without."""
        assert self._mapper.camera is not None
        image, rows = seen.image, np.argsort(np.isnan(seen.depths), kind="stable")[: self._most(seen.kind)]
        keyframe = SentKeyframe(
            timestamp_s=seen.timestamp_s, T_odom_camera=T_odom_camera, camera=self._mapper.camera,
            features=make_scaleless_features(
                image.pixels[rows], seen.depths[rows], image.descriptors[rows], seen.kind
            ),
            imu=self._mapper.keyframe_imu(seen.T_world_camera, self._last_keyframe_s, seen.timestamp_s),
        )  # fmt: skip
        return encode_keyframe(keyframe)

    def _most(self, kind: DescriptorKind) -> int:
        """Return how many features of a kind are sent."""
        return self.options.features * max_features(kind) // MAX_FEATURES

    def _relocalise(self, keyframe: WaitingKeyframe, pose: Array) -> None:
        """Ask where in the map a keyframe is, if its segment is not aligned and the map has others."""
        now = self._clock()
        if (
            self.aligned
            or not self._robot.connected
            or self._alignments.map_keyframes <= len(self.sent_keyframes)
            or now < self._relocalised_at + self._relocalise_pause_s()
            or (self._relocalising is not None and not self._relocalising.done())
        ):
            return
        self._relocalised_at = now
        self._relocalising = asyncio.create_task(self._ask_place(keyframe, pose))

    def _relocalise_pause_s(self) -> float:
        """Return how long to wait between two questions: longer where no other robot seems to have been."""
        is_alone = self._asked_in_vain >= _OFTEN_IN_VAIN
        return self.options.relocalise_s * (_RARELY if is_alone else 1.0)

    async def _ask_place(self, keyframe: WaitingKeyframe, pose: Array) -> None:
        request = LiveRelocalise(map=self.name, keyframe=keyframe.data)
        try:
            answer = await self._robot.call(
                "live-relocalise", request, RelocaliseReply, deadline_s=self.options.deadline_s, keep=True
            )
            self._place_trouble = ""
            self._verdicts[answer.reply.verdict] += 1
            self._asked_in_vain = self._asked_in_vain + 1 if answer.reply.verdict == "none" else 0
            self._announce(self._alignments.relocalised(keyframe.segment, pose, answer.reply))
        except RsePfError as error:
            self._verdicts[error.code] += 1
            self._place_trouble = f"{error.code}: {error.message}"

    async def _follow(self) -> None:
        """Follow the updates of the map until cancelled."""
        while True:
            try:
                if not self._is_known:
                    await self._sender.introduce()
                async for key, payload in self._robot.subscribe(live_topic(self.name)):
                    self._trouble = ""
                    await self._take(key, payload)
            except RsePfError as error:
                self._trouble = f"{error.code}: {error.message}"
            await asyncio.sleep(_RETRY_S)

    async def _take(self, key: str, payload: Any) -> None:
        try:
            self._announce(self._alignments.updated(key, payload))
        except BadMessage as error:
            self._trouble = f"{error.code}: {error.message}"

    def _note_introduction(self, myself: Myself, base: Base) -> None:
        """Take how the map knows this robot."""
        self._is_known = True
        self._attachments.may_have_images = myself.images
        if myself.robot:
            for correction in self._alignments.know_myself(myself.robot, base.segment):
                self._announce(correction)
        self._alignments.map_keyframes = max(self._alignments.map_keyframes, myself.keyframes)

    def _announce(self, correction: Correction | None) -> None:
        if correction is None:
            return
        self._is_corrected |= correction.segment == self._segment
        self._corrections.append(correction)
        for listener in self._listeners:
            if listener.qsize() >= _MAX_CORRECTIONS:
                listener.get_nowait()
            listener.put_nowait(correction)

    def _place_in_map(self, done: TrackedFrame) -> TrackedFrame:
        """Return the result with its place in the map by the alignment of this moment."""
        pose = done.T_world_camera
        placed = replace(
            done,
            segment=self._segment,
            T_map_camera=None if pose is None else self._alignments.of(self._segment).in_map(pose),
            corrected=self._is_corrected,
        )
        self._is_corrected = False
        return placed
