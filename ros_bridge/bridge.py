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
from typing import Any

import numpy as np

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.live import LiveMapper
from client_sdk.mapper import Mapper
from client_sdk.robot import Robot
from ros_bridge.access import connect_robot
from ros_bridge.incoming import IncomingFrames, PairedImages, Role
from ros_bridge.map_services import MapServices, as_json
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import Message, OutgoingMessages
from rse_pf.errors import RsePfError, UsageError
from rse_pf.geometry import Array, Camera
from rse_pf.terminal import show

__all__ = ["Bridge", "CallReply", "Publish", "connected_bridge"]

Publish = Callable[[Message], None]
"""Publishes a message; called from the bridge's event loop, so it must not wait."""

# Time between two status messages, in seconds.
_DIAGNOSTICS_EVERY_S = 1.0
# Time between two messages with the path, in seconds.
_PATH_EVERY_S = 0.5
# Smallest number of measurements of a point that is published in the cloud of a robot's own map.
_LEAST_READINGS = 2
# Deadline of a call of the platform through the ROS service ``call``, in seconds.
_CALL_S = 10.0
# A frame that is earlier than the last one by more than this, in seconds, comes from a restarted source.
_CLOCK_RESTART_S = 1.0
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
        mapper: Mapper | LiveMapper,
        options: BridgeOptions,
        publish: Publish,
        *,
        is_ros1: bool,
        robot: Robot | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Describe a bridge.

        Args:
            mapper: The mapper of a connected robot.
            options: The options of the bridge.
            publish: Called with each message to publish.
            is_ros1: Whether messages are encoded as in ROS 1; otherwise as CDR, as in ROS 2.
            robot: The robot with which ROS services call the platform; None lets those services fail.
            clock: Returns seconds, monotonic; for the intervals between clouds and paths.
        """
        maker = MessageMaker(is_ros1=is_ros1)
        self.frames = 0
        self.lost_frames = 0
        self.track_s: list[float] = []
        self._mapper, self._options, self._publish, self._robot = mapper, options, publish, robot
        self._incoming = IncomingFrames(maker, options)
        self._outgoing = OutgoingMessages(maker, options)
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._has_frame = asyncio.Event()
        self._due = {"cloud": clock() + options.cloud_every_s, "path": clock()}
        self._stamp_ns = 0
        self._last_s = float("-inf")
        self._reason = ""
        self._cloud: asyncio.Task[None] | None = None
        self._maps = None if robot is None else MapServices(robot, mapper, options)
        self._seen: Camera | None = None
        self._publishes_imu = bool(options.imu) and options.publish_odom

    def close(self) -> None:
        """Close the connection to the data service, if a service of maps has opened one."""
        if self._maps is not None:
            self._maps.close()

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
        if self._incoming.add(role, data):
            with contextlib.suppress(RuntimeError):  # the event loop is closed: the bridge has stopped
                self._loop.call_soon_threadsafe(self._has_frame.set)

    async def run(self) -> None:
        """Track frames and publish the results, until cancelled.

        Raises:
            RsePfError: The robot has stopped reconnecting: its token expired, or another robot uses its name.
        """
        running = [asyncio.create_task(self._take()), asyncio.create_task(self._report())]
        try:
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            ending = [*running, *([self._cloud] if self._cloud is not None else [])]
            for task in ending:
                task.cancel()
            await asyncio.gather(*ending, return_exceptions=True)

    async def save(self) -> CallReply:
        """Write map and trajectory to the folder ``out`` of the options.

        Return the mapper's report as JSON.
        """
        if not self._options.out:
            return CallReply(ok=False, code="usage", message="no folder: set the parameter out")
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
        if self._maps is None:
            return CallReply(ok=False, code="disconnected", message="this bridge has no connection")
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
        frame = await asyncio.to_thread(self._incoming.decode, images)
        if frame is None:
            return
        started, self._seen = time.perf_counter(), frame.camera
        try:
            tracked = await self._track(frame)
        except UsageError as error:
            self._incoming.check.refuse("not tracked", error.message)
            return
        self.track_s.append(time.perf_counter() - started)
        del self.track_s[:-10_000]
        self.frames += 1
        self._stamp_ns = images.stamp_ns
        self._reason = tracked.reason if tracked.lost else ""
        self.lost_frames += tracked.lost
        T_map_odom, alignment = self._alignment()
        for message in self._outgoing.of_frame(
            tracked, images.stamp_ns, images.camera_frame, T_map_odom=T_map_odom, alignment=alignment
        ):
            self._publish(message)
        self._publish_imu_pose(images)
        now = self._clock()
        if now >= self._due["path"]:
            self._due["path"] = now + _PATH_EVERY_S
            for message in self._outgoing.path():
                self._publish(message)
        if now >= self._due["cloud"] and (self._cloud is None or self._cloud.done()):
            self._due["cloud"] = now + self._options.cloud_every_s
            self._cloud = asyncio.create_task(self._publish_cloud(images.stamp_ns))

    def _publish_imu_pose(self, images: PairedImages) -> None:
        """Publish the IMU's pose in the camera frame once, when it and the IMU's frame name are known."""
        rig = self._incoming.rig
        T = rig.T_camera_imu
        if self._publishes_imu and rig.imu_frame and T is not None:
            self._publishes_imu = False
            self._publish(self._outgoing.imu_place(images.stamp_ns, images.camera_frame, rig.imu_frame, T))

    async def _track(self, frame: Frame) -> TrackedFrame:
        back_s = self._last_s - frame.timestamp_s
        if back_s > _CLOCK_RESTART_S:
            show(f"the time of the images went back by {back_s:.1f} s, as if a bag is played again")
            self._mapper.restart_clock()
        tracked = await self._mapper.track(frame)
        self._last_s = frame.timestamp_s
        return tracked

    def _alignment(self) -> tuple[Array | None, Array | None]:
        """Return the pose ``(4, 4)`` of the odometry frame in the map and its covariance ``(6, 6)``.

        Both may be None with a live map.  A robot with a map of its own has the identity and None.
        """
        if isinstance(self._mapper, LiveMapper):
            return self._mapper.T_map_odom, self._mapper.covariance
        return _IDENTITY, None

    async def _publish_cloud(self, stamp_ns: int) -> None:
        def made() -> list[Message]:
            least = 1 if isinstance(self._mapper, LiveMapper) else _LEAST_READINGS
            points, colours = self._mapper.map.points(min_readings=least)
            return self._outgoing.cloud(stamp_ns, points, colours)

        for message in await asyncio.to_thread(made):
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
            values = {
                "frames": str(self.frames),
                "lost frames": str(self.lost_frames),
                "scale": self._mapper.scale,
                "track ms (median)": f"{1e3 * median(self.track_s):.1f}" if self.track_s else "",
                "connected": str(connected).lower(),
                **{f"left out: {why}": str(count) for why, count in sorted(check.left_out.items())},
            }
            trouble = "" if connected else f"no connection to the platform{cause and f': {cause}'}"
            trouble = (
                trouble or check.fault or self._reason or self._silence(received, last) or check.shortage
            )
            if isinstance(self._mapper, LiveMapper):
                values |= {"map": self._mapper.name, "map state": self._mapper.state}
                values["aligned"] = str(self._mapper.aligned).lower()
                trouble = trouble or self._mapper.trouble or self._mapper.reason
            if not trouble and self.frames == last:
                trouble = f"no new frame of {self._options.named(self._options.colour)}"
            check.next_report()
            last, received = self.frames, Counter(self._incoming.received)
            self._publish(
                self._outgoing.diagnostics(
                    self._stamp_ns, trouble=trouble, is_working=connected and self.frames > 0, values=values
                )
            )
            await asyncio.sleep(_DIAGNOSTICS_EVERY_S)

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
    options: BridgeOptions, publish: Publish, *, is_ros1: bool
) -> AsyncIterator[Bridge]:
    """Connect to the platform, join the live map if *options* name one, and yield a bridge.

    Close all afterwards.

    Raises:
        UsageError: The options have no address, or the token cannot be read.
        RsePfError: The platform rejected the robot.
    """
    async with connect_robot(options) as robot, contextlib.AsyncExitStack() as stack:
        mapper: Mapper | LiveMapper
        if options.map:
            mapper = await stack.enter_async_context(robot.live_map(options.map, depth=True))
        else:
            name = (options.namespace.strip("/") or "robot") if options.publish_as else ""
            mapper = robot.mapper(depth=options.partner == "depth", keyframes_of=name)
        bridge = Bridge(mapper, options, publish, is_ros1=is_ros1, robot=robot)
        stack.callback(bridge.close)
        yield bridge
