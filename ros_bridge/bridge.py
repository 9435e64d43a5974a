"""The bridge without ROS: it tracks received frames with a mapper, and publishes the poses as messages.

A shell passes the bytes of received messages to `Bridge.receive`, from any thread, and gives the bridge a
function that publishes messages.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np

from client_sdk.bags.bag_file import BrokenMessage
from client_sdk.bags.message_maker import MessageMaker
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.live import LiveMapper
from client_sdk.mapper import Mapper
from client_sdk.robot import Robot
from client_sdk.tracking.segment_join import CONTRADICTED, NOT_JOINED
from client_sdk.wheel_odometry import OdometryReading
from ros_bridge.access import connect_robot
from ros_bridge.base_poses import BasePoses
from ros_bridge.frame_tree import Transform, pose_of
from ros_bridge.incoming import TOO_FAST, IncomingFrames, PairedImages, Role, kind_of
from ros_bridge.map_services import MapServices, as_json
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import Message, OutgoingMessages
from ros_bridge.robot_frames import RobotFrames
from rse_pf.errors import RsePfError, UsageError
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.slam.localise import PosePrior
from rse_pf.slam.occupancy import GridOptions, OccupancyGrid
from rse_pf.terminal import show

__all__ = ["Bridge", "CallReply", "OpenMapper", "Publish", "connected_bridge"]

Publish = Callable[[Message], None]
"""Publishes a message; called from the bridge's event loop, so it must not wait."""
OpenMapper = Callable[[Array | None], contextlib.AbstractAsyncContextManager[Mapper | LiveMapper]]
"""Opens the mapper for a mount ``T_base_camera`` ``(4, 4)`` of the camera; None if the mount is not known."""
PoseStatus = Literal["visual", "odometry", "lost"]

# Time between two status messages, in seconds.
_DIAGNOSTICS_EVERY_S = 1.0
# Time between two messages with the path, in seconds.
_PATH_EVERY_S = 0.5
# Time between two requests for the floor plan of a live map, in seconds: its corrections arrive within 1 s.
_LIVE_PLAN_EVERY_S = 0.25
# Smallest number of measurements of a point that is published in the cloud of a robot's own map.
_LEAST_READINGS = 2
# Deadline of a call of the platform through the ROS service ``call``, in seconds.
_CALL_S = 10.0
# A frame that is earlier than the last one by more than this, in seconds, comes from a restarted source.
_CLOCK_RESTART_S = 1.0
# Time between two transforms from map to odometry frame, in seconds: 10 Hz, at which Nav2's AMCL works.
_MAP_ODOM_EVERY_S = 0.1
# Longest wait for the static transforms from base to camera, in seconds: a latched topic comes at once.
_MOUNT_WAIT_S = 2.0
# Longest time without a processed image, in seconds, for which the pose counts as visual.
_STALE_S = 2.0
# Longest time without a reading, in seconds, for which odometry counts as alive.
_ODOMETRY_STALE_S = 1.0
# Time without a pose, in seconds, after which the level of the status message is error.
_LOST_ERROR_S = 5.0
# Largest difference of ROS clock and time stamp of an image, in ns: above it, images have another clock.
_OTHER_CLOCK_NS = 10_000_000_000
# Time before the first image from which odometry is given to the mapper, in ns: it needs a reading before.
_FIRST_ODOMETRY_NS = 1_000_000_000
# Levels of ``diagnostic_msgs/DiagnosticStatus``.
_OK, _WARNING, _ERROR = 0, 1, 2
_IDENTITY = np.eye(4)


@dataclass(frozen=True, slots=True)
class CallReply:
    """The result of a ROS service: ``reply`` as JSON if ``ok``, else ``code`` and ``message`` of an error."""

    ok: bool
    reply: str = ""
    code: str = ""
    message: str = ""


class Bridge:
    """The bridge of one robot: `run` tracks and publishes, `receive` may be called from any thread."""

    def __init__(
        self,
        open_mapper: OpenMapper,
        options: BridgeOptions,
        publish: Publish,
        *,
        is_ros1: bool,
        robot: Robot | None = None,
        clock: Callable[[], float] = time.monotonic,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Describe a bridge.

        Args:
            open_mapper: Opens the mapper of a connected robot, when the mount of the camera is known.
            options: The options of the bridge.
            publish: Called with each message to publish.
            is_ros1: Whether messages are encoded as in ROS 1; otherwise as CDR, as in ROS 2.
            robot: The robot with which ROS services call the platform; None lets those services fail.
            clock: Returns seconds, monotonic; for the intervals between clouds and paths.
            now_ns: Returns the time of ROS in nanoseconds, for the transform from map to odometry frame.
        """
        self._maker = maker = MessageMaker(is_ros1=is_ros1)
        self.frames = 0
        self.lost_frames = 0
        self.track_s: list[float] = []
        self._options, self._publish, self._robot = options, publish, robot
        self._open_mapper = open_mapper
        self._mapper: Mapper | LiveMapper | None = None
        self._stack = contextlib.AsyncExitStack()
        self._incoming = IncomingFrames(maker, options, self._why_full)
        self._frames = RobotFrames(options)
        self._poses = BasePoses(self._frames, options.max_correction_m_s)
        self._outgoing = OutgoingMessages(maker, options, self._frames)
        self._clock, self._now_ns = clock, now_ns
        self._loop = asyncio.get_running_loop()
        self._has_frame, self._has_static = asyncio.Event(), asyncio.Event()
        self._started_s = clock()
        self._due = {
            "cloud": clock() + options.cloud_every_s,
            "path": clock(),
            "floor plan": clock() + options.floor_plan_every_s,
        }
        self._stamp_ns = 0
        self._T_map_world: Array | None = None
        self._last_s = float("-inf")
        self._reason = ""
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._plan_trouble = ""
        self._plan: OccupancyGrid | None = None
        self._maps: MapServices | None = None
        self._seen: Camera | None = None
        self._statics: list[Transform] = []
        self._awaits_imu_frame = bool(options.imu)
        self._tracking_since_s: float | None = None
        self._fed_ns: int | None = None
        self._status: PoseStatus | None = None
        self._frame_status: PoseStatus = "lost"
        self._is_elsewhere = False
        self._frame_s = self._lost_since_s = clock()
        self._odometry_seen: tuple[int | None, float] = (None, float("-inf"))
        self._uses_ros_clock = True
        self._map_odom_ns = 0
        self._printed: set[str] = set()

    async def close(self) -> None:
        """Leave the live map, and close the connection to the data service, if they are open."""
        await self._stack.aclose()

    @property
    def triggers(self) -> dict[str, Callable[[], Coroutine[Any, Any, CallReply]]]:
        """The functions of the ROS services without a request (``std_srvs/Trigger``), by service name."""
        return {
            "save": self.save,
            "publish": lambda: self._of_maps(MapServices.publish),
            "relocalise": lambda: self._of_maps(MapServices.relocalise),
            "localise": lambda: self._of_maps(lambda maps: maps.localise(self._seen)),
        }

    def receive(self, role: Role, data: bytes | memoryview) -> None:
        """Store the bytes of a message of the topic *role*; never waits and raises no error."""
        if role in ("odometry", "tf", "tf_static", "initialpose"):
            self._receive_frames(role, data)
        elif self._incoming.add(role, data):
            self._set(self._has_frame)

    def _receive_frames(self, role: Role, data: bytes | memoryview) -> None:
        if role == "tf" and not self._frames.concerns(data):
            return
        try:
            message = self._maker.decode(kind_of(role, ""), data)
            if role == "initialpose":
                self._receive_initial_pose(message)
            elif role == "odometry":
                self._frames.add_odometry(message)
            else:
                self._frames.add_transforms(message, is_static=role == "tf_static")
        except BrokenMessage as error:
            self._incoming.check.refuse("broken", f"a message of {role} cannot be used: {error}")
        if role == "tf_static":
            self._set(self._has_static)

    def _receive_initial_pose(self, message: Any) -> None:
        """Let the mapper expect the robot at a pose in the map; raises BrokenMessage for one that is none."""
        frame, pose = message.header.frame_id.strip("/"), message.pose.pose
        T_map_base = pose_of(pose.position, pose.orientation)
        if T_map_base is None or frame != self._frames.map:
            raise BrokenMessage(f"it is no pose in {self._frames.map}, but in {frame}")
        T_base_camera = _IDENTITY if self._frames.T_base_camera is None else self._frames.T_base_camera
        try:
            prior = PosePrior(
                T_map_camera=T_map_base @ T_base_camera,
                covariance=np.array(message.pose.covariance, np.float64).reshape(6, 6),
            )
        except RsePfError as error:
            raise BrokenMessage(error.message) from error
        with contextlib.suppress(RuntimeError):  # the event loop is closed: the bridge has stopped
            self._loop.call_soon_threadsafe(self._expect, prior)

    def _expect(self, prior: PosePrior) -> None:
        if isinstance(self._mapper, LiveMapper):
            self._mapper.relocalise(prior)
        else:
            self._print_once("an initial pose came before the first image, and is not used: give it again")

    def _set(self, event: asyncio.Event) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop is closed: the bridge has stopped
            self._loop.call_soon_threadsafe(event.set)

    async def run(self) -> None:
        """Track frames and publish the results, until cancelled.

        Raises:
            RsePfError: The robot has stopped reconnecting: its token expired, or another robot uses its name.
        """
        works = self._take(), self._report(), self._repeat_transform()
        running = [asyncio.create_task(work) for work in works]
        try:
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            ending = [*running, *self._tasks.values()]
            for task in ending:
                task.cancel()
            await asyncio.gather(*ending, return_exceptions=True)

    async def save(self) -> CallReply:
        """Write map and trajectory to the folder ``out`` of the options.

        Return the mapper's report as JSON.
        """
        if not self._options.out:
            return CallReply(ok=False, code="usage", message="no folder: set the parameter out")
        if self._mapper is None:
            return CallReply(ok=False, code="usage", message="there is no image yet: wait for a pose")
        try:
            report = await asyncio.to_thread(self._mapper.save, Path(self._options.out))
        except RsePfError as error:
            return CallReply(ok=False, code=error.code, message=error.message)
        return CallReply(ok=True, reply=json.dumps(report))

    async def call(self, service: str, payload: str) -> CallReply:
        """Call the platform's service *service* with the JSON *payload*; return its reply as JSON."""
        if self._robot is None:
            return CallReply(ok=False, code="disconnected", message="this bridge has no connection")
        try:
            request = json.loads(payload or "null")
        except ValueError as error:
            return CallReply(ok=False, code="bad-request", message=f"the payload is no JSON: {error}")
        try:
            answer = await self._robot.call(service, request, deadline_s=_CALL_S, keep=True)
            return CallReply(ok=True, reply=as_json(answer.reply))
        except RsePfError as error:
            return CallReply(ok=False, code=error.code, message=error.message)

    async def _of_maps(self, ask: Callable[[MapServices], Awaitable[Any]]) -> CallReply:
        if self._robot is None:
            return CallReply(ok=False, code="disconnected", message="this bridge has no connection")
        if self._maps is None:
            return CallReply(ok=False, code="usage", message="there is no image yet: wait for a pose")
        try:
            return CallReply(ok=True, reply=as_json(await ask(self._maps)))
        except RsePfError as error:
            said = error.message + (f" ({error.hint})" if error.hint else "")
            return CallReply(ok=False, code=error.code, message=said)

    async def _take(self) -> None:
        """Track and publish each received frame, until cancelled."""
        while True:
            await self._has_frame.wait()
            self._has_frame.clear()
            while (images := self._incoming.take()) is not None:
                await self._bridge(images)

    async def _bridge(self, images: PairedImages) -> None:
        frames = self._frames
        has_wheels = frames.T_base_camera is not None and frames.newest_odometry_ns is not None
        frame = await asyncio.to_thread(self._incoming.decode, images, keeps_repeated=has_wheels)
        if frame is None:
            return
        mapper = self._mapper or await self._begin(images)
        self._uses_ros_clock = abs(self._now_ns() - images.stamp_ns) <= _OTHER_CLOCK_NS
        started, self._seen = time.perf_counter(), frame.camera
        try:
            tracked = await self._track(mapper, frame, images.stamp_ns)
        except UsageError as error:
            self._incoming.check.refuse("not tracked", error.message)
            return
        self.track_s.append(time.perf_counter() - started)
        del self.track_s[:-10_000]
        self.frames += 1
        self._stamp_ns, self._frame_s = images.stamp_ns, self._clock()
        self._is_elsewhere = tracked.reason in (CONTRADICTED, NOT_JOINED)
        is_visual = tracked.pose_source == "visual" and not self._is_elsewhere
        self._reason = "" if is_visual else tracked.reason
        self.lost_frames += not is_visual
        self._publish_poses(mapper, tracked, images.stamp_ns)
        self._publish_imu_pose(images)
        self._publish_map(mapper, images.stamp_ns)

    async def _begin(self, images: PairedImages) -> Mapper | LiveMapper:
        """Find the mount of the camera, open the mapper, and publish the mount if no other node does."""
        rig, base = self._incoming.rig, self._options.own_base_frame
        T_base_left = self._frames.mount(images.camera_frame)
        while base and T_base_left is None:
            left_s = self._started_s + _MOUNT_WAIT_S - self._clock()
            self._has_static.clear()
            T_base_left = self._frames.mount(images.camera_frame)
            if T_base_left is None:
                try:
                    await asyncio.wait_for(self._has_static.wait(), left_s)
                except asyncio.TimeoutError:
                    T_base_left = rig.T_base_left
                    break
        T_base_camera = None if T_base_left is None else T_base_left @ rig.T_left_rectified
        self._frames.settle(images.camera_frame, T_base_camera)
        if T_base_left is not None:
            self._add_static(
                self._frames.static_transform(images.stamp_ns, base, images.camera_frame, T_base_left)
            )
        self._print_once(self._frames.missing_mount)
        mapper = await self._stack.enter_async_context(self._open_mapper(T_base_camera))
        if self._robot is not None:
            self._maps = MapServices(self._robot, mapper, self._options)
            self._stack.callback(self._maps.close)
        self._mapper = mapper
        return mapper

    async def _track(self, mapper: Mapper | LiveMapper, frame: Frame, stamp_ns: int) -> TrackedFrame:
        back_s = self._last_s - frame.timestamp_s
        if back_s > _CLOCK_RESTART_S:
            show(f"the time of the images went back by {back_s:.1f} s, as if a bag is played again")
            mapper.restart_clock()
            self._poses.restart_clock()
            self._fed_ns = None
        after_ns = stamp_ns - _FIRST_ODOMETRY_NS if self._fed_ns is None else self._fed_ns
        poses = [] if self._frames.T_base_camera is None else self._frames.readings(after_ns, stamp_ns)
        readings = [OdometryReading(timestamp_s=ns / 1e9, T_odom_base=T) for ns, T in poses]
        self._tracking_since_s = self._clock()
        try:
            tracked = await mapper.track(frame, odometry=readings)
        finally:
            self._tracking_since_s = None
        self._last_s = frame.timestamp_s
        self._fed_ns = poses[-1][0] if poses else self._fed_ns
        return tracked

    def _publish_poses(self, mapper: Mapper | LiveMapper, tracked: TrackedFrame, stamp_ns: int) -> None:
        T_map_world, alignment = self._alignment(mapper, tracked)
        self._T_map_world = T_map_world
        if tracked.T_new_old is not None:
            self._outgoing.move_path(tracked.T_new_old)
        pose = self._poses.add(tracked, stamp_ns, T_map_world, alignment)
        is_in_map = pose is not None and pose.T_map_base is not None
        self._frame_status = tracked.pose_source if is_in_map else "lost"
        if pose is None and tracked.T_world_camera is not None:
            self._reason = "no pose of the base before the scale of the map is known"
        self._update_status()
        if pose is None:
            return
        if not self._is_elsewhere:
            self._outgoing.extend_path(stamp_ns, pose.T_world_base)
        if not self._frames.is_odometry_foreign and pose.T_odom_base is not None:
            self._publish_transforms([self._frames.odom_transform(stamp_ns, pose.T_odom_base)])
        for message in self._outgoing.of_pose(pose, stamp_ns):
            self._publish(message)

    def _publish_map(self, mapper: Mapper | LiveMapper, stamp_ns: int) -> None:
        """Start to publish those of path, cloud and floor plan whose interval has passed.

        Nothing is published before the pose of the mapper's world in the map is known.  *stamp_ns* is the
        stamp of cloud and floor plan: the time of the newest frame.
        """
        T_map_world, options = self._T_map_world, self._options
        if T_map_world is None:
            return
        if self._is_due("path", _PATH_EVERY_S):
            self._start("path", self._publish_path(T_map_world))
        if self._is_due("cloud", options.cloud_every_s):
            self._start("cloud", self._publish_cloud(mapper, stamp_ns, T_map_world))
        every_s = options.floor_plan_every_s
        if isinstance(mapper, LiveMapper):
            every_s = min(every_s, _LIVE_PLAN_EVERY_S)
        if every_s > 0 and self._is_due("floor plan", every_s):
            self._start("floor plan", self._publish_floor_plan(mapper, stamp_ns))

    def _is_due(self, name: str, every_s: float) -> bool:
        """Return whether the message *name* is to be made now, and then set the time of the next one."""
        now, task = self._clock(), self._tasks.get(name)
        if now < self._due[name] or (task is not None and not task.done()):
            return False
        self._due[name] = now + every_s
        return True

    def _start(self, name: str, work: Coroutine[Any, Any, None]) -> None:
        self._tasks[name] = asyncio.create_task(work)

    def _publish_imu_pose(self, images: PairedImages) -> None:
        """Publish the IMU's pose in the camera frame once, when it and the IMU's frame name are known."""
        rig = self._incoming.rig
        T = rig.T_camera_imu
        if self._awaits_imu_frame and rig.imu_frame and T is not None:
            self._awaits_imu_frame = False
            self._add_static(
                self._frames.static_transform(images.stamp_ns, images.camera_frame, rig.imu_frame, T)
            )

    def _add_static(self, transform: Transform | None) -> None:
        """Publish *transform* with the earlier ones: a late subscriber receives only the last message."""
        if transform is not None:
            self._statics.append(transform)
            for message in self._outgoing.transforms(self._statics, is_static=True):
                self._publish(message)

    def _publish_transforms(self, transforms: list[Transform]) -> None:
        for message in self._outgoing.transforms(self._frames.permitted(transforms)):
            self._publish(message)

    async def _repeat_transform(self) -> None:
        """Publish the transform from map to odometry frame at 10 Hz, and the status, until cancelled."""
        last_s = self._clock()
        while True:
            elapsed_s = self._clock() - last_s
            last_s += elapsed_s
            self._update_status()
            T_map_odom = self._poses.map_to_odom(elapsed_s) if self._frames.base else None
            now_ns = self._now_ns() if self._uses_ros_clock else self._stamp_ns
            stamp_ns = now_ns + round(1e9 * self._options.transform_tolerance_s)
            if T_map_odom is not None and stamp_ns != self._map_odom_ns:  # tf warns about a repeated stamp
                self._map_odom_ns = stamp_ns
                frames = self._frames
                self._publish_transforms(
                    [Transform(parent=frames.map, child=frames.odom, stamp_ns=stamp_ns, T=T_map_odom)]
                )
            await asyncio.sleep(_MAP_ODOM_EVERY_S)

    def _update_status(self) -> None:
        """Publish the status of the pose in the map if it has changed."""
        now, newest_ns = self._clock(), self._frames.newest_odometry_ns
        if newest_ns != self._odometry_seen[0]:
            self._odometry_seen = newest_ns, now
        is_carried = (
            self._frames.is_odometry_foreign
            and self._poses.is_odom_known
            and not self._is_elsewhere
            and now - self._odometry_seen[1] <= _ODOMETRY_STALE_S
        )
        status: PoseStatus = self._frame_status if now - self._frame_s <= _STALE_S else "lost"
        if status == "lost" and is_carried:
            status = "odometry"
        if status != "lost":
            self._lost_since_s = now
        if status != self._status:
            self._status = status
            self._publish(self._outgoing.status(status))

    def _alignment(
        self, mapper: Mapper | LiveMapper, tracked: TrackedFrame
    ) -> tuple[Array | None, Array | None]:
        """Return the pose ``(4, 4)`` of the mapper's world in the map and its covariance ``(6, 6)``.

        Both may be None with a live map.  A robot with a map of its own has the identity and None, or twice
        None while it is at a place that is not connected with the map.
        """
        if not isinstance(mapper, LiveMapper):
            return None if self._is_elsewhere else _IDENTITY, None
        T_map_world, pose = mapper.T_map_odom, tracked.T_world_camera
        if T_map_world is None and pose is not None and tracked.T_map_camera is not None:
            # The segment is not aligned yet, and continues one that is: the wheels have carried the pose.
            T_map_world = tracked.T_map_camera @ inverse(pose)
        return T_map_world, mapper.covariance

    async def _publish_path(self, T_map_world: Array) -> None:
        for message in await asyncio.to_thread(self._outgoing.path, T_map_world):
            self._publish(message)

    async def _publish_cloud(self, mapper: Mapper | LiveMapper, stamp_ns: int, T_map_world: Array) -> None:
        def made() -> list[Message]:
            least = 1 if isinstance(mapper, LiveMapper) else _LEAST_READINGS
            points, colours = mapper.map.points(min_readings=least)
            return self._outgoing.cloud(stamp_ns, T_map_world, points, colours)

        for message in await asyncio.to_thread(made):
            self._publish(message)

    async def _publish_floor_plan(self, mapper: Mapper | LiveMapper, stamp_ns: int) -> None:
        """Publish the floor plan if it has changed and the map is level.

        Otherwise the status message says why there is none.
        """
        try:
            if isinstance(mapper, LiveMapper):
                plan = await mapper.floor_plan(max_age_s=self._options.floor_plan_every_s)
            elif self._frames.T_base_camera is None:
                raise UsageError(self._frames.missing_mount or "there is no base_frame")
            else:
                plan = await asyncio.to_thread(mapper.floor_plan, GridOptions(up=(0.0, 0.0, 1.0)))
        except RsePfError as error:
            self._plan_trouble = f"no floor plan: {error.message}"
            return
        self._plan_trouble = ""
        if plan is not self._plan:
            self._plan = plan
            for message in self._outgoing.floor_plan(stamp_ns, plan):
                self._publish(message)

    async def _report(self) -> None:
        """Publish the status of the bridge each second, also if no frames arrive, until cancelled."""
        last, received, logged, check = 0, Counter[str](), "", self._incoming.check
        while True:
            connected = self._robot is None or self._robot.connected
            cause = "" if self._robot is None or connected else self._robot.stats.last_error
            if cause and cause != logged and not cause.startswith("connection lost"):  # is printed elsewhere
                show(f"no connection to the platform: {cause}")
            logged = cause
            mapper, frame_troubles = self._mapper, self._frames.troubles()
            for trouble in frame_troubles:
                self._print_once(trouble)
            values = {
                "frames": str(self.frames),
                "lost frames": str(self.lost_frames),
                "status": self._status or "lost",
                "base": self._frames.missing_mount or self._frames.base,
                "scale": "" if mapper is None else mapper.scale,
                "track ms (median)": f"{1e3 * median(self.track_s):.1f}" if self.track_s else "",
                "connected": str(connected).lower(),
                **{f"left out: {why}": str(count) for why, count in sorted(check.left_out.items())},
            }
            troubles = [
                "" if connected else f"no connection to the platform{cause and f': {cause}'}",
                check.fault,
                self._reason,
                self._silence(received, last),
                check.shortage,
                self._lateness(last),
                *frame_troubles,
                self._frames.missing_mount if self._options.planar or self._options.odometry else "",
            ]
            if mapper is not None:
                troubles += [mapper.odometry_trouble, self._plan_trouble]
            if isinstance(mapper, LiveMapper):
                values |= {"map": mapper.name, "map state": mapper.state}
                values["aligned"] = str(mapper.aligned).lower()
                troubles += [mapper.trouble, mapper.reason]
            text = next((trouble for trouble in troubles if trouble), "")
            lost_s = self._clock() - self._lost_since_s
            is_working = connected and self.frames > 0 and lost_s <= _LOST_ERROR_S
            if self.frames and lost_s > _LOST_ERROR_S:
                text = f"lost for {lost_s:.0f} s{text and f': {text}'}"
            level = _ERROR if not is_working else _WARNING if text else _OK
            check.next_report()
            last, received = self.frames, Counter(self._incoming.received)
            self._publish(
                self._outgoing.diagnostics(
                    self._stamp_ns, level=level, text=text or "poses are given", values=values
                )
            )
            await asyncio.sleep(_DIAGNOSTICS_EVERY_S)

    def _print_once(self, sentence: str) -> None:
        if sentence and sentence not in self._printed:
            self._printed.add(sentence)
            show(sentence)

    def _why_full(self) -> tuple[str, str]:
        """Return why an image does not fit into the queue: the key of the count, and the sentence."""
        if self._robot is not None and not self._robot.connected:
            return "no connection", "there was no connection to the platform"
        return TOO_FAST if self._mapper is not None else ("before the start", "the bridge has just started")

    def _lateness(self, frames_before: int) -> str:
        """Return a sentence if no frame was tracked since the count *frames_before*, else an empty text."""
        if self.frames != frames_before:
            return ""
        if self._tracking_since_s is not None:
            return f"an image is tracked for {self._clock() - self._tracking_since_s:.1f} s"
        return f"no new frame of {self._options.named(self._options.colour)}"

    def _silence(self, before: Counter[str], frames_before: int) -> str:
        """Return a sentence with the image topics that sent no message since the counts *before*.

        The text is empty if each topic sent a message, or if a frame was tracked since.
        """
        if self.frames != frames_before:
            return ""
        partner = self._options.partner
        topics = {"colour": self._options.colour}
        if partner:
            topics[partner] = str(getattr(self._options, partner))
        now = self._incoming.received
        silent = [
            self._options.named(name) for role, name in topics.items() if name and now[role] == before[role]
        ]
        return f"no new message of {' and '.join(silent)}" if silent else ""


@contextlib.asynccontextmanager
async def connected_bridge(
    options: BridgeOptions,
    publish: Publish,
    *,
    is_ros1: bool,
    now_ns: Callable[[], int] = time.time_ns,
) -> AsyncIterator[Bridge]:
    """Connect to the platform, and yield a bridge; close all afterwards.

    With the first image, the bridge joins the live map if *options* name one.  *now_ns* returns the time of
    ROS in nanoseconds.

    Raises:
        UsageError: The options have no address, or the token cannot be read.
        RsePfError: The platform rejected the robot.
    """
    async with connect_robot(options) as robot:

        @contextlib.asynccontextmanager
        async def open_mapper(T_base_camera: Array | None) -> AsyncIterator[Mapper | LiveMapper]:
            if options.map:
                async with robot.live_map(options.map, depth=True, T_base_camera=T_base_camera) as live:
                    yield live
                return
            keeps_keyframes = options.publish_as or options.floor_plan_every_s
            name = (options.namespace.strip("/") or "robot") if keeps_keyframes else ""
            is_deep = options.partner == "depth"
            is_planar = options.planar and T_base_camera is not None
            yield robot.mapper(
                depth=is_deep, keyframes_of=name, T_base_camera=T_base_camera, planar=is_planar
            )

        bridge = Bridge(open_mapper, options, publish, is_ros1=is_ros1, robot=robot, now_ns=now_ns)
        try:
            yield bridge
        finally:
            await bridge.close()
