"""A ROS bridge without ROS: messages of a robot, and what the bridge publishes for them."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import CAMERA_INFO, IMAGE, ODOMETRY, POSE_WITH_COVARIANCE, TF
from client_sdk.frontend import Frame
from client_sdk.mapper import Mapper
from ros_bridge import Bridge, BridgeOptions
from ros_bridge.incoming import Role
from ros_bridge.outgoing import Message
from rse_pf.geometry import Array, from_quaternion
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import frame_at
from tests.kit.small_bags import raw_image

__all__ = [
    "MAKER",
    "START_NS",
    "STEP_NS",
    "Heard",
    "count_of",
    "drive",
    "messages_of",
    "running",
    "send",
    "send_odometry",
    "send_transforms",
]

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
"""Time between two frames."""
MAKER = MessageMaker(is_ros1=True)


class Heard:
    """What a bridge published; `until` waits for it."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self._changed = asyncio.Event()

    def publish(self, message: Message) -> None:
        self.messages.append(message)
        self._changed.set()

    async def until(self, enough: Callable[[list[Message]], bool]) -> None:
        async def wait() -> None:
            while not enough(self.messages):
                self._changed.clear()
                await self._changed.wait()

        await asyncio.wait_for(wait(), 20)  # also if messages of another kind come each second

    def of(self, kind: str, maker: MessageMaker = MAKER, topic: str = "") -> list[Any]:
        messages = [each for each in self.messages if each.kind == kind and topic in ("", each.topic)]
        return [maker.decode(kind, each.data) for each in messages]

    def transforms(self, parent: str, child: str) -> list[tuple[int, Array]]:
        """Return time stamps and poses of the transforms from *parent* to *child*."""
        return [
            (stamp_of(each), pose_of(each.transform.translation, each.transform.rotation))
            for message in self.of(TF)
            for each in message.transforms
            if (each.header.frame_id, each.child_frame_id) == (parent, child)
        ]

    def parents(self) -> dict[str, set[str]]:
        """Return the parents of each frame that the bridge published as a child."""
        found: dict[str, set[str]] = {}
        for message in self.of(TF):
            for each in message.transforms:
                found.setdefault(each.child_frame_id, set()).add(each.header.frame_id)
        return found


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def pose_of(position: Any, orientation: Any) -> Array:
    T = np.eye(4)
    T[:3, :3] = from_quaternion([orientation.x, orientation.y, orientation.z, orientation.w])
    T[:3, 3] = position.x, position.y, position.z
    return T


def messages_of(maker: MessageMaker, frame: Frame, row: int) -> list[tuple[str, bytes]]:
    """Return the messages that a driver would send for a frame."""
    stamp, camera = START_NS + row * STEP_NS, frame.camera
    roi = maker.make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    info = maker.make(
        CAMERA_INFO, header=maker.header(stamp, "eye"), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=camera.matrix.ravel(), r=np.eye(3).ravel(),
        p=np.hstack((camera.matrix, np.zeros((3, 1)))).ravel(), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip
    colour = raw_image(maker, stamp, frame.rgb, "rgb8")
    depth = raw_image(maker, stamp, np.round(1000 * frame.depth_m).astype(np.uint16), "16UC1")
    return [
        ("info", maker.encode(CAMERA_INFO, info)),
        ("colour", maker.encode(IMAGE, colour)),
        ("depth", maker.encode(IMAGE, depth)),
    ]


@asynccontextmanager
async def running(
    heard: Heard,
    robot: Any = None,
    *,
    make_mapper: Callable[[Array | None], Any] = lambda T: Mapper(ask=solve, T_base_camera=T),
    now_ns: Callable[[], int] | None = None,
    clock: Callable[[], float] = time.monotonic,
    before: Callable[[Bridge], None] = lambda bridge: None,
    **options: Any,
) -> AsyncIterator[Bridge]:
    """A bridge that runs, and publishes to *heard*; *before* may send messages before it starts.

    Without other options, the camera is its base.
    """

    @asynccontextmanager
    async def open_mapper(T_base_camera: Array | None) -> AsyncIterator[Any]:
        yield make_mapper(T_base_camera)

    chosen = BridgeOptions.of({"base_frame": "", **options})
    now_ns = now_ns or itertools.count(START_NS, 1_000_000).__next__
    bridge = Bridge(open_mapper, chosen, heard.publish, is_ros1=True, robot=robot, clock=clock, now_ns=now_ns)
    before(bridge)
    task = asyncio.create_task(bridge.run())
    try:
        yield bridge
        assert not task.done()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await bridge.close()


def send(bridge: Bridge, frame: Frame, row: int, *roles: str) -> None:
    """Send the messages of a frame, or those of some roles."""
    for role, data in messages_of(MAKER, frame, row):
        if role in (roles or ("info", "colour", "depth")):
            bridge.receive(role, data)  # type: ignore[arg-type]


def send_transforms(bridge: Bridge, role: Role, edges: Iterable[tuple[int, str, str, Array]]) -> None:
    """Send a message of ``tf`` or ``tf_static``: time stamp, parent, child and pose of each transform."""
    made = [MAKER.transform(*edge) for edge in edges]
    bridge.receive(role, MAKER.encode(TF, MAKER.transforms(made)))


def send_odometry(bridge: Bridge, stamp_ns: int, T: Array, frames: tuple[str, str]) -> None:
    """Send a message of the topic of odometry."""
    message = MAKER.odometry(stamp_ns, frames, T, np.zeros((6, 6)))
    bridge.receive("odometry", MAKER.encode(ODOMETRY, message))


def count_of(kind: str, count: int) -> Callable[[list[Message]], bool]:
    """Return a function that returns whether *count* messages of a kind have come."""
    return lambda heard: sum(each.kind == kind for each in heard) >= count


async def drive(bridge: Bridge, heard: Heard, rows: int) -> None:
    """Send frames of the flat world, and wait for the pose of each one."""
    for row in range(rows):
        send(bridge, frame_at(row, depth=True), row)
        await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))
